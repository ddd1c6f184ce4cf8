"""Mutants of the library: small mistakes put into a copy of it, one at a time, and do the tests find them?

Run with ``python -m tools.mutants``, or ``make mutants``. What is found goes to a file as it comes, one JSON object a
line. Started once more, the script goes on where it was stopped; with ``--again`` it tries the survivors anew, which
is what one wants when tests have been added. It draws from all modules except ``testing``, ``many/plots.py`` and the
models among ``templates``.

Before the first mutant, the tests run once and it is measured which of them execute which lines, and how long they
take. A mutant is only shown to tests that execute its function: first those that execute its line, some quick ones of
each file before the others.

Some changes are no mistakes: ``mutants_known.toml`` has each with the reason why no test need find it.
"""

from __future__ import annotations

import argparse
import difflib
import hashlib
import json
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
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from .mutants_draw import Mutant, candidates

ROOT = Path(__file__).parents[1]
PACKAGE = Path("src/simenv_marl")
LEFT_OUT = ("testing/", "many/plots.py", *(f"templates/{name}" for name in ("mesa", "plain", "simpy", "test_")))
COPIED = ("src", "tests", "tools", "examples", "benchmarks", "docs", "README.md", "CHANGELOG.md", "pyproject.toml")
TEST_LIMIT = 20.0
"""Seconds that any test may take, beyond ten times what it took when nothing was wrong."""
FIRST = 6
"""How many tests of each file come first, which are its quickest."""
QUICK = 0.2
"""Seconds that those may take at most."""


@dataclass(frozen=True)
class Measured:
    """What has been measured: which tests execute which lines, and how long they take.

    Attributes:
        seconds: By test that passes, in the order in which they ran.
        lines: By module and line, the tests that execute it.
    """

    seconds: dict[str, float]
    lines: dict[str, dict[int, list[str]]]

    def tests(self, mutant: Mutant) -> list[str]:
        """The tests that could find a mutant, in the order in which they are to run.

        First those that execute its line; then those that execute anything in its function, because what comes after a
        switch between stacks is not always measured. Of what nothing executes, as at the import, all tests of the files
        that execute anything in its module.
        """
        lines = self.lines.get(mutant.module, {})
        found = [
            {test for line, tests in lines.items() if first <= line <= last for test in tests}
            for first, last in (mutant.lines, mutant.function)
        ]
        if not any(found):
            files = {file_of(test) for tests in lines.values() for test in tests}
            found = [{test for test in self.seconds if not files or file_of(test) in files}]
        return list(dict.fromkeys(test for tests in found for test in self.ordered(tests)))

    def ordered(self, found: set[str]) -> list[str]:
        """Tests in the order in which they are to run: some quick ones of each file first."""
        by_file: dict[str, list[str]] = {}
        for test in self.seconds:
            if test in found:
                by_file.setdefault(file_of(test), []).append(test)
        files = sorted(by_file.values(), key=lambda tests: sum(map(self.seconds.__getitem__, tests)))
        quick = [[test for test in tests if self.seconds[test] < QUICK] for tests in files]
        first_ones = [
            test
            for tests in quick
            for test in sorted(tests, key=lambda test: ("[thread" in test, self.seconds[test]))[:FIRST]
        ]
        rest = [test for tests in files for test in tests]
        rest.sort(key=lambda test: "[thread" in test)  # what the first driver finds, the second one need not
        return first_ones + rest


def file_of(test: str) -> str:
    """The file in which a test stands."""
    return test.partition("::")[0]


