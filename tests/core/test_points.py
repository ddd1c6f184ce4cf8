"""Decision points where nobody sees them from outside: how they cross to other processes, and quick rewards."""

import sys

import numpy as np
import pytest

from simenv_marl import single_env
from simenv_marl.core import agent, packing
from simenv_marl.core.packing import pack, pack_plainly, unpack
from simenv_marl.core.points import portable
from simenv_marl.decision import point_of
from simenv_marl.errors import RewardError
from simenv_marl.hooks.hook import hook_of
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


@pytest.mark.parametrize("others", [[], ["a difference that was made elsewhere"]])
def test_each_reward_is_checked_also_where_no_difference_was_made(others, monkeypatch):
    monkeypatch.setattr(agent, "DIFFERENCES", others)
    rewards = iter([0.0, 2, np.float32(0.5), "2", 0.0, float("nan")])
    decide = decision(reward_mapping=lambda: next(rewards))
    env = single_env(calling(*[decide] * 4), decide)
    env.reset()
    assert [repr(env.step(1)[1]) for _ in range(2)] == ["2.0", "0.5"]
    with pytest.raises(RewardError, match="not one number"):
        env.step(1)
    env.reset()
    with pytest.raises(RewardError, match="not finite"):
        env.step(1)


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
