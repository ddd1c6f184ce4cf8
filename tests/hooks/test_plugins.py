"""Section 8: handlers before, after and instead of a model's functions, for the whole process."""

import asyncio
import collections.abc
import copy
import gc
import inspect
import pickle
import statistics

import pytest

from simenv_marl import SimEnvError, aec_env
from simenv_marl.errors import HandlerError, PatchError, UnknownTargetError
from simenv_marl.hooks.places import resolve
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
from tests.foreign import market, shop
from tests.foreign.market import Broker, Cautious, Dealer, Junior, Trader
from tests.worlds.models import calling, decision, define, notes, plainly, play
from tests.worlds.undone import left_as_they_were

MARKET = "tests.foreign.market"
HERE = __name__


@pytest.fixture(autouse=True)
def _nothing_stays_attached():
    with left_as_they_were(market, shop, Trader, Broker, Junior, Dealer, Cautious, Greenhouse, Heated):
        yield
        assert attached_handlers() == []


class Greenhouse:
    def __init__(self, humidity=50):
        self.humidity = humidity

    def __repr__(self):
        return f"Greenhouse({self.humidity})"

    def update_air_exchange(self):
        self.humidity += 1

    def water(self, amount, *, twice=False):
        """Water the plants."""
        return amount * (2 if twice else 1)

    def days(self, number):
        yield from range(number)
        return "over"

    async def wire(self, amount):
        return amount

    @staticmethod
    def rounded(amount):
        return int(amount)

    @classmethod
    def kind(cls, suffix=""):
        return cls.__name__ + suffix


class Heated(Greenhouse):
    def water(self, amount, *, twice=False):
        return super().water(amount, twice=twice) + 100


HOUSE = f"{HERE}.Greenhouse"


def local():
    """A function of its own, exposed, with a log of its handlers."""

    @expose_to_plugins
    def function(value, more=0):
        """Add."""
        return value + more

    return function


# -- positions ------------------------------------------------------------------------------------


def test_handlers_of_a_position_run_in_the_order_in_which_they_were_attached_and_their_changes_chain():
    function, seen = local(), []

    def see(*args, **kwargs):
        seen.append((args, kwargs))

    with handlers(
        (lambda value, more=0: ChangedArgs(value * 2, more=5), function, "before"),
        (see, function, "before"),
        (lambda value, more=0: ChangedArgs(value + 1, more=more), function, "before"),
        (see, function, "after"),
        (lambda value, more=0, *, _result=None: ChangedResult(_result * 10), function, "after"),
        (lambda *args, _result, **kwargs: ChangedResult(_result + 1), function, "after"),
        (lambda value, more=0: seen.append("plain"), function, "after"),
    ):
        assert function(3) == (7 + 5) * 10 + 1
    assert seen == [((6,), {"more": 5}), ((7,), {"more": 5, "_result": 12}), "plain"]
    assert repr(ChangedArgs(1, b=2)) == "ChangedArgs(1, b=2)"
    assert repr(ChangedResult("x")) == "ChangedResult('x')"


@pytest.mark.parametrize("nothing", [None, 0, False, "text", (1, 2)])
def test_whatever_else_handlers_return_changes_nothing(nothing):
    function = local()
    with handlers((lambda *args: nothing, function, "before"), (lambda *args, _result: nothing, function, "after")):
        assert function(1, 2) == 3


@pytest.mark.parametrize(
    ("args", "kwargs", "under_other_names"),
    [
        ((1,), {}, (1, 8, 9)),
        ((1, 2), {}, (1, 2, 9)),
        ((1,), {"more": 2}, (1, 2, 9)),
        ((), {"value": 1}, (1, 8, 9)),
        ((), {"more": 3, "value": 1}, (1, 3, 9)),
        ((1,), {"most": 5}, (1, 2, 5)),
    ],
    ids=str,
)
def test_handlers_get_the_arguments_as_they_were_passed_whatever_they_call_them(args, kwargs, under_other_names):
    @expose_to_plugins
    def function(value, more=2, most=3):
        return value, more, most

    seen = []
    with handlers(
        (lambda *args, **kwargs: seen.append((args, kwargs)), function, "before"),
        (lambda a, b=8, c=9: seen.append((a, b, c)), function, "before"),
    ):
        assert function(*args, **kwargs) == function.__wrapped__(*args, **kwargs)
    assert seen == [(args, kwargs), under_other_names]


