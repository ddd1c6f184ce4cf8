"""One sheep of a herd plans over the model's own rule: does it live longer than the others?

``python -m studies.wolf_sheep.plan`` lets one sheep in each of many herds try out the four
directions at each turn, in branches of a few turns in which all animals follow the rule and all
random numbers are drawn anew. There is no training. The comparison is with the other initial sheep
of its herd, which follow the rule, and with the same sheep under the rule on the same meadow.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from typing import Any, Final

import numpy as np
from examples.wolf_sheep.env import MOVE, Meadow, sheep_points
from numpy.typing import NDArray

from simenv_marl import RULE
from simenv_marl.data import collect_episodes
from simenv_marl.planning import RolloutPolicy

TICKS: Final = 40
"""The number of ticks per herd."""


@dataclass(frozen=True)
class Lives:
    """The lengths of sheep's lives, in turns.

    Attributes:
        own: ``(herds,)``: the sheep that plans.
        same: ``(herds,)``: the same sheep under the rule.
        others: ``(herds,)``: the mean over the other initial sheep of its herd.
    """

    own: NDArray[np.float64]
    same: NDArray[np.float64]
    others: NDArray[np.float64]


def lives(seed: int, planner: Any, ticks: int) -> tuple[int, int, float]:
    """Measure the lives of a planning sheep, of the same sheep by the rule, of the others.

    Args:
        seed: The seed of the meadow; it also selects the sheep.
        planner: The policy of the sheep that plans.
        ticks: The number of ticks.
    """
    meadow = Meadow(ticks)
    meadow.reset(seed)
    names = [f"sheep_{sheep.unique_id}" for sheep in meadow.sheep]
    name = names[seed % len(names)]
    found = []
    for policy in (planner, RULE):
        team = {name: policy, MOVE: RULE}
        played = collect_episodes(Meadow(ticks), team, points=sheep_points(), seeds=[seed])
        herd = played[MOVE]
        turns = dict(
            zip(
                (herd.names[herd.agents[start]] for start in herd.starts),
                herd.lengths.tolist(),
                strict=True,
            )
        )
        found.append(
            (len(played[name]), float(np.mean([turns[other] for other in names if other != name])))
        )
    (own, others), (same, _) = found
    return own, same, others


def watch(
    herds: Sequence[int], *, horizon: int, futures: int, ticks: int = TICKS, workers: int = 2
) -> Lives:
    """Measure the lives in several herds.

    Args:
        herds: The seeds of the herds.
        horizon: The number of turns for which a direction is tried out.
        futures: The number of futures in which it is tried out.
        ticks: The number of ticks per herd.
        workers: The number of processes.
    """
    planner = RolloutPolicy(horizon=horizon, futures=futures)
    work = partial(lives, planner=planner, ticks=ticks)
    with ProcessPoolExecutor(workers, get_context("spawn")) as executor:
        found = list(executor.map(work, herds))
    own, same, others = np.array(found, np.float64).T
    return Lives(own, same, others)


def main(arguments: Sequence[str] | None = None) -> Lives:
    """Run herds, and print the lengths of the sheep's lives."""
    parser = argparse.ArgumentParser(description="Let one sheep of a herd plan.")
    parser.add_argument(
        "--herds", type=int, default=200, help="number of herds (default: %(default)s)"
    )
    parser.add_argument(
        "--horizon", type=int, default=6, help="turns to simulate per branch (default: %(default)s)"
    )
    parser.add_argument(
        "--futures", type=int, default=2, help="futures per direction (default: %(default)s)"
    )
    parser.add_argument(
        "--ticks", type=int, default=TICKS, help="ticks per herd (default: %(default)s)"
    )
    parser.add_argument("--workers", type=int, default=2, help="processes (default: %(default)s)")
    options = parser.parse_args(arguments)
    found = watch(
        range(options.herds),
        horizon=options.horizon, futures=options.futures,
        ticks=options.ticks, workers=options.workers,
    )  # fmt: skip
    for title, turns in (
        ("plans", found.own),
        ("the same by the rule", found.same),
        ("others of its herd", found.others),
    ):
        error = turns.std(ddof=1) / np.sqrt(len(turns)) if len(turns) > 1 else np.nan
        alive = (
            f", {np.mean(turns >= options.ticks):.0%} to the end"
            if title != "others of its herd"
            else ""
        )
        print(
            f"{title}: {turns.mean():.1f} ± {error:.1f} turns, median {np.median(turns):.0f}{alive}"
        )
    gained = found.own - found.same
    print(
        f"plans longer than by the rule in {np.mean(gained > 0):.0%} of the herds, shorter in"
        f" {np.mean(gained < 0):.0%}"
    )
    return found


if __name__ == "__main__":
    main()
