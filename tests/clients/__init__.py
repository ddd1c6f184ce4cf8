"""Tests with real learners: each trains, and ends with a better policy than it began with."""
