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
from simenv_marl.errors import AgentError, DefinitionError, NoDecisionError, PatchError, UnknownPointError
from tests.foreign import market, shop
from tests.foreign.market import Broker, Cautious, Dealer, Junior, Trader
from tests.hooks.forms import BID, FORMS, MARKET, PLACES, found
from tests.worlds.models import Script, calling, decision, decisions, define, plainly, play
from tests.worlds.undone import left_as_they_were

# Traders and brokers decide under one name here: it is about functions, and not about agents.
pytestmark = pytest.mark.filterwarnings("ignore:several objects decide")


OPEN: weakref.WeakSet = weakref.WeakSet()


def aec_env(simulation, points=None):
    env = simenv_marl.aec_env(simulation, points)
    OPEN.add(env)
    return env


@pytest.fixture(autouse=True)
def _nothing_stays_patched():
    with left_as_they_were(*PLACES):
        yield
        for env in list(OPEN):  # a failed test keeps its environments alive
            env.close()
        gc.collect()


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

    def dry(self):
        return "dry"


def home():
    return calling(*[lambda name=name: getattr(Home(), name)() for name in ("heat", "cool", "air", "light")])


HOME = f"{__name__}.Home"


@pytest.mark.parametrize(
    ("points", "agents"),
    [
        (f"{HOME}.cool", ["cool_0"]),
        (Home.cool, ["cool_0"]),
        ([f"{HOME}.cool", Home.heat], ["cool_0", "heat_0"]),
        ((Home.light, Home.air), ["light_0", "air_0"]),
        ((point for point in (Home.light, f"{HOME}.air")), ["light_0", "air_0"]),
        ({f"{HOME}.cool": define(agent="cooler_0"), Home.heat: define()}, ["cooler_0", "heat_0"]),
        ({Home.light: define(), f"{HOME}.air": define(agent="fan_0")}, ["light_0", "fan_0"]),
        (vars(Home)["air"], ["air_0"]),
        (vars(Home)["light"], ["light_0"]),
    ],
    ids=plainly,
)
def test_points_in_all_forms(points, agents):
    env = aec_env(home(), points)
    order = ["heat_0", "cool_0", "cooler_0", "air_0", "fan_0", "light_0"]  # in which the simulation calls them
    assert env.possible_agents == agents
    assert decisions(play(env, 1)) == sorted(agents, key=order.index)
    assert env.unwrapped.simulation.log.count(1) == len(agents)  # what is not named runs its rule


@pytest.mark.parametrize("where", ["class", "instance", "factory"])
def test_without_points_the_simulation_names_them(where):
    class Own(Script):
        def __init__(self):
            super().__init__(lambda simulation: [Home().heat(), Home().cool()])
            if where == "factory":
                self.points = {Home.cool: define()}

    source = {"class": Own, "instance": Own(), "factory": lambda: Own()}[where]
    if where != "factory":
        source.points = f"{HOME}.cool" if where == "instance" else [Home.cool]
    assert decisions(play(aec_env(source))) == ["cool_0"]
    assert decisions(play(aec_env(source, Home.heat))) == ["heat_0"]


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


def test_without_points_all_registered_ones_of_one_package_are_meant(tmp_path):
    main = """
        import pytest
        from simenv_marl import aec_env, single_env
        from simenv_marl.errors import UnknownPointError
        class Simulation:
            def reset(self): pass
            def run(self): pass
        with pytest.raises(UnknownPointError):
            aec_env(Simulation)
        from model import Simulation, first
        env = aec_env(Simulation)
        env.reset()
        print(*env.possible_agents, env.agent_selection)
        import other
        with pytest.raises(UnknownPointError, match="model.*other|other.*model"):
            aec_env(Simulation)
        single_env(Simulation, first).reset()
    """
    (tmp_path / "model.py").write_text(dedent(MODEL))
    (tmp_path / "other.py").write_text("from model import define\n@define\ndef third(): return 0\n")
    command = [sys.executable, "-W", "error", "-c", dedent(main)]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stdout) == (0, "second_0 first_0 first_0\n"), result.stderr


