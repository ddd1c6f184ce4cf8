"""A planner whose latest choice can stand for it in the branches of other planners."""

from __future__ import annotations

from typing import Any

from simenv_marl import RULE
from simenv_marl.planning import RolloutPolicy


class Planner(RolloutPolicy):
    """A planner that keeps its latest choice, for the branches of others."""

    latest: Any = RULE

    def choose(self, env: Any) -> Any:
        """Choose, and keep the choice."""
        values = super().choose(env)
        self.latest = values.best
        return values
