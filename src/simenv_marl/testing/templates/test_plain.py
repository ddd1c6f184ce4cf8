"""Tests of MyModel. Keep them when you replace the model: they say whether its environment can be trusted."""

from gymnasium.utils.env_checker import check_env

from simenv_marl import RULE
from simenv_marl.testing import check_simulation
from simenv_marl.testing.templates.plain import MyModelSimulation, env


def test_with_the_rule_throughout_the_environment_is_the_plain_run() -> None:
    """Otherwise the environment would be another model."""
    plain = MyModelSimulation()
    plain.reset(seed=7)
    plain.run()
    made, over = env(), False
    made.reset(seed=7)
    while not over:
        _, _, terminated, truncated, _ = made.step(RULE)
        over = terminated or truncated
    assert made.simulation.model.cost == plain.model.cost


def test_there_is_nothing_to_complain_of() -> None:
    """Seeds, resets, spaces, rewards: ``print(report)`` shows what is looked at."""
    report = check_simulation(MyModelSimulation, episodes=2)
    assert {finding.severity for finding in report.findings} <= {"note"}, str(report)


def test_gymnasium_accepts_the_environment() -> None:
    """As learners do that are made for Gymnasium."""
    check_env(env(), skip_render_check=True)
