"""Sections 3 and 4: what ``points=`` names, and what that does to models which nobody has decorated."""

import gc
import subprocess
import sys
import types
import weakref
from textwrap import dedent

import pytest

import simenv_marl
from simenv_marl import RULE, SimEnvError, generate_env
from simenv_marl.errors import AgentError, DefinitionError, PatchError, UnknownPointError
from tests.foreign import market, shop
from tests.foreign.market import Broker, Cautious, Dealer, Junior, Trader
from tests.worlds.models import Script, calling, decision, decisions, define, plainly, play

MARKET = "tests.foreign.market"

# Traders and brokers decide under one name here: it is about functions, and not about agents.
pytestmark = pytest.mark.filterwarnings("ignore:several objects decide")


OPEN: weakref.WeakSet = weakref.WeakSet()


def aec_env(simulation, points=None):
    env = simenv_marl.aec_env(simulation, points)
    OPEN.add(env)
    return env


@pytest.fixture(autouse=True)
def _nothing_stays_patched():
    places = [market, shop, Trader, Broker, Junior, Dealer, Cautious]
    before = [dict(vars(place)) for place in places]
    yield
    for env in list(OPEN):  # a failed test keeps its environments alive
        env.close()
    gc.collect()
    for place, held in zip(places, before, strict=True):
        now = {name: value for name, value in vars(place).items() if not name.startswith("__")}
        assert now == {name: value for name, value in held.items() if not name.startswith("__")}


def log_of(env, action=9):
    """What the simulation gets to see when one action answers everything."""
    play(env, action)
    return env.unwrapped.simulation.log


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


def home():
    return calling(*[lambda name=name: getattr(Home(), name)() for name in ("heat", "cool", "air", "light")])


HOME = f"{__name__}.Home"


@pytest.mark.parametrize(
    ("points", "agents"),
    [
        (f"{HOME}.cool", ["cool_0"]),
        (Home.cool, ["cool_0"]),
        ([Home.cool], ["cool_0"]),
        ([f"{HOME}.cool", Home.heat], ["heat_0", "cool_0"]),
        ((Home.light, Home.air), ["air_0", "light_0"]),
        ((point for point in (Home.light, f"{HOME}.air")), ["air_0", "light_0"]),
        ({f"{HOME}.cool": define(agent="cooler_0"), Home.heat: define()}, ["heat_0", "cooler_0"]),
        ({Home.light: define(), f"{HOME}.air": define(agent="fan_0")}, ["fan_0", "light_0"]),
        (vars(Home)["air"], ["air_0"]),
        (vars(Home)["light"], ["light_0"]),
    ],
    ids=plainly,
)
def test_points_in_all_forms(points, agents):
    env = aec_env(home(), points)
    assert decisions(play(env, 1)) == agents
    assert sorted(env.possible_agents) == sorted(agents)


def test_possible_agents_stand_in_the_order_of_points():
    points = [Home.light, Home.heat, Home.air]
    assert aec_env(home(), points).possible_agents == ["light_0", "heat_0", "air_0"]


def test_what_is_not_named_runs_its_rule():
    assert log_of(aec_env(home(), Home.cool), 1) == ["heat", 1, "air", "light"]


@pytest.mark.parametrize("where", ["class", "instance", "factory"])
def test_without_points_the_simulation_names_them(where):
    class Own(Script):
        def __init__(self):
            super().__init__(lambda simulation: [Home().heat(), Home().cool()])

    if where == "class":
        Own.points = [Home.cool]
        source = Own
    elif where == "instance":
        source = Own()
        source.points = f"{HOME}.cool"
    else:

        def source():
            made = Own()
            made.points = {Home.cool: define()}
            return made

    assert decisions(play(aec_env(source))) == ["cool_0"]
    assert decisions(play(aec_env(source, Home.heat))) == ["heat_0"]


def in_a_new_process(tmp_path, *, main, **modules):
    for name, text in modules.items():
        (tmp_path / f"{name}.py").write_text(dedent(text))
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", dedent(main)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.split()


