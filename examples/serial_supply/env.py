"""A serial supply chain of the package stockpyl, unmodified, as an environment.

Three stages pass goods on to a customer: stage 3 buys from a supplier that is never out of stock,
stage 2 from stage 3, stage 1 from stage 2. In each period the customer's demand arrives at stage 1,
and the stages order one after the other, from stage 1 on. What cannot be delivered is delivered
later. Each stage pays for what it holds and has sent off; stage 1 also pays for late deliveries.

**Exact optimum.** The chain is example 6.1 of Snyder and Shen, *Fundamentals of Supply Chain
Theory*. Base stocks are optimal (Clark and Scarf, 1960): each stage orders until its echelon
position, which is all the stock from its supplier to the customer, reaches a level. ``OPTIMAL`` has
these levels, and ``OPTIMUM`` their long-run cost per period.

**Rule.** Each stage orders up to the mean demand of its lead time, so it has no safety stock.

**Orders.** A stage has room for one and a half times the mean demand of its lead time, and orders
no more than it has room for. With more room, training may stand still: if stages 1 and 2 order all
that there is, stages 2 and 3 have nothing left, and somewhat smaller orders change nothing. Without
a limit, this costs 10 % more than the optimum, with this one 3 to 4 %.

**Observations.** Five numbers for each stage, all in periods of mean demand (see ``look``). They do
not depend on the orders of the same period. So a stage sees the same in all views.

**Rewards.** A stage's own costs since its previous decision. The option ``team_reward=profit``
rewards the costs of the whole chain instead. Both are in units of ``UNIT``.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, Final

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray
from stockpyl.instances import load_instance
from stockpyl.policy import Policy
from stockpyl.sim import close, simulation

from simenv_marl import TRUNCATED, Definition, SimulationInterface, difference, make_step

PERIODS: Final = 100
"""The length of an episode."""

STAGES: Final = ("stage_1", "stage_2", "stage_3")
"""The agents, in the order of their decisions."""

DEMAND: Final = 5.0
"""The mean demand of a period. Its standard deviation is 1."""

LEAD_TIMES: Final = (1, 1, 2)
"""The number of periods for which goods travel to each stage."""

RULE_LEVELS: Final = tuple(DEMAND * time for time in LEAD_TIMES)
"""The local base stocks of the rule."""

OPTIMAL: Final = (6.48, 12.03, 22.72)
"""The optimal echelon base stocks."""

OPTIMUM: Final = 47.665
"""The expected cost of a period with optimal base stocks."""

FIRST_STOCKS: Final = (6.48, 5.55, 10.69)
"""The first stocks: the optimal base stocks, as local ones, so that episodes begin calmly."""

UNIT: Final = 250.0
"""The unit of rewards: with it, the values that learners estimate are about 1."""

MOST: Final = 2 * DEMAND
"""The largest order."""

ROOM: Final = tuple(1.5 * level for level in RULE_LEVELS)
"""The largest local position of each stage."""

QUANTITIES: Final = tuple(number / 2 for number in range(21))
"""The orders of ``few_orders``."""

FARTHEST: Final = 5.0
"""The bound of observations, in periods of mean demand: runs with bad policies go astray."""


class SerialSupply(SimulationInterface):
    """The chain for a limited time.

    Attributes:
        network: stockpyl's model.
        nodes: The stages, from the customer's on.
    """

    points: ClassVar[Mapping[Any, Definition]]

    def reset(self, seed: int | None = None) -> None:
        """Begin with the optimal stocks."""
        self.network: Any = load_instance("example_6_1")
        self.nodes = [self.network.nodes_by_index[number] for number in range(1, len(STAGES) + 1)]
        for node, level, stock in zip(self.nodes, RULE_LEVELS, FIRST_STOCKS, strict=True):
            node.inventory_policy.base_stock_level = level
            node.initial_inventory_level = stock  # else stockpyl asks the policy for it
        self._seed = seed

    def run(self) -> Any:
        """Run stockpyl's loop. The chain has no end, so the limit truncates."""
        options = {"rand_seed": self._seed, "progress_bar": False, "consistency_checks": "N"}
        simulation(self.network, PERIODS, **options)
        self.network.period += 1  # the last observations are of the next period's beginning
        return TRUNCATED

    def expected_calls(self, point: str) -> list[tuple[Any, ...]]:
        """Return the calls of a period, so that stages are observed before their first order.

        Nobody observes the second argument, the local position.
        """
        return [(node.inventory_policy, 0.0) for node in self.nodes]

    def time(self) -> float:
        """Return the number of the period."""
        return float(self.network.period)

    def cost_of(self, stage: int) -> float:
        """Return the costs of a stage so far. Stages count from 0."""
        return float(sum(period.total_cost_incurred for period in self.nodes[stage].state_vars))

    @property
    def cost(self) -> float:
        """The costs of all stages so far."""
        return float(close(self.network))

    @property
    def demand(self) -> float:
        """The customer's demand in this period; its mean where it is not known yet."""
        return float(self.nodes[0].state_vars_current.get_inbound_order() or DEMAND)

    def position(self, stage: int) -> float:
        """Return a stage's echelon position: all stock down to the customer, less the demand."""
        states = [node.state_vars_current for node in self.nodes[: stage + 1]]
        stock = sum(
            each.get_inventory_level() + each.get_on_order_by_predecessor() for each in states
        )
        ordered = sum(each.get_inbound_order() for each in states[1:])
        return float(stock - ordered - self.demand)


