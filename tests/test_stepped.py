"""Models that are made with a seed and stepped, as simulations."""

import copy
import pickle
import random
from functools import partial

import pytest
from gymnasium import spaces

from simenv_marl import RULE, SteppedSimulation, aec_env, evaluate, simulate, single_env
from simenv_marl.errors import OptionValueError, SimulationError, UnknownPointError
from tests.worlds.models import begun, define


class Walk:
    """A walk that ends where it gets too far."""

    def __init__(self, drift=0.0, far=50.0, seed=None):
        self.random = random.Random(seed)
        self.drift, self.far, self.place, self.running = drift, far, 0.0, True

    def step(self):
        self.place += self.stride() + self.random.uniform(-1, 1)
        self.running = abs(self.place) < self.far

    def stride(self):
        return self.drift


class ByRng(Walk):
    def __init__(self, *, rng=None):
        super().__init__(seed=rng)


class PassedOn(ByRng):
    """Passes the seed on, as models of Mesa do."""

    def __init__(self, drift=0.0, **kwargs):
        super().__init__(**kwargs)
        self.drift = drift


class Planned(Walk):
    """Takes a scenario, which holds its seed, as Mesa's own models do."""

    def __init__(self, scenario=None):
        super().__init__(**(scenario or {}))


class Clocked:
    """Events between whole units of time, and no steps."""

    def __init__(self, seed=None):
        self.time = 0.0
        self.log = []

    def run_for(self, duration):
        for moment in (0.25, 0.75):
            self.time = float(int(self.time)) + moment
            self.log.append(self.ring())
        self.time = float(int(self.time)) + duration

    def ring(self):
        return -1


STRIDE = {
    f"{__name__}.Walk.stride": define(
        observation_space_mapping=lambda walk: [walk.place, 0.0],
        action_space=spaces.Discrete(3),
        action_space_mapping=lambda action: action - 1.0,
    )
}


def walked(seed, steps, **parameters):
    model = Walk(seed=seed, **parameters)
    for _ in range(steps):
        model.step()
    return model.place


def test_stepped_simulation_with_rule_actions_runs_like_without_env():
    assert simulate(SteppedSimulation(Walk, 20, drift=0.1), seed=3).model.place == walked(
        3, 20, drift=0.1
    )
    env = begun(single_env(SteppedSimulation(Walk, 20), STRIDE), 3)
    ended = False
    while not ended:
        *_, terminated, truncated, info = env.step(RULE)
        ended = terminated or truncated
    assert env.simulation.model.place == walked(3, 20)
    assert (terminated, truncated, info["time"]) == (False, True, 20.0)
    first = env.simulation.model
    env.reset(seed=3)
    assert env.simulation.model is not first
    env.close()


@pytest.mark.parametrize("steps", [None, 1000])
def test_stepped_simulation_ends_when_the_model_stops_running(steps):
    env = begun(aec_env(SteppedSimulation(Walk, steps, far=3.0), STRIDE), 1)
    while not env.terminations["stride_0"]:
        env.step(2)
    assert not env.truncations["stride_0"]
    env.close()


def test_stepped_simulation_passes_the_seed_to_the_model():
    assert simulate(SteppedSimulation(ByRng, 5), seed=2).model.place == walked(2, 5)
    assert simulate(SteppedSimulation(PassedOn, 5, drift=1.0), seed=2).model.place == walked(
        2, 5, drift=1.0
    )
    assert simulate(SteppedSimulation(partial(PassedOn, 1.0), 5), seed=2).model.place == walked(
        2, 5, drift=1.0
    )
    assert simulate(
        SteppedSimulation(lambda **given: Walk(**given), 5), seed=2
    ).model.place == walked(2, 5)
    assert simulate(SteppedSimulation(lambda: Walk(seed=1), 5), seed=2).model.place == walked(1, 5)
    # by the user's own seed
    assert simulate(SteppedSimulation(Walk, 5, seed=9), seed=2).model.place == walked(9, 5)


def test_stepped_simulation_seeds_a_model_whose_scenario_holds_the_seed():
    with pytest.raises(
        SimulationError, match=r"Planned'> takes a scenario.*lambda seed, \*\*parameters"
    ):
        SteppedSimulation(Planned, 5)
    made = SteppedSimulation(
        lambda seed, **parameters: Planned({"seed": seed, **parameters}), 5, drift=0.1
    )
    assert simulate(made, seed=2).model.place == walked(2, 5, drift=0.1)
    fixed = SteppedSimulation(Planned, 5, scenario={"seed": 4})  # by the user's own scenario
    assert simulate(fixed, seed=2).model.place == walked(4, 5)


def test_stepped_simulation_runs_the_same_after_copying_and_pickling():
    simulation = SteppedSimulation(Walk, 5, drift=0.5)
    for twin in (copy.deepcopy(simulation), pickle.loads(pickle.dumps(simulation))):
        assert simulate(twin, seed=2).model.place == walked(2, 5, drift=0.5)


def test_stepped_simulation_refuses_invalid_arguments():
    with pytest.raises(SimulationError, match="the class of a model, not 3"):
        SteppedSimulation(3)
    for steps in (0, -1, 1.5, True, "many"):
        with pytest.raises(OptionValueError, match="steps"):
            SteppedSimulation(Walk, steps)
    with pytest.raises(SimulationError, match="no method step"):
        simulate(SteppedSimulation(object, 3))
    with pytest.raises(TypeError, match="length"):
        simulate(SteppedSimulation(Walk, 3, length=1))


def test_stepped_simulation_uses_only_the_points_that_it_is_given():
    with pytest.raises(UnknownPointError, match="points is empty"):
        aec_env(SteppedSimulation(Walk, 5))
    assert evaluate(SteppedSimulation(Walk, 5), {"rule": {}}, seeds=[1]).frame[
        "return"
    ].tolist() == [0.0]
    played = simulate(
        SteppedSimulation(Walk, 5), {"stride_0": lambda place: 2}, points=STRIDE, seed=2
    )
    assert played.model.place == walked(2, 5, drift=1.0)


def test_stepped_simulation_runs_a_model_without_steps_for_units_of_time():
    ring = {f"{__name__}.Clocked.ring": define()}
    env = single_env(SteppedSimulation(Clocked, 2), ring)
    _, info = env.reset(seed=1)
    times = [info["time"]]
    truncated = False
    while not truncated:
        *_, truncated, info = env.step(3)
        times.append(info["time"])
    assert times == [0.25, 0.75, 1.25, 1.75, 2.0]
    assert env.unwrapped.simulation.model.log == [3] * 4


def test_stepped_simulation_counts_steps_as_time_if_the_model_has_no_clock():
    class Timeless(Walk):
        def time(self):
            return "late"

    simulation = simulate(SteppedSimulation(Timeless, 3), {}, seed=1)
    assert simulation.time() == 3.0
