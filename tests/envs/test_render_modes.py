"""Render modes that a simulation lacks, and lists of pictures."""

import gymnasium
import numpy as np
import pytest

from simenv_marl import aec_env, parallel_env, register_simulation, single_env, vector_env
from tests.worlds.copied import Walk


class Drawn(Walk):
    """With pictures."""

    render_modes = ("rgb_array",)

    def render(self, mode):
        assert mode == "rgb_array"
        return np.full((2, 2, 3), len(self.steps), np.uint8)


@pytest.fixture(params=["a simulation", "a function"])
def registered(request):
    """The id of what is registered in one way or the other."""
    gymnasium.register("ByFunction-v0", lambda **options: single_env(Drawn, Drawn.choose, **options))
    identity = register_simulation(Drawn, Drawn.choose, name="drawn")[0]
    yield identity if request.param == "a simulation" else "ByFunction-v0"
    for each in (identity, "ByFunction-v0"):
        gymnasium.registry.pop(each)


@pytest.mark.parametrize(
    "make", [aec_env, parallel_env, single_env, lambda *of, **to: vector_env(*of, num_envs=1, **to)]
)
@pytest.mark.parametrize("mode", ["human", "rgb_array", "rgb_array_list"])
def test_a_mode_that_the_simulation_lacks_is_a_warning(make, mode):
    with pytest.warns(UserWarning, match=f"render_mode '{mode}' is not one of the simulation's .it has none."):
        env = make(Walk, Walk.choose, render_mode=mode)
    assert env.render_mode is None
    env.close()


def test_lists_of_pictures_have_those_since_the_last_reset_or_render(registered):
    env = gymnasium.make(registered, render_mode="rgb_array_list")
    for _ in range(2):
        env.reset()
        env.step(0)
        assert [int(frame[0, 0, 0]) for frame in env.render()] == [0, 1]
    env.step(0)
    assert [int(frame[0, 0, 0]) for frame in env.render()] == [2]
    env.close()


def test_vector_environments_collect_the_pictures_of_each_simulation(registered):
    envs = gymnasium.make_vec(registered, num_envs=2, render_mode="rgb_array_list")
    envs.reset()
    envs.step(envs.action_space.sample())
    assert [[int(frame[0, 0, 0]) for frame in frames] for frames in envs.render()] == [[0, 1]] * 2
    envs.close()
