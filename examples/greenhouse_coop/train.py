"""Two agents learn to keep a greenhouse together, and what that is worth.

``python -m examples.greenhouse_coop.train`` trains the waterer and the ventilator by evolution
(CMA-ES), looks for the best constant decisions to compare them with, and lets all of them keep
greenhouses that they have never seen. It prints a table, and writes the results to a file;
``make demo`` draws a picture of them, too. All of it happens in ``raw_env``, the PettingZoo
environment of both agents, in which ``RULE`` answers for agents that are to follow the model's
rule.

The same options bring the same result, on any number of processes.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium import Space
from numpy.typing import NDArray

from simenv_marl import RULE

from ..evolution import evolve
from .env import DAYS, MOST_WATER, OBSERVED, VENTILATOR, WATERER, raw_env

HELD_OUT: Final = 1_000_000
"""Seeds from here on are for the final comparison; all others may be learnt from."""

OUT: Final = Path(__file__).parent / "out"
"""The folder of results; it is not under version control."""

NEXT: Final = """
What to do next:
  examples/greenhouse_coop/model.py  the model, which knows nothing of reinforcement learning
  examples/greenhouse_coop/env.py    its environments: what the two agents observe, decide and earn
  docs/tutorial.md                   an environment of a model of your own, step by step
  docs/clients.md                    training with Stable-Baselines3, TorchRL, RLlib and others
  make plan                          the same greenhouses kept by planning, without any training"""


# -- policies -------------------------------------------------------------------------------------

Policy = Callable[[NDArray[np.float32], Space[Any]], Any]
"""Chooses an action, given an observation and the space of actions."""

Team = Mapping[str, Policy]
"""A policy for each agent; who has none follows the rule of the model."""


def anything(observation: NDArray[np.float32], space: Space[Any]) -> Any:
    """Choose at random."""
    return space.sample()


@dataclass(frozen=True)
class Constant:
    """Chooses the same always, for one observation or for a batch."""

    value: float

    def __call__(self, observation: NDArray[np.float32], _: Any = None) -> NDArray[np.float32]:
        """Choose an action."""
        return np.full((*observation.shape[:-1], 1), self.value, np.float32)


@dataclass(frozen=True)
class Linear:
    """Weighs what it observes; the logistic function makes an action of the sum.

    Attributes:
        weights: One for each part of the observation, and the sum in the middle of the observation
            space.
    """

    weights: NDArray[np.float64]

    def __call__(self, observation: NDArray[np.float32], _: Any = None) -> NDArray[np.float32]:
        """Choose an action."""
        total = float((observation - 0.5) @ self.weights[:-1] + self.weights[-1])
        return np.array([1 / (1 + math.exp(-total)) if total > -700 else 0.0], np.float32)


# -- playing --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """How an episode went.

    Attributes:
        value: Its return: that of one agent, because all are rewarded for the same.
        alive: How many plants were alive at the beginning of each day, and at the end. All are dead
            in the days after an early end.
        poured: The litres poured on each day.
    """

    value: float
    alive: list[int]
    poured: list[float]


def play(team: Team, seed: int) -> Outcome:
    """Let a team play an episode; the seed says which greenhouse it keeps, in which weather."""
    environment = raw_env()
    environment.reset(seed=seed)
    greenhouse = environment.simulation.greenhouse
    share_alive = OBSERVED.index("share of the plants that are alive")
    value, alive, used = 0.0, [], []
    for agent in environment.agent_iter():
        observation, reward, terminated, truncated, _ = environment.last()
        if agent == VENTILATOR:  # asked first in each day: its rewards are those of all days
            value += reward
            alive.append(round(observation[share_alive] * len(greenhouse.pots)))
            used.append(greenhouse.water_use)
        if terminated or truncated:
            environment.step(None)
        elif agent in team:
            environment.step(team[agent](observation, environment.action_space(agent)))
        else:
            environment.step(RULE)
    environment.close()
    missing = DAYS + 1 - len(alive)
    return Outcome(value, alive + [0] * missing, np.diff(used + used[-1:] * missing).tolist())


Run = Callable[[Callable[..., Outcome], Sequence[Team], Sequence[int]], Iterable[Outcome]]
"""Calls a function for each team and seed, like Python's ``map`` or that of several processes."""


def play_all(teams: Sequence[Team], seeds: Iterable[int], run: Run = map) -> list[list[Outcome]]:
    """Let every team play every seed.

    Return a list for each team, with an outcome for each seed.
    """
    seeds = list(seeds)
    outcomes = list(run(play, [team for team in teams for _ in seeds], seeds * len(teams)))
    return [outcomes[start : start + len(seeds)] for start in range(0, len(outcomes), len(seeds))]


