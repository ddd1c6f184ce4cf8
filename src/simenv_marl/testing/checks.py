"""The check of a simulation: its runs are compared, and each fault is a finding."""

from __future__ import annotations

import time
import traceback
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from inspect import iscoroutinefunction, isgeneratorfunction
from itertools import chain, count, islice, pairwise, product
from operator import attrgetter
from typing import Any, Final

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
    listed,
)
from ..simulation import (
    RULE,
    make_simulation,
    takes,
)
from .fingerprint import (
    ABSENT,
    Fingerprint,
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
        for view in ("single", "joint", "turn")
    ),
)
"""The tests and their views; each test is called with a factory of environments."""

_BLAMED: Final[dict[type[SimEnvError], str]] = {
    DefinitionError: "callable of labels, question or display",
    MaskError: "action_mask_mapping, or choices,",
    ObservationError: "observation_space_mapping",
    RewardError: "reward_mapping",
}
"""The mappings that errors of the library blame."""

_HASH_SEEDS: Final = (33, 33, 97, 296, 488, 887, 907)
"""Under these, sets of two letters, digits or names like agent_1 have both orders, and so do 97 %
of all sets of two words. Each further seed would halve the rest. The first one comes twice, because
processes also differ without it.
"""


@dataclass
class Check(Runner):
    """A check: a simulation, the limits of its runs, and the results so far.

    The time limit for all runs together is four times that for one.

    Attributes:
        seeds: The seeds of plain runs, and of the first episodes of random actions.
        most_episodes: The number of episodes of random actions.
        findings: The findings by title; the first with a title stays.
        checked, statistics, episodes: As in ``CheckReport``, but mutable.
        stage: The part of the check that is running, in words.
        refused: The reasons why a view has no environment, by view.
        tests: The tests by the reason why they were left out; empty if they ran.
        plain_runs: The plain runs by seed.
        is_repeatable: Whether the same seed gives the same plain run.
        unstable: Parts of the fingerprint that are not compared.
        sources: The global generators that the simulation uses, by name.
    """

    seeds: list[int]
    most_episodes: int

    def __post_init__(self) -> None:
        """Begin the check."""
        self.findings: dict[str, Finding] = {}
        self.checked: list[str] = []
        self.statistics: list[PointStatistics] = []
        self.episodes = {"terminated": 0, "truncated": 0, "cut": 0}
        self.plain_runs: dict[int, Run] = {}
        self.is_repeatable = True
        self.unstable: set[str] = set()
        self.sources: set[str] = set()
        self.stage = "while the simulation was made"
        self.refused = dict.fromkeys(VIEWS, "plain runs fail")
        self.tests: dict[str, list[str]] = {}
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
        if self.is_late:
            self.add("out_of_time", f"after {4 * self.seconds:g} seconds, {self.stage}")

    def run_checks(self) -> None:
        """Run the checks, the more basic first: if plain runs fail, the others are left out.

        Raises:
            Exception: A simulation cannot be made, or the arguments of the check are invalid.
        """
        self.make_environment("aec")
        self.check_plain_runs()
        if self.views:
            self.check_repetition()
            self.check_rules()
            self.check_views()
            self.check_episodes()

    def report(self, simulation: str) -> CheckReport:
        """Return the report of a simulation with a name."""
        runs = list(self.plain_runs.values())
        for reason, tests in self.tests.items():
            names = ", ".join(tests)
            self.checked.append(f"Left out: {names}, because {reason}" if reason else names)
        findings = sorted(self.findings.values(), key=lambda f: SEVERITIES.index(f.severity))
        return CheckReport(
            simulation,
            tuple(findings),
            tuple(self.checked),
            tuple(self.statistics),
            self.episodes,
            order_of(runs[0].calls) if runs else "",
        )

    @property
    def views(self) -> list[str]:
        """The views that the plan allows. Empty if plain runs fail or decide nothing."""
        return [view for view in VIEWS if view not in self.refused]

    @property
    def is_late(self) -> bool:
        """Whether the time is up."""
        return not self.left

    @property
    def left(self) -> float:
        """The time that is left, in seconds."""
        return max(0.0, self._deadline - time.monotonic())

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
        self.findings.setdefault(title, Finding(severity, title, explanation, evidence))

    def add_error(self, error: BaseException, where: str) -> None:
        """Add an error."""
        source = self.mapping_of(error)
        self.add(
            "mapping_raises" if source else "raises",
            f"{where}: {describe_with_place(error)}",
            kind=type(error).__name__,
            source=source,
        )

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

    def fails(self, run: Run, view: str = "aec") -> bool:
        """Return whether a run has failed, and add its error."""
        error = run.error
        if isinstance(error, LimitReached):
            evidence = f"{self.stage}, after {len(run.calls)} steps"
            with suppress(Exception):  # the simulation may have no clock
                evidence += f", at the simulated time {run.simulation.time():g}"
            if time.monotonic() - run.step_began > self.seconds / 2:
                self.add("stuck", f"{evidence} ({place_of(error) or 'in another thread'})")
            else:
                self.add("out_of_time", evidence)
        # The joint view may be unable to know all agents.
        elif error is not None and not (view == "joint" and isinstance(error, AgentError)):
            self.add_error(error, self.stage)
        return error is not None

    @contextmanager
    def environment(self, view: str = "aec", **options: Any) -> Iterator[Any]:
        """Make an environment, and close it at the end."""
        env = self.make_environment(view, **options)
        try:
            yield env
        finally:
            self.fails(Run().play(env.close, self.seconds))

    def repeats(self, first: Fingerprint, again: Fingerprint, name: str) -> bool:
        """Return whether a run repeats another one; else add the finding with a name."""
        parts = differences(first, again, self.unstable)
        if parts:
            self.add(name, f"{self.stage}: {describe_differences(parts)}")
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
            if self.fails(run):
                return
        runs = list(self.plain_runs.values())
        for name, place in run.early.items():
            # A reset that calls more of the model may play its history, which no agent decides.
            is_direct = place.endswith(("in reset", "in __init__"))
            self.add("early_decisions" if is_direct else "history", place, point=name)
        if not any(run.calls for run in runs):
            overriding = [hook.name for hooks in self.plan.overrides.values() for hook in hooks]
            evidence = f"overridden by {listed(overriding)}" if overriding else ""
            points = listed([point.hook.name for point in self.plan.active])
            self.add("no_decision", evidence, points=points)
            return
        self.refused = self.refused_views()
        if any(run.is_cut for run in runs):
            self.add("cut_runs")
        if len(runs) > 1 and not any(differences(run.parts, other.parts) for other in runs):
            self.add("same_seeds", f"seeds {self.seeds}")

    def check_repetition(self) -> None:
        """Repeat a plain run: if it differs, differences of environments mean nothing."""
        seed = self.seeds[0]
        self.stage = f"in another plain run of seed {seed}"
        first = self.plain_runs[seed].parts
        again = self.run_plainly(seed)
        if self.fails(again):
            return
        self.check_clock(again, drawn=0)
        if self.sources:
            # Another state of the global generators shows whether the model seeds them.
            differs = differences(first, self.run_plainly(seed, seed + 1).parts)
            name = "unseeded_generators" if differs else "shared_generators"
            self.add(name, self.sources_of_chance(seed).lstrip())
        paths = {part.path for part in differences(first, again.parts)}
        self.is_repeatable = not any(map(is_essential, paths))
        if not self.is_repeatable:
            self.stage += self.sources_of_chance(seed)
        self.repeats(first, again.parts, "unstable" if self.is_repeatable else "unrepeatable")
        self.unstable = {generalize(path) for path in paths if not is_essential(path)}

    def check_rules(self) -> None:
        """Check the rules for effects and waits that an action does not have."""
        self.stage = "in a plain run whose rules are watched"
        watch = Watch(self.state_of)
        self.run_plainly(self.seeds[0], run=watch)
        for point in self.plan.active:
            apply = point.definition.apply
            waits = isgeneratorfunction(apply) or iscoroutinefunction(apply)
            for name, evidence in watch.found[point.hook].items():
                # An apply takes the place of the rule, with its effects, and may wait as well.
                is_replaced = waits or (point.applies and name == "changing_rule")
                if name == "settings" or not is_replaced:
                    self.add(name, evidence, point=point.hook.name)

    def check_clock(self, run: Run, *, drawn: int) -> None:
        """Check that the times of a run go on.

        Its actions are ``drawn`` at random, or ``RULE``, as in ``run_randomly``.
        """
        for before, now in pairwise(run.times):
            if not now >= before:  # NaN is no time
                self.add("backward_clock", f"{self.stage}: from {before:g} to {now:g}")
                return
        # A longer episode tells a loop from many decisions at one time.
        for most in (self.max_steps, 10 * self.max_steps):
            if most > self.max_steps:
                with self.environment(max_steps=most) as env:
                    run = self.run_randomly(env, self.seeds[0], drawn=drawn)
            late = slice(most // 2, most)
            is_one_time = len(run.times) >= most and len(set(run.times[late])) == 1
            if not is_one_time or 20 * len(set(run.calls[late])) > most:
                return
        self.add("standing_clock", f"{self.stage}: {most} decisions, the last at {run.times[-1]:g}")

    # -- environments with RULE throughout --------------------------------------------------------

    def check_views(self) -> None:
        """Compare plain runs with each view and driver under ``RULE``, to the first difference."""
        if not self.is_repeatable:
            return
        options = self.plan.options
        drivers = list(dict.fromkeys([options.driver, "thread"]))
        # Rules take all decisions, because plain runs have no policies.
        policies = dict.fromkeys(options.policies or (), RULE) or None
        rules = {"policies": policies, "max_steps": None, "skip_forced": False}
        for driver, view, seed in product(drivers, self.views, self.seeds):
            plain = self.plain_runs[seed]
            if self.is_late:
                return
            if not plain.calls:
                continue
            self.stage = f"in the {view} view, driver {driver}, seed {seed}, with RULE throughout"
            with self.environment(view, driver=driver, **rules) as env:
                run = Run(self.state_of)
                self.record_rules(run, partial(run.play_rules, env, seed), seed)
            if self.fails(run, view):
                continue
            if run.draws - self.sources:
                self.sources |= run.draws
                self.add("unseeded_generators", self.stage)
            parts = differences(plain.parts, run.parts, self.unstable)
            writes = all(part.first is ABSENT and not is_essential(part.path) for part in parts)
            name = "writing_mappings" if writes else "changed_model"
            if not self.repeats(plain.parts, run.parts, name):
                return
        self.checked.append(
            f"plain runs against RULE throughout ({', '.join(self.views)}; drivers"
            f" {', '.join(drivers)}; seeds {self.seeds})"
        )

    # -- episodes of random legal actions ---------------------------------------------------------

    def check_episodes(self) -> None:
        """Play episodes with random legal actions, and compare episodes of the same seed."""
        records = {point.hook: PointRecord(point) for point in self.plan.active}
        seeds = list(islice(chain(self.seeds, count(max(self.seeds) + 1)), self.most_episodes))
        with self.environment(max_steps=self.max_steps) as env:
            for number, seed in enumerate(seeds, 1):
                if self.is_late:
                    break
                self.stage = f"in episode {number} of random legal actions, seed {seed}"
                run = self.run_randomly(env, seed)
                for agent, answered, result in run.results:
                    records[agent.point.hook].add(agent.name, answered, result)
                if self.fails(run):
                    break
                if number == 1:
                    first = run
                    self.check_clock(run, drawn=1)
                    self.check_generators(run)
                self.episodes["cut" if len(run.actions) == self.max_steps else run.end] += 1
            episodes = sum(self.episodes.values())
            for hook, record in records.items():
                self.statistics.append(record.statistics())
                for name, evidence in record.findings():
                    self.add(name, evidence, point=hook.name)
                calls = [run.calls for run in self.plain_runs.values()]
                if not (record.decisions or any(hook.name in names for names in calls)):
                    self.add("never_called", point=hook.name)
            if episodes:
                self.checked.append(f"{episodes} episodes of random legal actions in the AEC view")
            if self.episodes["cut"] == episodes > 0:
                self.add("cut_runs")
            if episodes == len(seeds) and self.is_repeatable:
                self.compare_episodes(env, first)
            Run().play(partial(env.reset, seed=seeds[0]), self.seconds)  # closed in mid-episode

    def check_generators(self, run: Run) -> None:
        """Add a finding if entities share generators, unless the model has no generator."""
        names = list({agent.name: None for agent, *_ in run.results if agent.point.agent is None})
        generators = generators_of(run.simulation)
        number = sum(len(each) if isinstance(each, Streams) else 1 for each in generators)
        if 0 < number < len(names):
            self.add(
                "few_generators",
                f"{number} for {len(names)} agents, {names[0]} and {names[1]} among them",
            )

    def compare_episodes(self, used: SimulationAECEnv, first: Run) -> None:
        """Repeat an episode in a new environment, in a used one, and beside another one."""
        seed = self.seeds[0]
        self.stage = f"seed {seed}, the same actions, after an episode closed in mid-episode"
        with self.environment(max_steps=self.max_steps) as new:
            Run().play(partial(used.reset, seed=seed), self.seconds)
            for name, env, beside in (
                ("unrepeatable", new, None),
                ("left_over", used, None),
                ("disturbance", new, used),
            ):
                again = self.run_randomly(env, seed, beside=beside)
                if self.fails(again) or self.is_late or (beside and self.sources):
                    return
                if not self.repeats(first.parts, again.parts, name):
                    return
            other = self.run_randomly(used, seed, drawn=2)
            acts_alike = repr(first.actions) == repr(other.actions)
            if not acts_alike and not differences(first.parts, other.parts):
                self.add("no_effect", f"seed {seed}, {len(first.actions)} actions")
        self.checked.append(
            "the same seed and actions in a new environment, in a used one, and beside another one"
        )

    # -- the tests of PettingZoo and Gymnasium, and other processes -------------------------------

    def check_conformance(self) -> None:
        """Run the tests of PettingZoo and Gymnasium and in new processes.

        Note why one was left out.
        """
        elsewhere = "new processes with six hash seeds"
        for name, view, test in (*_TESTS, (elsewhere, "aec", lambda _: self.compare_processes())):
            reason = self.obstacle(name, view)
            if not reason:
                self.stage = f"in {name}"
                make = partial(self.make_environment, view, max_steps=self.max_steps)
                run = Run().play(partial(test, make), self.left)
                if self.is_late:
                    reason = "the time is up"
                # Pickling and the other process may raise anything.
                elif run.error is not None and name is elsewhere:
                    reason = describe_error(run.error)
                # The tests ignore masks, changes of masks, and the bounds of some spaces.
                elif isinstance(run.error, InvalidActionError):
                    reason = f"it takes illegal actions: {error_text(run.error)}"
                elif isinstance(run.error, AssertionError):
                    self.add("failed_test", describe_with_place(run.error), test=name)
                else:
                    self.fails(run, view)
            # The rest is a remedy, for those who want that view.
            self.tests.setdefault(reason.partition(";")[0], []).append(name)

    def obstacle(self, test: str, view: str) -> str:
        """Return the reason why a test of a view cannot run; empty if it can."""
        if any(finding.severity == "error" for finding in self.findings.values()):
            return "there are errors"
        if self.is_late:
            return "the time is up"
        if self.sources and test.endswith("seed_test"):
            return "the model draws from shared generators"
        return self.refused.get(view, "")

    def compare_processes(self) -> None:
        """Compare runs in new processes, whose sets of strings have another order.

        Raises:
            Exception: The runs cannot be pickled, or a process fails.
        """
        self.stage += f", seed {self.seeds[0]}"
        # The processes end at the time limit of this test.
        runner = Runner(self.make_plan, self.max_steps, 4 * self.seconds, self.state_of)
        recipe = pack((runner, self.seeds[0]))
        with ThreadPoolExecutor() as pool:
            first, again, *others = pool.map(
                lambda hash_seed: run_elsewhere(recipe, self.left, hash_seed), _HASH_SEEDS
            )
        self.unstable |= {generalize(part.path) for part in differences(first, again)}
        for other in others:
            self.repeats(first, other, "hash_seed")
