"""Workers that are replaced when they die: no other module knows of dead workers that come back."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from time import monotonic
from typing import Any, Final

from ..core import pack_plainly, pack_request, unpack
from ..errors import StepTimeoutError, WorkerError, warn_user
from .parallel import Outcomes, Worker, WorkerPool, call

HOUR: Final = 3600.0
"""The number of seconds over which deaths are counted."""


def remake(recipe: bytes, *state: object) -> Any:
    """In a new worker, make an object by a recipe, and let it take over from another worker's."""
    make, arguments = unpack(recipe)
    made = make(*arguments)
    made.take_over(*state)
    return made


class RestartingPool(WorkerPool):
    """Worker processes that are replaced when they die, or take too long for a step.

    The object of a new worker takes over the last observations. It reports the lost episodes at the
    next step, in place of a step. Other workers do not notice.
    """

    def __init__(
        self, most: int, make: Callable[..., object], arguments: Any, *others: Any
    ) -> None:
        """Start the workers.

        Args:
            most: The largest number of deaths within an hour.
            make: As ``WorkerPool`` takes it. The objects also have the methods ``take_over``,
                ``report_lost``, ``reset``, ``step`` and ``check`` of ``SimulationBatch``.
            arguments: As ``WorkerPool`` takes them.
            *others: The other arguments of ``WorkerPool``.
        """
        self._most = most
        self._deaths: deque[float] = deque()
        self._lost: dict[int, str] = {}  # why a worker's episodes are lost, until a step reports it
        self._latest: dict[int, Any] = {}  # the last observations of each worker
        self._seeds: dict[int, list[Any]] = {}  # of each worker's last reset with seeds
        super().__init__(make, arguments, *others)

    def _ask_all(self, method: str, shares: Sequence[Sequence[Any]]) -> list[Any]:
        """Call a method of each worker's object. A worker that dies is replaced, and asked again.

        Raises:
            WorkerError: More workers than allowed have died within an hour. The pool is broken.
        """
        had_failed = self.failed
        outcomes: Outcomes = {}
        news = []
        missing = [*range(len(shares))]
        while missing:
            requests = {}
            for number in missing:
                share = shares[number]
                why = self._lost.get(number)
                if why is None or method not in ("check", "step"):
                    requests[number] = pack_request(call, method, *share)
                elif method == "step":
                    requests[number] = pack_request(call, "report_lost", share[-1], why)
                else:
                    outcomes[number] = share[0], None  # no simulation uses the actions
            outcomes |= self._exchange(requests)
            missing = []
            for number in requests:
                error = outcomes[number][1]
                why = self._workers[number].gone
                if isinstance(error, StepTimeoutError):
                    why = why or str(error)
                if why:
                    news.append(self._replace(number, why))
                    missing.append(number)
        if news:
            self._is_broken = False
            self.failed = had_failed
        for text in news:
            warn_user(text)
        results = self._results(outcomes)
        for number, result in enumerate(results if method in ("reset", "step") else ()):
            self._latest[number] = result[0]
            if method == "step" or shares[number][-1].all():
                self._lost.pop(number, None)
            if method == "reset" and any(seed is not None for seed in shares[number][0]):
                self._seeds[number] = shares[number][0]
        return results

    def _replace(self, number: int, why: str) -> str:
        """Start a new worker in place of one that was lost. Return the text of a warning."""
        while why:
            self._break()
            now = monotonic()
            self._deaths.append(now)
            while self._deaths[0] < now - HOUR:
                self._deaths.popleft()
            self._workers[number].stop(0.0)
            if len(self._deaths) > self._most:
                raise WorkerError(
                    f"{why}. {len(self._deaths)} workers were lost within an hour, more than"
                    f" most_restarts={self._most}; reset() starts new workers"
                )
            self.restarts += 1
            text = (
                f"{why}. Its episodes are lost, and new ones begin in a new worker; restart"
                f" {len(self._deaths)} within an hour, of most_restarts={self._most}"
            )
            latest = self._latest.get(number)
            if latest is not None:
                self._lost[number] = why
            # The seeds of other workers do not depend on them.
            seeds = [
                None if seed is None else [seed, self.restarts]
                for seed in self._seeds.get(number, ())
            ]
            recipe = pack_plainly((remake, (self._recipes[number], latest, seeds)))
            part = self._parts[number]
            self._workers[number] = Worker(self._context, number, part, recipe)
            outcomes = self._exchange({number: b""})
            why = self._workers[number].gone
        self._results(outcomes)
        return text
