"""The example: the model on its own, its environments, and what is trained in them."""

import gc
import re
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import gymnasium
import numpy as np
import pettingzoo
import pytest
from examples.greenhouse_coop import train
from examples.greenhouse_coop.env import (
    ACTION_SPACE,
    DAYS,
    OBSERVATION_SPACE,
    GreenhouseSim,
    env,
    exchange_air,
    observe,
    parallel_env,
    raw_env,
    to_litres,
    ventilation_env,
    watering_env,
)
from examples.greenhouse_coop.model import Greenhouse, Plant
from examples.greenhouse_coop.picture import draw
from gymnasium.utils.env_checker import check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from pettingzoo.test import api_test, seed_test

from simenv_marl import RULE, TRUNCATED, branch
from simenv_marl.errors import InvalidActionError

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


class Kept(Greenhouse):
    """A greenhouse whose own rules are 80 litres and 90 % of the air."""

    def choose_water_amount(self):
        return 80.0

    def update_air_exchange(self):
        self.humidity = 0.1 * self.humidity + 0.9 * self.outside_humidity


KEEP = {"waterer_0": 0.08, "ventilator_0": 0.9}


def keep(environment, actions, seed):
    """Play an episode of the AEC environment; return all that was seen, by agent."""
    environment.reset(seed=seed)
    seen = {agent: [] for agent in environment.possible_agents}
    for agent in environment.agent_iter():
        observation, reward, terminated, truncated, _ = environment.last()
        seen[agent].append((observation, reward, terminated, truncated))
        environment.step(None if terminated or truncated else actions[agent])
    return seen


@pytest.fixture
def pair():
    environment = raw_env()
    yield environment
    environment.close()


# -- the model ------------------------------------------------------------------------------------


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


def test_plants_and_weather_stay_within_their_bounds():
    greenhouse = Greenhouse(3)
    assert all(0.1 <= plant.health <= 0.9 and 0.1 <= plant.req_water <= 0.4 for plant in greenhouse.pots)
    temperatures = [greenhouse.temp]
    for _ in range(2000):
        greenhouse.update_temperature()
        temperatures.append(greenhouse.temp)
    assert (min(temperatures), max(temperatures)) == (15, 35)
    assert {b - a for a, b in pairwise(temperatures)} == {-2, -1, 0, 1, 2}


def test_chance_is_the_greenhouses_own():
    one, other = Greenhouse(7), Greenhouse(7)
    for _ in range(20):
        one.update_day()
        Greenhouse().update_day()
        other.update_day()
    assert state(one) == state(other) != state(Greenhouse(8))


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


# -- the simulation behind environments -----------------------------------------------------------


@pytest.mark.parametrize("seed", [0, 1, 2**31 - 1])
def test_ruled_throughout_it_is_the_plain_model(pair, seed):
    expected = state(kept_plainly(seed))
    keep(pair, dict.fromkeys(KEEP, RULE), seed)
    assert state(pair.simulation.greenhouse) == expected
    for make in (watering_env, ventilation_env):
        single = make()
        single.reset(seed=seed)
        while not any(single.step(RULE)[2:4]):
            pass
        assert state(single.simulation.greenhouse) == expected
        single.close()
    simulation = GreenhouseSim()
    simulation.reset(seed=seed)
    assert simulation.run() is None
    assert state(simulation.greenhouse) == expected


def test_deciding_as_the_rule_does_is_the_plain_model(pair):
    # A plain float reaches the model as it is; in the space's float32 there is no exact fifth.
    keep(pair, {"waterer_0": 0.2, "ventilator_0": 0.2}, 4)
    assert state(pair.simulation.greenhouse) == state(kept_plainly(4))


def test_the_model_is_undecorated_again(pair):
    gc.collect()  # environments that other tests have left open
    assert vars(Greenhouse)["update_air_exchange"] is not UNDECORATED[0]
    pair.reset(seed=1)
    single = watering_env()
    single.reset(seed=1)
    pair.close()
    assert vars(Greenhouse)["update_air_exchange"] is UNDECORATED[0]
    assert vars(Greenhouse)["choose_water_amount"] is not UNDECORATED[1]
    single.close()
    assert vars(Greenhouse)["choose_water_amount"] is UNDECORATED[1]


def test_a_plain_greenhouse_is_not_touched_by_open_environments(pair):
    expected = state(kept_plainly(6))
    pair.reset(seed=6)
    pair.step(1.0)
    assert state(kept_plainly(6)) == expected
    assert pair.agent_selection == "waterer_0"


