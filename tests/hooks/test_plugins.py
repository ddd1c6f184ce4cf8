"""Section 8: handlers before, after and instead of functions, per process and per environment."""

import asyncio
import collections.abc
import copy
import gc
import inspect
import pickle
import sys
from contextlib import closing
from random import Random

import numpy as np
import pytest

from simenv_marl import (
    RULE,
    TRUNCATED,
    aec_env,
    generate_env,
    joint_env,
    parallel_env,
    simulate,
    single_env,
    vector_env,
)
from simenv_marl.errors import HandlerError, PatchError, UnknownTargetError
from simenv_marl.hooks.hook import hook_of
from simenv_marl.plugins import (
    ChangedArgs,
    ChangedResult,
    attach_handler,
    attached_handlers,
    decision_points,
    expose_to_plugins,
    exposed_functions,
    handlers,
    remove_handler,
    trace,
)
from tests.foreign import market
from tests.foreign.market import Broker, Trader
from tests.hooks.forms import BID, FORMS, MARKET, PLACES, found
from tests.worlds.models import (
    begun,
    calling,
    decision,
    decisions,
    define,
    fails,
    left_as_they_were,
    notes,
    plainly,
    play,
    script,
    step,
)

HERE = __name__

# Traders and brokers decide under one name here: it is about functions, and not about agents.
pytestmark = pytest.mark.filterwarnings("ignore:several objects decide")


@pytest.fixture(autouse=True)
def _nothing_stays_attached(monkeypatch):
    with left_as_they_were(*PLACES, House):
        yield
        monkeypatch.undo()
        gc.collect()
        assert attached_handlers() == []


# -- what handlers are attached to -----------------------------------------------------------------


@expose_to_plugins
def counting(number, step=1):
    """Counts; what is sent is added, and what is thrown is counted as zero."""
    total = 0
    try:
        for value in range(number):
            try:
                sent = yield value * step
                total += sent or 0
            except KeyError:
                total = 0
    finally:
        closed.append(number)
    return total


closed = []


def local():
    """An exposed function of its own."""

    @expose_to_plugins
    def function(value, more=0):
        """Add."""
        return value + more

    return function


def nothing(*args, **kwargs):
    """A handler that changes nothing."""


def failing(*args, **kwargs):
    raise ZeroDivisionError("of the handler")


# -- by whom ---------------------------------------------------------------------------------------


def of_the_process(call, *entries):
    with handlers(*entries):
        return call()


def of_an_environment(call, *entries):
    """The simulation calls it."""
    env = aec_env(calling(call, CHOOSE), CHOOSE, plugins=entries)
    with closing(env):
        env.reset()
    return env.simulation.log[0]


CHOOSE = decision()

EVERYWHERE = pytest.mark.parametrize("with_handlers", [of_the_process, of_an_environment])
"""Calls a function with handlers that are attached in one way or the other."""


def telling(log, target, by=""):
    """Handlers before and after a target, which tell of it."""

    def tell(position):
        return lambda *args, **kwargs: log.append(position + by)

    return [(tell(position), target, position) for position in ("before", "after")]


@EVERYWHERE
@pytest.mark.parametrize("how", ["by name", "as itself"])
@pytest.mark.parametrize(("name", "call", "result"), FORMS.values(), ids=FORMS)
def test_plugins_extend_any_importable_function(name, call, result, how, with_handlers):
    log = []
    assert with_handlers(call, *telling(log, found(name, how))) == call() == result
    assert log == ["before", "after"]


# -- positions ------------------------------------------------------------------------------------


