"""Tries candidate actions for one decision on common futures, in branches."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import nullcontext
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ..core.branching import branch
from ..errors import BranchError, annotate, short_repr, warn_user
from ..many.parallel import progress_bar
from .lookahead import Lookahead
from .players import player_of

_KEY: Final = 0x706C616E
"""Separates the seeds of futures from other seeds that are derived from the episode's seed."""


class Futures:
    """The futures of a pending decision. Future number i is the same for all candidates.

    Attributes:
        actions: The candidates.
        endless: Whether there are unlimited futures. Otherwise there is only the one exact future.
        returns: The returns of each candidate's tries.
    """

    def __init__(self, env: Any, actions: Any, look: Lookahead, seed: int | None, *, legal: bool = False) -> None:
        """Prepare the futures.

        Args:
            env: The environment.
            actions: The candidates, as ``Player.candidates`` takes them.
            look: How candidates are tried.
            seed: A number that distinguishes these futures from others of the same decision. None: the decision's own
                futures.
            legal: Whether masked candidates are left out.

        Raises:
            SimEnvError: Something cannot work. The subclass tells what.
        """
        self._env, self._look = env, look
        player = player_of(env, look.base)
        look.check(player)
        self.actions = player.candidates(actions, legal=legal)
        self.returns: list[list[float]] = [[] for _ in self.actions]
        self._entropy = [*player.entropy, _KEY, *(() if seed is None else (seed,))]
        try:
            player.view.check_reseed()
            self.endless = True
        except BranchError:
            self.endless = False
            warn_user(
                f"{type(player.view.simulation).__name__} cannot draw new random numbers in a branch: the planner"
                " tries all candidates on the one future that will happen, and so foresees chance. Give it a method"
                " reseed(seed), empty if nothing is random, or set global_rng=True if it draws from random or"
                " numpy.random"
            )

    def run(self, candidates: Iterable[int], more: int, *, progress: bool = False) -> None:
        """Try candidates on their next futures.

        Args:
            candidates: The places of the candidates.
            more: The number of futures for each candidate; at most one if there is only one future.
            progress: Whether to show a progress bar.

        Raises:
            BranchError: A branch died, or took too long.
            BaseException: Any exception of the model, a mapping or the base in a branch.
        """
        pairs = [
            (candidate, future)
            for candidate in candidates
            for future in range(len(self.returns[candidate]), len(self.returns[candidate]) + more)
            if self.endless or future == 0
        ]
        size = len(self.actions) if progress else max(1, len(pairs))
        with progress_bar(len(pairs), "branch") if progress else nullcontext() as bar:
            for start in range(0, len(pairs), size):
                part = pairs[start : start + size]
                self.play([((candidate,), future) for candidate, future in part])
                if bar is not None:
                    bar.update(len(part))

    def play(self, tries: Sequence[tuple[tuple[int, ...], int]]) -> list[list[float]]:
        """Try sequences of candidates.

        Args:
            tries: For each try, the places of its actions, and the number of the future.

        Returns:
            For each try, the result of ``Lookahead.play``.
        """
        look, seeds = self._look, None
        if self.endless:
            numbers = self.seeds(1 + max((future for _, future in tries), default=0))
            seeds = [numbers[future] for _, future in tries]
        brought: list[list[float]] = branch(
            self._env,
            lambda twin, number: self._tried(twin, *tries[number]),
            len(tries),
            method=look.method,
            seeds=seeds,
            time_limit=look.time_limit,
        )
        for (places, _), rewards in zip(tries, brought, strict=True):
            self.returns[places[0]].append(sum(rewards))
        return brought

    def _tried(self, twin: Any, places: tuple[int, ...], future: int) -> list[float]:
        """Try actions, given by their places, in a branch."""
        actions = [self.actions[place] for place in places]
        try:
            return self._look.play(twin, actions)
        except BaseException as error:
            annotate(
                error, f"simenv_marl: while {', '.join(map(short_repr, actions))} was tried out in future {future}"
            )
            raise

    def seeds(self, number: int) -> list[int]:
        """Return the seeds of the first futures."""
        return [int(word) for word in np.random.SeedSequence(self._entropy).generate_state(number)]

    def table(self) -> NDArray[np.float64]:
        """Return the returns, one row for each candidate; nan where it was not tried."""
        table = np.full((len(self.returns), max(map(len, self.returns))), np.nan)
        for row, values in enumerate(self.returns):
            table[row, : len(values)] = values
        return table