def test_a_wrong_call_is_the_functions_own_error_and_no_handler_runs():
    function, log = local(), []
    with handlers((lambda *args, **kwargs: log.append(1), function, "before")):
        for wrong in (lambda: function(), lambda: function(1, 2, 3), lambda: function(1, other=3)):
            with pytest.raises(TypeError):
                wrong()
    assert log == []


def test_of_several_instead_the_latest_alone_runs_and_may_call_what_it_replaces():
    function, log = local(), []
    with handlers(
        (lambda *args: log.append("before"), function, "before"),
        (lambda *args: "first", function, "instead"),
        (lambda value, more=0: function.__wrapped__(value, more) * 10, function, "instead"),
        (lambda *args: log.append("after"), function, "after"),
    ):
        assert function(2) == 20
        assert log == []
        remove_handler(function, "instead", attached_handlers()[2][0])
        assert function(1) == "first"
    assert function(1) == 1
    with handlers((lambda self, *_, **__: Greenhouse.water.__wrapped__(self, 1) + 0.5, f"{HOUSE}.water", "instead")):
        assert Greenhouse().water(7) == 1.5


def test_handlers_that_call_the_function_again_are_called_again():
    function, depths = local(), []

    def before(value, more=0):
        depths.append(value)
        if value:
            function(value - 1)

    with handlers((before, function, "before")):
        function(2)
    assert depths == [2, 1, 0]


def test_handlers_may_come_and_go_while_the_function_runs():
    log = []

    @expose_to_plugins
    def function():
        if not attached_handlers():
            attach_handler(lambda: log.append("after"), function, "after")
            attach_handler(once, function, "before")
            attach_handler(lambda: log.append("second"), function, "before")

    def once():
        log.append("once")
        remove_handler(function, "before")

    function()
    assert log == []
    function()
    function()
    assert log == ["once", "second", "after", "after"]
    remove_handler(function, "after")


# -- what can be extended -------------------------------------------------------------------------


FORMS = {
    "method": (f"{HOUSE}.water", lambda: Greenhouse().water(3), 3),
    "construction": (f"{HOUSE}.__init__", lambda: Heated(humidity=3).humidity, 3),
    "inherited": (f"{HERE}.Heated.update_air_exchange", lambda: Heated().update_air_exchange(), None),
    "overridden": (f"{HOUSE}.water", lambda: Heated().water(3) - 100, 3),
    "staticmethod": (f"{HOUSE}.rounded", lambda: Greenhouse.rounded(2.5), 2),
    "staticmethod of an object": (f"{HOUSE}.rounded", lambda: Heated().rounded(2.5), 2),
    "inherited staticmethod": (f"{HERE}.Heated.rounded", lambda: Heated.rounded(2.5), 2),
    "classmethod": (f"{HOUSE}.kind", lambda: Heated.kind(suffix="!"), "Heated!"),
    "inherited classmethod": (f"{HERE}.Heated.kind", lambda: Heated.kind(suffix="!"), "Heated!"),
    "function": (f"{MARKET}.price", lambda: market.price("tea", rebate=2), 8),
    "imported by name": (f"{MARKET}.price", lambda: shop.total("tea"), 10),
    "imported under another name": (f"{MARKET}.price", lambda: shop.total_cost("tea"), 9),
    "private": (f"{MARKET}.Trader.__hidden", lambda: Trader().look(), 7),
    "standard library": ("statistics.mean", lambda: statistics.mean([1, 2, 3]), 2),
    "generator function": (f"{HOUSE}.days", lambda: list(Greenhouse().days(3)), [0, 1, 2]),
    "coroutine function": (f"{HOUSE}.wire", lambda: asyncio.run(Greenhouse().wire(3)), 3),
}


