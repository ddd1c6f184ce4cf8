"""The overhead of premium decisions of ten thousand clients, beside the overhead of moves in Mesa's wolf-sheep model.

The model's rule makes all decisions. The comparison is of the time that a decision *adds*: microseconds in an AEC
environment less those of the plain model, for the fund and for Mesa's wolves and sheep, in the same round.

An agent's first decision and its end cost more than the decisions between them. The fund runs for ten years, so that a
client decides about as often (7.5 times) as an animal (9.5 times).
"""

from __future__ import annotations

import gc
import statistics
from collections.abc import Callable
from dataclasses import replace
from typing import Any
from unittest.mock import patch

import numpy as np
from examples.fin_base.company import Company
from examples.fin_base.env import PREMIUMS, FundSim
from examples.fin_base.pension import Parameters
from gymnasium import spaces

from benchmarks import wolf_sheep
from benchmarks.measure import Contender, Section, now, side_by_side
from simenv_marl import aec_env

SEED = 5
YEARS = 10
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
"""The same decision, with observation and reward like a sheep's in its benchmark."""

MASKED = replace(PREMIUM, rule_action_mapping=None)
"""The same decision with all mappings but ``rule_action_mapping``."""

DEFINITIONS = {
    "mappings as for sheep": AS_SHEEP,
    "13 numbers and a mask": MASKED,
    "13 numbers, a mask and the rule's action": PREMIUM,
}


def measure(rounds: int, number: int) -> Section:
    """Measure in a number of rounds, of one episode each."""
    expected, _ = plain()
    decisions = aec(PREMIUM)[2]
    sheep = wolf_sheep.crossing()[1]

    def of_fund(run: Callable[..., Any], *given: Any) -> Contender:
        def checked() -> float:
            outcome, seconds, *_ = run(*given)
            assert outcome == expected
            gc.collect()
            return float(seconds) / decisions * 1e6

        return checked

    def of_meadow(run: Callable[..., Any], **given: Any) -> Contender:
        def timed() -> float:
            seconds = run(**given)[2]
            gc.collect()
            return float(seconds) / sheep * 1e6

        return timed

    times = side_by_side(
        {
            "fund, plain": of_fund(plain),
            "fund, plain, and all mappings called": of_fund(called, PREMIUM),
            **{f"fund, AEC, {name}": of_fund(aec, definition) for name, definition in DEFINITIONS.items()},
            "WolfSheep, plain": of_meadow(wolf_sheep.plain),
            "WolfSheep, AEC": of_meadow(wolf_sheep.aec, look=False),
        },
        rounds,
    )

    def added(what: str, to: str) -> list[float]:
        return [with_it - without for with_it, without in zip(times[what], times[to], strict=True)]

    section = Section(
        "A pension fund of 10,000 clients, RULE throughout", "microseconds per decision, the model's included"
    )
    by_sheep = added("WolfSheep, AEC", "WolfSheep, plain")
    for name, definition in DEFINITIONS.items():
        by_premium = added(f"fund, AEC, {name}", "fund, plain")
        section.ratio(
            f"added per premium, {name} / added per sheep's decision",
            statistics.median(one / other for one, other in zip(by_premium, by_sheep, strict=True)),
            *((1.1, 1.0) if definition is AS_SHEEP else ()),
        )
        section.time(f"added per premium, {name}", statistics.median(by_premium))
    mappings = added("fund, plain, and all mappings called", "fund, plain")
    section.time("of these the mappings' own, called in the plain model", statistics.median(mappings))
    section.time("added per sheep's decision", statistics.median(by_sheep))
    section.times(times)
    speed = YEARS / decisions / statistics.median(times["fund, plain"]) * 1e6
    section.remarks.append(
        f"{YEARS} years with {decisions:,} decisions: the plain model runs {speed:.1f} years a second, and every run"
        " ends with the same fund."
    )
    return section


def plain() -> tuple[Any, float]:
    """Run the model without an environment."""
    simulation = FundSim(YEARS, FUND)
    simulation.reset(SEED)
    started = now()
    simulation.run()
    seconds = now() - started
    return outcome(simulation), seconds


def called(definition: Any) -> tuple[Any, float]:
    """Run the model without an environment, and call the mappings of a definition at each decision."""
    rule = Company.set_premium

    def decide(company: Any, client: Any) -> float:
        definition.agent(company, client)
        definition.reward_mapping(company, client)
        definition.observation_space_mapping(company, client)
        definition.action_mask_mapping(company, client)
        premium = rule(company, client)
        definition.rule_action_mapping(premium, company, client)
        return premium

    with patch.object(Company, "set_premium", decide):
        return plain()


def aec(definition: Any) -> tuple[Any, float, int]:
    """Run an AEC environment, in the shortest loop."""
    env: Any = aec_env(FundSim(YEARS, FUND), {POINT: definition})
    decisions, seconds = wolf_sheep.by_rule(env, SEED, look=False)
    return outcome(env.simulation), seconds, decisions


def outcome(simulation: FundSim) -> Any:
    """Summarise the state at the end of a run."""
    fund = simulation.fund
    return fund.company.cents, fund.world.counts, fund.world.ledger.flows, fund.people.getstate()
