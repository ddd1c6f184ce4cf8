"""Runs of a simulation: plain runs, runs with RULE throughout, and episodes of random actions.

Every run has an end. At the limit of decisions, the next decision raises an exit. At the time
limit, the Python code that is running raises one.
"""

from __future__ import annotations

import ctypes
import io
import os
import random
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import (
    Callable,
    Generator,
    Iterable,
    Iterator,
)
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from datetime import date, datetime
from functools import cached_property
from textwrap import shorten
from types import FrameType, coroutine
from typing import Any, Final, NoReturn

from greenlet import getcurrent

from ..core import (
    MASK,
    Agent,
    GlobalRandom,
    LoopExit,
    Plan,
    Where,
    environment_context,
    global_states,
    preserve_generators,
)
from ..envs import VIEWS, SimulationAECEnv
from ..envs.base import StepResult
from ..errors import describe_error, error_notes, error_text
from ..hooks.handlers import Installation
from ..hooks.hook import Hook
from ..hooks.stacks import Args, Kwargs, outside_simulation, stack_of
from ..simulation import (
    RULE,
    TRUNCATED,
    Action,
    Model,
    make_simulation,
    optional_method,
    passing,
)
from .fingerprint import STEP, Fingerprint, fingerprint

WARNINGS: Final = {
    "their own rule decides": "silent_override",
    "refuses to end": "warned",
    "several objects decide at": "warned",
    "did not appear in the episode": "warned",
}
"""Texts of the warnings that are findings, with their names."""

Rule = Generator[Model, Model, Model]
"""The rule of a generator or coroutine function, while it runs."""


class LimitReached(LoopExit):
    """Ends a run that has reached its limit of decisions or of time."""


def _raise_limit(number: int, frame: FrameType | None) -> NoReturn:
    raise LimitReached


def call_within(seconds: float, function: Callable[[], object]) -> None:
    """Call a function, and raise ``LimitReached`` in it after a time.

    In the main thread, a signal interrupts a sleep, too. In other threads, a sleep is interrupted
    when it returns.
    """
    thread = threading.get_ident()
    over = threading.Event()
    is_main = threading.current_thread() is threading.main_thread()
    urgent = getattr(signal, "SIGURG", None) if is_main else None  # not on Windows

    def watch() -> None:
        pause = seconds
        while not over.wait(pause):
            if urgent is None:
                ctypes.pythonapi.PyThreadState_SetAsyncExc(
                    ctypes.c_ulong(thread), ctypes.py_object(LimitReached)
                )
            else:
                signal.pthread_kill(thread, urgent)
            pause = 0.5  # then again, because the model may swallow it

    watcher = threading.Thread(target=watch, daemon=True, name="time limit of a check")
    handler = None if urgent is None else signal.signal(urgent, _raise_limit)
    try:
        watcher.start()
        function()
    finally:
        # The watcher may still raise until it has ended, and Python delivers that soon after. (It
        # is not revoked, because in CPython the interpreter would check for it forever.)
        while True:
            try:
                over.set()
                watcher.join()
                for _ in range(10):
                    pass
                if urgent is not None:
                    signal.signal(urgent, handler or signal.SIG_DFL)
                break
            except LimitReached:
                continue


# -- global generators ----------------------------------------------------------------------------

_GENERATORS: Final = {"random": "Python's random", "numpy.random": "numpy.random"}
"""The names of global generators in findings."""


@contextmanager
def silence() -> Iterator[list[warnings.WarningMessage]]:
    """Silence a model, and restore the global generators at the end.

    Yields:
        The warnings that are findings, a list that grows.
    """
    output = io.StringIO()
    with (
        outside_simulation(),
        preserve_generators(),
        warnings.catch_warnings(record=True) as records,
        redirect_stdout(output),
        redirect_stderr(output),
    ):
        warnings.simplefilter("ignore")
        for pattern in WARNINGS:
            warnings.filterwarnings("always", f".*{pattern}")
        yield records


# -- runs -----------------------------------------------------------------------------------------


