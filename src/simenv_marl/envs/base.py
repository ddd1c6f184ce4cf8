"""What all views have in common: a session, spaces of their own, a picture and a state."""

from __future__ import annotations

import copy
import os
import weakref
from collections.abc import Callable
from contextlib import suppress
from functools import wraps
from sys import modules
from threading import RLock
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding
from numpy.typing import NDArray

from ..core.bindings import Binding
from ..core.episode import Episode
from ..core.plan import Plan
from ..core.provenance import describe
from ..core.session import AnyEpisode, Session, checked_seed, seed_space
from ..core.spaces import duplicate, observation_cast
from ..errors import CopyError, OptionValueError, ReentrancyError, UnknownAgentError, UnknownOptionError, ViewError
from ..hooks.plugins import Entry


class View:
    """A reading of a simulation's episodes.

    Attributes:
        metadata: Its name, and the render modes of its simulation.
        render_mode: What ``render`` returns.
    """

    metadata: dict[str, Any]
    render_mode: str | None
    _together: tuple[spaces.Tuple[Any], spaces.Space[Any]] | None = None

    def __init__(self, plan: Plan) -> None:
        """Make the view of a plan.

        Raises:
            SimEnvError: Something in the plan cannot work.
        """
        self.check(plan)
        super().__init__()
        self._claimed_by: type[View] | None = None
        if plan.options.driver == "thread":
            self._claimed_by = type(self)
            one_at_a_time(self)
        self._plan = self._made_of = plan
        self._session = Session(plan)
        self._finalizer = weakref.finalize(self, self._session.abandon)
        self._episode: Episode | None = None
        self.metadata = self.metadata_of(plan)
        self.render_mode = plan.options.render_mode
        self._shows = self.render_mode == "human"  # after every reset and step, without being asked to

    @staticmethod
    def check(plan: Plan) -> None:
        """Make sure that a plan allows this view.

        Raises:
            ViewError: It does not.
        """
        if plan.options.flatten:
            raise UnknownOptionError("flatten is an option of the joint view alone")

    @staticmethod
    def metadata_of(plan: Plan) -> dict[str, Any]:
        """What the environments of a plan say about themselves."""
        return {"name": f"{plan.name.lower()}_v0", "render_modes": plan.render_modes, "render_fps": 4}

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
            if self._episode is None:
                raise self._session.not_running()
            parts, space = self._seen_together()
            return np.asarray(spaces.flatten(parts, self._seen(self._episode))).astype(space.dtype)
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
            if self._session.idle:  # else it was refused, or something came in between
                # The finalizer would keep the session alive, and with it an environment that its own parts refer to.
                self._finalizer.detach()

    def _make_way(self) -> None:
        """End the episode that runs, and see to it that the next one ends should the environment be abandoned."""
        if not self._finalizer.alive:
            self._finalizer = weakref.finalize(self, self._session.abandon)
        self._end(self._session.end)

    def _end(self, end: Callable[[], None]) -> None:
        """End the episode; forget it, unless that was refused."""
        try:
            end()
        finally:
            if self._episode is None or self._episode.over:
                self._clear()

    def __deepcopy__(self, memory: dict[int, Any]) -> Any:
        """Copy it, between episodes: an environment like this one, with a simulation of its own."""
        made = memory[id(self)] = _made_again(self._claimed_by or type(self), self._made_of)
        made.__setstate__(copy.deepcopy(self._kept(), memory))
        return made

    def __copy__(self) -> Any:
        return copy.deepcopy(self)

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Be pickled, between episodes: to an environment like this one, with a simulation of its own."""
        made = self._claimed_by or type(self)
        found: Any = modules.get(made.__module__)
        for name in made.__qualname__.split("."):
            found = getattr(found, name, None)
        if found is not made:  # a class that generate_env has made, and which nobody would find by its name
            made = next(base for base in made.__mro__ if base.__module__.startswith(__package__))
        return _made_again, (made, self._made_of), self._kept()

    def __setstate__(self, kept: dict[str, Any]) -> None:
        self._session.seed = kept.pop("seed")
        vars(self).update(kept)

    def _kept(self) -> dict[str, Any]:
        """What a copy takes over.

        Raises:
            CopyError: An episode is going on, and the stack of a simulation cannot be copied.
        """
        if self._in_mid_episode():
            raise CopyError(
                f"{type(self).__name__} can be copied and pickled between episodes, and not in mid-episode: close() or"
                " reset it afterwards, or see branch() for copies of a running simulation"
            )
        return self._state()

    def _state(self) -> dict[str, Any]:
        kept = {name: value for name, value in vars(self).items() if name not in _OWN}
        return kept | {"seed": self._session.seed}

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
        if self._episode is None:
            raise self._session.not_running()
        if self._episode.pending is None:
            raise self._episode.nothing_pending()

    def replayed(self) -> Any:
        """Make an environment that stands just where this one stands in mid-episode: a copy for ``branch``.

        Raises:
            BranchError: It cannot be brought there.
            ResetNeededError: There is no episode that could be brought anywhere.
        """
        made = _made_again(self._claimed_by or type(self), self._made_of)
        made.__setstate__(copy.deepcopy(self._state()))
        made._go_on(made._session.replay(self._session))
        return made

    def _go_on(self, episode: Any) -> None:
        """Take over an episode in the midst of it."""
        self._episode = episode

    def _in_mid_episode(self) -> bool:
        return self._episode is not None and not self._episode.over

    def _clear(self) -> None:
        """Forget the episode."""
        self._episode = None


class OneAgentView(View, gym.Env[Any, Any]):
    """A view with one agent, and so a Gymnasium environment."""

    _agent: str
    action_space: spaces.Space[Any]
    observation_space: spaces.Space[Any]

    def _seen_spaces(self) -> list[spaces.Space[Any]]:
        return [self.observation_space]

    def action_masks(self) -> NDArray[np.bool_]:
        """Which actions are legal now, in the shape in which sb3-contrib's ``MaskablePPO`` asks for it.

        Returns:
            Shape ``(n,)`` for a ``Discrete``; for a ``MultiDiscrete`` the masks of its parts, one behind the other.
            True throughout where the decision point does not restrict its actions.

        Raises:
            ViewError: The action space is neither, and so there are no masks of it.
            ResetNeededError: There is no episode.
        """
        if not isinstance(self.action_space, (spaces.Discrete, spaces.MultiDiscrete)):
            raise ViewError(
                f"there are masks of Discrete and MultiDiscrete action spaces, and not of {self.action_space}; joint"
                " environments of discrete actions have a MultiDiscrete with flatten=True"
            )
        if self._episode is None:
            raise self._session.not_running()
        masks = self._legal(self._episode)
        parts = [part for mask in masks for part in (mask if isinstance(mask, tuple) else (mask,))]
        return np.concatenate(parts).astype(np.bool_)

    def _legal(self, episode: Episode) -> list[Any]:
        """The masks of all that is decided in a step."""
        raise NotImplementedError

    def _begin(self, seed: int | None, options: dict[str, Any] | None, kind: type[AnyEpisode]) -> AnyEpisode:
        """End the episode that runs, begin another, and seed the generator and the spaces."""
        seed = checked_seed(seed)
        self._make_way()
        gym.Env.reset(self, seed=seed)
        episode = self._session.start(seed, options, self.np_random, kind)
        if seed is not None:
            seed_space(self.observation_space, seed, self._agent)
            seed_space(self.action_space, seed, self._agent)
        return episode


class AgentsView(View):
    """A view in which agents are told apart. ``possible_agents`` exists only where all are known beforehand.

    Attributes:
        agents: The agents that are there now.
    """

    agents: list[str]

    def __init__(self, plan: Plan) -> None:
        """Make the view of a plan.

        Raises:
            SimEnvError: Something in the plan cannot work.
        """
        if plan.options.padded and not plan.complete:
            raise OptionValueError("padded=True needs a roster: say in possible_agents= who there may be")
        super().__init__(plan)
        if plan.possible_agents is not None:
            self.possible_agents = plan.possible_agents
        self._padded = plan.options.padded
        self._generator: np.random.Generator | None = None
        self._observation_spaces: dict[str, spaces.Space[Any]] = {}
        self._action_spaces: dict[str, spaces.Space[Any]] = {}

    def _start(self, seed: int | None, options: dict[str, Any] | None, kind: type[AnyEpisode]) -> AnyEpisode:
        """End the episode that runs, begin another, and seed the agents' spaces."""
        seed = checked_seed(seed)
        self._make_way()
        if seed is not None or self._generator is None:
            self._generator, _ = seeding.np_random(seed)
        episode = self._session.start(seed, options, self._generator, kind)
        if not self._plan.complete:  # names that may never come again
            self._observation_spaces, self._action_spaces = {}, {}
        elif seed is not None:
            for agent in self._action_spaces:
                self._seed_spaces(agent, seed)
        return episode

    @staticmethod
    def check(plan: Plan) -> None:
        """Make sure that a plan allows this view.

        Raises:
            ViewError: It does not.
        """
        View.check(plan)
        if isinstance(plan.options.state_space, str) and plan.possible_agents is None:
            raise ViewError(
                'state_space="observations" needs to know all agents beforehand: declare them in possible_agents='
            )

    def _seen_spaces(self) -> list[spaces.Space[Any]]:
        return [self.observation_space(agent) for agent in self.possible_agents]

    def _seen(self, episode: Episode) -> tuple[Any, ...]:
        return tuple(self._observation(episode, agent) for agent in self.possible_agents)

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """The observation space of an agent: of this environment alone, and always the same object.

        Raises:
            UnknownAgentError: There is no such agent.
        """
        space = self._observation_spaces.get(agent)
        return space if space is not None else self._make_spaces(agent)[0]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """The action space of an agent: of this environment alone, and always the same object.

        Raises:
            UnknownAgentError: There is no such agent.
        """
        space = self._action_spaces.get(agent)
        return space if space is not None else self._make_spaces(agent)[1]

    @property
    def observation_spaces(self) -> dict[str, spaces.Space[Any]]:
        """By possible agent, its observation space: for learners that ask for all at once.

        Raises:
            AttributeError: Not all agents are known beforehand, and so there is no ``possible_agents`` either.
        """
        return {agent: self.observation_space(agent) for agent in self.possible_agents}

    @property
    def action_spaces(self) -> dict[str, spaces.Space[Any]]:
        """By possible agent, its action space: for learners that ask for all at once.

        Raises:
            AttributeError: Not all agents are known beforehand, and so there is no ``possible_agents`` either.
        """
        return {agent: self.action_space(agent) for agent in self.possible_agents}

    def _binding(self, agent: str) -> Binding:
        binding = self._plan.roster.get(agent)
        if binding is None:
            record = self._episode.record(agent) if self._episode is not None else None
            if record is None:
                raise UnknownAgentError(f"there is no agent {agent!r}; the agents now are {self.agents[:10]}")
            binding = record.binding
        return binding

    def _make_spaces(self, agent: str) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        definition = self._binding(agent).definition
        made = copy.deepcopy((definition.observation_space, definition.action_space))
        self._observation_spaces[agent], self._action_spaces[agent] = made
        if self._session.seed is not None:
            self._seed_spaces(agent, self._session.seed)
        return made

    def _seed_spaces(self, agent: str, seed: int) -> None:
        seed_space(self._observation_spaces[agent], seed, agent)
        seed_space(self._action_spaces[agent], seed, agent)

    def _observation(self, episode: Episode, agent: str) -> Any:
        """The latest observation of an agent, as a copy of the caller's own."""
        record = episode.record(agent)
        if record is None or record.observation is None or (self._padded and agent in episode.gone):
            return self._binding(agent).blank()
        return duplicate(record.observation)


