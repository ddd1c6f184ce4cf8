"""Environments made from the pension fund: agents for its decisions, with observations, actions and rewards.

The model itself does not refer to this module: the module names the model's methods as decision points.

- ``COMPANY``, ``MANAGER``, ``REGULATOR``: single agents. ``indexer_0`` and ``planner_0`` decide once a year on
  indexation and cuts, ``manager_0`` each quarter on the asset mix, ``regulator_0`` on what recovery plans must contain.
  Their rewards differ and partly conflict: see ``REWARDS``.
- ``TEAM``: the same agents with a common reward: the gain in the members' welfare, as ``welfare`` defines it.
- ``PREMIUMS``: each client is an agent, which decides once a year on its own premium *on behalf of the company*; all
  these agents can share one policy. The agent ends when the client retires, leaves or dies.
- ``FundSim``: the simulation: a fund over a number of years. Its time is in years, and so is the time in infos.

``premium_env``, ``board_env``, ``team_env`` and ``mix_env`` make environments from these. The last one is goal-based:
the goal is a coverage, and transitions can be relabelled with another goal. Importing this
module registers all of them: see ``_register``.

Masks exclude the actions that the law forbids: discounts on premiums without the coverage for them, indexation below
110 %, more risk in a shortfall. An action that is not masked can still be denied: a recovery plan that cuts less than
the regulator demands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import log
from typing import Any, Final

import gymnasium
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
    single_env,
)
from simenv_marl.envs import SimulationAECEnv, SimulationEnv

from .company import Company, Manager, Regulator
from .law import MINIMUM, REQUIRED, SPREAD
from .observations import CLIENT_SPACE, HIGH, LOW, SPACE, company_of, look_at, observe, observe_client
from .pension import Fund, Parameters
from .people import Client
from .welfare import Account

YEARS: Final = 40
"""The number of years after which an episode is truncated."""

CLIENTS: Final = 1000
"""The default number of clients at the start."""

SURCHARGES: Final = (0.8, 0.9, 1.0, 1.05, 1.15, 1.3)
"""Premiums to choose from, relative to the cost of the client's accrual."""

INDEXATIONS: Final = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Indexations to choose from, relative to the highest lawful one."""

CUTS: Final = (0.0, 0.5 / SPREAD, 1 / SPREAD, 3 / SPREAD, 1.0)
"""Cuts to choose from, relative to the shortfall: for the company's plans and for the regulator's demands."""

MIXES: Final = (0.0, 0.2, 0.3, 0.4, 0.6, 0.8)
"""Shares of equities to choose from."""


# -- rewards --------------------------------------------------------------------------------------


@difference
def purchasing_power(*call: Any) -> float:
    """The logarithm of the purchasing power of a right that was 1 in the first month."""
    company = company_of(*call)
    return log(max(company.indexed / company.market.price_level, 1e-9))


@difference
def gain_of_coverage(*call: Any) -> float:
    """The coverage."""
    return company_of(*call).coverage()


@difference
def welfare(*call: Any, _simulation: FundSim) -> float:
    """The welfare of the members: see the module ``welfare``."""
    return _simulation.welfare()


def sound(company: Company) -> float:
    """Return 1 for a company without a shortfall; with one, subtract ten times the gap to the minimum coverage."""
    coverage = company.policy_coverage()
    return 1.0 if coverage >= MINIMUM else 1.0 - 10 * (MINIMUM - coverage)


def company_reward(*call: Any) -> float:
    """Reward soundness, and pensions that keep their value: one per cent of value counts a tenth of a sound year."""
    return sound(company_of(*call)) + 10 * float(purchasing_power(*call))


def manager_reward(*call: Any) -> float:
    """Reward a gain in coverage."""
    return float(gain_of_coverage(*call))


def regulator_reward(*call: Any) -> float:
    """Reward years without a shortfall, regardless of the pensions."""
    return sound(company_of(*call))


def premium_reward(company: Company, client: Client) -> float:
    """Reward soundness less the premium: a premium of ten per cent of the wage costs a fifth of a sound year."""
    return sound(company) - 2 * client.premium


REWARDS: Final = {
    "indexer_0": company_reward,
    "planner_0": company_reward,
    "manager_0": manager_reward,
    "regulator_0": regulator_reward,
}
"""The company: soundness *and* the pensions' value. The manager: gains. The regulator: soundness."""


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
        agent=lambda company, client: client.name,
        removed_by={
            f"{Client.__module__}.Client.vanish": lambda client, *rest, **more: client.name,
            f"{Client.__module__}.Client.retire": lambda client: client.name,
        },
    )
}
"""The premiums: one agent per client."""

