"""The single view of one named agent among many, and what it asks that agent."""

from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import (
    RULE,
    aec_env,
    generate_env,
    joint_env,
    make_step,
    parallel_env,
    register_simulation,
    simulate,
    single_env,
    vector_env,
)
from simenv_marl.data import collect_episodes
from simenv_marl.errors import (
    AgentError,
    EpisodeOverError,
    InvalidActionError,
    NoDecisionError,
    OptionValueError,
    UnknownOptionError,
    UnknownPointError,
    ViewError,
)
from tests.worlds.entities import beings, life
from tests.worlds.models import EVERY_VIEW, begun, calling, decision, play
from tests.worlds.vectors import same

NAMES = ("player_red", "player_blue")
RED = {"agent": "player_red"}
ROSTER = {"possible_agents": list(NAMES), "skip_forced": True}
PLACE = f"{__name__}.Player"


class Player:
    """Moves as far as it likes out of what is offered, and earns as much."""

    def __init__(self, name):
        self.name, self.coins = name, 0

    def move(self, moves):
        return moves[-1]

    def bet(self, moves):
        return moves[0]


class Game:
    """Two players, turn by turn; how many moves are offered depends on the round.

    Each episode has six rounds.
    """

    offers = (1, 3, 1, 2, 1, 1)

    def reset(self, seed=None):
        self.players = [Player(name) for name in NAMES]
        self.log = []

    def run(self):
        for offered in self.offers:
            for player in self.players:
                move = player.move(list(range(1, offered + 1)))
                player.coins += move
                self.log.append((player.name, move))

    def time(self):
        return 10.0 * len(self.log)


class Forced(Game):
    """Offers one move only."""

    offers = (1, 1)


def definition(**changes):
    """A definition for moves or bets, whose choices are what is offered."""
    given = {
        "observation_space": spaces.Box(0, 100, (1,), np.float64),
        "observation_space_mapping": lambda player, moves: [player.coins],
        "action_space": spaces.Discrete(3),
        "choices": lambda player, moves: moves,
        "reward_mapping": lambda player, moves: player.coins,
        "agent": lambda player, moves: player.name,
    }
    return make_step(**given | changes)


def zeros():
    return dict.fromkeys(NAMES, 0)


def moves_of(env, agent):
    return [move for name, move in env.simulation.log if name == agent]


MOVE = {f"{PLACE}.move": definition()}


class Casino(Game):
    """Two players, who bet and move, in one round."""

    def run(self):
        for player in self.players:
            self.log.append((player.bet([5, 6]), player.move([1, 2])))


NAMED = {f"{PLACE}.move": definition(agent="mover"), f"{PLACE}.bet": definition(agent="better")}


def episode(env):
    """Play an episode of a Gymnasium environment; return its steps without infos, and offers."""
    observation, info = env.reset(seed=3)
    steps, offers = [], [int(info["action_mask"].sum())]
    while True:
        observation, reward, terminated, truncated, info = env.step(0)
        steps.append((observation.item(), reward, terminated, truncated))
        if terminated or truncated:
            return steps, offers
        offers.append(int(info["action_mask"].sum()))


# -- agent= ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("policies", "moves"),
    [(None, [1, 3, 1, 2, 1, 1]), ({"player_blue": lambda observation: 0}, [1] * 6)],
    ids=["the model's rule", "policies"],
)
def test_single_env_agent_option_leaves_other_agents_to_policies(policies, moves):
    env = single_env(Game, MOVE, agent="player_red", policies=policies)
    steps, offers = episode(env)
    assert offers == [1, 3, 1, 2, 1, 1]
    assert [step[0] for step in steps] == [1, 2, 3, 4, 5, 6]
    assert steps[-1][2:] == (True, False)
    assert moves_of(env, "player_blue") == moves
    with pytest.raises(EpisodeOverError):
        env.step(0)


def test_single_env_agent_can_be_chosen_among_several_decision_points():
    """Names of a roster and of policies that are left to the rule are no reason for a warning."""
    env = begun(
        single_env(
            Casino,
            NAMED,
            agent="mover",
            possible_agents=["mover", "better"],
            policies={"better": RULE},
        ),
        0,
    )
    while not env.step(0)[2]:
        pass
    assert env.simulation.log == [(5, 1), (5, 1)]


