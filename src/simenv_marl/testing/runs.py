"""Recorded runs of a simulation: plain runs, runs with RULE throughout, and episodes of random actions.

Every run has an end, whatever the model does. At its limit of decisions, an exit is raised at the
next decision. When its time is up, an exit is raised in whatever Python code the model is
executing.
"""

from __future__ import annotations

import ctypes
import io
import math
import os
import random
import sys
import threading
import time
import traceback
import types
import warnings
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from datetime import date, datetime
from itertools import islice
from pickle import dumps
from textwrap import shorten
from typing import Any, Final

import numpy as np
from greenlet import getcurrent

from ..core import MASK, GlobalRandom, LoopExit, Plan, environment_context
from ..decision import DecisionPoint
from ..errors import describe_error, error_notes
from ..hooks.handlers import Installation
from ..hooks.stacks import outside_simulation, stack_of
from ..simulation import RULE, make_simulation, resetter
from .fingerprint import Difference, Fingerprint, describe_differences, differences, fingerprint

_WARNINGS: Final = ("refuses to end", "several objects decide at", "did not appear in the episode")
"""Texts in the warnings of environments that are findings."""


class LimitReached(LoopExit):
    """Raised in a run that has reached its limit of decisions or of time."""


def within(seconds: float, function: Callable[[], Any]) -> None:
    """Call a function, and raise ``LimitReached`` in it when the time is up.

    This interrupts Python code. Waiting outside of Python (in a sleep, for example) is interrupted
    when it returns.
    """
    thread, over = threading.get_ident(), threading.Event()

    def watch() -> None:
        pause = seconds
        while not over.wait(pause):
            ctypes.pythonapi.PyThreadState_SetAsyncExc(
                ctypes.c_ulong(thread), ctypes.py_object(LimitReached)
            )
            pause = 0.5  # raise it again in a model that swallows it

    watcher = threading.Thread(target=watch, daemon=True, name="time limit of a check")
    try:
        watcher.start()
        function()
    finally:
        # It may still be raised until the watcher has ended, and is then delivered at once. (It is
        # not revoked: in CPython that would leave the interpreter checking for it forever.)
        while True:
            try:
                over.set()
                watcher.join()
                for _ in range(10):
                    pass
                break
            except LimitReached:
                continue


# -- global generators ----------------------------------------------------------------------------


def seed_global_generators(seed: int) -> None:
    """Seed Python's and NumPy's global generators, so that runs of a model that draws from them can be compared."""
    random.seed(seed)
    np.random.seed(seed % 2**32)


def global_generators() -> dict[str, Any]:
    """Return the states of both."""
    return {"Python's random": random.getstate(), "numpy.random": np.random.get_state(legacy=False)}


@contextmanager
def quietly() -> Iterator[list[warnings.WarningMessage]]:
    """Ignore what a model prints and warns.

    Restore the global generators; yield warnings that are findings.
    """
    states, silenced = global_generators(), io.StringIO()
    try:
        with (
            outside_simulation(),
            warnings.catch_warnings(record=True) as caught,
            redirect_stdout(silenced),
            redirect_stderr(silenced),
        ):
            warnings.simplefilter("ignore")
            for pattern in _WARNINGS:
                warnings.filterwarnings("always", f".*{pattern}")
            yield caught
    finally:
        random.setstate(states["Python's random"])
        np.random.set_state(states["numpy.random"])


# -- runs -----------------------------------------------------------------------------------------


@dataclass
class Run:
    """What is recorded of a run."""

    # the names of the points that were called, or of the agents
    calls: list[str] = field(default_factory=list)
    steps: Fingerprint = field(default_factory=dict)  # the decisions, or the results of ``last()``
    actions: list[Any] = field(default_factory=list)  # the random ones
    simulation: Any = None
    in_main_loop: bool = False  # whether a plain run is in the simulation's main loop
    # of the simulation at its end, or when it was cut
    fingerprint: Fingerprint = field(default_factory=dict)
    cut: bool = False  # whether it has reached its limit of decisions
    error: BaseException | None = None
    # what run() returned in a plain run, or how an episode of random actions ended
    result: Any = None
    drawn: set[str] = field(default_factory=set)  # the global generators from which it has drawn
    latest: float = field(default_factory=time.monotonic)  # the time of the latest call
    stuck: bool = False  # whether its time was up long after the latest call

    def begin_step(self, name: str) -> str:
        """Record that a point was called or an agent asked.

        Return the name of this step in ``steps``.
        """
        self.calls.append(name)
        self.latest = time.monotonic()
        step = f"in step {len(self.calls)}, {name}"
        self.steps[step] = "without a result"
        return step

    def difference(self, other: Run) -> str:
        """Describe the first differences from the steps of another run; empty if there are none."""
        if other.error is not None:
            return f"the second one raises {describe_with_place(other.error)}"
        parts = differences(self.steps, other.steps)
        if not parts and len(self.calls) != len(other.calls):
            return f"there are first {len(self.calls)} steps, then {len(other.calls)}"
        return describe_differences(parts)