def test_it_ends_when_all_are_dead_and_is_truncated_after_a_hundred_days(pair):
    dead = keep(pair, dict.fromkeys(KEEP, RULE), 1)
    assert all(seen[-1][2:] == (True, False) for seen in dead.values())
    assert pair.simulation.greenhouse.alive == 0
    assert pair.simulation.greenhouse.day < 15
    alive = keep(pair, KEEP, 1)
    assert all(seen[-1][2:] == (False, True) for seen in alive.values())
    assert pair.simulation.greenhouse.alive > 0
    assert [len(seen) for seen in alive.values()] == [DAYS + 1, DAYS + 1]
    simulation = GreenhouseSim()
    simulation.greenhouse = Kept(1)
    assert simulation.run() is TRUNCATED


def test_the_ventilator_is_asked_before_the_waterer_each_day(pair):
    pair.reset(seed=1)
    order = []
    for _ in range(6):
        order.append((pair.simulation.greenhouse.day, pair.agent_selection))
        pair.step(RULE)
    assert order == [(day, agent) for day in range(3) for agent in ("ventilator_0", "waterer_0")]


def test_actions_arrive_as_litres_and_as_fractions_of_the_air(pair):
    assert [to_litres(a) for a in (0.0, 0.25, 1.0, np.array([0.5], np.float32), np.float32(0.5), 1)] == [
        0, 250, 1000, 500, 500, 1000,
    ]  # fmt: skip
    assert type(to_litres(np.array([0.5], np.float32))) is float
    greenhouse = Greenhouse(1)
    for action, humidity in ((0.0, 0.8), (np.array([0.5], np.float32), 0.7), (1.0, 0.6)):
        greenhouse.humidity = 0.8
        exchange_air(action, greenhouse)
        assert greenhouse.humidity == pytest.approx(humidity)
    pair.reset(seed=1)
    pair.step(1.0)
    assert pair.simulation.greenhouse.humidity == 0.6
    pair.step(np.array([0.125], np.float32))
    assert pair.simulation.greenhouse.water_use == 125
    for action in (np.array([1.5], np.float32), -0.1, np.array([np.nan], np.float32), np.zeros(2, np.float32)):
        with pytest.raises(InvalidActionError, match="is not in its action space"):
            pair.step(action)
    assert type(pair.simulation.greenhouse.humidity) is float


# -- observations ---------------------------------------------------------------------------------


def test_observed_is_what_it_says():
    greenhouse = Greenhouse(1)
    greenhouse.temp, greenhouse.humidity, greenhouse.day = 25, 0.7, 30
    for number, plant in enumerate(greenhouse.pots):
        plant.water, plant.health = (3.0, 0.0) if number < 100 else (1.5, 1.0) if number < 150 else (0.75, 0.5)
    assert observe(greenhouse) == pytest.approx([0.5, 0.7, 0.5, 0.3, (1.5 + 0.75) / 2 / 3, 0.75 / 3])
    for plant in greenhouse.pots:
        plant.health = float(plant.health > 0)
    assert observe(greenhouse)[5] == pytest.approx((1.5 + 0.75) / 2 / 3)  # nobody lacks anything: all count alike
    for plant in greenhouse.pots:
        plant.health = 0.0
    assert observe(greenhouse) == pytest.approx([0.5, 0.7, 0, 0.3, 0, 0])


@pytest.mark.parametrize("value", [np.inf, -np.inf, np.nan, 1e300, -1e300])
def test_observations_of_a_greenhouse_gone_mad(value):
    greenhouse = Greenhouse(1)
    greenhouse.humidity = value
    for plant in greenhouse.pots[:5]:
        plant.water = value
    assert observe(greenhouse) in OBSERVATION_SPACE
    for _ in range(5):
        greenhouse.update_day()
        assert observe(greenhouse) in OBSERVATION_SPACE


def test_both_agents_are_observed_from_the_reset_on(pair):
    pair.reset(seed=1)
    assert np.array_equal(pair.observe("waterer_0"), pair.observe("ventilator_0"))
    assert pair.observe("waterer_0") == pytest.approx(observe(pair.simulation.greenhouse))


def all_in_bounds(environment, actions, seed):
    """Play an episode with actions that are repeated for as long as it takes; say how humid it became."""
    environment.reset(seed=seed)
    humidity = []
    for number, agent in enumerate(environment.agent_iter()):
        observation, reward, terminated, truncated, _ = environment.last()
        assert environment.observation_space(agent).contains(observation), observation
        assert np.isfinite(observation).all()
        assert type(reward) is float
        assert -2 <= reward <= 1
        assert terminated or truncated or number <= 2 * DAYS
        humidity.append(abs(environment.simulation.greenhouse.humidity))
        action = np.array([actions[number % len(actions)]], np.float32)
        environment.step(None if terminated or truncated else action)
    return max(humidity, default=0.0)


