"""A check for authors of clients: does a simulator speak the wire as it should?"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import partial
from subprocess import DEVNULL, PIPE, TimeoutExpired, run
from typing import Any, Final

from ..errors import ProcessDiedError, ProcessError, ProcessTimeoutError, short_repr
from .child import Child
from .wire import DESCRIPTORS, LONGEST, STOP, encode

OK, NOTE, WRONG = "ok", "note", "wrong"

PADDING: Final = 1 << 20
"""How many blanks make a line long: longer than any pipe's buffer."""


@dataclass(frozen=True)
class Finding:
    """What has come out of one thing that was tried.

    Attributes:
        tried: What was tried.
        verdict: "ok", "wrong", or "note" for what may be meant to be so.
        text: What was seen.
    """

    tried: str
    verdict: str
    text: str


@dataclass
class WireReport:
    """What ``check_wire`` has found.

    Attributes:
        findings: One for each thing that was tried.
    """

    findings: list[Finding] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return all(finding.verdict != WRONG for finding in self.findings)

    def to_dict(self) -> dict[str, Any]:
        """The same as JSON has it."""
        return {"ok": self.ok, "findings": [asdict(finding) for finding in self.findings]}

    def __str__(self) -> str:
        lines = [f"{finding.verdict:5}  {finding.tried}: {finding.text}" for finding in self.findings]
        wrong = sum(finding.verdict == WRONG for finding in self.findings)
        return "\n".join([*lines, "", f"{wrong} of {len(lines)} tests failed" if wrong else "nothing is wrong"])


def check_wire(
    command: Sequence[str],
    *,
    options: Mapping[str, Any] | None = None,
    seed: int = 1,
    decisions: int = 1000,
    timeout: float = 30.0,
) -> WireReport:
    """Play with a simulator, and say what it does wrong.

    Episodes by its rule, one after the other and in a process of their own; episodes that are broken off; long lines;
    ``reseed``; frames that it must refuse; an input that is closed; and a run without an environment.

    Args:
        command: The program and its arguments.
        options: What ``start`` is to bring.
        seed: Of the episodes.
        decisions: After how many decisions an episode that does not end is broken off.
        timeout: For how many seconds to wait for each line.
    """
    return _Check(list(command), {"seed": seed, "options": dict(options or {})}, decisions, timeout).made()


