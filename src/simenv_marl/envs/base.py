"""The parts that views share: session, spaces, state, rendering, copies and branches."""

from __future__ import annotations

import copy
import pickle
import weakref
from collections.abc import Callable
from functools import cached_property
from typing import Any, Self, TypeAlias, TypeVar
from zlib import crc32

import numpy as np

from ..core import (
    Action,
    Agent,
    BaseSession,
    EpisodeState,
    Info,
    Model,
    Observation,
    Plan,
    Point,
    Session,
    Space,
    StateReader,
    checked_seed,
    describe,
    pack,
    unpack,
)
from ..errors import (
    AgentError,
    UnknownAgentError,
    UnknownOptionError,
    did_you_mean,
    listed,
    short_repr,
    warn_user,
)
from ..files.tapes import recorder
from ..plugins import Entry

Result = TypeVar("Result")

ResetOptions: TypeAlias = dict[str, Any] | None
"""The options of a reset."""

StepResult: TypeAlias = tuple[Observation, float, bool, bool, Info]
"""Observation, reward, terminated, truncated, info."""

_OWN_OPTIONS = {
    "agent": "the single view only; elsewhere, policies={name: RULE} leaves an agent to its rule",
    "flatten": "joint and turn views only",
    "state_in_info": "joint and turn views only",
}
"""The options that not every view takes, and the views that take them."""

_NOT_COPIED = frozenset(
    ("_finalizer", "_lock", "_roster", "joint", "own_agent", "own_seat", "session", "turn")
)
"""The attributes that each view makes for itself."""


