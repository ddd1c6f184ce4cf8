"""Decision points on top of hooks, and how they are found."""

import gc
import sys
import weakref

import numpy as np
import pytest

from simenv_marl import single_env
from simenv_marl.core import agent, packing
from simenv_marl.core.packing import pack, pack_plainly, unpack
from simenv_marl.core.points import find_point, locate, portable
from simenv_marl.decision import point_of, registered
from simenv_marl.errors import RewardError
from simenv_marl.hooks.hook import hook_of, unwrap
from simenv_marl.plugins import handlers
from tests.worlds.models import calling, decision, define

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


@pytest.mark.parametrize("others", [[], ["a difference that was made elsewhere"]])
@pytest.mark.parametrize(
    ("value", "told"), [(2, 2.0), (np.float32(0.5), 0.5), (float("nan"), RewardError), ("2", RewardError)]
)
def test_each_reward_is_checked(value, told, others, monkeypatch):
    monkeypatch.setattr(agent, "DIFFERENCES", others)
    rewards = iter([0.0, 0.0, value])
    decide = decision(reward_mapping=lambda: next(rewards))
    env = single_env(calling(decide, decide, decide), decide)
    env.reset()
    env.step(1)
    if told is RewardError:
        with pytest.raises(RewardError):
            env.step(1)
    else:
        reward = env.step(1)[1]
        assert (reward, type(reward)) == (told, float)


def test_a_decorated_function_is_found_under_its_name_and_as_itself():
    point, definition = find_point(f"{HERE}.Base.decorated")
    assert find_point(Base.decorated) == (point, definition)
    assert point is point_of(Base.decorated)[0] is registered()[f"{HERE}.Base.decorated"]
    assert definition is point.definition
    assert definition.agent == "decorated_0"
    assert portable(point.rule, point.name) == f"{HERE}.Base.decorated"
    assert point.permanent


def test_an_undecorated_function_is_one_point_however_it_is_named_set_or_handled():
    one, two = define(), define()
    by_name, as_itself = find_point(f"{HERE}.Base.plain", one), find_point(Base.plain, two)
    point = by_name[0]
    assert (by_name, as_itself) == ((point, one), (point, two))
    assert point.definition is None
    assert not point.permanent
    assert hook_of(vars(Base)["plain"]) is None  # nothing is set before it is held
    point.install(1)
    try:
        assert locate(Base.plain) is locate(f"{HERE}.Base.plain") is point
        assert unwrap(Base.plain) is point.rule
    finally:
        point.uninstall(1)
    with handlers((lambda self: None, f"{HERE}.Base.plain", "before")):
        assert locate(Base.plain) is point
    assert locate(Base.plain) is point


def test_an_inherited_function_is_a_point_of_its_own_with_the_definition_of_the_base_class():
    inherited, definition = find_point(f"{HERE}.Sub.decorated")
    assert inherited is not point_of(Base.decorated)[0]
    assert definition is point_of(Base.decorated)[1]
    inherited.install(1)
    try:
        assert find_point(f"{HERE}.Sub.decorated") == (inherited, definition)
        assert Sub().decorated() == "decorated"
    finally:
        inherited.uninstall(1)
    assert "decorated" not in vars(Sub)


def test_a_point_goes_with_its_model():
    def made():
        return define()(lambda: 0)

    function = made()
    reference, name = weakref.ref(point_of(function)[0]), point_of(function)[0].name
    assert name in registered()
    del function
    gc.collect()
    assert reference() is None
    assert name not in registered()


def test_a_point_is_itself_again_where_it_is_and_comes_along_with_its_hook():
    @define(agent="local_0")
    def function():
        return 0

    point, _ = point_of(Base.decorated)
    assert unpack(pack(point)) is point
    hook = unpack(pack(hook_of(function)))
    assert hook is not hook_of(function)
    assert hook.definition.agent == "local_0"


def test_functions_go_to_other_processes_by_name(monkeypatch):
    """The name leads there, whatever binds them: nothing is made anew."""
    functions = [Base.decorated, Base.plain, Base.of_class.__func__]
    assert [portable(function) for function in functions[:2]] == [f"{HERE}.Base.decorated", f"{HERE}.Base.plain"]
    assert portable(lambda: 0).__name__ == "<lambda>"
    parcels = list(map(pack, functions))
    monkeypatch.setattr(packing, "_known", {})  # as where nothing has come from yet
    assert list(map(unpack, parcels)) == functions


def test_what_is_defined_in_a_notebook_goes_to_other_processes_by_value(monkeypatch):
    main = sys.modules["__main__"]
    monkeypatch.delattr(main, "__file__", raising=False)
    with monkeypatch.context() as notebook:
        notebook.setattr(main, "Cell", type("Cell", (), {"__module__": "__main__", "value": 3}), raising=False)
        parcel = pack_plainly(main.Cell)
    assert unpack(parcel).value == 3
