"""Admission to a queue: the model, its exact values, and the environment; its training is in ``tests/clients``."""

import math

import numpy as np
import pytest
from examples.queue_admission.env import AGENT, QueueSimulation, env, observation
from examples.queue_admission.exact import ADMIT_ALL, DECISIONS, EMPTY, best_table, values, worth
from examples.queue_admission.model import INTEREST, Queue

from simenv_marl import simulate_many
from simenv_marl.testing import check_simulation
from tests.worlds.models import follow_the_rule

SEEN = {observation(decision).tobytes(): decision for decision in DECISIONS}


def policy_of(table):
    return lambda observations: np.array([table[SEEN[seen.tobytes()]] for seen in observations], int)


def earned(policies, seeds):
    return np.array(
        simulate_many(QueueSimulation, policies, seeds=seeds, collect=lambda run: run.model.present_value())
    )


def test_the_optimum_and_what_discounting_by_decision_makes_of_it():
    optimum = worth(best_table())
    assert round(optimum, 3) == 4.458
    assert round(worth(ADMIT_ALL) / optimum, 2) == 0.76
    for gamma in (0.3, 0.5, 0.9, 0.95, 0.99, 0.995):
        for reward_rate in (0.0, INTEREST):
            assert best_table(rate=0.0, reward_rate=reward_rate, gamma=gamma) == ADMIT_ALL
    assert round(worth(best_table(reward_rate=0.0)) / optimum, 3) == 0.776  # rewards not discounted in the interval


def test_a_table_is_worth_what_it_earns_in_the_model():
    best, seeds = best_table(), range(300)
    gains = earned({AGENT: policy_of(best)}, seeds) - earned({}, seeds)
    expected = values(best)[EMPTY] - values(ADMIT_ALL)[EMPTY]
    assert abs(gains.mean() - expected) < 2.5 * gains.std() / math.sqrt(len(seeds))
    assert gains.mean() > 5 * gains.std() / math.sqrt(len(seeds))


def test_discounted_rewards_add_up_to_the_present_value():
    world = env()
    for seed in range(3):
        seen, info = world.reset(seed=seed)
        total, weight, over = 0.0, math.exp(-INTEREST * info["time"]), False
        while not over:
            assert seen.tobytes() in SEEN  # a full queue asks nobody
            seen, reward, terminated, truncated, info = world.step(world.action_space.sample())
            total, weight, over = total + weight * reward, weight * info["discount"], truncated
            assert not terminated
        assert total == pytest.approx(world.unwrapped.simulation.model.present_value(), rel=1e-9)


def test_left_to_the_rule_it_is_the_plain_model():
    def picture(model):
        states = [generator.bit_generator.state for generator in model.generators]
        return model.clock.now, model.present_value(), model.serving(), model.waiting(0), model.waiting(1), states

    for seed in range(3):
        plain = Queue(seed)
        plain.clock.run(until=150)
        assert picture(follow_the_rule(env(), seed=seed).model) == picture(plain)
    report = check_simulation(QueueSimulation, episodes=3)
    assert report.findings == (), str(report)
