"""What the views tell beside observations: goals, masks, the time, the state and pictures."""

from functools import partial
from math import exp

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env

from simenv_marl import (
    RULE,
    TRUNCATED,
    aec_env,
    joint_env,
    parallel_env,
    register_simulation,
    simulate,
    single_env,
    vector_env,
)
from simenv_marl.errors import (
    DefinitionError,
    InvalidActionError,
    NotResetError,
    ObservationError,
    OptionValueError,
    ViewError,
)
from tests.worlds.entities import beings, life
from tests.worlds.models import (
    EVERY_VIEW,
    begun,
    calling,
    decision,
    define,
    play,
    registries_put_back,
    step,
)

# -- goals ----------------------------------------------------------------------------------------


class Walk:
    """Walks on a plane, and wants to come to some place."""

    def reset(self, seed=None):
        self.place, self.goal, self.steps = (
            np.zeros(2),
            np.random.default_rng(seed).integers(-3, 4, 2).astype(float),
            0,
        )

    def run(self):
        for self.steps in range(1, 9):
            self.place += self.walk(0.5)
        return TRUNCATED

    def walk(self, pace):
        return np.array([pace, 0.0])


def distance(achieved, desired, info):
    return -np.linalg.norm(achieved - desired, axis=-1)


GOAL = {
    "agent": "walker_0",
    "observation_space": spaces.Box(-20, 20, (3,), np.float32),
    "observation_space_mapping": lambda walk, pace: [*walk.place, walk.steps],
    "action_space": spaces.Box(-1, 1, (2,), np.float32),
    "action_space_mapping": lambda action: action.astype(float),
    "reward_mapping": lambda walk, pace: distance(
        np.float32(walk.place), np.float32(walk.goal), None
    ),
    "goal_space": spaces.Box(-20, 20, (2,), np.float32),
    "achieved_goal_mapping": lambda walk, pace: walk.place,
    "desired_goal_mapping": lambda walk, pace: walk.goal,
    "compute_reward": distance,
}


def goals(**changes):
    return {Walk.walk: define(**GOAL | changes)}


def test_goal_observations_are_new_dicts_at_each_step():
    env = single_env(Walk, goals())
    assert isinstance(env.observation_space, spaces.Dict)
    assert set(env.observation_space.spaces) == {"observation", "achieved_goal", "desired_goal"}
    assert (
        env.observation_space["achieved_goal"]
        == env.observation_space["desired_goal"]
        == GOAL["goal_space"]
    )
    first, info = env.reset(seed=3)
    assert info == {}
    assert first in env.observation_space
    goal = env.simulation.goal.tolist()
    assert first["desired_goal"].tolist() == goal
    first["desired_goal"][:] = first["achieved_goal"][:] = 9
    observation, reward, *_ = env.step(np.array([0.5, -1], np.float32))
    assert observation["achieved_goal"].tolist() == [0.5, -1]
    assert observation["desired_goal"].tolist() == env.simulation.goal.tolist() == goal
    assert observation["observation"].tolist() == [0.5, -1, 2]
    assert observation["achieved_goal"].dtype == np.float32
    assert first["achieved_goal"].tolist() == [9, 9]
    assert type(reward) is float
    with pytest.raises(ViewError, match="masks need a Discrete or MultiDiscrete"):
        env.action_masks()
    check_env(env, skip_render_check=True)
    # Other views observe no goals.
    assert aec_env(Walk, goals()).observation_space("walker_0") == GOAL["observation_space"]
    assert joint_env(Walk, goals()).observation_space["walker_0"] == GOAL["observation_space"]


def test_goal_mappings_take_only_the_arguments_they_want():
    env = single_env(
        Walk,
        goals(
            observation_space_mapping=lambda walk: [*walk.place, walk.steps],
            achieved_goal_mapping=lambda *, _simulation: _simulation.place,
            desired_goal_mapping=lambda walk, *, _simulation: _simulation.goal,
        ),
    )
    first, _ = env.reset(seed=3)
    assert first["achieved_goal"].tolist() == [0, 0]
    assert first["desired_goal"].tolist() == env.simulation.goal.tolist()


