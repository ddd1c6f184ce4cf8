"""What a decision costs: this library's AEC and single views beside what they replace, in one run.

Run with ``make benchmark``, which pins it to one core.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from statistics import median
from typing import Any

from greenlet import getcurrent, greenlet
from pettingzoo.utils.wrappers import AssertOutOfBoundsWrapper, OrderEnforcingWrapper

from benchmarks.hand_written import (
    ACTION_SPACE,
    OBSERVATION_SPACE,
    BareEnv,
    EventEnv,
    GeneratorEnv,
    LockEnv,
    State,
    TemplateAECEnv,
    TemplateEnv,
)
from benchmarks.measure import Contender, Report, Times, ratio, side_by_side, timed
from simenv_marl import aec_env, make_step, single_env

DEFINITION: dict[str, Any] = {
    "observation_space": OBSERVATION_SPACE,
    "observation_space_mapping": lambda entity: entity.observe(),
    "action_space": ACTION_SPACE,
    "action_space_mapping": lambda action: action,
    "reward_mapping": lambda entity: 1.0,
}


class Model(State):
    """Two decisions that change nothing."""

    @make_step(**DEFINITION, agent="agent_0")
    def left(self) -> int:
        return 0

    @make_step(**DEFINITION, agent="agent_1")
    def right(self) -> int:
        return 0


class Turns:
    """Two agents, turn by turn, without an end."""

    def reset(self) -> None:
        self.model = Model()

    def run(self) -> None:
        model = self.model
        while True:
            model.left()
            model.right()


class Alone(Turns):
    """One agent, without an end."""

    def run(self) -> None:
        model = self.model
        while True:
            model.left()


class Entity(State):
    """One of many, an agent of its own."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.name = f"entity_{number}"

    @make_step(**DEFINITION, agent=lambda entity: entity.name)
    def decide(self) -> int:
        return 0


class Crowd:
    """Many agents, round after round; without an end, or for one round."""

    def __init__(self, size: int, rounds: int | None = None) -> None:
        self.size, self.rounds = size, rounds

    def reset(self) -> None:
        self.entities = [Entity(number) for number in range(self.size)]

    def run(self) -> None:
        done = 0
        while done != self.rounds:
            for entity in self.entities:
                entity.decide()
            done += 1


# -- contenders -----------------------------------------------------------------------------------


def aec(env: Any, number: int) -> Contender:
    """``last`` and ``step`` of an AEC environment that does not end."""
    env.reset(seed=0)

    def loop(number: int) -> None:
        last, step = env.last, env.step
        for _ in range(number):
            last()
            step(1)

    return timed(loop, number)


def single(env: Any, number: int) -> Contender:
    """``step`` of a Gymnasium environment that does not end."""
    env.reset(seed=0)

    def loop(number: int) -> None:
        step = env.step
        for _ in range(number):
            step(1)

    return timed(loop, number)


def dead_steps(env: Any, agents: int) -> Contender:
    """``last`` and ``step`` of agents whose episode has ended."""

    def prepare_and_run() -> float:
        env.reset(seed=0)
        for _ in range(agents):
            env.step(1)
        assert all(env.terminations.values())
        return timed(loop, agents)()

    def loop(number: int) -> None:
        last, step = env.last, env.step
        for _ in range(number):
            last()
            step(None)

    return prepare_and_run


def round_trip(number: int) -> Contender:
    """To a bare greenlet and back."""

    def loop_in_greenlet() -> None:
        back = getcurrent().parent.switch
        while True:
            back(1)

    other = greenlet(loop_in_greenlet)
    other.switch()

    def loop(number: int) -> None:
        switch = other.switch
        for _ in range(number):
            switch(1)

    return timed(loop, number)


def _nothing(number: int) -> None:
    for _ in range(number):
        pass


def calls(function: Any, argument: Any, number: int) -> Contender:
    """Calls of a function with one argument."""

    def loop(number: int) -> None:
        for _ in range(number):
            function(argument)

    return timed(loop, number)


# -- the benchmark --------------------------------------------------------------------------------


