"""The reservoirs of ``tests/worlds/outside.py`` as a simulation, in a process or in this one."""

import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from gymnasium import spaces

from simenv_marl import SimulationInterface, difference, make_step
from simenv_marl.remote import ProcessSimulation
from tests.worlds import outside
from tests.worlds.models import play


def total(call):
    return [call.total]


def cost(call):
    return -call.total


INFLOW = make_step(
    observation_space=spaces.Box(-50, 50, (2,), np.float64),
    observation_space_mapping=lambda call: [call.level, call["queue-length"]],
    action_space=spaces.Box(0, 5, (1,), np.float64),
    action_space_mapping=lambda action: float(action[0]),
    reward_mapping=difference(lambda call: call.level),
    agent=lambda call: call.entity,
)
# Can be pickled.
PRICE = make_step(
    observation_space=spaces.Box(-500, 500, (1,), np.float64),
    observation_space_mapping=total,
    action_space=spaces.Discrete(3),
    action_space_mapping={0: 0.5, 1: 1.0, 2: 2.0},
    reward_mapping=cost,
)
BOTH = {"reservoir.inflow": INFLOW, "broker.price": PRICE}


def command(*arguments):
    """What starts the model in a process of its own."""
    return [sys.executable, outside.__file__, *arguments]


def reservoirs(points=BOTH, **options):
    """The model in a process of its own."""
    return ProcessSimulation(command(), points, **options)


def broken(what):
    """A simulator that does something wrong in mid-episode."""
    return ProcessSimulation(command("faulty", what), BOTH, timeout=20.0)


CHANGED = """
import sys
sys.path.insert(0, {folder!r})
import outside
{change}
outside.main()
"""


def changed(folder, change):
    """What starts the model with some change to it or to its end of the wire."""
    script = folder / "changed.py"
    script.write_text(CHANGED.format(folder=str(Path(outside.__file__).parent), change=change))
    return [sys.executable, str(script)]


def by_its_rule(seed, **options):
    """What comes of the model by its own rule, in this process."""
    return outside.Reservoirs(seed, options).by_its_rule()


def child(env):
    """The number of the process of an environment's simulation; None if it has none."""
    found = env.unwrapped.simulation._child
    return None if found is None else found.pid


def plays_by_its_rule(env, seed=1, **options):
    """Whether an episode of an AEC environment in which the rule decides is the model's own."""
    env.reset(seed=seed, options=options)
    play(env, reset=False)
    return env.unwrapped.simulation.result == by_its_rule(seed, **options)


class Call:
    """A call's arguments."""

    def __getitem__(self, name):
        return vars(self)[name]


def inflow(call):
    return call.rule()


def price(call):
    return call.rule()


def removed(call):
    """It is gone."""


TELLING = {
    "reservoir.inflow": replace(INFLOW, rule_action_mapping=lambda decision: [decision]),
    "broker.price": replace(PRICE, rule_action_mapping=lambda decision: min(2, int(decision))),
}
"""For where it is known what the rule decides."""


class Here(SimulationInterface):
    """The model in this process: what its process is to be indistinguishable from."""

    points: ClassVar = {
        f"{__name__}.inflow": replace(
            TELLING["reservoir.inflow"], removed_by=f"{__name__}.removed"
        ),
        f"{__name__}.price": TELLING["broker.price"],
    }

    def reset(self, seed=None, options=None):
        self.model = outside.Reservoirs(seed, options or {})
        self.calls = defaultdict(Call)

    def run(self):
        self.model.run(
            self._decide,
            lambda point, entity: removed(self.calls.pop((point, entity))),
            lambda point, entity, arguments: vars(self.calls[point, entity]).update(arguments),
        )

    def time(self):
        return self.model.time

    def _decide(self, point, entity, time, arguments, rule):
        call = self.calls[point, entity]
        vars(call).update(arguments, entity=entity, rule=rule)
        return price(call) if entity is None else inflow(call)
