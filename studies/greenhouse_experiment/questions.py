"""The five questions, and the evaluation of the policies that answer them.

Learners see the greenhouse through different views: one agent or two, in turns or in rounds. The
evaluation is the same for all: as a team in the AEC environment of both agents, on held-out
greenhouses, by ``play`` of the module ``train``, whose return is that of one agent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from examples.greenhouse_coop.env import VENTILATOR, WATERER
from examples.greenhouse_coop.plan import BEST
from examples.greenhouse_coop.train import HELD_OUT, Constant, Outcome, Policy, Team, play
from numpy.typing import NDArray

CURVE: Final = range(HELD_OUT + 10_000, HELD_OUT + 10_008)
"""The seeds of the greenhouses for the learning curves."""

FINAL: Final = range(HELD_OUT, HELD_OUT + 32)
"""The seeds of the greenhouses for the final evaluation: those of ``make demo``."""

BEST_WATERING: Final = {WATERER: Constant(0.06)}
"""The best constant watering by ``make demo`` where ventilation follows its rule: 60 litres."""


@dataclass(frozen=True)
class Question:
    """A question of the experiment.

    Attributes:
        title: A short description.
        learners: The agents that learn.
        fixed: The fixed policies of other agents. Agents that neither learn nor have one follow
            their rule.
        needs: The question whose trained policy, from the same seed, is a fixed policy here.
    """

    title: str
    learners: tuple[str, ...]
    fixed: Team
    needs: str | None = None


def _fixed(agent: str) -> Team:
    return {agent: BEST[agent]}


BOTH: Final = (WATERER, VENTILATOR)

QUESTIONS: Final = {
    "1": Question("watering alone", (WATERER,), {}),
    "2": Question("ventilation alone", (VENTILATOR,), {}),
    "3": Question("both, as one agent", BOTH, {}),
    "4a": Question("both, as two independent learners", BOTH, {}),
    "4b": Question("both, as two with a centralised critic", BOTH, {}),
    "5a": Question("watering, constant ventilation", (WATERER,), _fixed(VENTILATOR)),
    "5b": Question("ventilation, constant watering", (VENTILATOR,), _fixed(WATERER)),
    "5c": Question("ventilation, watering as learned in 1", (VENTILATOR,), {}, needs="1"),
}


# -- policies -------------------------------------------------------------------------------------

Act = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""A trained policy: from an observation, float32 ``(6,)``, to actions, float32 ``(learners,)``."""


def in_turns(agent: str, act: Act) -> Team:
    """Make the team of one learner, which decides on its own observation.

    Its policy also serves ``simenv_marl.simulate`` and the option ``policies``, which pass an info
    where ``play`` passes a space.
    """

    def policy(observation: NDArray[np.float32], _: Any = None) -> NDArray[np.float32]:
        return act(observation)

    return {agent: policy}


def in_rounds(act: Act) -> Team:
    """Make the team of two learners with simultaneous decisions, as in parallel and joint views.

    Args:
        act: The policy of both; it returns the waterer's action, then the ventilator's.
    """
    waters = np.zeros(1, np.float32)

    def ventilator(observation: NDArray[np.float32], _: Any = None) -> NDArray[np.float32]:
        nonlocal waters
        actions = act(observation)
        waters = actions[:1]
        return actions[1:]

    def waterer(observation: NDArray[np.float32], _: Any = None) -> NDArray[np.float32]:
        return waters  # decided at the beginning of the day

    return {WATERER: waterer, VENTILATOR: ventilator}


def team_of(question: Question, act: Act) -> dict[str, Policy]:
    """Make the team that answers a question: the trained policies and the fixed ones."""
    learnt = in_rounds(act) if question.learners == BOTH else in_turns(question.learners[0], act)
    return {**question.fixed, **learnt}


# -- evaluation -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Verdict:
    """The results of a team, as means over greenhouses.

    Attributes:
        value: The return of the team.
        alive: The number of plants alive at the end.
        litres: The litres poured.
    """

    value: float
    alive: float
    litres: float

    @classmethod
    def of(cls, outcomes: Iterable[Outcome]) -> Verdict:
        """Take the mean of outcomes."""
        rows = [(outcome.value, outcome.alive[-1], sum(outcome.poured)) for outcome in outcomes]
        return cls(*np.mean(rows, axis=0).round(4).tolist())


def judge(team: Team, seeds: Iterable[int]) -> Verdict:
    """Evaluate a team on greenhouses.

    Args:
        team: The policies by agent.
        seeds: The seeds of the greenhouses.
    """
    return Verdict.of(play(team, seed) for seed in seeds)