@EVERYWHERE
def test_plugins_run_in_order_and_see_each_others_changes(
    with_handlers,
):
    function, seen = local(), []

    def see(*args, **kwargs):
        seen.append((args, kwargs))
        return 0  # which changes nothing

    entries = [
        (lambda value, more=0: ChangedArgs(value * 2, more=5), function, "before"),
        (see, function, "before"),
        (lambda value, more=0: ChangedArgs(value + 1, more=more), function, "before"),
        (see, function, "after"),
        (lambda value, more=0, *, _result=None: ChangedResult(_result * 10), function, "after"),
        (lambda *args, _result, **kwargs: ChangedResult(_result + 1), function, "after"),
        (lambda value, more=0: seen.append("plain"), function, "after"),
    ]
    assert with_handlers(lambda: function(3), *entries) == (7 + 5) * 10 + 1
    assert seen == [((6,), {"more": 5}), ((7,), {"more": 5, "_result": 12}), "plain"]
    assert repr(ChangedArgs(1, b=2)) == "ChangedArgs(1, b=2)"
    assert repr(ChangedResult("x")) == "ChangedResult(value='x')"


@EVERYWHERE
def test_plugins_get_arguments_as_passed_under_any_parameter_names(with_handlers):
    @expose_to_plugins
    def function(value, more=2, most=3):
        return value, more, most

    seen = []
    entries = [
        (lambda *args, **kwargs: seen.append((args, kwargs)), function, "before"),
        (lambda a, b=8, c=9: seen.append((a, b, c)), function, "before"),
    ]
    assert with_handlers(lambda: function(more=4, value=1), *entries) == (1, 4, 3)
    assert with_handlers(lambda: function(1, most=5), *entries) == (1, 2, 5)
    assert seen == [((), {"more": 4, "value": 1}), (1, 4, 9), ((1,), {"most": 5}), (1, 2, 5)]


@EVERYWHERE
def test_plugin_instead_runs_alone_and_can_call_the_original_function(with_handlers):
    function, log = local(), []
    first = (lambda *args: "first", function, "instead")
    latest = (lambda value, more=0: function.__wrapped__(value, more) * 10, function, "instead")
    assert with_handlers(lambda: function(2), *telling(log, function), first, latest) == 20
    assert with_handlers(lambda: function(2), *telling(log, function), latest, first) == "first"
    assert log == []


def test_plugin_attached_during_a_call_runs_from_the_next_call_on():
    function, log = local(), []

    def change(value, more=0):
        log.append(value)
        if value == 1:
            remove_handler(function, "after")
            attach_handler(lambda *args: log.append("late"), function, "before")
            function(0)

    with handlers((change, function, "before")):
        attach_handler(lambda *args: log.append("after"), function, "after")
        function(1)
        assert log == [1, 0, "late", "after"]
        remove_handler(function, "before")


# -- what is exposed ------------------------------------------------------------------------------


def test_expose_to_plugins_exposes_a_method_for_one_class():
    held, log = vars(Trader), []

    class Model(Trader):
        over = expose_to_plugins(held["rounded"])
        under = staticmethod(expose_to_plugins(held["rounded"].__func__))
        class_over = expose_to_plugins(held["opening"])
        class_under = classmethod(expose_to_plugins(held["opening"].__func__))
        bid = expose_to_plugins(Trader.bid)

    class Sub(Model):
        fee = 6

    for name in ("over", "under", "class_over", "class_under"):
        given, result = ((), 6) if name.startswith("class") else ((2.5,), 2)
        with handlers((lambda *args: log.append(1), getattr(Model, name), "before")):
            assert getattr(Sub(), name)(*given) == getattr(Sub, name)(*given) == result
        assert getattr(Sub, name)(*given) == result
    assert log == [1] * 8
    with handlers((lambda *args, **kwargs: "sub", Model.bid, "instead")):
        assert [kind().bid("tea") for kind in (Trader, Sub)] == [5, "sub"]
    assert expose_to_plugins(vars(Model)["over"]) is vars(Model)["over"]
    assert isinstance(expose_to_plugins(expose_to_plugins(Trader.opening)), classmethod)


