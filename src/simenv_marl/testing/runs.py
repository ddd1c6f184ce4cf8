"""Recorded runs of a simulation: plain runs, runs with RULE throughout, and episodes of random actions.

Every run has an end, whatever the model does. At its limit of decisions, an exit is raised at the next decision. When
its time is up, an exit is raised in whatever Python code the model is executing.
"""

from __future__ import annotations

import copy
import ctypes
import io
import random
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar
from zlib import crc32

import numpy as np

from ..errors import error_text
from ..simulation import RULE
from .fingerprint import Difference, Fingerprint, alike, brief, describe_differences, fingerprint
from .internals import MASK, Plan, SimulationExit, outside_simulation, set_up, watching_rules

Result = TypeVar("Result")


class Cut(SimulationExit):
    """Raised in a run that has reached its limit of decisions."""


class TimeUp(SimulationExit):
    """Raised in a run whose time is up."""


def within(seconds: float, function: Callable[[], Result]) -> Result:
    """Call a function, and raise ``TimeUp`` in it when the time is up.

    This interrupts Python code. Waiting outside of Python (in a sleep, for example) is interrupted when it returns.
    """
    deadline = time.monotonic() + seconds
    thread, over = threading.get_ident(), threading.Event()

    def watch() -> None:
        pause = deadline - time.monotonic()
        while not over.wait(max(0.0, pause)):
            ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), ctypes.py_object(TimeUp))
            pause = 0.5  # raise it again in a model that swallows it

    watcher = threading.Thread(target=watch, daemon=True, name="time limit of a check")
    try:
        watcher.start()
        return function()
    finally:
        # TimeUp may still be raised until the watcher has ended, and is then delivered at once. (It is not revoked: in
        # CPython that would leave the interpreter checking for it forever.)
        while True:
            try:
                over.set()
                watcher.join()
                for _ in range(10):
                    pass
                break
            except TimeUp:
                continue


# -- global generators ----------------------------------------------------------------------------


def seed_global_generators(seed: int) -> None:
    """Seed Python's and NumPy's global generators, so that runs of a model that draws from them can be compared."""
    random.seed(seed)
    np.random.seed(seed % 2**32)


def global_generators() -> dict[str, Any]:
    """Return the states of both."""
    return {"Python's random": random.getstate(), "numpy.random": np.random.get_state(legacy=False)}


def drawn_since(states: dict[str, Any]) -> set[str]:
    """Return the names of the global generators whose states have changed."""
    return {name for name, state in global_generators().items() if not alike(state, states[name])}


