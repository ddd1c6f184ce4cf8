"""In the turn view, planners try the learner's actions; the return is the sum over all agents."""

from itertools import product

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, TransformAction, TransformReward

from simenv_marl import RULE, branch, clone, generate_env, joint_env, simulate, turn_env
from simenv_marl.data import joint_policy, turn_policy
from simenv_marl.errors import InvalidActionError, OptionValueError, UnknownAgentError
from simenv_marl.planning import RolloutPolicy, TreeSearchPolicy, action_values
from tests.planning.test_action_values import METHODS, begun, futures_of
from tests.worlds import random_worlds
from tests.worlds.models import calling, decision
from tests.worlds.valued import Duel, Unseeded, points

ONE_FUTURE = pytest.mark.filterwarnings("ignore:.*cannot draw new random numbers")


def made(model=Duel, **options):
    """A duel whose pending decision is that of the one on the left."""
    return begun(turn_env(model, points(), **options))


def by_hand(env, action, seed, *, base, horizon=None, discount=1.0, terminal=0.0):
    """What an action is worth in a future, by stepping a clone."""
    twin = clone(env, seed=seed, method="replay")
    total, weight, steps, ended = 0.0, 1.0, 0, False
    while not ended and steps != horizon:
        seen, reward, terminated, truncated, info = twin.step(action)
        total += weight * reward
        steps, weight, ended = steps + 1, weight * discount, terminated or truncated
        action = RULE if ended or base is RULE else base(seen, info)
    twin.close()
    return total + (0.0 if ended else weight * terminal)


def rising(seen, info):
    return (int(seen["observation"][0]) + seen["kind"] + len(info["agent"])) % 3


@METHODS
@pytest.mark.parametrize("base", [RULE, rising])
@pytest.mark.parametrize(
    "given", [{}, {"horizon": 1}, {"horizon": 4, "discount": 0.5}, {"discount": 0.9}]
)
def test_action_values_in_turn_env_match_clones_stepped_by_hand(base, given, method):
    env = made()
    for _ in range(3):  # up to a decision of the one on the right
        env.step(2)
    told = action_values(
        env, futures=2, base=base, method=method, terminal_value=lambda env: 7.0, **given
    )
    table = [
        [
            by_hand(env, action, seed, base=base, terminal=7.0, **given)
            for seed in futures_of(env, 2)
        ]
        for action in range(3)
    ]
    assert told.actions == (0, 1, 2)
    assert told.returns == pytest.approx(np.array(table))


@pytest.mark.thorough
@pytest.mark.parametrize("flatten", [False, True])
def test_action_values_in_turn_env_with_births_match_stepping_by_hand(flatten):
    class Yard(random_worlds.Yard):
        def reseed(self, seed):
            self.random.seed(seed)

    design = random_worlds.YardDesign(machines=3, jobs=3, cranes=2, plans=2, luck=3, until=None)
    options = {"possible_agents": random_worlds.YARD_ROSTER, "flatten": flatten}
    env = begun(turn_env(lambda: Yard(design), random_worlds.YARD_POINTS, **options))
    actions = [RULE, *range(env.action_space.n)]
    for _ in range(3):
        told = action_values(env, actions, futures=2)
        table = [
            [by_hand(env, action, seed, base=RULE) for seed in futures_of(env, 2)]
            for action in actions
        ]
        assert told.returns == pytest.approx(np.array(table))
        env.step(told.best)


@METHODS
def test_action_values_in_turn_env_take_base_policies_by_agent(method):
    env = made()

    def by_kind(seen, info):
        number = int(seen["observation"][0])
        return 2 - number % 3 if info["agent"] == "right" else RULE

    bases = {"right": lambda seen: 2 - int(seen[0]) % 3}
    told = action_values(env, futures=2, base=bases, method=method)
    table = [
        [by_hand(env, action, seed, base=by_kind) for seed in futures_of(env, 2)]
        for action in range(3)
    ]
    assert told.returns == pytest.approx(np.array(table))
    with pytest.raises(UnknownAgentError, match="'middle'"):
        action_values(env, base={"middle": RULE})
    env = begun(TransformAction(made(), lambda action: action, spaces.Discrete(2)))
    with pytest.raises(OptionValueError, match="no wrapper has replaced"):
        action_values(env, base=bases)


def paced(seen):
    return int(seen[0]) % 3


@pytest.mark.thorough
@pytest.mark.parametrize("view", ["turn", "aec", "parallel", "joint"])
def test_action_values_in_turn_env_take_one_base_policy_for_all_agents(view):
    bases = [
        dict.fromkeys(("left", "right"), paced),
        turn_policy(lambda seen: paced(seen["observation"]), like=made()),
        joint_policy(
            lambda seen: {name: paced(part) for name, part in seen.items()},
            like=joint_env(Duel, points()),
        ),
    ]
    env = begun(generate_env(Duel, points(), view=view)())
    actions = [{"left": 2, "right": 0}] if view == "joint" else [0, 2]
    table = [action_values(env, actions, base=base, futures=2).returns for base in bases]
    if view == "joint":
        env = begun(joint_env(Duel, points(), flatten=True))
        base = joint_policy(lambda seen: (np.repeat(paced(seen), 2), {}), like=env)
        table.append(action_values(env, [np.array([2, 0])], base=base, futures=2).returns)
    assert table == [pytest.approx(table[0])] * len(table)


