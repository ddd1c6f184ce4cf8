"""Environments made from the pension fund: agents, observations, actions and rewards.

The model itself does not refer to this module: the module names the model's methods as decision
points.

- ``TEAM``: ``indexer_0`` and ``planner_0`` decide once a year on indexation and cuts, ``manager_0``
  each quarter on the asset mix, ``regulator_0`` on what recovery plans must contain. Their common
  reward is the gain in the members' welfare, as the module ``welfare`` defines it.
- ``PREMIUMS``: each client is an agent, which decides once a year on its own premium *on behalf of
  the company*; all these agents can share one policy. The agent ends when the client retires,
  leaves or dies.
- ``FundSim``: the simulation: a fund over a number of years. Its time is in years, and so is the
  time in infos.

Masks exclude the actions that the law forbids: discounts on premiums without the coverage for them,
indexation below 110 %, more risk in a shortfall. An action that is not masked can still be denied:
a recovery plan that cuts less than the regulator demands.

Importing this module registers the team as ``fin_base/coop_v0`` (AEC and parallel) and
``fin_base/Joint-v0``, each of its agents alone as ``fin_base/ChooseMix-v0`` and so on, and the
clients as ``fin_base/premium_v0``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
import pettingzoo
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from simenv_marl import (
    TRUNCATED,
    Definition,
    SimulationInterface,
    aec_env,
    difference,
    make_step,
    register_simulation,
)
from simenv_marl.envs import SimulationAECEnv

from .company import Company, Manager, Regulator
from .law import MINIMUM, REQUIRED, SPREAD
from .pension import Fund, Parameters
from .people import Client
from .welfare import Account

YEARS: Final = 40  # after which an episode is truncated
CLIENTS: Final = 1000  # at the start

# premiums, relative to the cost of the client's accrual
SURCHARGES: Final = (0.8, 0.9, 1.0, 1.05, 1.15, 1.3)
INDEXATIONS: Final = (0.0, 0.25, 0.5, 0.75, 1.0)  # relative to the highest lawful one
CUTS: Final = (0.0, 0.5 / SPREAD, 1 / SPREAD, 3 / SPREAD, 1.0)  # relative to the shortfall
MIXES: Final = (0.0, 0.2, 0.3, 0.4, 0.6, 0.8)  # shares of equities


# -- observations ---------------------------------------------------------------------------------

OBSERVED: Final = {
    "coverage, at most 10": (0, 10),
    "policy coverage, at most 10": (0, 10),
    "number of yearly measurements in a row below the minimum": (0, 100),
    "share of equities": (0, 1),
    "yield, times 10": (-3, 3),
    "inflation, times 10": (-3, 3),
    "purchasing power of a right that was 1 in the first month": (0, 3),
}
"""The observation of the company, and the bounds of its space."""

OF_A_CLIENT: Final = {
    "age / 100 years": (0, 1.2),
    "wage / 100,000, in prices of the first month": (0, 20),
    "rights / wage": (0, 20),
    "contribution beyond the standard": (0, 0.5),
    "cost of the standard accrual / wage": (0, 1),
    "savings / wage": (0, 20),
}
"""The observation of a client, which follows that of the company."""

SPACE: Final = Box(*np.array(list(OBSERVED.values()), np.float32).T)
CLIENT_SPACE: Final = Box(*np.array(list((OBSERVED | OF_A_CLIENT).values()), np.float32).T)


def look_at(company: Company) -> tuple[float, ...]:
    """Return the numbers that ``OBSERVED`` lists."""
    market = company.market
    return (
        min(company.coverage(), 10.0),
        min(company.policy_coverage(), 10.0),
        company.measured_short,
        company.manager.equities,
        10 * market.bond_yield,
        10 * market.inflation,
        company.indexed / market.price_level,
    )


def company_of(*call: Any) -> Company:
    """Find the company in a single agent's call: the last argument, or that argument's company."""
    last = call[-1]
    return last if isinstance(last, Company) else last.company


def observe(*call: Any) -> NDArray[np.float32]:
    """Observe the company."""
    return np.array(look_at(company_of(*call)), np.float32)


def observe_client(company: Company, client: Client) -> NDArray[np.float32]:
    """Observe the company and one client."""
    wage = client.wage
    own = (
        client.age / 1200,
        wage / 100_000_00 / company.market.price_level,
        client.accrued / wage,
        client.extra,
        company.cost_rate(client),
        client.cents / wage,
    )
    return np.array([*look_at(company), *own], np.float32)


def display(*call: Any) -> dict[str, str | float]:
    """Return what people and language models read of the company in place of the observation."""
    company = company_of(*call)
    market = company.market
    return {
        "coverage": f"{100 * company.coverage():.1f} %",
        "policy coverage": f"{100 * company.policy_coverage():.1f} %",
        "yearly measurements in a row below the minimum": company.measured_short,
        "share of equities": f"{100 * company.manager.equities:.0f} %",
        "yield": f"{100 * market.bond_yield:.2f} %",
        "inflation": f"{100 * market.inflation:.2f} %",
        "purchasing power of a right": f"{100 * company.indexed / market.price_level:.1f} %",
    }


def display_client(company: Company, client: Client) -> dict[str, str | float]:
    """Return what people and language models read of a client in place of the observation."""
    own = {
        "age": f"{client.age / 12:.1f} years",
        "wage": f"{client.wage / 100:.0f}",
        "cost of the standard accrual": f"{100 * company.cost_rate(client):.1f} % of the wage",
    }
    return own | display(company)


# -- rewards --------------------------------------------------------------------------------------


def total_welfare(*call: Any, _simulation: FundSim) -> float:
    """The welfare of the members: see the module ``welfare``."""
    return _simulation.welfare()


welfare: Final = difference(total_welfare)


def premium_reward(company: Company, client: Client) -> float:
    """Reward years without a shortfall, less the premium.

    Ten per cent of the wage cost a fifth of a sound year.
    """
    coverage = company.policy_coverage()
    sound = 1.0 if coverage >= MINIMUM else 1.0 - 10 * (MINIMUM - coverage)
    return sound - 2 * client.premium


# -- decisions ------------------------------------------------------------------------------------


def nearest(levels: Sequence[float], value: float) -> int:
    """Return the index of the level nearest to a value."""
    return min(range(len(levels)), key=lambda number: abs(levels[number] - value))


def ask_premium(action: Any, company: Company, client: Client) -> float:
    """Map an action to a premium: a multiple of the cost of the accrual."""
    return SURCHARGES[action] * company.cost_rate(client) * (1 + client.extra)


def premium_asked(premium: float, company: Company, client: Client) -> int | None:
    """Map a premium of the company's rule to its action."""
    return ACTIONS.get(round(premium / (company.cost_rate(client) * (1 + client.extra)), 6))


