"""A SimPy queue with two kinds of jobs: irregular decisions, and learners that discount by time."""
