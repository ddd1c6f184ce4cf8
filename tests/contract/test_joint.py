"""The joint view: one agent that takes all decisions."""

import re
from functools import partial

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env, data_equivalence

from simenv_marl import RULE, aec_env, generate_env, joint_env, parallel_env, vector_env
from simenv_marl.errors import (
    EpisodeOverError,
    InvalidActionError,
    NoDecisionError,
    NotResetError,
    UnknownOptionError,
    ViewError,
)
from tests.worlds.entities import Being, beings, life
from tests.worlds.models import calling, decision, unwinding


def points(number=2, **changes):
    """Decision functions of so many agents, ``ant_0``, ``bee_0`` and so on."""
    return [
        decision(agent=f"{name}_0", **changes) for name in ("ant", "bee", "cat", "dog")[:number]
    ]


BOX = {
    "action_space": spaces.Box(0, 1, (1,), np.float32),
    "action_space_mapping": lambda action: float(action[0]),
}


# -- dicts ----------------------------------------------------------------------------------------


def test_joint_env_spaces_are_dicts_keyed_by_agent():
    ant, bee, cat = points(
        3, action_space=spaces.Discrete(10), observation_space=spaces.Box(-9, 9, (2,))
    )
    env = joint_env(
        calling(ant, cat, bee), [ant, bee, cat], policies={"cat_0": lambda observation: 7}
    )
    assert env.action_space == spaces.Dict(
        {"ant_0": spaces.Discrete(10), "bee_0": spaces.Discrete(10)}
    )
    assert list(env.observation_space.spaces) == ["ant_0", "bee_0"]
    for space in (env.observation_space, env.action_space):
        assert space["ant_0"] is not space["bee_0"]  # each has its own generator
    observation, info = env.reset(seed=1)
    assert observation in env.observation_space
    assert observation["ant_0"].tolist() == [1, 2]
    assert observation["bee_0"].tolist() == [0, 0]
    assert info == {"deciding": "ant_0", "acted": {"ant_0": False, "bee_0": False}}
    env.step({"ant_0": 1, "bee_0": 2})
    assert env.simulation.log == [1, 7, 2]


def test_joint_env_ignores_an_action_that_is_illegal_at_its_agents_turn():
    mask = np.array([1] * 3 + [0] * 7, np.int8)
    ant, cat = decision(agent="ant_0", action_mask_mapping=lambda: mask), decision(agent="cat_0")
    bee = decision(agent="bee_0", choices=lambda: ["x", "y"], action_space=spaces.Discrete(3))
    env = joint_env(calling(ant, bee, cat, ant, bee), [ant, bee, cat])
    env.reset()
    env.step({"ant_0": 2, "bee_0": 1, "cat_0": 0})
    *_, info = env.step({"ant_0": 2, "bee_0": 2, "cat_0": 0})
    assert env.simulation.log == [2, "y", 0, 2]
    assert (info["deciding"], info["acted"]) == (
        "bee_0",
        {"ant_0": True, "bee_0": False, "cat_0": False},
    )
    masks = {name: given.tolist() for name, given in info["action_mask"].items()}
    assert masks == {"ant_0": mask.tolist(), "bee_0": [1, 1, 0]}


@pytest.mark.parametrize("max_steps", [None, 2])
def test_joint_env_step_answers_one_decision_of_each_agent(max_steps):
    ant, bee = points(reward_mapping=lambda: 1.5)
    calls = [ant, bee] * (2 if max_steps is None else 9)
    env = joint_env(calling(*calls), [ant, bee], max_steps=max_steps)
    for _ in range(2):
        env.reset()
        observation, reward, terminated, truncated, info = env.step({"bee_0": 2, "ant_0": RULE})
        assert env.simulation.log == ["rule", 2]
        assert observation in env.observation_space
        assert (reward, terminated, truncated) == (3.0, False, False)
        assert type(reward) is float
        assert type(terminated) is type(truncated) is bool
        assert info == {"deciding": "ant_0", "acted": {"ant_0": True, "bee_0": True}}
        *_, terminated, truncated, info = env.step(RULE)
        assert env.simulation.log == ["rule", 2, "rule", "rule"]
        assert (terminated, truncated) == (max_steps is None, max_steps is not None)
        assert info["deciding"] == ""
        with pytest.raises(EpisodeOverError, match="begin the next one"):
            env.step({"ant_0": 3, "bee_0": 4})


