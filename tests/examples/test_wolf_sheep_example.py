"""One policy for all sheep of Mesa's unmodified model; how it is trained is tested in ``tests/clients``."""

import pickle

import numpy as np
import pytest
from examples.wolf_sheep.env import MOVE, Meadow, numbers, sheep_points
from gymnasium.utils.env_checker import check_env
from mesa.examples.advanced.wolf_sheep.agents import GrassPatch, Sheep, Wolf

from simenv_marl import RULE, aec_env, joint_env, simulate_many
from simenv_marl.data import collect_episodes
from tests.worlds.models import play

SMALL = {"width": 8, "height": 8, "initial_sheep": 20, "initial_wolves": 5}


class Pasture(Meadow):
    """A small one."""

    def __init__(self, ticks=25, **changes):
        super().__init__(ticks, **SMALL | changes)


def picture(meadow):
    """All that there is to know at the end, with all its digits."""
    model = meadow.model
    animals = [
        (kind.__name__, animal.unique_id, animal.energy, animal.cell.coordinate)
        for kind in (Sheep, Wolf)
        for animal in model.agents_by_type.get(kind, ())
    ]
    grass = [patch.fully_grown for patch in model.agents_by_type[GrassPatch]]
    counts = {kind: values.tolist() for kind, values in numbers(meadow).items()}
    return animals, grass, counts, model.random.getstate(), model.rng.bit_generator.state


def plain(seed):
    meadow = Pasture()
    meadow.reset(seed)
    meadow.run()
    return picture(meadow)


def by_rule(observations):
    return [RULE] * len(observations)


@pytest.mark.parametrize("sight", [1, 2])
def test_left_to_the_rule_it_is_the_plain_model(sight):
    expected = [plain(seed) for seed in range(4)]
    assert all(len(set(counts["sheep"])) > 5 for _, _, counts, *_ in expected)  # they are lively runs
    points = sheep_points(sight)
    assert simulate_many(Pasture, seeds=range(4), points=points, collect=picture) == expected
    found = collect_episodes(Pasture, {MOVE: by_rule}, points=points, seeds=range(4), collect=picture)[MOVE]
    assert list(found.collected) == expected
    env = pickle.loads(pickle.dumps(aec_env(Pasture(), points)))
    play(env, seed=2)
    assert picture(env.simulation) == expected[2]


@pytest.mark.filterwarnings("ignore:.*maximum value is infinity")  # of their energy
def test_gymnasium_accepts_a_herd_as_one_agent():
    herd = [f"sheep_{number}" for number in range(1, 21)]
    check_env(joint_env(Pasture, possible_agents=herd, undeclared="rule"), skip_render_check=True)


def test_lives_begin_with_births_and_end_with_deaths():
    def alive(meadow):
        return {f"sheep_{sheep.unique_id}" for sheep in meadow.sheep}, numbers(meadow)["sheep"]

    found = collect_episodes(Pasture, {MOVE: by_rule}, points=sheep_points(), seeds=range(6), collect=alive)[MOVE]
    assert found.rewards.tolist() == [1.0] * len(found)  # all turns are worth the same, the last one too
    ends = found.starts + found.lengths - 1
    assert (found.terminations[ends] ^ found.truncations[ends]).all()
    for episode, (survivors, counts) in enumerate(found.collected):
        own = found.episodes[ends] == episode
        names = np.array(found.names)[found.agents[ends]]
        assert len(set(names[own])) == own.sum()  # nobody lives twice
        # Lambs of the last tick have not decided anything yet, and are nobody.
        assert set(names[own & found.truncations[ends]]) <= survivors
        assert not set(names[own & found.terminations[ends]]) & survivors
        # At each tick all sheep decide that were there before it.
        assert (found.episodes == episode).sum() == counts[:-1].sum()
    # At its death a sheep is seen whole: it has starved, or a wolf is in its own cell.
    died, last = found.terminations[ends], found.last_observations
    starved = died & (last[:, 0] < 0)
    assert starved.sum() > 5
    assert (died & ~starved).sum() > 5
    assert (last[died & ~starved, 1 + 13] > 0).all()
    assert (last[~died, 0] >= 0).all()
