"""Behaviour cloning: a network learns the model's ventilation rule, and ventilates in its place.

``python -m studies.imitation.rule`` lets the rule ventilate some greenhouses, records its decisions
as a Minari data set, and clones its behaviour with TorchRL. It then compares rule and clone in
held-out greenhouses: decision by decision, by return, and in the model's own loop. It needs
``pip install "simenv-marl[minari]" torchrl``.

The rule is that of the paper's plugin, which exchanges more air at higher temperatures; a fixed 20
% would be too easy to learn. The waterer pours a constant amount that the plants can take, because
with the model's rule all plants die within days.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable, Sequence
from typing import Any, Final
from unittest.mock import patch

import minari
import numpy as np
import torch
from examples.greenhouse_coop.env import (
    ACTION_SPACE,
    MOST_WATER,
    OBSERVATION_SPACE,
    OBSERVED,
    VENTILATOR,
    WATERER,
    WATERING,
    GreenhouseSim,
    observe,
    reward,
    to_fraction,
)
from examples.greenhouse_coop.model import Greenhouse
from examples.greenhouse_coop.train import HELD_OUT
from numpy.typing import NDArray
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.modules import MLP
from torchrl.objectives import BCLoss

from simenv_marl import RULE, make_step, simulate
from simenv_marl.data import collect_episodes, compare_with_rule, record_dataset
from simenv_marl.experiments import Variant

from ..greenhouse_matrix.variants import AIR_EXCHANGE

DATASET: Final = "greenhouse/ventilator-rule-v0"

TOLERANCE: Final = 0.01
"""Actions that differ by at most this much count as equal: one per cent of the air."""


# -- the model and its decisions ------------------------------------------------------------------


@make_step(
    observation_space=OBSERVATION_SPACE,
    observation_space_mapping=observe,
    action_space=ACTION_SPACE,
    action_space_mapping=to_fraction,
    rule_action_mapping=lambda fraction: [fraction],
    reward_mapping=reward,
    agent="ventilator_0",
)
def choose_air_exchange(greenhouse: Greenhouse) -> float:
    """Choose the fraction of air to replace, by the temperature (paper, section 4, step 3)."""
    return (greenhouse.temp - 15) / 20


def decided_air_exchange(greenhouse: Greenhouse) -> None:
    """Exchange the chosen fraction of the air."""
    fraction = choose_air_exchange(greenhouse)
    greenhouse.humidity = (
        1 - fraction
    ) * greenhouse.humidity + fraction * greenhouse.outside_humidity


WARM: Final = Variant(
    "ventilated_by_warmth",
    GreenhouseSim,
    points={**WATERING, choose_air_exchange: None},
    plugins=[(decided_air_exchange, AIR_EXCHANGE, "instead")],
)
"""Two agents: the waterer, and one that ventilates as the paper's plugin does."""


def sparing(observations: NDArray[np.float32]) -> NDArray[np.float32]:
    """Pour sixty litres a day."""
    return np.full((len(observations), 1), 60 / MOST_WATER, np.float32)


# -- learning -------------------------------------------------------------------------------------

Policy = Callable[[NDArray[np.float32]], NDArray[np.float32]]
"""Maps a batch of observations to a batch of actions."""


def clone(dataset: minari.MinariDataset, steps: int) -> Policy:
    """Train a policy by behaviour cloning.

    Args:
        dataset: The recorded observations and actions.
        steps: The number of training batches.
    """
    episodes = list(dataset)
    data = TensorDict(
        {
            "observation": torch.as_tensor(
                np.concatenate([episode.observations[:-1] for episode in episodes])
            ),
            "action": torch.as_tensor(np.concatenate([episode.actions for episode in episodes])),
        },
        [dataset.total_steps],
    )
    network = MLP(in_features=len(OBSERVED), out_features=1, num_cells=[32, 32])
    loss = BCLoss(TensorDictModule(network, ["observation"], ["action"]), loss_function="mse")
    optimizer = torch.optim.Adam(loss.parameters(), 3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        loss(data[torch.randint(len(data), (256,))])["loss_bc"].backward()
        optimizer.step()
        schedule.step()

    def policy(observations: NDArray[np.float32]) -> NDArray[np.float32]:
        with torch.no_grad():
            actions: NDArray[np.float32] = (
                network(torch.as_tensor(observations)).clamp(0, 1).numpy()
            )
        return actions

    return policy


# -- the comparison -------------------------------------------------------------------------------


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Record the rule's decisions, clone them, and compare.

    Returns:
        The share of decisions in which both agree, and the mean return with each.
    """
    parser = argparse.ArgumentParser(
        description="Clone the ventilation rule from a data set, and compare."
    )
    parser.add_argument(
        "--episodes", type=int, default=50, help="greenhouses to learn from (default: %(default)s)"
    )
    parser.add_argument(
        "--steps", type=int, default=3000, help="batches to learn from (default: %(default)s)"
    )
    parser.add_argument(
        "--seeds", type=int, default=32, help="greenhouses to compare on (default: %(default)s)"
    )
    options = parser.parse_args(arguments)
    torch.manual_seed(0)
    torch.set_num_threads(1)
    # a temporary folder; leave this line out to keep the data set
    with (
        tempfile.TemporaryDirectory() as folder,
        patch.dict(os.environ, MINARI_DATASETS_PATH=folder),
    ):
        record_dataset(
            {VENTILATOR: DATASET},
            WARM,
            {WATERER: sparing, VENTILATOR: RULE},
            seeds=range(options.episodes),
        )
        learned = clone(minari.load_dataset(DATASET), options.steps)

    unseen = range(HELD_OUT, HELD_OUT + options.seeds)
    compared = compare_with_rule(
        WARM, {VENTILATOR: learned}, others={WATERER: sparing}, seeds=unseen, tolerance=TOLERANCE
    )[VENTILATOR]
    differences = np.abs(compared.policy_actions - compared.trajectories.actions)
    print(
        f"agreement: {compared.agreement:.1%} of the decisions; largest difference:"
        f" {differences.max():.3f}"
    )
    results = {"agreement": compared.agreement}
    for title, ventilate in (("rule", RULE), ("imitation", learned)):
        collected = collect_episodes(WARM, {WATERER: sparing, VENTILATOR: ventilate}, seeds=unseen)
        # the team's return, as both agents get the same reward
        values = collected[VENTILATOR].returns
        results[title] = float(values.mean())
        print(f"{title}: return {values.mean():.2f} ± {values.std():.2f}")
    for title, alone in (("rule", RULE), ("imitation", one_by_one(learned))):
        simulation = simulate(
            WARM, {WATERER: one_by_one(sparing), VENTILATOR: alone}, seed=HELD_OUT
        )
        print(f"{title}, in the model itself, seed {HELD_OUT}: {simulation.render('ansi')}")
    return results


def one_by_one(policy: Policy) -> Callable[[Any], Any]:
    """Turn a policy for batches into one for single observations."""
    return lambda observation: policy(observation[None])[0]


if __name__ == "__main__":
    main()
