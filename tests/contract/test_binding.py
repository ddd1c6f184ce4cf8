"""Mappings get the call's arguments bound to the function's signature, however the model writes the call."""

import pytest
from gymnasium import spaces

from simenv_marl import RULE, SimulationInterface, make_step, parallel_env

CALLS = {
    "by position": (lambda model: model.choose(1, 2), (1, 2), {"z": 3}),
    "by keyword": (lambda model: model.choose(y=5, x=1), (1, 5), {"z": 3}),
    "with defaults": (lambda model: model.choose(1), (1, 2), {"z": 3}),
    "with a keyword-only argument": (lambda model: model.choose(1, z=4), (1, 2), {"z": 4}),
    "with more than are named": (lambda model: model.choose(2, 3, 4, other=5), (2, 3, 4), {"z": 3, "other": 5}),
}


def recording(call, seen):
    """A simulation that decides once by ``call``; the definition notes what its callables get."""

    def noting(name, value):
        def note(*args, **kwargs):
            seen[name] = args, kwargs
            return value

        return note

    class Model(SimulationInterface):
        @make_step(
            agent=noting("agent", "ant"),
            observation_space=spaces.Discrete(2),
            observation_space_mapping=noting("observation", 0),
            action_space=spaces.Discrete(2),
            action_mask_mapping=noting("mask", [1, 1]),
            apply=noting("apply", 7),
            reward_mapping=noting("reward", 0.0),
            rule_action_mapping=noting("rule action", 1),
        )
        def choose(self, x, y=2, *rest, z=3, **options):
            return x, y, *rest, z

        def reset(self):
            self.decided = None

        def run(self):
            self.decided = call(self)

    return Model


@pytest.mark.parametrize(("call", "args", "kwargs"), CALLS.values(), ids=list(CALLS))
def test_every_callable_gets_the_bound_arguments(call, args, kwargs):
    seen = {}
    simulation = recording(call, seen)
    env = parallel_env(simulation, simulation.choose)
    env.reset()
    env.step({"ant": 1})
    model = env.unwrapped.simulation
    assert model.decided == 7
    env.reset()
    env.step({"ant": RULE})
    assert model.decided == (*args, kwargs["z"])
    before = {"apply": (1,), "rule action": (model.decided,)}
    assert seen == {name: ((*before.get(name, ()), model, *args), kwargs) for name in seen}
    assert len(seen) == 6
    env.close()


def test_a_call_that_does_not_bind_raises_the_error_of_python():
    seen = {}
    simulation = recording(lambda model: model.choose(y=1), seen)
    env = parallel_env(simulation, simulation.choose)
    with pytest.raises(TypeError, match=r"missing 1 required positional argument: 'x'"):
        env.reset()
    assert seen == {}
