"""What it brings to have policies answer many simulations at once, and to have several processes share the work.

Run with ``make benchmark``, or alone with ``python -m benchmarks.core --only many``. Torch is measured where it is
installed. Processes are compared only where there are several cores: run it alone, and not pinned to one.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from gymnasium import spaces

from benchmarks.measure import Contender, Section, Times, ratio, side_by_side
from simenv_marl import make_step, simulate, simulate_many

SIMULATIONS, DECISIONS = 1000, 20
SLOWLY = 100e-6
"""Seconds that a decision of the slow simulation takes."""

WIDTH, ACTIONS = 8, 4


class Walk:
    """A simulation that does next to nothing between its decisions."""

    def reset(self, seed: int) -> None:
        self.state = np.full(WIDTH, seed % 7, np.float32)

    @make_step(
        observation_space=spaces.Box(-1e6, 1e6, (WIDTH,), np.float32),
        observation_space_mapping=lambda walk: walk.state,
        action_space=spaces.Discrete(ACTIONS),
        action_space_mapping=lambda action: action,
        reward_mapping=lambda walk: 0.0,
    )
    def decide(self) -> int:
        return 0

    def run(self) -> None:
        for _ in range(DECISIONS):
            self.state[self.decide()] += 1


class SlowWalk(Walk):
    """The same, and every decision is followed by a while of work."""

    def run(self) -> None:
        for _ in range(DECISIONS):
            self.state[self.decide()] += 1
            end = time.perf_counter() + SLOWLY
            while time.perf_counter() < end:
                pass


def perceptron() -> list[tuple[Any, Any]]:
    """The weights of a network with two hidden layers of 64."""
    generator = np.random.default_rng(0)
    sizes = (WIDTH, 64, 64, ACTIONS)
    return [
        (generator.normal(0, n**-0.5, (n, m)).astype(np.float32), np.zeros(m, np.float32)) for n, m in pairwise(sizes)
    ]


def numpy_policy() -> Callable[[Any], Any]:
    """A policy of one observation or of many."""
    (w0, b0), (w1, b1), (w2, b2) = perceptron()

    def policy(observations: Any) -> Any:
        hidden = np.tanh(observations @ w0 + b0)
        return (np.tanh(hidden @ w1 + b1) @ w2 + b2).argmax(-1)

    return policy


def torch_policy() -> Callable[[Any], Any] | None:
    """The same with torch; None where that is not installed."""
    try:
        import torch
    except ImportError:
        return None
    torch.set_num_threads(1)
    layers: list[Any] = []
    for weights, biases in perceptron():
        layer = torch.nn.Linear(*weights.shape)
        layer.load_state_dict({"weight": torch.tensor(weights.T), "bias": torch.tensor(biases)})
        layers += [layer, torch.nn.Tanh()]
    network = torch.nn.Sequential(*layers[:-1])

    def policy(observations: Any) -> Any:
        with torch.no_grad():
            return network(torch.from_numpy(observations)).argmax(-1).numpy()

    return policy


def nothing(simulation: Any) -> None:
    """Keep nothing of a simulation."""


def one_by_one(policy: Callable[[Any], Any], number: int) -> Contender:
    def run() -> float:
        start = time.perf_counter()
        for seed in range(number):
            simulate(Walk, {Walk.decide: policy}, seed=seed)
        return (time.perf_counter() - start) / number / DECISIONS * 1e6

    return run


def at_once(
    policy: Callable[[Any], Any], number: int, *, model: type[Walk] = Walk, size: int = SIMULATIONS, workers: int = 0
) -> Contender:
    def run() -> float:
        start = time.perf_counter()
        seeds = range(number)
        simulate_many(model, {model.decide: policy}, seeds=seeds, batch_size=size, workers=workers, collect=nothing)
        return (time.perf_counter() - start) / number / DECISIONS * 1e6

    return run


def measure(rounds: int, number: int) -> Section:
    """Measure many simulations.

    Args:
        rounds: How many rounds, at most; a few are enough here.
        number: Not used: there are always as many decisions as a thousand simulations make.
    """
    section = Section("Many simulations", "microseconds per decision")
    policies: dict[str, Any] = {"numpy": numpy_policy(), "torch": torch_policy()}
    limits = {"numpy": (3.0, 4.0), "torch": (10.0, 15.0)}
    for name, policy in policies.items():
        if policy is None:
            section.remarks.append(f"Many simulations: {name} is not installed, and was not measured.")
            continue
        times = side_by_side(
            {
                f"one by one with simulate, {name}": one_by_one(policy, SIMULATIONS // 5),
                f"{SIMULATIONS} at once, {name}": at_once(policy, SIMULATIONS),
            },
            min(rounds, 7),
        )
        single, many = times
        section.ratio(
            f"one by one / {SIMULATIONS} at once, MLP 64x64, {name}", ratio(times, single, many), *limits[name]
        )
        section.times(times)
    _measure_workers(section, min(rounds, 5), policies["numpy"])
    return section


def _measure_workers(section: Section, rounds: int, policy: Callable[[Any], Any]) -> None:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if cores < 2:
        section.remarks.append(
            "Many simulations: pinned to one core, so that several processes were not measured; they are with"
            " `python -m benchmarks.core --only many`."
        )
        return
    try:
        import joblib  # noqa: F401
    except ImportError:
        section.remarks.append("Many simulations: joblib is not installed, and several processes were not measured.")
        return
    times: Times = side_by_side(
        {
            "100 us per decision, this process": at_once(policy, SIMULATIONS, model=SlowWalk),
            "100 us per decision, two workers": at_once(policy, SIMULATIONS, model=SlowWalk, workers=2),
        },
        rounds,
    )
    alone, shared = times
    section.ratio("100 us per decision: one process / two workers, not pinned", ratio(times, alone, shared), 1.7, 1.9)
    section.times(times)
