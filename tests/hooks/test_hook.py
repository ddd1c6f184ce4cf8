"""Wrappers of a model's functions, and who takes part in their calls."""

import pickle
from types import SimpleNamespace

import cloudpickle
import pytest
from greenlet import getcurrent, greenlet

from simenv_marl.hooks.hook import Hook, hook_of, made_with, unwrap
from simenv_marl.hooks.stacks import STACKS, outside_simulation, stack_of


def rule(first, second=2, *, third=3):
    return first, second, third


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
def test_an_interceptor_gets_the_arguments_as_they_were_passed(function, args, kwargs):
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


def test_a_wrapper_that_is_pickled_by_value_asks_the_hook_where_it_arrives():
    scope = {"__name__": "__main__"}
    exec("def function(number): return number", scope)
    made = Hook(scope["function"], "__main__.function").make_wrapper("made with")
    again = pickle.loads(cloudpickle.dumps(made))
    hook = hook_of(again)
    assert (again(3), made_with(again)) == (3, "made with")
    hook.enter(getcurrent(), lambda args, kwargs: "intercepted", None)
    assert again(3) == "intercepted"
    hook.leave(getcurrent())


def test_outside_a_simulation_its_interceptors_are_masked(monkeypatch):
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
