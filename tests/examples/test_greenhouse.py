"""The greenhouse: the model alone, the ends of episodes, registration, and the gain by training."""

import re

import gymnasium
import numpy as np
import pytest
from examples.greenhouse_coop import model, train
from examples.greenhouse_coop.env import DAYS, env, parallel_env, raw_env
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test

from tests.worlds.models import play


def test_greenhouse_prints_its_days_as_in_the_paper(capsys):
    model.main(["--seed", "1"])
    lines = capsys.readouterr().out.splitlines()
    days = [re.fullmatch(r"day (\d+) alive: (\d+), dead: (\d+)", line).groups() for line in lines]
    alive = [int(alive) for _, alive, _ in days]
    assert [int(day) for day, _, _ in days] == list(range(10))
    assert [int(dead) for _, _, dead in days] == [200 - number for number in alive]
    assert alive[:2] == [200, 200]
    assert alive == sorted(alive, reverse=True)
    assert alive[-1] == 0  # the rule means too well


def test_greenhouse_day_has_the_numbers_of_the_paper():
    house = model.Greenhouse(5)
    house.update_temperature = lambda: None  # 20 degrees
    house.update_day()
    assert house.humidity == pytest.approx(0.8 * (0.6 + 32 / 480) + 0.2 * 0.6)
    assert (house.water_use, house.day) == (200, 1)


def test_greenhouse_passes_pettingzoos_tests():
    api_test(env(), num_cycles=100)
    parallel_api_test(parallel_env(), num_cycles=100)


def test_greenhouse_episode_ends_with_the_last_plant_or_after_100_days():
    environment = raw_env()
    dead = play(environment, seed=1)
    assert [turn[3:5] for turn in dead[-2:]] == [(True, False)] * 2
    assert environment.simulation.greenhouse.alive == 0
    alive = play(environment, {"waterer_0": 0.08, "ventilator_0": 0.9}, seed=1)
    assert [turn[3:5] for turn in alive[-2:]] == [(False, True)] * 2
    assert environment.simulation.greenhouse.alive > 0
    assert [turn.agent for turn in alive[: 2 * DAYS]] == ["ventilator_0", "waterer_0"] * DAYS


@pytest.mark.parametrize(
    ("name", "options"),
    [("Watering", {}), ("Ventilation", {}), ("Joint", {}), ("Joint", {"flatten": True})],
)
def test_greenhouse_passes_gymnasiums_check_env(name, options):
    environment = gymnasium.make(f"greenhouse_coop/{name}-v0", **options)
    check_env(environment.unwrapped)
    environment.close()


@pytest.mark.thorough
def test_greenhouse_training_beats_the_models_rule():
    generations, seeds = 3, range(train.HELD_OUT, train.HELD_OUT + 8)
    # what searching finds
    pair = {"waterer_0": train.Constant(0.084), "ventilator_0": train.Constant(1.0)}
    trained = train.learn(train.rate, pair, generations, np.random.default_rng(0))
    rule, constant, learnt = train.rate([{}, pair, trained], seeds)
    assert rule < 5 < 65 < constant < learnt - 3
    assert max(train.draw_seeds(np.random.default_rng(0), 10000)) < train.HELD_OUT
