"""Decisions that arise below frames of C, and what is raised there."""

import ctypes
import gc
import random
import shutil
import sqlite3
import subprocess
import sys
import textwrap
import threading
import warnings
import weakref
from contextlib import closing, suppress
from functools import cache, reduce
from itertools import count
from pathlib import Path
from tempfile import mkdtemp

import greenlet
import pytest

from simenv_marl import RULE, aec_env, branch, parallel_env, simulate, single_env
from simenv_marl.plugins import handlers
from simenv_marl.remote import CallbackGuard
from tests.contract.test_faults import interrupt_at
from tests.worlds.models import Script, alive, culprits, decision, notes, script, stacks

ROOT = Path(__file__).parents[2]
VIEWS = pytest.mark.parametrize("view", [aec_env, single_env])
TRIGGERS = pytest.mark.parametrize("trigger", ["close", "reset", "collect"])

INT = ctypes.POINTER(ctypes.c_int)
COMPARE = ctypes.CFUNCTYPE(ctypes.c_int, INT, INT)
EACH = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_int)

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="libc is looked for in the process itself")


@pytest.fixture(autouse=True)
def _silent(capfd):
    """What a callback raises in vain is printed, and is a warning of pytest's besides."""
    yield
    gc.collect()
    assert capfd.readouterr().err == ""


def sort(values, compare):
    """Sort numbers by the C library."""
    array = (ctypes.c_int * len(values))(*values)
    ctypes.CDLL(None).qsort(array, len(values), ctypes.sizeof(ctypes.c_int), COMPARE(compare))
    return list(array)


