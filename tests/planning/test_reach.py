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

from simenv_marl import (
    SimulationInterface,
    aec_env,
    branch,
    difference,
    joint_env,
    make_step,
    parallel_env,
    single_env,
)
from simenv_marl.envs import pad_agents
from simenv_marl.errors import BranchError, OptionValueError
from simenv_marl.planning import RolloutPolicy, action_values
from tests.processes import gone

SPACE = spaces.Box(-99, 99, (2,), np.float32)


def point(state, agent, earned):
    """A decision point of an agent that sees its state and is paid what is earned."""
    return make_step(
        observation_space=SPACE,
        observation_space_mapping=state,
        action_space=spaces.Discrete(3),
        action_space_mapping=int,
        reward_mapping=difference(earned),
        agent=agent,
    )


class Pair(SimulationInterface):
    """Two who decide in turn; at the end of a round one has earned both actions, the other ten times its own."""

    def reset(self, seed=None):
        self.turn, self.both, self.own = 0, 0.0, 0.0

    def reseed(self, seed):
        pass

    def run(self):
        while self.turn < 4:
            first, second = self.first(), self.second()
            self.both += first + second
            self.own += 10 * second
            self.turn += 1

    @point(lambda pair: [pair.turn, 1], "first", lambda pair: pair.both)
    def first(self):
        return 1

    @point(lambda pair: [pair.turn, 2], "second", lambda pair: pair.own)
    def second(self):
        return 1


POINTS = [Pair.first, Pair.second]


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

    @point(
        lambda births, number: [births.turn, number],
        lambda births, number: f"born_{number}",
        lambda births, number: births.earned[number],
    )
    def act(self, number):
        return 1


def begun(env):
    env.reset(seed=1)
    return env


@pytest.mark.parametrize("view", [aec_env, parallel_env])
def test_what_an_action_is_worth_reaches_to_the_next_decision(view):
    env = begun(view(Births, [Births.act]))
    for horizon, means in ((1, [0, 1, 2]), (2, [1, 2, 3]), (None, [3, 4, 5])):
        assert action_values(env, futures=1, horizon=horizon).means.tolist() == means
    assert action_values(env, futures=1, discount=0.5).means.tolist() == [0.875, 1.875, 2.875]
    turn = action_values(env, futures=1, horizon=1, terminal_value=lambda env: 100 * env.unwrapped.simulation.turn)
    assert turn.means.tolist() == [100, 101, 102]


@pytest.mark.parametrize("wrapper", [lambda env: env, pad_agents])
def test_the_first_of_padded_rounds(wrapper):
    env = begun(wrapper(parallel_env(Pair, POINTS, possible_agents=["first", "second"])))
    assert action_values(env, futures=1, horizon=1).means.tolist() == [1, 2, 3]
    assert RolloutPolicy(futures=1, horizon=1).choose(env).best == 2


def test_wrappers_that_look_at_masks_see_legal_actions():
    masked = {
        "observation_space": spaces.Dict(observation=SPACE, action_mask=spaces.Box(0, 1, (6,), np.int8)),
        "observation_space_mapping": lambda pair: {"observation": [pair.turn, 1]},
        "action_space": spaces.Discrete(6),
        "action_space_mapping": int,
        "action_mask_mapping": lambda pair: [0, 1, 0, 1, 0, 0],
        "reward_mapping": difference(lambda pair: pair.both),
    }
    points = {f"{__name__}.Pair.{name}": make_step(**masked, agent=name) for name in ("first", "second")}
    env = begun(aec_env(Pair, points))
    wrapped = begun(TerminateIllegalWrapper(aec_env(Pair, points), -1))
    assert action_values(wrapped, futures=2).returns.tolist() == action_values(env, futures=2).returns.tolist()


@pytest.mark.parametrize(
    ("view", "candidate"), [(aec_env, 1), (parallel_env, 1), (joint_env, {"first": 1, "second": 1})]
)
def test_a_planner_as_the_base_of_another_agent_is_its_base(view, candidate):
    def own(observation):
        return 2 if observation[1] == 2 else 0

    means = [
        action_values(begun(view(Pair, POINTS)), [candidate], base={"second": base}, futures=1).means.tolist()
        for base in (own, RolloutPolicy(base=own))
    ]
    assert means[0] == means[1]


