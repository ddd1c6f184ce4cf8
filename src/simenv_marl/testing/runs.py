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
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar
from zlib import crc32

import numpy as np

from ..errors import error_text
from ..simulation import RULE
from .fingerprint import Fingerprint, alike, brief, describe_differences, fingerprint
from .internals import MASK, Plan, SimulationExit, outside_simulation, set_up, watching_rules

Result = TypeVar("Result")


class Cut(SimulationExit):
    """Raised in a run that has reached its limit of decisions."""


class TimeUp(SimulationExit):
    """Raised in a run whose time is up."""


def within(deadline: float, function: Callable[[], Result]) -> Result:
    """Call a function, and raise ``TimeUp`` in it after a deadline, given as ``time.monotonic()``.

    This interrupts Python code. Waiting outside of Python (in a sleep, for example) is interrupted when it returns.

    Raises:
        TimeUp: The function was interrupted, or it was too late to call it.
    """
    if time.monotonic() >= deadline:
        raise TimeUp
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
    """Run a model that may print and warn; the global generators are left as they were.

    Yields:
        The warnings that were not ignored.
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
    """A run, and what it has shown so far.

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

    def play(self, deadline: float, function: Callable[[], None]) -> Run:
        """Call a function that plays this run; note its error and the global generators."""
        states = global_generators()
        try:
            within(deadline, function)
        except (Exception, SystemExit) as error:
            if not self.cut:
                self.error = error
        self.drawn = drawn_since(states)
        return self

    def difference(self, other: Run, here: str = "first", there: str = "then") -> str:
        """Describe the first difference from the entries of another run; empty if there is none."""
        for number, (one, another) in enumerate(zip(self.entries, other.entries, strict=False), 1):
            if one[0] != another[0]:
                return f"step {number} is {here} of {one[0]}, {there} of {another[0]}"
            name, value = one
            parts = fingerprint(name, value).differences(fingerprint(name, another[1]))
            if parts:
                return f"in step {number}, {describe_differences(parts, here, there)}"
        if other.error is not None:
            return f"the second one raises {describe_with_place(other.error)}"
        if len(self.entries) != len(other.entries):
            return f"there are {here} {len(self.entries)} steps, {there} {len(other.entries)}"
        return ""


Look = Callable[[Any], Fingerprint | None]
"""A function that returns the fingerprint of a simulation."""


def _recorder(run: Run, limit: int, look: Look) -> Callable[[str], Callable[[Any], None]]:
    """Return a function that records the decisions of a run, and cuts it at a limit."""

    def begin(name: str) -> Callable[[Any], None]:
        if len(run.entries) >= limit:
            if not run.cut:
                run.cut, run.fingerprint = True, look(run.simulation)
            raise Cut
        place = len(run.entries)
        run.entries.append((name, "left without a decision"))

        def end(value: Any) -> None:
            run.entries[place] = name, brief(value)

        return end

    return begin


def plain_run(plan: Plan, seed: int, limit: int, deadline: float, look: Look) -> Run:
    """Run a simulation's own loop; only the results of its rules are recorded.

    Args:
        plan: The plan of the simulation.
        seed: The seed of the simulation.
        limit: The number of decisions after which it is cut.
        deadline: The time at which it is interrupted.
        look: Returns the fingerprint of the simulation at the end.
    """
    run = Run()

    def play() -> None:
        with set_up(plan, seed) as (simulation, start):
            run.simulation, begun = simulation, time.perf_counter()
            run.result = start()
            run.seconds = time.perf_counter() - begun
            run.fingerprint = look(simulation)

    with watching_rules(plan, _recorder(run, limit, look)):
        return run.play(deadline, play)


def rule_run(plan: Plan, env: Any, seed: int, limit: int, deadline: float, look: Look) -> Run:
    """Run an environment of a plan, of any view, with ``RULE`` throughout; the other arguments as for ``plain_run``."""
    run = Run(simulation=env.simulation)

    def play() -> None:
        begun = time.perf_counter()
        play_rules(env, seed)
        run.seconds = time.perf_counter() - begun
        run.fingerprint = look(run.simulation)

    with watching_rules(plan, _recorder(run, limit, look)):
        return run.play(deadline, play)


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


