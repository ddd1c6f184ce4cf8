"""Render modes that a simulation lacks, and lists of pictures."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import (
    SimulationInterface,
    aec_env,
    make_step,
    parallel_env,
    register_simulation,
    single_env,
    vector_env,
)

DEFINITION = make_step(
    agent="ant",
    observation_space=spaces.Discrete(9),
    observation_space_mapping=lambda model: model.steps,
    action_space=spaces.Discrete(2),
    action_space_mapping=int,
    reward_mapping=lambda model: 0.0,
)


class Blind(SimulationInterface):
    """Decides three times an episode, and has no pictures."""

    def reset(self):
        self.steps = 0

    def run(self):
        for self.steps in range(3):
            self.choose()

    @DEFINITION
    def choose(self):
        return 0


class Drawn(Blind):
    """The same, with pictures."""

    render_modes = ("rgb_array",)

    def render(self, mode):
        assert mode == "rgb_array"
        return np.full((2, 2, 3), self.steps, np.uint8)


def by_function(**options):
    return single_env(Drawn, Drawn.choose, **options)


@pytest.fixture
def registered():
    """The ids of both simulations, and one that is registered on a function."""
    ids = [register_simulation(kind, kind.choose, name=kind.__name__)[0] for kind in (Blind, Drawn)]
    gymnasium.register("ByFunction-v0", by_function)
    yield [*ids, "ByFunction-v0"]
    for identity in (*ids, "ByFunction-v0"):
        gymnasium.registry.pop(identity)


@pytest.mark.parametrize(
    "make", [aec_env, parallel_env, single_env, lambda *of, **to: vector_env(*of, num_envs=1, **to)]
)
@pytest.mark.parametrize("mode", ["human", "rgb_array", "rgb_array_list"])
def test_a_mode_that_the_simulation_lacks_is_a_warning(make, mode):
    with pytest.warns(UserWarning, match=f"render_mode '{mode}' is not one of the simulation's .it has none."):
        env = make(Blind, Blind.choose, render_mode=mode)
    assert env.render_mode is None
    env.close()


@pytest.mark.parametrize("mode", ["human", "rgb_array"])
def test_registered_simulations_without_pictures_are_made(registered, mode):
    with pytest.warns(UserWarning, match="it has none"):
        env = gymnasium.make(registered[0], render_mode=mode)
    assert env.reset()[0] == 0
    env.close()


@pytest.mark.parametrize("number", [1, 2])
def test_lists_of_pictures_have_those_since_the_last_reset_or_render(registered, number):
    env = gymnasium.make(registered[number], render_mode="rgb_array_list")
    for _ in range(2):
        env.reset()
        env.step(0)
        assert [int(frame[0, 0, 0]) for frame in env.render()] == [0, 1]
    env.step(0)
    assert [int(frame[0, 0, 0]) for frame in env.render()] == [2]
    env.close()


@pytest.mark.parametrize("number", [1, 2])
def test_vector_environments_collect_the_pictures_of_each_simulation(registered, number):
    envs = gymnasium.make_vec(registered[number], num_envs=2, render_mode="rgb_array_list")
    envs.reset()
    envs.step(envs.action_space.sample())
    assert [[int(frame[0, 0, 0]) for frame in frames] for frames in envs.render()] == [[0, 1]] * 2
    envs.close()