# -- what is refused ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("points", "error", "match"),
    [
        ("nowhere", UnknownPointError, "dotted name"),
        ("", UnknownPointError, "dotted name"),
        (".", UnknownPointError, "dotted name"),
        (MARKET, PatchError, None),
        (f"{HOME}.haet", UnknownPointError, r"Home\.heat"),
        ([], UnknownPointError, None),
        ({}, UnknownPointError, None),
        ([Home.heat, f"{HOME}.heat"], UnknownPointError, "twice"),
        ({f"{MARKET}.price": define(agent="a_0"), shop.cost: define(agent="b_0")}, UnknownPointError, "twice"),
        ({Home.heat: define(agent="pump_0"), Home.cool: define(agent="pump_0")}, AgentError, "pump_0"),
        (BID, DefinitionError, None),
        (Trader.bid, DefinitionError, None),
        ({Trader.bid: None}, DefinitionError, None),
        ({Trader.bid: lambda action: action}, DefinitionError, None),
        ({Home.heat: "heat"}, DefinitionError, None),
        ({Trader.bid: define(), f"{MARKET}.Trader.quote": define()}, PatchError, "not a function written"),
        ({f"{MARKET}.Trader.fee": define()}, PatchError, None),
        ({f"{MARKET}.cached_price": define()}, PatchError, None),
        ({"math.sqrt": define()}, PatchError, None),
        ({"builtins.list.append": define()}, PatchError, None),
        ({"random.random": define()}, PatchError, None),
        ({len: define()}, PatchError, None),
        ({Trader().bid: define()}, PatchError, None),
        ({3: define()}, PatchError, None),
        ([None], SimEnvError, None),
    ],
    ids=plainly,
)
def test_points_that_cannot_be_decided_are_refused_at_construction(points, error, match):
    for make in (aec_env, generate_env):
        with pytest.raises(error, match=match) as caught:
            make(home(), points)
        assert isinstance(caught.value, SimEnvError)


@pytest.mark.parametrize(("error", "raised"), [(TypeError, PatchError), (ZeroDivisionError, ZeroDivisionError)])
def test_if_one_place_cannot_be_set_none_is(error, raised):
    class Sealing(type):
        def __setattr__(cls, name, value):
            if sealed:
                raise error("sealed")
            super().__setattr__(name, value)

    class Vault(metaclass=Sealing):
        def open(self):
            return "rule"

    points = {f"{MARKET}.price": define(), Vault.open: define()}
    made = generate_env(calling(lambda: Vault().open()), points, plugins=[(lambda *args: None, BID, "before")])
    sealed, bid, before = [True], vars(Trader)["bid"], vars(Vault)["open"]
    with pytest.raises(raised, match="sealed"):
        made()
    gc.collect()
    assert vars(Trader)["bid"] is bid
    assert vars(Vault)["open"] is before
    assert not hasattr(market.price, "__wrapped__")
    sealed.clear()
    env = opened(made())
    assert log_of(env) == [9]
    env.close()
    assert vars(Vault)["open"] is before


# -- undecorated models ---------------------------------------------------------------------------


@pytest.mark.parametrize("how", ["by name", "as itself"])
@pytest.mark.parametrize(("name", "call", "rule"), FORMS.values(), ids=FORMS)
def test_a_plain_function_becomes_a_decision_point(name, call, rule, how):
    env = aec_env(calling(call, call), {found(name, how): define()})
    env.reset()
    assert call() == rule  # for everybody else
    env.step(9)
    env.step(RULE)
    assert env.unwrapped.simulation.log == [9, rule]
    assert call() == rule


BASE, SUB = {BID: define()}, {f"{MARKET}.Broker.bid": define()}


