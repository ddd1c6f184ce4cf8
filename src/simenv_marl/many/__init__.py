"""Policies back in the model: in one simulation, or in many at once; what learners learn from it, and pictures."""
