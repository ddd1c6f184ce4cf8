"""The five questions, and how whatever has been learnt for one of them is judged.

Learners see the greenhouse through different views: one agent or two, in turns or in rounds. What they have learnt is
judged alike all the same: as a team in the AEC environment of both agents, on greenhouses that nobody has learnt from,
by ``play`` of the module ``train``, whose return is that of one agent.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from simenv_marl import SimulationAECEnv

from ..train import HELD_OUT, VENTILATOR, WATERER, Constant, Outcome, Policy, Team, play

CURVE: Final = range(HELD_OUT + 10_000, HELD_OUT + 10_008)
"""Greenhouses that are kept while learning goes on, for the learning curves."""

FINAL: Final = range(HELD_OUT, HELD_OUT + 32)
"""Greenhouses that are kept in the end: those of ``make demo``."""

BEST_CONSTANTS: Final = {WATERER: Constant(0.084), VENTILATOR: Constant(1.0)}
"""The best constant pair that ``make demo`` finds: 84 litres, and all of the air."""


BEST_WATERING: Final = {WATERER: Constant(0.06)}
"""The best constant watering that it finds where ventilation follows its rule: 60 litres."""


@dataclass(frozen=True)
class Question:
    """A question.

    Attributes:
        title: What is asked.
        learners: Who learns.
        fixed: Who is answered by a fixed policy meanwhile. Whoever neither learns nor is fixed follows the rule.
        needs: The question whose answer, of the same seed, is the fixed policy of whoever learnt there.
    """

    title: str
    learners: tuple[str, ...]
    fixed: Team
    needs: str | None = None


def _fixed(agent: str) -> Team:
    return {agent: BEST_CONSTANTS[agent]}


BOTH: Final = (WATERER, VENTILATOR)

QUESTIONS: Final = {
    "1": Question("watering alone", (WATERER,), {}),
    "2": Question("ventilation alone", (VENTILATOR,), {}),
    "3": Question("both, as one agent", BOTH, {}),
    "4a": Question("both, as two independent learners", BOTH, {}),
    "4b": Question("both, as two with a centralised critic", BOTH, {}),
    "5a": Question("watering, constant ventilation", (WATERER,), _fixed(VENTILATOR)),
    "5b": Question("ventilation, constant watering", (VENTILATOR,), _fixed(WATERER)),
    "5c": Question("ventilation, watering as learnt in 1", (VENTILATOR,), {}, needs="1"),
}


# -- policies -------------------------------------------------------------------------------------

Act = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""What a library has learnt: from an observation, float32 ``(6,)``, to actions, float32 ``(number of learners,)``."""


def in_turns(agent: str, act: Act) -> Team:
    """The team of one learner, who decides on what it observes when it is asked.

    Its policy also serves ``simenv_marl.simulate`` and the option ``policies``, which pass an info where ``play``
    passes a space.
    """

    def policy(observation: NDArray[np.float32], _: Any = None) -> NDArray[np.float32]:
        return act(observation)

    return {agent: policy}


def in_rounds(act: Act) -> Team:
    """The team of two learners who decide at once, as in parallel and joint views: both on what is seen first in a day.

    Args:
        act: Of an action for each of both, the waterer's first.
    """
    waters = np.zeros(1, np.float32)

    def ventilator(observation: NDArray[np.float32], _: Any = None) -> NDArray[np.float32]:
        nonlocal waters
        actions = act(observation)
        waters = actions[:1]
        return actions[1:]

    def waterer(observation: NDArray[np.float32], _: Any = None) -> NDArray[np.float32]:
        return waters  # its decision was taken when the day began

    return {WATERER: waterer, VENTILATOR: ventilator}


def team_of(question: Question, act: Act) -> dict[str, Policy]:
    """Who plays when a question has been answered: those who have learnt, and those who are fixed."""
    learnt = in_rounds(act) if question.learners == BOTH else in_turns(question.learners[0], act)
    return {**question.fixed, **learnt}


# -- judging --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Verdict:
    """What a team was worth, in the mean over greenhouses.

    Attributes:
        value: The return of the team.
        alive: How many plants were alive in the end.
        litres: How many litres were poured.
    """

    value: float
    alive: float
    litres: float

    @classmethod
    def of(cls, outcomes: Iterable[Outcome]) -> Verdict:
        """Take the mean of outcomes."""
        rows = [(outcome.value, outcome.alive[-1], sum(outcome.poured)) for outcome in outcomes]
        return cls(*np.mean(rows, axis=0).round(4).tolist())


def judge(environment: SimulationAECEnv, team: Team, seeds: Iterable[int]) -> Verdict:
    """Let a team keep greenhouses.

    Args:
        environment: As ``raw_env`` makes it.
        team: Who plays.
        seeds: Of the greenhouses.
    """
    return Verdict.of(play(environment, team, seed) for seed in seeds)
