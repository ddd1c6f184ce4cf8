"""Which stacks belong to simulations, and for whom something is evaluated on a stack.

A *stack* is a greenlet; a thread that knows nothing of greenlets has one all the same, its root. The stack of a
simulation is entered in ``STACKS`` for as long as it lives. A greenlet belongs to the simulation whose stack is the
nearest among itself, its parents, their parents, and so on. What an environment evaluates on its user's side
(mappings, policies, the clock) is entered in ``EVALUATING`` under the greenlet on which that runs.

Nothing here changes when a simulation is resumed or suspended: other stacks have other keys.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from multiprocessing.util import register_after_fork
from threading import RLock
from typing import Any, Final, Protocol

from greenlet import getcurrent, greenlet

Taker = Callable[[tuple[Any, ...], dict[str, Any]], Any]
"""Takes part in a call: gets its arguments, positional and by keyword, and returns what the call returns."""

LOCK: Final = RLock()
"""Held while functions are set in a model or put back, and while handlers come and go. Calls need none."""


class Stack(Protocol):
    """What hooks need to know of a simulation's stack.

    Attributes:
        plugins: The plugins of the simulation's environment; None if it has none.
    """

    plugins: Any

    def taker(self, hook: Any, here: greenlet) -> Taker | None:
        """Who decides a call of a hook in a greenlet of the simulation's; None: the rule, with handlers around it."""

    def refusal_of(self, hook: Any, where: str) -> Taker | None:
        """What refuses a decision that was asked for where the simulation cannot wait; None where it is none."""

    def hide(self) -> None:
        """Take no part in calls on the simulation's stack until ``show``."""

    def show(self) -> None:
        """Take part again."""

    def forked(self) -> None:
        """The process was forked, and this is the child."""

    def forked_worker(self) -> None:
        """The simulation has begun a worker of ``multiprocessing`` by a fork, and this is the worker."""


class Evaluation(Protocol):
    """For whom something is evaluated.

    Attributes:
        memory: What differences remember; None: nothing.
        plugins: The plugins that take part; None: none but the handlers of the whole process.
    """

    @property
    def memory(self) -> dict[Any, Any] | None:
        """What differences remember."""

    @property
    def plugins(self) -> Any:
        """The plugins that take part."""


class Outside:
    """Stands in ``STACKS`` for a simulation's stack on which another environment is at work."""

    def __repr__(self) -> str:
        return "OUTSIDE"


OUTSIDE: Final = Outside()

STACKS: Final[dict[greenlet, Any]] = {}
"""The stacks of simulations, by greenlet: a ``Stack`` for each, or ``OUTSIDE``."""

EVALUATING: Final[dict[greenlet, Evaluation]] = {}
"""By greenlet: for whom something is evaluated there. Those who enter something put back what was there."""

DIFFERENCES: Final[list[str]] = []
"""Not empty once a difference was made. While it is empty, and there are no plugins, mappings need no entry in
``EVALUATING``."""


def stack_of(here: greenlet | None) -> Any:
    """The simulation's stack to which a greenlet belongs; None if it belongs to none."""
    while here is not None:
        stack = STACKS.get(here)
        if stack is not None:
            return None if stack is OUTSIDE else stack
        here = here.parent
    return None


def spawner_of(here: greenlet) -> Any:
    """The simulation's stack from which a greenlet was spawned on a hub of others, as gevent does it; or None."""
    spawned: Any = here
    for _ in range(100):
        spawner = getattr(spawned, "spawning_greenlet", None)
        spawner = spawner() if callable(spawner) else spawner  # a weak reference
        if spawner is None:
            break
        stack = stack_of(spawner)
        if stack is not None:
            return stack
        spawned = spawner
    # A greenlet that has spawned another one may be gone, but all that one stack has led to share a dict.
    tree = getattr(spawned, "spawn_tree_locals", None)
    if tree is not None:
        for stack in list(STACKS):
            if getattr(stack, "spawn_tree_locals", None) is tree:
                return stack_of(stack)
    return None


def plugins_at_work() -> Any:
    """The plugins that take part in what runs here; None: none but the handlers of the whole process."""
    here = getcurrent()
    stack = stack_of(here) if STACKS else None
    if stack is not None:
        return stack.plugins
    evaluation = EVALUATING.get(here)
    return None if evaluation is None else evaluation.plugins


class outside_simulation:  # noqa: N801 - it is used like a function
    """Keep apart what runs in this greenlet from a simulation or an evaluation that runs around it.

    Decision functions run their rule, and what takes part is what this says, and not what did before.

    It is a class, because a context manager made of a generator cannot pass on errors that refuse to be changed, as
    frozen dataclasses do.
    """

    __slots__ = ("_before", "_evaluation", "_here", "_hidden", "_mask")

    def __init__(self, evaluation: Evaluation | None = None) -> None:
        """Prepare it.

        Args:
            evaluation: For whom something is evaluated here, and who takes part in it.
        """
        self._evaluation = evaluation

    def __enter__(self) -> None:
        self._here = here = getcurrent()
        self._before = EVALUATING.get(here)
        self._hidden = stack_of(here) if STACKS else None
        self._mask = STACKS.get(here)
        if self._hidden is not None:
            if self._mask is not None:
                self._hidden.hide()
            STACKS[here] = OUTSIDE
        self._put(EVALUATING, self._evaluation)

    def __del__(self) -> None:
        # An interrupt at the entry of ``__exit__`` has kept it from running.
        if hasattr(self, "_mask") and EVALUATING.get(self._here) is self._evaluation:
            outside_simulation.__exit__(self)

    def __exit__(self, *error: object) -> None:
        self._put(EVALUATING, self._before)
        if self._hidden is not None:
            self._put(STACKS, self._mask)
            if self._mask is not None:
                self._hidden.show()
        del self._here, self._hidden, self._mask, self._before

    def _put(self, book: dict[greenlet, Any], value: Any) -> None:
        if value is None:
            book.pop(self._here, None)
        else:
            book[self._here] = value


def _in_the_child_of_a_fork() -> None:
    for stack in [stack for stack in STACKS.values() if stack is not OUTSIDE]:
        stack.forked()
    here: greenlet | None = getcurrent()
    kept = set()
    while here is not None:
        kept.add(here)
        here = here.parent
    for other in EVALUATING.keys() - kept:
        del EVALUATING[other]


def _in_a_forked_worker(_: object) -> None:
    stack = stack_of(getcurrent())
    if stack is not None:
        stack.forked_worker()


register_after_fork(OUTSIDE, _in_a_forked_worker)  # of multiprocessing alone: a plain fork goes on twice

if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_the_child_of_a_fork)