def test_compute_reward_gives_rewards_for_other_goals():
    env = begun(single_env(Walk, goals()), 3)
    observations, rewards, _, truncations, infos = zip(
        *[env.step(env.action_space.sample()) for _ in range(8)], strict=True
    )
    assert truncations[-1]
    achieved, desired = (
        np.stack([seen[part] for seen in observations])
        for part in ("achieved_goal", "desired_goal")
    )
    assert env.compute_reward(achieved, desired, infos).tolist() == list(rewards)
    relabelled = env.compute_reward(achieved, np.repeat(achieved[-1:], 8, 0), infos)
    assert relabelled.shape == (8,)
    assert relabelled[-1] == 0.0
    one = env.compute_reward(achieved[0], desired[0], infos[0])
    assert type(one) is float
    assert one == rewards[0]


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        *(({part: None}, part) for part in GOAL if "goal" in part or part == "compute_reward"),
        ({"goal_space": (2,)}, "must be a gymnasium space"),
        ({"compute_reward": 3}, "compute_reward must be callable"),
    ],
)
def test_make_step_refuses_incomplete_goals_and_goals_outside_their_space(changes, match):
    with pytest.raises(DefinitionError, match=match):
        goals(**changes)
    with pytest.raises(ObservationError, match="its space Box"):
        single_env(Walk, goals(achieved_goal_mapping=lambda walk, pace: [1, 2, 3])).reset()


def test_goal_observations_keep_the_action_mask_in_observation_and_info():
    changes = {
        "action_space": spaces.Discrete(3),
        "action_space_mapping": lambda action: np.array([action - 1.0, 0]),
        "action_mask_mapping": lambda walk, pace: [1, 0, 1],
        "observation_space": spaces.Dict(
            place=GOAL["goal_space"], action_mask=spaces.MultiBinary(3)
        ),
        "observation_space_mapping": lambda walk, pace: {"place": walk.place},
    }
    env = single_env(Walk, goals(**changes))
    observation, info = env.reset()
    assert observation in env.observation_space
    assert (
        info["action_mask"].tolist()
        == observation["observation"]["action_mask"].tolist()
        == [1, 0, 1]
    )
    with pytest.raises(InvalidActionError, match="is masked"):
        env.step(1)
    assert env.step(2)[0]["achieved_goal"].tolist() == [1, 0]


# -- masks ----------------------------------------------------------------------------------------


def test_action_masks_method_returns_flat_masks_through_wrappers():
    """The method that sb3-contrib's MaskablePPO calls before each step."""
    legal = iter([([1, 0], [0, 1, 1]), ([0, 1], [1, 0, 0]), ([1, 1], [1, 1, 1])])
    parts = spaces.MultiDiscrete([2, 3])
    ant = decision(agent="ant_0", action_space=parts, action_mask_mapping=lambda: next(legal))
    env = gymnasium.wrappers.RecordEpisodeStatistics(single_env(calling(ant, ant), ant))
    masks = env.get_wrapper_attr("action_masks")
    with pytest.raises(NotResetError, match="no episode yet"):
        masks()
    env.reset()
    assert masks().dtype == np.bool_
    for action, expected in (
        ([0, 1], [True, False, False, True, True]),
        ([1, 0], [False, True, True, False, False]),
    ):
        assert masks().tolist() == expected
        env.step(np.array(action))
    assert masks().tolist() == [True] * 5
    for space in (spaces.Discrete(5, start=2), parts):
        ant = decision(agent="ant_0", action_space=space)
        env = begun(single_env(calling(ant), ant))
        assert env.action_masks().tolist() == [True] * 5


ONE_MASK = np.array([1] * 4 + [0] * 6, np.int8)
MASKED = {"action_mask_mapping": lambda: ONE_MASK}