def look(policy: Policy, *, _simulation: SerialSupply) -> NDArray[np.float32]:
    """Observe a stage, in periods of mean demand.

    Returns:
        Echelon position and local position, each less the mean demand of the lead time; stock on
        hand less what is owed to the next stage; goods on their way; the customer's demand.
    """
    stage = policy.node.index - 1
    state = policy.node.state_vars_current
    stock = state.get_inventory_level()
    local = stock + state.get_on_order_by_predecessor()
    seen = np.array(
        [
            _simulation.position(stage) / DEMAND - sum(LEAD_TIMES[: stage + 1]),
            local / DEMAND - LEAD_TIMES[stage],
            stock / DEMAND,
            state.in_transit_from() / DEMAND - LEAD_TIMES[stage],
            _simulation.demand / DEMAND - 1,
        ],
        np.float32,
    )
    return seen.clip(-FARTHEST, FARTHEST)


OBSERVED: Final = (
    "echelon position, less the demand of its lead time",
    "local position, less the demand of its lead time",
    "stock, less what is owed",
    "on the way, less the demand of its lead time",
    "demand, less its mean",
)
"""The labels of the observation, which counts in periods of mean demand."""


def display(policy: Policy, *, _simulation: SerialSupply) -> dict[str, float]:
    """Return what people and language models read in place of the observation."""
    state = policy.node.state_vars_current
    return {
        "your stock, less what you owe": float(state.get_inventory_level()),
        "on its way to you": float(state.in_transit_from()),
        "ordered in all": float(state.get_on_order_by_predecessor()),
        "demand of the customers": _simulation.demand,
    }


_own = difference(lambda policy, _simulation: -_simulation.cost_of(policy.node.index - 1) / UNIT)


def own_costs(policy: Policy, *, _simulation: SerialSupply) -> float:
    """Reward a stage's own costs since its previous decision."""
    return float(_own(policy, _simulation))


def place(action: Any, policy: Policy, position: float) -> float:
    """Return the quantity that a stage orders: as much as it wants and has room for."""
    room = ROOM[policy.node.index - 1] - position
    return float(max(0.0, min(np.ravel(action)[0], room)))


order = make_step(
    agent=lambda policy: STAGES[policy.node.index - 1],
    observation_space=Box(-FARTHEST, FARTHEST, (5,), np.float32),
    observation_space_mapping=look,
    action_space=Box(0.0, MOST, (1,), np.float32),
    apply=place,
    reward_mapping=own_costs,
    rule_action_mapping=lambda quantity: [min(quantity, MOST)],
    question="How much do you order from the stage before you?",
    display_mapping=display,
    action_labels=["quantity"],
    observation_labels=OBSERVED,
)
"""A stage's order, up to twice the mean demand."""

few_orders = replace(
    order,
    action_space=Discrete(len(QUANTITIES)),
    apply=lambda action, policy, position: place(QUANTITIES[action], policy, position),
    rule_action_mapping=lambda quantity: min(round(2 * quantity), len(QUANTITIES) - 1),
    action_labels=[f"{quantity:g}" for quantity in QUANTITIES],
)
"""The same in steps of half a unit, for learners of discrete actions."""

POINT: Final = "stockpyl.policy.Policy._get_order_quantity_base_stock"

SerialSupply.points = {POINT: order}

OPTIONS: Final[dict[str, Any]] = {"possible_agents": STAGES, "global_rng": True}
"""Options of all environments: stockpyl draws from NumPy's global generator."""

profit = difference(lambda chain: -chain.cost / UNIT)
"""The reward of the team, for the option ``team_reward``."""

DISCRETE: Final = {POINT: few_orders}
"""The decision in steps, for learners of discrete actions."""


def base_stocks(levels: tuple[float, ...] = OPTIMAL) -> dict[str, Any]:
    """Return policies that order up to echelon base stocks."""

    def policy(stage: int) -> Any:
        target = levels[stage] / DEMAND - sum(LEAD_TIMES[: stage + 1])
        return lambda seen: (DEMAND * (target - np.asarray(seen)[..., :1])).clip(0, MOST)

    return {name: policy(stage) for stage, name in enumerate(STAGES)}
