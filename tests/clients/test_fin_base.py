"""Stable-Baselines3 and TorchRL on the pension fund, as its page shows them: both gain over the rule."""

from types import SimpleNamespace

import torch
from examples.fin_base.env import FundSim
from studies.pension import torchrl as together

from simenv_marl import evaluate

from .page import blocks

UNSEEN = range(2_000_000, 2_000_128)


def welfare_gained(learner, agents):
    """By how much agents that decide by a learner do better than the rule, seed by seed: mean, low, high."""
    contenders = {"rule": {}, "learner": dict.fromkeys(agents, learner.decide)}
    found = evaluate(
        learner.fund, contenders, seeds=UNSEEN, points=learner.points, metric=FundSim.welfare, baseline="rule"
    )
    return found.summary("metric").loc["learner", ["difference", "difference_low", "difference_high"]]


def check(found, before):
    """A trained learner does better than the rule, seed by seed with the interval above 0, and than before training."""
    trained = found.summary("metric").loc["trained"]
    assert trained["difference_low"] > 0
    assert trained["difference"] > before["difference"]


def test_stable_baselines3_gains_over_the_rule():
    define, learn = blocks("_clients_pension.md", "Train it with Stable-Baselines3")
    names = {"__name__": "__main__"}
    exec(define, names)
    before = welfare_gained(SimpleNamespace(**names), ["indexer_0"])
    exec(learn, names)
    check(names["found"], before)


def test_torchrl_gains_over_the_rule():
    policy, loss = together.learner()
    together.train(policy, loss)
    trained = together.compare(policy)
    torch.manual_seed(0)
    untrained, _ = together.learner()
    check(trained, together.compare(untrained).summary("metric").loc["trained"])
