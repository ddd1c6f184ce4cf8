"""Random simulations under random use, compared with what was computed without the library."""

from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simenv_marl import RULE, aec_env, parallel_env, single_env
from simenv_marl.errors import EpisodeOverError, ResetNeededError
from tests.worlds.models import follow_the_rule, notes
from tests.worlds.worlds import (
    Design,
    FuseError,
    Reference,
    World,
    advised,
    agent_of,
    answers,
    designs,
    legal,
    points_of,
    seeds,
)


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


@given(designs(), seeds)
@settings(max_examples=150)
def test_with_rule_throughout_it_is_the_plain_run(design, seed):
    open_ended = replace(design, max_steps=None, policies=frozenset())
    plain = World(open_ended, points_of(open_ended))
    plain.reset(seed)
    plain.run()
    for make in (aec_env, parallel_env):
        simulation = follow_the_rule(made(open_ended, make), seed)
        assert simulation.trace == plain.trace
        assert simulation.random.getstate() == plain.random.getstate()


@given(designs(), seeds, answers)
@settings(max_examples=150)
def test_the_single_view_tells_the_same(design, seed, given_answers):
    only = next(point for point in design.active)
    if agent_of(design.kinds[only], only, 0) != agent_of(design.kinds[only], only, 1):
        return
    rules = frozenset(range(len(design.kinds))) - {only}
    if not any(point == only for point, _ in design.program):
        return
    design = replace(design, rules=rules, policies=frozenset())
    aec, single = made(design), made(design, single_env)
    aec.reset(seed=seed)
    observation, info = single.reset(seed=seed)
    told = (0.0, False, False)
    for given_answer in given_answers:
        expected = aec.last()
        assert observation.tolist() == expected[0].tolist()
        assert told == expected[1:4]
        if told[1] or told[2]:
            break
        action = legal(given_answer, info)
        observation, *told, info = single.step(action)
        told = tuple(told)
        aec.step(action)
    assert single.unwrapped.simulation.trace == aec.unwrapped.simulation.trace
    aec.close()
    single.close()


@given(designs(), st.integers(1, 60), seeds, answers)
@settings(max_examples=150)
def test_an_error_anywhere_surfaces_and_the_next_episode_is_as_ever(design, fuse, seed, given_answers):
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
