"""From a model to PPO, in one file. Needs simenv-marl and stable-baselines3."""

from random import Random

from gymnasium.spaces import Box, Discrete
from stable_baselines3 import PPO

from simenv_marl import difference, make_step, simulate, single_env


class Shop:
    """The model. It knows nothing of reinforcement learning."""

    def __init__(self, seed):
        self.random, self.stock, self.sold, self.cash = Random(seed), 10, 10, 0

    def choose_order(self):
        return self.sold  # the model's own rule: order what was sold yesterday

    def update_day(self):
        ordered = self.choose_order()
        self.stock += ordered
        self.sold = min(self.stock, self.random.randint(0, 20))
        self.stock -= self.sold
        self.cash += 3 * self.sold - ordered - self.stock  # sales - purchases - storage


class Quarter:
    """The simulation: what one episode is."""

    def reset(self, seed=None):
        self.shop = Shop(seed)

    def run(self):
        for _ in range(90):
            self.shop.update_day()


points = {
    Shop.choose_order: make_step(  # what the agent observes, does and earns
        observation_space=Box(0, 100, (1,)),
        observation_space_mapping=lambda shop: [shop.stock],
        action_space=Discrete(5),
        action_space_mapping={0: 0, 1: 5, 2: 10, 3: 15, 4: 20},
        reward_mapping=difference(lambda shop: shop.cash),
        agent="buyer_0",
    )
}

if __name__ == "__main__":
    env = single_env(Quarter, points)  # a gymnasium.Env
    ppo = PPO("MlpPolicy", env, learning_rate=1e-3, gamma=0.9, seed=0)
    ppo.learn(20_000)

    def buy(observation):
        return ppo.predict(observation, deterministic=True)[0]

    for name, policies in {"rule": {}, "PPO": {"buyer_0": buy}}.items():
        ends = [simulate(Quarter, policies, points=points, seed=n) for n in range(100, 110)]
        print(f"{name:4} earns {sum(end.shop.cash for end in ends) / 10:.0f} a quarter")
