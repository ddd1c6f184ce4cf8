"""The calls of a simulator's decision points, as mappings see them, and the functions that represent the points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import cache
from typing import Any, NamedTuple

from ..decision import BY_NAME, point_for
from ..hooks.hook import Hook
from ..simulation import RULE


class RemoteCall:
    """An entity's latest call of a decision point: the argument of mappings, ``agent`` and ``apply``.

    The call's arguments are its attributes and items: ``call.level``, ``call["queue-length"]``.
    Each entity at a point has one object, which changes from call to call. A copy of it does not
    change.

    Attributes:
        point: The name of the decision point.
        entity: The deciding entity, as the process names it; None if it names none.
        time: The process's time; None if it tells none.
    """

    __slots__ = ("__dict__", "__weakref__", "_rule", "entity", "point", "time")

    def __init__(self, point: str, entity: Any) -> None:
        self.point, self.entity = point, entity
        self.time: float | None = None
        # returns the rule's decision, while one is due and can be known
        self._rule: Callable[[], Any] | None = None

    def __getstate__(self) -> Any:
        return self.__dict__, {
            "point": self.point,
            "entity": self.entity,
            "time": self.time,
            "_rule": None,
        }

    def __getitem__(self, name: str) -> Any:
        if name in ("entity", "time"):
            return getattr(self, name)
        if name not in self.__dict__:
            raise KeyError(self._missing(name))
        return self.__dict__[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self.__dict__)

    def __len__(self) -> int:
        return len(self.__dict__)

    def __getattr__(self, name: str) -> Any:
        if name in RemoteCall.__slots__:  # a copy is being made
            raise AttributeError(name)
        raise AttributeError(self._missing(name))

    def _missing(self, name: str) -> str:
        return (
            f"the call of {self.point} has no argument {name!r}; it has"
            f" {', '.join(self.__dict__) or 'none'}"
        )

    def __repr__(self) -> str:
        arguments = "".join(f", {name}={value!r}" for name, value in self.__dict__.items())
        return f"RemoteCall({self.point}, entity={self.entity!r}, time={self.time!r}{arguments})"


class PointFunctions(NamedTuple):
    """The functions that represent a decision point of a simulator."""

    decide: Callable[[RemoteCall], Any]
    """The decision function.

    Its rule has the process decide, and returns what it decided; ``RULE`` if it tells not.
    """

    remove: Callable[[RemoteCall], None]
    """Ends the agent of an entity that is gone."""


@cache
def point_functions(name: str) -> PointFunctions:
    """Return the functions that represent decision points of that name, in all simulators."""
    decide_hook = _named_hook(lambda call: RULE if call._rule is None else call._rule(), name)
    remove_hook = _named_hook(lambda call: None, f"{name} (removed)")
    functions = PointFunctions(decide_hook.make_wrapper(), remove_hook.make_wrapper())
    point_for(decide_hook).removed_by[functions.remove] = None
    return functions


def _named_hook(function: Any, name: str) -> Hook:
    """Return the hook of a function that is found by a name, not in a module."""
    setattr(function, BY_NAME, name)
    function.__name__, function.__qualname__ = name.rpartition(".")[2], name
    return Hook(function, name, bound=True, exposed=True)
