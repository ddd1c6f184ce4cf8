"""Watched runs of a simulation: plain runs, runs with RULE throughout, and episodes of random actions.

Every run has an end, whatever the model does. At its *limit* of decisions, an exit is raised at the next decision. When
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
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar
from zlib import crc32

import numpy as np

from ..errors import error_text
from ..simulation import RULE
from .fingerprint import Fingerprint, alike, brief, shown
from .inside import MASK, Plan, SimulationExit, make_simulation, outside_simulation, plain_loop, watching_rules


class Cut(SimulationExit):
    """Raised in a run that has reached its limit of decisions."""


class TimeUp(SimulationExit):
    """Raised in a run whose time is up."""


Result = TypeVar("Result")
Look = Callable[[Any], Fingerprint | None]
"""A function that returns the fingerprint of a simulation."""

# -- time -----------------------------------------------------------------------------------------

_AGAIN: Final = 0.5
"""The time in seconds after which the exit is raised again in a model that swallowed it."""


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
            pause = _AGAIN

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


def global_generators() -> tuple[Any, Any]:
    """Return the states of Python's and NumPy's global generators."""
    return random.getstate(), np.random.get_state(legacy=False)


def set_global_generators(states: tuple[Any, Any]) -> None:
    """Restore states that ``global_generators`` returned."""
    random.setstate(states[0])
    np.random.set_state(states[1])


def seed_global_generators(seed: int) -> None:
    """Seed both generators, so that runs of a model that draws from them can be compared."""
    random.seed(seed)
    np.random.seed(seed % 2**32)


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
        set_global_generators(states)


# -- runs of the model's own rules ----------------------------------------------------------------


@dataclass
class Run:
    """The result of a run.

    Attributes:
        decisions: The decisions: the point's name, and what its rule returned.
        fingerprint: What the simulation held at its end, or when it was cut.
        cut: Whether it was cut at its limit.
        error: The exception that it raised.
        result: What ``run`` returned, in a plain run.
        drawn: The global generators from which it has drawn.
    """

    decisions: list[list[Any]] = field(default_factory=list)
    fingerprint: Fingerprint | None = None
    cut: bool = False
    error: BaseException | None = None
    result: Any = None
    drawn: set[str] = field(default_factory=set)

    @property
    def calls(self) -> list[str]:
        """The names of the points that were called, in that order."""
        return [name for name, _ in self.decisions]

    def difference(self, other: Run, here: str = "first", there: str = "then") -> str:
        """Describe the first difference from the decisions of another run; empty if there is none."""
        for number, (left, right) in enumerate(zip(self.decisions, other.decisions, strict=False), 1):
            if left[0] != right[0]:
                return f"decision {number} is {here} of {left[0]}, {there} of {right[0]}"
            if not alike(left[1], right[1]):
                return f"decision {number}, of {left[0]}, is {here} {shown(left[1])}, {there} {shown(right[1])}"
        if len(self.decisions) != len(other.decisions):
            return f"there are {here} {len(self.decisions)} decisions, {there} {len(other.decisions)}"
        return ""


class _Watch:
    """Watches one run, until a limit of decisions.

    Attributes:
        run: The result.
        simulation: The simulation that runs.
    """

    def __init__(self, limit: int, look: Look) -> None:
        self.run = Run()
        self.simulation: Any = None
        self._limit, self._look = limit, look

    def over(self, plan: Plan, play: Callable[[], Any]) -> Run:
        """Watch what a function plays, and record whatever it raises."""
        run, before = self.run, global_generators()
        with watching_rules(plan, self._begin):
            try:
                run.result = play()
                run.fingerprint = self._look(self.simulation)
            except Cut:
                pass
            except (Exception, SystemExit) as error:
                if not run.cut:
                    run.error = error
        sources = zip(("Python's random", "numpy.random"), before, global_generators(), strict=True)
        run.drawn = {name for name, one, other in sources if not alike(one, other)}
        return run

    def _begin(self, name: str) -> Callable[[Any], None]:
        run = self.run
        if len(run.decisions) >= self._limit:
            if not run.cut:
                run.cut = True
                run.fingerprint = self._look(self.simulation)
            raise Cut
        note = [name, "left without a decision"]
        run.decisions.append(note)

        def end(value: Any) -> None:
            note[1] = brief(value)

        return end


def plain_run(plan: Plan, seed: int, limit: int, deadline: float, look: Look, profile: Any = None) -> Run:
    """Run a simulation's own loop; only the results of its rules are recorded.

    Args:
        plan: The plan of the simulation.
        seed: The seed of the simulation.
        limit: The number of decisions after which it is cut.
        deadline: The time at which it is interrupted.
        look: Returns the fingerprint of the simulation at the end.
        profile: A profiler for all calls meanwhile, as ``sys.setprofile`` takes it.
    """
    watch, before = _Watch(limit, look), sys.getprofile()

    def play() -> Any:
        watch.simulation = make_simulation(plan.source)
        sys.setprofile(before if profile is None else profile)
        try:
            reset(watch.simulation, seed)
            return main(watch.simulation)
        finally:
            sys.setprofile(before)

    with plain_loop(plan, watched=True) as (reset, main):
        return watch.over(plan, lambda: within(deadline, play))


def seconds_of_plain_run(plan: Plan, seed: int, deadline: float) -> float:
    """Run a simulation's own loop without any recording. Return its duration in seconds."""

    def play() -> float:
        simulation = make_simulation(plan.source)
        reset(simulation, seed)
        start = time.perf_counter()
        main(simulation)
        return time.perf_counter() - start

    with plain_loop(plan, watched=False) as (reset, main):
        return within(deadline, play)