MODEL = """
    from gymnasium import spaces
    from simenv_marl import make_step
    define = make_step(
        observation_space=spaces.Discrete(2), observation_space_mapping=lambda: 0,
        action_space=spaces.Discrete(2), action_space_mapping=lambda a: a, reward_mapping=lambda: 0)
    @define
    def second(): return 0
    @define
    def first(): return 0
    class Simulation:
        def reset(self): pass
        def run(self):
            first()
            second()
"""


OTHER = """
    from model import define
    @define
    def third(): return 0
"""


def test_without_points_all_registered_ones_are_meant(tmp_path):
    main = """
        from simenv_marl import aec_env
        from model import Simulation
        env = aec_env(Simulation)
        env.reset()
        print(*env.possible_agents, env.agent_selection)
    """
    assert in_a_new_process(tmp_path, main=main, model=MODEL) == ["second_0", "first_0", "first_0"]


def test_without_points_those_of_more_than_one_package_are_refused(tmp_path):
    main = """
        import pytest, other
        from simenv_marl import aec_env, single_env
        from simenv_marl.errors import UnknownPointError
        from model import Simulation, first
        with pytest.raises(UnknownPointError, match="model.*other|other.*model"):
            aec_env(Simulation)
        env = single_env(Simulation, first)
        env.reset()
    """
    in_a_new_process(
        tmp_path, main=main, model=MODEL, other="from model import define\n@define\ndef third(): return 0\n"
    )


def test_without_any_point_nothing_can_be_made(tmp_path):
    main = """
        import pytest
        from simenv_marl import aec_env
        from simenv_marl.errors import UnknownPointError
        class Simulation:
            def reset(self): pass
            def run(self): pass
        with pytest.raises(UnknownPointError):
            aec_env(Simulation)
    """
    in_a_new_process(tmp_path, main=main)


# -- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("points", "error"),
    [
        ("nowhere.to.be.found", UnknownPointError),
        ("nowhere", UnknownPointError),
        ("", UnknownPointError),
        (".", UnknownPointError),
        (MARKET, PatchError),
        (f"{MARKET}.Trader.missing", UnknownPointError),
        (f"{MARKET}.Missing.bid", UnknownPointError),
        (f"{MARKET}.missing", UnknownPointError),
        ([], UnknownPointError),
        ({}, UnknownPointError),
        ([Home.heat, f"{HOME}.heat"], UnknownPointError),
        (f"{MARKET}.Trader.bid", DefinitionError),
        (Trader.bid, DefinitionError),
        ({Trader.bid: None}, DefinitionError),
        ({Trader.bid: lambda action: action}, DefinitionError),
        ({Home.heat: "heat"}, DefinitionError),
        ({f"{MARKET}.Trader.quote": define()}, PatchError),
        ({f"{MARKET}.Trader.fee": define()}, PatchError),
        ({f"{MARKET}.Trader": define()}, PatchError),
        ({f"{MARKET}.OPEN": define()}, PatchError),
        ({f"{MARKET}.cached_price": define()}, PatchError),
        ({"math.sqrt": define()}, PatchError),
        ({"builtins.len": define()}, PatchError),
        ({"builtins.list.append": define()}, PatchError),
        ({"datetime.datetime.now": define()}, PatchError),
        ({"random.random": define()}, PatchError),
        ({len: define()}, PatchError),
        ({Trader().bid: define()}, PatchError),
        ({3: define()}, PatchError),
        ([None], SimEnvError),
    ],
    ids=plainly,
)
def test_points_that_cannot_be_decided_are_refused_at_construction(points, error):
    for make in (aec_env, generate_env):
        with pytest.raises(error) as caught:
            make(home(), points)
        assert isinstance(caught.value, SimEnvError)


def test_a_slip_of_the_pen_gets_a_hint():
    with pytest.raises(UnknownPointError, match=r"Home\.heat"):
        aec_env(home(), f"{HOME}.haet")


def test_a_refusal_leaves_nothing_patched():
    before = vars(Trader)["bid"]
    with pytest.raises(PatchError, match="not a function written"):
        aec_env(home(), {f"{MARKET}.Trader.bid": define(), f"{MARKET}.Trader.quote": define()})
    assert vars(Trader)["bid"] is before