@EVERY_VIEW
@pytest.mark.parametrize(
    ("changes", "mask", "illegal", "legal", "log"),
    [
        (MASKED, [[1] * 4 + [0] * 6], [4, 9], [3, 0], [3, 0]),
        (
            {"choices": lambda: "ab", "action_space": spaces.Discrete(3)},
            [[1, 1, 0]],
            [2],
            [1, 0],
            ["b", "a"],
        ),
        (
            {
                "action_space": spaces.MultiDiscrete([2, 3]),
                "action_space_mapping": lambda action: action.tolist(),
                "action_mask_mapping": lambda: ([1, 0], [0, 1, 1]),
            },
            [[1, 0], [0, 1, 1]],
            [np.array([1, 1]), np.array([0, 0])],
            [np.array([0, 2]), np.array([0, 1])],
            [[0, 2], [0, 1]],
        ),
    ],
    ids=["a mask", "choices", "a mask of several parts"],
)
def test_every_env_refuses_masked_actions(view, changes, mask, illegal, legal, log):
    ant = decision(agent="ant_0", **changes)
    env = view(calling(ant, ant), ant)
    result = env.reset(seed=1)
    if view is joint_env:
        given = result[1]["action_mask"]["ant_0"]
    else:
        infos = env.infos if view is aec_env else result[1]
        given = (infos if view is single_env else infos["ant_0"])["action_mask"]
    parts = given if len(mask) > 1 else (given,)
    assert [part.tolist() for part in parts] == mask
    assert {part.dtype for part in parts} == {np.dtype(np.int8)}
    for part in parts:
        part[:] = 1  # the user's own
    for action in illegal:
        with pytest.raises(InvalidActionError, match="is masked"):
            step(env, action, "ant_0")
    assert env.simulation.log == []
    for action in legal:
        step(env, action, "ant_0")
    assert env.simulation.log == log


def test_model_observation_named_action_mask_does_not_mask_actions():
    space = spaces.Dict({"action_mask": spaces.MultiBinary(10)})
    own = {
        "observation_space": space,
        "observation_space_mapping": lambda: {"action_mask": [0, 1] * 5},
    }
    ant = decision(agent="ant_0", **own)
    env = single_env(calling(ant), ant)
    observation, info = env.reset()
    assert observation["action_mask"].tolist() == [0, 1] * 5
    assert info == {}
    env.step(0)


# -- time -----------------------------------------------------------------------------------------


class Clock:
    """Decisions at given times."""

    def __init__(self, *calls, end):
        self.calls, self.end = calls, end

    def reset(self):
        self.now = -1.0

    def run(self):
        for time, decide in self.calls:
            self.now = time
            decide()
        self.now = self.end

    def time(self):
        return self.now


def times(turns, agent):
    return [(turn.info["time"], turn.info["elapsed"]) for turn in turns if turn.agent == agent]


def test_infos_of_agents_before_and_after_their_decisions_have_their_times():
    program = "0 acts, 3 o'clock, 1 acts, 5 o'clock, 0 leaves, 8 o'clock, 1 acts"
    env = begun(
        aec_env(
            life(program, announced=[0, 1], timed=True),
            beings(action_mask_mapping=lambda being: ONE_MASK),
        )
    )
    told = env.infos["being_1"]
    assert (told["time"], told["elapsed"], told["action_mask"].tolist()) == (
        0.0,
        0.0,
        ONE_MASK.tolist(),
    )
    turns = play(env, 1)
    assert times(turns, "being_0") == [(0, 0), (5, 5)]
    assert times(turns, "being_1") == [(3, 0), (8, 5), (8, 0)]


def test_parallel_env_infos_have_the_simulation_time():
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    env = parallel_env(lambda: Clock((0, ant), (2, bee), (3, ant), (7, bee), end=11), [ant, bee])
    *_, infos = env.reset()
    assert (infos["ant_0"]["time"], infos["ant_0"]["elapsed"]) == (0, 0)
    for agent, time, *elapsed in (
        ("ant_0", 2, 2, 0),
        ("bee_0", 3, 3, 1),
        ("ant_0", 7, 4, 5),
        ("bee_0", 11, 8, 4),
    ):
        assert infos[agent]["deciding"]
        *_, infos = env.step({agent: 1})
        assert [info["time"] for info in infos.values()] == [time, time]
        assert [infos[name]["elapsed"] for name in ("ant_0", "bee_0")] == elapsed
    env.reset()
    *_, infos = env.step({"ant_0": 1, "bee_0": 1})
    assert [info["time"] for info in infos.values()] == [3, 3]
    assert infos["ant_0"]["elapsed"] == 3
    # since 2, when it decided, or since 0, when its action was chosen
    assert infos["bee_0"]["elapsed"] > 0


