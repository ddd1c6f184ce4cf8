"""The turn view: one learner takes each decision as it arises."""

import math

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from hypothesis import given

from simenv_marl import RULE, aec_env, clone, generate_env, turn_env, vector_env
from simenv_marl.errors import InvalidActionError, ResetNeededError, UnknownOptionError, ViewError
from tests.extent import examples
from tests.worlds.models import Timed, calling, decision, script
from tests.worlds.random_worlds import (
    YARD_POINTS,
    YARD_ROSTER,
    World,
    Yard,
    YardDesign,
    answers,
    legal,
    points_of,
    seeds,
    world_designs,
    world_policies,
    yard_designs,
    yard_policy,
)


def vector(low, high, size=1):
    """A decision at a vector of numbers."""
    return {
        "action_space": spaces.Box(low, high, (size,), np.float32),
        "action_space_mapping": lambda action: action.tolist(),
    }


def one_hot(place, size):
    """A vector of zeros with a one."""
    return np.eye(size)[place].tolist()


# -- equal to the AEC view ------------------------------------------------------------------------


def compared(aec, turn, seed, action_of):
    """Both environments tell the same at each decision, and pay the same from step to step."""
    aec.reset(seed=seed)
    observation, info = turn.reset(seed=seed)
    reward = 0.0
    hooks = [point.hook for point in turn.session.plan.active]
    terminated = truncated = False
    while not (terminated or truncated):
        agent = aec.agent_selection
        seen, _, _, _, told = aec.last()
        assert info["agent"] == agent
        assert observation["observation"].tolist() == seen.tolist()
        assert observation["kind"] == hooks.index(aec.session.episode.pending.point.hook)
        assert info.get("time") == told.get("time")
        answer = action_of(seen, told)
        aec.step(answer)
        booked = sum(aec.rewards.values())
        while (
            aec.agents
            and aec.terminations[aec.agent_selection] | aec.truncations[aec.agent_selection]
        ):
            terminated, truncated = (
                aec.terminations[aec.agent_selection],
                aec.truncations[aec.agent_selection],
            )
            last = aec.observe(agent) if not aec.session.episode.pending else None
            aec.step(None)
        observation, reward, terminated, truncated, info = turn.step(answer)
        assert type(reward) is float
        assert math.isclose(reward, booked, abs_tol=1e-9)
        assert (terminated or truncated) == (not aec.agents)
    assert observation["observation"].tolist() == last.tolist()
    aec.close()
    turn.close()


@given(yard_designs, seeds)
@examples(60)
def test_turn_env_with_births_and_deaths_matches_aec_env(design, seed):
    options = {"possible_agents": YARD_ROSTER}
    compared(
        aec_env(lambda: Yard(design), YARD_POINTS, **options),
        turn_env(lambda: Yard(design), YARD_POINTS, **options),
        seed,
        lambda observation, info: yard_policy(observation),
    )


@given(world_designs(), seeds, answers)
@examples(100)
def test_turn_env_matches_aec_env_in_random_models(design, seed, given_answers):
    points = points_of(design)
    options = {"policies": world_policies(design, points), "max_steps": design.max_steps}
    remaining = iter(given_answers)
    compared(
        aec_env(lambda: World(design, points), points, **options),
        turn_env(lambda: World(design, points), points, **options),
        seed,
        lambda observation, info: legal(
            next(remaining), {k: v for k, v in info.items() if k == "action_mask"}
        ),
    )


# -- spaces ---------------------------------------------------------------------------------------


def test_turn_env_observation_adds_kind_and_index_of_the_agent():
    ant = decision(agent=lambda: "ant_1")
    bee = decision(agent="bee_0", observation_space_mapping=lambda: [3.0, 4.0])
    env = turn_env(calling(ant, bee), [ant, bee])
    assert env.observation_space["kind"] == spaces.Discrete(2)
    assert "agent" not in env.observation_space.spaces
    assert env.action_space == spaces.Discrete(10)
    env = turn_env(calling(ant, bee), [ant, bee], possible_agents=["ant_0", "ant_1"])
    observation, info = env.reset()
    assert observation in env.observation_space
    assert (observation["kind"], observation["agent"]) == (0, 1)
    assert info == {"agent": "ant_1", "action_mask": pytest.approx(np.ones(10))}
    observation, *_ = env.step(4)
    assert observation["observation"].tolist() == [3.0, 4.0]
    assert (observation["kind"], observation["agent"]) == (1, 2)
    env.step(5)
    assert env.simulation.log == [4, 5]
    flat = turn_env(calling(ant, bee), [ant, bee], possible_agents=["ant_0", "ant_1"], flatten=True)
    assert flat.observation_space == spaces.flatten_space(env.observation_space)
    flat.reset()
    observation, *_ = flat.step(4)
    assert observation in flat.observation_space
    assert observation.tolist() == [*one_hot(2, 3), *one_hot(1, 2), 3.0, 4.0]