def test_expose_to_plugins_takes_functions_without_dotted_names():
    gc.collect()  # other tests have exposed functions, too
    first, function, length, items = (
        local(),
        local(),
        expose_to_plugins(len),
        expose_to_plugins({1}),
    )
    name = f"{HERE}.local.<locals>.function"
    assert expose_to_plugins(function) is function
    assert exposed_functions().count("an iterable set") == 1
    assert {name, "builtins.len"} < set(exposed_functions())
    assert BID not in exposed_functions()
    entries = [
        (lambda thing, **kwargs: ChangedResult(kwargs["_result"] + 1), length, "after"),
        (failing, BID, "instead"),
        (lambda value, more=0: 9, name, "instead"),
    ]
    with handlers(*entries):
        assert BID in exposed_functions()
        targets = ["builtins.len", BID, name]
        assert attached_handlers() == [
            (entry[0], name, entry[2]) for entry, name in zip(entries, targets, strict=True)
        ]
        assert (first(1), function(1)) == (1, 9)  # the latest of that name
        assert (length([1, 2]), list(items)) == (3, [1])
    assert length([1, 2]) == 2


POOL = expose_to_plugins([1, 2])


@EVERYWHERE
def test_expose_to_plugins_keeps_a_list_a_list(with_handlers):
    assert isinstance(POOL, list)
    assert not isinstance(POOL, collections.abc.Iterator)
    assert (len(POOL), POOL[0], 2 in POOL, POOL == [1, 2]) == (2, 1, True, True)
    subjects, numbers = [], iter([7, 8])
    items = with_handlers(
        lambda: [*POOL],
        (subjects.append, POOL, "before_next"),
        (lambda thing, _result: ChangedResult(_result * 10), f"{HERE}.POOL", "after_next"),
    )
    assert items == [10, 20]
    assert [subject is POOL for subject in subjects] == [True] * 3
    assert with_handlers(lambda: [*POOL], (lambda thing: next(numbers), POOL, "instead_next")) == [
        7,
        8,
    ]
    assert [*POOL] == [1, 2]


def test_expose_to_plugins_keeps_an_iterator_an_iterator():
    items = expose_to_plugins(iter([1, 2, 3]))
    assert expose_to_plugins(items) is items
    assert isinstance(items, collections.abc.Iterator)
    assert iter(items) is items
    with handlers((lambda thing, _result: ChangedResult(-_result), items, "after_next")):
        assert next(items) == -1
    assert list(items) == [2, 3]
    assert list(items) == []


def test_copied_iterable_exposed_to_plugins_keeps_its_plugins():
    items = expose_to_plugins([[1], [2]])
    with handlers((lambda thing, _result: ChangedResult(_result * 2), items, "after_next")):
        copied = copy.deepcopy(items)
        copied[0].append(5)
        assert list(copied) == [[1, 5, 1, 5], [2, 2]]
        shallow = copy.copy(items)
        shallow.append([3])
        assert (list(shallow)[:2], list(items)) == ([[1, 1], [2, 2]], [[1, 1], [2, 2]])
        restored = pickle.loads(pickle.dumps(items))
        assert list(restored) == [[1], [2]]
    assert type(restored) is type(items)


# -- what is refused ------------------------------------------------------------------------------


def two(a, b):
    return a, b


@pytest.mark.parametrize(
    ("entry", "error"),
    [
        ((print, "nowhere", "before"), UnknownTargetError),
        ((print, f"{MARKET}.OPEN", "before_next"), PatchError),
        ((print, "math.sqrt", "before"), PatchError),
        ((print, [1, 2], "before_next"), PatchError),
        ((print, Trader().bid, "before"), PatchError),
        ((print, two, "before_next"), HandlerError),
        ((print, POOL, "before"), HandlerError),
        *(
            ((wrong, two, "before"), HandlerError)
            for wrong in (
                None,
                lambda: 0,
                lambda a, *, b: 0,
                lambda a, b, _result: 0,
                lambda **kwargs: 0,
            )
        ),
        ((lambda a, b, _result: 0, two, "instead"), HandlerError),
        ((lambda good, *, discount=0: None, f"{MARKET}.price", "before"), HandlerError),
        ((lambda self, good: None, BID, "before"), HandlerError),
        ((print, BID), HandlerError),
    ],
    ids=plainly,
)
def test_attach_handler_refuses_plugins_that_cannot_work(entry, error):
    good = (nothing, f"{HERE}.two", "before")
    with pytest.raises(error), handlers(good, entry):
        raise AssertionError
    assert hook_of(two) is None
    with pytest.raises(error):
        generate_env(House, House.water, plugins=[good, entry])