@pytest.mark.parametrize("action", [1, RULE])
def test_policies_get_time_elapsed_time_and_discount_in_infos(action):
    """Since the decision before, whether the policy has taken that or left it to the rule."""
    ant, seen = decision(agent="ant_0"), []

    def policy(observation, info):
        seen.append((info["time"], info["elapsed"], info["discount"]))
        return action

    simulate(lambda: Clock((1, ant), (3, ant), (7, ant), end=8), {ant: policy}, discount_rate=0.5)
    assert seen == [(1.0, 0.0, 1.0), (3.0, 2.0, exp(-1.0)), (7.0, 4.0, exp(-2.0))]


def told(env):
    """The infos of the agent "ant_0" from the reset to the end, in any view."""
    if hasattr(env, "agent_iter"):
        return [turn.info for turn in play(env, 1)]
    rounds = hasattr(env, "possible_agents")
    by_agent = rounds or isinstance(env.action_space, spaces.Dict)
    *_, info = env.reset()
    infos = [info]
    for _ in range(3):
        with pytest.raises(InvalidActionError, match="is not in its action space"):
            env.step({"ant_0": 10} if by_agent else 10)  # takes no time
        *_, info = env.step({"ant_0": 1} if by_agent else 1)
        infos.append(info)
    return [info["ant_0"] for info in infos] if rounds else infos


@EVERY_VIEW
@pytest.mark.parametrize("rate", [0.25, 0, None])
def test_infos_have_time_elapsed_time_and_discount_in_every_env(view, rate):
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    clock = Clock((np.int64(1), ant), (2, bee), (3, ant), (7, ant), end=8)
    env = view(clock, ant, discount_rate=rate)
    for _ in range(2):
        infos = told(env)
        assert [(info["time"], info["elapsed"]) for info in infos] == [
            (1.0, 0.0),
            (3.0, 2.0),
            (7.0, 4.0),
            (8.0, 1.0),
        ]
        assert {type(info[name]) for info in infos for name in ("time", "elapsed")} == {float}
        expected = [None if rate is None else exp(-rate * info["elapsed"]) for info in infos]
        assert [info.get("discount") for info in infos] == expected


@pytest.mark.parametrize("rate", [-0.1, np.nan, np.inf, True, "fast", [0.1]])
def test_envs_refuse_invalid_discount_rates(rate):
    with pytest.raises(
        OptionValueError,
        match="discount_rate must be a finite number that is not negative, or None",
    ):
        aec_env(lambda: Clock(end=1), decision(agent="ant_0"), discount_rate=rate)


# -- infos ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [aec_env, parallel_env])
def test_env_infos_have_the_same_keys_from_reset_to_the_end(make):
    """There are learners that ask for them once and for all."""
    ant, bee, elk = (
        decision(agent="ant_0", **MASKED),
        decision(agent="bee_0", **MASKED),
        decision(agent="elk_0"),
    )
    env = make(Clock((0, ant), (1, bee), (2, ant), (3, ant), (4, bee), end=5), [ant, bee, elk])
    always = {"time", "elapsed"} | ({"deciding", "acted"} if make is parallel_env else set())
    expected = {
        "ant_0": always | {"action_mask"},
        "bee_0": always | {"action_mask"},
        "elk_0": always,
    }
    told = env.reset()
    infos = env.infos if told is None else told[1]
    assert infos.keys() == expected.keys()
    while env.agents:
        assert all(info.keys() == expected[agent] for agent, info in infos.items())
        if make is aec_env:
            env.step(None if env.terminations[env.agent_selection] else RULE)
        else:
            *_, infos = env.step(RULE)
            assert infos.keys() == expected.keys()
    assert all(info.keys() == expected[agent] for agent, info in infos.items())


def test_action_mask_allows_all_actions_before_an_agents_first_decision():
    ant, bee, elk = (decision(agent=agent, **MASKED) for agent in ("ant_0", "bee_0", "elk_0"))
    env = begun(aec_env(Clock((0, ant), (1, bee), (2, bee), end=3), [ant, bee, elk]))
    env.infos["bee_0"]["action_mask"][:] = 0  # the user's own
    assert env.infos["elk_0"]["action_mask"].tolist() == [1] * 10
    env.reset()
    assert env.infos["bee_0"]["action_mask"].tolist() == [1] * 10
    assert env.infos["bee_0"]["action_mask"].dtype == np.int8
    for time, elapsed in ((1.0, 0.0), (2.0, 1.0)):
        env.step(1)
        assert env.infos["bee_0"]["action_mask"].tolist() == ONE_MASK.tolist()
        assert (env.infos["bee_0"]["time"], env.infos["bee_0"]["elapsed"]) == (time, elapsed)