@cache
def loops():
    """Loops of C; skips the test where there is no compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("there is no C compiler")
    library = Path(mkdtemp()) / "loops.so"
    subprocess.run(
        [compiler, "-shared", "-fPIC", "-o", library, ROOT / "tests" / "worlds" / "loops.c"], check=True, timeout=60
    )
    return ctypes.CDLL(str(library))


def end(env, trigger):
    """End an episode: to be called with the only reference to its environment in a list."""
    if trigger == "collect":
        env.clear()
        gc.collect()
    else:
        getattr(env[0], trigger)()


def sorting(decide, log, size=20):
    """A simulation that sorts by decisions."""

    def main(simulation):
        guard = CallbackGuard()

        def compare(one, other):
            try:
                return decide(one[0], other[0])
            finally:
                log.append("finally")

        with guard:
            values = sort(range(size), guard.callback(compare))
        simulation.log.append(values)

    return script(main)


def comparing(rule=lambda one, other: one - other, **changes):
    changes = {"action_space_mapping": lambda action: 1 - action} | changes
    return decision(rule, agent="a_0", **changes)


# -- ends in mid-episode --------------------------------------------------------------------------


@VIEWS
@TRIGGERS
def test_an_end_in_a_callback_unwinds_past_the_c_code(view, trigger):
    log, asked = [], []
    decide = comparing(reward_mapping=lambda *arguments: asked.append(1) or 0.0)
    before = stacks()
    env = [view(sorting(decide, log), decide)]
    env[0].reset()
    env[0].step(1)
    env[0].step(1)
    told = env[0].unwrapped.simulation.log
    asked.clear()
    log.clear()
    end(env, trigger)
    assert log == ["finally"]
    assert told == []
    assert len(asked) == (1 if trigger == "reset" else 0)  # 1: the next episode's
    for one in env:
        one.close()
    env.clear()
    assert stacks(before) == before


@TRIGGERS
def test_c_code_is_asked_to_stop_where_it_calls_back(trigger):
    log, library, decide = [], loops(), decision(lambda number: 0, agent="a_0")
    stopped = ctypes.c_int(0)

    class Model(Script):
        def run(self):
            stopped.value = 0
            guard, here = CallbackGuard(stop=lambda: self.halt(here)), greenlet.getcurrent()
            try:
                with guard:
                    library.loop(EACH(guard.callback(decide)), 1000, ctypes.byref(stopped))
            finally:
                log.append("finally")

        def halt(self, here):
            assert greenlet.getcurrent() is here
            stopped.value = 1
            log.append("stop")

    env = [single_env(lambda: Model(None), decide)]
    env[0].reset()
    env[0].step(1)
    end(env, trigger)
    assert log == ["stop", "finally"]


def test_an_end_passes_several_layers_of_c_code():
    log, decide = [], comparing()

    def main(simulation):
        guard = CallbackGuard()

        def deep(depth):
            def compare(one, other):
                try:
                    if depth == 3:
                        return decide(one[0], other[0])
                    with guard:
                        sort(range(4), guard.callback(deep(depth + 1)))
                finally:
                    log.append(depth)

            return compare

        with guard:
            sort(range(4), guard.callback(deep(0)))

    env = single_env(script(main), decide)
    env.reset()
    env.step(1)
    log.clear()
    env.close()
    assert log == [3, 2, 1, 0]


@pytest.mark.greenlet("threads of their own unwind at once, wherever their environment is dropped")
def test_an_environment_that_is_dropped_in_another_thread_unwinds_past_c_code_in_its_own():
    log, decide = [], comparing()
    held = [single_env(sorting(decide, log), decide)]
    held[0].reset()
    thread = threading.Thread(target=held.clear)
    thread.start()
    thread.join()
    gc.collect()
    greenlet.greenlet(lambda: None).switch()  # whatever switches next
    assert log == ["finally"]


def test_environments_and_guards_that_refer_to_each_other_are_collected():
    class Witness:
        pass

    class Model(Script):
        def reset(self, seed=None, options=None):
            super().reset(seed, options)
            self.guard = CallbackGuard(stop=self.halt)
            self.compare = COMPARE(self.guard.callback(self.each))
            self.witness = Witness()

        def halt(self):
            pass

        def each(self, one, other):
            return decide(one[0], other[0])

        def run(self):
            array = (ctypes.c_int * 9)(*range(9))
            with self.guard:
                ctypes.CDLL(None).qsort(array, 9, ctypes.sizeof(ctypes.c_int), self.compare)

    def play():
        env = single_env(lambda: Model(None), decide)
        env.reset()
        env.step(1)
        return weakref.ref(env.unwrapped.simulation)

    decide = comparing()
    before = stacks()
    reference = play()
    gc.collect()
    assert reference() is None
    assert alive(Witness) == 0
    assert stacks(before) == before


# -- errors ---------------------------------------------------------------------------------------


@VIEWS
@pytest.mark.parametrize("error", [ZeroDivisionError, KeyboardInterrupt, SystemExit, StopIteration])
@pytest.mark.parametrize("where", ["callback", "apply", "handler"])
def test_an_error_in_a_callback_surfaces_from_step_as_itself(view, error, where):
    def fail(place):
        if armed and place == where:
            armed.clear()
            raise error("told")

    def main(simulation):
        guard = CallbackGuard()

        def compare(one, other):
            result = decide(one[0], other[0])
            fail("callback")
            simulation.log.append(result)
            return result

        with guard:
            sort(range(20), guard.callback(compare))
        simulation.log.append("after")

    def apply(action, one, other):
        fail("apply")
        return 0

    armed = []
    decide = decision(lambda one, other: one - other, agent="a_0", apply=apply)
    plugins = [(lambda *arguments: fail("handler"), decide, "after")] if where == "handler" else []
    env = view(script(main), decide, plugins=plugins)
    env.reset(seed=7)
    env.step(1)
    armed.append(True)
    with pytest.raises(error, match="told") as caught:
        env.step(1)
    assert culprits(caught.value)[-1] == "fail"
    assert "of 'a_0'" in notes(caught.value)
    assert "seed 7" in notes(caught.value)
    assert env.unwrapped.simulation.log == [0]
    env.reset()
    env.step(1)
    env.close()


def test_an_error_of_a_mapping_surfaces_and_the_c_code_is_unwound():
    def observe(one, other):
        if armed:
            raise ZeroDivisionError
        return [one, other]

    log, armed = [], []
    decide = comparing(observation_space_mapping=observe)
    env = single_env(sorting(decide, log), decide)
    env.reset()
    armed.append(True)
    with pytest.raises(ZeroDivisionError):
        env.step(1)
    assert log == ["finally", "finally"]


def test_an_error_of_stop_surfaces_with_what_it_was_called_for():
    def main(simulation):
        guard = CallbackGuard(stop=fail)
        with guard:
            sort(range(9), guard.callback(lambda one, other: decide(one[0], other[0]) and 1 // 0))

    def fail():
        raise KeyError("cannot stop")

    decide = comparing()
    env = single_env(script(main), decide)
    env.reset()
    with pytest.raises(KeyError, match="cannot stop") as caught:
        env.step(0)
    assert isinstance(caught.value.__context__, ZeroDivisionError)
    env.reset()
    with pytest.raises(KeyError, match="cannot stop"):
        env.close()


def test_what_the_c_codes_caller_says_of_having_been_stopped_does_not_hide_the_error():
    guard = CallbackGuard()

    def fail(one, other):
        try:
            raise KeyError("first")
        except KeyError:
            raise ValueError("second")  # noqa: B904

    def sort_in_vain():
        with guard:
            sort(range(9), guard.callback(fail))
            raise RuntimeError("sorting was stopped")

    with pytest.raises(ValueError, match="second") as caught:
        sort_in_vain()
    assert isinstance(caught.value.__context__, KeyError)


@pytest.mark.usefixtures("_collected")
def test_an_error_that_was_dealt_with_leaves_nothing_behind():
    class Witness:
        pass

    def fail():
        local = Witness()
        raise ZeroDivisionError(local)

    def call():
        guard = CallbackGuard()
        with guard:
            try:
                guard.callback(fail)()
                raise RuntimeError("was stopped")
            finally:
                local = Witness()  # noqa: F841 - in the frame of the traceback

    with suppress(ZeroDivisionError):
        call()
    assert sum(type(thing) is Witness for thing in gc.get_objects()) == 0


def test_an_error_is_dealt_with_at_the_block_around_the_c_code_that_has_called_back():
    decide, told = comparing(), []

    def main(simulation):
        guard = CallbackGuard()

        def outer(one, other):
            with suppress(ZeroDivisionError), guard:
                sort(range(3), guard.callback(lambda *pair: 1 // 0))
            return decide(one[0], other[0])

        with guard:
            told.append(sort(range(9), guard.callback(outer)))

    simulate(script(main), {decide: RULE})
    assert told == [list(range(9))]


def test_outside_an_environment_errors_surface_and_callbacks_cost_next_to_nothing_more():
    guard = CallbackGuard()
    calls = []

    def compare(one, other):
        calls.append(1)
        if len(calls) == 5:
            raise ZeroDivisionError
        return one[0] - other[0]

    with pytest.raises(ZeroDivisionError), guard:
        sort(range(50, 0, -1), guard.callback(compare))
    assert len(calls) == 5
    with guard:
        assert sort(range(50, 0, -1), guard.callback(compare)) == list(range(1, 51))


def test_outside_a_block_a_callback_is_called_as_it_is():
    guard = CallbackGuard(stop=lambda: pytest.fail("nothing is to be stopped"))
    divide = guard.callback(lambda number: 1 // number)
    with guard, guard:
        assert divide(1) == 1
    with pytest.raises(ZeroDivisionError):
        divide(0)
    assert divide.__name__ == "<lambda>"


def test_what_c_is_answered_after_an_error_can_be_said():
    answers, guard = [], CallbackGuard()
    call, other = guard.callback(lambda: 1 // 0, result=-1), guard.callback(lambda: 1)
    with pytest.raises(ZeroDivisionError), guard:
        answers += [call(), call(), other()]
    assert answers == [-1, -1, 0]


# -- interrupts -----------------------------------------------------------------------------------


def test_an_interrupt_that_comes_while_c_code_runs_is_not_lost():
    library, log, guard = loops(), [], CallbackGuard()
    for at in (0, 1, 5):
        log.clear()
        with pytest.raises(KeyboardInterrupt), guard:
            library.loop_interrupted(EACH(guard.callback(lambda number: log.append(number) or 0)), 9, at)
        assert log == list(range(at))


@VIEWS
@pytest.mark.parametrize("during", ["step", "close"])
def test_an_interrupt_that_comes_while_c_code_runs_surfaces(view, during):
    library, log, decide = loops(), [], decision(lambda number: 0, agent="a_0")

    def main(simulation):
        guard = CallbackGuard()
        try:
            with guard:
                library.loop_interrupted(EACH(guard.callback(decide)), 9, 2)
        finally:
            log.append("finally")

    env = view(script(main), decide)
    env.reset()
    env.step(1)
    with pytest.raises(KeyboardInterrupt):
        env.step(1) if during == "step" else env.close()
    assert log == ["finally"]
    env.reset()
    with pytest.raises(KeyboardInterrupt):
        env.close()


@pytest.mark.usefixtures("_collected")
def test_an_interrupt_anywhere_around_callbacks_surfaces(monkeypatch):
    monkeypatch.setattr("simenv_marl.core.threads.SECONDS_TO_UNWIND", 0.05)
    decide = comparing()

    def whole_run(env):
        for seed in range(2):
            env.reset(seed=seed)
            env.step(1)
        env.close()

    for number in count(1):
        env = single_env(sorting(decide, [], 4), decide)
        where, raised = interrupt_at(number, whole_run, env)
        if where is None:
            assert raised is None
            break
        assert type(raised) is KeyboardInterrupt, where
        del raised
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ResourceWarning)  # a thread that was never begun cannot be unwound
            whole_run(env)
    assert number > 100


def test_the_hook_of_what_cannot_be_raised_is_left_to_others(monkeypatch):
    others = []
    monkeypatch.setattr(sys, "unraisablehook", others.append)
    with CallbackGuard():
        pass
    once = sys.unraisablehook
    with CallbackGuard():
        sort(range(2), lambda one, other: 1 // 0)
    assert sys.unraisablehook is once
    assert [one.exc_type for one in others] == [ZeroDivisionError]


# -- C code that does not come to its end ---------------------------------------------------------


@pytest.fixture
def _impatient(monkeypatch):
    monkeypatch.setattr("simenv_marl.core.threads.SECONDS_TO_UNWIND", 0.1)
    monkeypatch.setattr("simenv_marl.remote.callbacks.SECONDS_TO_UNWIND", 0.05)


def endless(decide):
    def main(simulation):
        guard = CallbackGuard()
        with guard:
            loops().loop_until_told(EACH(guard.callback(lambda _: 1 // decide())))

    return script(main)


@pytest.mark.usefixtures("_impatient")
@pytest.mark.parametrize("trigger", ["close", "reset"])
def test_c_code_that_does_not_end_is_given_up_with_a_warning(trigger):
    decide = decision()
    env = single_env(endless(decide), decide)
    env.reset()
    env.step(1)
    with pytest.warns(ResourceWarning, match="neither decided anything nor ended"):
        getattr(env, trigger)()
    if trigger == "close":
        env.reset()
    env.step(1)
    with pytest.warns(ResourceWarning, match="neither decided anything nor ended"):
        env.close()


@pytest.mark.usefixtures("_impatient")
def test_an_error_in_c_code_that_does_not_end_surfaces_nevertheless():
    decide = decision()
    env = single_env(endless(decide), decide)
    env.reset()
    with pytest.raises(ZeroDivisionError), pytest.warns(ResourceWarning, match="neither decided anything nor ended"):
        env.step(0)
    env.reset()
    env.step(1)
    with pytest.warns(ResourceWarning, match="neither decided anything nor ended"):
        env.close()


@pytest.mark.usefixtures("_impatient")
def test_c_code_that_the_stop_of_the_simulation_ends_is_unwound_after_an_error():
    class Model(Script):
        def run(self):
            guard, self.stopped, log = CallbackGuard(), ctypes.c_int(0), self.log
            callback = EACH(guard.callback(lambda _: 1 // decide()))
            try:
                with guard:
                    loops().loop(callback, 2**31 - 1, ctypes.byref(self.stopped))
                    loops().loop(callback, 100, ctypes.byref(ctypes.c_int(0)))  # takes a while to end
            finally:
                log.append("finally")

        def stop(self):
            self.stopped.value = 1

    decide = decision()
    env = single_env(lambda: Model(None), decide)
    env.reset()
    with pytest.raises(ZeroDivisionError) as caught:
        env.step(0)
    assert "unwound" not in notes(caught.value)
    assert env.unwrapped.simulation.log == ["finally"]
    env.close()


@pytest.mark.usefixtures("_impatient")
def test_an_error_while_c_code_that_does_not_end_is_unwound_surfaces_nevertheless():
    def ask():
        try:
            return decide()
        finally:
            raise KeyError("while unwinding")

    decide = decision()
    env = single_env(endless(ask), decide)
    env.reset()
    with (
        pytest.raises(KeyError, match="while unwinding"),
        pytest.warns(ResourceWarning, match="neither decided anything nor ended"),
    ):
        env.close()


@pytest.mark.usefixtures("_impatient")
def test_an_error_in_a_reset_whose_c_code_does_not_end_surfaces():
    class Model(Script):
        def reset(self, seed=None, options=None):
            super().reset(seed, options)
            if self.episodes == 1 and armed:
                guard = CallbackGuard()
                with guard:
                    loops().loop_until_told(EACH(guard.callback(lambda number: 1 // number)))

    decide, armed = decision(), [True]
    env = single_env(lambda: Model(lambda simulation: decide()), decide)
    with pytest.raises(ZeroDivisionError):
        env.reset()
    armed.clear()
    env.reset()
    env.step(1)
    env.close()


def test_a_process_with_c_code_that_was_given_up_ends(request):
    driver = request.node.callspec.params["_driver"]
    code = f"""
        import warnings
        from simenv_marl import single_env
        from tests.contract import test_callbacks as tests
        from tests.worlds.models import decision
        import simenv_marl.remote.callbacks, simenv_marl.core.threads

        simenv_marl.remote.callbacks.SECONDS_TO_UNWIND = simenv_marl.core.threads.SECONDS_TO_UNWIND = 0.05
        decide = decision()
        env = single_env(tests.endless(decide), decide, driver={driver!r})
        env.reset()
        warnings.simplefilter("ignore")
        env.close()
        print("end")
    """
    loops()
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=60, check=False, cwd=ROOT
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "end\n", "")


# -- side by side ---------------------------------------------------------------------------------


def recursive(decide):
    """A simulation of C code that calls back, where C code is called that calls back, as chance has it."""

    def main(simulation):
        rng, guard = random.Random(simulation.seed), CallbackGuard()

        def sorted_by_c(values, depth):
            def compare(one, other):
                if depth < 2 and rng.random() < 0.3:
                    sorted_by_c([rng.randrange(100) for _ in range(4)], depth + 1)
                simulation.log.append((depth, one[0], other[0], decide(depth)))
                return one[0] - other[0]

            with guard:
                result = sort(values, guard.callback(compare))
            assert result == sorted(values)

        for _ in range(3):
            sorted_by_c([rng.randrange(100) for _ in range(8)], 0)

    return script(main)


def test_interleaved_environments_whose_callbacks_are_suspended_in_any_order():
    decide, seeds = decision(lambda depth: 0, agent="a_0"), range(12)

    def actions(seed):
        return iter(random.Random(seed).choices(range(10), k=10_000))

    alone = []
    for seed in seeds:
        env, mine = single_env(recursive(decide), decide), actions(seed)
        env.reset(seed=seed)
        while not env.step(next(mine))[2]:
            pass
        alone.append(env.unwrapped.simulation.log)
        env.close()
    order, envs = random.Random(1), {}
    for seed in seeds:
        envs[seed] = single_env(recursive(decide), decide), actions(seed)
        envs[seed][0].reset(seed=seed)
    left = list(seeds)
    while left:
        seed = order.choice(left)
        env, mine = envs[seed]
        if order.random() < 0.005:  # an end in mid-episode, and the same episode again
            envs[seed] = env, actions(seed)
            env.reset(seed=seed)
        elif env.step(next(mine))[2]:
            left.remove(seed)
    assert [env.unwrapped.simulation.log for env, _ in envs.values()] == alone
    for env, _ in envs.values():
        env.close()


def test_libraries_that_note_for_each_thread_which_call_is_under_way_need_threads(request):
    """With greenlets their calls are mixed up, which the page on callbacks says: results are wrong, or a crash."""
    if request.node.callspec.params["_driver"] != "thread":
        pytest.skip("it needs threads")
    integrate = pytest.importorskip("scipy.integrate")

    def integral(number, ask):
        return integrate.quad(lambda x: number * x + ask(), 0, 1)[0]

    def main(simulation):
        simulation.log.append(integral(simulation.seed, decide))

    decide = decision(lambda: 0)
    envs = [single_env(script(main), decide) for _ in range(3)]
    for seed, env in enumerate(envs):
        env.reset(seed=seed)
    order, left = random.Random(0), list(envs)
    while left:
        env = order.choice(left)
        if env.step(2)[2]:
            left.remove(env)
    assert [env.unwrapped.simulation.log for env in envs] == [[integral(seed, lambda: 2)] for seed in range(3)]


@pytest.mark.parametrize("method", ["fork", "replay"])
def test_an_episode_is_branched_while_it_is_suspended_in_a_callback(method, request):
    if method == "fork" and request.node.callspec.params["_driver"] == "thread":
        pytest.skip("a thread does not come along in a fork")

    def rest(env, number=0):
        while not env.step(1)[2]:
            pass
        return env.unwrapped.simulation.log

    decide = decision(lambda depth: 0, agent="a_0")
    env = single_env(recursive(decide), decide)
    env.reset(seed=3)
    for _ in range(20):
        env.step(2)
    found = branch(env, rest, 2, method=method)
    assert found == [rest(env)] * 2
    env.close()


def test_rounds_go_on_below_c_code():
    decide = decision(lambda number: 0, agent=lambda number: f"a_{number}")
    library, stopped = loops(), ctypes.c_int(0)

    def main(simulation):
        guard = CallbackGuard()
        with guard:
            for _ in range(3):
                library.loop(EACH(guard.callback(decide)), 4, ctypes.byref(stopped))

    env = parallel_env(script(main), decide, possible_agents=[f"a_{number}" for number in range(4)])
    env.reset()
    rounds = 0
    while env.agents:
        env.step(dict.fromkeys(env.agents, 1))
        rounds += 1
    assert rounds == 3
    env.close()


# -- other ways from C to Python ------------------------------------------------------------------


@TRIGGERS
@pytest.mark.parametrize("how", ["sorted", "reduce", "map"])
def test_exceptions_cross_the_c_code_of_python_itself(how, trigger):
    log, decide = [], decision(lambda *arguments: 0, agent="a_0")

    def main(simulation):
        try:
            if how == "sorted":
                sorted(range(9), key=decide)
            elif how == "reduce":
                reduce(decide, range(9))
            else:
                list(map(decide, range(9)))
        finally:
            log.append("finally")

    env = [single_env(script(main), decide)]
    env[0].reset()
    env[0].step(1)
    end(env, trigger)
    assert log == ["finally"]


@pytest.mark.parametrize("trigger", [*("close", "reset", "collect"), "error"])
def test_functions_of_a_database(trigger):
    log, decide = [], decision(lambda number: 0, agent="a_0")

    def main(simulation):
        guard = CallbackGuard()
        with closing(sqlite3.connect(":memory:")) as database:
            database.create_function("ask", 1, guard.callback(lambda number: 1 // decide(number)))
            try:
                rows = "select 1 as number union select 2 union select 3"
                with guard:
                    database.execute(f"select ask(number) from ({rows})").fetchall()
            finally:
                log.append("finally")

    env = [single_env(script(main), decide)]
    env[0].reset()
    env[0].step(1)
    if trigger == "error":
        with pytest.raises(ZeroDivisionError):
            env[0].step(0)
        env[0].close()
    else:
        end(env, trigger)
    assert log == ["finally"]


@TRIGGERS
@pytest.mark.parametrize("kind", ["int", "void"])
def test_callbacks_of_cffi(trigger, kind):
    cffi = pytest.importorskip("cffi")
    ffi = cffi.FFI()
    ffi.cdef("typedef int (*compare)(const void *, const void *); void qsort(void *, size_t, size_t, compare);")
    libc, log, decide = ffi.dlopen(None), [], decision(lambda *numbers: 0, agent="a_0")

    def main(simulation):
        guard = CallbackGuard()

        @guard.callback
        def compare(one, other):
            try:
                return decide(ffi.cast("int *", one)[0], ffi.cast("int *", other)[0])
            finally:
                log.append("finally")

        def tell(one, other):
            compare(one, other)

        array = ffi.new("int[9]", list(range(9)))
        given = ffi.callback("int(const void *, const void *)", compare)
        if kind == "void":
            silent = guard.callback(tell, result=None)
            nothing = ffi.callback("void(const void *, const void *)", silent)
            given = ffi.cast("compare", nothing)
        with guard:
            libc.qsort(array, 9, ffi.sizeof("int"), given)

    env = [single_env(script(main), decide)]
    env[0].reset()
    env[0].step(1)
    log.clear()
    end(env, trigger)
    assert log == ["finally"]


def test_handlers_around_decisions_below_c_code_are_run():
    told, decide = [], comparing()
    with handlers((lambda one, other: told.append((one, other)), decide, "before")):
        simulate(sorting(decide, []), {decide: lambda observation: 1}, points=decide)
    assert told