async def items_of_a_stream():
    yield 1


@pytest.mark.parametrize(
    ("thing", "why"),
    [(Trader, "expose one of its"), (3, "neither"), (items_of_a_stream, "async generator")],
)
def test_expose_to_plugins_refuses_all_but_functions_and_iterables(thing, why):
    with pytest.raises(PatchError, match=why):
        expose_to_plugins(thing)


# -- for a while ----------------------------------------------------------------------------------


def test_remove_handler_removes_only_its_own_plugin():
    function, log = local(), []

    def see(value, more=0):
        log.append(value)

    for _ in range(3):
        attach_handler(see, function, "before")
    with handlers((see, function, "before")):
        function(1)
    function(2)
    remove_handler(function, "before", see)
    with pytest.raises(
        HandlerError, match=r"print is not attached 'before' .*; handlers are attached: before"
    ):
        remove_handler(function, "before", print)
    function(3)
    remove_handler(function, "before")  # all of them
    for nowhere in (function, BID):
        with pytest.raises(
            HandlerError,
            match=r"no handler is attached 'before' .*; handlers are attached: nowhere",
        ):
            remove_handler(nowhere, "before")
    with pytest.raises(ZeroDivisionError), handlers((failing, function, "instead")):
        function(4)
    function(5)
    assert log == [1] * 4 + [2] * 3 + [3] * 2


# -- errors ---------------------------------------------------------------------------------------


@EVERYWHERE
@pytest.mark.parametrize(
    ("position", "target"),
    [("before", BID), ("after", BID), ("instead", BID), ("after_next", f"{HERE}.counting")],
)
def test_plugin_error_names_its_function_and_closes_the_generator(position, target, with_handlers):
    def call():
        return next(counting(3)) if position == "after_next" else Trader().bid("tea")

    expected = call()
    closed.clear()
    with pytest.raises(ZeroDivisionError, match="of the handler") as caught:
        with_handlers(call, (failing, target, position))
    assert closed == ([3] if position == "after_next" else [])
    said, *rest = notes(caught.value).splitlines()
    assert said == f"simenv_marl: in the handler failing, attached {position} {target}"
    assert rest == [] or with_handlers is of_an_environment
    assert with_handlers(call, (nothing, target, "before")) == expected


@EVERYWHERE
def test_plugin_after_does_not_run_if_the_function_raises_an_error(with_handlers):
    function, log = local(), []
    with pytest.raises(TypeError) as caught:
        with_handlers(lambda: function("text", 1), *telling(log, function))
    assert (log, "handler" in notes(caught.value)) == (["before"], False)


# -- generator and coroutine functions ------------------------------------------------------------


@EVERYWHERE
def test_plugins_of_a_generator_get_its_arguments_items_and_return_value(
    with_handlers,
):
    log = []

    def call():
        generator = counting(2)
        assert log == []
        return list(generator)

    items = with_handlers(
        call,
        (lambda number, step=1: ChangedArgs(number + 1, 10), counting, "before"),
        (lambda number, step=1, *, _result: log.append((number, step, _result)), counting, "after"),
        (lambda number, step=1: log.append(number), counting, "before_next"),
        (lambda number, step=1, *, _result: ChangedResult(_result + 100), counting, "after_next"),
        (lambda number, step=1, *, _result: ChangedResult(_result * 2), counting, "after_next"),
    )
    assert items == [200, 220, 240]
    assert log == [3, 3, 3, 3, (3, 10, 0)]
    assert inspect.isgeneratorfunction(counting)


