"""A simulation whose model runs in a process of its own, and calls for decisions over a pair of pipes."""

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from math import inf
from typing import Any

from ..core.reuse import acquire, release
from ..decision import BY_NAME, Definition
from ..errors import (
    BranchError,
    DefinitionError,
    OptionValueError,
    ProcessDiedError,
    ProcessError,
    SimEnvError,
    SimulationError,
    UnknownPointError,
    WireError,
    annotate,
    short_repr,
)
from ..simulation import RULE, TRUNCATED, SimulationInterface
from .calls import RemoteCall, point_named
from .child import Child
from .wire import STOP, answer, encode


class _Link:
    """The process of a simulation, and the state of its episode. Never copied.

    Attributes:
        child: The process; None until one was started.
        state: "idle" between episodes, "waits" for the answer to a call, "busy" with its model, or "stopped".
        first: The first frame of an episode that has begun and does not run yet.
        number: The number of the latest call.
        calls: The latest call of each entity at each point.
        time: The latest time of the process; None if it told none.
        seed: The seed with which it has to reseed before it goes on; None if it need not.
    """

    __slots__ = ("calls", "child", "first", "number", "seed", "state", "time")

    def __init__(self) -> None:
        self.child: Child | None = None
        self.state = "idle"
        self.begin(None)

    def begin(self, first: dict[str, Any] | None) -> None:
        """Begin an episode with its first frame."""
        self.first, self.number = first, 0
        self.seed: int | None = None
        self.calls: dict[tuple[str, Any], RemoteCall] = {}
        self.time: float | None = None
        if first is not None:
            self.state = "waits" if "decide" in first else "idle" if "end" in first else "busy"
            if type(first.get("time")) in (float, int):
                with suppress(OverflowError):  # reported when the frame is read
                    self.time = float(first["time"])

    def break_off(self) -> None:
        """End a running episode: a waiting process unwinds, a busy one is ended."""
        child, state = self.child, self.state
        if child is None or not child.usable:
            return
        if state == "waits":
            self.state, child.may_exit = "stopped", True
            with suppress(SimEnvError):  # it is ended then, and the next episode starts a new one
                child.send(STOP)
        elif state == "busy":
            child.end(patience=0.0)


