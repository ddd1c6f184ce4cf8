"""Policies that imitate: the model's rule, and a planner."""