@pytest.mark.parametrize(
    ("flatten", "action", "match"),
    [
        *((False, given, f"ant_0, bee_0; given: {list(given)}") for given in ({"ant_0": 0.5}, {})),
        (False, {"ant_0": 0.5, "bee_0": 0.5, "cat_0": 0.5}, "cat_0"),
        (False, {"ant_0": 0.5, 2: 0.5}, "2"),
        (False, {"ant_0": 0.5, "bee_0": 10}, "bee_0"),
        (False, {"ant_0": 0.5, "bee_0": None}, "bee_0"),
        *((False, given, f"given: {given!r}") for given in (None, np.array([1, 1]), "ant_0")),
        *(
            (True, np.array(row, np.float32), "action")
            for row in ([0.5], [[0.5, 0.5]], [0.5, 1.5], [0.5, np.nan])
        ),
        *((True, given, "action") for given in (None, 0.5, {"ant_0": [0.5], "bee_0": [0.5]})),
    ],
    ids=repr,
)
def test_joint_env_is_unchanged_after_it_refuses_an_action(flatten, action, match):
    paid, seen = [], []
    changes = BOX | {"action_space_mapping": lambda action: seen.append(action) or float(action[0])}
    ant, bee = points(reward_mapping=lambda: paid.append(0) or 1.0, **changes)
    env = joint_env(calling(ant, bee, ant, bee), [ant, bee], flatten=flatten)
    env.reset()
    del paid[:]
    with pytest.raises(InvalidActionError, match=re.escape(match)):
        env.step(action)
    assert env.simulation.log == seen == paid == []
    action = np.array([0.25, 0.5])
    env.step(action if flatten else {"ant_0": action[:1], "bee_0": action[1:]})
    action[:] = 0  # the user's own
    assert env.simulation.log == [0.25, 0.5]
    assert [part.tolist() for part in seen] == [[0.25], [0.5]]
    assert env.step(RULE)[2]
    assert env.simulation.log[2:] == ["rule", "rule"]


# -- who is there ---------------------------------------------------------------------------------


PACK = (
    "0 health 1, 0 acts, 1 health 1, 1 acts, 2 health 1, 2 acts, 0 health 2, 0 acts, 1 health 2, 1"
    " acts, 2 health 2, 2 acts, 0 leaves, 1 health 3, 1 acts, 2 health 3, 2 acts, 1 health 4, 1"
    " acts, 2 health 4, 2 acts"
)
"""Three beings act and grow, of whom the first dies in the second round."""


NAMES = ["being_0", "being_1", "being_2"]


def test_joint_env_takes_agents_from_possible_agents_or_the_simulation():
    declared = joint_env(life(PACK), beings(), possible_agents=[*NAMES, "being_3"])
    announced = joint_env(life(PACK, announced=range(3)), beings())
    for env, seen in (
        (declared, {"being_0": [0, 1], "being_1": [0, 0], "being_2": [0, 0], "being_3": [0, 0]}),
        (announced, {"being_0": [0, 1], "being_1": [1, 0], "being_2": [2, 0]}),
    ):
        assert sorted(env.action_space.spaces) == list(seen)
        observation, _ = env.reset()
        assert observation in env.observation_space
        assert {name: part.tolist() for name, part in observation.items()} == seen


def test_joint_env_keeps_ended_agents_last_observation_without_reward():
    env = joint_env(life(PACK, announced=range(3)), beings())
    env.reset()
    action = {"being_0": 5, "being_1": 6, "being_2": 7}
    assert env.step(action)[1] == 2.0 + 1.0 + 1.0
    observation, reward, terminated, _, info = env.step(action)
    assert observation["being_0"].tolist() == [0, 2]
    assert reward == 2.0 + 3.0 + 2.0
    assert not terminated
    assert info["acted"] == dict.fromkeys(NAMES, True)
    observation["being_0"][:] = 9  # the user's own
    with pytest.raises(InvalidActionError, match="being_0"):
        env.step({"being_1": 1, "being_2": 1})
    observation, reward, _, _, info = env.step(action | {"being_0": RULE})
    assert observation["being_0"].tolist() == [0, 2]
    assert reward == 4.0 + 3.0
    assert info["acted"] == {"being_0": False, "being_1": True, "being_2": True}
    assert env.simulation.log[6:] == [6, 7]
    assert env.step(action)[2]


@pytest.mark.parametrize(
    "make", [joint_env, partial(vector_env, num_envs=2)], ids=["one", "vector"]
)
def test_joint_env_refuses_a_model_whose_agents_are_unknown(make):
    for program in ("0 whole 1", PACK):
        with pytest.raises(
            ViewError,
            match=r"known when .* those of tests\S+act; .*possible_agents=.*expected_calls",
        ):
            make(life(program), beings())
    with pytest.raises(NoDecisionError, match="without a decision"):
        joint_env(life("0 whole 1", announced=[]), beings())


