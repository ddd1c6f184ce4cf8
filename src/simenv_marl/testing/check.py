"""All checks of a simulation, one after the other."""

from __future__ import annotations

import io
import warnings
from contextlib import redirect_stderr, redirect_stdout

from ..core.switch import unattended
from .conformance import ConformanceChecks
from .episodes import EpisodeChecks
from .plain import PlainChecks
from .report import (
    SEVERITIES,
    CheckReport,
)
from .runs import (
    global_generators,
    set_global_generators,
)
from .views import ViewChecks
from .words import first_lines, order_of


class Checker(PlainChecks, ViewChecks, EpisodeChecks, ConformanceChecks):
    """Checks one simulation."""

    def check(self) -> CheckReport:
        """Check all there is; the more basic first, and nothing that can only fail for a reason known already."""
        states = global_generators()
        silenced = io.StringIO()
        try:
            with (
                unattended(),
                warnings.catch_warnings(record=True) as caught,
                redirect_stdout(silenced),
                redirect_stderr(silenced),
            ):
                warnings.simplefilter("ignore")
                warnings.filterwarnings("always", ".* refuses to end", ResourceWarning)
                self._check_all()
        finally:
            set_global_generators(states)
        if caught:
            self._add(
                "warning",
                "The simulation refuses to end",
                "When an environment is closed or reset in mid-episode, SimulationExit is raised in the model, which"
                " has to let it pass. Look for an except that catches everything and goes on.",
                first_lines(str(caught[0].message)),
            )
        if self._late():
            self._add(
                "warning",
                f"The time limit of {self._limit:g} seconds has stopped the check",
                "What is missing below was not looked at. Give more time (time_limit=), or less to do (episodes=,"
                " max_steps=, fewer seeds=).",
            )
        plain = self._plain.get(self._seeds[0])
        return CheckReport(
            simulation=self._plan.name,
            findings=tuple(sorted(dict.fromkeys(self.findings), key=lambda f: SEVERITIES.index(f.severity))),
            checked=tuple(self.checked),
            observations=self._points,
            episodes=self._statistics,
            calls=order_of(plain.decisions) if plain else "",
            timing=self._timing,
        )

    def _check_all(self) -> None:
        try:
            if not self._runs_plainly():
                return
            for look in (
                self._compares_views,
                self._plays_episodes,
                self._ends_early,
                self._conforms,
                self._takes_time,
            ):
                look()
        except (Exception, SystemExit) as error:  # of the model, from where nobody expects it
            self._tell_of_error(error, "while it was checked")
