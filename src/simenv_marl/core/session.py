"""The simulation of one environment over all its episodes: made once, reset for each episode, closed at the end.

The session has no reference to its environment. So an environment that is dropped in mid-episode is
freed at once, together with its session.
"""

from __future__ import annotations

import copy
from collections import deque
from collections.abc import Callable, Iterable
from contextvars import Context, copy_context
from dataclasses import dataclass
from functools import partial
from typing import Any
from weakref import ref

import numpy as np
from gymnasium.utils import seeding

from ..errors import BranchError, OptionValueError, ReentrancyError, annotate, short_repr, warn_user
from ..hooks.handlers import Installation
from ..simulation import closer, make_simulation, resetter
from .context import ExclusiveLock, GlobalRandom, environment_context, reuse_resources
from .driver import Driver
from .episode import LONGEST_TAPE, Episode, refusal
from .plan import DRIVERS, Plan
from .policies import Where
from .rng import ENVIRONMENT, draws_check, is_seed, seed_globals
from .spaces import same


class Session:
    """The simulation of one environment, and its episodes.

    Attributes:
        bound_plan: The plan in which mappings have the simulation that they ask for.
        state: The reason why there is no episode, as ``refusal`` takes it; "moving" in a reset and
            a close.
        seed, options: The seed of the latest episode, and the options that the latest ``reset``
            got.
        episode: The current or latest episode. None before the first one, and after it was closed.
        np_random_seed: The seed of ``np_random``. -1 if the user has set a generator.
        where: Whether it belongs to the user, a clone or a branch.
        exclusive: The lock that lets one thread at a time begin and end the episodes of a view.
        lock: The same lock, if steps need it, too. None if only the thread that began an episode
            can step it.
    """

    __slots__ = (
        "__weakref__", "_close", "_driver", "_installed", "_np_random", "_reset", "_rng",
        "bound_plan", "episode", "exclusive", "lock", "np_random_seed", "options", "plan", "seed",
        "simulation", "state", "where",
    )  # fmt: skip

    def __init__(self, plan: Plan) -> None:
        """Make the simulation, and set the plan's decision functions in the model."""
        self.plan, self.state, self.where = plan, "new", Where.USER
        self.bound_plan: Plan | None = None
        self.seed: int | None = None
        self.options: dict[str, Any] | None = None
        self.episode: Episode | None = None
        self.np_random_seed: int | None = None
        self._np_random: np.random.Generator | None = None
        # closes the simulation, if it was reset since the last time
        self._close: Callable[[bool], None] | None = None
        self._rng = GlobalRandom() if plan.options.global_rng else None
        self.exclusive = ExclusiveLock()
        self.lock = self.exclusive if plan.options.driver == "thread" else None
        self._installed: Installation | None = Installation(plan.patches)
        self._driver: Driver
        prototype = plan.claim_prototype()
        if prototype is not None:
            self._driver, self.simulation = prototype
            self._reset = resetter(self.simulation)
            return
        self._driver = DRIVERS[plan.options.driver](plan.plugins)
        try:
            self._make_simulation()
        except BaseException:
            self._put_away()
            raise

    # -- the simulation's stack -------------------------------------------------------------------

    def _make_simulation(self) -> None:
        self.simulation = self._run(partial(make_simulation, self.plan.source))
        self._reset, self.bound_plan = resetter(self.simulation), None

    def _run(self, job: Callable[[], Any], context: Context | None = None) -> Any:
        """Run a job on the simulation's stack.

        A stack that has ended or belongs to another thread is replaced.
        """
        driver = self._driver
        if driver.ended or not (driver.idle and driver.reachable):
            driver.end()  # first, so that an interrupt cannot leave an unknown stack behind
            self._driver = DRIVERS[self.plan.options.driver](self.plan.plugins)
            self._driver.opened = driver.opened
            self._driver.given_up = driver.given_up  # until there is another simulation
        with self.context():
            return self._driver.run(job, context)

    def _close_simulation(self, *, last: bool) -> None:
        """Call the simulation's ``close`` on its stack, once for each successful reset.

        ``last``: no reset follows.
        """
        close, self._close = self._close, None
        if close is not None:
            self._run(partial(close, last))

    def _put_away(self) -> None:
        """End the stack and remove the patches."""
        self._driver.end()
        if self._installed is not None:
            self._installed.uninstall()
            self._installed = None

    def context(self) -> environment_context:
        """The context in which the environment's code must run."""
        return environment_context(self.plan.plugins, self._rng, self.lock)

    # -- episodes ---------------------------------------------------------------------------------

    @property
    def np_random(self) -> np.random.Generator:
        """The generator that was seeded with the last given seed.

        Seeds of other episodes are drawn from it.
        """
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
        script: Any = None,
    ) -> Episode:
        """End the current episode, reset the simulation, and run it to its first decision.

        Without a seed, one is drawn. An episode ``in_rounds`` updates all agents when a step
        returns. ``script`` is the tape of another episode to replay; ordinary episodes have none.
        """
        self.end()
        self.state = "moving"
        try:
            self._close_simulation(last=False)
            if self._installed is None or not self._installed.complete:
                self._installed = Installation(self.plan.patches)
            self.options = options
            self.seed = seed = self.seed_for(seed)
            if self._driver.given_up is not None or self._driver.outlived:
                # code that still uses the old one must not meet another episode
                self._make_simulation()
                self._driver.given_up = None
            return self._begin(seed, in_rounds, script)
        finally:
            self.state = "new" if self.episode is None else "over"

    def seed_for(self, seed: int | None) -> int:
        """Return the seed of an episode, and seed the generator with it.

        Draw one from the generator for None.
        """
        if seed is None:
            return int(self.np_random.integers(2**31))
        self._np_random, self.np_random_seed = None, seed  # made when a seed must be drawn
        return seed

    def _begin(self, seed: int, in_rounds: bool, script: Any) -> Episode:
        """Reset the simulation, and run it to its first decision."""
        context = copy_context()
        check = (
            None
            if self._rng is not None
            else draws_check(self.simulation, in_thread=self.lock is not None)
        )
        try:
            if self._rng is not None:
                with self.context():
                    self._rng.begin(seed)
            self._run(partial(self._reset, seed, self.options), context)
        except BaseException as error:
            annotate(error, f"simenv_marl: while the simulation was reset; seed {seed}")
            raise
        self._close = closer(self.simulation)
        if self.bound_plan is None and self.plan.is_bound_to_simulation:
            self.bound_plan = self.plan.with_simulation(self.simulation)
        plan = self.bound_plan or self.plan
        episode = Episode(
            plan, self.simulation, self._driver, seed, self._rng, self.lock, in_rounds=in_rounds
        )
        episode.session, episode.where = ref(self), self.where
        episode.script = None if script is None else deque(script)
        self._driver.begin(self.simulation.run, episode.events_by_hook(), context)
        try:
            self.episode = episode  # from now on the episode will be ended, even after an interrupt
            episode.begin(check)
        except BaseException:
            episode.over = True  # an interrupt may have come before the episode could set this
            if not episode.running:
                self.episode = None
            raise
        return episode

    def recording(self) -> tuple[Any, ...]:
        """Return what a replay of the episode needs: seed, options, kind, answers, decision, and last time."""
        episode = self.episode
        assert episode is not None
        if len(episode.tape) == episode.tape_size:
            raise BranchError(
                f"the episode has more than {LONGEST_TAPE:,} decisions, or already is a branch of"
                " the environment that"
                ' a policy is given, so its actions were not kept; use method="fork"'
            )
        return (
            episode.seed,
            self.options,
            episode.in_rounds,
            episode.tape,
            _decision(episode),
            episode.last_time,
        )

    def replay(self, other: Session) -> None:
        """Bring the simulation to the current decision of another session with the same plan, or raise an error."""
        self.move_to(max(other.where, Where.CLONE))
        seed, options, in_rounds, tape, decision, last_time = other.recording()
        again = self.start(seed, options, in_rounds=in_rounds, script=tape)
        while again.script:
            answer = again.script.popleft()
            if isinstance(answer, _Reseeded):
                self.reseed(answer.seed)
            else:
                again.step(answer)
        again.script, again.just_ended = None, []  # the other view has reported the ends
        again.last_time = last_time
        if not same(_decision(again), decision):
            raise BranchError(
                f"{type(self.simulation).__name__} does not repeat its decisions with the same"
                " seed and the same"
                " actions: some of its random numbers do not follow from the seed. Use"
                ' method="fork", or'
                " global_rng=True if it draws from random or numpy.random"
            )
        self.restore(copy.deepcopy(other.snapshot()) | {"state": self.state})

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Take over the attributes that ``snapshot`` has returned."""
        for name, value in snapshot.items():
            setattr(self, name, value)

    def inherit(self) -> None:
        """In a forked process: leave the episode's stack and simulation as they are when it ends, not unwound."""
        self.move_to(Where.CLONE)
        self._driver.given_up, self._close = "belongs to the environment that was cloned", None

    def move_to(self, where: Where) -> None:
        """Note that from now on its episodes are played in a clone, or in a branch."""
        self.where = max(self.where, where)
        if self.episode is not None:
            self.episode.where = max(self.episode.where, where)

    def ask(self, name: str, *args: Any) -> Any:
        """Call a method of the simulation on the user's side.

        Raise ``NotImplementedError`` if it has none.
        """
        method = getattr(self.simulation, name, None)
        if not callable(method):
            raise NotImplementedError(f"{type(self.simulation).__name__} has no method {name}()")
        with self.context():
            return method(*args)

    def call(self, env: Any, function: Callable[..., Any], args: tuple[Any, ...]) -> Any:
        """Call a function with an environment of this session where the simulation is."""
        return function(env, *args)

    def snapshot(self) -> dict[str, Any]:
        """The attributes that a copy takes over: its state, the latest seed, and the generator."""
        state = "new" if self.episode is None or self.episode.pending is None else "copied"
        names = ("seed", "np_random_seed", "_np_random")
        return {name: getattr(self, name) for name in names} | {"state": state}

    def refusal(self) -> Exception:
        """Make the error that says why no action can be taken now."""
        return refusal(self.state) if self.episode is None else self.episode.refusal()

    def end(self) -> None:
        """End the current episode, if there is one.

        Raise a ``ReentrancyError`` if that is not possible here.
        """
        if self.state == "moving":
            raise refusal(self.state)
        if self.episode is not None:
            try:
                self.episode.close()
            finally:
                if self.episode.over and not self.episode.running:
                    self.episode = None

    @property
    def idle(self) -> bool:
        """Whether there is no episode to end and no patch to remove."""
        return self.episode is None and self._installed is None

    def close(self) -> None:
        """Unwind the simulation and remove the patches. For errors, see ``end``."""
        try:
            self.end()
        finally:
            if self.episode is None and self.state != "moving":
                self.state = "moving"
                try:
                    self._close_simulation(last=True)
                finally:
                    self.state = "closed"
                    self._put_away()

    def abandon(self) -> None:
        """Unwind the simulation and remove the patches, from a finalizer.

        Warn of errors instead of raising them.
        """
        try:
            is_running = self.episode is not None and self.episode.running
            if not is_running or self._driver.reachable:
                self.close()  # otherwise the simulation's own thread unwinds it at its next switch
        except ReentrancyError:
            # the process is exiting, and the other thread in which the simulation moves ends with
            # it
            pass
        except Exception as error:
            warn_user(
                f"a simulation that was abandoned raised {short_repr(error)}", ResourceWarning
            )
        finally:
            self._put_away()

    # -- branches ---------------------------------------------------------------------------------

    def step_out(self) -> None:
        """Leave the reset or step in a branch that was forked from inside a policy.

        Restore the user's generators.
        """
        self.state = "over"  # a reset that has come to its first decision is still moving
        if self._rng is not None:
            self._rng.step_out()

    def check_reseed(self) -> None:
        """Raise a ``BranchError`` unless the simulation's future random numbers can be drawn anew."""
        if self._rng is None and not callable(getattr(self.simulation, "reseed", None)):
            raise BranchError(
                f"seeds= needs a way to reseed {type(self.simulation).__name__}: give it a method"
                " reseed(seed), which may call simenv_marl.reseed_generators(self, seed), or make"
                " the environment with global_rng=True if it draws from random or numpy.random"
            )

    def reseed(self, seed: int) -> None:
        """Draw the simulation's future random numbers anew, by its ``reseed`` and its own global generators."""
        reseed = getattr(self.simulation, "reseed", None)
        with self.context():
            if self._rng is not None:
                seed_globals(seed, ENVIRONMENT)
            if callable(reseed):
                try:
                    reseed(seed)
                except BaseException as error:
                    annotate(error, f"simenv_marl: while the simulation was reseeded; seed {seed}")
                    raise
        if self.episode is not None and len(self.episode.tape) < self.episode.tape_size:
            self.episode.tape.append(_Reseeded(seed))