def test_the_base_of_a_planner_sees_what_wrappers_let_through():
    def shifted(observation):
        return 2 if observation[0] > 500 else 0

    env = TransformObservation(single_env(Pair, POINTS, agent="first"), lambda observation: observation + 1000, None)
    begun(env)
    plain, planned = (action_values(env, base=base, futures=1).means for base in (shifted, RolloutPolicy(base=shifted)))
    assert plain.tolist() == planned.tolist()


def test_parts_of_joint_actions_that_are_left_to_the_rule_go_around_wrappers_alone():
    space = joint_env(Pair, POINTS).action_space

    def turned(action):
        return {name: 2 - part for name, part in action.items()}

    env = begun(TransformAction(joint_env(Pair, POINTS), turned, space))
    bases = ({"first": lambda observation: 0, "second": lambda observation: 1}, {"first": lambda observation: 0})
    both, one = (action_values(env, [{"first": 1, "second": 1}], base=base, futures=1).means[0] for base in bases)
    assert both == one


def test_candidates_that_are_clipped():
    amount = make_step(
        observation_space=SPACE,
        observation_space_mapping=lambda pair: [pair.turn, 1],
        action_space=spaces.Box(0, 1, (1,), np.float32),
        action_space_mapping=lambda action: action[0],
        reward_mapping=difference(lambda pair: pair.both),
        agent="first",
    )
    env = single_env(Pair, {f"{__name__}.Pair.first": amount}, clip_actions=True)
    for made in (env, TransformReward(env, lambda reward: reward)):
        assert action_values(begun(made), [[5.0]], futures=1).means.tolist() == [8.0]


@pytest.mark.filterwarnings("ignore:.*draws from the global generator", "ignore:.*cannot draw new random numbers")
def test_replays_leave_the_generators_of_the_process_alone():
    class Lucky(Pair):
        reseed = None

        def run(self):
            while self.turn < 4:
                self.both += self.first() * random.random()
                self.turn += 1

    random.seed(5)
    env = begun(single_env(Lucky, [Pair.first]))
    env.step(1)
    before = random.getstate()
    found = action_values(env, [1, 1, 1], futures=1, method="replay").returns.ravel().tolist()
    assert found == found[:1] * 3
    assert random.getstate() == before


def test_branches_are_not_nested_for_ever():
    env = begun(single_env(Pair, [Pair.first]))

    def deeper(twin, number):
        return branch(twin, deeper, 1)

    with pytest.raises(BranchError, match="nested 4 deep"):
        branch(env, deeper, 1)


@pytest.mark.skipif(not os.path.exists("/proc/self"), reason="what ends with its parent is Linux's to say")
def test_a_branch_that_is_ended_takes_its_own_branches_along(tmp_path):
    def slow(twin, number):
        (tmp_path / str(os.getpid())).touch()
        time.sleep(600)

    env = begun(single_env(Pair, [Pair.first]))
    for limit in (0.5, 2.0, 8.0, 32.0):  # until the branch in the branch begins within it
        with pytest.raises(BranchError, match="longer than"):
            branch(env, lambda twin, number: branch(twin, slow, 1, method="fork"), 1, method="fork", time_limit=limit)
        if inner := [int(path.name) for path in tmp_path.iterdir()]:
            break
    assert inner
    assert all(map(gone, inner))


def test_time_limits_candidates_and_terminal_values():
    env = begun(single_env(Pair, [Pair.first]))
    for limit in (0, -1.0, float("nan")):
        with pytest.raises(OptionValueError, match="time_limit"):
            branch(env, lambda twin, number: None, time_limit=limit)
    planner = RolloutPolicy((number for number in range(3)), futures=1, horizon=1)
    assert [planner.choose(env).best for _ in range(2)] == [2, 2]
    told = action_values(env, futures=1, horizon=1, terminal_value=lambda env: np.array([7.0]))
    assert told.means.tolist() == [8, 9, 10]


@dataclass(frozen=True)
class Unchanging(Exception):
    """An error that refuses to be changed."""

    value: int


@pytest.mark.parametrize("method", ["fork", "replay"])
def test_errors_come_as_themselves_and_say_which_candidate_was_tried_in_which_future(method):
    class Fragile(Pair):
        def run(self):
            raise Unchanging(1) if self.first() == 0 else ZeroDivisionError

    env = begun(single_env(Fragile, [Pair.first]))
    with pytest.raises(Unchanging):
        action_values(env, futures=1, method=method)
    with pytest.raises(ZeroDivisionError) as raised:
        action_values(env, [2], futures=2, method=method)
    assert any("while 2 was tried out in future" in note for note in raised.value.__notes__)
