"""How much is tested: with which drivers, how many random examples, and which cases.

`make test` tries few examples, `make test-thorough` all of them.
"""

import pytest
from hypothesis import settings

DRIVERS = ("greenlet", "thread")

QUICK = 0.1
"""The share of the examples that `--extent quick` leaves."""

share = 1.0


def examples(number):
    """Settings of a property test that tries so many examples, or their share."""
    return settings(max_examples=max(2, round(share * number)))


def thorough(*values):
    """Values of a parameter that `make test` leaves out."""
    return [pytest.param(value, marks=pytest.mark.thorough) for value in values]
