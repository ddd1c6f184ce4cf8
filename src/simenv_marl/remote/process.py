"""A simulation whose model runs in a process of its own, and calls for decisions over a pair of pipes."""

import os
from collections.abc import Callable, Mapping, Sequence
from math import inf
from typing import Any
from weakref import finalize

import numpy as np

from ..core import acquire, release
from ..decision import BY_NAME, Definition
from ..errors import (
    BranchError,
    DefinitionError,
    OptionValueError,
    ProcessDiedError,
    ProcessError,
    SimulationError,
    UnknownPointError,
    WireError,
    annotate,
    short_repr,
)
from ..simulation import RULE, TRUNCATED, SimulationInterface
from .calls import RemoteCall, point_functions
from .child import Child
from .wire import encode, encode_answer


class ProcessSimulation(SimulationInterface):
    """A simulation whose model runs in a process of its own (POSIX), in any language.

    The first ``reset`` starts the process. It plays one episode after the other, and is ended when
    the environment is closed or garbage-collected. It calls for decisions in its own order.
    Decisions that are left to ``RULE`` it takes itself.

    Mappings, ``agent`` and ``apply`` get one object for each entity at a point. The call's
    arguments are its attributes and items (``call.level``, ``call["queue-length"]``); it also has
    ``entity`` and ``time``. The result of ``apply`` is sent as the decision; ``RULE`` leaves it to
    the process.

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
            command: The program and its arguments; a program without arguments may be given as a
                string.
            points: A dict from the process's name of a decision point to its definition. The name
                can be used wherever a dotted name can. At points that are not in the dict, the
                process follows its own rule.
            timeout: The time to wait for each line of the process, and for it to read a message, in
                seconds.
            env: The environment variables of the process. None: those of this process.
            cwd: The folder in which it runs. None: that of this process.

        Raises:
            OptionValueError: The command, the timeout, ``env`` or ``cwd`` is invalid.
            DefinitionError: ``points`` is not a dict from names to definitions.
            ProcessError: The platform is not POSIX.
        """
        if os.name != "posix":
            raise ProcessError(
                "ProcessSimulation needs POSIX: elsewhere a process cannot inherit the descriptors"
            )
        self.command = _words(command)
        if (
            isinstance(timeout, bool)
            or not isinstance(timeout, (int, float, np.number))
            or not 0 < timeout < inf
        ):
            raise OptionValueError(
                f"timeout must be a positive number of seconds, not {short_repr(timeout)}"
            )
        words = [word for pair in env.items() for word in pair] if isinstance(env, Mapping) else []
        if not (env is None or isinstance(env, Mapping)) or not all(
            isinstance(word, str) for word in words
        ):
            raise OptionValueError(
                f"env must be a dict from names to values, all strings, not {short_repr(env)}"
            )
        if cwd is not None and not isinstance(cwd, (str, os.PathLike)):
            raise OptionValueError(f"cwd must be the path of a folder, not {short_repr(cwd)}")
        self.timeout, self.env, self.cwd = float(timeout), None if env is None else dict(env), cwd
        self.points = _by_function(points)
        self.result: Any = None
        self._child: Child | None = None
        self._finalizer: Any = None  # ends the process with the simulation
        self._clear()

    def _clear(self) -> None:
        """Forget the latest episode."""
        # the first frame of an episode that does not run yet
        self._frame: dict[str, Any] | None = None
        # the latest call of each entity at each point
        self._calls: dict[tuple[str, Any], RemoteCall] = {}
        # those of entities that are going to decide
        self._expected: dict[tuple[str, Any], RemoteCall] = {}
        self._time: float | None = None
        self._seed: int | None = None  # the seed to send with the next answer

    def __getstate__(self) -> dict[str, Any]:
        points = {
            getattr(function, BY_NAME): definition for function, definition in self.points.items()
        }
        of_this_process = dict.fromkeys(("_child", "_finalizer", "_frame", "_calls", "_expected"))
        return {**vars(self), "points": points, **of_this_process}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, points=_by_function(state["points"]))
        self._clear()

    # -- episodes ---------------------------------------------------------------------------------

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> None:
        """Begin an episode, in the existing process or in a new one.

        Args:
            seed: The seed for the process's generators.
            options: Further data for the episode, as JSON data.

        Raises:
            WireError: The options are not JSON data, and nothing was sent; or the process breaks
                the rules of the wire.
            ProcessDiedError, ProcessTimeoutError: It does not start, or does not answer.
            UnknownPointError: It does not have the named points.
        """
        start = encode({"start": {"seed": seed, "options": options or {}}})
        self.result = None
        self._clear()
        origin = self._origin()
        child = self._child or acquire(origin)
        if child is not None:
            child.break_off()
            try:
                if child.usable:
                    self._begin(child, start)
                    return
            except ProcessDiedError:
                if child.exit_code() != 0:
                    raise
        child = Child(self.command, self.timeout, self.env, self.cwd)
        child.origin = origin
        self._begin(child, start)

    def _origin(self) -> tuple[Any, ...]:
        """Return a value that is equal for processes that can replace each other, if they are started now."""
        env = dict(os.environ if self.env is None else self.env)
        return self.command, self.timeout, env, os.path.abspath(self.cwd or "")

    def _use(self, child: Child | None) -> None:
        """Use a process, or none, from now on."""
        if self._finalizer is not None:
            self._finalizer.detach()
        self._child = child
        self._finalizer = None if child is None else finalize(self, child.close)

    def _begin(self, child: Child, start: bytes) -> None:
        """Begin an episode in a process with a line, and wait for the first frame."""
        self._use(child)
        missing = [name for name in self._functions() if name not in child.points]
        if missing:
            has = ", ".join(sorted(child.points)) or "none"
            child.fail(
                UnknownPointError(
                    f"{child} has no decision point {', '.join(missing)}; it has {has}"
                )
            )
        try:
            self._frame = child.begin(start)
        except BaseException:
            child.break_off()
            raise
        self._time = child.time

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
        child, frame, self._frame = self._child, self._frame, None
        if child is None or frame is None:
            raise SimulationError("run() runs each episode once: call reset() first")
        functions = self._functions()
        try:
            while "end" not in frame:
                self._time = child.time
                for item in frame.get("expect", [frame]):
                    if item["point"] in functions:
                        self._handle(child, item, functions[item["point"]])
                    elif "decide" in item:
                        child.leave_to_rule()
                frame = child.next_frame()
        except BaseException:
            if self._child is child:  # otherwise it may serve another simulation already
                child.break_off()
            raise
        self.result = frame["end"].get("result")
        return TRUNCATED if frame["end"].get("truncated") else None

    def close(self, last: bool = True) -> None:
        """End the process, if no other episode follows.

        Args:
            last: Whether no other episode follows.
        """
        child = self._child
        if last and child is not None:
            self._use(None)
            child.break_off()
            if not release(child.origin, child):
                child.close()

    @property
    def time(self) -> Callable[[], float]:
        """A method that returns the process's time.

        The attribute is missing if the process tells no time.
        """
        if self._time is None:
            raise AttributeError("the process has not sent a time")
        return lambda: self._time  # type: ignore[return-value]

    @property
    def expected_calls(self) -> Callable[[str], list[tuple[RemoteCall]]]:
        """A method that returns the coming calls of a point.

        Missing if the process did not announce "expect".
        """
        if self._child is None or "expect" not in self._child.can:
            raise AttributeError('the process has not announced "expect" in its hello')
        return lambda point: [
            (call,) for (name, _), call in self._expected.items() if name == point
        ]

    def reseed(self, seed: int) -> None:
        """Ask the process to reseed its generators, so that it draws new random numbers from here on.

        Raises:
            BranchError: The process did not announce "reseed".
        """
        child = self._child
        if child is None or "reseed" not in child.can:
            raise BranchError(
                f'{child or "a process that was not started"} has not announced "reseed" in its'
                " hello"
            )
        self._seed = int(seed)

    # -- frames -----------------------------------------------------------------------------------

    def _handle(
        self, child: Child, frame: dict[str, Any], function: Callable[[RemoteCall], Any]
    ) -> None:
        """Handle a frame of an entity at a point, or an item of an "expect", given the point's decision function."""
        key = frame["point"], frame["entity"]
        call = self._calls.get(key)
        if call is None:
            if "update" in frame or "remove" in frame:
                return  # an entity without a call so far
            call = self._calls[key] = RemoteCall(*key)
        if "remove" in frame:
            self._expected.pop(key, None)
            del self._calls[key]
            point_functions(call.point).remove(call)
            return
        call.__dict__, call.time = frame.get("args") or {}, child.time
        if "decide" in frame:
            self._expected.pop(key, None)
            self._decide(child, call, function)
        elif "update" not in frame:
            self._expected[key] = call

    def _decide(
        self, child: Child, call: RemoteCall, function: Callable[[RemoteCall], Any]
    ) -> None:
        """Get the decision of a call, and send it.

        If the rule is run, the process decides at once.
        """
        ruled: list[Any] = []

        def rule() -> Any:
            if not ruled:
                ruled.append(child.leave_to_rule(self._reseeding()))
            return ruled[0]

        call._rule = rule if "decided" in child.can else None
        try:
            value = function(call)
        finally:
            call._rule = None
        if ruled:
            if value is not ruled[0] and value is not RULE:
                raise SimulationError(
                    f"the rule of {call.point} has decided {short_repr(ruled[0])} for"
                    f" {call.entity!r}, and the process continues with that: {short_repr(value)}"
                    " cannot replace it. A handler or apply that asks the rule must return what it"
                    " decided; of a call that is split, answer all items by RULE, or none"
                )
        elif value is RULE:
            rule()
        else:
            try:
                line = encode_answer(child.number, value)
            except WireError as error:
                annotate(error, f"simenv_marl: in the decision of {call.entity!r} at {call.point}")
                raise
            child.answer(self._reseeding() + line)

    def _reseeding(self) -> bytes:
        """Return the line that reseeds the process, if one is due."""
        seed, self._seed = self._seed, None
        return b"" if seed is None else encode({"reseed": seed})

    def _functions(self) -> dict[str, Any]:
        """Return the decision functions of the points, by name."""
        return {getattr(function, BY_NAME): function for function in self.points}


def _words(command: Any) -> list[str]:
    """Return the program and its arguments, as strings."""
    words = [command] if isinstance(command, (str, os.PathLike)) else command
    if (
        not isinstance(words, Sequence)
        or not words
        or not all(isinstance(word, (str, os.PathLike)) for word in words)
    ):
        raise OptionValueError(
            "command must be a program and its arguments, a list of strings, not"
            f" {short_repr(command)}"
        )
    return [os.fspath(word) for word in words]


def _by_function(points: Any) -> dict[Any, Definition]:
    """Return the definitions by the decision functions of their names."""
    if not isinstance(points, Mapping) or not points:
        raise DefinitionError(
            "points must be a dict from the process's names to definitions, not"
            f" {short_repr(points)}"
        )
    for name, definition in points.items():
        if not isinstance(name, str) or not name or not isinstance(definition, Definition):
            raise DefinitionError(
                "points must be a dict from the process's names to what make_step returns, not"
                f" {short_repr(name)}: {short_repr(definition)}"
            )
    return {point_functions(name).decide: definition for name, definition in points.items()}
