"""The check of a simulation: its runs are compared, and each fault is a finding."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from operator import attrgetter
from typing import Any, Final

import numpy as np
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import (
    api_test,
    parallel_api_test,
    parallel_seed_test,
    seed_test,
)

from ..core import Streams, generators_of, pack
from ..envs import VIEWS, SimulationAECEnv
from ..errors import (
    AgentError,
    DefinitionError,
    InvalidActionError,
    MaskError,
    ObservationError,
    RewardError,
    SimEnvError,
    describe_error,
    error_text,
    short_repr,
)
from ..simulation import (
    RULE,
    Model,
    make_simulation,
    takes,
)
from .fingerprint import (
    ABSENT,
    STEP,
    Difference,
    describe_differences,
    differences,
    generalize,
    is_essential,
)
from .processes import run_elsewhere
from .records import PointRecord
from .report import (
    FINDINGS,
    SEVERITIES,
    CheckReport,
    Finding,
    PointStatistics,
    order_of,
)
from .runs import (
    LimitReached,
    Run,
    Runner,
    call_within,
    describe_with_place,
    place_of,
    seed_global_generators,
)
from .watch import Watch

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

_BLAMED: Final[dict[type[SimEnvError], str]] = {
    DefinitionError: "callable of labels",
    MaskError: "action_mask_mapping, or choices,",
    ObservationError: "observation_space_mapping",
    RewardError: "reward_mapping",
}
"""The mappings that errors of the library blame."""


@dataclass(kw_only=True)
class Check(Runner):
    """A check: a simulation, the limits of its runs, and the results so far.

    The time limit for all runs together is four times that for one.

    Attributes:
        seeds: The seeds of plain runs, and of the first episodes of random actions.
        most_episodes: The number of episodes of random actions.
        findings: The findings, with their names in ``FINDINGS``.
        checked, statistics, episodes: As in ``CheckReport``, but mutable.
        stage: The part of the check that is running, in words.
        refused: The reasons why the plan does not allow a view, by view.
        left_out: The tests that were left out, by reason.
        plain_runs: The plain runs by seed.
        views: The views that the plan allows. Empty if plain runs fail or decide nothing.
        unstable: Parts of the fingerprint that are not compared.
        sources: The global generators that the simulation uses, by name.
    """

    seeds: list[int]
    most_episodes: int

    def __post_init__(self) -> None:
        """Begin the check."""
        self.findings: dict[Finding, str] = {}
        self.checked: list[str] = []
        self.statistics: list[PointStatistics] = []
        self.episodes = {"terminated": 0, "truncated": 0, "cut": 0}
        self.plain_runs: dict[int, Run] = {}
        self.views: list[str] = []
        self.unstable: set[str] = set()
        self.sources: set[str] = set()
        self.stage = "while the simulation was made"
        self.refused: dict[str, str] = {}
        self.left_out: dict[str, list[str]] = {}
        self._errors: set[tuple[str, str]] = set()  # by class and place
        self._deadline = time.monotonic() + 4 * self.seconds

    def run(self) -> None:
        """Run the checks within the time limit.

        Raises:
            SimEnvError: The simulation, the points or an option is invalid.
        """
        try:
            call_within(4 * self.seconds, self.run_checks)
        except LimitReached:
            pass
        except SimEnvError:
            raise
        except (Exception, SystemExit) as error:  # of the model's constructor, for example
            self.add_error(error, "while the simulation was made or reset")
        self.check_conformance()
        self.check_hash_seeds()
        if self.is_late:
            self.add("out_of_time", f"after {4 * self.seconds:g} seconds, {self.stage}")

    def run_checks(self) -> None:
        """Run the checks, the more basic first: if plain runs fail, the others are left out.

        Raises:
            Exception: A simulation cannot be made, or the arguments of the check are invalid.
        """
        self.make_environment("aec")
        self.check_plain_runs()
        if not any(run.error for run in self.plain_runs.values()):
            self.check_repetition()
            self.check_rules()
        if self.views:
            self.check_views()
            for drawn in (0, 1):
                known = {"backward_clock", "standing_clock"} & {*self.findings.values()}
                if not (self.is_late or known):
                    self.check_clock(drawn, self.max_steps)
            self.check_episodes()

    def report(self, simulation: str) -> CheckReport:
        """Return the report of a simulation with a name."""
        runs = list(self.plain_runs.values())
        for reason, tests in self.left_out.items():
            # The rest is a remedy, for those who want that view.
            because, _, _ = reason.partition(";")
            self.checked.append(f"Left out: {', '.join(tests)}, because {because}")
        return CheckReport(
            simulation=simulation,
            findings=tuple(sorted(self.findings, key=lambda f: SEVERITIES.index(f.severity))),
            checked=tuple(self.checked),
            statistics=tuple(self.statistics),
            episodes=self.episodes,
            calls=order_of(runs[0].calls) if runs else "",
        )

    @property
    def is_late(self) -> bool:
        """Whether the time is up."""
        return time.monotonic() >= self._deadline

    @property
    def left(self) -> float:
        """The time limit of a test, in seconds."""
        return max(0.0, min(self.seconds, self._deadline - time.monotonic()))

    @property
    def obstacle(self) -> str:
        """The reason why no further tests run; empty if they do."""
        if any(finding.severity == "error" for finding in self.findings):
            return "there are errors"
        return "the time is up" if self.is_late else ""

    def add(
        self,
        name: str,
        evidence: str = "",
        **words: str,
    ) -> None:
        """Add a finding of ``FINDINGS``; ``words`` replace the placeholders of its text."""
        words["most"] = str(self.max_steps)
        words["generators"] = " and ".join(sorted(self.sources))
        severity, *texts = FINDINGS[name]
        title, explanation = (" ".join(text.format(**words).split()) for text in texts)
        self.findings[Finding(severity, title, explanation, evidence)] = name

    def add_error(self, error: BaseException, where: str) -> None:
        """Add an error, once for each place."""
        kind = type(error).__name__
        key = kind, place_of(error) or error_text(error)
        if key not in self._errors:
            self._errors.add(key)
            source = self.mapping_of(error)
            name = "mapping_raises" if source else "raises"
            self.add(name, f"{where}: {describe_with_place(error)}", kind=kind, source=source)

    def mapping_of(self, error: BaseException) -> str:
        """Return the mapping that has raised an error, or that it blames; empty for the model."""
        for kind, name in _BLAMED.items():
            if isinstance(error, kind):
                return f"The {name}"
        codes = [frame.f_code for frame, _ in traceback.walk_tb(error.__traceback__)]
        # A function, the function of a partial one, or that of an object.
        forms = [attrgetter(f"{form}__code__") for form in ("", "func.", "__call__.")]
        for point, code_of in product(self.plan.points, forms):
            for name, part in vars(point.definition).items():
                with suppress(AttributeError):
                    if code_of(part) in codes:
                        return f"The {name} of {point.hook.name}"
        return ""

    def fails(
        self,
        run: Run,
        where: str,
        view: str = "aec",
    ) -> bool:
        """Return whether a run has failed, and add its error."""
        error = run.error
        if isinstance(error, LimitReached):
            evidence = f"{where}, after {len(run.calls)} steps"
            with suppress(Exception):  # the simulation may have no clock
                evidence += f", at the simulated time {run.simulation.time():g}"
            if run.is_stuck:
                self.add("stuck", f"{evidence} ({place_of(error) or 'in another thread'})")
            elif not self.is_late:  # else the end of the check adds it
                self.add("out_of_time", evidence)
        # The joint view may be unable to know all agents.
        elif error is not None and not (view == "joint" and isinstance(error, AgentError)):
            self.add_error(error, where)
        return error is not None

    @contextmanager
    def environment(self, view: str = "aec", **options: Any) -> Iterator[Any]:
        """Make an environment, and close it at the end."""
        env = self.make_environment(view, **options)
        try:
            yield env
        finally:
            self.fails(self.call(env.close), "when an environment was closed in mid-episode")

    def differences(self, run: Run, other: Run) -> list[Difference]:
        """Return the differences between two runs."""
        return differences(run.parts, other.parts, self.unstable)

    def repeats(
        self,
        first: Run,
        again: Run,
        name: str,
        where: str,
    ) -> bool:
        """Return whether a run repeats another one; else add the finding with a name."""
        parts = self.differences(first, again)
        if parts:
            sources = self.sources_of_chance(self.seeds[0]) if name == "unrepeatable" else ""
            self.add(name, f"{where}: {describe_differences(parts)}{sources}")
        return not parts

    # -- the simulation by itself -----------------------------------------------------------------

    def check_plain_runs(self) -> None:
        """Check that the simulation runs without an environment, and decides something."""
        if not takes(make_simulation(self.plan.subject.source).reset, "seed"):
            self.add("unseeded_reset")
        for seed in self.seeds:
            self.stage = f"in a plain run without any environment, seed {seed}"
            run = self.run_plainly(seed)
            self.plain_runs[seed] = run
            self.sources |= run.draws
            if self.fails(run, self.stage):
                return
        first, *others = self.plain_runs.values()
        for name, place in first.early.items():
            # A reset that calls more of the model may play its history, which no agent decides.
            is_direct = place.endswith(("in reset", "in __init__"))
            self.add("early_decisions" if is_direct else "history", place, point=name)
        if not any(run.calls for run in (first, *others)):
            points = ", ".join(point.hook.name for point in self.plan.active)
            self.add("no_decision", points=points)
            return
        self.refused = self.refused_views()
        self.views = [view for view in VIEWS if view not in self.refused]
        if any(run.is_cut for run in (first, *others)):
            self.add("cut_runs")
        if others and not any(self.differences(first, run) for run in others):
            self.add("same_seeds", f"seeds {', '.join(map(str, self.seeds))}")

    def check_repetition(self) -> None:
        """Repeat a plain run: if it differs, differences of environments mean nothing."""
        seed = self.seeds[0]
        self.stage = f"in another plain run of seed {seed}"
        first = self.plain_runs[seed]
        again = self.run_plainly(seed)
        # Other states of the global generators show whether the model seeds them.
        other = self.run_plainly(seed, seed + 1) if self.sources else again
        if any(self.fails(run, "in another plain run") for run in (again, other)):
            return
        if self.sources:
            differs = self.differences(first, other)
            name = "unseeded_generators" if differs else "shared_generators"
            self.add(name, self.sources_of_chance(seed).lstrip())
        parts = self.differences(first, again)
        paths = {part.path for part in parts}
        self.unstable = {generalize(path) for path in paths if not is_essential(path)}
        if self.repeats(first, again, "unrepeatable", f"two plain runs of seed {seed}") and parts:
            self.add("unstable", describe_differences(parts))

    def check_rules(self) -> None:
        """Check the rules for effects and waits that an action does not have."""
        self.stage = "in a plain run whose rules are watched"
        watch = Watch(self.state_of, self.plan)
        self.run_plainly(self.seeds[0], run=watch)
        for kind in watch.overriding - watch.deciding:
            self.add("silent_override", kind=f"{kind.__module__}.{kind.__qualname__}")
        points = {point.hook: point for point in self.plan.active}
        for (finding, hook), evidence in watch.found.items():
            # An apply takes the place of the rule, with its effects, and may wait as well.
            point = points.get(hook)
            if point is None:
                continue
            fits = finding != "settings" and point.applies
            if fits and finding != "changing_rule":
                fits = self.apply_waits(point, self.seeds[0])
            if not fits:
                self.add(finding, evidence, point=hook.name)

    # -- environments with RULE throughout --------------------------------------------------------

    def check_views(self) -> None:
        """Compare plain runs with each view and driver under ``RULE``, to the first difference."""
        if self.is_unrepeatable:
            return
        options = self.plan.options
        drivers = ["greenlet", "thread"] if options.driver == "greenlet" else [options.driver]
        # Rules take all decisions, because plain runs have no policies.
        policies = dict.fromkeys(options.policies or (), RULE) or None
        rules = {"policies": policies, "max_steps": None, "skip_forced": False}
        for driver, view, seed in product(drivers, self.views, self.seeds):
            plain = self.plain_runs[seed]
            if self.is_late:
                return
            if not plain.calls:
                continue
            seed_global_generators(seed)
            where = f"{view} view, driver {driver}, seed {seed}"
            self.stage = f"in the {where}, with RULE throughout"
            with self.environment(view, driver=driver, **rules) as env:
                run = self.record_rules(partial(Run.play_rules, env=env, seed=seed), seed)
            if self.fails(run, self.stage, view):
                continue
            if run.draws - self.sources:
                self.sources |= run.draws
                self.add("unseeded_generators", f"in the {where}")
            parts = self.differences(plain, run)
            name = "changed_model"
            if all(part.first is ABSENT and not is_essential(part.path) for part in parts):
                name = "writing_mappings"
            if not self.repeats(plain, run, name, f"plain run, then {where}"):
                return
        most = max(len(run.calls) for run in self.plain_runs.values())
        held = [path for path in plain.parts if not path.startswith(STEP)]
        self.checked.append(
            f"plain runs against RULE throughout ({', '.join(self.views)}; drivers"
            f" {', '.join(drivers)}; seeds {', '.join(map(str, self.seeds))}; up to {most}"
            f" decisions each): the decisions, and {len(held)} parts that the simulation holds then"
        )

    def check_clock(self, drawn: int, most: int) -> None:
        """Check that the times of an episode go on.

        The episode has at most ``most`` decisions, of ``drawn`` random actions, or of ``RULE``.
        """
        self.stage = f"in an episode of {'random actions' if drawn else 'RULE throughout'}"
        with self.environment(max_steps=most) as env:
            run = self.run_randomly(env, self.seeds[0], drawn=drawn)
        times = run.times
        for before, now in pairwise(times):
            if not now >= before:  # NaN is no time
                self.add("backward_clock", f"{self.stage}: from {before:g} to {now:g}")
                return
        half = most // 2
        is_one_time = len(times) == most and len(set(times[half:])) == 1
        if not is_one_time or 10 * len(set(run.calls[half:])) > half:
            return
        # A longer episode tells a loop from many decisions at one time.
        if most == self.max_steps:
            self.check_clock(drawn, 10 * most)
        else:
            self.add("standing_clock", f"{self.stage}: {most} decisions, the last at {times[-1]:g}")

    @property
    def is_unrepeatable(self) -> bool:
        """Whether the same seed does not give the same run."""
        return "unrepeatable" in self.findings.values()

    # -- episodes of random legal actions ---------------------------------------------------------

    def check_episodes(self) -> None:
        """Play episodes with random legal actions, and compare episodes of the same seed."""
        records = {point.hook: PointRecord(point) for point in self.plan.active}
        later = range(max(self.seeds) + 1, max(self.seeds) + 1 + self.most_episodes)
        seeds = [*self.seeds, *later][: self.most_episodes]
        with self.environment(max_steps=self.max_steps) as env:
            for number, seed in enumerate(seeds, 1):
                if self.is_late:
                    break
                self.stage = f"in episode {number} of random legal actions, seed {seed}"
                run = self.run_randomly(env, seed)
                actors = set()
                for agent, result in run.results:
                    record = records[agent.point.hook]
                    record.add(agent.name, result)
                    if agent.name in actors:
                        record.tally("reward", result[1])
                    actors.add(agent.name)
                if self.fails(run, self.stage):
                    if isinstance(run.error, LimitReached):
                        break
                    continue
                if number == 1:
                    first = run
                    self.check_generators(run, env.simulation)
                self.episodes["cut" if len(run.actions) == self.max_steps else run.end] += 1
            for record in records.values():
                self.conclude(record)
            episodes = sum(self.episodes.values())
            if episodes:
                self.checked.append(f"{episodes} episodes of random legal actions in the AEC view")
            if self.episodes["cut"] == episodes > 0:
                self.add("cut_runs")
            if episodes == len(seeds) and not self.is_unrepeatable:
                self.stage = "when an episode was repeated"
                self.compare_episodes(env, first)
            self.call(partial(env.reset, seed=seeds[0]))  # to close it in mid-episode

    def conclude(self, record: PointRecord) -> None:
        """Add the statistics of a decision point, and their findings."""
        statistics = record.statistics()
        self.statistics.append(statistics)
        point = statistics.point
        if not (record.decisions or any(point in run.calls for run in self.plain_runs.values())):
            self.add("never_called", point=point)
        # NaN makes sums NaN, infinite numbers make them infinite.
        infinite = [r for r in statistics.observations if not np.isfinite(r.minimum + r.maximum)]
        if infinite:
            self.add("not_finite", "; ".join(map(str, infinite[:3])), point=point)
        elif record.outside:
            self.add("outside", record.outside, point=point)
        if any(self.episodes.values()) and record.decisions > 1 and record.is_blind():
            self.add("same_observations", f"always {short_repr(record.first)}", point=point)
        if statistics.never_legal:
            actions = ", ".join(map(str, statistics.never_legal[:10]))
            self.add("never_legal", f"actions {actions}", point=point)
        rewards = record.tallies.get("reward")
        if rewards is not None and rewards.low == rewards.high and rewards.number > 1:
            name = "same_rewards" if rewards.low else "zero_rewards"
            self.add(
                name,
                f"{rewards.number} rewards of {rewards.total / rewards.number:.6g}",
                point=point,
            )

    def check_generators(self, run: Run, simulation: Model) -> None:
        """Add a finding if entities share generators, unless the model has no generator."""
        names = list({agent.name: None for agent, _ in run.results if agent.point.agent is None})
        generators = generators_of(simulation)
        number = sum(len(each) if isinstance(each, Streams) else 1 for each in generators)
        if 0 < number < len(names):
            evidence = f"{number} for {len(names)} agents, {names[0]} and {names[1]} among them"
            self.add("few_generators", evidence)

    def compare_episodes(self, used: SimulationAECEnv, first: Run) -> None:
        """Repeat an episode in a new environment, in a used one, and beside another one."""
        seed = self.seeds[0]
        with self.environment(max_steps=self.max_steps) as new:
            self.run_randomly(used, seed, most=1 + len(first.calls) // 2)
            for name, env, beside in (
                ("unrepeatable", new, None),
                ("left_over", used, None),
                ("disturbance", new, used),
            ):
                again = self.run_randomly(env, seed, beside=beside)
                if self.fails(again, "after an episode that was closed in mid-episode"):
                    return
                if self.is_late or (beside and self.sources):
                    return
                if not self.repeats(first, again, name, f"seed {seed}, the same actions"):
                    return
            other = self.run_randomly(used, seed, drawn=2)
            acts_alike = len(other.calls) <= 1 or repr(first.actions) == repr(other.actions)
            if not acts_alike and not self.differences(first, other):
                self.add("no_effect", f"seed {seed}, {len(first.actions)} actions")
        self.checked.append(
            "the same seed and actions in a new environment, in a used one, and beside another one"
        )

    # -- the tests of PettingZoo and Gymnasium ----------------------------------------------------

    def check_conformance(self) -> None:
        """Run the tests of PettingZoo and Gymnasium, and note why one was left out."""
        passed_tests = []
        for name, view, test in _TESTS:
            fits = "" if view in self.views else self.refused.get(view, "plain runs fail")
            shares = "the model draws from shared generators"
            reason = self.obstacle or fits or (shares if self.sources and "seed" in name else "")
            if not reason:
                self.stage = f"in {name}"
                make = partial(self.make_environment, view, max_steps=self.max_steps)
                run = Run().play(partial(test, make), self.left)
                if run.error is None:
                    passed_tests.append(name)
                elif isinstance(run.error, AssertionError):
                    self.add("failed_test", describe_with_place(run.error), test=name)
                # The tests ignore masks, changes of masks, and the bounds of some spaces.
                elif isinstance(run.error, InvalidActionError):
                    reason = f"of an illegal action: {error_text(run.error)}"
                elif isinstance(run.error, LimitReached):
                    reason = "it takes too long"
                else:
                    self.fails(run, self.stage, view)
            if reason:
                self.left_out.setdefault(reason, []).append(name)
        if passed_tests:
            self.checked.append(", ".join(passed_tests))

    # -- other processes --------------------------------------------------------------------------

    def check_hash_seeds(self) -> None:
        """Compare runs in new processes, whose sets of strings have another order."""
        reason = self.obstacle or ("" if self.views else "plain runs fail")
        if not reason:
            self.stage = "in new processes with other hash seeds"
            try:
                self.compare_processes()
            except Exception as error:  # pickling and the other process may raise anything
                reason = describe_error(error)
        if reason:
            self.left_out.setdefault(reason, []).append("runs with other hash seeds")

    def compare_processes(self) -> None:
        """Compare runs in new processes.

        Raises:
            Exception: The runs cannot be pickled, or a process fails.
        """
        runner = Runner(self.make_plan, self.max_steps, self.seconds, self.state_of)
        run = partial(run_elsewhere, pack((runner, self.seeds[0])), self.left)
        # Under these hash seeds, most sets of two short words have both orders.
        hash_seeds = (2, 6, 14, 34)
        first, *others = map(run, hash_seeds)
        parts = [part for other in others for part in differences(first, other)]
        if parts:
            # The same hash seed shows other differences of processes.
            again = {part.path for part in differences(first, run(hash_seeds[0]))}
            parts = [part for part in parts if part.path not in again]
        if parts:
            self.add("hash_seed", f"seed {self.seeds[0]}: {describe_differences(parts)}")
        self.checked.append("new processes with four hash seeds")
