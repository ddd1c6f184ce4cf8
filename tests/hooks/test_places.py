"""Where functions are found, set, and put back."""

import gc
import itertools
import random
import sys
import threading
import time
import types
import weakref
from textwrap import dedent
from unittest import mock

import pytest
from greenlet import getcurrent

from simenv_marl import aec_env
from simenv_marl.errors import PatchError, UnknownTargetError
from simenv_marl.hooks.handlers import Installation
from simenv_marl.hooks.hook import hook_of, unbind
from simenv_marl.hooks.places import PlacedHook, find_hook, hook_at, places_of, resolve
from simenv_marl.plugins import _TARGET as TARGET
from simenv_marl.plugins import (
    ChangedResult,
    attach_handler,
    attached_handlers,
    expose_to_plugins,
    handlers,
    remove_handler,
    trace,
)
from tests.contract.test_faults import interrupt_at
from tests.worlds.models import calling, define

HERE = __name__


class Base:
    def method(self):
        return "rule"

    @staticmethod
    def static():
        return "static"

    @classmethod
    def of_class(cls):
        return cls.__name__

    def __hidden(self):
        return "hidden"

    def look(self):
        return self.__hidden()


class _Base(Base):
    def __hidden(self):
        return "hidden"

    def look(self):
        return self.__hidden()


class Sub(Base):
    pass


def function():
    return "rule"


def hook_of_name(name):
    return find_hook(name, TARGET)


def taken(hook):
    """Have a hook decided in this greenlet."""
    hook.enter(getcurrent(), lambda args, kwargs: "taken", None)


# -- names ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("owner", [Base, _Base])
@pytest.mark.parametrize("name", ["__hidden", "_Base__hidden"])
def test_private_names_are_found_as_they_are_written_and_as_they_are(owner, name):
    name = f"{HERE}.{owner.__name__}.{name}"
    assert resolve(name, TARGET) == (owner, "_Base__hidden")
    hook = hook_of_name(name)
    hook.install(1)
    taken(hook)
    assert owner().look() == "taken"
    hook.uninstall(1)
    assert owner().look() == "hidden"


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("nowhere", "it needs a dotted name"),
        ("no_such_package_at_all.function", "no module 'no_such_package_at_all'"),
        (f"{HERE}.Missing.method", "has no 'Missing'"),
        (f"{HERE}.Base.missing", "has no 'missing'"),
    ],
)
def test_a_name_that_leads_to_nothing_says_what_is_missing(name, why):
    with pytest.raises(UnknownTargetError, match=why):
        resolve(name, TARGET)


def test_a_module_that_imports_what_is_not_there_says_so_itself(tmp_path, monkeypatch):
    (tmp_path / "broken_model.py").write_text("import no_such_package_at_all\n")
    (tmp_path / "raising_model.py").write_text("raise ZeroDivisionError\n")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="no_such_package_at_all"):
        resolve("broken_model.Model.method", TARGET)
    with pytest.raises(ZeroDivisionError):
        resolve("raising_model.Model.method", TARGET)


# -- set and put back -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["Base.method", "Base.static", "Base.of_class", "Sub.method", "Sub.of_class"])
def test_what_is_set_stays_until_its_last_user_uninstalls_it(name):
    owner, attribute = resolve(f"{HERE}.{name}", TARGET)
    before = vars(owner).get(attribute)
    hook = hook_of_name(f"{HERE}.{name}")
    hook.install(1)
    hook.install(2)
    assert type(vars(owner)[attribute]) is type(vars(Base)[attribute])
    taken(hook)
    assert getattr(owner(), attribute)() == "taken"
    hook.uninstall(2)
    assert hook_of_name(f"{HERE}.{name}") is hook
    hook.uninstall(1)
    assert vars(owner).get(attribute) is before


def set_and_put_back(hooks):
    Installation(hooks).uninstall()


