"""Environments of examples and of other people's models are saved, and go on in a fresh process."""

import importlib
import json
import random
from pathlib import Path

import pytest

from simenv_marl import aec_env, load_episode, save_episode
from simenv_marl.errors import EpisodeFileError
from tests.processes import alone
from tests.worlds.saved import future, move

ENVIRONMENTS = [
    "greenhouse_coop.env.raw_env",
    "greenhouse_coop.env.parallel_env",
    "greenhouse_coop.env.joint_env",
    "queue_admission.env.env",
    "market_seats.env.env",
    "fin_base.env.team_env",
]
MODELS = [
    "boltzmann_wealth", "schelling", "boid_flockers", "conways_game_of_life", "virus_on_network",
    "epstein_civil_violence", "pd_grid", "sugarscape", "alliance_formation",
]  # fmt: skip


def begun(make):
    env = make()
    env.reset(seed=3)
    chance = random.Random(1)
    for _ in range(20):
        if move(env, chance)[1]:
            break
    return env


def go_on(folder):
    """Load the files of a folder, and compare what they come to."""
    for path in sorted(Path(folder).glob("*.jsonl")):
        name = path.stem
        given = arguments_of(name) if name in MODELS else {}
        env = load_episode(path, **given)
        assert future(env, 2, 20) == json.loads(path.with_suffix(".future").read_text()), name


def arguments_of(name):
    """Return the arguments that a file of a model of Mesa leaves open."""
    mesa_models = pytest.importorskip("examples.mesa_models")
    model, points, options = getattr(mesa_models, name)()
    return {"simulation": mesa_models.stepped(model), "points": points, **options}


def test_environments_of_examples_go_on_in_a_fresh_process(tmp_path):
    for name in ENVIRONMENTS:
        module, _, attribute = name.rpartition(".")
        env = begun(getattr(importlib.import_module(f"examples.{module}"), attribute))
        save_episode(env, tmp_path / f"{name}.jsonl")
        (tmp_path / f"{name}.future").write_text(json.dumps(future(env, 2, 20)))
        env.close()
    alone(go_on, str(tmp_path))


@pytest.mark.filterwarnings("ignore")
def test_models_of_mesa_go_on_in_a_fresh_process(tmp_path):
    pytest.importorskip("mesa")
    for name in MODELS:
        given = arguments_of(name)
        env = begun(lambda given=given: aec_env(**given))
        with pytest.raises(EpisodeFileError, match="no dotted name"):
            save_episode(env, tmp_path / f"{name}.jsonl")
        save_episode(env, tmp_path / f"{name}.jsonl", unnamed=True)
        (tmp_path / f"{name}.future").write_text(json.dumps(future(env, 2, 20)))
        env.close()
    alone(go_on, str(tmp_path))
