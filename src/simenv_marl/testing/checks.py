"""Checks of the plain simulation, and comparisons with environments in which ``RULE`` takes all decisions."""

from __future__ import annotations

from dataclasses import replace
from functools import wraps
from typing import Any, Final

from ..decision import Definition
from ..errors import AgentError, OptionValueError
from ..simulation import takes
from .fingerprint import ABSENT, alike, differences_in_words, general
from .inside import VIEWS, ActivePoint, active_points, make_simulation, redefined
from .runs import Run, TimeUp, global_generators, play_rules, rule_run, seed_global_generators, within
from .subject import SHARE, Opened, Report, Subject

DRIVERS: Final = ("greenlet", "thread")
"""The drivers that are compared with the plain run."""


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
        if run.error is not None:
            subject.playable = False
            if isinstance(run.error, TimeUp):
                _add_slow_run(subject, report, run, seed)
            else:
                report.add_error(run.error, f"in a plain run without any environment, seed {seed}")
            return
    if not any(run.decisions for run in subject.plain.values()):
        subject.playable = False
        points = ", ".join(point.name for point in active_points(subject.plan))
        report.add("no_decision", f"plain runs with seeds {', '.join(map(str, subject.seeds))}", points=points)
    elif any(run.cut for run in subject.plain.values()):
        report.add("cut_runs", most=subject.max_steps)


def _add_slow_run(subject: Subject, report: Report, run: Run, seed: int) -> None:
    seconds = f"{subject.limit * SHARE:.3g} seconds"
    if run.decisions:
        report.add("slow_run", f"{len(run.decisions)} decisions in {seconds}, seed {seed}")
    else:
        report.add("hanging", f"{seconds} of a plain run, seed {seed}")


def check_repeated_run(subject: Subject, report: Report) -> None:
    """Run a seed a second time: differences then are not due to environments."""
    seed = subject.seeds[0]
    first = subject.plain[seed]
    if subject.drawn:
        seed_global_generators(seed + 1)
        other = _run_again(subject, report, seed)
        same = other is not None and alike(other.decisions, first.decisions)
        _add_shared_generators(subject, report, repeats=same and not subject.differences(first, other or first))
    seed_global_generators(seed)
    again = _run_again(subject, report, seed)
    if again is None:
        return
    parts = subject.differences(first, again)
    generators = [path for path, _, _ in parts if "state of the generator" in path]
    if difference := first.difference(again):
        subject.repeats = False
        report.add_unrepeatable(subject, f"two plain runs of seed {seed}: {difference}")
    elif generators:
        subject.repeats = False
        report.add_unrepeatable(subject, f"after two plain runs of seed {seed}, {generators[0]} differs")
    elif parts:
        report.add("unstable", differences_in_words(parts))
    if not difference:
        subject.unstable = frozenset(general(path) for path, _, _ in parts)


def _run_again(subject: Subject, report: Report, seed: int) -> Run | None:
    run = subject.run_plainly(seed)
    if run.error is None:
        return run
    if not isinstance(run.error, TimeUp):
        report.add_error(run.error, f"in a second plain run of seed {seed}, though not in the first")
    return None


def _add_shared_generators(subject: Subject, report: Report, *, repeats: bool) -> None:
    names = " and ".join(sorted(subject.drawn))
    sources = "; ".join(source for source in subject.chance() if "global" in source)
    if repeats:
        report.add("shared_generators", sources, names=names)
    else:
        report.add("unseeded_generators", sources, names=names)


# -- behind environments, with RULE throughout ----------------------------------------------------


def check_views(subject: Subject, report: Report) -> None:
    """Compare the plain run with every view and driver, with ``RULE`` throughout."""
    if not subject.repeats:
        return
    chosen = subject.plan.options.driver
    drivers = DRIVERS if chosen == DRIVERS[0] else (chosen,)
    compared: dict[str, list[str]] = {}
    different: list[str] = []
    place = 0
    for driver in drivers:
        for view in VIEWS:
            if subject.late or subject.slow:
                return
            difference = _compare_view(subject, report, view, driver)
            if difference is None:
                continue
            compared.setdefault(view, []).append(driver)
            if difference and not different:
                place = len(report.findings)
                _add_observed_difference(subject, report, *difference)
            if difference and view not in different:
                different.append(view)
    if len(different) > 1:
        first = report.findings[place]
        others = f"{first.evidence}\nthe same in the views {', '.join(different[1:])}"
        report.findings[place] = replace(first, evidence=others)
    if compared:
        _say_what_was_compared(subject, report, compared, drivers)


