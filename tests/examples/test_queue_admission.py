"""Admission to a queue: exact values, and the model's; ``tests/clients`` tests the training."""

import math

import numpy as np
import pytest
from examples.queue_admission.env import AGENT, QueueSimulation, observation
from examples.queue_admission.exact import ADMIT_ALL, DECISIONS, EMPTY, best_table, values, worth
from examples.queue_admission.model import INTEREST

from simenv_marl import simulate_many

SEEN = {observation(decision).tobytes(): decision for decision in DECISIONS}


def policy_of(table):
    return lambda observations: np.array(
        [table[SEEN[seen.tobytes()]] for seen in observations], int
    )


def earned(policies, seeds):
    return np.array(
        simulate_many(
            QueueSimulation, policies, seeds=seeds, collect=lambda run: run.model.present_value()
        )
    )


def test_queue_admission_discounting_by_decision_misses_the_optimum():
    optimum = worth(best_table())
    assert round(optimum, 3) == 4.458
    assert round(worth(ADMIT_ALL) / optimum, 2) == 0.76
    for gamma in (0.3, 0.5, 0.9, 0.95, 0.99, 0.995):
        for reward_rate in (0.0, INTEREST):
            assert best_table(rate=0.0, reward_rate=reward_rate, gamma=gamma) == ADMIT_ALL
    # rewards not discounted in the interval
    assert round(worth(best_table(reward_rate=0.0)) / optimum, 3) == 0.776


@pytest.mark.thorough
def test_queue_admission_table_value_matches_returns_in_the_model():
    best, seeds = best_table(), range(300)
    gains = earned({AGENT: policy_of(best)}, seeds) - earned({}, seeds)
    expected = values(best)[EMPTY] - values(ADMIT_ALL)[EMPTY]
    assert abs(gains.mean() - expected) < 2.5 * gains.std() / math.sqrt(len(seeds))
    assert gains.mean() > 5 * gains.std() / math.sqrt(len(seeds))
