"""Checks of a simulation and its decision points, to run before trusting an environment.

``check_simulation`` runs a simulation by itself and in environments, plays episodes of random actions, and explains
what is wrong. ``inspect_simulation`` lists the decision points and their calls. Both are also on the command line::

    python -m simenv_marl check package.module:Simulation
    python -m simenv_marl inspect package.module:Simulation
"""

from .check import check_simulation, inspect_simulation
from .report import CheckReport, Finding, Inspection, PointStatistics, Range

__all__ = [
    "CheckReport",
    "Finding",
    "Inspection",
    "PointStatistics",
    "Range",
    "check_simulation",
    "inspect_simulation",
]