def test_a_class_that_refuses_to_be_patched_is_refused_at_construction():
    class Sealing(type):
        def __setattr__(cls, name, value):
            raise TypeError("sealed")

    class Sealed(metaclass=Sealing):
        def decide(self):
            return 0

    sealed = types.ModuleType("sealed_model")
    sealed.Sealed = Sealed
    sys.modules["sealed_model"] = sealed
    try:
        with pytest.raises(PatchError, match="cannot be a decision point"):
            aec_env(
                calling(Sealed().decide),
                {"tests.foreign.market.price": define(), "sealed_model.Sealed.decide": define()},
            )
        assert not hasattr(market.price, "__wrapped__")
    finally:
        del sys.modules["sealed_model"]


def test_two_points_with_the_same_agent_are_refused():
    with pytest.raises(AgentError, match="pump_0"):
        aec_env(home(), {Home.heat: define(agent="pump_0"), Home.cool: define(agent="pump_0")})


# -- undecorated models ---------------------------------------------------------------------------


def exhaust(generator):
    try:
        next(generator)
        generator.send(1)
    except StopIteration as stop:
        return stop.value


def await_(coroutine):
    try:
        coroutine.send(None)
    except StopIteration as stop:
        return stop.value


@pytest.mark.parametrize(
    ("name", "call", "rule"),
    [
        ("Trader.bid", lambda: Trader().bid("tea"), 5),
        ("Trader.bid", lambda: Broker().bid("tea", limit=6), 6),
        ("Trader.bid", lambda: Cautious().bid("tea") + 1, 5),
        ("Trader.rounded", lambda: Trader.rounded(2.5), 2),
        ("Trader.rounded", lambda: Dealer().rounded(2.5), 2),
        ("Trader.opening", lambda: Trader.opening(), 1),
        ("Trader.opening", lambda: Junior().opening(), 3),
        ("Trader.haggle", lambda: exhaust(Trader().haggle("tea")), 51),
        ("Trader.wire", lambda: await_(Trader().wire(8)), 8),
        ("Trader.__hidden", lambda: Trader().look(), 7),
        ("price", lambda: market.price("tea", rebate=2), 8),
        ("price", lambda: shop.total("tea"), 10),
        ("price", lambda: shop.total_cost("tea"), 9),
        ("Broker.bid", lambda: Broker().bid("tea"), 5),
        ("Broker.rounded", lambda: Broker.rounded(2.5), 2),
        ("Broker.rounded", lambda: Junior().rounded(2.5), 2),
        ("Broker.opening", lambda: Broker.opening(), 2),
        ("Broker.opening", lambda: Junior.opening(), 3),
        ("Broker.haggle", lambda: exhaust(Broker().haggle("tea")), 51),
        ("Broker.wire", lambda: await_(Broker().wire(8)), 8),
    ],
)
def test_a_plain_function_becomes_a_decision_point_by_its_name(name, call, rule):
    env = aec_env(calling(call, call), {f"{MARKET}.{name}": define()})
    env.reset()
    assert call() == rule  # for everybody else
    env.step(9)
    env.step(RULE)
    assert env.unwrapped.simulation.log[1] == rule
    assert env.unwrapped.simulation.log[0] in (9, 10)  # 10: by the call's own + 1
    assert call() == rule


@pytest.mark.parametrize(
    ("function", "call"),
    [
        (Trader.bid, lambda: Trader().bid("tea")),
        (Trader.rounded, lambda: Trader.rounded(2.5)),
        (Trader.opening, lambda: Trader.opening()),
        (market.price, lambda: shop.total("tea")),
        (shop.cost, lambda: shop.total_cost("tea")),
    ],
)
def test_a_plain_function_becomes_a_decision_point_as_itself(function, call):
    assert log_of(aec_env(calling(call), {function: define()})) == [9]


def test_the_standard_library_can_be_decided_too():
    import statistics

    before = statistics.mean
    env = aec_env(calling(lambda: statistics.mean([1, 2, 3])), {"statistics.mean": define(agent="mean_0")})
    assert log_of(env) == [9]
    assert statistics.mean([1, 2, 3]) == 2
    env.close()
    assert statistics.mean is before


