"""The cost of a decision in AEC, single and turn views, and without an environment."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from greenlet import getcurrent, greenlet
from pettingzoo.utils.wrappers import AssertOutOfBoundsWrapper, OrderEnforcingWrapper

from benchmarks.hand_written import TemplateAECEnv, TemplateEnv, ThreadEnv
from benchmarks.measure import Contender, Group, Row, both, calls, timer
from benchmarks.noop import (
    Alone,
    AloneBy,
    Crowd,
    CrowdBy,
    Dispatched,
    Entity,
    Model,
    Turns,
    TurnsBy,
    aec,
    single,
    vector,
)
from simenv_marl import aec_env, single_env, turn_env, vector_env

MANY = 10_000
TOGETHER = 64


def groups(number: int) -> Iterator[Group]:
    """Yield the rows, with a number of decisions of each contender."""
    model = Model()
    plain = calls_alone(Model.left.__wrapped__, model, number)
    decision = calls_alone(Model.left, model, number)
    yield Group(
        [
            Row(
                "a decision function outside any environment / the plain function",
                decision,
                plain,
                2.5,
                2.1,
            )
        ]
    )

    env: Any = single_env(Alone, Model.left)
    env.reset(seed=0)
    yield Group(
        [
            Row(
                "the same on its caller's stack, while an environment is in an episode",
                decision,
                plain,
            )
        ]
    )
    env.close()

    greenlets = calls(echo().switch, number, 1)
    template, crossing = single(TemplateEnv(), number), "template + one greenlet round trip"
    template_aec = aec(TemplateAECEnv(), number)
    wrapped = aec(OrderEnforcingWrapper(AssertOutOfBoundsWrapper(TemplateAECEnv())), number)
    least, least_aec = both(template, greenlets), both(template_aec, greenlets)
    thread = ThreadEnv()
    by_lock = single(thread, number // 10)

    turns = aec(aec_env(Turns, [Model.left, Model.right]), number)
    turns_by = aec(aec_env(TurnsBy, [Model.left_by, Model.right_by]), number)
    entities = aec(aec_env(Crowd(2), Entity.decide), number)
    entities_by = aec(aec_env(CrowdBy(2), Entity.decide_by), number)
    many = min(MANY, number)
    items = aec(aec_env(Dispatched(100), Dispatched.dispatch), number)
    hundred = aec(aec_env(CrowdBy(100), Entity.decide_by), number)
    of_many = aec(aec_env(Crowd(many), Entity.decide), number)
    alone = single(single_env(Alone, Model.left), number)
    alone_by = single(single_env(AloneBy, Model.left_by), number)
    yield Group(
        [
            Row(f"AEC / {crossing}", turns, least_aec, 1.55, 1.45),
            Row(f"AEC, another argument / {crossing}", turns_by, least_aec),
            Row(f"AEC, entities / {crossing}", entities, least_aec),
            Row(f"AEC, entities, another argument / {crossing}", entities_by, least_aec, 1.7, 1.55),
            Row("AEC / template", turns, template_aec),
            Row("AEC / template in two wrappers", turns, wrapped),
            Row("AEC / one greenlet round trip", turns, greenlets),
            Row(
                "AEC, an item of a call for 100 / a decision with a call of its own",
                items,
                hundred,
                1.0,
            ),
            Row(f"AEC, entities: {MANY:,} / 2", of_many, entities, 1.2, 1.1),
            Row(f"single / {crossing}", alone, least, 2.6, 2.3),
            Row(f"single, another argument / {crossing}", alone_by, least, 2.7, 2.3),
            Row("single / template", alone, template),
            Row("single beside thread and Lock", alone, by_lock, faster=True),
        ]
    )
    thread.close()
    yield from of_teams(number)

    few = min(100, many // 2)
    dead_many = dead_steps(aec_env(Crowd(many, rounds=1), Entity.decide), many)
    dead_few = dead_steps(aec_env(Crowd(few, rounds=1), Entity.decide), few)
    yield Group(
        [Row(f"AEC, a dead agent's step, entities: {MANY:,} / 100", dead_many, dead_few, 1.2, 1.1)],
        most=6,
    )


def of_teams(number: int) -> Iterator[Group]:
    """Yield the rows of the turn view, and of the team's reward."""
    points = [Model.left, Model.right]
    envs = vector_env(Turns, points, num_envs=TOGETHER, view="turn")
    alone = single(single_env(Alone, Model.left), number)
    turn = single(turn_env(Turns, points), number)
    flat = single(turn_env(Turns, points, flatten=True), number)
    together = vector(envs, TOGETHER, number)
    each = aec(aec_env(Turns, points), number)
    team = aec(aec_env(Turns, points, team_reward=lambda turns: 1.0), number)
    yield Group(
        [
            Row("turn view / single", turn, alone, 1.15),
            Row("turn view, flatten=True / turn view", flat, turn),
            Row(f"turn view, {TOGETHER} in a vector / turn view", together, turn),
            Row("AEC, team_reward= / AEC", team, each),
        ]
    )
    envs.close()


def calls_alone(function: Any, argument: Any, number: int) -> Contender:
    """Make a contender of calls with one argument, without the time of the loop around them."""

    def idle(number: int) -> None:
        for _ in range(number):
            pass

    loop_and_calls, loop = calls(function, number, argument), timer(idle, number)
    return lambda: max(loop_and_calls() - loop(), 1e-6)


def dead_steps(env: Any, agents: int) -> Contender:
    """Make a contender of ``last`` and ``step`` of agents whose episode has ended."""

    def loop(number: int) -> None:
        last, step = env.last, env.step
        for _ in range(number):
            last()
            step(None)

    def run() -> float:
        env.reset(seed=0)
        for _ in range(agents):
            env.step(1)
        assert all(env.terminations.values())
        return timer(loop, agents)()

    return run


def echo() -> Any:
    """Make a greenlet that only switches back."""

    def loop() -> None:
        back = getcurrent().parent.switch
        while True:
            back(1)

    other = greenlet(loop)
    other.switch()
    return other