def random_steps(run: Run, env: Any, seed: int, salt: int = 0) -> Iterator[None]:
    """Play an episode of an AEC environment, one step at a time, with random legal actions.

    The actions depend on seed, agent and salt alone. Steps and actions are recorded in a run.
    """
    env.reset(seed=seed)
    spaces: dict[str, Any] = {}
    while env.agents:
        agent = env.agent_selection
        step = Step(*env.last())
        run.entries.append((agent, step))
        run.latest = time.monotonic()
        action = None
        if not (step.terminated or step.truncated):
            if agent not in spaces:
                spaces[agent] = copy.deepcopy(env.action_space(agent))
                spaces[agent].seed(crc32(f"{seed} {agent} {salt}".encode(errors="surrogatepass")))
            action = spaces[agent].sample(step.info.get(MASK))
            run.actions.append(action)
        yield
        env.step(action)


def play_out(steps: Iterable[Any]) -> None:
    """Play all steps of an episode, or of several in turns."""
    for _ in steps:
        pass


# -- where errors and differences come from -------------------------------------------------------

_PACKAGE: Final = __file__.rpartition("testing")[0]


def place_of(error: BaseException) -> str:
    """Return where an error was raised, outside of this library: file, line and function; empty if nowhere."""
    place, trace = "", error.__traceback__
    while trace is not None:
        code = trace.tb_frame.f_code
        if not code.co_filename.startswith((_PACKAGE, "<")) and "site-packages" not in code.co_filename:
            place = f"{code.co_filename}:{trace.tb_lineno}, in {code.co_name}"
        trace = trace.tb_next
    return place


def describe_with_place(error: BaseException) -> str:
    """Describe an error: its class, the beginning of its text, and where it was raised."""
    text, place = " ".join(error_text(error).split()), place_of(error)
    text = text if len(text) <= 400 else f"{text[:396]} ..."
    return f"{type(error).__name__}: {text}" + (f" ({place})" if place else "")


def sources_of_chance(plan: Plan, seed: int, deadline: float, limit: int) -> list[str]:
    """Run the simulation by itself, and find its sources of chance: clocks, entropy, global generators.

    Returns:
        Each as the end of a sentence, with the place of the call.
    """
    found: dict[str, None] = {}
    library = random.__file__.rpartition("random.py")[0]
    shared: Any = random.random.__self__  # type: ignore[attr-defined]
    clocks = {"time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "process_time"}

    def add(source: str, frame: Any) -> None:
        """Add a source, with the place in the model or a package from which the standard library called it."""
        while frame is not None and not frame.f_code.co_filename.startswith(_PACKAGE):
            path = frame.f_code.co_filename
            if ("site-packages" in path or not path.startswith(library)) and not path.startswith("<"):
                if "numpy" not in path:
                    found[f"{source} at {path}:{frame.f_lineno}, in {frame.f_code.co_name}"] = None
                return
            frame = frame.f_back

    def profile(frame: Any, event: str, argument: Any) -> None:
        if event == "call" and frame.f_code is random.Random.seed.__code__ and frame.f_locals.get("a", 0) is None:
            add("a random.Random is made without a seed", frame.f_back)
        if event != "c_call":
            return
        module, name = getattr(argument, "__module__", None), getattr(argument, "__name__", "")
        owner = getattr(argument, "__self__", None)
        if module == "time" and name in clocks:
            add(f"the clock is read (time.{name})", frame)
        elif name in ("now", "utcnow", "today") and getattr(owner, "__module__", "") == "datetime":
            add(f"the clock is read (datetime.{name})", frame)
        elif name == "urandom":
            add("the operating system is asked for random bits (as by a generator without a seed)", frame)
        elif owner is shared and name in ("random", "getrandbits"):
            add("Python's global generator is used", frame)

    before = sys.getprofile()
    sys.setprofile(profile)
    try:
        plain_run(plan, seed, limit, deadline, lambda simulation: None)
    finally:
        sys.setprofile(before)
    return list(found)
