"""The values of candidate actions are those of a reference that runs the model by itself."""

import copy
import random
import time
from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import (
    OrderEnforcing,
    PassiveEnvChecker,
    TimeLimit,
    TransformAction,
    TransformReward,
)
from pettingzoo.utils.wrappers import (
    AssertOutOfBoundsWrapper,
    BaseParallelWrapper,
    OrderEnforcingWrapper,
    TerminateIllegalWrapper,
)

from simenv_marl import (
    RULE,
    TRUNCATED,
    aec_env,
    difference,
    joint_env,
    parallel_env,
    single_env,
    turn_env,
    vector_env,
)
from simenv_marl.envs import pad_agents
from simenv_marl.errors import (
    BranchError,
    EpisodeOverError,
    InvalidActionError,
    OptionValueError,
    UnknownAgentError,
    ViewError,
)
from simenv_marl.planning import RolloutPolicy, action_values
from simenv_marl.planning.players import player_of
from simenv_marl.planning.rollouts import Rollouts
from tests.test_branch import METHODS
from tests.worlds.models import BY_DRIVER, define
from tests.worlds.valued import LEFT, Duel, Unseeded, points, worth

VIEWS = ("aec", "parallel", "single", "agent")


def begun(env, seed=5):
    env.reset(seed=seed)
    return env


def made(view, model=Duel, **options):
    """An environment whose pending decision is that of the one on the left, reset."""
    given = {LEFT: points()[LEFT]} if view == "single" else points()
    several = {"aec": aec_env, "parallel": parallel_env, "joint": joint_env, "turn": turn_env}
    make = several.get(view, single_env)
    return begun(make(model, given, **options, **{"agent": "left"} if view == "agent" else {}))


def futures_of(env, number):
    return Rollouts(player_of(env, RULE), RolloutPolicy([RULE])).seeds(number)


def expected(env, agent, actions=(0, 1, 2), number=3, **given):
    seeds = futures_of(env, number)
    return np.array(
        [[worth(agent, action, future, **given) for future in seeds] for action in actions]
    )


def greedy(observation):
    return int(observation[1]) % 3


def down(observation):
    return 2 - int(observation[0]) % 3


BASES = {"left": greedy, "right": down}


class Limited(Duel):
    """One that ends truncated."""

    def run(self):
        super().run()
        return TRUNCATED


def test_action_values_in_a_branch_return_the_answer_of_the_base():
    def planned(env):
        values = action_values(env, base=lambda observation: 2)
        assert not values.counts.any()
        return 1000.0 * values.best

    options = {"horizon": 1, "futures": 1, "method": "replay"}
    found = action_values(made("aec"), terminal_value=planned, **options)
    plain = action_values(made("aec"), **options)
    assert found.means - plain.means == pytest.approx([2000.0] * 3)


@pytest.mark.thorough
@METHODS
@BY_DRIVER
@pytest.mark.parametrize("view", VIEWS)
def test_action_values_are_the_same_in_every_env_and_driver(view, driver, method):
    if driver == "thread" and method == "fork":
        method = None  # which is then a replay
    env = made(view, Limited, driver=driver)
    told = action_values(env, futures=3, method=method, terminal_value=lambda env: 1e6)
    table = expected(env, "left")
    assert told.actions == (0, 1, 2)
    assert told.returns == pytest.approx(table)
    assert told.means == pytest.approx(table.mean(axis=1))
    assert told.standard_errors == pytest.approx(table.std(axis=1, ddof=1) / np.sqrt(3))
    assert told.counts.tolist() == [3, 3, 3]
    assert told.best == 2
    env.close()


