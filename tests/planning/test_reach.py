"""Where planning meets what else there is: births in rounds, masks and clipping in wrappers, planners as bases."""

import os
import random
import time
from dataclasses import dataclass

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import TransformAction, TransformObservation, TransformReward
from pettingzoo.utils.wrappers import TerminateIllegalWrapper

from simenv_marl import SimulationInterface, aec_env, branch, difference, parallel_env, single_env
from simenv_marl.envs import pad_agents
from simenv_marl.errors import BranchError, OptionValueError
from simenv_marl.planning import RolloutPolicy, action_values
from tests.planning.test_action_values import METHODS, Global, begun, expected, made
from tests.processes import gone
from tests.worlds.duels import LEFT, RIGHT, SPACE, Duel, observe, points
from tests.worlds.models import define


class Births(SimulationInterface):
    """One decides; a second one is born in the first round and decides at once; both are paid at its end."""

    def reset(self, seed=None):
        self.earned, self.turn = {0: 0.0}, 0

    def reseed(self, seed):
        pass

    def run(self):
        while self.turn < 4:
            actions = {number: self.act(number) for number in list(self.earned)}
            if self.turn == 0:
                self.earned[1] = 0.0
                actions[1] = self.act(1)
            for number, action in actions.items():
                self.earned[number] += action
            self.turn += 1

    @define(
        action_space=spaces.Discrete(3),
        reward_mapping=difference(lambda births, number: births.earned[number]),
        agent=lambda births, number: f"born_{number}",
    )
    def act(self, number):
        return 1


@pytest.mark.parametrize("view", [aec_env, parallel_env])
def test_what_an_action_is_worth_reaches_to_the_next_decision(view):
    env = begun(view(Births, [Births.act]))
    turn = {"horizon": 1, "terminal_value": lambda env: 100 * env.unwrapped.simulation.turn}
    for given, means in (
        ({"horizon": 1}, [0, 1, 2]),
        ({"horizon": 2}, [1, 2, 3]),
        ({}, [3, 4, 5]),
        ({"discount": 0.5}, [0.875, 1.875, 2.875]),
        (turn, [100, 101, 102]),
        (turn | {"terminal_value": lambda env: np.array([7.0])}, [7, 8, 9]),
    ):
        assert action_values(env, futures=1, **given).means.tolist() == means


@pytest.mark.parametrize("wrapper", [lambda env: env, pad_agents])
def test_the_first_of_padded_rounds(wrapper):
    class Unannounced(Duel):
        def expected_calls(self, point):
            return []

    env = begun(wrapper(parallel_env(Unannounced, points(), possible_agents=["left", "right"])))
    assert action_values(env, futures=3, horizon=1).returns == pytest.approx(expected(env, "left", horizon=1))
    planner = RolloutPolicy((number for number in range(3)), futures=1, horizon=1)
    assert [planner.choose(env).best for _ in range(2)] == [2, 2]


def test_wrappers_that_look_at_masks_see_legal_actions():
    masked = {
        "observation_space": spaces.Dict(observation=SPACE, action_mask=spaces.Box(0, 1, (6,), np.int8)),
        "observation_space_mapping": lambda duel: {"observation": observe(duel)},
        "action_space": spaces.Discrete(6),
        "action_mask_mapping": lambda duel: [0, 1, 0, 1, 0, 0],
        "reward_mapping": difference(lambda duel: duel.value),
    }
    given = {LEFT: define(**masked, agent="left"), RIGHT: define(**masked, agent="right")}
    env = begun(aec_env(Duel, given))
    wrapped = begun(TerminateIllegalWrapper(aec_env(Duel, given), -1))
    assert action_values(wrapped, futures=2).returns.tolist() == action_values(env, futures=2).returns.tolist()


def high(observation):
    return 2 if observation[0] > 1 else 0


@pytest.mark.parametrize(
    ("view", "candidate"), [("aec", 1), ("parallel", 1), ("joint", {"left": 1, "right": 1})], ids=str
)
def test_a_planner_as_the_base_of_another_agent_is_its_base(view, candidate):
    plain, planned = (
        action_values(made(view), [candidate], base={"right": base}, futures=1).means.tolist()
        for base in (high, RolloutPolicy(base=high))
    )
    assert plain == planned


