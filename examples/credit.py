"""What an agent's action was worth with all else the same: by branches, and by returns less a learnt baseline.

``python -m examples.credit`` goes to decisions of the greenhouse pair and of the sheep of Mesa's meadow, draws an
action for each, and asks what it was worth beside what the agent's base would have done there: the difference between
the values of the two, where the base goes on after either. Each way of estimating it is held against the same truth,
the mean of many futures to the end, and costs simulated days (ticks of the meadow):

- the return of one future in which the action is taken, less what a baseline that was learnt from episodes of the base
  expects there: what policy gradients go by;
- the difference between two branches of ``action_values`` in the same future, or in two independent ones;
- the same, cut off after a few days; what comes then is what the baseline expects.

It prints a table in Markdown. The days from which the baseline was learnt are not counted: all can make use of it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from simenv_marl import RULE, action_values, aec_env, collect_episodes

from .greenhouse_coop.env import DAYS, GreenhouseSim
from .greenhouse_coop.plan import BEST, VENTILATOR, WATERER
from .wolf_sheep.env import MOVE, Meadow, sheep_points

TICKS: Final = 60
"""For how long meadows last: few sheep live that long."""

DAYS_SPENT: Final = 200
"""At how many days for each decision the ways are compared."""

HORIZONS: Final = (3, 10)
"""After how many decisions of the agent futures are cut off."""


# -- decisions ------------------------------------------------------------------------------------

Baseline = Callable[[NDArray[np.float32]], float]


@dataclass(frozen=True)
class World:
    """Where decisions are looked at.

    Attributes:
        title: Whose they are.
        make: Makes the simulation.
        points: Its decision points.
        key: Of the agents whose decisions they are, in ``policies``.
        base: The policies of all.
        a_day: How many decisions a day has that may all be given credit.
    """

    title: str
    make: Callable[[], Any]
    points: Any
    key: Any
    base: Any
    a_day: float


def worlds() -> Iterator[World]:
    """Both agents of the greenhouse, around the best constants, and the sheep, around their rule."""
    for agent in (WATERER, VENTILATOR):
        yield World(f"greenhouse, {agent}", GreenhouseSim, None, agent, BEST, 2)
    yield World("one of the sheep", lambda: Meadow(TICKS), sheep_points(), MOVE, RULE, 100)


def decisions(world: World, number: int, rng: np.random.Generator) -> Iterator[tuple[Any, list[Any]]]:
    """Go to decisions, each of another episode.

    Yields:
        The environment with the decision pending, and two candidates: one that is drawn, and that of the base.
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
        if not env.agents:  # it has ended before
            continue
        number -= 1
        observation = env.last()[0]
        if world.base is RULE:
            yield env, [int(rng.integers(4)), RULE]
        else:
            usual = world.base[world.key](observation)
            spread = 0.04 if world.key == WATERER else 0.4
            drawn = 1 - np.abs(1 - np.abs(usual + rng.normal(0, spread, 1)))  # thrown back at 0 and at 1
            yield env, [np.clip(drawn, 0, 1).astype(np.float32), usual]
        env.close()


def learn_baseline(world: World, episodes: int) -> Baseline:
    """Learn what to expect: least squares on squares and products of what is observed."""
    policies = {MOVE: RULE} if world.base is RULE else world.base
    found = collect_episodes(world.make, policies, points=world.points, seeds=range(10**6, 10**6 + episodes))[world.key]
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
    """One way of giving credit.

    Attributes:
        title: Its name.
        bias: The root of the mean square, over decisions, of how far its mean is from the truth.
        deviation: Of one estimate, likewise.
        days: What an estimate costs.
        a_decision: What it costs where all decisions of an episode are given credit.
    """

    title: str
    bias: float
    deviation: float
    days: float
    a_decision: float

    @property
    def error(self) -> float:
        """The root of the mean square error of as many estimates as ``DAYS_SPENT`` pay for."""
        return float(np.sqrt(self.bias**2 + self.deviation**2 * self.days / DAYS_SPENT))


def measure(world: World, number: int, futures: int, episodes: int, seed: int) -> tuple[list[Way], float]:
    """Estimate what actions were worth.

    Args:
        world: Where.
        number: How many decisions.
        futures: In how many futures each way is tried, and the truth is found.
        episodes: From how many the baseline is learnt.
        seed: Of what is drawn.

    Returns:
        The ways, and the root mean square of the truth.
    """
    rng = np.random.default_rng(seed)
    baseline = learn_baseline(world, episodes)
    titles = ["return less baseline", "two branches, independent futures", "two branches, the same future"]
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
        # What the truth is not sure of is no bias of those that are cut off.
        unsure = float(np.var(taken - usual, ddof=1)) / futures
        whole = float(np.mean(taken)) if world.base is RULE else float(DAYS - env.simulation.greenhouse.day)
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
    """Make the table of a world, in Markdown."""
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
            f"| {way.title} | {way.bias:.2f} | {way.deviation:.2f} | {way.days:.1f} | {way.error:.2f} | {one:.2g} x |"
            f" {every:.2g} x |"
        )
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> dict[str, list[Way]]:
    """Measure, and print a table for each world."""
    parser = argparse.ArgumentParser(description="Give credit for actions.")
    parser.add_argument("--decisions", type=int, default=24, help="of each kind (default: %(default)s)")
    parser.add_argument("--futures", type=int, default=48, help="for each way (default: %(default)s)")
    parser.add_argument("--episodes", type=int, default=100, help="for the baselines (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of all that is drawn (default: %(default)s)")
    options = parser.parse_args(arguments)
    found = {}
    for world in worlds():
        ways, truth = measure(world, options.decisions, options.futures, options.episodes, options.seed)
        found[world.title] = ways
        print(table(world, ways, truth), end="\n\n", flush=True)
    return found


if __name__ == "__main__":
    main()
