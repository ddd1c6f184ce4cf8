"""The clock of an episode: times, elapsed times and discounts for infos."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import exp
from typing import Any


@dataclass(eq=False, slots=True)
class Clock:
    """Reads the simulation's time.

    Attributes:
        time: Returns the simulation's time.
        rate: The discount rate per unit of time. None: infos have no discount.
    """

    time: Callable[[], float]
    rate: float | None

    def read(self, before: float | None) -> dict[str, Any]:
        """Return the time, and the time elapsed since an earlier one, as an info."""
        read = self.time
        time = read()
        now = time if type(time) is float else float(time)
        info: dict[str, Any] = {"time": now, "elapsed": 0.0 if before is None else now - before}
        if self.rate is not None:
            info["discount"] = exp(-self.rate * info["elapsed"])
        return info
