"""Exact values of the queue: with exponential times, it is a Markov chain with few states.

A *state* is the number of waiting jobs of each kind, and the kind in service (None: the server is
idle). A *decision* is the kind of an arriving job and the state that it finds. A *table* tells for
each decision whether the job is admitted.
"""

from __future__ import annotations

from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from .model import HOLDING_COST, INTEREST, KINDS, PLACES

State = tuple[int, int, int | None]
Decision = tuple[int, State]
Table = dict[Decision, bool]

EMPTY: Final[State] = (0, 0, None)

STATES: Final[list[State]] = [
    EMPTY,
    *(
        (a, b, serving)
        for serving in (0, 1)
        for a, b in product(range(PLACES + 1), repeat=2)
        if a + b <= PLACES
    ),
]

DECISIONS: Final[list[Decision]] = [
    (kind, x) for kind in range(len(KINDS)) for x in STATES if x[0] + x[1] < PLACES
]

ADMIT_ALL: Final[Table] = dict.fromkeys(DECISIONS, True)


def admitted(kind: int, state: State) -> State:
    """Return the state after a job was admitted."""
    a, b, serving = state
    if serving is None:
        return (0, 0, kind)
    return (a + (kind == 0), b + (kind == 1), serving)


def finished(state: State) -> State:
    """Return the state after a service has ended."""
    a, b, _ = state
    return (a - 1, b, 0) if a else (a, b - 1, 1) if b else EMPTY


def values(
    table: Table, *, rate: float = INTEREST, reward_rate: float | None = None, gamma: float = 1.0
) -> dict[State, float]:
    """Return the value of a table in each state, by linear equations.

    Args:
        table: Which jobs are admitted.
        rate: The rate that discounts what comes after the next decision, for the time until then.
        reward_rate: The rate that discounts the rewards before the next decision. None: the same.
        gamma: A further discount for each decision.
    """
    number = {state: i for i, state in enumerate(STATES)}
    # rates of moves without a decision, and by a decision
    moves, decided = np.zeros((2, len(STATES), len(STATES)))
    gain = np.zeros(len(STATES))
    for state, i in number.items():
        a, b, serving = state
        gain[i] = -HOLDING_COST * (a + b + (serving is not None))
        if serving is not None:
            moves[i, number[finished(state)]] += KINDS[serving].services
            gain[i] += KINDS[serving].services * KINDS[serving].reward
        for kind, about in enumerate(KINDS):
            if (kind, state) in table:
                after = admitted(kind, state) if table[kind, state] else state
                decided[i, number[after]] += about.arrivals
    leaving = np.diag((moves + decided).sum(1))
    unit = np.eye(len(STATES))
    rewards = np.linalg.solve(
        leaving + unit * (rate if reward_rate is None else reward_rate) - moves, gain
    )
    weights = gamma * np.linalg.solve(leaving + unit * rate - moves, decided)
    found: NDArray[np.float64] = np.linalg.solve(unit - weights, rewards)
    return dict(zip(STATES, found.tolist(), strict=True))


def worth(table: Table) -> float:
    """Return a table's worth: the expected present value of an endless run from an empty queue."""
    return values(table)[EMPTY]


def best_table(**discounts: float) -> Table:
    """Return the best table under the given discounts of ``values``, by policy iteration."""
    table: Table = {}
    better = ADMIT_ALL
    while better != table:
        table = better
        known = values(table, **discounts)
        better = {
            (kind, state): known[admitted(kind, state)] > known[state] for kind, state in DECISIONS
        }
    return table
