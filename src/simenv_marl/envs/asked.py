"""The environment that a policy is given which asks for it: the single view of the agent for which it decides."""

from __future__ import annotations

import copy
from typing import Any, NoReturn

from gymnasium import spaces

from ..core.agent import Agent
from ..core.asking import AskingPolicy
from ..core.session import Session
from ..errors import BranchError, CopyError, ReentrancyError
from .single import SimulationEnv


class AskedEnv(SimulationEnv):
    """The single view of an agent while its policy is asked. It is for ``branch``, and what is made of that.

    Its decision is pending, and is answered by what the policy returns. In a branch it is an environment like any
    other: it can be stepped, and tells the agent's observations and rewards. All other agents are left to their
    policies there, and to their rule where they have none.
    """

    def __init__(self, session: Session) -> None:
        """Make the view.

        Args:
            session: A session in whose episode a policy is asked that is given the environment.
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
        """Wait for the agent alone, now that this is a branch."""
        if not self._branched:
            self._branched = True
            self._session.step_out()
            self._running().single_out(self._own)

    def check_pending(self) -> None:
        """Make sure that the decision is pending.

        Raises:
            ResetNeededError, ReentrancyError: It was answered.
        """
        episode = self._running()
        if (episode.pending or episode.consulted) is not self._own:
            raise episode.refusal()

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """In a branch: answer the pending decision and run to the agent's next one, as in every single view.

        Raises:
            ReentrancyError: This is no branch.
        """
        if not self._branched:
            raise ReentrancyError(
                "the decision is answered by what the policy returns; step(action) is for branches of this environment"
            )
        return super().step(action)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> NoReturn:
        """Refuse: it is the environment of one decision.

        Raises:
            ReentrancyError: Always.
        """
        raise ReentrancyError("the environment that a policy is given stands at its decision, and is not to be reset")

    def close(self) -> None:
        """In a branch: end it.

        Raises:
            ReentrancyError: This is no branch.
        """
        if not self._branched:
            raise ReentrancyError(
                "the environment that a policy is given goes on when it has answered; it is not closed"
            )
        super().close()

    def replayed(self) -> AskedEnv:
        """Make an environment that stands just where this one stands: a copy for ``branch``.

        Raises:
            BranchError: It cannot be brought there.
        """
        if self._running().alone:
            raise BranchError(
                "a branch of the environment that a policy is given cannot be branched again by replaying; use"
                ' method="fork"'
            )
        session = Session(self._made_of)
        try:
            session.take_over(copy.deepcopy(self._session.kept()))
            session.replay(self._session)
            return type(self)(session)
        except BaseException:
            session.close()
            raise

    def __deepcopy__(self, memory: dict[int, Any]) -> NoReturn:
        raise CopyError("the environment that a policy is given cannot be copied; branch continues it")

    def __reduce_ex__(self, protocol: Any) -> NoReturn:
        raise CopyError("the environment that a policy is given cannot be pickled; branch continues it")


AskingPolicy.make = staticmethod(AskedEnv)
