"""Checks of a simulation and its decision points: what to know before trusting an environment.

``check_simulation`` runs a simulation plainly and behind environments, plays episodes of random actions, and says in
plain words what is wrong; ``inspect_simulation`` tells what there is to be decided. Both are on the command line too::

    python -m simenv_marl check package.module:Simulation
    python -m simenv_marl inspect package.module:Simulation

A check is a function of a ``Subject`` and a ``Report``; all of them stand in ``check.CHECKS``, in the order in which
they run. Nothing else of the library imports this package. Its modules, each importing only from those above it::

    fingerprint    what a simulation holds, so that two runs can be compared
    report         findings, reports and their text
    inside         all that is used of the library's inside
    runs           plain runs, runs with RULE throughout, random episodes; all of them end
    subject        what is checked, and the report while it is written
    statistics     what observations and rewards range over
    checks, episodes, conformance    the check functions
    check          all of them, one after the other
    inspection     what there is to be decided
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
