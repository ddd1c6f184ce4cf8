"""Wrappers, and who takes part in their calls."""

import asyncio
import gc
import inspect
import pickle
import threading
import weakref

import cloudpickle
import pytest
from greenlet import getcurrent, greenlet

from simenv_marl.errors import PatchError
from simenv_marl.hooks.hook import Hook, hook_of, hooks, made_with, unwrap
from simenv_marl.hooks.stacks import EVALUATING, OUTSIDE, STACKS, outside_simulation, stack_of


def rule(first, second=2, *, third=3):
    """Say what it was called with."""
    return first, second, third


class Model:
    def decide(self):
        return "rule"

    def items(self, number):
        yield from range(number)
        return "rule"

    async def wait(self, seconds):
        return seconds


class Stack:
    """A simulation's stack that decides everything."""

    def __init__(self, plugins=None):
        self.plugins, self.asked, self.hidden = plugins, 0, 0

    def interceptor(self, hook):
        self.asked += 1
        return lambda args, kwargs: ("elsewhere", args)

    def leave_hooks(self, here):
        self.hidden += 1

    def enter_hooks(self):
        self.hidden -= 1


@pytest.fixture
def stack():
    made = Stack()
    here = getcurrent()
    STACKS[here] = made
    yield made
    del STACKS[here]


def in_a_greenlet(function):
    return greenlet(function).switch()


# -- wrappers --------------------------------------------------------------------------------------


def test_a_wrapper_looks_like_its_function_and_runs_it():
    hook = Hook(rule, "somewhere.rule")
    made, other = hook.make_wrapper("one"), hook.make_wrapper("two")
    assert (made.__name__, made.__doc__, inspect.signature(made)) == ("rule", rule.__doc__, inspect.signature(rule))
    assert made(1) == made(first=1) == (1, 2, 3)
    assert made(1, third=4) == (1, 2, 4)
    assert hook_of(made).function is unwrap(made) is rule
    assert (hook_of(rule), unwrap(rule)) == (None, rule)
    assert (made_with(made), made_with(other)) == ("one", "two")
    assert hook_of(made) is hook_of(other) is hook
    with pytest.raises(TypeError):
        made()


@pytest.mark.parametrize(("args", "kwargs"), [((1,), {}), ((1, 5), {}), ((1,), {"third": 7}), ((), {"first": 1})])
def test_an_interceptor_gets_the_arguments_as_they_were_passed(args, kwargs):
    hook = Hook(rule, "somewhere.rule")
    hook.enter(getcurrent(), lambda *given: given, None)
    made = hook.make_wrapper()
    assert made(*args, **kwargs) == (args, kwargs)
    with pytest.raises(TypeError, match="missing"):
        made()
    hook.leave(getcurrent())
    assert hook.interceptors == {}


@pytest.mark.parametrize(
    ("function", "alone"),
    [
        (Model.decide, True),
        (Model.items, False),
        (lambda model=None: 0, False),
        (lambda *models: 0, False),
        (lambda *, model: 0, False),
        (lambda model, /: 0, True),
        (lambda: 0, False),
    ],
)
def test_what_takes_nothing_but_what_it_is_called_on_is_told_apart(function, alone):
    function.__qualname__ = f"Model.{function.__name__}"
    assert Hook(function, "somewhere.Model.function").alone is alone


def test_every_kind_of_function_has_interceptors_of_its_kind():
    items, wait = Hook(Model.items, f"{__name__}.Model.items"), Hook(Model.wait, f"{__name__}.Model.wait")
    assert (items.kind, wait.kind) == ("generator", "coroutine")

    def generate(args, kwargs):
        yield "intercepted"

    async def wait_for(args, kwargs):
        return "intercepted"

    async def flow():
        yield 1

    items.enter(getcurrent(), generate, None)
    wait.enter(getcurrent(), wait_for, None)
    assert list(items.make_wrapper()(Model(), 2)) == ["intercepted"]
    assert asyncio.run(wait.make_wrapper()(Model(), 1)) == "intercepted"
    with pytest.raises(PatchError, match="async generator"):
        Hook(flow, "somewhere.flow")


def test_interceptors_are_found_by_greenlet_and_by_the_nearest_stack_among_its_parents(request):
    hook = Hook(Model.decide, f"{__name__}.Model.decide")
    made, model, said = hook.make_wrapper(), Model(), []
    hook.enter(getcurrent(), lambda args, kwargs: "intercepted", None)
    assert made(model) == "intercepted"
    assert in_a_greenlet(lambda: made(model)) == "rule"  # no simulation's stack is among its parents
    thread = threading.Thread(target=lambda: said.append(made(model)))
    thread.start()
    thread.join()
    assert said == ["rule"]
    stack = request.getfixturevalue("stack")
    assert in_a_greenlet(lambda: made(model)) == ("elsewhere", (model,))
    assert in_a_greenlet(lambda: in_a_greenlet(lambda: made(model))) == ("elsewhere", (model,))
    assert stack.asked == 2


def test_what_a_stack_has_spawned_on_a_hub_of_others_belongs_to_the_stack(stack):
    hook = Hook(Model.decide, f"{__name__}.Model.decide")
    made = hook.make_wrapper()
    hook.enter(getcurrent(), lambda args, kwargs: "intercepted", None)
    here, said, going = getcurrent(), [], threading.Event()

    class Spawned(greenlet):
        spawning_greenlet = staticmethod(weakref.ref(here))

    def hub():
        assert going.wait(10)
        spawned = Spawned(lambda: made(Model()))
        return spawned.switch()

    thread = threading.Thread(target=lambda: said.append(hub()))  # where no parent is the stack
    with outside_simulation():  # where threads are watched, it would be one that the simulation has started
        thread.start()
    going.set()
    thread.join()
    assert (said[0][0], stack.asked) == ("elsewhere", 1)


def test_outside_a_simulation_its_interceptors_are_masked(stack):
    here = getcurrent()
    with outside_simulation():
        assert stack.hidden == 1
        assert STACKS[here] is OUTSIDE
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


# -- rules and what is made of them -----------------------------------------------------------------


def test_what_runs_in_the_functions_place_does_so_everywhere_but_in_what_has_begun():
    hook = Hook(Model.decide, f"{__name__}.Model.decide")
    made = hook.make_wrapper()
    hook.replace_rule(lambda model: "other")
    assert made(Model()) == in_a_greenlet(lambda: made(Model())) == "other"
    hook.replace_rule()
    assert made(Model()) == "rule"
    assert hook.interceptors == {}


def test_a_hook_goes_with_its_wrappers():
    def function():
        return 1

    made = Hook(function, "somewhere.function").make_wrapper()
    reference = weakref.ref(hook_of(made))
    assert reference() in hooks()
    del made
    gc.collect()
    assert reference() is None


def test_a_wrapper_that_is_pickled_by_value_asks_the_hook_where_it_arrives():
    scope = {"__name__": "__main__"}
    exec("def function(number): return number", scope)
    made = Hook(scope["function"], "__main__.function").make_wrapper("made with")
    again = pickle.loads(cloudpickle.dumps(made))
    hook = hook_of(again)
    assert again(3) == 3
    assert made_with(again) == "made with"
    hook.enter(getcurrent(), lambda args, kwargs: "intercepted", None)
    assert again(3) == "intercepted"
    hook.leave(getcurrent())