def test_possible_agents_by_decision_point_tell_where_each_agent_decides():
    named = {
        f"{PLACE}.move": definition(),
        f"{PLACE}.bet": definition(agent=lambda player, moves: f"{player.name}_bet"),
    }
    with pytest.raises(AgentError, match="possible_agents"):
        single_env(Casino, named, agent="player_red")
    roster = {f"{PLACE}.move": NAMES, f"{PLACE}.bet": [f"{name}_bet" for name in NAMES]}
    env = begun(single_env(Casino, named, agent="player_red_bet", possible_agents=roster), 0)
    assert env.step(1)[2]
    assert env.simulation.log == [(6, 2), (5, 2)]


def test_single_env_reset_without_its_agent_names_the_other_agents():
    with pytest.raises(NoDecisionError, match=r"'player_green'.*player_red, player_blue"):
        single_env(Game, MOVE, agent="player_green").reset()
    with pytest.raises(NoDecisionError):
        single_env(life("0 whole 1"), beings(), agent="being_0", skip_forced=True).reset()


ANT, BEE = decision(agent="ant_0"), decision(agent="bee_0")


def simulated(simulation, points, **options):
    return simulate(simulation, points=points, **options)


@pytest.mark.parametrize(
    ("make", "simulation", "points", "options", "error", "match"),
    [
        (single_env, Game, MOVE, {}, ViewError, "agent="),
        (single_env, Casino, NAMED, {"agent": "mvoer"}, AgentError, "mover, better"),
        (
            single_env,
            calling(ANT, BEE),
            ANT,
            {"agent": "bee_0", "policies": {BEE: RULE}},
            AgentError,
            "its agents are ant_0",
        ),
        *(
            (single_env, Game, MOVE, {"agent": agent}, OptionValueError, "agent")
            for agent in ("", 3, ("player_red",))
        ),
        *(
            (make, Game, MOVE, RED, UnknownOptionError, "single view")
            for make in (aec_env, parallel_env, joint_env)
        ),
        (simulated, Game, MOVE, RED, UnknownOptionError, "single_env"),
        (
            single_env,
            Game,
            MOVE,
            RED | {"policies": {"player_red": RULE}},
            OptionValueError,
            "policies",
        ),
        # Of a point all of whose agents a policy answers, none is left.
        (
            single_env,
            Game,
            MOVE,
            RED | {"policies": {f"{PLACE}.move": RULE}},
            UnknownPointError,
            "no decision point",
        ),
    ],
)
def test_single_env_refuses_invalid_uses_of_the_agent_option(
    make, simulation, points, options, error, match
):
    with pytest.raises(error, match=match):
        make(simulation, points, **options)


def test_agent_option_works_in_generate_env_registration_and_vector_env():
    alone = episode(single_env(Game, MOVE, agent="player_blue"))
    made = generate_env(Game, MOVE, agent="player_blue")
    assert episode(made()) == alone
    assert (
        episode(generate_env(Game, MOVE, view="single", agent="player_red")(agent="player_blue"))
        == alone
    )
    ids = register_simulation(Game, MOVE, name="one-agent", agent="player_blue")
    assert "one-agent/Move-v0" in ids
    assert episode(gymnasium.make("one-agent/Move-v0")) == alone


# -- skip_forced= ---------------------------------------------------------------------------------


def test_skip_forced_adds_up_rewards_and_times_of_skipped_decisions():
    steps, _ = episode(single_env(Game, MOVE, agent="player_red"))
    env = single_env(Game, MOVE, agent="player_red", skip_forced=True)
    skipped, offers = episode(env)
    assert offers == [3, 2]
    rewards = [step[1] for step in steps]
    assert [step[1] for step in skipped] == [sum(rewards[:3]), sum(rewards[3:])]
    assert moves_of(env, "player_red") == [1] * 6
    env.reset()
    assert [env.step(0)[-1]["elapsed"] for _ in range(2)] == [40.0, 60.0]


