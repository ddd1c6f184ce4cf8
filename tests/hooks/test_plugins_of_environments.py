"""Section 8: plugins of one environment alone, and handlers around decisions."""

import gc
import sys
from contextlib import suppress
from random import Random
from threading import Thread

import mesa
import numpy as np
import pytest
from gymnasium import spaces

import simenv_marl
from simenv_marl import (
    RULE,
    aec_env,
    difference,
    generate_env,
    joint_env,
    parallel_env,
    simulate,
    single_env,
    vector_env,
)
from simenv_marl.core import agent as agent_module
from simenv_marl.errors import HandlerError, NoDecisionError, OptionValueError, UnknownTargetError
from simenv_marl.hooks.hook import hook_of
from simenv_marl.hooks.stacks import EVALUATING
from simenv_marl.plugins import (
    ChangedArgs,
    ChangedResult,
    attached_handlers,
    expose_to_plugins,
    handlers,
    remove_handler,
    trace,
)
from tests.foreign import market, shop
from tests.foreign.market import Broker, Trader
from tests.worlds.models import (
    alive,
    calling,
    decision,
    decisions,
    define,
    nobody_is_asked,
    notes,
    play,
    script,
    stacks,
)
from tests.worlds.undone import held, left_as_they_were

MARKET = "tests.foreign.market"
HERE = __name__
BID = f"{MARKET}.Trader.bid"

# Traders and brokers decide under one name here: it is about functions, and not about agents.
pytestmark = pytest.mark.filterwarnings("ignore:several objects decide")


@pytest.fixture(autouse=True)
def _nothing_stays_attached():
    with left_as_they_were(market, shop, Trader, Broker, House):
        yield
        gc.collect()
        assert attached_handlers() == []


class House:
    """A greenhouse whose ventilation nobody has thought of as a decision."""

    step = 0

    def __init__(self):
        self.log = []

    def reset(self, seed=None):
        self.log.append(self.word())

    def run(self):
        for self.step in range(3):
            self.log.append(self.word())
            self.water()
            self.log.append(self.word())

    @define(agent="waterer_0", observation_space_mapping=lambda self: [len(self.word()), self.step])
    def water(self):
        return 0

    def word(self):
        return "plain"

    def stop(self):
        self.log.append(self.word())

    def time(self):
        self.word()
        return float(self.step)

    def state(self):
        return [len(self.word())]

    render_modes = ("ansi",)

    def render(self, mode):
        return self.word()


WORD = f"{HERE}.House.word"


def says(word):
    return (lambda self: word, WORD, "instead")


# -- one environment alone ------------------------------------------------------------------------


def test_plugins_apply_wherever_the_environments_simulation_is_at_work():
    env = single_env(House, House.water, plugins=[says("mine")], render_mode="ansi")
    simulation = env.unwrapped.simulation
    observation, _ = env.reset()
    assert simulation.word() == "plain"
    assert observation.tolist() == [4, 0]
    observation, *_ = env.step(1)
    assert observation.tolist() == [4, 1]
    assert simulation.word() == "plain"
    assert env.render() == "mine"
    assert env.unwrapped.state().tolist() == [4]
    env.close()
    assert simulation.log == ["mine"] * 5
    assert simulation.word() == "plain"


def test_construction_is_extended_too():
    env = single_env(
        House,
        House.water,
        plugins=[(lambda self: self.log.append("made"), f"{HERE}.House.__init__", "after")],
    )
    assert env.unwrapped.simulation.log == ["made"]
    assert House().log == []


@pytest.mark.parametrize("make", [aec_env, parallel_env, single_env, joint_env, generate_env])
def test_every_view_takes_plugins(make):
    env = make(House, House.water, plugins=[says("mine")])
    if make is generate_env:
        env = env()
    env.reset(seed=1)
    action = {"waterer_0": 1} if make in (parallel_env, joint_env) else 1
    env.step(action)
    log = env.unwrapped.simulation.log
    assert set(log) == {"mine"}
    assert len(log) == 4
    assert [entry[1:] for entry in attached_handlers(env)] == [(WORD, "instead")]
    env.close()


def test_simulate_takes_plugins():
    done = simulate(House, points=House.water, plugins=[says("mine")])
    assert done.log == ["mine"] * 7
    assert simulate(House, points=House.water).log == ["plain"] * 7


