"""The inventory networks of gym-invmgmt as simulations, and an (s, S) rule for them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from gym_invmgmt import CoreEnv
from gymnasium import spaces
from numpy.typing import NDArray

from simenv_marl import TRUNCATED, make_step

PERIODS: Final = 30

QUANTILE: Final = 1.645
"""The safety stock in standard deviations: 95 % of the demand of a lead time are met."""

MOST: Final = 500.0
"""The largest order of a link."""


class Warehouse:
    """A network, in which one agent orders for all links in each period."""

    network, demand = "serial", "seasonal"
    shock, goodwill, backlog = False, False, True

    def reset(self, seed: int | None = None) -> None:
        """Begin an episode."""
        demand: dict[str, Any] = {"type": "stationary", "base_mu": 20}
        if self.demand == "seasonal":
            effects = ["trend", "seasonal", *(["shock"] if self.shock else [])]
            demand |= {"type": "combined_chaos", "effects": effects}
        self.model: Any = CoreEnv(
            scenario=self.network,
            demand_config=demand | {"use_goodwill": self.goodwill},
            num_periods=PERIODS,
            backlog=self.backlog,
        )
        self.model.reset(seed=seed)

    def reseed(self, seed: int) -> None:
        """Draw the demand anew. The engine of the demand has the generator of the environment."""
        generator = np.random.default_rng(seed)
        self.model.np_random.bit_generator.state = generator.bit_generator.state

    def run(self) -> Any:
        """Run all periods."""
        for _ in range(PERIODS):
            self.model.step(self.order())
        return TRUNCATED

    def time(self) -> float:
        """Return the number of the period."""
        return float(self.model.period)

    @property
    def profit(self) -> float:
        """The profit so far."""
        return float(self.model.P[: self.model.period].sum())

    @make_step(
        observation_space=spaces.Box(0, 1, (1,), np.float32),
        observation_space_mapping=lambda: [0.0],  # policies look at the network itself
        action_space=spaces.Box(0.0, MOST, (11,), np.float64),
        apply=lambda action, warehouse: action[: len(warehouse.model.network.reorder_links)],
        reward_mapping=lambda: 0.0,
        agent="planner",
    )
    def order(self) -> NDArray[np.float64]:
        """Order by the (s, S) rule."""
        links = len(self.model.network.reorder_links)
        return RULE_ORDERS(None, _simulation=self)[:links]


@dataclass(frozen=True)
class Orders:
    """An (s, S) rule: a node whose position is below s orders up to S.

    It is informed: it knows the mean demand of each period. s is the demand of the lead time with a
    safety stock, S is s and the lot of the square-root formula, with costs of an order of ten
    times the holding costs; each is multiplied by a factor.

    Attributes:
        factors: The factors of s by node. 1 where there is none.
        lots: The factors of the lots by node. 1 where there is none.
        shares: The factors of the shares of suppliers by link. 1 where there is none.
    """

    factors: Mapping[int, float] = field(default_factory=dict)
    lots: Mapping[int, float] = field(default_factory=dict)
    shares: Mapping[int, float] = field(default_factory=dict)

    def __call__(self, observation: Any, *, _simulation: Warehouse) -> NDArray[np.float64]:
        """Return the orders of all links."""
        model, orders = _simulation.model, np.zeros(11)
        network, now = model.network, model.period
        for node in network.main_nodes:
            links = [n for n, link in enumerate(network.reorder_links) if link[1] == node]
            edges = [model.graph.edges[network.reorder_links[link]] for link in links]
            if not links:
                continue
            position = model.X[now, network.node_map[node]] + model.Y[now, links].sum()
            if model.backlog and now and node in network.retail:
                position -= sum(
                    model.U[now - 1, number]
                    for (seller, _), number in network.retail_map.items()
                    if seller == node
                )
            span = range(now, now + max(edge["L"] for edge in edges) + 1)
            means = [model.demand_engine.get_current_mu(period) for period in span]
            low = sum(means) + QUANTILE * np.sqrt(sum(max(mean, 1.0) for mean in means))
            low *= self.factors.get(node, 1.0)
            holding = max(model.graph.nodes[node].get("h", 0.1), 1e-9)
            setup = 10 * holding
            if node in network.factory:
                setup = 10 * model.graph.nodes[node].get("o", 0.01)
            lot = np.sqrt(2 * means[0] * setup / holding) * self.lots.get(node, 1.0)
            if position < low:
                weights = np.array([1 / (1 + edge["p"] + 0.1 * edge["L"]) for edge in edges])
                weights *= [self.shares.get(link, 1.0) for link in links]
                orders[links] = (low + lot - position) * weights / max(weights.sum(), 1e-9)
        return orders.clip(0.0, MOST)


RULE_ORDERS: Final = Orders()
"""The rule of the simulation, all of whose factors are 1."""