@EVERYWHERE
@pytest.mark.parametrize("position", ["before", "after_next"])
def test_plugins_pass_sent_values_and_errors_on_to_the_generator(position, with_handlers):
    def call():
        generator = counting(4)
        seen = [next(generator), generator.send(5), generator.throw(KeyError()), generator.send(7)]
        assert seen == [0, 1, 2, 3]
        with pytest.raises(StopIteration) as stop:
            generator.send(1)
        assert stop.value.value == 8
        closed.clear()
        given_up, failed = counting(5), counting(6)
        next(given_up)
        next(failed)
        given_up.close()
        with pytest.raises(ZeroDivisionError):
            failed.throw(ZeroDivisionError())
        assert closed == [5, 6]

    with_handlers(call, (nothing, counting, position))


def letters(number, step=1):
    yield from "ab"
    return "c"


@EVERYWHERE
@pytest.mark.parametrize(
    ("instead", "items", "value"),
    [
        (letters, ["a", "b"], "c"),
        (lambda number, step=1: [7, 8], [7, 8], None),
        (lambda number, step=1: None, [], None),
        (lambda number, step=1: "ab", [], "ab"),
        (lambda number, step=1: b"ab", [], b"ab"),
    ],
    ids=["generator", "list", "nothing", "string", "bytes"],
)
def test_plugin_instead_of_a_generator_can_return_items_or_a_value(
    instead, items, value, with_handlers
):
    returned = []

    def call():
        returned.append((yield from counting(100)))

    assert with_handlers(lambda: [*call()], (instead, counting, "instead")) == items
    assert returned == [value]


def test_plugin_can_replace_single_items_of_a_generator():
    left = letters(3)
    with handlers((lambda number, step=1: next(left), counting, "instead_next")):
        generator, ended = counting(3), counting(3)
        assert (next(generator), generator.send(7)) == ("a", "b")
        with pytest.raises(StopIteration) as stop:
            next(ended)
        assert (stop.value.value, notes(stop.value)) == ("c", "")
    assert generator.send(5) == 0  # what is sent to a generator that has not begun is not passed on


@EVERYWHERE
def test_plugin_after_a_coroutine_function_gets_the_awaited_result(with_handlers):
    name, log = f"{MARKET}.Trader.wire", []

    async def before(self, amount):
        await asyncio.sleep(0)
        log.append("before")
        return ChangedArgs(self, amount + 1)

    async def instead(self, amount):
        return amount or failing()

    def call(amount=1):
        coroutine = Trader().wire(amount)
        assert inspect.iscoroutinefunction(Trader.wire)
        assert log == []
        return asyncio.run(coroutine)

    after = (lambda self, amount, _result: ChangedResult((amount, _result)), name, "after")
    assert with_handlers(call, (before, name, "before"), after) == (2, 2)
    log.clear()
    assert with_handlers(call, after, (instead, name, "instead")) == 1
    with fails(ZeroDivisionError, "instead, attached instead"):
        with_handlers(lambda: call(0), (instead, name, "instead"))


# -- seeing what happens --------------------------------------------------------------------------


def test_trace_lists_calls_in_the_order_in_which_they_begin():
    function = local()
    with (
        handlers(
            (lambda value, more=0: market.price("tea", rebate=value) and None, function, "before")
        ),
        trace(function, f"{MARKET}.price", counting, Trader.wire) as calls,
    ):
        function(3, more=4)
        list(counting(2))
        asyncio.run(Trader().wire(8))
        with pytest.raises(TypeError):
            function([])
    *shown, failed, price = [
        (call.target.rpartition(".")[2], call.arguments, call.result) for call in calls
    ]
    assert shown[:2] == [("function", "3, more=4", "7"), ("price", "'tea', rebate=3", "7")]
    assert shown[2] == ("counting", "2", "0")
    assert shown[3][::2] == ("wire", "8")
    assert (failed[:2], price[:2]) == (("function", "[]"), ("price", "'tea', rebate=[]"))
    assert failed[2].startswith("raised TypeError")
    # which is what is exposed, or has handlers
    with handlers((nothing, BID, "before")), trace() as everything:
        function(1)
        Trader().bid("tea")
        Trader.rounded(2.5)
    assert [call.target for call in everything] == [f"{HERE}.local.<locals>.function", BID]
    assert len(calls) == 6