class Run:
    """The record of a run.

    Attributes:
        simulation: The simulation; of a plain run, from its main loop on.
        calls: The name of the decision point, or of the agent, of each step.
        parts: The fingerprint of the steps (the decisions of the rules, or the results of
            ``last()``), and of the simulation at the end or at the limit of decisions.
        results: The agents in an episode of random actions, the numbers of their earlier decisions,
            and the results of ``last()``.
        actions: Those actions.
        in_main_loop: Whether a plain run is in the main loop of the simulation.
        is_cut: Whether the run has reached the limit of decisions.
        end: "terminated" or "truncated".
        error: The exception that ended the run, unless the limit of decisions did.
        step_began: The time at which the last step began.
        draws: The global generators that the run has used, by name.
        early: The places where a plain run called decision points before its main loop, by name.
        times: The times of the simulation at its steps, if it has a clock.
    """

    def __init__(self, state_of: Callable[[Model], Model] | None = None) -> None:
        """Begin the record.

        Args:
            state_of: A function of the simulation whose results are compared. None: the ``state()``
                of the simulation, or else all its attributes.
        """
        self.state_of = state_of
        self.simulation: Model = None
        self.calls: list[str] = []
        self.parts: Fingerprint = {}
        self.results: list[tuple[Agent, int, StepResult]] = []
        self.actions: list[Action] = []
        self.in_main_loop = False
        self.is_cut = False
        self.end = "terminated"
        self.error: BaseException | None = None
        self.draws: set[str] = set()
        self.early: dict[str, str] = {}
        self.times: list[float] = []
        self.step_began = time.monotonic()

    def play(
        self,
        function: Callable[[], object],
        seconds: float,
        seed: int = 0,
    ) -> Run:
        """Call a function within a time limit; record its error and draws, and return the record.

        The global generators are seeded first.
        """
        GlobalRandom.begin(seed)
        states = global_states()
        try:
            call_within(seconds, function)
        except (Exception, SystemExit, LimitReached) as error:
            if not self.is_cut:
                self.error = error
        for name, state in global_states().items():
            if state != states[name]:
                self.draws.add(_GENERATORS[name])
        return self

    def run_main_loop(self, simulation: Model) -> None:
        """Run the main loop of a simulation, and record its end and its fingerprint."""
        self.simulation = simulation
        self.in_main_loop = True
        self.end = "truncated" if simulation.run() is TRUNCATED else "terminated"
        self.in_main_loop = False
        self.parts |= self.look()

    def play_rules(self, env: Any, seed: int) -> None:
        """Play an episode of an environment with ``RULE`` throughout."""
        self.simulation = env.simulation
        env.reset(seed=seed)
        while not env.episode.over:
            env.step(RULE)
        self.parts |= self.look()

    def play_randomly(
        self,
        env: SimulationAECEnv,
        seed: int,
        drawn: int = 1,
    ) -> Iterator[None]:
        """Play an episode with random legal actions, and yield before each step.

        The last of ``drawn`` random actions is used at each step; without any, ``RULE``.
        """
        env.reset(seed=seed)  # which also seeds the spaces of the actions
        self.simulation = env.simulation
        for name in env.agent_iter():
            result = env.last()
            _, _, terminated, truncated, info = result
            agent = env.episode.agents.get(name) or env.episode.ended[name]
            self.results.append((agent, agent.answered, result))
            self.parts |= fingerprint(self.begin_step(name), result)
            self.end = "truncated" if truncated else "terminated"
            action = None
            if not (terminated or truncated):
                action = RULE
                for _ in range(drawn):
                    action = env.action_space(name).sample(info.get(MASK))
                self.actions.append(action)
                # It raises an error if labels do not fit, and so does the display.
                _ = agent.describe(seed, Where.USER).display
            yield
            env.step(action)

    # -- plain runs -------------------------------------------------------------------------------

    def decide(self, hook: Hook, args: Args, kwargs: Kwargs) -> Model:
        """Let the rule decide in a plain run."""
        return hook.function(*args, **kwargs)

    @coroutine
    def follow(self, hook: Hook, step: str, rule: Rule) -> Rule:
        """Follow the rule of a generator or coroutine function, and record its result."""
        return self.end_step(step, (yield from rule))

    def begin_step(self, name: str) -> str:
        """Record the call of a decision point or agent; return the name of its step."""
        self.calls.append(name)
        self.step_began = time.monotonic()
        step = f"{STEP} {len(self.calls)}, {name}"
        self.parts[step] = "without a result"
        clock = optional_method(self.simulation, "time")
        if clock is not None:
            self.times.append(float(clock()))
        return step

    def end_step(self, step: str, value: Model) -> Model:
        """Record the result of a step, and return it."""
        self.parts |= fingerprint(step, value, follow=False)
        return value

    def look(self) -> Fingerprint:
        """Return the fingerprint of the simulation."""
        with outside_simulation():  # decision functions run their rule here
            simulation = self.simulation
            state = optional_method(simulation, "state")
            if self.state_of is not None:
                return fingerprint("fingerprint", self.state_of(simulation))
            if state is not None:
                return fingerprint("state()", state())
            return fingerprint("simulation", simulation)

    def stop(self) -> NoReturn:
        """Stop the run at the limit of decisions, as often as the model swallows the exit."""
        if not self.is_cut:
            self.is_cut = True
            self.parts |= self.look()
        raise LimitReached


