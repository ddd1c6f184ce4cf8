"""The lives of sheep in Mesa's unmodified model; ``tests/clients`` tests the shared policy."""

import numpy as np
from examples.wolf_sheep.env import MOVE, Meadow, numbers, sheep_points

from simenv_marl import RULE
from simenv_marl.data import collect_episodes


def test_wolf_sheep_agents_begin_with_births_and_end_with_deaths():
    def alive(meadow):
        return {f"sheep_{sheep.unique_id}" for sheep in meadow.sheep}, numbers(meadow)["sheep"]

    def by_rule(observations):
        return [RULE] * len(observations)

    meadow = Meadow(25, width=8, height=8, initial_sheep=20, initial_wolves=5)
    found = collect_episodes(
        meadow, {MOVE: by_rule}, points=sheep_points(), seeds=range(6), collect=alive
    )[MOVE]
    # all turns are worth the same, the last one too
    assert found.rewards.tolist() == [1.0] * len(found)
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
