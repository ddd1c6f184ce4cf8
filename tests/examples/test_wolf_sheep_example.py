"""The example of one policy for all sheep: what a sheep sees, does and is rewarded for, in Mesa's unmodified model.

How it is trained is tested where learners are installed, in ``tests/clients``.
"""

import numpy as np
import pytest
from examples.wolf_sheep.env import DIRECTIONS, MOVE, Meadow, cells, go, look, numbers, sheep_points
from gymnasium.utils.env_checker import check_env
from mesa.examples.advanced.wolf_sheep.agents import GrassPatch, Sheep, Wolf

from simenv_marl import RULE, aec_env, branch, joint_env, simulate_many
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


def plain(seed, **changes):
    meadow = Pasture(**changes)
    meadow.reset(seed)
    meadow.run()
    return picture(meadow)


def by_rule(observations):
    return [RULE] * len(observations)


def eastwards(observations):
    return np.full(len(observations), DIRECTIONS.index((0, 1)))


# -- the model stays what it is -------------------------------------------------------------------


@pytest.mark.parametrize("sight", [1, 2])
def test_left_to_the_rule_it_is_the_plain_model(sight):
    expected = [plain(seed) for seed in range(4)]
    assert all(len(set(counts["sheep"])) > 5 for _, _, counts, *_ in expected)  # they are lively runs
    points = sheep_points(sight)
    assert simulate_many(Pasture, seeds=range(4), points=points, collect=picture) == expected
    found = collect_episodes(Pasture, {MOVE: by_rule}, points=points, seeds=range(4), collect=picture)[MOVE]
    assert list(found.collected) == expected
    env = aec_env(Pasture, points)
    play(env, seed=2)
    assert picture(env.simulation) == expected[2]


def test_ticks_one_by_one_are_those_that_the_model_runs_at_once():
    meadow = Pasture()
    meadow.reset(3)
    meadow._runner.run_for(meadow.ticks)
    assert picture(meadow) == plain(3)


@pytest.mark.filterwarnings("ignore:.*maximum value is infinity")  # of their energy
def test_gymnasium_accepts_a_herd_as_one_agent():
    herd = [f"sheep_{number}" for number in range(1, 21)]
    check_env(joint_env(Pasture, possible_agents=herd, undeclared="rule"), skip_render_check=True)


# -- what a sheep sees ----------------------------------------------------------------------------


def deserted(seed=0):
    """A meadow without animals or grass."""
    meadow = Pasture()
    meadow.reset(seed)
    for kind in (Sheep, Wolf):
        for animal in list(meadow.model.agents_by_type[kind]):
            animal.remove()
    for patch in meadow.model.agents_by_type[GrassPatch]:
        patch.fully_grown = False
    return meadow


def put(meadow, kind, row, column, energy=8.0):
    return kind(meadow.model, energy=energy, cell=meadow.model.grid[row % 8, column % 8])


def grow(meadow, row, column):
    for other in meadow.model.grid[row % 8, column % 8].agents:
        if isinstance(other, GrassPatch):
            other.fully_grown = True


def seen(observation, sight):
    """By kind, where something is, and how much of it."""
    parts = np.split(observation[1:], 3)
    return [
        {cell: number for cell, number in zip(cells(sight), part.tolist(), strict=True) if number} for part in parts
    ]


def test_cells_are_seen_by_their_distance():
    assert cells(0) == ((0, 0),)
    assert cells(1) == ((0, 0), *DIRECTIONS)
    assert len(cells(2)) == 13
    assert len(cells(3)) == len(set(cells(3))) == 25
    distances = [abs(row) + abs(column) for row, column in cells(3)]
    assert distances == sorted(distances)
    assert max(distances) == 3


@pytest.mark.parametrize("home", [(4, 4), (0, 0), (7, 3)])  # the meadow has no edges
def test_a_sheep_sees_what_is_around_it(home):
    row, column = home
    meadow = deserted()
    sheep = put(meadow, Sheep, row, column, energy=3.5)
    put(meadow, Sheep, row, column)
    put(meadow, Sheep, row - 1, column)
    put(meadow, Wolf, row, column)
    for _ in range(3):
        put(meadow, Wolf, row, column + 1)
    put(meadow, Wolf, row + 1, column - 1)
    put(meadow, Wolf, row + 2, column + 1)  # three steps away
    grow(meadow, row, column)
    grow(meadow, row, column - 2)
    observation = look(sheep, 2)
    assert observation.dtype == np.float32
    assert observation[0] == 3.5
    assert seen(observation, 2) == [
        {(0, 0): 1, (0, -2): 1},
        {(0, 0): 1, (0, 1): 3, (1, -1): 1},
        {(0, 0): 1, (-1, 0): 1},
    ]
    near = look(sheep, 1)
    assert near[0] == 3.5
    assert seen(near, 1) == [{(0, 0): 1}, {(0, 0): 1, (0, 1): 3}, {(0, 0): 1, (-1, 0): 1}]


def test_actions_lead_where_they_are_seen_to():
    meadow = deserted()
    for action, direction in enumerate(DIRECTIONS):
        sheep = put(meadow, Sheep, 0, 7)
        grow(meadow, *np.add((0, 7), direction))
        before = seen(look(sheep, 1), 1)[0]
        assert before[direction] == 1
        go(np.int64(action), sheep)
        assert (0, 0) in seen(look(sheep, 1), 1)[0]
        assert sheep.cell.coordinate == tuple(np.add((0, 7), direction) % 8)
        sheep.remove()