@dataclass(frozen=True)
class _Reseeded:
    """On the tape of an episode: here the simulation was reseeded."""

    seed: int


def _decision(episode: Episode) -> Any:
    """What the pending decision of an episode looks like; None if there is none."""
    agent = episode.deciding
    return agent and (agent.name, list(episode.agents), agent.observation, agent.mask)


def checked_seed(seed: Any) -> int | None:
    """Convert the seed of a ``reset`` to a Python integer, unless it is None.

    Refuse what is no seed.
    """
    if seed is None:
        return None
    if not is_seed(seed):
        raise OptionValueError(
            f"seed must be a non-negative integer or None, not {short_repr(seed)}"
        )
    return int(seed)


def close_all(
    sessions: Iterable[tuple[str, Session]], error: BaseException | None = None
) -> BaseException | None:
    """Close all sessions, given with their names. Return the first error, with notes of all others.

    None without any.

    ``error`` is an error before.
    """
    with reuse_resources():  # it waits for all processes of simulations together
        for name, session in sessions:
            try:
                session.close()
            except BaseException as problem:
                if error is None:
                    error = problem
                    annotate(error, f"simenv_marl: in {name}")
                else:
                    annotate(
                        error, f"simenv_marl: closing {name} raised {short_repr(problem)} as well"
                    )
    return error
