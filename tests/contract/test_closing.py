"""The simulation's ``close``: once for each successful reset, after the last observations."""

import threading
from contextlib import nullcontext

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from simenv_marl import (
    branch,
    simulate,
    simulate_many,
    single_env,
    vector_env,
)
from simenv_marl.data import collect_episodes
from simenv_marl.experiments import evaluate
from tests.worlds.models import EVERY_VIEW, begun, define, fails

BOOK = f"{__name__}.Shop.book"
LOG = []


class Shop:
    """Keeps books, which the last observation reads; only the opening thread may close them."""

    fails = False

    def reset(self, seed=None):
        if seed == 13:
            raise ValueError("no shop today")
        LOG.append(("reset", seed))
        self.seed, self.books, self.thread = seed, [], threading.get_ident()

    def run(self):
        try:
            for _ in range(2):
                self.books.append(self.book())
        finally:
            LOG.append(("unwound", self.seed))

    def book(self):
        return 1

    def sold(self):
        return sum(self.books)  # None after it was closed, which is an error

    def close(self):
        assert threading.get_ident() == self.thread
        self.books = None
        LOG.append(("close", self.seed))
        if self.fails:
            raise ConnectionError("the books cannot be closed")


class Broken(Shop):
    fails = True


@pytest.fixture(autouse=True)
def _log():
    LOG.clear()


BOOKS = {
    BOOK: define(
        observation_space_mapping=lambda shop: [shop.sold(), 0],
        reward_mapping=lambda shop: shop.sold(),
        agent="clerk",
    )
}


def fail(*_):
    raise LookupError("first")


def of(what):
    return [seed for kind, seed in LOG if kind == what]


def test_simulation_close_is_called_before_each_reset_and_at_env_close():
    env = begun(single_env(Shop, BOOKS), 1)
    env.step(3)
    *_, terminated, _, _ = env.step(4)
    assert terminated
    assert of("close") == []
    env.reset(seed=2)
    assert LOG == [("reset", 1), ("unwound", 1), ("close", 1), ("reset", 2)]
    env.close()
    assert LOG[4:] == [("unwound", 2), ("close", 2)]
    env.close()
    for _ in range(2):
        with pytest.raises(ValueError, match="no shop"):
            env.reset(seed=13)  # which leaves nothing to close
        env.close()
        env.reset(seed=3)
    env.close()
    assert of("close") == of("reset") == [1, 2, 3, 3]


@pytest.mark.parametrize("shop", [Shop, Broken])
@EVERY_VIEW
def test_dropped_env_closes_its_simulation_and_warns_of_errors(view, shop):
    envs = [view(shop, BOOKS)]
    envs[0].reset(seed=1)
    with (
        pytest.warns(ResourceWarning, match="books cannot be closed")
        if shop is Broken
        else nullcontext()
    ):
        envs.clear()
    assert LOG == [("reset", 1), ("unwound", 1), ("close", 1)]


@pytest.mark.parametrize("mode", AutoresetMode)
def test_vector_env_closes_each_simulation_before_its_next_reset(mode):
    env = begun(vector_env(Shop, BOOKS, num_envs=2, autoreset_mode=mode), 1)
    for _ in range(2):
        env.step(np.ones(2, np.int64))
    if mode == AutoresetMode.NEXT_STEP:
        assert of("close") == []
        env.step(np.ones(2, np.int64))
    elif mode == AutoresetMode.DISABLED:
        env.reset(options={"reset_mask": np.ones(2, np.bool_)})
    assert of("close") == [1, 2]
    env.close()
    assert len(of("close")) == len(of("reset")) == 4


def test_simulate_many_closes_each_simulation_after_collect():
    def collect(shop):
        assert shop.books is not None
        LOG.append(("collect", shop.seed))

    policies = {BOOK: lambda observations: np.ones(len(observations), np.int64)}
    simulate_many(Shop, policies, seeds=[1, 2, 3], points=BOOKS, collect=collect, batch_size=2)
    assert sorted(of("close")) == sorted(of("collect")) == [1, 2, 3]
    LOG.clear()
    collect_episodes(Shop, policies, seeds=[1, 2], points=BOOKS, collect=collect)
    assert of("close") == of("collect") == [1, 2]
    LOG.clear()
    simulate(Shop, {BOOK: lambda observation: 2}, points=BOOKS, seed=4)
    assert LOG == [("reset", 4), ("unwound", 4), ("close", 4)]
    LOG.clear()
    with pytest.raises(LookupError):
        simulate_many(Shop, None, seeds=[1, 2], points=BOOKS, collect=fail)
    assert of("close") == of("reset") != []


def test_error_in_simulation_close_does_not_replace_an_earlier_error():
    for run, policies in ((simulate, {BOOK: fail}), (evaluate, {"bad": {BOOK: fail}})):
        seed = {"seed": 1} if run is simulate else {"seeds": [1]}
        with fails(LookupError, "books cannot be closed", match="first"):
            run(Broken, policies, points=BOOKS, **seed)
    env = begun(single_env(Broken, BOOKS), 1)
    with fails(LookupError, "books cannot be closed", match="first"):
        branch(env, fail, 1, method="replay")
    with pytest.raises(ConnectionError):
        env.reset(seed=2)
    assert 2 not in of("reset")
    env.close()