def lawful_surcharges(company: Company, client: Client) -> NDArray[np.int8]:
    """Mask discounts unless coverage is high enough."""
    return ALL_SURCHARGES if company.policy_coverage() >= REQUIRED else NO_DISCOUNTS


ACTIONS: Final = {level: action for action, level in enumerate(SURCHARGES)}
ALL_SURCHARGES: Final = np.ones(len(SURCHARGES), np.int8)
NO_DISCOUNTS: Final = np.array([level >= 1 for level in SURCHARGES], np.int8)


def agent_of(*call: Any) -> str:
    """Name the agent of the client in a call, which the company may precede."""
    client: Client = call[-1] if isinstance(call[0], Company) else call[0]
    return client.name


def index(action: Any, company: Company) -> float:
    """Map an action to an indexation: a share of the highest lawful one."""
    return INDEXATIONS[action] * company.lawful_indexation()


def indexed(indexation: float, company: Company) -> int:
    """Map an indexation of the company's rule to the nearest action."""
    most = company.lawful_indexation()
    return nearest(INDEXATIONS, indexation / most) if most > 0 else 0


def lawful_indexations(company: Company) -> list[bool]:
    """Mask all levels but zero where no indexation is lawful."""
    some = company.lawful_indexation() > 0
    return [level == 0 or some for level in INDEXATIONS]


def cut(action: Any, *call: Any) -> float:
    """Map an action to a cut, or a demanded cut: a share of the shortfall."""
    return CUTS[action] * company_of(*call).shortfall()


def was_cut(decided: float, *call: Any) -> int:
    """Map a cut of a rule to the nearest action."""
    shortfall = company_of(*call).shortfall()
    return nearest(CUTS, decided / shortfall) if shortfall > 0 else 0


def mixed(equities: float) -> int:
    """Map a share of equities of the manager's rule to the nearest action."""
    return nearest(MIXES, equities)


def lawful_mixes(manager: Manager) -> list[bool]:
    """Mask shares of equities above the lawful one; a share of zero is always lawful."""
    most = manager.lawful_mix()
    return [level <= most for level in MIXES]


PREMIUMS: Final[dict[Any, Definition]] = {
    f"{Company.__module__}.Company.set_premium": make_step(
        observation_space=CLIENT_SPACE,
        observation_space_mapping=observe_client,
        action_space=Discrete(len(SURCHARGES)),
        apply=ask_premium,
        action_mask_mapping=lawful_surcharges,
        rule_action_mapping=premium_asked,
        reward_mapping=premium_reward,
        agent=agent_of,
        question="Which premium does the company ask, as a share of the cost rate?",
        display_mapping=display_client,
        action_labels=[f"{100 * level:g} %" for level in SURCHARGES],
        removed_by={
            f"{Client.__module__}.Client.{event}": agent_of for event in ("vanish", "retire")
        },
    )
}
"""The premiums: one agent per client."""


