"""The simulation of one environment over all its episodes: made once, reset for each episode, closed at the end.

The session has no reference to its environment. So an environment that is dropped in mid-episode is freed at once,
together with its session.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager, nullcontext
from contextvars import Context, copy_context
from functools import partial
from typing import Any
from zlib import crc32

import numpy as np
from gymnasium import spaces
from gymnasium.utils import seeding

from ..errors import BranchError, OptionValueError, annotate, short_repr, warn_user
from ..hooks.patches import Installation
from ..simulation import closer, make_simulation, resetter
from .contexts import Claim, at_work
from .draws import WatchedDriver, is_watched, watched
from .drivers import DRIVERS, run_job
from .ending import refusal
from .episode import LONGEST_TAPE, LOST, Episode, When
from .forking import loops_on, sockets_of
from .plan import Plan
from .rng import GlobalRandom, is_seed
from .spaces import same
from .switch import BaseDriver


class Session:
    """The simulation of one environment, and its episodes.

    Attributes:
        plan: The plan of the environment.
        simulation: The simulation.
        seed: The seed of the latest episode.
        options: The options that the latest ``reset`` of the environment got.
        episode: The current or latest episode. None before the first one, and after it was closed.
        np_random_seed: The seed of ``np_random``. -1 if the user has set a generator.
        claim: The lock that lets one thread at a time use the environment. None if only one thread can use it.
    """

    __slots__ = (
        "__weakref__", "_bound", "_closed", "_copied", "_driver", "_held", "_np_random", "_open", "_reset", "_rng",
        "_starting", "_worn", "claim", "episode", "np_random_seed", "options", "plan", "seed", "simulation",
    )  # fmt: skip

    def __init__(self, plan: Plan) -> None:
        """Make the simulation, and set the plan's decision functions in the model.

        Raises:
            SimulationError: The plan's source does not make a simulation.
            PatchError: A function cannot be patched.
        """
        self.plan = plan
        self.seed: int | None = None
        self.options: dict[str, Any] | None = None
        self.episode: Episode | None = None
        self.np_random_seed: int | None = None
        self._np_random: np.random.Generator | None = None
        self._closed = self._copied = False
        self._starting = False
        self._open = False  # whether the simulation was reset and not closed since
        self._worn = False  # whether it was given up: code that still uses it must not meet another episode
        self._bound: tuple[Any, Any, Plan] | None = None  # the plan whose mappings have the simulation they ask for
        self._held: Installation | None = None
        self._rng = GlobalRandom() if plan.options.global_rng else None
        self.claim = Claim() if plan.options.driver == "thread" else None
        self._driver: BaseDriver | None = None
        self.simulation: Any = None
        self._hold_patches()
        try:
            spare = plan.spare()
            if spare is None:
                self._make_simulation()
            else:
                self._driver, self.simulation = spare.taken()
                self._reset = resetter(self.simulation)
        except BaseException:
            self._put_away()
            raise

    # -- the simulation's stack -------------------------------------------------------------------

    def _make_simulation(self) -> None:
        with self.at_work():
            self.simulation = self._run(lambda: make_simulation(self.plan.source))
        self._reset = resetter(self.simulation)

    def _run(self, job: Callable[[], Any], context: Context | None = None) -> Any:
        """Run a job on the simulation's stack, where decision functions run their rule."""
        return run_job(self._usable_driver(), job if self._rng is None else self._rng.around(job), context)

    def _usable_driver(self) -> BaseDriver:
        """The driver of the simulation's stack. It is replaced if the stack has ended or belongs to another thread."""
        before = self._driver
        if before is None or not before.usable:
            if before is not None:
                self._worn = self._worn or before.given_up is not None
                before.end()  # first, so that an interrupt cannot leave an unknown stack behind
            make = DRIVERS[self.plan.options.driver]
            # With ``global_rng`` each step must enter the simulation's own generators, and so is never direct.
            self._driver = make(plugins=self.plan.plugins, before=before, direct=self._rng is None)
        assert self._driver is not None
        return self._driver

    def _put_away(self) -> None:
        """End the stack and remove the patches."""
        if self._driver is not None:
            self._driver.end()
        self._let_go_of_patches()

    def at_work(self) -> AbstractContextManager[None]:
        """The context in which the environment's code must run."""
        return at_work(self.plan.plugins, self._rng, self.claim)

    def claimed(self) -> AbstractContextManager[None]:
        """The context in which no other thread can use the environment."""
        return nullcontext() if self.claim is None else self.claim

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
        when: When,
        script: Iterable[Any] | None = None,
    ) -> Episode:
        """End the current episode, reset the simulation, and run it to its first decision.

        Args:
            seed: The seed of the reset. None: a seed is drawn.
            options: The options that the environment's ``reset`` got.
            when: When agents are settled.
            script: The tape of another episode to replay. None: this is an ordinary episode.

        Raises:
            NoDecisionError: The simulation ended without a decision.
            BaseException: Any error of the model.
        """
        with self.claimed():
            self.end()
            self._close_simulation()
            try:
                self._closed, self._starting = False, True
                return self._begin(seed, options, when, script)
            finally:
                self._starting = False

    def _close_simulation(self, *, last: bool = False) -> None:
        """Call the simulation's ``close`` on its stack, once for each successful reset. ``last``: no reset follows."""
        close = closer(self.simulation) if self._open else None
        if close is None:
            return
        self._open, self._starting = False, True
        try:
            with self.at_work():
                self._run(partial(close, last))
        finally:
            self._starting = False

    def _plan_of_simulation(self) -> Plan:
        """The plan in which mappings and policies that ask for the simulation or the session have it."""
        if not self.plan.asks:
            return self.plan
        if self._bound is None or self._bound[0] is not self.plan or self._bound[1] is not self.simulation:
            self._bound = self.plan, self.simulation, self.plan.with_simulation(self.simulation, self)
        return self._bound[2]

    def _begin(
        self,
        seed: int | None,
        options: dict[str, Any] | None,
        when: When,
        script: Iterable[Any] | None,
    ) -> Episode:
        self._hold_patches()
        self.options = options
        if seed is None:
            seed = int(self.np_random.integers(2**31))
        else:
            self._np_random, self.np_random_seed = None, seed  # made when a seed must be drawn
        self.seed = seed
        if self._worn or (self._driver is not None and self._driver.given_up is not None):
            self._make_simulation()
            self._worn = False
        context, watches = copy_context(), self._rng is None and is_watched(self.simulation)
        try:
            with self.at_work():
                if self._rng is not None:
                    self._rng.begin(seed)
                reset = partial(self._run, partial(self._reset, seed, options), context)
                if watches:
                    watched(self.simulation, reset, in_thread=self.claim is not None)
                else:
                    reset()
        except BaseException as error:
            annotate(error, f"simenv_marl: while the simulation was reset; seed {seed}")
            raise
        self._open = True
        driver, plan = self._usable_driver(), self._plan_of_simulation()
        run = self.simulation.run if self._rng is None else self._rng.around(self.simulation.run)
        seen: Any = WatchedDriver(driver, self) if watches else driver
        episode = Episode(plan, self.simulation, seen, seed, when, (self._rng, self.claim), script)
        driver.prepare(run, episode.crossing(), context)
        try:
            self.episode = episode  # from now on the episode will be ended, even after an interrupt
            episode.begin()
        except BaseException:
            episode.over = True  # an interrupt may have come before the episode could set this
            if episode.unwound:
                self.episode = None
            raise
        return episode

    def replay(self, other: Session) -> Episode:
        """Bring the simulation to the current decision of another session with the same plan.

        Returns:
            The episode.

        Raises:
            BranchError: The replay does not reach the same decision.
            BaseException: Any error of the model.
        """
        episode = other.episode
        if episode is None or (episode.pending or episode.consulted) is None:
            raise other.refusal()
        if episode.tape is LOST:
            raise BranchError(
                f'the episode has more than {LONGEST_TAPE:,} decisions, so its actions were not kept; use method="fork"'
            )
        generator = self.kept()
        again = self.start(other.seed, other.options, episode.when, episode.tape)
        self.take_over(generator)  # undo the seeding by ``start``: the other session may have drawn seeds since
        answer = again.play if again.when is When.RETURN else again.step
        while again.script:
            answer(again.script.popleft())
        again.script = None
        if not _stand_alike(again, episode):
            again.close()
            raise BranchError(
                f"{type(self.simulation).__name__} does not repeat its decisions with the same seed and the same"
                ' actions: some of its random numbers do not follow from the seed. Use method="fork", or'
                " global_rng=True if it draws from random or numpy.random"
            )
        return again

    def opened(self) -> tuple[list[str], list[Any]]:
        """Find the things that the simulation has opened and that a forked process would share.

        Returns:
            A short description of each thing that cannot continue in a forked process; and the asyncio event loops,
            which can.
        """
        found = {} if self._driver is None else self._driver.children.alive()
        loops = loops_on(found) if found else []
        for loop in loops:
            for number in sockets_of(loop):
                found.pop(number, None)
        return list(found.values()), loops

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
        """Draw the simulation's future random numbers anew.

        Args:
            seed: The seed for the simulation's ``reseed``, and for its own global generators if it has them.

        Raises:
            BaseException: Any error of the simulation's ``reseed``.
        """
        reseed = getattr(self.simulation, "reseed", None)
        with self.at_work():
            if self._rng is not None:
                self._rng.begin_anew(seed)
            if callable(reseed):
                try:
                    reseed(seed)
                except BaseException as error:
                    annotate(error, f"simenv_marl: while the simulation was reseeded; seed {seed}")
                    raise

    def kept(self) -> dict[str, Any]:
        """The state that a copy takes over: the latest seed, the generator, and whether an episode is under way."""
        return {
            "seed": self.seed,
            "np_random_seed": self.np_random_seed,
            "_np_random": self._np_random,
            "_copied": self.episode is not None and self.episode.pending is not None,
        }

    def take_over(self, kept: Mapping[str, Any]) -> None:
        """Take over the state that ``kept`` of another session returned."""
        for name, value in kept.items():
            setattr(self, name, value)

    def refusal(self) -> Exception:
        """Make the error that says why no action can be taken now."""
        if self.episode is not None:
            return self.episode.refusal()
        if self._starting:
            return refusal("resetting")
        return refusal("closed" if self._closed else "copied" if self._copied else "new")

    def end(self) -> None:
        """End the current episode, if there is one.

        Raises:
            ReentrancyError, WrongThreadError: The episode cannot be ended from here, and continues.
            BaseException: Any error that the simulation raises while it unwinds.
        """
        if self._starting:
            raise refusal("resetting")
        if self.episode is not None:
            try:
                with self.claimed():
                    self.episode.close()
            finally:
                if self.episode.unwound:
                    self.episode = None

    @property
    def idle(self) -> bool:
        """Whether there is no episode to end and no patch to remove."""
        return self.episode is None and self._held is None

    def render(self) -> Any:
        """Render the simulation in the environment's render mode; without a render mode, warn and return None."""
        mode = self.plan.options.render_mode
        if mode is None:
            warn_user(
                "render() shows nothing without a render_mode; the simulation's render modes are"
                f" {self.plan.render_modes}"
            )
            return None
        with self.at_work():
            return self.simulation.render(mode)

    def close(self) -> None:
        """Unwind the simulation and remove the patches.

        Raises:
            ReentrancyError, WrongThreadError: The episode cannot be ended from here, and continues.
            BaseException: Any error that the simulation raises while it unwinds.
        """
        try:
            self.end()
        finally:
            if self.episode is None and not self._starting:
                self._closed = True
                try:
                    self._close_simulation(last=True)
                finally:
                    self._put_away()

    def abandon(self) -> None:
        """Unwind the simulation and remove the patches, from a finalizer. Warn of errors instead of raising them."""
        try:
            left = self.episode is not None and self.episode.running and not self._reachable()
            if self.episode is not None:
                self.episode.abandon()
            if not left:  # otherwise the simulation has still to unwind, in another thread
                self._close_abandoned()
        finally:
            self._put_away()

    def _close_abandoned(self) -> None:
        try:
            self._close_simulation(last=True)
        except Exception as error:
            warn_user(f"a simulation that was abandoned raised {short_repr(error)} when it was closed", ResourceWarning)

    def _reachable(self) -> bool:
        return self._driver is not None and self._driver.reachable()

    def _hold_patches(self) -> None:
        if self._held is None or not self._held.complete:
            self._let_go_of_patches()
            self._held = Installation(self.plan.patches)

    def _let_go_of_patches(self) -> None:
        if self._held is not None:
            self._held.uninstall()
            self._held = None


def _stand_alike(one: Episode, other: Episode) -> bool:
    """Whether the pending decisions of two episodes look the same."""
    mine, theirs = one.pending, other.pending or other.consulted
    return (
        mine is not None
        and theirs is not None
        and mine.name == theirs.name
        and list(one.agents) == list(other.agents)
        and same(mine.observation, theirs.observation)
        and same(mine.mask, theirs.mask)
    )


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
