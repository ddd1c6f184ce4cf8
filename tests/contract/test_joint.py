"""The joint view: one agent that takes all decisions."""

import re
from functools import partial

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env, data_equivalence
from hypothesis import given, settings

from simenv_marl import RULE, TRUNCATED, aec_env, generate_env, joint_env, parallel_env, vector_env
from simenv_marl.errors import (
    AgentError,
    EpisodeOverError,
    InvalidActionError,
    NoDecisionError,
    NotResetError,
    UnknownOptionError,
    ViewError,
)
from tests.worlds.many_worlds import ROSTER, Announcing, Answered, Being, Colony, answer, beings, colony, designs, seeds
from tests.worlds.models import calling, decision


def points(number=2, **changes):
    """Decision functions of so many agents, ``ant_0``, ``bee_0`` and so on."""
    return [decision(agent=f"{name}_0", **changes) for name in ("ant", "bee", "cat", "dog")[:number]]


BOX = {"action_space": spaces.Box(0, 1, (1,), np.float32), "action_space_mapping": lambda action: float(action[0])}


# -- dicts ----------------------------------------------------------------------------------------


def test_spaces_are_dicts_keyed_by_agent():
    ant, bee = points()
    env = joint_env(calling(ant, bee), [ant, bee])
    assert env.action_space == spaces.Dict({"ant_0": spaces.Discrete(10), "bee_0": spaces.Discrete(10)})
    assert list(env.observation_space.spaces) == ["ant_0", "bee_0"]
    observation, info = env.reset(seed=1)
    assert observation in env.observation_space
    assert observation["ant_0"].tolist() == [1, 2]
    assert observation["bee_0"].tolist() == [0, 0]
    assert info == {"deciding": "ant_0", "acted": {"ant_0": False, "bee_0": False}}


def test_a_step_is_a_round():
    ant, bee = points(reward_mapping=lambda: 1.5)
    env = joint_env(calling(ant, bee, ant, bee), [ant, bee])
    env.reset()
    observation, reward, terminated, truncated, info = env.step({"bee_0": 2, "ant_0": 1})
    assert env.simulation.log == [1, 2]
    assert observation in env.observation_space
    assert (reward, terminated, truncated) == (3.0, False, False)
    assert type(reward) is float
    assert type(terminated) is type(truncated) is bool
    assert info == {"deciding": "ant_0", "acted": {"ant_0": True, "bee_0": True}}
    *_, terminated, truncated, info = env.step({"ant_0": 3, "bee_0": 4})
    assert env.simulation.log == [1, 2, 3, 4]
    assert (terminated, truncated) == (True, False)
    assert info["deciding"] == ""
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step({"ant_0": 3, "bee_0": 4})


def test_a_round_ends_where_an_action_was_used_already():
    ant, bee = points()
    env = joint_env(calling(ant, ant, bee), [ant, bee])
    env.reset()
    *_, info = env.step({"ant_0": 1, "bee_0": 2})
    assert env.simulation.log == [1]
    assert info == {"deciding": "ant_0", "acted": {"ant_0": True, "bee_0": False}}
    *_, terminated, _, info = env.step({"ant_0": 3, "bee_0": 4})
    assert env.simulation.log == [1, 3, 4]
    assert terminated


@pytest.mark.parametrize(
    "action",
    [
        {"ant_0": 1},
        {"bee_0": 1},
        {},
        {"ant_0": 1, "bee_0": 1, "cat_0": 1},
        {"ant_0": 1, "cat_0": 1},
        {"ant_0": 1, 2: 1},
        {"ant_0": 10, "bee_0": 1},
        {"ant_0": 1, "bee_0": 10},
        {"ant_0": 1, "bee_0": None},
        None,
        3,
        [1, 1],
        (1, 1),
        np.array([1, 1]),
        "ant_0",
    ],
    ids=repr,
)
def test_what_is_refused_moves_nothing(action):
    paid = []
    ant, bee = points(reward_mapping=lambda: paid.append(0) or 1.0)
    env = joint_env(calling(ant, bee), [ant, bee])
    env.reset()
    del paid[:]
    with pytest.raises(InvalidActionError):
        env.step(action)
    assert env.simulation.log == []
    assert paid == []
    assert env.step({"ant_0": 1, "bee_0": 2})[2]
    assert env.simulation.log == [1, 2]


def test_rule_for_all_and_for_some():
    ant, bee = points()
    env = joint_env(calling(ant, bee, ant, bee), [ant, bee])
    env.reset()
    env.step(RULE)
    env.step({"ant_0": RULE, "bee_0": 4})
    assert env.simulation.log == ["rule", "rule", "rule", 4]


