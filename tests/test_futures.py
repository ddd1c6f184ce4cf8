"""Branches with ``seeds=``: the same present, and the chance that lies ahead drawn anew."""

import os
import random
import sys
import types

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from simenv_marl import aec_env, branch, joint_env, parallel_env, reseed_generators, single_env
from simenv_marl.errors import BranchError, NotResetError, OptionValueError
from tests.core.test_global_rng import world
from tests.test_branch import METHODS, POINTS, move, rest_of, short
from tests.worlds.copied import Walk
from tests.worlds.exactness import advance, is_over, rest_of_yard
from tests.worlds.models import notes
from tests.worlds.random_worlds import POINTS as POINTS_OF_YARD
from tests.worlds.random_worlds import Yard, designs
from tests.worlds.random_worlds import seeds as yard_seeds

VIEWS = pytest.mark.parametrize(
    ("make", "points"),
    [(aec_env, POINTS), (parallel_env, POINTS), (single_env, Walk.choose), (joint_env, POINTS)],
    ids=["aec", "parallel", "single", "joint"],
)


class Reseeded(Walk):
    """A walk whose chance can be drawn anew."""

    def reseed(self, seed):
        self.random.seed(seed)
        self.place += 1000  # seen by those who look whether it was called


class Gambling(Walk):
    """One that draws from the global generators."""

    def drift(self):
        return random.random() + np.random.standard_normal()


class Both(Gambling):
    def reseed(self, seed):
        self.random.seed(seed)


def going_on(make=single_env, points=Walk.choose, simulation=Reseeded, **options):
    env = make(lambda: simulation(6), points, **options)
    env.reset(seed=3)
    move(env)
    return env


def drawn(env, number):
    """What a base that draws from the global generators would draw."""
    return random.random(), random.gauss(0, 1), np.random.random(), np.random.standard_normal()


@pytest.mark.parametrize(("simulation", "options"), [(Reseeded, {}), (Gambling, {"global_rng": True})])
@VIEWS
def test_the_same_seeds_are_the_same_futures(make, points, simulation, options):
    """By either method and driver, and whatever has been drawn before; other seeds are other futures."""
    env = going_on(make, points, simulation, **options)
    threaded = going_on(make, points, simulation, driver="thread", **options)
    seeds = [5, 6, 5, 2**70]
    forked, replayed = (branch(env, short, 4, method=method, seeds=seeds) for method in ("fork", "replay"))
    random.random()
    assert forked == replayed == branch(env, short, 4, seeds=np.array(seeds, object))
    assert forked == branch(threaded, short, 4, seeds=seeds)
    assert forked[0] == forked[2]
    assert len({repr(each) for each in forked}) == 3
    assert branch(env, short, 1, seeds=[6]) == forked[1:2]
    threaded.close()


def present(twin, number):
    """Who decides, seeing what, where."""
    pending = twin.unwrapped._session.episode.pending
    simulation = twin.unwrapped.simulation
    return pending.name, pending.observation.tolist(), simulation.steps, simulation.place


@METHODS
@VIEWS
def test_the_present_stays_what_it_is(make, points, method):
    env = going_on(make, points)
    *seen, place = present(env, 0)
    assert branch(env, present, 2, method=method, seeds=[1, 2]) == [(*seen, place + 1000)] * 2


@METHODS
@pytest.mark.parametrize(("simulation", "options"), [(Reseeded, {}), (Both, {"global_rng": True})])
@VIEWS
def test_neither_the_environment_nor_the_generators_of_its_user_move(make, points, simulation, options, method):
    env = going_on(make, points, simulation, **options)
    random.gauss(0, 1)
    np.random.standard_normal()
    (ahead,), before = branch(env, short, 1, method=method), world()
    branch(env, short, 2, method=method, seeds=[1, 2])
    with pytest.raises(ZeroDivisionError):
        branch(env, lambda twin, number: 1 / 0, 1, method=method, seeds=[1])
    assert world() == before
    assert rest_of(env) == ahead


@METHODS
def test_the_generators_of_the_process_are_seeded_for_each_future(method):
    """Those of a base policy: alike for the same seeds, and not with the simulation's numbers."""
    env, own = going_on(simulation=Both, global_rng=True), []

    def base(twin, number):
        with twin._session.context():
            own.append(drawn(twin, number))
        return drawn(twin, number), own[-1], twin.simulation.random.random()

    found = branch(env, base, 3, method=method, seeds=[7, 8, 7])
    assert found[0] == found[2] != found[1]
    assert found[0][2] != found[1][2]  # the simulation is reseeded, too
    assert found == branch(env, base, 3, seeds=[7, 8, 7])
    assert len({value for each in found[:2] for part in each[:2] for value in part}) == 16
    plain = [random.Random(7).random(), np.random.RandomState(7).random(), np.random.default_rng(7).random()]
    for child in np.random.SeedSequence(7).spawn(3):
        plain += [np.random.default_rng(part).random() for part in (child, *child.spawn(3))]
    assert not {*plain} & {value for part in found[0][:2] for value in part}