@pytest.mark.parametrize("view", ["aec", "parallel"])
def test_action_values_in_mid_episode_belong_to_the_pending_decision(view):
    env = made(view)
    for agent in ("left", "right", "left"):
        env.step(1 if view == "aec" else {agent: 1})
    told = action_values(env, futures=3, horizon=2)
    assert told.returns == pytest.approx(expected(env, "right", at=3, horizon=2))
    assert told.best == 2


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("given", "told"),
    [
        *[({"horizon": horizon}, {}) for horizon in (1, 2, 4, 6, 7)],
        ({"discount": 0.8}, {}),
        ({"discount": 0.8, "discount_by": "time"}, {"timed": True}),
        ({"discount": 0}, {"horizon": 1}),
        *[({"horizon": 2, "discount": 0.5, "method": method}, {}) for method in ("fork", "replay")],
        *[
            ({"horizon": h, "horizon_by": "time"}, {"timed_horizon": True})
            for h in (0.1, 0.5, 2.0, 5, 1e9)
        ],
    ],
)
@pytest.mark.parametrize("view", [*VIEWS, "joint"])
def test_action_values_horizon_counts_the_agents_decisions_or_time(view, given, told):
    env, joint = made(view), view == "joint"
    actions = [{"left": action, "right": 1} for action in range(3)] if joint else None
    value = {"terminal_value": lambda env: np.array([10 + env.simulation.value])}
    found = action_values(env, actions, futures=3, **{"method": "replay"} | given, **value)
    reference = {name: given[name] for name in ("horizon", "discount") if name in given} | told
    terminal = None if given.get("discount") == 0 else lambda value: 10 + value
    table = expected(env, "left", both=joint, terminal=terminal, **reference)
    assert found.returns == pytest.approx(table)


@pytest.mark.thorough
@METHODS
@pytest.mark.parametrize("view", VIEWS)
def test_action_values_base_is_one_policy_or_policies_by_agent(view, method):
    env, given = made(view), [(greedy, {"left": greedy})]
    if view in ("aec", "parallel"):
        given += [(BASES, BASES), (BASES | {"left": RULE}, {"right": down})]
    for base, bases in given:
        told = action_values(env, futures=3, base=base, method=method)
        assert told.returns == pytest.approx(expected(env, "left", bases=bases))
    told = action_values(
        env, futures=3, base=lambda observation, info: info["time"] > 2, method=method
    )
    assert not np.allclose(told.returns, expected(env, "left"))


@METHODS
def test_action_values_in_joint_env_sum_rewards_and_take_joint_bases(method):
    env = made("joint")
    actions, first = (
        [{"left": 2, "right": RULE}, RULE, {"left": 0, "right": 1}],
        {"left": 2, "right": 1},
    )
    table = expected(env, "left", (2, 1, 0), both=True)
    told = action_values(env, actions, futures=3, method=method)
    assert told.returns == pytest.approx(table)
    assert told.best is actions[2]
    told = action_values(env, [first], futures=3, base={"left": greedy}, method=method)
    assert told.returns == pytest.approx(
        expected(env, "left", (2,), both=True, bases={"left": greedy})
    )
    # A round: the one on the right decides by what was seen before the other one has moved.
    whole = action_values(
        env, [first], futures=3, base=lambda seen: {n: BASES[n](seen[n]) for n in BASES}
    )
    parts = action_values(env, [first], futures=3, base=BASES)
    assert whole.returns == pytest.approx(parts.returns)
    with pytest.raises(OptionValueError, match="without flatten"):
        action_values(made("joint", flatten=True), [[1, 1]], base=BASES)
    env = begun(TransformReward(env, lambda reward: -reward))
    with pytest.raises(InvalidActionError, match="not in"):
        action_values(env, [{"left": 3, "right": RULE}])
    assert action_values(env, actions, futures=3, method=method).returns == pytest.approx(-table)


def test_action_values_prefer_the_envs_policies_to_the_base():
    stays = {"right": lambda observation: 2}
    env = made("aec", policies=stays)
    for base in (RULE, {"left": RULE, "right": lambda observation: 0}):
        told = action_values(env, futures=3, base=base)
        assert told.returns == pytest.approx(expected(env, "left", bases=stays))


