"""Random simulations under random use, compared with what was computed without the library."""

import gc
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, consumes, initialize, invariant, rule

from simenv_marl import RULE, aec_env, parallel_env, single_env
from simenv_marl.errors import EpisodeOverError, InvalidActionError, ResetNeededError
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


# -- one episode ----------------------------------------------------------------------------------


@given(designs(), seeds, answers)
@settings(max_examples=300)
def test_an_episode_is_what_was_computed_without_the_library(design, seed, given_answers):
    env = made(design)
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
def test_no_reward_is_lost_or_counted_twice(design, seed, given_answers):
    env = made(design)
    env.reset(seed=seed)
    told: dict[str, float] = {}
    booked: dict[str, float] = {}
    used = []
    for agent in env.agent_iter():
        _, reward, terminated, truncated, info = env.last()
        assert type(reward) is float
        told[agent] = told.get(agent, 0.0) + reward
        if terminated or truncated:
            env.step(None)
            continue
        used.append(given_answers[len(used)])
        env.step(legal(used[-1], info))
        for name, value in env.rewards.items():
            assert type(value) is float
            booked[name] = booked.get(name, 0.0) + value
    reference = Reference(design, seed, used)
    due = dict.fromkeys(told, 0.0)
    for turn in [*reference.turns, *reference.ends.values()]:
        due[turn.agent] += turn.reward
    assert told == booked == due
    env.close()


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


# -- many episodes --------------------------------------------------------------------------------


@given(designs(), st.lists(st.tuples(seeds, answers, st.integers(0, 20), st.booleans()), max_size=4), seeds, answers)
@settings(max_examples=100)
def test_an_episode_replays_whatever_happened_before(design, disturbances, seed, given_answers):
    fresh = list(turns_of(made(design), seed, given_answers))
    env = made(design)
    for other_seed, others, steps, close in disturbances:
        for _, _ in zip(turns_of(env, other_seed, others), range(steps), strict=False):
            pass
        if close:
            env.close()
    assert list(turns_of(env, seed, given_answers)) == fresh
    assert list(turns_of(env, seed, given_answers)) == fresh


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


@given(st.lists(st.tuples(designs(), seeds, answers), min_size=2, max_size=4), st.booleans(), st.randoms())
@settings(max_examples=100)
def test_interleaved_is_as_separate(specifications, same_design, rng):
    if same_design:
        specifications = [(specifications[0][0], *rest) for _, *rest in specifications]
    separate = [list(turns_of(made(design), *others)) for design, *others in specifications]
    shared = {}  # environments of one design share its decision points
    episodes = []
    for design, *others in specifications:
        points = shared.setdefault(id(design), points_of(design))
        episodes.append(turns_of(made(design, points=points), *others))
    together = [[] for _ in episodes]
    running = list(range(len(episodes)))
    while running:
        number = rng.choice(running)
        try:
            together[number].append(next(episodes[number]))
        except StopIteration:
            running.remove(number)
    assert together == separate


class Use(RuleBasedStateMachine):
    """Environments of one design, used in any way; each must stand where its reference stands."""

    environments = Bundle("environments")

    @initialize(design=designs())
    def begin(self, design):
        self.design, self.points = design, points_of(design)
        self.states: dict[int, tuple[int, list[Any]] | None] = {}
        self.alive: dict[int, Any] = {}

    @rule(target=environments)
    def make(self):
        number = len(self.states)
        self.alive[number] = made(self.design, points=self.points)
        self.states[number] = None
        return number

    @rule(number=environments, seed=seeds)
    def reset(self, number, seed):
        self.alive[number].reset(seed=seed)
        self.states[number] = (seed, [])

    def pending(self, number):
        state = self.states[number]
        return state is not None and Reference(self.design, *state).ends is None

    @rule(number=environments, answer=st.integers(0, 9) | st.just(RULE))
    def step(self, number, answer):
        env = self.alive[number]
        if self.pending(number):
            self.states[number][1].append(answer)
            env.step(legal(answer, env.infos[env.agent_selection]))
        elif not env.agents:
            with pytest.raises(ResetNeededError, match="call reset"):
                env.step(1)

    @rule(number=environments, action=st.sampled_from([-1, 10, None, "1", 0.5, [1]]))
    def step_illegally(self, number, action):
        if self.pending(number):
            with pytest.raises(InvalidActionError, match="is not in its action space"):
                self.alive[number].step(action)

    @rule(number=environments)
    def deface(self, number):
        if self.pending(number):
            observation, *_, info = self.alive[number].last()
            observation[:] = -1
            for mask in info.values():
                mask[:] = mask

    @rule(number=environments)
    def close(self, number):
        self.alive[number].close()
        self.states[number] = None

    @rule(number=consumes(environments))
    def drop(self, number):
        trace = getattr(self.alive[number].unwrapped.simulation, "trace", None)
        suspended = self.pending(number)
        del self.alive[number], self.states[number]
        self.states[number] = None
        if suspended:
            assert trace[-1] == "over"

    @rule(seed=seeds)
    def run_the_plain_model(self, seed):
        open_ended = Design(self.design.kinds, self.design.program)
        plain = World(open_ended, self.points)
        plain.reset(seed)
        plain.run()
        everybody = Design(self.design.kinds, self.design.program, rules=frozenset(range(len(self.design.kinds))))
        assert plain.trace == [*Reference(everybody, seed, []).trace, "over"]

    @invariant()
    def all_stand_where_they_should(self):
        for number, env in getattr(self, "alive", {}).items():
            state = self.states[number]
            if state is None:
                continue
            reference = Reference(self.design, *state)
            if reference.ends is None or env.agents:
                agrees(env, reference)

    def teardown(self):
        self.alive = {}
        gc.collect()


Use.TestCase.settings = settings(max_examples=60, stateful_step_count=30)
TestUse = Use.TestCase