def rule_run(plan: Plan, env: Any, seed: int, limit: int, deadline: float, look: Look) -> Run:
    """Run an environment of a plan, of any view, with ``RULE`` throughout, and watch it."""

    def play() -> None:
        env.reset(seed=seed)
        play_rules(env)

    watch = _Watch(limit, look)
    watch.simulation = env.simulation
    return watch.over(plan, lambda: within(deadline, play))


def play_rules(env: Any, selected: dict[str, None] | None = None) -> None:
    """Play an environment of any view with ``RULE`` throughout, after its reset.

    Args:
        env: The environment.
        selected: A dict that collects the agents that the AEC view selects.
    """
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


# -- episodes of random actions -------------------------------------------------------------------


@dataclass
class Step:
    """What an agent got at its turn, and what it did (None if its episode has ended)."""

    agent: str
    told: tuple[Any, float, bool, bool, dict[str, Any]]
    action: Any

    def difference(self, other: Step) -> str:
        """Describe the difference from a step of another episode; empty if there is none."""
        if self.agent != other.agent:
            return f"the agent is first {self.agent}, then {other.agent}"
        names = ("observation", "reward", "terminated", "truncated", "info")
        for name, here, there in zip(names, self.told, other.told, strict=True):
            if not alike(here, there):
                return f"the {name} of {self.agent} is first {shown(here)}, then {shown(there)}"
        return "" if alike(brief(self.action), brief(other.action)) else f"the action of {self.agent} differs"


def random_steps(env: Any, seed: int, salt: int = 0) -> Iterator[Step]:
    """Play an episode of an AEC environment with random legal actions, which depend on seed, agent and salt alone."""
    env.reset(seed=seed)
    spaces: dict[str, Any] = {}
    while env.agents:
        agent = env.agent_selection
        told = env.last()
        action = None
        if not (told[2] or told[3]):
            if agent not in spaces:
                spaces[agent] = copy.deepcopy(env.action_space(agent))
                spaces[agent].seed(crc32(f"{seed} {agent} {salt}".encode(errors="surrogatepass")))
            mask = told[4].get(MASK)
            action = spaces[agent].sample() if mask is None else spaces[agent].sample(mask)
        yield Step(agent, told, action)
        env.step(action)


# -- where errors and differences come from -------------------------------------------------------

_PACKAGE: Final = __file__.rpartition("testing")[0]
_CLOCKS: Final = {"time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "process_time"}


def culprit(error: BaseException) -> str:
    """Return where an error was raised, outside of this library: file, line and function; empty if nowhere."""
    place, trace = "", error.__traceback__
    while trace is not None:
        code = trace.tb_frame.f_code
        if not code.co_filename.startswith((_PACKAGE, "<")) and "site-packages" not in code.co_filename:
            place = f"{code.co_filename}:{trace.tb_lineno}, in {code.co_name}"
        trace = trace.tb_next
    return place


def error_in_words(error: BaseException, most: int = 300) -> str:
    """Describe an error: its kind, the first lines of its text, and where it was raised."""
    text, place = " ".join(error_text(error).split()), culprit(error)
    text = text if len(text) <= most else f"{text[: most - 4]} ..."
    return f"{type(error).__name__}: {text}" + (f" ({place})" if place else "")


def sources_of_chance(plan: Plan, seed: int, deadline: float, limit: int) -> list[str]:
    """Run the simulation by itself, and find its sources of chance: clocks, entropy, global generators.

    Returns:
        Each as the end of a sentence, with the place of the call.
    """
    found: dict[str, None] = {}
    library = random.__file__.rpartition("random.py")[0]
    shared: Any = random.random.__self__  # type: ignore[attr-defined]
    seeding = random.Random.seed.__code__

    def asked(what: str, frame: Any) -> None:
        while frame is not None and not frame.f_code.co_filename.startswith(_PACKAGE):
            path = frame.f_code.co_filename
            if ("site-packages" in path or not path.startswith(library)) and not path.startswith("<"):
                if "numpy" not in path:
                    found[f"{what} at {path}:{frame.f_lineno}, in {frame.f_code.co_name}"] = None
                return
            frame = frame.f_back

    def profile(frame: Any, event: str, argument: Any) -> None:
        if event == "call" and frame.f_code is seeding and frame.f_locals.get("a", 0) is None:
            asked("a random.Random is made without a seed", frame.f_back)
        if event != "c_call":
            return
        module, name = getattr(argument, "__module__", None), getattr(argument, "__name__", "")
        owner = getattr(argument, "__self__", None)
        if module == "time" and name in _CLOCKS:
            asked(f"the clock is read (time.{name})", frame)
        elif name in ("now", "utcnow", "today") and getattr(owner, "__module__", "") == "datetime":
            asked(f"the clock is read (datetime.{name})", frame)
        elif name == "urandom":
            asked("the operating system is asked for random bits (as by a generator without a seed)", frame)
        elif owner is shared and name in ("random", "getrandbits"):
            asked("Python's global generator is used", frame)

    plain_run(plan, seed, limit, deadline, lambda simulation: None, profile)
    return list(found)