class Herd:
    """Two beings count up together, in turns; the other one joins at its first decision."""

    def reset(self, seed=None):
        self.sum, self.moves = 0, 0

    def reseed(self, seed):
        pass

    def run(self):
        for self.moves in range(6):
            self.sum += self.graze("one" if self.moves % 2 == 0 else "other")

    def graze(self, name):
        return 1


GRAZING = {
    f"{__name__}.Herd.graze": define(
        agent=lambda herd, name: name,
        observation_space_mapping=lambda herd, name: [herd.moves, herd.sum],
        reward_mapping=difference(lambda herd, name: float(herd.sum)),
    )
}


@METHODS
@pytest.mark.parametrize(
    ("make", "others"), [(single_env, 1 + 3 + 5), (aec_env, 1 + 3 + 5), (parallel_env, 1 + 2 + 4)]
)
def test_action_values_base_by_agent_decides_for_other_agents_too(make, others, method):
    """In a round by what they saw before it; in that in which they join, by the rule."""
    options = {"agent": "one"} if make is single_env else {}
    env = begun(make(Herd, GRAZING, **options), 1)
    assert action_values(env, [0, 3], futures=1, method=method).means.tolist() == [5.0, 8.0]
    told = action_values(
        env, [0, 3], futures=1, method=method, base={"other": lambda seen: int(seen[0])}
    )
    assert told.means.tolist() == [2 + others, 5 + others]
    # at a point that is not the environment's
    with pytest.raises(UnknownAgentError, match="'right'"):
        action_values(made("agent"), base={"right": RULE})
    declared = begun(make(Herd, GRAZING, possible_agents=["one", "other"], **options), 1)
    with pytest.raises(UnknownAgentError, match="'third'"):
        action_values(declared, base={"third": RULE})
    for given in ({"discount_by": "time"}, {"horizon_by": "time", "horizon": 1}):
        with pytest.raises(OptionValueError, match=r"time\(\)"):  # which it has not
            action_values(env, **given)


class Mortal(Duel):
    ceiling = 3.0


@pytest.mark.thorough
@METHODS
@pytest.mark.parametrize("padded", [False, True])
@pytest.mark.parametrize("view", ["aec", "parallel", "single"])
def test_action_values_are_exact_if_the_agent_ends_in_a_future(view, padded, method):
    env, given = (
        made(view, Mortal),
        {"futures": 8, "base": lambda observation: 2, "terminal_value": lambda env: 1e6},
    )
    if padded and view != "single":
        env = begun(pad_agents(env))
    table, endless = (
        expected(env, "left", number=8, model=model, bases={"left": lambda seen: 2})
        for model in (Mortal, Duel)
    )
    assert action_values(env, **given, method=method).returns == pytest.approx(table)
    assert not np.allclose(table, endless)  # the last reward counts, and none after it
    assert action_values(env, **given, horizon=5).means.max() < 1e3


def test_action_values_use_the_same_futures_at_the_same_decision():
    env = made("single")

    def returns(env, **given):
        return action_values(env, **{"futures": 4} | given).returns.tolist()

    first = returns(env)
    assert returns(env) == returns(made("aec")) == first
    assert [row[:4] for row in returns(env, futures=6)] == first
    assert returns(env, seed=1) == returns(env, seed=1) != first
    seeds = futures_of(env, 4)
    assert seeds[0] == 2344043841  # in every version
    env.step(1)
    assert not set(seeds) & set(futures_of(env, 4))
    env.reset(seed=6)
    assert not set(seeds) & set(futures_of(env, 4))


