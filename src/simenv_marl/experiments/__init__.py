"""Experiments: evaluations, designs, experiments that resume, effects, variants of a model."""

from ..core import provenance
from .designs import design
from .effects import Effects, effects, sobol_indices
from .evaluation import Evaluation, evaluate
from .runs import Variant, run_experiment

__all__ = [
    "Effects",
    "Evaluation",
    "Variant",
    "design",
    "effects",
    "evaluate",
    "provenance",
    "run_experiment",
    "sobol_indices",
]