def _made_again(view: type[View], plan: Plan) -> View:
    """An environment of a class, of which a plan is all that is known."""
    made = view.__new__(view)
    base: Any = next(base for base in view.__mro__ if base.__module__.startswith(__package__))
    base.__init__(made, plan)
    return made


_OWN = frozenset(
    ("_claim", "_claimed_by", "_episode", "_finalizer", "_made_of", "_plan", "_record", "_session", "metadata")
)
"""What each environment has of its own, and no copy takes over."""


# -- many threads ---------------------------------------------------------------------------------


class _Claim:
    """Makes sure that one thread at a time uses an environment. Within it, episodes see to that themselves."""

    def __init__(self) -> None:
        self._lock, self._process = RLock(), os.getpid()

    def __enter__(self) -> None:
        if self._process != os.getpid():  # a fork: whoever may have held the lock is not in this process
            self.__init__()  # type: ignore[misc]
        try:
            claimed = self._lock.acquire(blocking=False)
        except BaseException:  # an interrupt; whoever has it already keeps it
            with suppress(RuntimeError):
                self._lock.release()
            raise
        if not claimed:
            raise ReentrancyError(
                "the environment was used while another thread was stepping, resetting or closing it; any thread may"
                " use it, but one at a time"
            )

    def __exit__(self, *error: object) -> None:
        self._lock.release()


def one_at_a_time(env: Any) -> None:
    """Have an environment be used from changing threads: what moves its simulation claims it before.

    It gets a class of its own, so that environments which stay in their thread have nothing to pay for it.
    """
    env.__class__ = _one_at_a_time(type(env))
    env._claim = _Claim()


def _one_at_a_time(view: type[Any]) -> type[Any]:
    made: type[Any] | None = vars(view).get("_claiming")
    if made is None:
        claiming = {name: _claiming(getattr(view, name)) for name in ("reset", "step", "close")}
        same = {name: getattr(view, name) for name in ("__module__", "__qualname__", "__doc__")}
        made = type(view.__name__, (view,), claiming | same)
        view._claiming = made
    return made


def _claiming(method: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(method)
    def claim(self: Any, *args: Any, **kwargs: Any) -> Any:
        with self._claim:
            return method(self, *args, **kwargs)

    return claim
