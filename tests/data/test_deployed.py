"""Policies of learners that were trained in a turn or a joint view."""

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import (
    RULE,
    SimulationInterface,
    difference,
    evaluate,
    joint_env,
    simulate,
    simulate_many,
    single_env,
    turn_env,
    vector_env,
)
from simenv_marl.core import pack, unpack
from simenv_marl.data import collect_episodes, joint_policy, turn_policy
from simenv_marl.errors import InvalidActionError, OptionValueError, ViewError
from simenv_marl.experiments import run_experiment
from tests.worlds.models import calling, decision, define

SEEDS = range(4)


class Bakery:
    """Two ovens and a shop decide in turns; chance decides how often."""

    def reset(self, seed=None):
        self.random = np.random.default_rng(seed)
        self.trace = []
        self.heat = 0.0

    def run(self):
        for _ in range(6):
            for oven in range(2):
                if self.random.random() < 0.7:
                    self.heat += self.bake(oven)
            self.heat -= self.sell()[0]

    def bake(self, oven):
        return 0

    def sell(self):
        return [0.0]

    def log(self, agent, value):
        self.trace.append((agent, value))
        return value


POINTS = {
    Bakery.bake: define(
        agent=lambda bakery, oven: f"oven_{oven}",
        observation_space_mapping=lambda bakery, oven: [bakery.heat, oven],
        action_space=spaces.Discrete(3),
        apply=lambda action, bakery, oven: bakery.log(f"oven_{oven}", int(action)),
        action_mask_mapping=lambda bakery, oven: np.array([1, 1, oven], np.int8),
        reward_mapping=lambda bakery: bakery.heat,
    ),
    Bakery.sell: define(
        agent="shop",
        observation_space=spaces.Box(-1e6, 1e6, (1,), np.float64),
        observation_space_mapping=lambda bakery: [bakery.heat],
        action_space=spaces.Box(0, 4, (1,), np.float32),
        apply=lambda action, bakery: bakery.log("shop", action.tolist()),
    ),
}
ROSTER = {Bakery.bake: ["oven_0", "oven_1"]}


def predict(observation, info=None):
    """What a learner answers: it depends on all that it sees."""
    numbers = np.concatenate([np.ravel(part) for part in _parts(observation)])
    return np.sin(numbers.sum() + np.arange(4)).astype(np.float32)


def _parts(observation):
    return list(observation.values()) if isinstance(observation, dict) else [observation]


def played(env, answer, seed):
    """What a model comes to whose environment is stepped with a learner's answers."""
    observation, info = env.reset(seed=seed)
    ended = False
    while not ended:
        observation, _, terminated, truncated, info = env.step(answer(observation, info))
        ended = terminated or truncated
    return env.unwrapped.simulation.trace


def test_turn_policy_decides_in_simulate_as_in_turn_env():
    env = turn_env(Bakery, POINTS, possible_agents=ROSTER)
    expected = [played(env, predict, seed) for seed in SEEDS]
    policies = turn_policy(predict, like=env)
    assert [
        simulate(Bakery, policies, points=POINTS, seed=seed).trace for seed in SEEDS
    ] == expected
    many = simulate_many(
        Bakery, policies, points=POINTS, seeds=SEEDS, collect=lambda bakery: bakery.trace
    )
    assert many == expected
    again = unpack(pack(policies))
    assert simulate(Bakery, again, points=POINTS, seed=2).trace == expected[2]


def test_turn_policy_with_batches_gets_stacked_observations():
    env = turn_env(Bakery, POINTS, possible_agents=ROSTER, flatten=True)
    expected = [played(env, predict, seed) for seed in SEEDS]
    sizes = []

    def predict_many(observations, info):
        sizes.append(len(observations))
        assert info["action_mask"].shape == (len(observations), 3)
        assert len(info["agent"]) == len(observations)
        return np.stack(list(map(predict, observations))), {"value": np.zeros(len(observations))}

    policies = turn_policy(predict_many, like=env, batched=True)
    many = simulate_many(
        Bakery, policies, points=POINTS, seeds=SEEDS, collect=lambda bakery: bakery.trace
    )
    assert many == expected
    assert max(sizes) > 1


def test_turn_policy_gets_masks_of_multi_discrete_actions():
    several = {
        "agent": lambda: "ant_0",
        "action_space": spaces.MultiDiscrete([2, 3]),
        "action_space_mapping": lambda action: action.tolist(),
    }
    ant = decision(action_mask_mapping=lambda: ([0, 1], [0, 0, 1]), **several)
    env = turn_env(calling(ant), [ant])
    one = turn_policy(
        lambda seen, info: np.array([m.argmax() for m in info["action_mask"]]), like=env
    )
    many = turn_policy(
        lambda seen, info: np.stack([m.argmax(1) for m in info["action_mask"]], 1),
        like=env,
        batched=True,
    )
    assert env.reset()[1]["action_mask"][1].tolist() == [0, 0, 1]
    for policies in (one, many):
        (found,) = simulate_many(calling(ant), policies, points=[ant], seeds=[0])
        assert found.log == [[1, 2]]


def test_joint_policy_decides_in_simulate_as_in_joint_env():
    for flatten in (False, True):
        env = joint_env(Bakery, POINTS, possible_agents=ROSTER, flatten=flatten)

        def answer(observation, info, flatten=flatten):
            numbers = np.concatenate([np.ravel(part) for part in _parts(observation)])
            wave = np.sin(numbers.sum() + np.arange(7)).astype(np.float32)
            if flatten:
                return np.concatenate((wave[:6], np.abs(wave[6:])))
            number = int(abs(wave[0]) * 2)
            return {"oven_0": number, "oven_1": number, "shop": np.abs(wave[:1])}

        with pytest.warns(UserWarning, match=r"were used.*turn_env"):
            expected = [played(env, answer, seed) for seed in SEEDS]
        policies = joint_policy(answer, like=env)
        traces = [simulate(Bakery, policies, points=POINTS, seed=seed).trace for seed in SEEDS]
        assert traces == expected


