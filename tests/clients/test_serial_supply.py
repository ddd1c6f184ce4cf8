"""Recipes for cooperative learners: each trains for a moment, from its command line."""

import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("stockpyl")

from examples.serial_supply.command import cost
from examples.serial_supply.env import (
    DISCRETE,
    FIRST_STOCKS,
    OPTIMUM,
    OPTIONS,
    PERIODS,
    RULE_LEVELS,
    STAGES,
    SerialSupply,
    base_stocks,
)
from stockpyl.instances import load_instance
from stockpyl.sim import simulation

from simenv_marl import RULE, aec_env, parallel_env, simulate
from simenv_marl.testing import check_simulation

from . import commands

EXAMPLE = Path(commands.ROOT) / "examples" / "serial_supply"

RECIPES = {
    "sb3_turn": ("stable_baselines3", 2400),
    "torchrl_mappo": ("torchrl.collectors:Collector", 1600),
    "independent": ("torchrl.collectors:Collector", 1600),
    "selfish": ("torchrl.collectors:Collector", 1600),
    "rllib_ppo": ("ray", 1600),
    "benchmarl_recipe mappo": ("benchmarl", 1600),
    "benchmarl_recipe qmix": ("benchmarl", 800),
    "benchmarl_recipe vdn": ("benchmarl", 800),
}
"""What each recipe needs, and the steps of one update."""

GLUE = 60
"""The most lines of a recipe that are neither imports nor constants."""


def plain(seed):
    """The cost of stockpyl's own run, without any environment."""
    network = load_instance("example_6_1")
    for number, stock in enumerate(FIRST_STOCKS):
        node = network.nodes_by_index[number + 1]
        node.inventory_policy.base_stock_level = RULE_LEVELS[number]
        node.initial_inventory_level = stock
    return simulation(network, PERIODS, rand_seed=seed, progress_bar=False, consistency_checks="N")


def test_serial_supply_rule_costs_as_much_as_in_stockpyl():
    env = aec_env(SerialSupply, **OPTIONS)
    for seed in (1, 2):
        env.reset(seed=seed)
        while env.agents:
            _, _, ended, cut, _ = env.last()
            env.step(None if ended or cut else RULE)
        assert env.unwrapped.simulation.cost == plain(seed)
        assert simulate(SerialSupply, seed=seed, **OPTIONS).cost == plain(seed)


def test_serial_supply_passes_check_simulation():
    check_simulation(SerialSupply, **OPTIONS).raise_for_errors()


def test_serial_supply_optimal_base_stocks_cost_as_much_as_in_the_book():
    seeds = range(40)
    best = cost(base_stocks(), seeds)
    assert best == pytest.approx(OPTIMUM, rel=0.02)
    assert cost({}, seeds) > 1.3 * best


def test_serial_supply_observations_are_the_same_in_every_env():
    turns, rounds = aec_env(SerialSupply, **OPTIONS), parallel_env(SerialSupply, **OPTIONS)
    turns.reset(seed=3)
    seen, _ = rounds.reset(seed=3)
    drawn = np.random.default_rng(3)
    for _ in range(5):
        actions = {stage: drawn.uniform(0, 10, 1).astype(np.float32) for stage in STAGES}
        for stage in STAGES:
            assert turns.agent_selection == stage
            np.testing.assert_allclose(turns.observe(stage), seen[stage], rtol=0, atol=1e-5)
            turns.step(actions[stage])
        seen, *_ = rounds.step(actions)


def test_serial_supply_discrete_actions_order_in_half_units():
    env = parallel_env(SerialSupply, DISCRETE, **OPTIONS)
    env.reset(seed=1)
    env.step(dict.fromkeys(STAGES, 9))
    chain = env.unwrapped.simulation
    assert [node.state_vars[0].get_order_quantity() for node in chain.nodes] == [4.5] * 3


@pytest.mark.parametrize("recipe", RECIPES)
def test_serial_supply_recipe_trains_and_its_policies_run(recipe):
    needs, steps = RECIPES[recipe]
    package, _, name = needs.partition(":")
    library = pytest.importorskip(package)
    if name and not hasattr(library, name):
        pytest.skip(f"needs {name} of a newer {package}")
    module, *arguments = recipe.split()
    told = commands.python(
        "-m", f"examples.serial_supply.{module}", *arguments, "--steps", steps, "--runs", 2
    )
    found = re.search(r"cost of a period: ([0-9.]+)", told)
    assert found, told
    assert 30 < float(found[1]) < 20_000


@pytest.mark.parametrize("path", sorted(EXAMPLE.glob("*.py")), ids=lambda path: path.stem)
def test_serial_supply_recipe_has_few_lines_of_glue_code(path):
    text = path.read_text(encoding="utf-8")
    if "# -- glue: begin" in text:
        glue = text.partition("# -- glue: begin")[2].partition("# -- glue: end")[0]
        assert len([line for line in glue.splitlines()[1:] if line.strip()]) <= GLUE


def test_serial_supply_table_resumes_and_shows_all_learners(tmp_path):
    pytest.importorskip("stable_baselines3")
    pytest.importorskip("torchrl")
    table = import_module("examples.serial_supply.table")
    figure = tmp_path / "figure.png"
    arguments = ["--trainings", "2", "--runs", "3", "--steps", "1600"]
    arguments += ["--out", str(tmp_path), "--figure", str(figure)]
    table.main(arguments)
    first = (tmp_path / "table.csv").read_text()
    written = {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.pkl")}
    assert len(written) == 2 * len(table.LEARNERS)
    table.main(arguments)
    assert (tmp_path / "table.csv").read_text() == first
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("*.pkl")} == written
    assert figure.stat().st_size > 10_000
