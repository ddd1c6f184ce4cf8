"""Games that go on from the files of episodes."""

import random

import pytest

from simenv_marl import (
    RULE,
    aec_env,
    clone,
    joint_env,
    load_episode,
    parallel_env,
    save_episode,
    single_env,
    turn_env,
)
from simenv_marl.errors import EpisodeFileError
from simenv_marl.seats.play.host import Rules
from simenv_marl.seats.play.start import open_game
from tests.files.test_episodes import Reseeded
from tests.worlds.random_worlds import HERE as YARDS
from tests.worlds.random_worlds import YARD_POINTS, Yard, yard_outcome, yard_policy
from tests.worlds.saved import (
    VANS,
    YARD,
    Depot,
    Pumps,
    cases,
    mid_episode,
    move,
    pushing,
    save,
    steady,
)


def open_at(path, until=None):
    game, _ = open_game(path, until, Rules(""))
    return game


def state_of(simulation):
    """Return what two simulations have alike."""
    if isinstance(simulation, Yard):
        return yard_outcome(simulation)
    parts = {**vars(simulation)}
    chance = parts.pop("random")
    state = chance.getstate() if isinstance(chance, random.Random) else chance.bit_generator.state
    return repr((parts, state))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("make", "simulation", "points", "options"),
    [
        (aec_env, YARD, YARD_POINTS, {}),
        (aec_env, YARD, YARD_POINTS, {"policies": {f"{YARDS}.Machine.load": yard_policy}}),
        (parallel_env, YARD, YARD_POINTS, {}),
        (parallel_env, YARD, YARD_POINTS, {"policies": {"planner": yard_policy}}),
        (turn_env, YARD, YARD_POINTS, {"flatten": True}),
        (single_env, YARD, YARD_POINTS, {"agent": "planner"}),
        (aec_env, Depot, VANS, {"policies": {"van_1": pushing, "van_0": RULE}}),
        (turn_env, Depot, VANS, {"skip_forced": True}),
        (parallel_env, Depot, VANS, {}),
        (joint_env, Pumps, None, {"flatten": True}),
        (single_env, Pumps, None, {"agent": "push", "policies": {"pull": steady}}),
    ],
)
def test_play_opens_an_episode_file_at_its_decision(make, simulation, points, options, tmp_path):
    env = mid_episode(make, simulation, points, **options)
    save_episode(env, tmp_path / "a")
    game = open_at(tmp_path / "a")
    pending = env.unwrapped.episode.pending
    assert game.now["agent"] == pending.name
    assert state_of(game.root.simulation) == state_of(env.unwrapped.simulation)
    turn = game.turn
    game.decide(None, "rule")
    game.jump(0)
    game.jump(turn)
    game.close()


def test_play_opens_an_episode_file_after_a_given_number_of_decisions(tmp_path):
    save_episode(mid_episode(), tmp_path / "a")
    game = open_at(tmp_path / "a", until=3)
    env = mid_episode(taken=3)
    assert (game.turn, game.now["agent"]) == (3, env.agent_selection)
    assert state_of(game.root.simulation) == state_of(env.simulation)
    game.close()


@pytest.mark.parametrize("make", [aec_env, parallel_env, joint_env])
def test_play_opens_a_finished_episode_file_at_its_end(make, tmp_path):
    env = mid_episode(make, Pumps, None, taken=0)
    while not env.unwrapped.episode.over:
        move(env, random.Random(1))
    save_episode(env, tmp_path / "a")
    game = open_at(tmp_path / "a")
    assert (game.over, game.now) == ("terminated", None)
    assert state_of(game.root.simulation) == state_of(env.unwrapped.simulation)
    game.close()


def test_play_keeps_the_reset_options_of_an_opened_file(tmp_path):
    env = aec_env(Pumps, max_steps=3)
    env.reset(seed=1, options={"level": [4, 5]})
    env.step(RULE)
    save_episode(env, tmp_path / "a")
    game = open_at(tmp_path / "a")
    assert state_of(game.root.simulation) == state_of(env.simulation)
    for _ in range(2):
        game.decide(None, "rule")
    assert game.over == "truncated"
    game.close()


def test_play_refuses_the_episode_file_of_a_reseeded_clone(tmp_path):
    env = mid_episode(aec_env, Reseeded, None, taken=2)
    save_episode(clone(env, seed=5), tmp_path / "a")
    with pytest.raises(EpisodeFileError, match="drawn anew"):
        open_at(tmp_path / "a")


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("seed", range(0, 60, 20))
def test_play_opens_episode_files_of_random_models_at_their_decision(seed, tmp_path):
    for number in range(seed, seed + 20):
        case = cases(random.Random(number))
        if case.given is not dict:  # it has no name
            continue
        save(case, number, tmp_path / "a")
        env = load_episode(tmp_path / "a").unwrapped
        game = open_at(tmp_path / "a")
        pending = env.episode.pending
        assert (game.now or {}).get("agent") == (None if pending is None else pending.name)
        assert state_of(game.root.simulation) == state_of(env.simulation)
        game.close()