# -- one environment alone ------------------------------------------------------------------------


class House:
    """A greenhouse whose ventilation nobody has thought of as a decision."""

    step, render_modes = 0, ("ansi",)

    def __init__(self):
        self.log = []

    def word(self):
        return "plain"

    def note(self):
        self.log.append(self.word())

    stop = note

    def reset(self, seed=None):
        self.note()

    def run(self):
        for self.step in range(3):
            self.note()
            self.water()
            self.note()

    @define(agent="waterer_0", observation_space_mapping=lambda self: [len(self.word()), self.step])
    def water(self):
        return 0

    def time(self):
        return self.step + len(self.word()) / 10

    def state(self):
        return [len(self.word())]

    def render(self, mode):
        return self.word()


WORD = f"{HERE}.House.word"


def says(word):
    return (lambda self: word, WORD, "instead")


def test_plugins_apply_to_the_simulation_and_mappings_of_their_env():
    env = single_env(House, House.water, plugins=[says("mine")], render_mode="ansi")
    simulation = env.simulation
    assert env.reset()[0].tolist() == [4, 0]
    assert simulation.word() == "plain"
    assert env.step(1)[0].tolist() == [4, 1]
    assert simulation.word() == "plain"
    assert env.render() == "mine"
    assert env.unwrapped.state().tolist() == [4]
    env.close()
    assert joint_env(House, House.water, plugins=[says("mine")]).reset()[1]["time"] == 0.4
    assert simulation.log == ["mine"] * 5
    assert simulation.word() == "plain"
    assert simulate(House, points=House.water, plugins=iter([says("mine")])).log == ["mine"] * 7


@pytest.mark.parametrize(
    "make",
    [
        aec_env,
        parallel_env,
        single_env,
        joint_env,
        lambda *args, **kwargs: generate_env(*args, **kwargs)(),
    ],
)
def test_envs_with_different_plugins_can_be_interleaved(make):
    words = {"one": [says("one")], "two": [says("two")], "plain": []}
    envs = {word: make(House, House.water, plugins=plugins) for word, plugins in words.items()}
    for _ in range(2):
        for word, env in envs.items():
            env.reset(seed=1)
            assert [entry[1:] for entry in attached_handlers(env)] == [(WORD, "instead")] * (
                word != "plain"
            )
        for _ in range(2):
            for env in envs.values():
                step(env, 1, "waterer_0")
                assert House().word() == "plain"
        for word, env in envs.items():
            env.close()
            assert set(env.simulation.log) == {word}


def test_plugins_of_the_process_run_before_plugins_of_an_env():
    log = []
    process, environment = (
        telling(log, WORD, " of the process"),
        telling(log, WORD, " of the environment"),
    )
    env = single_env(House, House.water, plugins=environment)
    with handlers(*process):
        env.reset()
    env.close()
    assert log[:2] == ["before of the process", "before of the environment"]
    assert log[2:4] == ["after of the process", "after of the environment"]
    env = single_env(House, House.water, plugins=[*environment, says("environment")])
    log.clear()
    with handlers(*process, says("process")):
        env.reset()
        assert House().word() == "process"
    assert env.simulation.log[-1] == "environment"
    assert log == []  # the latest "instead" alone runs
    env.close()


