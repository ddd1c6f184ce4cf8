"""Random simulations under random use, compared with what was computed without the library."""

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simenv_marl import RULE, aec_env
from simenv_marl.errors import EpisodeOverError, ResetNeededError
from tests.worlds.models import notes
from tests.worlds.worlds import Design, FuseError, Reference, World, advised, answers, designs, legal, points_of, seeds


def made(design: Design, make: Any = aec_env, points: Any = None) -> Any:
    """An environment of a design."""
    points = points or points_of(design)
    policies = {points[point]: advised for point in design.policies} | {points[point]: RULE for point in design.rules}
    return make(lambda: World(design, points), points, policies=policies or None, max_steps=design.max_steps)


def agrees(env: Any, reference: Reference) -> None:
    """An AEC environment that stands where the reference does says what the reference says."""
    assert env.unwrapped.simulation.trace[: len(reference.trace)] == reference.trace
    if reference.ends is None:
        told = reference.turns[-1]
        assert env.agent_selection == told.agent
        observation, reward, terminated, truncated, _ = env.last()
        assert (observation.tolist(), reward, terminated, truncated) == (told.observation, told.reward, False, False)
        assert type(reward) is float
        return
    flags = (not reference.truncated, reference.truncated)
    seen = set()
    for agent in env.agent_iter():
        observation, reward, terminated, truncated, _ = env.last()
        assert (terminated, truncated) == flags
        assert agent not in seen
        seen.add(agent)
        if agent in reference.ends:
            told = reference.ends[agent]
            assert (observation.tolist(), reward) == (told.observation, told.reward)
        else:
            assert reward == 0.0
        env.step(None)
    assert seen >= set(reference.ends)
    assert env.agents == []


def turns_of(env: Any, seed: int, given_answers: list[Any]) -> Any:
    """All that an episode says, turn by turn."""
    env.reset(seed=seed)
    given_answers = iter(given_answers)
    for agent in env.agent_iter():
        observation, reward, terminated, truncated, info = env.last()
        ended = terminated or truncated
        yield agent, observation.tolist(), reward, terminated, truncated, sorted(info)
        env.step(None if ended else legal(next(given_answers), info))


@given(designs(), seeds, answers)
@settings(max_examples=300)
def test_an_episode_is_what_was_computed_without_the_library(design, seed, given_answers):
    """Also the rewards that each step books: none is lost or counted twice."""
    env = made(design)
    booked: dict[str, float] = {}
    try:
        env.reset(seed=seed)
        used: list[Any] = []
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
    finally:
        env.close()


@given(designs(), st.integers(1, 60), seeds, answers)
@settings(max_examples=150)
def test_an_error_anywhere_surfaces_and_the_next_episode_is_complete(design, fuse, seed, given_answers):
    env = made(design)
    fresh = list(turns_of(env, seed, given_answers))
    world = env.unwrapped.simulation
    world.fuse = fuse
    told: list[Any] = []
    raised = None
    try:
        told.extend(turns_of(env, seed, given_answers))
    except FuseError as error:
        raised = error
    if raised is None:
        assert told == fresh
    else:
        assert str(seed) in notes(raised)
        assert world.trace[-1] == "over"
        with pytest.raises(ResetNeededError, match="call reset"):
            env.step(0)
    world.fuse = None
    assert list(turns_of(env, seed, given_answers)) == fresh