def test_skip_forced_asks_no_policy_if_only_one_action_is_legal():
    asked = []

    def policy(observation, info):
        asked.append(int(info["action_mask"].sum()))
        return 0

    def batched(observations, infos):
        return np.array([policy(None, info) for info in infos])

    simulate(Game, {f"{PLACE}.move": policy}, points=MOVE, skip_forced=True)
    assert asked == [3, 3, 2, 2]
    asked.clear()
    (made,) = collect_episodes(
        Game, {f"{PLACE}.move": batched}, seeds=[0], points=MOVE, skip_forced=True
    ).values()
    assert sorted(asked) == [2, 2, 3, 3]
    assert len(made.actions) == 4
    # Each player is paid what it has after each move but the first, and forced moves are paid with
    # the next.
    assert made.rewards.sum() == 2 * sum(range(1, 7))


def test_parallel_env_with_skip_forced_keeps_actions_of_skipped_decisions():
    env, joint = parallel_env(Game, MOVE, **ROSTER), joint_env(Game, MOVE, **ROSTER)
    env.reset(seed=0)
    joint.reset(seed=0)
    for ended in (False, True):
        *_, terminations, _, infos = env.step(zeros())
        assert terminations == dict.fromkeys(NAMES, ended)
        assert {name: info["acted"] for name, info in infos.items()} == dict.fromkeys(NAMES, True)
        assert joint.step(zeros())[2] == ended
    assert [move for _, move in env.simulation.log] == [1] * 12


@pytest.mark.parametrize(
    ("changes", "asked", "moves"),
    [
        ({"action_space": spaces.Discrete(1, start=4), "action_space_mapping": int}, [], [4] * 6),
        (
            {
                "action_space": spaces.MultiDiscrete([2, 3], start=[0, 5]),
                "action_space_mapping": lambda action: int(action.sum()),
                "action_mask_mapping": lambda player, moves: (
                    [0, 1],
                    [0, 0, 1] if len(moves) == 1 else [1, 0, 1],
                ),
            },
            [np.array([1, 5])],
            [8, 6, 8],
        ),
    ],
    ids=["a space of one action", "several parts"],
)
def test_skip_forced_works_with_masks_instead_of_choices(changes, asked, moves):
    points = {f"{PLACE}.move": definition(choices=None, **changes)}
    env = begun(single_env(Game, points, agent="player_red", skip_forced=True), 0)
    for action in asked:
        env.step(action)
    assert moves_of(env, "player_red") == moves


def test_skip_forced_episode_without_a_choice_ends_at_the_first_step():
    env = single_env(Forced, MOVE, agent="player_red", skip_forced=True)
    for _ in range(2):
        observation, _ = env.reset(seed=0)
        assert observation == [2]
        assert env.step(0)[:4] == (np.array([2.0]), 2 + 1, True, False)
        with pytest.raises(EpisodeOverError):
            env.step(0)
    aec = aec_env(Forced, MOVE, skip_forced=True)
    assert {turn.agent: turn[2:5] for turn in play(aec)} == dict.fromkeys(NAMES, (3.0, True, False))
    with pytest.raises(EpisodeOverError):
        aec.step(0)
    parallel = begun(parallel_env(Forced, MOVE, **ROSTER), 0)
    assert parallel.agents == list(NAMES)
    assert parallel.step(zeros())[2] == dict.fromkeys(NAMES, True)
    actions = np.zeros(2, np.int64)
    for options, action, reward in (
        (RED | {"skip_forced": True}, actions, 3.0),
        (ROSTER | {"view": "joint"}, dict.fromkeys(NAMES, actions), 4.0),
    ):
        vector = begun(vector_env(Forced, MOVE, num_envs=2, **options), 0)
        for ended in (True, False, True):
            _, rewards, terminations, *_ = vector.step(action)
            assert terminations.tolist() == [ended] * 2
            assert rewards.tolist() == [reward * ended] * 2
        vector.close()


# -- clip_actions= --------------------------------------------------------------------------------

BOX = spaces.Box(np.array([-1.0, 0.0], np.float32), np.array([1.0, np.inf], np.float32))
CAR = spaces.Dict(gas=BOX, gear=spaces.Tuple([spaces.Discrete(3), spaces.Box(0, 1)]))


def flown(make, space, action, *, clip_actions=True):
    """The argument of the mapping of agent ``pilot``, or of the last one among several."""
    taken = []
    fly = decision(agent="pilot", action_space=space, action_space_mapping=taken.append)
    env = begun(make(calling(fly), fly, clip_actions=clip_actions), 0)
    try:
        env.step({"pilot": action} if make in (parallel_env, joint_env) else action)
    except InvalidActionError:
        assert taken == []
        raise
    finally:
        env.close()
    return taken[-1]


