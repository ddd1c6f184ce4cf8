"""A controller in ROS 1, whose callbacks run in threads, on simulated time."""

import json
import os
import subprocess

import numpy as np
import pytest
from examples.ros_follower import env as ros

from tests.outside.reservoirs import child
from tests.worlds.models import follow_the_rule

pytestmark = pytest.mark.skipif(bool(ros.missing()), reason=ros.missing())


def test_ros_episodes_with_rule_actions_match_a_run_without_env(make_env):
    env, found = make_env(ros.env), []
    for seed in range(5):
        for _ in range(2):
            found.append(follow_the_rule(env, seed).result)
            env.reset(seed=9)
            for _ in range(10 * seed):
                env.step(env.action_space.sample())
    printed = subprocess.run(
        [*ros.COMMAND, "0"], check=True, capture_output=True, timeout=60
    ).stdout
    assert found[::2] == found[1::2]
    assert len({result["digest"] for result in found}) == 5
    assert found[0] == json.loads(printed)


@pytest.mark.greenlet("the driver makes no difference to the nodes")
def test_ros_nodes_get_a_policys_decisions_and_end_with_the_env(make_env):
    env = make_env(ros.env)
    env.reset(seed=1)
    group = child(env)
    observation, reward, *_ = env.step(np.array([1.0, 0.0], np.float32))
    assert observation[0] == pytest.approx(1.95, abs=0.01), (
        "both move ahead: half a metre and a metre per second"
    )
    assert reward == pytest.approx(-0.95, abs=0.01)
    env.close()
    with pytest.raises(ProcessLookupError):
        os.killpg(group, 0)
