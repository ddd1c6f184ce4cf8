"""What PettingZoo and Gymnasium check themselves, and how long a decision takes."""

from __future__ import annotations

import re
import time
import warnings
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, Final

from gymnasium.utils.env_checker import check_env
from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test, seed_test

from ..errors import (
    AgentError,
    InvalidActionError,
)
from .base import Checks
from .report import (
    Timing,
)
from .runs import (
    TimeUp,
    play_rules,
    seed_global_generators,
    untouched_run,
    within,
)
from .words import at, first_lines

_SAID_OTHERWISE: Final = (
    "possible_agents defined",  # PettingZoo's rule where agents are only known when they decide
    "No agents present",  # after the end of each episode of such an environment
    "alternative render modes",
    "not a NumPy array",  # PettingZoo knows Dict observations of its own environments alone
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
    "does not have a render() method",
    "has not defined a render() method",
)
"""What PettingZoo and Gymnasium warn of that is no fault, or that the check says in words of its own."""

_IN_PLAIN_WORDS: Final = (
    (
        "more than 3 dimensions",
        "Observations have more than three dimensions",
        "Learning libraries know what to do with up to three (pictures).",
    ),
    (
        "minimum and maximum values are equal",
        "A space holds only one value somewhere",
        "Lower and upper bound of a component are the same, so that nothing can be observed or decided there.",
    ),
)


class ConformanceChecks(Checks):
    """Runs the tests of PettingZoo and Gymnasium."""

    def _conforms(self) -> None:
        """Run what PettingZoo and Gymnasium check; say what they warn of in plain words."""
        if self._late() or any(finding.severity == "error" for finding in self.findings):
            # They could only say the same in other words.
            self.checked.append("not, because of the errors: what PettingZoo and Gymnasium test themselves")
            return
        limits = {"max_steps": self._max_steps}
        passed = []
        seed_global_generators(0)

        def make(view: str) -> Callable[[], Any]:
            return lambda: self._make(view, limits)

        for name, view, test in (
            ("PettingZoo's api_test", "aec", lambda make: api_test(make(), num_cycles=50)),
            ("seed_test", "aec", lambda make: seed_test(make, num_cycles=20)),
            ("parallel_api_test", "parallel", lambda make: parallel_api_test(make(), num_cycles=50)),
            ("parallel_seed_test", "parallel", lambda make: parallel_seed_test(make, num_cycles=20)),
            ("Gymnasium's check_env (single view)", "single", _check_env),
            ("Gymnasium's check_env (joint view)", "joint", _check_env),
        ):
            if self._late() or (self._drawn and "seed" in name):
                continue
            try:
                if (env := self._make(view, limits)) is None:
                    continue
                self._close(env)
                with warnings.catch_warnings(record=True) as caught:
                    warnings.simplefilter("always")
                    within(self._deadline(), partial(test, make(view)))
            except TimeUp:
                continue
            except InvalidActionError:
                continue  # the test knows nothing of masks, or of those that change within a round
            except AgentError as error:
                if view != "joint":
                    self._tell_of_error(error, f"in {name}")
                continue
            except AssertionError as error:
                self._add(
                    "error",
                    f"{name} fails",
                    "Learning libraries rely on what it tests.",
                    first_lines(str(error)) + at(error),
                )
                continue
            except (Exception, SystemExit) as error:
                self._tell_of_error(error, f"in {name}")
                continue
            passed.append(name)
            self._tell_of_warnings(name, caught)
        if passed:
            self.checked.append(", ".join(passed))

    def _tell_of_warnings(self, name: str, caught: Iterable[warnings.WarningMessage]) -> None:
        for message in dict.fromkeys(_bare(str(warning.message)) for warning in caught):
            if any(known in message for known in _SAID_OTHERWISE):
                continue
            for pattern, title, explanation in _IN_PLAIN_WORDS:
                if pattern in message:
                    self._add("note", title, explanation)
                    break
            else:
                self._add("note", f"{name} warns", "Learning libraries may trip over this.", first_lines(message))

    def _takes_time(self) -> None:
        """Measure what a decision takes, where runs come to their end."""
        seed = self._seeds[0]
        run = self._plain[seed]
        if run.cut or not run.decisions or self._late():
            return
        env = None
        try:
            seed_global_generators(seed)
            plain = untouched_run(self._plan, seed, self._deadline())
            env = self._make("aec", {"max_steps": None})
            seed_global_generators(seed)
            env.reset(seed=seed)
            start = time.perf_counter()
            within(self._deadline(), partial(play_rules, env))
            seconds = time.perf_counter() - start
        except (Exception, SystemExit):
            return
        finally:
            self._close(env)
        number = len(run.decisions)
        self._timing = Timing(plain / number * 1e6, seconds / number * 1e6)


def _check_env(make: Callable[[], Any]) -> None:
    check_env(make(), skip_render_check=True)


def _bare(message: str) -> str:
    """A message without the codes of colours and what Gymnasium begins it with."""
    return re.sub(r"\x1b\[[0-9;]*m", "", message).removeprefix("WARN: ").strip()
