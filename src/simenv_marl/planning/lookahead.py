"""How a future is valued: horizon, discount and terminal value, and the return of a candidate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from numbers import Real
from typing import Any, Final

import numpy as np

from ..core.asking import PLANNING
from ..errors import OptionValueError, short_repr
from ..simulation import RULE
from .players import Player, player_of

UNITS: Final = ("decision", "time")
"""The units of horizons and discounts."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Lookahead:
    """The parameters of tries; ``action_values`` has the same ones and describes them."""

    base: Any = RULE
    futures: int = 16
    horizon: float | None = None
    horizon_by: str = "decision"
    terminal_value: Callable[[Any], float] | None = None
    discount: float = 1.0
    discount_by: str = "decision"
    method: str | None = None
    time_limit: float = 600.0

    def __post_init__(self) -> None:
        for name in ("horizon_by", "discount_by"):
            if getattr(self, name) not in UNITS:
                raise OptionValueError(f'{name} must be "decision" or "time", not {short_repr(getattr(self, name))}')
        if not is_count(self.futures):
            raise OptionValueError(f"futures must be a positive integer, not {short_repr(self.futures)}")
        horizon, timed = self.horizon, self.horizon_by == "time"
        if horizon is not None and not (is_number(horizon) and horizon > 0 if timed else is_count(horizon)):
            kind = "a positive time" if timed else "a number of decisions, 1 or more,"
            raise OptionValueError(f"horizon must be {kind} or None, not {short_repr(horizon)}")
        if not (is_number(self.discount) and 0 <= self.discount <= 1):
            raise OptionValueError(f"discount must be a number from 0 to 1, not {short_repr(self.discount)}")
        if self.terminal_value is not None and not callable(self.terminal_value):
            raise OptionValueError(
                f"terminal_value must be a callable of the environment, not {short_repr(self.terminal_value)}"
            )

    def check(self, player: Player) -> None:
        """Check that the parameters fit a player.

        Raises:
            OptionValueError: They do not.
            UnknownAgentError: The base names an agent that does not exist.
        """
        player.check_base()
        if self._timed and player.episode.clock is None:
            raise OptionValueError('discount_by="time" and horizon_by="time" need a simulation with a method time()')

    @property
    def _timed(self) -> bool:
        """Whether the simulation's time is needed."""
        return "time" in (self.discount_by, self.horizon_by)

    def play(self, env: Any, actions: Sequence[Any]) -> list[float]:
        """Take actions in a branch, one after the other, and go on with the base.

        Args:
            env: The branch.
            actions: The candidate, followed by actions for the agent's next decisions. If one of these is illegal when
                its decision arises, the base decides.

        Returns:
            The discounted reward of each decision of the agent. The terminal value is added to the last one.
        """
        planning = PLANNING.set(True)
        try:
            return self._play(player_of(env, self.base), actions)
        finally:
            PLANNING.reset(planning)

    def _play(self, player: Player, actions: Sequence[Any]) -> list[float]:
        player.begin()
        timed, action = self._timed, actions[0]
        brought: list[float] = []
        began = now = player.now() if timed else 0.0
        while True:
            weight = self.discount ** (now - began if self.discount_by == "time" else len(brought))
            brought.append(weight * player.step(action))
            if player.over:
                return brought
            decided, now = len(brought), player.now() if timed else 0.0
            if self.horizon is not None and (now - began if self.horizon_by == "time" else decided) >= self.horizon:
                break
            planned = decided < len(actions) and player.allows(actions[decided])
            action = actions[decided] if planned else player.decide()
        if self.terminal_value is not None:
            rest: Any = self.terminal_value(player.env)
            if isinstance(rest, np.ndarray) and rest.size == 1:
                rest = rest.item()
            if not is_number(rest):
                raise OptionValueError(f"terminal_value must return a finite number, not {short_repr(rest)}")
            brought[-1] += float(rest) * self.discount ** (now - began if self.discount_by == "time" else decided)
        return brought


def is_count(value: Any) -> bool:
    """Return whether a value is a positive integer."""
    return hasattr(value, "__index__") and not isinstance(value, bool) and value >= 1


def is_number(value: Any) -> bool:
    """Return whether a value is one finite number."""
    return isinstance(value, Real) and not isinstance(value, bool) and isfinite(value)


def within_a_branch() -> bool:
    """Return whether this runs in a branch that tries a candidate. There, planners act as their bases."""
    return PLANNING.get()
