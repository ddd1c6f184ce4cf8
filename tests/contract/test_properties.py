"""Random simulations, compared with what was computed without the library."""

import pytest
from hypothesis import given

from simenv_marl import aec_env
from simenv_marl.errors import EpisodeOverError
from tests.extent import examples
from tests.worlds.models import play
from tests.worlds.random_worlds import (
    Reference,
    World,
    answers,
    legal,
    points_of,
    seeds,
    world_designs,
    world_policies,
)


def made(design):
    """An environment of a design."""
    points = points_of(design)
    policies = world_policies(design, points)
    return aec_env(
        lambda: World(design, points), points, policies=policies, max_steps=design.max_steps
    )


def agrees(env, reference):
    """An AEC environment that stands where the reference does says what the reference says."""
    assert env.simulation.trace == reference.trace
    if reference.ends is None:
        told = reference.turns[-1]
        assert env.agent_selection == told.agent
        observation, reward, terminated, truncated, _ = env.last()
        assert (observation.tolist(), reward, terminated, truncated) == (
            told.observation,
            told.reward,
            False,
            False,
        )
        assert type(reward) is float
        return
    flags = (not reference.truncated, reference.truncated)
    ended = play(env, reset=False)
    assert len({turn.agent for turn in ended}) == len(ended)
    assert {(turn.terminated, turn.truncated) for turn in ended} == {flags}
    told = {turn.agent: (turn.observation.tolist(), turn.reward) for turn in ended}
    assert {agent: told.pop(agent) for agent in reference.ends} == {
        agent: (end.observation, end.reward) for agent, end in reference.ends.items()
    }
    assert all(reward == 0.0 for _, reward in told.values())
    assert env.agents == []


@given(world_designs(), seeds, answers)
@examples(300)
def test_aec_env_matches_a_reference_implementation_of_random_models(design, seed, given_answers):
    """Also the rewards that each step books: none is lost or counted twice."""
    env = made(design)
    booked = {}
    env.reset(seed=seed)
    used = []
    while True:
        reference = Reference(design, seed, used)
        agrees(env, reference)
        if reference.ends is not None:
            break
        used.append(given_answers[len(used)])
        env.step(legal(used[-1], env.infos[env.agent_selection]))
        for name, value in env.rewards.items():
            assert type(value) is float
            booked[name] = booked.get(name, 0.0) + value
    due = dict.fromkeys(booked, 0.0)
    for turn in [*reference.turns, *reference.ends.values()]:
        due[turn.agent] += turn.reward
    assert booked == due
    with pytest.raises(EpisodeOverError, match="begin the next one"):
        env.step(1)
    env.close()
