"""The single view of one named agent among many, and what it asks that agent."""

import copy
import pickle
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl import (
    RULE,
    SimulationInterface,
    aec_env,
    generate_env,
    joint_env,
    make_step,
    parallel_env,
    register_simulation,
    simulate,
    simulate_many,
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
from tests.worlds.counters import same

NAMES = ("player_red", "player_blue")
RED = {"agent": "player_red"}
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
    """Two players, turn by turn; how many moves are offered depends on the round. Each episode has six rounds."""

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


class Forced(Game):
    """Offers one move only."""

    offers = (1, 1)


def watch(player, moves):
    return [player.coins]


def offered(player, moves):
    return moves


def pay(player, moves):
    return player.coins


def name(player, moves):
    return player.name


def definition(**changes):
    given = {
        "observation_space": spaces.Box(0, 100, (1,), np.float64),
        "observation_space_mapping": watch,
        "action_space": spaces.Discrete(3),
        "choices": offered,
        "reward_mapping": pay,
        "agent": name,
    }
    return make_step(**given | changes)


MOVE = {f"{PLACE}.move": definition()}


class Casino(Game):
    """Two players, who bet and move, in one round."""

    def run(self):
        for player in self.players:
            self.log.append((player.bet([5, 6]), player.move([1, 2])))


NAMED = {f"{PLACE}.move": definition(agent="mover"), f"{PLACE}.bet": definition(agent="better")}


def episode(env, choose=lambda info: 0):
    """Play an episode of a Gymnasium environment; what each step has returned but for the info, and the offers."""
    observation, info = env.reset(seed=3)
    steps, offers = [], [int(info["action_mask"].sum())]
    while True:
        observation, reward, terminated, truncated, info = env.step(choose(info))
        steps.append((observation.item(), reward, terminated, truncated))
        if terminated or truncated:
            return steps, offers
        offers.append(int(info["action_mask"].sum()))


# -- agent= ---------------------------------------------------------------------------------------


def test_one_named_agent_is_asked_and_all_others_are_left_to_their_rule() -> None:
    env = single_env(Game, MOVE, agent="player_red")
    steps, offers = episode(env)
    assert offers == [1, 3, 1, 2, 1, 1]
    assert [step[0] for step in steps] == [1, 2, 3, 4, 5, 6]
    assert steps[-1][2:] == (True, False)
    assert [move for name, move in env.simulation.log if name == "player_blue"] == [1, 3, 1, 2, 1, 1]
    with pytest.raises(EpisodeOverError):
        env.step(0)


def test_the_others_are_left_to_policies_by_agent() -> None:
    env = single_env(Game, MOVE, agent="player_red", policies={"player_blue": lambda observation: 0})
    episode(env)
    assert [move for name, move in env.simulation.log if name == "player_blue"] == [1] * 6


def test_an_agent_with_a_name_of_its_own_is_one_of_several_points() -> None:
    env = single_env(Casino, NAMED, agent="mover")
    env.reset(seed=0)
    while not env.step(0)[2]:
        pass
    assert env.simulation.log == [(5, 1), (5, 1)]


def test_of_points_that_name_their_agents_a_roster_tells_whose_it_is() -> None:
    named = {
        f"{PLACE}.move": definition(),
        f"{PLACE}.bet": definition(agent=lambda player, moves: f"{player.name}_bet"),
    }

    with pytest.raises(AgentError, match="possible_agents"):
        single_env(Casino, named, agent="player_red")
    roster = {f"{PLACE}.move": NAMES, f"{PLACE}.bet": [f"{name}_bet" for name in NAMES]}
    env = single_env(Casino, named, agent="player_red_bet", possible_agents=roster)
    env.reset(seed=0)
    assert env.step(1)[2]
    assert env.simulation.log == [(6, 2), (5, 2)]


def test_an_agent_that_never_decides_is_an_error_that_lists_who_did() -> None:
    with pytest.raises(NoDecisionError, match=r"'player_green'.*player_red, player_blue"):
        single_env(Game, MOVE, agent="player_green").reset()


@pytest.mark.parametrize(
    ("make", "simulation", "points", "options", "error", "match"),
    [
        (single_env, Game, MOVE, {}, ViewError, "agent="),
        (single_env, Casino, NAMED, {}, ViewError, "agent="),
        (single_env, Casino, NAMED, {"agent": "mvoer"}, AgentError, "mover, better"),
        *((single_env, Game, MOVE, {"agent": agent}, OptionValueError, "agent") for agent in ("", 3, ("player_red",))),
        *(
            (make, Game, MOVE, {"agent": "player_red"}, UnknownOptionError, "single view")
            for make in (aec_env, parallel_env, joint_env)
        ),
        (
            lambda game, points, **options: simulate(game, points=points, **options),
            Game,
            MOVE,
            {"agent": "player_red"},
            UnknownOptionError,
            "single_env",
        ),
        (single_env, Game, MOVE, RED | {"policies": {"player_red": RULE}}, OptionValueError, "policies"),
        # Of a point all of whose agents a policy answers, none is left.
        (single_env, Game, MOVE, RED | {"policies": {f"{PLACE}.move": RULE}}, UnknownPointError, "no decision point"),
    ],
)
def test_only_the_single_view_takes_an_agent_and_needs_one_of_many(
    make, simulation, points, options, error, match
) -> None:
    with pytest.raises(error, match=match):
        make(simulation, points, **options)


def test_all_that_makes_single_views_takes_the_name_of_the_agent() -> None:
    alone = episode(single_env(Game, MOVE, agent="player_blue"))
    made = generate_env(Game, MOVE, agent="player_blue")
    assert episode(made()) == alone
    assert episode(generate_env(Game, MOVE, view="single", agent="player_red")(agent="player_blue")) == alone
    ids = register_simulation(Game, MOVE, name="one-agent", agent="player_blue")
    assert "one-agent/Move-v0" in ids
    assert episode(gymnasium.make("one-agent/Move-v0")) == alone
    env = made()
    for again in (copy.deepcopy(env), pickle.loads(pickle.dumps(env.unwrapped))):
        assert episode(again) == alone


@pytest.mark.parametrize("workers", [0, 1])
def test_the_vector_view_of_one_agent_is_many_single_views(workers) -> None:
    env = vector_env(Game, MOVE, agent="player_red", num_envs=2, workers=workers, context="fork" if workers else None)
    env.reset(seed=3)
    single, _ = episode(single_env(Game, MOVE, agent="player_red"))
    for observation, reward, terminated, _ in single:
        observations, rewards, terminations, _, _ = env.step(np.zeros(2, np.int64))
        assert observations.ravel().tolist() == [observation] * 2
        assert rewards.tolist() == [reward] * 2
        assert terminations.tolist() == [terminated] * 2
    env.close()


# -- skip_forced= ---------------------------------------------------------------------------------


def test_forced_moves_are_not_asked_for_and_their_rewards_add_up() -> None:
    steps, _ = episode(single_env(Game, MOVE, agent="player_red"))
    env = single_env(Game, MOVE, agent="player_red", skip_forced=True)
    skipped, offers = episode(env)
    assert offers == [3, 2]
    rewards = [step[1] for step in steps]
    assert [step[1] for step in skipped] == [sum(rewards[:3]), sum(rewards[3:])]
    assert [move for name, move in env.simulation.log if name == "player_red"] == [1] * 6


def test_nobody_is_asked_for_a_forced_move_not_even_a_policy() -> None:
    asked = []

    def policy(observation, info):
        asked.append(int(info["action_mask"].sum()))
        return 0

    def batched(observations, infos):
        asked.extend(int(info["action_mask"].sum()) for info in infos)
        return np.zeros(len(infos), np.int64)

    simulate(Game, {f"{PLACE}.move": policy}, points=MOVE, skip_forced=True)
    assert asked == [3, 3, 2, 2]
    asked.clear()
    simulate_many(Game, {f"{PLACE}.move": batched}, seeds=[0, 1], points=MOVE, skip_forced=True)
    assert sorted(asked) == [2, 2, 2, 2, 3, 3, 3, 3]


def test_trajectories_have_no_forced_moves_and_all_rewards() -> None:
    def collected(**options):
        policies = {f"{PLACE}.move": lambda observations: np.zeros(len(observations), np.int64)}
        (made,) = collect_episodes(Game, policies, seeds=[0], points=MOVE, **options).values()
        return made

    every, chosen = collected(), collected(skip_forced=True)
    assert len(chosen.actions) == 4
    assert chosen.rewards.sum() == every.rewards.sum()


@pytest.mark.parametrize("make", [parallel_env, joint_env])
def test_in_rounds_forced_moves_use_no_action(make) -> None:
    env = make(Game, MOVE, possible_agents=list(NAMES), skip_forced=True)
    env.reset(seed=0)
    rounds = 0
    ended = False
    while not ended:
        *_, terminations, _, infos = env.step(dict.fromkeys(NAMES, 0))
        acted = infos["acted"] if make is joint_env else {name: infos[name]["acted"] for name in NAMES}
        assert all(acted.values())
        ended = terminations if make is joint_env else all(terminations.values())
        rounds += 1
    assert rounds == 2
    assert [move for _, move in env.unwrapped.simulation.log] == [1] * 12


def test_a_space_of_one_action_is_a_forced_move_too() -> None:
    one = spaces.Discrete(1, start=4)
    points = {f"{PLACE}.move": definition(action_space=one, choices=None, action_space_mapping=lambda action: action)}
    env = single_env(Game, points, agent="player_red", skip_forced=True)
    env.reset(seed=0)
    assert [move for name, move in env.simulation.log if name == "player_red"] == [4] * 6


def test_a_forced_move_of_several_parts() -> None:
    made = definition(
        action_space=spaces.MultiDiscrete([2, 3], start=[0, 5]),
        choices=None,
        action_space_mapping=lambda action: int(action.sum()),
        action_mask_mapping=lambda player, moves: ([0, 1], [0, 0, 1] if len(moves) == 1 else [1, 0, 1]),
    )
    env = single_env(Game, {f"{PLACE}.move": made}, agent="player_red", skip_forced=True)
    env.reset(seed=0)
    assert env.simulation.log[0] == ("player_red", 8)
    env.step(np.array([1, 5]))
    assert [move for name, move in env.simulation.log if name == "player_red"][:3] == [8, 6, 8]


def test_an_episode_of_forced_moves_alone_is_told_at_the_first_step() -> None:
    env = single_env(Forced, MOVE, agent="player_red", skip_forced=True)
    for _ in range(2):
        observation, _ = env.reset(seed=0)
        assert observation == [2]
        assert env.step(0)[:4] == (np.array([2.0]), 2 + 1, True, False)
        with pytest.raises(EpisodeOverError):
            env.step(0)
    aec = aec_env(Forced, MOVE, skip_forced=True)
    aec.reset(seed=0)
    told = {}
    for agent in aec.agent_iter():
        told[agent] = aec.last()[1:4]
        aec.step(None)
    assert told == dict.fromkeys(NAMES, (3.0, True, False))
    with pytest.raises(EpisodeOverError):
        aec.step(0)
    parallel = parallel_env(Forced, MOVE, skip_forced=True, possible_agents=list(NAMES))
    parallel.reset(seed=0)
    assert parallel.agents == list(NAMES)
    assert parallel.step(dict.fromkeys(NAMES, 0))[2] == dict.fromkeys(NAMES, True)
    actions = np.zeros(2, np.int64)
    for options, action, reward in (
        (RED, actions, 3.0),
        ({"view": "joint", "possible_agents": list(NAMES)}, dict.fromkeys(NAMES, actions), 4.0),
    ):
        vector = vector_env(Forced, MOVE, skip_forced=True, num_envs=2, **options)
        vector.reset(seed=0)
        for ended in (True, False, True):
            _, rewards, terminations, *_ = vector.step(action)
            assert terminations.tolist() == [ended] * 2
            assert rewards.tolist() == [reward * ended] * 2
        vector.close()


def test_an_episode_without_any_decision_still_is_an_error() -> None:
    class Nothing(Game):
        offers = ()

    with pytest.raises(NoDecisionError):
        single_env(Nothing, MOVE, agent="player_red", skip_forced=True).reset()


# -- clip_actions= --------------------------------------------------------------------------------

BOX = spaces.Box(np.array([-1.0, 0.0], np.float32), np.array([1.0, np.inf], np.float32))


def flown(make, space, action, **options):
    """What reaches the mapping of an agent called ``pilot``."""
    taken = []

    def mapping(action):
        taken.append(action)
        return 0

    made = definition(action_space=space, choices=None, action_space_mapping=mapping, agent="pilot")
    env = make(Game, {f"{PLACE}.move": made}, **options)
    env.reset(seed=0)
    env.step({"pilot": action} if make in (parallel_env, joint_env) else action)
    return taken[0]


ONE, HALF = spaces.Box(-1, 1, (1,), np.float32), spaces.Box(0.25, 0.5, (1,), np.float32)
WHOLE = spaces.Box(0, 5, (1,), np.int8)
CAR = spaces.Dict(gas=BOX, gear=spaces.Tuple([spaces.Discrete(3), spaces.Box(0, 1)]))


@pytest.mark.parametrize("make", [aec_env, parallel_env, joint_env, single_env])
@pytest.mark.parametrize(
    ("space", "action", "expected"),
    [
        (BOX, np.array([-7.5, 1e30]), np.float32([-1.0, 1e30])),
        (ONE, 3.5, 1.0),
        (ONE, -2, -1),
        (HALF, 7, 0.5),
        (HALF, 0, 0.25),
        (WHOLE, np.array([300]), np.int8([5])),
        (
            CAR,
            {"gas": [9.5, -9], "gear": (2, np.float32([7]))},
            {"gas": np.float32([1, 0]), "gear": (2, np.float32([1]))},
        ),
    ],
)
def test_actions_outside_a_box_are_clipped(make, space, action, expected) -> None:
    taken = flown(make, space, action, clip_actions=True)
    assert same(taken, expected) or (type(taken) is float and taken == expected)


@pytest.mark.parametrize("make", [aec_env, parallel_env, joint_env, single_env])
@pytest.mark.parametrize(
    ("space", "wrong"),
    [
        *((BOX, wrong) for wrong in (np.array([np.nan, 0.0]), np.array([5.0]), np.array(["a", "b"]), None, [[1, 2]])),
        (WHOLE, np.array([2.5])),
        (CAR, {"gas": [9.5, -9], "gear": (3, np.float32([7]))}),
    ],
)
def test_what_is_no_action_is_refused_all_the_same(make, space, wrong) -> None:
    with pytest.raises(InvalidActionError):
        flown(make, space, wrong, clip_actions=True)


def test_without_the_option_nothing_is_clipped() -> None:
    with pytest.raises(InvalidActionError):
        flown(single_env, BOX, np.array([-7.5, 1.0]))


@given(st.lists(st.floats(width=32), min_size=2, max_size=2))
def test_the_vector_view_clips_as_the_single_view_does(numbers) -> None:
    action = np.array(numbers, np.float32)
    taken = []
    made = definition(
        action_space=BOX, choices=None, action_space_mapping=lambda action: taken.append(action) or 0, agent="pilot"
    )
    env = vector_env(Game, {f"{PLACE}.move": made}, num_envs=2, clip_actions=True)
    env.reset(seed=0)
    if np.isnan(action).any():
        with pytest.raises(InvalidActionError):
            env.step(np.stack([np.zeros(2, np.float32), action]))
        assert taken == []
    else:
        env.step(np.stack([np.zeros(2, np.float32), action]))
        assert same(taken, [np.zeros(2, np.float32), flown(single_env, BOX, action, clip_actions=True)])
    env.close()


# -- forced moves and ends ------------------------------------------------------------------------


class Seats(Game, SimulationInterface):
    """Red has no choice and is out before blue is asked; blue plays on for as long as it is let."""

    offers = (1, 1)
    days = 3

    def reset(self, seed=None):
        super().reset(seed)
        self.now = 0.0

    def time(self):
        return self.now

    def run(self):
        red, blue = self.players
        for _ in self.offers:
            red.coins += red.move([1])
            self.now += 10
        self.end_agent("player_red")
        for _ in range(self.days):
            blue.coins += blue.move([1, 2])
            self.now += 10


class Endless(Game, SimulationInterface):
    """Red is out after its first move, and the others go on for ever."""

    def run(self):
        self.players[0].move([1, 2])
        self.end_agent("player_red")
        while True:
            self.players[1].move([1, 2])


class Pauses(Game):
    """The same choices as the game's, at a time each."""

    now = 0.0

    def reset(self, seed=None):
        super().reset(seed)
        self.now = 0.0

    def time(self):
        return self.now

    def run(self):
        for offered in (2, 1, 1, 2, 1):
            self.players[0].move([1, 2][:offered])
            self.players[0].coins += 1
            self.now += 10


def test_rewards_of_agents_that_end_during_the_reset_come_with_the_first_round() -> None:
    roster = {"possible_agents": list(NAMES), "skip_forced": True}
    env = parallel_env(Seats, MOVE, **roster)
    env.reset(seed=1)
    assert sorted(env.agents) == sorted(NAMES)
    _, rewards, terminations, _, _ = env.step(dict.fromkeys(NAMES, 0))
    assert rewards == {"player_red": 2.0, "player_blue": 1.0}
    assert terminations == {"player_red": True, "player_blue": False}
    assert env.agents == ["player_blue"]
    joint = joint_env(Seats, MOVE, **roster)
    joint.reset(seed=1)
    assert joint.step(dict.fromkeys(NAMES, 0))[1] == 3.0

    class Short(Seats):
        days = 0

    env = parallel_env(Short, MOVE, **roster)
    env.reset(seed=1)
    assert env.step(dict.fromkeys(env.agents, 0))[1]["player_red"] == 2.0


def test_the_single_view_of_an_agent_that_ends_during_the_reset() -> None:
    env = single_env(Seats, MOVE, agent="player_red", skip_forced=True)
    for _ in range(2):
        env.reset(seed=1)
        assert env.step(0)[1:4] == (3.0, True, False)
    vector = vector_env(Seats, MOVE, agent="player_red", skip_forced=True, num_envs=2)
    vector.reset(seed=1)
    assert vector.step(np.zeros(2, np.int64))[1:3] == (pytest.approx([3.0, 3.0]), pytest.approx([True, True]))
    vector.close()


def test_elapsed_time_adds_up_as_rewards_do() -> None:
    env = single_env(Pauses, MOVE, agent="player_red", skip_forced=True)
    env.reset(seed=1)
    told = [env.step(0) for _ in range(2)]
    assert [step[1] for step in told] == [6.0, 9.0]
    assert [step[-1]["elapsed"] for step in told] == [30.0, 20.0]


def test_the_episode_is_over_once_its_one_agent_has_ended_whatever_the_others_do() -> None:
    env = single_env(Endless, MOVE, agent="player_red")
    for _ in range(2):
        env.reset(seed=1)
        assert env.step(0)[2:4] == (True, False)
        with pytest.raises(EpisodeOverError):
            env.step(0)
    env = single_env(Endless, MOVE, agent="player_red", policies={"player_blue": lambda observation: 0})
    env.reset(seed=1)
    assert env.step(0)[2]


def test_names_of_a_roster_and_of_policies_that_agent_leaves_to_the_rule() -> None:
    env = single_env(Casino, NAMED, agent="mover", possible_agents=["mover", "better"], policies={"better": RULE})
    env.reset(seed=1)
    env.step(0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert env.step(0)[2]