def test_a_patched_function_keeps_its_looks():
    import inspect

    env = aec_env(calling(lambda: 0), {f"{MARKET}.Broker.bid": define(), f"{MARKET}.price": define()})
    assert str(inspect.signature(Broker.bid)) == "(self, good: str, limit: int = 5) -> int"
    assert Broker.bid.__name__ == "bid"
    assert Broker.bid.__doc__ == "The most that this trader pays."
    assert str(inspect.signature(market.price)) == "(good: str, *, rebate: int = 0) -> int"
    assert market.price.__module__ == MARKET
    env.close()


BASE, SUB = {f"{MARKET}.Trader.bid": define()}, {f"{MARKET}.Broker.bid": define()}


def all_bids():
    kinds = (Trader, Broker, Junior, Dealer, Cautious)
    return calling(*[lambda kind=kind: kind().bid("tea") for kind in kinds])


def test_an_inherited_method_is_decided_for_its_class_and_its_subclasses():
    env = aec_env(all_bids(), SUB)
    assert "bid" in vars(Broker)
    assert log_of(env) == [5, 9, 9, 5, 4]
    env.close()
    assert "bid" not in vars(Broker)


def test_a_base_classes_method_is_decided_wherever_it_runs():
    env = aec_env(all_bids(), BASE)
    assert log_of(env) == [9, 9, 9, 9, 8]


def test_an_inherited_classmethod_gets_its_class():
    seen = []
    env = aec_env(
        calling(lambda: Broker.opening(), lambda: Junior.opening(), lambda: Dealer.opening()),
        {f"{MARKET}.Broker.opening": define(observation_space_mapping=lambda cls: seen.append(cls) or [0, 0])},
    )
    assert log_of(env) == [9, 9, 4]
    assert seen == [Broker, Junior, Junior]


def test_an_inherited_decorated_method_is_decided_for_the_class_that_is_named():
    class_name = f"{__name__}.Kitchen.heat"
    for points in (class_name, {class_name: define()}):
        env = aec_env(calling(*[lambda kind=kind: kind().heat() for kind in (Home, Kitchen, Cellar)]), points)
        assert log_of(env) == ["heat", 9, "heat"]


class Kitchen(Home):
    pass


class Cellar(Home):
    pass


def test_base_and_subclass_may_both_be_points():
    env = aec_env(
        calling(lambda: Trader().bid("tea"), lambda: Broker().bid("tea")),
        {f"{MARKET}.Trader.bid": define(agent="trader_0"), f"{MARKET}.Broker.bid": define(agent="broker_0")},
    )
    # RULE for the broker runs what it has inherited, which is a decision of its own.
    turns = play(env, {"broker_0": RULE, "trader_0": 7})
    assert decisions(turns) == ["trader_0", "broker_0", "trader_0"]
    assert env.unwrapped.simulation.log == [7, 7]


def opened(env):
    OPEN.add(env)
    return env


def bids():
    return calling(lambda: Trader().bid("tea"), lambda: Broker().bid("tea"))


@pytest.mark.parametrize(("first", "second"), [(BASE, SUB), (SUB, BASE)], ids=["base-first", "subclass-first"])
@pytest.mark.parametrize("closed", [0, 1])
def test_environments_of_a_base_class_and_of_a_subclass_get_along(first, second, closed):
    expected = {id(BASE): [9, 9], id(SUB): [5, 9]}
    one, two = aec_env(bids(), first), aec_env(bids(), second)
    assert log_of(one) == expected[id(first)]
    assert log_of(two) == expected[id(second)]
    gone, left = ((one, first), (two, second))[:: 1 if closed == 0 else -1]
    gone[0].close()
    assert log_of(left[0]) == expected[id(left[1])]
    assert (Trader().bid("tea"), Broker().bid("tea")) == (5, 5)
    left[0].close()
    assert (Trader().bid("tea"), Broker().bid("tea")) == (5, 5)
    assert "bid" not in vars(Broker)


def test_an_environment_of_a_subclass_is_used_again_while_one_of_the_base_class_lives():
    sub = aec_env(bids(), SUB)
    assert log_of(sub) == [5, 9]
    sub.close()
    base = aec_env(bids(), BASE)
    assert log_of(sub) == [5, 9]
    assert log_of(base) == [9, 9]
    base.close()
    assert log_of(sub) == [5, 9]


