"""What the trained policies are worth, on meadows that none of them has seen.

``python -m examples.wolf_sheep.results`` lets the policies of ``train`` and those that they are compared with lead the
sheep, and writes what has become of them to ``docs/figures/shared-policy.json``. It needs TorchRL (the extra
``clients``); ``python -m examples.wolf_sheep.picture``, which shows it, does not.
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
from numpy.typing import NDArray
from tqdm import tqdm  # type: ignore[import-untyped]

from simenv_marl import RULE, Trajectories, collect_episodes

from .env import DIRECTIONS, MOVE, SIGHT, Meadow, cells, numbers, sheep_points
from .train import HELD_OUT, OUT, SIGHTS, Herd, policies_of
from .train import TICKS as TRAINED_FOR

RESULTS: Final = Path(__file__).parents[2] / "docs" / "figures" / "shared-policy.json"

LIVES: Final = 60
"""How many turns of a life are told."""

UNTRAINED: Final = 3
"""How many policies that have learnt nothing are among those that are compared."""

Policy = Callable[[NDArray[np.float32]], Any]


# -- whom the trained are compared with -----------------------------------------------------------


def by_rule(observations: NDArray[np.float32]) -> list[Any]:
    """Leave it to the model."""
    return [RULE] * len(observations)


def at_random(seed: int) -> Policy:
    """Make a policy that goes anywhere."""
    generator = np.random.default_rng(seed)
    return lambda observations: generator.integers(len(DIRECTIONS), size=len(observations))


def by_hand(observations: NDArray[np.float32]) -> Any:
    """Go where the fewest wolves are beside the cell; of such cells where there is grass; else to the first.

    It takes two steps of sight, and is what one comes to who has read the model: wolves go to cells beside their own.
    So sheep are in danger beside a wolf, and in none in the same cell, which is the one that the model's rule avoids.
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
    """Let all sheep be led by a policy.

    Returns:
        What the sheep have lived through, with the ``numbers`` of each meadow as what was collected.
    """
    found = collect_episodes(
        lambda: Meadow(**parameters),
        {MOVE: policy},
        points=sheep_points(sight),
        seeds=seeds,
        collect=numbers,
    )
    return found[MOVE]


def lives(lengths: NDArray[np.int64], died: NDArray[np.bool_], turns: int = LIVES) -> NDArray[np.float64]:
    """Estimate which share of the sheep live for at least so many turns, some of whose lives were cut off.

    Args:
        lengths: How many turns each has had.
        died: Whether it has died of the last one; the others have seen the end of the episode (the estimate is Kaplan
            and Meier's).
        turns: For how many turns to tell it.

    Returns:
        ``(turns + 1,)``: for each number of turns, the share that survive them.
    """
    shares = [1.0]
    for turn in range(1, turns + 1):
        there, dead = np.count_nonzero(lengths >= turn), np.count_nonzero(lengths[died] == turn)
        shares.append(shares[-1] * (1 - dead / there) if there else float("nan"))
    return np.array(shares)


def summary(played: Sequence[Trajectories]) -> dict[str, Any]:
    """Sum up what has become of the sheep, and of the wolves.

    Args:
        played: What the same sheep have lived through on the same meadows, with each of several policies that were
            trained alike; or with one.
    """
    counts = {
        kind: np.array([one[kind] for found in played for one in found.collected or ()]) for kind in ("sheep", "wolves")
    }
    lengths = np.concatenate([found.lengths for found in played])
    ends = [found.starts + found.lengths - 1 for found in played]
    died = np.concatenate([found.terminations[own] for found, own in zip(played, ends, strict=True)])
    energies = np.concatenate([found.last_observations[:, 0] for found in played])
    deaths = max(1, int(died.sum()))
    shares = [float(np.mean([one["sheep"][-1] > 0 for one in found.collected or ()])) for found in played]
    return {
        "survived": [round(share, 3) for share in shares],
        "sheep at the end": [float(value) for value in np.percentile(counts["sheep"][:, -1], (25, 50, 75))],
        "wolves survived": round(float((counts["wolves"][:, -1] > 0).mean()), 3),
        "turns per death": round(float(lengths.sum()) / deaths, 2),
        "starved": round(float((energies[died] < 0).sum()) / deaths, 3),
        "sheep while training": round(float(counts["sheep"][:, :TRAINED_FOR].mean()), 2),
        "numbers": {
            kind: {str(part): np.percentile(values, part, axis=0).round(1).tolist() for part in (25, 50, 75)}
            for kind, values in counts.items()
        },
        "lives": [None if np.isnan(share) else round(float(share), 4) for share in lives(lengths, died)],
    }


def compare(folder: Path, seeds: Sequence[int], **parameters: Any) -> dict[str, Any]:
    """Let all policies lead the sheep of the same meadows.

    Args:
        folder: Where the trained policies are; as many as there are.
        seeds: Of the meadows.
        **parameters: As ``Meadow`` takes them.
    """
    contenders: dict[str, Sequence[tuple[Policy, int]]] = {
        "the model's rule": [(by_rule, SIGHT)],
        "random moves": [(at_random(0), SIGHT)],
        "untrained": [(Herd(SIGHT, seed).decide, SIGHT) for seed in range(UNTRAINED)],
        "by hand, two steps of sight": [(by_hand, 2)],
    }
    for sight in SIGHTS:
        title = f"trained, {'one step' if sight == 1 else 'two steps'} of sight"
        contenders[title] = [(Herd.load(path, sight).decide, sight) for path in policies_of(sight, folder)]
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
    """Write them, a line for each list of numbers."""
    text = re.sub(r"\[[^][{}]*\]", lambda found: " ".join(found[0].split()), json.dumps(results, indent=1))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text + "\n")


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare, and write down the results."""
    parser = argparse.ArgumentParser(description="Compare the policies that lead the sheep.")
    parser.add_argument("--meadows", type=int, default=16, help="to compare on (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=OUT, help="where the policies are (default: beside this file)")
    parser.add_argument("--results", type=Path, default=RESULTS, help="file to write (default: %(default)s)")
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    write(compare(options.out, range(HELD_OUT, HELD_OUT + options.meadows)), options.results)


if __name__ == "__main__":
    main()
