"""The stacks of simulations, and evaluations for an environment on the user's side.

A *stack* is a greenlet; a thread without greenlets has one as well, its root. ``STACKS`` maps the
stack of each simulation to its driver. A greenlet belongs to the simulation whose stack is the
nearest among the greenlet and its parents. All other code is the user's: there, decision functions
run their rule. While an environment evaluates mappings, policies or the clock on the user's side,
``EVALUATING`` has an entry for the greenlet that runs them.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Hashable
from threading import RLock
from typing import Any, Final, Protocol

from greenlet import getcurrent, greenlet

from ..simulation import Model

Args = tuple[Model, ...]
"""The positional arguments of a call."""

Kwargs = dict[str, Model]
"""The keyword arguments of a call."""

Interceptor = Callable[[Args, Kwargs], Model]
"""A function that intercepts a call.

It receives the positional and keyword arguments, and returns the call's result.
"""


class Evaluation(Protocol):
    """An agent, or the plugins of an environment, while code is evaluated for it."""

    @property
    def plugins(self) -> Hashable | None:
        """The plugins that take part. None: only the handlers of the whole process."""

    @property
    def memory(self) -> dict[Any, Any] | None:
        """The latest values of the agent's differences. None: differences are 0.0."""


LOCK: Final = RLock()
"""Protects changes of patches and handlers. Calls do not need it."""

SIMULATION: Final = "simulation"
"""The name of threads that run simulations."""

STACKS: Final[dict[greenlet, Any]] = {}
"""The driver of each simulation by its stack, and by the root of each thread that the simulation
has started. None: another environment runs on the stack."""

EVALUATING: Final[dict[greenlet, Any]] = {}
"""The ``Evaluation`` that each greenlet runs. Code that sets an entry restores the previous one."""

DIFFERENCES: Final[list[str]] = []
"""Not empty once a difference was made. While it is empty and there are no plugins, mappings need
no entry in ``EVALUATING``."""


def stack_of(here: greenlet | None) -> Any:
    """Return the driver of the simulation that owns a greenlet; None for the user's greenlets."""
    while here is not None:
        if here in STACKS:
            return STACKS.get(here)  # None after all if another thread has just removed it
        here = here.parent
    return None


def spawner_of(here: greenlet | None) -> Any:
    """Return the driver of the simulation that spawned a greenlet with gevent.

    None for other greenlets.
    """
    driver = None
    while driver is None and (spawner := getattr(here, "spawning_greenlet", None)) is not None:
        here = spawner()  # None after the spawner's end
        driver = stack_of(here)
    return driver


def current_plugins() -> Hashable | None:
    """Return the plugins that take part here. None: only the handlers of the whole process."""
    here = getcurrent()
    evaluation = (stack_of(here) if STACKS else None) or EVALUATING.get(here)
    return None if evaluation is None else evaluation.plugins


class outside_simulation:  # noqa: N801 - it is used like a function
    """Separate code in this greenlet from a simulation or an evaluation that runs around it.

    Inside, decision functions run their rule, and only the plugins of the given evaluation take
    part. This is a class, because a generator-based context manager cannot pass on immutable
    errors, such as frozen dataclasses.
    """

    __slots__ = ("_driver", "_evaluation", "_here", "_masked", "_previous")

    def __init__(self, evaluation: Evaluation | None = None) -> None:
        self._evaluation = evaluation
        self._here: greenlet | None = None
        self._masked = False

    def __enter__(self) -> None:
        here = getcurrent()
        self._previous = EVALUATING.get(here)
        self._here = here  # from here on, __exit__ restores
        if STACKS and stack_of(here) is not None:
            self._driver = STACKS.get(here)
            self._masked = True
            if self._driver is not None:
                self._driver.leave_hooks(here)
            STACKS[here] = None
        if self._evaluation is None:
            EVALUATING.pop(here, None)
        else:
            EVALUATING[here] = self._evaluation

    def __exit__(self, *error: object) -> None:
        here = self._here
        # Tracebacks keep this object, but a root must not outlive its thread.
        self._here = None
        if here is None:
            return
        if self._previous is None:
            EVALUATING.pop(here, None)
        else:
            EVALUATING[here] = self._previous
        if not self._masked:
            return
        self._masked = False
        if self._driver is None:
            STACKS.pop(here, None)
        else:
            STACKS[here] = self._driver
            self._driver.enter_hooks()


def _refuse_after_fork() -> None:
    """Refuse decisions in a process that a simulation has forked.

    The environment's user is in the other process.
    """
    LOCK.release()
    driver = stack_of(getcurrent())
    if driver is not None:
        driver.refuse_all()


if hasattr(os, "register_at_fork"):
    # A fork waits for the changes of other threads, because no thread would complete them there.
    os.register_at_fork(
        before=LOCK.acquire, after_in_parent=LOCK.release, after_in_child=_refuse_after_fork
    )
