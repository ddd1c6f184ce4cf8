"""Credit assignment: an action's advantage, by branches and by returns less a learned baseline.

``python -m studies.credit.estimators`` goes to decisions of the greenhouse's two agents and of the
sheep on Mesa's meadow, and draws an action for each. The advantage of the action is the difference
between its value and the value of the base policy's action, where the base policy continues after
both. The script compares several estimators of it with the same ground truth, the mean over many
futures to the end, and counts their cost in simulated days (ticks of the meadow):

- the return of one future after the action, less a baseline that was learned from episodes of the
  base policy: the estimator of policy gradients;
- the difference between two branches of ``action_values``, in the same future or in two independent
  ones;
- the same, cut off after a few days, with the baseline as terminal value.

It prints a table in Markdown. The cost does not include the days for learning the baseline, as all
estimators can use it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from examples.greenhouse_coop.env import DAYS, VENTILATOR, WATERER, GreenhouseSim
from examples.greenhouse_coop.plan import BEST
from examples.wolf_sheep.env import MOVE, Meadow, sheep_points
from numpy.typing import NDArray

from simenv_marl import RULE, aec_env
from simenv_marl.data import collect_episodes
from simenv_marl.planning import action_values

TICKS: Final = 60
"""The length of an episode on the meadow, in ticks: few sheep live that long."""

DAYS_SPENT: Final = 200
"""The budget of simulated days per decision at which the estimators are compared."""

HORIZONS: Final = (3, 10)
"""The numbers of the agent's decisions after which futures are cut off."""


# -- decisions ------------------------------------------------------------------------------------

Baseline = Callable[[NDArray[np.float32]], float]


@dataclass(frozen=True)
class World:
    """A simulation whose decisions are studied.

    Attributes:
        title: The name of the agents.
        make: The function that makes the simulation.
        points: The decision points.
        key: The key of the agents in ``policies``.
        base: The base policies of all agents.
        a_day: The number of decisions per day that can all be assigned credit.
    """

    title: str
    make: Callable[[], Any]
    points: Any
    key: Any
    base: Any
    a_day: float


def worlds() -> Iterator[World]:
    """Yield both agents of the greenhouse, with the best constants as base, and the sheep.

    The base of the sheep is their rule.
    """
    for agent in (WATERER, VENTILATOR):
        yield World(f"greenhouse, {agent}", GreenhouseSim, None, agent, BEST, 2)
    yield World("one of the sheep", lambda: Meadow(TICKS), sheep_points(), MOVE, RULE, 100)


def decisions(
    world: World, number: int, rng: np.random.Generator
) -> Iterator[tuple[Any, list[Any]]]:
    """Go to decisions, each in another episode.

    Yields:
        The environment with the decision pending, and two candidates: a random action, and that of
        the base policy.
    """
    while number:
        env = aec_env(world.make(), world.points)
        env.reset(seed=int(rng.integers(10**6)))
        if world.base is RULE:
            passed = int(rng.integers(200, 800))
        else:
            passed = 2 * int(rng.integers(3, 80)) + (world.key == WATERER)
        while env.agents and (passed > 0 or env.terminations[env.agent_selection]):
            agent = env.agent_selection
            base = RULE if world.base is RULE else world.base[agent](env.last()[0])
            env.step(None if env.terminations[agent] or env.truncations[agent] else base)
            passed -= 1
        if not env.agents:  # the episode ended too early
            continue
        number -= 1
        observation = env.last()[0]
        if world.base is RULE:
            yield env, [int(rng.integers(4)), RULE]
        else:
            usual = world.base[world.key](observation)
            spread = 0.04 if world.key == WATERER else 0.4
            # reflected at 0 and at 1
            drawn = 1 - np.abs(1 - np.abs(usual + rng.normal(0, spread, 1)))
            yield env, [np.clip(drawn, 0, 1).astype(np.float32), usual]
        env.close()


def learn_baseline(world: World, episodes: int) -> Baseline:
    """Learn a baseline: least squares on squares and products of the observations."""
    policies = {MOVE: RULE} if world.base is RULE else world.base
    found = collect_episodes(
        world.make, policies, points=world.points, seeds=range(10**6, 10**6 + episodes)
    )[world.key]
    rest = np.concatenate(
        [np.cumsum(found.rewards[start : start + length][::-1])[::-1]
         for start, length in zip(found.starts, found.lengths, strict=True)]
    )  # fmt: skip
    matrix = _features(found.observations)
    weights = np.linalg.solve(matrix.T @ matrix + np.eye(matrix.shape[1]), matrix.T @ rest)
    return lambda observation: float(_features(observation[None])[0] @ weights)


def _features(observations: NDArray[np.float32]) -> NDArray[np.float64]:
    values = np.column_stack([observations.astype(np.float64), np.ones(len(observations))])
    rows, columns = np.triu_indices(values.shape[1])
    return values[:, rows] * values[:, columns]


