"""TorchRL: one policy for all sheep of Mesa's model, learnt from ``collect_episodes``."""

from functools import partial

import torch
from examples.wolf_sheep import train
from examples.wolf_sheep.env import MOVE, Meadow, sheep_points

from simenv_marl.data import collect_episodes

SMALL = {"width": 10, "height": 10, "initial_sheep": 30, "initial_wolves": 12}


def test_shared_sheep_policy_training_depends_only_on_its_seed():
    def run(seed):
        herd, course = train.train(2, seed, decisions=5000, each=1000, ticks=20, **SMALL)
        return herd.logits.state_dict(), [
            (one.decisions, one.sheep, one.life, one.survived) for one in course
        ]

    (one, course), (another, again), (other, _) = run(0), run(0), run(1)
    assert len(course) >= 2
    assert course == again
    assert all(torch.equal(one[name], another[name]) for name in one)
    assert not all(torch.equal(one[name], other[name]) for name in one)


def test_shared_sheep_policy_learns_to_live_longer():
    """On held-out seeds of the default meadow, each sheep has more turns than before."""

    def turns(policy):
        meadow, seeds = (
            partial(Meadow, 40, only_with_sheep=True),
            range(train.HELD_OUT, train.HELD_OUT + 8),
        )
        found = collect_episodes(meadow, {MOVE: policy}, points=sheep_points(2), seeds=seeds)[MOVE]
        return len(found) / len(found.starts)

    herd, _ = train.train(2, 0, decisions=50_000, each=8_000, ticks=40)
    before = turns(train.Herd(2, 0).explore)
    assert turns(herd.decide) > 1.5 * before
