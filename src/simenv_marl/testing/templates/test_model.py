"""Tests of MyModel. Keep them when you replace the model: they say whether its environments can be trusted."""

from simenv_marl.testing import check_simulation
from simenv_marl.testing.templates.plain import MySimulation


def test_there_is_nothing_to_complain_of() -> None:
    """With the rule throughout, environments repeat the plain run; seeds, resets, spaces and rewards are right."""
    report = check_simulation(MySimulation, episodes=2, max_steps=300)
    assert {finding.severity for finding in report.findings} <= {"note"}, str(report)