# -- estimates ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Way:
    """The results of an estimator.

    Attributes:
        title: Its name.
        bias: The root mean square, over decisions, of the difference between its mean and the
            truth.
        deviation: The root mean square, over decisions, of the standard deviation of one estimate.
        days: The cost of one estimate, in simulated days.
        a_decision: The cost per decision where all decisions of an episode are assigned credit, in
            simulated days.
    """

    title: str
    bias: float
    deviation: float
    days: float
    a_decision: float

    @property
    def error(self) -> float:
        """The root mean square error of as many estimates as a budget of ``DAYS_SPENT`` allows."""
        return float(np.sqrt(self.bias**2 + self.deviation**2 * self.days / DAYS_SPENT))


def measure(
    world: World, number: int, futures: int, episodes: int, seed: int
) -> tuple[list[Way], float]:
    """Measure the errors of all estimators.

    Args:
        world: The simulation.
        number: The number of decisions.
        futures: The number of futures for each estimator and for the truth.
        episodes: The number of episodes from which the baseline is learned.
        seed: The seed of the random draws.

    Returns:
        The results of the estimators, and the root mean square of the truth.
    """
    rng = np.random.default_rng(seed)
    baseline = learn_baseline(world, episodes)
    titles = [
        "return less baseline",
        "two branches, independent futures",
        "two branches, the same future",
    ]
    titles += [f"the same, cut off after {horizon}" for horizon in HORIZONS]
    biases: list[list[float]] = [[] for _ in titles]
    variances: list[list[float]] = [[] for _ in titles]
    costs: list[list[float]] = [[] for _ in titles]
    truths = []
    for env, candidates in decisions(world, number, rng):
        expected = baseline(env.last()[0])
        taken, usual = action_values(env, candidates, base=world.base, futures=futures).returns
        truth = float(np.mean(taken - usual))
        truths.append(truth)
        # the sampling error of the truth does not count as a bias of the estimators that are cut
        # off
        unsure = float(np.var(taken - usual, ddof=1)) / futures
        whole = (
            float(np.mean(taken))
            if world.base is RULE
            else float(DAYS - env.simulation.greenhouse.day)
        )
        other = float(np.mean(usual)) if world.base is RULE else whole
        found = [(taken - expected, whole, 0.0), (taken - np.roll(usual, 1), whole + other, 0.0)]
        found.append((taken - usual, whole + other, 0.0))
        for horizon in HORIZONS:
            first, second = action_values(
                env, candidates, base=world.base, futures=futures, horizon=horizon,
                terminal_value=lambda twin: baseline(twin.last()[0]),
            ).returns  # fmt: skip
            found.append((first - second, min(horizon, whole) + min(horizon, other), unsure))
        for place, (estimates, days, doubt) in enumerate(found):
            biases[place].append(max(0.0, float(np.mean(estimates) - truth) ** 2 - doubt))
            variances[place].append(float(np.var(estimates, ddof=1)))
            costs[place].append(days)
    ways = []
    for title, bias, variance, cost in zip(titles, biases, variances, costs, strict=True):
        days = float(np.mean(cost))
        ways.append(
            Way(title, float(np.sqrt(np.mean(bias))), float(np.sqrt(np.mean(variance))), days,
                1 / world.a_day if title == titles[0] else days)
        )  # fmt: skip
    return ways, float(np.sqrt(np.mean(np.square(truths))))


def table(world: World, ways: Sequence[Way], truth: float) -> str:
    """Make the table of a simulation, in Markdown."""
    first = ways[0]
    lines = [
        f"**{world.title}** (what actions were worth: {truth:.2f} in the root mean square)",
        "",
        f"| estimate | bias | deviation | days | error of {DAYS_SPENT} days |"
        " days for the same variance, one decision | all decisions |",
        "| --- | ---: | ---: | ---: | ---: | ---: | ---: |",
    ]
    for way in ways:
        one = (way.deviation / first.deviation) ** 2 * way.days / first.days
        every = (way.deviation / first.deviation) ** 2 * way.a_decision / first.a_decision
        lines.append(
            f"| {way.title} | {way.bias:.2f} | {way.deviation:.2f} | {way.days:.1f} |"
            f" {way.error:.2f} | {one:.2g} x | {every:.2g} x |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> dict[str, list[Way]]:
    """Measure the errors, and print a table for each simulation."""
    parser = argparse.ArgumentParser(description="Compare estimators of the advantage of actions.")
    parser.add_argument(
        "--decisions", type=int, default=24, help="decisions of each kind (default: %(default)s)"
    )
    parser.add_argument(
        "--futures", type=int, default=48, help="futures per estimator (default: %(default)s)"
    )
    parser.add_argument(
        "--episodes",
        type=int,
        default=100,
        help="episodes for each baseline (default: %(default)s)",
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of all randomness (default: %(default)s)"
    )
    options = parser.parse_args(arguments)
    found = {}
    for world in worlds():
        ways, truth = measure(
            world, options.decisions, options.futures, options.episodes, options.seed
        )
        found[world.title] = ways
        print(table(world, ways, truth), end="\n\n", flush=True)
    return found


if __name__ == "__main__":
    main()
