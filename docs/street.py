"""Self-play: two shops on a street choose prices, against a growing pool of opponents."""

from itertools import product

import numpy as np
from gymnasium import spaces

from simenv_marl import RULE, difference, evaluate, make_step, single_env
from simenv_marl.data import OpponentPool

WEEKS = 20


class Street:
    """Each week, the shops set their prices in turn, and forty customers choose a shop."""

    def reset(self, seed=None):
        """Begin with equal prices."""
        self.random = np.random.default_rng(seed)
        self.prices, self.profits = [4.0, 4.0], [0.0, 0.0]

    def run(self):
        """Sell for some weeks."""
        for _ in range(WEEKS):
            for shop in (0, 1):
                self.prices[shop] = self.choose_price(shop)
            first, second = self.prices
            buyers = self.random.binomial(40, 1 / (1 + np.exp(2 * (first - second))))
            self.profits[0] += buyers * (first - 1)
            self.profits[1] += (40 - buyers) * (second - 1)

    def profit(self, shop):
        """Return the profit of a shop so far."""
        return self.profits[shop]

    @make_step(
        observation_space=spaces.Box(1, 6, (2,), np.float32),
        observation_space_mapping=lambda street, shop: [
            street.prices[shop],
            street.prices[1 - shop],
        ],
        action_space=spaces.Discrete(10),
        action_space_mapping=lambda action: 1.5 + 0.5 * int(action),
        reward_mapping=difference(lambda street, shop: street.profits[shop]),
        agent=lambda street, shop: f"shop_{shop}",
    )
    def choose_price(self, shop):
        """Keep the price of the shop."""
        return self.prices[shop]

    points = (choose_price,)


def train(generations=3, steps=8_000):
    """Train a shop by PPO. After each generation, its policy joins its opponents."""
    from stable_baselines3 import PPO

    pool = OpponentPool([RULE])
    env = single_env(Street, agent="shop_0", policies={"shop_1": pool})
    for generation in range(generations):
        learner = PPO("MlpPolicy", env, n_steps=500, batch_size=125, seed=generation)
        learner.learn(steps)
        pool.add(
            lambda seen, model=learner: model.predict(seen, deterministic=True)[0],
            weight=2.0**generation,
        )
    return pool


def rate(policies, seeds):
    """Return the mean profit of each policy against each, on the same seeds."""
    pairs = {
        f"{first} against {second}": {"shop_0": policies[first], "shop_1": policies[second]}
        for first, second in product(policies, repeat=2)
    }
    found = evaluate(Street, pairs, seeds=seeds, metric={"profit": lambda street: street.profit(0)})
    means = found.summary(metric="profit")["mean"].to_numpy(float)
    return means.reshape(len(policies), -1)


if __name__ == "__main__":
    pool = train()
    names = ["rule", *(f"generation {number}" for number in range(1, len(pool.policies)))]
    print(rate(dict(zip(names, pool.policies, strict=True)), seeds=range(50)).round())