def test_masks_and_choices():
    ant = decision(agent="ant_0", action_mask_mapping=lambda: [1] * 3 + [0] * 7)
    bee = decision(agent="bee_0", choices=lambda: ["x", "y"], action_space=spaces.Discrete(3))
    cat = decision(agent="cat_0")
    env = joint_env(calling(ant, bee, cat, ant, bee), [ant, bee, cat])
    _, info = env.reset()
    assert info["action_mask"]["ant_0"].tolist() == [1] * 3 + [0] * 7
    assert info["action_mask"]["ant_0"].dtype == np.int8
    with pytest.raises(InvalidActionError, match="mask"):
        env.step({"ant_0": 3, "bee_0": 0, "cat_0": 0})
    assert env.simulation.log == []
    *_, info = env.step({"ant_0": 2, "bee_0": 1, "cat_0": 0})
    assert env.simulation.log == [2, "y", 0]
    assert info["action_mask"]["bee_0"].tolist() == [1, 1, 0]
    assert "cat_0" not in info["action_mask"]
    *_, info = env.step({"ant_0": 2, "bee_0": 2, "cat_0": 0})
    assert env.simulation.log == [2, "y", 0, 2]
    assert info["deciding"] == "bee_0"
    assert info["acted"] == {"ant_0": True, "bee_0": False, "cat_0": False}


def test_policies_answer_for_whom_they_name():
    ant, bee = points()
    env = joint_env(calling(ant, bee, ant), [ant, bee], policies={"bee_0": lambda observation: 7})
    assert list(env.action_space.spaces) == ["ant_0"]
    env.reset()
    env.step({"ant_0": 1})
    assert env.simulation.log == [1, 7]


def test_max_steps_counts_rounds():
    ant, bee = points(reward_mapping=lambda: 1.0)
    env = joint_env(calling(*[ant, bee] * 9), [ant, bee], max_steps=2)
    for _ in range(2):
        env.reset()
        assert env.step({"ant_0": 1, "bee_0": 2})[1:4] == (2.0, False, False)
        *told, info = env.step({"ant_0": 1, "bee_0": 2})
        assert told[1:] == [2.0, False, True]
        assert info["deciding"] == ""
        with pytest.raises(EpisodeOverError, match="begin the next one"):
            env.step({"ant_0": 1, "bee_0": 2})
        assert env.simulation.log == [1, 2, 1, 2]


def test_what_is_returned_is_the_users_own():
    kept = np.array([1.0, 2.0])
    ant, bee = points(observation_space_mapping=lambda: kept, action_mask_mapping=lambda: [1] * 10)
    env = joint_env(calling(*[ant, bee] * 3), [ant, bee])
    first, info = env.reset()
    first["ant_0"][:] = 9
    info["action_mask"]["ant_0"][:] = 0
    second, *_, other = env.step({"ant_0": 1, "bee_0": 2})
    assert kept.tolist() == [1, 2]
    assert second["ant_0"].tolist() == [1, 2]
    assert second["ant_0"] is not second["bee_0"]
    assert other["action_mask"]["ant_0"].tolist() == [1] * 10


# -- who is there ---------------------------------------------------------------------------------


class Pack:
    """Three beings, of whom the first dies in the second round."""

    def reset(self, seed=None):
        self.beings, self.log = [Being(number) for number in range(3)], []

    def run(self):
        for tick in range(4):
            for being in self.beings:
                if being.whole:
                    being.health += 1
                    self.log.append((being.number, being.act()))
            if tick == 1:
                self.beings[0].leave()


class AnnouncingPack(Pack):
    def expected_calls(self, point):
        return [(being,) for being in self.beings if being.whole]


NAMES = ["being_0", "being_1", "being_2"]


def test_the_roster_is_declared():
    env = joint_env(Pack, beings(), possible_agents=[*NAMES, "being_3"])
    assert set(env.action_space.spaces) == {*NAMES, "being_3"}
    observation, _ = env.reset()
    assert observation in env.observation_space
    assert observation["being_3"].tolist() == [0, 0]


def test_the_roster_is_asked_for():
    env = joint_env(AnnouncingPack, beings())
    assert sorted(env.action_space.spaces) == NAMES
    observation, _ = env.reset()
    assert sorted(observation) == NAMES