@METHODS
@pytest.mark.parametrize("model", [Duel, Unseeded])
@pytest.mark.filterwarnings("ignore:Unseeded cannot draw")
def test_action_values_random_base_draws_the_same_for_all_actions(model, method):
    def draws(observation):
        return random.randrange(3) if observation[0] % 2 else int(np.random.randint(3))

    def returns(**given):
        return action_values(
            made("single", model), [1, RULE, 2], futures=4, method=method, **given
        ).returns.tolist()

    random.seed(1)
    state = random.getstate(), np.random.get_state()[1].tolist()
    told = returns(base=draws)
    assert told[0] == told[1]
    assert (random.getstate(), np.random.get_state()[1].tolist()) == state
    random.seed(2)
    np.random.seed(2)
    # what is drawn there follows the state of the process
    assert returns(base=draws) == told or model is Unseeded
    assert not np.allclose(told, returns())


@METHODS
@pytest.mark.parametrize("view", VIEWS)
def test_action_values_warn_of_a_model_without_reseed(view, method):
    env = made(view, Unseeded)
    with pytest.warns(
        UserWarning, match="Unseeded cannot draw new random numbers .* foresees"
    ) as caught:
        told = action_values(env, futures=9, method=method)
    assert caught[0].filename == __file__
    assert told.counts.tolist() == [1, 1, 1]
    assert np.isnan(told.standard_errors).all()
    assert told.returns == pytest.approx(
        np.array([[worth("left", action, None)] for action in range(3)])
    )


def test_action_values_do_not_draw_from_the_envs_action_space():
    space = spaces.Dict({"left": spaces.Discrete(2), "right": spaces.Discrete(3)})
    env = begun(TransformAction(made("joint"), lambda action: action, space))
    drawn = copy.deepcopy(env.action_space["right"].np_random)
    action_values(env, [{"left": 0, "right": RULE}], futures=1, horizon=1)
    assert env.action_space["right"].np_random.random() == drawn.random()


def test_action_values_apply_wrappers_of_single_env():
    env = made("single")
    table = expected(env, "left", horizon=3)
    limited = begun(TimeLimit(OrderEnforcing(PassiveEnvChecker(env)), 3))  # as gymnasium.make does
    assert action_values(
        limited, futures=3, terminal_value=lambda env: 1e6
    ).returns == pytest.approx(table)
    wrapped = TransformReward(
        TransformAction(env, lambda action: 2 - action, spaces.Discrete(3)), lambda r: 10 * r
    )
    wrapped.reset(seed=5)
    # with RULE as base, which no wrapper is to meet
    told = action_values(wrapped, futures=3, horizon=3)
    assert told.returns == pytest.approx(10 * table[::-1])
    assert told.best == 0
    told = action_values(wrapped, futures=3, horizon=3, base=lambda observation: 2)
    bases = {"left": lambda seen: 0}
    assert told.returns == pytest.approx(10 * expected(env, "left", horizon=3, bases=bases)[::-1])
    told = action_values(wrapped, iter([RULE]), futures=3, horizon=3, base=lambda observation: 2)
    assert told.returns == pytest.approx(10 * expected(env, "left", (1,), horizon=3, bases=bases))


class Doubled(BaseParallelWrapper):
    def step(self, actions):
        observations, rewards, *rest = self.env.step(dict(actions))
        doubled = (
            {agent: 2 * told for agent, told in all_told.items()}
            for all_told in (observations, rewards)
        )
        return *doubled, *rest


@METHODS
def test_action_values_apply_pettingzoo_wrappers(method):
    env = begun(OrderEnforcingWrapper(AssertOutOfBoundsWrapper(made("aec"))))
    told = action_values(env, futures=3, method=method)
    assert told.returns == pytest.approx(expected(env, "left"))
    env = begun(Doubled(made("parallel")))
    told = action_values(env, [RULE, 2], futures=3, method=method)
    assert told.returns == pytest.approx(2 * expected(env, "left", (1, 2)))
    told = action_values(env, [2], futures=3, base=lambda seen: greedy(seen / 2), method=method)
    assert told.returns == pytest.approx(2 * expected(env, "left", (2,), bases={"left": greedy}))
    masked = {
        "action_space": spaces.Discrete(6),
        "action_mask_mapping": lambda duel: [0, 1, 0, 1, 0, 0],
    }
    given = {name: replace(point, **masked) for name, point in points().items()}
    env, wrapped = aec_env(Duel, given), TerminateIllegalWrapper(aec_env(Duel, given), -1)
    told, plain = (
        action_values(begun(each), futures=2, method=method).returns.tolist()
        for each in (wrapped, env)
    )
    assert told == plain


