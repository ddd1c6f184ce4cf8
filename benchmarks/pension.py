"""What premiums decided for each of ten thousand clients add to a pension fund, beside what sheep add to a meadow.

With ``RULE`` throughout. What is compared is what a decision *adds*: microseconds behind an AEC environment less those
of the plain model, for the fund and for Mesa's wolves and sheep, in the same round.
"""

from __future__ import annotations

import gc
import statistics
from dataclasses import replace
from typing import Any

import numpy as np
from examples.fin_base.env import PREMIUMS, FundSim
from examples.fin_base.pension import Parameters
from gymnasium import spaces

from benchmarks import wolf_sheep
from benchmarks.measure import Contender, Section, now, side_by_side
from simenv_marl import RULE, aec_env

SEED = 5
YEARS = 3
FUND = Parameters(clients=10_000)

((POINT, PREMIUM),) = PREMIUMS.items()

AS_SHEEP = replace(
    PREMIUM,
    observation_space=spaces.Box(0, np.inf, (2,), np.float32),
    observation_space_mapping=lambda company, client: np.array((client.wage, client.extra), np.float32),
    reward_mapping=lambda company, client: float(client.premium),
    action_mask_mapping=None,
    rule_action_mapping=None,
)
"""The same decision, seen and rewarded as little as a sheep's is in the benchmark of these."""


def measure(rounds: int, number: int) -> Section:
    """Measure in so many rounds, of an episode each."""
    expected, _ = plain()
    decisions = aec(PREMIUM)[2]
    sheep = wolf_sheep.crossing()[1]

    def of_fund(definition: Any = None) -> Contender:
        def run() -> float:
            outcome, seconds, *_ = plain() if definition is None else aec(definition)
            assert outcome == expected
            gc.collect()
            return seconds / decisions * 1e6

        return run

    def of_meadow(*, views: bool) -> Contender:
        def run() -> float:
            seconds = (wolf_sheep.aec(look=False) if views else wolf_sheep.plain())[2]
            gc.collect()
            return seconds / sheep * 1e6

        return run

    times = side_by_side(
        {
            "fund, plain": of_fund(),
            "fund, AEC": of_fund(PREMIUM),
            "fund, AEC, mappings as for sheep": of_fund(AS_SHEEP),
            "WolfSheep, plain": of_meadow(views=False),
            "WolfSheep, AEC": of_meadow(views=True),
        },
        rounds,
    )

    def added(what: str, plainly: str) -> list[float]:
        return [with_it - without for with_it, without in zip(times[what], times[plainly], strict=True)]

    section = Section(
        "A pension fund of 10,000 clients, RULE throughout", "microseconds per decision, the model's included"
    )
    by_sheep = added("WolfSheep, AEC", "WolfSheep, plain")
    for what, called in (
        (
            "fund, AEC",
            "added per premium, with masks, rule's actions and 13 numbers observed / added per sheep's decision",
        ),
        (
            "fund, AEC, mappings as for sheep",
            "added per premium, with mappings as for sheep / added per sheep's decision",
        ),
    ):
        ratios = [one / other for one, other in zip(added(what, "fund, plain"), by_sheep, strict=True)]
        section.ratio(called, statistics.median(ratios))
    section.times(times)
    speed = YEARS / decisions / statistics.median(times["fund, plain"]) * 1e6
    section.remarks.append(
        f"{YEARS} years with {decisions:,} decisions: the plain model runs {speed:.1f} years a second, and every run"
        " ends with the same fund."
    )
    return section


def plain() -> tuple[Any, float]:
    """The model by itself."""
    simulation = FundSim(YEARS, FUND)
    simulation.reset(SEED)
    started = now()
    simulation.run()
    seconds = now() - started
    return outcome(simulation), seconds


def aec(definition: Any) -> tuple[Any, float, int]:
    """An AEC environment, in the shortest loop."""
    env: Any = aec_env(FundSim(YEARS, FUND), {POINT: definition})
    env.reset(seed=SEED)
    decisions = 0
    step = env.step
    started = now()
    for agent in env.agent_iter():
        if env.terminations[agent] or env.truncations[agent]:
            step(None)
        else:
            step(RULE)
            decisions += 1
    seconds = now() - started
    env.close()
    return outcome(env.simulation), seconds, decisions


def outcome(simulation: FundSim) -> Any:
    """All that the decisions of a run have led to, in short."""
    fund = simulation.fund
    return fund.company.cents, fund.world.counts, fund.world.ledger.flows, fund.people.getstate()