def test_who_joins_after_all_is_refused_or_follows_its_rule():
    class Growing(AnnouncingPack):
        def run(self):
            super().run()
            self.log.append(Being(9).act())

    env = joint_env(Growing, beings())
    env.reset()
    for _ in range(3):
        env.step(dict.fromkeys(NAMES, 1))
    with pytest.raises(AgentError, match="being_9"):
        env.step(dict.fromkeys(NAMES, 1))
    env = joint_env(Growing, beings(), undeclared="rule")
    env.reset()
    while not env.step(dict.fromkeys(NAMES, 1))[2]:
        pass
    assert env.simulation.log[-1] == "rule"


def test_the_dead_are_observed_as_they_ended_and_not_rewarded():
    env = joint_env(AnnouncingPack, beings())
    env.reset()
    action = dict.fromkeys(NAMES, 1)
    assert env.step(action)[1] == 2.0 + 1.0 + 1.0
    observation, reward, terminated, _, info = env.step(action)
    assert observation["being_0"].tolist() == [0, 2]
    assert reward == 2.0 + 3.0 + 2.0
    assert not terminated
    assert info["acted"] == dict.fromkeys(NAMES, True)
    observation, reward, *_ = env.step(action)
    assert observation["being_0"].tolist() == [0, 2]
    assert reward == 4.0 + 3.0
    assert env.simulation.log[6:] == [(1, 1), (2, 1)]
    assert env.step(action)[2]


def test_the_dead_have_not_acted():
    env = joint_env(AnnouncingPack, beings())
    env.reset()
    for _ in range(2):
        env.step(dict.fromkeys(NAMES, 1))
    *_, info = env.step(dict.fromkeys(NAMES, 1))
    assert info["acted"] == {"being_0": False, "being_1": True, "being_2": True}


def test_actions_of_the_dead_are_asked_for_and_not_used():
    env = joint_env(AnnouncingPack, beings())
    env.reset()
    for _ in range(2):
        env.step(dict.fromkeys(NAMES, 1))
    with pytest.raises(InvalidActionError, match="being_0"):
        env.step({"being_1": 1, "being_2": 1})
    env.step(env.action_space.sample())
    env.step({"being_0": RULE, "being_1": 1, "being_2": 1})


def test_all_may_die_before_the_simulation_ends():
    class Doom(Pack):
        def run(self):
            for being in self.beings:
                being.act()
            for being in self.beings:
                being.health = 10
                being.leave()
            return TRUNCATED

    env = joint_env(Doom, beings(), possible_agents=NAMES)
    env.reset()
    _, reward, terminated, truncated, _ = env.step(dict.fromkeys(NAMES, 1))
    assert reward == 30.0
    assert terminated or truncated


def test_a_roster_that_is_not_known_is_refused():
    class Nobody(Pack):
        def run(self):
            pass

    for make in (joint_env, partial(vector_env, num_envs=2)):
        with pytest.raises(ViewError, match=r"possible_agents=.*expected_calls.*agent="):
            make(Nobody, beings())
        with pytest.raises(ViewError, match="known when the environment is made"):
            make(Pack, beings())

    class Announced(Nobody):
        def expected_calls(self, point):
            return []

    with pytest.raises(NoDecisionError, match="without a decision"):
        joint_env(Announced, beings())


def test_one_simulation_alone_is_used():
    made = []

    class Counted(AnnouncingPack):
        def __init__(self):
            made.append(self)

    env = joint_env(Counted, beings())
    env.reset()
    env.close()
    assert env.simulation in made


def test_asking_for_the_roster_leaves_nothing_behind():
    ended = []

    class Ending(AnnouncingPack):
        def run(self):
            try:
                super().run()
            finally:
                ended.append(len(self.log))

    env = joint_env(Ending, beings())
    assert ended == [0]
    env.reset()
    assert ended == [0]
    env.close()
    assert ended == [0, 0]


# -- flattened ------------------------------------------------------------------------------------


def test_flattened_spaces_are_boxes():
    ant, bee = (
        decision(
            agent=f"{name}_0",
            observation_space=spaces.Box(-size, size, (size,), np.float32),
            observation_space_mapping=lambda size=size: np.full(size, size / 2),
            action_space=spaces.Box(0, size, (size,), np.float32),
            action_space_mapping=lambda action: action.tolist(),
        )
        for name, size in (("ant", 1), ("bee", 2))
    )
    env = joint_env(calling(ant, bee, ant), [ant, bee], flatten=True)
    assert env.action_space == spaces.Box(np.zeros(3, np.float32), np.array([1, 2, 2], np.float32))
    assert env.observation_space == spaces.Box(np.array([-1, -2, -2], np.float32), np.array([1, 2, 2], np.float32))
    observation, info = env.reset()
    assert observation.tolist() == [0.5, 0, 0]
    assert observation.dtype == np.float32
    observation, *_, info = env.step(np.array([0.5, 1.5, 2], np.float32))
    assert observation.tolist() == [0.5, 1, 1]
    assert env.simulation.log == [[0.5], [1.5, 2.0]]
    assert info["acted"] == {"ant_0": True, "bee_0": True}
    assert info["deciding"] == "ant_0"