@settings(max_examples=25, deadline=None)
@given(st.lists(st.sampled_from([0.0, 1.0]) | st.floats(0, 1, width=32), min_size=1, max_size=20), st.integers(0, 9))
def test_observations_stay_in_their_space(actions, seed):
    environment = raw_env()
    try:
        all_in_bounds(environment, actions, seed)
    finally:
        environment.close()


def test_observations_stay_in_their_space_when_the_humidity_does_not(pair):
    # The ventilator keeps the windows shut, the waterer soon opens all taps.
    assert all_in_bounds(pair, [0, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 0, 1, 1, 0, 1, 0, 0, 1], 9) > 1.5


def test_random_actions_of_many_seeds_stay_in_bounds(pair):
    rng = np.random.default_rng(0)
    for seed in range(20):
        all_in_bounds(pair, rng.random(2 * DAYS), seed)


# -- rewards --------------------------------------------------------------------------------------


def test_the_teams_return_is_one_agents_return(pair):
    for seed in range(3):
        seen = keep(pair, KEEP, seed)
        greenhouse = Kept(seed)
        days = []
        for _ in range(DAYS):
            greenhouse.update_day()
            days.append(greenhouse.alive / 200 - 0.08)
        assert pair.simulation.greenhouse.alive == greenhouse.alive
        # The first value that an agent sees is no reward of anything.
        rewards = {agent: [reward for _, reward, _, _ in values] for agent, values in seen.items()}
        assert rewards["ventilator_0"] == pytest.approx([0, *days])
        assert rewards["waterer_0"] == pytest.approx([0, *days[1:], days[-1]])
        team, waterer = (sum(rewards[agent]) for agent in ("ventilator_0", "waterer_0"))
        assert waterer == pytest.approx(team - (1 - greenhouse.alive / 200))


def test_water_is_charged_once_and_to_the_day_on_which_it_was_poured(pair):
    pair.reset(seed=1)
    poured = [0.0, 0.2, 0.0, 0.1, 0.05]
    ventilators, waterers = [], []
    for fraction in poured:
        ventilators.append(pair.rewards["ventilator_0"])
        pair.step(RULE)
        waterers.append(pair.rewards["waterer_0"])
        pair.step(fraction)
    assert pair.simulation.greenhouse.alive == 200
    assert ventilators == pytest.approx([0, *(1 - fraction for fraction in poured[:-1])])
    assert waterers == pytest.approx(ventilators)
    # In the next episode nothing is remembered of this one.
    pair.reset(seed=1)
    pair.step(RULE)
    pair.step(0.0)
    assert pair.rewards["ventilator_0"] == 1.0


@pytest.mark.parametrize(("make", "agent"), [(watering_env, "waterer_0"), (ventilation_env, "ventilator_0")])
def test_single_views_are_the_pair_with_the_other_on_its_rule(pair, make, agent):
    seen = keep(pair, dict.fromkeys(KEEP, RULE) | {agent: KEEP[agent]}, 3)[agent]
    single = make()
    observation, _ = single.reset(seed=3)
    alone = [(observation, 0.0, False, False)]
    while not any(alone[-1][2:]):
        alone.append(single.step(KEEP[agent])[:4])
    single.close()
    assert len(alone) == len(seen)
    for one, other in zip(alone, seen, strict=True):
        assert np.array_equal(one[0], other[0])
        assert one[1:] == other[1:]


# -- conventions ----------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [raw_env, env])
def test_pettingzoo_accepts_it(make):
    environment = make()
    api_test(environment, num_cycles=300)
    environment.close()
    seed_test(make)
    assert vars(Greenhouse)["update_air_exchange"] is UNDECORATED[0]


@pytest.mark.parametrize(
    ("name", "options"), [("Watering", {}), ("Ventilation", {}), ("Joint", {}), ("Joint", {"flatten": True})]
)
def test_gymnasium_accepts_it(name, options):
    environment = gymnasium.make(f"greenhouse_coop/{name}-v0", **options)
    check_env(environment.unwrapped)
    environment.close()


def test_agents_and_spaces(pair):
    assert pair.possible_agents == ["waterer_0", "ventilator_0"]
    for agent in pair.possible_agents:
        assert pair.observation_space(agent) == OBSERVATION_SPACE
        assert pair.action_space(agent) == ACTION_SPACE
    assert OBSERVATION_SPACE.dtype == ACTION_SPACE.dtype == np.float32


