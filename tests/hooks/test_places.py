"""Wrappers of a model's functions: their users, and how they are found, set and removed."""

import gc
import pickle
import sys
import types
import weakref
from functools import partial, wraps
from types import SimpleNamespace
from unittest import mock

import cloudpickle
import pytest
from greenlet import getcurrent, greenlet

from simenv_marl import aec_env
from simenv_marl.decision import registered
from simenv_marl.errors import PatchError
from simenv_marl.hooks.handlers import Installation
from simenv_marl.hooks.hook import Hook, hook_of, made_with, unwrap
from simenv_marl.hooks.places import find_hook, places_of, resolve
from simenv_marl.hooks.stacks import STACKS, outside_simulation, stack_of
from simenv_marl.plugins import (
    ChangedResult,
    attach_handler,
    attached_handlers,
    expose_to_plugins,
    handlers,
)
from tests.foreign import market, shop
from tests.hooks.forms import FORMS, MARKET
from tests.worlds.models import begun, calling, define, play

PRICE, LOOK = f"{MARKET}.price", f"{__name__}._Hiding.look"


class _Hiding:
    def __hidden(self):
        return "hidden"

    def look(self):
        return self.__hidden()


# -- calls -----------------------------------------------------------------------------------------


def rule(first, second=2, *, third=3):
    return first, second, third


def on_a_stack(test):
    """Run a test on a stack of its own: calls on the main thread's run the rule at once."""

    @wraps(test)
    def run(*args, **kwargs):
        greenlet(partial(test, *args, **kwargs)).switch()

    return run


@pytest.mark.parametrize(
    ("function", "args", "kwargs"),
    [
        (rule, (1,), {}),
        (rule, (1, 5), {"third": 7}),
        (rule, (), {"first": 1}),
        (lambda model, /: 0, (1,), {}),
        (lambda model=None: 0, (), {}),
        (lambda getcurrent: 0, (), {"getcurrent": 1}),  # a name that wrappers use
        (lambda *models: 0, (1, 2), {}),
        (lambda *, model: 0, (), {"model": 1}),
        (lambda: 0, (), {}),
    ],
)
@on_a_stack
def test_decision_function_passes_on_arguments_as_they_were_passed(function, args, kwargs):
    hook = Hook(function, "somewhere.Model.function")
    made, other = hook.make_wrapper("one"), hook.make_wrapper("other")
    hook.enter(getcurrent(), lambda *given: given, None)
    assert made(*args, **kwargs) == other(*args, **kwargs) == (args, kwargs)
    with pytest.raises(TypeError):
        made(1, wrong=2)
    hook.leave(getcurrent())
    assert hook.interceptors == {}
    assert (made_with(made), made_with(other)) == ("one", "other")
    assert hook_of(made) is hook_of(other) is hook
    assert unwrap(made) is unwrap(function) is function


@on_a_stack
def test_pickled_decision_function_works_where_it_is_unpickled():
    scope = {"__name__": "__main__"}
    exec("def function(number): return number", scope)
    made = Hook(scope["function"], "__main__.function").make_wrapper("made with")
    again = pickle.loads(cloudpickle.dumps(made))
    hook = hook_of(again)
    assert (again(3), made_with(again)) == (3, "made with")
    hook.enter(getcurrent(), lambda args, kwargs: "intercepted", None)
    assert again(3) == "intercepted"
    hook.leave(getcurrent())


def test_outside_simulation_block_lets_decisions_follow_the_models_rule(monkeypatch):
    here, told = getcurrent(), []
    stack = SimpleNamespace(leave_hooks=told.append, enter_hooks=lambda: told.append("entered"))

    def in_a_greenlet_of_the_model():
        with outside_simulation():  # only that is masked, which has no hooks of its own to leave
            assert stack_of(getcurrent()) is None
        return stack_of(getcurrent())

    monkeypatch.setitem(STACKS, here, stack)
    assert greenlet(in_a_greenlet_of_the_model).switch() is stack
    with outside_simulation():
        assert stack_of(here) is greenlet(lambda: stack_of(getcurrent())).switch() is None
        with outside_simulation():
            assert told == [here]
    assert stack_of(here) is stack
    assert told == [here, "entered"]


# -- names -----------------------------------------------------------------------------------------


def test_decision_point_name_can_be_a_private_method_as_written():
    with handlers((lambda self: "taken", f"{__name__}._Hiding.__hidden", "instead")):
        assert _Hiding().look() == "taken"
    assert _Hiding().look() == "hidden"


class Till:
    @staticmethod
    def fee():
        return 3


def test_decorated_function_of_a_static_method_stays_a_static_method(monkeypatch):
    monkeypatch.setattr(Till, "fee", define()(Till.fee))
    assert Till.fee() == Till().fee() == 3


STALL = SimpleNamespace(price=lambda: 1)


def test_decision_point_name_of_an_objects_function_raises_patch_error():
    with pytest.raises(PatchError, match="STALL is neither a class nor a module"):
        resolve(f"{__name__}.STALL.price")


