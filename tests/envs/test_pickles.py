"""Pickles of environments: plain ones, and those whose model lives in the main module."""

import pickle
import subprocess
import sys

import pytest
from gymnasium import spaces

from simenv_marl import SimulationInterface, aec_env, joint_env, make_step, parallel_env, single_env


class Model(SimulationInterface):
    """Decides three times an episode."""

    def reset(self):
        self.decided = []

    def run(self):
        for _ in range(3):
            self.decided.append(self.choose())

    def choose(self):
        return 7


def definition():
    return make_step(
        agent="ant",
        observation_space=spaces.Discrete(9),
        observation_space_mapping=lambda model: len(model.decided),
        action_space=spaces.Discrete(2),
        action_space_mapping=lambda action: action,
        reward_mapping=lambda model: 0.0,
    )


@pytest.mark.parametrize("make", [aec_env, parallel_env, single_env, joint_env])
def test_plain_pickles_hold_definitions_with_lambdas(make):
    there = pickle.loads(pickle.dumps(make(Model, {Model.choose: definition()})))
    there.reset(seed=3)
    assert there.unwrapped.simulation.decided == []
    there.close()


MAIN = """
import cloudpickle
import pickle
from gymnasium import spaces
from simenv_marl import make_step, single_env

class Plain:
    def reset(self):
        self.decided = []

    def run(self):
        for _ in range(3):
            self.decided.append(self.choose())

    def choose(self):
        return 7

definition = make_step(
    agent="ant", observation_space=spaces.Discrete(9), observation_space_mapping=lambda model: 0,
    action_space=spaces.Discrete(2), action_space_mapping=int, reward_mapping=lambda model: 0.0,
)
made = single_env(Plain, {Plain.choose: definition})
early = [module.dumps(made) for module in (pickle, cloudpickle)]
made.reset()
late = [module.dumps(made) for module in (pickle, cloudpickle)]
Plain.rate = 5
for parcel in early + late:
    copied = pickle.loads(parcel)
    made.step(1)
    assert type(copied.unwrapped.simulation) is Plain
    copied.reset()
    copied.step(1)
    copied.close()
    decided = made.unwrapped.simulation.decided
    assert decided == [1] * len(decided), decided
    if len(decided) == 3:
        made.reset()
made.close()
for parcel in late:
    pickle.loads(parcel).close()
assert Plain.rate == 5 and Plain.choose.__code__.co_filename == __file__
"""


def test_copies_leave_a_class_of_the_main_module_as_it_stands(tmp_path):
    script = tmp_path / "main.py"
    script.write_text(MAIN, encoding="utf-8")
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")