def _say_what_was_compared(
    subject: Subject, report: Report, compared: dict[str, list[str]], drivers: tuple[str, ...]
) -> None:
    views = ", ".join(compared)
    if any(len(by) < len(drivers) for by in compared.values()):
        views = ", ".join(f"{view} ({', '.join(by)})" for view, by in compared.items())
    elif len(drivers) > 1:
        views = f"{views}; drivers {', '.join(drivers)}"
    most = max(len(run.decisions) for run in subject.plain.values())
    seeds = f"seeds {', '.join(map(str, subject.seeds))}"
    report.checked.append(f"plain runs against RULE throughout ({views}; {seeds}; up to {most} decisions each)")
    held = subject.plain[subject.seeds[0]].fingerprint
    if held is not None:
        left = f"; cannot be compared: {', '.join(sorted(held.left_out)[:6])}" if held.left_out else ""
        more = "" if held.complete else " (and there are more)"
        report.checked.append(f"what the simulation holds afterwards: {len(held.parts)} parts{more}{left}")


Difference = tuple[int, str, bool]
"""A difference of two runs: the seed, the parts, and whether the second only holds more than the first."""


def _compare_view(subject: Subject, report: Report, view: str, driver: str) -> Difference | tuple[()] | None:
    """Compare one view. Return the first difference; () if there is none; None if the view does not fit or fails."""
    for seed, plain in subject.plain.items():
        if not plain.decisions or subject.late:
            continue
        try:
            seed_global_generators(seed)
            with Opened(subject, report, view, driver=driver, policies=subject.rules, max_steps=None) as env:
                if env is None:
                    return None
                seed_global_generators(seed)
                run = rule_run(subject.plan, env, seed, subject.max_steps, subject.deadline(), subject.look)
        except OptionValueError:
            return None  # a driver that this platform does not have
        except (Exception, SystemExit) as error:
            report.add_error(error, f"when the {view} view was made")
            return None
        if run.error is not None:
            _add_failed_view(subject, report, view, seed, run.error)
            return None
        if names := run.drawn - subject.drawn:
            subject.drawn |= names
            report.add("drawing_mappings", names=" and ".join(sorted(names)))
        words = ("plainly", "in the environment")
        decisions, parts = plain.difference(run, *words), subject.differences(plain, run)
        if decisions or parts:
            told = decisions or differences_in_words(parts, *words)
            only_more = not decisions and all(here is ABSENT for _, here, _ in parts)
            return seed, f"{view} view, driver {driver}, seed {seed}: {told}", only_more
    return ()


def _add_failed_view(subject: Subject, report: Report, view: str, seed: int, error: BaseException) -> None:
    if isinstance(error, TimeUp):
        subject.slow = True
        report.add("slow_view", view=view)
    elif not (view == "joint" and isinstance(error, AgentError)):
        # The joint view needs to know all agents beforehand.
        report.add_error(error, f"in the {view} view with RULE throughout, seed {seed}")


def _add_observed_difference(subject: Subject, report: Report, seed: int, where: str, only_more: bool) -> None:
    evidence = "\n".join([where, *_mappings_at_fault(subject, report, seed)])
    if only_more:
        report.add("writing_mappings", evidence)
    else:
        report.add("changed_model", evidence)


_MAPPINGS: Final = {
    "observation_space_mapping": "observation_space_mapping",
    "reward_mapping": "reward_mapping",
    "action_mask_mapping": "mask or choices",
    "choices": "mask or choices",
    "agent": "agent",
}


def _mappings_at_fault(subject: Subject, report: Report, seed: int) -> list[str]:
    """Play the AEC view once more, and compare the model before and after each call of a mapping."""
    found: dict[str, None] = {}
    simulations: list[Any] = []

    def watched(mapping: Any, what: str) -> Any:
        @wraps(mapping)
        def watching(*args: Any, **kwargs: Any) -> Any:
            if what in found or not simulations:
                return mapping(*args, **kwargs)
            before, drawn = subject.look(simulations[0]), global_generators()
            value = mapping(*args, **kwargs)
            changed = before.differences(subject.look(simulations[0]), subject.unstable)
            if changed:
                found[f"the {what} changes {changed[0][0]}"] = None
            elif not alike(drawn, global_generators()):
                found[f"the {what} draws from a global generator"] = None
            return value

        return watching

    def watch(point: ActivePoint) -> Definition:
        mappings = {name: getattr(point.definition, name) for name in _MAPPINGS}
        watched_ones = {
            name: watched(mapping, f"{_MAPPINGS[name]} of {point.name}")
            for name, mapping in mappings.items()
            if callable(mapping)
        }
        return replace(point.definition, **watched_ones)

    def play(env: Any) -> None:
        env.reset(seed=seed)
        play_rules(env)

    try:
        with Opened(subject, report, plan=redefined(subject.plan, watch), policies=subject.rules, max_steps=50) as env:
            simulations.append(env.simulation)
            seed_global_generators(seed)
            within(subject.deadline(), lambda: play(env))
    except (Exception, SystemExit):
        pass  # report the mappings that were seen until then
    return list(found)