@pytest.mark.parametrize("how", ["by name", "as itself"])
@pytest.mark.parametrize("form", FORMS)
def test_whatever_is_importable_can_be_extended(form, how):
    name, call, result = FORMS[form]
    target, log = name, []
    if how == "as itself":
        owner, attribute = resolve(name, UnknownTargetError)
        target = getattr(owner, attribute)
    with handlers(
        (lambda *args, **kwargs: log.append("before"), target, "before"),
        (lambda *args, **kwargs: log.append("after"), target, "after"),
    ):
        assert call() == result
        assert log == ["before", "after"]
    assert call() == result
    assert log == ["before", "after"]


def test_an_inherited_method_is_extended_for_its_class_and_subclasses_alone():
    log = []
    sub = (lambda self, *args, **kwargs: log.append(type(self).__name__), f"{MARKET}.Broker.bid", "before")
    base = (lambda self, *args, **kwargs: log.append("base"), f"{MARKET}.Trader.bid", "before")
    with handlers(sub):
        assert [kind().bid("tea") for kind in (Trader, Broker, Junior, Dealer, Cautious)] == [5, 5, 5, 5, 4]
    assert log == ["Broker", "Junior"]
    for first, second in ((sub, base), (base, sub)):
        log.clear()
        attach_handler(*first)
        attach_handler(*second)
        Broker().bid("tea")
        assert log == ["Broker", "base"]
        remove_handler(first[1], "before")
        Broker().bid("tea")
        assert log == ["Broker", "base", "base" if first is sub else "Broker"]
        remove_handler(second[1], "before")


@pytest.mark.parametrize("name", ["over", "under", "class_over", "class_under"])
def test_statics_and_class_methods_can_be_exposed_in_either_order(name):
    held = vars(Greenhouse)

    class Model(Greenhouse):
        over = expose_to_plugins(held["rounded"])
        under = staticmethod(expose_to_plugins(held["rounded"].__func__))
        class_over = expose_to_plugins(held["kind"])
        class_under = classmethod(expose_to_plugins(held["kind"].__func__))

    class Sub(Model):
        pass

    log = []
    given, result = (("!",), "Sub!") if name.startswith("class") else ((2.5,), 2)
    with handlers((lambda *args, **kwargs: log.append(1), getattr(Model, name), "before")):
        assert getattr(Sub(), name)(*given) == getattr(Sub, name)(*given) == result
    assert getattr(Sub, name)(*given) == result
    assert log == [1, 1]


def test_exposing_again_gives_the_same():
    function = local()
    assert expose_to_plugins(function) is function
    items = expose_to_plugins([1])
    assert expose_to_plugins(items) is items
    held = expose_to_plugins(vars(Greenhouse)["rounded"])
    assert isinstance(held, staticmethod)
    assert expose_to_plugins(held) is held
    again = expose_to_plugins(expose_to_plugins(Greenhouse.kind))
    assert isinstance(again, classmethod)


@pytest.mark.parametrize(
    "function",
    [Greenhouse.water, Greenhouse.days, Greenhouse.wire, market.price],
    ids=lambda function: function.__name__,
)
def test_an_exposed_function_keeps_its_looks(function):
    exposed = expose_to_plugins(function)
    assert exposed is not function
    assert inspect.signature(exposed) == inspect.signature(function)
    for name in ("__name__", "__qualname__", "__doc__", "__module__"):
        assert getattr(exposed, name) == getattr(function, name)
    for kind in (inspect.isgeneratorfunction, inspect.iscoroutinefunction, inspect.isfunction):
        assert kind(exposed) == kind(function)
    assert exposed.__wrapped__ is function


