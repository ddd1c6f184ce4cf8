"""The speed of a third-party model in environments, relative to the plain run: Mesa's unmodified wolf-sheep model.

All actions are ``RULE``, so that the simulation is the same as without an environment, tick for tick.
"""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import numpy as np
from greenlet import getcurrent, greenlet
from gymnasium import spaces
from mesa.examples.advanced.wolf_sheep import model as wolf_sheep
from mesa.examples.advanced.wolf_sheep.agents import Sheep, Wolf
from numpy.typing import NDArray

from benchmarks.measure import Contender, Section, now, ratio, side_by_side
from simenv_marl import RULE, TRUNCATED, Definition, SimulationInterface, aec_env, make_step, parallel_env

SEED = 5
TICKS = 25
KINDS: dict[str, Any] = {"wolf": Wolf, "sheep": Sheep}


class Meadow(SimulationInterface):
    """The model over ``TICKS`` ticks.

    Attributes:
        counts: The numbers of wolves and sheep after each tick.
    """

    def reset(self, seed: int | None = None) -> None:
        self.model, self.clock = wolves_and_sheep(seed)
        self.counts: list[tuple[int, int]] = []

    def run(self) -> Any:
        for _ in range(TICKS):
            self.clock.run_for(1)
            living = self.model.agents_by_type
            self.counts.append((len(living[Wolf]), len(living[Sheep])))
        return TRUNCATED

    def expected_calls(self, point: str) -> list[tuple[Any]]:
        living = self.model.agents_by_type
        return [(animal,) for kind in KINDS.values() if point == name_of(kind) for animal in living.get(kind, ())]

    def outcome(self) -> Any:
        """Return the state at the end of a run."""
        animals = [
            (animal.unique_id, animal.energy, animal.cell.coordinate)
            for kind in KINDS.values()
            for animal in self.model.agents_by_type.get(kind, ())
        ]
        return self.counts, animals, self.model.random.getstate()


def wolves_and_sheep(seed: int | None) -> tuple[Any, Any]:
    """Make the model, and the object that runs its ticks: since Mesa 3.5 the model itself, before a simulator."""
    if hasattr(wolf_sheep, "WolfSheepScenario"):
        model = wolf_sheep.WolfSheep(wolf_sheep.WolfSheepScenario(rng=seed))
        return model, model
    from mesa.experimental.devs import ABMSimulator

    simulator = ABMSimulator()
    return wolf_sheep.WolfSheep(simulator=simulator, seed=seed), simulator


def name_of(kind: type) -> str:
    """Return the name of a kind's decision point."""
    return f"{kind.__module__}.{kind.__qualname__}.move"


def observe(animal: Any) -> NDArray[np.float32]:
    return np.array((animal.energy, animal.p_reproduce), np.float32)


def reward(animal: Any) -> float:
    return float(animal.energy)


def move(action: int, animal: Any) -> None:
    cells = list(animal.cell.neighborhood)
    animal.cell = cells[action % len(cells)]


def definition(word: str) -> Definition:
    return make_step(
        observation_space=spaces.Box(-np.inf, np.inf, (2,), np.float32),
        observation_space_mapping=observe,
        action_space=spaces.Discrete(4),
        apply=move,
        reward_mapping=reward,
        agent=lambda animal: f"{word}_{animal.unique_id}",
        removed_by="mesa.agent.Agent.remove",
    )


POINTS = {name_of(kind): definition(word) for word, kind in KINDS.items()}