@pytest.mark.parametrize("again", [True, False])
@pytest.mark.parametrize("name", ["Base.method", "Base.static", "Sub.method", "Sub.of_class", "function"])
def test_an_interrupt_while_something_is_set_or_put_back_leaves_nothing(name, again, monkeypatch):
    other = types.ModuleType("other_module")
    other.alias = function
    monkeypatch.setitem(sys.modules, "other_module", other)
    # Of all modules these will do.
    monkeypatch.setattr("simenv_marl.hooks.places.modules", {HERE: sys.modules[HERE], "other_module": other})
    owner, attribute = resolve(f"{HERE}.{name}", TARGET)
    before = vars(owner).get(attribute), other.alias
    hooks = [hook_of_name(f"{HERE}.{name}"), hook_of_name(f"{HERE}.Base.look")]
    for number in itertools.count(1):
        kept = Installation(hooks)
        where, raised = interrupt_at(number, kept.uninstall) if again else interrupt_at(number, set_and_put_back, hooks)
        del raised
        gc.collect(0)
        kept.uninstall()
        assert (vars(owner).get(attribute), other.alias) == before, where
        assert hook_of(vars(Base)["look"]) is None, where
        assert not kept.complete
        kept = Installation(hooks)
        assert hook_of(unbind(vars(owner)[attribute])) is hooks[0], where
        kept.uninstall()
        if where is None:
            break
    assert number > 10


def test_a_function_of_a_module_is_set_under_all_its_names():
    other = types.ModuleType("other_module")
    other.alias = function
    sys.modules["other_module"] = other
    try:
        hook = hook_of_name(f"{HERE}.function")
        assert hook_at("other_module.alias", other, "alias", TARGET) is hook
        original = function
        hook.install(1)
        assert hook_of(other.alias) is hook_of(function) is hook
        late = other.late = other.alias
        hook.uninstall(1)
        assert other.alias is other.late is function is original
        assert late() == "rule"
        assert {owner.__name__ for owner, _ in places_of(function)} == {HERE, "other_module"}
    finally:
        del sys.modules["other_module"]
    reference = weakref.ref(other)
    del other
    gc.collect()
    assert reference() is None
    assert hook.function is original


def test_a_function_is_found_by_what_its_module_calls_it():
    module, log = types.ModuleType("renaming_module"), []
    exec("def first(): return 1\nsecond = first\ndel first", vars(module))
    sys.modules["renaming_module"] = module
    try:
        attach_handler(lambda: log.append("called"), module.second, "before")
        assert [entry[1] for entry in attached_handlers()] == ["renaming_module.second"]
        assert module.second() == 1
        assert log == ["called"]
        remove_handler(module.second, "before")
    finally:
        del sys.modules["renaming_module"]


def test_what_something_else_has_set_is_left_alone_and_usable_afterwards():
    before = vars(Base)["method"]
    hook = hook_of_name(f"{HERE}.Base.method")
    hook.install(1)
    with mock.patch.object(Base, "method", return_value="mocked"):
        hook.uninstall(1)
        assert Base().method() == "mocked"
        assert hook.stale
        with pytest.raises(PatchError, match="has been replaced"):
            hook.install(1)
    assert Base().method() == "rule"  # what the mock has put back
    hook = hook_of_name(f"{HERE}.Base.method")
    hook.install(1)
    taken(hook)
    assert Base().method() == "taken"
    hook.uninstall(1)
    hook.leave(getcurrent())
    assert vars(Base)["method"] is before


def test_what_fails_half_way_is_put_back():
    class Refusing(types.ModuleType):
        def __setattr__(self, name, value):
            if name == "alias" and hook_of(value) is not None:
                raise TypeError("sealed")
            super().__setattr__(name, value)

    refusing = Refusing("refusing_module")
    refusing.alias = function
    sys.modules["refusing_module"] = refusing
    original = function
    try:
        with pytest.raises(PatchError, match="sealed"):
            attach_handler(print, f"{HERE}.function", "instead")
        assert function is refusing.alias is original
        with (
            pytest.raises(PatchError, match="sealed"),
            handlers((lambda self: 1, f"{HERE}.Base.method", "instead"), (lambda: 1, f"{HERE}.function", "instead")),
        ):
            pass
        assert (Base().method(), function()) == ("rule", "rule")
        assert hook_of(vars(Base)["method"]) is None
    finally:
        del sys.modules["refusing_module"]


# -- nothing stays behind ---------------------------------------------------------------------------