@pytest.mark.parametrize("rounds", [False, True])
def test_environments_with_opposite_plugins_are_interleaved(rounds):
    make, action = (parallel_env, {"waterer_0": 1}) if rounds else (single_env, 1)
    envs = [make(House, House.water, plugins=[says(word)]) for word in ("one", "two")] + [make(House, House.water)]
    for env in envs:
        env.reset()
    for _ in range(2):
        for env in envs:
            env.step(action)
            assert House().word() == "plain"
    for env, word in zip(envs, ("one", "two", "plain"), strict=True):
        assert env.unwrapped.simulation.log == [word] * 6
    for env in envs:
        env.close()


def test_handlers_of_the_process_run_before_the_environments():
    log = []
    entries = [
        (lambda self, name=name, position=position: log.append((position, name)), WORD, position)
        for name in ("process", "environment")
        for position in ("before", "after")
    ]
    env = single_env(House, House.water, plugins=entries[2:])
    with handlers(*entries[:2]):
        env.reset()
    assert log[:4] == [
        ("before", "process"),
        ("before", "environment"),
        ("after", "process"),
        ("after", "environment"),
    ]
    with handlers(says("process")):
        env.reset()
        assert env.unwrapped.simulation.log[-1] == "process"
        own = single_env(House, House.water, plugins=[says("environment")])
        own.reset()
        assert own.unwrapped.simulation.log[-1] == "environment"
        assert House().word() == "process"
    env.close()
    own.close()


def test_nothing_is_patched_but_while_there_is_an_environment():
    before = vars(House)["word"]
    made = generate_env(House, House.water, plugins=[says("mine")])
    assert vars(House)["word"] is before
    one, two = made(), made(plugins=[])
    assert vars(House)["word"] is not before
    two.reset()
    assert set(two.unwrapped.simulation.log) == {"plain"}
    two.close()
    one.reset()
    one.close()
    assert vars(House)["word"] is before
    one.reset()
    assert set(one.unwrapped.simulation.log[-2:]) == {"mine"}
    del one
    gc.collect()
    assert vars(House)["word"] is before


def test_an_environment_stepped_from_inside_another_one_does_not_see_its_plugins():
    inner = single_env(House, House.water)
    inner.reset()

    def step(*args):
        inner.step(1)
        return 1

    other = decision(agent="other_0")

    def main(simulation):
        simulation.log.append(House().word())
        other()
        inner.step(1)
        House.water(House())

    env = aec_env(script(main), [other, House.water], plugins=[says("mine")], policies={House.water: step})
    env.reset()
    env.step(1)
    assert env.unwrapped.simulation.log == ["mine"]
    assert inner.unwrapped.simulation.log == ["plain"] * 6
    env.close()
    inner.close()


@pytest.mark.parametrize(
    ("plugins", "error"),
    [
        ("text", OptionValueError),
        (3, OptionValueError),
        ({WORD: print}, OptionValueError),
        ([WORD], HandlerError),
        ([(print, WORD)], HandlerError),
        ([(print, WORD, "during")], HandlerError),
        ([(lambda: 0, WORD, "before")], HandlerError),
        ([says("good"), (print, f"{HERE}.House.missing", "before")], UnknownTargetError),
    ],
)
def test_plugins_are_checked_when_the_environment_is_made(plugins, error):
    for make in (single_env, generate_env):
        with pytest.raises(error):
            make(House, House.water, plugins=plugins)


def test_a_plugins_error_surfaces_from_step_and_the_next_reset_works():
    env = single_env(House, House.water, plugins=[(fail_once(), WORD, "before")])
    env.reset()
    with pytest.raises(ZeroDivisionError) as caught:
        env.step(1)
    assert "in the handler" in notes(caught.value)
    assert "waterer_0" in notes(caught.value)
    env.reset()
    env.step(1)
    env.close()
    assert nobody_is_asked()
    assert hook_of(vars(House)["water"]).interceptors == EVALUATING == {}


def fail_once():
    calls = []

    def fail(self):
        calls.append(self)
        if len(calls) == 3 + 2:
            raise ZeroDivisionError

    return fail