def measure(rounds: int, number: int) -> Section:
    """Measure in a number of rounds, of one episode each."""
    expected, ticks, _ = plain()
    _, decisions, _ = crossing()

    def contender(run: Callable[[], tuple[Any, int, float]], count: int) -> Contender:
        def checked() -> float:
            outcome, counted, seconds = run()
            assert outcome == expected
            assert counted == count
            gc.collect()  # the model's reference cycles, as automatic collection is off
            return seconds / decisions * 1e6

        return checked

    times = side_by_side(
        {
            "plain": contender(plain, ticks),
            "AEC": contender(aec, decisions),
            "AEC, without last": contender(lambda: aec(look=False), decisions),
            "parallel": contender(parallel, ticks),
            "only the crossing": contender(crossing, decisions),
            "the crossing and the mappings": contender(lambda: crossing(mappings=True), decisions),
        },
        rounds,
    )
    section = Section(
        "Mesa's WolfSheep, unmodified, RULE throughout", "microseconds per decision, the model's included"
    )
    section.ratio("WolfSheep, AEC: speed / the plain model's", ratio(times, "plain", "AEC"), 0.68, 0.8, at_least=True)
    section.ratio("AEC without last(), whose results RULE does not need", ratio(times, "plain", "AEC, without last"))
    section.ratio(
        "WolfSheep, parallel with expected_calls: speed / the plain model's",
        ratio(times, "plain", "parallel"),
        0.65,
        0.75,
        at_least=True,
    )
    section.ratio(
        "the least that suspends and resumes each decision, a bare greenlet: speed / the plain model's",
        ratio(times, "plain", "only the crossing"),
    )
    section.ratio(
        "the same with agents named, rewarded and observed: speed / the plain model's",
        ratio(times, "plain", "the crossing and the mappings"),
    )
    for view in ("AEC", "parallel"):
        section.ratio(
            f"{view}: speed / that of the crossing and the mappings",
            ratio(times, "the crossing and the mappings", view),
        )
    section.times(times)
    section.remarks.append(
        f"{ticks} ticks with {decisions:,} decisions; every run ends with the same animals in the same places and"
        f" the same state of the generator, and the parallel one takes {ticks} steps."
    )
    return section


# -- runs: each returns the outcome, the number of decisions, steps or ticks, and seconds ----------------------


def plain() -> tuple[Any, int, float]:
    """Run the model without an environment."""
    simulation = Meadow()
    simulation.reset(SEED)
    started = now()
    simulation.run()
    seconds = now() - started
    return simulation.outcome(), len(simulation.counts), seconds


def aec(*, look: bool = True) -> tuple[Any, int, float]:
    """Run an AEC environment, in the loop of PettingZoo's documentation or in the shortest one."""
    env: Any = aec_env(Meadow, POINTS)
    decisions, seconds = by_rule(env, SEED, look=look)
    return env.simulation.outcome(), decisions, seconds


def by_rule(env: Any, seed: int, *, look: bool) -> tuple[int, float]:
    """Run an episode of an AEC environment with ``RULE`` throughout; return the numbers of decisions and seconds."""
    env.reset(seed=seed)
    decisions = 0
    last, step = env.last, env.step
    started = now()
    for agent in env.agent_iter():
        if look:
            _, _, terminated, truncated, _ = last()
            over = terminated or truncated
        else:
            over = env.terminations[agent] or env.truncations[agent]
        if over:
            step(None)
        else:
            step(RULE)
            decisions += 1
    seconds = now() - started
    env.close()
    return decisions, seconds


def parallel() -> tuple[Any, int, float]:
    """Run a parallel environment, with all actions at once."""
    env: Any = parallel_env(Meadow, POINTS)
    env.reset(seed=SEED)
    steps = 0
    started = now()
    while env.agents:
        env.step(dict.fromkeys(env.agents, RULE))
        steps += 1
    seconds = now() - started
    env.close()
    return env.simulation.outcome(), steps, seconds


def crossing(*, mappings: bool = False) -> tuple[Any, int, float]:
    """Run without an environment: suspend and resume each decision, and call the mappings on demand."""
    simulation = Meadow()
    simulation.reset(SEED)
    rules = {kind: kind.move for kind in KINDS.values()}
    out = getcurrent().switch

    def suspended(rule: Callable[[Any], None], word: str) -> Callable[[Any], None]:
        def decide(animal: Any) -> None:
            out((word, animal))
            rule(animal)

        return decide

    for word, kind in KINDS.items():
        kind.move = suspended(rules[kind], word)
    inside = greenlet(simulation.run)
    decisions = 0
    try:
        started = now()
        asked = inside.switch()
        while asked is not TRUNCATED:
            decisions += 1
            if mappings:
                word, animal = asked
                f"{word}_{animal.unique_id}"
                reward(animal)
                observe(animal)
            asked = inside.switch()
        seconds = now() - started
    finally:
        for kind, rule in rules.items():
            kind.move = rule
    return simulation.outcome(), decisions, seconds
