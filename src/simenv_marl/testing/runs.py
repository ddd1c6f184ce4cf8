"""Runs of a simulation that are watched: plain ones, ones with RULE throughout, and episodes of random actions.

Every run has an end, whatever the model does. It is cut at its *limit* of decisions, by an exit that is raised at the
next one; and when its time is up, by one that is raised in whatever Python code the model is executing.
"""

from __future__ import annotations

import copy
import ctypes
import random
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Final, TypeVar
from zlib import crc32

import numpy as np

from ..core.bindings import Binding
from ..core.contexts import Surroundings
from ..core.plan import Plan
from ..core.spaces import MASK
from ..core.switch import RUNNING, SimulationExit
from ..decision import DecisionPoint
from ..simulation import RULE, make_simulation, resetter
from .fingerprint import Fingerprint, alike, brief, fingerprint


class Cut(SimulationExit):
    """Raised in a run that has reached its limit of decisions."""


class TimeUp(SimulationExit):
    """Raised in a run whose time is up."""


Result = TypeVar("Result")

# -- time -----------------------------------------------------------------------------------------

_AGAIN: Final = 0.5
"""After how many seconds a model that has swallowed the exit is told again."""


def within(deadline: float, function: Callable[[], Result]) -> Result:
    """Call a function, and raise ``TimeUp`` in it when it is later than a ``time.monotonic()``.

    It interrupts Python code; what waits outside of it (in a sleep, say) is interrupted when it returns.

    Raises:
        TimeUp: It was interrupted, or it was too late before.
    """
    if time.monotonic() >= deadline:
        raise TimeUp
    thread, over = threading.get_ident(), threading.Event()
    interrupt = ctypes.pythonapi.PyThreadState_SetAsyncExc

    def watch() -> None:
        pause = deadline - time.monotonic()
        while not over.wait(max(0.0, pause)):
            interrupt(ctypes.c_ulong(thread), ctypes.py_object(TimeUp))
            pause = _AGAIN

    watcher = threading.Thread(target=watch, daemon=True, name="time limit of a check")
    try:
        watcher.start()
        return function()
    finally:
        # It may still be raised up to when nobody is left who would raise it, and is then delivered at once. (It is not
        # taken back: in CPython that leaves the interpreter checking for it for ever.)
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
    """The states of Python's and NumPy's global generators."""
    return random.getstate(), np.random.get_state(legacy=False)


def set_global_generators(states: tuple[Any, Any]) -> None:
    """Put states of ``global_generators`` back."""
    random.setstate(states[0])
    np.random.set_state(states[1])


def seed_global_generators(seed: int) -> None:
    """Seed both, so that runs can be compared whose model draws from them."""
    random.seed(seed)
    np.random.seed(seed % 2**32)


def drawn_from(before: tuple[Any, Any]) -> set[str]:
    """Which of the global generators have moved since."""
    now = global_generators()
    names = ("Python's random", "numpy.random")
    return {name for name, one, other in zip(names, before, now, strict=True) if not alike(one, other)}


# -- watched rules --------------------------------------------------------------------------------


@dataclass
class Run:
    """What came of a run.

    Attributes:
        decisions: What was decided: the point's name, and what its rule returned.
        fingerprint: What the simulation held at its end, or where it was cut.
        cut: Whether it was cut at its limit.
        error: What it raised.
        result: What ``run`` returned, of a plain run.
        drawn: From which global generators it has drawn.
        seconds: How long it took.
    """

    decisions: list[list[Any]] = field(default_factory=list)
    fingerprint: Fingerprint | None = None
    cut: bool = False
    error: BaseException | None = None
    result: Any = None
    drawn: set[str] = field(default_factory=set)
    seconds: float = 0.0