def rate(teams: Sequence[Team], seeds: Iterable[int], run: Run = map) -> NDArray[np.float64]:
    """Compute the mean return of every team over the seeds."""
    played = play_all(teams, seeds, run)
    return np.array([np.mean([outcome.value for outcome in outcomes]) for outcomes in played])


# -- learning -------------------------------------------------------------------------------------

LITRES: Final = tuple(range(40, 101, 4))
EXCHANGES: Final = (0.2, 0.4, 0.6, 0.8, 1.0)
"""The constant decisions to try: what to pour each day, and the fraction of the air to exchange."""

POPULATION: Final = 16
EPISODES_EACH: Final = 3
"""By how many episodes a candidate of a generation is judged."""

Rate = Callable[[Sequence[Team], Iterable[int]], NDArray[np.float64]]
"""Rates every team by its mean return over seeds."""


def learn(
    rate: Rate, start: Mapping[str, Constant], generations: int, rng: np.random.Generator
) -> dict[str, Linear]:
    """Train linear policies together, by evolution of their weights.

    Args:
        rate: Rates the candidates of a generation.
        start: For each agent that is to learn, the constant decision that it begins with.
        generations: For how long.
        rng: Draws everything that is drawn.
    """
    size = len(OBSERVED) + 1
    first = np.zeros((len(start), size))
    for weights, constant in zip(first, start.values(), strict=True):
        value = min(max(constant.value, 0.02), 0.98)  # from farther out there is no way back
        weights[-1] = math.log(value / (1 - value))

    def team(weights: NDArray[np.float64]) -> dict[str, Linear]:
        return dict(zip(start, map(Linear, weights.reshape(-1, size)), strict=True))

    def rated(candidates: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
        return rate([team(weights) for weights in candidates], draw_seeds(rng, EPISODES_EACH))

    return team(evolve(rated, first.ravel(), generations, rng, POPULATION))


def draw_seeds(rng: np.random.Generator, number: int) -> list[int]:
    """Draw seeds to learn from."""
    return [int(seed) for seed in rng.integers(HELD_OUT, size=number)]


# -- the comparison -------------------------------------------------------------------------------

ONE_TRAINED, BOTH_TRAINED = "watering trained", "both trained"
"""Titles of the teams that are trained."""

Curves = dict[str, list[NDArray[np.float64]]]
"""By the title of each trained team, the mean return of each candidate of each generation."""


def compare(
    budget: int, seeds: int, seed: int, workers: int
) -> tuple[dict[str, list[Outcome]], Curves]:
    """Search, train, and let all policies keep the greenhouses of the held-out seeds.

    Args:
        budget: The episodes to learn from: a tenth, a quarter, a fifth and 45 % of them go to
            constant watering, constant pairs, the waterer's training and the training of both.
        seeds: The number of held-out seeds.
        seed: Determines everything.
        workers: The number of processes.

    Returns:
        By the title of each team, the outcome for each seed; and the course of learning.
    """
    # Large libraries slow down forks, so they are imported where they are used.
    from tqdm import tqdm  # type: ignore[import-untyped]

    curves: Curves = {ONE_TRAINED: [], BOTH_TRAINED: []}
    rng = np.random.default_rng(seed)
    # forks of a process that may have threads are no good
    spawned = multiprocessing.get_context("spawn")
    with (
        ProcessPoolExecutor(workers, spawned) as pool,
        tqdm(total=budget + 6 * seeds, unit="episode", desc="constant amounts", delay=5) as bar,
    ):

        def run(
            function: Callable[..., Outcome], teams: Sequence[Team], seeds: Sequence[int]
        ) -> Iterable[Outcome]:
            # Several chunks for each process, because episodes that end early would leave it idle.
            for outcome in pool.map(
                function, teams, seeds, chunksize=max(1, len(seeds) // (6 * workers))
            ):
                bar.update()
                yield outcome

        def best(teams: Sequence[dict[str, Constant]], share: float) -> dict[str, Constant]:
            number = max(1, int(budget * share) // len(teams))
            return teams[int(np.argmax(rate(teams, draw_seeds(rng, number), run)))]

        def trained(title: str, start: Mapping[str, Constant], share: float) -> dict[str, Linear]:
            def rated(teams: Sequence[Team], seeds: Iterable[int]) -> NDArray[np.float64]:
                curves[title].append(rate(teams, seeds, run))
                return curves[title][-1]

            bar.set_description_str(title)
            return learn(
                rated, start, max(1, int(budget * share) // (POPULATION * EPISODES_EACH)), rng
            )

        waterers = [{WATERER: Constant(amount / MOST_WATER)} for amount in LITRES]
        alone = best(waterers, 0.1)
        pair = best(
            [
                team | {VENTILATOR: Constant(fraction)}
                for team in waterers
                for fraction in EXCHANGES
            ],
            0.25,
        )
        poured, exchanged = pair[WATERER].value * MOST_WATER, 100 * pair[VENTILATOR].value
        teams: dict[str, Team] = {
            "rule": {},
            "random actions": {WATERER: anything, VENTILATOR: anything},
            f"constant watering ({alone[WATERER].value * MOST_WATER:.0f} l)": alone,
            f"constant pair ({poured:.0f} l, {exchanged:.0f} %)": pair,
            ONE_TRAINED: trained(ONE_TRAINED, alone, 0.2),
            BOTH_TRAINED: trained(BOTH_TRAINED, pair, 0.45),
        }
        bar.set_description_str("held-out seeds")
        outcomes = play_all(list(teams.values()), range(HELD_OUT, HELD_OUT + seeds), run)
    return dict(zip(teams, outcomes, strict=True)), curves


def tabulate(title: str, columns: Mapping[str, str], rows: Mapping[str, Sequence[Any]]) -> None:
    """Print a table.

    Args:
        title: Its title.
        columns: The title and the format of each column.
        rows: By the title of each team, the values of each column, one for each greenhouse, or a
            number.
    """
    from rich.console import Console
    from rich.table import Table

    table = Table(title=title)
    table.add_column("who decides")
    for column in columns:
        table.add_column(column, justify="right")
    for who, values in rows.items():
        cells = [
            f"{own:{form}}"
            if isinstance(own, float)
            else f"{np.mean(own):{form}} ± {np.std(own):<4{form}}"
            for own, form in zip(values, columns.values(), strict=True)
        ]
        table.add_row(who, *cells, style="bold" if who == BOTH_TRAINED else None)
    Console().print(table)


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare, print the result as a table, and write it to a file."""
    parser = argparse.ArgumentParser(description="Train two agents to keep a greenhouse together.")
    parser.add_argument(
        "--budget", type=int, default=3600, help="episodes to learn from (default: %(default)s)"
    )
    parser.add_argument(
        "--seeds", type=int, default=32, help="greenhouses to compare on (default: %(default)s)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="determines everything (default: %(default)s)"
    )
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="processes (default: %(default)s)"
    )
    parser.add_argument(
        "--out", type=Path, default=OUT, help="folder for the results (default: beside this file)"
    )
    options = parser.parse_args(arguments)
    if min(options.budget, options.seeds, options.workers) < 1:
        parser.error("--budget, --seeds and --workers must be at least 1")
    results, curves = compare(options.budget, options.seeds, options.seed, options.workers)
    returns = {
        title: [outcome.value for outcome in outcomes] for title, outcomes in results.items()
    }
    alive = {title: [outcome.alive for outcome in outcomes] for title, outcomes in results.items()}
    poured = {
        title: [outcome.poured for outcome in outcomes] for title, outcomes in results.items()
    }
    tabulate(
        f"{options.seeds} greenhouses that no policy was trained on: mean ± standard deviation",
        {"return": ".1f", f"alive, day {DAYS}": ".0f", "litres poured": ".0f"},
        {
            who: (returns[who], np.array(alive[who])[:, -1], np.sum(poured[who], axis=1))
            for who in results
        },
    )
    _, _, _, pair, _, both = returns.values()
    gains = np.subtract(both, pair)
    better = f"better in {np.sum(gains > 0)} of {len(gains)}"
    print(f"Both trained against the best constant pair: {np.mean(gains):+.1f} ({better})")
    most, days = np.max(poured["rule"]), np.max(np.sum(np.array(alive["rule"]) > 0, axis=1))
    because = (
        f"{most:.0f} litres a day drown all plants within {days} days, and dead plants earn nothing"
    )
    print(f"Why the rule earns {np.mean(returns['rule']):.1f}: {because}.")
    options.out.mkdir(parents=True, exist_ok=True)
    learnt = {title: np.array(own).tolist() for title, own in curves.items()}
    told = {
        "returns": returns,
        "alive": alive,
        "poured": poured,
        "notes": {"rule": because},
        "curves": learnt,
    }
    (options.out / "greenhouse.json").write_text(json.dumps(told), encoding="utf-8")
    print(f"Results: {options.out / 'greenhouse.json'}")
    print(NEXT)


if __name__ == "__main__":
    main()
