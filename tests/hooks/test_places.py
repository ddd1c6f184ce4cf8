"""Where functions are found, set, and put back."""

import gc
import sys
import threading
import types
import weakref
from textwrap import dedent
from unittest import mock

import pytest
from greenlet import getcurrent

from simenv_marl import (
    PatchError,
    UnknownTargetError,
    aec_env,
    attach_handler,
    attached_handlers,
    expose_to_plugins,
    handlers,
    remove_handler,
    trace,
)
from simenv_marl.hooks.hook import hook_of
from simenv_marl.hooks.places import hook_at, places_of, resolve
from simenv_marl.hooks.targets import TARGET
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
    return hook_at(name, *resolve(name, TARGET), TARGET)


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
    hook.hold()
    taken(hook)
    assert owner().look() == "taken"
    hook.let_go()
    assert owner().look() == "hidden"


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("nowhere", "a dotted name is needed"),
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
def test_what_is_set_goes_with_the_last_who_has_let_go(name):
    owner, attribute = resolve(f"{HERE}.{name}", TARGET)
    before = vars(owner).get(attribute)
    hook = hook_of_name(f"{HERE}.{name}")
    hook.hold()
    hook.hold()
    assert type(vars(owner)[attribute]) is type(vars(Base)[attribute])
    taken(hook)
    assert getattr(owner(), attribute)() == "taken"
    hook.let_go()
    assert hook_of_name(f"{HERE}.{name}") is hook
    hook.let_go()
    assert vars(owner).get(attribute) is before


def test_a_function_of_a_module_is_set_under_all_its_names():
    other = types.ModuleType("other_module")
    other.alias = function
    sys.modules["other_module"] = other
    try:
        hook = hook_of_name(f"{HERE}.function")
        assert hook_at("other_module.alias", other, "alias", TARGET) is hook
        original = function
        hook.hold()
        assert hook_of(other.alias) is hook_of(function) is hook
        late = other.late = other.alias
        hook.let_go()
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
    hook.hold()
    with mock.patch.object(Base, "method", return_value="mocked"):
        hook.let_go()
        assert Base().method() == "mocked"
        assert hook.stale
        with pytest.raises(PatchError, match="has been replaced"):
            hook.hold()
    assert Base().method() == "rule"  # what the mock has put back
    hook = hook_of_name(f"{HERE}.Base.method")
    hook.hold()
    taken(hook)
    assert Base().method() == "taken"
    hook.let_go()
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


def test_setting_and_putting_back_in_many_threads_at_once():
    class Model:
        def decide(self):
            return "rule"

    before, errors = vars(Model)["decide"], []

    def work():
        try:
            for _ in range(50):
                env = aec_env(calling(lambda: Model().decide()), {Model.decide: define()})
                env.reset()
                env.step(1)
                assert env.unwrapped.simulation.log == [1]
                env.close()
        except BaseException as error:
            errors.append(error)

    threads = [threading.Thread(target=work) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not errors
    assert vars(Model)["decide"] is before


def test_definitions_are_made_of_functions_alone():
    with pytest.raises(PatchError):
        define()(3)