@dataclass(kw_only=True)
class Subject:
    """A simulation with its decision points and options, the limits of its runs, and what is known so far."""

    plan: Plan
    max_steps: int
    seconds: float  # the time limit of a single run
    own: Callable[[Any], Any] | None = None  # the user's callable by which simulations are compared
    seeds: tuple[int, ...] = ()
    episodes: int = 0
    end: float = math.inf  # of the time limit for all checks, as time.monotonic()
    plain: dict[int, Run] = field(default_factory=dict)  # plain runs, by seed
    repeats: bool = True  # whether the same seed gives the same plain run
    drawn: set[str] = field(default_factory=set)  # the global generators that it draws from
    unstable: frozenset[str] = frozenset()  # parts that are not compared
    # that the plan allows; none if the plain runs fail or decide nothing
    views: tuple[str, ...] = ()

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        return time.monotonic() >= self.end

    def look(self, simulation: Any) -> Fingerprint:
        """Return the fingerprint of a simulation: of the user's callable, of its ``state()``, or of its attributes."""
        with outside_simulation():  # decision functions called there run their rule
            if self.own is not None:
                return fingerprint("fingerprint", self.own(simulation))
            state = getattr(simulation, "state", None)
            return (
                fingerprint("state()", state())
                if callable(state)
                else fingerprint("simulation", simulation)
            )

    def differences(self, run: Run, other: Run) -> list[Difference]:
        """Return the parts in which the simulations differ after two runs."""
        return differences(run.fingerprint, other.fingerprint, self.unstable)

    def play(self, function: Callable[[], Any], run: Run | None = None, *, seed: int = 0) -> Run:
        """Seed the global generators, call a function within the time limit, and record its error and its draws."""
        run = Run() if run is None else run
        seed_global_generators(seed)
        states = global_generators()
        try:
            within(self.seconds, function)
        except (Exception, SystemExit, LimitReached) as error:
            run.error = None if run.cut else error
            run.stuck = time.monotonic() - run.latest > self.seconds / 2
        run.drawn = {
            name
            for name, state in global_generators().items()
            if dumps(state) != dumps(states[name])
        }
        return run

    def run_plainly(self, seed: int, *, shared_seed: int | None = None) -> Run:
        """Run the simulation's own loop, with the plan's handlers and generators.

        Record the results of its rules.

        The global generators get the same seed, or a ``shared_seed``.
        """
        run = Run()

        def start() -> None:
            rng = GlobalRandom() if self.plan.options.global_rng else None
            installation = Installation(self.plan.patches)
            try:
                with environment_context(self.plan.plugins, rng):
                    run.simulation = make_simulation(self.plan.subject.source)
                    if rng is not None:
                        rng.begin(seed)
                    resetter(run.simulation)(seed, None)
                    run.in_main_loop = True
                    run.result = run.simulation.run()
                    run.in_main_loop = False
                    run.fingerprint = self.look(run.simulation)
            finally:
                installation.uninstall()

        return self._record(run, start, seed if shared_seed is None else shared_seed)

    def run_rules(self, env: Any, seed: int) -> Run:
        """Run an environment of any view with ``RULE`` throughout.

        The results of rules are recorded.
        """
        run = Run(simulation=env.simulation)

        def start() -> None:
            env.reset(seed=seed)
            if not hasattr(env, "agents"):
                while not any(env.step(RULE)[2:4]):
                    pass
            while getattr(env, "agents", ()):
                over = (
                    hasattr(env, "agent_selection")
                    and (env.terminations | env.truncations)[env.agent_selection]
                )
                env.step(None if over else RULE)
            run.fingerprint = self.look(run.simulation)

        return self._record(run, start, seed)

    def _record(self, run: Run, start: Callable[[], None], seed: int) -> Run:
        """Play a run in which the decisions of the rules are recorded."""
        points = list(dict.fromkeys(bound.hook for bound in self.plan.points))
        for point in points:
            point.replace_rule(self._recording_rule(run, point))
        try:
            return self.play(start, run, seed=seed)
        finally:
            for point in points:
                point.replace_rule()

    def _recording_rule(self, run: Run, point: DecisionPoint) -> Callable[..., Any]:
        """Return a rule that records each of its decisions, and cuts the run at the limit."""
        name, rule = point.name, point.function

        def decide(*args: Any, **kwargs: Any) -> Any:
            stack = stack_of(getcurrent())
            # In a reset or a mapping, rules do not count as decisions.
            if not (run.in_main_loop if stack is None else stack.events):
                return rule(*args, **kwargs)
            if len(run.calls) >= self.max_steps:
                if not run.cut:
                    run.cut, run.fingerprint = True, self.look(run.simulation)
                raise LimitReached
            step = run.begin_step(name)
            value = rule(*args, **kwargs)
            return end(step, value) if point.kind == "function" else wait(step, value)

        def end(step: str, value: Any) -> Any:
            run.steps |= fingerprint(step, value, follow=False)
            return value

        @types.coroutine
        def wait(step: str, running: Any) -> Generator[Any, Any, Any]:
            awaited = running.__await__() if point.kind == "coroutine" else running
            return end(step, (yield from awaited))

        return decide

    def run_randomly(
        self,
        env: Any,
        seed: int,
        *,
        salt: int = 0,
        most: int | None = None,
        beside: Any = None,
        collect: Any = None,
    ) -> Run:
        """Play an episode with random legal actions in an AEC environment.

        A salt gives others with the same seed.

        The episode is broken off after ``most`` steps. The environment ``beside`` is stepped in
        turns with this one. ``collect`` is called with the environment, the agent and the result of
        ``last()`` at each step.
        """
        run = Run()

        def start() -> None:
            other = iter(()) if beside is None else _random_steps(Run(), beside, seed + 1, salt)
            for agent, step in islice(_random_steps(run, env, seed, salt), most):
                if collect is not None:
                    collect(env, agent, step)
                next(other, None)

        return self.play(start, run, seed=seed)

    def sources_of_chance(self) -> str:
        """Run the simulation, and say where it uses clocks, entropy and Python's global generator, if it does."""
        found: dict[str, None] = {}

        def profile(frame: Any, event: str, argument: Any) -> None:
            source = _CHANCE.get(argument) if event == "c_call" else None
            if frame.f_code is random.Random.seed.__code__ and frame.f_locals.get("a", 0) is None:
                source = "a random.Random is made without a seed"
            while (
                source
                and frame is not None
                and frame.f_code.co_filename.startswith((_LIBRARY, "<"))
            ):
                frame = frame.f_back
            if source and frame is not None and not frame.f_code.co_filename.startswith(_PACKAGE):
                code = frame.f_code
                found[f"{source} at {code.co_filename}:{frame.f_lineno}, in {code.co_name}"] = None

        before = sys.getprofile()
        sys.setprofile(profile)
        try:
            self.run_plainly(self.seeds[0])
        finally:
            sys.setprofile(before)
        return f"\nin the model, {'; '.join(list(found)[:3])}" if found else ""