@pytest.mark.parametrize("make", [aec_env, parallel_env, joint_env])
def test_action_mask_in_an_observation_without_a_decision_is_all_ones(make):
    """A mask of zeros would leave a policy nothing to choose from."""
    seen = spaces.Dict(
        observations=spaces.Box(0, 9, (1,), np.float32), action_mask=spaces.MultiBinary(10)
    )
    given = {
        "observation_space": seen,
        "observation_space_mapping": lambda: {"observations": [1.0]},
    }
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0", **MASKED, **given)
    env = make(calling(ant, bee), [ant, bee])
    told = env.reset()
    observation = env.observe("bee_0") if told is None else told[0]["bee_0"]
    assert observation["action_mask"].tolist() == [1] * 10
    assert observation["observations"].tolist() == [0.0]
    assert observation in (
        env.observation_space["bee_0"] if make is joint_env else env.observation_space("bee_0")
    )
    if make is parallel_env:
        observations, *_, infos = env.step({"ant_0": 1})
        seen, told = observations["bee_0"]["action_mask"], infos["bee_0"]["action_mask"]
        assert seen.tolist() == told.tolist() == ONE_MASK.tolist()
        assert seen.dtype == told.dtype == np.int8
        assert not np.shares_memory(seen, told)


# -- the state ------------------------------------------------------------------------------------


class Counted:
    """A simulation that tells its state, and can be rendered."""

    def __init__(self, function):
        self.function = function

    def reset(self):
        self.numbers = np.array([0, 0])

    def run(self):
        for number in range(3):
            self.numbers[0] = number
            self.numbers[1] += self.function()

    def state(self):
        return self.numbers

    def render(self, mode):
        text = f"now {self.numbers[1]}"
        if mode == "rgb_array":
            return np.full((4, 6, 3), self.numbers[1], np.uint8)
        return print(text) if mode == "human" else text


class Ragged(Counted):
    """Its state is no array."""

    def state(self):
        return [[1], [1, 2]]


@EVERY_VIEW
def test_env_state_is_a_copy_of_the_simulation_state_cast_to_its_space(view):
    ant, space = decision(agent="ant_0"), spaces.Box(-9, 9, (2,), np.float32)
    env = view(lambda: Counted(ant), ant)
    assert env.state_space is None
    env.reset()
    state = env.state()
    step(env, 4, "ant_0")
    assert state.tolist() == [0, 0]
    state = env.state()
    assert state.tolist() == [1, 4]
    state[:] = 9
    assert env.simulation.numbers.tolist() == [1, 4]
    env = view(lambda: Counted(ant), ant, state_space=space)
    assert env.state_space == space
    env.reset()
    assert env.state().dtype == np.float32
    assert env.state() in env.state_space


def test_env_state_refuses_invalid_results_of_the_simulation():
    ant = decision(agent="ant_0")
    for make, options, error, match in (
        (
            lambda: Counted(ant),
            {"state_space": spaces.Box(-9, 9, (3,))},
            ObservationError,
            "the state has shape",
        ),
        (lambda: Ragged(ant), {}, ObservationError, "has returned an illegal value: setting"),
        (calling(ant), {}, NotImplementedError, None),
    ):
        env = begun(parallel_env(make, ant, **options))
        with pytest.raises(error, match=match):
            env.state()
    with pytest.raises(OptionValueError, match="must be a gymnasium space"):
        aec_env(lambda: Counted(ant), ant, state_space="rewards")
    ant = decision(agent="ant_0", observation_space=spaces.Sequence(spaces.Discrete(3)))
    with pytest.raises(ViewError, match="flattened"):
        _ = aec_env(calling(ant), ant, state_space="observations").state_space
    with pytest.raises(ViewError, match="possible_agents"):
        parallel_env(life("0 acts", announced=[0]), beings(), state_space="observations")


