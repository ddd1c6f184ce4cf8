"""``global_rng=True``: each environment has global generators of its own; others stay untouched."""

import random
import threading

import numpy as np
import pytest

from simenv_marl import RULE, TRUNCATED, aec_env, simulate
from simenv_marl.errors import OptionValueError, WrongThreadError
from tests.worlds.models import EVERY_DRIVER, EVERY_VIEW, begun, define, play


class Casino:
    """Draws from everything that is global, in every part of it."""

    def __init__(self):
        self.luck = (random.random(), np.random.random())

    def reset(self, seed=None):
        self.seed = seed
        self.log = [
            random.random(),
            np.random.random(),
            random.gauss(0, 1),
            np.random.standard_normal(),
        ]

    def run(self):
        for _ in range(6):
            self.log.append(self.bet(random.randrange(10)))
            self.log.append(random.gauss(0, 1))
            self.log.append(np.random.normal())
        return TRUNCATED

    def bet(self, card):
        return random.choice("abc") + str(np.random.randint(100))


BET = f"{__name__}.Casino.bet"
POINTS = {
    BET: define(
        agent="player_0", observation_space_mapping=lambda casino, card: [card, np.random.random()]
    )
}


def world():
    """The state of all global generators."""
    name, key, *others = np.random.get_state()
    return random.getstate(), name, key.tolist(), others


@pytest.fixture(autouse=True)
def _kept():
    """Leaves Python's generator as it was, with a normally distributed number kept in both."""
    before = random.getstate()
    random.gauss(0, 1)
    np.random.standard_normal()
    yield
    random.setstate(before)


def plain(seed):
    """What a run without the library draws when both generators were seeded so."""
    casino = Casino()
    random.seed(seed)
    np.random.seed(seed)
    casino.reset(seed)
    casino.run()
    return casino.log


@EVERY_DRIVER
@EVERY_VIEW
def test_global_rng_repeats_the_models_draws_despite_other_draws(view):
    logs = {seed: plain(seed) for seed in (7, 8)}
    envs = {seed: view(Casino, {BET: define(agent="player_0")}, global_rng=True) for seed in logs}

    def assert_untouched(move, *args, **kwargs):
        before = world()
        move(*args, **kwargs)
        assert world() == before
        random.gauss(0, 1)
        np.random.random()

    for _ in range(2):
        for seed, env in envs.items():
            assert_untouched(env.reset, seed=seed)
        for _ in range(6):
            for env in envs.values():
                assert_untouched(env.step, RULE)
        assert {seed: env.simulation.log for seed, env in envs.items()} == logs
    for env in envs.values():
        assert_untouched(env.reset)
        assert_untouched(env.close)


@pytest.mark.filterwarnings("ignore:.* draws from the global generator")
def test_global_generators_are_shared_unless_global_rng_is_set():
    env = begun(aec_env(Casino, POINTS), 7)
    before = world()
    env.step(RULE)
    assert world() != before
    env = aec_env(Casino, POINTS, global_rng=True)
    before = world()
    play(env)
    assert world() == before
    assert env.simulation.log[:4] == plain(env.simulation.seed)[:4]  # of the seed that it drew
    assert env.provenance()["options"] == {"global_rng": True}
    with pytest.raises(OptionValueError, match="global_rng"):
        aec_env(Casino, POINTS, global_rng=1)


def test_global_rng_restores_the_users_generators_after_an_error():
    before = world()
    broken = define(agent="player_0", observation_space_mapping=lambda casino, card: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        aec_env(Casino, {BET: broken}, global_rng=True).reset(seed=1)
    assert world() == before


class Seeding(Casino):
    def run(self):
        random.seed(1)
        np.random.seed(1)
        self.log = [self.bet(0)]


def test_global_rng_allows_simulations_to_seed_the_generators():
    before = world()
    policies = {BET: lambda observation: int(observation[0])}
    one, other = (
        simulate(Seeding, policies, points=POINTS, seed=seed, global_rng=True) for seed in (1, 2)
    )
    assert one.log == other.log
    assert world() == before


def test_global_rng_keeps_the_users_numpy_bit_generator():
    ours = np.random.get_bit_generator()
    theirs = np.random.PCG64(3)
    np.random.set_bit_generator(theirs)
    try:
        env = aec_env(Casino, {BET: define(agent="player_0")}, global_rng=True)
        play(env, RULE, seed=7)
        assert np.random.get_bit_generator() is theirs
        assert theirs.state == np.random.PCG64(3).state
    finally:
        np.random.set_bit_generator(ours)
    assert env.simulation.log == plain(7)


@EVERY_DRIVER
def test_global_rng_works_for_nested_environments():
    """The state of the outer one is in place in its simulation's thread, too."""

    class Gambler(Casino):
        def run(self):
            self.inner = simulate(Casino, points=POINTS, seed=self.seed, global_rng=True)
            return super().run()

    outer = simulate(Gambler, points=POINTS, seed=3, global_rng=True)
    assert outer.inner.log == outer.log == plain(3)


def test_global_rng_refuses_environments_in_two_threads_at_once():
    """There is one state of the global generators in a process, and whoever is at work has it."""
    other, errors = aec_env(Casino, POINTS, global_rng=True), []

    def work():
        with pytest.raises(WrongThreadError, match="one state") as caught:
            other.reset(seed=1)
        errors.append(caught.value)

    def observe(casino, card):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join(30)
        return [card, 0]

    before = world()
    env = begun(
        aec_env(
            Casino,
            {BET: define(agent="player_0", observation_space_mapping=observe)},
            global_rng=True,
        ),
        7,
    )
    env.step(RULE)
    assert len(errors) == 2
    other.reset(seed=1)
    other.close()
    env.step(RULE)
    assert env.simulation.log == plain(7)[: len(env.simulation.log)]
    random.setstate(before[0])
