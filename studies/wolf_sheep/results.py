"""Evaluation of the trained policies on held-out meadows.

``python -m studies.wolf_sheep.results`` evaluates the policies of ``train`` and several baselines,
and writes the results to ``docs/figures/shared-policy.json``. It needs TorchRL (the extra
``clients``); ``python -m studies.wolf_sheep.picture``, which draws the results, does not.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from examples.wolf_sheep.env import DIRECTIONS, MOVE, SIGHT, Meadow, cells, numbers, sheep_points
from examples.wolf_sheep.train import HELD_OUT, OUT, SIGHTS, Herd, policies_of
from examples.wolf_sheep.train import TICKS as TRAINED_FOR
from numpy.typing import NDArray
from tqdm import tqdm  # type: ignore[import-untyped]

from simenv_marl import RULE
from simenv_marl.data import Trajectories, collect_episodes

RESULTS: Final = Path(__file__).parents[2] / "docs" / "figures" / "shared-policy.json"

LIVES: Final = 60
"""The number of turns in survival curves."""

UNTRAINED: Final = 3
"""The number of untrained policies in the comparison."""

Policy = Callable[[NDArray[np.float32]], Any]


# -- baselines ------------------------------------------------------------------------------------


def by_rule(observations: NDArray[np.float32]) -> list[Any]:
    """Follow the model's rule."""
    return [RULE] * len(observations)


def at_random(seed: int) -> Policy:
    """Make a random policy."""
    generator = np.random.default_rng(seed)
    return lambda observations: generator.integers(len(DIRECTIONS), size=len(observations))


def by_hand(observations: NDArray[np.float32]) -> Any:
    """Go to the cell with the fewest wolves next to it.

    Of several, to one with grass; else to the first.

    This needs two steps of sight, and follows from the model's code: wolves move to neighbouring
    cells. So a sheep is in danger next to a wolf, and safe in the wolf's own cell, which is the
    cell that the model's rule avoids.
    """
    seen = cells(2)
    grass, wolves, _ = np.split(observations[:, 1:], 3, axis=1)
    worth = []
    for row, column in DIRECTIONS:
        beside = [seen.index((row + step[0], column + step[1])) for step in DIRECTIONS]
        worth.append(grass[:, seen.index((row, column))] - 2 * wolves[:, beside].sum(axis=1))
    return np.argmax(worth, axis=0)


# -- the comparison -------------------------------------------------------------------------------


def play(policy: Policy, sight: int, seeds: Sequence[int], **parameters: Any) -> Trajectories:
    """Run meadows in which all sheep follow a policy.

    Returns:
        The trajectories of the sheep, with the ``numbers`` of each meadow as ``collected``.
    """
    found = collect_episodes(
        lambda: Meadow(**parameters),
        {MOVE: policy},
        points=sheep_points(sight),
        seeds=seeds,
        collect=numbers,
    )
    return found[MOVE]


def lives(
    lengths: NDArray[np.int64], died: NDArray[np.bool_], turns: int = LIVES
) -> NDArray[np.float64]:
    """Estimate the survival curve of sheep by Kaplan and Meier's method: some lives are censored.

    Args:
        lengths: The number of turns of each sheep.
        died: Whether each sheep died in its last turn; the others lived until the end of the
            episode.
        turns: The number of turns of the curve.

    Returns:
        ``(turns + 1,)``: the share of sheep that survive each number of turns.
    """
    shares = [1.0]
    for turn in range(1, turns + 1):
        there, dead = np.count_nonzero(lengths >= turn), np.count_nonzero(lengths[died] == turn)
        shares.append(shares[-1] * (1 - dead / there) if there else float("nan"))
    return np.array(shares)


def summary(played: Sequence[Trajectories]) -> dict[str, Any]:
    """Summarise the results for sheep and wolves.

    Args:
        played: The trajectories on the same meadows under each of several policies of the same
            training; or one.
    """
    counts = {
        kind: np.array([one[kind] for found in played for one in found.collected or ()])
        for kind in ("sheep", "wolves")
    }
    lengths = np.concatenate([found.lengths for found in played])
    ends = [found.starts + found.lengths - 1 for found in played]
    died = np.concatenate(
        [found.terminations[own] for found, own in zip(played, ends, strict=True)]
    )
    energies = np.concatenate([found.last_observations[:, 0] for found in played])
    deaths = max(1, int(died.sum()))
    shares = [
        float(np.mean([one["sheep"][-1] > 0 for one in found.collected or ()])) for found in played
    ]
    return {
        "survived": [round(share, 3) for share in shares],
        "sheep at the end": [
            float(value) for value in np.percentile(counts["sheep"][:, -1], (25, 50, 75))
        ],
        "wolves survived": round(float((counts["wolves"][:, -1] > 0).mean()), 3),
        "turns per death": round(float(lengths.sum()) / deaths, 2),
        "starved": round(float((energies[died] < 0).sum()) / deaths, 3),
        "sheep while training": round(float(counts["sheep"][:, :TRAINED_FOR].mean()), 2),
        "numbers": {
            kind: {
                str(part): np.percentile(values, part, axis=0).round(1).tolist()
                for part in (25, 50, 75)
            }
            for kind, values in counts.items()
        },
        "lives": [
            None if np.isnan(share) else round(float(share), 4) for share in lives(lengths, died)
        ],
    }


def compare(folder: Path, seeds: Sequence[int], **parameters: Any) -> dict[str, Any]:
    """Evaluate all policies on the same meadows.

    Args:
        folder: The folder of the trained policies; all of them take part.
        seeds: The seeds of the meadows.
        **parameters: The parameters of ``Meadow``.
    """
    contenders: dict[str, Sequence[tuple[Policy, int]]] = {
        "the model's rule": [(by_rule, SIGHT)],
        "random moves": [(at_random(0), SIGHT)],
        "untrained": [(Herd(SIGHT, seed).decide, SIGHT) for seed in range(UNTRAINED)],
        "by hand, two steps of sight": [(by_hand, 2)],
    }
    for sight in SIGHTS:
        title = f"trained, {'one step' if sight == 1 else 'two steps'} of sight"
        contenders[title] = [
            (Herd.load(path, sight).decide, sight) for path in policies_of(sight, folder)
        ]
    results: dict[str, Any] = {}
    with tqdm(total=sum(map(len, contenders.values())), unit="policy") as bar:
        for title, policies in contenders.items():
            played = []
            for policy, sight in policies:
                played.append(play(policy, sight, seeds, **parameters))
                bar.update()
            if played:
                results[title] = summary(played)
    return {"meadows": len(seeds), "results": results}


def write(results: Mapping[str, Any], path: Path) -> None:
    """Write the results as JSON, with one line for each list of numbers."""
    text = re.sub(
        r"\[[^][{}]*\]", lambda found: " ".join(found[0].split()), json.dumps(results, indent=1)
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n")


def main(arguments: Sequence[str] | None = None) -> None:
    """Evaluate all policies, and write the results."""
    parser = argparse.ArgumentParser(
        description="Evaluate the sheep's policies on held-out meadows."
    )
    parser.add_argument(
        "--meadows", type=int, default=16, help="number of meadows (default: %(default)s)"
    )
    parser.add_argument(
        "--out", type=Path, default=OUT, help="folder of the policies (default: beside this file)"
    )
    parser.add_argument(
        "--results", type=Path, default=RESULTS, help="file to write (default: %(default)s)"
    )
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    write(compare(options.out, range(HELD_OUT, HELD_OUT + options.meadows)), options.results)


if __name__ == "__main__":
    main()
