"""The environments of the bakery. Importing this module registers them."""

import numpy as np
from bakery import Bakery
from gymnasium import spaces

from simenv_marl import SimulationInterface, difference, make_step, register_simulation

batch = make_step(
    observation_space=spaces.Box(0, 100, (2,), np.float32),
    observation_space_mapping=lambda shop: [shop.day % 7, shop.asked],
    action_space=spaces.Discrete(5),
    action_space_mapping={0: 20, 1: 30, 2: 40, 3: 50, 4: 60},
    reward_mapping=difference(lambda shop: shop.cash),
    agent="baker_0",
)

price = make_step(
    observation_space=spaces.Box(0, 100, (2,), np.float32),
    observation_space_mapping=lambda shop: [shop.day % 7, shop.loaves],
    action_space=spaces.Discrete(3),
    apply=lambda action, shop: setattr(shop, "price", (2.5, 3.0, 3.5)[action]),
    reward_mapping=difference(lambda shop: shop.cash),
    agent="seller_0",
)

decisions = {"bakery.Bakery.choose_batch": batch, "bakery.Bakery.set_price": price}


class FourWeeks(SimulationInterface):
    """Four weeks of a bakery."""

    points = decisions

    def reset(self, seed=None):
        """Open a new bakery."""
        self.shop = Bakery(seed)

    def run(self):
        """Simulate 28 days."""
        while self.shop.day < 28:
            self.shop.update_day()


register_simulation(FourWeeks, name="bakery")