def test_classes_of_undecorated_points_go_with_their_environments():
    references = []
    for _ in range(20):

        class Model:
            def decide(self):
                return 0

        references.append(weakref.ref(Model))
        env = aec_env(calling(lambda model=Model: model().decide()), {Model.decide: define()})
        env.reset()
        env.step(1)
        assert env.unwrapped.simulation.log == [1]
        env.close()
        del env, Model
    gc.collect()
    gc.collect()
    assert [reference() for reference in references] == [None] * 20


def test_classes_whose_items_have_handlers_are_collected():
    references = []
    for _ in range(5):

        class Pool:
            @expose_to_plugins
            def __iter__(self):
                yield from [1, 2]

        references.append(weakref.ref(Pool))
        with handlers((lambda pool, _result: ChangedResult(_result + 1), Pool.__iter__, "after_next")):
            assert list(Pool()) == [2, 3]
        assert list(Pool()) == [1, 2]
        del Pool
    gc.collect()
    gc.collect()
    assert [reference() for reference in references] == [None] * 5


def test_a_handler_that_is_attached_by_name_after_a_redecoration_is_called():
    module = types.ModuleType("redecorated_model")
    sys.modules["redecorated_model"] = module
    log = []
    try:
        exec(dedent("class Model:\n    def decide(self):\n        return 0"), vars(module))
        name = "redecorated_model.Model.decide"
        env = aec_env(calling(lambda: module.Model().decide()), {name: define()})
        env.reset()
        env.close()
        module.Model.decide = define()(module.Model.decide)
        attach_handler(lambda model: log.append("called"), name, "before")
        assert module.Model().decide() == 0
        remove_handler(name, "before")
        module.Model.decide = lambda self: 1
        attach_handler(lambda model: log.append("again"), name, "before")
        assert module.Model().decide() == 1
        remove_handler(name, "before")
        assert log == ["called", "again"]
    finally:
        del sys.modules["redecorated_model"]


def test_a_function_that_is_decorated_while_an_environment_uses_it_stays_decorated():
    class Model:
        def decide(self):
            return "rule"

    env = aec_env(calling(lambda: Model().decide()), {Model.decide: define()})
    env.reset()
    Model.decide = decorated = define(agent="other_0")(Model.decide)
    env.step(1)
    assert env.unwrapped.simulation.log == [1]
    env.close()
    assert Model.decide is decorated
    assert Model().decide() == "rule"
    env = aec_env(calling(lambda: Model().decide()), Model.decide)
    env.reset()
    assert env.agents == ["other_0"]
    env.close()


@pytest.mark.parametrize("make", [define(), expose_to_plugins])
def test_what_is_decorated_while_an_environment_uses_it_has_handlers_of_its_own(make):
    class Model:
        def decide(self):
            return "rule"

    env = aec_env(calling(lambda: Model().decide()), {Model.decide: define()})
    env.reset()
    Model.decorated = make(Model.decide)
    env.close()
    with trace() as calls:
        Model().decorated()
    assert len(calls) == 1
    log = []
    attach_handler(log.append, Model.decide, "before")
    try:
        Model().decorated()
        assert log == []
        Model().decide()
        assert len(log) == 1
    finally:
        remove_handler(Model.decide, "before")


def test_modules_may_be_imported_while_names_are_looked_for(monkeypatch):
    class Lazy:
        """Stands in for a module that is imported as soon as something is asked of it."""

        @property
        def __class__(self):
            sys.modules.setdefault("late_module", types.ModuleType("late_module"))
            return types.ModuleType

    monkeypatch.setitem(sys.modules, "lazy_module", Lazy())
    try:
        assert places_of(function) == [(sys.modules[HERE], "function")]
    finally:
        del sys.modules["late_module"]


def test_modules_may_change_in_other_threads_while_names_are_looked_for():
    module, ended = types.ModuleType("changing_module"), threading.Event()
    vars(module).update({f"name_{number}": number for number in range(3000)})

    def work():
        while not ended.is_set():
            for number in range(50):
                setattr(module, f"more_{number}", number)
            for number in range(50):
                delattr(module, f"more_{number}")

    thread, interval = threading.Thread(target=work), sys.getswitchinterval()
    sys.modules["changing_module"] = module
    sys.setswitchinterval(1e-6)
    thread.start()
    try:
        for _ in range(30):
            assert places_of(function) == [(sys.modules[HERE], "function")]
    finally:
        sys.setswitchinterval(interval)
        ended.set()
        thread.join()
        del sys.modules["changing_module"]


