"""Wrappers, and who takes part in their calls."""

import pickle

import cloudpickle
import pytest
from greenlet import getcurrent, greenlet

from simenv_marl.hooks.hook import Hook, hook_of, made_with, unwrap
from simenv_marl.hooks.stacks import EVALUATING, OUTSIDE, STACKS, outside_simulation, stack_of


def rule(first, second=2, *, third=3):
    return first, second, third


class Stack:
    """A simulation's stack."""

    hidden = 0

    def leave_hooks(self, here):
        self.hidden += 1

    def enter_hooks(self):
        self.hidden -= 1


@pytest.fixture
def stack():
    made, here = Stack(), getcurrent()
    STACKS[here] = made
    yield made
    del STACKS[here]


def in_a_greenlet(function):
    return greenlet(function).switch()


# -- wrappers --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("function", "args", "kwargs"),
    [
        (rule, (1,), {}),
        (rule, (1, 5), {}),
        (rule, (1,), {"third": 7}),
        (rule, (), {"first": 1}),
        (lambda model, /: 0, (1,), {}),
        (lambda model=None: 0, (), {}),
        (lambda *models: 0, (), {}),
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


# -- who takes part --------------------------------------------------------------------------------


def test_outside_a_simulation_its_interceptors_are_masked(stack):
    here = getcurrent()
    with outside_simulation():
        assert stack.hidden == 1
        assert stack_of(here) is None
        assert in_a_greenlet(lambda: stack_of(getcurrent())) is None
        with outside_simulation():
            assert stack.hidden == 1
        assert STACKS[here] is OUTSIDE
    assert stack.hidden == 0
    assert stack_of(here) is stack
    assert EVALUATING == {}


def test_in_a_greenlet_of_the_model_only_that_is_masked(stack):
    def work():
        with outside_simulation():
            assert stack.hidden == 0
            assert stack_of(getcurrent()) is None
        return stack_of(getcurrent())

    assert in_a_greenlet(work) is stack
    assert list(STACKS.values()).count(OUTSIDE) == 0


def test_what_runs_in_the_functions_place_does_so_everywhere_but_in_what_has_begun():
    hook = Hook(rule, f"{__name__}.rule")
    made = hook.make_wrapper()
    hook.replace_rule(lambda first: "other")
    assert made(1) == in_a_greenlet(lambda: made(1)) == "other"
    hook.replace_rule()
    assert made(1) == (1, 2, 3)
    assert hook.interceptors == {}
