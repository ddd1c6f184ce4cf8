"""Scripts in one file, as CleanRL has them: the vector view."""

import numpy as np
import torch

from simenv_marl import single_env

from . import page
from .returns import single_return


def test_the_code_of_the_page_runs(monkeypatch):
    steps = page.steps("Scripts in one file", monkeypatch)
    names = next(steps)
    env = single_env(names["FourWeeks"], {"bakery.Bakery.choose_batch": names["batch"]})

    def act(observation, info):
        with torch.no_grad():
            return names["Categorical"](logits=names["actor"](names["seen"](observation))).sample().item()

    before = single_return(env, act)
    names = next(steps)
    assert single_return(env, act) > before + 100
    assert names["best"] in env.action_space
    assert len(names["envs"].return_queue) == 100
    assert np.mean(names["envs"].length_queue) == 28
    names["envs"].close()