def test_joint_env_unwinds_the_trial_run_in_which_it_finds_its_agents():
    being, log = Being(0), []

    def announcing():
        simulation = unwinding(lambda: being.act(), log)()
        simulation.expected_calls = lambda point: [(being,)]
        return simulation

    env = joint_env(announcing, beings())
    assert log == ["unwound"]
    env.reset()
    env.close()
    assert log == ["unwound"] * 2


# -- flattened ------------------------------------------------------------------------------------


def test_joint_env_with_flatten_has_box_spaces():
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


def test_joint_env_with_flatten_has_one_mask_for_all_discrete_spaces():
    ant = decision(
        agent="ant_0",
        action_space=spaces.MultiDiscrete([2, 3]),
        action_space_mapping=lambda action: action.tolist(),
        action_mask_mapping=lambda: ([0, 1], [1, 1, 1]),
    )
    functions = [
        ant,
        decision(agent="bee_0", action_space=spaces.Discrete(2, start=5)),
        decision(agent="cat_0"),
    ]
    env = joint_env(calling(*functions * 2), functions, flatten=True)
    assert env.action_space == spaces.MultiDiscrete([2, 3, 2, 10], start=[0, 0, 5, 0])
    with pytest.raises(NotResetError, match="no episode yet"):
        env.action_masks()
    env.reset()
    for refused in (
        [1, 2, 6, 9],
        np.array([1.0, 2, 6, 9]),
        np.array([1, 2, 4, 9]),
        np.array([1, 2, 6]),
        6,
    ):
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


@pytest.mark.parametrize(
    ("of_ant", "of_bee", "match"),
    [
        ({"action_space": spaces.MultiDiscrete([[2, 2]])}, {}, "needs one-dimensional Box"),
        (
            {**BOX, "observation_space": spaces.Box(0, 1, (2, 2), np.float32)},
            BOX,
            "needs one-dimensional Box",
        ),
        ({"action_space": spaces.MultiBinary(2)}, BOX, "needs one-dimensional Box"),
    ],
    ids=["matrix of numbers", "matrix", "bits"],
)
def test_flatten_refuses_unsuitable_spaces_and_environments(of_ant, of_bee, match):
    ant, bee = decision(agent="ant_0", **of_ant), decision(agent="bee_0", **of_bee)
    with pytest.raises(ViewError, match=match):
        joint_env(calling(ant, bee), [ant, bee], flatten=True)
    for make in (aec_env, parallel_env):
        with pytest.raises(UnknownOptionError, match="an option of joint and turn views only"):
            make(calling(ant, bee), [ant, bee], flatten=True)


def test_flattened_action_chooses_the_legal_action_with_the_largest_value():
    mask = np.array([0, 1, 1], np.int8)
    ant = decision(
        agent="ant_0",
        action_space=spaces.Discrete(3, start=4),
        action_mask_mapping=lambda: mask,
        observation_space=spaces.Discrete(2),
        observation_space_mapping=lambda: 1,
    )
    bee = decision(agent="bee_0", **BOX, observation_space=spaces.Box(-9, 9, (2,), np.float32))
    env = joint_env(calling(ant, bee), [ant, bee], flatten=True)
    assert env.action_space.low.tolist() == [-1, -1, -1, 0]
    assert env.action_space.high.tolist() == [1, 1, 1, 1]
    observation, _ = env.reset()
    assert observation in env.observation_space
    assert observation.tolist() == [0, 1, 0, 0]
    env.step(np.array([0.9, -0.5, 0.5, 0.25], np.float32))
    assert env.simulation.log == [6, 0.25]


# -- Gymnasium's check ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "make",
    [
        lambda: joint_env(life(PACK), beings(), possible_agents=[*NAMES, "being_3"]),
        lambda: generate_env(
            calling(*(pair := points(**BOX)) * 20), pair, view="joint", flatten=True
        )(),
    ],
    ids=["deaths and possible agents", "flattened"],
)
def test_joint_env_passes_gymnasiums_check_env(make):
    env = make()
    check_env(env, skip_render_check=True)
    drawn = []
    for seed in (4, 4, 5):
        env.reset(seed=seed)
        drawn.append(env.action_space.sample())
    assert data_equivalence(drawn[0], drawn[1])
    assert not data_equivalence(drawn[0], drawn[2])
