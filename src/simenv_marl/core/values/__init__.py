"""Casts, checks and stacks of observations and actions. It uses nothing else of the core."""