COMPANY: Final[dict[Any, Definition]] = {
    f"{Company.__module__}.Company.choose_indexation": make_step(
        observation_space=SPACE,
        observation_space_mapping=observe,
        action_space=Discrete(len(INDEXATIONS)),
        apply=index,
        action_mask_mapping=lawful_indexations,
        rule_action_mapping=indexed,
        reward_mapping=company_reward,
        agent="indexer_0",
    ),
    f"{Company.__module__}.Company.choose_cut": make_step(
        observation_space=SPACE,
        observation_space_mapping=observe,
        action_space=Discrete(len(CUTS)),
        apply=cut,
        rule_action_mapping=was_cut,
        reward_mapping=company_reward,
        agent="planner_0",
    ),
}
"""The company's yearly decisions: indexation in good years, cuts in a shortfall."""

MANAGER: Final[dict[Any, Definition]] = {
    f"{Manager.__module__}.Manager.choose_mix": make_step(
        observation_space=SPACE,
        observation_space_mapping=observe,
        action_space=Discrete(len(MIXES)),
        action_space_mapping=dict(enumerate(MIXES)),
        action_mask_mapping=lawful_mixes,
        rule_action_mapping=lambda equities: nearest(MIXES, equities),
        reward_mapping=manager_reward,
        agent="manager_0",
    )
}
"""The asset mix, each quarter."""

REGULATOR: Final[dict[Any, Definition]] = {
    f"{Regulator.__module__}.Regulator.choose_demand": make_step(
        observation_space=SPACE,
        observation_space_mapping=observe,
        action_space=Discrete(len(CUTS)),
        apply=cut,
        rule_action_mapping=was_cut,
        reward_mapping=regulator_reward,
        agent="regulator_0",
    )
}
"""The regulator's demand in a shortfall."""

BOARD: Final[dict[Any, Definition]] = COMPANY | MANAGER | REGULATOR
"""All single agents, each with a reward of its own."""

TEAM: Final[dict[Any, Definition]] = {
    point: replace(definition, reward_mapping=welfare) for point, definition in BOARD.items()
}
"""The same agents, with the gain in the members' welfare as their common reward."""

GOALS: Final = Box(0.0, 10.0, (1,), np.float32)


def reach(achieved: Any, desired: Any, info: Any) -> Any:
    """Compute the reward: minus the distance to the desired coverage, for one step or for a batch."""
    return -np.abs(np.asarray(achieved) - np.asarray(desired)).max(axis=-1)


def coverage_of(manager: Manager) -> list[float]:
    """Return the achieved goal: the coverage, at most 10."""
    return [min(manager.company.coverage(), 10.0)]


MIX_WITH_GOAL: Final[dict[Any, Definition]] = {
    point: replace(
        definition,
        reward_mapping=lambda manager: float(reach(coverage_of(manager), [REQUIRED], None)),
        goal_space=GOALS,
        achieved_goal_mapping=coverage_of,
        desired_goal_mapping=lambda manager: [REQUIRED],
        compute_reward=reach,
    )
    for point, definition in MANAGER.items()
}
"""The asset mix, with the required coverage as the goal."""


# -- the simulation -------------------------------------------------------------------------------


