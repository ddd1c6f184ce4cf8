"""Decision points on top of hooks, and how they are found."""

import gc
import sys
import weakref
from types import ModuleType, SimpleNamespace

import pytest

from simenv_marl.core import packing
from simenv_marl.core.packing import pack, unpack
from simenv_marl.core.points import find_point, find_points, locate, own_points, portable
from simenv_marl.decision import point_of, registered
from simenv_marl.errors import UnknownPointError
from simenv_marl.hooks.hook import hook_of, unwrap
from simenv_marl.plugins import handlers
from tests.worlds.models import define

HERE = __name__


class Base:
    def plain(self):
        return "plain"

    @define(agent="decorated_0")
    def decorated(self):
        return "decorated"

    @classmethod
    @define()
    def of_class(cls):
        return "of the class"


class Sub(Base):
    pass


def test_a_decorated_function_is_found_under_its_name_and_as_itself():
    by_name, as_itself = find_point(f"{HERE}.Base.decorated"), find_point(Base.decorated)
    assert by_name == as_itself
    assert by_name.point is point_of(Base.decorated)[0] is registered(f"{HERE}.Base.decorated")
    assert by_name.definition.agent == "decorated_0"
    assert (by_name.key, by_name.own_definition) == (f"{HERE}.Base.decorated", None)
    assert by_name.point.hook.permanent


def test_an_undecorated_function_is_one_point_however_it_is_named():
    one, two = define(), define()
    by_name, as_itself = find_point(f"{HERE}.Base.plain", one), find_point(Base.plain, two)
    assert by_name.point is as_itself.point
    assert (by_name.own_definition, as_itself.own_definition) == (one, two)
    assert by_name.point.definition is None
    assert not by_name.point.hook.permanent
    assert hook_of(vars(Base)["plain"]) is None  # nothing is set before it is held


def test_it_is_found_while_it_is_set_and_while_it_has_handlers():
    point = locate(Base.plain)
    point.hook.install(1)
    try:
        assert locate(Base.plain) is locate(f"{HERE}.Base.plain") is point
        assert unwrap(Base.plain) is point.rule
    finally:
        point.hook.uninstall(1)
    with handlers((lambda self: None, f"{HERE}.Base.plain", "before")):
        assert locate(Base.plain) is point
    fetched = Base.plain
    assert locate(fetched) is point


def test_what_a_class_inherits_is_a_point_of_its_own_with_the_definition_of_the_base_class():
    inherited = find_point(f"{HERE}.Sub.decorated")
    assert inherited.point is not point_of(Base.decorated)[0]
    assert inherited.definition is point_of(Base.decorated)[1]
    inherited.point.hook.install(1)
    try:
        again = find_point(f"{HERE}.Sub.decorated")
        assert (again.point, again.definition) == (inherited.point, inherited.definition)
        assert Sub().decorated() == "decorated"
    finally:
        inherited.point.hook.uninstall(1)
    assert "decorated" not in vars(Sub)


def test_a_simulations_own_definition_comes_before_the_inherited_one():
    name, definition = f"{HERE}.Sub.decorated", define(agent="own_0")
    own = own_points(SimpleNamespace(points={name: definition}))
    assert find_point(name, own=own).definition is definition
    assert find_point(name).definition is point_of(Base.decorated)[1]


def test_a_function_is_a_point_by_what_its_module_calls_it(monkeypatch):
    module = ModuleType("renaming_points")
    exec("def first(): return 1\nsecond = first\ndel first", vars(module))
    monkeypatch.setitem(sys.modules, "renaming_points", module)
    assert locate(module.second) is locate("renaming_points.second")


def test_two_definitions_of_one_function_are_one_point():
    one, two = define(agent="one_0"), define(agent="two_0")

    def function():
        return 0

    first = one(function)
    second = two(first)
    assert point_of(first)[0] is point_of(second)[0]
    assert (find_point(first).definition, find_point(second).definition) == (one, two)
    assert find_point(first).point.definition is two  # what the bare name means
    other = define()(function)
    assert point_of(other)[0] is not point_of(first)[0]


def test_a_point_goes_with_its_model():
    def made():
        @define()
        def function():
            return 0

        return weakref.ref(point_of(function)[0])

    reference = made()
    gc.collect()
    assert reference() is None
    assert registered(f"{HERE}.test_a_point_goes_with_its_model.<locals>.made.<locals>.function") is None


def test_a_point_is_itself_again_where_it_is():
    point, _ = point_of(Base.decorated)
    assert unpack(pack(point)) is point
    assert unpack(pack(point.hook)) is point.hook


def test_a_point_comes_along_with_its_hook():
    @define(agent="local_0")
    def function():
        return 0

    hook = unpack(pack(hook_of(function)))
    assert hook is not hook_of(function)
    assert (hook.point.hook, hook.point.definition.agent) == (hook, "local_0")


@pytest.mark.parametrize("name", ["Base.decorated", "Base.plain"])
def test_functions_go_to_other_processes_by_name(name):
    function = getattr(Base, name.partition(".")[2])
    assert portable(function) == f"{HERE}.{name}"
    assert portable(lambda: 0).__name__ == "<lambda>"


def test_functions_are_themselves_again_in_other_processes(monkeypatch):
    """The name leads there, whatever binds them: nothing is made anew."""
    functions = [Base.decorated, Base.plain, Base.of_class.__func__]
    parcels = list(map(pack, functions))
    monkeypatch.setattr(packing, "_known", {})  # as where nothing has come from yet
    assert list(map(unpack, parcels)) == functions


def test_what_is_named_twice_or_not_at_all_is_refused():
    with pytest.raises(UnknownPointError, match="twice"):
        find_points([Base.decorated, f"{HERE}.Base.decorated"], None)
    with pytest.raises(UnknownPointError, match="empty"):
        find_points([], None)