@METHODS
def test_another_kind_of_generator_behind_numpys_functions(method):
    """It is seeded whatever its kind, and put back as it was."""
    env, kept, mine = going_on(), np.random.get_bit_generator(), np.random.PCG64(5)
    try:
        np.random.set_bit_generator(mine)
        state, sequence = mine.state, mine.seed_seq
        expected = branch(env, drawn, 2, method="fork", seeds=[1, 2])
        assert branch(env, drawn, 2, method=method, seeds=[1, 2]) == expected
        assert np.random.get_bit_generator() is mine
        assert (mine.state, mine.seed_seq) == (state, sequence)
    finally:
        np.random.set_bit_generator(kept)


@METHODS
def test_torchs_generator_is_seeded_too(monkeypatch, method):
    generator = types.SimpleNamespace(state=0, get_state=lambda: generator.state)
    generator.set_state = generator.manual_seed = lambda state: setattr(generator, "state", state)
    torch = types.ModuleType("torch")
    torch.set_num_threads, torch.default_generator = (lambda number: None), generator
    monkeypatch.setitem(sys.modules, "torch", torch)
    found = branch(going_on(), lambda *_: torch.default_generator.state, 3, method=method, seeds=[1, 2, 1])
    assert 0 != found[0] == found[2] != found[1] != 0
    assert generator.state == 0


@METHODS
def test_branches_of_branches_have_futures_of_their_own(method):
    def deeper(twin, number):
        before = random.getstate()
        found = branch(twin, short, 2, method=method, seeds=[number, 9])
        assert random.getstate() == before
        return found

    found = branch(going_on(), deeper, 2, method=method, seeds=[1, 2])
    assert found[0][1] != found[0][0] != found[1][0]


class Deciding(Reseeded):
    def reseed(self, seed):
        super().reseed(seed)
        self.chosen = self.choose()


@METHODS
def test_decisions_of_reseed_are_the_rules(method):
    env = going_on(simulation=Deciding)
    found = branch(env, lambda twin, number: twin.simulation.chosen, 8, method=method, seeds=range(8))
    assert found == [random.Random(seed).choice([-1, 1]) for seed in range(8)]


class Reopened(Yard):
    def reseed(self, seed):
        reseed_generators(self, seed)


@settings(max_examples=40)
@given(designs, yard_seeds, st.integers(0, 20), st.lists(st.integers(0, 2), min_size=3, max_size=3))
def test_random_worlds_have_the_same_futures_by_either_method_and_driver(design, seed, taken, futures):
    env, threaded = (aec_env(lambda: Reopened(design), POINTS_OF_YARD, driver=d) for d in ("greenlet", "thread"))
    for each in (env, threaded):
        each.reset(seed=seed)
        advance(each, taken)
    if not is_over(env):
        found = branch(env, rest_of_yard, 3, method="fork", seeds=futures)
        assert found == branch(env, rest_of_yard, 3, method="replay", seeds=futures)
        assert found == branch(threaded, rest_of_yard, 3, seeds=futures)
        assert [found[futures.index(future)] for future in futures] == found
        assert branch(env, rest_of_yard) == branch(threaded, rest_of_yard) == [rest_of_yard(env)]
    threaded.close()


@METHODS
def test_who_cannot_draw_anew_is_told_what_to_do(monkeypatch, method):
    env = going_on(simulation=Walk)
    monkeypatch.setattr(os, "fork", None)
    with pytest.raises(BranchError, match=r"Walk[\s\S]*reseed\(seed\)[\s\S]*global_rng=True"):
        branch(env, short, 2, method=method, seeds=[1, 2])
    env.simulation.reseed = None
    with pytest.raises(BranchError, match="reseed"):
        branch(env, short, 1, method=method, seeds=[1])
    env.step(1)


@pytest.mark.parametrize(
    "seeds", [[], [1], [1, 2, 3], [1, True], [1, -1], [1, 2.0], [1, None], [1, "2"], "12", 1, {1, 2}, iter([1, 2])]
)
def test_seeds_are_one_integer_for_each_branch(seeds):
    with pytest.raises(OptionValueError, match="seeds must be n = 2 non-negative integers"):
        branch(going_on(), short, 2, seeds=seeds)
    assert branch(going_on(), short, 0, seeds=[]) == []
    with pytest.raises(NotResetError):
        branch(single_env(lambda: Reseeded(6), Walk.choose), short, 1, seeds=[1])


class Failing(Walk):
    def reseed(self, seed):
        return 1 / (1 - seed)


@METHODS
def test_an_error_of_reseed_surfaces_as_itself(method):
    env, before = going_on(simulation=Failing), random.getstate()
    with pytest.raises(ZeroDivisionError) as caught:
        branch(env, short, 2, method=method, seeds=[0, 1])
    assert "reseeded; seed 1" in notes(caught.value)
    assert "in branch 1" in notes(caught.value)
    assert random.getstate() == before
    env.step(1)