def test_what_is_inherited_is_decided_for_the_class_that_is_named_and_gets_the_class_that_was_called():
    seen = []
    env = aec_env(
        calling(lambda: Broker.opening(), lambda: Junior.opening(), lambda: Dealer.opening()),
        {f"{MARKET}.Broker.opening": define(observation_space_mapping=lambda cls: seen.append(cls) or [0, 0])},
    )
    assert log_of(env) == [9, 9, 4]
    assert seen == [Broker, Junior, Junior]
    name = f"{__name__}.Kitchen.heat"
    for points in (name, {name: define()}):
        env = aec_env(calling(*[lambda kind=kind: kind().heat() for kind in (Home, Kitchen, Cellar)]), points)
        assert log_of(env) == ["heat", 9, "heat"]


class Kitchen(Home):
    pass


class Cellar(Home):
    pass


Kitchen.dry = define(action_space_mapping=lambda action: ("kitchen", action))(Kitchen.dry)
Cellar.dry = define(action_space_mapping=lambda action: ("cellar", action))(Cellar.dry)


def test_base_and_subclass_may_both_be_points():
    env = aec_env(
        calling(lambda: Trader().bid("tea"), lambda: Broker().bid("tea")),
        {BID: define(agent="trader_0"), f"{MARKET}.Broker.bid": define(agent="broker_0")},
    )
    # RULE for the broker runs what it has inherited, which is a decision of its own.
    turns = play(env, {"broker_0": RULE, "trader_0": 7})
    assert decisions(turns) == ["trader_0", "broker_0", "trader_0"]
    assert env.unwrapped.simulation.log == [7, 7]


def opened(env):
    OPEN.add(env)
    return env


BIDDERS = (Trader, Broker, Junior, Dealer, Cautious)


@pytest.mark.parametrize(("first", "second"), [(BASE, SUB), (SUB, BASE)], ids=["base-first", "subclass-first"])
@pytest.mark.parametrize("closed", [0, 1])
def test_environments_of_a_base_class_and_of_a_subclass_get_along(first, second, closed):
    bids, envs, classes = calling(*[lambda kind=kind: kind().bid("tea") for kind in BIDDERS]), [], []
    expected = [[9, 9, 9, 9, 8] if points is BASE else [5, 9, 9, 5, 4] for points in (first, second)]
    for points in (first, second):  # the second ones are made while the first environment is there
        envs.append(aec_env(bids, points))
        classes.append(generate_env(bids, points, view="aec"))
    assert [log_of(env) for env in envs] == expected
    for number in (closed, 1 - closed):
        envs[number].close()
        assert log_of(envs[1 - closed]) == expected[1 - closed]
        assert [log_of(opened(env_class())) for env_class in classes] == expected
        assert log_of(envs[number]) == expected[number]
        envs[number].close()
        gc.collect()
    assert [kind().bid("tea") for kind in BIDDERS] == [5, 5, 5, 5, 4]
    assert "bid" not in vars(Broker)


@pytest.mark.parametrize(
    ("points", "log"),
    [
        (Kitchen.dry, ["dry", ("kitchen", 9), "dry"]),
        (f"{__name__}.Cellar.dry", ["dry", "dry", ("cellar", 9)]),
        ([Cellar.dry, f"{__name__}.Kitchen.dry"], ["dry", ("kitchen", 9), ("cellar", 9)]),
    ],
    ids=["one", "one by name", "both"],
)
def test_siblings_may_each_decorate_what_they_have_inherited(points, log):
    rooms = calling(*[lambda kind=kind: kind().dry() for kind in (Home, Kitchen, Cellar)])
    assert log_of(aec_env(rooms, points)) == log


def test_a_point_that_is_never_called_is_named():
    env = aec_env(calling(lambda: Trader().bid("tea")), SUB)
    with pytest.raises(NoDecisionError, match=r"without a decision of .*Broker\.bid; does the simulation call"):
        env.reset()


