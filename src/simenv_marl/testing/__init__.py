"""Checks of a simulation and its decision points, to run before trusting an environment.

``check_simulation`` runs a simulation by itself and in environments, plays episodes of random actions, and explains
what is wrong. ``inspect_simulation`` lists the decision points and their calls. Both are also on the command line::

    python -m simenv_marl check package.module:Simulation
    python -m simenv_marl inspect package.module:Simulation

A check is a function of a ``Subject`` and a ``Report``; ``check.CHECKS`` has all of them, in the order in which they
run. Nothing else in the library imports this package. Its modules, each importing only from those above it::

    fingerprint    what a simulation holds, to compare two runs
    report         findings, reports and their text
    inside         all that is used of the library's internals
    runs           plain runs, runs with RULE throughout, random episodes; all of them end
    subject        what is checked, and the report while it is written
    statistics     the ranges of observations and rewards
    checks, episodes, conformance    the check functions
    check          all of them, one after the other
    inspection     decision points and the order of their calls
"""

from .check import check_simulation
from .inspection import inspect_simulation
from .report import (
    CheckReport,
    ComponentStatistics,
    EpisodeStatistics,
    Finding,
    Inspection,
    PointDescription,
    PointStatistics,
    Timing,
)

__all__ = [
    "CheckReport",
    "ComponentStatistics",
    "EpisodeStatistics",
    "Finding",
    "Inspection",
    "PointDescription",
    "PointStatistics",
    "Timing",
    "check_simulation",
    "inspect_simulation",
]
