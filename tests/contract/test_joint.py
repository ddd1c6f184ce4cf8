"""The joint view: one agent that takes all decisions."""

import re
from functools import partial
from itertools import product

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env, data_equivalence
from hypothesis import given, settings

from simenv_marl import RULE, aec_env, generate_env, joint_env, parallel_env, vector_env
from simenv_marl.errors import (
    AgentError,
    EpisodeOverError,
    InvalidActionError,
    NoDecisionError,
    NotResetError,
    UnknownOptionError,
    ViewError,
)
from tests.worlds.lives import life
from tests.worlds.many_worlds import ROSTER, Announcing, Answered, Being, Colony, answer, beings, colony, designs, seeds
from tests.worlds.models import calling, decision


def points(number=2, **changes):
    """Decision functions of so many agents, ``ant_0``, ``bee_0`` and so on."""
    return [decision(agent=f"{name}_0", **changes) for name in ("ant", "bee", "cat", "dog")[:number]]


BOX = {"action_space": spaces.Box(0, 1, (1,), np.float32), "action_space_mapping": lambda action: float(action[0])}


# -- dicts ----------------------------------------------------------------------------------------


def test_spaces_are_dicts_keyed_by_agent():
    ant, bee, cat = points(3)
    env = joint_env(calling(ant, cat, bee), [ant, bee, cat], policies={"cat_0": lambda observation: 7})
    assert env.action_space == spaces.Dict({"ant_0": spaces.Discrete(10), "bee_0": spaces.Discrete(10)})
    assert list(env.observation_space.spaces) == ["ant_0", "bee_0"]
    observation, info = env.reset(seed=1)
    assert observation in env.observation_space
    assert observation["ant_0"].tolist() == [1, 2]
    assert observation["bee_0"].tolist() == [0, 0]
    assert info == {"deciding": "ant_0", "acted": {"ant_0": False, "bee_0": False}}
    env.step({"ant_0": 1, "bee_0": 2})
    assert env.simulation.log == [1, 7, 2]


@pytest.mark.parametrize("max_steps", [None, 2])
def test_a_step_is_a_round(max_steps):
    ant, bee = points(reward_mapping=lambda: 1.5)
    calls = [ant, bee] * (2 if max_steps is None else 9)
    env = joint_env(calling(*calls), [ant, bee], max_steps=max_steps)
    for _ in range(2):
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
        assert (terminated, truncated) == (max_steps is None, max_steps is not None)
        assert info["deciding"] == ""
        with pytest.raises(EpisodeOverError, match="begin the next one"):
            env.step({"ant_0": 3, "bee_0": 4})


BOTH = "ant_0, bee_0; given: "


@pytest.mark.parametrize(
    ("flatten", "action", "match"),
    [
        *((False, given, f"{BOTH}{list(given)}") for given in ({"ant_0": 0.5}, {"bee_0": 0.5}, {})),
        (False, {"ant_0": 0.5, "bee_0": 0.5, "cat_0": 0.5}, "cat_0"),
        (False, {"ant_0": 0.5, "cat_0": 0.5}, "cat_0"),
        (False, {"ant_0": 0.5, 2: 0.5}, "2"),
        (False, {"ant_0": 10, "bee_0": 0.5}, "ant_0"),
        (False, {"ant_0": 0.5, "bee_0": 10}, "bee_0"),
        (False, {"ant_0": 0.5, "bee_0": None}, "bee_0"),
        *((False, given, f"given: {given!r}") for given in (None, 3, [1, 1], np.array([1, 1]), "ant_0")),
        *(
            (True, given, "action")
            for given in (
                *(np.array(row, np.float32) for row in ([0.5], [0.5] * 3, [[0.5, 0.5]], [0.5, 1.5], [0.5, np.nan])),
                np.array([-0.5, 0.5]),
                None,
                0.5,
                {"ant_0": [0.5], "bee_0": [0.5]},
            )
        ),
    ],
    ids=repr,
)
def test_actions_that_are_refused_move_nothing(flatten, action, match):
    paid, seen = [], []
    changes = BOX | {"action_space_mapping": lambda action: seen.append(action) or float(action[0])}
    ant, bee = points(reward_mapping=lambda: paid.append(0) or 1.0, **changes)
    env = joint_env(calling(ant, bee), [ant, bee], flatten=flatten)
    env.reset()
    del paid[:]
    with pytest.raises(InvalidActionError, match=re.escape(match)):
        env.step(action)
    assert env.simulation.log == seen == paid == []
    action = np.array([0.25, 0.5])
    assert env.step(action if flatten else {"ant_0": action[:1], "bee_0": action[1:]})[2]
    action[:] = 0  # the user's own
    assert env.simulation.log == [0.25, 0.5]
    assert [part.tolist() for part in seen] == [[0.25], [0.5]]


