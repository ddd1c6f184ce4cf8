"""The speed-up by policies that answer many simulations at once, and by several processes that share the work.

Run it with ``make benchmark``, which is pinned to one core; or alone and not pinned, with ``python -m benchmarks.core
--only many``, for the speed-up by several processes. Torch is measured if it is installed.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from benchmarks.hand_written import ACTION_SPACE, OBSERVATION_SPACE
from benchmarks.measure import Contender, Section, Times, now, ratio, side_by_side
from benchmarks.noop import Model
from simenv_marl import simulate, simulate_many

SIMULATIONS, DECISIONS = 1000, 100
FEW = 128
"""A number of simulations that fit into the processor's cache."""
SLOWLY = 100e-6
"""The seconds of a decision of the slow simulation."""


class Turns:
    """A simulation that only makes decisions, so that only the overhead remains."""

    def reset(self) -> None:
        self.model = Model()

    def run(self) -> None:
        model = self.model
        for _ in range(DECISIONS):
            model.left()


class SlowTurns(Turns):
    """The same with some work after each decision."""

    def run(self) -> None:
        for _ in range(DECISIONS // 10):
            self.model.left()
            end = time.perf_counter() + SLOWLY
            while time.perf_counter() < end:
                pass


def perceptron() -> list[tuple[Any, Any]]:
    """Draw the weights of a network with two hidden layers of 64."""
    generator = np.random.default_rng(0)
    sizes = (OBSERVATION_SPACE.shape[0], 64, 64, int(ACTION_SPACE.n))
    return [
        (generator.normal(0, n**-0.5, (n, m)).astype(np.float32), np.zeros(m, np.float32)) for n, m in pairwise(sizes)
    ]


def numpy_policy() -> Callable[[Any], Any]:
    """Make a policy for one observation or a batch."""
    (w0, b0), (w1, b1), (w2, b2) = perceptron()

    def policy(observations: Any) -> Any:
        hidden = np.tanh(observations @ w0 + b0)
        return (np.tanh(hidden @ w1 + b1) @ w2 + b2).argmax(-1)

    return policy


def torch_policy() -> Callable[[Any], Any] | None:
    """Make the same policy with Torch; None if it is not installed."""
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


def zeros(observations: Any) -> Any:
    """Choose action 0: a policy without cost."""
    return np.zeros(len(observations), np.int64)


def nothing(simulation: Any) -> None:
    """Keep nothing of a simulation."""


def one_by_one(policy: Callable[[Any], Any], number: int) -> Contender:
    def run() -> float:
        start = now()
        for seed in range(number):
            simulate(Turns, {Model.left: policy}, seed=seed)
        return (now() - start) / number / DECISIONS * 1e6

    return run


def at_once(policy: Callable[[Any], Any], number: int, size: int) -> Contender:
    def run() -> float:
        start = now()
        simulate_many(Turns, {Model.left: policy}, seeds=range(number), batch_size=size, collect=nothing)
        return (now() - start) / number / DECISIONS * 1e6

    return run


def slowly(policy: Callable[[Any], Any], number: int, workers: int) -> Contender:
    def run() -> float:
        start = time.perf_counter()
        simulate_many(SlowTurns, {Model.left: policy}, seeds=range(number), workers=workers, collect=nothing)
        return (time.perf_counter() - start) / number / (DECISIONS // 10) * 1e6

    return run


def measure(rounds: int, number: int) -> Section:
    """Measure many simulations: the policies if pinned to one core, else the processes.

    Args:
        rounds: The maximum number of rounds; a few suffice here.
        number: Not used: the decisions are always those of a thousand simulations.
    """
    section = Section("Many simulations", "microseconds per decision")
    if (len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()) == 1:
        _measure_policies(section, min(rounds, 7))
        section.remarks.append(
            "Many simulations: pinned to one core, so that several processes were not measured. They are with"
            " `python -m benchmarks.core --only many`, not pinned."
        )
    else:
        _measure_workers(section, min(rounds, 7))
        section.remarks.append("Many simulations: not pinned to one core, so that only processes were measured.")
    return section


def _measure_policies(section: Section, rounds: int) -> None:
    policies: dict[str, Any] = {"numpy": numpy_policy(), "torch": torch_policy()}
    limits = {"numpy": (3.5, 4.5), "torch": (13.0, 16.0)}
    for name, policy in policies.items():
        if policy is None:
            section.remarks.append(f"Many simulations: {name} is not installed, and was not measured.")
            continue
        times = side_by_side(
            {
                f"one by one with simulate, {name}": one_by_one(policy, SIMULATIONS // 10),
                f"{SIMULATIONS} at once, {name}": at_once(policy, SIMULATIONS, SIMULATIONS),
                f"{SIMULATIONS}, {FEW} of them at once, {name}": at_once(policy, SIMULATIONS, FEW),
            },
            rounds,
        )
        single, many, few = times
        what = f"one by one / {SIMULATIONS} at once, MLP 64x64, {name}"
        section.ratio(what, ratio(times, single, many), *limits[name], at_least=True)
        section.ratio(f"one by one / {SIMULATIONS}, {FEW} at once, MLP 64x64, {name}", ratio(times, single, few))
        section.times(times)


def _measure_workers(section: Section, rounds: int) -> None:
    try:
        import joblib  # noqa: F401
    except ImportError:
        section.remarks.append("Many simulations: joblib is not installed, and several processes were not measured.")
        return
    times: Times = side_by_side(
        {
            "100 us per decision, this process": slowly(zeros, SIMULATIONS, 0),
            "100 us per decision, two workers": slowly(zeros, SIMULATIONS, 2),
        },
        rounds,
    )
    alone, shared = times
    section.ratio(
        "100 us per decision: one process / two workers, not pinned",
        ratio(times, alone, shared),
        1.7,
        1.9,
        at_least=True,
    )
    section.times(times)
