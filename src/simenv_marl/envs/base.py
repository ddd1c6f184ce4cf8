"""What views have in common: the session, spaces, the state, rendering, copies, and what branches and planners need."""

from __future__ import annotations

import copy
import pickle
import weakref
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from functools import cached_property
from typing import Any, ClassVar
from zlib import crc32

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..core import (
    Agent,
    BaseSession,
    EpisodeState,
    Plan,
    Point,
    Session,
    checked_seed,
    describe,
    observation_cast,
    pack,
    unpack,
)
from ..errors import (
    UnknownAgentError,
    UnknownOptionError,
    ViewError,
    did_you_mean,
    short_repr,
    warn_user,
)
from ..plugins import Entry

_OWN = frozenset(
    ("_definition", "_finalizer", "_own", "_plan", "_roster", "joint", "metadata", "session")
)
"""The attributes that no copy takes over."""


class View:
    """A view of a simulation's episodes.

    Attributes:
        metadata: Its name, and the render modes of its simulation.
        render_mode: What ``render`` returns.
    """

    metadata: dict[str, Any]
    render_mode: str | None
    _option: ClassVar[str | None] = None  # the option that only this view takes
    _in_rounds: ClassVar[bool] = False  # whether all agents are updated when a step returns
    waits_for_one: ClassVar[bool] = False  # whether its branches wait for one agent only
    _finalizer: Any = None
    set_up: Callable[[], None]  # completes what is made
    # makes the records of a new episode, and returns the results of its reset
    _begin: Callable[[EpisodeState], Any]

    def __init__(self, plan: Plan, session: BaseSession | None = None) -> None:
        """Make the view of a plan, of a session that its owner closes, or else of a new session."""
        super().__init__()
        self._plan = plan
        self.session: BaseSession = session or Session(self._adapt(plan))
        if session is None:
            self._finalizer = weakref.finalize(self, self.session.abandon)
        self.metadata = self._metadata_of(plan)
        self.render_mode = plan.options.render_mode
        self._picture_mode, self._shows = plan.options.picture_mode, plan.options.shows
        self._frames: list[Any] = []
        # of agents that are known beforehand
        self._roster: Mapping[str, Point] = self.session.plan.roster
        # of observations and of actions, by agent
        self._spaces: dict[str, tuple[spaces.Space[Any], ...]] = {}
        self._clear()
        self.set_up()

    @classmethod
    def _adapt(cls, plan: Plan) -> Plan:
        """Check that a plan allows this view, and return the plan of its sessions."""
        for option, view in (("flatten", "joint"), ("agent", "single")):
            if getattr(plan.options, option) and option != cls._option:
                raise UnknownOptionError(f"{option} is an option of the {view} view only")
        return plan

    @classmethod
    def _metadata_of(cls, plan: Plan) -> dict[str, Any]:
        """Return the metadata of a plan's environments."""
        modes = list(
            dict.fromkeys(filter(None, [*plan.subject.render_modes, plan.options.render_mode]))
        )
        return {
            "name": f"{plan.name.lower()}_v0",
            "render_modes": modes,
            "render_fps": plan.subject.render_fps,
        }

    @property
    def simulation(self) -> Any:
        """The simulation that this environment runs."""
        return self.session.simulation

    @property
    def driver(self) -> str:
        """The name of the driver: "greenlet" or "thread"."""
        return self._plan.options.driver

    @property
    def plugins(self) -> list[Entry]:
        """The handlers of the option ``plugins``: tuples of handler, dotted name of the target, and position."""
        return [] if self._plan.plugins is None else self._plan.plugins.entries

    def provenance(self) -> dict[str, Any]:
        """Return what ``simenv_marl.experiments.provenance`` describes, with the seed of the latest episode."""
        return describe(self._plan, self.session.seed)

    @property
    def np_random(self) -> np.random.Generator:
        """The generator that was seeded with the last given seed, and from which other seeds are drawn."""
        return self.session.np_random

    @np_random.setter
    def np_random(self, generator: np.random.Generator) -> None:
        self.session.np_random = generator

    @property
    def np_random_seed(self) -> int:
        """The seed of the generator; -1 if the generator was set."""
        if self.session.np_random_seed is None:
            _ = self.session.np_random  # draws a seed
        return self.session.np_random_seed  # type: ignore[return-value]

    # -- the state --------------------------------------------------------------------------------

    @cached_property
    def state_space(self) -> spaces.Space[Any] | None:
        """The space of ``state()``, if the environment was made with one."""
        space = self._plan.options.state_space
        if not isinstance(space, str):
            return space
        parts = spaces.Tuple(
            [point.definition.observation_space for point in self._roster.values()]
        )
        together = spaces.flatten_space(parts)
        if not isinstance(together, spaces.Box):
            raise ViewError(
                f'state_space="observations" needs spaces that can be flattened, not {parts}'
            )
        return together

    def state(self) -> Any:
        """Return the state of the simulation, for centralised critics, from the simulation's own ``state()``.

        Returns:
            A new array, in the dtype of ``state_space`` if the environment was made with one. With
            ``state_space="observations"``: the flattened observations of all possible agents,
            concatenated.

        Raises:
            NotImplementedError: The simulation has no ``state`` (PettingZoo's convention).
            ResetNeededError: With ``state_space="observations"``: there is no episode.
        """
        if isinstance(self._plan.options.state_space, str):
            parts: list[Any] = []
            for agent in self._agents():
                seen = agent.point.blank() if agent.observation is None else agent.observation
                parts.append(spaces.flatten(agent.point.definition.observation_space, seen))
            value: Any = np.concatenate(parts)
        else:
            value = self.session.ask("state")
        return (
            np.array(value)
            if self.state_space is None
            else observation_cast(self.state_space)(value)
        )

    # -- episodes ---------------------------------------------------------------------------------

    @property
    def episode(self) -> EpisodeState:
        """The running episode, or the one that has just ended.

        Raise ``ResetNeededError`` if there is none.
        """
        episode = self.session.episode
        if episode is None:
            raise self.session.refusal()
        return episode

    def _agents(self) -> list[Agent]:
        """The agents of the roster; raise ``ResetNeededError`` if there is no episode."""
        episode = self.episode
        return [episode.agent(name) or episode.others[name] for name in self._roster]

    def render(self) -> Any:
        """Render the simulation in ``render_mode``. Without a render mode, warn and return None.

        In the mode "human", every ``reset`` and ``step`` renders by itself. With ``_list`` at the
        end of a mode, these are collected; return the list of those since the last ``render`` or
        ``reset``.
        """
        if self.render_mode is None:
            warn_user(
                "render() shows nothing without a render_mode; the simulation's render modes are"
                f" {self._plan.subject.render_modes}"
            )
            return None
        if self._picture_mode != self.render_mode:
            frames, self._frames = self._frames, []
            return frames
        return self.session.ask("render", self._picture_mode)

    def _show(self, *, begins: bool = False) -> None:
        """Render after a step, or after the reset with which an episode ``begins``."""
        if begins:
            self._frames = []
        if self._picture_mode == self.render_mode:
            self.render()
            return
        self._frames.append(self.session.ask("render", self._picture_mode))

    def close(self) -> None:
        """End the episode and unwind the simulation; a later ``reset`` begins a new one.

        Raises:
            BaseException: Any exception of the simulation while it unwinds.
        """
        with self.session.exclusive:
            self._end(self.session.close)

    def _start(self, seed: int | None, options: dict[str, Any] | None) -> Any:
        """Begin another episode, which ends if the environment is abandoned.

        Return the results of the reset.
        """
        session = self.session
        with session.exclusive:
            seed = checked_seed(seed)
            self._end(session.end)
            if self._finalizer is not None and not self._finalizer.alive:
                self._finalizer = weakref.finalize(self, session.abandon)
            results = self._begin(session.start(seed, options, in_rounds=self._in_rounds))
            if not self._plan.complete:  # the agents of the last episode may never appear again
                self._spaces = {}
            for agent in self._spaces:
                self._seed_spaces(agent, seed)
            if self._shows:
                self._show(begins=True)
            return results

    def _step_alone(self, step: Callable[..., Any], action: Any) -> Any:
        """Take a step with the lock, which also covers reading the results.

        Refuse it if there is no episode.
        """
        if self.session.episode is None:
            raise self.session.refusal()
        with self.session.lock or nullcontext():
            return step(self, action)

    def _end(self, end: Callable[[], None]) -> None:
        """End the episode, and forget its records unless that was refused."""
        try:
            end()
        finally:
            episode = self.session.episode
            if episode is None or episode.over:
                self._clear()
            if self._finalizer is not None and self.session.idle:
                # It would keep the session alive, and with it an environment that its own parts
                # refer to.
                self._finalizer.detach()

    def _clear(self) -> None:
        """Forget the records of the episode."""

    def _make_spaces(self, agent: str, definition: Any) -> tuple[spaces.Space[Any], ...]:
        """Make the spaces of an agent, which no other environment shares, on demand: many may never need them."""
        made = self._spaces[agent] = copy.deepcopy(
            (definition.observation_space, definition.action_space)
        )
        given = self.session.np_random_seed if self._plan.complete else -1
        self._seed_spaces(agent, self.session.seed if given == -1 else given)
        return made

    def _seed_spaces(self, agent: str, seed: int | None) -> None:
        """Seed the spaces of an agent by its name, and not by the order in which agents join."""
        if seed is not None:
            sequence = np.random.SeedSequence([seed, crc32(agent.encode(errors="surrogatepass"))])
            for space in self._spaces[agent]:
                space.seed(int(sequence.generate_state(1)[0]))

    # -- copies, branches and planners ------------------------------------------------------------

    def __copy__(self) -> Any:
        return copy.deepcopy(self)

    def __deepcopy__(self, memory: dict[int, Any]) -> Any:
        """Make an environment like this one, with a simulation of its own. It needs a reset."""
        made = memory[id(self)] = type(self).__new__(type(self))
        made.__setstate__(copy.deepcopy(self._recipe(), memory))
        return made

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Pickle the recipe of an environment like this one, with a simulation of its own. It needs a reset.

        Functions without names, such as lambdas, are pickled by value, also by the standard
        library's ``pickle``.
        """
        view: Any = type(self)
        try:
            pickle.dumps(view)
        except Exception:  # a class that generate_env made and that its name does not lead to
            view = next(base for base in view.__mro__ if base.__module__.startswith(__package__))
        return _unpickled, (pack((view, self._recipe())),)

    def _state(self) -> dict[str, Any]:
        """Return what is in the same state in a copy."""
        return {name: value for name, value in vars(self).items() if name not in _OWN}

    def export_state(self) -> dict[str, Any]:
        """Return the state of the view, for its twin in the process of a clone."""
        return self._state()

    def import_state(self, state: dict[str, Any]) -> None:
        """Take over the state of the twin."""
        vars(self).update(state)
        self.set_up()  # there may be another episode

    def _recipe(self) -> dict[str, Any]:
        """Return what a copy is made of."""
        return self._state() | {"_plan": self._plan, "session": self.session.snapshot()}

    def __setstate__(self, recipe: dict[str, Any]) -> None:
        """Make this environment like the one with a recipe."""
        View.__init__(self, recipe.pop("_plan"))
        self.session.restore(recipe.pop("session"))
        vars(self).update(recipe)
        self._clear()

    def check_pending(self) -> None:
        """Check that a decision is pending, or raise ``ResetNeededError`` or ``ReentrancyError``."""
        if self.episode.pending is None:
            raise self.session.refusal()

    def cloned(self, session: BaseSession) -> Any:
        """Make an environment in the same state in mid-episode, with a session that stands at the same decision."""
        made = type(self).__new__(type(self))
        View.__init__(made, self._plan, session)
        vars(made).update(copy.deepcopy(self._state()))
        made._finalizer = weakref.finalize(made, session.abandon)
        made.set_up()
        return made

    def call(self, function: Callable[..., Any], *args: Any) -> Any:
        """Return ``function(environment, *args)``.

        For a clone from its process, with its unwrapped view there.

        Raises:
            BaseException: Any exception of the function; a ``BranchError`` if the clone's process
                has ended.
        """
        return self.session.call(self, function, args)

    def begin_branch(self) -> None:
        """Prepare the environment of a branch, which was forked in mid-episode, or replayed."""


def _unpickled(parcel: bytes) -> View:
    """Make the environment that ``View.__reduce_ex__`` has pickled."""
    view, state = unpack(parcel)
    made: View = object.__new__(view)
    made.__setstate__(state)
    return made


class _Undeclared:
    """In place of ``possible_agents`` where not all are known.

    A ``__getattr__`` would make each attribute slower.
    """

    def __get__(self, view: Any, kind: Any) -> Any:
        raise AttributeError(
            "there is no possible_agents, because not all agents are known beforehand; declare"
            " them with the option possible_agents=, or name them by strings"
        )


class AgentsView(View):
    """A view with several agents: a PettingZoo environment.

    Attributes:
        agents: The names of the current agents.
        possible_agents: The names of all agents. It exists only if they are known beforehand.
    """

    agents: list[str]
    possible_agents: Any = _Undeclared()

    def set_up(self) -> None:
        if self._plan.possible_agents is not None:
            self.possible_agents = self._plan.possible_agents
        elif isinstance(self._plan.options.state_space, str):
            raise ViewError(
                'state_space="observations" needs to know all agents beforehand: declare them in'
                " possible_agents="
            )

    @classmethod
    def _metadata_of(cls, plan: Plan) -> dict[str, Any]:
        """Return the metadata of a plan's environments.

        The order of agents is an order of rounds only in rounds.
        """
        return super()._metadata_of(plan) | {"is_parallelizable": cls._in_rounds}

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """The observation space of an agent. It is always the same object, and no other environment shares it.

        Raises:
            UnknownAgentError: There is no such agent.
        """
        return (self._spaces.get(agent) or self._make_spaces(agent, self._point(agent).definition))[
            0
        ]

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """The action space of an agent, as ``observation_space`` returns the observation space."""
        return (self._spaces.get(agent) or self._make_spaces(agent, self._point(agent).definition))[
            1
        ]

    @property
    def observation_spaces(self) -> dict[str, spaces.Space[Any]]:
        """The observation spaces of all possible agents, by name, for learners that read all at once.

        Raises:
            AttributeError: Not all agents are known beforehand, and so there is no
                ``possible_agents`` either.
        """
        return {agent: self.observation_space(agent) for agent in self.possible_agents}

    @property
    def action_spaces(self) -> dict[str, spaces.Space[Any]]:
        """The action spaces of all possible agents, as ``observation_spaces`` has the observation spaces."""
        return {agent: self.action_space(agent) for agent in self.possible_agents}

    def _point(self, agent: str) -> Point:
        """The decision point of an agent; raise ``UnknownAgentError`` if there is no such agent."""
        episode = self.session.episode
        found = None if episode is None else episode.agent(agent)
        point = self._roster.get(agent) if found is None else found.point
        if point is None:
            raise UnknownAgentError(
                f"there is no agent {short_repr(agent)}; the agents now are {self.agents[:10]}"
                f"{did_you_mean(agent, self.agents)}"
            )
        return point


class OneAgentView(View, gym.Env[Any, Any]):
    """A view with one agent: a Gymnasium environment."""

    _agent: str
    _definition: Any  # has the spaces, of which this environment has copies
    # where Gymnasium's checks look
    _np_random, _np_random_seed = View.np_random, View.np_random_seed

    @cached_property
    def observation_space(self) -> spaces.Space[Any]:  # type: ignore[override]
        """The observation space. No other environment shares it."""
        return (self._spaces.get(self._agent) or self._make_spaces(self._agent, self._definition))[
            0
        ]

    @cached_property
    def action_space(self) -> spaces.Space[Any]:  # type: ignore[override]
        """The action space. No other environment shares it."""
        return (self._spaces.get(self._agent) or self._make_spaces(self._agent, self._definition))[
            1
        ]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the simulation and run it to its first decision.

        The arguments and errors are those of ``SimulationAECEnv.reset``.

        Returns:
            The observation and the info.
        """
        observation, info = self._start(seed, options)
        return observation, info

    def action_masks(self) -> NDArray[np.bool_]:
        """The mask of the legal actions, in the form that ``MaskablePPO`` of sb3-contrib expects.

        Returns:
            A bool array. For a ``Discrete`` it has shape ``(n,)``. For a ``MultiDiscrete`` it is
            the concatenation of the masks of the parts. If the decision point does not restrict its
            actions, all entries are True.

        Raises:
            ViewError: The action space is neither ``Discrete`` nor ``MultiDiscrete``, and so has no
                masks.
            ResetNeededError: There is no episode.
        """
        if not isinstance(self.action_space, (spaces.Discrete, spaces.MultiDiscrete)):
            raise ViewError(
                "action masks need a Discrete or MultiDiscrete action space, not"
                f" {self.action_space}; a joint environment of discrete actions has a"
                " MultiDiscrete with flatten=True"
            )
        parts: list[Any] = []
        for agent in self._agents():
            mask = agent.point.open_mask() if agent.mask is None else agent.mask
            parts += mask if isinstance(mask, tuple) else (mask,)
        return np.concatenate(parts).astype(np.bool_)
