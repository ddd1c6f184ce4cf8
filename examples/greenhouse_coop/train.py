"""Two agents learn to keep a greenhouse together, and what that is worth.

``python -m examples.greenhouse_coop.train`` (or ``make demo``) trains the waterer and the ventilator by evolution
(CMA-ES), looks for the best constant decisions to compare them with, and lets all of them keep greenhouses that they
have never seen. It prints a table and draws a picture. All of it happens in ``raw_env``, the PettingZoo environment of
both agents, in which ``RULE`` answers for agents that are to follow the model's rule.

The same options bring the same result, on any number of processes.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
from gymnasium import Space
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from tqdm import tqdm  # type: ignore[import-untyped]

from simenv_marl import RULE
from simenv_marl.envs import SimulationAECEnv

from ..evolution import evolve
from .env import DAYS, MOST_WATER, OBSERVED, raw_env

WATERER, VENTILATOR = "waterer_0", "ventilator_0"

HELD_OUT: Final = 1_000_000
"""Seeds from here on are for the final comparison; all others may be learnt from."""

NEXT: Final = """
What to do next:
  examples/greenhouse_coop/model.py  the model, which knows nothing of reinforcement learning
  examples/greenhouse_coop/env.py    its environments: what the two agents observe, decide and earn
  docs/tutorial.md                   an environment of a model of your own, step by step
  docs/clients.md                    training with Stable-Baselines3, TorchRL, RLlib and others
  make plan                          the same greenhouses kept by planning, without any training"""
"""Printed at the end."""

OUT: Final = Path(__file__).parent / "out"


# -- policies -------------------------------------------------------------------------------------

Policy = Callable[[NDArray[np.float32], Space[Any]], Any]
"""Chooses an action, given an observation and the space of actions."""


def anything(observation: NDArray[np.float32], space: Space[Any]) -> Any:
    """Choose at random."""
    return space.sample()


@dataclass(frozen=True)
class Constant:
    """Chooses the same always."""

    value: float

    def __call__(self, observation: NDArray[np.float32], space: Space[Any]) -> Any:
        """Choose an action."""
        return np.array([self.value], np.float32)


@dataclass(frozen=True)
class Linear:
    """Weighs what it observes; the logistic function makes an action of the sum.

    Attributes:
        weights: One for each part of the observation, and the sum in the middle of the observation space.
    """

    weights: NDArray[np.float64]

    def __call__(self, observation: NDArray[np.float32], space: Space[Any]) -> Any:
        """Choose an action."""
        total = float((observation - 0.5) @ self.weights[:-1] + self.weights[-1])
        return np.array([1 / (1 + math.exp(-total)) if total > -700 else 0.0], np.float32)


ONE_TRAINED, BOTH_TRAINED = "watering trained", "both trained"
"""Titles of the teams that are trained."""

Team = Mapping[str, Policy]
"""A policy for each agent; who has none follows the rule of the model."""


# -- playing --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Outcome:
    """How an episode went.

    Attributes:
        value: Its return: that of one agent, because all are rewarded for the same.
        alive: How many plants were alive at the beginning of each day, and at the end. All are dead in the days
            after an early end.
        poured: The litres poured on each day.
    """

    value: float
    alive: list[int]
    poured: list[float]


def play(environment: SimulationAECEnv, team: Team, seed: int) -> Outcome:
    """Play an episode.

    Args:
        environment: The environment of both agents.
        team: Who plays.
        seed: Which greenhouse they keep, in which weather.
    """
    environment.reset(seed=seed)
    greenhouse = environment.simulation.greenhouse
    spaces = {agent: environment.action_space(agent) for agent in environment.agents}
    share_alive = OBSERVED.index("share of the plants that are alive")
    value = 0.0
    alive: list[int] = []
    used: list[float] = []
    for agent in environment.agent_iter():
        observation, reward, terminated, truncated, _ = environment.last()
        if agent == VENTILATOR:  # asked first in each day, so that its rewards are those of all days
            value += reward
            alive.append(round(observation[share_alive] * len(greenhouse.pots)))
            used.append(greenhouse.water_use)
        if terminated or truncated:
            environment.step(None)
        elif agent in team:
            environment.step(team[agent](observation, spaces[agent]))
        else:
            environment.step(RULE)
    missing = DAYS + 1 - len(alive)
    return Outcome(value, alive + [0] * missing, np.diff(used + used[-1:] * missing).tolist())


class Crew:
    """Plays any number of episodes, in this process or in several others. A context manager."""

    def __init__(self, workers: int, bar: Any) -> None:
        """Hire the crew.

        Args:
            workers: In how many processes it plays.
            bar: A progress bar, which counts the episodes.
        """
        self._bar = bar
        self._open = ExitStack()
        self._executor: ProcessPoolExecutor | None = None
        self._workers = workers
        if workers == 1:
            self._environment = raw_env()
            self._open.callback(self._environment.close)
        else:
            # Spawned, as on every platform: forks of a process that may have threads are no good.
            context = multiprocessing.get_context("spawn")
            self._executor = ProcessPoolExecutor(workers, context, _hire)
            self._open.callback(self._executor.shutdown, cancel_futures=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()

    def play(self, teams: Sequence[Team], seeds: Iterable[int]) -> list[list[Outcome]]:
        """Let every team play every seed.

        Returns:
            A list for each team, with an outcome for each seed.
        """
        seeds = list(seeds)
        jobs = [(team, seed) for team in teams for seed in seeds]
        outcomes = []
        for outcome in self._map(jobs):
            outcomes.append(outcome)
            self._bar.update()
        return [outcomes[start : start + len(seeds)] for start in range(0, len(jobs), len(seeds))]

    def rate(self, teams: Sequence[Team], seeds: Iterable[int]) -> NDArray[np.float64]:
        """The mean return of every team over the seeds."""
        return np.array([_mean(outcomes) for outcomes in self.play(teams, seeds)])

    def say(self, what: str) -> None:
        """Show in the progress bar what is being done."""
        self._bar.set_description_str(f"{what:<24}")

    def _map(self, jobs: Sequence[tuple[Team, int]]) -> Iterable[Outcome]:
        if self._executor is None:
            return (play(self._environment, team, seed) for team, seed in jobs)
        # Several chunks for each, because episodes that end early would leave a process idle.
        return self._executor.map(_play, jobs, chunksize=max(1, len(jobs) // (6 * self._workers)))


_hired: list[SimulationAECEnv] = []
"""In a process of a crew: its environment."""


def _hire() -> None:
    _hired.append(raw_env())


def _play(job: tuple[Team, int]) -> Outcome:
    return play(_hired[0], *job)


def _mean(outcomes: Sequence[Outcome]) -> float:
    return float(np.mean([outcome.value for outcome in outcomes]))


# -- learning -------------------------------------------------------------------------------------

LITRES: Final = tuple(range(40, 101, 4))
EXCHANGES: Final = (0.2, 0.4, 0.6, 0.8, 1.0)

POPULATION: Final = 16
EPISODES_EACH: Final = 3
"""By how many episodes a candidate of a generation is judged."""


@dataclass(frozen=True)
class Schedule:
    """Of a budget of episodes, what is spent on what. Something is done of everything, however small the budget.

    Attributes:
        alone_seeds, pair_seeds: On how many seeds constant watering, and constant pairs, are tried.
        alone_generations, both_generations: For how many generations the waterer, and both, are trained.
    """

    alone_seeds: int
    pair_seeds: int
    alone_generations: int
    both_generations: int

    @classmethod
    def of(cls, budget: int) -> Self:
        """Divide a budget."""
        units = (len(LITRES), len(LITRES) * len(EXCHANGES), POPULATION * EPISODES_EACH, POPULATION * EPISODES_EACH)
        shares = (0.1, 0.25, 0.2, 0.45)
        return cls(*(max(1, int(budget * share) // unit) for share, unit in zip(shares, units, strict=True)))

    @property
    def episodes(self) -> int:
        """How many episodes that is."""
        constants = len(LITRES) * (self.alone_seeds + len(EXCHANGES) * self.pair_seeds)
        return constants + POPULATION * EPISODES_EACH * (self.alone_generations + self.both_generations)


def search(
    crew: Crew, litres: Sequence[float], exchanges: Sequence[float], seeds: Sequence[int]
) -> dict[str, Constant]:
    """Find the best constant decisions.

    Args:
        crew: Plays.
        litres: What to pour each day.
        exchanges: The fractions of air to exchange each day; empty: ventilation follows the rule.
        seeds: The seeds to try them on.
    """
    teams = [{WATERER: Constant(amount / MOST_WATER)} for amount in litres]
    if exchanges:
        teams = [team | {VENTILATOR: Constant(fraction)} for team in teams for fraction in exchanges]
    return teams[int(np.argmax(crew.rate(teams, seeds)))]


Rate = Callable[[Sequence[Team], Iterable[int]], NDArray[np.float64]]
"""Rates every team by its mean return over seeds."""


def learn(rate: Rate, start: Mapping[str, Constant], generations: int, rng: np.random.Generator) -> dict[str, Linear]:
    """Train linear policies together, by evolution of their weights.

    Args:
        rate: Rates the candidates of a generation, such as ``Crew.rate``.
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