class View:
    """A view of a simulation's episodes.

    Subclasses fill these methods::

        method            is called                                 is filled by
        ------            ---------                                 ------------
        adapt             with the plan, before the session         several agents, single, planner
        set_up            when a view is made or cloned, and when   one agent, planner
                          another process may have reset it
        _original_spaces  when an agent's spaces are first read     View, joint, turn
        spaces_of         when a vector environment is made         one agent
        reset             by the user                               all
        begin             at the first decision of a reset          all but the planner
        step              by the user                               all
        read_all,         by vector environments, in place of step  one agent
        read_end, validate
        masks             by ``action_masks``                       one agent
        _clear            when an episode ends                      AEC, parallel, single, turn
        check_pending     before a branch or a clone is made        View, planner
        begin_branch      in a new branch or clone                  planner
        repeat            when an episode is loaded from a file     AEC, joint, turn

    Attributes:
        kind: The name of the view, as ``generate_env`` takes it.
        session: The session of the simulation.
        metadata: Its name, and the render modes of its simulation.
        render_mode: The form of the result of ``render``.
        in_rounds: Whether all agents are updated when a step returns.
    """

    kind = ""
    in_rounds = False
    _latest: Any = None  # the results of the latest reset or step
    _has_warned_of_losses = False
    _own_options: tuple[str, ...] = ()  # options that other views refuse

    def __init__(self, plan: Plan) -> None:
        """Make the view of a plan, with a new session."""
        super().__init__()
        self._attach(Session(self.adapt(plan), kind=self.kind), {})

    @classmethod
    def of_session(cls, session: BaseSession, *, owned: bool = False) -> Self:
        """Make the view of a session, which its owner closes, or which ends with the view."""
        view = cls.__new__(cls)
        view._attach(session, {}, owned=owned)
        return view

    def hand_over(self) -> BaseSession:
        """Return the session, which does not end with this view any more."""
        if self._finalizer is not None:
            self._finalizer.detach()
        return self.session

    def _attach(
        self,
        session: BaseSession,
        attributes: dict[str, Model],
        *,
        owned: bool = True,
    ) -> None:
        """Take over a session, and the attributes of another view.

        ``owned``: the session ends with this view.
        """
        plan = session.plan
        self.session = session
        self._lock = session.lock
        self._finalizer = weakref.finalize(self, session.abandon) if owned else None
        if plan.options.record is not None and self.kind and isinstance(session, Session):
            session.make_tapes(recorder(plan, self.kind))
        self._roster = plan.roster  # the decision points of the agents that are known beforehand
        if attributes:  # because ``vars`` makes the attributes of an object slower
            vars(self).update(attributes)
        else:
            self.metadata = self.metadata_of(plan)
            self.render_mode = plan.options.render_mode
            self._shows = plan.options.shows
            self._frames: list[Model] = []
            self._spaces: dict[str, tuple[Space, Space]] = {}  # of observations and of actions
            self._clear()
        self.set_up()

    @classmethod
    def adapt(cls, plan: Plan) -> Plan:
        """Check that a plan allows this view, and return the plan of its sessions."""
        for option, views in _OWN_OPTIONS.items():
            if getattr(plan.options, option) and option not in cls._own_options:
                raise UnknownOptionError(f"{option} is an option of {views}")
        for point in plan.active:
            first = plan.roster.get(point.agent or "", point)
            if not plan.can_share(point, first):
                raise AgentError(
                    f"{first.hook.name} and {point.hook.name} have the same agent {point.agent!r},"
                    " but their spaces differ; name the agents differently, or use turn_env"
                )
        return plan

    @classmethod
    def metadata_of(cls, plan: Plan) -> dict[str, Any]:
        """Return the metadata of a plan's environments."""
        modes = [*plan.subject.render_modes, plan.options.render_mode]
        return {
            "name": f"{plan.name.lower()}_v0",
            "render_modes": list(dict.fromkeys(filter(None, modes))),
            "render_fps": plan.subject.render_fps,
        }

    def set_up(self) -> None:
        """Derive further attributes from the session."""

    @property
    def simulation(self) -> Model:
        """The simulation that this environment runs."""
        return self.session.simulation

    @property
    def driver(self) -> str:
        """The name of the driver: "greenlet" or "thread"."""
        return self.session.plan.options.driver

    @property
    def plugins(self) -> list[Entry]:
        """The handlers of the option ``plugins``.

        They are tuples of the handler, the dotted name of the target, and the position.
        """
        plugins = self.session.plan.plugins
        return [] if plugins is None else plugins.entries

    def provenance(self) -> dict[str, Any]:
        """Return the provenance of this environment, with the seed of its latest episode.

        ``simenv_marl.experiments.provenance`` explains the items.
        """
        return describe(self.session.plan, self.session.seed)

    @property
    def np_random(self) -> np.random.Generator:
        """The generator that the last given seed has seeded. It draws all other seeds."""
        return self.session.np_random

    @np_random.setter
    def np_random(self, generator: np.random.Generator) -> None:
        self.session.set_generator(generator)

    @property
    def np_random_seed(self) -> int:
        """The seed of the generator; -1 if the generator was set."""
        if self.session.np_random_seed is None:
            _ = self.session.np_random  # draws a seed
        return self.session.np_random_seed  # type: ignore[return-value]

    # -- the state --------------------------------------------------------------------------------

    @cached_property
    def state_space(self) -> Space | None:
        """The space of ``state()``, if the environment was made with one."""
        return self.session.plan.derive(StateReader).space

    def state(self) -> Model:
        """Return the state of the simulation, for centralised critics.

        It comes from the simulation's own ``state()``.

        Returns:
            A new array, in the dtype of ``state_space`` if the environment was made with one. With
            ``state_space="observations"``: the flattened observations of all possible agents,
            concatenated.

        Raises:
            NotImplementedError: The simulation has no ``state`` (PettingZoo's convention).
            ResetNeededError: With ``state_space="observations"``: there is no episode.
        """
        return self.session.read_state()

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

    @property
    def latest(self) -> Any:
        """The results of the latest ``reset`` or ``step``; in the AEC view, of ``last()`` now.

        Raise ``ResetNeededError`` if there are none.
        """
        if self._latest is None:
            raise self.session.refusal()
        return self._latest

    def known_agents(self) -> list[Agent]:
        """Return the agents that are known beforehand.

        Raises:
            ResetNeededError: There is no episode.
        """
        episode = self.episode
        return [episode.agent(name) or episode.others[name] for name in self._roster]

    def render(self) -> Model:
        """Render the simulation in ``render_mode``. Without a render mode, warn and return None.

        In the mode "human", every ``reset`` and ``step`` renders by itself. A mode that ends with
        ``_list`` collects the images. Then this returns those since the last ``render`` or
        ``reset``.
        """
        plan = self.session.plan
        mode = plan.options.picture_mode
        if mode is None:
            warn_user(
                "render() shows nothing without a render_mode; the simulation's render modes are"
                f" {plan.subject.render_modes}"
            )
            return None
        if mode == self.render_mode:
            return self.session.ask("render", mode)
        frames, self._frames = self._frames, []
        return frames

    def show_step(self) -> None:
        """Render for people, or collect an image, after a step."""
        mode = self.session.plan.options.picture_mode
        if mode == self.render_mode:
            self.render()
        else:
            self._frames.append(self.session.ask("render", mode))

    def show_reset(self) -> None:
        """Forget the images of the last episode, and render as after a step."""
        self._frames = []
        self.show_step()

    def stop_showing(self) -> None:
        """Do not render at steps and resets any more."""
        self._shows = False

    def close(self) -> None:
        """End the episode and unwind the simulation; a later ``reset`` begins a new one.

        Raises:
            BaseException: Any exception of the simulation while it unwinds.
        """
        with self.session.exclusive:
            try:
                self.session.close()
            finally:
                self._forget_ended()

    def _start(
        self,
        seed: int | None,
        options: ResetOptions,
        begin: Callable[[EpisodeState], Result],
    ) -> Result:
        """Begin another episode, and return the results of ``begin`` at its first decision.

        The episode ends if the environment is abandoned.
        """
        session = self.session
        with session.exclusive:
            seed = checked_seed(seed)
            if self._finalizer is not None and not self._finalizer.alive:
                self._finalizer = weakref.finalize(self, session.abandon)
            try:
                episode = session.start(seed, options, in_rounds=self.in_rounds)
            except BaseException:
                self._forget_ended()
                raise
            self._clear()
            self._latest = results = begin(episode)
            if not session.plan.complete:  # the agents of the last episode may never appear again
                self._spaces = {}
            for agent in self._spaces:
                self._seed_spaces(agent, seed)
            if self._shows:
                self.show_reset()
            return results

    def _step_in_lock(self, step: Callable[..., Result], action: Action) -> Result:
        """Take a step with the lock of the thread driver, or refuse it without an episode.

        The lock also covers the reading of the results. No other method takes it for a step.
        """
        session = self.session
        if session.episode is None:
            raise session.refusal()
        with session.exclusive:
            return step(self, action)

    def warn_of_losses(self, episode: EpisodeState) -> None:
        """Warn once if an episode in rounds has used fewer than nine in ten actions."""
        problem = "" if episode.round is None else episode.round.explain_losses()
        if problem and not (self._has_warned_of_losses or episode.is_branch):
            self._has_warned_of_losses = True
            warn_user(problem)

    def _forget_ended(self) -> None:
        """Forget the records of an episode that has ended."""
        episode = self.session.episode
        if episode is None or episode.over:
            self._clear()
        if self._finalizer is not None and self.session.idle:
            # It would keep the session alive, and with it an environment that its own options refer
            # to.
            self._finalizer.detach()

    def _clear(self) -> None:
        """Forget the records of the episode."""
        self._latest = None

    # -- spaces -----------------------------------------------------------------------------------

    def _spaces_of(self, agent: str) -> tuple[Space, Space]:
        """Return the observation space and the action space of an agent.

        No other environment shares them. They are made on demand, because many agents may never
        need them.
        """
        if agent not in self._spaces:
            self._spaces[agent] = copy.deepcopy(self._original_spaces(agent))
            session = self.session
            seed = session.np_random_seed
            if seed == -1 or not session.plan.complete:
                seed = session.seed
            self._seed_spaces(agent, seed)
        return self._spaces[agent]

    def _original_spaces(self, agent: str) -> tuple[Space, Space]:
        """Return the spaces of an agent's definition."""
        definition = self._point_of(agent).definition
        return definition.observation_space, definition.action_space

    def _point_of(self, agent: str) -> Point:
        """Return the decision point of an agent.

        Raises:
            UnknownAgentError: There is no such agent.
        """
        episode = self.session.episode
        live = None if episode is None else episode.agent(agent)
        point = self._roster.get(agent) if live is None else live.point
        if point is None:
            names = [] if episode is None else episode.agents
            raise UnknownAgentError(
                f"there is no agent {short_repr(agent)}; the agents now are {listed(names)}"
                f"{did_you_mean(agent, names)}"
            )
        return point

    def _seed_spaces(self, agent: str, seed: int | None) -> None:
        """Seed the spaces of an agent by its name, because agents may join in any order."""
        if seed is None:
            return
        sequence = np.random.SeedSequence([seed, crc32(agent.encode(errors="surrogatepass"))])
        number = int(sequence.generate_state(1)[0])
        for space in self._spaces[agent]:
            space.seed(number)

    # -- copies, branches and planners ------------------------------------------------------------

    def __copy__(self) -> Self:
        return copy.deepcopy(self)

    def __deepcopy__(self, memory: dict[int, Any]) -> Self:
        """Make an environment like this one, with another simulation. It needs a reset."""
        made = object.__new__(type(self))
        memory[id(self)] = made
        made._imitate(*copy.deepcopy(self._recipe(), memory))
        return made

    def __reduce_ex__(self, protocol: object) -> tuple[Any, ...]:
        """Pickle an environment like this one, with another simulation. It needs a reset.

        Functions without names, such as lambdas, are pickled by value, also by the standard
        library's ``pickle``.
        """
        view: type = type(self)
        try:
            pickle.dumps(view)
        except Exception:  # generate_env made the class, and its name does not lead to it
            view = next(base for base in view.__mro__ if base.__module__.startswith(__package__))
        return _unpickled, (pack((view, *self._recipe())),)

    def _recipe(self) -> tuple[Any, ...]:
        """Return the plan, the session's snapshot and the attributes of a copy.

        The attributes include all that users have set.
        """
        return self.session.plan, self.session.snapshot(), self.export_state()

    def _imitate(self, plan: Plan, snapshot: Any, attributes: dict[str, Model]) -> None:
        """Make this environment a copy of the one that has returned a recipe."""
        session = Session(plan)
        session.restore(snapshot)
        self._attach(session, attributes)
        self._clear()

    def cloned(self, session: BaseSession) -> Self:
        """Make an environment in the same state, whose session stands at the same decision."""
        made = object.__new__(type(self))
        made._attach(session, copy.deepcopy(self.export_state()))
        return made

    def export_state(self) -> dict[str, Any]:
        """Return the attributes of a copy, or of the twin in the process of a clone."""
        return {name: value for name, value in vars(self).items() if name not in _NOT_COPIED}

    def import_state(self, state: dict[str, Any]) -> None:
        """Take over the attributes of the twin."""
        vars(self).update(state)
        self.set_up()  # because another episode may have begun there

    def check_pending(self) -> None:
        """Check that a decision is pending.

        Raises:
            ResetNeededError, ReentrancyError: None is.
        """
        if self.episode.pending is None:
            raise self.session.refusal()

    def repeat(self, answer: Action) -> None:
        """Take a step with an answer of the tape."""
        step: Callable[[Action], object] = self.step  # type: ignore[attr-defined]
        step(answer)

    def begin_branch(self) -> None:
        """Prepare the environment of a branch, which was forked in mid-episode, or replayed."""

    def call(self, function: Callable[..., Model], *args: Model) -> Model:
        """Return ``function(environment, *args)``.

        For a clone, its process calls the function, with the unwrapped view there.

        Raises:
            BaseException: Any exception of the function; a ``BranchError`` if the clone's process
                has ended.
        """
        return self.session.call(self, function, args)


def _unpickled(parcel: bytes) -> View:
    """Make the environment that ``View.__reduce_ex__`` has pickled."""
    view, *recipe = unpack(parcel)
    made: View = view.__new__(view)
    made._imitate(*recipe)
    return made
