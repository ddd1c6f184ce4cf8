"""Sections 3 and 4: the names in ``points=``, and their effect on undecorated models."""

import gc
import sys
import threading
import types
from concurrent.futures import ThreadPoolExecutor
from time import sleep

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import RULE, aec_env, generate_env, simulate, single_env
from simenv_marl.core.copies import packing
from simenv_marl.core.copies.packing import pack, pack_plainly, unpack
from simenv_marl.core.plans.points import find_point, portable
from simenv_marl.errors import (
    AgentError,
    DefinitionError,
    PatchError,
    RewardError,
    UnknownPointError,
)
from simenv_marl.hooks.hook import hook_of, hooks
from simenv_marl.hooks.places import PlacedHook, resolve
from simenv_marl.plugins import handlers
from tests.foreign import market, shop
from tests.foreign.market import Broker, Cautious, Dealer, Junior, Trader
from tests.hooks.forms import BID, FORMS, MARKET, PLACES, found
from tests.worlds.models import (
    begun,
    calling,
    decision,
    decisions,
    define,
    left_as_they_were,
    plainly,
    play,
    script,
)

# Traders and brokers decide under one name here: it is about functions, and not about agents.
pytestmark = pytest.mark.filterwarnings("ignore:several objects decide")


@pytest.fixture(autouse=True)
def _nothing_stays_patched():
    with left_as_they_were(*PLACES):
        yield
        gc.collect()


def log_of(env, action=9):
    """What the simulation gets to see when one action answers everything."""
    play(env, action)
    return env.simulation.log


# -- forms ----------------------------------------------------------------------------------------


class Home:
    @define()
    def heat(self):
        return "heat"

    @define()
    def cool(self):
        return "cool"

    @define()
    @staticmethod
    def air():
        return "air"

    @define()
    @classmethod
    def light(cls):
        return "light"


class Cabin(Home):
    """Inherits its points together with their definitions."""


def home():
    return calling(
        *[lambda name=name: getattr(Cabin(), name)() for name in ("heat", "cool", "air", "light")]
    )


HOME, CABIN = f"{__name__}.Home", f"{__name__}.Cabin"


@pytest.mark.parametrize(
    ("points", "agents"),
    [
        (f"{HOME}.cool", ["cool_0"]),
        (Home.cool, ["cool_0"]),
        ([f"{CABIN}.cool", f"{CABIN}.air"], ["cool_0", "air_0"]),
        ([f"{HOME}.cool", Home.heat], ["cool_0", "heat_0"]),
        ((point for point in (Home.light, f"{HOME}.air")), ["light_0", "air_0"]),
        ({f"{HOME}.cool": define(agent="cooler_0"), Home.heat: define()}, ["cooler_0", "heat_0"]),
        ({Home.light: define(), f"{HOME}.air": define(agent="fan_0")}, ["light_0", "fan_0"]),
        (vars(Home)["air"], ["air_0"]),
        (vars(Home)["light"], ["light_0"]),
    ],
    ids=plainly,
)
def test_points_option_takes_all_documented_forms(points, agents):
    env = aec_env(home(), points)
    # in which the simulation calls them
    order = ["heat_0", "cool_0", "cooler_0", "air_0", "fan_0", "light_0"]
    assert env.possible_agents == agents
    assert decisions(play(env, 1)) == sorted(agents, key=order.index)
    assert env.simulation.log.count(1) == len(agents)  # what is not named runs its rule


@pytest.mark.parametrize(
    "points", [[Home.cool], f"{HOME}.cool", {Home.cool: define()}], ids=plainly
)
def test_points_option_defaults_to_the_simulations_points(points):
    simulation = script(lambda simulation: [Home().heat(), Home().cool()])()
    simulation.points = points
    for source in (simulation, lambda: simulation):
        assert decisions(play(aec_env(source))) == ["cool_0"]
        assert decisions(play(aec_env(source, Home.heat))) == ["heat_0"]


def test_points_option_defaults_to_decorated_functions_of_one_package(monkeypatch):
    registered = []
    monkeypatch.setattr("simenv_marl.core.plans.points.decision_points", lambda: registered)
    with pytest.raises(UnknownPointError, match="there is no decision point"):
        aec_env(home())
    registered += [f"{HOME}.cool", f"{HOME}.heat"]
    assert aec_env(home()).possible_agents == ["cool_0", "heat_0"]
    assert simulate(home(), {"heat_0": lambda seen: 7}).log == [7, "cool", "air", "light"]
    registered.append("other.third")
    with pytest.raises(UnknownPointError, match="other, tests"):
        aec_env(home())