def test_siblings_may_each_expose_what_they_have_inherited():
    class Wolf(Greenhouse):
        pass

    class Sheep(Greenhouse):
        pass

    Wolf.water = expose_to_plugins(Wolf.water)
    Sheep.water = expose_to_plugins(Sheep.water)
    with handlers((lambda self, amount, *, twice=False: "wolf", Wolf.water, "instead")):
        assert [kind().water(3) for kind in (Greenhouse, Wolf, Sheep)] == [3, "wolf", 3]


@pytest.mark.parametrize("parameter", ["found", "rule", "args", "self", "SLOT"])
def test_parameters_may_have_any_name(parameter):
    scope = {"expose_to_plugins": expose_to_plugins}
    exec(
        f"class Model:\n    @staticmethod\n    @expose_to_plugins\n    def function({parameter}): return {parameter}",
        scope,
    )
    function, log = scope["Model"].function, []
    for attached in ([], [(lambda *args, **kwargs: log.append(1), function, "before")]):
        with handlers(*attached):
            assert function(3) == function(**{parameter: 4}) - 1 == 3
    assert log == [1, 1]


def test_what_was_exposed_inside_a_function_has_its_name_all_the_same():
    first, function = local(), local()
    with handlers((lambda value, more=0: 9, f"{HERE}.local.<locals>.function", "instead")):
        assert (first(1), function(1)) == (1, 9)


def test_builtins_can_be_exposed_as_themselves():
    length = expose_to_plugins(len)
    with handlers((lambda thing, **kwargs: ChangedResult(kwargs["_result"] + 1), length, "after")):
        assert length([1, 2]) == 3
    assert length([1, 2]) == 2


# -- what is refused ------------------------------------------------------------------------------


def two(a, b):
    return a, b


@pytest.mark.parametrize(
    ("handler", "target", "position", "error"),
    [
        (print, "nowhere", "before", UnknownTargetError),
        (print, "", "before", UnknownTargetError),
        (print, f"{MARKET}.Trader.missing", "before", UnknownTargetError),
        (print, f"{MARKET}.Trader.quote", "before", PatchError),
        (print, f"{MARKET}.OPEN", "before", PatchError),
        (print, f"{HERE}.CLOSED", "before_next", PatchError),
        (print, "math.sqrt", "before", PatchError),
        (print, "datetime.datetime.now", "before", PatchError),
        (print, len, "before", PatchError),
        (print, 3, "before", PatchError),
        (print, [1, 2], "before_next", PatchError),
        (print, Trader().bid, "before", PatchError),
        (print, Trader, "before_next", PatchError),
        (print, f"{MARKET}.Trader", "before", PatchError),
        (print, two, "during", HandlerError),
        (print, two, None, HandlerError),
        (print, two, "before_next", HandlerError),
        (print, expose_to_plugins([1]), "before", HandlerError),
        (print, expose_to_plugins([1]), "after", HandlerError),
        (print, expose_to_plugins([1]), "instead", HandlerError),
        (None, two, "before", HandlerError),
        (lambda: None, two, "before", HandlerError),
        (lambda a: None, two, "before", HandlerError),
        (lambda a, b, c: None, two, "before", HandlerError),
        (lambda a, *, b: None, two, "before", HandlerError),
        (lambda a, b, _result: None, two, "before", HandlerError),
        (lambda a, b, _result: None, two, "instead", HandlerError),
        (lambda **kwargs: None, two, "before", HandlerError),
        (lambda good: None, f"{MARKET}.price", "before", HandlerError),
        (lambda good, *, discount=0: None, f"{MARKET}.price", "before", HandlerError),
        (lambda self, good: None, f"{MARKET}.Trader.bid", "before", HandlerError),
        (lambda good, limit: None, f"{MARKET}.Trader.bid", "after", HandlerError),
    ],
    ids=plainly,
)
def test_what_cannot_work_is_refused_when_it_is_attached(handler, target, position, error):
    with pytest.raises(error) as caught:
        attach_handler(handler, target, position)
    assert isinstance(caught.value, SimEnvError)
    with pytest.raises(error), handlers((handler, target, position)):
        raise AssertionError


