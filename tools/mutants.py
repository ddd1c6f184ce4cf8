"""Mutation tests of the library: put small mistakes into a copy of it, one at a time.

Do the tests find them?

Run it with ``python -m tools.mutants``, or ``make mutants``. It writes each result to a file at
once, one JSON object per line. A second call resumes where the first stopped; with ``--again`` it
retries the survivors, for example after tests were added. It draws mutants from all modules except
``testing`` and those that draw plots.

Before the first mutant, it runs all tests once and measures their durations, and which tests
execute which lines, also in processes that they start. Only tests that execute a mutant's module
run for it: first those that execute its line, then those that execute its function, some quick ones
of each file before the others.

A mutant that survives can cost half an hour, because nearly all tests execute some functions of the
core. ``--most`` limits the tests for each mutant to the first ones; the report says how many of
them ran.

Some changes are no mistakes (equivalent mutants): ``mutants_known.toml`` lists each with the
reason.
"""

from __future__ import annotations

import argparse
import difflib
import hashlib
import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from .mutants_draw import Mutant, candidates

ROOT = Path(__file__).parents[1]
PACKAGE = Path("src/simenv_marl")
LEFT_OUT = ("testing/", "data/plots.py", "data/timeline.py", "experiments/plots.py")
TEST_LIMIT = 20.0
"""The time limit of a test in seconds, in addition to ten times its normal duration."""
FIRST = 6
"""The number of tests of each file that come first, its quickest ones."""
QUICK = 0.2
"""The longest duration of those tests, in seconds."""
PROCESSES = """[run]
source_pkgs = simenv_marl
branch = true
concurrency = greenlet, thread
parallel = true
data_file = {folder}/processes
context = ${{PYTEST_CURRENT_TEST-}}
patch = _exit
"""
"""The settings of Coverage.py for processes that a test starts: their data name the test."""


@dataclass(frozen=True)
class Measured:
    """The measurements: which tests execute which lines, and their durations.

    Attributes:
        seconds: The durations of the tests that pass, in the order in which they ran.
        lines: For each module and line, the tests that execute it.
    """

    seconds: dict[str, float]
    lines: dict[str, dict[int, list[str]]]

    def tests(self, mutant: Mutant) -> list[str]:
        """List the tests that could find a mutant, in the order in which they should run.

        First those that execute its line; then those that execute any line of its function, because
        the measurement can miss lines after a switch between stacks; then those that execute any
        line of its module, because the measurement misses forks. If no test executes the module, as
        with code that runs at import, all tests.
        """
        lines = self.lines.get(mutant.module, {})
        found = [
            {test for line, tests in lines.items() if first <= line <= last for test in tests}
            for first, last in (mutant.lines, mutant.function, (0, math.inf))
        ]
        if not any(found):
            found = [set(self.seconds)]
        return list(dict.fromkeys(test for tests in found for test in self.ordered(tests)))

    def ordered(self, found: set[str]) -> list[str]:
        """Sort tests into their running order: some quick ones of each file first."""
        by_file: dict[str, list[str]] = {}
        for test in self.seconds:
            if test in found:
                by_file.setdefault(file_of(test), []).append(test)
        files = sorted(
            by_file.values(), key=lambda tests: sum(map(self.seconds.__getitem__, tests))
        )
        quick = [[test for test in tests if self.seconds[test] < QUICK] for tests in files]
        first_ones = [
            test
            for tests in quick
            for test in sorted(tests, key=lambda test: ("[thread" in test, self.seconds[test]))[
                :FIRST
            ]
        ]
        rest = [test for tests in files for test in tests]
        # the second driver rarely finds more than the first
        rest.sort(key=lambda test: "[thread" in test)
        return first_ones + rest


def file_of(test: str) -> str:
    """Return the file of a test."""
    return test.partition("::")[0]