def test_envs_with_plugins_can_be_garbage_collected_at_any_moment():
    """Also while handlers are made ready, which looks through those that environments have."""

    def look(frame, event, arg):
        nonlocal left
        left -= event == "call" and "/hooks/" in frame.f_code.co_filename
        if left == 0:
            gc.collect()

    choose = decision()
    left = number = 0
    gc.disable()
    try:
        while left <= 0:  # until there are no more calls
            env = begun(
                aec_env(
                    calling(lambda: Trader().bid("tea"), choose),
                    choose,
                    plugins=[(nothing, BID, "before")],
                )
            )
            env.itself = env
            del env
            number += 1
            left = number
            sys.setprofile(look)
            with handlers((nothing, BID, "before")):
                assert Trader().bid("tea") == 5
                found = hook_of(vars(Trader)["bid"])
            sys.setprofile(None)
            gc.collect()
    finally:
        sys.setprofile(None)
        gc.enable()
    assert number > 10
    assert found.interceptors == hook_of(choose).interceptors == {}


def test_functions_are_patched_for_plugins_only_while_an_env_exists():
    before = vars(House)["word"]
    made = generate_env(House, House.water, plugins=[says("mine")])
    assert vars(House)["word"] is before
    env = begun(made(plugins=[]))
    assert env.simulation.word() == "plain"
    assert vars(House)["word"] is before
    env = made()
    assert vars(House)["word"] is not before
    del env
    gc.collect()
    assert vars(House)["word"] is before


# -- handlers and decisions ------------------------------------------------------------------------


@define(agent="ventilator_0", observation_space_mapping=lambda self: [self.step, 0])
def ventilate(self):
    return "rule"


def test_plugin_can_decide_and_extend_the_simulations_methods():
    plugins = [
        (lambda self: self.log.append("made"), f"{HERE}.House.__init__", "after"),
        (lambda self, seed=None: ChangedArgs(self, seed=77), f"{HERE}.House.reset", "before"),
        (lambda self, seed=None: self.log.append(seed), f"{HERE}.House.reset", "after"),
        (lambda self, _result: ChangedResult(TRUNCATED), f"{HERE}.House.run", "after"),
        (ventilate, WORD, "instead"),
    ]
    env = aec_env(House, [House.water, ventilate], plugins=plugins)
    turns = play(env, {"waterer_0": 1, "ventilator_0": 7})
    assert decisions(turns) == ["ventilator_0", "waterer_0", "ventilator_0"] * 3
    # during reset the rule decides
    assert env.simulation.log == ["made", "rule", 77, *[7] * 6]
    assert turns[-1].truncated
    env.close()


@pytest.mark.parametrize("where", ["before the points", "after the points", "of the environment"])
def test_plugins_before_and_after_a_decision_point_run_around_the_decision(where):
    seen, decided = [], []

    def before(self, good, limit=5):
        return ChangedArgs(self, good.upper(), limit=limit + 1)

    def after(self, good, limit=5, *, _result):
        decided.append(_result)
        return ChangedResult(_result * 10)

    points = {
        BID: define(
            observation_space_mapping=lambda self, good, limit=5: (
                seen.append((good, limit)) or [0, 0]
            )
        )
    }
    entries = {where: [(before, BID, "before"), (after, BID, "after")]}
    bids = calling(lambda: Trader().bid("tea"), lambda: Broker().bid("tea", limit=6))
    with handlers(*entries.get("before the points", ())):
        env = aec_env(bids, points, plugins=entries.get("of the environment", ()))
        with handlers(*entries.get("after the points", ())):
            play(env, 4)
    assert env.simulation.log == [40, 40]
    assert decided == [4, 4]
    assert set(seen) == {("TEA", 6), ("TEA", 7)}
    env.close()


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(8))
def test_envs_and_plugins_can_be_added_and_removed_in_any_order(seed):
    random, live, log = Random(seed), [], []
    calls = {name: (call, result) for name, call, result in FORMS.values()}

    def log_as(name):
        return lambda *args, **kwargs: log.append(name)

    def attach(name):
        block = handlers((log_as(name), name, "before"))
        block.__enter__()
        return "handlers", name, lambda: block.__exit__(None, None, None)

    def environment(name):
        plugins = [(log_as("plugin"), other, "after") for other in random.sample(sorted(calls), 3)]
        env = aec_env(calling(calls[name][0]), {name: define()}, plugins=plugins)
        return env, name, env.close

    for _ in range(60):
        if live and random.random() < 0.5:
            *_, leave = live.pop(random.randrange(len(live)))
            leave()
        else:
            live.append(random.choice([attach, environment])(random.choice(sorted(calls))))
        attached = [name for what, name, _ in live if what == "handlers"]
        for name, (call, result) in calls.items():
            log.clear()
            assert call() == result
            base = name.replace("Broker", "Trader")  # which a broker's call goes on to
            assert log == [name] * attached.count(name) + [base] * attached.count(base) * (
                base != name
            )
        for env, name, _ in random.sample(live, min(len(live), 2)):
            for action, result in ((4, 4), (RULE, calls[name][1])) if env != "handlers" else ():
                log.clear()
                play(env, action)
                assert env.simulation.log == [result]
                assert log.count(name) == attached.count(name)
    for *_, leave in live:
        leave()