def test_a_class_of_environments_of_a_subclass_outlives_one_of_the_base_class():
    sub_class = generate_env(bids(), SUB, view="aec")
    base = aec_env(bids(), BASE)
    assert log_of(opened(sub_class())) == [5, 9]
    base.close()
    assert log_of(opened(sub_class())) == [5, 9]


def test_a_class_made_while_the_base_class_was_decided_outlives_that():
    base = aec_env(bids(), BASE)
    sub_class = generate_env(bids(), SUB, view="aec")
    assert log_of(opened(sub_class())) == [5, 9]
    base.close()
    gc.collect()
    assert log_of(opened(sub_class())) == [5, 9]


class Animal:
    def move(self):
        return "rule"


class Wolf(Animal):
    pass


class Sheep(Animal):
    pass


Wolf.move = define(action_space_mapping=lambda action: ("wolf", action))(Wolf.move)
Sheep.move = define(action_space_mapping=lambda action: ("sheep", action))(Sheep.move)


def animals():
    return calling(*[lambda kind=kind: kind().move() for kind in (Animal, Wolf, Sheep)])


@pytest.mark.parametrize(
    ("points", "log"),
    [
        (Wolf.move, ["rule", ("wolf", 9), "rule"]),
        (Sheep.move, ["rule", "rule", ("sheep", 9)]),
        (f"{__name__}.Wolf.move", ["rule", ("wolf", 9), "rule"]),
        (f"{__name__}.Sheep.move", ["rule", "rule", ("sheep", 9)]),
        ([Wolf.move, Sheep.move], ["rule", ("wolf", 9), ("sheep", 9)]),
        ([f"{__name__}.Sheep.move", f"{__name__}.Wolf.move"], ["rule", ("wolf", 9), ("sheep", 9)]),
    ],
    ids=["wolf", "sheep", "wolf-by-name", "sheep-by-name", "both", "both-by-name"],
)
def test_siblings_may_each_decorate_what_they_have_inherited(points, log):
    assert log_of(aec_env(animals(), points)) == log


# -- restoring ------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", ["close", "collect"])
@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("Trader.bid", Trader),
        ("Trader.rounded", Trader),
        ("Trader.opening", Trader),
        ("price", market),
        ("price", shop),
    ],
)
def test_patches_last_until_the_last_environment_is_gone(name, place, end):
    attribute = name.rpartition(".")[2]
    before = vars(place)[attribute]
    envs = [aec_env(calling(Trader().bid), {f"{MARKET}.{name}": define()}) for _ in range(3)]
    while envs:
        assert vars(place)[attribute] is not before
        env = envs.pop(1 if len(envs) > 1 else 0)
        if end == "close":
            env.close()
            env.close()
        del env
        gc.collect()
    assert vars(place)[attribute] is before


def test_collection_in_mid_episode_restores_too():
    before = Trader.bid
    env = aec_env(calling(lambda: Trader().bid("tea")), {f"{MARKET}.Trader.bid": define()})
    env.reset()
    del env
    gc.collect()
    assert Trader.bid is before


def test_a_closed_environment_patches_again_when_it_is_reset():
    before = Trader.bid
    env = aec_env(calling(lambda: Trader().bid("tea")), {f"{MARKET}.Trader.bid": define()})
    for _ in range(3):
        assert log_of(env) == [9]
        env.close()
        assert Trader.bid is before


def test_a_class_of_environments_patches_nothing_before_there_is_one():
    before = Trader.bid
    env_class = generate_env(calling(lambda: Trader().bid("tea")), {f"{MARKET}.Trader.bid": define()})
    assert Trader.bid is before
    env = env_class()
    env.close()
    assert Trader.bid is before


def test_modules_that_are_imported_meanwhile_are_restored_too():
    before = market.price
    env = aec_env(calling(lambda: market.price("tea")), {f"{MARKET}.price": define()})
    late = types.ModuleType("late_shop")
    sys.modules["late_shop"] = late
    try:
        exec("from tests.foreign.market import price as asked", vars(late))
        assert late.asked("tea") == 10
        env.close()
        assert late.asked is before
        assert market.price is before
        assert shop.price is before
        assert shop.cost is before
    finally:
        del sys.modules["late_shop"]