def decision(agent: str, levels: Sequence[float], question: str, **mappings: Any) -> Definition:
    """Define a decision of the team among levels."""
    return make_step(
        question=question,
        display_mapping=display,
        action_labels=[f"{100 * level:g} %" for level in levels],
        observation_space=SPACE,
        observation_space_mapping=observe,
        action_space=Discrete(len(levels)),
        reward_mapping=welfare,
        agent=agent,
        **mappings,
    )


TEAM: Final[dict[Any, Definition]] = {
    f"{Company.__module__}.Company.choose_indexation": decision(
        "indexer_0",
        INDEXATIONS,
        "By how much of the highest lawful indexation do the rights grow?",
        apply=index,
        action_mask_mapping=lawful_indexations,
        rule_action_mapping=indexed,
    ),
    f"{Company.__module__}.Company.choose_cut": decision(
        "planner_0",
        CUTS,
        "By how much of the shortfall does the plan cut the rights?",
        apply=cut,
        rule_action_mapping=was_cut,
    ),
    f"{Manager.__module__}.Manager.choose_mix": decision(
        "manager_0",
        MIXES,
        "Which share of the investments are equities?",
        action_space_mapping=dict(enumerate(MIXES)),
        action_mask_mapping=lawful_mixes,
        rule_action_mapping=mixed,
    ),
    f"{Regulator.__module__}.Regulator.choose_demand": decision(
        "regulator_0",
        CUTS,
        "Which cut does the regulator demand, as a share of the shortfall?",
        apply=cut,
        rule_action_mapping=was_cut,
    ),
}
"""Indexation in good years, cuts in a shortfall, the asset mix, and the regulator's demand."""


# -- the simulation -------------------------------------------------------------------------------


class FundSim(SimulationInterface):
    """A pension fund over a number of years, or until it cannot pay all pensions."""

    points = TEAM

    def __init__(self, years: int = YEARS, parameters: Parameters | None = None) -> None:
        """Make a simulation of so many years; without parameters, of ``CLIENTS`` clients."""
        self.years = years
        self.parameters = parameters or Parameters(clients=CLIENTS)
        self.fund = Fund(0, replace(self.parameters, clients=0))
        self.account = Account(self.fund)
        self._stopped = False

    def reset(self, seed: int | None = None) -> None:
        """Create a new fund."""
        self._stopped = False
        self.fund = Fund(seed, self.parameters)
        self.account = Account(self.fund)

    def run(self) -> Any:
        """Simulate months until the last year ends or the fund cannot pay all pensions."""
        fund = self.fund
        while fund.world.month < 12 * self.years:
            if self._stopped:
                return None
            if fund.company.rations:
                self.account.close_for_ever(self.years - self.time())
                return None
            fund.advance()
            if fund.world.month % 12 == 0:
                self.account.close_year()
        fund.world.check()
        return TRUNCATED

    def stop(self) -> None:
        """Ask the loop to end after the current month."""
        self._stopped = True

    def time(self) -> float:
        """The time in years."""
        return self.fund.world.month / 12

    def welfare(self) -> float:
        """The members' welfare: see the module ``welfare``."""
        return self.account.welfare()

    def reseed(self, seed: int) -> None:
        """Draw another future, for the market and for the people."""
        fund = self.fund
        fund.market.random.seed(f"{seed}/market")
        fund.people.seed(f"{seed}/people")

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """Return the calls to come at a point: of the company, its manager and its regulator."""
        company = self.fund.company
        callers = {
            "Company": (company,),
            "Manager": (company.manager,),
            "Regulator": (company.regulator, company),
        }
        kind, name = point.split(".")[-2:]
        return [] if name == "set_premium" else [callers[kind]]


# -- environments: their options are those of the library's functions ------------------------------


def team_env(simulation: Any = FundSim, **options: Any) -> SimulationAECEnv:
    """Make the environment of the company's, the manager's and the regulator's decisions."""
    return aec_env(simulation, TEAM, **options)


def premium_env(simulation: Any = FundSim, **options: Any) -> SimulationAECEnv:
    """Make the environment with one agent per client, which decides on the client's premium."""
    return aec_env(simulation, PREMIUMS, **options)


register_simulation(FundSim, TEAM, name="fin_base")
known = getattr(pettingzoo, "aec_registry", None)  # since PettingZoo 1.26, and with "-" for "_"
if known is not None and "fin_base/premium-v0" not in known:
    pettingzoo.register("aec", "fin_base/premium_v0", f"{__name__}:premium_env")