def main() -> None:
    """Try mutants, and print a report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--number", type=int, default=200, help="number of mutants (200)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the draw (0)")
    parser.add_argument("--jobs", type=int, default=2, help="number of parallel jobs (2)")
    parser.add_argument(
        "--out", type=Path, default=ROOT / ".mutants", help="folder for the results"
    )
    parser.add_argument(
        "--only", default="", metavar="PATH", help="only modules whose path begins with PATH"
    )
    parser.add_argument(
        "--kind", default="", help="only mistakes of this kind, such as copy or clean-up"
    )
    parser.add_argument(
        "--most", type=float, default=math.inf, help="seconds of tests for each mutant (all tests)"
    )
    parser.add_argument("--again", action="store_true", help="retry the survivors")
    parser.add_argument("--report", action="store_true", help="only show the results so far")
    given = parser.parse_args()
    given.out.mkdir(exist_ok=True)
    results = given.out / f"seed-{given.seed}.jsonl"
    drawn = draw(given.number, given.seed, given.only, given.kind)
    done = {result["mutant"]: result for result in read(results)}
    if given.again:
        done = {name: result for name, result in done.items() if result["outcome"] != "survived"}
    missing = [mutant for mutant in drawn if mutant.name not in done]
    if missing and not given.report:
        measured = measure(given.out / "measured.json")
        with results.open("a", encoding="utf-8") as file:
            for number, result in enumerate(tried(missing, measured, given.jobs, given.most), 1):
                done[result["mutant"]] = result
                file.write(json.dumps(result) + "\n")
                file.flush()
                print(
                    (
                        f"{number}/{len(missing)} {result['outcome']:8} {result['seconds']:6.1f}"
                        f" s  {result['mutant']}"
                    ),
                    flush=True,
                )
    report([done[mutant.name] for mutant in drawn if mutant.name in done])


def modules() -> list[str]:
    """List the modules from which mutants are drawn."""
    paths = sorted(
        path.relative_to(ROOT / PACKAGE).as_posix() for path in (ROOT / PACKAGE).rglob("*.py")
    )
    return [path for path in paths if not path.startswith(LEFT_OUT)]


def draw(number: int, seed: int, only: str = "", kind: str = "") -> list[Mutant]:
    """Draw mutants: by each module's number of candidates, at least one, evenly by kind."""
    found = {
        path: candidates(path, (ROOT / PACKAGE / path).read_text(encoding="utf-8"))
        for path in modules()
    }
    found = {
        path: [mutant for mutant in mutants if kind in ("", mutant.kind)]
        for path, mutants in found.items()
    }
    found = {path: mutants for path, mutants in found.items() if mutants and path.startswith(only)}
    total = sum(map(len, found.values()))
    exact = {path: number * len(mutants) / total for path, mutants in found.items()}
    shares = {path: max(1, int(share)) for path, share in exact.items()}
    for path in sorted(exact, key=lambda path: int(exact[path]) - exact[path]):
        if sum(shares.values()) < number:
            shares[path] += 1
    drawn = []
    for path, mutants in found.items():
        chance = random.Random(f"{seed} {path}")
        kinds: dict[str, list[Mutant]] = {}
        for mutant in mutants:
            kinds.setdefault(mutant.kind, []).append(mutant)
        for _ in range(min(shares[path], len(mutants))):
            kind = chance.choice([kind for kind in sorted(kinds) if kinds[kind]])
            drawn.append(kinds[kind].pop(chance.randrange(len(kinds[kind]))))
    random.Random(seed).shuffle(drawn)
    return drawn


# -- which test executes which lines --------------------------------------------------------------


