"""An environment that is used from inside itself says so, in every view, whatever is asked or runs just then."""

from contextlib import closing

import numpy as np
import pytest

from simenv_marl import RULE, aec_env, joint_env, parallel_env, single_env, vector_env
from simenv_marl.errors import NotResetError, ReentrancyError
from tests.worlds.models import decision, script


def vector(*args, **options):
    return vector_env(*args, num_envs=2, **options)


VIEWS = {
    "aec": (aec_env, 1),
    "parallel": (parallel_env, {"ant_0": 1}),
    "single": (single_env, 1),
    "joint": (joint_env, {"ant_0": 1}),
    "vector": (vector, np.array([1, 1])),
    "vector of joint": (vector, {"ant_0": np.array([1, 1])}),
}
PLACES = [
    *["action_space_mapping", "observation_space_mapping", "reward_mapping", "action_mask_mapping", "choices", "apply"],
    *["agent", "rule", "policy", "plugin", "time", "expected_calls", "reset"],
]


class World:
    """An environment that is used from one place inside itself, once it is armed for that."""

    def __init__(self, view, place, method):
        make, self.action = VIEWS[view]
        self.place, self.method = place, method
        self.armed, self.resetting, self.catch, self.raised = False, False, True, []
        self.made = []

        def ant_rule():
            return 0

        named = view == "vector of joint" or place == "agent"
        ant = decision(
            ant_rule, **{"agent": (lambda: self.at("agent", "ant_0")) if named else "ant_0"} | self.changes()
        )
        bee = decision(lambda: self.at("rule", 0), agent="bee_0")

        def main(simulation):
            for _ in range(3):
                bee()
                simulation.log.append(ant())

        def simulation():
            made = script(main)()
            if place == "reset":
                reset = made.reset
                made.reset = lambda seed=None: (reset(seed), self.at("reset", None))
            if place == "time":
                made.time = lambda: self.at("time", 0.0)
            if place == "expected_calls":
                made.expected_calls = lambda point: self.at("expected_calls", [()] if "ant_rule" in point else [])
            self.made.append(made)
            return made

        policies = {"bee_0": (lambda *_: self.at("policy", 1)) if place == "policy" else RULE}
        options = {"policies": policies, "possible_agents": ["ant_0"] if named else None}
        if place == "plugin":
            options["plugins"] = [(lambda: self.at("plugin", None), bee, "before")]
        self.env = make(simulation, [ant, bee], **options)

    def changes(self):
        values = {
            "action_space_mapping": lambda action: self.at("action_space_mapping", action),
            "observation_space_mapping": lambda: self.at("observation_space_mapping", [0, 0]),
            "reward_mapping": lambda: self.at("reward_mapping", 1.0),
            "action_mask_mapping": lambda: self.at("action_mask_mapping", [1] * 10),
            "choices": lambda: self.at("choices", list(range(10))),
            "apply": lambda action: self.at("apply", action),
        }
        return {name: value for name, value in values.items() if name == self.place}

    def at(self, place, value):
        """Come by a place, at which a value is asked for."""
        if self.armed and place == self.place:
            self.armed = False
            try:
                getattr(self if self.method == "step" else self.env, self.method)()
            except (ReentrancyError, NotResetError) as error:
                said = type(error) is ReentrancyError and (self.resetting or "was used from" in str(error))
                self.raised.append(said or (self.resetting and self.method == "step"))
                if not self.catch:
                    raise
            else:
                self.raised.append("nothing")
        return value

    def step(self):
        self.env.step(self.action)

    def play(self):
        for _ in range(3):
            self.step()

    def played_as_ever(self):
        """Whether those simulations that the environment has used were answered each time."""
        return all(made.log == [1, 1, 1] for made in self.made if getattr(made, "log", None))


def possible(view, place):
    """Single views know no agents that are named by a callable, and only joint ones ask for what is expected."""
    if place == "agent":
        return view not in ("single", "vector")
    return place != "expected_calls" or view in ("parallel", "joint", "vector of joint")


EVERYWHERE = pytest.mark.parametrize(
    ("view", "place"), [(view, place) for view in VIEWS for place in PLACES if possible(view, place)]
)
METHODS = pytest.mark.parametrize("method", ["step", "reset", "close"])


@EVERYWHERE
@METHODS
def test_an_environment_that_is_used_from_inside_itself_says_so_and_goes_on(view, place, method):
    if place == "reset":
        return
    world = World(view, place, method)
    with closing(world.env):
        for world.catch in (True, True, False, False):
            world.env.reset(seed=1)
            world.armed = True
            if world.catch:
                world.play()
                assert world.played_as_ever()
            else:
                with pytest.raises(ReentrancyError, match="was used from"):
                    world.play()
            assert not world.armed
        assert world.raised == [True] * 4
        world.env.reset(seed=1)
        world.play()
        assert world.played_as_ever()


@EVERYWHERE
@METHODS
def test_an_environment_that_is_used_from_inside_its_own_reset_says_so_and_goes_on(view, place, method):
    world = World(view, place, method)
    with closing(world.env):
        world.armed = world.resetting = True
        world.env.reset(seed=1)
        world.resetting = False
        assert world.raised == [True] * (not world.armed)
        assert not (world.armed and place in ("reset", "rule", "observation_space_mapping", "policy"))
        world.armed = False
        world.play()
        assert world.played_as_ever()