def test_expose_to_plugins_works_before_or_after_make_step():
    def choose():
        return "rule"

    over, under, log = (
        expose_to_plugins(define()(choose)),
        define(agent="under_0")(expose_to_plugins(choose)),
        [],
    )
    assert inspect.unwrap(over) is inspect.unwrap(under) is choose
    assert decision_points().count(f"{choose.__module__}.{choose.__qualname__}") == 1
    for point, agent in ((over, "choose_0"), (under, "under_0")):
        env = aec_env(calling(point), point)
        with handlers((lambda _result: log.append(_result), point, "after")):
            assert decisions(play(env, 4)) == [agent]
        env.close()
    assert log == [4, 4]


def test_make_step_under_attached_plugins_does_not_keep_the_plugins(monkeypatch):
    log = []
    monkeypatch.setattr(Trader, "bid", Trader.bid)  # which puts it back
    with handlers((lambda *args, **kwargs: log.append(1), BID, "before")):
        Trader.bid = define()(Trader.bid)
        assert Trader().bid("tea") == 5
    with handlers(
        (lambda *args, **kwargs: log.append(2), BID, "before"),
        (lambda *args, **kwargs: log.append(3), Trader.bid, "before"),
    ):
        env = aec_env(calling(lambda: Trader().bid("tea")), Trader.bid)
        play(env, 4)
        assert env.simulation.log == [4]
        env.close()
    assert log == [1, 2, 3]


def test_suspended_generators_keep_the_plugins_of_their_env():
    items, envs = expose_to_plugins([1, 2, 3]), {}

    @expose_to_plugins
    def days(number):
        for _ in range(number):
            yield CHOOSE()

    def times(factor, target):
        return (lambda _, _result: ChangedResult(_result * factor), target, "after_next")

    simulation = script(lambda simulation: simulation.log.extend(zip(days(3), items, strict=False)))
    for factor in (10, 100, 1):
        plugins = [times(factor, days), times(factor, items)] if factor > 1 else []
        envs[factor] = aec_env(simulation, CHOOSE, plugins=plugins)
        envs[factor].reset()
    for action in (7, 8, 9):
        for env in envs.values():
            env.step(action)
    for factor, env in envs.items():
        assert env.simulation.log == [
            (7 * factor, factor),
            (8 * factor, 2 * factor),
            (9 * factor, 3 * factor),
        ]


def test_vector_env_plugins_apply_to_mappings_too(monkeypatch):
    # as long as no difference was made, less is entered
    monkeypatch.setattr("simenv_marl.core.episodes.agent.DIFFERENCES", [])
    reward = {House.water: define(agent="a_0", reward_mapping=lambda self: len(self.word()))}
    for points, observations, rewards in ((reward, [1, 2], 4), (House.water, [4, 0], 0)):
        envs = vector_env(House, points, num_envs=2, plugins=[says("mine")])
        assert envs.reset()[0].tolist() == [observations] * 2
        assert envs.step(np.zeros(2, np.int64))[1].tolist() == [rewards] * 2
        envs.close()
