"""What candidate actions of a pending decision are worth."""

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
    """What candidate actions are worth. Made by ``action_values`` and by planners.

    Attributes:
        actions: The candidates.
        means: ``(candidates,)``: of each the mean return; nan where it was not tried.
        standard_errors: ``(candidates,)``: of these means; nan where there are not two returns.
        counts: ``(candidates,)`` int: in how many futures each was tried.
        best: The best candidate.
        returns: ``(candidates, futures)``: the returns themselves, nan where a candidate was not tried. A column is one
            future, so that the difference of two rows is free of what chance does to both alike.
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
    """Find out what each candidate action of the pending decision is worth, by trying it out in branches.

    In a branch the action is taken, and the agent's base decides from then on, up to the horizon or the agent's end.
    The futures are the same for all candidates. ``env`` itself does not move.

    Args:
        env: An environment of one simulation, with a decision pending: in any view, in wrappers or not. In the
            parallel view the agent is the one that is ``"deciding"``, and the others play the same rounds; in the joint
            view it is all agents together.
        actions: The candidates; ``RULE`` may be among them. None: all legal actions of a ``Discrete``.
        base: Who decides after the candidate: ``RULE``, a policy of the agent (a callable of the observation, or of the
            observation and the info), or a dict of these by agent. Other agents of the environment follow their own
            in the dict, else their rule; those in the option ``policies`` keep theirs.
        futures: In how many futures each candidate is tried.
        horizon: For how many decisions of the agent its rewards count, the candidate's being the first; with
            ``horizon_by="time"`` up to its first decision so much later. None: up to its end.
        horizon_by: "decision", or "time", the simulation's.
        terminal_value: What comes after the horizon is worth, a callable of the environment. It is called in the branch
            where the agent lives at the horizon.
        discount: By what a reward is discounted, for each decision of the agent that lies before the rewarded one.
        discount_by: "decision"; or "time", for each unit of the simulation's time that lies between the two.
        seed: Tells the futures from others of the same decision. None: those that the seed of the episode and the
            number of the decision give.
        method: As ``branch`` takes it.
        time_limit: After how many seconds a branch is ended.
        progress: Whether to show a bar, by ``tqdm``.

    Returns:
        The values. Where the simulation has no ``reseed``, and the environment no ``global_rng=True``, they are of the
        one future that lies ahead, which a warning says.

    Raises:
        ViewError: It is no environment of one simulation.
        ResetNeededError: No decision is pending.
        InvalidActionError: A candidate is not legal.
        UnknownAgentError: The base is one of an agent that there is not.
        OptionValueError: An argument cannot have its value.
        BranchError: A branch has died, has taken too long, or cannot be made.
        BaseException: What the model, a mapping or the base raises in a branch.
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
    """The values of candidates that were tried out.

    Args:
        found: What was found.
        left: Of which candidates the best is one.
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
    """Within a branch: what the base says, of which nothing is found out."""
    player = player_of(env, base)
    nothing = np.full(1, np.nan)
    return ActionValues((action := player.decide(),), nothing, nothing, np.zeros(1, np.int64), action, np.zeros((1, 0)))
