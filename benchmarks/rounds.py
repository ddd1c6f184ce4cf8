"""The cost of a parallel step: every agent acts once, then all are rewarded and observed."""

from __future__ import annotations

from collections.abc import Iterator

from pettingzoo.utils.conversions import aec_to_parallel, turn_based_aec_to_parallel

from benchmarks.hand_written import TemplateAECEnv
from benchmarks.measure import Group, Row
from benchmarks.noop import Crowd, Entity, ForetoldCrowd, aec, parallel, steps
from simenv_marl import aec_env, parallel_env

SIZES = (2, 100, 1_000, 10_000)

CONVERTIBLE = (2, 100, 1_000)
"""The agents for ``aec_to_parallel``: its quadratic step takes tens of seconds for 10,000."""

TURNS = 50
"""The number of steps of the turn-based converter.

Each is one decision, and is linear in the number of agents.
"""


def groups(number: int) -> Iterator[Group]:
    """Yield the rows, with a number of decisions of each contender."""
    sizes = [size for size in SIZES if size <= number]
    turns = {size: aec(aec_env(Crowd(size), Entity.decide), number) for size in sizes}
    ours = {
        size: parallel(
            parallel_env(Crowd(size), Entity.decide, possible_agents=Crowd(size).names()),
            size,
            number,
        )
        for size in sizes
    }
    foretold = {
        size: parallel(parallel_env(ForetoldCrowd(size), Entity.decide), size, number)
        for size in sizes
    }
    rows = []
    for size in sizes:
        limits = (0.95, 0.85) if size == 2 else (0.75, 0.65)
        rows += [
            Row(
                f"{size:,} agents: a parallel step, for each / an AEC decision",
                ours[size],
                turns[size],
                *limits,
            ),
            Row(f"{size:,} agents: with expected_calls / without", foretold[size], ours[size]),
        ]
    most = sizes[-1]
    if most > 100:
        rows += [
            Row(
                f"a parallel step, for each: {most:,} agents / 100", ours[most], ours[100], 1.5, 1.1
            ),
            Row(
                f"the same with expected_calls: {most:,} agents / 100",
                foretold[most],
                foretold[100],
            ),
        ]
    yield Group(rows)

    few, rows = min(number, 2_000), []
    for size in sizes:
        if size in CONVERTIBLE:
            converter = parallel(aec_to_parallel(TemplateAECEnv(size)), size, few)
            rows.append(
                Row(
                    f"{size:,} agents: ours beside aec_to_parallel",
                    ours[size],
                    converter,
                    faster=True,
                )
            )
        env = turn_based_aec_to_parallel(TemplateAECEnv(size))
        env.reset(seed=0)
        one_decision = steps(env, dict.fromkeys(env.agents, 1), few if size == 2 else TURNS)
        name = f"{size:,} agents: ours beside turn_based_aec_to_parallel"
        rows.append(Row(name, ours[size], one_decision, faster=True))
    yield Group(rows, most=3)
