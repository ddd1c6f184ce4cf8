"""Mesa's own model of wolves and sheep, unmodified: births and deaths in the hundreds, addressed by names from outside.

Its other example models are tested in ``tests/examples/test_mesa_models.py``.
"""

import pytest
from examples.wolf_sheep import env as example
from examples.wolf_sheep.env import numbers
from mesa.examples.advanced.wolf_sheep.agents import Sheep, Wolf

from examples import mesa_models
from simenv_marl import RULE, aec_env, parallel_env, simulate
from tests.worlds.models import follow_the_rule


class Pasture(example.Meadow):
    """The model for some ticks; it does not say who is going to decide."""

    expected_calls = None

    def __init__(self, ticks=25, **parameters):
        super().__init__(ticks, **parameters)


class AnnouncedPasture(Pasture):
    def expected_calls(self, point):
        return [(animal,) for animal in self.model.agents_by_type.get(Wolf if ".Wolf." in point else Sheep, ())]


class Meadow(Pasture):
    """A small one."""

    def __init__(self):
        super().__init__(8, width=6, height=6, initial_sheep=14, initial_wolves=6)


def herd():
    """The decision points of wolves and of sheep."""
    return mesa_models.wolf_sheep()[1]


@pytest.mark.parametrize("seed", [5, 11])
def test_wolves_and_sheep_with_rule_throughout_are_the_plain_run(seed):
    plain = Pasture()
    plain.reset(seed)
    plain.run()
    assert len(set(zip(*numbers(plain).values(), strict=True))) > 20  # it is a lively run
    expected = mesa_models.fingerprint(plain)
    assert mesa_models.fingerprint(simulate(Pasture, points=herd(), seed=seed)) == expected
    for simulation in (Pasture, AnnouncedPasture):
        assert mesa_models.fingerprint(follow_the_rule(aec_env(simulation, herd()), seed)) == expected
        env = parallel_env(simulation, herd())
        env.reset(seed=seed)
        rounds = dropped = 0
        while env.agents:
            actions = dict.fromkeys(env.agents, RULE)
            *_, infos = env.step(actions)
            rounds += 1
            dropped += sum(not infos[agent]["acted"] for agent in actions)
        assert mesa_models.fingerprint(env.simulation) == expected
        if simulation is AnnouncedPasture:
            assert (rounds, dropped) == (plain.ticks, 0)
        else:
            assert rounds > plain.ticks  # each birth needs a return
