"""A market for four people: a model without an environment, two conditions, and their seats."""
