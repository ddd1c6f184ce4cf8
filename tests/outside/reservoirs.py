"""The reservoirs of ``tests/worlds/outside.py`` as a simulation: in a process of its own, and in this one."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from gymnasium import spaces

from simenv_marl import TRUNCATED, SimulationInterface, difference, make_step
from simenv_marl.remote import ProcessSimulation
from tests.worlds import faulty, outside
from tests.worlds.models import play

INFLOW = make_step(
    observation_space=spaces.Box(-50, 50, (2,), np.float64),
    observation_space_mapping=lambda call: [call.level, call["queue-length"]],
    action_space=spaces.Box(0, 5, (1,), np.float64),
    action_space_mapping=lambda action: float(action[0]),
    reward_mapping=difference(lambda call: call.level),
    agent=lambda call: call.entity,
)
PRICE = make_step(
    observation_space=spaces.Box(-500, 500, (1,), np.float64),
    observation_space_mapping=lambda call: [call.total],
    action_space=spaces.Discrete(3),
    action_space_mapping={0: 0.5, 1: 1.0, 2: 2.0},
    reward_mapping=lambda call: -call.total,
)
BOTH = {"reservoir.inflow": INFLOW, "broker.price": PRICE}


def command(*arguments: str) -> list[str]:
    """What starts the model in a process of its own."""
    return [sys.executable, outside.__file__, *arguments]


def reservoirs(points=BOTH, **options) -> ProcessSimulation:
    """The model in a process of its own."""
    return ProcessSimulation(command(), points, **options)


def broken(when: str, what: str, timeout: float = 20.0, points=BOTH) -> ProcessSimulation:
    """A simulator that does something wrong."""
    return ProcessSimulation([sys.executable, faulty.__file__, when, what], points, timeout=timeout)


CHANGED = """
import sys
sys.path.insert(0, {folder!r})
import outside
{change}
outside.main()
"""


def changed(folder: Path, change: str) -> list[str]:
    """What starts the model with some change to it or to its end of the wire."""
    script = folder / "changed.py"
    script.write_text(CHANGED.format(folder=str(Path(outside.__file__).parent), change=change))
    return [sys.executable, str(script)]


def by_its_rule(seed: int, **options) -> dict:
    """What comes of the model by its own rule, in this process."""
    model = outside.Reservoirs(seed, options)
    model.run(lambda point, entity, time, arguments, rule: rule(), lambda *named: None, lambda *named: None)
    return told(model.result())


def told(result: dict) -> dict:
    """A result as it arrives."""
    return {**result, "log": [list(row) for row in result["log"]]}


def child(env):
    """The number of the process of an environment's simulation; None if it has none."""
    found = env.unwrapped.simulation._child
    return None if found is None else found.pid


def plays_by_its_rule(env, seed=1, **options) -> bool:
    """Whether an episode of an AEC environment in which the rule decides is the model's own."""
    env.reset(seed=seed, options=options)
    play(env, reset=False)
    return env.unwrapped.simulation.result == by_its_rule(seed, **options)


class Here(SimulationInterface):
    """The model in this process: what its process is to be indistinguishable from."""

    def __init__(self) -> None:
        self.calls: dict = {}

    def reset(self, seed=None, options=None) -> None:
        self.options = options or {}
        self.calls = {}
        self.model = outside.Reservoirs(seed, self.options)

    def run(self):
        self.model.run(self._decide, self._remove, self._update)
        return TRUNCATED if self.options.get("truncated") else None

    def time(self) -> float:
        return self.model.time

    def _decide(self, point, entity, time, arguments, rule):
        function = {"reservoir.inflow": inflow, "broker.price": price}[point]
        call = self.calls.setdefault((point, entity), Call())
        vars(call).update(arguments, entity=entity, rule=rule)
        return function(call)

    def _update(self, point, entity, arguments) -> None:
        vars(self.calls[point, entity]).update(arguments)

    def _remove(self, point, entity) -> None:
        removed(self.calls.pop((point, entity)))


class Call:
    """A call's arguments."""

    def __getitem__(self, name):
        return vars(self)[name]


def inflow(call):
    return call.rule()


def price(call):
    return call.rule()


def removed(call) -> None:
    """It is gone."""


HERE = f"{__name__}."
BOTH_HERE = {
    f"{HERE}inflow": replace(INFLOW, removed_by=f"{HERE}removed"),
    f"{HERE}price": PRICE,
}
