"""Functions that stand in front of a model's own, and who takes part in their calls."""