@pytest.mark.parametrize("make", [aec_env, parallel_env])
def test_env_state_can_be_the_concatenated_observations(make):
    ant = decision(agent="ant_0", observation_space=spaces.Box(0, 9, (2,), np.float32))
    bee = decision(
        agent="bee_0", observation_space=spaces.Discrete(3), observation_space_mapping=lambda: 2
    )
    env = make(calling(ant, bee), [ant, bee], state_space="observations")
    assert (env.state_space.low.tolist(), env.state_space.high.tolist()) == (
        [0] * 5,
        [9, 9, 1, 1, 1],
    )
    assert env.state_space is env.state_space
    with pytest.raises(NotResetError, match="no episode yet"):
        env.state()
    env.reset()
    assert env.state().tolist() == [1, 2, 1, 0, 0]  # the second has not been observed yet
    step(env, 4, "ant_0")
    state = env.state()
    assert state.tolist() == [1, 2, 0, 0, 1]
    assert state in env.state_space
    while env.agents:
        env.step(RULE)
    assert env.state().tolist() == [1, 2, 0, 0, 1]
    for view in (single_env, joint_env):
        env = begun(view(calling(ant), ant, state_space="observations"))
        assert env.state().tolist() == [1, 2]
        assert env.state() in env.state_space


# -- pictures -------------------------------------------------------------------------------------


@EVERY_VIEW
def test_env_render_returns_frames_of_the_simulation_in_its_modes(view, capsys):
    ant = decision(agent="ant_0")
    ansi, array, human, none = (
        view(lambda: Counted(ant), ant, render_mode=mode)
        for mode in ("ansi", "rgb_array", "human", None)
    )
    assert ansi.render_mode == "ansi"
    assert ansi.metadata["render_modes"] == ["ansi", "human", "rgb_array"]
    ansi.reset()
    assert ansi.render() == "now 0"
    step(ansi, 4, "ant_0")
    assert ansi.render() == "now 4"
    array.reset()
    assert array.render().shape == (4, 6, 3)
    assert array.render().dtype == np.uint8
    for act, text in (
        (human.reset, "now 0\n"),
        (lambda: step(human, 4, "ant_0"), "now 4\n"),
        (human.render, "now 4\n"),
    ):
        act()
        assert capsys.readouterr().out == text
    assert human.render() is None
    none.reset()
    with pytest.warns(UserWarning, match="render_mode"):
        assert none.render() is None


@pytest.mark.parametrize(
    "make", [aec_env, parallel_env, single_env, lambda *of, **to: vector_env(*of, num_envs=1, **to)]
)
@pytest.mark.parametrize("mode", ["human", "rgb_array", "rgb_array_list"])
def test_env_warns_of_a_render_mode_that_the_simulation_lacks(make, mode):
    ant = decision(agent="ant_0")
    with pytest.warns(
        UserWarning, match=f"render_mode '{mode}' is not one of the simulation's .it has none."
    ):
        env = make(calling(ant), ant, render_mode=mode)
    assert env.render_mode is None


def first_numbers(frames):
    return [int(frame[0, 0, 0]) for frame in frames]


@pytest.mark.parametrize("registered_as", ["a simulation", "a function"])
def test_env_render_rgb_array_list_returns_frames_since_the_last_render(registered_as):
    ant = decision(agent="ant_0")
    with registries_put_back():
        if registered_as == "a simulation":
            identity = register_simulation(lambda: Counted(ant), ant, name="drawn")[0]
        else:
            identity = "ByFunction-v0"
            gymnasium.register(
                identity, lambda **options: single_env(lambda: Counted(ant), ant, **options)
            )
        env = gymnasium.make(identity, render_mode="rgb_array_list")
        envs = gymnasium.make_vec(identity, num_envs=2, render_mode="rgb_array_list")
    for _ in range(2):
        env.reset()
        env.step(4)
        assert first_numbers(env.render()) == [0, 4]
    env.step(3)
    assert first_numbers(env.render()) == [7]
    envs.reset()
    envs.step(np.array([4, 5]))
    assert [first_numbers(frames) for frames in envs.render()] == [[0, 4], [0, 5]]


def test_info_time_uses_a_time_method_that_reset_replaces():
    class Shift:
        def reset(self, seed=None):
            self.time = partial(float, seed)

        def run(self):
            self.work()

        def work(self):
            return 1

    definition = define(
        agent="worker",
        observation_space_mapping=lambda: [0, 0],
        reward_mapping=lambda: 0.0,
    )
    env = single_env(Shift, {Shift.work: definition})
    assert [env.reset(seed=seed)[1]["time"] for seed in (3, 5)] == [3.0, 5.0]
