"""Pools of policies, of which one decides in each episode."""

import pickle
from collections import Counter

import pytest

from simenv_marl import RULE, clone, evaluate, simulate, simulate_many, single_env
from simenv_marl.data import OpponentPool
from simenv_marl.errors import OptionValueError
from tests.worlds.models import calling, decision


def ant_and_bee():
    """Points of two agents, and a factory of simulations that ask both three times."""
    ant, bee = decision(agent="ant_0"), decision(agent="bee_0")
    return [ant, bee], calling(*[ant, bee] * 3)


def always(action):
    return lambda observation: action


def logs(pool, seeds, agents=("ant_0", "bee_0")):
    points, make = ant_and_bee()
    policies = dict.fromkeys(agents, pool)
    return [simulate(make, policies, points=points, seed=seed).log for seed in seeds]


def test_opponent_pool_uses_one_policy_for_all_agents_of_an_episode():
    found = logs(OpponentPool([always(1), always(2)]), range(20))
    assert {tuple(log) for log in found} == {(1,) * 6, (2,) * 6}


def test_opponent_pool_draw_depends_on_the_episodes_seed():
    pool = OpponentPool([always(1), always(2), RULE], seed=3)
    assert logs(pool, range(10)) == logs(pickle.loads(pickle.dumps(PICKLED)), range(10))
    assert logs(pool, range(10)) != logs(OpponentPool(pool.policies, seed=4), range(10))


def one(observation):
    return 1


def two(observation):
    return 2


PICKLED = OpponentPool([one, two, RULE], seed=3)


def test_opponent_pool_draws_policies_by_their_weights():
    pool = OpponentPool([always(1), always(2), always(3)], weights=[1, 0, 3])
    drawn = Counter(pool.draw(seed) for seed in range(2000))
    assert drawn[1] == 0
    assert drawn[2] / drawn[0] == pytest.approx(3, rel=0.2)


def test_opponent_pool_draws_an_added_policy_from_the_next_episode_on():
    points, make = ant_and_bee()
    pool = OpponentPool([RULE])
    env = single_env(make, points, policies={"bee_0": pool})
    env.reset(seed=1)
    env.step(1)
    pool.add(always(7), weight=1e9)
    env.step(1)
    assert env.unwrapped.simulation.log[:4] == [1, "rule", 1, "rule"]
    env.reset(seed=2)
    env.step(1)
    assert env.unwrapped.simulation.log[:2] == [1, 7]


def test_clone_continues_with_the_policy_drawn_from_an_opponent_pool():
    points, make = ant_and_bee()
    pool = OpponentPool([always(1)])
    env = single_env(make, points, policies={"bee_0": pool})
    env.reset(seed=1)
    env.step(5)
    pool.add(always(9), weight=1e9)
    twin = clone(env, method="replay")
    twin.step(5)
    assert twin.unwrapped.simulation.log[:4] == [5, 1, 5, 1]
    twin.close()


def test_opponent_pool_policies_can_take_the_decision():
    def numbered(observation, *, _decision):
        return _decision.number

    assert logs(OpponentPool([numbered]), [0], ["ant_0"])[0][::2] == [1, 2, 3]


def test_opponent_pool_works_in_simulate_many_and_evaluate():
    points, make = ant_and_bee()
    pool = OpponentPool([always(1), always(2)])
    many = simulate_many(make, {"ant_0": pool}, points=points, seeds=range(6))
    assert [each.log for each in many] == logs(pool, range(6), ["ant_0"])
    evaluate(make, {"pool": {"ant_0": pool}}, points=points, seeds=[1])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"policies": [1]}, "functions that answer at once"),
        ({"policies": [lambda observation, *, _environment: 1]}, "functions that answer at once"),
        ({"policies": [lambda observation, *, _state: 1]}, "functions that answer at once"),
        ({"policies": [RULE], "weights": [-1]}, "a number from 0 on"),
        ({"policies": [RULE], "weights": [float("nan")]}, "a number from 0 on"),
        ({"policies": [RULE], "weights": []}, "one number for each"),
        ({"policies": [RULE], "seed": -1}, "seed must be"),
    ],
    ids=["number", "planner", "state", "negative", "nan", "few", "seed"],
)
def test_opponent_pool_refuses_wrong_arguments(options, message):
    with pytest.raises(OptionValueError, match=message):
        OpponentPool(**options)


def test_opponent_pool_refuses_coroutine_policies():
    async def wait(observation):
        return 1

    with pytest.raises(OptionValueError, match="answer at once"):
        OpponentPool([RULE]).add(wait)


def test_opponent_pool_without_weights_raises_an_error_at_the_draw():
    with pytest.raises(OptionValueError, match="no policy with a weight above 0"):
        OpponentPool([RULE], weights=[0]).draw(1)
