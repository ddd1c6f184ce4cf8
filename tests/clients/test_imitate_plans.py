"""The example of expert iteration, in a small way."""

import numpy as np
import pytest

pytest.importorskip("torch")

from examples.greenhouse_coop import imitate_plans
from examples.greenhouse_coop.imitate_plans import CANDIDATES, Network, iterate, teach

from . import commands

pytestmark = pytest.mark.filterwarnings("default")  # learners warn of much that is theirs


def test_a_network_is_taught_what_is_worth_most_by_what_it_sees():
    """Where the first number is below a half little water is worth most, else much."""
    rng = np.random.default_rng(0)
    observations = rng.random((400, 6), np.float32)
    best = np.where(observations[:, :1] < 0.5, CANDIDATES[1], CANDIDATES[7])
    values = -np.abs(CANDIDATES - best) * 100
    network = teach(observations, values, steps=600, seed=0)
    poured = network(observations)
    assert poured.shape == (400, 1)
    assert poured.dtype == np.float32
    clear = np.abs(observations[:, 0] - 0.5) > 0.1
    assert np.abs(poured - best)[clear].mean() < 0.01
    assert network(observations[0]) == pytest.approx(poured[0], abs=1e-6)


def test_days_are_counted_and_the_budget_holds(monkeypatch):
    monkeypatch.setattr(imitate_plans, "EPISODES", 1)
    monkeypatch.setattr(imitate_plans, "HORIZON", 2)
    course = iterate(2000, seed=1, steps=5, workers=0, watched=[3])
    assert isinstance(course.policy, Network)
    ends = [days for days, _ in course.rounds]
    rounds = np.diff([0, *ends])
    assert course.days == ends[-1] <= 2000
    assert 2000 - course.days < rounds.max()
    assert ((rounds - 100) % len(CANDIDATES) == 0).all()  # a hundred days of an episode, and those of its branches
    assert (rounds > 100 + 9 * 2 * 10).all()


def test_it_comes_to_the_same_in_any_number_of_processes(monkeypatch):
    monkeypatch.setattr(imitate_plans, "EPISODES", 2)
    monkeypatch.setattr(imitate_plans, "HORIZON", 1)
    courses = [iterate(1200, seed=1, steps=3, workers=workers) for workers in (0, 2)]
    assert courses[0].days == courses[1].days
    seen = np.full((1, 6), 0.5, np.float32)
    assert courses[0].policy(seen).tolist() == courses[1].policy(seen).tolist()


def test_what_was_poured_is_imitated():
    pytest.importorskip("minari")
    course = imitate_plans.imitate_plainly(2800, seed=0, steps=10, workers=0)
    assert course.days == 100 + 9 * (3 * 98 + 2 + 1)
    assert course.policy(np.zeros((3, 6), np.float32)).shape == (3, 1)


def test_the_script():
    printed = commands.example(
        "greenhouse_coop.imitate_plans", "--budget", 1000, "--learners", 1, "--steps", 5, "--seeds", 1, "--workers", 2
    )
    assert "learner 1: " in printed