@pytest.mark.thorough
def test_rollout_and_tree_search_policy_take_a_base_for_all_agents():
    turn = turn_policy(lambda seen: paced(seen["observation"]), like=made())
    values = []
    for base in (dict.fromkeys(("left", "right"), paced), turn, turn | {"right": RULE}):

        def plan(seen, *, _environment, base=base):
            values.append(action_values(_environment, [0, 2], base=base, futures=2).means.tolist())
            return RULE

        simulate(Duel, {"left": plan}, points=points(), seed=5)
    by_agent, by_all, by_some = np.reshape(values, (3, -1))
    assert by_all == pytest.approx(by_agent)
    assert by_some != pytest.approx(by_agent)
    assert TreeSearchPolicy([0, 2], base=turn, futures=4).choose(made()).means.all()


@ONE_FUTURE
def test_action_values_translate_and_check_actions_of_base_policies():
    ant = decision(agent="ant_0", action_space=spaces.Discrete(2, start=5))
    bee = decision(
        agent="bee_0",
        action_space=spaces.Box(0, 4, (1,), np.float32),
        action_space_mapping=lambda action: action.tolist(),
        reward_mapping=lambda: 1.0,
    )
    env = begun(turn_env(calling(bee, ant, bee, ant), [ant, bee]))
    first = np.array([0.0, 0.0, -1.0], np.float32)
    logs = []

    def note(env):
        logs.append(env.simulation.log)
        return 0.0

    bases = {"ant_0": lambda seen: 6, "bee_0": lambda seen: np.array([3.0], np.float32)}
    given = {"futures": 1, "method": "replay", "horizon": 3, "terminal_value": note}
    action_values(env, [first], base=bases, **given)
    assert logs == [[[0.0], 6, [3.0]]]
    for wrong in ({"ant_0": lambda seen: 0}, {"bee_0": lambda seen: np.array([5.0], np.float32)}):
        with pytest.raises(InvalidActionError, match="not in"):
            action_values(env, [first], base=bases | wrong, **given)


@ONE_FUTURE
def test_action_values_in_turn_env_try_the_deciding_agents_legal_actions():
    mask = np.array([1, 0, 1], np.int8)
    ant = decision(
        agent="ant_0", action_space=spaces.Discrete(3, start=4), action_mask_mapping=lambda: mask
    )
    bee = decision(agent="bee_0", action_space=spaces.Discrete(5))
    env = begun(turn_env(calling(ant, bee), [ant, bee]))
    assert action_values(env, futures=1).actions == (0, 2)
    for wrong, match in ((1, "mask"), (3, "has 3 of the 5"), (5, "is not in Discrete")):
        with pytest.raises(InvalidActionError, match=match):
            action_values(env, [0, wrong])
    assert RolloutPolicy([0, 1, 3]).choose(env).actions == (0, RULE)
    with pytest.raises(InvalidActionError, match="not in"):
        RolloutPolicy([0, 5]).choose(env)
    env.step(0)
    assert action_values(env, futures=1).actions == (0, 1, 2, 3, 4)
    amount = decision(action_space=spaces.Box(0, 1, (1,), np.float32))
    env = begun(turn_env(calling(amount), [amount], clip_actions=True))
    with pytest.raises(OptionValueError, match="Discrete"):
        action_values(env)
    assert len(action_values(env, [np.array([2.0])], futures=1).means) == 1


@METHODS
def test_action_values_apply_wrappers_of_turn_env(method):
    env = made()
    seeds = futures_of(env, 2)
    table = [
        [by_hand(env, action, seed, base=RULE, horizon=3) for seed in seeds] for action in range(3)
    ]
    wrapped = TransformReward(PassiveEnvChecker(env), lambda reward: -reward)
    wrapped = begun(OrderEnforcing(wrapped))
    told = action_values(wrapped, futures=2, horizon=3, method=method)
    assert told.returns == pytest.approx(-np.array(table))


def in_turn(actions):
    """A policy that takes some actions, and then follows the rule."""
    left = iter(actions)
    return lambda *_: next(left, RULE)


@pytest.mark.thorough
@METHODS
@ONE_FUTURE
def test_tree_search_policy_in_turn_env_finds_the_best_sequence(method):
    env = made(Unseeded)
    planner = TreeSearchPolicy([0, 2], depth=3, budget=60, horizon=4, margin=0, method=method)
    values = {}
    for path in product([0, 2], repeat=3):
        values[path] = by_hand(env, path[0], None, base=in_turn(path[1:]), horizon=4)
    told = planner.choose(env)
    best = max(values, key=values.get)
    assert (told.actions, told.best) == ((0, 2, RULE), best[0])
    assert np.nanmax(told.returns) == pytest.approx(values[best])
    assert branch(env, lambda twin, number: planner.choose(twin).best, method=method) == [best[0]]
    chance = TreeSearchPolicy([0, 2], depth=2, futures=8, margin=0, method=method)
    assert chance.choose(made()).best == 2  # because the first move pays the one on the left alone