def test_turn_env_flattens_different_observations_and_pads_with_zeros():
    ant = decision(
        agent="ant_0",
        observation_space=spaces.Discrete(3),
        observation_space_mapping=lambda: 2,
    )
    bee = decision(
        agent="bee_0",
        observation_space=spaces.Box(2, 5, (1,), np.float32),
        observation_space_mapping=lambda: [4.0],
    )
    env = turn_env(calling(ant, bee), [ant, bee])
    common = env.observation_space["observation"]
    assert (common.low.tolist(), common.high.tolist()) == ([0, 0, 0], [5, 1, 1])
    observation, _ = env.reset()
    assert observation["observation"].tolist() == [0, 0, 1]
    observation, *_ = env.step(1)
    assert observation["observation"].tolist() == [4, 0, 0]
    assert observation in env.observation_space
    text = decision(
        observation_space=spaces.Sequence(spaces.Discrete(2)),
        observation_space_mapping=lambda: (),
    )
    with pytest.raises(ViewError, match="must be flattened"):
        turn_env(calling(ant, text), [ant, text])


def test_turn_env_unites_discrete_actions_in_one_masked_space():
    mask = np.array([0, 1], np.int8)
    ant = decision(
        agent="ant_0", action_space=spaces.Discrete(2, start=5), action_mask_mapping=lambda: mask
    )
    bee = decision(agent="bee_0", action_space=spaces.Discrete(4))
    env = turn_env(calling(ant, bee, ant), [ant, bee])
    assert env.action_space == spaces.Discrete(4)
    _, info = env.reset()
    assert info["action_mask"].tolist() == [0, 1, 0, 0]
    assert env.action_masks().tolist() == [False, True, False, False]
    for action, match in ((0, "mask"), (2, "has 2 of the 4 actions"), (4, "is not in Discrete")):
        with pytest.raises(InvalidActionError, match=match):
            env.step(action)
    *_, info = env.step(1)
    assert info["action_mask"].tolist() == [1, 1, 1, 1]
    *_, info = env.step(3)
    info["action_mask"][:] = 1  # the user's own
    assert env.action_masks().tolist() == [False, True, False, False]
    assert env.simulation.log == [6, 3]


def test_turn_env_scales_box_actions_to_each_agents_bounds():
    ant = decision(agent="ant_0", **vector(0, 10))
    bee = decision(agent="bee_0", **vector(-1, 3, 2))
    whole = decision(
        agent="cat_0",
        action_space=spaces.Box(0, 5, (1,), np.int64),
        action_space_mapping=lambda action: action.tolist(),
    )
    env = turn_env(calling(ant, bee, whole), [ant, bee, whole])
    assert env.action_space == spaces.Box(-1, 1, (2,), np.float32)
    _, info = env.reset()
    assert "action_mask" not in info
    for action in ([-1.0, 1.0], [0.5, -0.5], [0.1, 0.0]):
        env.step(np.array(action, np.float32))
    assert env.simulation.log == [[0.0], [2.0, 0.0], [3]]
    env.reset()
    with pytest.raises(InvalidActionError, match="is not in"):
        env.step(np.array([2.0, 0.0], np.float32))
    clipped = turn_env(calling(ant, bee), [ant, bee], clip_actions=True)
    clipped.reset()
    clipped.step(np.array([2.0, 0.0], np.float32))
    assert clipped.simulation.log == [[10.0]]
    unbounded = decision(agent="dog_0", **vector(-np.inf, np.inf))
    with pytest.raises(ViewError, match="must be finite"):
        turn_env(calling(ant, unbounded), [ant, unbounded])


def test_turn_env_chooses_discrete_actions_beside_boxes_by_largest_value():
    mask = np.array([1, 0, 1], np.int8)
    ant = decision(
        agent="ant_0",
        action_space=spaces.Discrete(3),
        action_mask_mapping=lambda: mask,
        rule_action_mapping={"rule": 2},
    )
    bee = decision(lambda: [2.0], agent="bee_0", rule_action_mapping=np.float32, **vector(0, 4))
    env = turn_env(calling(ant, bee, ant, ant), [ant, bee])
    assert env.action_space == spaces.Box(-1, 1, (4,), np.float32)
    _, info = env.reset()
    assert info["action_mask"].tolist() == [1, 0, 1]
    env.step(np.array([0.1, 0.9, 0.2, -1.0], np.float32))
    *_, info = env.step(RULE)
    assert info["rule_action"].tolist() == [0, 0, 0, 0]
    *_, info = env.step(RULE)
    assert info["rule_action"].tolist() == [-1, -1, 1, 0]
    assert env.simulation.log == [2, [2.0], "rule"]
    *_, info = env.step(np.array([0.1, 0.9, 0.2, -1.0], np.float32))
    assert "rule_action" not in info


