"""The stacks of simulations, and the environment for which code on a stack is evaluated.

A *stack* is a greenlet; a thread without greenlets has one, too, its root. ``STACKS`` has the stack of each simulation
as long as it lives. A greenlet belongs to the simulation whose stack is the nearest among itself, its parent, the
parent of that, and so on. While an environment evaluates something on the caller's side (mappings, policies, the
clock), ``EVALUATING`` has an entry for the greenlet that runs it.

Resuming or suspending a simulation changes nothing here, since other stacks have other keys.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from multiprocessing.util import register_after_fork
from threading import RLock
from typing import Any, Final, Protocol

from greenlet import getcurrent, greenlet

Taker = Callable[[tuple[Any, ...], dict[str, Any]], Any]
"""A participant in a call: it gets the positional and keyword arguments, and returns the result of the call."""

LOCK: Final = RLock()
"""Held while patches or handlers change. Calls do not need it."""


class Stack(Protocol):
    """What hooks need to know of a simulation's stack.

    Attributes:
        plugins: The plugins of the simulation's environment; None if it has none.
    """

    plugins: Any

    def taker(self, hook: Any, here: greenlet) -> Taker | None:
        """Return what decides a call in a greenlet of the simulation; None for the rule with its handlers."""

    def refusal_of(self, hook: Any, where: str) -> Taker | None:
        """Return a taker that refuses a decision where the simulation cannot wait; None if it is not a decision."""

    def hide(self) -> None:
        """Take no part in calls on the simulation's stack until ``show``."""

    def show(self) -> None:
        """Take part again."""

    def forked(self) -> None:
        """React to a fork, in the child process."""

    def forked_worker(self) -> None:
        """React to a fork by which the simulation started a ``multiprocessing`` worker, in the worker."""


class Evaluation(Protocol):
    """The environment or agent for which code is evaluated.

    Attributes:
        memory: The memory of differences; None if there is none.
        plugins: The plugins that take part. None: only the handlers of the whole process.
    """

    @property
    def memory(self) -> dict[Any, Any] | None:
        """The memory of differences."""

    @property
    def plugins(self) -> Any:
        """The plugins that take part."""


class Outside:
    """The entry in ``STACKS`` for a simulation's stack on which another environment runs."""

    def __repr__(self) -> str:
        return "OUTSIDE"


OUTSIDE: Final = Outside()

STACKS: Final[dict[greenlet, Any]] = {}
"""The stacks of simulations, by greenlet: a ``Stack`` for each, or ``OUTSIDE``."""

EVALUATING: Final[dict[greenlet, Evaluation]] = {}
"""The running evaluation of each greenlet. Code that sets an entry restores the previous one."""

DIFFERENCES: Final[list[str]] = []
"""Not empty once a difference was made. While it is empty and there are no plugins, mappings need no entry in
``EVALUATING``."""


def stack_of(here: greenlet | None) -> Any:
    """Return the simulation's stack to which a greenlet belongs; None if it belongs to none."""
    while here is not None:
        stack = STACKS.get(here)
        if stack is not None:
            return None if stack is OUTSIDE else stack
        here = here.parent
    return None


def spawner_of(here: greenlet) -> Any:
    """Return the simulation's stack that spawned a greenlet on another hub, as gevent does; or None."""
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
    # The greenlet that spawned this one may be gone, but all descendants of one stack share a dict.
    tree = getattr(spawned, "spawn_tree_locals", None)
    if tree is not None:
        for stack in list(STACKS):
            if getattr(stack, "spawn_tree_locals", None) is tree:
                return stack_of(stack)
    return None


def plugins_at_work() -> Any:
    """Return the plugins that take part here. None: only the handlers of the whole process."""
    here = getcurrent()
    stack = stack_of(here) if STACKS else None
    if stack is not None:
        return stack.plugins
    evaluation = EVALUATING.get(here)
    return None if evaluation is None else evaluation.plugins


class outside_simulation:  # noqa: N801 - it is used like a function
    """Separate code in this greenlet from a simulation or an evaluation that runs around it.

    Inside, decision functions run their rule, and only the given evaluation's plugins take part.

    This is a class because the context manager of a generator cannot pass on immutable errors, such as frozen
    dataclasses.
    """

    __slots__ = ("_before", "_evaluation", "_here", "_hidden", "_mask")

    def __init__(self, evaluation: Evaluation | None = None) -> None:
        """Prepare the separation.

        Args:
            evaluation: The evaluation that runs inside.
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
        # An interrupt at the entry of ``__exit__`` kept it from running.
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


register_after_fork(OUTSIDE, _in_a_forked_worker)  # only for multiprocessing: after a plain fork, both processes go on

if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_in_the_child_of_a_fork)
