"""The checks: functions of a ``Subject`` and a ``Report``. Each adds what it finds to the report."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property, partial, wraps
from itertools import chain, count, islice, product
from statistics import fmean
from typing import Any, Final

from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

from ..errors import AgentError, InvalidActionError, SimEnvError, error_notes, error_text
from ..simulation import RULE, takes
from .fingerprint import ABSENT, alike, describe_differences, general
from .internals import Plan, fitting_views, make_environment, make_simulation, redefined
from .report import EpisodeStatistics, Finding, PointStatistics, Timing, finding, finding_names
from .runs import (
    Run,
    Runner,
    TimeUp,
    describe_with_place,
    drawn_since,
    global_generators,
    place_of,
    play_rules,
    seed_global_generators,
    within,
)
from .statistics import collecting


@dataclass(kw_only=True)
class Subject(Runner):
    """A simulation with its decision points and options, the parameters of the check, and what is known so far."""

    seeds: tuple[int, ...]
    episodes: int
    end: float  # of the time limit, as time.monotonic()
    plain: dict[int, Run] = field(default_factory=dict)  # plain runs, by seed
    playable: bool = False  # whether plain runs decide something and end
    repeats: bool = True  # whether the same seed gives the same plain run
    drawn: set[str] = field(default_factory=set)  # the global generators that it draws from

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        return time.monotonic() >= self.end

    @cached_property
    def views(self) -> tuple[str, ...]:
        """The views that its plan allows."""
        return fitting_views(self.plan)

    @property
    def rules(self) -> dict[Any, Any] | None:
        """The option ``policies`` with the rule in place of each policy."""
        return dict.fromkeys(self.plan.options.policies or (), RULE) or None


@dataclass
class Report:
    """A report while it is written."""

    findings: list[Finding] = field(default_factory=list)
    checked: list[str] = field(default_factory=list)
    observations: tuple[PointStatistics, ...] = ()
    episodes: EpisodeStatistics = field(default_factory=EpisodeStatistics)
    timing: Timing | None = None
    errors: set[tuple[str, str]] = field(default_factory=set)  # by kind and place

    @property
    def has_errors(self) -> bool:
        """Whether there is a finding of severity "error"."""
        return any(finding.severity == "error" for finding in self.findings)

    def add(self, name: str, evidence: str = "", **words: Any) -> None:
        """Add a finding, as ``finding`` makes it."""
        self.findings.append(finding(name, evidence, **words))

    def add_error(self, error: BaseException, where: str, name: str = "model_error") -> None:
        """Add the finding for an exception; the same one from the same place is reported once."""
        kind = type(error).__name__
        key = kind, place_of(error) or error_text(error)
        if key in self.errors:
            return
        self.errors.add(key)
        if isinstance(error, AgentError) and "after its end" in error_text(error):
            name = "revival"
        elif isinstance(error, SimEnvError) and kind in finding_names():
            name = kind
        notes = [note.removeprefix("simenv_marl: ") for note in error_notes(error)]
        self.add(name, "\n".join([f"{where}: {describe_with_place(error)}", *notes[:2]]), kind=kind)

    def add_unrepeatable(self, subject: Subject, evidence: str) -> None:
        """Add the finding that two runs of the same seed differ."""
        sources = [f"in the model, {source}" for source in subject.sources_of_chance(subject.seeds[0])]
        self.add("unrepeatable", "\n".join([evidence, *[source for source in sources if "global" not in source][:4]]))

    @contextmanager
    def opened(self, subject: Subject, view: str = "aec", plan: Plan | None = None, **options: Any) -> Iterator[Any]:
        """Make an environment, which is closed at the end."""
        env = make_environment((plan or subject.plan).amended(options), view)
        try:
            yield env
        finally:
            closing = Run().play(subject.seconds, env.close)
            if isinstance(closing.error, TimeUp):
                self.add("unclosable")
            elif closing.error is not None:
                self.add_error(closing.error, "when an environment was closed in mid-episode")


# -- the simulation by itself ---------------------------------------------------------------------


def check_plain_runs(subject: Subject, report: Report) -> None:
    """Check that the simulation runs without an environment, and decides something."""
    if not takes(make_simulation(subject.plan.source).reset, "seed"):
        report.add("unseeded_reset")
    for seed in subject.seeds:
        seed_global_generators(seed)
        run = subject.plain[seed] = subject.run_plainly(seed)
        if not subject.plan.options.global_rng:
            subject.drawn |= run.drawn
        where = f"in a plain run without any environment, seed {seed}"
        if isinstance(run.error, TimeUp):
            where += f", after {len(run.entries)} decisions and {subject.seconds:.3g} seconds"
            report.add("slow" if run.entries else "hanging", where)
            return
        if run.error is not None:
            report.add_error(run.error, where)
            return
    if not any(run.entries for run in subject.plain.values()):
        points = ", ".join(bound.point.name for bound in subject.plan.active)
        report.add("no_decision", f"plain runs with seeds {', '.join(map(str, subject.seeds))}", points=points)
        return
    subject.playable = True
    if any(run.cut for run in subject.plain.values()):
        report.add("cut_runs", most=subject.max_steps)


def check_repeated_run(subject: Subject, report: Report) -> None:
    """Run a seed again: differences then are not due to environments."""
    seed = subject.seeds[0]
    first = subject.plain[seed]
    # If it draws from the global generators, run it with these in another state, too.
    runs = []
    for other_seed in (seed, seed + 1) if subject.drawn else (seed,):
        seed_global_generators(other_seed)
        runs.append(subject.run_plainly(seed))
        if isinstance(runs[-1].error, TimeUp):
            return
    if subject.drawn:
        differs = first.difference(runs[1]) or subject.differences(first, runs[1])
        sources = "; ".join(source for source in subject.sources_of_chance(seed) if "global" in source)
        names = " and ".join(sorted(subject.drawn))
        report.add("unseeded_generators" if differs else "shared_generators", sources, names=names)
    parts = subject.differences(first, runs[0])
    generators = [part for part in parts if "state of the generator" in part[0]]
    difference = first.difference(runs[0]) or describe_differences(generators[:1])
    if difference:
        subject.repeats = False
        report.add_unrepeatable(subject, f"two plain runs of seed {seed}: {difference}")
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
    compared: dict[str, set[str]] = {driver: set() for driver in drivers}
    for driver, view, seed in product(drivers, subject.views, subject.plain):
        if subject.late or not subject.plain[seed].entries:
            continue
        seed_global_generators(seed)
        with report.opened(subject, view, driver=driver, policies=subject.rules, max_steps=None) as env:
            seed_global_generators(seed)
            run = subject.run_rules(env, seed)
        where = f"{view} view, driver {driver}, seed {seed}"
        if isinstance(run.error, TimeUp):
            report.add("slow", where)
            break
        if run.error is None:
            compared[driver].add(view)
            if not _is_alike(subject, report, seed, run, where):
                break
        elif not (view == "joint" and isinstance(run.error, AgentError)):  # that view needs to know all agents
            report.add_error(run.error, f"in the {where}, with RULE throughout")
    views = "; ".join(f"{driver}: {', '.join(v for v in subject.views if v in compared[driver])}" for driver in drivers)
    most = max(len(run.entries) for run in subject.plain.values())
    seeds = ", ".join(map(str, subject.seeds))
    report.checked.append(f"plain runs against RULE throughout ({views}; seeds {seeds}; up to {most} decisions each)")
    state = subject.plain[subject.seeds[0]].fingerprint
    if state is not None:
        left_out = f"; cannot be compared: {', '.join(sorted(state.left_out)[:6])}" if state.left_out else ""
        report.checked.append(f"what the simulation holds afterwards: {len(state.parts)} parts{left_out}")


def _is_alike(subject: Subject, report: Report, seed: int, run: Run, where: str) -> bool:
    """Compare a run in an environment with the plain run, and report a difference."""
    plain = subject.plain[seed]
    if report.timing is None and not plain.cut:
        report.timing = Timing(*(1e6 * one.seconds / len(plain.entries) for one in (plain, run)))
    if run.drawn - subject.drawn:
        report.add("drawing_mappings", names=" and ".join(sorted(run.drawn - subject.drawn)))
        subject.drawn |= run.drawn
    words = ("alone", "in the environment")
    decisions, parts = plain.difference(run, *words), subject.differences(plain, run)
    if not decisions and not parts:
        return True
    only_more = not decisions and all(here is ABSENT for _, here, _ in parts)
    difference = decisions or describe_differences(parts, *words)
    evidence = "\n".join([f"{where}: {difference}", *_mappings_at_fault(subject, report, seed)])
    report.add("writing_mappings" if only_more else "changed_model", evidence)
    return False


def _mappings_at_fault(subject: Subject, report: Report, seed: int) -> list[str]:
    """Play the AEC view once more, and compare the model before and after each call of a mapping."""
    found: dict[str, str] = {}
    simulations: list[Any] = []

    def watched(name: str, mapping: Any) -> Any:
        @wraps(mapping)
        def watching(*args: Any, **kwargs: Any) -> Any:
            if name in found or not simulations:
                return mapping(*args, **kwargs)
            before, states = subject.look(simulations[0]), global_generators()
            value = mapping(*args, **kwargs)
            changed = before.differences(subject.look(simulations[0]), subject.unstable)
            if changed:
                found[name] = f"the {name} changes {changed[0][0]}"
            elif drawn_since(states):
                found[name] = f"the {name} draws from a global generator"
            return value

        return watching

    def redefine(bound: Any) -> Any:
        names = ("observation_space_mapping", "reward_mapping", "choices", "action_mask_mapping", "agent")
        mappings = {name: getattr(bound.definition, name) for name in names}
        changes = {name: watched(f"{name} of {bound.point.name}", m) for name, m in mappings.items() if callable(m)}
        return replace(bound.definition, **changes)

    plan = redefined(subject.plan, redefine)
    with report.opened(subject, plan=plan, policies=subject.rules, max_steps=50) as env:
        simulations.append(env.simulation)
        seed_global_generators(seed)
        Run().play(subject.seconds, partial(play_rules, env, seed))  # an error may end it early
    return list(found.values())


# -- episodes of random legal actions -------------------------------------------------------------


def check_episodes(subject: Subject, report: Report) -> None:
    """Play episodes with random legal actions; collect statistics; compare episodes of the same seed."""
    plan, collectors = collecting(subject.plan)
    known: dict[int, Run] = {}
    lengths: list[int] = []
    ends = {"terminated": 0, "truncated": 0, "cut": 0}
    failures = 0
    with report.opened(subject, plan=plan, max_steps=subject.max_steps) as env:
        seeds = islice(chain(subject.seeds, count(max(subject.seeds) + 1)), subject.episodes)
        for number, seed in enumerate(seeds, 1):
            if subject.late or failures == 3:
                break
            run = subject.run_randomly((env, seed))[0]
            where = f"in episode {number} of random legal actions, seed {seed}"
            if isinstance(run.error, TimeUp):
                stalled = time.monotonic() - run.latest > subject.seconds / 2
                report.add("standstill" if stalled else "slow", f"{where}, after {len(run.entries)} steps")
                failures = 3
            elif run.error is not None:
                failures += 1
                report.add_error(run.error, where, "action_error")
            if run.error is not None:
                continue
            if number <= max(2, len(subject.seeds)):
                known[seed] = run
            for collector in collectors:
                collector.add_episode(run.entries)
            lengths.append(len(run.actions))
            truncated = bool(run.entries) and run.entries[-1][1].truncated
            cut = truncated and lengths[-1] >= subject.max_steps
            ends["cut" if cut else "truncated" if truncated else "terminated"] += 1
        results = [collector.results() for collector in collectors]
        report.observations = tuple(statistics for statistics, _ in results)
        if lengths:
            report.episodes = EpisodeStatistics(len(lengths), min(lengths), max(lengths), fmean(lengths), **ends)
            report.findings += chain.from_iterable(findings for _, findings in results)
            if ends["cut"] == len(lengths):
                report.add("endless", most=subject.max_steps)
            report.checked.append(f"{len(lengths)} episodes of random legal actions in the AEC view")
        if known and not failures and subject.repeats:
            _compare_episodes(subject, report, env, known)
        if not report.has_errors:
            Run().play(subject.seconds, partial(env.reset, seed=subject.seeds[0]))
            report.checked.append("an environment that is closed in mid-episode")


def _compare_episodes(subject: Subject, report: Report, used: Any, known: dict[int, Run]) -> None:
    """Compare episodes of the same seed: in a new environment, in a used one, and beside another one."""
    seed, first = next(iter(known.items()))
    new = partial(report.opened, subject, max_steps=subject.max_steps)
    with new() as fresh, new() as beside:
        for env in (fresh, used):
            again = subject.run_randomly((env, seed))[0]
            if isinstance(again.error, TimeUp) or subject.late:
                return
            difference = first.difference(again)
            if difference and env is fresh:
                report.add_unrepeatable(subject, f"two environments, seed {seed}, the same actions: {difference}")
                return
            if difference:
                left_over = within(subject.seconds, partial(_left_over, subject, beside, used, seed))
                report.add("left_over", f"seed {seed}, the same actions: {difference}{left_over}")
                return
        if not subject.drawn:
            _compare_side_by_side(subject, report, (fresh, beside), known)
            _compare_actions(subject, report, used, seed, first)
        _compare_seeds(subject, report, known)
    report.checked.append("the same seed and actions in a new environment, in a used one, and beside another one")


def _left_over(subject: Subject, new: Any, used: Any, seed: int) -> str:
    """Describe what a used simulation holds after a reset, and a new one does not."""
    looks = []
    for env in (new, used):
        seed_global_generators(seed)
        env.reset(seed=seed)
        looks.append(subject.look(env.simulation))
    parts = looks[0].differences(looks[1], subject.unstable)
    return f"\nafter reset, {describe_differences(parts, 'at first', 'later')}" if parts else ""


def _compare_side_by_side(subject: Subject, report: Report, envs: tuple[Any, Any], known: dict[int, Run]) -> None:
    """Step two environments in turns, and compare their episodes with those of each alone."""
    seeds = list(known)[:2]
    runs = subject.run_randomly(*zip(envs, seeds, strict=False))
    if isinstance(runs[-1].error, TimeUp):
        return
    for seed, run in zip(seeds, runs, strict=True):
        difference = known[seed].difference(run)
        if difference:
            report.add("disturbance", f"seeds {', '.join(map(str, seeds))}: {difference}")
            return


def _compare_seeds(subject: Subject, report: Report, known: dict[int, Run]) -> None:
    """Report if all seeds give the same episode, but for attributes that are the seed itself."""
    seed, *others = [seed for seed in known if seed in subject.plain]
    for other in others:
        plain, start = subject.plain[seed], Run(known[seed].entries[:1])
        parts = subject.differences(plain, subject.plain[other])
        if plain.difference(subject.plain[other]) or start.difference(Run(known[other].entries[:1])):
            return
        if any((str(here), str(there)) != (str(seed), str(other)) for _, here, there in parts):
            return
    if others:
        report.add("same_seeds", f"seeds {', '.join(map(str, known))}")


def _compare_actions(subject: Subject, report: Report, env: Any, seed: int, first: Run) -> None:
    """Play other actions with the same seed, and report if they change nothing."""
    other = subject.run_randomly((env, seed), salt=1)[0]
    if len(other.entries) > 1 and not alike(first.actions, other.actions) and not first.difference(other):
        report.add("no_effect", f"seed {seed}, {len(first.actions)} actions")


# -- the tests of PettingZoo and Gymnasium --------------------------------------------------------

_TESTS: Final[tuple[tuple[str, str, Callable[[Callable[[], Any]], Any]], ...]] = (
    ("PettingZoo's api_test", "aec", lambda make: api_test(make(), num_cycles=50)),
    ("seed_test", "aec", lambda make: seed_test(make, num_cycles=20)),
    ("parallel_api_test", "parallel", lambda make: parallel_api_test(make(), num_cycles=50)),
    ("parallel_seed_test", "parallel", lambda make: parallel_seed_test(make, num_cycles=20)),
    ("Gymnasium's check_env (single view)", "single", lambda make: check_env(make(), skip_render_check=True)),
    ("Gymnasium's check_env (joint view)", "joint", lambda make: check_env(make(), skip_render_check=True)),
)
"""The tests and their views; each test is called with a factory of environments."""


def check_conformance(subject: Subject, report: Report) -> None:
    """Run the tests of PettingZoo and Gymnasium, unless errors were found that they would only repeat."""
    passed = []
    plan = subject.plan.amended({"max_steps": subject.max_steps})
    seed_global_generators(0)
    for name, view, test in _TESTS:
        skipped = report.has_errors or view not in subject.views or (subject.drawn and "seed" in name)
        if subject.late or skipped:
            continue
        error = Run().play(subject.seconds, partial(test, partial(make_environment, plan, view))).error
        if error is None:
            passed.append(name)
        elif isinstance(error, AssertionError):
            report.add("failed_test", describe_with_place(error), test=name)
        # These tests ignore masks, or masks that change within a round; the joint view needs to know all agents.
        elif not isinstance(error, (TimeUp, InvalidActionError)) and not (
            view == "joint" and isinstance(error, AgentError)
        ):
            report.add_error(error, f"in {name}")
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