def main() -> None:
    """What ``python -m tools.mutants`` does."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--number", type=int, default=200, help="how many mutants (200)")
    parser.add_argument("--seed", type=int, default=0, help="with which they are drawn (0)")
    parser.add_argument("--jobs", type=int, default=2, help="how many at a time (2)")
    parser.add_argument("--out", type=Path, default=ROOT / ".mutants", help="the folder for what is found")
    parser.add_argument("--only", default="", metavar="PATH", help="modules whose path below the package begins so")
    parser.add_argument("--again", action="store_true", help="try those anew that have survived")
    parser.add_argument("--report", action="store_true", help="only show what has been found")
    given = parser.parse_args()
    given.out.mkdir(exist_ok=True)
    results = given.out / f"seed-{given.seed}.jsonl"
    drawn = draw(given.number, given.seed, given.only)
    done = {result["mutant"]: result for result in read(results)}
    if given.again:
        done = {name: result for name, result in done.items() if result["outcome"] != "survived"}
    missing = [mutant for mutant in drawn if mutant.name not in done]
    if missing and not given.report:
        measured = measure(given.out / "measured.json")
        with results.open("a", encoding="utf-8") as file:
            for number, result in enumerate(tried(missing, measured, given.jobs), 1):
                done[result["mutant"]] = result
                file.write(json.dumps(result) + "\n")
                file.flush()
                print(
                    f"{number}/{len(missing)} {result['outcome']:8} {result['seconds']:6.1f} s  {result['mutant']}",
                    flush=True,
                )
    report([done[mutant.name] for mutant in drawn if mutant.name in done])


def modules() -> list[str]:
    """The modules that mutants are drawn from."""
    paths = sorted(path.relative_to(ROOT / PACKAGE).as_posix() for path in (ROOT / PACKAGE).rglob("*.py"))
    return [path for path in paths if not path.startswith(LEFT_OUT)]


def draw(number: int, seed: int, only: str) -> list[Mutant]:
    """So many mutants: of each module by its share of all there could be, at least one, of all kinds alike."""
    found = {path: candidates(path, (ROOT / PACKAGE / path).read_text(encoding="utf-8")) for path in modules()}
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


# -- which test executes what ---------------------------------------------------------------------


def copied(folder: Path) -> Path:
    """A copy of everything that the tests need."""
    for name in COPIED:
        source = ROOT / name
        if source.is_dir():
            ignored = shutil.ignore_patterns("__pycache__", "_build", "out")
            shutil.copytree(source, folder / name, ignore=ignored)
        elif source.exists():
            shutil.copy(source, folder / name)
    return folder


def environment(folder: Path, **more: Path) -> dict[str, str]:
    """The environment variables of the tests of a copy."""
    path = os.pathsep.join([str(folder / "src"), str(folder)])
    return os.environ | {"PYTHONPATH": path, "MUTANTS_ROOT": str(folder)} | {name: str(at) for name, at in more.items()}


def measure(cache: Path) -> Measured:
    """Run all tests and see what they execute, unless that is known already of just this source and these tests."""
    digest = hashlib.sha256()
    for path in sorted([*ROOT.glob("src/**/*.py"), *ROOT.glob("tests/**/*.py")]):
        digest.update(path.read_bytes())
    if cache.exists() and (known := json.loads(cache.read_text(encoding="utf-8")))["digest"] == digest.hexdigest():
        lines = {path: {int(at): tests for at, tests in of.items()} for path, of in known["lines"].items()}
        names = list(known["seconds"])
        by_name = {path: {at: [names[n] for n in numbers] for at, numbers in of.items()} for path, of in lines.items()}
        return Measured(known["seconds"], by_name)
    print("measuring which tests execute which lines", flush=True)
    with tempfile.TemporaryDirectory(prefix="mutants-") as temporary:
        folder = copied(Path(temporary).resolve())
        notes, data = folder / "notes.jsonl", folder / "coverage"
        options = ["-q", "-n", "2", "--driver", "greenlet", "-p", "tools.mutants_plugin", "--cov", "--cov-context=test"]
        command = [sys.executable, "-m", "pytest", *options, "--cov-report=", "tests"]
        subprocess.run(
            command, cwd=folder, env=environment(folder, MUTANTS_NOTE=notes, COVERAGE_FILE=data), check=False
        )
        measured = measured_in(folder, notes, data)
    numbers = {name: number for number, name in enumerate(measured.seconds)}
    compact = {
        path: {at: [numbers[test] for test in tests] for at, tests in of.items()} for path, of in measured.lines.items()
    }
    content = {"digest": digest.hexdigest(), "seconds": measured.seconds, "lines": compact}
    cache.write_text(json.dumps(content), encoding="utf-8")
    return measured


def measured_in(folder: Path, notes: Path, data: Path) -> Measured:
    """What the tests of a copy have noted."""
    from coverage import CoverageData

    outcomes: dict[str, tuple[str, float]] = {}
    for name, outcome, seconds in read(notes):
        if outcomes.get(name, ("passed",))[0] == "passed":
            outcomes[name] = outcome, seconds
    for name in (name for name, (outcome, _) in outcomes.items() if outcome != "passed"):
        print(f"left out, for it fails anyway: {name}", flush=True)
    seconds_of = {name: seconds for name, (outcome, seconds) in outcomes.items() if outcome == "passed"}
    covered = CoverageData(str(data))
    covered.read()
    lines: dict[str, dict[int, list[str]]] = {}
    for path in covered.measured_files():
        module = Path(path).resolve().relative_to(folder / PACKAGE).as_posix()
        of_module = lines.setdefault(module, {})
        for line, contexts in covered.contexts_by_lineno(path).items():
            tests = {context.rpartition("|")[0] for context in contexts} & seconds_of.keys()
            if tests:
                of_module[line] = sorted(tests | set(map(twin, tests)))
    return Measured(seconds_of | {twin(name): 2 * seconds for name, seconds in seconds_of.items()} | seconds_of, lines)


def twin(test: str) -> str:
    """The same test with the other driver; it is not measured, but is taken to execute the same lines."""
    return test.replace("[greenlet", "[thread", 1)


def read(path: Path) -> list[Any]:
    """The objects in a file of JSON lines, which need not be there."""
    return list(map(json.loads, path.read_text(encoding="utf-8").splitlines())) if path.exists() else []


# -- one mutant after the other -------------------------------------------------------------------


def tried(mutants: list[Mutant], measured: Measured, jobs: int) -> Iterator[dict[str, Any]]:
    """Show mutants to the tests, some at a time, each in a copy that no other is in."""
    with tempfile.TemporaryDirectory(prefix="mutants-") as temporary, ThreadPoolExecutor(jobs) as threads:
        free: SimpleQueue[Path] = SimpleQueue()
        for number in range(jobs):
            (Path(temporary).resolve() / str(number)).mkdir()
            free.put(copied(Path(temporary).resolve() / str(number)))

        def try_one(mutant: Mutant) -> dict[str, Any]:
            folder = free.get()
            try:
                return outcome(mutant, folder, measured)
            finally:
                free.put(folder)

        for future in as_completed([threads.submit(try_one, mutant) for mutant in mutants]):
            yield future.result()


def outcome(mutant: Mutant, folder: Path, measured: Measured) -> dict[str, Any]:
    """Whether a test finds a mutant, and which."""
    path = folder / PACKAGE / mutant.module
    original, begun = path.read_text(encoding="utf-8"), time.monotonic()
    changed = mutant.applied(original)
    tests, notes = measured.tests(mutant), folder / "notes.jsonl"
    notes.unlink(missing_ok=True)
    chosen = folder / "chosen.json"
    chosen.write_text(json.dumps({test: TEST_LIMIT + 10 * measured.seconds[test] for test in tests}), encoding="utf-8")
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
        "of": len(tests),
        "seconds": round(time.monotonic() - begun, 1),
        "diff": "".join(
            difflib.unified_diff(
                original.splitlines(keepends=True), changed.splitlines(keepends=True), mutant.module, mutant.kind, n=2
            )
        ),
    }


def write(path: Path, text: str) -> None:
    """Write a module, and forget what was compiled of it: within a second, its time says nothing."""
    for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
        compiled.unlink(missing_ok=True)
    path.write_text(text, encoding="utf-8")


def run(command: list[str], folder: Path, variables: dict[str, str], limit: float) -> int | str:
    """The exit status of a command, or that its time was up; nothing of it is left."""
    with subprocess.Popen(
        command, cwd=folder, env=variables, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    ) as process:
        try:
            return process.wait(limit)
        except subprocess.TimeoutExpired:
            return "time limit"
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


def report(results: list[dict[str, Any]]) -> None:
    """Show by module and by kind how many were killed, and each of those that have survived."""
    for what in ("module", "kind"):
        drawn = Counter(result[what] for result in results)
        killed = Counter(result[what] for result in results if result["outcome"] == "killed")
        print(f"\n{what:32} drawn killed")
        for name in sorted(drawn):
            print(f"{name:32} {drawn[name]:5} {killed[name]:6}")
    known = {(entry["module"], entry.get("change", "").strip()): entry["why"] for entry in reasons()}
    survivors = [result for result in results if result["outcome"] == "survived"]
    told = [
        (result, known.get((result["module"], change_of(result)), known.get((result["module"], ""))))
        for result in survivors
    ]
    for result, why in sorted(told, key=lambda pair: pair[1] is None):
        print(f"\nsurvived {result['of']} tests: {result['mutant']}\n{why or result['diff']}")
    seconds = sum(result["seconds"] for result in results) / max(1, len(results))
    number, listed = len(results) - len(survivors), sum(why is not None for _, why in told)
    print(f"\n{len(results)} mutants, {number / max(1, len(results)):.0%} killed, {seconds:.0f} s each")
    print(f"{number / max(1, len(results) - listed):.0%} without the {listed} that are no mistakes")


def reasons() -> list[dict[str, str]]:
    """The changes that are known to be no mistakes."""
    text = (ROOT / "tools/mutants_known.toml").read_text(encoding="utf-8")
    found: list[dict[str, str]] = tomllib.loads(text)["known"]
    return found


def change_of(result: dict[str, Any]) -> str:
    """The lines that a mutant has changed, wherever they stand: those before, and those after."""
    lines = [line for line in result["diff"].splitlines()[3:] if line.startswith(("-", "+"))]
    return "\n".join(f"{line[0]} {line[1:].strip()}" for line in lines)


if __name__ == "__main__":
    main()