class _Check:
    """One check of a simulator."""

    def __init__(self, command: list[str], start: dict[str, Any], most: int, timeout: float) -> None:
        self._command, self._most, self._timeout = command, most, timeout
        self._start = encode({"start": start})
        self._report = WireReport()
        self._first: list[dict[str, Any]] = []  # what an episode by its rule is, in a new process

    def made(self) -> WireReport:
        """Try everything."""
        self._try("starts, and says hello", self._hello)
        if self._report.ok:
            self._try("an episode by its own rule", self._episode)
        if not self._report.ok:
            return self._report
        self._try("two episodes in a row with the same seed", self._two)
        for number in sorted({1, (self._decisions + 1) // 2, self._decisions} - {0}):
            self._try(f"stop in place of the answer to call {number}", partial(self._stop, number))
        self._try("a line of 1 MiB", self._long)
        self._try("reseed", self._reseed)
        for what, line in (
            ("an answer with the number of another call", encode({"act": 10**6, "rule": True})),
            ("a frame that does not exist", encode({"desire": 1})),
            ("a line that is not JSON", b"hello?\n"),
            ("half a line, then the end of its input", b'{"act'),
            ("the end of its input in mid-episode", b""),
        ):
            self._try(what, partial(self._refusal, line))
        self._try("the end of its input between episodes", self._idle)
        self._try("a run without an environment", self._alone)
        return self._report

    def _try(self, tried: str, attempt: Callable[[], tuple[str, str]]) -> None:
        try:
            verdict, text = attempt()
        except ProcessError as error:
            verdict, text = WRONG, str(error)
        self._report.findings.append(Finding(tried, verdict, text))

    @property
    def _decisions(self) -> int:
        return sum("decide" in frame for frame in self._first)

    @contextmanager
    def _child(self) -> Any:
        child = Child(self._command, self._timeout)
        try:
            yield child
        finally:
            child.end()

    def _play(self, child: Child, *, stop: int = 0, reseed: tuple[int, int] = (0, 0), pad: int = 0) -> list[Any]:
        """Play an episode by the rule.

        Args:
            child: The process.
            stop: In place of the answer to which call to break it off.
            reseed: Before the answer to which call to send a reseed, and with which seed.
            pad: How many blanks to put into the first two lines.

        Returns:
            The frames that came.
        """
        frames, number = [], 0
        child.send(_padded(self._start, pad))
        while True:
            frame = child.receive()
            child.may_exit = False
            frames.append(frame)
            if "end" in frame:
                child.check_end(frame["end"])
                child.may_exit = True
                return frames
            if "decide" not in frame:
                if "error" in frame:
                    child.fail(ProcessError(f"it has sent {short_repr(frame)}"))
                if not {"remove", "update"} & frame.keys():
                    child.fail(ProcessError(f"it sent {short_repr(frame)}, which is not a frame of the wire"))
                child.check_named(frame, frame.get("update", frame.get("remove")))
                continue
            number += 1
            if type(frame["decide"]) is not int or frame["decide"] != number:
                child.fail(ProcessError(f"call {number} was due, but it sent {short_repr(frame)}"))
            child.check_named(frame, frame.get("entity"))
            if number == stop or number == self._most:
                child.send(STOP)
                child.may_exit = True
                return frames
            before = encode({"reseed": reseed[1]}) if number == reseed[0] else b""
            child.send(before + _padded(encode({"act": number, "rule": True}), pad if number == 1 else 0))

    # -- what is tried ----------------------------------------------------------------------------

    def _hello(self) -> tuple[str, str]:
        with self._child() as child:
            points = ", ".join(sorted(child.points))
            return (OK, f"points {points}; can {', '.join(sorted(child.can)) or 'nothing else'}") if points else (
                WRONG, "it has no points"
            )  # fmt: skip

    def _episode(self) -> tuple[str, str]:
        with self._child() as child:
            self._first = self._play(child)
            count = Counter(frame["point"] for frame in self._first if "decide" in frame)
            told = ", ".join(f"{point} {number}" for point, number in count.items())
            if not count:
                return WRONG, "it asked for no decision"
            if "end" not in self._first[-1]:
                return NOTE, f"it was stopped after {self._most} decisions ({told})"
            return (
                OK,
                f"{self._decisions} decisions ({told}), result {short_repr(self._first[-1]['end'].get('result'))}",
            )

    def _two(self) -> tuple[str, str]:
        with self._child() as child:
            self._play(child)
            return self._again(child)

    def _again(self, child: Child) -> tuple[str, str]:
        """Play an episode in a process that has played one, unless it has exited after that."""
        try:
            return self._compared(self._play(child))
        except ProcessDiedError:
            if child.may_exit and child.exit_code() == 0:
                return NOTE, "it exits after an episode, and is started again for each"
            raise

    def _compared(self, frames: list[Any]) -> tuple[str, str]:
        for number, (one, other) in enumerate(zip(self._first, frames, strict=False)):
            if one != other:
                return WRONG, f"frame {number} is {short_repr(other)}, and in a new process it was {short_repr(one)}"
        if len(frames) != len(self._first):
            return WRONG, f"it sent {len(frames)} frames, and in a new process {len(self._first)}"
        return OK, "the same as in a new process"

    def _stop(self, number: int) -> tuple[str, str]:
        with self._child() as child:
            self._play(child, stop=number)
            return self._again(child)

    def _long(self) -> tuple[str, str]:
        with self._child() as child:
            return self._compared(self._play(child, pad=PADDING))

    def _reseed(self) -> tuple[str, str]:
        with self._child() as child:
            if "reseed" not in child.can:
                return NOTE, 'the "can" of its hello does not list "reseed": no branches with other futures'
        middle, futures = (self._decisions + 1) // 2, []
        for seed in (11, 11, 12):
            with self._child() as child:
                futures.append(self._play(child, reseed=(middle, seed)))
        one, again, other = futures
        if one != again:
            return WRONG, "the same seed has led to two futures"
        if one == other:
            return NOTE, "two seeds have led to the same future; is nothing in the model random?"
        return OK, f"at call {middle}, two seeds lead to two futures, and the same seed to the same future"

    def _refusal(self, line: bytes) -> tuple[str, str]:
        with self._child() as child:
            child.send(self._start)
            while "decide" not in child.receive():
                pass
            child.send(line)
            if not line.endswith(b"\n"):
                child.close_input()
            try:
                frame = child.receive()
            except ProcessTimeoutError:
                return WRONG, f"it neither sends an error nor ends within {self._timeout:g} s"
            except ProcessDiedError:
                return OK, "it ends"
            if "error" in frame:
                return OK, f"it sends the error {short_repr(frame['error'])}"
            return WRONG, f"it continues with {short_repr(frame)}"

    def _idle(self) -> tuple[str, str]:
        with self._child() as child:
            self._play(child)
            child.close_input()
            try:
                return WRONG, f"it sends {short_repr(child.receive())}"
            except ProcessTimeoutError:
                return WRONG, f"it does not end within {self._timeout:g} s"
            except ProcessDiedError:
                return OK, "it ends"

    def _alone(self) -> tuple[str, str]:
        env = {name: value for name, value in os.environ.items() if name != DESCRIPTORS}
        try:
            done = run(self._command, env=env, stdin=DEVNULL, stdout=DEVNULL, stderr=PIPE, timeout=self._timeout)
        except TimeoutExpired:
            return NOTE, f"it still ran after {self._timeout:g} s"
        if done.returncode != 0:
            last = done.stderr.decode(errors="replace").strip()[-300:]
            return NOTE, f"it has exited with code {done.returncode}: {last}"
        return OK, "it runs on its own rule, and exits with code 0"


def _padded(line: bytes, blanks: int) -> bytes:
    """A line with so many blanks before its end."""
    return line if not blanks else line[:-1] + b" " * min(blanks, LONGEST - len(line)) + b"\n"
