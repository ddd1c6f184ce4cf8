"""The speed of EnergyPlus when its thermostats are agents, relative to the plain run.

Run it with ``python -m benchmarks.energyplus``; it needs the extra ``energyplus``. All actions are ``RULE``, so that
the simulation is the same as without an environment. The time is that of the whole run: set-up, EnergyPlus's warm-up
days, the days of the run, and its end.
"""

from __future__ import annotations

import argparse
import queue
import threading
from collections.abc import Callable
from typing import Any

from examples.energyplus_zones.env import BuildingSim, parallel_env, raw_env
from examples.energyplus_zones.model import STEPS_PER_DECISION, Zone

from benchmarks.measure import Contender, Section, now, ratio, side_by_side
from simenv_marl import RULE

SEED = 3


def measure(rounds: int) -> Section:
    """Measure in a number of rounds, of one run each."""
    expected, decisions, _ = plain()

    def contender(run: Callable[[], tuple[str, int, float]]) -> Contender:
        def checked() -> float:
            results, counted, seconds = run()
            assert results == expected
            assert counted == decisions
            return seconds / decisions * 1e6

        return checked

    runs = {"plain": plain, "AEC": aec, "AEC, driver=thread": threaded, "parallel": rounds_of_both, "queues": queues}
    times = side_by_side({name: contender(run) for name, run in runs.items()}, rounds)
    section = Section("EnergyPlus, two rooms, RULE throughout", "microseconds per decision, EnergyPlus included")
    section.ratio("EnergyPlus, AEC: speed / the plain run's", ratio(times, "plain", "AEC"), 0.95, 1.0, at_least=True)
    section.ratio("EnergyPlus, parallel: speed / the plain run's", ratio(times, "plain", "parallel"), at_least=True)
    section.ratio('AEC with driver="thread": speed / the plain run\'s', ratio(times, "plain", "AEC, driver=thread"))
    section.ratio("a thread and two queues, as others do it: speed / the plain run's", ratio(times, "plain", "queues"))
    section.times(times)
    section.remarks.append(f"{decisions:,} decisions; every run writes the same results, digit by digit.")
    return section


# -- runs: each returns the results, the number of decisions, and seconds --------------------------------------------


def plain() -> tuple[str, int, float]:
    """Run the model without an environment."""
    simulation = BuildingSim()
    started = now()
    simulation.reset(SEED)
    simulation.run()
    simulation.close()
    seconds = now() - started
    return simulation.results, 2 * simulation.building.steps // STEPS_PER_DECISION, seconds


def aec(**options: Any) -> tuple[str, int, float]:
    """Run an AEC environment, in the loop of PettingZoo's documentation."""
    env: Any = raw_env(**options)
    decisions = 0
    started = now()
    env.reset(seed=SEED)
    for _ in env.agent_iter():
        _, _, terminated, truncated, _ = env.last()
        if terminated or truncated:
            env.step(None)
        else:
            env.step(RULE)
            decisions += 1
    env.close()
    return env.unwrapped.simulation.results, decisions, now() - started


def threaded() -> tuple[str, int, float]:
    """Run the same with the thread driver."""
    return aec(driver="thread")


def rounds_of_both() -> tuple[str, int, float]:
    """Run a parallel environment, with all actions at once."""
    env: Any = parallel_env()
    decisions = 0
    started = now()
    env.reset(seed=SEED)
    while env.agents:
        decisions += len(env.agents)
        env.step(dict.fromkeys(env.agents, RULE))
    env.close()
    return env.unwrapped.simulation.results, decisions, now() - started


def queues() -> tuple[str, int, float]:
    """Run EnergyPlus in a thread without an environment; decisions cross two queues."""
    simulation, asked, answered, rule = BuildingSim(), queue.Queue[Any](1), queue.Queue[Any](1), Zone.choose_setpoint

    def decide(zone: Zone) -> float:
        asked.put(zone)
        answered.get()
        return rule(zone)

    def run() -> None:
        simulation.reset(SEED)
        simulation.run()
        simulation.close()
        asked.put(None)

    decisions = 0
    Zone.choose_setpoint = decide  # type: ignore[method-assign]
    try:
        started = now()
        thread = threading.Thread(target=run)
        thread.start()
        while asked.get() is not None:
            decisions += 1
            answered.put(None)
        thread.join()
    finally:
        Zone.choose_setpoint = rule  # type: ignore[method-assign]
    return simulation.results, decisions, now() - started


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=20, help="runs of each contender (20)")
    section = measure(parser.parse_args().rounds)
    for figure in section.ratios:
        print(*figure.row(), sep=" | ")
    for what, time in section.medians.items():
        print(f"{what}: {time:.1f} us per decision")
    print(*section.remarks, sep="\n")
