"""Section 8: plugins of one environment alone, and handlers around decisions."""

import gc
import inspect
import itertools
import sys
from contextlib import nullcontext, suppress
from random import Random
from threading import Thread

import numpy as np
import pytest

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
    made = (lambda self: self.log.append("made"), f"{HERE}.House.__init__", "after")
    env = single_env(House, House.water, plugins=[says("mine"), made], render_mode="ansi")
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
    assert simulation.log == ["made"] + ["mine"] * 5
    assert simulation.word() == "plain"
    assert House().log == []


@pytest.mark.parametrize("make", [aec_env, parallel_env, single_env, joint_env, generate_env])
def test_every_view_takes_plugins(make):
    env = make(House, House.water, plugins=[says("mine")])
    if make is generate_env:
        env = env()
    env.reset(seed=1)
    env.step({"waterer_0": 1} if make in (parallel_env, joint_env) else 1)
    assert env.unwrapped.simulation.log == ["mine"] * 4
    assert [entry[1:] for entry in attached_handlers(env)] == [(WORD, "instead")]
    env.close()


def test_simulate_takes_plugins():
    assert simulate(House, points=House.water, plugins=[says("mine")]).log == ["mine"] * 7
    assert simulate(House, points=House.water).log == ["plain"] * 7


@pytest.mark.parametrize("rounds", [False, True])
def test_environments_with_opposite_plugins_are_interleaved(rounds):
    make, action = (parallel_env, {"waterer_0": 1}) if rounds else (single_env, 1)
    words = {"one": [says("one")], "two": [says("two")], "plain": []}
    envs = {word: make(House, House.water, plugins=plugins) for word, plugins in words.items()}
    for env in envs.values():
        env.reset()
    for _ in range(2):
        for env in envs.values():
            env.step(action)
            assert House().word() == "plain"
    for word, env in envs.items():
        assert env.unwrapped.simulation.log == [word] * 6
        env.close()


def test_handlers_of_the_process_run_before_the_environments():
    log = []
    entries = [
        (lambda self, name=name, position=position: log.append((position, name)), WORD, position)
        for name in ("process", "environment")
        for position in ("before", "after")
    ]
    env = single_env(House, House.water, plugins=entries[2:])
    own = single_env(House, House.water, plugins=[says("environment")])
    with handlers(*entries[:2]):
        env.reset()
    assert log[:4] == [(position, name) for position in ("before", "after") for name in ("process", "environment")]
    with handlers(says("process")):
        for each, word in ((env, "process"), (own, "environment")):
            each.reset()
            assert each.unwrapped.simulation.log[-1] == word
        assert House().word() == "process"
    env.close()
    own.close()


def test_an_environment_stepped_from_inside_another_one_sees_its_own_plugins_alone():
    plain, mine = (single_env(House, House.water, plugins=plugins) for plugins in ([], [says("inner")]))
    for env in (plain, mine):
        env.reset()

    def step(*args):
        plain.step(1)
        return 1

    def main(simulation):
        simulation.log.append(House().word())
        other()
        plain.step(1)
        mine.step(1)
        House.water(House())
        simulation.log.append(House().word())
        other()

    other = decision(agent="other_0")
    env = aec_env(script(main), [other, House.water], plugins=[says("mine")], policies={House.water: step})
    env.reset()
    env.step(1)
    assert env.unwrapped.simulation.log == ["mine", "mine"]
    assert plain.unwrapped.simulation.log == ["plain"] * 6
    assert mine.unwrapped.simulation.log == ["inner"] * 4
    for each in (env, plain, mine):
        each.close()


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


