"""The simulation of one environment over all its episodes: made once, reset for each episode, closed at the end.

The session has no reference to its environment. So an environment that is dropped in mid-episode is freed at once,
together with its session.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from contextvars import Context, copy_context
from enum import Enum
from functools import partial
from typing import Any, Final
from zlib import crc32

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding

from ..errors import BranchError, OptionValueError, annotate, short_repr, warn_user
from ..hooks.handlers import Installation
from ..simulation import closer, make_simulation, resetter
from .context import ExclusiveLock, GlobalRandom, environment_context
from .driver import Driver, open_resources
from .episode import LONGEST_TAPE, LOST, Episode
from .plan import DRIVERS, Plan
from .rng import draws_check, is_seed
from .run import refusal
from .spaces import same

_NO_LOCK: Final = nullcontext()


class State(Enum):
    """What a session is doing, as far as its episode does not tell.

    Attributes:
        NEW: There was no episode yet.
        COPIED: The same, and the session was copied from one with a running episode.
        STARTING: The simulation is being reset or closed.
        READY: There is an episode, or the latest one was ended.
        CLOSED: The environment was closed.
    """

    NEW = "new"
    COPIED = "copied"
    STARTING = "resetting"
    READY = "over"
    CLOSED = "closed"


class Session:
    """The simulation of one environment, and its episodes.

    Attributes:
        plan: The plan of the environment.
        simulation: The simulation.
        state: What the session is doing.
        seed: The seed of the latest episode.
        options: The options that the latest ``reset`` of the environment got.
        episode: The current or latest episode. None before the first one, and after it was closed.
        np_random_seed: The seed of ``np_random``. -1 if the user has set a generator.
        lock: The lock that lets one thread at a time use the environment. None if only one thread can use it.
    """

    __slots__ = (
        "__weakref__", "_driver", "_given_up", "_installed", "_np_random", "_plan_of_simulation", "_reset", "_rng",
        "_was_reset", "episode", "lock", "np_random_seed", "options", "plan", "seed", "simulation", "state",
    )  # fmt: skip

    def __init__(self, plan: Plan) -> None:
        """Make the simulation, and set the plan's decision functions in the model."""
        self.plan, self.state = plan, State.NEW
        self.seed: int | None = None
        self.options: dict[str, Any] | None = None
        self.episode: Episode | None = None
        self.np_random_seed: int | None = None
        self._np_random: np.random.Generator | None = None
        self._was_reset = False  # and not closed since
        self._given_up = False  # whether the simulation refused to unwind on an earlier stack
        self._plan_of_simulation: tuple[Plan, Any, Plan] | None = None
        self._installed: Installation | None = None
        self._driver: Driver | None = None
        self._rng = GlobalRandom() if plan.options.global_rng else None
        self.lock = ExclusiveLock() if plan.options.driver == "thread" else None
        self.simulation: Any = None
        self._install()
        try:
            prototype = plan.prototype()
            if prototype is None:
                self._make_simulation()
            else:
                self._driver, self.simulation = prototype.claim()
                self._reset = resetter(self.simulation)
        except BaseException:
            self._put_away()
            raise

    # -- the simulation's stack -------------------------------------------------------------------

    def _make_simulation(self) -> None:
        with self.context():
            self.simulation = self._run(lambda: make_simulation(self.plan.source))
        self._reset = resetter(self.simulation)

    def _run(self, job: Callable[[], Any], context: Context | None = None) -> Any:
        """Run a job on the simulation's stack, where decision functions run their rule."""
        return self._usable_driver().run(job, context)

    def _usable_driver(self) -> Driver:
        """The driver of the simulation's stack. It is replaced if the stack has ended or belongs to another thread."""
        before = self._driver
        if before is None or not before.usable:
            if before is not None:
                self._given_up = self._given_up or before.given_up is not None
                before.end()  # first, so that an interrupt cannot leave an unknown stack behind
            # With ``global_rng`` each step must enter the simulation's own generators, and so is never direct.
            self._driver = DRIVERS[self.plan.options.driver](
                self.plan.plugins, None if before is None else before.opened, direct=self._rng is None
            )
        assert self._driver is not None
        return self._driver

    def _put_away(self) -> None:
        """End the stack and remove the patches."""
        if self._driver is not None:
            self._driver.end()
        if self._installed is not None:
            self._installed.uninstall()
            self._installed = None

    def _install(self) -> None:
        """Set the plan's decision functions in the model, unless they are set."""
        if self._installed is None or not self._installed.complete:
            if self._installed is not None:
                self._installed.uninstall()
            self._installed = Installation(self.plan.patches)

    def context(self) -> environment_context:
        """The context in which the environment's code must run."""
        return environment_context(self.plan.plugins, self._rng, self.lock)

    def exclusive(self) -> AbstractContextManager[None]:
        """The context in which no other thread can use the environment."""
        return _NO_LOCK if self.lock is None else self.lock

    # -- episodes ---------------------------------------------------------------------------------

    @property
    def np_random(self) -> np.random.Generator:
        """The generator that was seeded with the last given seed. Seeds of other episodes are drawn from it."""
        if self._np_random is None:
            self._np_random, self.np_random_seed = seeding.np_random(self.np_random_seed)
        return self._np_random

    @np_random.setter
    def np_random(self, generator: np.random.Generator) -> None:
        self._np_random, self.np_random_seed = generator, -1

    def start(
        self,
        seed: int | None,
        options: dict[str, Any] | None,
        *,
        in_rounds: bool = False,
        script: Iterable[Any] | None = None,
    ) -> Episode:
        """End the current episode, reset the simulation, and run it to its first decision.

        Args:
            seed: The seed of the reset. None: a seed is drawn.
            options: The options that the environment's ``reset`` got.
            in_rounds: Whether all agents are updated when a step returns.
            script: The tape of another episode to replay. None: this is an ordinary episode.

        Raises:
            NoDecisionError: The simulation ended without a decision.
        """
        with self.exclusive():
            self.end()
            self._close_simulation(last=False)
            self.state = State.STARTING
            try:
                return self._begin(seed, options, in_rounds, script)
            finally:
                self.state = State.NEW if self.episode is None else State.READY

    def _close_simulation(self, *, last: bool) -> None:
        """Call the simulation's ``close`` on its stack, once for each successful reset. ``last``: no reset follows."""
        close = closer(self.simulation) if self._was_reset else None
        if close is None:
            return
        state, self._was_reset, self.state = self.state, False, State.STARTING
        try:
            with self.context():
                self._run(partial(close, last))
        finally:
            self.state = state

    def _begin(
        self, seed: int | None, options: dict[str, Any] | None, in_rounds: bool, script: Iterable[Any] | None
    ) -> Episode:
        self._install()
        self.options = options
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        else:
            self._np_random, self.np_random_seed = None, seed  # made when a seed must be drawn
        self.seed = seed
        if self._given_up or (self._driver is not None and self._driver.given_up is not None):
            self._make_simulation()  # code that still uses the old one must not meet another episode
            self._given_up = False
        context = copy_context()
        check = None if self._rng is not None else draws_check(self.simulation, in_thread=self.lock is not None)
        try:
            with self.context():
                if self._rng is not None:
                    self._rng.begin(seed)
                self._run(partial(self._reset, seed, options), context)
        except BaseException as error:
            annotate(error, f"simenv_marl: while the simulation was reset; seed {seed}")
            raise
        self._was_reset = True
        driver = self._usable_driver()
        episode = Episode(
            self._bound_plan(), self.simulation, driver, seed, in_rounds=in_rounds, rng=self._rng, lock=self.lock,
            script=script,
        )  # fmt: skip
        driver.begin(self.simulation.run, episode.events_by_hook(), context)
        try:
            self.episode = episode  # from now on the episode will be ended, even after an interrupt
            episode.begin(check)
        except BaseException:
            episode.over = True  # an interrupt may have come before the episode could set this
            if episode.unwound:
                self.episode = None
            raise
        return episode

    def _bound_plan(self) -> Plan:
        """The plan in which mappings and policies that ask for the simulation or the session have it."""
        if not self.plan.is_bound_to_simulation:
            return self.plan
        known = self._plan_of_simulation
        if known is None or known[0] is not self.plan or known[1] is not self.simulation:
            known = self.plan, self.simulation, self.plan.with_simulation(self.simulation, self)
            self._plan_of_simulation = known
        return known[2]

    def replay(self, other: Session) -> Episode:
        """Bring the simulation to the current decision of another session with the same plan; return the episode.

        Raises:
            BranchError: The replay does not reach the same decision.
        """
        episode = other.episode
        if episode is None or (episode.pending or episode.consulted) is None:
            raise other.refusal()
        if episode.tape is LOST:
            raise BranchError(
                f'the episode has more than {LONGEST_TAPE:,} decisions, so its actions were not kept; use method="fork"'
            )
        snapshot = self.snapshot()
        again = self.start(other.seed, other.options, in_rounds=episode.rounds is not None, script=episode.tape)
        self.restore(snapshot)  # undo the seeding by ``start``: the other session may have drawn seeds since
        while again.script:
            again.play(again.script.popleft())
        again.script = None
        if not same(_decision(again), _decision(episode)):
            again.close()
            raise BranchError(
                f"{type(self.simulation).__name__} does not repeat its decisions with the same seed and the same"
                ' actions: some of its random numbers do not follow from the seed. Use method="fork", or'
                " global_rng=True if it draws from random or numpy.random"
            )
        return again

    def snapshot(self) -> dict[str, Any]:
        """The state that a copy takes over: the latest seed, the generator, and whether an episode is under way."""
        running = self.episode is not None and self.episode.pending is not None
        return {
            "seed": self.seed,
            "np_random_seed": self.np_random_seed,
            "_np_random": self._np_random,
            "state": State.COPIED if running else State.NEW,
        }

    def restore(self, snapshot: Mapping[str, Any]) -> None:
        """Take over the state that ``snapshot`` of another session returned."""
        for name, value in snapshot.items():
            setattr(self, name, value)

    def refusal(self) -> Exception:
        """Make the error that says why no action can be taken now."""
        return refusal(self.state.value) if self.episode is None else self.episode.refusal()

    def end(self) -> None:
        """End the current episode, if there is one.

        Raises:
            ReentrancyError, WrongThreadError: The episode cannot be ended from here, and continues.
        """
        if self.state is State.STARTING:
            raise refusal("resetting")
        if self.episode is not None:
            try:
                with self.exclusive():
                    self.episode.close()
            finally:
                if self.episode.unwound:
                    self.episode = None

    @property
    def idle(self) -> bool:
        """Whether there is no episode to end and no patch to remove."""
        return self.episode is None and self._installed is None

    def render(self) -> Any:
        """Render the simulation in the environment's render mode; without a render mode, warn and return None."""
        mode = self.plan.options.render_mode
        if mode is None:
            warn_user(
                "render() shows nothing without a render_mode; the simulation's render modes are"
                f" {self.plan.render_modes}"
            )
            return None
        with self.context():
            return self.simulation.render(mode)

    def close(self) -> None:
        """Unwind the simulation and remove the patches. For errors, see ``end``."""
        try:
            self.end()
        finally:
            if self.episode is None and self.state is not State.STARTING:
                self.state = State.CLOSED
                try:
                    self._close_simulation(last=True)
                finally:
                    self._put_away()

    def abandon(self) -> None:
        """Unwind the simulation and remove the patches, from a finalizer. Warn of errors instead of raising them."""
        reachable = self._driver is not None and self._driver.reachable
        try:
            is_running = self.episode is not None and self.episode.running
            if self.episode is not None:
                self.episode.abandon()
            if reachable or not is_running:  # otherwise the simulation has still to unwind, in another thread
                self._close_simulation(last=True)
        except Exception as error:
            warn_user(f"a simulation that was abandoned raised {short_repr(error)} when it was closed", ResourceWarning)
        finally:
            self._put_away()

    # -- branches ---------------------------------------------------------------------------------

    def open_resources(self) -> dict[Any, str]:
        """Describe what the simulation has opened that a forked process would share, by thing or descriptor."""
        return {} if self._driver is None else open_resources(self._driver.opened)

    def step_out(self) -> None:
        """Restore the user's global generators in a branch that was forked from inside a policy."""
        if self._rng is not None:
            self._rng.step_out()

    def check_reseed(self) -> None:
        """Make sure that the simulation's future random numbers can be drawn anew.

        Raises:
            BranchError: They cannot.
        """
        if self._rng is None and not callable(getattr(self.simulation, "reseed", None)):
            raise BranchError(
                f"seeds= needs a way to reseed {type(self.simulation).__name__}: give it a method reseed(seed), which"
                " may call simenv_marl.reseed_generators(self, seed), or make the environment with global_rng=True if"
                " it draws from random or numpy.random"
            )

    def reseed(self, seed: int) -> None:
        """Draw the simulation's future random numbers anew, by its ``reseed`` and its own global generators."""
        reseed = getattr(self.simulation, "reseed", None)
        with self.context():
            if self._rng is not None:
                self._rng.begin_anew(seed)
            if callable(reseed):
                try:
                    reseed(seed)
                except BaseException as error:
                    annotate(error, f"simenv_marl: while the simulation was reseeded; seed {seed}")
                    raise


def _decision(episode: Episode) -> Any:
    """What the pending decision of an episode looks like; None if there is none."""
    agent = episode.pending or episode.consulted
    return agent and (agent.name, list(episode.agents), agent.observation, agent.mask)


def checked_seed(seed: Any) -> int | None:
    """Convert the seed of a ``reset`` to a Python integer, unless it is None.

    Raises:
        OptionValueError: The seed is not a non-negative integer.
    """
    if seed is None:
        return None
    if not is_seed(seed):
        raise OptionValueError(f"seed must be a non-negative integer or None, not {short_repr(seed)}")
    return int(seed)


def seed_space(space: spaces.Space[Any], seed: int, agent: str) -> None:
    """Seed a space of an agent. The seed depends on the agent's name, and not on the order in which agents join."""
    space.seed(int(np.random.SeedSequence([seed, crc32(agent.encode(errors="surrogatepass"))]).generate_state(1)[0]))
