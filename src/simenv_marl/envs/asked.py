"""The environment for policies that ask for one: the single view of the agent for which the policy decides."""

from __future__ import annotations

import copy
from typing import Any, NoReturn

from gymnasium import spaces

from ..core.agent import Agent
from ..core.asking import AskingPolicy
from ..core.session import Session
from ..core.solo import single_out
from ..errors import BranchError, CopyError, ReentrancyError
from .single import SimulationEnv


class AskedEnv(SimulationEnv):
    """The single view of an agent while its policy is asked. It serves for ``branch`` and the functions built on it.

    The agent's decision is pending, and the return value of the policy answers it. A branch of it is an ordinary
    environment: it can be stepped, and returns the agent's observations and rewards. In a branch, policies answer for
    all other agents, or the rule where there is no policy.
    """

    def __init__(self, session: Session) -> None:
        """Make the view.

        Args:
            session: A session in whose episode such a policy is being asked.
        """
        self._plan = self._made_of = session.plan
        self._session = session
        self.metadata = self.metadata_of(session.plan)
        self.render_mode, self._shows = session.plan.options.render_mode, False
        episode: Any = session.episode
        self._own: Agent = episode.consulted or episode.pending
        self._agent = self._own.name
        self._branched = False

    def _make_spaces(self) -> tuple[spaces.Space[Any], spaces.Space[Any]]:
        definition = self._own.point.definition
        return copy.deepcopy((definition.observation_space, definition.action_space))

    def begin_branch(self) -> None:
        """Turn this environment into a branch that waits for the agent only."""
        if not self._branched:
            self._branched = True
            self._session.step_out()
            single_out(self._running(), self._own)

    def check_pending(self) -> None:
        """Make sure that the decision is pending.

        Raises:
            ResetNeededError, ReentrancyError: The decision was already answered.
        """
        episode = self._running()
        if (episode.pending or episode.consulted) is not self._own:
            raise episode.refusal()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """In a branch, answer the pending decision and run to the agent's next one, as in every single view.

        Raises:
            ReentrancyError: This environment is not a branch.
        """
        if not self._branched:
            raise ReentrancyError(
                "a policy answers by what it returns; call step(action) only on branches of this environment"
            )
        return super().step(action)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> NoReturn:
        """Refuse the reset: this is the environment of one decision.

        Raises:
            ReentrancyError: Always.
        """
        raise ReentrancyError("a policy cannot reset the environment that it is given; it must return an action")

    def close(self) -> None:
        """End a branch.

        Raises:
            ReentrancyError: This environment is not a branch.
        """
        if not self._branched:
            raise ReentrancyError("a policy cannot close the environment that it is given; it must return an action")
        super().close()

    def replayed(self) -> AskedEnv:
        """Make a copy for ``branch`` that stands at the same decision, by a replay.

        Raises:
            BranchError: The replay does not reach the same decision.
        """
        if self._running().plan.solo:
            raise BranchError(
                "a branch of the environment that a policy is given cannot be branched again by replay; use"
                ' method="fork"'
            )
        session = Session(self._made_of)
        try:
            session.restore(copy.deepcopy(self._session.snapshot()))
            session.replay(self._session)
            return type(self)(session)
        except BaseException:
            session.close()
            raise

    def __deepcopy__(self, memory: dict[int, Any]) -> NoReturn:
        raise CopyError("the environment that a policy is given cannot be copied; use branch to continue it")

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise CopyError("the environment that a policy is given cannot be pickled; use branch to continue it")


AskingPolicy.make = staticmethod(AskedEnv)
