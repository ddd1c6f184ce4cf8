"""The checks: functions of a ``Subject`` and a ``Report``.

Each adds its findings to the report.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from itertools import chain, product
from typing import Any, Final

import numpy as np
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import (
    api_test,
    parallel_api_test,
    parallel_seed_test,
    seed_test,
)

from ..core import MASK, Plan, Point, Streams, generators_of
from ..envs import VIEWS, SimulationAECEnv, view_class
from ..errors import (
    AgentError,
    InvalidActionError,
    error_text,
    short_repr,
)
from ..simulation import (
    RULE,
    Model,
    Observation,
    make_simulation,
    takes,
)
from .fingerprint import (
    ABSENT,
    STATE,
    describe_differences,
    generalize,
)
from .report import (
    FINDINGS,
    Finding,
    PointStatistics,
    Range,
)
from .runs import (
    LimitReached,
    Run,
    Step,
    Subject,
    describe_with_place,
    place_of,
    seed_global_generators,
)


def make_environment(plan: Plan, view: str, **options: Any) -> Any:
    """Make an environment of a plan with changed options."""
    if view != "joint" and plan.options.flatten:
        options["flatten"] = False
    plan = plan.amended(options)
    return view_class(plan, view)(plan)


def fitting_views(plan: Plan) -> list[str]:
    """Return the views that a plan allows."""
    views = []
    for view in VIEWS:
        # The view may refuse the plan, or reset the model, which may raise anything.
        with suppress(Exception):
            make_environment(plan, view).close()
            views.append(view)
    return views


class Report:
    """A report while it is written.

    Attributes:
        findings, checked, statistics, episodes: As in ``CheckReport``, but mutable.
        names: The names of the findings.
    """

    def __init__(self) -> None:
        self.findings: list[Finding] = []
        self.names: set[str] = set()
        self.checked: list[str] = []
        self.statistics: list[PointStatistics] = []
        self.episodes = {"terminated": 0, "truncated": 0, "cut": 0}
        self._errors: set[tuple[str, str]] = set()  # by class and place

    def add(
        self,
        name: str,
        evidence: str = "",
        **words: str | int,
    ) -> None:
        """Add a finding of ``FINDINGS``; ``words`` replace the placeholders of its text."""
        severity, *texts = FINDINGS[name]
        title, explanation = (" ".join(text.format(**words).split()) for text in texts)
        self.findings.append(Finding(severity, title, explanation, evidence))
        self.names.add(name)

    def add_error(
        self,
        run: Run,
        where: str,
        view: str = "aec",
    ) -> bool:
        """Add the error of a run, once for each place; return whether the run has an error."""
        error = run.error
        if isinstance(error, LimitReached):
            name = "stuck" if run.is_stuck else "out_of_time"
            self.add(name, f"{where}, after {len(run.calls)} steps")
        # The joint view may be unable to know all agents.
        elif error is not None and not (view == "joint" and isinstance(error, AgentError)):
            kind = type(error).__name__
            key = kind, place_of(error) or error_text(error)
            if key not in self._errors:
                self._errors.add(key)
                self.add("raises", f"{where}: {describe_with_place(error)}", kind=kind)
        return error is not None

    @contextmanager
    def environment(
        self,
        subject: Subject,
        view: str = "aec",
        **options: Any,
    ) -> Iterator[Any]:
        """Make an environment, and close it at the end."""
        env = make_environment(subject.plan, view, **options)
        try:
            yield env
        finally:
            self.add_error(
                subject.record(env.close), "when an environment was closed in mid-episode"
            )


# -- the simulation by itself ---------------------------------------------------------------------


def check_plain_runs(subject: Subject, report: Report) -> None:
    """Check that the simulation runs without an environment, and decides something."""
    if not takes(make_simulation(subject.plan.subject.source).reset, "seed"):
        report.add("unseeded_reset")
    for seed in subject.seeds:
        run = subject.run_plainly(seed)
        subject.plain_runs[seed] = run
        subject.draws.update(run.draws)
        if report.add_error(run, f"in a plain run without any environment, seed {seed}"):
            return
    runs = list(subject.plain_runs.values())
    if not any(run.calls for run in runs):
        points = ", ".join(point.hook.name for point in subject.plan.active)
        report.add("no_decision", points=points)
        return
    subject.views.extend(fitting_views(subject.plan))
    if any(run.is_cut for run in runs):
        report.add("cut_runs", most=subject.max_steps)
    first, *others = runs
    if others and not any(
        first.difference(run) or subject.differences(first, run) for run in others
    ):
        report.add("same_seeds", f"seeds {', '.join(map(str, subject.seeds))}")


def check_repetition(subject: Subject, report: Report) -> None:
    """Repeat a plain run: if it differs, differences of environments mean nothing."""
    seed = subject.seeds[0]
    first = subject.plain_runs[seed]
    again = subject.run_plainly(seed)
    # Other states of the global generators show whether the model seeds them.
    other = subject.run_plainly(seed, seed + 1) if subject.draws else again
    if any(isinstance(run.error, LimitReached) for run in (again, other)):
        return
    if subject.draws:
        differs = first.difference(other) or subject.differences(first, other)
        name = "unseeded_generators" if differs else "shared_generators"
        names = " and ".join(sorted(subject.draws))
        report.add(name, subject.sources_of_chance().lstrip(), names=names)
    parts = subject.differences(first, again)
    states = [part for part in parts if STATE in part.path]
    difference = first.difference(again) or describe_differences(states)
    if difference:
        evidence = f"two plain runs of seed {seed}: {difference}{subject.sources_of_chance()}"
        report.add("unrepeatable", evidence)
    elif parts:
        report.add("unstable", describe_differences(parts))
        subject.unstable.update(generalize(part.path) for part in parts)


# -- environments with RULE throughout ------------------------------------------------------------


def check_views(subject: Subject, report: Report) -> None:
    """Compare plain runs with each view and driver under ``RULE``, up to the first difference."""
    if "unrepeatable" in report.names:
        return
    options = subject.plan.options
    drivers = ["greenlet", "thread"] if options.driver == "greenlet" else [options.driver]
    # Rules take all decisions, because plain runs have no policies.
    policies = dict.fromkeys(options.policies or (), RULE) or None
    rules = {"policies": policies, "max_steps": None, "skip_forced": False}
    for driver, view, seed in product(drivers, subject.views, subject.plain_runs):
        plain = subject.plain_runs[seed]
        if subject.is_late or not plain.calls:
            continue
        seed_global_generators(seed)
        with report.environment(subject, view, driver=driver, **rules) as env:
            run = subject.run_rules(env, seed)
        where = f"{view} view, driver {driver}, seed {seed}"
        if report.add_error(run, f"in the {where}, with RULE throughout", view):
            continue
        draws = run.draws - subject.draws
        if draws:
            names = " and ".join(sorted(draws))
            report.add("unseeded_generators", f"in the {where}", names=names)
            subject.draws.update(draws)
        difference = plain.difference(run)
        parts = subject.differences(plain, run)
        if difference or parts:
            more = not difference and all(part.first is ABSENT for part in parts)
            evidence = f"plain run, then {where}: {difference}\n{describe_differences(parts)}"
            report.add("writing_mappings" if more else "changed_model", evidence.rstrip())
            return
    most = max(len(run.calls) for run in subject.plain_runs.values())
    report.checked.append(
        f"plain runs against RULE throughout ({', '.join(subject.views)}; drivers"
        f" {', '.join(drivers)}; seeds {', '.join(map(str, subject.seeds))}; up to {most} decisions"
        f" each): the decisions, and {len(plain.fingerprint)} parts that the simulation holds then"
    )


# -- episodes of random legal actions -------------------------------------------------------------


class Tally:
    """The number, the minimum, the maximum and the sum of arrays of one shape."""

    def __init__(self) -> None:
        self.number = 0
        self.low = np.array(np.inf)
        self.high = np.array(-np.inf)
        self.total = np.array(0.0)

    def add(self, value: Observation) -> None:
        """Add an array or a number; skip it if the first one had another shape."""
        array = np.array(value, float)
        if self.number and array.shape != self.total.shape:
            return
        self.number += 1
        self.low = np.minimum(self.low, array)
        self.high = np.maximum(self.high, array)
        self.total = self.total + array

    def ranges(self, name: str) -> list[Range]:
        """Return the range of each element."""
        ranges = []
        for place, mean in np.ndenumerate(self.total / self.number):
            path = f"{name}{list(place) or ''}"
            low = self.low[place].item()
            high = self.high[place].item()
            ranges.append(Range(path, low, mean.item(), high))
        return ranges


class PointRecord:
    """The record of a decision point in episodes of random legal actions."""

    def __init__(self, point: Point) -> None:
        self.point = point
        self.decisions = 0
        self.rewards = Tally()
        self.masks = Tally()
        self.observations: defaultdict[str, Tally] = defaultdict(Tally)
        self.outside = ""  # the first observation outside of its space

    def add(
        self,
        agent: str,
        step: Step,
        *,
        with_reward: bool,
    ) -> None:
        """Add a result of ``last()``, with its reward if the agent has acted in the episode."""
        observation, reward, terminated, truncated, info = step
        self.observe("observation", observation)
        space = self.point.definition.observation_space
        if not (self.outside or space.contains(observation)):
            text = short_repr(observation)
            self.outside = f"{agent} has observed {text}; the space is {space}"
        if with_reward:
            self.rewards.add(reward)
        if not (terminated or truncated):
            self.decisions += 1
            if isinstance(info.get(MASK), np.ndarray):
                self.masks.add(info[MASK])

    def observe(self, name: str, value: Observation) -> None:
        """Add a number, an array, or a dict or tuple of these."""
        if isinstance(value, Mapping):
            for key, part in value.items():
                if key != MASK:
                    self.observe(f"{name}.{key}", part)
        elif isinstance(value, tuple):
            for number, part in enumerate(value):
                self.observe(f"{name}.{number}", part)
        elif isinstance(value, (np.ndarray, np.generic, int, float)):
            self.observations[name].add(value)

    def conclude(self, report: Report, subject: Subject) -> None:
        """Report the statistics, and their findings."""
        point = self.point.hook.name
        rewards = self.rewards.ranges("reward")[0] if self.rewards.number else None
        start = int(getattr(self.point.definition.action_space, "start", 0))
        never = (np.flatnonzero(self.masks.high == 0) + start).tolist()
        if not self.decisions and not any(
            point in run.calls for run in subject.plain_runs.values()
        ):
            report.add("never_called", point=point)
        if self.outside:
            report.add("outside", self.outside, point=point)
        if never:
            report.add("never_legal", f"actions {', '.join(map(str, never[:10]))}", point=point)
        if rewards is not None and rewards.minimum == rewards.maximum and self.rewards.number > 1:
            name = "same_rewards" if rewards.minimum else "zero_rewards"
            report.add(name, f"{self.rewards.number} rewards of {rewards.mean:.6g}", point=point)
        ranges = (tally.ranges(name) for name, tally in self.observations.items())
        observations = tuple(chain(*ranges))
        agents = self.point.agent or "agents named by each call"
        report.statistics.append(
            PointStatistics(point, agents, self.decisions, observations, rewards, tuple(never))
        )


def check_episodes(subject: Subject, report: Report) -> None:
    """Play episodes with random legal actions, and compare episodes of the same seed."""
    records = {point.hook: PointRecord(point) for point in subject.plan.active}
    most = subject.max_steps
    first: Run | None = None
    failures = 0
    with report.environment(subject, max_steps=most) as env:
        for number, seed in enumerate(subject.episode_seeds, 1):
            if subject.is_late or failures == 3:
                break
            run = subject.run_randomly(env, seed)
            actors = set()
            for agent, step in run.results:
                record = records[agent.point.hook]
                record.add(agent.name, step, with_reward=agent.name in actors)
                actors.add(agent.name)
            if report.add_error(run, f"in episode {number} of random legal actions, seed {seed}"):
                failures += 1
                if isinstance(run.error, LimitReached):
                    break
                continue
            if number == 1:
                first = run
                check_generators(report, run, env.simulation)
            report.episodes[run.end if len(run.actions) < most else "cut"] += 1
        for record in records.values():
            record.conclude(report, subject)
        episodes = sum(report.episodes.values())
        if episodes:
            report.checked.append(f"{episodes} episodes of random legal actions in the AEC view")
        if report.episodes["cut"] == episodes > 0:
            report.add("cut_runs", most=most)
        if first is not None and not failures and "unrepeatable" not in report.names:
            compare_episodes(subject, report, env, first)
        subject.record(partial(env.reset, seed=subject.seeds[0]))  # to close it in mid-episode


def check_generators(report: Report, run: Run, simulation: Model) -> None:
    """Report that entities share generators, unless the model has no generator."""
    names = list({agent.name: None for agent, _ in run.results if agent.point.agent is None})
    generators = generators_of(simulation)
    number = sum(len(each) if isinstance(each, Streams) else 1 for each in generators)
    if 0 < number < len(names):
        evidence = f"{number} for {len(names)} agents, {names[0]} and {names[1]} among them"
        report.add("few_generators", evidence)


def compare_episodes(
    subject: Subject,
    report: Report,
    used: SimulationAECEnv,
    first: Run,
) -> None:
    """Repeat an episode in a new environment, in a used one, and beside another one."""
    seed = subject.seeds[0]
    with report.environment(subject, max_steps=subject.max_steps) as new:
        subject.run_randomly(used, seed, most=1 + len(first.calls) // 2)
        for name, env, beside in (
            ("unrepeatable", new, None),
            ("left_over", used, None),
            ("disturbance", new, used),
        ):
            again = subject.run_randomly(env, seed, beside=beside)
            if report.add_error(again, "after an episode that was closed in mid-episode"):
                return
            if subject.is_late or (beside and subject.draws):
                return
            difference = first.difference(again)
            if difference:
                sources = subject.sources_of_chance() if name == "unrepeatable" else ""
                report.add(name, f"seed {seed}, the same actions: {difference}{sources}")
                return
        other = subject.run_randomly(used, seed, salt=1)
        acts_alike = len(other.calls) <= 1 or repr(first.actions) == repr(other.actions)
        if not acts_alike and not first.difference(other):
            report.add("no_effect", f"seed {seed}, {len(first.actions)} actions")
    report.checked.append(
        "the same seed and actions in a new environment, in a used one, and beside another one"
    )


# -- the tests of PettingZoo and Gymnasium --------------------------------------------------------


_TESTS: Final = (
    ("PettingZoo's api_test", "aec", lambda make: api_test(make(), num_cycles=50)),
    ("seed_test", "aec", lambda make: seed_test(make, num_cycles=20)),
    ("parallel_api_test", "parallel", lambda make: parallel_api_test(make(), num_cycles=50)),
    ("parallel_seed_test", "parallel", lambda make: parallel_seed_test(make, num_cycles=20)),
    *(
        (
            f"Gymnasium's check_env ({view} view)",
            view,
            lambda make: check_env(make(), skip_render_check=True),
        )
        for view in ("single", "joint")
    ),
)
"""The tests and their views; each test is called with a factory of environments."""


def check_conformance(subject: Subject, report: Report) -> None:
    """Run the tests of PettingZoo and Gymnasium, unless they would only repeat errors."""
    passed_tests = []
    for name, view, test in _TESTS:
        if any(finding.severity == "error" for finding in report.findings):
            break
        if subject.is_late or view not in subject.views or (subject.draws and "seed" in name):
            continue
        make = partial(make_environment, subject.plan, view, max_steps=subject.max_steps)
        run = subject.record(partial(test, make))
        if run.error is None:
            passed_tests.append(name)
        elif isinstance(run.error, AssertionError):
            report.add("failed_test", describe_with_place(run.error), test=name)
        # The tests ignore masks, or changes of masks.
        elif not isinstance(run.error, (LimitReached, InvalidActionError)):
            report.add_error(run, f"in {name}", view)
    if passed_tests:
        report.checked.append(", ".join(passed_tests))


CHECKS: Final = (
    check_plain_runs,
    check_repetition,
    check_views,
    check_episodes,
    check_conformance,
)
"""All checks, the more basic first: if the plain run fails, the others are left out."""