def run(rounds: int, number: int) -> Report:
    """Measure and tell.

    Args:
        rounds: How many rounds.
        number: How many decisions a contender makes in a round.
    """
    model = Model()
    plain = Model.left.__wrapped__  # type: ignore[attr-defined]
    outside = side_by_side(
        {
            "loop": timed(_nothing, number),
            "plain": calls(plain, model, number),
            "decision": calls(Model.left, model, number),
        },
        rounds,
    )
    wrapped = OrderEnforcingWrapper(AssertOutOfBoundsWrapper(TemplateAECEnv()))
    threads = {"thread + Event": EventEnv(), "thread + Lock": LockEnv()}
    times = side_by_side(
        {
            "greenlet": round_trip(number),
            "template AEC": aec(TemplateAECEnv(), number),
            "template AEC, wrapped": aec(wrapped, number),
            "AEC": aec(aec_env(Turns, [Model.left, Model.right]), number),
            "AEC, entities, 2": aec(aec_env(Crowd(2), Entity.decide), number),
            "AEC, entities, 10,000": aec(aec_env(Crowd(10_000), Entity.decide), number),
            "template": single(TemplateEnv(), number),
            "bare": single(BareEnv(), number),
            "single": single(single_env(Alone, Model.left), number),
            "generator": single(GeneratorEnv(), number),
            **{name: single(env, number // 10) for name, env in threads.items()},
        },
        rounds,
    )
    for env in threads.values():
        env.close()
    dead = side_by_side(
        {str(agents): dead_steps(aec_env(Crowd(agents, rounds=1), Entity.decide), agents) for agents in (100, 10_000)},
        max(3, rounds // 5),
    )
    # Imported here, because its difference() makes all environments that are made afterwards say for whom they
    # evaluate a mapping.
    from benchmarks import greenhouse

    houses = side_by_side(
        {
            "watering, plain loop": greenhouse.plain_days(greenhouse.PlainWatering),
            "watering, single environment": greenhouse.single_days(),
            "both, plain loop": greenhouse.plain_days(greenhouse.PlainCoop),
            "both, AEC environment": greenhouse.aec_days(),
        },
        rounds,
    )
    return _tell(outside, times, dead, houses)


def _tell(outside: Times, times: Times, dead: Times, houses: Times) -> Report:
    def us(name: str, source: Times = times) -> str:
        return f"{median(source[name]):.2f}"

    report = Report("What a decision costs")
    report.table(
        "Ratios (medians over the rounds)",
        ["what", "ratio", "bar", "aim"],
        [
            [
                "AEC, 2 agents: ours / (template + one greenlet round trip)",
                f"{ratio(times, 'AEC', 'template AEC', 'greenlet'):.2f}",
                "1.9",
                "1.6",
            ],
            [
                "AEC: 10,000 agents / 2 agents (entity-level)",
                f"{ratio(times, 'AEC, entities, 10,000', 'AEC, entities, 2'):.2f}",
                "1.5",
                "1.1",
            ],
            [
                "AEC: a dead agent's step, 10,000 agents / 100 agents",
                f"{ratio(dead, '10000', '100'):.2f}",
                "1.5",
                "1.1",
            ],
            [
                "single: ours / (template + one greenlet round trip)",
                f"{ratio(times, 'single', 'template', 'greenlet'):.2f}",
                "2.7",
                "2.3",
            ],
            [
                "single: ours / (barest possible environment + one greenlet round trip)",
                f"{ratio(times, 'single', 'bare', 'greenlet'):.2f}",
                "",
                "",
            ],
            [
                "a decision function outside any environment / the plain function",
                f"{ratio(_without_loop(outside), 'decision', 'plain'):.2f}",
                "3",
                "2.1",
            ],
            [
                "greenhouse, 200 plants: days/s through the single environment / plain loop with the same mappings",
                f"{ratio(houses, 'watering, plain loop', 'watering, single environment'):.3f}",
                "0.95",
                "0.98",
            ],
            [
                "the same with two agents, two decisions a day, in the AEC environment",
                f"{ratio(houses, 'both, plain loop', 'both, AEC environment'):.3f}",
                "",
                "",
            ],
        ],
    )
    report.table(
        "Times (medians, microseconds per decision)",
        ["what", "us"],
        [
            *([name, us(name)] for name in times),
            ["AEC, a dead agent's step, of 100", us("100", dead)],
            ["AEC, a dead agent's step, of 10,000", us("10000", dead)],
            ["plain function, without the loop around it", f"{median(_without_loop(outside)['plain']):.3f}"],
            ["decision function outside any environment", f"{median(_without_loop(outside)['decision']):.3f}"],
            *([f"greenhouse, a day: {name}", us(name, houses)] for name in houses),
        ],
    )
    return report


def _without_loop(outside: Times) -> Times:
    return {
        name: [time - loop for time, loop in zip(outside[name], outside["loop"], strict=True)]
        for name in ("plain", "decision")
    }


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=31, help="how many rounds (%(default)s)")
    parser.add_argument("--number", type=int, default=20_000, help="decisions per round (%(default)s)")
    parser.add_argument("--write", type=Path, help="a Markdown file for the tables")
    arguments = parser.parse_args()
    report = run(arguments.rounds, arguments.number)
    if arguments.write is not None:
        report.write(arguments.write)


if __name__ == "__main__":
    main()