def test_the_base_of_a_planner_sees_what_wrappers_let_through():
    env = begun(TransformObservation(made("agent"), lambda observation: observation + 1000, None))
    told = [action_values(env, base=base, futures=1).means.tolist() for base in (high, RolloutPolicy(base=high))]
    assert told[0] == told[1] == action_values(made("agent"), base=lambda observation: 2, futures=1).means.tolist()


def test_parts_of_joint_actions_that_are_left_to_the_rule_go_around_wrappers_alone():
    def turned(action):
        return {name: 2 - part for name, part in action.items()}

    joint = made("joint")
    env = begun(TransformAction(joint, turned, joint.action_space))
    bases = ({"left": lambda observation: 0, "right": lambda observation: 1}, {"left": lambda observation: 0})
    both, one = (action_values(env, [{"left": 1, "right": 1}], base=base, futures=1).means[0] for base in bases)
    assert both == one


def test_candidates_that_are_clipped():
    amount = points(action_space=spaces.Box(0, 2, (1,), np.float32), action_space_mapping=np.sum)
    env = single_env(Duel, {LEFT: amount[LEFT]}, clip_actions=True)
    for wrapped in (env, TransformReward(env, lambda reward: reward)):
        told = action_values(begun(wrapped), [[5.0]], futures=3)
        assert told.returns == pytest.approx(expected(env, "left", (2,)))


@pytest.mark.filterwarnings("ignore:.*draws from the global generator", "ignore:.*cannot draw new random numbers")
def test_replays_leave_the_generators_of_the_process_alone():
    unlucky = points(observation_space_mapping=lambda duel: [duel.turn, 0])[LEFT]
    env = begun(single_env(Global, {LEFT: unlucky}))
    env.step(1)
    before = random.getstate()
    found = action_values(env, [1, 1, 1], futures=1, method="replay").returns.ravel().tolist()
    assert found == found[:1] * 3
    assert random.getstate() == before


def test_branches_are_not_nested_for_ever():
    def deeper(twin, number):
        return branch(twin, deeper, 1)

    with pytest.raises(BranchError, match="nested 4 deep"):
        branch(made("single"), deeper, 1)


@pytest.mark.skipif(not os.path.exists("/proc/self"), reason="what ends with its parent is Linux's to say")
def test_a_branch_that_is_ended_takes_its_own_branches_along(tmp_path):
    def slow(twin, number):
        (tmp_path / str(os.getpid())).touch()
        time.sleep(600)

    env = made("single")
    for limit in (0.5, 2.0, 8.0, 32.0):  # until the branch in the branch begins within it
        with pytest.raises(BranchError, match="longer than"):
            branch(env, lambda twin, number: branch(twin, slow, 1, method="fork"), 1, method="fork", time_limit=limit)
        if inner := [int(path.name) for path in tmp_path.iterdir()]:
            break
    assert inner
    assert all(map(gone, inner))


@pytest.mark.parametrize("limit", [0, -1.0, float("nan")])
def test_time_limits_that_cannot_be(limit):
    with pytest.raises(OptionValueError, match="time_limit"):
        branch(made("single"), lambda twin, number: None, time_limit=limit)


@dataclass(frozen=True)
class Unchanging(Exception):
    """An error that refuses to be changed."""

    value: int


@METHODS
def test_errors_come_as_themselves_and_say_which_candidate_was_tried_in_which_future(method):
    class Fragile(Duel):
        def run(self):
            raise Unchanging(1) if self.left() == 0 else ZeroDivisionError

    env = made("single", Fragile)
    with pytest.raises(Unchanging):
        action_values(env, futures=1, method=method)
    with pytest.raises(ZeroDivisionError) as raised:
        action_values(env, [2], futures=2, method=method)
    assert any("while 2 was tried out in future" in note for note in raised.value.__notes__)
