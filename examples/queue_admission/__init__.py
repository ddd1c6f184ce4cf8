"""A SimPy queue with two kinds of jobs: decisions at irregular times, and learners that discount by time."""
