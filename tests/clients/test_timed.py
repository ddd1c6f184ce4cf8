"""Buffers of Stable-Baselines3 that discount each transition by its own time."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.vec_env import DummyVecEnv

from simenv_marl import TRUNCATED, make_step, single_env
from simenv_marl.data import TimedReplayBuffer, TimedRolloutBuffer
from simenv_marl.errors import OptionValueError

RATE = 0.1


class Visits:
    """Decisions at irregular times, of which one in two episodes is truncated."""

    space = spaces.Box(-10, 10, (2,), np.float32)

    def reset(self, seed=None):
        self.random = np.random.default_rng(seed)
        self.now = 0.0

    def time(self):
        return self.now

    def run(self):
        for _ in range(self.random.integers(2, 6)):
            self.choose()
            self.now += self.random.exponential()
        return self.random.choice([TRUNCATED, None])

    def look(self):
        return self.random.normal(size=2).clip(-10, 10)

    definition = make_step(
        observation_space=space,
        observation_space_mapping=lambda visits: visits.look(),
        action_space=spaces.Discrete(3),
        action_space_mapping=int,
        reward_mapping=lambda visits: visits.now,
        agent="nurse",
    )

    @definition
    def choose(self):
        return 0


class Masked(Visits):
    """The same where one action is illegal."""

    @replace(Visits.definition, action_mask_mapping=lambda visits: [1, 1, 0])
    def choose(self):
        return 0


class Named(Visits):
    """The same with observations of a ``Dict``."""

    @replace(
        Visits.definition,
        observation_space=spaces.Dict({"seen": Visits.space}),
        observation_space_mapping=lambda visits: {"seen": visits.look()},
    )
    def choose(self):
        return 0


def vector(simulation=Visits, number=2, **options):
    options = {"discount_rate": RATE, **options}
    points = [simulation.choose]
    return DummyVecEnv([lambda: single_env(simulation, points, **options)] * number)


def expected_returns(buffer, last_values, dones):
    """Advantages by their definition: a sum over later errors, each with its own discounts."""
    steps, envs = buffer.rewards.shape
    ends = np.vstack([buffer.episode_starts[1:], dones])
    values = np.vstack([buffer.values, last_values])
    found = np.zeros((steps, envs))
    for env in range(envs):
        for step in range(steps):
            weight = 1.0
            for later in range(step, steps):
                on = 0.0 if ends[later, env] else buffer.discounts[later, env]
                error = buffer.rewards[later, env] + on * values[later + 1, env]
                found[step, env] += weight * (error - values[later, env])
                weight *= on * buffer.gae_lambda
    return found + buffer.values


@pytest.mark.parametrize(
    ("learner", "simulation"),
    [(PPO, Visits), (PPO, Named), (A2C, Named), (MaskablePPO, Masked)],
)
def test_timed_rollout_buffer_discounts_returns_by_elapsed_time(learner, simulation, monkeypatch):
    checked = []
    compute = TimedRolloutBuffer.compute_returns_and_advantage

    def compute_and_check(self, last_values, dones):
        compute(self, last_values, dones)
        expected = expected_returns(self, last_values.cpu().numpy().reshape(1, -1), dones)
        checked.append(np.allclose(self.returns, expected, atol=1e-4))
        assert ((self.discounts > 0) & (self.discounts < 1)).mean() > 0.9

    monkeypatch.setattr(TimedRolloutBuffer, "compute_returns_and_advantage", compute_and_check)
    policy = "MultiInputPolicy" if simulation is Named else "MlpPolicy"
    options = {} if learner is A2C else {"batch_size": 16, "n_epochs": 1}
    model = learner(
        policy, vector(simulation), n_steps=16, rollout_buffer_class=TimedRolloutBuffer, **options
    )
    model.learn(64)
    assert checked == [True, True]


def test_timed_rollout_buffer_bootstraps_truncated_episodes_with_discount():
    """The learner adds gamma times the value; without gamma, all of it must be there."""
    returns = []
    for gamma in (0.0, 0.9):
        model = PPO(
            "MlpPolicy", vector(), n_steps=64, batch_size=64, n_epochs=1, seed=3, gamma=gamma,
            rollout_buffer_class=TimedRolloutBuffer,
        )  # fmt: skip
        model.learn(128)
        returns.append(model.rollout_buffer.returns)
    assert np.allclose(*returns, atol=1e-4)


@pytest.mark.parametrize("simulation", [Visits, Named])
def test_timed_replay_buffer_samples_have_their_transitions_discounts(simulation):
    policy = "MultiInputPolicy" if simulation is Named else "MlpPolicy"
    model = DQN(
        policy, vector(simulation), buffer_size=400, learning_starts=50, train_freq=4,
        replay_buffer_class=TimedReplayBuffer,
    )  # fmt: skip
    model.learn(200)
    buffer = model.replay_buffer
    known = {
        (round(float(reward), 5), round(float(discount), 5))
        for reward, discount in zip(
            buffer.rewards[: buffer.pos].ravel(),
            buffer.discounts[: buffer.pos].ravel(),
            strict=True,
        )
    }
    samples = buffer.sample(100)
    found = zip(samples.rewards.ravel().tolist(), samples.discounts.ravel().tolist(), strict=True)
    assert {(round(reward, 5), round(discount, 5)) for reward, discount in found} <= known
    assert len({discount for _, discount in known}) > 10
    again = pickle.loads(pickle.dumps(buffer))
    assert type(again) is type(buffer)
    assert np.array_equal(again.discounts, buffer.discounts)


@pytest.mark.parametrize(
    "options",
    [{"rollout_buffer_class": TimedRolloutBuffer}, {"replay_buffer_class": TimedReplayBuffer}],
    ids=["rollout", "replay"],
)
def test_timed_buffers_raise_an_error_for_infos_without_a_discount(options):
    learner = PPO if "rollout_buffer_class" in options else DQN
    model = learner("MlpPolicy", vector(discount_rate=None), **options)
    with pytest.raises(OptionValueError, match="discount_rate="):
        model.learn(10)


def test_timed_rollout_buffer_is_filled_by_a_learner():
    buffer = TimedRolloutBuffer(4, Visits.space, spaces.Discrete(3))
    with pytest.raises(OptionValueError, match="collect_rollouts"):
        buffer.add(np.zeros(2), np.zeros(1), np.zeros(1), np.zeros(1), None, None)
