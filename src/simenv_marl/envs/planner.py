"""The environment that a planner gets: the single view of the agent for which it decides."""

from __future__ import annotations

from copy import deepcopy
from typing import Any, NoReturn

from gymnasium import spaces

from ..core.plan import Plan
from ..core.session import Session
from ..errors import BranchError, CopyError, ReentrancyError
from .base import View
from .single import SimulationEnv


class PlannerEnv(SimulationEnv):
    """The single view of an agent whose planner is being asked, for ``branch`` and the functions built on it.

    The decision is pending until the planner returns an action. A branch is an ordinary environment of the agent, which
    can be stepped; policies or rules answer for all other agents.
    """

    def __init__(self, plan: Plan, session: Session | None = None) -> None:
        """Make the view of a session in whose episode a planner is being asked; None: of a new session, to replay."""
        View.__init__(self, plan, session)
        self._shows = self._branched = False
        if session is not None:
            self._resume_from_replay()

    @classmethod
    def check(cls, plan: Plan) -> None:
        """Allow every plan: the agent is the one whose planner is being asked."""

    def _resume_from_replay(self) -> None:
        episode: Any = self._running()
        self._own = episode.consulted or episode.pending
        self._agent = self._own.name

    def _make_spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        definition = self._own.point.definition
        return deepcopy((definition.observation_space, definition.action_space))

    def replayed(self) -> Any:
        """Make a copy for ``branch`` that stands at the same decision, by a replay."""
        if self._running().plan.solo:
            raise BranchError(
                "a branch of the environment that a policy is given cannot be branched again by replay; use"
                ' method="fork"'
            )
        return super().replayed()

    def begin_branch(self) -> None:
        """Turn this environment into a branch that waits for the agent only."""
        if not self._branched:
            self._branched = True
            self._session.step_out()
            self._running().single_out(self._own)

    def check_pending(self) -> None:
        """Refuse a branch after the planner has returned its action."""
        episode = self._running()
        if (episode.pending or episode.consulted) is not self._own:
            raise episode.refusal()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """In a branch, answer the pending decision and run to the agent's next one."""
        if not self._branched:
            raise ReentrancyError(
                "a policy answers by what it returns; call step(action) only on branches of this environment"
            )
        return super().step(action)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> NoReturn:
        """Refuse the reset: this is the environment of one decision."""
        raise ReentrancyError("a policy cannot reset the environment that it is given; it must return an action")

    def close(self) -> None:
        """End a branch."""
        if not self._branched:
            raise ReentrancyError("a policy cannot close the environment that it is given; it must return an action")
        super().close()

    def __deepcopy__(self, memory: dict[int, Any]) -> NoReturn:
        raise CopyError("the environment that a policy is given cannot be copied; use branch to continue it")

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise CopyError("the environment that a policy is given cannot be pickled; use branch to continue it")
