"""The simulation of one environment over all its episodes: made once, reset for each episode.

A session does not refer to its environment. So an environment that is dropped in mid-episode is
freed at once, together with its session.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np

from ...errors import (
    BranchError,
    NoDecisionError,
    OptionValueError,
    ReentrancyError,
    annotate,
    listed,
    short_repr,
    warn_user,
)
from ...hooks.handlers import Installation
from ...hooks.places import homes_of, is_outdated
from ...simulation import Action, Model, make_simulation, optional_method, passing, takes
from ..plans.plan import DRIVERS, Plan
from ..plans.policies import Where
from ..switching.context import GlobalRandom, environment_context
from ..switching.driver import Driver, Job
from ..switching.generators import ENVIRONMENT, draws_check, seed_globals
from ..values.clock import Clock
from ..values.spaces import same
from .base import (
    GO_ON,
    LONGEST_TAPE,
    BaseSession,
    Branched,
    PendingDecision,
    Recording,
    Replay,
    Reseeded,
    ResetOptions,
    Tape,
)
from .episode import Episode
from .events import Handlers, handlers_of
from .state import RUNNING, EpisodeState, State, UnmatchedNames

MOST_SEEDS: Final = 100
"""How many seeds a reset tries until the one agent of a single view decides."""


class LimitedEpisode(Episode):
    """An episode whose steps have a time limit."""

    __slots__ = ()

    def step(self, action: Action, entered: bool = False) -> None:
        """Take a step, or raise a ``StepTimeoutError``."""
        if entered:
            super().step(action, entered)
            return
        try:
            with self.driver.limit(self.plan.options.step_timeout or 0.0):
                super().step(action)
        except BaseException as error:
            # The limit may end a step where no other error can arise.
            if self.pending is None and self.outcome is RUNNING:
                self.fail(error)
            raise


class Session(BaseSession):
    """A session whose simulation is in this process.

    Attributes:
        handlers: The handlers of the simulation's events.
        context: Makes the context that the environment's code needs.
        unmatched_names: The agents that options name, and that no episode has had yet.
    """

    __slots__ = (
        "_close", "_closer", "_defined", "_driver", "_homes", "_in_rounds", "_installed",
        "_make_tape", "_replay", "_reset", "_rng", "_simulation", "context", "episode", "handlers",
        "unmatched_names",
    )  # fmt: skip

    episode: Episode | None
    handlers: Handlers
    _driver: Driver

    def __init__(
        self, plan: Plan, unmatched_names: UnmatchedNames | None = None, *, kind: str = ""
    ) -> None:
        """Make the simulation, and set the plan's decision functions in the model.

        Args:
            plan: The plan.
            unmatched_names: Is shared by sessions that run side by side.
            kind: The view.
        """
        super().__init__(plan, Where.USER, kind=kind)
        self.episode = None
        self._in_rounds = False  # at the beginning of the episode
        self._make_tape: Callable[[Session], Tape] | None = None
        self._replay: Replay | None = None
        self.unmatched_names = unmatched_names or UnmatchedNames(plan.named_agents)
        if plan.options.driver == "thread":
            self.lock = self.exclusive
        self._rng = GlobalRandom() if plan.options.global_rng else None
        self.context: Callable[..., environment_context] = partial(
            environment_context, plan.plugins, self._rng, self.lock
        )
        self._homes = homes_of([hook for hook, _ in plan.patches])
        self._defined: list[Model] = []  # the functions and classes there, at the latest reset
        self._close: Callable[..., Model] | None = None  # set by a reset, called once
        self._installed: Installation | None = Installation(plan.patches)
        prototype = plan.claim_prototype()
        if prototype is not None:
            self._driver, simulation = prototype
            self._take_simulation(simulation)
            return
        self._driver = DRIVERS[plan.options.driver](plan.plugins)
        try:
            self._make_simulation()
        except BaseException:
            self._put_away()
            raise

    @property
    def simulation(self) -> Model:
        """The simulation."""
        return self._simulation

    # -- the simulation's stack -------------------------------------------------------------------

    def _make_simulation(self) -> None:
        self._take_simulation(self._run(partial(make_simulation, self.plan.subject.source)))

    def _take_simulation(self, simulation: Model) -> None:
        self._simulation = simulation
        self._reset = passing(simulation.reset, "seed", "options")
        close = optional_method(simulation, "close")
        close = close or optional_method(simulation, "close", last=True)
        self._closer = None if close is None else passing(close, "last")
        self.handlers = handlers_of(self.plan, simulation)

    def _run(self, job: Callable[[], Model]) -> Model:
        """Run a job on the simulation's stack. A stack that cannot run it is replaced."""
        self._driver = self._driver.ready()
        with self.context(self._driver):
            return self._driver.run(job)

    def _close_simulation(self, *, last: bool) -> None:
        """Close the simulation, once for each reset. ``last``: no reset follows."""
        close, self._close = self._close, None
        if close is not None:
            self._run(partial(close, last=last))

    def _put_away(self) -> None:
        """End the stack and remove the patches."""
        self._driver.end()
        if self._installed is not None:
            self._installed.uninstall()
            self._installed = None

    # -- episodes ---------------------------------------------------------------------------------

    def start(
        self,
        seed: int | None,
        options: ResetOptions,
        *,
        in_rounds: bool = False,
        replay: Replay | None = None,
        beside: bool | None = None,
    ) -> Episode:
        """Begin another episode: see ``BaseSession``.

        Args:
            seed: The seed.
            options: The options of the reset.
            in_rounds: Whether all agents are updated when a step returns.
            replay: Repeats an episode of another session.
            beside: As ``draws_check`` takes it.
        """
        if not self._is_suspended():
            self._driver = self._driver.ready()
        driver = self._driver
        with self.context(driver):
            self._end_episode()
            self._state = State.MOVING
            try:
                if self._close is not None:
                    self._close_simulation(last=False)
                if self._installed is None or not self._installed.complete:
                    self._installed = Installation(self.plan.patches)
                self._warn_of_outdated()
                self.options = options
                self._in_rounds = in_rounds
                self.seed = self.seed_for(seed)
                if replay is None:
                    replay, self._replay = self._replay, None
                more: list[int] | None = None
                while True:
                    self._driver = self._driver.ready()
                    if self._driver is not driver:
                        self._driver.enter(direct=self._rng is None)
                    if self._driver.stale:  # code that still uses it must not meet another episode
                        self._make_simulation()
                        self._driver.renew()
                    try:
                        return self._begin(self.seed, in_rounds, replay, beside)
                    except NoDecisionError:
                        more = self._more_seeds(self.seed) if more is None else more
                        if not more:
                            raise
                        self.seed = more.pop()
            finally:
                self._state = State.NEW if self.episode is None else State.OVER

    def _warn_of_outdated(self) -> None:
        """Warn of functions that were defined again since they were named."""
        defined = [namespace.get(name) for namespace, name in self._homes]
        if defined == self._defined:
            return
        self._defined = defined
        names = [hook.name for hook, _ in self.plan.patches if is_outdated(hook)]
        if names:
            warn_user(
                "these were defined again, by a reload or a cell that ran again:"
                f" {listed(names)}. Calls of the new functions are no decisions here; name them in"
                " points=, and make the environment anew"
            )

    def _more_seeds(self, seed: int) -> list[int]:
        """Return seeds that follow from one, for an agent that is not born in each episode."""
        simulation = self._simulation
        if self.plan.options.agent is None or not takes(simulation.reset, "seed"):
            return []
        if getattr(simulation, "deterministic", False):
            return []
        return list(map(int, np.random.SeedSequence(seed).generate_state(MOST_SEEDS - 1)))

    def _begin(
        self, seed: int, in_rounds: bool, replay: Replay | None, beside: bool | None
    ) -> Episode:
        """Reset the simulation, and run it to its first decision."""
        driver = self._driver
        check = None  # warns of draws from the global generators
        if self._rng is None:
            in_thread = self.lock is not None
            check = draws_check(self._simulation, in_thread=in_thread, beside=beside)
        else:
            self._rng.begin(seed)
        try:
            driver.begin(partial(self._reset_simulation, seed, in_rounds, replay))
            events = [driver.resume(None)]
            episode = self.episode
            if episode is None:
                driver.take_outcome()  # raises the error of the reset
                raise AssertionError("a reset without an error begins an episode")
        except BaseException as error:
            self._fail(error)
            raise
        try:
            episode.begin(events, check)
        except BaseException as error:
            episode.tape.end(error)
            episode.stop()  # an interrupt may have come before
            if not episode.running:
                self.episode = None
            raise
        return episode

    def _fail(self, error: BaseException) -> None:
        """Note that a reset has failed, or an interrupt has come before the first decision."""
        if self.episode is not None:
            self.episode.fail(error)
            self.episode = None
            return
        self._driver.unwind()
        annotate(error, f"simenv_marl: while the simulation was reset; seed {self.seed}")

    def _reset_simulation(self, seed: int, in_rounds: bool, replay: Replay | None) -> Job:
        """On the simulation's stack, reset the simulation, and prepare its episode.

        Return the simulation's ``run``, and the handlers of its events.
        """
        simulation = self._simulation
        self._reset(seed=seed, options=self.options)
        self._close = self._closer
        kind = Episode
        limit = self.plan.options.step_timeout
        if limit is not None:
            self._driver.limit(limit)  # or an error here
            kind = LimitedEpisode
        self.episode = episode = kind(
            self, simulation, self._driver, seed, replay, in_rounds=in_rounds
        )
        return simulation.run, self.handlers.with_agents(episode.agents.values())

    def new_clock(self) -> Clock | None:
        """Return the clock for another episode. None if the simulation has no time.

        It is another one for each episode, because a reset may set another method.
        """
        time = optional_method(self._simulation, "time")
        if time is None and self.plan.options.discount_rate is not None:
            raise OptionValueError(
                "discount_rate needs the times of decisions, but"
                f" {short_repr(self._simulation)} has no method time(); add one that returns its"
                " clock, or leave out discount_rate"
            )
        if time is None:
            return None
        if self.plan.plugins is not None or self._rng is not None:
            time = _within(self.context, time)  # because views read the clock, too
        return Clock(time, self.plan.options.discount_rate)

    def end(self) -> None:
        """End the current episode, or raise a ``ReentrancyError`` if that is not possible here."""
        if self._is_suspended():
            with self.context(self._driver):
                self._end_episode()
        else:
            self._end_episode()

    def _is_suspended(self) -> bool:
        """Return whether there is an episode to unwind, or raise a ``ReentrancyError``."""
        if self._state is State.MOVING:
            raise self._state.refusal()
        return self.episode is not None and self.episode.is_suspended()

    def _end_episode(self) -> None:
        """End the current episode, in the context of its driver if it is suspended."""
        episode = self.episode
        if episode is None:
            return
        try:
            episode.close()
        finally:
            if episode.over and not episode.running:
                episode.tape.end()
                self.episode = None

    @property
    def idle(self) -> bool:
        """Whether there is no episode to end and no patch to remove."""
        return self.episode is None and self._installed is None

    def close(self) -> None:
        """Unwind the simulation, close it, and remove the patches. For errors, see ``end``."""
        try:
            self.end()
        finally:
            if self.episode is None and self._state is not State.MOVING:
                self._state = State.MOVING
                try:
                    self._close_simulation(last=True)
                finally:
                    self._state = State.CLOSED
                    self._put_away()

    def abandon(self) -> None:
        """Close it from a finalizer. Warn of errors instead of raising them."""
        episode = self.episode
        try:
            if episode is None or not episode.running or self._driver.reachable:
                self.close()  # else the simulation's thread unwinds it at its next switch
        except ReentrancyError:
            pass  # the process exits, and the thread of the moving simulation ends with it
        except Exception as error:
            warn_user(
                f"a simulation that was abandoned raised {short_repr(error)}", ResourceWarning
            )
        finally:
            self._put_away()

    def ask(self, name: str, *args: Any) -> Model:
        """Call a method of the simulation, or raise ``NotImplementedError`` if it has none."""
        method = optional_method(self._simulation, name, *args)
        if method is None:
            raise NotImplementedError(f"{type(self._simulation).__name__} has no method {name}()")
        with self.context():
            return method(*args)

    def call(self, view: Model, function: Callable[..., Model], args: tuple[Any, ...]) -> Model:
        """Call a function with the view."""
        return function(view, *args)

    def declare(self, plan: Plan) -> None:
        """Forget the episode, and take over a plan: see ``BaseSession``."""
        self.close()
        self.plan = plan
        self.handlers = handlers_of(plan, self._simulation)
        self.seed = None
        self.np_random_seed = None

    # -- replays ----------------------------------------------------------------------------------

    def make_tapes(
        self, make: Callable[[Session], Tape] | None, replay: Replay | None = None
    ) -> None:
        """Make the tapes of episodes by a function of the session. The next one is a replay."""
        self._make_tape = make
        self._replay = replay

    def new_tape(self) -> Tape:
        """Return the tape for another episode."""
        is_user = self.where is Where.USER
        return self._make_tape(self) if self._make_tape is not None and is_user else Tape()

    def note_exit(self, agent: str) -> None:
        """Note on the tape that an agent that has ended was taken out of the view."""
        if self.episode is not None:
            self.episode.tape.note_exit(agent)

    def recording(self) -> Recording:
        """Return the record for a replay of the episode."""
        episode = self.episode
        if episode is None:
            raise self.refusal()
        if not episode.is_recorded:
            raise BranchError(
                f"the episode has more than {LONGEST_TAPE:,} decisions, or is a branch in which a"
                ' base decides for others, so its actions were not kept; use method="fork"'
            )
        return Recording(
            episode.seed,
            self.options,
            self._in_rounds,
            [*episode.tape],
            _pending_decision(episode),
        )

    def replay(self, original: BaseSession) -> None:
        """Bring the simulation to the current decision of another session with the same plan.

        Raises:
            BranchError: The simulation does not repeat its decisions.
        """
        self.move_to(max(original.where, Where.CLONE))
        recording = original.recording()
        replay = Replay(recording.tape)
        episode = self.start(
            recording.seed, recording.options, in_rounds=recording.in_rounds, replay=replay
        )
        while replay:
            self.repeat(replay, episode.step)
        episode.end_replay()
        if original.episode is not None:
            episode.remember(original.episode)
        if not same(_pending_decision(episode), recording.decision):
            raise BranchError(
                f"{type(self._simulation).__name__} does not repeat its decisions with the same"
                " seed and the same actions: some of its random numbers do not follow from the"
                " seed. Use"
                ' method="fork", or global_rng=True if it draws from random or numpy.random'
            )
        state = self._state
        self.restore(copy.deepcopy(original.snapshot())._replace(state=state))

    def repeat(self, replay: Replay, step: Callable[[Action], object]) -> None:
        """Repeat the user's answers by ``step``, up to the beginning of a branch, or to the end."""
        while replay and replay[0] is not GO_ON:
            answer = replay.popleft()
            if isinstance(answer, Reseeded):
                self.reseed(answer.seed)
            elif isinstance(answer, Branched) and self.episode is not None:
                if self.episode.deciding is None:
                    raise self.episode.refusal()
                self.episode.single_out(self.episode.deciding)
                return
            else:
                step(answer)

    # -- branches ---------------------------------------------------------------------------------

    def leave_parent(self) -> None:
        """In a forked process, never unwind or close the simulation that has forked it."""
        self.move_to(Where.CLONE)
        self._driver.give_up("belongs to the environment that was cloned")
        self._close = None

    def leave_caller(self) -> None:
        """In a branch that was forked from inside a policy, leave the step that has asked it."""
        self._state = State.OVER  # a reset that has come to its first decision is still moving
        if self._rng is not None:
            self._rng.leave_all()

    def check_reseed(self) -> None:
        """Raise a ``BranchError`` unless the simulation's future chance can be drawn anew."""
        if self._rng is None and optional_method(self._simulation, "reseed", 0) is None:
            raise BranchError(
                f"seeds= needs a way to reseed {type(self._simulation).__name__}: give it a method"
                " reseed(seed), which may call simenv_marl.reseed_generators(self, seed), or make"
                " the environment with global_rng=True if it draws from random or numpy.random"
            )

    def reseed(self, seed: int) -> None:
        """Draw the simulation's future chance anew, and its own global generators."""
        reseed = optional_method(self._simulation, "reseed", seed)
        with self.context():
            if self._rng is not None:
                seed_globals(seed, ENVIRONMENT)
            if reseed is not None:
                try:
                    reseed(seed)
                except BaseException as error:
                    annotate(error, f"simenv_marl: while the simulation was reseeded; seed {seed}")
                    raise
        if self.episode is not None:
            self.episode.record(Reseeded(seed))


def _within(
    context: Callable[[], environment_context], function: Callable[[], float]
) -> Callable[[], float]:
    def call() -> float:
        with context():
            return function()

    return call


def _pending_decision(episode: EpisodeState) -> PendingDecision | None:
    agent = episode.deciding
    if agent is None:
        return None
    return PendingDecision(agent.name, list(episode.agents), agent.observation, agent.mask)