@pytest.mark.parametrize("flatten", [False, True])
def test_rule_may_answer_for_all_and_for_some(flatten):
    ant, bee = points(**BOX)
    env = joint_env(calling(ant, bee, ant, bee), [ant, bee], flatten=flatten)
    env.reset()
    env.step(RULE)
    assert env.simulation.log == ["rule", "rule"]
    if not flatten:
        env.step({"ant_0": RULE, "bee_0": [0.5]})
        assert env.simulation.log[2:] == ["rule", 0.5]


def test_masks_and_choices_are_those_of_the_pending_decision():
    ant = decision(agent="ant_0", action_mask_mapping=lambda: [1] * 3 + [0] * 7)
    bee = decision(agent="bee_0", choices=lambda: ["x", "y"], action_space=spaces.Discrete(3))
    cat = decision(agent="cat_0")
    env = joint_env(calling(ant, bee, cat, ant, bee), [ant, bee, cat])
    env.reset()
    *_, info = env.step({"ant_0": 2, "bee_0": 1, "cat_0": 0})
    assert env.simulation.log == [2, "y", 0]
    assert {agent: mask.tolist() for agent, mask in info["action_mask"].items()} == {
        "ant_0": [1] * 3 + [0] * 7,
        "bee_0": [1, 1, 0],
    }
    *_, info = env.step({"ant_0": 2, "bee_0": 2, "cat_0": 0})
    assert env.simulation.log == [2, "y", 0, 2]
    assert info["deciding"] == "bee_0"
    assert info["acted"] == {"ant_0": True, "bee_0": False, "cat_0": False}


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


@pytest.mark.parametrize(
    ("pack", "options", "names"),
    [(Pack, {"possible_agents": [*NAMES, "being_3"]}, [*NAMES, "being_3"]), (AnnouncingPack, {}, NAMES)],
    ids=["declared", "announced"],
)
def test_the_roster_is_declared_or_asked_of_the_simulation(pack, options, names):
    env = joint_env(pack, beings(), **options)
    assert sorted(env.action_space.spaces) == names
    observation, _ = env.reset()
    assert observation in env.observation_space
    assert {name: part.tolist() for name, part in observation.items() if name not in NAMES[:1]} == {
        name: [int(name[-1]) if pack is AnnouncingPack else 0, 0] for name in names[1:]
    }


@pytest.mark.parametrize("undeclared", ["error", "rule"])
def test_agents_that_join_after_all_are_refused_or_follow_their_rule(undeclared):
    env = joint_env(life("0 acts, 0 acts, 9 acts", announced=[0]), beings(), undeclared=undeclared)
    env.reset()
    env.step({"being_0": 1})
    if undeclared == "rule":
        assert env.step({"being_0": 1})[2]
        assert env.simulation.log == [1, 1, "rule"]
    else:
        with pytest.raises(AgentError, match="being_9"):
            env.step({"being_0": 1})


