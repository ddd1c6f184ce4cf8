"""A simulation whose model runs in another process, and requests decisions over a pair of pipes."""

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial

from ..core import acquire, release
from ..decision import Definition
from ..errors import (
    BranchError,
    DefinitionError,
    OptionValueError,
    ProcessDiedError,
    ProcessError,
    SimulationError,
    UnknownPointError,
    short_repr,
)
from ..simulation import TRUNCATED, Model, SimulationInterface, check_seconds
from .calls import DecisionFunction, RemoteCall, RemoteEpisode, decision_function
from .child import Child, StrPath
from .wire import encode


class ProcessSimulation(SimulationInterface):
    """A simulation whose model runs in another process (POSIX), in any language.

    The first ``reset`` starts the process, which plays one episode after the other. The process
    ends when the environment is closed or garbage-collected. It requests decisions in its own
    order, and decides itself if the answer is ``RULE``.

    Mappings, ``agent`` and ``apply`` get one object for each entity at a point. The call's
    arguments are its attributes and items (``call.level``, ``call["queue-length"]``); it also has
    ``entity`` and ``time``. The result of ``apply`` is sent as the decision; ``RULE`` leaves it to
    the process.

    Attributes:
        result: The result that the process sent at the end of the latest episode; None before.
    """

    _child: Child | None = None
    _episode: RemoteEpisode | None = None

    def __init__(
        self,
        command: StrPath | Sequence[StrPath],
        points: Mapping[str, Definition],
        *,
        timeout: float = 30.0,
        env: Mapping[str, str] | None = None,
        cwd: StrPath | None = None,
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
            env: The environment variables of the process. None: the variables of this process.
            cwd: The working directory of the process. None: the directory of this process.

        Raises:
            OptionValueError: The command, the timeout, ``env`` or ``cwd`` is invalid.
            DefinitionError: ``points`` is not a dict from names to definitions.
            ProcessError: The platform is not POSIX.
        """
        if os.name != "posix":
            raise ProcessError(
                "ProcessSimulation needs POSIX: elsewhere a process cannot inherit the descriptors"
            )
        self.command = _command_words(command)
        if env is not None and not (
            isinstance(env, Mapping)
            and all(isinstance(text, str) for text in [*env, *env.values()])
        ):
            raise OptionValueError(
                f"env must be a dict from names to values, all strings, not {short_repr(env)}"
            )
        if cwd is not None and not isinstance(cwd, (str, os.PathLike)):
            raise OptionValueError(f"cwd must be the path of a folder, not {short_repr(cwd)}")
        self.timeout = check_seconds(timeout, "timeout")
        self.env = None if env is None else dict(env)
        self.cwd = cwd
        self._points = _checked_points(points)
        self.result: Model = None

    def __del__(self) -> None:
        if self._child is not None:
            self._child.close()

    def __getstate__(self) -> dict[str, Model]:
        return {**vars(self), "_child": None, "_episode": None}

    @property
    def points(self) -> dict[DecisionFunction, Definition]:
        """The decision points with their definitions."""
        return {decision_function(name): part for name, part in self._points.items()}

    # -- episodes ---------------------------------------------------------------------------------

    def reset(self, seed: int | None = None, options: dict[str, Model] | None = None) -> None:
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
        self._episode = None
        # equal for processes that can replace each other
        variables = dict(os.environ if self.env is None else self.env)
        launch = self.command, self.timeout, variables, os.path.abspath(self.cwd or "")
        child = self._child or acquire(launch, Child)
        if child is not None:
            child.break_off()
            try:
                if child.usable:
                    self._begin(child, start)
                    return
            except ProcessDiedError:
                if child.exit_code() != 0:
                    raise
        self._begin(Child(*launch), start)

    def _begin(self, child: Child, start: bytes) -> None:
        """Begin an episode in a process with a line, and wait for the first frame."""
        self._child = child
        missing = [name for name in self._points if name not in child.points]
        if missing:
            child.fail(
                f"has no decision point {', '.join(missing)}; it has"
                f" {', '.join(sorted(child.points)) or 'none'}",
                UnknownPointError,
            )
        try:
            self._episode = RemoteEpisode(child, self._points, start)
        except BaseException:
            child.break_off()
            raise

    def run(self) -> Model:
        """Run the episode in the process; its calls become calls of the points' decision functions.

        Returns:
            ``TRUNCATED`` if the process reports a time limit; else None.

        Raises:
            RemoteError: The model raised an error.
            WireError: The process breaks the rules of the wire, or a decision is not JSON data.
            ProcessDiedError, ProcessTimeoutError: It has ended, or does not answer.
            SimulationError: No episode was begun.
        """
        child = self._child
        episode = self._episode
        if child is None or episode is None or episode.has_run:
            raise SimulationError("run() runs each episode once: call reset() first")
        try:
            end = episode.run()
        except BaseException:
            if self._child is child:  # otherwise it may serve another simulation already
                child.break_off()
            raise
        self.result = end.get("result")
        return TRUNCATED if end.get("truncated") else None

    def close(self, last: bool = True) -> None:
        """End the process, if no other episode follows.

        Args:
            last: Whether no other episode follows.
        """
        child = self._child
        if last and child is not None:
            self._child = None
            child.break_off()
            if not release(child.launch, child):
                child.close()

    @property
    def time(self) -> Callable[[], float]:
        """A method that returns the process's time.

        The attribute is missing if the process sends no time.
        """
        if self._episode is None or self._episode.time is None:
            raise AttributeError("the process has not sent a time")
        return partial(getattr, self._episode, "time")

    @property
    def expected_calls(self) -> Callable[[str], list[tuple[RemoteCall]]]:
        """A method that returns the coming calls of a point.

        Missing if the process did not announce "expect".
        """
        if self._child and self._episode and "expect" in self._child.can:
            return self._episode.expected_calls
        raise AttributeError('the process has not announced "expect" in its hello')

    def reseed(self, seed: int) -> None:
        """Ask the process to reseed its generators, for new random numbers from here on.

        Raises:
            BranchError: The process did not announce "reseed".
        """
        child = self._child
        if child is None or "reseed" not in child.can:
            raise BranchError(
                f'{child or "a process that was not started"} has not announced "reseed" in its'
                " hello"
            )
        child.reseed(int(seed))


def _command_words(command: StrPath | Sequence[StrPath]) -> list[str]:
    """Return the program and its arguments, as strings."""
    words = [command] if isinstance(command, (str, os.PathLike)) else command
    with suppress(TypeError):
        if words and isinstance(words, Sequence):
            return [os.fspath(word) for word in words]
    raise OptionValueError(
        f"command must be a program and its arguments, a list of strings, not {short_repr(command)}"
    )


def _checked_points(points: Mapping[str, Definition]) -> dict[str, Definition]:
    """Copy the definitions by name, or refuse them."""
    if not isinstance(points, Mapping) or not points:
        raise DefinitionError(
            f"points must be a dict from names to definitions, not {short_repr(points)}"
        )
    for name, definition in points.items():
        if not isinstance(name, str) or not name or not isinstance(definition, Definition):
            raise DefinitionError(
                "points must be a dict from the process's names to definitions, the results of"
                f" make_step, not {short_repr(name)}: {short_repr(definition)}"
            )
    return dict(points)