@pytest.fixture
def _dawdling(monkeypatch):
    """Others may have their turn between any two looks and changes at a place."""
    drawn = random.Random(1)

    def dawdle(function):
        def slow(*args):
            time.sleep(drawn.choice([0, 1e-3]))
            value = function(*args)
            time.sleep(drawn.choice([0, 1e-3]))
            return value

        return slow

    for name in ("__init__", "is_free", "_apply", "_revert"):
        monkeypatch.setattr(PlacedHook, name, dawdle(getattr(PlacedHook, name)))


SOURCE = """
class Base:
    def method(self): return "rule"
    def look(self): return "rule"

class Sub(Base): pass

def function(): return "rule"
"""


@pytest.mark.usefixtures("_dawdling")
@pytest.mark.parametrize("how", ["environment", "handlers"])
@pytest.mark.parametrize("path", ["Base.method", "Sub.method", "function"])
def test_threads_come_and_go_at_once(path, how, monkeypatch):
    """In each round eight of them come to a module that is new, and go."""
    module, errors = types.ModuleType("new_model"), []
    monkeypatch.setitem(sys.modules, "new_model", module)
    monkeypatch.setattr("simenv_marl.hooks.places.modules", {"new_model": module})  # looking at all takes its time
    *_, attribute = path.split(".")

    def owner():
        return getattr(module, path.split(".")[0]) if "." in path else module

    def call():
        return getattr(owner()() if "." in path else owner(), attribute)()

    def renew():
        exec(SOURCE, vars(module))
        before.append(vars(owner()).get(attribute))

    def environment():
        plugins = [(lambda *_: None, "new_model.Base.look", "before")]
        env = aec_env(calling(call), {f"new_model.{path}": define()}, plugins=plugins)
        env.reset()
        env.step(1)
        assert env.unwrapped.simulation.log == [1]
        return env.close

    def handled():
        called = []
        block = handlers((lambda *_: called.append(1), f"new_model.{path}", "before"))
        block.__enter__()
        assert call() == "rule"
        assert called
        return lambda: block.__exit__(None, None, None)

    def work():
        try:
            for number in range(10):
                if ready.wait(30) == 0:
                    renew()
                ready.wait(30)
                go = environment() if how == "environment" else handled()
                ready.wait(30)
                go()
                ready.wait(30)
                assert vars(owner()).get(attribute) is before[number]
                assert hook_of(vars(module.Base)["look"]) is None
        except BaseException as error:
            errors.append(error)
            ready.abort()

    before, ready = [], threading.Barrier(8)
    threads = [threading.Thread(target=work, daemon=True) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert not any(thread.is_alive() for thread in threads)
    assert errors == []
    assert len(before) == 10


@pytest.mark.parametrize("end", ["close", "drop"])
@pytest.mark.parametrize("name", ["Base.method", "Base.static", "Base.of_class", "Sub.method", "function"])
def test_a_point_can_be_used_after_a_mock_stood_there_while_an_environment_ended(name, end):
    owner, attribute = resolve(f"{HERE}.{name}", TARGET)
    before, rule = vars(owner).get(attribute), getattr(Base if isinstance(owner, type) else owner, attribute)

    def call():
        return getattr(owner() if isinstance(owner, type) else owner, attribute)()

    expected = call()
    points = {f"{HERE}.{name}": define(agent="one_0")}
    for _ in range(3):
        env = aec_env(calling(call), points)
        env.reset()
        with mock.patch.object(owner, attribute, return_value="mocked"):
            if end == "close":
                env.close()
            del env
            gc.collect()
            assert call() == "mocked"
        assert call() == expected
        env = aec_env(calling(call, call), points)
        env.reset()
        env.step(1)
        env.step(2)
        assert env.unwrapped.simulation.log == [1, 2]
        env.close()
        assert vars(owner).get(attribute) is before
        assert call() == expected
    assert getattr(Base if isinstance(owner, type) else owner, attribute) == rule


def test_definitions_are_made_of_functions_alone():
    with pytest.raises(PatchError):
        define()(3)