def test_the_dead_are_observed_as_they_ended_and_neither_act_nor_are_paid():
    env = joint_env(AnnouncingPack, beings())
    env.reset()
    action = dict.fromkeys(NAMES, 1)
    assert env.step(action)[1] == 2.0 + 1.0 + 1.0
    observation, reward, terminated, _, info = env.step(action)
    assert observation["being_0"].tolist() == [0, 2]
    assert reward == 2.0 + 3.0 + 2.0
    assert not terminated
    assert info["acted"] == dict.fromkeys(NAMES, True)
    with pytest.raises(InvalidActionError, match="being_0"):
        env.step({"being_1": 1, "being_2": 1})
    observation, reward, _, _, info = env.step(action | {"being_0": RULE})
    assert observation["being_0"].tolist() == [0, 2]
    assert reward == 4.0 + 3.0
    assert info["acted"] == {"being_0": False, "being_1": True, "being_2": True}
    assert env.simulation.log[6:] == [(1, 1), (2, 1)]
    assert env.step(action)[2]


def test_a_roster_that_is_not_known_is_refused():
    for make, program in product((joint_env, partial(vector_env, num_envs=2)), (life("0 whole 1"), Pack)):
        with pytest.raises(ViewError, match=r"known when the environment is made.*possible_agents=.*expected_calls"):
            make(program, beings())
    with pytest.raises(NoDecisionError, match="without a decision"):
        joint_env(life("0 whole 1", announced=[]), beings())


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
    functions = [
        decision(
            agent=f"{name}_0",
            observation_space=spaces.Box(-size, size, (size,), np.float32),
            observation_space_mapping=lambda size=size: np.full(size, size / 2),
            action_space=spaces.Box(0, size, (size,), np.float32),
            action_space_mapping=lambda action: action.tolist(),
        )
        for name, size in (("ant", 2), ("bee", 3), ("cat", 1))
    ]
    env = joint_env(calling(*functions, functions[0]), functions, flatten=True)
    high = np.array([2, 2, 3, 3, 3, 1], np.float32)
    assert env.action_space == spaces.Box(np.zeros(6, np.float32), high)
    assert env.observation_space == spaces.Box(-high, high)
    observation, info = env.reset()
    assert observation.tolist() == [1, 1, 0, 0, 0, 0]
    assert observation.dtype == np.float32
    observation, *_, info = env.step(np.array([0, 1, 0.5, 1.5, 2.5, 0.25], np.float32))
    assert observation.tolist() == [1, 1, 1.5, 1.5, 1.5, 0.5]
    assert env.simulation.log == [[0, 1], [0.5, 1.5, 2.5], [0.25]]
    assert info == {"deciding": "ant_0", "acted": dict.fromkeys(["ant_0", "bee_0", "cat_0"], True)}


def test_flattened_discrete_spaces_have_one_mask():
    ant = decision(
        agent="ant_0",
        action_space=spaces.MultiDiscrete([2, 3]),
        action_space_mapping=lambda action: action.tolist(),
        action_mask_mapping=lambda: ([0, 1], [1, 1, 1]),
    )
    functions = [ant, decision(agent="bee_0", action_space=spaces.Discrete(2, start=5)), decision(agent="cat_0")]
    env = joint_env(calling(*functions * 2), functions, flatten=True)
    assert env.action_space == spaces.MultiDiscrete([2, 3, 2, 10], start=[0, 0, 5, 0])
    with pytest.raises(NotResetError, match="no episode yet"):
        env.action_masks()
    observation, _ = env.reset()
    assert observation.tolist() == [1, 2, 0, 0, 0, 0]
    for refused in ([1, 2, 6, 9], np.array([1.0, 2, 6, 9]), np.array([1, 2, 4, 9]), np.array([1, 2, 6]), 6):
        with pytest.raises(InvalidActionError):
            env.step(refused)
    assert env.simulation.log == []
    *_, info = env.step(np.array([1, 2, 6, 9]))
    assert env.simulation.log == [[1, 2], 6, 9]
    assert info["acted"] == dict.fromkeys(["ant_0", "bee_0", "cat_0"], True)
    masks = env.action_masks()
    assert masks.dtype == np.bool_
    assert masks.tolist() == [False, True] + [True] * 15
    masks[:] = False
    assert env.action_masks().any()
    env = joint_env(calling(*functions), functions)
    env.reset()
    with pytest.raises(ViewError, match="flatten"):
        env.action_masks()
    envs = vector_env(calling(*functions * 2), functions, num_envs=2, flatten=True)
    envs.reset()
    envs.step(np.array([[1, 2, 5, 3], [1, 0, 6, 9]]))
    assert [simulation.log for simulation in envs.get_attr("simulation")] == [[[1, 2], 5, 3], [[1, 0], 6, 9]]
    with pytest.raises(InvalidActionError, match="sub-environment 1"):
        envs.step(np.array([[1, 2, 5, 3], [1, 0, 7, 9]]))
    envs.close()


