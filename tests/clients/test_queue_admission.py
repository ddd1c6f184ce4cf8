"""Stable-Baselines3 with a discount for each transition, on decisions at irregular times."""

import numpy as np
import pytest
import torch
from examples.queue_admission import train
from examples.queue_admission.env import env
from examples.queue_admission.exact import ADMIT_ALL, worth
from examples.queue_admission.model import INTEREST


def elapsed(actions, seed):
    """The times between the decisions of an episode."""
    world = env(discount_rate=None)
    world.reset(seed=seed)
    return [world.step(action)[-1]["elapsed"] for action in actions]


def test_replayed_transitions_have_the_discounts_of_their_times():
    learner = train.train_dqn(3, steps=50)
    buffer = learner.replay_buffer
    times = elapsed(buffer.actions[:50].ravel().tolist(), 3)
    assert buffer.discounts[:50].ravel().tolist() == pytest.approx(np.exp(-INTEREST * np.array(times)))
    found = buffer._get_samples(np.array([4, 9]))
    assert torch.equal(found.discounts, torch.from_numpy(buffer.discounts[[4, 9]]))


def test_advantages_have_the_discounts_of_their_times():
    world = env()
    buffer = train.TimedRollout(4, world.observation_space, world.action_space, device="cpu", gae_lambda=0.5)
    zeros = np.zeros((1, 6)), np.zeros((1, 1))
    for reward, begins, value in ((1.0, 1, 0.5), (2.0, 0, 1.5), (3.0, 1, 2.5), (4.0, 0, 3.5)):
        buffer.add(*zeros, np.array([reward]), np.array([begins]), torch.tensor([value]), torch.zeros(1))
    buffer.discounts[:, 0] = 0.9, 0.8, 0.7, 0.6
    buffer.compute_returns_and_advantage(torch.tensor([10.0]), np.array([False]))
    last = 4.0 + 0.6 * 10 - 3.5
    second = 2.0 - 1.5  # an episode ends after it
    expected = [1.0 + 0.9 * 1.5 - 0.5 + 0.5 * 0.9 * second, second, 3.0 + 0.7 * 3.5 - 2.5 + 0.5 * 0.7 * last, last]
    assert buffer.advantages.ravel().tolist() == pytest.approx(expected)
    assert buffer.returns.ravel().tolist() == pytest.approx(np.add(expected, [0.5, 1.5, 2.5, 3.5]))


def test_a_short_training_by_time_beats_all_trainings_by_decision():
    """By decision, the best table admits all: see ``tests/examples/test_queue_admission.py``."""
    assert worth(train.table_of(train.train_dqn(0, steps=20_000))) > 1.1 * worth(ADMIT_ALL)


def test_the_command_writes_a_row_for_each_training_and_a_figure(tmp_path):
    results, figure = tmp_path / "results.csv", tmp_path / "figure.png"
    train.main(["--seeds", "1", "--steps", "500", "--runs", "3", "--out", str(results), "--figure", str(figure)])
    assert len(results.read_text().splitlines()) == 1 + 2 + len(train.GAMMAS)
    assert figure.stat().st_size > 10_000