class ProcessSimulation(SimulationInterface):
    """A simulation whose model runs in a process of its own (POSIX), in any language.

    The first ``reset`` starts the process. It plays one episode after the other, and is ended when the environment is
    closed or garbage-collected. It calls for decisions in its own order. Decisions that are left to ``RULE`` it takes
    itself.

    Mappings, ``agent`` and ``apply`` get one object for each entity at a point. The call's arguments are its attributes
    and items (``call.level``, ``call["queue-length"]``); it also has ``entity`` and ``time``. The result of ``apply``
    is sent as the decision; ``RULE`` leaves it to the process.

    Attributes:
        points: The decision points with their definitions.
        result: The result that the process sent at the end of the latest episode; None before.
    """

    def __init__(
        self,
        command: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
        points: Mapping[str, Definition],
        *,
        timeout: float = 30.0,
        env: Mapping[str, str] | None = None,
        cwd: str | os.PathLike[str] | None = None,
    ) -> None:
        """Define how the process is started, and its decision points.

        Args:
            command: The program and its arguments; a program without arguments may be given as a string.
            points: A dict from the process's name of a decision point to its definition. The name can be used wherever
                a dotted name can. At points that are not in the dict, the process follows its own rule.
            timeout: The time to wait for each line of the process, and for it to read a message, in seconds.
            env: The environment variables of the process. None: those of this process.
            cwd: The folder in which it runs. None: that of this process.

        Raises:
            OptionValueError: The command or the timeout is invalid.
            DefinitionError: ``points`` is not a dict from names to definitions.
            ProcessError: The platform is not POSIX.
        """
        if os.name != "posix":
            raise ProcessError("ProcessSimulation needs POSIX: elsewhere a process cannot inherit the descriptors")
        self.command = _words(command)
        if isinstance(timeout, bool) or not isinstance(timeout, (int, float)) or not 0 < timeout < inf:
            raise OptionValueError(f"timeout must be a positive number of seconds, not {short_repr(timeout)}")
        self.timeout, self.env, self.cwd = float(timeout), None if env is None else dict(env), cwd
        self.points = _by_function(points)
        self.result: Any = None
        self._link = _Link()

    def __getstate__(self) -> dict[str, Any]:
        points = {getattr(function, BY_NAME): definition for function, definition in self.points.items()}
        return {**vars(self), "points": points, "_link": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self.points, self._link = _by_function(state["points"]), _Link()

    # -- episodes ---------------------------------------------------------------------------------

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Begin an episode, in the existing process or in a new one.

        Args:
            seed: The seed for the process's generators.
            options: Further data for the episode, as JSON data.

        Raises:
            WireError: The options are not JSON data, and nothing was sent; or the process breaks the rules of the wire.
            ProcessDiedError, ProcessTimeoutError: It does not start, or does not answer.
            UnknownPointError: It does not have the named points.
        """
        start = encode({"start": {"seed": seed, "options": options or {}}})
        self.result, link = None, self._link
        link.break_off()
        if link.child is None:
            link.child = acquire(self._alike())
        child = link.child
        if child is not None and child.usable:
            try:
                self._begin(child, start)
                return
            except ProcessDiedError:
                if not child.may_exit or child.exit_code() != 0:
                    raise
        link.child, link.state = Child(self.command, self.timeout, self.env, self.cwd), "idle"
        self._begin(link.child, start)

    def _alike(self) -> tuple[Any, ...]:
        """Return the values that are equal for processes that can replace each other."""
        env = None if self.env is None else tuple(sorted(self.env.items()))
        return tuple(self.command), self.timeout, env, self.cwd

    def _begin(self, child: Child, start: bytes) -> None:
        """Send the line that starts an episode, and wait for the first frame."""
        link = self._link
        stopped, link.state = link.state == "stopped", "busy"
        try:
            missing = [name for name in self._names() if name not in child.points]
            if missing:
                has = ", ".join(sorted(child.points)) or "none"
                child.fail(UnknownPointError(f"{child} has no decision point {', '.join(missing)}; it has {has}"))
            child.check_silent()
            child.send(start)
            first = child.receive()
            if stopped and "end" in first:
                child.refuse(
                    first, f'has sent {short_repr(first)} after "stop"; it must be silent until the next start'
                )
            child.may_exit = False
            link.begin(first)
        except BaseException:
            link.break_off()
            raise

    def run(self) -> Any:
        """Run the episode in the process; its calls become calls of the points' decision functions.

        Returns:
            ``TRUNCATED`` if the process reports a time limit; else None.

        Raises:
            RemoteError: The model raised an error.
            WireError: The process breaks the rules of the wire, or a decision is not JSON data.
            ProcessDiedError, ProcessTimeoutError: It has ended, or does not answer.
            SimulationError: No episode was begun.
        """
        link = self._link
        child, frame, link.first = link.child, link.first, None
        if child is None or frame is None:
            raise SimulationError("run() runs each episode once: call reset() first")
        functions = dict(zip(self._names(), self.points, strict=True))
        try:
            while "end" not in frame:
                if "decide" in frame:
                    line = self._answered(child, frame, functions)
                    link.state = "busy"
                    child.send(line)
                elif "update" in frame:
                    self._update(child, frame)
                elif "remove" in frame:
                    self._remove(child, frame)
                else:
                    child.refuse(frame, f"has sent {short_repr(frame)}, which is not a frame of the wire")
                frame = child.receive()
            return self._end(child, frame["end"])
        except BaseException:
            link.break_off()
            raise

    def close(self, last: bool = True) -> None:
        """End the process, if no other episode follows.

        Args:
            last: Whether no other episode follows.
        """
        link = self._link
        if last and link.child is not None:
            link.break_off()
            child, link.child = link.child, None
            if not release(self._alike(), child):
                child.end()

    @property
    def time(self) -> Callable[[], float]:
        """A method that returns the process's time. The attribute is missing if the process tells no time."""
        link = self._link
        if link.time is None:
            raise AttributeError("the process has not sent a time")
        return lambda: link.time  # type: ignore[return-value]

    def reseed(self, seed: int) -> None:
        """Ask the process to reseed its generators, so that it draws new random numbers from here on.

        Raises:
            BranchError: The process did not announce "reseed".
        """
        child = self._link.child
        if child is None or "reseed" not in child.can:
            raise BranchError(f'{child or "a process that was not started"} has not announced "reseed" in its hello')
        self._link.seed = int(seed)

    # -- frames -----------------------------------------------------------------------------------

    def _answered(self, child: Child, frame: dict[str, Any], functions: dict[str, Any]) -> bytes:
        """Get the decision of a call; return the lines that answer it."""
        link, number = self._link, frame["decide"]
        if type(number) is not int or number != link.number + 1:
            child.fail(WireError(f"{child} has made call {short_repr(number)} where call {link.number + 1} was due"))
        entity = frame.get("entity")
        name, time = child.check_named(frame, entity)
        if time is not None:
            link.time = time
        link.number, link.state = number, "waits"
        function = functions.get(name)
        if function is None:
            return answer(number, RULE)
        call = link.calls.get((name, entity))
        if call is None:
            call = link.calls[name, entity] = RemoteCall(name, entity)
        call.__dict__, call.time = frame.get("args") or {}, link.time
        value = function(call)
        try:
            line = answer(number, value)
        except WireError as error:
            annotate(error, f"simenv_marl: in the decision of {call.entity!r} at {call.point}")
            raise
        if link.seed is None:
            return line
        seed, link.seed = link.seed, None
        return encode({"reseed": seed}) + line

    def _update(self, child: Child, frame: dict[str, Any]) -> None:
        """Update the arguments of an entity's latest call."""
        call = self._link.calls.get(self._named(child, frame, frame["update"]))
        if call is not None:
            call.__dict__, call.time = frame.get("args") or {}, self._link.time

    def _remove(self, child: Child, frame: dict[str, Any]) -> None:
        """End the agent of an entity that is gone."""
        call = self._link.calls.pop(self._named(child, frame, frame["remove"]), None)
        if call is not None:
            point_named(call.point).remove(call)

    def _named(self, child: Child, frame: dict[str, Any], entity: Any) -> tuple[str, Any]:
        """Return the point and the entity of a frame, and record its time."""
        name, time = child.check_named(frame, entity)
        if time is not None:
            self._link.time = time
        return name, entity

    def _end(self, child: Child, end: Any) -> Any:
        """Record the end of the episode."""
        child.check_end(end)
        self._link.state, child.may_exit = "idle", True
        self.result = end.get("result")
        return TRUNCATED if end.get("truncated") else None

    def _names(self) -> list[str]:
        return [getattr(function, BY_NAME) for function in self.points]


def _words(command: Any) -> list[str]:
    """Return the program and its arguments.

    Raises:
        OptionValueError: They are invalid.
    """
    words = [command] if isinstance(command, (str, os.PathLike)) else command
    if not isinstance(words, Sequence) or not words or not all(isinstance(word, (str, os.PathLike)) for word in words):
        raise OptionValueError(
            f"command must be a program and its arguments, a list of strings, not {short_repr(command)}"
        )
    return [os.fspath(word) for word in words]


def _by_function(points: Any) -> dict[Any, Definition]:
    """Return the definitions by the decision functions of their names.

    Raises:
        DefinitionError: ``points`` is not a dict from names to definitions.
    """
    if not isinstance(points, Mapping) or not points:
        raise DefinitionError(
            f"points must be a dict from the process's names to definitions, not {short_repr(points)}"
        )
    for name, definition in points.items():
        if not isinstance(name, str) or not name or not isinstance(definition, Definition):
            raise DefinitionError(
                f"points must be a dict from the process's names to what make_step returns, not {short_repr(name)}:"
                f" {short_repr(definition)}"
            )
    return {point_named(name).decide: definition for name, definition in points.items()}
