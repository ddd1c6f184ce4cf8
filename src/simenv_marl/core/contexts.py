"""What an environment's simulation finds around it whenever it is at work.

An environment whose options ask for surroundings enters them before anything runs for it, and leaves them
afterwards: for each turn, and not for each switch to the simulation. All others pay nothing for that.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from functools import partial
from typing import Any, Final

from .episode import Episode
from .plan import Plan
from .rounds import Rounds
from .switch import Surrounding, attended, unattended


class Surroundings:
    """The surroundings of one environment's simulation, from the outermost to the innermost."""

    def __init__(self, surroundings: list[Surrounding]) -> None:
        self._surroundings = surroundings

    def __bool__(self) -> bool:
        return bool(self._surroundings)

    def entered(self) -> AbstractContextManager[None]:
        """Keep what runs apart from whatever runs around it, and in these surroundings."""
        return _Entered(self)

    def begin(self, seed: int) -> None:
        """An episode begins."""
        for surrounding in self._surroundings:
            surrounding.begin(seed)

    def enter(self) -> None:
        """Put them up."""
        done = []
        try:
            for surrounding in self._surroundings:
                surrounding.enter()
                done.append(surrounding)
        except BaseException:
            for surrounding in reversed(done):
                surrounding.leave()
            raise

    def leave(self) -> None:
        """Take them down."""
        for surrounding in reversed(self._surroundings):
            surrounding.leave()

    def around(self, run: Callable[[], Any]) -> Callable[[], Any]:
        """A simulation's main loop in these surroundings, in whatever thread it runs."""
        for surrounding in reversed(self._surroundings):
            run = surrounding.around(run)
        return run


class _Entered(unattended):
    __slots__ = ("_surroundings",)

    def __init__(self, surroundings: Surroundings) -> None:
        self._surroundings = surroundings

    def __enter__(self) -> None:
        super().__enter__()
        try:
            self._surroundings.enter()
        except BaseException:
            super().__exit__()
            raise

    def __exit__(self, *error: object) -> None:
        try:
            self._surroundings.leave()
        finally:
            super().__exit__()


class Surrounded(Episode):
    """An episode of a simulation that has surroundings, played in turns or in rounds."""

    def __init__(self, plan: Plan, simulation: Any, *others: Any, surroundings: Surroundings) -> None:
        """Prepare an episode, as ``Episode`` does."""
        self._surroundings = surroundings
        super().__init__(plan, simulation, *others)
        clock = self.clock
        if clock is not None:
            self.clock = lambda: self._tell(clock)

    def _tell(self, clock: Callable[[], float]) -> float:
        with self._surroundings.entered():
            return clock()

    def _main_loop(self) -> Callable[[], Any]:
        return self._surroundings.around(super()._main_loop())

    def _attended(self) -> bool:
        return False  # it has been kept apart before it entered its surroundings

    def _kept_apart(self) -> AbstractContextManager[None]:
        return self._surroundings.entered()

    def turn(self, action: Any) -> None:
        """Answer the pending decision, as ``Episode.turn`` does."""
        if attended():
            with unattended():
                self.turn(action)
            return
        surroundings = self._surroundings
        surroundings.enter()
        try:
            super().turn(action)
        finally:
            surroundings.leave()


class SurroundedRounds(Surrounded, Rounds):
    """The same in rounds."""

    def play(self, actions: Mapping[str, Any]) -> None:
        """Answer the decisions of a round, as ``Rounds.play`` does."""
        with self._surroundings.entered():
            super().play(actions)


def surrounded(kind: type[Episode], surroundings: Surroundings) -> Callable[..., Episode]:
    """What prepares an episode that is played like those of a kind, in surroundings."""
    if kind not in _SURROUNDED:
        _SURROUNDED[kind] = type(f"Surrounded{kind.__name__}", (Surrounded, kind), {})
    return partial(_SURROUNDED[kind], surroundings=surroundings)


_SURROUNDED: Final[dict[type[Episode], type[Surrounded]]] = {Episode: Surrounded, Rounds: SurroundedRounds}
"""By kind, the kind of episodes that are played like those, in surroundings. All but rounds are played in turns."""
