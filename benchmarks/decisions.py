"""The cost of a decision in the AEC and the single view, beside their alternatives."""

from __future__ import annotations

from statistics import median
from typing import Any

from greenlet import getcurrent, greenlet
from pettingzoo.utils.wrappers import AssertOutOfBoundsWrapper, OrderEnforcingWrapper

from benchmarks.hand_written import BareEnv, EventEnv, GeneratorEnv, LockEnv, TemplateAECEnv, TemplateEnv
from benchmarks.measure import Contender, Section, Times, ratio, side_by_side, timed
from benchmarks.noop import Alone, AloneBy, Crowd, CrowdBy, Entity, Model, Turns, TurnsBy, aec, single
from simenv_marl import aec_env, single_env


def measure(rounds: int, number: int) -> Section:
    """Measure in a number of rounds, with a number of decisions of each contender."""
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
            "AEC, with another argument": aec(aec_env(TurnsBy, [Model.left_by, Model.right_by]), number),
            "AEC, entities, 2": aec(aec_env(Crowd(2), Entity.decide), number),
            "AEC, entities, 2, with another argument": aec(aec_env(CrowdBy(2), Entity.decide_by), number),
            "AEC, entities, 10,000": aec(aec_env(Crowd(10_000), Entity.decide), number),
            "template": single(TemplateEnv(), number),
            "bare": single(BareEnv(), number),
            "single": single(single_env(Alone, Model.left), number),
            "single, with another argument": single(single_env(AloneBy, Model.left_by), number),
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
    return _tell(outside, times, dead)


def _tell(outside: Times, times: Times, dead: Times) -> Section:
    section = Section("Decisions", "microseconds per decision")
    crossing = ("template AEC", "greenlet")
    section.ratio(
        "AEC, 2 agents: ours / (template + one greenlet round trip)", ratio(times, "AEC", *crossing), bar=1.55, aim=1.45
    )
    section.ratio(
        "AEC, 2 agents, another argument, named by a callable: ours / (template + greenlet)",
        ratio(times, "AEC, entities, 2, with another argument", *crossing),
        bar=1.7,
        aim=1.55,
    )
    section.ratio(
        "AEC, 2 agents, another argument: ours / (template + greenlet)",
        ratio(times, "AEC, with another argument", *crossing),
    )
    section.ratio(
        "AEC, 2 agents, named by a callable: ours / (template + greenlet)",
        ratio(times, "AEC, entities, 2", *crossing),
    )
    section.ratio(
        "AEC: 10,000 agents / 2 agents (entity-level)",
        ratio(times, "AEC, entities, 10,000", "AEC, entities, 2"),
        bar=1.2,
        aim=1.1,
    )
    section.ratio("AEC: a dead agent's step, 10,000 agents / 100 agents", ratio(dead, "10000", "100"), bar=1.2, aim=1.1)
    section.ratio(
        "single: ours / (template + one greenlet round trip)",
        ratio(times, "single", "template", "greenlet"),
        bar=2.6,
        aim=2.3,
    )
    section.ratio(
        "single, another argument: ours / (template + greenlet)",
        ratio(times, "single, with another argument", "template", "greenlet"),
        bar=2.7,
        aim=2.3,
    )
    section.ratio(
        "single: ours / (barest possible environment + one greenlet round trip)",
        ratio(times, "single", "bare", "greenlet"),
    )
    section.ratio(
        "a decision function outside any environment / the plain function",
        ratio(_without_loop(outside), "decision", "plain"),
        bar=2.5,
        aim=2.1,
    )
    section.times(times)
    section.time("AEC, a dead agent's step, of 100", median(dead["100"]))
    section.time("AEC, a dead agent's step, of 10,000", median(dead["10000"]))
    alone = _without_loop(outside)
    section.time("plain function, without the loop around it", median(alone["plain"]))
    section.time("decision function outside any environment", median(alone["decision"]))
    return section


def _without_loop(outside: Times) -> Times:
    return {
        name: [time - loop for time, loop in zip(outside[name], outside["loop"], strict=True)]
        for name in ("plain", "decision")
    }


# -- contenders -----------------------------------------------------------------------------------


def dead_steps(env: Any, agents: int) -> Contender:
    """Make a contender of ``last`` and ``step`` of agents whose episode has ended."""

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


def bare_greenlet() -> Any:
    """Make a greenlet that only switches back; it waits for its first ``switch``."""

    def loop_in_greenlet() -> None:
        back = getcurrent().parent.switch
        while True:
            back(1)

    other = greenlet(loop_in_greenlet)
    other.switch()
    return other


def round_trip(number: int) -> Contender:
    """Make a contender of switches to a bare greenlet and back."""
    other = bare_greenlet()

    def loop(number: int) -> None:
        switch = other.switch
        for _ in range(number):
            switch(1)

    return timed(loop, number)


def _nothing(number: int) -> None:
    for _ in range(number):
        pass


def calls(function: Any, argument: Any, number: int) -> Contender:
    """Make a contender of calls of a function with one argument."""

    def loop(number: int) -> None:
        for _ in range(number):
            function(argument)

    return timed(loop, number)