def test_modules_that_are_imported_between_reset_and_step_are_restored_and_decide():
    env = aec_env(
        calling(lambda: market.price("tea"), lambda: sys.modules["late_shop"].asked("tea")),
        {f"{MARKET}.price": define()},
    )
    env.reset()
    late = types.ModuleType("late_shop")
    sys.modules["late_shop"] = late
    try:
        exec("from tests.foreign.market import price as asked", vars(late))
        env.step(3)
        env.step(4)
        assert env.unwrapped.simulation.log == [3, 4]
        env.close()
    finally:
        del sys.modules["late_shop"]


def test_somebody_elses_patch_meanwhile_is_left_alone():
    before = vars(Trader)["bid"]
    env = aec_env(calling(lambda: Trader().bid("tea")), {f"{MARKET}.Trader.bid": define()})

    def replacement(self, good, limit=5):
        return 0

    Trader.bid = replacement
    try:
        env.close()
        assert Trader.bid is replacement
    finally:
        Trader.bid = before


def priced():
    return calling(lambda: market.price("tea"), lambda: shop.total("tea"), lambda: shop.total_cost("tea"))


PRICES = [f"{MARKET}.price", "tests.foreign.shop.price", "tests.foreign.shop.cost"]


@pytest.mark.parametrize("first", range(3))
def test_one_function_under_many_names_is_one_point(first):
    before = market.price
    classes = [generate_env(priced(), {name: define()}, view="aec") for name in PRICES[first:] + PRICES[:first]]
    envs = [opened(env_class()) for env_class in classes]
    for env in envs:
        assert log_of(env) == [9, 9, 9]
    for env in envs:
        env.close()
        assert log_of(envs[-1]) == [9, 9, 9]
        assert log_of(envs[0]) == [9, 9, 9]
    for env in envs:
        env.close()
    assert before is market.price is shop.price is shop.cost


def test_one_function_under_many_names_is_one_point_for_environments_that_are_used_again():
    one = aec_env(priced(), {PRICES[0]: define()})
    one.close()
    two = aec_env(priced(), {PRICES[1]: define()})
    assert log_of(one) == log_of(two) == [9, 9, 9]


def test_one_function_under_two_names_is_named_twice():
    with pytest.raises(UnknownPointError, match="twice"):
        aec_env(priced(), {PRICES[0]: define(agent="a_0"), PRICES[1]: define(agent="b_0")})


# -- environments of the same undecorated model ---------------------------------------------------


def test_a_patch_is_a_decision_point_for_the_environments_that_named_it_alone():
    @define()
    def other():
        return "other"

    def traders():
        return calling(lambda: Trader().bid("tea"), other)

    asks = aec_env(traders(), {f"{MARKET}.Trader.bid": define()})
    does_not = aec_env(traders(), other)
    asks.reset()
    assert log_of(does_not) == [5, 9]
    assert log_of(asks) == [9, "other"]


def test_two_environments_may_define_the_same_undecorated_point_differently():
    def call():
        return Trader().bid("tea")

    one = aec_env(calling(call), {f"{MARKET}.Trader.bid": define(action_space_mapping=lambda action: ("one", action))})
    two = aec_env(calling(call), {Trader.bid: define(action_space_mapping=lambda action: ("two", action), agent="b_0")})
    one.reset()
    two.reset()
    one.step(1)
    two.step(2)
    assert one.unwrapped.simulation.log == [("one", 1)]
    assert two.unwrapped.simulation.log == [("two", 2)]
    assert (one.possible_agents, two.possible_agents) == (["bid_0"], ["b_0"])


def test_local_classes_are_found_by_their_functions():
    class Local:
        def decide(self):
            return "rule"

    local = Local()
    env = aec_env(calling(lambda: local.decide()), {Local.decide: define()})
    assert log_of(env) == [9]
    env.close()
    assert local.decide() == "rule"


def test_local_functions_without_a_class_must_be_decorated():
    def decide():
        return "rule"

    with pytest.raises(PatchError, match="is the name of another object"):
        aec_env(calling(decide), {decide: define()})
    decorated = decision(decide)
    assert log_of(aec_env(calling(decorated), decorated)) == [9]