WRONG = [
    *(({"actions": actions}, OptionValueError, "list of candidates") for actions in ([], "12", 1)),
    *(({"futures": futures}, OptionValueError, "futures") for futures in (0, 2.5, True)),
    *(({"horizon": horizon}, OptionValueError, "horizon") for horizon in (0, 1.5)),
    ({"horizon": 0.0, "horizon_by": "time"}, OptionValueError, "horizon"),
    ({"horizon_by": "days"}, OptionValueError, "horizon_by"),
    ({"discount_by": "step"}, OptionValueError, "discount_by"),
    *(({"discount": discount}, OptionValueError, "discount") for discount in (1.1, float("nan"))),
    ({"terminal_value": 3.0}, OptionValueError, "terminal_value"),
    ({"terminal_value": lambda env: None, "horizon": 1}, OptionValueError, "finite number"),
    *(({"base": base}, OptionValueError, "base must be") for base in (1, {"left": 1})),
    ({"base": {"middle": RULE}}, UnknownAgentError, "'middle'"),
    ({"base": lambda observation: 7}, InvalidActionError, "7"),
    ({"actions": [0, 3]}, InvalidActionError, "3 of 'left' is not in its action space"),
    ({"seed": -1}, OptionValueError, "seed"),
    ({"method": "spoon"}, OptionValueError, "method"),
]


@pytest.mark.parametrize(("given", "error", "match"), WRONG)
@pytest.mark.parametrize("view", ["aec", "parallel", "single"])
def test_action_values_refuse_invalid_arguments(view, given, error, match):
    env = made(view)
    with pytest.raises(error, match=match):
        action_values(env, **{"futures": 1} | given)
    assert action_values(env, futures=1).best == 2  # nothing has come of it


def test_action_values_refuse_aec_env_while_a_dead_agent_must_step():
    env = made("aec", Mortal)
    while env.agent_selection == "right" or not env.terminations["left"]:
        env.step(2)
    with pytest.raises(EpisodeOverError, match=r"step\(None\)"):
        action_values(env)
    env.step(None)
    assert action_values(env, futures=2).best == 2


def test_action_values_refuse_vector_env():
    for other in (vector_env(Duel, {LEFT: points()[LEFT]}, num_envs=2), Duel()):
        with pytest.raises(ViewError, match="one simulation"):
            action_values(other)


def test_action_values_need_a_list_of_actions_unless_they_are_discrete():
    amount = points(action_space=spaces.Box(0, 2, (1,), np.float64), action_space_mapping=np.sum)
    env = begun(single_env(Duel, {LEFT: amount[LEFT]}))
    for other in (env, made("joint")):
        with pytest.raises(OptionValueError, match="Discrete"):
            action_values(other)
    assert action_values(env, np.array([[0.0], [2.0], [1.0]]), futures=2).best.tolist() == [2.0]
    env = begun(single_env(Duel, {LEFT: points(action_space=spaces.Discrete(2, start=1))[LEFT]}))
    assert action_values(env, futures=3).actions == (1, 2)


@pytest.mark.parametrize("wrapper", [lambda env: env, lambda env: TransformReward(env, float)])
def test_action_values_omit_masked_actions(wrapper):
    given = points(action_mask_mapping=lambda duel: [1, 1, duel.turn % 2])
    env = begun(wrapper(single_env(Duel, {LEFT: given[LEFT]})))
    assert action_values(env, futures=2).actions == (0, 1)
    with pytest.raises(InvalidActionError, match="masked"):
        action_values(env, [1, 2])
    assert RolloutPolicy([1, 2], futures=2).choose(env).actions == (1, RULE)
    told = RolloutPolicy([RULE]).choose(env)  # one alone is not tried
    assert (told.actions, told.best, told.counts.tolist()) == ((RULE,), RULE, [0])
    assert np.isnan(told.means).all()
    for actions, match in (([2], "all candidates"), ([2, 5], "not in")):
        with pytest.raises(InvalidActionError, match=match):
            RolloutPolicy(actions).choose(env)


