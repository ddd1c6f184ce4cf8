"""The cost of a parallel step: every agent acts once, and then all of them are rewarded and observed.

All agents are entities, named by a callable. The comparison is with our AEC view, which takes as many turns, and with
PettingZoo's two converters over the hand-written AEC environment with as many agents.
"""

from __future__ import annotations

from typing import Any

from pettingzoo.utils.conversions import aec_to_parallel, turn_based_aec_to_parallel

from benchmarks.hand_written import TemplateAECEnv
from benchmarks.measure import Contender, Section, Times, ratio, side_by_side, timed
from benchmarks.noop import Crowd, Entity, ForetoldCrowd, aec
from simenv_marl import aec_env, parallel_env

SIZES = (2, 100, 1_000, 10_000)

CONVERTED = (2, 100, 1_000)
"""The numbers of agents for ``aec_to_parallel``: its step is quadratic, and takes tens of seconds at 10,000."""

CONVERTED_ROUNDS = 3

TURNS = 50
"""The number of steps of the turn-based converter; each is one decision, and is linear in the number of agents."""


def measure(rounds: int, number: int) -> Section:
    """Measure in a number of rounds, with a number of decisions of each contender."""
    ours: dict[str, Contender] = {}
    for size in SIZES:
        crowd = Crowd(size)
        ours[f"AEC, {size:,}"] = aec(aec_env(crowd, Entity.decide), number)
        ours[f"parallel, {size:,}"] = steps(
            parallel_env(crowd, Entity.decide, possible_agents=crowd.names()), size, number
        )
        ours[f"parallel, expected_calls, {size:,}"] = steps(
            parallel_env(ForetoldCrowd(size), Entity.decide), size, number
        )
    times = side_by_side(ours, rounds)
    # in separate rounds, because they are expensive; with ours again, for the ratios
    beside: dict[str, Contender] = {}
    for size in SIZES:
        beside[f"parallel, {size:,}"] = ours[f"parallel, {size:,}"]
        few = min(number, 2_000)
        if size in CONVERTED:
            beside[f"aec_to_parallel, {size:,}"] = steps(aec_to_parallel(TemplateAECEnv(size)), size, few)
        beside[f"turn_based_aec_to_parallel, {size:,}"] = turns(
            turn_based_aec_to_parallel(TemplateAECEnv(size)), few if size == 2 else TURNS
        )
    return _tell(times, side_by_side(beside, min(rounds, CONVERTED_ROUNDS)))


def _tell(times: Times, beside: Times) -> Section:
    section = Section("Rounds of many agents", "microseconds per agent and step")
    for size in SIZES:
        section.ratio(
            f"{size:,} agents: a parallel step per agent / an AEC decision",
            ratio(times, f"parallel, {size:,}", f"AEC, {size:,}"),
            bar=0.95 if size == 2 else 0.75,
            aim=0.85 if size == 2 else 0.65,
        )
    section.ratio(
        "a parallel step per agent: 10,000 agents / 100 agents",
        ratio(times, "parallel, 10,000", "parallel, 100"),
        bar=1.5,
        aim=1.1,
    )
    section.ratio(
        "the same with expected_calls",
        ratio(times, "parallel, expected_calls, 10,000", "parallel, expected_calls, 100"),
    )
    converters = {name: name.partition(", ")[::2] for name in beside if not name.startswith("parallel")}
    for name, (converter, size) in converters.items():
        section.ratio(f"{size} agents: {converter} / ours", ratio(beside, name, f"parallel, {size}"))
    section.times(times)
    section.times({name: beside[name] for name in converters})
    section.remarks.append(
        "aec_to_parallel is quadratic in the agents and left out at 10,000, where one step of it takes tens of seconds."
        " A round takes turn_based_aec_to_parallel as many steps as there are agents, and its figures are of one such"
        " step."
    )
    return section


# -- contenders -----------------------------------------------------------------------------------


def steps(env: Any, agents: int, number: int) -> Contender:
    """Make a contender of steps of a parallel environment that does not end, with actions of all agents."""
    env.reset(seed=0)
    number = max(number // agents, 1)
    if len(env.agents) < agents:  # some agents have not appeared yet
        for _ in range(agents):
            env.step(dict.fromkeys(env.agents, 1))
    actions = dict.fromkeys(env.agents, 1)
    assert len(actions) == agents

    def loop(number: int) -> None:
        step = env.step
        for _ in range(number):
            step(actions)

    run = timed(loop, number)
    return lambda: run() / agents


def turns(env: Any, number: int) -> Contender:
    """Make a contender of steps of a converted environment, each of which is the decision of one agent."""
    env.reset(seed=0)
    actions = dict.fromkeys(env.agents, 1)

    def loop(number: int) -> None:
        step = env.step
        for _ in range(number):
            step(actions)

    return timed(loop, number)
