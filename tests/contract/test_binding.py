"""Mappings get the call's arguments bound to the function's signature, in any form of the call."""

import pytest

from simenv_marl import RULE, parallel_env
from tests.worlds.models import calling, decision


def test_mappings_get_arguments_bound_to_the_decision_functions_signature():
    seen = {}

    def noting(name, value):
        def note(*args, **kwargs):
            seen[name] = args, kwargs
            return value

        return note

    def rule(x, y=2, *rest, z=3, **options):
        return x, y, *rest, z

    choose = decision(
        rule,
        agent=noting("agent", "ant"),
        observation_space_mapping=noting("observation", [0, 0]),
        action_mask_mapping=noting("mask", [1] * 10),
        apply=noting("apply", 7),
        reward_mapping=noting("reward", 0.0),
        rule_action_mapping=noting("rule action", 1),
    )
    bound = {
        lambda: choose(y=5, x=1): ((1, 5), {"z": 3}),
        lambda: choose(1, z=4): ((1, 2), {"z": 4}),
        lambda: choose(2, 3, 4, other=5): ((2, 3, 4), {"z": 3, "other": 5}),
    }
    for call, (args, kwargs) in bound.items():
        env = parallel_env(calling(call), choose)
        for action, decided in ((1, 7), (RULE, (*args, kwargs["z"]))):
            env.reset()
            env.step({"ant": action})
            assert env.simulation.log == [decided]
        before = {"apply": (1,), "rule action": (decided,)}
        assert seen == {name: ((*before.get(name, ()), *args), kwargs) for name in seen}
        assert len(seen) == 6
    seen.clear()
    with pytest.raises(TypeError, match=r"missing 1 required positional argument: 'x'"):
        parallel_env(calling(lambda: choose(y=1)), choose).reset()
    assert seen == {}