def test_whatever_can_be_called_with_the_arguments_is_accepted():
    good = [lambda a, b: None, lambda x, y: None, lambda *args, **kwargs: None, lambda *args: None]
    good += [lambda a, *rest: None, lambda a, b, c=0: None, lambda a, b, /: None, Trader().bid, print]
    for handler in good:
        with handlers((handler, two, "before")):
            assert two(1, b=2) == (1, 2)
            assert two(a=1, b=2) == (1, 2)


@pytest.mark.parametrize(
    ("target", "position", "handler"),
    [(two, "before", None), (two, "before", print), (two, "during", None), (f"{MARKET}.Trader.bid", "after", None)],
    ids=plainly,
)
def test_removing_what_is_not_attached_is_refused(target, position, handler):
    with handlers((two, two, "after")), pytest.raises(HandlerError, match="handlers are attached") as caught:
        remove_handler(target, position, handler)
    assert ("no handler is attached" in str(caught.value)) is (handler is None)


def test_a_slip_of_the_pen_gets_a_hint():
    with pytest.raises(UnknownTargetError, match=r"did you mean .*counting"):
        attach_handler(print, f"{HERE}.countin", "before")


# -- for a while ----------------------------------------------------------------------------------


def test_handlers_are_there_for_as_long_as_the_block_runs():
    bid = (lambda *args, **kwargs: 1, f"{MARKET}.Trader.bid", "instead")
    with handlers(bid):
        assert Trader().bid("tea") == 1
        assert attached_handlers() == [bid]
    assert Trader().bid("tea") == 5
    with pytest.raises(ZeroDivisionError), handlers(bid):
        raise ZeroDivisionError
    assert Trader().bid("tea") == 5
    with (
        pytest.raises(HandlerError, match="cannot be called with the arguments"),
        handlers(bid, (lambda: 1, f"{MARKET}.price", "instead")),
    ):
        raise AssertionError
    with pytest.raises(HandlerError, match="handlers are given as"), handlers(print):
        raise AssertionError


def test_blocks_may_overlap_and_remove_nothing_but_their_own():
    function, log = local(), []

    def see(value, more=0):
        log.append(value)

    for _ in range(2):
        attach_handler(see, function, "before")
    one, two = handlers((see, function, "before")), handlers((see, function, "before"))
    one.__enter__()
    two.__enter__()
    function(1)
    assert log == [1] * 4
    one.__exit__(None, None, None)
    remove_handler(function, "before", see)
    function(2)
    assert log == [1] * 4 + [2] * 2
    remove_handler(function, "before")  # all of them
    two.__exit__(None, None, None)
    function(3)
    assert log == [1] * 4 + [2] * 2
    with pytest.raises(HandlerError, match="not attached"):
        remove_handler(function, "before", see)


# -- errors ---------------------------------------------------------------------------------------


def failing(*args, **kwargs):
    raise ZeroDivisionError("of the handler")


@pytest.mark.parametrize(
    ("position", "target"),
    [(position, f"{MARKET}.Trader.bid") for position in ("before", "after", "instead")]
    + [("before_next", f"{HERE}.counting")],
)
def test_a_handlers_error_is_its_own_and_says_where_it_was_attached(position, target):
    def call():
        return next(counting(3)) if position == "before_next" else Trader().bid("tea")

    log, expected = [], call()
    with handlers((failing, target, position)):
        with pytest.raises(ZeroDivisionError, match="of the handler") as caught:
            call()
        assert notes(caught.value) == f"simenv_marl: in the handler failing, attached {position} {target}"
        remove_handler(target, position)
        with handlers((lambda *args, **kwargs: log.append(1), target, "before")):
            assert call() == expected
    assert log == [1]


def test_a_functions_error_passes_by_what_comes_after():
    function, log = local(), []
    with handlers((lambda *args: log.append(1), function, "after")), pytest.raises(TypeError) as caught:
        function("text", 1)
    assert log == []
    assert notes(caught.value) == ""


# -- generator functions --------------------------------------------------------------------------


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
        CLOSED.append(number)
    return total