def test_action_values_time_limit_ends_branches_that_hang():
    with pytest.raises(BranchError, match="longer than"):
        action_values(
            made("single"), futures=1, base=lambda observation: time.sleep(60), time_limit=0.2
        )


def test_action_values_show_progress_on_request(capsys):
    assert action_values(made("single"), futures=3, progress=True).counts.tolist() == [3, 3, 3]
    assert "9/9" in capsys.readouterr().err


def test_action_values_do_not_render_branches():
    class Shown(Duel):
        render_modes = ("human",)
        pictures = 0

        def render(self, mode):
            self.pictures += 1

    env = begun(single_env(Shown, {LEFT: points()[LEFT]}, render_mode="human"))
    told = action_values(
        env, [1], futures=1, horizon=3, terminal_value=lambda env: env.simulation.pictures
    )
    assert told.means[0] == pytest.approx(worth("left", 1, futures_of(env, 1)[0], horizon=3) + 1)


@pytest.mark.thorough
@pytest.mark.parametrize("wrapper", [lambda env: env, pad_agents])
def test_action_values_count_rewards_of_steps_without_the_agent(wrapper):
    class Unannounced(Duel):
        def expected_calls(self, point):
            return []

    env = begun(wrapper(parallel_env(Unannounced, points(), possible_agents=["left", "right"])))
    table = expected(env, "left", horizon=2, discount=0.5)
    assert action_values(env, futures=3, horizon=2, discount=0.5).returns == pytest.approx(table)
    planner = RolloutPolicy((number for number in range(3)), futures=1, horizon=1)
    assert [planner.choose(env).best for _ in range(2)] == [2, 2]


def high(observation):
    return 2 if observation[0] > 1 else 0


@pytest.mark.parametrize(
    ("view", "candidate"),
    [("aec", 1), ("parallel", 1), ("turn", 1), ("joint", {"left": 1, "right": 1})],
    ids=str,
)
def test_rollout_policy_as_a_base_acts_by_its_own_base(view, candidate):
    plain, planned = (
        action_values(made(view), [candidate], base={"right": base}, futures=1).means.tolist()
        for base in (high, RolloutPolicy(base=high))
    )
    assert plain == planned


def without_base(observation, info, *, _environment):
    return 1


def with_base(base):
    def policy(observation, info, *, _environment):
        return 1

    policy.base = base
    return policy


@pytest.mark.parametrize(
    "base",
    [
        without_base,
        {"right": without_base},
        RolloutPolicy(base=without_base),
        {"right": with_base({"right": with_base(without_base)})},
    ],
)
@pytest.mark.parametrize("view", [*VIEWS, "joint", "turn"])
def test_action_values_refuse_a_planning_policy_without_a_base_as_base(view, base):
    env = made(view)
    if view == "single" and isinstance(base, dict):
        base = {"left": base["right"]}  # the only agent
    actions = [{"left": 1, "right": 1}] if view == "joint" else [1]
    for plan in (
        action_values,
        lambda *args, **given: RolloutPolicy(*args[1:], **given).choose(env),
    ):
        with pytest.raises(OptionValueError, match="set its attribute base"):
            plan(env, actions, base=base, futures=1)


@METHODS
def test_action_values_errors_keep_their_type_and_name_the_action(method):
    class Fragile(Duel):
        def run(self):
            return 1 / (self.left() - 2)

    env = made("single", Fragile)
    with pytest.raises(ZeroDivisionError) as raised:
        action_values(env, [2], futures=2, method=method)
    assert any("while 2 was tried out in future" in note for note in raised.value.__notes__)
