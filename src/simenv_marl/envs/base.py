"""What all views have in common: a session, spaces of their own, a picture and a state."""

import copy
import weakref
from collections.abc import Callable
from sys import modules
from typing import Any, ClassVar

import numpy as np
from gymnasium import spaces

from ..core.episode import Episode
from ..core.plan import Plan
from ..core.provenance import describe
from ..core.session import Session
from ..core.spaces import observation_cast
from ..errors import UnknownOptionError, ViewError
from ..hooks.plugins import Entry


class View:
    """A reading of a simulation's episodes.

    Attributes:
        metadata: Its name, and the render modes of its simulation.
        render_mode: What ``render`` returns.
        takes: The options that only this view takes.
    """

    metadata: dict[str, Any]
    render_mode: str | None
    takes: ClassVar[tuple[str, ...]] = ()
    _together: tuple[spaces.Tuple[Any], spaces.Space[Any]] | None = None

    _finalizer: Any = None

    def __init__(self, plan: Plan, session: Session | None = None) -> None:
        """Make the view of a plan.

        Args:
            plan: The plan.
            session: The simulation that it reads, which is closed elsewhere; None: one of its own.

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
        self._shows = self.render_mode == "human"  # after every reset and step, without being asked to

    @classmethod
    def check(cls, plan: Plan) -> None:
        """Make sure that a plan allows this view.

        Raises:
            UnknownOptionError: An option is given that only another view takes.
            ViewError: It does not allow the view.
        """
        for option, view in (("flatten", "joint"), ("agent", "single")):
            if getattr(plan.options, option) and option not in cls.takes:
                raise UnknownOptionError(f"{option} is an option of the {view} view alone")

    @staticmethod
    def metadata_of(plan: Plan) -> dict[str, Any]:
        """What the environments of a plan say about themselves."""
        return {"name": f"{plan.name.lower()}_v0", "render_modes": plan.render_modes, "render_fps": plan.render_fps}

    @property
    def np_random(self) -> np.random.Generator:
        """The generator that the last given seed has seeded, and from which other seeds are drawn."""
        return self._session.np_random

    @np_random.setter
    def np_random(self, generator: np.random.Generator) -> None:
        self._session.np_random = generator

    @property
    def np_random_seed(self) -> int:
        """What the generator was seeded with; -1 where it was set."""
        seed = self._session.np_random_seed
        if seed is None:
            _ = self._session.np_random  # which a seed is drawn for
            seed = self._session.np_random_seed
        assert seed is not None
        return seed

    @property
    def simulation(self) -> Any:
        """The simulation that this environment runs."""
        return self._session.simulation

    @property
    def plugins(self) -> list[Entry]:
        """Of each handler of the option ``plugins``: the handler, the dotted name of its target, its position."""
        plugins = self._plan.plugins
        return [] if plugins is None else plugins.entries

    def provenance(self) -> dict[str, Any]:
        """What this environment is made of, and the seed of its latest episode, ready for ``json.dump``.

        Returns:
            What ``simenv_marl.provenance`` lists.
        """
        return describe(self._plan, self._session.seed)

    @property
    def state_space(self) -> spaces.Space[Any] | None:
        """The space of ``state()``, where the environment was made with one."""
        space = self._plan.options.state_space
        return self._seen_together()[1] if isinstance(space, str) else space

    def state(self) -> Any:
        """The state of the simulation, for centralised critics: what its own ``state()`` returns.

        Returns:
            A new array; in the dtype of ``state_space``, where the environment was made with one. With
            ``state_space="observations"`` what all possible agents observe, flattened, one behind the other.

        Raises:
            NotImplementedError: The simulation has no ``state``, as PettingZoo has it.
            ResetNeededError: With ``state_space="observations"``: there is no episode.
        """
        if isinstance(self._plan.options.state_space, str):
            parts, space = self._seen_together()
            return np.asarray(spaces.flatten(parts, self._seen(self._running()))).astype(space.dtype)
        tell = getattr(self.simulation, "state", None)
        if not callable(tell):
            raise NotImplementedError(f"{type(self.simulation).__name__} has no method state()")
        with self._session.at_work():
            value = tell()
        return np.array(value) if self.state_space is None else observation_cast(self.state_space)(value)

    def _seen_together(self) -> tuple[spaces.Tuple[Any], spaces.Space[Any]]:
        """The spaces of all that is observed, and the one of them all.

        Raises:
            ViewError: There is no vector of them.
        """
        if self._together is None:
            parts = spaces.Tuple(self._seen_spaces())
            together = spaces.flatten_space(parts)
            if not isinstance(together, spaces.Box):
                raise ViewError(f'state_space="observations" needs spaces that can be flattened, not {parts}')
            self._together = parts, together
        return self._together

    def _seen_spaces(self) -> list[spaces.Space[Any]]:
        """The spaces of all that is observed."""
        raise NotImplementedError

    def _seen(self, episode: Episode) -> tuple[Any, ...]:
        """All that is observed."""
        raise NotImplementedError

    def render(self) -> Any:
        """Render the simulation in ``render_mode``; without one, None and a warning.

        In the mode "human" every ``reset`` and ``step`` does so by itself.
        """
        return self._session.render()

    def close(self) -> None:
        """End the episode and unwind the simulation; a later ``reset`` begins anew.

        Raises:
            BaseException: What the simulation raises while it unwinds.
        """
        try:
            self._end(self._session.close)
        finally:
            if self._finalizer is not None and self._session.idle:  # else it was refused, or interrupted
                # The finalizer would keep the session alive, and with it an environment that its own parts refer to.
                self._finalizer.detach()

    def _make_way(self) -> None:
        """End the episode that runs, and see to it that the next one ends should the environment be abandoned."""
        if self._finalizer is not None and not self._finalizer.alive:
            self._finalizer = weakref.finalize(self, self._session.abandon)
        self._end(self._session.end)

    def _end(self, end: Callable[[], None]) -> None:
        """End the episode; forget it, unless that was refused."""
        try:
            end()
        finally:
            episode = self._session.episode
            if episode is None or episode.over:
                self._clear()

    def __deepcopy__(self, memory: dict[int, Any]) -> Any:
        """Make an environment like this one, with a simulation of its own, that is to be reset."""
        made = memory[id(self)] = _made_again(type(self), self._made_of)
        _take_over(made, copy.deepcopy(self._state(), memory))
        return made

    def __copy__(self) -> Any:
        return copy.deepcopy(self)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Be pickled: to an environment like this one, with a simulation of its own, that is to be reset."""
        made: Any = type(self)
        found: Any = modules.get(made.__module__)
        for name in made.__qualname__.split("."):
            found = getattr(found, name, None)
        if found is not made:  # a class that generate_env has made, and which is not found by its name
            made = next(base for base in made.__mro__ if base.__module__.startswith(__package__))
        return _made_again, (made, self._made_of), self._state(), None, None, _take_over

    def __setstate__(self, kept: dict[str, Any]) -> None:
        self._session.take_over(kept.pop("session"))
        vars(self).update(kept)

    def _state(self) -> dict[str, Any]:
        """What a copy takes over."""
        kept = {name: value for name, value in vars(self).items() if name not in _OWN}
        return kept | {"session": self._session.kept()}

    @property
    def driver(self) -> str:
        """What switches between the simulation and its user."""
        return self._plan.options.driver

    def check_pending(self) -> None:
        """Make sure that a decision is pending.

        Raises:
            ResetNeededError: None is.
            ReentrancyError: The simulation is moving.
        """
        if self._running().pending is None:
            raise self._session.refusal()

    def opened(self) -> tuple[list[str], list[Any]]:
        """What the simulation has opened that a forked process would share: see ``Session.opened``."""
        return self._session.opened()

    def check_reseed(self) -> None:
        """Make sure that the chance that lies ahead can be drawn anew: see ``Session.check_reseed``."""
        self._session.check_reseed()

    def reseed(self, seed: int) -> None:
        """Draw the chance that lies ahead anew: for ``branch``, see ``Session.reseed``."""
        self._session.reseed(seed)

    def _running(self) -> Episode:
        """The episode that goes on, or has just ended.

        Raises:
            ResetNeededError: There is none.
        """
        episode = self._session.episode
        if episode is None:
            raise self._session.refusal()
        return episode

    def replayed(self) -> Any:
        """Make an environment that stands just where this one stands in mid-episode: a copy for ``branch``.

        Raises:
            BranchError: It cannot be brought there.
            ResetNeededError: There is no episode that could be brought anywhere.
        """
        made = _made_again(type(self), self._made_of)
        made.__setstate__(copy.deepcopy(self._state()))
        made._session.replay(self._session)
        made._resume_from_replay()
        return made

    @property
    def episode(self) -> Episode:
        """The episode that goes on, or has just ended: for planners.

        Raises:
            ResetNeededError: There is none.
        """
        return self._running()

    def stop_showing(self) -> None:
        """In a branch: show nothing of what is not to happen."""
        self._shows = False

    def begin_branch(self) -> None:
        """Make ready for what is done in a branch, of which this is the environment."""

    def _resume_from_replay(self) -> None:
        """Take over the session's episode in the midst of it."""

    def _clear(self) -> None:
        """Forget what was noted of the episode."""


def _made_again(view: type[View], plan: Plan) -> View:
    """An environment of a class, of which a plan is all that is known."""
    made = view.__new__(view)
    base: Any = next(base for base in view.__mro__ if base.__module__.startswith(__package__))
    base.__init__(made, plan)
    return made


def _take_over(view: View, state: dict[str, Any]) -> None:
    """Have a copy take over the state of another view, but for what that has noted of its episode."""
    view.__setstate__(state)
    view._clear()


_OWN = frozenset(("_deciding", "_finalizer", "_made_of", "_own", "_plan", "_session", "joint", "metadata"))
"""What each environment has of its own, and no copy takes over."""