# -- rewards, infos, ends -------------------------------------------------------------------------


def test_turn_env_elapsed_time_and_discount_count_from_the_last_step():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")

    def main(simulation):
        for function in (ant, bee, ant):
            simulation.log.append(function())

    env = turn_env(lambda: Timed(main), [ant, bee], discount_rate=0.1)
    _, info = env.reset()
    infos = [info, *(env.step(1)[-1] for _ in range(3))]
    assert [info["time"] for info in infos] == [0.0, 10.0, 20.0, 30.0]
    assert [info["elapsed"] for info in infos] == [0.0, 10.0, 10.0, 10.0]
    assert infos[1]["discount"] == pytest.approx(math.exp(-1))


def test_turn_env_last_observation_is_of_the_agent_that_decided_last():
    level = [0]

    def main(simulation):
        level[0] = 1
        ant()
        level[0] = 2
        bee()
        level[0] = 3

    changes = {"observation_space_mapping": lambda: [level[0], 0], "reward_mapping": lambda: 1.0}
    ant, bee = decision(agent="ant_0", **changes), decision(agent="bee_0", **changes)
    env = turn_env(script(main), [ant, bee])
    env.reset()
    env.step(1)
    observation, reward, terminated, truncated, info = env.step(1)
    assert observation["observation"].tolist() == [3, 0]
    assert (reward, terminated, truncated, info["agent"]) == (2.0, True, False, "bee_0")
    with pytest.raises(ResetNeededError):
        env.step(1)


def test_clone_of_turn_env_continues_like_the_original():
    design = YardDesign(machines=3, jobs=3, cranes=2, plans=2, luck=3, until=None)
    env = turn_env(
        lambda: Yard(design),
        YARD_POINTS,
        possible_agents=YARD_ROSTER,
    )
    env.reset(seed=5)
    env.step(2)
    clones = [clone(env, method=method) for method in (None, "replay")]
    ended = False
    while not ended:
        observation, reward, terminated, truncated, info = env.step(RULE)
        ended = terminated or truncated
        for twin in clones:
            seen, paid, *flags, told = twin.step(RULE)
            assert {k: np.asarray(v).tolist() for k, v in seen.items()} == {
                k: np.asarray(v).tolist() for k, v in observation.items()
            }
            assert (paid, *flags) == (reward, terminated, truncated)
            assert told.keys() == info.keys()
            assert (told["agent"], told["elapsed"]) == (info["agent"], info["elapsed"])
    for twin in clones:
        twin.close()


# -- in other forms -------------------------------------------------------------------------------


@pytest.mark.parametrize("flatten", [False, True])
def test_turn_env_passes_check_env_and_works_in_vector_env(flatten):
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0", **vector(0, 1))
    options = {"flatten": flatten}
    check_env(turn_env(calling(ant, bee, ant), [ant, bee], **options), skip_render_check=True)
    kind = generate_env(calling(ant, bee, ant), [ant, bee], view="turn", **options)
    vectors = vector_env(calling(ant, bee, ant), [ant, bee], view="turn", num_envs=2, **options)
    single = kind()
    assert vectors.single_observation_space == single.observation_space
    vectors.reset(seed=1)
    single.reset(seed=1)
    for number in range(3):
        action = np.full(single.action_space.shape, number / 4, np.float32)
        seen, rewards, terminated, _, infos = vectors.step(np.stack([action] * 2))
        observation, reward, ended, _, info = single.step(action)
        rows = seen if flatten else seen["observation"]
        assert rows[1].tolist() == (observation if flatten else observation["observation"]).tolist()
        assert (rewards[1], terminated[1]) == (reward, ended)
        assert infos["agent"][1] == info["agent"]
    vectors.close()


def test_turn_env_infos_contain_the_state_on_request():
    class Counting:
        def reset(self):
            self.count = 0

        def run(self):
            for _ in range(2):
                self.count += 1
                ant()

        def state(self):
            return [self.count]

    ant = decision(agent="ant_0")
    env = turn_env(Counting, [ant], state_in_info=True)
    _, info = env.reset()
    assert info["state"].tolist() == [1]
    assert env.step(1)[-1]["state"].tolist() == [2]
    with pytest.raises(UnknownOptionError, match="joint and turn views"):
        aec_env(Counting, [ant], state_in_info=True)
