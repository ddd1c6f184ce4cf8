"""Shared by all scripts of the experiment: command line, processes, files.

A run is one question, answered by one library from one seed. It writes a JSON file with its
results, and beside it the files from which the library can load the policy. A run whose JSON file
exists is not repeated: an interrupted script resumes with the run that it was at, which starts from
the beginning.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from examples.greenhouse_coop.train import Team

from .questions import CURVE, FINAL, QUESTIONS, Question, Verdict, judge

Job = TypeVar("Job")
Result = TypeVar("Result")

RUNS: Final = Path(__file__).parent / "out"
"""The default folder of runs; it is not under version control."""


@dataclass(frozen=True)
class Run:
    """A run of the experiment.

    Attributes:
        library: The learning library.
        question: The key of the question.
        seed: The seed of the run.
        budget: The number of simulated days for learning.
        out: The folder of all runs.
    """

    library: str
    question: str
    seed: int
    budget: int
    out: Path

    @property
    def asked(self) -> Question:
        """The question."""
        return QUESTIONS[self.question]

    @property
    def stem(self) -> Path:
        """The path of the run's files, without a suffix."""
        return self.out / f"{self.library}-{self.question}-{self.seed}"

    @property
    def file(self) -> Path:
        """The path of the file with the results."""
        return self.stem.with_suffix(".json")

    def of(self, question: str) -> Run:
        """Return the run of another question with the same other attributes."""
        return Run(self.library, question, self.seed, self.budget, self.out)


class Log:
    """The log of a run: evaluates the policies so far, and writes the results at the end."""

    def __init__(self, run: Run, settings: Mapping[str, Any]) -> None:
        """Open the log of a run.

        Args:
            run: The run.
            settings: The learner's settings, serialisable to JSON.
        """
        self._run, self._settings = run, dict(settings)
        self._began = time.process_time()
        self._curve: list[dict[str, Any]] = []

    def judge(self, days: int, team: Team) -> None:
        """Add a point to the learning curve.

        Args:
            days: The number of days simulated for learning so far.
            team: The current policies.
        """
        self._curve.append({"days": days, **asdict(judge(team, CURVE))})

    def close(self, days: int, team: Team) -> Verdict:
        """Evaluate the final policies, and write the run's file; nothing may fail after that.

        Args:
            days: The number of days simulated for learning.
            team: The final policies.
        """
        seconds = time.process_time() - self._began
        verdict = judge(team, FINAL)
        write(
            self._run.file,
            {
                "library": self._run.library,
                "question": self._run.question,
                "seed": self._run.seed,
                "budget": self._run.budget,
                "days": days,
                "seconds": round(seconds, 1),
                "settings": self._settings,
                "curve": self._curve,
                "final": asdict(verdict),
            },
        )
        return verdict


def write(path: Path, found: Any) -> None:
    """Write a JSON file atomically."""
    unfinished = path.with_suffix(".unfinished")
    unfinished.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    unfinished.replace(path)


def parser(
    description: str, *, budget: int, questions: Iterable[str] = ()
) -> argparse.ArgumentParser:
    """Make the command line parser of a script.

    Args:
        description: The description of the script.
        budget: The default number of simulated days per run.
        questions: The keys of the questions that the script can answer.
    """
    made = argparse.ArgumentParser(description=description)
    if questions := list(questions):
        made.add_argument(
            "--questions", nargs="+", choices=questions, default=questions, metavar="QUESTION"
        )
    made.add_argument(
        "--seeds",
        nargs="+",
        type=int,
        default=list(range(5)),
        metavar="SEED",
        help="default: 0 to 4",
    )
    made.add_argument(
        "--budget",
        type=int,
        default=budget,
        help="simulated days for each run (default: %(default)s)",
    )
    made.add_argument(
        "--workers", type=int, default=1, help="parallel runs, in processes (default: %(default)s)"
    )
    made.add_argument(
        "--out", type=Path, default=RUNS, help="folder for all runs (default: %(default)s)"
    )
    return made


def carry_out(library: str, learn: Callable[[Run], Verdict], options: argparse.Namespace) -> None:
    """Carry out the missing runs of a script.

    Args:
        library: The learning library.
        learn: The function that carries out one run; at module level, so that other processes can
            import it.
        options: The options of the command line.
    """
    options.out.mkdir(parents=True, exist_ok=True)
    runs = [
        Run(library, question, seed, options.budget, options.out)
        for question in options.questions
        for seed in options.seeds
    ]
    # runs that need the policy of another run come last
    for stage in (
        [run for run in runs if not run.asked.needs],
        [run for run in runs if run.asked.needs],
    ):
        pending = [run for run in stage if not _done(run)]
        for run, verdict in zip(pending, each(learn, pending, options.workers), strict=True):
            _tell(run, verdict)


def each(function: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """Run jobs in processes; the results come in the order of the jobs.

    Args:
        function: The function that runs a job; it must be picklable.
        jobs: The arguments of the function.
        workers: The number of processes. The calling process is none of them, because the hash seed
            is fixed in the workers: RLlib's results depend on the order of sets of strings.
    """
    os.environ["PYTHONHASHSEED"] = "0"
    context = multiprocessing.get_context("spawn")  # a process with threads should not fork
    with ProcessPoolExecutor(workers, context) as executor:
        yield from executor.map(function, jobs)


def _done(run: Run) -> bool:
    if not run.file.exists():
        return False
    budget = json.loads(run.file.read_text(encoding="utf-8"))["budget"]
    if budget != run.budget:
        raise SystemExit(
            f"{run.file} is of a run with a budget of {budget} days, not {run.budget}: give"
            f" --budget {budget}, or another folder as --out"
        )
    print(f"{run.file.name} is there already")
    return True


def _tell(run: Run, verdict: Verdict) -> None:
    print(
        f"{run.library} {run.question} ({run.asked.title}), seed {run.seed}: return"
        f" {verdict.value:.1f},"
        f" {verdict.alive:.0f} plants alive, {verdict.litres:.0f} litres",
        flush=True,
    )