# -- restoring ------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", ["close", "collect", "collect in mid-episode"])
@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("Trader.bid", Trader),
        ("Trader.rounded", Trader),
        ("Trader.opening", Trader),
        ("Broker.bid", Broker),
        ("price", market),
        ("price", shop),
    ],
)
def test_patches_last_until_the_last_environment_is_gone(name, place, end):
    attribute = name.rpartition(".")[2]
    before = vars(place).get(attribute)
    simulation = calling(Trader().day, lambda: Broker().bid("tea"), lambda: shop.total("tea"))
    envs = [aec_env(simulation, {f"{MARKET}.{name}": define()}) for _ in range(3)]
    while envs:
        patched = vars(place)[attribute]
        assert patched is not before
        assert place in (market, shop) or type(patched) is type(vars(Trader)[attribute])
        env = envs.pop(1 if len(envs) > 1 else 0)
        if end == "collect in mid-episode":
            env.reset()
        if end == "close":
            env.close()
            env.close()
        del env
        gc.collect()
    assert vars(place).get(attribute) is before


def test_a_closed_environment_patches_again_when_it_is_reset():
    before = Trader.bid
    env_class = generate_env(calling(lambda: Trader().bid("tea")), BASE, view="aec")
    assert Trader.bid is before
    env = opened(env_class())
    for _ in range(3):
        assert log_of(env) == [9]
        env.close()
        assert Trader.bid is before


def test_modules_that_are_imported_between_reset_and_step_decide_and_are_restored(monkeypatch):
    before, late = market.price, types.ModuleType("late_shop")
    monkeypatch.setitem(sys.modules, "late_shop", late)
    env = aec_env(calling(lambda: market.price("tea"), lambda: late.asked("tea")), {f"{MARKET}.price": define()})
    env.reset()
    exec("from tests.foreign.market import price as asked", vars(late))
    assert late.asked("tea") == 10
    env.step(3)
    env.step(4)
    assert env.unwrapped.simulation.log == [3, 4]
    env.close()
    assert before is late.asked is market.price is shop.price is shop.cost


@pytest.mark.parametrize("first", range(3))
def test_one_function_under_many_names_is_one_point(first):
    before = market.price
    calls = [lambda: market.price("tea"), lambda: shop.total("tea"), lambda: shop.total_cost("tea")]
    names = [f"{MARKET}.price", "tests.foreign.shop.price", "tests.foreign.shop.cost"]
    classes = [generate_env(calling(*calls), {name: define()}, view="aec") for name in names[first:] + names[:first]]
    envs = [opened(env_class()) for env_class in classes]
    assert [log_of(env) for env in envs] == [[9, 9, 9]] * 3
    for env in envs:
        env.close()
        assert log_of(envs[-1]) == log_of(envs[0]) == [9, 9, 9]
    for env in envs:
        env.close()
    assert before is market.price is shop.price is shop.cost
    assert [log_of(env) for env in envs] == [[9, 9, 9]] * 3  # used again


# -- environments of the same undecorated model ---------------------------------------------------


def test_environments_of_the_same_undecorated_model_have_their_own_points_and_definitions():
    other = decision()
    traders = calling(lambda: Trader().bid("tea"), other)
    one = aec_env(traders, {BID: define(action_space_mapping=lambda action: ("one", action))})
    two = aec_env(traders, {Trader.bid: define(action_space_mapping=lambda action: ("two", action), agent="b_0")})
    one.reset()
    two.reset()
    assert log_of(aec_env(traders, other)) == [5, 9]
    one.step(1)
    two.step(2)
    assert one.unwrapped.simulation.log == [("one", 1), "rule"]
    assert two.unwrapped.simulation.log == [("two", 2), "rule"]
    assert (one.possible_agents, two.possible_agents) == (["bid_0"], ["b_0"])


def test_local_classes_are_found_by_their_functions_and_local_functions_must_be_decorated():
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
    decorated = decision(decide)
    assert log_of(aec_env(calling(decorated), decorated)) == [9]