def test_who_is_sent_goes():
    def columns(meadow):
        return {sheep.unique_id: sheep.cell.coordinate[1] for sheep in meadow.sheep}

    changes = {"initial_wolves": 1, "initial_sheep": 10, "sheep_reproduce": 0}
    now = Pasture(0, **changes)
    now.reset(1)
    before = columns(now)
    found = collect_episodes(
        lambda: Pasture(3, **changes), {MOVE: eastwards}, points=sheep_points(), seeds=[1], collect=columns
    )[MOVE]
    after = found.collected[0]
    assert after
    assert after == {number: (before[number] + 3) % 8 for number in after}


# -- births, deaths and rewards -------------------------------------------------------------------


def test_lives_begin_with_births_and_end_with_deaths():
    def alive(meadow):
        return {f"sheep_{sheep.unique_id}" for sheep in meadow.sheep}, numbers(meadow)["sheep"]

    found = collect_episodes(
        lambda: Pasture(15), {MOVE: by_rule}, points=sheep_points(), seeds=range(6), collect=alive
    )[MOVE]
    assert found.rewards.tolist() == [1.0] * len(found)  # all turns are worth the same, the last one too
    ends = found.starts + found.lengths - 1
    assert (found.terminations[ends] ^ found.truncations[ends]).all()
    for episode, (survivors, counts) in enumerate(found.collected):
        own = found.episodes[ends] == episode
        names = np.array(found.names)[found.agents[ends]]
        assert len(set(names[own])) == own.sum()  # nobody lives twice
        truncated = set(names[own & found.truncations[ends]])
        # Lambs of the last tick have not decided anything yet, and are nobody.
        assert truncated <= survivors
        assert not set(names[own & found.terminations[ends]]) & survivors
        # At each tick all sheep decide that were there before it.
        assert (found.episodes == episode).sum() == counts[:-1].sum()
    born = {name for name in found.names if int(name.partition("_")[2]) > 25}
    assert len(born) > 10
    assert found.terminations.sum() > 20
    assert found.truncations.sum() > 5


def test_at_its_death_a_sheep_is_seen_whole():
    found = collect_episodes(Pasture, {MOVE: by_rule}, points=sheep_points(), seeds=range(6))[MOVE]
    died = found.terminations[found.starts + found.lengths - 1]
    energies = found.last_observations[:, 0]
    wolves = found.last_observations[:, 1 + 13]  # in its own cell
    starved = died & (energies < 0)
    eaten = died & ~starved
    assert starved.sum() > 5
    assert eaten.sum() > 5
    assert (wolves[eaten] > 0).all()
    assert (energies[~died] >= 0).all()


def test_meadows_that_end_with_their_sheep():
    changes = {"initial_wolves": 40, "initial_sheep": 5}
    lasting, ended = (
        collect_episodes(
            lambda only=only: Pasture(30, only_with_sheep=only, **changes),
            {MOVE: eastwards},
            points=sheep_points(),
            seeds=range(4),
            collect=lambda meadow: len(numbers(meadow)["sheep"]),
        )[MOVE]
        for only in (False, True)
    )
    assert lasting.collected == (31,) * 4
    assert max(ended.collected) < 31
    assert np.array_equal(lasting.observations, ended.observations)
    assert lasting.terminations.tolist() == ended.terminations.tolist()
    assert not ended.truncations.any()


def test_only_wolves_two_steps_away_or_in_its_own_cell_catch_a_sheep():
    """Wolves that are one step away are not beside it once it has moved, nor is any that comes later."""
    generator = np.random.default_rng(0)
    found = collect_episodes(
        Pasture,
        {MOVE: lambda observations: generator.integers(4, size=len(observations))},
        points=sheep_points(2),
        seeds=range(8),
    )[MOVE]
    last = found.starts + found.lengths - 1
    died = found.terminations[last]
    eaten = died & (found.last_observations[:, 0] >= 0)
    seen = cells(2)
    beside = np.zeros(len(found))
    for action, (row, column) in enumerate(DIRECTIONS):
        chosen = found.actions == action
        for step in DIRECTIONS:
            beside[chosen] += found.observations[chosen, 1 + 13 + seen.index((row + step[0], column + step[1]))]
    assert eaten.sum() > 30
    assert (beside[last[eaten]] > 0).all()
    assert (beside == 0).sum() > 30  # it is not so everywhere


def test_the_future_of_a_meadow_can_be_drawn_anew():
    def next_days(env, number):
        for _ in range(300):
            env.step(None if env.terminations[env.agent_selection] else RULE)
        return [(sheep.unique_id, sheep.cell.coordinate, sheep.energy) for sheep in env.simulation.sheep]

    env = aec_env(Meadow)
    env.reset(seed=1)
    for _ in range(50):
        env.step(RULE)
    forked, replayed = (branch(env, next_days, 3, method=method, seeds=[1, 2, 1]) for method in ("fork", "replay"))
    assert forked == replayed
    assert forked[0] == forked[2] != forked[1] != branch(env, next_days)[0]
