"""A market for four people: a model without any environment, two conditions of an experiment, and their seats."""