class Watcher:
    """Notes what the rules of some points return, until a limit.

    Attributes:
        run: What is noted.
        simulation: The simulation whose run it is, once that is known.
    """

    def __init__(self, points: list[DecisionPoint], limit: int, own: Callable[[Any], Any] | None) -> None:
        self.run = Run()
        self.simulation: Any = None
        self._points, self._limit, self._own = points, limit, own

    @contextmanager
    def watching(self) -> Iterator[Run]:
        """Have the rules watched, and whatever is raised noted."""
        run = self.run
        rules = [point.rule for point in self._points]
        before, start = global_generators(), time.perf_counter()
        for point in self._points:
            point.rule = self._watched(point)
        try:
            yield run
            run.seconds = time.perf_counter() - start
            run.fingerprint = fingerprint(self.simulation, self._own)
        except Cut:
            run.seconds = time.perf_counter() - start
        except (Exception, SystemExit) as error:
            if not run.cut:
                run.error = error
        finally:
            for point, rule in zip(self._points, rules, strict=True):
                point.rule = rule
            run.drawn = drawn_from(before)

    def _arise(self, point: DecisionPoint) -> list[Any]:
        run = self.run
        if len(run.decisions) >= self._limit:
            if not run.cut:
                run.cut = True
                run.fingerprint = fingerprint(self.simulation, self._own)
            raise Cut
        note = [point.name, "nothing, but was left"]
        run.decisions.append(note)
        return note

    def _watched(self, point: DecisionPoint) -> Any:
        rule: Any = point.rule

        def function(*args: Any, **kwargs: Any) -> Any:
            note = self._arise(point)
            value = rule(*args, **kwargs)
            note[1] = brief(value)
            return value

        def generator(*args: Any, **kwargs: Any) -> Any:
            note = self._arise(point)
            value = yield from rule(*args, **kwargs)
            note[1] = brief(value)
            return value

        async def coroutine(*args: Any, **kwargs: Any) -> Any:
            note = self._arise(point)
            value = await rule(*args, **kwargs)
            note[1] = brief(value)
            return value

        return {"function": function, "generator": generator, "coroutine": coroutine}[point.kind]


def points_of(plan: Plan) -> list[DecisionPoint]:
    """The points whose decisions an environment of a plan sees."""
    return [point for point, binding in plan.bindings.items() if isinstance(binding, Binding)]


# -- runs -----------------------------------------------------------------------------------------


def plain_run(
    plan: Plan,
    seed: int,
    limit: int,
    deadline: float,
    own: Callable[[Any], Any] | None,
    profile: Any = None,
) -> Run:
    """Run a simulation's own loop, with nothing around it but a note of what its rules return.

    Args:
        plan: Whose simulation it is.
        seed: What it is reset with.
        limit: After how many decisions it is cut.
        deadline: When its time is up.
        own: What it is compared by.
        profile: What is told of all calls meanwhile, as ``sys.setprofile`` has it.
    """
    watcher = Watcher(points_of(plan), limit, own)
    thread = threading.get_ident()
    before = sys.getprofile()

    def run_it() -> None:
        watcher.simulation = simulation = make_simulation(plan.source)
        if profile is not None:
            sys.setprofile(profile)
        try:
            surroundings.begin(seed)
            resetter(simulation)(seed, None)
            RUNNING[thread] = _rule
            watcher.run.result = simulation.run()
        finally:
            RUNNING.pop(thread, None)
            if profile is not None:
                sys.setprofile(before)

    with held(plan) as surroundings, watcher.watching() as run:
        within(deadline, run_it)
    return run


@contextmanager
def held(plan: Plan) -> Iterator[Surroundings]:
    """Set in the model what environments of a plan set there, and be where their simulations are."""
    surroundings, done = Surroundings(plan.surroundings()), []
    try:
        for site in plan.patches:
            site.hold()
            done.append(site)
        with surroundings.entered():
            yield surroundings
    finally:
        for site in reversed(done):
            site.let_go()


