"""Mesa's unmodified wolves and sheep: hundreds of births and deaths, and names from outside.

Its other example models are tested in ``tests/examples/test_mesa_models.py``.
"""

import pytest
from examples.wolf_sheep import env as example

from examples import mesa_models
from simenv_marl import aec_env, parallel_env, simulate
from tests.worlds.models import follow_the_rule


class Pasture:
    """The model for some ticks, in which wolves decide as well; it announces no decisions."""

    ticks, size = 25, {}

    def reset(self, seed=None):
        self.meadow = example.Meadow(self.ticks, **self.size)
        self.meadow.reset(seed)

    def run(self):
        return self.meadow.run()

    @property
    def model(self):
        return self.meadow.model


class Meadow(Pasture):
    """A small one."""

    ticks, size = 8, {"width": 6, "height": 6, "initial_sheep": 14, "initial_wolves": 6}


def herd():
    """The decision points of wolves and of sheep."""
    return mesa_models.wolf_sheep()[1]


@pytest.mark.parametrize("seed", [5, 11])
def test_mesa_wolf_sheep_env_with_rule_actions_runs_like_without_env(seed):
    plain = Pasture()
    plain.reset(seed)
    plain.run()
    assert len(set(zip(*example.numbers(plain).values(), strict=True))) > 20  # it is a lively run
    expected = mesa_models.fingerprint(plain)
    assert mesa_models.fingerprint(simulate(Pasture, points=herd(), seed=seed)) == expected
    for view in (aec_env, parallel_env):
        assert mesa_models.fingerprint(follow_the_rule(view(Pasture, herd()), seed)) == expected
