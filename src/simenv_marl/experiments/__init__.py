"""Experiments: evaluations, designs, experiments that resume, effects, variants of a model."""

from ..core import provenance
from .designs import design
from .effects import Effects, effects, sobol_indices
from .evaluation import Evaluation, evaluate
from .ledgers import Ledger, decision_values, ledger
from .runs import Variant, run_experiment

__all__ = [
    "Effects",
    "Evaluation",
    "Ledger",
    "Variant",
    "decision_values",
    "design",
    "effects",
    "evaluate",
    "ledger",
    "provenance",
    "run_experiment",
    "sobol_indices",
]