def test_wrappers_tell_mistakes_and_clip(caplog):
    environment = env()
    with pytest.raises(AttributeError):
        _ = environment.agent_selection
    environment.reset(seed=1)
    environment.step(np.array([0.5], np.float32))
    environment.step(np.array([1.5], np.float32))
    assert "clipping to space" in caplog.text
    assert environment.unwrapped.simulation.greenhouse.water_use == 1000
    environment.close()


def test_options_reach_the_environment():
    environment = env(max_steps=3)
    environment.reset(seed=1)
    for _ in range(3):
        environment.step(np.array([0.5], np.float32))
    assert all(environment.truncations.values())
    environment.close()


def test_it_is_rendered_in_the_models_words():
    environment = raw_env(render_mode="ansi")
    environment.reset(seed=1)
    assert environment.render() == "day 0 alive: 200, dead: 0"
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


# -- training -------------------------------------------------------------------------------------

TINY = ("--budget", "1", "--seeds", "2")


def test_trains_end_to_end(tmp_path, capsys):
    before = np.random.get_state()[1].tolist()
    train.main([*TINY, "--workers", "1", "--out", str(tmp_path / "new" / "folder")])
    printed = capsys.readouterr().out
    for title in ("rule", "random actions", "constant watering", "constant pair", "watering trained", "both trained"):
        assert title in printed
    assert re.search(r"Why the rule earns 3\.\d: 200 litres a day drown all plants within \d days", printed)
    named = re.findall(r"^  (\S+/\S+)", printed.partition("What to do next:")[2], flags=re.MULTILINE)
    assert len(named) == 4
    assert all((ROOT / path).is_file() for path in named)
    picture = tmp_path / "new" / "folder" / "greenhouse.png"
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert vars(Greenhouse)["update_air_exchange"] is UNDECORATED[0]
    assert np.random.get_state()[1].tolist() == before


def test_the_picture_shows_all_that_happened_and_how_it_was_learnt(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    results, curves = train.compare(train.parse([*TINY, "--workers", "1"]))
    assert {title: np.shape(values) for title, values in curves.items()} == {
        train.ONE_TRAINED: (1, train.POPULATION), train.BOTH_TRAINED: (1, train.POPULATION)
    }  # fmt: skip
    poured = {title: np.array([outcome.poured for outcome in outcomes]) for title, outcomes in results.items()}
    draw(
        {title: [outcome.value for outcome in outcomes] for title, outcomes in results.items()},
        {title: np.array([outcome.alive for outcome in outcomes]) for title, outcomes in results.items()},
        poured,
        tmp_path,
        title="The title",
        notes={"rule": "drowned"},
        curves=curves,
    )
    (figure,) = drawn
    returns, learning, _, litres = figure.axes
    assert figure.get_suptitle() == "The title"
    assert "drowned" in [text.get_text() for text in returns.texts]
    assert learning.lines[0].get_ydata() == pytest.approx(np.mean(curves[train.ONE_TRAINED], axis=1))
    assert litres.get_ylim()[1] >= poured["random actions"].mean(axis=0).max() > 300


def test_trains_alike_on_any_number_of_processes(tmp_path, capsys):
    train.main([*TINY, "--workers", "1", "--out", str(tmp_path)])
    alone = capsys.readouterr().out
    together = run_python("-m", "examples.greenhouse_coop.train", *TINY, "--workers", 2, "--out", tmp_path)
    assert together == alone


def test_training_is_worth_it():
    generations, seeds = 8, range(train.HELD_OUT, train.HELD_OUT + 8)
    pair = {"waterer_0": train.Constant(0.084), "ventilator_0": train.Constant(1.0)}  # what searching finds
    with train.Crew(1, train.tqdm(disable=True)) as crew:
        trained = train.learn(crew.rate, pair, generations, np.random.default_rng(0))
        rule, constant, learnt = crew.rate([{}, pair, trained], seeds)
    assert rule < 5 < 65 < constant < learnt - 3


def test_nothing_learns_from_the_held_out_seeds():
    assert max(train.draw_seeds(np.random.default_rng(0), 10000)) < train.HELD_OUT


@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-1e6, 1e6), min_size=7, max_size=7))
def test_linear_policies_stay_in_the_action_space(weights):
    action = train.Linear(np.array(weights))(np.full(6, 0.9, np.float32), ACTION_SPACE)
    assert action in ACTION_SPACE


@pytest.mark.parametrize("arguments", [["--budget", "0"], ["--seeds", "0"], ["--workers", "-1"]])
def test_senseless_options_are_refused(arguments, capsys):
    with pytest.raises(SystemExit):
        train.main(arguments)
    assert "must be at least 1" in capsys.readouterr().err


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
