"""An environment's simulation over all its episodes: made once, reset for each, closed.

The session is what outlives an episode. It holds nothing of the environment, so that an environment which
is abandoned in mid-episode goes at once and takes its session along.
"""

from __future__ import annotations

from collections import deque
from contextlib import AbstractContextManager
from typing import Any, TypeVar
from zlib import crc32

import numpy as np
from gymnasium import spaces

from ..errors import (
    BranchError,
    ClosedError,
    NotResetError,
    OptionValueError,
    ReentrancyError,
    annotate,
    warn_user,
)
from ..simulation import resetter
from .contexts import Surroundings, surrounded
from .episode import LOST, MOST_TAKEN, Episode
from .plan import Plan
from .switch import Offspring, preparing, unattended

AnyEpisode = TypeVar("AnyEpisode", bound=Episode)


class Session:
    """A simulation of one environment's own.

    Attributes:
        plan: What the environment is made of.
        simulation: The simulation.
        seed: The seed of the latest episode.
        options: What the latest ``reset`` of the environment was given.
        kind: How the latest episode was played.
    """

    def __init__(self, plan: Plan) -> None:
        """Make the simulation, and set the decision functions that the plan asks for.

        Raises:
            SimulationError: There is no simulation in the plan.
            PatchError: A function cannot be patched.
        """
        self.plan = plan
        self.seed: int | None = None
        self.options: dict[str, Any] | None = None
        self.kind: type[Episode] = Episode
        self._episode: Episode | None = None
        self._closed = False
        self._starting = False
        self._held: list[Any] = []  # what is set, and is to be put back
        self._surroundings = Surroundings(plan.surroundings())
        self._offspring = Offspring()
        self._hold_patches()
        try:
            with self.at_work(), preparing(self._offspring):
                self.simulation = plan.make_simulation()
                self._reset = resetter(self.simulation)
        except BaseException:
            self._let_go_of_patches()
            raise

    def start(
        self,
        seed: int | None,
        options: dict[str, Any] | None,
        generator: np.random.Generator,
        kind: type[AnyEpisode],
    ) -> AnyEpisode:
        """End the episode that runs, reset the simulation, and run it to its first decision.

        Args:
            seed: The seed to reset it with; None: one is drawn.
            options: What the environment's ``reset`` was given.
            generator: What a seed is drawn from.
            kind: How the episode is played: in turns or in rounds.

        Raises:
            NoDecisionError: The simulation ended without one.
            BaseException: What the model raises.
        """
        self.end()
        try:
            self._closed, self._starting = False, True
            return self._begin(seed, options, generator, kind)
        finally:
            self._starting = False

    def _begin(
        self,
        seed: int | None,
        options: dict[str, Any] | None,
        generator: np.random.Generator,
        kind: type[AnyEpisode],
        foretold: deque[Any] | None = None,
    ) -> AnyEpisode:
        self._hold_patches()
        self.options, self.kind = options, kind
        self.seed = int(generator.integers(2**31)) if seed is None else seed
        try:
            with self.at_work(), preparing(self._offspring):
                self._surroundings.begin(self.seed)
                self._reset(self.seed, options)
        except BaseException as error:
            annotate(error, f"simenv_marl: while the simulation was reset; seed {self.seed}")
            raise
        prepare: Any = surrounded(kind, self._surroundings) if self._surroundings else kind
        episode: AnyEpisode = prepare(self.plan, self.simulation, self.seed, self._offspring, foretold)
        try:
            self._episode = episode  # whenever an interrupt comes from now on, its end is seen to
            episode.begin()
        except BaseException:
            episode.over = True  # it may have been interrupted before it could say so
            if episode.unwound:
                self._episode = None
            raise
        return episode

    def replay(self, other: Session) -> Any:
        """Bring the simulation to where another session's, of the same plan, stands in mid-episode.

        Returns:
            The episode.

        Raises:
            BranchError: It cannot be brought there.
            BaseException: What the model raises.
        """
        episode = other._episode
        if episode is None or episode.pending is None:
            raise other.not_running() if episode is None else episode.nothing_pending()
        if episode.taken is LOST or episode.consulted is LOST:
            raise BranchError(
                f"the episode has had more than {MOST_TAKEN:,} decisions, and its actions were not kept; use"
                ' method="fork"'
            )
        self.end()
        self._closed = False
        again = self._begin(other.seed, other.options, np.random.default_rng(), other.kind, deque(episode.consulted))
        again.replay(episode.taken)
        if again.pending is None or not again.stands_as(episode):
            again.close()
            raise BranchError(
                f"{type(self.simulation).__name__} does not come to the same decision again when it is reset with the"
                ' same seed and given the same actions: something in it is random for itself. Use method="fork", or'
                " global_rng=True if it draws from Python's or NumPy's global generators"
            )
        return again

    def at_work(self) -> AbstractContextManager[None]:
        """Keep what the simulation does apart from whatever runs around it, and in its surroundings."""
        return self._surroundings.entered() if self._surroundings else unattended()

    def end(self) -> None:
        """End the episode that runs, if one does.

        Raises:
            ReentrancyError, WrongThreadError: It cannot be ended from here; it goes on.
            BaseException: What the simulation raises while it unwinds.
        """
        if self._starting:
            raise ReentrancyError("the environment was used from inside its own reset")
        if self._episode is not None:
            try:
                self._episode.close()
            finally:
                if self._episode.unwound:
                    self._episode = None

    @property
    def idle(self) -> bool:
        """Whether there is nothing to end."""
        return self._episode is None

    def not_running(self) -> Exception:
        """The error that says why there is no episode."""
        if self._closed:
            return ClosedError("the environment is closed; call reset() to use it again")
        return NotResetError("there is no episode yet; call reset() first")

    def render(self) -> Any:
        """Render the simulation in the environment's render mode; None, with a warning, where it has none."""
        mode = self.plan.options.render_mode
        if mode is None:
            warn_user(f"render() without a render_mode shows nothing; the simulation's are {self.plan.render_modes}")
            return None
        with self.at_work():
            return self.simulation.render(mode)

    def close(self) -> None:
        """Unwind the simulation and put back what was patched.

        Raises:
            ReentrancyError, WrongThreadError: The episode cannot be ended from here; it goes on.
            BaseException: What the simulation raises while it unwinds.
        """
        try:
            self.end()
        finally:
            if self._episode is None and not self._starting:
                self._closed = True
                self._let_go_of_patches()

    def abandon(self) -> None:
        """The same, from a finalizer: raises nothing."""
        try:
            if self._episode is not None:
                self._episode.abandon()
        finally:
            self._let_go_of_patches()

    def _hold_patches(self) -> None:
        if self._held:
            return
        try:
            for patch in self.plan.patches:
                patch.hold()
                self._held.append(patch)
        except BaseException:
            self._let_go_of_patches()
            raise

    def _let_go_of_patches(self) -> None:
        while self._held:
            try:
                self._held[-1].let_go()
            finally:
                self._held.pop()


def checked_seed(seed: Any) -> int | None:
    """The seed of a ``reset`` as a python integer.

    Raises:
        OptionValueError: It is none.
    """
    if seed is None:
        return None
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise OptionValueError(f"seed must be a non-negative integer or None, not {seed!r}")
    return int(seed)


def seed_space(space: spaces.Space[Any], seed: int, agent: str) -> None:
    """Seed a space of an agent: for every agent differently, and for every order of joining alike."""
    space.seed(int(np.random.SeedSequence([seed, crc32(agent.encode())]).generate_state(1)[0]))
