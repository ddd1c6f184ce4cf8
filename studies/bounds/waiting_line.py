"""LineFlow's line in which a source waits, and its variant with a jump, as simulations."""

from __future__ import annotations

from typing import Any, ClassVar, Final

import numpy as np
from gymnasium import spaces
from lineflow.examples.waiting_time import WaitingTime, make_optimal_agent

from simenv_marl import make_step

STEP: Final = 10
"""The time between two decisions."""


class Line:
    """A line of which someone decides how long the source of components waits.

    The rule leaves this as it is, and it is 0 in the beginning.
    """

    jumps: ClassVar[bool] = False
    end: ClassVar[int] = 4000

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode."""
        self.line: Any = WaitingTime(
            with_jump=self.jumps, t_jump_max=self.end / 2, random_state=seed, step_size=STEP
        )

    def reseed(self, seed: int) -> None:
        """Draw all times anew, and a jump that has not begun."""
        self.line.random.seed(seed)
        np.random.seed(seed)  # the package draws the length of a jump from it
        assembly, now = self.line["Assembly"], self.time()
        if self.jumps and now < assembly.trigger_time:
            assembly._sample_trigger_time()
            while assembly.trigger_time <= now:
                assembly._sample_trigger_time()

    def run(self) -> None:
        """Run LineFlow's loop."""
        self.line.run(self.end, agent=lambda state, env: self.set(self.wait()), show_status=False)

    def set(self, waiting: int) -> dict[str, dict[str, int]]:
        """Return LineFlow's action for a waiting time."""
        return {"S_component": {"waiting_time": waiting}}

    def time(self) -> float:
        """Return the time."""
        return float(self.line.env.now)

    @property
    def score(self) -> float:
        """The number of parts less that of scrapped ones."""
        return float(self.line.get_n_parts_produced() - self.line.get_n_scrap_parts())

    @make_step(
        observation_space=spaces.Box(0, 1, (1,), np.float32),
        observation_space_mapping=lambda: [0.0],  # policies look at the line itself
        action_space=spaces.Discrete(100),
        action_space_mapping=int,
        reward_mapping=lambda: 0.0,
        agent="source",
    )
    def wait(self) -> int:
        """Choose the waiting time."""
        return int(self.line.state["S_component"]["waiting_time"].value)


class JumpingLine(Line):
    """The line in which the assembly takes longer for some time."""

    jumps = True


def best_known(observation: Any, *, _simulation: Line) -> int:
    """Wait as the package's best heuristic does, which knows the assembly's mean time."""
    line = _simulation.line
    decided = make_optimal_agent(line)(line.state, line.env)
    return int(decided["S_component"]["waiting_time"])
