"""Tests of MyModel. Keep them when you replace the model: they say whether its environment can be trusted."""

from typing import Any

import pytest
from pettingzoo.test import api_test

from simenv_marl import RULE
from simenv_marl.testing import check_simulation
from simenv_marl.testing.templates.mesa import MyModelSimulation, env


def rabbits(simulation: MyModelSimulation) -> list[tuple[Any, ...]]:
    """Note where every rabbit is, and what it has."""
    return [(rabbit.unique_id, rabbit.cell.coordinate, rabbit.energy) for rabbit in simulation.model.agents]


def test_with_the_rule_throughout_the_environment_is_the_plain_run() -> None:
    """Otherwise the environment would be another model."""
    plain = MyModelSimulation()
    plain.reset(seed=7)
    plain.run()
    made = env()
    made.reset(seed=7)
    for agent in made.agent_iter():
        made.step(None if made.terminations[agent] or made.truncations[agent] else RULE)
    assert rabbits(made.simulation) == rabbits(plain)


def test_there_is_nothing_to_complain_of() -> None:
    """Seeds, resets, spaces, rewards: ``print(report)`` shows what is looked at."""
    report = check_simulation(lambda: MyModelSimulation(days=20), episodes=2)
    assert {finding.severity for finding in report.findings} <= {"note"}, str(report)


def test_agents_are_born_and_die() -> None:
    """Each has an end of its own: those that starve are terminated, those that see the last day truncated."""
    made = env()
    made.reset(seed=7)
    first, ends = set(made.agents), {}
    for agent in made.agent_iter():
        _, _, terminated, truncated, _ = made.last()
        if terminated or truncated:
            ends[agent] = "starved" if terminated else "alive"
        made.step(None if terminated or truncated else RULE)
    assert set(ends) > first
    assert set(ends.values()) == {"starved", "alive"}


@pytest.mark.filterwarnings("ignore:This environment does not have possible_agents")  # as rabbits are born
def test_pettingzoo_accepts_the_environment() -> None:
    """As learners do that are made for PettingZoo."""
    api_test(env(), num_cycles=500)
