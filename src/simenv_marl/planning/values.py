"""The values of candidate actions for a pending decision."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.session import checked_seed
from ..simulation import RULE
from .futures import Futures
from .lookahead import Lookahead, within_a_branch
from .players import player_of


@dataclass(frozen=True, eq=False)
class ActionValues:
    """The estimated values of candidate actions. Made by ``action_values`` and by planners.

    Attributes:
        actions: The candidates.
        means: ``(candidates,)``: the mean return of each candidate; nan if it was not tried.
        standard_errors: ``(candidates,)``: the standard errors of the means; nan with fewer than two returns.
        counts: ``(candidates,)`` int: the number of futures in which each candidate was tried.
        best: The best candidate.
        returns: ``(candidates, futures)``: the returns, nan where a candidate was not tried. A column is one future, so
            that the difference of two rows excludes the chance that affects both.
    """

    actions: tuple[Any, ...]
    means: NDArray[np.float64]
    standard_errors: NDArray[np.float64]
    counts: NDArray[np.int64]
    best: Any
    returns: NDArray[np.float64]


def action_values(
    env: Any,
    actions: Any = None,
    *,
    base: Any = RULE,
    futures: int = 16,
    horizon: float | None = None,
    horizon_by: str = "decision",
    terminal_value: Callable[[Any], float] | None = None,
    discount: float = 1.0,
    discount_by: str = "decision",
    seed: int | None = None,
    method: str | None = None,
    time_limit: float = 600.0,
    progress: bool = False,
) -> ActionValues:
    """Estimate the value of each candidate action of the pending decision by trying it in branches.

    In a branch the action is taken, and the agent's base decides from then on, up to the horizon or the agent's end.
    All candidates meet the same futures. ``env`` itself does not move.

    Args:
        env: An environment of one simulation with a pending decision, in any view, with or without wrappers. In the
            parallel view, the agent is the one that is ``"deciding"``, and the others play the same rounds. In the
            joint view, it is the one agent that stands for all.
        actions: The candidates; ``RULE`` may be among them. None: all legal actions of a ``Discrete``.
        base: What decides after the candidate: ``RULE``, a policy of the agent (a callable of the observation, or of
            the observation and the info), or a dict of these by agent. Other agents of the environment follow their
            entry in the dict, else their rule. Agents in the option ``policies`` keep their policies.
        futures: The number of futures in which each candidate is tried.
        horizon: The number of the agent's decisions whose rewards count, including the candidate. With
            ``horizon_by="time"``: a duration; rewards count up to the agent's first decision after at least that time.
            None: up to the agent's end.
        horizon_by: The unit of the horizon: "decision", or "time" for the simulation's time.
        terminal_value: The value of what comes after the horizon: a callable of the environment. It is called in the
            branch if the agent still lives at the horizon.
        discount: The discount factor, from 0 to 1.
        discount_by: The unit of discounting: "decision" for each decision of the agent before the rewarded one, or
            "time" for each unit of the simulation's time between the candidate and the rewarded decision.
        seed: A number that distinguishes the futures from others of the same decision. None: the futures that follow
            from the seed of the episode and the number of the decision.
        method: The method of branching, as ``branch`` takes it.
        time_limit: The time after which a branch is ended, in seconds.
        progress: Whether to show a progress bar, by ``tqdm``.

    Returns:
        The values. If the simulation has no ``reseed`` and the environment was not made with ``global_rng=True``, there
        is only the one exact future, and a warning says so.

    Raises:
        ViewError: ``env`` is not an environment of one simulation.
        ResetNeededError: No decision is pending.
        InvalidActionError: A candidate is not legal.
        UnknownAgentError: The base names an agent that does not exist.
        OptionValueError: An argument has an invalid value.
        BranchError: A branch died, took too long, or cannot be made.
        BaseException: Any exception of the model, a mapping or the base in a branch.
    """
    look = Lookahead(
        base=base, futures=futures, horizon=horizon, horizon_by=horizon_by, terminal_value=terminal_value,
        discount=discount, discount_by=discount_by, method=method, time_limit=time_limit,
    )  # fmt: skip
    if within_a_branch():
        return base_value(env, base)
    found = Futures(env, actions, look, checked_seed(seed))
    found.run(range(len(found.actions)), look.futures, progress=progress)
    return valued(found, range(len(found.actions)))


def valued(found: Futures, left: Sequence[int]) -> ActionValues:
    """Return the values of candidates that were tried.

    Args:
        found: The results of the tries.
        left: The places of the candidates among which the best one is chosen.
    """
    table, counts = found.table(), np.array([len(values) for values in found.returns], np.int64)
    means, errors = np.full((2, len(counts)), np.nan)
    for row, values in enumerate(found.returns):
        if values:
            means[row] = np.mean(values)
        if len(values) > 1:
            errors[row] = np.std(values, ddof=1) / np.sqrt(len(values))
    best = max(left, key=lambda place: -np.inf if np.isnan(means[place]) else means[place])
    return ActionValues(tuple(found.actions), means, errors, counts, found.actions[best], table)


def base_value(env: Any, base: Any) -> ActionValues:
    """Return the base's answer as the best action, without tries; within a branch."""
    player = player_of(env, base)
    nothing = np.full(1, np.nan)
    return ActionValues((action := player.decide(),), nothing, nothing, np.zeros(1, np.int64), action, np.zeros((1, 0)))