def _random_steps(run: Run, env: Any, seed: int, salt: int) -> Iterator[tuple[str, Any]]:
    """Play one step at a time, record it, and yield the agent and the result of ``last()``."""
    env.reset(seed=seed)
    for agent in env.agent_iter():
        step, action = env.last(), None
        run.steps |= fingerprint(run.begin_step(agent), step)
        run.result = "truncated" if step[3] else "terminated"
        if not (step[2] or step[3]):
            for _ in range(1 + salt):  # the space is seeded by the reset
                action = env.action_space(agent).sample(step[4].get(MASK))
            run.actions.append(action)
        yield agent, step
        env.step(action)


# -- where errors and differences come from -------------------------------------------------------

_PACKAGE: Final = __file__.rpartition("testing")[0]
_LIBRARY: Final = random.__file__.rpartition("random.py")[0]
_CLOCKS: Final = (
    time.time,
    time.time_ns,
    time.monotonic,
    time.perf_counter,
    datetime.now,
    date.today,
)
_CHANCE: Final[dict[Any, str]] = {
    **{clock: f"the clock is read ({clock.__name__})" for clock in _CLOCKS},
    **dict.fromkeys((random.random, random.getrandbits), "Python's global generator is used"),
    os.urandom: "the operating system is asked for random bits (as by a generator without a seed)",
}
"""Builtin functions that are sources of chance."""


def place_of(error: BaseException) -> str:
    """Return where an error was raised, outside of this library: file, line and function.

    Empty if nowhere.
    """
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if not frame.filename.startswith((_PACKAGE, "<")) and "site-packages" not in frame.filename:
            return f"{frame.filename}:{frame.lineno}, in {frame.name}"
    return ""


def describe_with_place(error: BaseException) -> str:
    """Describe an error: its class, the beginning of its text, where it was raised, and this library's notes."""
    text, place = shorten(describe_error(error), 400, placeholder=" ..."), place_of(error)
    notes = "".join(f"\n{note.removeprefix('simenv_marl: ')}" for note in error_notes(error)[:2])
    return text + (f" ({place})" if place else "") + notes