def test_evaluate_and_collect_episodes_take_a_turn_or_joint_policy():
    env = turn_env(Bakery, POINTS, possible_agents=ROSTER)
    joint = joint_env(Bakery, POINTS, possible_agents=ROSTER)

    def nothing(observation):
        return {"oven_0": 0, "oven_1": 0, "shop": np.zeros(1, np.float32)}

    result = evaluate(
        Bakery,
        {
            "rule": {},
            "turn": turn_policy(predict, like=env),
            "joint": joint_policy(nothing, like=joint),
        },
        seeds=SEEDS,
        points=POINTS,
        metric=lambda bakery: bakery.heat,
    )
    table = result.frame[result.frame.agent == "team"].set_index(["contender", "seed"])
    for seed in SEEDS:
        heat = simulate(Bakery, turn_policy(predict, like=env), points=POINTS, seed=seed).heat
        assert table.loc[("turn", seed), "metric"] == heat
        assert table.loc[("joint", seed), "metric"] == table.loc[("rule", seed), "metric"] == 0.0
    found = collect_episodes(Bakery, turn_policy(predict, like=env), seeds=SEEDS, points=POINTS)
    names = {key.rpartition(".")[2]: set(each.names) for key, each in found.items()}
    assert names == {"bake": {"oven_0", "oven_1"}, "sell": {"shop"}}


def test_turn_policy_can_decide_for_all_other_agents_of_single_env():
    env = turn_env(Bakery, POINTS, possible_agents=ROSTER)
    expected = played(env, predict, 1)
    policies = turn_policy(predict, like=env)
    single = single_env(Bakery, POINTS, agent="shop", policies=policies)
    turn = policies[next(iter(policies))]
    observation, info = single.reset(seed=1)
    ended = False
    while not ended:
        agent = single.session.episode.pending
        action = turn.answer(None, agent, observation, info)
        observation, _, terminated, truncated, info = single.step(action)
        ended = terminated or truncated
    assert single.simulation.trace == expected
    assert [*single.provenance()["policies"].values()] == ["<TurnPolicy: predict>"]
    with pytest.raises(OptionValueError, match="agent="):
        turn_env(Bakery, POINTS, policies=policies)


def test_turn_and_joint_policies_refuse_wrong_use_with_an_explanation():
    ant = decision(agent="ant_0")
    env = turn_env(calling(ant), [ant])
    with pytest.raises(OptionValueError, match="SimulationJointEnv"):
        joint_policy(predict, like=env)
    policies = turn_policy(
        lambda observation: 1, like=vector_env(calling(ant), [ant], view="turn", num_envs=1)
    )
    assert simulate(calling(ant), policies, points=[ant]).log == [1]
    bee = decision(agent="bee_0")
    with pytest.raises(ViewError, match="is no decision point of this view"):
        simulate(calling(bee), policies, points=[bee])
    few = turn_policy(lambda observations: [1, 2], like=env, batched=True)
    with pytest.raises(InvalidActionError, match="for 1 decisions at once"):
        simulate_many(calling(ant), few, points=[ant], seeds=[0])
    assert simulate(
        calling(ant), turn_policy(lambda observation: RULE, like=env), points=[ant]
    ).log == ["rule"]


def test_evaluate_counts_the_team_reward_once(tmp_path):
    env = turn_env(Bakery, POINTS, possible_agents=ROSTER)
    contenders = {"rule": {}, "turn": turn_policy(predict, like=env)}
    options = {"points": POINTS, "team_reward": difference(lambda bakery: bakery.heat)}
    result = evaluate(Bakery, contenders, seeds=SEEDS, **options)
    tables = [
        run_experiment(Bakery, [{}], contenders=contenders, seeds=SEEDS, store=tmp_path, **options)
        for _ in range(2)
    ]
    for frame in (result.frame, *tables):
        teams = frame[frame.agent == "team"].set_index(["contender", "seed"])["return"]
        for seed in SEEDS:
            heat = simulate(Bakery, contenders["turn"], points=POINTS, seed=seed).heat
            assert teams["turn", seed] == pytest.approx(heat)
            assert teams["rule", seed] == 0.0


class Pair(SimulationInterface):
    """Two animals decide in rounds. The first one dies."""

    def reset(self, seed=None):
        self.ages = {"ant": 0, "bee": 0}
        self.trace = []

    def run(self):
        for day in range(6):
            for name in list(self.ages):
                self.trace.append(self.act(name))
                self.ages[name] += 1
            if day == 2:
                self.end_agent("ant")
                del self.ages["ant"]

    def act(self, name):
        return 0


def test_joint_policy_gets_the_last_observations_of_ended_agents():
    points = {
        f"{__name__}.Pair.act": define(
            agent=lambda pair, name: name,
            observation_space_mapping=lambda pair, name: [pair.ages.get(name, 9), 0],
        )
    }
    env = joint_env(Pair, points, possible_agents=["ant", "bee"])

    def answer(observation, info=None):
        return {"ant": 0, "bee": int(observation["ant"][0])}

    expected = played(env, answer, 0)
    policies = joint_policy(answer, like=env)
    assert simulate(Pair, policies, points=points).trace == expected