@contextmanager
def quietly() -> Iterator[list[warnings.WarningMessage]]:
    """Ignore what a model prints, and its warnings; leave the global generators as they were.

    Yields:
        The warnings for which a filter was added.
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
            yield caught
    finally:
        random.setstate(states["Python's random"])
        np.random.set_state(states["numpy.random"])


# -- runs -----------------------------------------------------------------------------------------


@dataclass
class Step:
    """What an agent got at its turn."""

    observation: Any
    reward: float
    terminated: bool
    truncated: bool
    info: dict[str, Any]


@dataclass
class Run:
    """What is recorded of a run.

    Its entries are the decisions in plain runs and with RULE (the point's name, and what its rule returned), and the
    steps in episodes of random actions (the agent's name, and a ``Step``).
    """

    entries: list[tuple[str, Any]] = field(default_factory=list)
    actions: list[Any] = field(default_factory=list)  # the random ones
    simulation: Any = None
    fingerprint: Fingerprint | None = None  # of the simulation at its end, or when it was cut
    cut: bool = False  # whether it has reached its limit of decisions
    error: BaseException | None = None
    result: Any = None  # what the simulation's run() returned, in a plain run
    drawn: set[str] = field(default_factory=set)  # the global generators from which it has drawn
    seconds: float = 0.0
    latest: float = field(default_factory=time.monotonic)  # the time of the latest step

    @property
    def calls(self) -> list[str]:
        """The names of the points that were called, in that order."""
        return [name for name, _ in self.entries]

    def play(self, seconds: float, function: Callable[[], Any]) -> Run:
        """Call a function that plays this run; record its error and the global generators."""
        states = global_generators()
        try:
            within(seconds, function)
        except (Exception, SystemExit) as error:
            if not self.cut:
                self.error = error
        self.drawn = drawn_since(states)
        return self

    def difference(self, other: Run, here: str = "first", there: str = "then") -> str:
        """Describe the first difference from the entries of another run; empty if there is none."""
        pairs = zip(self.entries, other.entries, strict=False)
        for number, ((name, value), (other_name, other_value)) in enumerate(pairs, 1):
            if name != other_name:
                return f"step {number} is {here} of {name}, {there} of {other_name}"
            parts = fingerprint(name, value).differences(fingerprint(name, other_value))
            if parts:
                return f"in step {number}, {describe_differences(parts, here, there)}"
        if other.error is not None:
            return f"the second one raises {describe_with_place(other.error)}"
        if len(self.entries) != len(other.entries):
            return f"there are {here} {len(self.entries)} steps, {there} {len(other.entries)}"
        return ""


@dataclass(kw_only=True)
class Runner:
    """Runs a simulation in different ways, within a number of decisions and of seconds."""

    plan: Plan
    max_steps: int
    seconds: float
    own: Callable[[Any], Any] | None = None  # the user's callable by which simulations are compared
    unstable: frozenset[str] = frozenset()  # parts that are not compared

    def look(self, simulation: Any) -> Fingerprint:
        """Return the fingerprint of a simulation: of the user's callable, of its ``state()``, or of its attributes."""
        with outside_simulation():  # decision functions called there run their rule
            if self.own is not None:
                return fingerprint("fingerprint", self.own(simulation))
            state = getattr(simulation, "state", None)
            return fingerprint("state()", state()) if callable(state) else fingerprint("simulation", simulation)

    def differences(self, run: Run, other: Run) -> list[Difference]:
        """Return the parts in which the simulations differ after two runs."""
        if run.fingerprint is None or other.fingerprint is None:
            return []
        return run.fingerprint.differences(other.fingerprint, self.unstable)

    def run_plainly(self, seed: int) -> Run:
        """Run the simulation's own loop; only the results of its rules are recorded."""
        run = Run()

        def start() -> None:
            with set_up(self.plan, seed) as (simulation, main):
                run.simulation, begun = simulation, time.perf_counter()
                run.result = main()
                run.seconds = time.perf_counter() - begun
                run.fingerprint = self.look(simulation)

        return self._record(run, start)

    def run_rules(self, env: Any, seed: int) -> Run:
        """Run an environment of any view with ``RULE`` throughout; the results of rules are recorded."""
        run = Run(simulation=env.simulation)

        def start() -> None:
            begun = time.perf_counter()
            play_rules(env, seed)
            run.seconds = time.perf_counter() - begun
            run.fingerprint = self.look(run.simulation)

        return self._record(run, start)

    def _record(self, run: Run, start: Callable[[], None]) -> Run:
        """Record the decisions of a run, and cut it at the limit."""

        def begin(name: str) -> Callable[[Any], None]:
            place = len(run.entries)
            if place >= self.max_steps:
                if not run.cut:
                    run.cut, run.fingerprint = True, self.look(run.simulation)
                raise Cut
            run.entries.append((name, "left without a decision"))

            def end(value: Any) -> None:
                run.entries[place] = name, brief(value)

            return end

        with watching_rules(self.plan, begin):
            return run.play(self.seconds, start)

    def run_randomly(self, *games: tuple[Any, int], salt: int = 0) -> list[Run]:
        """Play episodes with random legal actions, in turns; each in an AEC environment and with a seed.

        The actions depend on seed, agent and salt alone. An error is that of the last run.
        """
        runs = [Run() for _ in games]

        def start() -> None:
            left = [_random_steps(run, env, seed, salt) for run, (env, seed) in zip(runs, games, strict=True)]
            while left:
                left = [steps for steps in left if next(steps, False)]

        seed_global_generators(games[0][1])
        runs[-1].play(self.seconds, start)
        return runs

    def sources_of_chance(self, seed: int) -> list[str]:
        """Run the simulation, and find its sources of chance: clocks, entropy, global generators.

        Returns:
            Each as the end of a sentence, with the place of the call.
        """
        found: dict[str, None] = {}

        def profile(frame: Any, event: str, argument: Any) -> None:
            source = _source_of_chance(frame, event, argument)
            place = _caller(frame) if source else None
            if place:
                found[f"{source} at {place}"] = None

        before = sys.getprofile()
        sys.setprofile(profile)
        try:
            self.run_plainly(seed)
        finally:
            sys.setprofile(before)
        return list(found)


def play_rules(env: Any, seed: int, selected: dict[str, None] | None = None) -> None:
    """Play an episode in any view with ``RULE`` throughout; collect the agents that the AEC view selects."""
    env.reset(seed=seed)
    if not hasattr(env, "agents"):
        while not any(env.step(RULE)[2:4]):
            pass
        return
    while env.agents:
        if not hasattr(env, "agent_selection"):
            env.step(RULE)
            continue
        agent = env.agent_selection
        if selected is not None:
            selected[agent] = None
        env.step(None if env.terminations[agent] or env.truncations[agent] else RULE)


def _random_steps(run: Run, env: Any, seed: int, salt: int) -> Iterator[bool]:
    """Play one step at a time, and record it."""
    env.reset(seed=seed)
    spaces: dict[str, Any] = {}
    while env.agents:
        agent = env.agent_selection
        step, action = Step(*env.last()), None
        run.entries.append((agent, step))
        run.latest = time.monotonic()
        if not (step.terminated or step.truncated):
            if agent not in spaces:
                spaces[agent] = copy.deepcopy(env.action_space(agent))
                spaces[agent].seed(crc32(f"{seed} {agent} {salt}".encode(errors="surrogatepass")))
            action = spaces[agent].sample(step.info.get(MASK))
            run.actions.append(action)
        yield True
        env.step(action)


# -- where errors and differences come from -------------------------------------------------------

_PACKAGE: Final = __file__.rpartition("testing")[0]
_LIBRARY: Final = random.__file__.rpartition("random.py")[0]
_CLOCKS: Final = {"time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "process_time"}


def place_of(error: BaseException) -> str:
    """Return where an error was raised, outside of this library: file, line and function; empty if nowhere."""
    places = [
        f"{frame.filename}:{frame.lineno}, in {frame.name}"
        for frame in traceback.extract_tb(error.__traceback__)
        if not frame.filename.startswith((_PACKAGE, "<")) and "site-packages" not in frame.filename
    ]
    return places[-1] if places else ""


def describe_with_place(error: BaseException) -> str:
    """Describe an error: its class, the beginning of its text, and where it was raised."""
    text, place = " ".join(error_text(error).split()), place_of(error)
    text = text if len(text) <= 400 else f"{text[:396]} ..."
    return f"{type(error).__name__}: {text}" + (f" ({place})" if place else "")


def _source_of_chance(frame: Any, event: str, function: Any) -> str:
    """Describe the source of chance that a call uses, as a profiler sees it; empty if it uses none."""
    if event == "call" and frame.f_code is random.Random.seed.__code__ and frame.f_locals.get("a", 0) is None:
        return "a random.Random is made without a seed"
    if event != "c_call":
        return ""
    module, name = getattr(function, "__module__", None), getattr(function, "__name__", "")
    owner = getattr(function, "__self__", None)
    if module == "time" and name in _CLOCKS:
        return f"the clock is read (time.{name})"
    if name in ("now", "utcnow", "today") and getattr(owner, "__module__", "") == "datetime":
        return f"the clock is read (datetime.{name})"
    if name == "urandom":
        return "the operating system is asked for random bits (as by a generator without a seed)"
    if name in ("random", "getrandbits") and owner is getattr(random.random, "__self__", None):
        return "Python's global generator is used"
    return ""


def _caller(frame: Any) -> str:
    """Return the place in the model, or in a package, from which the standard library was called; empty if nowhere."""
    while frame is not None and not frame.f_code.co_filename.startswith(_PACKAGE):
        path = frame.f_code.co_filename
        if ("site-packages" in path or not path.startswith(_LIBRARY)) and not path.startswith("<"):
            return "" if "numpy" in path else f"{path}:{frame.f_lineno}, in {frame.f_code.co_name}"
        frame = frame.f_back
    return ""
