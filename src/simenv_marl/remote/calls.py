"""The calls of a simulator's decision points.

``RemoteEpisode`` turns the frames of an episode into calls of decision functions, which
``decision_function`` makes. Their argument, which mappings receive, is a ``RemoteCall``.
"""

from collections import deque
from collections.abc import Callable, Collection, Iterator
from functools import cache
from types import CodeType, FunctionType
from typing import Final, TypeAlias
from weakref import WeakKeyDictionary

from ..decision import BY_NAME, point_for
from ..errors import SimulationError, WireError, annotate, short_repr
from ..hooks.hook import Hook
from ..simulation import RULE, Model
from .child import Child
from .wire import Entity, Frame


class RemoteCall:
    """An entity's latest call of a decision point: the argument of mappings and ``apply``.

    The call's arguments are its attributes and items: ``call.level``, ``call["queue-length"]``.
    Each entity at a point has one object, which changes from call to call. A copy of it does not
    change.

    Attributes:
        point: The name of the decision point.
        entity: The name of the deciding entity in the process; None without an entity.
        time: The process's time; None if it sent none.
    """

    __slots__ = ("__dict__", "__weakref__", "entity", "point", "time")

    def __init__(self, point: str, entity: Entity) -> None:
        self.point = point
        self.entity = entity
        self.time: float | None = None

    def __getitem__(self, name: str) -> Model:
        if name in self.__dict__ or name in ("entity", "time"):
            return getattr(self, name)
        raise KeyError(self._missing(name))

    def __iter__(self) -> Iterator[str]:
        return iter(self.__dict__)

    def __len__(self) -> int:
        return len(self.__dict__)

    def __getattr__(self, name: str) -> Model:
        if name in RemoteCall.__slots__:  # a copy is being made
            raise AttributeError(name)
        raise AttributeError(self._missing(name))

    def __repr__(self) -> str:
        return (
            f"RemoteCall({self.point}, entity={self.entity!r}, time={self.time!r},"
            f" arguments={self.__dict__})"
        )

    def _missing(self, name: str) -> str:
        return (
            f"the call of {self.point} has no argument {name!r}; it has"
            f" {', '.join(self.__dict__) or 'none'}"
        )

    def _update(self, arguments: dict[str, Model], time: float | None) -> None:
        self.__dict__ = arguments
        self.time = time


# -- decision functions ---------------------------------------------------------------------------

DecisionFunction: TypeAlias = Callable[[RemoteCall], Model]

_DECIDING: Final[WeakKeyDictionary[RemoteCall, Child]] = WeakKeyDictionary()
"""The processes that wait for the decisions of calls, by call."""


@cache
def decision_function(name: str) -> DecisionFunction:
    """Return the function that represents decision points of that name, in all simulators.

    Its rule has the process decide, and returns the decision; ``RULE`` if the process does not
    report it.
    """
    hook = _named_hook(_decide_by_rule.__code__, name)
    point_for(hook).removed_by[removal_function(name)] = None
    return hook.make_wrapper()


@cache
def removal_function(name: str) -> DecisionFunction:
    """Return the function that ends the agent of an entity at decision points of that name."""
    return _named_hook(_remove.__code__, f"{name} (removed)").make_wrapper()


def _decide_by_rule(call: RemoteCall) -> Model:
    child = _DECIDING.get(call)
    return RULE if child is None or "decided" not in child.can else child.decide_by_rule()


def _remove(call: RemoteCall) -> None:
    pass


def _named_hook(code: CodeType, name: str) -> Hook:
    """Return the hook of a function that is found by a name, not in a module."""
    code = code.replace(co_name=name.rpartition(".")[2], co_qualname=name)
    function = FunctionType(code, globals())
    setattr(function, BY_NAME, name)
    return Hook(function, name, bound=True, exposed=True)


# -- episodes -------------------------------------------------------------------------------------


class RemoteEpisode:
    """An episode in a process, whose calls become calls of decision functions.

    Attributes:
        time: The process's time; None if it sent none.
        has_run: Whether ``run`` was called.
    """

    def __init__(self, child: Child, points: Collection[str], start: bytes) -> None:
        """Begin an episode in a process with a line, and read its frames up to the first call.

        The process decides itself at points other than these. The frames before the first call may
        have no time, but code that asks after the reset must learn whether there is one.
        """
        self._child = child
        self._points = points
        self._calls: dict[tuple[str, Entity], RemoteCall] = {}
        self._expected_calls: dict[RemoteCall, None] = {}
        frame = child.begin(start)
        self._frames = deque([(frame, child.time)])
        while not frame.keys() & {"decide", "end"}:
            frame = child.next_frame()
            self._frames.append((frame, child.time))
        self.time = child.time
        self.has_run = False

    def run(self) -> Frame:
        """Run the episode once; return the "end" of its last frame.

        Raises:
            ProcessError: As ``Child.next_frame``.
            SimulationError: A handler or ``apply`` has replaced a decision of the rule.
        """
        self.has_run = True
        child = self._child
        while True:
            frame, time = (
                self._frames.popleft() if self._frames else (child.next_frame(), child.time)
            )
            if "end" in frame:
                end: Frame = frame["end"]
                return end
            if time is not None:
                self.time = time
            for item in frame.get("expect", [frame]):
                if item["point"] in self._points:
                    self._handle(item, time)
                elif "decide" in item:
                    child.decide_by_rule()

    def expected_calls(self, point: str) -> list[tuple[RemoteCall]]:
        """Return the calls of a point that the process has announced and has not made yet."""
        return [(call,) for call in self._expected_calls if call.point == point]

    def _handle(self, frame: Frame, time: float | None) -> None:
        """Handle a frame of an entity at a point, or an item of an "expect"."""
        key = frame["point"], frame["entity"]
        call = self._calls.get(key)
        if call is None:
            if "update" in frame or "remove" in frame:
                return  # the entity has made no call that could change
            call = self._calls[key] = RemoteCall(*key)
        if "remove" in frame:
            self._expected_calls.pop(call, None)
            del self._calls[key]
            removal_function(call.point)(call)
            return
        call._update(frame.get("args") or {}, time)
        if "decide" in frame:
            self._expected_calls.pop(call, None)
            self._decide(call)
        elif "update" not in frame:
            self._expected_calls[call] = None

    def _decide(self, call: RemoteCall) -> None:
        """Get the decision of a call, and send it unless the rule has decided already."""
        child = self._child
        _DECIDING[call] = child
        try:
            value = decision_function(call.point)(call)
        finally:
            del _DECIDING[call]
        if child.rule_frame is not None:
            decision = child.rule_frame["value"]
            if value is not decision and value is not RULE:
                raise SimulationError(
                    f"the rule of {call.point} has decided {short_repr(decision)} for"
                    f" {call.entity!r}, and the process continues with that: {short_repr(value)}"
                    " cannot replace it. A handler or apply that asks the rule must return the"
                    " rule's decision; of a call that is split, answer all items by RULE, or none"
                )
        elif value is RULE:
            child.decide_by_rule()
        else:
            try:
                child.answer(value)
            except WireError as error:
                annotate(error, f"simenv_marl: in the decision of {call.entity!r} at {call.point}")
                raise