@EVERY_VIEW
@pytest.mark.parametrize(
    ("space", "action", "expected"),
    [
        (BOX, np.array([-7.5, 1e30]), np.float32([-1.0, 1e30])),
        (spaces.Box(0.25, 0.5, (1,), np.float32), 7, 0.5),
        (spaces.Box(0.25, 0.5, (1,), np.float32), -2.5, 0.25),
        (spaces.Box(0, 5, (1,), np.int8), np.array([300]), np.int8([5])),
        (
            CAR,
            {"gas": [9.5, -9], "gear": (2, np.float32([7]))},
            {"gas": np.float32([1, 0]), "gear": (2, np.float32([1]))},
        ),
    ],
)
def test_actions_outside_a_box_are_clipped_only_with_clip_actions(view, space, action, expected):
    taken = flown(view, space, action)
    assert same(taken, expected) or (type(taken) is float and taken == expected)
    with pytest.raises(InvalidActionError):
        flown(view, space, action, clip_actions=False)


@pytest.mark.parametrize(
    ("space", "wrong"),
    [
        *(
            (BOX, wrong)
            for wrong in (
                np.array([np.nan, 0.0]),
                np.array([5.0]),
                np.array(["a", "b"]),
                None,
                [[1, 2]],
            )
        ),
        (spaces.Box(0, 5, (1,), np.int8), np.array([2.5])),
        (CAR, {"gas": [9.5, -9], "gear": (3, np.float32([7]))}),
    ],
)
def test_clip_actions_refuses_actions_that_cannot_be_clipped(space, wrong):
    with pytest.raises(InvalidActionError):
        flown(single_env, space, wrong)


def test_vector_env_clips_actions_like_single_env():
    two = partial(vector_env, num_envs=2)
    action = np.array([-7.5, 1e30], np.float32)
    assert same(
        flown(two, BOX, np.stack([np.zeros(2, np.float32), action])), flown(single_env, BOX, action)
    )
    with pytest.raises(InvalidActionError):
        flown(two, BOX, np.array([[0, 0], [np.nan, 0]], np.float32))


# -- forced moves and ends ------------------------------------------------------------------------


def test_single_env_first_step_returns_rewards_earned_during_reset():
    """The first being has no choice and is out before the second one is asked."""
    program = (
        "0 acts, 0 health 1, 0 acts, 0 health 2, 0 leaves, 1 acts, 1 health 1, 1 acts, 1 health 2,"
        " 1 acts, 1 health 3"
    )
    points = beings(choices=lambda being: [1] if being.number == 0 else [1, 2])
    one = {"agent": "being_0", "skip_forced": True}
    both = {"possible_agents": ["being_0", "being_1"], "skip_forced": True}
    env = begun(parallel_env(life(program), points, **both), 1)
    assert sorted(env.agents) == ["being_0", "being_1"]
    _, rewards, terminations, _, _ = env.step({"being_0": 0, "being_1": 0})
    assert rewards == {"being_0": 2.0, "being_1": 1.0}
    assert terminations == {"being_0": True, "being_1": False}
    assert env.agents == ["being_1"]
    joint = begun(joint_env(life(program), points, **both), 1)
    assert joint.step({"being_0": 0, "being_1": 0})[1] == 3.0
    single = begun(single_env(life(program), points, **one), 1)
    assert single.step(0)[1:4] == (3.0, True, False)
    vector = begun(vector_env(life(program), points, num_envs=2, **one), 1)
    _, rewards, terminations, *_ = vector.step(np.zeros(2, np.int64))
    assert (rewards.tolist(), terminations.tolist()) == ([3.0, 3.0], [True, True])
    vector.close()


@pytest.mark.parametrize("policies", [None, {"being_1": lambda observation: 0}])
def test_single_env_terminates_with_its_agent_even_if_others_go_on(policies):
    program = life("0 acts, 0 health 2, 0 leaves, 1 acts, 1 acts")
    env = single_env(program, beings(), agent="being_0", policies=policies)
    for _ in range(2):
        env.reset(seed=1)
        assert env.step(1)[1:4] == (2.0, True, False)
        assert env.simulation.log == [1]  # the others might go on for ever
        with pytest.raises(EpisodeOverError):
            env.step(0)