def compare(options: argparse.Namespace) -> tuple[dict[str, list[Outcome]], dict[str, list[NDArray[np.float64]]]]:
    """Train, search, and let all policies keep the greenhouses of the held-out seeds.

    Returns:
        By the title of each team, the outcome for each seed; and by the title of each team that was trained, the mean
        return of each candidate of each generation.
    """
    curves: dict[str, list[NDArray[np.float64]]] = {ONE_TRAINED: [], BOTH_TRAINED: []}

    def rated(title: str) -> Rate:
        def rate(teams: Sequence[Team], seeds: Iterable[int]) -> NDArray[np.float64]:
            curves[title].append(crew.rate(teams, seeds))
            return curves[title][-1]

        return rate

    schedule = Schedule.of(options.budget)
    rng = np.random.default_rng(options.seed)
    total = schedule.episodes + 6 * options.seeds
    with tqdm(total=total, unit="episode", smoothing=0.05) as bar, Crew(options.workers, bar) as crew:
        crew.say("constant watering")
        alone = search(crew, LITRES, (), draw_seeds(rng, schedule.alone_seeds))
        crew.say("constant pairs")
        pair = search(crew, LITRES, EXCHANGES, draw_seeds(rng, schedule.pair_seeds))
        crew.say("training the waterer")
        waterer = learn(rated(ONE_TRAINED), alone, schedule.alone_generations, rng)
        crew.say("training both")
        both = learn(rated(BOTH_TRAINED), pair, schedule.both_generations, rng)
        poured, exchanged = alone[WATERER].value * MOST_WATER, 100 * pair[VENTILATOR].value
        teams: dict[str, Team] = {
            "rule": {},
            "random actions": {WATERER: anything, VENTILATOR: anything},
            f"constant watering ({poured:.0f} l)": alone,
            f"constant pair ({pair[WATERER].value * MOST_WATER:.0f} l, {exchanged:.0f} %)": pair,
            ONE_TRAINED: waterer,
            BOTH_TRAINED: both,
        }
        crew.say("held-out seeds")
        outcomes = crew.play(list(teams.values()), range(HELD_OUT, HELD_OUT + options.seeds))
        crew.say("done")
    return dict(zip(teams, outcomes, strict=True)), curves


