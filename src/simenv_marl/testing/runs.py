"""Runs of a simulation: plain runs, runs with RULE throughout, and episodes of random actions.

Every run has an end. At the limit of decisions, the next decision raises an exit. At the time
limit, the Python code that is running raises one.
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
import warnings
from collections.abc import (
    Callable,
    Generator,
    Iterable,
    Iterator,
)
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from datetime import date, datetime
from itertools import islice
from textwrap import shorten
from types import FrameType, coroutine
from typing import Any, Final, NoReturn

import numpy as np
from greenlet import getcurrent

from ..core import (
    MASK,
    Agent,
    GlobalRandom,
    LoopExit,
    Plan,
    environment_context,
    global_states,
    preserve_generators,
)
from ..envs import SimulationAECEnv
from ..errors import describe_error, error_notes
from ..hooks.handlers import Installation
from ..hooks.hook import Hook
from ..hooks.stacks import outside_simulation, stack_of
from ..simulation import (
    RULE,
    TRUNCATED,
    Action,
    Model,
    Observation,
    make_simulation,
    resetter,
)
from .fingerprint import (
    Difference,
    Fingerprint,
    describe_differences,
    differences,
    fingerprint,
)

Step = tuple[Observation, float, bool, bool, dict[str, Any]]
"""The result of ``last()``: observation, reward, terminated, truncated, info."""

_WARNINGS: Final = ("refuses to end", "several objects decide at", "did not appear in the episode")
"""Texts of the warnings that are findings."""


class LimitReached(LoopExit):
    """Ends a run that has reached its limit of decisions or of time."""


def call_within(seconds: float, function: Callable[[], object]) -> None:
    """Call a function, and raise ``LimitReached`` in it after a time.

    This interrupts Python code. Waiting outside of Python (in a sleep, for example) is interrupted
    when it returns.
    """
    thread = threading.get_ident()
    over = threading.Event()

    def watch() -> None:
        pause = seconds
        while not over.wait(pause):
            ctypes.pythonapi.PyThreadState_SetAsyncExc(
                ctypes.c_ulong(thread), ctypes.py_object(LimitReached)
            )
            pause = 0.5  # then again, because the model may swallow it

    watcher = threading.Thread(target=watch, daemon=True, name="time limit of a check")
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
                break
            except LimitReached:
                continue


# -- global generators ----------------------------------------------------------------------------

_GENERATORS: Final = {"random": "Python's random", "numpy.random": "numpy.random"}
"""The names of global generators in findings."""


def seed_global_generators(seed: int) -> None:
    """Seed Python's and NumPy's global generators, to compare runs that draw from them."""
    random.seed(seed)
    np.random.seed(seed % 2**32)


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
        for pattern in _WARNINGS:
            warnings.filterwarnings("always", f".*{pattern}")
        yield records


# -- runs -----------------------------------------------------------------------------------------


class Run:
    """The record of a run.

    Attributes:
        simulation: The simulation; of a plain run, from its main loop on.
        calls: The name of the decision point, or of the agent, of each step.
        steps: The decisions of the rules, or the results of ``last()``, as a fingerprint.
        results: The agents and results of ``last()`` in an episode of random actions.
        actions: Those actions.
        fingerprint: The fingerprint of the simulation at the end, or at the limit of decisions.
        in_main_loop: Whether a plain run is in the main loop of the simulation.
        is_cut: Whether the run has reached the limit of decisions.
        end: "terminated" or "truncated".
        error: The exception that ended the run.
        is_stuck: Whether the last step began long before that exception.
        draws: The global generators that the run has used, by name.
    """

    def __init__(
        self, simulation: Model = None, state_of: Callable[[Model], Model] | None = None
    ) -> None:
        """Begin the record.

        Args:
            simulation: The simulation, if there is one already.
            state_of: A function of the simulation whose results are compared. None: the ``state()``
                of the simulation, or else all its attributes.
        """
        self.simulation = simulation
        self._state_of = state_of
        self.calls: list[str] = []
        self.steps: Fingerprint = {}
        self.results: list[tuple[Agent, Step]] = []
        self.actions: list[Action] = []
        self.fingerprint: Fingerprint = {}
        self.in_main_loop = False
        self.is_cut = False
        self.end = "terminated"
        self.error: BaseException | None = None
        self.is_stuck = False
        self.draws: set[str] = set()
        self._step_began = time.monotonic()

    def run_main_loop(self, simulation: Model) -> None:
        """Run the main loop of a simulation, and record its end and its fingerprint."""
        self.simulation = simulation
        self.in_main_loop = True
        self.end = "truncated" if simulation.run() is TRUNCATED else "terminated"
        self.in_main_loop = False
        self.take_fingerprint()

    def begin_step(self, name: str) -> str:
        """Record the call of a decision point or agent; return the name of its step."""
        self.calls.append(name)
        self._step_began = time.monotonic()
        step = f"in step {len(self.calls)}, {name}"
        self.steps[step] = "without a result"
        return step

    def end_step(self, step: str, value: Model) -> Model:
        """Record the result of a step, and return it."""
        self.steps |= fingerprint(step, value, follow=False)
        return value

    def add_result(self, agent: Agent, result: Step) -> None:
        """Record a step of an agent with its result of ``last()``."""
        self.results.append((agent, result))
        self.steps |= fingerprint(self.begin_step(agent.name), result)
        self.end = "truncated" if result[3] else "terminated"

    def take_fingerprint(self) -> None:
        """Record the fingerprint of the simulation."""
        with outside_simulation():  # decision functions run their rule here
            state = getattr(self.simulation, "state", None)
            if self._state_of is not None:
                self.fingerprint = fingerprint("fingerprint", self._state_of(self.simulation))
            elif callable(state):
                self.fingerprint = fingerprint("state()", state())
            else:
                self.fingerprint = fingerprint("simulation", self.simulation)

    def stop(self) -> NoReturn:
        """Stop the run at the limit of decisions, as often as the model swallows the exit."""
        if not self.is_cut:
            self.is_cut = True
            self.take_fingerprint()
        raise LimitReached

    def fail(self, error: BaseException, seconds: float = math.inf) -> None:
        """Record an exception of a run with a time limit; ignore it at the limit of decisions."""
        if not self.is_cut:
            self.error = error
            self.is_stuck = time.monotonic() - self._step_began > seconds / 2

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
    """A simulation with its decision points, the limits of its runs, and the results so far.

    Attributes:
        plan: The simulation with its decision points and options.
        max_steps: The limit of decisions in a run.
        seconds: The time limit of a run.
        state_of: As for ``Run``.
        seeds: The seeds of plain runs.
        episode_seeds: The seeds of episodes of random actions.
        deadline: The end of the time limit for all checks, as ``time.monotonic()``.
        plain_runs: The plain runs by seed.
        draws: The global generators that the simulation uses, by name.
        unstable: Parts of the fingerprint that are not compared.
        views: The views that the plan allows. Empty if plain runs fail or decide nothing.
    """

    plan: Plan
    max_steps: int
    seconds: float
    state_of: Callable[[Model], Model] | None = None
    seeds: list[int] = field(default_factory=list)
    episode_seeds: Iterable[int] = ()
    deadline: float = math.inf
    plain_runs: dict[int, Run] = field(default_factory=dict)
    draws: set[str] = field(default_factory=set)
    unstable: set[str] = field(default_factory=set)
    views: list[str] = field(default_factory=list)

    @property
    def is_late(self) -> bool:
        """Whether the time is up."""
        return time.monotonic() >= self.deadline

    def differences(self, run: Run, other: Run) -> list[Difference]:
        """Return the differences between the simulations after two runs."""
        return differences(run.fingerprint, other.fingerprint, self.unstable)

    def record(
        self,
        function: Callable[[], object],
        seed: int = 0,
        run: Run | None = None,
    ) -> Run:
        """Call a function within the time limit, and record its error and draws.

        The global generators are seeded first.
        """
        run = run or Run()
        seed_global_generators(seed)
        states = global_states()
        try:
            call_within(self.seconds, function)
        except (Exception, SystemExit, LimitReached) as error:
            run.fail(error, self.seconds)
        for name, state in global_states().items():
            if state != states[name]:
                run.draws.add(_GENERATORS[name])
        return run

    def run_plainly(self, seed: int, global_seed: int | None = None) -> Run:
        """Run the simulation's own loop, with the plan's handlers and generators.

        Records the decisions of the rules. The global generators get the same seed, or
        ``global_seed``.
        """
        run = Run(None, self.state_of)

        def start() -> None:
            rng = GlobalRandom() if self.plan.options.global_rng else None
            installation = Installation(self.plan.patches)
            try:
                with environment_context(self.plan.plugins, rng):
                    simulation = make_simulation(self.plan.subject.source)
                    if rng is not None:
                        rng.begin(seed)
                    resetter(simulation)(seed, None)
                    run.run_main_loop(simulation)
            finally:
                installation.uninstall()

        return self._record_rules(run, start, seed if global_seed is None else global_seed)

    def run_rules(self, env: Any, seed: int) -> Run:
        """Run an environment of any view with ``RULE`` throughout, and record the rules."""
        run = Run(env.simulation, self.state_of)

        def start() -> None:
            env.reset(seed=seed)
            if hasattr(env, "agents"):
                while env.agents:
                    env.step(RULE)
            else:
                while not any(env.step(RULE)[2:4]):
                    pass
            run.take_fingerprint()

        return self._record_rules(run, start, seed)

    def _record_rules(
        self,
        run: Run,
        start: Callable[[], None],
        seed: int,
    ) -> Run:
        """Play a run, and record the decisions of the rules."""
        hooks = {point.hook for point in self.plan.points}
        for hook in hooks:
            hook.replace_rule(self._recording_rule(hook, run))
        try:
            return self.record(start, seed, run)
        finally:
            for hook in hooks:
                hook.replace_rule()

    def _recording_rule(self, hook: Hook, run: Run) -> Callable[..., Model]:
        """Return a rule that records its decisions, and stops the run at the limit."""

        def decide(*args: Model, **kwargs: Model) -> Model:
            stack = stack_of(getcurrent())
            # Calls in a reset or a mapping are no decisions.
            if not (run.in_main_loop if stack is None else stack.events):
                return hook.function(*args, **kwargs)
            if len(run.calls) >= self.max_steps:
                run.stop()
            step = run.begin_step(hook.name)
            value = hook.function(*args, **kwargs)
            if hook.kind == "function":
                return run.end_step(step, value)
            return wait(step, value.__await__() if hook.kind == "coroutine" else value)

        @coroutine
        def wait(step: str, rule: Generator[Model, Model, Model]) -> Generator[Model, Model, Model]:
            return run.end_step(step, (yield from rule))

        return decide

    def run_randomly(
        self,
        env: SimulationAECEnv,
        seed: int,
        *,
        salt: int = 0,
        most: int | None = None,
        beside: SimulationAECEnv | None = None,
    ) -> Run:
        """Play an episode with random legal actions.

        Args:
            env: The environment.
            seed: The seed of the episode and its actions.
            salt: Another salt gives other actions with the same seed.
            most: The number of steps after which the episode is broken off.
            beside: Another environment, which is stepped in turns with this one.
        """
        run = Run()

        def start() -> None:
            other = iter(()) if beside is None else _random_steps(Run(), beside, seed + 1, salt)
            for _ in islice(_random_steps(run, env, seed, salt), most):
                next(other, None)

        return self.record(start, seed, run)

    def sources_of_chance(self) -> str:
        """Return where a plain run uses clocks, entropy and the global generators; or nothing."""
        places: list[str] = []

        def profile(frame: FrameType, event: str, function: object) -> None:
            source = _CHANCE.get(function) if event == "c_call" else None
            if frame.f_code is random.Random.seed.__code__ and frame.f_locals.get("a", 0) is None:
                source = "a random.Random is made without a seed"
            caller: FrameType | None = frame if source else None
            while caller is not None and caller.f_code.co_filename.startswith((_LIBRARY, "<")):
                caller = caller.f_back
            if caller is not None and not caller.f_code.co_filename.startswith(_PACKAGE):
                file, name = caller.f_code.co_filename, caller.f_code.co_name
                places.append(f"{source} at {file}:{caller.f_lineno}, in {name}")

        before = sys.getprofile()
        sys.setprofile(profile)
        try:
            self.run_plainly(self.seeds[0])
        finally:
            sys.setprofile(before)
        texts = list(dict.fromkeys(places))
        return f"\nin the model, {'; '.join(texts[:3])}" if texts else ""


def _random_steps(
    run: Run,
    env: SimulationAECEnv,
    seed: int,
    salt: int,
) -> Iterator[None]:
    """Play an episode, record it, and yield before each step."""
    env.reset(seed=seed)
    for name in env.agent_iter():
        step = env.last()
        _, _, terminated, truncated, info = step
        run.add_result(env.episode.agents.get(name) or env.episode.ended[name], step)
        action = None
        if not (terminated or truncated):
            for _ in range(1 + salt):  # the reset has seeded the space
                action = env.action_space(name).sample(info.get(MASK))
            run.actions.append(action)
        yield
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
_CHANCE: Final[dict[object, str]] = {
    **{clock: f"the clock is read ({clock.__name__})" for clock in _CLOCKS},
    **dict.fromkeys((random.random, random.getrandbits), "Python's global generator is used"),
    os.urandom: "the operating system is asked for random bits (as by a generator without a seed)",
}
"""Builtin functions that are sources of chance."""


def place_of(error: BaseException) -> str:
    """Return the place in the user's code that raised an error; empty if there is none."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if not frame.filename.startswith((_PACKAGE, "<")) and "site-packages" not in frame.filename:
            return f"{frame.filename}:{frame.lineno}, in {frame.name}"
    return ""


def describe_with_place(error: BaseException) -> str:
    """Describe an error by its class, the beginning of its text, its place, and our notes."""
    text = shorten(describe_error(error), 400, placeholder=" ...")
    place = place_of(error)
    notes = "".join(f"\n{note.removeprefix('simenv_marl: ')}" for note in error_notes(error)[:2])
    return f"{text} ({place}){notes}" if place else text + notes