# -- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("points", "error", "match"),
    [
        (".", UnknownPointError, "dotted name"),
        (MARKET, PatchError, None),
        (
            "no_such_package_at_all.function",
            UnknownPointError,
            "no module 'no_such_package_at_all'",
        ),
        (f"{__name__}.Missing.method", UnknownPointError, "has no 'Missing'"),
        (f"{HOME}.haet", UnknownPointError, r"has no 'haet'; did you mean .*Home\.heat"),
        ([], UnknownPointError, None),
        ({}, UnknownPointError, None),
        ([Home.heat, f"{HOME}.heat"], UnknownPointError, "twice"),
        (
            {f"{MARKET}.price": define(agent="a_0"), shop.cost: define(agent="b_0")},
            UnknownPointError,
            "twice",
        ),
        (
            {
                Home.heat: define(agent="pump_0"),
                Home.cool: define(agent="pump_0", action_space=spaces.Discrete(3)),
            },
            AgentError,
            "pump_0",
        ),
        (BID, DefinitionError, None),
        ({Trader.bid: lambda action: action}, DefinitionError, None),
        (
            {Trader.bid: define(), f"{MARKET}.Trader.quote": define()},
            PatchError,
            "not a function written",
        ),
        ({"random.random": define()}, PatchError, None),
        ({len: define()}, PatchError, None),
        ({Trader().bid: define()}, PatchError, None),
    ],
    ids=plainly,
)
def test_env_refuses_invalid_points(points, error, match):
    for make in (aec_env, generate_env):
        with pytest.raises(error, match=match):
            make(home(), points)


# -- undecorated models ---------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["by name", "as itself"])
@pytest.mark.parametrize(("name", "call", "rule"), FORMS.values(), ids=FORMS)
def test_undecorated_function_becomes_a_decision_point_by_its_name(name, call, rule, how):
    env = begun(aec_env(calling(call, call), {found(name, how): define()}))
    assert call() == rule  # for everybody else
    env.step(9)
    env.step(RULE)
    assert env.simulation.log == [9, rule]
    assert call() == rule


def test_decision_point_on_an_inherited_class_method_gets_the_called_class():
    seen = []
    env = aec_env(
        calling(lambda: Broker.opening(), lambda: Junior.opening(), lambda: Dealer.opening()),
        {
            f"{MARKET}.Broker.opening": define(
                observation_space_mapping=lambda cls: seen.append(cls) or [0, 0]
            )
        },
    )
    assert Broker.opening.__qualname__ == "Broker.opening"
    assert log_of(env) == [9, 9, 4]
    assert seen == [Broker, Junior, Junior]


BASE, SUB = {BID: define(agent="trader_0")}, {f"{MARKET}.Broker.bid": define(agent="broker_0")}


@pytest.mark.parametrize(
    "points", [(BASE, SUB), (SUB, BASE), (BASE | SUB, SUB), (SUB, BASE | SUB)], ids=plainly
)
def test_envs_of_a_base_class_and_a_subclass_can_be_used_together(points):
    def bids():
        return [kind().bid("tea") for kind in (Trader, Broker, Junior, Dealer, Cautious)]

    envs = [
        aec_env(script(lambda simulation: simulation.log.extend(bids())), named) for named in points
    ]
    for _ in range(2):  # the second time they patch again
        for env, named in zip(envs, points, strict=True):
            assert log_of(env) == ([5, 9, 9, 5, 4] if named is SUB else [9, 9, 9, 9, 8])
            # RULE for the broker runs what it has inherited, which may be a decision of its own.
            play(env, {"broker_0": RULE, "trader_0": 7})
            assert env.simulation.log == ([5, 5, 5, 5, 4] if named is SUB else [7, 7, 7, 7, 6])
        for env in envs:
            env.close()
        assert bids() == [5, 5, 5, 5, 4]