CLOSED = []


def test_handlers_of_a_generator_function_see_its_arguments_its_items_and_what_it_returns():
    log = []
    with handlers(
        (lambda number, step=1: ChangedArgs(number + 1, 10), counting, "before"),
        (lambda number, step=1, *, _result: log.append((number, step, _result)), counting, "after"),
        (lambda number, step=1: log.append(number), counting, "before_next"),
        (lambda number, step=1, *, _result: ChangedResult(_result + 100), counting, "after_next"),
        (lambda number, step=1, *, _result: ChangedResult(_result * 2), counting, "after_next"),
    ):
        generator = counting(2)
        assert log == []
        assert list(generator) == [200, 220, 240]
    assert log == [3, 3, 3, 3, (3, 10, 0)]
    assert inspect.isgeneratorfunction(counting)


@pytest.mark.parametrize("position", [None, "before", "after_next"])
def test_what_is_sent_and_thrown_reaches_the_generator(position):
    attached = [] if position is None else [(lambda *args, **kwargs: None, counting, position)]
    with handlers(*attached):
        generator = counting(4)
        assert next(generator) == 0
        assert generator.send(5) == 1
        assert generator.throw(KeyError()) == 2
        assert generator.send(7) == 3
        with pytest.raises(StopIteration) as stop:
            generator.send(1)
        assert stop.value.value == 8
        CLOSED.clear()
        generator = counting(5)
        next(generator)
        generator.close()
        assert CLOSED == [5]
        generator = counting(6)
        next(generator)
        with pytest.raises(ZeroDivisionError):
            generator.throw(ZeroDivisionError())
        assert CLOSED == [5, 6]


def test_items_may_be_handed_out_instead():
    left = [1, 2, 3]

    def instead(number, step=1):
        if not left:
            raise StopIteration("over")
        return left.pop()

    with handlers((instead, counting, "instead_next")):
        generator = counting(100)
        assert [next(generator), generator.send(7), next(generator)] == [3, 2, 1]
        with pytest.raises(StopIteration) as stop:
            next(generator)
        assert stop.value.value == "over"
        assert notes(stop.value) == ""


def test_what_is_sent_before_a_generator_was_asked_is_not_sent_to_it():
    with handlers((lambda number, step=1: "instead", counting, "instead_next")):
        generator = counting(3)
        assert next(generator) == "instead"
    assert generator.send(5) == 0


def letters(number, step=1):
    yield from "ab"
    return "c"


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
def test_a_generator_may_be_replaced(instead, items, value):
    with handlers((instead, counting, "instead")):
        generator = counting(3)
        assert [next(generator) for _ in items] == items
        with pytest.raises(StopIteration) as stop:
            next(generator)
        assert stop.value.value == value


# -- coroutine functions --------------------------------------------------------------------------


def test_coroutine_functions_stay_ones_and_after_gets_what_was_awaited():
    log = []

    async def before(self, amount):
        await asyncio.sleep(0)
        log.append("before")
        return ChangedArgs(self, amount + 1)

    async def instead(self, amount):
        return "instead"

    async def fails(self, amount):
        failing()

    with handlers(
        (before, f"{HOUSE}.wire", "before"),
        (lambda self, amount, _result: ChangedResult((amount, _result)), f"{HOUSE}.wire", "after"),
    ):
        assert inspect.iscoroutinefunction(Greenhouse.wire)
        coroutine = Greenhouse().wire(1)
        assert log == []
        assert asyncio.run(coroutine) == (2, 2)
    with handlers((instead, f"{HOUSE}.wire", "instead")):
        assert asyncio.run(Greenhouse().wire(1)) == "instead"
    with handlers((fails, f"{HOUSE}.wire", "before")):
        with pytest.raises(ZeroDivisionError) as caught:
            asyncio.run(Greenhouse().wire(1))
        assert "fails, attached before" in notes(caught.value)


# -- iterables ------------------------------------------------------------------------------------