@pytest.mark.parametrize(
    ("of_ant", "of_bee", "match"),
    [
        ({"action_space": spaces.MultiDiscrete([[2, 2]])}, {}, "needs one-dimensional Box"),
        ({**BOX, "observation_space": spaces.Box(0, 1, (2, 2), np.float32)}, BOX, "needs one-dimensional Box"),
        ({**BOX, "observation_space": spaces.Discrete(3)}, BOX, "needs one-dimensional Box"),
        ({"action_space": spaces.Box(0, 1, (), np.float32)}, BOX, "needs one-dimensional Box"),
        ({}, BOX, "all continuous or all discrete"),
    ],
    ids=["matrix of numbers", "matrix", "number", "scalar", "partly discrete"],
)
def test_some_spaces_cannot_be_flattened(of_ant, of_bee, match):
    ant, bee = decision(agent="ant_0", **of_ant), decision(agent="bee_0", **of_bee)
    for make, error, text in (
        (joint_env, ViewError, match),
        (aec_env, UnknownOptionError, "an option of the joint view only"),
        (parallel_env, UnknownOptionError, "an option of the joint view only"),
    ):
        with pytest.raises(error, match=text):
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


SEEN_MASKS = {
    "observation_space": spaces.Dict(
        {"observation": spaces.Box(0, 1, (1,), np.float32), "action_mask": spaces.MultiBinary(10)}
    ),
    "observation_space_mapping": lambda: {"observation": [0.5]},
    "action_mask_mapping": lambda: [1] * 10,
}


JOINTS = {
    "dicts": lambda: joint_env(calling(*(pair := points()) * 20), list(pair)),
    "boxes": lambda: joint_env(calling(*(pair := points(**BOX)) * 20), list(pair)),
    "deaths": lambda: joint_env(AnnouncingPack, beings()),
    "a roster": lambda: joint_env(Pack, beings(), possible_agents=[*NAMES, "being_3"]),
    "flattened": lambda: generate_env(calling(*(pair := points(**BOX)) * 20), pair, view="joint", flatten=True)(),
    "masks in observations": lambda: joint_env(calling(*(pair := points(**SEEN_MASKS)) * 20), list(pair)),
}


@pytest.mark.parametrize("make", JOINTS.values(), ids=JOINTS.keys())
def test_gymnasiums_check_passes(make):
    env = make()
    check_env(env, skip_render_check=True)
    drawn = []
    for seed in (4, 4, 5):
        env.reset(seed=seed)
        drawn.append([env.action_space.sample() for _ in range(5)])
    assert data_equivalence(drawn[0], drawn[1])
    assert not data_equivalence(drawn[0], drawn[2])


@pytest.mark.parametrize("flatten", [False, True])
def test_what_is_returned_is_the_users_own(flatten):
    kept = np.array([1.0, 2.0])
    ant, bee = points(observation_space_mapping=lambda: kept, action_mask_mapping=lambda: [1] * 10)
    env = joint_env(calling(ant, bee, bee, bee), [ant, bee], flatten=flatten)
    action = np.array([1, 1]) if flatten else {"ant_0": 1, "bee_0": 1}
    told = [env.reset(), *(env.step(action) for _ in range(2))]
    for observation, *_, info in told:
        info["action_mask"]["ant_0"][:] = 0
        for part in [observation] if flatten else observation.values():
            part += 100
    again, *_, info = env.step(action)
    assert kept.tolist() == [1, 2]
    assert (again.tolist() if flatten else again["ant_0"].tolist() + again["bee_0"].tolist()) == [1, 2, 1, 2]
    assert info["action_mask"]["ant_0"].tolist() == [1] * 10


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
