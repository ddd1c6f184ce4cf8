"""What all scripts of the experiment have in common: command line, processes, files.

A run is one question, learnt by one library from one seed. It leaves a JSON file, which says what came out, and beside
it whatever the library needs to load its policy again. A run whose file is there is not done again: a script that was
interrupted goes on where it was, with the run that it was at from its beginning.
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

from ..env import raw_env
from ..train import OUT, Team
from .questions import CURVE, FINAL, QUESTIONS, Question, Verdict, judge

Job = TypeVar("Job")
Result = TypeVar("Result")

RUNS: Final = OUT / "experiment"
"""Where runs are kept, unless ``--out`` says otherwise. Nothing of it is under version control."""


@dataclass(frozen=True)
class Run:
    """A run.

    Attributes:
        library: Who learns.
        question: The key of what is asked.
        seed: Determines everything.
        budget: The days that may be simulated for learning.
        out: The folder of all runs.
    """

    library: str
    question: str
    seed: int
    budget: int
    out: Path

    @property
    def asked(self) -> Question:
        """What is asked."""
        return QUESTIONS[self.question]

    @property
    def stem(self) -> Path:
        """The path of the run's files, without a suffix."""
        return self.out / f"{self.library}-{self.question}-{self.seed}"

    @property
    def file(self) -> Path:
        """What came out."""
        return self.stem.with_suffix(".json")

    def of(self, question: str) -> Run:
        """The run of another question, all else alike."""
        return Run(self.library, question, self.seed, self.budget, self.out)


class Log:
    """Judges what a run has learnt so far, and writes it down in the end."""

    def __init__(self, run: Run, settings: Mapping[str, Any]) -> None:
        """Open the log of a run.

        Args:
            run: The run.
            settings: With what it learns; such as JSON can hold.
        """
        self._run, self._settings = run, dict(settings)
        self._environment = raw_env()
        self._began = time.process_time()
        self._curve: list[dict[str, Any]] = []

    def judge(self, days: int, team: Team) -> None:
        """Add a point to the learning curve.

        Args:
            days: How many have been simulated for learning.
            team: As it plays now.
        """
        self._curve.append({"days": days, **asdict(judge(self._environment, team, CURVE))})

    def close(self, days: int, team: Team) -> Verdict:
        """Judge what was learnt in the end, and write the run's file: nothing may go wrong after that.

        Args:
            days: How many have been simulated for learning.
            team: As it plays in the end.
        """
        seconds = time.process_time() - self._began
        verdict = judge(self._environment, team, FINAL)
        self._environment.close()
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
    """Write a JSON file, all of it or nothing."""
    unfinished = path.with_suffix(".unfinished")
    unfinished.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    unfinished.replace(path)


def parser(description: str, *, budget: int, questions: Iterable[str] = ()) -> argparse.ArgumentParser:
    """What scripts understand on the command line.

    Args:
        description: What the script does.
        budget: How many days a run may simulate where nobody says otherwise.
        questions: What the script can answer.
    """
    made = argparse.ArgumentParser(description=description)
    if questions := list(questions):
        made.add_argument("--questions", nargs="+", choices=questions, default=questions, metavar="QUESTION")
    made.add_argument("--seeds", nargs="+", type=int, default=list(range(5)), metavar="SEED", help="default: 0 to 4")
    made.add_argument("--budget", type=int, default=budget, help="simulated days for each run (default: %(default)s)")
    made.add_argument("--workers", type=int, default=1, help="runs at a time, in processes (default: %(default)s)")
    made.add_argument("--out", type=Path, default=RUNS, help="folder for all runs (default: %(default)s)")
    return made


def carry_out(library: str, learn: Callable[[Run], Verdict], options: argparse.Namespace) -> None:
    """Carry out all runs of a script that have not been carried out before.

    Args:
        library: Who learns.
        learn: Carries out one run; a function of a module, so that other processes find it.
        options: Of the command line.
    """
    options.out.mkdir(parents=True, exist_ok=True)
    runs = [
        Run(library, question, seed, options.budget, options.out)
        for question in options.questions
        for seed in options.seeds
    ]
    # Those who need what another run has learnt come after all others.
    for stage in ([run for run in runs if not run.asked.needs], [run for run in runs if run.asked.needs]):
        pending = [run for run in stage if not _done(run)]
        for run, verdict in zip(pending, each(learn, pending, options.workers), strict=True):
            _tell(run, verdict)


def each(function: Callable[[Job], Result], jobs: Sequence[Job], workers: int) -> Iterator[Result]:
    """Do jobs, one after the other or several at a time; what comes out stands in their order.

    Args:
        function: Does a job; such as can be pickled.
        jobs: What is to be done.
        workers: In how many processes. None of them is this one: in theirs, all sets of strings have the same order,
            on which it depends what RLlib comes to.
    """
    os.environ["PYTHONHASHSEED"] = "0"
    context = multiprocessing.get_context("spawn")  # forks of a process that may have threads are no good
    with ProcessPoolExecutor(workers, context) as executor:
        yield from executor.map(function, jobs)


def _done(run: Run) -> bool:
    if not run.file.exists():
        return False
    budget = json.loads(run.file.read_text(encoding="utf-8"))["budget"]
    if budget != run.budget:
        raise SystemExit(
            f"{run.file} is of a run with a budget of {budget} days, not {run.budget}: give --budget {budget},"
            " or another folder as --out"
        )
    print(f"{run.file.name} is there already")
    return True


def _tell(run: Run, verdict: Verdict) -> None:
    print(
        f"{run.library} {run.question} ({run.asked.title}), seed {run.seed}: return {verdict.value:.1f},"
        f" {verdict.alive:.0f} plants alive, {verdict.litres:.0f} litres",
        flush=True,
    )