def test_nothing_is_left_behind():
    env = single_env(House, House.water, plugins=[says("mine")])
    before = stacks()
    for end in ("close", "reset", "collect"):
        env.reset()
        env.step(1)
        if end == "close":
            env.close()
    del env
    gc.collect()
    assert stacks() <= before
    assert alive(House) == 0
    assert nobody_is_asked()
    assert hook_of(vars(House)["water"]).interceptors == EVALUATING == {}


def test_environments_in_threads_of_their_own_have_their_own_plugins():
    choose, errors = decision(), []

    def work(number):
        try:
            for _ in range(10):
                plugins = [(lambda self, good, limit=5: number, BID, "instead")]
                env = aec_env(calling(lambda: Trader().bid("tea"), choose), choose, plugins=plugins)
                play(env, 2)
                assert env.unwrapped.simulation.log == [number, 2]
                env.close()
        except BaseException as error:
            errors.append(error)

    threads = [Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert errors == []


def test_environments_may_be_collected_at_any_moment():
    """Also while handlers are made ready, which looks through those that environments have."""
    choose, number = decision(), 0

    def look(frame, event, arg):
        nonlocal left
        left -= event == "call" and "/hooks/" in frame.f_code.co_filename
        if left == 0:
            gc.collect()

    gc.disable()
    try:
        left = 0
        while left <= 0:  # until there are no more calls
            plugins = [(lambda *args, **kwargs: None, BID, "before")]
            env = aec_env(calling(lambda: Trader().bid("tea"), choose), choose, plugins=plugins)
            env.reset()
            env.itself = env
            del env
            number += 1
            left = number
            sys.setprofile(look)
            try:
                with handlers((lambda *args, **kwargs: None, BID, "before")):
                    assert Trader().bid("tea") == 5
            finally:
                sys.setprofile(None)
            gc.collect()
    finally:
        gc.enable()
    assert number > 10


def test_nested_environments_have_each_their_own():
    choose = decision()
    inner = aec_env(
        calling(lambda: Trader().bid("tea"), choose),
        choose,
        plugins=[(lambda self, good, limit=5: "inner", BID, "instead")],
    )

    def main(simulation):
        simulation.log.append(Trader().bid("tea"))
        play(inner, 3)
        simulation.log += [Trader().bid("tea"), *inner.unwrapped.simulation.log]
        choose()

    outer = aec_env(script(main), choose, plugins=[(lambda self, good, limit=5: "outer", BID, "instead")])
    play(outer, 1)
    assert outer.unwrapped.simulation.log == ["outer", "outer", "inner", 3]
    outer.close()
    inner.close()


def test_a_class_of_environments_outlives_the_exposing_of_a_target():
    made = generate_env(House, House.water, plugins=[says("mine")])
    before = House.word
    House.word = expose_to_plugins(House.word)
    try:
        env = made()
        env.reset()
        assert set(env.unwrapped.simulation.log) == {"mine"}
    finally:
        House.word = before
    env.step(1)
    assert env.unwrapped.simulation.log[-2:] == ["plain", "plain"]
    env.close()
    assert House.word is before


def test_the_simulations_own_methods_can_be_extended():
    def run(self):
        self.log += [choose(), choose()]
        return simenv_marl.TRUNCATED

    choose = decision()
    plugins = [
        (run, f"{HERE}.House.run", "instead"),
        (lambda self, seed=None: ChangedArgs(self, seed=77), f"{HERE}.House.reset", "before"),
        (lambda self, seed=None: self.log.append(seed), f"{HERE}.House.reset", "after"),
    ]
    env = aec_env(House, choose, plugins=plugins)
    turns = play(env, 3)
    assert env.unwrapped.simulation.log == ["plain", 77, 3, 3]
    assert turns[-1].truncated
    env.close()


def test_iterables_of_a_copied_simulation_have_their_plugins():
    class Shelf:
        def __init__(self):
            self.items = expose_to_plugins([1, 2])

        def reset(self):
            self.log = []

        def run(self):
            for item in self.items:
                self.log.append((item, choose()))

    choose, shelf = decision(), Shelf()
    five = [(lambda items, _result: ChangedResult(_result * 5), shelf.items, "after_next")]
    env, plain = aec_env(shelf, choose, plugins=five), aec_env(shelf, choose)
    for each in (env, plain):
        each.reset()
    for action in (7, 8):
        for each in (env, plain):
            each.step(action)
    assert env.unwrapped.simulation.log == [(5, 7), (10, 8)]
    assert plain.unwrapped.simulation.log == [(1, 7), (2, 8)]


# -- decisions in plugins -------------------------------------------------------------------------


@define(agent="ventilator_0", observation_space_mapping=lambda self: [self.step, 0])
def ventilate(self):
    return "rule"


def ask_for_the_word(self):
    return f"asked {ventilate(self)}"


@pytest.mark.parametrize(("handler", "prefix"), [(ventilate, ""), (ask_for_the_word, "asked ")])
def test_the_papers_extrapolation(handler, prefix):
    env = aec_env(House, [House.water, ventilate], plugins=[(handler, WORD, "instead")])
    turns = play(env, {"waterer_0": 1, "ventilator_0": 7})
    assert decisions(turns) == ["ventilator_0", "waterer_0", "ventilator_0"] * 3
    log = env.unwrapped.simulation.log
    assert log[0] == f"{prefix}rule"  # during reset the rule decides
    assert [str(word) for word in log[1:]] == [f"{prefix}7"] * 6
    env.close()
    together = joint_env(House, [House.water, ventilate], plugins=[(handler, WORD, "instead")])
    together.reset()
    *_, info = together.step({"waterer_0": 1, "ventilator_0": 7})
    assert info["acted"] == {"waterer_0": True, "ventilator_0": True}
    together.close()


def bidding():
    return calling(lambda: Trader().bid("tea"), lambda: Broker().bid("tea", limit=6))


@pytest.mark.parametrize("how", ["process", "environment", "exposed"])
@pytest.mark.parametrize("order", ["handlers first", "points first"])
def test_handlers_lie_outside_the_decision(how, order):
    seen, decided = [], []

    def before(self, good, limit=5):
        return ChangedArgs(self, good.upper(), limit=limit + 1)

    def after(self, good, limit=5, *, _result):
        decided.append(_result)
        return ChangedResult(_result * 10)

    points = {BID: define(observation_space_mapping=lambda self, good, limit=5: seen.append((good, limit)) or [0, 0])}
    entries = [(before, BID, "before"), (after, BID, "after")]
    original = vars(Trader)["bid"]
    if how == "exposed":
        Trader.bid = expose_to_plugins(Trader.bid)
    try:
        if how == "environment":
            env = aec_env(bidding(), points, plugins=entries)
            play(env, 4)
        elif order == "handlers first":
            with handlers(*entries):
                env = aec_env(bidding(), points)
                play(env, 4)
        else:
            env = aec_env(bidding(), points)
            env.reset()
            seen.clear()
            with handlers(*entries):
                play(env, 4)
        assert env.unwrapped.simulation.log == [40, 40]
        assert decided == [4, 4]
        assert ("TEA", 6) in seen
        assert ("TEA", 7) in seen
        env.close()
        assert Trader().bid("tea") == 5
    finally:
        Trader.bid = original


@pytest.mark.parametrize("first", ["handlers", "points"])
@pytest.mark.parametrize("last", ["handlers", "points"])
@pytest.mark.parametrize("name", [BID, f"{MARKET}.price", f"{MARKET}.Broker.bid", f"{MARKET}.Trader.rounded"])
def test_patches_come_and_go_in_any_order(first, last, name):
    owner = name.rpartition(".")[0]
    place = market if owner == MARKET else getattr(market, owner.rpartition(".")[2])
    call = {
        BID: lambda: Trader().bid("tea"),
        f"{MARKET}.price": lambda: shop.total("tea"),
        f"{MARKET}.Broker.bid": lambda: Broker().bid("tea"),
        f"{MARKET}.Trader.rounded": lambda: Trader.rounded(2.5),
    }[name]
    before, plain = dict(held(place)), call()
    log = []
    attached = handlers((lambda *args, **kwargs: log.append(1), name, "before"))
    env_class = generate_env(calling(call), {name: define()}, view="aec")
    if first == "handlers":
        attached.__enter__()
        env = env_class()
    else:
        env = env_class()
        attached.__enter__()
    play(env, 4)
    assert env.unwrapped.simulation.log == [4]
    assert log == [1]
    if last == "points":
        attached.__exit__(None, None, None)
        play(env, 4)
        assert env.unwrapped.simulation.log == [4]
        assert log == [1]
        env.close()
    else:
        env.close()
        assert call() == plain
        assert log == [1, 1]
        attached.__exit__(None, None, None)
    now = held(place)
    assert now.keys() == before.keys()
    assert all(now[key] is before[key] for key in before)
    assert call() == plain


PLACES = [
    BID,
    f"{MARKET}.Broker.bid",
    f"{MARKET}.price",
    "tests.foreign.shop.cost",
    f"{MARKET}.Trader.opening",
    f"{MARKET}.Junior.opening",
    f"{MARKET}.Trader.rounded",
    f"{MARKET}.Trader.haggle",
]


@pytest.mark.parametrize("seed", range(5))
def test_whoever_comes_and_goes_nobody_is_in_anothers_way(seed):
    random, live = Random(seed), []
    model = calling(lambda: Broker().bid("tea"), lambda: market.Junior.opening(), lambda: shop.total_cost("tea"))

    def attach(name):
        def handler(*args, **kwargs):
            return None

        simenv_marl.plugins.attach_handler(handler, name, "before")
        return lambda: remove_handler(name, "before", handler)

    def environment(name, *others):
        plugins = [(lambda *args, **kwargs: None, other, "after") for other in others]
        env = aec_env(model, {name: define()}, plugins=plugins)
        with suppress(NoDecisionError):
            env.reset()
        return env.close

    for _ in range(100):
        if live and random.random() < 0.5:
            live.pop(random.randrange(len(live)))()
        else:
            come = random.choice([attach, environment])
            live.append(come(random.choice(PLACES)))
            live.append(environment(*random.sample(PLACES, 3)))
        assert (Broker().bid("tea"), shop.total_cost("tea"), market.Junior.opening()) == (5, 9, 3)
    while live:
        live.pop(random.randrange(len(live)))()


def test_points_find_functions_that_handlers_stand_in_front_of():
    with handlers(
        (lambda *args, **kwargs: None, BID, "before"), (lambda *a, **k: None, f"{MARKET}.Broker.bid", "after")
    ):
        for key in (Trader.bid, Broker.bid, BID, f"{MARKET}.Broker.bid"):
            env = aec_env(calling(lambda: Broker().bid("tea")), {key: define()})
            play(env, 3)
            assert env.unwrapped.simulation.log == [3]
            env.close()
        fetched = Trader.bid
    env = aec_env(bidding(), {fetched: define()})
    play(env, 3)
    assert env.unwrapped.simulation.log == [3, 3]
    env.close()


def test_an_inherited_decorated_method_keeps_its_definition_under_handlers():
    class Shed(House):
        pass

    with handlers((lambda self: None, Shed.water, "before")):
        env = aec_env(Shed, Shed.water)
        assert decisions(play(env, 1)) == ["waterer_0"] * 3
        env.close()


def test_exposing_what_an_environment_has_patched_outlasts_it():
    original = vars(Trader)["bid"]
    env = aec_env(bidding(), {BID: define()})
    try:
        Trader.bid = expose_to_plugins(Trader.bid)
        with handlers((lambda *args, **kwargs: ChangedResult(kwargs["_result"] * 2), Trader.bid, "after")):
            play(env, 4)
            assert env.unwrapped.simulation.log == [8, 8]
        env.close()
        assert Trader().bid("tea") == 5
        with handlers((lambda *args, **kwargs: 1, Trader.bid, "instead")):
            assert Trader().bid("tea") == 1
    finally:
        Trader.bid = original


def test_decision_functions_can_be_named_whether_they_are_exposed_or_not():
    class Model:
        @expose_to_plugins
        @define()
        def over(self):
            return "rule"

        @define()
        @expose_to_plugins
        def under(self):
            return "rule"

    model, log = Model(), []
    env = aec_env(calling(lambda: model.over(), lambda: model.under()), [Model.over, Model.under])
    with handlers(
        (lambda self: log.append("over"), Model.over, "before"),
        (lambda self, _result: log.append(_result), Model.under, "after"),
    ):
        assert decisions(play(env, 4)) == ["over_0", "under_0"]
    assert log == ["over", 4]
    env.close()


# -- ends -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", ["close", "reset", "collect"])
def test_an_episode_that_ends_inside_an_exposed_call_passes_its_handlers(end):
    log = []
    choose = decision()

    @expose_to_plugins
    def day():
        try:
            return choose()
        finally:
            log.append("unwound")

    def main(simulation):
        day()

    env = aec_env(
        script(main),
        choose,
        plugins=[(lambda: log.append("before"), day, "before"), (lambda: log.append("after"), day, "after")],
    )
    with handlers((lambda: log.append("everybody"), day, "after")):
        env.reset()
        assert log == ["before"]
        if end == "close":
            env.close()
        elif end == "reset":
            env.reset()
            env.close()
        else:
            del env
            gc.collect()
    assert log == ["before", "unwound"] * (2 if end == "reset" else 1)


def test_generators_suspended_over_decisions():
    choose = decision()

    @expose_to_plugins
    def days(number):
        for day in range(number):
            yield (day, choose())

    def main(simulation):
        simulation.log += days(3)

    def env(factor):
        after = lambda number, _result: ChangedResult((_result[0] * factor, _result[1]))  # noqa: E731
        return aec_env(script(main), choose, plugins=[(after, days, "after_next")])

    one, two, none = env(10), env(100), aec_env(script(main), choose)
    for each in (one, two, none):
        each.reset()
    for action in range(3):
        for each in (one, two, none):
            each.step(action)
    assert one.unwrapped.simulation.log == [(0, 0), (10, 1), (20, 2)]
    assert two.unwrapped.simulation.log == [(0, 0), (100, 1), (200, 2)]
    assert none.unwrapped.simulation.log == [(0, 0), (1, 1), (2, 2)]


def test_a_plugin_may_remove_everybodys_handlers_in_mid_episode():
    log = []

    def remove(self):
        if any(position == "after" for _, _, position in attached_handlers()):
            remove_handler(WORD, "after")

    env = single_env(House, House.water, plugins=[(remove, WORD, "before")])
    simenv_marl.plugins.attach_handler(lambda self: log.append(1), WORD, "after")
    env.reset()
    env.step(1)
    env.close()
    assert log == [1]


# -- other people's models ------------------------------------------------------------------------


class Sheep(mesa.Agent):
    def __init__(self, model):
        super().__init__(model)
        self.name = f"sheep_{self.unique_id}"

    def step(self):
        if self.graze() == 3:
            self.remove()

    @define(agent=lambda self: self.name, removed_by="mesa.agent.Agent.remove")
    def graze(self):
        return 0


class Meadow(mesa.Model):
    def __init__(self, seed=None):
        super().__init__(rng=seed)
        Sheep.create_agents(self, 2)


class Days:
    def reset(self, seed=None):
        self.model = Meadow(seed=seed)

    def run(self):
        for _ in range(2):
            self.model.agents.do("step")


@pytest.mark.parametrize("how", ["process", "environment"])
def test_a_removal_may_have_handlers(how):
    removed = []
    entries = [(lambda self: removed.append(self.name), "mesa.agent.Agent.remove", "after")]
    if how == "environment":
        env = aec_env(Days, Sheep.graze, plugins=entries)
        turns = play(env, {"sheep_1": 3, "sheep_2": 1})
    else:
        env = aec_env(Days, Sheep.graze)
        with handlers(*entries):
            turns = play(env, {"sheep_1": 3, "sheep_2": 1})
    assert decisions(turns) == ["sheep_1", "sheep_2", "sheep_2"]
    assert [turn.agent for turn in turns if turn.terminated] == ["sheep_1", "sheep_2"]
    assert removed == ["sheep_1"]
    env.close()
    assert not hasattr(mesa.agent.Agent.remove, "__wrapped__")


def test_with_handlers_that_change_nothing_rule_is_the_plain_run():
    class Walk:
        def __init__(self):
            self.path = []

        def reset(self, seed=None):
            self.generator = np.random.default_rng(seed)

        def run(self):
            for _ in range(20):
                self.path.append(self.stride())

        @define(observation_space=spaces.Box(-9, 9, (1,)), observation_space_mapping=lambda self: [len(self.path)])
        def stride(self):
            return self.generator.integers(10)

    plain = Walk()
    plain.reset(seed=4)
    plain.run()
    nothing = [(lambda self: None, Walk.stride, "before"), (lambda self, _result: None, Walk.stride, "after")]
    env = single_env(Walk, Walk.stride, plugins=nothing)
    env.reset(seed=4)
    while not env.step(RULE)[2]:
        pass
    assert env.unwrapped.simulation.path == plain.path


def test_differences_are_the_same_with_plugins():
    class Meter:
        def reset(self):
            self.used = 0

        def run(self):
            for _ in range(3):
                self.used += self.use()

        @define(reward_mapping=difference(lambda self: self.used))
        def use(self):
            return 0

    rewards = []
    for plugins in ([], [(lambda self: None, Meter.use, "before")]):
        env = single_env(Meter, Meter.use, plugins=plugins)
        env.reset()
        rewards.append([env.step(action)[1] for action in (1, 5, 2)])
        env.close()
    assert rewards == [[1.0, 5.0, 2.0]] * 2


def test_calls_of_an_episode_are_traced():
    env = single_env(House, House.water, plugins=[says("mine")])
    with trace(WORD, House.water) as calls:
        env.reset()
        env.step(7)
    short = [(call.target.rpartition(".")[2], call.result) for call in calls]
    assert ("word", "'mine'") in short
    assert ("water", "7") in short
    assert short[-1] == ("word", "'mine'")
    waters = [call for call in calls if call.target.endswith("water")]
    assert waters[-1].result is None
    env.close()
    assert waters[-1].result.startswith("raised SimulationExit")


# -- when something fails half-way ------------------------------------------------------------------


class Sealing(type):
    """A kind of class that can be sealed, after which nothing in it can be set."""

    sealed = False

    def __setattr__(cls, name, value):
        if cls.sealed and name != "sealed":
            raise ZeroDivisionError(f"{name} is sealed")
        super().__setattr__(name, value)


class Vault(metaclass=Sealing):
    def open(self):
        return "rule"

    def shut(self):
        return "rule"


@pytest.mark.parametrize("points", [False, True])
def test_if_one_place_cannot_be_set_none_is(points):
    ant = decision(agent="ant_0")
    bid, before, log = Trader.bid, vars(Vault)["open"], []
    plugins = [(lambda *args: log.append("before"), f"{MARKET}.Trader.bid", "before")]
    named = {ant: None}
    if points:
        named[f"{HERE}.Vault.open"] = define(agent="vault_0")
    else:
        plugins.append((lambda vault: log.append("open"), f"{HERE}.Vault.open", "before"))
    Vault.sealed = True
    try:
        with pytest.raises(ZeroDivisionError, match="sealed"):
            aec_env(calling(ant), named, plugins=plugins).reset()
    finally:
        Vault.sealed = False
    assert vars(Vault)["open"] is before
    gc.collect()
    assert Trader.bid is bid
    env = aec_env(calling(lambda: Vault().open(), ant), named, plugins=plugins)
    play(env, 1)
    assert env.simulation.log == ([1, 1] if points else ["rule", 1])
    assert log == ([] if points else ["open"])
    env.close()
    del env
    gc.collect()
    assert vars(Vault)["open"] is before


def test_mappings_of_vector_environments_see_the_plugins_too(monkeypatch):
    monkeypatch.setattr(agent_module, "DIFFERENCES", [])  # as long as no difference was made, less is entered

    class Meter:
        def level(self):
            return 1.0

        def read(self):
            return 0

    meter = Meter()
    read = define(
        agent="reader",
        observation_space_mapping=lambda meter: [meter.level(), 0],
        reward_mapping=lambda meter: meter.level(),
    )
    plugins = [(lambda meter, _result: ChangedResult(_result + 41), Meter.level, "after")]
    env = vector_env(calling(*[lambda: meter.read()] * 3), {Meter.read: read}, num_envs=2, plugins=plugins)
    assert env.reset()[0].tolist() == [[42, 0]] * 2
    observations, rewards, *_ = env.step(np.zeros(2, np.int64))
    assert observations.tolist() == [[42, 0]] * 2
    assert rewards.tolist() == [42] * 2
    env.close()
