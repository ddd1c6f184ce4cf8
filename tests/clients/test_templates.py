"""The template of a plain loop, with Stable-Baselines3: it trains in place, briefly, and gains."""

import re

from simenv_marl.testing.templates import write_template

from .commands import python

NUMBER = re.compile(r"-?\d[\d.]*")


def test_template_training_beats_the_rule_and_has_a_quick_mode(tmp_path):
    write_template("plain", "tank", tmp_path)
    assert "trained " in python(tmp_path / "tank.py", "--quick")
    printed = python(tmp_path / "tank.py")
    row = next(line for line in printed.splitlines() if line.startswith("trained "))
    difference, difference_low, difference_high = map(float, NUMBER.findall(row)[3:])
    assert 1 < difference_low <= difference <= difference_high
