"""The stacks of simulations, and the environment for which code on a stack is evaluated.

A *stack* is a greenlet; a thread without greenlets has one, too, its root. ``STACKS`` has the
driver of each simulation by its stack. A greenlet belongs to the simulation whose stack is the
nearest among itself and its parents. All other code is the user's: there, decision functions run
their rule. While an environment evaluates something on the user's side (mappings, policies, the
clock), ``EVALUATING`` has an entry for the greenlet that runs it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from threading import RLock
from typing import Any, Final

from greenlet import getcurrent, greenlet

Interceptor = Callable[[tuple[Any, ...], dict[str, Any]], Any]
"""A function that intercepts a call.

It gets the positional and keyword arguments, and returns the call's result.
"""

LOCK: Final = RLock()
"""Held while patches or handlers change. Calls do not need it."""

SIMULATION: Final = "simulation"
"""The name of the threads in which simulations run."""

OUTSIDE: Final = object()
"""The entry in ``STACKS`` for a simulation's stack on which another environment runs."""

STACKS: Final[dict[greenlet, Any]] = {}
"""The driver of each simulation by its stack, or ``OUTSIDE``.

And its driver for each thread that a simulation
has started, by its root."""

EVALUATING: Final[dict[greenlet, Any]] = {}
"""For each greenlet, the agent or the plugins of the environment for which it evaluates something: an object with the
``plugins`` that take part, and the ``memory`` of differences. Code that sets an entry restores the
previous one."""

DIFFERENCES: Final[list[str]] = []
"""Not empty once a difference was made. While it is empty and there are no plugins, mappings need no entry in
``EVALUATING``."""


def stack_of(here: greenlet | None) -> Any:
    """Return the entry of the nearest stack to which a greenlet belongs.

    None if it belongs to none.
    """
    while here is not None:
        driver = STACKS.get(here)
        if driver is not None:
            return None if driver is OUTSIDE else driver
        here = here.parent
    return None


def spawner_of(here: Any) -> Any:
    """Return the entry of the stack whose code has spawned a greenlet with gevent.

    None if none has.
    """
    driver = None
    while driver is None and (spawner := getattr(here, "spawning_greenlet", None)) is not None:
        here = spawner()  # None if it is gone
        driver = stack_of(here)
    return driver


def plugins_at_work() -> Any:
    """Return the plugins that take part here. None: only the handlers of the whole process."""
    here = getcurrent()
    evaluation = (stack_of(here) if STACKS else None) or EVALUATING.get(here)
    return None if evaluation is None else evaluation.plugins


class outside_simulation:  # noqa: N801 - it is used like a function
    """Separate code in this greenlet from a simulation or an evaluation that runs around it.

    Inside, decision functions run their rule, and only the given evaluation's plugins take part.
    This is a class because the context manager of a generator cannot pass on immutable errors, such
    as frozen dataclasses.
    """

    __slots__ = ("_before", "_entry", "_evaluation", "_here")

    def __init__(self, evaluation: Any = None) -> None:
        self._evaluation = evaluation
        self._here: greenlet | None = None

    def __enter__(self) -> None:
        here = getcurrent()
        self._before, self._entry = EVALUATING.get(here), STACKS.get(here)
        self._here = here  # from now on there is something to restore
        if STACKS and stack_of(here) is not None:
            if self._entry is not None:
                self._entry.leave_hooks(here)
            STACKS[here] = OUTSIDE
        if self._evaluation is not None:
            EVALUATING[here] = self._evaluation
        else:
            EVALUATING.pop(here, None)

    def __exit__(self, *error: object) -> None:
        # tracebacks keep this object, and a root must not outlive its thread
        here, self._here = self._here, None
        if here is None:
            return
        if self._before is not None:
            EVALUATING[here] = self._before
        else:
            EVALUATING.pop(here, None)
        if self._entry is None:
            STACKS.pop(here, None)
            return
        STACKS[here] = self._entry
        if self._entry is not OUTSIDE:
            self._entry.enter_hooks()


def _refuse_after_fork() -> None:
    """In a process that a simulation has forked: refuse its decisions, because its user is in the other process."""
    driver = stack_of(getcurrent())
    if driver is not None:
        driver.forked = True
        driver.enter_hooks()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_refuse_after_fork)