def explain(outcomes: Sequence[Outcome]) -> str:
    """Say why the model's rule earns so little."""
    litres = max(max(outcome.poured) for outcome in outcomes)
    day = max(sum(number > 0 for number in outcome.alive) for outcome in outcomes)
    return f"{litres:.0f} litres a day drown all plants within {day} days, and dead plants earn nothing"


def tabulate(results: Mapping[str, Sequence[Outcome]]) -> Table:
    """Make the table of a comparison."""
    number = len(next(iter(results.values())))
    table = Table(title=f"{number} greenhouses that no policy was trained on: mean ± standard deviation")
    table.add_column("who decides")
    for column in ("return", f"alive, day {DAYS}", "litres poured"):
        table.add_column(column, justify="right")
    for title, outcomes in results.items():
        columns = (
            ([outcome.value for outcome in outcomes], ".1f"),
            ([outcome.alive[-1] for outcome in outcomes], ".0f"),
            ([sum(outcome.poured) for outcome in outcomes], ".0f"),
        )
        cells = [f"{np.mean(values):{form}} ± {np.std(values):<4{form}}" for values, form in columns]
        table.add_row(title, *cells, style="bold" if title == BOTH_TRAINED else None)
    return table


def parse(arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Read the options of the command line."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    parser = argparse.ArgumentParser(description="Train two agents to keep a greenhouse together.")
    parser.add_argument("--budget", type=int, default=3600, help="episodes to learn from (default: %(default)s)")
    parser.add_argument("--seeds", type=int, default=32, help="greenhouses to compare on (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="determines everything (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=cores, help="processes (default: one for each core)")
    parser.add_argument("--out", type=Path, default=OUT, help="folder for the picture (default: beside this file)")
    options = parser.parse_args(arguments)
    for name in ("budget", "seeds", "workers"):
        if getattr(options, name) < 1:
            parser.error(f"--{name} must be at least 1")
    return options


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare, and show the result as a table and as a picture."""
    from .picture import draw

    options = parse(arguments)
    results, curves = compare(options)
    console = Console()
    console.print(tabulate(results))
    titles = list(results)
    gains = [a.value - b.value for a, b in zip(results[titles[-1]], results[titles[3]], strict=True)]
    console.print(
        f"Both trained against the best constant pair: {np.mean(gains):+.1f}"
        f" (better in {sum(gain > 0 for gain in gains)} of {len(gains)})"
    )
    because = explain(results["rule"])
    console.print(f"Why the rule earns {_mean(results['rule']):.1f}: {because}.", soft_wrap=True)
    path = draw(
        {title: [outcome.value for outcome in outcomes] for title, outcomes in results.items()},
        {title: np.array([outcome.alive for outcome in outcomes]) for title, outcomes in results.items()},
        {title: np.array([outcome.poured for outcome in outcomes]) for title, outcomes in results.items()},
        options.out,
        title="Two agents learn to keep a greenhouse: one decides the water, the other the ventilation",
        notes={"rule": because},
        curves=curves,
    )
    console.print(f"Picture: {path}", soft_wrap=True)
    console.print(NEXT, soft_wrap=True, highlight=False)


if __name__ == "__main__":
    main()
