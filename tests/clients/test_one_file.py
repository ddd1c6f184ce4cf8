"""Scripts in one file, as CleanRL has them: the vector view."""

from importlib import import_module

import numpy as np
import torch

from tests.worlds.models import models_of_pages_forgotten

from .page import DOCS
from .returns import mean_return


def test_single_file_script_of_the_docs_learns(monkeypatch):
    monkeypatch.syspath_prepend(DOCS)
    with models_of_pages_forgotten():
        script = import_module("one_file")

        def act(agent, observation, info):
            with torch.no_grad():
                return (
                    script.Categorical(logits=script.actor(script.seen(observation)))
                    .sample()
                    .item()
                )

        before = mean_return(script.FourWeeks, script.points, act)
        script.train(21)
        assert mean_return(script.FourWeeks, script.points, act) > before + 100
        assert len(script.envs.return_queue) == 100
        assert np.mean(script.envs.length_queue) == 28
        script.envs.close()