@pytest.mark.parametrize(
    "action",
    [
        np.array([0.5], np.float32),
        np.array([0.5, 0.5, 0.5], np.float32),
        np.array([[0.5, 0.5]], np.float32),
        np.array([0.5, 1.5], np.float32),
        np.array([0.5, np.nan], np.float32),
        np.array([-0.5, 0.5]),
        None,
        0.5,
        {"ant_0": [0.5], "bee_0": [0.5]},
    ],
)
def test_what_is_refused_of_a_flattened_action(action):
    ant, bee = points(**BOX)
    env = joint_env(calling(ant, bee), [ant, bee], flatten=True)
    env.reset()
    with pytest.raises(InvalidActionError):
        env.step(action)
    assert env.simulation.log == []
    env.step(np.array([0.25, 0.5]))
    assert env.simulation.log == [0.25, 0.5]


def test_rule_for_all_of_a_flattened_view():
    ant, bee = points(**BOX)
    env = joint_env(calling(ant, bee), [ant, bee], flatten=True)
    env.reset()
    env.step(RULE)
    assert env.simulation.log == ["rule", "rule"]


def test_a_flattened_action_is_not_kept():
    seen = []
    ant, bee = points(action_space=spaces.Box(0, 1, (1,), np.float32), action_space_mapping=seen.append)
    env = joint_env(calling(ant, bee), [ant, bee], flatten=True)
    env.reset()
    action = np.array([0.25, 0.5], np.float32)
    env.step(action)
    action[:] = 0
    assert [part.tolist() for part in seen] == [[0.25], [0.5]]


def discrete():
    """Two decisions: one of two or three from 5 on, and one of two of which the first is not legal, with three."""
    ant = decision(agent="ant_0", action_space=spaces.Discrete(2, start=5))
    bee = decision(
        agent="bee_0",
        action_space=spaces.MultiDiscrete([2, 3]),
        action_space_mapping=lambda action: action.tolist(),
        action_mask_mapping=lambda: ([0, 1], [1, 1, 1]),
    )
    return ant, bee


def test_flattened_actions_of_discrete_spaces():
    ant, bee = discrete()
    env = joint_env(calling(ant, bee, ant), [ant, bee], flatten=True)
    assert env.action_space == spaces.MultiDiscrete([2, 2, 3], start=[5, 0, 0])
    observation, _ = env.reset()
    assert observation.tolist() == [1, 2, 0, 0]
    *_, info = env.step(np.array([6, 1, 2]))
    assert env.simulation.log == [6, [1, 2]]
    assert info["acted"] == {"ant_0": True, "bee_0": True}


@pytest.mark.parametrize("action", [[6, 1, 2], np.array([6.0, 1, 2]), np.array([4, 1, 2]), np.array([6, 1]), 6])
def test_what_is_refused_of_flattened_actions_of_discrete_spaces(action):
    ant, bee = discrete()
    env = joint_env(calling(ant, bee), [ant, bee], flatten=True)
    env.reset()
    with pytest.raises(InvalidActionError):
        env.step(action)
    assert env.simulation.log == []


def test_flattened_actions_of_discrete_spaces_side_by_side():
    ant, bee = discrete()
    envs = vector_env(calling(ant, bee, ant, bee), [ant, bee], num_envs=2, flatten=True)
    envs.reset()
    envs.step(np.array([[5, 1, 2], [6, 1, 0]]))
    assert [simulation.log for simulation in envs.get_attr("simulation")] == [[5, [1, 2]], [6, [1, 0]]]
    with pytest.raises(InvalidActionError, match="sub-environment 1"):
        envs.step(np.array([[5, 1, 2], [7, 1, 0]]))
    envs.close()


def test_flattened_masks():
    ant, bee = discrete()
    env = joint_env(calling(ant, bee, ant, bee), [ant, bee], flatten=True)
    with pytest.raises(NotResetError, match="no episode yet"):
        env.action_masks()
    env.reset()
    env.step(np.array([6, 1, 2]))
    masks = env.action_masks()
    assert masks.dtype == np.bool_
    assert masks.tolist() == [True, True, False, True, True, True, True]
    masks[:] = False
    assert env.action_masks().any()


