"""The checks: functions of a ``Subject`` and a ``Report``.

Each adds what it finds to the report.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, count, islice, product
from typing import Any, Final

import numpy as np
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

from ..core import MASK, Plan, Streams, generators_of
from ..envs import VIEWS, view_class
from ..errors import AgentError, InvalidActionError, error_text, short_repr
from ..simulation import RULE, make_simulation, takes
from .fingerprint import ABSENT, STATE, describe_differences, general
from .report import FINDINGS, SEVERITIES, Finding, PointStatistics, Range
from .runs import LimitReached, Run, Subject, describe_with_place, place_of, seed_global_generators


def make_environment(plan: Plan, view: str, **options: Any) -> Any:
    """Make an environment of a plan with changed options."""
    if view != "joint" and plan.options.flatten:
        options["flatten"] = False
    plan = plan.amended(options)
    return view_class(plan, view)(plan)


def fitting_views(plan: Plan) -> tuple[str, ...]:
    """Return the views that a plan allows."""
    found = []
    for view in VIEWS:
        with suppress(Exception):  # of the plan, or of the model if the view resets it
            make_environment(plan, view).close()
            found.append(view)
    return tuple(found)


@dataclass
class Report:
    """A report while it is written."""

    findings: list[Finding] = field(default_factory=list)
    checked: list[str] = field(default_factory=list)
    statistics: tuple[PointStatistics, ...] = ()
    episodes: dict[str, int] = field(
        default_factory=lambda: dict.fromkeys(("terminated", "truncated", "cut"), 0)
    )
    errors: set[tuple[str, str]] = field(default_factory=set)  # by class and place

    def add(self, name: str, evidence: str = "", **words: Any) -> None:
        """Add a finding of ``FINDINGS``; words are the values of placeholders there."""
        severity = next(severity for severity in SEVERITIES if name in FINDINGS[severity])
        title, text = FINDINGS[severity][name].format(**words).split("\n", 1)
        self.findings.append(Finding(severity, title, " ".join(text.split()), evidence))

    def add_error(self, run: Run, where: str, view: str = "aec") -> None:
        """Add the finding for the exception of a run.

        The same one from the same place is reported once.
        """
        error: Any = run.error
        if view == "joint" and isinstance(error, AgentError):
            return  # that view needs to know all agents
        if isinstance(error, LimitReached):
            self.add(
                "stuck" if run.stuck else "out_of_time", f"{where}, after {len(run.calls)} steps"
            )
            return
        key = type(error).__name__, place_of(error) or error_text(error)
        if key not in self.errors:
            self.errors.add(key)
            self.add("raises", f"{where}: {describe_with_place(error)}", kind=type(error).__name__)

    @contextmanager
    def opened(self, subject: Subject, view: str = "aec", **options: Any) -> Iterator[Any]:
        """Make an environment, which is closed at the end."""
        env = make_environment(subject.plan, view, **options)
        try:
            yield env
        finally:
            closing = subject.play(env.close)
            if closing.error is not None:
                self.add_error(closing, "when an environment was closed in mid-episode")


# -- the simulation by itself ---------------------------------------------------------------------


def check_plain_runs(subject: Subject, report: Report) -> None:
    """Check that the simulation runs without an environment, and decides something."""
    if not takes(make_simulation(subject.plan.subject.source).reset, "seed"):
        report.add("unseeded_reset")
    for seed in subject.seeds:
        run = subject.plain[seed] = subject.run_plainly(seed)
        if not subject.plan.options.global_rng:
            subject.drawn |= run.drawn
        if run.error is not None:
            report.add_error(run, f"in a plain run without any environment, seed {seed}")
            return
    if not any(run.calls for run in subject.plain.values()):
        report.add(
            "no_decision", points=", ".join(bound.hook.name for bound in subject.plan.active)
        )
        return
    subject.views = fitting_views(subject.plan)
    if any(run.cut for run in subject.plain.values()):
        report.add("cut_runs", most=subject.max_steps)
    first, *others = subject.plain.values()
    if others and not any(
        first.difference(run) or subject.differences(first, run) for run in others
    ):
        report.add("same_seeds", f"seeds {', '.join(map(str, subject.seeds))}")


def check_repeated_run(subject: Subject, report: Report) -> None:
    """Run a seed again: differences then are not due to environments."""
    seed = subject.seeds[0]
    first = subject.plain[seed]
    # If it draws from the global generators, run it with these in another state, too.
    shared_seeds = (seed, seed + 1) if subject.drawn else (seed,)
    runs = [subject.run_plainly(seed, shared_seed=shared_seed) for shared_seed in shared_seeds]
    if any(isinstance(run.error, LimitReached) for run in runs):
        return
    if subject.drawn:
        differs = first.difference(runs[1]) or subject.differences(first, runs[1])
        names = " and ".join(sorted(subject.drawn))
        name = "unseeded_generators" if differs else "shared_generators"
        report.add(name, subject.sources_of_chance().lstrip(), names=names)
    parts = subject.differences(first, runs[0])
    difference = first.difference(runs[0]) or describe_differences(
        [part for part in parts if STATE in part[0]]
    )
    if difference:
        subject.repeats = False
        report.add(
            "unrepeatable",
            f"two plain runs of seed {seed}: {difference}{subject.sources_of_chance()}",
        )
    elif parts:
        report.add("unstable", describe_differences(parts))
        subject.unstable = frozenset(general(path) for path, _, _ in parts)


# -- behind environments, with RULE throughout ----------------------------------------------------


def check_views(subject: Subject, report: Report) -> None:
    """Compare the plain run with every view and driver, with ``RULE`` throughout, up to the first difference."""
    if not subject.repeats:
        return
    chosen = subject.plan.options.driver
    drivers = ("greenlet", "thread") if chosen == "greenlet" else (chosen,)
    policies = dict.fromkeys(subject.plan.options.policies or (), RULE) or None
    for driver, view, seed in product(drivers, subject.views, subject.plain):
        plain = subject.plain[seed]
        if subject.late or not plain.calls:
            continue
        seed_global_generators(seed)
        # so that rules take all decisions
        asking = {"policies": policies, "max_steps": None, "skip_forced": False}
        with report.opened(subject, view, driver=driver, **asking) as env:
            run = subject.run_rules(env, seed)
        where = f"{view} view, driver {driver}, seed {seed}"
        if run.error is not None:
            report.add_error(run, f"in the {where}, with RULE throughout", view)
            continue
        if run.drawn - subject.drawn:
            report.add(
                "unseeded_generators",
                f"in the {where}",
                names=" and ".join(sorted(run.drawn - subject.drawn)),
            )
            subject.drawn |= run.drawn
        decisions, parts = plain.difference(run), subject.differences(plain, run)
        if decisions or parts:
            evidence = (
                f"plain run, then {where}: {decisions}\n{describe_differences(parts)}".rstrip()
            )
            only_more = not decisions and all(here is ABSENT for _, here, _ in parts)
            report.add("writing_mappings" if only_more else "changed_model", evidence)
            return
    most = max(len(run.calls) for run in subject.plain.values())
    views, seeds = ", ".join(subject.views), ", ".join(map(str, subject.seeds))
    report.checked.append(
        f"plain runs against RULE throughout ({views}; drivers {', '.join(drivers)}; seeds"
        f" {seeds}; up to {most} decisions each): the decisions, and {len(plain.fingerprint)}"
        " parts that the simulation holds then"
    )


# -- episodes of random legal actions -------------------------------------------------------------


@dataclass
class PointRecord:
    """What episodes have shown of one decision point."""

    point: Any
    decisions: int = 0
    values: dict[str, tuple[int, Any, Any, Any]] = field(default_factory=dict)
    """The number, minimum, sum and maximum of the rewards, and of each array in the observations."""
    legal: Any = False  # for each action of a masked space, whether it was legal at least once
    unfit: str = ""  # an observation outside of its space

    def record(self, name: str, value: Any) -> None:
        """Add a number, an array, or a dict or tuple of these."""
        if isinstance(value, Mapping):
            for key in value:
                if key != MASK:
                    self.record(f"{name}.{key}", value[key])
        elif isinstance(value, tuple):
            for number, part in enumerate(value):
                self.record(f"{name}.{number}", part)
        elif isinstance(value, (np.ndarray, np.generic, int, float)):
            array = np.array(value, float)
            number, low, total, high = self.values.get(
                name, (0, array, np.zeros_like(array), array)
            )
            if array.shape == low.shape:
                self.values[name] = (
                    number + 1,
                    np.minimum(low, array),
                    total + array,
                    np.maximum(high, array),
                )

    def results(self, report: Report, called: set[str]) -> PointStatistics:
        """Return the statistics, and report what they show; plain runs have called some points."""
        ranges = {
            name: [
                Range(
                    f"{name}{list(place)}" if place else name,
                    low[place].item(),
                    mean.item(),
                    high[place].item(),
                )
                for place, mean in np.ndenumerate(total / number)
            ]
            for name, (number, low, total, high) in self.values.items()
        }
        point, rewards = self.point.hook.name, ranges.pop("reward", [None])[0]
        never: tuple[int, ...] = ()
        if isinstance(self.legal, np.ndarray):
            start = int(getattr(self.point.definition.action_space, "start", 0))
            never = tuple((np.flatnonzero(~self.legal) + start).tolist())
        if not self.decisions and point not in called:
            report.add("never_called", point=point)
        if self.unfit:
            report.add("outside", self.unfit, point=point)
        if never:
            report.add("never_legal", f"actions {', '.join(map(str, never[:10]))}", point=point)
        if rewards and rewards.minimum == rewards.maximum and self.values["reward"][0] > 1:
            name = "same_rewards" if rewards.minimum else "zero_rewards"
            report.add(
                name, f"{self.values['reward'][0]} rewards of {rewards.mean:.6g}", point=point
            )
        agents, observations = (
            self.point.agent or "agents named by each call",
            tuple(chain(*ranges.values())),
        )
        return PointStatistics(point, agents, self.decisions, observations, rewards, never)


def _collect(
    records: Mapping[Any, PointRecord], acted: dict[str, Any], env: Any, agent: str, step: Any
) -> None:
    """Record a step of an episode. Rewards count only for agents that have acted in it."""
    bound = env._point(agent)
    record = records[bound.hook.name, bound.agent]
    observation, reward, terminated, truncated, info = step
    record.record("observation", observation)
    space = env.observation_space(agent)
    if not record.unfit and not space.contains(observation):
        record.unfit = f"{agent} has observed {short_repr(observation)}; the space is {space}"
    if agent in acted:
        record.record("reward", reward)
    acted[agent] = bound
    if not (terminated or truncated):
        record.decisions += 1
        if isinstance(info.get(MASK), np.ndarray):
            record.legal = record.legal | info[MASK].astype(bool)


def check_episodes(subject: Subject, report: Report) -> None:
    """Play episodes with random legal actions.

    Collect statistics; compare episodes of the same seed.
    """
    records = {(bound.hook.name, bound.agent): PointRecord(bound) for bound in subject.plan.active}
    first, failures = None, 0
    acted: dict[str, Any] = {}
    with report.opened(subject, max_steps=subject.max_steps) as env:
        seeds = islice(chain(subject.seeds, count(max(subject.seeds) + 1)), subject.episodes)
        for number, seed in enumerate(seeds, 1):
            if subject.late or failures == 3:
                break
            acted.clear()
            run = subject.run_randomly(env, seed, collect=partial(_collect, records, acted))
            if run.error is not None:
                failures += 1
                report.add_error(run, f"in episode {number} of random legal actions, seed {seed}")
                if isinstance(run.error, LimitReached):
                    break
                continue
            if number == 1:
                first = run
                _compare_generators(
                    report, env.simulation, [agent for agent in acted if acted[agent].agent is None]
                )
            report.episodes[run.result if len(run.actions) < subject.max_steps else "cut"] += 1
        called = {name for run in subject.plain.values() for name in run.calls}
        report.statistics = tuple(record.results(report, called) for record in records.values())
        episodes = sum(report.episodes.values())
        if episodes:
            report.checked.append(f"{episodes} episodes of random legal actions in the AEC view")
        if report.episodes["cut"] == episodes > 0:
            report.add("cut_runs", most=subject.max_steps)
        if first is not None and not failures and subject.repeats:
            _compare_episodes(subject, report, env, first)
        subject.play(partial(env.reset, seed=subject.seeds[0]))  # to be closed in mid-episode


def _compare_generators(report: Report, simulation: Any, entities: list[str]) -> None:
    """Report fewer generators than entities that decide.

    A model without any was reported before.
    """
    generators = list(generators_of(simulation))
    number = sum(len(found) if isinstance(found, Streams) else 1 for found in generators)
    if 0 < number < len(entities):
        report.add(
            "few_generators",
            f"{number} for {len(entities)} agents, {entities[0]} and {entities[1]} among them",
        )


def _compare_episodes(subject: Subject, report: Report, used: Any, first: Run) -> None:
    """Compare the first episode with episodes of its seed in a new environment, in a used one, and beside another."""
    seed = subject.seeds[0]
    with report.opened(subject, max_steps=subject.max_steps) as new:
        subject.run_randomly(used, seed, most=1 + len(first.calls) // 2)  # broken off
        for name, env, beside in (
            ("unrepeatable", new, None),
            ("left_over", used, None),
            ("disturbance", new, used),
        ):
            again = subject.run_randomly(env, seed, beside=beside)
            if again.error is not None:
                report.add_error(again, "after an episode that was closed in mid-episode")
            if again.error is not None or subject.late or (beside and subject.drawn):
                return
            difference = first.difference(again)
            if difference:
                sources = subject.sources_of_chance() if name == "unrepeatable" else ""
                report.add(name, f"seed {seed}, the same actions: {difference}{sources}")
                return
        other = subject.run_randomly(used, seed, salt=1)
        if (
            len(other.calls) > 1
            and repr(first.actions) != repr(other.actions)
            and not first.difference(other)
        ):
            report.add("no_effect", f"seed {seed}, {len(first.actions)} actions")
    report.checked.append(
        "the same seed and actions in a new environment, in a used one, and beside another one"
    )


# -- the tests of PettingZoo and Gymnasium --------------------------------------------------------

_TESTS: Final[tuple[tuple[str, str, Callable[[Callable[[], Any]], Any]], ...]] = (
    ("PettingZoo's api_test", "aec", lambda make: api_test(make(), num_cycles=50)),
    ("seed_test", "aec", lambda make: seed_test(make, num_cycles=20)),
    ("parallel_api_test", "parallel", lambda make: parallel_api_test(make(), num_cycles=50)),
    ("parallel_seed_test", "parallel", lambda make: parallel_seed_test(make, num_cycles=20)),
    (
        "Gymnasium's check_env (single view)",
        "single",
        lambda make: check_env(make(), skip_render_check=True),
    ),
    (
        "Gymnasium's check_env (joint view)",
        "joint",
        lambda make: check_env(make(), skip_render_check=True),
    ),
)
"""The tests and their views; each test is called with a factory of environments."""


def check_conformance(subject: Subject, report: Report) -> None:
    """Run the tests of PettingZoo and Gymnasium, unless errors were found that they would only repeat."""
    passed = []
    for name, view, test in _TESTS:
        failed = any(finding.severity == "error" for finding in report.findings)
        if (
            failed
            or subject.late
            or view not in subject.views
            or (subject.drawn and "seed" in name)
        ):
            continue
        make = partial(make_environment, subject.plan, view, max_steps=subject.max_steps)
        run = subject.play(partial(test, make))
        if run.error is None:
            passed.append(name)
        elif isinstance(run.error, AssertionError):
            report.add("failed_test", describe_with_place(run.error), test=name)
        # tests ignore masks, or that these change
        elif not isinstance(run.error, (LimitReached, InvalidActionError)):
            report.add_error(run, f"in {name}", view)
    if passed:
        report.checked.append(", ".join(passed))


CHECKS: Final[tuple[Callable[[Subject, Report], None], ...]] = (
    check_plain_runs,
    check_repeated_run,
    check_views,
    check_episodes,
    check_conformance,
)
"""All checks, the more basic first: if the plain run fails, the others are left out."""