def copied(folder: Path) -> Path:
    """Copy all files of the repository to a folder, but for those that Git ignores."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    names = subprocess.run(
        command, cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.split("\0")
    for name in names:
        if (ROOT / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / name)
    return folder


def environment(folder: Path, **more: Path) -> dict[str, str]:
    """Return the environment variables for the tests of a copy."""
    path = os.pathsep.join([str(folder / "src"), str(folder)])
    return (
        os.environ
        | {"PYTHONPATH": path, "MUTANTS_ROOT": str(folder)}
        | {name: str(at) for name, at in more.items()}
    )


def measure(cache: Path) -> Measured:
    """Measure the lines that each test executes, or load them for the same sources and tests."""
    digest = hashlib.sha256()
    for path in sorted([*ROOT.glob("src/**/*.py"), *ROOT.glob("tests/**/*.py")]):
        digest.update(path.read_bytes())
    if (
        cache.exists()
        and (known := json.loads(cache.read_text(encoding="utf-8")))["digest"] == digest.hexdigest()
    ):
        lines = {
            path: {int(at): tests for at, tests in of.items()}
            for path, of in known["lines"].items()
        }
        names = list(known["seconds"])
        by_name = {
            path: {at: [names[n] for n in numbers] for at, numbers in of.items()}
            for path, of in lines.items()
        }
        return Measured(known["seconds"], by_name)
    print("measuring which tests execute which lines", flush=True)
    with tempfile.TemporaryDirectory(prefix="mutants-") as temporary:
        folder = copied(Path(temporary).resolve())
        notes, data, settings = folder / "notes.jsonl", folder / "coverage", folder / "settings.ini"
        settings.write_text(PROCESSES.format(folder=folder), encoding="utf-8")
        options = [
            "-q",
            "-n",
            "2",
            "--driver",
            "greenlet",
            "-p",
            "tools.mutants_plugin",
            "--cov",
            "--cov-context=test",
        ]
        command = [sys.executable, "-m", "pytest", *options, "--cov-report=", "tests"]
        variables = environment(
            folder, MUTANTS_NOTE=notes, MUTANTS_COVERAGE=settings, COVERAGE_FILE=data
        )
        subprocess.run(command, cwd=folder, env=variables, check=False)
        measured = measured_in(folder, notes, data)
    numbers = {name: number for number, name in enumerate(measured.seconds)}
    compact = {
        path: {at: [numbers[test] for test in tests] for at, tests in of.items()}
        for path, of in measured.lines.items()
    }
    content = {"digest": digest.hexdigest(), "seconds": measured.seconds, "lines": compact}
    cache.write_text(json.dumps(content), encoding="utf-8")
    return measured


def measured_in(folder: Path, notes: Path, data: Path) -> Measured:
    """Read the measurements of the tests of a copy, and of the processes that they have started."""
    from coverage.exceptions import CoverageException

    outcomes: dict[str, tuple[str, float]] = {}
    for name, outcome, seconds in read(notes):
        if outcomes.get(name, ("passed",))[0] == "passed":
            outcomes[name] = outcome, seconds
    for name in (name for name, (outcome, _) in outcomes.items() if outcome != "passed"):
        print(f"left out, because it fails without a mutant: {name}", flush=True)
    seconds_of = {
        name: seconds for name, (outcome, seconds) in outcomes.items() if outcome == "passed"
    }
    lines: dict[str, dict[int, set[str]]] = {}
    at_import = set()
    for module, line, contexts in covered(data, folder):
        lines.setdefault(module, {})[line] = {
            context.rpartition("|")[0] for context in contexts
        } & seconds_of.keys()
        if "" in contexts:
            at_import.add((module, line))
    for part in folder.glob("processes.*"):
        with suppress(CoverageException):  # its process was killed while it wrote
            for module, line, contexts in covered(part, folder):
                if (module, line) not in at_import:
                    tests = {
                        context.rpartition(" (")[0] for context in contexts
                    } & seconds_of.keys()
                    lines.setdefault(module, {}).setdefault(line, set()).update(tests)
    both = {
        module: {
            line: sorted(tests | set(map(twin, tests)))
            for line, tests in of_module.items()
            if tests
        }
        for module, of_module in lines.items()
    }
    return Measured(
        seconds_of | {twin(name): 2 * seconds for name, seconds in seconds_of.items()} | seconds_of,
        both,
    )


def covered(data: Path, folder: Path) -> Iterator[tuple[str, int, list[str]]]:
    """Iterate over the modules and lines of a Coverage.py file, with the contexts of each line."""
    from coverage import CoverageData

    measured = CoverageData(str(data))
    measured.read()
    for path in measured.measured_files():
        module = Path(path).resolve().relative_to(folder / PACKAGE).as_posix()
        for line, contexts in measured.contexts_by_lineno(path).items():
            yield module, line, contexts


def twin(test: str) -> str:
    """Return the same test with the other driver, which is assumed to execute the same lines."""
    return test.replace("[greenlet", "[thread", 1)


def read(path: Path) -> list[Any]:
    """Read the objects of a file of JSON lines; none if there is no file."""
    return (
        list(map(json.loads, path.read_text(encoding="utf-8").splitlines()))
        if path.exists()
        else []
    )


# -- trying mutants -------------------------------------------------------------------------------


def tried(
    mutants: list[Mutant], measured: Measured, jobs: int, most: float
) -> Iterator[dict[str, Any]]:
    """Run the tests for each mutant, several mutants in parallel, each in its own copy."""
    with (
        tempfile.TemporaryDirectory(prefix="mutants-") as temporary,
        ThreadPoolExecutor(jobs) as threads,
    ):
        free: SimpleQueue[Path] = SimpleQueue()
        for number in range(jobs):
            (Path(temporary).resolve() / str(number)).mkdir()
            free.put(copied(Path(temporary).resolve() / str(number)))

        def try_one(mutant: Mutant) -> dict[str, Any]:
            folder = free.get()
            try:
                return outcome(mutant, folder, measured, most)
            finally:
                free.put(folder)

        for future in as_completed([threads.submit(try_one, mutant) for mutant in mutants]):
            yield future.result()


def outcome(mutant: Mutant, folder: Path, measured: Measured, most: float) -> dict[str, Any]:
    """Find out whether a test finds a mutant, and which."""
    path = folder / PACKAGE / mutant.module
    original, begun = path.read_text(encoding="utf-8"), time.monotonic()
    changed = mutant.applied(original)
    found_by, notes = measured.tests(mutant), folder / "notes.jsonl"
    spent = accumulate(measured.seconds[test] for test in found_by)
    tests = [
        test for test, seconds in zip(found_by, spent, strict=True) if seconds <= most
    ] or found_by[:1]
    notes.unlink(missing_ok=True)
    chosen = folder / "chosen.json"
    chosen.write_text(
        json.dumps({test: TEST_LIMIT + 10 * measured.seconds[test] for test in tests}),
        encoding="utf-8",
    )
    files = list(dict.fromkeys(map(file_of, tests)))
    options = ["-x", "-q", "-p", "no:cacheprovider", "-p", "tools.mutants_plugin"]
    limit = 120 + 3 * sum(measured.seconds[test] for test in tests)
    try:
        write(path, changed)
        found = run(
            [sys.executable, "-m", "pytest", *options, *files],
            folder,
            environment(folder, MUTANTS_NOTE=notes, MUTANTS_TESTS=chosen),
            limit,
        )
    finally:
        write(path, original)
    ran = read(notes)
    killers = [name for name, said, _ in ran if said == "failed"]
    return {
        "mutant": mutant.name,
        "module": mutant.module,
        "kind": mutant.kind,
        "outcome": "survived" if found == 0 else "killed",
        "exit": found,
        "by": killers[0] if killers else None,
        "tests": len(ran),
        "of": len(found_by),
        "seconds": round(time.monotonic() - begun, 1),
        "diff": "".join(
            difflib.unified_diff(
                original.splitlines(keepends=True),
                changed.splitlines(keepends=True),
                mutant.module,
                mutant.kind,
                n=2,
            )
        ),
    }


def write(path: Path, text: str) -> None:
    """Write a module and delete its compiled files: timestamps miss changes within a second."""
    for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
        compiled.unlink(missing_ok=True)
    path.write_text(text, encoding="utf-8")


def run(command: list[str], folder: Path, variables: dict[str, str], limit: float) -> int | str:
    """Run a command, end all its processes, and return its exit status or "time limit"."""
    with subprocess.Popen(
        command,
        cwd=folder,
        env=variables,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as process:
        try:
            return process.wait(limit)
        except subprocess.TimeoutExpired:
            return "time limit"
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            end_processes_of(folder)


def end_processes_of(folder: Path) -> None:
    """End the processes that the tests of a copy have left in sessions of their own."""
    for variables in Path("/proc").glob("[0-9]*/environ"):
        with suppress(OSError):
            if f"MUTANTS_ROOT={folder}\0".encode() in variables.read_bytes():
                os.kill(int(variables.parent.name), signal.SIGKILL)


def report(results: list[dict[str, Any]]) -> None:
    """Print how many mutants were killed, by module and by kind, and each survivor."""
    for what in ("module", "kind"):
        drawn = Counter(result[what] for result in results)
        killed = Counter(result[what] for result in results if result["outcome"] == "killed")
        print(f"\n{what:32} drawn killed")
        for name in sorted(drawn):
            print(f"{name:32} {drawn[name]:5} {killed[name]:6}")
    known = {
        (entry["module"], entry.get("change", "").strip()): entry["why"] for entry in reasons()
    }
    survivors = [result for result in results if result["outcome"] == "survived"]
    told = [
        (
            result,
            known.get((result["module"], change_of(result)), known.get((result["module"], ""))),
        )
        for result in survivors
    ]
    for result, why in sorted(told, key=lambda pair: pair[1] is None):
        print(
            f"\nsurvived {result['tests']} of {result['of']} tests:"
            f" {result['mutant']}\n{why or result['diff']}"
        )
    seconds = sum(result["seconds"] for result in results) / max(1, len(results))
    number, listed = len(results) - len(survivors), sum(why is not None for _, why in told)
    print(
        f"\n{len(results)} mutants, {number / max(1, len(results)):.0%} killed, {seconds:.0f} s"
        " each"
    )
    print(f"{number / max(1, len(results) - listed):.0%} without the {listed} that are no mistakes")


def reasons() -> list[dict[str, str]]:
    """Read the changes that are known to be no mistakes."""
    text = (ROOT / "tools/mutants_known.toml").read_text(encoding="utf-8")
    found: list[dict[str, str]] = tomllib.loads(text)["known"]
    return found


def change_of(result: dict[str, Any]) -> str:
    """Return the lines that a mutant changes, before and after, without their line numbers."""
    lines = [line for line in result["diff"].splitlines()[3:] if line.startswith(("-", "+"))]
    return "\n".join(f"{line[0]} {line[1:].strip()}" for line in lines)


if __name__ == "__main__":
    main()