def _rule(point: DecisionPoint, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
    return point.rule(*args, **kwargs)


def untouched_run(plan: Plan, seed: int, deadline: float) -> float:
    """Run a simulation's own loop with nothing around it at all. Returns how many seconds that took."""

    def run_it() -> float:
        simulation = make_simulation(plan.source)
        surroundings.begin(seed)
        resetter(simulation)(seed, None)
        start = time.perf_counter()
        simulation.run()
        return time.perf_counter() - start

    surroundings = Surroundings(plan.surroundings())
    with surroundings.entered():
        return within(deadline, run_it)


def rule_run(env: Any, seed: int, limit: int, deadline: float, own: Callable[[Any], Any] | None) -> Run:
    """Run an environment of any view with ``RULE`` throughout, watched."""
    watcher = Watcher(points_of(env._plan), limit, own)
    watcher.simulation = env.simulation
    with watcher.watching() as run:
        within(deadline, lambda: all_rules(env, seed))
    return run


def all_rules(env: Any, seed: int) -> None:
    """Play an environment of any view with ``RULE`` throughout."""
    env.reset(seed=seed)
    play_rules(env)


def play_rules(env: Any) -> None:
    """The same, once it has been reset."""
    if not hasattr(env, "agents"):
        while not any(env.step(RULE)[2:4]):
            pass
    elif hasattr(env, "agent_selection"):
        while env.agents:
            agent = env.agent_selection
            env.step(None if env.terminations[agent] or env.truncations[agent] else RULE)
    else:
        while env.agents:
            env.step(RULE)


@dataclass
class Step:
    """What an agent was told at its turn, and what it did (None where its episode has ended)."""

    agent: str
    point: str
    told: tuple[Any, float, bool, bool, dict[str, Any]]
    action: Any

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Step)
            and self.agent == other.agent
            and alike(self.told, other.told)
            and alike(brief(self.action), brief(other.action))
        )


def random_steps(env: Any, seed: int, salt: int = 0) -> Iterator[Step]:
    """Play an episode of an AEC environment with random legal actions, which depend on seed, agent and salt alone."""
    env.reset(seed=seed)
    spaces: dict[str, Any] = {}
    while env.agents:
        agent = env.agent_selection
        told = env.last()
        action = None
        if not (told[2] or told[3]):
            space = spaces.get(agent)
            if space is None:
                space = spaces[agent] = copy.deepcopy(env.action_space(agent))
                space.seed(crc32(f"{seed} {agent} {salt}".encode()))
            mask = told[4].get(MASK)
            action = space.sample() if mask is None else space.sample(mask)
        yield Step(agent, env._binding(agent).point.name, told, action)
        env.step(action)


def culprit(error: BaseException) -> str:
    """Where an error was raised, outside of this library: file, line and function; empty if nowhere."""
    package = __file__.rpartition("testing")[0]
    place, trace = "", error.__traceback__
    while trace is not None:
        code = trace.tb_frame.f_code
        if not code.co_filename.startswith((package, "<")) and "site-packages" not in code.co_filename:
            place = f"{code.co_filename}:{trace.tb_lineno}, in {code.co_name}"
        trace = trace.tb_next
    return place


# -- what makes runs differ -----------------------------------------------------------------------

_CLOCKS: Final = {"time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns", "process_time"}


def sources_of_chance(plan: Plan, seed: int, deadline: float, limit: int) -> list[str]:
    """Run the simulation plainly, and see what it asks that is different each time: clocks, entropy, global generators.

    Returns:
        Each as a sentence's end, the place that asks for it included.
    """
    found: dict[str, None] = {}
    package = __file__.rpartition("testing")[0]
    library = random.__file__.rpartition("random.py")[0]
    shared: Any = random.random.__self__  # type: ignore[attr-defined]
    seeding = random.Random.seed.__code__

    def asked(what: str, frame: Any) -> None:
        while frame is not None:
            path = frame.f_code.co_filename
            outside = "site-packages" in path or not path.startswith(library)
            if outside and not path.startswith((package, "<")):
                if "numpy" not in path:
                    found[f"{what} at {path}:{frame.f_lineno}, in {frame.f_code.co_name}"] = None
                return
            if path.startswith(package):
                return
            frame = frame.f_back

    def profile(frame: Any, event: str, argument: Any) -> None:
        if event == "c_call":
            module, name = getattr(argument, "__module__", None), getattr(argument, "__name__", "")
            owner = getattr(argument, "__self__", None)
            if module == "time" and name in _CLOCKS:
                asked(f"the clock is asked (time.{name})", frame)
            elif name in ("now", "utcnow", "today") and getattr(owner, "__module__", "") == "datetime":
                asked(f"the clock is asked (datetime.{name})", frame)
            elif name == "urandom":
                asked("the operating system is asked for random bits (as by a generator without a seed)", frame)
            elif owner is shared and name in ("random", "getrandbits"):
                asked("Python's global generator is used", frame)
        elif event == "call" and frame.f_code is seeding and frame.f_locals.get("a", 0) is None:
            asked("a random.Random is made without a seed", frame.f_back)

    plain_run(plan, seed, limit, deadline, lambda simulation: None, profile)
    return list(found)