def test_an_exposed_list_is_one_in_all_respects():
    items = expose_to_plugins([3, 1, 2])
    assert isinstance(items, list)
    assert isinstance(items, collections.abc.Iterable)
    assert not isinstance(items, collections.abc.Iterator)
    items.append(4)
    assert (len(items), items[0], items[1:3], 4 in items, items == [3, 1, 2, 4]) == (4, 3, [1, 2], True, True)
    assert [*items] == sorted(items, key=[3, 1, 2, 4].index) == [3, 1, 2, 4]
    assert list(reversed(items)) == [4, 2, 1, 3]
    seen, numbers = [], iter([7, 8])
    with handlers(
        (lambda thing: seen.append(thing is items), items, "before_next"),
        (lambda thing, _result: ChangedResult(_result * 10), items, "after_next"),
    ):
        assert [*items] == [30, 10, 20, 40]
        assert [item for item in items] == [30, 10, 20, 40]  # noqa: C416
    assert seen == [True] * 10
    with handlers((lambda thing: next(numbers), items, "instead_next")):
        assert list(items) == [7, 8]
    assert [*items] == [3, 1, 2, 4]


def test_iterators_stay_iterators():
    items = expose_to_plugins(iter([1, 2, 3]))
    assert isinstance(items, collections.abc.Iterator)
    assert iter(items) is items
    with handlers((lambda thing, _result: ChangedResult(-_result), items, "after_next")):
        assert next(items) == -1
    assert list(items) == [2, 3]
    assert list(items) == []
    generator = expose_to_plugins((lambda: (yield (yield 1)))())
    assert next(generator) == 1
    assert generator.send(5) == 5
    generator.close()


def test_copies_of_an_exposed_iterable_have_its_handlers():
    items = expose_to_plugins([[1], [2]])
    with handlers((lambda thing, _result: ChangedResult(_result * 2), items, "after_next")):
        copied = copy.deepcopy(items)
        copied[0].append(5)
        assert list(copied) == [[1, 5, 1, 5], [2, 2]]
        assert list(copy.copy(items)) == list(items) == [[1, 1], [2, 2]]
        restored = pickle.loads(pickle.dumps(items))
        assert list(restored) == [[1], [2]]
    assert type(restored) is type(items)


POOL = expose_to_plugins([1, 2])


class Pool:
    def __init__(self, *items):
        self.items = items

    def __iter__(self):
        yield from self.items


class Deck:
    def __init__(self):
        self.left = 3

    def __iter__(self):
        return self

    def __next__(self):
        if not self.left:
            raise StopIteration
        self.left -= 1
        return self.left


def test_an_iterables_own_functions_and_a_modules_iterables_are_targets():
    pool, subjects, before = Pool(1, 2), [], dict(vars(Pool))
    with handlers(
        (subjects.append, f"{HERE}.Pool.__iter__", "before_next"),
        (lambda thing, _result: ChangedResult(_result + 10), Pool.__iter__, "after_next"),
        (lambda thing, _result: ChangedResult(_result + 20), f"{HERE}.Deck.__next__", "after"),
        (lambda thing, _result: ChangedResult(_result + 30), f"{HERE}.POOL", "after_next"),
    ):
        assert list(pool) == [11, 12]
        assert list(Deck()) == [22, 21, 20]
        assert list(POOL) == [31, 32]
    assert subjects == [pool] * 3
    assert (list(pool), list(Deck()), list(POOL)) == ([1, 2], [2, 1, 0], [1, 2])
    assert dict(vars(Pool)) == before


@pytest.mark.parametrize("kind", [Pool, int])
def test_classes_are_no_iterables(kind):
    with pytest.raises(PatchError, match="expose one of its functions"):
        expose_to_plugins(kind)


# -- decision points ------------------------------------------------------------------------------


