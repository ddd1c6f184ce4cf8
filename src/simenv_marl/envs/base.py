"""The base class of all views: the session, rendering, the state, copies, and what branches need."""

from __future__ import annotations

import copy
import weakref
from collections.abc import Callable
from functools import cached_property
from sys import modules
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from ..core.episode import Episode
from ..core.plan import Plan
from ..core.provenance import describe
from ..core.session import Session, checked_seed
from ..core.spaces import observation_cast
from ..errors import UnknownOptionError, ViewError
from ..plugins import Entry

_OWN = frozenset(("_deciding", "_finalizer", "_made_of", "_own", "_plan", "_session", "joint", "metadata"))
"""The attributes that no copy takes over."""


class View:
    """A view of a simulation's episodes.

    Attributes:
        metadata: Its name, and the render modes of its simulation.
        render_mode: What ``render`` returns.
        takes: The options that only this view takes.
        in_rounds: Whether all agents are updated when a step returns.
    """

    metadata: dict[str, Any]
    render_mode: str | None
    takes: ClassVar[tuple[str, ...]] = ()
    in_rounds: ClassVar[bool] = False
    _finalizer: Any = None

    def __init__(self, plan: Plan, session: Session | None = None) -> None:
        """Make the view of a plan, of a session that its owner closes, or else of a new session.

        Raises:
            SimEnvError: Something in the plan cannot work.
        """
        self.check(plan)
        super().__init__()
        self._plan = self._made_of = plan
        self._session = Session(plan) if session is None else session
        if session is None:
            self._finalizer = weakref.finalize(self, self._session.abandon)
        self.metadata = self.metadata_of(plan)
        self.render_mode = plan.options.render_mode
        self._shows = self.render_mode == "human"  # render after every reset and step
        self._clear()

    @classmethod
    def check(cls, plan: Plan) -> None:
        """Check that a plan allows this view, or raise ``UnknownOptionError`` or ``ViewError``."""
        for option, view in (("flatten", "joint"), ("agent", "single")):
            if getattr(plan.options, option) and option not in cls.takes:
                raise UnknownOptionError(f"{option} is an option of the {view} view only")

    @classmethod
    def metadata_of(cls, plan: Plan) -> dict[str, Any]:
        """Return the metadata of a plan's environments."""
        return {"name": f"{plan.name.lower()}_v0", "render_modes": plan.render_modes, "render_fps": plan.render_fps}

    @property
    def simulation(self) -> Any:
        """The simulation that this environment runs."""
        return self._session.simulation

    @property
    def plugins(self) -> list[Entry]:
        """The handlers of the option ``plugins``: tuples of handler, dotted name of the target, and position."""
        plugins = self._plan.plugins
        return [] if plugins is None else plugins.entries

    def provenance(self) -> dict[str, Any]:
        """Return what ``simenv_marl.experiments.provenance`` describes, with the seed of the latest episode."""
        return describe(self._plan, self._session.seed)

    @property
    def np_random(self) -> np.random.Generator:
        """The generator that was seeded with the last given seed, and from which other seeds are drawn."""
        return self._session.np_random

    @np_random.setter
    def np_random(self, generator: np.random.Generator) -> None:
        self._session.np_random = generator

    @property
    def np_random_seed(self) -> int:
        """The seed of the generator; -1 if the generator was set."""
        if self._session.np_random_seed is None:
            _ = self._session.np_random  # draws a seed
        return self._session.np_random_seed  # type: ignore[return-value]

    @property
    def state_space(self) -> spaces.Space[Any] | None:
        """The space of ``state()``, if the environment was made with one."""
        space = self._plan.options.state_space
        return self._observed_together[1] if isinstance(space, str) else space

    def state(self) -> Any:
        """Return the state of the simulation, for centralised critics, from the simulation's own ``state()``.

        Returns:
            A new array, in the dtype of ``state_space`` if the environment was made with one. With
            ``state_space="observations"``: the flattened observations of all possible agents, concatenated.

        Raises:
            NotImplementedError: The simulation has no ``state`` (PettingZoo's convention).
            ResetNeededError: With ``state_space="observations"``: there is no episode.
        """
        if isinstance(self._plan.options.state_space, str):
            parts, space = self._observed_together
            return np.asarray(spaces.flatten(parts, self._all_observations(self._running()))).astype(space.dtype)
        tell = getattr(self.simulation, "state", None)
        if not callable(tell):
            raise NotImplementedError(f"{type(self.simulation).__name__} has no method state()")
        with self._session.context():
            value = tell()
        return np.array(value) if self.state_space is None else observation_cast(self.state_space)(value)

    @cached_property
    def _observed_together(self) -> tuple[spaces.Tuple[Any], spaces.Space[Any]]:
        """The spaces of all observations, and the space of their concatenation."""
        parts = spaces.Tuple(self._all_observation_spaces())
        together = spaces.flatten_space(parts)
        if not isinstance(together, spaces.Box):
            raise ViewError(f'state_space="observations" needs spaces that can be flattened, not {parts}')
        return parts, together

    def _all_observation_spaces(self) -> list[spaces.Space[Any]]:
        """Return the spaces of all observations."""
        raise NotImplementedError

    def _all_observations(self, episode: Episode) -> tuple[Any, ...]:
        """Return all observations."""
        raise NotImplementedError

    def render(self) -> Any:
        """Render the simulation in ``render_mode``. Without a render mode, warn and return None.

        In the mode "human", every ``reset`` and ``step`` renders by itself.
        """
        return self._session.render()

    def close(self) -> None:
        """End the episode and unwind the simulation; a later ``reset`` begins a new one.

        Raises:
            BaseException: Any exception of the simulation while it unwinds.
        """
        try:
            self._end(self._session.close)
        finally:
            if self._finalizer is not None and self._session.idle:  # else closing was refused, or interrupted
                # The finalizer would keep the session alive, and with it an environment that its own parts refer to.
                self._finalizer.detach()

    def _start(self, seed: int | None, options: dict[str, Any] | None) -> Episode:
        """End the current episode, and begin another, which ends if the environment is abandoned."""
        seed = checked_seed(seed)
        if self._finalizer is not None and not self._finalizer.alive:
            self._finalizer = weakref.finalize(self, self._session.abandon)
        self._end(self._session.end)
        return self._session.start(seed, options, in_rounds=self.in_rounds)

    def _end(self, end: Callable[[], None]) -> None:
        """End the episode, and forget it unless that was refused."""
        try:
            end()
        finally:
            episode = self._session.episode
            if episode is None or episode.over:
                self._clear()

    def _clear(self) -> None:
        """Forget the records of the episode."""

    def _running(self) -> Episode:
        """The running episode, or the one that has just ended; raise ``ResetNeededError`` if there is none."""
        episode = self._session.episode
        if episode is None:
            raise self._session.refusal()
        return episode

    def __copy__(self) -> Any:
        return copy.deepcopy(self)

    def __deepcopy__(self, memory: dict[int, Any]) -> Any:
        """Make an environment like this one, with a simulation of its own. It needs a reset."""
        made = memory[id(self)] = _make_again(type(self), self._made_of)
        made.__setstate__(copy.deepcopy(self._state(), memory))
        return made

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle the recipe of an environment like this one, with a simulation of its own. It needs a reset."""
        view: Any = type(self)
        found: Any = modules.get(view.__module__)
        for name in view.__qualname__.split("."):
            found = getattr(found, name, None)
        if found is not view:  # a class that generate_env made and that its name does not lead to
            view = _class_of_package(view)
        return _make_again, (view, self._made_of), self._state()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._restore(state)
        self._clear()

    def _state(self) -> dict[str, Any]:
        """Return what a copy takes over."""
        own = {name: value for name, value in vars(self).items() if name not in _OWN}
        return own | {"session": self._session.snapshot()}

    def _restore(self, state: dict[str, Any]) -> None:
        """Take over the state of another environment, with the records of its episode."""
        self._session.restore(state.pop("session"))
        vars(self).update(state)

    # -- branches and planners --------------------------------------------------------------------

    episode = property(_running)

    @property
    def driver(self) -> str:
        """The name of the driver, which switches between the simulation and its user."""
        return self._plan.options.driver

    def check_pending(self) -> None:
        """Check that a decision is pending, or raise ``ResetNeededError`` or ``ReentrancyError``."""
        if self._running().pending is None:
            raise self._session.refusal()

    def open_resources(self) -> dict[Any, str]:
        """Describe what the simulation has opened that a forked process would share: see ``Session``."""
        return self._session.open_resources()

    def check_reseed(self) -> None:
        """Check that the random numbers ahead can be drawn anew: see ``Session.check_reseed``."""
        self._session.check_reseed()

    def reseed(self, seed: int) -> None:
        """Reseed the simulation: see ``Session.reseed``."""
        self._session.reseed(seed)

    def replayed(self) -> Any:
        """Make an environment in exactly the same state in mid-episode, or raise as ``Session.replay``."""
        made = _make_again(type(self), self._made_of)
        made._restore(copy.deepcopy(self._state()))
        made._session.replay(self._session)
        made._resume_from_replay()
        return made

    def _resume_from_replay(self) -> None:
        """Take over the session's episode in mid-episode."""

    def begin_branch(self) -> None:
        """Prepare the environment of a branch."""

    def stop_showing(self) -> None:
        """Stop rendering, in a branch."""
        self._shows = False


def _class_of_package(view: type[View]) -> Any:
    """Return the class of this package from which a generated class is derived."""
    return next(base for base in view.__mro__ if base.__module__.startswith(__package__))


def _make_again(view: type[View], plan: Plan) -> View:
    """Make an environment of a class from its plan alone."""
    made = view.__new__(view)
    _class_of_package(view).__init__(made, plan)
    return made
