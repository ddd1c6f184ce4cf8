"""Mistakes of users that are told when the environment is made, or with the remedy."""

from queue import SimpleQueue
from threading import Thread

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import SimulationInterface, aec_env, envs, make_step, parallel_env, single_env
from simenv_marl.errors import DefinitionError, NoDecisionError, UnknownPointError


def definition(**changes):
    parts = {
        "agent": "ant",
        "observation_space": spaces.Discrete(2),
        "observation_space_mapping": lambda model: 0,
        "action_space": spaces.Discrete(2),
        "action_space_mapping": int,
        "reward_mapping": lambda model: 0.0,
    }
    return make_step(**{**parts, **changes})


class Model(SimulationInterface):
    def reset(self):
        self.decided = None

    def run(self):
        self.decided = self.choose()

    def choose(self):
        return 0


class Derived(Model):
    def choose(self):
        return 1


class Simulation(SimulationInterface):
    """Runs a derived model, though the point names the base class."""

    def reset(self):
        self.model = Derived()

    def run(self):
        self.model.run()


CHOOSE = f"{__name__}.Model.choose"


@pytest.mark.parametrize("part", ["observation_space_mapping", "reward_mapping", "agent", "action_mask_mapping"])
def test_a_simulation_parameter_that_is_not_keyword_only_is_refused(part):
    def mapping(model, _simulation=None):
        return 0

    with pytest.raises(DefinitionError, match=r"_simulation of .*mapping.* must be keyword-only: write it behind a \*"):
        aec_env(Model, {CHOOSE: definition(**{part: mapping})})


@pytest.mark.parametrize(
    ("name", "close"),
    [(f"{__name__}.Model.chose", "Model.choose"), (f"{__name__}.Modle.choose", f"{__name__}.Model")],
)
def test_a_typo_in_the_name_of_a_point_gets_the_nearest_names(name, close):
    with pytest.raises(UnknownPointError, match=f"did you mean .*{close}"):
        aec_env(Model, {name: definition()})


def test_an_episode_without_a_decision_names_the_functions_that_override_the_point():
    env = single_env(Simulation, {CHOOSE: definition()})
    with pytest.raises(NoDecisionError, match=rf"{CHOOSE}; .* called instead.*{__name__}\.Derived\.choose"):
        env.reset()


@pytest.mark.parametrize("make", [aec_env, parallel_env])
def test_possible_agents_without_a_roster_say_how_to_declare_them(make):
    env = make(Model, {CHOOSE: definition(agent=lambda model: "ant")})
    assert not hasattr(env, "possible_agents")
    with pytest.raises(AttributeError, match="declare them with the option possible_agents="):
        print(env.possible_agents)
    with pytest.raises(AttributeError, match="no attribute 'posible_agents'"):
        print(env.posible_agents)


@pytest.mark.parametrize(("action", "clipped"), [(2**64 - 1, 2**63 - 1), (-(2**63), -5), (7, 7)])
@pytest.mark.parametrize("shape", [(1,), (2,)])
def test_integers_are_clipped_without_wrapping_around(action, clipped, shape):
    box = spaces.Box(-5, 2**63 - 1, shape, np.int64)
    env = single_env(
        Model, {CHOOSE: definition(action_space=box, action_space_mapping=lambda action: action)}, clip_actions=True
    )
    env.reset()
    env.step(np.full(shape, action, np.uint64 if action > 7 else np.int64))
    assert env.unwrapped.simulation.decided.tolist() == [clipped] * shape[0]


def test_an_episode_whose_decisions_fall_in_a_late_thread_names_the_thread_and_the_point():
    calls, answers = SimpleQueue(), SimpleQueue()
    middleware = Thread(target=lambda: [answers.put(call()) for call in iter(calls.get, None)], name="middleware")

    class Served(Model):
        def run(self):
            calls.put(self.choose)
            assert answers.get(timeout=10) == 0

    middleware.start()
    env = single_env(Served, {f"{__name__}.Model.choose": definition()})
    try:
        with pytest.raises(NoDecisionError, match=rf"{CHOOSE}; .*threads that are not the simulation's: middleware"):
            env.reset()
    finally:
        calls.put(None)
        middleware.join()


def test_tab_completion_shows_what_users_call():
    own = ["driver", "episode", "plugins", "provenance", "simulation", "state_space"]
    for view, of_its_own in (
        ("SimulationAECEnv", []),
        ("SimulationParallelEnv", []),
        ("SimulationJointEnv", ["action_masks"]),
    ):
        kind = getattr(envs, view)
        theirs = {name for base in kind.__mro__ if not base.__module__.startswith("simenv_marl") for name in dir(base)}
        shown = {name for name in dir(kind) if not name.startswith("_")} - theirs
        shown -= {"np_random", "np_random_seed", "possible_agents", "state"}
        shown -= {f"{what}_space{plural}" for what in ("action", "observation") for plural in ("", "s")}
        assert sorted(shown) == sorted(own + of_its_own)
