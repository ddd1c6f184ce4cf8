"""Infos have the same keys from the reset to the end: there are learners that ask for them once and for all."""

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, joint_env, parallel_env
from tests.worlds.models import Script, calling, decision

MASKED = {"action_mask_mapping": lambda: [0, 1, 1] + [0] * 7}
SEES_MASKS = {
    "observation_space": spaces.Dict(
        {"observations": spaces.Box(0, 9, (1,), np.float32), "action_mask": spaces.MultiBinary(10)}
    ),
    "observation_space_mapping": lambda: {"observations": [1.0]},
}


def clocked(*functions):
    """A factory of simulations with a clock, which call those functions one after the other."""

    class Clocked(Script):
        def time(self):
            return float(len(self.log))

    return lambda: Clocked(calling(*functions)().main)


def keys(env):
    """The keys of each agent's infos, as they are seen after the reset and after each step."""
    _, infos = env.reset(seed=1) or (None, env.infos)
    yield {agent: set(info) for agent, info in infos.items()}
    while env.agents:
        in_turns = hasattr(env, "agent_selection")
        results = env.step(None if in_turns and env.terminations[env.agent_selection] else RULE)
        yield {agent: set(info) for agent, info in (env.infos if in_turns else results[-1]).items()}


@pytest.mark.parametrize("make", [aec_env, parallel_env])
def test_keys_are_there_before_the_first_decision_and_stay(make):
    ant, bee, elk = decision(agent="ant_0", **MASKED), decision(agent="bee_0", **MASKED), decision(agent="elk_0")
    env = make(clocked(ant, bee, ant, ant, bee), [ant, bee, elk])
    more = {"deciding", "acted"} if make is parallel_env else set()
    expected = {
        "ant_0": {"action_mask", "time", "elapsed"} | more,
        "bee_0": {"action_mask", "time", "elapsed"} | more,
        "elk_0": {"time", "elapsed"} | more,
    }
    seen = list(keys(env))
    assert seen[0] == expected
    assert all(infos[agent] == expected[agent] for infos in seen for agent in infos)
    assert len(seen) > 2


def test_everything_is_legal_for_those_who_have_not_decided_yet():
    ant, bee, elk = (decision(agent=agent, **MASKED) for agent in ("ant_0", "bee_0", "elk_0"))
    env = aec_env(clocked(ant, bee, bee), [ant, bee, elk])
    env.reset()
    env.infos["bee_0"]["action_mask"][:] = 0  # the user's own
    assert env.infos["elk_0"]["action_mask"].tolist() == [1] * 10
    env.reset()
    assert env.infos["bee_0"]["action_mask"].tolist() == [1] * 10
    assert env.infos["bee_0"]["action_mask"].dtype == np.int8
    env.step(1)
    assert env.infos["bee_0"]["action_mask"].tolist() == [0, 1, 1] + [0] * 7
    assert (env.infos["bee_0"]["time"], env.infos["bee_0"]["elapsed"]) == (1.0, 0.0)
    env.step(2)
    assert (env.infos["bee_0"]["time"], env.infos["bee_0"]["elapsed"]) == (2.0, 1.0)


@pytest.mark.parametrize("make", [aec_env, parallel_env, joint_env])
def test_a_mask_in_an_observation_without_a_decision_is_open(make):
    """A mask of zeros would leave a policy nothing to choose from."""
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0", **MASKED, **SEES_MASKS)
    env = make(calling(ant, bee), [ant, bee])
    if make is aec_env:
        env.reset()
        observation = env.observe("bee_0")
    else:
        observation = env.reset()[0]["bee_0"]
    assert observation["action_mask"].tolist() == [1] * 10
    assert observation["observations"].tolist() == [0.0]
    space = env.observation_space["bee_0"] if make is joint_env else env.observation_space("bee_0")
    assert observation in space
    if make is parallel_env:
        observations, *_, infos = env.step({"ant_0": 1})
        seen, told = observations["bee_0"]["action_mask"], infos["bee_0"]["action_mask"]
        assert seen.tolist() == told.tolist() == [0, 1, 1] + [0] * 7
        assert seen.dtype == told.dtype == np.int8
        assert not np.shares_memory(seen, told)