class FundSim(SimulationInterface):
    """A pension fund over a number of years, or until it cannot pay all pensions.

    Attributes:
        fund: The fund of the current episode.
        account: The account of its members' welfare.
    """

    points = BOARD

    def __init__(self, years: int = YEARS, parameters: Parameters | None = None) -> None:
        """Make a simulation.

        Args:
            years: The number of years after which an episode is truncated.
            parameters: The fund's parameters; None: the model's defaults, with ``CLIENTS`` clients.
        """
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
        """Simulate months until the last year ends or the fund cannot pay all pensions.

        Returns:
            ``TRUNCATED`` if the fund has paid all pensions to the end, else None.
        """
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
        fund.world.random.seed(seed)
        fund.market.random.seed(f"{seed}/market")
        fund.people.seed(f"{seed}/people")

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """Return the calls to come at a decision point: those of the company, its manager and its regulator."""
        company = self.fund.company
        callers = {"Company": (company,), "Manager": (company.manager,), "Regulator": (company.regulator, company)}
        kind, name = point.split(".")[-2:]
        return [] if name == "set_premium" else [callers[kind]]

    def state(self) -> NDArray[np.float32]:
        """Return the observation of the company, the distribution of rights over age groups of ten years, and time."""
        company = self.fund.company
        ages = [0.0] * 12
        for client in self.fund.clients:
            ages[min(client.age // 120, 11)] += client.accrued
        total = sum(ages) or 1.0
        return np.array([*look_at(company), *(rights / total for rights in ages), self.time() / self.years], np.float32)


STATE_SPACE: Final = Box(np.array([*LOW, *[0] * 13], np.float32), np.array([*HIGH, *[1] * 13], np.float32))
"""The space of the state."""


# -- environments ---------------------------------------------------------------------------------


def board_env(simulation: Any = FundSim, **options: Any) -> SimulationAECEnv:
    """Make the environment of the company's, the manager's and the regulator's decisions, with different rewards.

    Args:
        simulation: The simulation.
        **options: The options of ``simenv_marl.aec_env``.
    """
    return aec_env(simulation, BOARD, **{"state_space": STATE_SPACE, **options})


def team_env(simulation: Any = FundSim, **options: Any) -> SimulationAECEnv:
    """Make the same environment with a common reward.

    Args:
        simulation: The simulation.
        **options: The options of ``simenv_marl.aec_env``.
    """
    return aec_env(simulation, TEAM, **{"state_space": STATE_SPACE, **options})


def premium_env(simulation: Any = FundSim, **options: Any) -> SimulationAECEnv:
    """Make the environment with one agent per client, which decides on the client's premium.

    Args:
        simulation: The simulation.
        **options: The options of ``simenv_marl.aec_env``.
    """
    return aec_env(simulation, PREMIUMS, **{"state_space": STATE_SPACE, **options})


def mix_env(simulation: Any = FundSim, **options: Any) -> SimulationEnv:
    """Make the goal-based environment of the asset mix.

    Args:
        simulation: The simulation.
        **options: The options of ``simenv_marl.single_env``.
    """
    return single_env(simulation, MIX_WITH_GOAL, **options)


def _register() -> None:
    """Enter the environments into the registries of Gymnasium and PettingZoo.

    The team is ``fin_base/coop_v0`` (AEC and parallel) and ``fin_base/Joint-v0``, each of its agents alone
    ``fin_base/ChooseMix-v0`` and so on; the others are ``fin_base/board_v0``, ``fin_base/premium_v0`` and
    ``fin_base/MixWithGoal-v0``.
    """
    register_simulation(FundSim, TEAM, name="fin_base", state_space=STATE_SPACE)
    if "fin_base/MixWithGoal-v0" not in gymnasium.registry:
        gymnasium.register("fin_base/MixWithGoal-v0", f"{__name__}:mix_env")
    known = getattr(pettingzoo, "aec_registry", None)  # since PettingZoo 1.26, and with "-" for "_"
    for name in ("board", "premium"):
        if known is not None and f"fin_base/{name}-v0" not in known:
            pettingzoo.register("aec", f"fin_base/{name}_v0", f"{__name__}:{name}_env")


_register()
