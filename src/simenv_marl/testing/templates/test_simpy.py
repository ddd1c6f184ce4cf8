"""Tests of MyModel. Keep them when you replace the model: they say whether its environment can be trusted."""

from typing import Any

from simenv_marl import RULE
from simenv_marl.testing import check_simulation
from simenv_marl.testing.templates.simpy import MyModelSimulation, env


def test_with_the_rule_throughout_the_environment_is_the_plain_run() -> None:
    """Otherwise the environment would be another model."""
    plain = MyModelSimulation()
    plain.reset(seed=7)
    plain.run()
    made: Any = env()
    over = False
    made.reset(seed=7)
    while not over:
        _, _, terminated, truncated, _ = made.step(RULE)
        over = terminated or truncated
    assert made.simulation.model.minutes_late() == plain.model.minutes_late()


def test_there_is_nothing_to_complain_of() -> None:
    """Seeds, resets, spaces, rewards: ``print(report)`` shows what is looked at."""
    report = check_simulation(MyModelSimulation, episodes=2)
    assert {finding.severity for finding in report.findings} <= {"note"}, str(report)


def test_masks_tell_which_actions_are_legal_and_infos_how_long_they_took() -> None:
    """Gymnasium's ``check_env`` does not look at masks; any other action would be an ``InvalidActionError``."""
    made, over, minutes = env(), False, 0.0
    _, info = made.reset(seed=7)
    made.action_space.seed(7)
    while not over:
        assert info["action_mask"].sum() > 1  # a forced choice is not asked for
        _, _, terminated, truncated, info = made.step(made.action_space.sample(info["action_mask"]))
        minutes += info["elapsed"]
        over = terminated or truncated
    assert info["time"] == 480.0
    assert 0 < minutes <= 480.0  # from the first decision to the end