def test_decision_point_name_raises_an_import_error_of_its_module(tmp_path, monkeypatch):
    (tmp_path / "broken_model.py").write_text("import no_such_package_at_all\n")
    (tmp_path / "raising_model.py").write_text("raise ZeroDivisionError\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="no_such_package_at_all"):
        resolve("broken_model.Model.method")
    with pytest.raises(ZeroDivisionError):
        resolve("raising_model.Model.method")


# -- set and put back ------------------------------------------------------------------------------


def test_decision_point_name_is_the_functions_attribute_in_its_module(monkeypatch):
    module, log = types.ModuleType("renaming_module"), []
    module.second = lambda: 1
    module.second.__module__ = module.__name__
    monkeypatch.setitem(sys.modules, module.__name__, module)
    with handlers((lambda: log.append("called"), module.second, "before")):
        assert [entry[1] for entry in attached_handlers()] == ["renaming_module.second"]
        assert module.second() == 1
    assert log == ["called"]


@pytest.mark.parametrize(
    ("error", "raised"), [(TypeError, PatchError), (ZeroDivisionError, ZeroDivisionError)]
)
def test_env_undoes_model_patches_that_fail_half_way(error, raised):
    class Refusing(type):
        def __setattr__(cls, name, value):
            if hook_of(value) is not None:
                raise error("sealed")
            super().__setattr__(name, value)

    class Sealed(metaclass=Refusing):
        def cost(self):
            return 1

    original = Sealed.cost
    price = (lambda *args, **kwargs: 1, PRICE, "instead")
    good, bad = (lambda self: 1, LOOK, "instead"), (lambda self: 1, original, "instead")
    with pytest.raises(raised, match="sealed"):
        aec_env(calling(market.price), {PRICE: define(), original: define()}, plugins=[good])
    with pytest.raises(raised, match="sealed"):
        attach_handler(*bad)
    with pytest.raises(raised, match="sealed"), handlers(good, price, bad):
        raise AssertionError
    gc.collect()
    assert Sealed.cost is original
    assert market.price is shop.price
    assert hook_of(market.price) is None
    assert hook_of(vars(_Hiding)["look"]) is None
    kept = Installation([(find_hook(LOOK), None)])
    kept.uninstall()
    assert not kept.complete  # so that an environment that is used again sets all of it again


# -- nothing stays behind --------------------------------------------------------------------------


def test_model_classes_are_garbage_collected_with_their_decision_points():
    references = []
    for _ in range(20):

        class Model:
            def decide(self):
                return 0

            @define()
            def decorated(self):
                return 0

            @expose_to_plugins
            def __iter__(self):
                yield from [1, 2]

        references.append(weakref.ref(Model))
        name = hook_of(Model.decorated).name
        assert name in registered()
        env = begun(
            aec_env(
                calling(lambda model=Model: model().decide()),
                {Model.decide: define(), Model.decorated: None},
            )
        )
        env.close()
        with handlers(
            (lambda model, _result: ChangedResult(_result + 1), Model.__iter__, "after_next")
        ):
            assert list(Model()) == [2, 3]
        del env, Model
    gc.collect()
    gc.collect()
    assert [reference() for reference in references] == [None] * 20
    assert name not in registered()


def test_decision_point_names_are_found_while_other_threads_import_modules(monkeypatch):
    class Lazy:
        """Stands in for a module that is imported as soon as something is asked of it."""

        @property
        def __class__(self):
            monkeypatch.setitem(
                sys.modules, f"late_module_{len(sys.modules)}", types.ModuleType("late_module")
            )
            return types.ModuleType

    monkeypatch.setitem(sys.modules, "lazy_module", Lazy())
    found = [(namespace["__name__"], name) for namespace, name in places_of(market.price)]
    places = [(market, "price"), (shop, "cost"), (shop, "price")]
    assert sorted(found) == [(module.__name__, name) for module, name in places]


@pytest.mark.parametrize("form", ["method", "static", "of a class", "inherited", "function"])
@pytest.mark.parametrize("end", ["close", "drop"])
def test_env_keeps_patches_of_other_code_on_a_decision_point(form, end):
    name, call, expected = FORMS[form]
    owner, attribute = resolve(name)
    before, points = vars(owner).get(attribute), {name: define(agent="one_0")}
    for _ in range(3):
        env = begun(aec_env(calling(call), points))
        hook = find_hook(name)
        with mock.patch.object(owner, attribute, return_value="mocked"):
            if end == "close":
                env.close()
            del env
            gc.collect()
            assert call() == "mocked"
            with pytest.raises(PatchError, match="has been replaced"):
                hook.install(1)
        assert call() == expected
        env = aec_env(calling(call, call), points)
        play(env, iter([1, 2]))
        assert env.simulation.log == [1, 2]
        env.close()
        assert vars(owner).get(attribute) is before