@dataclass
class Runner:
    """A simulation with its decision points, and the limits of its runs.

    Attributes:
        make_plan: Makes the plan. It may call the simulation's constructor.
        max_steps: The limit of decisions in a run.
        seconds: The time limit of a run.
        state_of: As for ``Run``.
    """

    make_plan: Callable[[], Plan]
    max_steps: int
    seconds: float
    state_of: Callable[[Model], Model] | None

    @cached_property
    def plan(self) -> Plan:
        """The simulation with its decision points and options."""
        return self.make_plan()

    def make_environment(self, view: str, **options: Any) -> Any:
        """Make an environment with changed options."""
        if view not in ("joint", "turn"):  # the others refuse these options
            options |= {"flatten": False, "state_in_info": False}
        plan = self.plan.amended(options)
        return VIEWS[view](plan)

    def refused_views(self) -> dict[str, str]:
        """Return the reasons why the plan does not allow a view, by view."""
        refused = {}
        for view in VIEWS:
            try:
                self.make_environment(view).close()
            # The view may refuse the plan, or reset the model, which may raise anything.
            except Exception as error:
                refused[view] = error_text(error)
        return refused

    def run_plainly(self, seed: int, global_seed: int | None = None, run: Run | None = None) -> Run:
        """Run the simulation's own loop, with the plan's handlers and generators.

        Records the decisions of the rules, in a new ``run`` if none is given. The global generators
        get the same seed, or ``global_seed``.
        """
        played = run or Run(self.state_of)

        def start() -> None:
            rng = GlobalRandom() if self.plan.options.global_rng else None
            installation = Installation(self.plan.patches)
            try:
                with environment_context(self.plan.plugins, rng):
                    simulation = make_simulation(self.plan.subject.source)
                    if rng is not None:
                        rng.begin(seed)
                    passing(simulation.reset, "seed", "options")(seed=seed, options=None)
                    played.run_main_loop(simulation)
            finally:
                installation.uninstall()

        return self.record_rules(played, start, seed if global_seed is None else global_seed)

    def record_rules(self, run: Run, start: Callable[[], object], seed: int) -> Run:
        """Play a run by a function, and record the decisions of the rules."""
        hooks = {point.hook for point in self.plan.points}
        for hook in hooks:
            hook.replace_rule(self._recording_rule(hook, run))
        try:
            return run.play(start, self.seconds, seed)
        finally:
            for hook in hooks:
                hook.replace_rule()

    def _recording_rule(self, hook: Hook, run: Run) -> Callable[..., Model]:
        """Return a rule that records its decisions, and stops the run at the limit."""

        def decide(*args: Model, **kwargs: Model) -> Model:
            stack = stack_of(getcurrent())
            # Calls in a reset or a mapping are no decisions.
            if not (run.in_main_loop if stack is None else stack.events):
                if run.simulation is None:
                    run.early[hook.name] = _innermost(traceback.extract_stack(), _PACKAGE)
                return hook.function(*args, **kwargs)
            if len(run.calls) >= self.max_steps:
                run.stop()
            step = run.begin_step(hook.name)
            value = run.decide(hook, args, kwargs)
            if hook.kind == "function":
                return run.end_step(step, value)
            rule = value.__await__() if hook.kind == "coroutine" else value
            return run.follow(hook, step, rule)

        return decide

    def run_randomly(
        self,
        env: SimulationAECEnv,
        seed: int,
        *,
        drawn: int = 1,
        beside: SimulationAECEnv | None = None,
    ) -> Run:
        """Play an episode with random legal actions.

        Args:
            env: The environment.
            seed: The seed of the episode and its actions.
            drawn: Another number gives other actions with the same seed; 0 gives ``RULE``.
            beside: Another environment, which is stepped in turns with this one.
        """
        run = Run()

        def start() -> None:
            other = iter(()) if beside is None else Run().play_randomly(beside, seed + 1)
            for _ in run.play_randomly(env, seed, drawn):
                next(other, None)

        return run.play(start, self.seconds, seed)

    def sources_of_chance(self, seed: int) -> str:
        """Return where a plain run uses clocks, entropy and the global generators; or nothing."""
        places: dict[str, None] = {}

        def profile(frame: FrameType, event: str, function: object) -> None:
            source = _CHANCE.get(function) if event == "c_call" else None
            if frame.f_code is random.Random.seed.__code__ and frame.f_locals.get("a", 0) is None:
                source = "a random.Random is made without a seed"
            if source:
                place = _innermost(traceback.extract_stack(frame), _LIBRARY)
                if not place.startswith(_PACKAGE):
                    places[f"{source} at {place}"] = None

        before = sys.getprofile()
        sys.setprofile(profile)
        try:
            self.run_plainly(seed)
        finally:
            sys.setprofile(before)
        return f"\nin the model, {'; '.join([*places][:3])}" if places else ""