def test_a_function_that_is_decorated_while_it_has_handlers_keeps_them_outside():
    original = vars(Trader)["bid"]
    log = []
    try:
        with handlers((lambda *args, **kwargs: log.append(1), f"{MARKET}.Trader.bid", "before")):
            Trader.bid = define()(Trader.bid)
            assert Trader().bid("tea") == 5
        with handlers(
            (lambda *args, **kwargs: log.append(2), f"{MARKET}.Trader.bid", "before"),
            (lambda *args, **kwargs: log.append(3), Trader.bid, "before"),
        ):
            env = aec_env(calling(lambda: Trader().bid("tea")), Trader.bid)
            play(env, 4)
            assert env.unwrapped.simulation.log == [4]
            env.close()
        assert log == [1, 2, 3]
    finally:
        Trader.bid = original


# -- copies ---------------------------------------------------------------------------------------


def test_models_of_a_patched_class_are_copied_and_pickled():
    house = Greenhouse(7)
    with handlers((lambda self, amount, *, twice=False: 1, f"{HOUSE}.water", "instead")):
        for copied in (copy.deepcopy(house), pickle.loads(pickle.dumps(house))):
            assert (copied.humidity, copied.water(5)) == (7, 1)
        assert pickle.loads(pickle.dumps(Greenhouse.water)) is Greenhouse.water
    assert copied.water(5) == 5


# -- seeing what happens --------------------------------------------------------------------------


def test_what_is_exposed_and_attached_is_listed():
    gc.collect()  # other tests have exposed functions, too
    function, items, choose = local(), expose_to_plugins([1]), decision()
    name = f"{HERE}.local.<locals>.function"
    assert exposed_functions().count("an iterable list") == 1
    assert name in exposed_functions()
    assert f"{MARKET}.Trader.bid" not in exposed_functions()
    with handlers((print, function, "before"), (failing, f"{MARKET}.Trader.bid", "instead")):
        assert f"{MARKET}.Trader.bid" in exposed_functions()
        assert attached_handlers() == [(failing, f"{MARKET}.Trader.bid", "instead"), (print, name, "before")]
    assert "tests.worlds.models.decision.<locals>.choose" in decision_points()
    assert (choose(), list(items)) == ("rule", [1])


def test_calls_are_traced_in_the_order_in_which_they_begin():
    function = local()
    with (
        handlers((lambda value, more=0: Trader().bid("tea", limit=value) and None, function, "before")),
        trace(function, f"{MARKET}.Trader.bid", counting, f"{HOUSE}.wire") as calls,
    ):
        function(3, more=4)
        list(counting(2))
        asyncio.run(Greenhouse().wire(8))
        with pytest.raises(TypeError):
            function("x")
    shown = [(call.target.rpartition(".")[2], call.arguments.partition(" object at")[0], call.result) for call in calls]
    assert shown[:4] == [
        ("function", "3, more=4", "7"),
        ("bid", f"<{MARKET}.Trader", "3"),
        ("counting", "2", "0"),
        ("wire", "Greenhouse(50), 8", "8"),
    ]
    assert shown[4][:2] == ("function", "'x'")
    assert shown[4][2].startswith("raised TypeError")
    length = len(calls)
    with trace() as everything:  # which is what is exposed
        function(1)
        Trader().bid("tea")
    assert [call.target for call in everything] == [f"{HERE}.local.<locals>.function"]
    assert len(calls) == length


# -- what is nearly an item, an end or a name -------------------------------------------------------


@pytest.mark.parametrize("position", ["before", "instead"])
def test_handlers_of_a_generator_function_end_no_items(position):
    def stopping(*args, **kwargs):
        raise StopIteration("a slip")

    with handlers((stopping, counting, position)):
        with pytest.raises(RuntimeError, match="StopIteration") as caught:
            list(counting(3))
        assert f"stopping, attached {position}" in notes(caught.value.__cause__)


def test_errors_of_a_generator_that_is_closed_are_raised():
    @expose_to_plugins
    def items():
        try:
            yield 1
        finally:
            raise LookupError("while it was closed")

    with handlers((lambda: None, items, "before_next")):
        generator = items()
        assert next(generator) == 1
        with pytest.raises(LookupError, match="while it was closed"):
            generator.close()