# -- restoring ------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", ["close", "collect", "collect in mid-episode"])
@pytest.mark.parametrize("name", ["Trader.rounded", "Trader.opening", "Broker.bid", "price"])
def test_model_functions_stay_patched_until_their_last_env_is_gone(name, end):
    owner, attribute = resolve(f"{MARKET}.{name}")
    before = vars(owner).get(attribute)
    simulation = calling(Broker().day, lambda: market.price("tea"))
    envs = [aec_env(simulation, {f"{MARKET}.{name}": define()}) for _ in range(3)]
    while envs:
        assert vars(owner)[attribute] is not before
        env = envs.pop(len(envs) // 2)
        if end == "collect in mid-episode":
            env.reset()
        if end == "close":
            env.close()
            env.close()
        del env
        gc.collect()
    assert vars(owner).get(attribute) is before


def test_env_patches_and_restores_modules_imported_in_mid_episode(monkeypatch):
    before, late = market.price, types.ModuleType("late_shop")
    monkeypatch.setitem(sys.modules, "late_shop", late)
    env = begun(
        aec_env(
            calling(lambda: market.price("tea"), lambda: late.asked("tea")),
            {f"{MARKET}.price": define()},
        )
    )
    exec("from tests.foreign.market import price as asked", vars(late))
    assert late.asked("tea") == 10
    env.step(3)
    env.step(4)
    assert env.simulation.log == [3, 4]
    env.close()
    assert before is late.asked is market.price is shop.price is shop.cost


@pytest.mark.parametrize("first", range(3))
def test_function_with_several_names_is_one_decision_point(first):
    before = market.price
    calls = [lambda: market.price("tea"), lambda: shop.total("tea"), lambda: shop.total_cost("tea")]
    names = [f"{MARKET}.price", "tests.foreign.shop.price", "tests.foreign.shop.cost"]
    envs = [aec_env(calling(*calls), {name: define()}) for name in names[first:] + names[:first]]
    assert [log_of(env) for env in envs] == [[9, 9, 9]] * 3
    for env in envs:
        env.close()
        assert log_of(envs[-1]) == log_of(envs[0]) == [9, 9, 9]
    for env in envs:
        env.close()
    assert before is market.price is shop.price is shop.cost
    assert [log_of(env) for env in envs] == [[9, 9, 9]] * 3  # used again


# -- environments of the same undecorated model ---------------------------------------------------


def test_envs_of_one_undecorated_model_can_have_different_definitions():
    other = decision()
    traders = calling(lambda: Trader().bid("tea"), other)
    one = aec_env(traders, {BID: define(action_space_mapping=lambda action: ("one", action))})
    two = aec_env(
        traders,
        {Trader.bid: define(action_space_mapping=lambda action: ("two", action), agent="b_0")},
    )
    one.reset()
    two.reset()
    assert log_of(aec_env(traders, other)) == [5, 9]
    one.step(1)
    two.step(2)
    assert one.simulation.log == [("one", 1), "rule"]
    assert two.simulation.log == [("two", 2), "rule"]
    assert (one.possible_agents, two.possible_agents) == (["bid_0"], ["b_0"])


def test_decision_point_in_a_local_class_works_without_a_decorator():
    class Local:
        def decide(self):
            return "rule"

    def decide():
        return "rule"

    local = Local()
    env = aec_env(calling(lambda: local.decide()), {Local.decide: define()})
    assert log_of(env) == [9]
    env.close()
    assert local.decide() == "rule"
    with pytest.raises(PatchError, match="is the name of another object"):
        aec_env(calling(decide), {decide: define()})


def test_threads_can_define_points_and_plugins_at_the_same_time(
    monkeypatch,
):
    def dawdle(hook, *args):
        sleep(1e-3)
        make(hook, *args)

    def work(_):
        meet.wait()
        registered = [define()(lambda: 0) for _ in range(100)]
        points = [find_point(name, define())[0] for name in names]
        with handlers(*[(called.append, name, "before") for name in names]):
            meet.wait()
            crowd.Plain().choose_0()
            meet.wait()
        meet.wait()
        for _ in range(5):
            env = aec_env(calling(lambda: crowd.Plain().choose_1()), {names[1]: define()})
            logs.append(log_of(env))
            env.close()
        return registered, points

    crowd, names = (
        types.ModuleType("crowd"),
        [f"crowd.Plain.choose_{number}" for number in range(20)],
    )
    crowd.Plain = type("Plain", (), {name.rpartition(".")[2]: lambda self: 0 for name in names})
    monkeypatch.setitem(sys.modules, "crowd", crowd)
    make, called, logs, meet = PlacedHook.__init__, [], [], threading.Barrier(8, timeout=30)
    monkeypatch.setattr(PlacedHook, "__init__", dawdle)
    with left_as_they_were(crowd.Plain), ThreadPoolExecutor(8) as threads:
        found = list(threads.map(work, range(8)))
    assert all(points == found[0][1] for _, points in found)
    assert {hook_of(choose) for registered, _ in found for choose in registered} <= set(hooks())
    assert len(called) == 8 * 8
    assert logs == [[9]] * 40


# -- in other processes ---------------------------------------------------------------------------


def test_decision_point_sent_to_a_process_is_the_existing_one_there(monkeypatch):
    local = decision(agent="local_0")
    point = hook_of(Home.heat)
    assert unpack(pack(point)) is point
    parcel = pack(hook_of(local))
    monkeypatch.setattr(packing, "_known", {})  # as in another process
    hook = unpack(parcel)
    assert unpack(parcel) is hook is not hook_of(local)
    assert hook.definition.agent == "local_0"


def test_decision_functions_are_sent_to_other_processes_by_name(monkeypatch):
    """The name leads there, whatever binds them: nothing is made anew."""
    functions = [Home.heat, Trader.bid, Home.light.__func__]
    assert [portable(function) for function in functions[:2]] == [f"{HOME}.heat", BID]
    assert portable(lambda: 0).__name__ == "<lambda>"
    parcels = list(map(pack, functions))
    monkeypatch.setattr(packing, "_known", {})  # as where nothing has come from yet
    assert list(map(unpack, parcels)) == functions


def test_decision_functions_of_a_notebook_are_sent_by_value(monkeypatch):
    main = sys.modules["__main__"]
    monkeypatch.delattr(main, "__file__", raising=False)
    with monkeypatch.context() as notebook:
        notebook.setattr(
            main, "Cell", type("Cell", (), {"__module__": "__main__", "value": 3}), raising=False
        )
        parcel = pack_plainly(main.Cell)
    assert unpack(parcel).value == 3


# -- dicts from functions -------------------------------------------------------------------------


def test_points_can_be_keyed_by_functions_while_other_envs_are_alive():
    """The class then has a wrapper, which is another key of the same point."""
    points = {Trader.bid: define(agent="old")}
    env = begun(aec_env(calling(lambda: Trader().bid("tea")), points))
    assert Trader.bid not in points
    changed = points | {Trader.bid: define(agent="new")}
    for given, agent in [(points, "old"), (changed, "new"), (changed, "new")]:
        other = begun(aec_env(calling(lambda: Trader().bid("tea")), given))
        assert other.agents == [agent]
        env.close()
    assert simulate(env.simulation, {Trader.bid: lambda _: 4}, points=changed).log == [4]
    with pytest.raises(UnknownPointError, match="was named twice"):
        aec_env(calling(Trader), {BID: define(), Trader.bid: define()})


# -- quick rewards --------------------------------------------------------------------------------


@pytest.mark.parametrize("others", [[], ["a difference that was made elsewhere"]])
def test_env_checks_every_reward_even_if_difference_is_not_used(others, monkeypatch):
    monkeypatch.setattr("simenv_marl.core.episodes.agent.DIFFERENCES", others)
    rewards = iter([0.0, 2, np.float32(0.5), "2", 0.0, float("nan")])
    decide = decision(reward_mapping=lambda: next(rewards))
    env = begun(single_env(calling(*[decide] * 4), decide))
    assert [repr(env.step(1)[1]) for _ in range(2)] == ["2.0", "0.5"]
    with pytest.raises(RewardError, match="not one number"):
        env.step(1)
    env.reset()
    with pytest.raises(RewardError, match="not finite"):
        env.step(1)


def test_decision_point_name_means_the_function_of_the_named_class():
    class Derived(Trader):
        bid = define(agent="derived")(Trader.bid)

    env = aec_env(calling(lambda: Trader().bid("wheat")), {BID: define(agent="base")})
    assert log_of(env) == [9]
    assert env.possible_agents == ["base"]
