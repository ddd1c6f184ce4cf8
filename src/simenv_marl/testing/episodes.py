"""Checks by episodes of random legal actions: ranges, and whether episodes repeat."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from functools import partial
from itertools import chain, count, islice, zip_longest
from statistics import fmean
from typing import Any, Final

from .fingerprint import alike, differences_in_words, general
from .report import EpisodeStatistics
from .runs import TimeUp, random_steps, seed_global_generators, within
from .statistics import Collectors
from .subject import SHARE, Opened, Played, Report, Subject, play

_MOST_ERRORS: Final = 3
"""The number of failing random episodes after which no more are played."""


def check_episodes(subject: Subject, report: Report) -> None:
    """Play episodes with random legal actions; collect statistics; compare episodes of the same seed."""
    collectors = Collectors(subject.plan)
    known: dict[int, Played] = {}
    failures: list[BaseException] = []
    lengths: list[int] = []
    ends = {"terminated": 0, "truncated": 0, "cut": 0}
    with Opened(subject, report, plan=collectors.plan, max_steps=subject.max_steps) as env:
        seeds = islice(chain(subject.seeds, count(max(subject.seeds) + 1)), subject.episodes)
        for number, seed in enumerate(seeds, 1):
            if subject.late or len(failures) == _MOST_ERRORS:
                break
            seed_global_generators(seed)
            played = play(subject, env, seed)
            if played.error is not None:
                failures.append(played.error)
                if isinstance(played.error, TimeUp):
                    _add_stall(subject, report, played, f"episode {number}, seed {seed}")
                    break
                report.add_error(played.error, f"in episode {number} of random legal actions, seed {seed}")
                continue
            if number <= max(2, len(subject.seeds)):
                known[seed] = played
            collectors.played(played.steps)
            lengths.append(sum(not (step.told[2] or step.told[3]) for step in played.steps))
            truncated = bool(played.steps) and played.steps[-1].told[3]
            cut = truncated and lengths[-1] >= subject.max_steps
            ends["cut" if cut else "truncated" if truncated else "terminated"] += 1
        report.points = tuple(point.statistics() for point in collectors.points)
        if lengths:
            report.episodes = EpisodeStatistics(len(lengths), min(lengths), max(lengths), fmean(lengths), **ends)
            report.findings += [finding for point in collectors.points for finding in point.findings()]
            if ends["cut"] == len(lengths):
                report.add("endless", most=subject.max_steps)
            report.checked.append(f"{len(lengths)} episodes of random legal actions in the AEC view")
        if known and not failures and subject.repeats:
            _compare_episodes(subject, report, env, known)


def _add_stall(subject: Subject, report: Report, played: Played, where: str) -> None:
    where = f"{where}, after {len(played.steps)} steps"
    if time.monotonic() - played.latest < subject.limit * SHARE / 2:
        report.add("slow_episode", where)
    else:
        report.add("standstill", where)


def _compare_episodes(subject: Subject, report: Report, used: Any, known: dict[int, Played]) -> None:
    """Compare episodes of the same seed: in a new environment, in a used one, and beside another one."""
    first, *others = known
    new = partial(Opened, subject, report, max_steps=subject.max_steps)
    with new() as fresh, new() as beside:
        for env in (fresh, used):
            seed_global_generators(first)
            again = play(subject, env, first)
            if isinstance(again.error, TimeUp) or subject.late:
                return
            if not (difference := known[first].difference(again)):
                continue
            where = f"seed {first}, the same actions: {difference}"
            if env is fresh:
                report.add_unrepeatable(subject, f"two environments, {where}")
            else:
                report.add("left_over", where + _left_over(subject, report, first))
            return
        if others and not subject.drawn:
            _compare_side_by_side(subject, report, (fresh, beside), known)
        _compare_seeds(subject, report, known)
        _compare_actions(subject, report, used, first, known[first])
        report.checked.append("the same seed and actions in a new environment, in a used one, and beside another one")


def _left_over(subject: Subject, report: Report, seed: int) -> str:
    """Return what a simulation holds after a run and a reset, but not after the first reset."""
    looks = []

    def look(env: Any) -> None:
        seed_global_generators(seed)
        env.reset(seed=seed)
        looks.append(subject.look(env.simulation))
        for _ in random_steps(env, seed + 1):
            pass

    try:
        with Opened(subject, report, max_steps=subject.max_steps) as env:
            for _ in range(2):
                within(subject.deadline(), partial(look, env))
    except (Exception, SystemExit):
        return ""
    parts = looks[0].differences(looks[1], subject.unstable)
    return f"\nafter reset, {subject.plan.name}: {differences_in_words(parts, 'at first', 'later')}" if parts else ""


def _compare_side_by_side(subject: Subject, report: Report, envs: Sequence[Any], known: dict[int, Played]) -> None:
    """Step two environments in turns, and compare their episodes with those of each alone."""
    seeds, played = list(known)[:2], (Played(), Played())

    def steps() -> None:
        games = [random_steps(env, seed) for env, seed in zip(envs, seeds, strict=True)]
        for pair in zip_longest(*games):
            for one, step in zip(played, pair, strict=True):
                if step is not None:
                    one.steps.append(step)

    try:
        within(subject.deadline(), steps)
    except TimeUp:
        return
    except (Exception, SystemExit) as raised:
        for one in played:
            one.error = raised
    differences = [known[seed].difference(one) for seed, one in zip(seeds, played, strict=True)]
    if any(differences):
        report.add("disturbance", f"seeds {', '.join(map(str, seeds))}: {differences[0] or differences[1]}")


def _compare_seeds(subject: Subject, report: Report, known: dict[int, Played]) -> None:
    """Report if all seeds give the same episode."""
    runs = [(seed, run.decisions, run.fingerprint) for seed, run in subject.plain.items() if run.fingerprint]
    seed_like = {  # parts that hold only the seed itself
        general(path)
        for seed, _, held in runs
        for path, value in held.parts.items()
        if type(value) is int and value == seed and "seed" in path
    }
    starts = [played.told[0] for played in known.values() if played.steps]
    if (
        len(known) > 1
        and all(alike(runs[0][1], decisions) for _, decisions, _ in runs[1:])
        and not any(runs[0][2].differences(held, subject.unstable | seed_like) for _, _, held in runs[1:])
        and all(alike(starts[0], other) for other in starts[1:])
    ):
        report.add("same_seeds", f"seeds {', '.join(map(str, known))}")


def _compare_actions(subject: Subject, report: Report, env: Any, seed: int, known: Played) -> None:
    """Play other actions with the same seed, and report if they change nothing."""
    seed_global_generators(seed)
    other = play(subject, env, seed, salt=1)
    if other.error is not None or subject.drawn or len(other.steps) < 2:
        return
    acted, instead = ([step.action for step in one.steps if step.action is not None] for one in (known, other))
    if alike(known.told, other.told) and not alike(acted, instead):
        report.add("no_effect", f"seed {seed}, {len(acted)} actions")


def check_early_end(subject: Subject, report: Report) -> None:
    """Close an environment in mid-episode."""
    if subject.late or report.has_errors:
        return
    with Opened(subject, report, max_steps=None) as env:
        seed_global_generators(subject.seeds[0])
        with suppress(TimeUp):
            within(subject.deadline(), partial(env.reset, seed=subject.seeds[0]))
    report.checked.append("an environment that is closed in mid-episode")