# -- where errors and differences come from -------------------------------------------------------

_PACKAGE: Final = __file__.rpartition("testing")[0]
_LIBRARY: Final = random.__file__.rpartition("random.py")[0]
_CHANCE: Final[dict[object, str]] = {
    time.time: "the clock is read (time)",
    time.time_ns: "the clock is read (time_ns)",
    time.monotonic: "the clock is read (monotonic)",
    time.perf_counter: "the clock is read (perf_counter)",
    datetime.now: "the clock is read (now)",
    date.today: "the clock is read (today)",
    random.random: "Python's global generator is used",
    random.getrandbits: "Python's global generator is used",
    os.urandom: "the operating system is asked for random bits (as by a generator without a seed)",
}
"""Builtin functions that are sources of chance."""


def _innermost(frames: Iterable[traceback.FrameSummary], folder: str) -> str:
    """Return the place of the last frame outside a folder; empty if there is none."""
    places = [
        f"{frame.filename}:{frame.lineno}, in {frame.name}"
        for frame in frames
        if not frame.filename.startswith((folder, "<"))
    ]
    return places[-1] if places else ""


def place_of(error: BaseException) -> str:
    """Return the place in the user's code that raised an error; empty if there is none."""
    frames = traceback.extract_tb(error.__traceback__)
    return _innermost((each for each in frames if "site-packages" not in each.filename), _PACKAGE)


def describe_with_place(error: BaseException) -> str:
    """Describe an error by its class, the beginning of its text, its place, and our notes."""
    text = shorten(describe_error(error), 400, placeholder=" ...")
    place = place_of(error)
    notes = "".join(f"\n{note.removeprefix('simenv_marl: ')}" for note in error_notes(error)[:2])
    return f"{text} ({place}){notes}" if place else text + notes