def test_joint_actions_that_have_no_masks():
    ant, bee = discrete()
    env = joint_env(calling(ant, bee), [ant, bee])
    env.reset()
    with pytest.raises(ViewError, match="flatten"):
        env.action_masks()


@pytest.mark.parametrize(
    "changes",
    [
        {"action_space": spaces.MultiDiscrete([[2, 2]])},
        {**BOX, "observation_space": spaces.Box(0, 1, (2, 2), np.float32)},
        {**BOX, "observation_space": spaces.Discrete(3)},
        {"action_space": spaces.Box(0, 1, (), np.float32)},
    ],
)
def test_what_cannot_be_flattened(changes):
    ant, bee = points(**changes)
    with pytest.raises(ViewError, match="needs one-dimensional Box"):
        joint_env(calling(ant, bee), [ant, bee], flatten=True)


def test_what_is_partly_discrete_cannot_be_flattened():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0", **BOX)
    with pytest.raises(ViewError, match="all continuous or all discrete"):
        joint_env(calling(ant, bee), [ant, bee], flatten=True)


@pytest.mark.parametrize("make", [aec_env, parallel_env])
def test_flatten_is_the_joint_views_alone(make):
    ant, bee = points(**BOX)
    with pytest.raises(UnknownOptionError, match="an option of the joint view only"):
        make(calling(ant, bee), [ant, bee], flatten=True)


# -- colonies -------------------------------------------------------------------------------------


@given(designs, seeds)
@settings(max_examples=60)
def test_a_colony_is_what_it_would_be_without_the_library(design, seed):
    plain = Answered(design, seed)
    for simulation in (Colony, Announcing):
        env = colony(joint_env, design, simulation, roster=True)
        if not plain.decisions:
            with pytest.raises(NoDecisionError):
                env.reset(seed=seed)
            continue
        env.reset(seed=seed)
        agents = [*ROSTER, "overseer_0"] if design.overseen else ROSTER
        used, total, ended, joined = dict.fromkeys(agents, 0), 0.0, False, {}
        while not ended:
            if simulation is Announcing:
                if design.overseen:
                    joined.setdefault("overseer_0", env.simulation.fortune)
                for creature in env.simulation.creatures:
                    seen = plain.first[creature.name] if creature.decided else env.simulation.fortune
                    joined.setdefault(creature.name, seen)
            action = {agent: answer(seed, agent, used[agent]) for agent in agents}
            observation, reward, terminated, truncated, info = env.step(action)
            assert observation in env.observation_space
            total += reward
            ended = terminated or truncated
            for agent in agents:
                used[agent] += info["acted"][agent]
        assert (terminated, truncated) == (not design.truncates, design.truncates)
        assert env.simulation.trace == plain.trace
        # Whoever was not announced at a return before has joined at its first decision.
        joined = plain.first | joined
        assert total == sum(plain.last.get(agent, plain.fortune) - fortune for agent, fortune in joined.items())


# -- Gymnasium's check ----------------------------------------------------------------------------


def boxes(**options):
    ant, bee = points(**BOX)
    return joint_env(calling(*[ant, bee] * 20), [ant, bee], **options)


JOINTS = {
    "dicts": lambda: joint_env(calling(*(pair := points()) * 20), list(pair)),
    "flattened": lambda: boxes(flatten=True),
    "boxes": boxes,
    "irregular": lambda: irregular(),
    "deaths": lambda: joint_env(AnnouncingPack, beings()),
    "a roster": lambda: joint_env(Pack, beings(), possible_agents=[*NAMES, "being_3"]),
    "limited": lambda: boxes(flatten=True, max_steps=2),
    "a class": lambda: generate_env(calling(*(pair := points(**BOX)) * 20), pair, view="joint", flatten=True)(),
    "masks in observations": lambda: masked(),
}


def irregular():
    ant, bee, cat = points(3)
    return joint_env(calling(*[ant, ant, bee, cat, bee] * 5), [ant, bee, cat])


def masked():
    space = spaces.Dict({"observation": spaces.Box(0, 1, (1,), np.float32), "action_mask": spaces.MultiBinary(10)})
    ant, bee = points(
        observation_space=space,
        observation_space_mapping=lambda: {"observation": [0.5]},
        action_mask_mapping=lambda: [1] * 10,
    )
    return joint_env(calling(*[ant, bee] * 20), [ant, bee])


