"""The greenhouse: the model on its own, its environments, and what is trained and planned in them, in a small way."""

import gc
import json
import pickle
import re
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pettingzoo
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
from examples.greenhouse_coop.model import Greenhouse, Plant
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, seed_test

from simenv_marl import RULE, branch
from tests.worlds.models import follow_the_rule, play

ROOT = Path(__file__).parents[2]
UNDECORATED = vars(Greenhouse)["update_air_exchange"], vars(Greenhouse)["choose_water_amount"]


def run_python(*arguments):
    """Run Python in the repository, warnings being errors; return what it prints."""
    command = [sys.executable, "-W", "error", *map(str, arguments)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout


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


@pytest.mark.parametrize(
    ("water", "before", "after"),
    [(1.0, 0.5, 0.6), (1.0, 0.95, 1.0), (0.1, 0.5, 0.25), (3.4, 0.5, 0.25), (3.2, 0.5, 0.6), (0.1, 0.2, 0), (1, 0, 0)],
)
def test_plants_suffer_from_dry_and_from_flooded_pots(water, before, after):
    plant = Plant(Greenhouse(1))
    plant.water, plant.health, plant.req_water = water, before, 0.2
    plant.update_day()
    assert plant.water == pytest.approx(max(0, water - 0.2))
    assert plant.health == pytest.approx(after)


@pytest.mark.parametrize("start", [("-m", "examples.greenhouse_coop.model"), ("examples/greenhouse_coop/model.py",)])
def test_the_model_tells_its_days_as_in_the_paper(start):
    lines = run_python(*start, "--seed", 1).splitlines()
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


def test_the_model_is_undecorated_again(pair):
    gc.collect()  # environments that other tests have left open
    pair.reset(seed=1)
    single = watering_env()
    single.reset(seed=1)
    pair.close()
    assert vars(Greenhouse)["update_air_exchange"] is UNDECORATED[0]
    assert vars(Greenhouse)["choose_water_amount"] is not UNDECORATED[1]
    single.close()
    assert vars(Greenhouse)["choose_water_amount"] is UNDECORATED[1]


def test_it_ends_when_all_are_dead_and_is_truncated_after_a_hundred_days(pair):
    dead = play(pair, seed=1)
    assert [turn[3:5] for turn in dead[-2:]] == [(True, False)] * 2
    assert pair.simulation.greenhouse.alive == 0
    alive = play(pair, KEEP, seed=1)
    assert [turn[3:5] for turn in alive[-2:]] == [(False, True)] * 2
    assert pair.simulation.greenhouse.alive > 0
    assert [turn.agent for turn in alive[: 2 * DAYS]] == ["ventilator_0", "waterer_0"] * DAYS


@pytest.mark.parametrize(("make", "agent"), [(watering_env, "waterer_0"), (ventilation_env, "ventilator_0")])
def test_single_views_are_the_pair_with_the_other_on_its_rule(pair, make, agent):
    turns = play(pair, dict.fromkeys(KEEP, RULE) | {agent: KEEP[agent]}, seed=3)
    single = make()
    alone = [(single.reset(seed=3)[0].tolist(), 0.0, False, False)]
    while not any(alone[-1][2:]):
        observation, *rest, _ = single.step(KEEP[agent])
        alone.append((observation.tolist(), *rest))
    single.close()
    assert alone == [(turn.observation.tolist(), *turn[2:5]) for turn in turns if turn.agent == agent]


@pytest.mark.parametrize("make", [raw_env, env])
def test_pettingzoo_accepts_it(make):
    environment = make()
    api_test(environment, num_cycles=300)
    environment.close()
    seed_test(make)


@pytest.mark.parametrize(
    ("name", "options"), [("Watering", {}), ("Ventilation", {}), ("Joint", {}), ("Joint", {"flatten": True})]
)
def test_gymnasium_accepts_it(name, options):
    environment = gymnasium.make(f"greenhouse_coop/{name}-v0", **options)
    check_env(environment.unwrapped)
    environment.close()


def test_wrappers_tell_mistakes_and_clip(caplog):
    environment = pickle.loads(pickle.dumps(env(max_steps=3, render_mode="ansi")))
    with pytest.raises(AttributeError):
        _ = environment.agent_selection
    environment.reset(seed=1)
    assert environment.render() == "day 0 alive: 200, dead: 0"
    environment.step(np.array([0.5], np.float32))
    environment.step(np.array([1.5], np.float32))
    assert "clipping to space" in caplog.text
    assert environment.unwrapped.simulation.greenhouse.water_use == 1000
    environment.step(np.array([0.5], np.float32))
    assert all(environment.truncations.values())
    environment.close()


def test_registered_in_a_fresh_process_and_imported_twice():
    code = """
import importlib
import gymnasium
import pettingzoo
import examples.greenhouse_coop.env as module

importlib.reload(module)
for name in ("Watering", "Ventilation"):
    environment = gymnasium.make(f"greenhouse_coop/{name}-v0")
    environment.reset(seed=1)
    print(type(environment.unwrapped).__name__, *environment.step(environment.action_space.sample())[2:4])
    print(gymnasium.spec(environment.spec.id).to_json() == environment.spec.to_json())
    environment.close()
if hasattr(pettingzoo, "aec_registry"):
    environment = pettingzoo.make("aec", "greenhouse_coop/coop_v0", max_steps=5)
    environment.reset(seed=1)
    print(environment.agents)
    environment.close()
"""
    lines = run_python("-c", code).splitlines()
    assert lines[:4] == ["SimulationEnv False False", "True"] * 2
    if hasattr(pettingzoo, "aec_registry"):
        assert lines[4:] == ["['waterer_0', 'ventilator_0']"]


def test_the_weather_that_lies_ahead_can_be_drawn_anew():
    def ten_days(env, number):
        for _ in range(10):
            env.step(dict.fromkeys(env.agents, RULE))
        greenhouse = env.simulation.greenhouse
        return greenhouse.temp, greenhouse.humidity, [plant.req_water for plant in greenhouse.pots]

    env = parallel_env()
    env.reset(seed=1)
    env.step(dict.fromkeys(env.agents, RULE))
    forked, replayed = (branch(env, ten_days, 3, method=method, seeds=[1, 2, 1]) for method in ("fork", "replay"))
    assert forked == replayed
    assert forked[0] == forked[2] != forked[1] != branch(env, ten_days)[0]
    assert forked[0][2] == forked[1][2]  # the plants are what they are


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


def test_trains_alike_on_any_number_of_processes():
    one, two = (train.compare(1, 2, seed=0, workers=workers) for workers in (1, 2))
    assert one[0] == two[0]


def test_training_is_worth_it():
    generations, seeds = 8, range(train.HELD_OUT, train.HELD_OUT + 8)
    pair = {"waterer_0": train.Constant(0.084), "ventilator_0": train.Constant(1.0)}  # what searching finds
    trained = train.learn(train.rate, pair, generations, np.random.default_rng(0))
    rule, constant, learnt = train.rate([{}, pair, trained], seeds)
    assert rule < 5 < 65 < constant < learnt - 3
    assert max(train.draw_seeds(np.random.default_rng(0), 10000)) < train.HELD_OUT