def test_a_plugins_error_surfaces_from_step_the_next_reset_works_and_nothing_is_left_behind():
    number = itertools.count()

    def fail(self):
        if next(number) == 4:
            raise ZeroDivisionError

    env = single_env(House, House.water, plugins=[(fail, WORD, "before")])
    before = stacks()
    env.reset()
    with pytest.raises(ZeroDivisionError) as caught:
        env.step(1)
    assert "in the handler" in notes(caught.value)
    assert "waterer_0" in notes(caught.value)
    del caught
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
    logs = []

    def work(number):
        for _ in range(10):
            env = single_env(House, House.water, plugins=[says(number * "x")])
            env.reset()
            while not env.step(1)[2]:
                pass
            logs.append((number, env.unwrapped.simulation.log))
            env.close()

    threads = [Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert sorted(logs) == [(number, [number * "x"] * 7) for number in range(4) for _ in range(10)]


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
    House.word = expose_to_plugins(House.word)  # which the class of environments outlives
    try:
        env = made()
        env.reset()
        assert set(env.unwrapped.simulation.log) == {"mine"}
    finally:
        House.word = before
    env.step(1)
    assert env.unwrapped.simulation.log[-2:] == ["plain", "plain"]
    env.close()
    assert vars(House)["word"] is before


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


# -- decisions in plugins -------------------------------------------------------------------------


@define(agent="ventilator_0", observation_space_mapping=lambda self: [self.step, 0])
def ventilate(self):
    return "rule"


def asked(self):
    return f"asked {ventilate(self)}"


def test_a_plugin_may_decide_or_call_what_decides():
    for handler, prefix in ((ventilate, ""), (asked, "asked ")):
        points, plugins = [House.water, ventilate], [(handler, WORD, "instead")]
        env = aec_env(House, points, plugins=plugins)
        turns = play(env, {"waterer_0": 1, "ventilator_0": 7})
        assert decisions(turns) == ["ventilator_0", "waterer_0", "ventilator_0"] * 3
        log = env.unwrapped.simulation.log
        assert log[0] == f"{prefix}rule"  # during reset the rule decides
        assert [str(word) for word in log[1:]] == [f"{prefix}7"] * 6
        env.close()
        together = joint_env(House, points, plugins=plugins)
        together.reset()
        *_, info = together.step({"waterer_0": 1, "ventilator_0": 7})
        assert info["acted"] == {"waterer_0": True, "ventilator_0": True}
        together.close()


@pytest.mark.parametrize("how", ["handlers first", "points first", "environment", "exposed"])
def test_handlers_lie_outside_the_decision(how):
    seen, decided = [], []

    def before(self, good, limit=5):
        return ChangedArgs(self, good.upper(), limit=limit + 1)

    def after(self, good, limit=5, *, _result):
        decided.append(_result)
        return ChangedResult(_result * 10)

    points = {BID: define(observation_space_mapping=lambda self, good, limit=5: seen.append((good, limit)) or [0, 0])}
    entries = [(before, BID, "before"), (after, BID, "after")]
    bids = calling(lambda: Trader().bid("tea"), lambda: Broker().bid("tea", limit=6))
    original = vars(Trader)["bid"]
    if how == "exposed":
        Trader.bid = expose_to_plugins(Trader.bid)
    try:
        if how == "points first":
            env = aec_env(bids, points)
            env.reset()
            seen.clear()
        with handlers(*entries) if how != "environment" else nullcontext():
            if how != "points first":
                env = aec_env(bids, points, plugins=entries if how == "environment" else ())
            play(env, 4)
        assert env.unwrapped.simulation.log == [40, 40]
        assert decided == [4, 4]
        assert {("TEA", 6), ("TEA", 7)} <= {*seen}
        env.close()
        assert Trader().bid("tea") == 5
    finally:
        Trader.bid = original


@pytest.mark.parametrize("first", ["handlers", "points"])
@pytest.mark.parametrize("last", ["handlers", "points"])
@pytest.mark.parametrize(
    ("name", "place", "call"),
    [
        (BID, Trader, lambda: Trader().bid("tea")),
        (f"{MARKET}.price", market, lambda: shop.total("tea")),
        (f"{MARKET}.Broker.bid", Broker, lambda: Broker().bid("tea")),
        (f"{MARKET}.Trader.rounded", Trader, lambda: Trader.rounded(2.5)),
    ],
    ids=["method", "function", "inherited", "static"],
)
def test_patches_come_and_go_in_any_order(first, last, name, place, call):
    before, plain, log = held(place), call(), []
    attached = handlers((lambda *args, **kwargs: log.append(1), name, "before"))
    env_class = generate_env(calling(call), {name: define()}, view="aec")
    if first == "handlers":
        attached.__enter__()
    env = env_class()
    if first == "points":
        attached.__enter__()
    play(env, 4)
    assert (env.unwrapped.simulation.log, log) == ([4], [1])
    if last == "points":
        attached.__exit__(None, None, None)
        play(env, 4)
        assert (env.unwrapped.simulation.log, log) == ([4], [1])
        env.close()
    else:
        env.close()
        assert call() == plain
        assert log == [1, 1]
        attached.__exit__(None, None, None)
    assert held(place) == before
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
        attached = handlers((lambda *args, **kwargs: None, name, "before"))
        attached.__enter__()
        return lambda: attached.__exit__(None, None, None)

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
    class Shed(House):
        pass

    nothing = [(lambda *args, **kwargs: None, target, "before") for target in (BID, f"{MARKET}.Broker.bid", Shed.water)]
    with handlers(*nothing):
        for key in (Trader.bid, Broker.bid, BID, f"{MARKET}.Broker.bid"):
            env = aec_env(calling(lambda: Broker().bid("tea")), {key: define()})
            play(env, 3)
            assert env.unwrapped.simulation.log == [3]
            env.close()
        fetched = Trader.bid
        env = aec_env(Shed, Shed.water)  # with the definition that it has inherited
        assert decisions(play(env, 1)) == ["waterer_0"] * 3
        env.close()
    env = aec_env(calling(lambda: Broker().bid("tea")), {fetched: define()})
    play(env, 3)
    assert env.unwrapped.simulation.log == [3]
    env.close()


def test_decision_functions_can_be_named_whether_they_are_exposed_before_or_after():
    def choose():
        return "rule"

    over, under, log = expose_to_plugins(define()(choose)), define(agent="under_0")(expose_to_plugins(choose)), []
    assert inspect.unwrap(over) is inspect.unwrap(under) is choose
    for point, agent in ((over, "choose_0"), (under, "under_0")):
        env = aec_env(calling(point), point)
        with handlers((lambda _result: log.append(_result), point, "after")):
            assert decisions(play(env, 4)) == [agent]
        env.close()
    assert log == [4, 4]


# -- ends -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", ["close", "reset", "collect"])
def test_an_episode_that_ends_inside_an_exposed_call_passes_its_handlers(end):
    log, choose = [], decision()

    @expose_to_plugins
    def day():
        try:
            return choose()
        finally:
            log.append("unwound")

    plugins = [(lambda position=position: log.append(position), day, position) for position in ("before", "after")]
    env = aec_env(calling(day), choose, plugins=plugins)
    with handlers((lambda: log.append("everybody"), day, "after")):
        env.reset()
        assert log == ["before"]
        if end == "reset":
            env.reset()
        if end != "collect":
            env.close()
        del env
        gc.collect()
    assert log == ["before", "unwound"] * (2 if end == "reset" else 1)


def test_generators_and_iterables_suspended_over_decisions_have_their_environments_plugins():
    choose = decision()

    @expose_to_plugins
    def days(number):
        for day in range(number):
            yield (day, choose())

    class Shelf:
        """Its iterable is copied with it."""

        def __init__(self):
            self.items = expose_to_plugins([1, 2, 3])

        def reset(self):
            self.log = []

        def run(self):
            for (day, action), item in zip(days(3), self.items, strict=False):
                self.log.append((day, item, action))

    def env(factor):
        after = [
            (lambda number, _result: ChangedResult((_result[0] * factor, _result[1])), days, "after_next"),
            (lambda items, _result: ChangedResult(_result * factor), shelf.items, "after_next"),
        ]
        return aec_env(shelf, choose, plugins=after if factor > 1 else ())

    shelf = Shelf()
    envs = {factor: env(factor) for factor in (10, 100, 1)}
    for each in envs.values():
        each.reset()
    for action in (7, 8, 9):
        for each in envs.values():
            each.step(action)
    for factor, each in envs.items():
        assert each.unwrapped.simulation.log == [(day * factor, (day + 1) * factor, day + 7) for day in range(3)]


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


# -- removals and rewards --------------------------------------------------------------------------


class Sheep:
    def __init__(self, name):
        self.name = name

    def step(self):
        if self.graze() == 3:
            self.remove()

    def remove(self):
        pass

    @define(agent=lambda self: self.name, removed_by=f"{HERE}.Sheep.remove")
    def graze(self):
        return 0


@pytest.mark.parametrize("how", ["process", "environment"])
def test_a_removal_may_have_handlers(how):
    def main(simulation):
        one, two = Sheep("sheep_1"), Sheep("sheep_2")
        for sheep in (one, two, two):
            sheep.step()

    removed = []
    entries = [(lambda self: removed.append(self.name), f"{HERE}.Sheep.remove", "after")]
    env = aec_env(script(main), Sheep.graze, plugins=entries if how == "environment" else ())
    with handlers(*entries) if how == "process" else nullcontext():
        turns = play(env, {"sheep_1": 3, "sheep_2": 1})
    assert decisions(turns) == ["sheep_1", "sheep_2", "sheep_2"]
    assert [turn.agent for turn in turns if turn.terminated] == ["sheep_1", "sheep_2"]
    assert removed == ["sheep_1"]
    env.close()
    assert hook_of(Sheep.remove) is None


def test_with_handlers_that_change_nothing_rule_is_the_plain_run():
    class Walk:
        def __init__(self):
            self.path = []

        def reset(self, seed=None):
            self.generator = np.random.default_rng(seed)

        def run(self):
            for _ in range(20):
                self.path.append(self.stride())

        @define(reward_mapping=difference(lambda self: sum(self.path)))
        def stride(self):
            return self.generator.integers(10)

    plain = Walk()
    plain.reset(seed=4)
    plain.run()
    nothing = [(lambda self: None, Walk.stride, "before"), (lambda self, _result: None, Walk.stride, "after")]
    env = single_env(Walk, Walk.stride, plugins=nothing)
    env.reset(seed=4)
    rewards = [env.step(RULE)[1] for _ in range(20)]
    assert env.unwrapped.simulation.path == plain.path == rewards


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