@pytest.mark.parametrize("make", JOINTS.values(), ids=JOINTS.keys())
def test_gymnasiums_check(make):
    check_env(make(), skip_render_check=True)


def test_seeds_seed_the_space():
    env = boxes(flatten=True)
    env.reset(seed=4)
    drawn = [env.action_space.sample() for _ in range(5)]
    env.reset(seed=4)
    assert data_equivalence([env.action_space.sample() for _ in range(5)], drawn)
    env.reset(seed=5)
    assert not data_equivalence([env.action_space.sample() for _ in range(5)], drawn)


def test_of_one_agent_the_joint_view_is_the_single_view():
    ant = decision(agent="ant_0", reward_mapping=lambda: 1.0)
    env = joint_env(calling(ant, ant), ant)
    env.reset()
    assert env.step({"ant_0": 3})[1:4] == (1.0, False, False)
    assert env.step({"ant_0": 4})[1:4] == (1.0, True, False)


# -- each agent's part is its own ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("parts", "action", "expected"),
    [
        (
            [spaces.Box(-9, 9, (length,), np.float64) for length in (2, 3, 1)],
            [1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
            [[1, 2], [3, 4, 5], [6]],
        ),
        (
            [spaces.MultiDiscrete([4, 4, 4]), spaces.Discrete(3, start=5), spaces.MultiDiscrete([2, 2])],
            [1, 2, 3, 6, 0, 1],
            [[1, 2, 3], 6, [0, 1]],
        ),
    ],
    ids=["boxes", "numbers"],
)
def test_each_agent_gets_its_part_of_a_flat_action_whatever_its_length(parts, action, expected):
    functions = [
        decision(agent=f"{name}_0", action_space=part, action_space_mapping=lambda given: np.array(given).tolist())
        for name, part in zip(("ant", "bee", "cat"), parts, strict=True)
    ]
    env = joint_env(calling(*functions), functions, flatten=True)
    env.reset()
    assert env.action_space.shape == (6,)
    env.step(np.array(action))
    assert env.simulation.log == expected


def test_the_time_of_an_episode_begins_with_its_reset():
    ant, bee = points()

    class Timed:
        def reset(self, seed=None):
            self.now = 0.0

        def run(self):
            for _ in range(2):
                ant()
                bee()
                self.now += 5.0

        def time(self):
            return self.now

    env = joint_env(Timed, [ant, bee])
    for _ in range(2):
        _, info = env.reset()
        assert (info["time"], info["elapsed"]) == (0.0, 0.0)
        *_, info = env.step(RULE)
        assert (info["time"], info["elapsed"]) == (5.0, 5.0)


@pytest.mark.parametrize("flatten", [False, True])
def test_what_is_told_can_be_changed_by_its_user(flatten):
    ant, bee = points()
    env = joint_env(calling(ant, bee, bee, bee), [ant, bee], flatten=flatten)
    action = np.array([1, 1]) if flatten else {"ant_0": 1, "bee_0": 1}
    told = [env.reset()[0], *(env.step(action)[0] for _ in range(2))]
    for observation in told:
        for part in [observation] if flatten else observation.values():
            part += 100
    again = env.step(action)[0]
    assert (again.tolist() if flatten else again["ant_0"].tolist() + again["bee_0"].tolist()) == [1, 2, 1, 2]


def test_its_spaces_are_its_own():
    seeing, acting = spaces.Box(-9, 9, (2,), np.float64), spaces.Discrete(10)
    ant, bee = points(observation_space=seeing, action_space=acting)
    for space in (seeing, acting):
        space.seed(5)
    states = [space.np_random.bit_generator.state for space in (seeing, acting)]
    one, other = (joint_env(calling(ant, bee), [ant, bee]) for _ in range(2))
    one.reset(seed=1)
    one.action_space.seed(1)
    one.observation_space.seed(1)
    assert [space.np_random.bit_generator.state for space in (seeing, acting)] == states
    for name in ("observation_space", "action_space"):
        parts = [getattr(env, name)[agent] for env in (one, other) for agent in ("ant_0", "bee_0")]
        assert len({id(part) for part in parts}) == 4


def test_an_action_that_lacks_an_agent_names_those_that_are_given():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    env = joint_env(calling(ant, bee), [ant, bee])
    env.reset()
    with pytest.raises(InvalidActionError, match=re.escape("ant_0, bee_0; given: ['bee_0']")):
        env.step({"bee_0": 1})
