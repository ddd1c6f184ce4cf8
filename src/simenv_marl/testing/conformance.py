"""The tests of PettingZoo and Gymnasium, and the time that a decision takes."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable, Iterable
from typing import Any, Final

from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

from ..errors import AgentError, InvalidActionError
from .inside import make_environment
from .report import Timing
from .runs import TimeUp, error_in_words, play_rules, seconds_of_plain_run, seed_global_generators, within
from .subject import Opened, Report, Subject

_SAID_OTHERWISE: Final = (
    "possible_agents defined",  # PettingZoo's rule if agents are only known when they decide
    "No agents present",  # after the end of each episode of such an environment
    "alternative render modes",
    "not a NumPy array",  # PettingZoo allows Dict observations only in its own environments
    "should be gymnasium.spaces.box",
    "space for each agent probably should be",
    "infinity. This is probably",
    "normalized space",
    "different classes",
    "different shapes",
    "different number of dimensions",
    "different observation space sizes",
    "different action space sizes",
    "different between two agents",
    "all zeros",
    "single number",
    "several objects decide at",
    "did not appear in the episode",
    "draws from the global generator",
    "does not have a render() method",
    "has not defined a render() method",
)
"""Texts in warnings of PettingZoo and Gymnasium that are not faults, or that the checks report themselves."""

_IN_PLAIN_WORDS: Final = (
    ("more than 3 dimensions", "many_dimensions"),
    ("minimum and maximum values are equal", "one_value"),
)
"""Texts in their warnings, and the findings that say the same."""

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
    """Run the tests of PettingZoo and Gymnasium; explain their warnings."""
    if subject.late or report.has_errors:
        # They would only repeat these errors in other words.
        report.checked.append("skipped because of the errors: the tests of PettingZoo and Gymnasium")
        return
    passed = []
    seed_global_generators(0)
    for name, view, test in _TESTS:
        if subject.late or (subject.drawn and "seed" in name):
            continue
        caught = _passes(subject, report, name, view, test)
        if caught is not None:
            passed.append(name)
            _add_warnings(report, name, caught)
    if passed:
        report.checked.append(", ".join(passed))


def _passes(
    subject: Subject, report: Report, name: str, view: str, test: Callable[[Callable[[], Any]], Any]
) -> list[warnings.WarningMessage] | None:
    """Run one test. Return its warnings; None if it fails, or tells nothing."""
    plan = subject.plan.amended({"max_steps": subject.max_steps})
    try:
        with Opened(subject, report, view, plan) as env:
            if env is None:
                return None
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            within(subject.deadline(), lambda: test(lambda: make_environment(plan, view)))
        return caught
    except (TimeUp, InvalidActionError):
        pass  # the test ignores masks, or masks that change within a round
    except AgentError as error:
        if view != "joint":
            report.add_error(error, f"in {name}")
    except AssertionError as error:
        words = error_in_words(error).partition(": ")[2]
        report.add("failed_test", words, test=name)
    except (Exception, SystemExit) as error:
        report.add_error(error, f"in {name}")
    return None


def _add_warnings(report: Report, name: str, caught: Iterable[warnings.WarningMessage]) -> None:
    for message in dict.fromkeys(_bare(str(warning.message)) for warning in caught):
        if any(known in message for known in _SAID_OTHERWISE):
            continue
        for pattern, found in _IN_PLAIN_WORDS:
            if pattern in message:
                report.add(found)
                break
        else:
            report.add("warning_test", message[:300], test=name)


def check_timing(subject: Subject, report: Report) -> None:
    """Measure the time per decision, if runs come to their end."""
    seed = subject.seeds[0]
    run = subject.plain[seed]
    if run.cut or not run.decisions or subject.late:
        return
    number = len(run.decisions)
    try:
        seed_global_generators(seed)
        plain = seconds_of_plain_run(subject.plan, seed, subject.deadline())
        with Opened(subject, report, max_steps=None) as env:
            seed_global_generators(seed)
            env.reset(seed=seed)
            start = time.perf_counter()
            within(subject.deadline(), lambda: play_rules(env))
            seconds = time.perf_counter() - start
    except (Exception, SystemExit):
        return
    report.timing = Timing(plain / number * 1e6, seconds / number * 1e6)


def _bare(message: str) -> str:
    """Return a message without colour codes and without Gymnasium's prefix."""
    return re.sub(r"\x1b\[[0-9;]*m", "", message).removeprefix("WARN: ").strip()
