"""One sheep of a herd plans over the model's own rule: how long does it live, beside the others?

``python -m examples.wolf_sheep.plan`` lets one sheep in each of many herds try out the four directions at each turn, in
branches of a few turns in which all animals follow the rule and all chance is drawn anew. Nothing is learnt. The sheep
is compared with the others that were there from the beginning of its herd, which follow the rule, and with itself by
the rule on the same meadow.
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
from numpy.typing import NDArray

from simenv_marl import RULE, RolloutPolicy, collect_episodes

from .env import MOVE, Meadow, sheep_points

TICKS: Final = 40
"""How long a herd is watched."""


@dataclass(frozen=True)
class Lives:
    """How long sheep have lived, in turns.

    Attributes:
        own: ``(herds,)``: the sheep that plans.
        same: ``(herds,)``: the same one by the rule.
        others: ``(herds,)``: the others of its herd that were there from the beginning, in the mean.
    """

    own: NDArray[np.float64]
    same: NDArray[np.float64]
    others: NDArray[np.float64]


def lives(seed: int, planner: Any, ticks: int) -> tuple[int, int, float]:
    """How long a sheep lives that plans, how long by the rule, and how long the others of its herd.

    Args:
        seed: Of the meadow; determines which sheep it is.
        planner: Its policy.
        ticks: How long they are watched.
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
        turns = dict(zip((herd.names[herd.agents[start]] for start in herd.starts), herd.lengths.tolist(), strict=True))
        found.append((len(played[name]), float(np.mean([turns[other] for other in names if other != name]))))
    (own, others), (same, _) = found
    return own, same, others


def watch(herds: Sequence[int], *, horizon: int, futures: int, ticks: int = TICKS, workers: int = 2) -> Lives:
    """Watch herds.

    Args:
        herds: Their seeds.
        horizon: For how many turns a direction is tried out.
        futures: In how many futures.
        ticks: How long they are watched.
        workers: How many processes share the work.
    """
    planner = RolloutPolicy(horizon=horizon, futures=futures)
    work = partial(lives, planner=planner, ticks=ticks)
    with ProcessPoolExecutor(workers, get_context("spawn")) as executor:
        found = list(executor.map(work, herds))
    own, same, others = np.array(found, np.float64).T
    return Lives(own, same, others)


def main(arguments: Sequence[str] | None = None) -> Lives:
    """Watch herds, and tell how long sheep have lived."""
    parser = argparse.ArgumentParser(description="Let one sheep of a herd plan.")
    parser.add_argument("--herds", type=int, default=200, help="default: %(default)s")
    parser.add_argument("--horizon", type=int, default=6, help="turns that are tried out (default: %(default)s)")
    parser.add_argument("--futures", type=int, default=2, help="for each direction (default: %(default)s)")
    parser.add_argument("--ticks", type=int, default=TICKS, help="how long they are watched (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=2, help="processes (default: %(default)s)")
    options = parser.parse_args(arguments)
    found = watch(
        range(options.herds),
        horizon=options.horizon, futures=options.futures, ticks=options.ticks, workers=options.workers,
    )  # fmt: skip
    for title, turns in (
        ("plans", found.own),
        ("the same by the rule", found.same),
        ("others of its herd", found.others),
    ):
        error = turns.std(ddof=1) / np.sqrt(len(turns)) if len(turns) > 1 else np.nan
        alive = f", {np.mean(turns >= options.ticks):.0%} to the end" if title != "others of its herd" else ""
        print(f"{title}: {turns.mean():.1f} ± {error:.1f} turns, median {np.median(turns):.0f}{alive}")
    gained = found.own - found.same
    print(
        f"plans longer than by the rule in {np.mean(gained > 0):.0%} of the herds, shorter in {np.mean(gained < 0):.0%}"
    )
    return found


if __name__ == "__main__":
    main()
