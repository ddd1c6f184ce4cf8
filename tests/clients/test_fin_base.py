"""Stable-Baselines3 and TorchRL on the pension fund, as on its page: both gain over the rule."""

import torch
from studies.pension import torchrl as together

from .page import blocks


def check(found, untrained):
    """A trained learner surpasses the rule, with an interval above 0, and the untrained learner."""
    trained, before = (each.summary("metric").loc["trained"] for each in (found, untrained))
    assert trained["difference_low"] > 0
    assert trained["difference"] > before["difference"]


def test_pension_fund_stable_baselines3_gains_over_the_models_rule(monkeypatch):
    define, learn = blocks("_clients_pension.md", "Train it with Stable-Baselines3")
    names = {"__name__": "__main__"}
    exec(define, names)
    with monkeypatch.context() as without:
        without.setattr(names["model"], "learn", lambda steps: None)
        exec(learn, names)
    untrained = names["found"]
    exec(learn, names)
    check(names["found"], untrained)


def test_pension_fund_torchrl_gains_over_the_models_rule():
    policy, loss = together.learner()
    together.train(policy, loss)
    trained = together.compare(policy)
    torch.manual_seed(0)
    check(trained, together.compare(together.learner()[0]))
