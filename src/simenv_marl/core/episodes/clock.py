"""The clock of an episode: the times in infos."""

from __future__ import annotations

from collections.abc import Callable
from math import exp
from typing import Any


class Clock:
    """Reads the simulation's time.

    Attributes:
        time: Returns the simulation's time.
    """

    __slots__ = ("_rate", "time")

    def __init__(self, time: Callable[[], float], rate: float | None) -> None:
        """Read times by a function, and discount by a rate per unit of time if there is one."""
        self.time = time
        self._rate = rate

    def read(self, before: float | None) -> dict[str, Any]:
        """Return the time, and the time elapsed since an earlier one, as an info."""
        read = self.time
        time = read()
        now = time if type(time) is float else float(time)
        info: dict[str, Any] = {"time": now, "elapsed": 0.0 if before is None else now - before}
        if self._rate is not None:
            info["discount"] = exp(-self._rate * info["elapsed"])
        return info
