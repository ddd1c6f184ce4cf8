"""The greenhouse: the model on its own, its environments, and what is trained and planned in them, in a small way."""

import json
import pickle
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from examples.greenhouse_coop import train
from examples.greenhouse_coop.env import (
    DAYS,
    env,
    joint_env,
    parallel_env,
    raw_env,
    ventilation_env,
    watering_env,
)
from examples.greenhouse_coop.model import Greenhouse
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, seed_test

from tests.worlds.models import follow_the_rule, play

ROOT = Path(__file__).parents[2]


def state(greenhouse):
    """All that there is to know of a greenhouse, to the last bit."""
    pots = [(plant.water, plant.health, plant.req_water) for plant in greenhouse.pots]
    house = (greenhouse.day, greenhouse.temp, greenhouse.humidity, greenhouse.water_use, greenhouse.random.getstate())
    return house, pots


def kept_plainly(seed):
    """A greenhouse that has been kept by its own rules, as supplement S2 of the paper has it."""
    greenhouse = Greenhouse(seed)
    anyone = True
    while anyone and greenhouse.day < DAYS:
        anyone = greenhouse.alive > 0
        greenhouse.update_day()
    return greenhouse


KEEP = {"waterer_0": 0.08, "ventilator_0": 0.9}


@pytest.fixture
def pair():
    environment = raw_env()
    yield environment
    environment.close()


def test_a_day_in_the_papers_order():
    greenhouse = Greenhouse(5)
    greenhouse.update_temperature = lambda: None  # 20 degrees
    thirst = [plant.req_water for plant in greenhouse.pots]
    health = [plant.health for plant in greenhouse.pots]
    greenhouse.update_day()
    # 20 % of 40 % of 2 litres evaporate, 32 litres from all pots, into 2400 cubic metres that hold 480 litres.
    assert greenhouse.humidity == pytest.approx(0.8 * (0.6 + 32 / 480) + 0.2 * 0.6)
    assert [plant.water for plant in greenhouse.pots] == pytest.approx([2 - 0.16 - need + 1 for need in thirst])
    assert [plant.health for plant in greenhouse.pots] == pytest.approx([min(1, h + 0.1) for h in health])
    assert greenhouse.water_use == 200
    assert greenhouse.day == 1


def test_the_model_prints_its_days_as_in_the_paper():
    command = [sys.executable, "-W", "error", "examples/greenhouse_coop/model.py", "--seed", "1"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120, check=True)
    lines = done.stdout.splitlines()
    days = [re.fullmatch(r"day (\d+) alive: (\d+), dead: (\d+)", line).groups() for line in lines]
    alive = [int(alive) for _, alive, _ in days]
    assert [int(day) for day, _, _ in days] == list(range(10))
    assert [int(dead) for _, _, dead in days] == [200 - number for number in alive]
    assert alive[:2] == [200, 200]
    assert alive == sorted(alive, reverse=True)
    assert alive[-1] == 0  # the rule means too well


@pytest.mark.parametrize("make", [raw_env, parallel_env, joint_env, watering_env, ventilation_env])
def test_ruled_throughout_a_pickled_environment_is_the_plain_model(make):
    environment = pickle.loads(pickle.dumps(make()))
    for seed in (0, 1, 2**31 - 1):
        assert state(follow_the_rule(environment, seed).greenhouse) == state(kept_plainly(seed))
    environment.close()


def test_an_episode_terminates_when_all_plants_are_dead_and_is_truncated_after_a_hundred_days(pair):
    dead = play(pair, seed=1)
    assert [turn[3:5] for turn in dead[-2:]] == [(True, False)] * 2
    assert pair.simulation.greenhouse.alive == 0
    alive = play(pair, KEEP, seed=1)
    assert [turn[3:5] for turn in alive[-2:]] == [(False, True)] * 2
    assert pair.simulation.greenhouse.alive > 0
    assert [turn.agent for turn in alive[: 2 * DAYS]] == ["ventilator_0", "waterer_0"] * DAYS


@pytest.mark.parametrize("make", [raw_env, env])
def test_the_greenhouse_passes_pettingzoos_tests(make):
    environment = make()
    api_test(environment, num_cycles=300)
    environment.close()
    seed_test(make)


@pytest.mark.parametrize(
    ("name", "options"), [("Watering", {}), ("Ventilation", {}), ("Joint", {}), ("Joint", {"flatten": True})]
)
def test_the_greenhouse_passes_gymnasiums_check(name, options):
    environment = gymnasium.make(f"greenhouse_coop/{name}-v0", **options)
    check_env(environment.unwrapped)
    environment.close()


def test_trains_end_to_end(tmp_path, capsys):
    folder = tmp_path / "new" / "folder"
    train.main(["--budget", "1", "--seeds", "2", "--workers", "1", "--out", str(folder)])
    printed = capsys.readouterr().out
    titles = ("rule", "random actions", "constant watering", "constant pair", "watering trained", "both trained")
    assert all(title in printed for title in titles)
    named = re.findall(r"^  (\S+/\S+)", printed.partition("What to do next:")[2], flags=re.MULTILINE)
    assert len(named) == 4
    assert all((ROOT / path).is_file() for path in named)
    found = json.loads((folder / "greenhouse.json").read_text())
    assert [len(values) for values in found["returns"].values()] == [2] * len(titles)


def test_training_is_worth_it():
    generations, seeds = 3, range(train.HELD_OUT, train.HELD_OUT + 8)
    pair = {"waterer_0": train.Constant(0.084), "ventilator_0": train.Constant(1.0)}  # what searching finds
    trained = train.learn(train.rate, pair, generations, np.random.default_rng(0))
    rule, constant, learnt = train.rate([{}, pair, trained], seeds)
    assert rule < 5 < 65 < constant < learnt - 3
    assert max(train.draw_seeds(np.random.default_rng(0), 10000)) < train.HELD_OUT
