"""The parallel view: rounds, in which every agent has at most one action."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pettingzoo import ParallelEnv

from ..core.agent import Record
from ..core.plan import Plan
from ..core.rounds import Rounds
from ..core.spaces import duplicate
from ..simulation import Sentinel
from .base import AgentsView

Results = tuple[dict[str, Any], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]


class SimulationParallelEnv(AgentsView, ParallelEnv[str, Any, Any]):
    """A simulation as a PettingZoo parallel environment. Made by ``parallel_env`` and ``generate_env``.

    With ``padded=True`` all of ``possible_agents`` are there until the episode ends, whether they are ``"present"``, as
    their infos then tell, or not.

    A step answers each decision as it arises with the action given for its agent, once, and returns at the
    first decision whose action is missing or used already. All actions at once so give simultaneous moves,
    and one action at a time gives turns. All live agents are observed and rewarded at the return.

    Attributes:
        agents: The live agents.
    """

    _episode: Rounds | None

    def __init__(self, plan: Plan) -> None:
        """Make the environment of a plan.

        Raises:
            SimEnvError: Something in the plan cannot work.
        """
        super().__init__(plan)
        self.agents = []

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """Reset the simulation and run it to its first decision.

        Args:
            seed: Seeds the environment's generator and the agents' spaces, and is what the simulation's
                ``reset`` gets. None: the simulation gets a seed drawn from the generator.
            options: Handed to the simulation's ``reset``, where that takes them.

        Returns:
            By agent, the observations and the infos.

        Raises:
            NoDecisionError: The simulation ended without a decision.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        self._episode = episode = self._start(seed, options, Rounds)
        self.agents = list(episode.agents)
        if self._shows:
            self.render()
        records = episode.agents.values()
        observations = {record.agent: self._hand_out(record) for record in records}
        infos = {
            record.agent: {**record.info, "deciding": record is episode.pending, "acted": False} for record in records
        }
        if self._padded:
            self._pad(episode, (observations, {}, {}, {}, infos))
        return observations, infos

    def step(self, actions: Mapping[str, Any] | Sentinel) -> Results:
        """Play a round.

        Args:
            actions: By live agent: an action in its action space, or ``RULE``. ``RULE`` in place of the dict:
                for all of them.

        Returns:
            By agent: observations, rewards (python floats), terminations, truncations (python bools) and
            infos. ``infos[agent]["deciding"]`` tells whose decision is pending, ``["acted"]`` whether the
            agent's action was used. Agents that have ended are among them for the last time.

        Raises:
            UnknownAgentError: An action is for nobody who lives. The environment stands where it stood.
            InvalidActionError: An action is not legal. The environment stands where it stood.
            ResetNeededError: There is no episode to go on with.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        episode = self._episode
        if episode is None:
            raise self._session.not_running()
        if isinstance(actions, Sentinel):
            actions = dict.fromkeys(episode.agents, actions)
        elif self._padded and isinstance(actions, Mapping):
            actions = self._of_those_present(episode, actions)
        try:
            episode.play(actions)
        except BaseException:
            if episode.over:  # an error has ended it
                self.agents = []
            raise
        results: Results = {}, {}, {}, {}, {}
        observations, rewards, terminations, truncations, infos = results
        terminated, truncated, pending = episode.terminated, episode.truncated, episode.pending
        for record in episode.parting:
            agent = record.agent
            observations[agent] = self._hand_out(record)
            rewards[agent] = record.reward
            terminations[agent], truncations[agent] = True, False
            infos[agent] = info = record.info
            info["deciding"], info["acted"] = False, record.acted
        for agent, record in episode.agents.items():
            observation, info = record.observation, record.info
            if observation is None or record.handed_out is observation:
                observation = self._hand_out(record)
            else:
                record.handed_out = observation
            observations[agent] = observation
            rewards[agent] = record.reward
            terminations[agent], truncations[agent] = terminated, truncated
            info["deciding"], info["acted"] = False, record.acted
            infos[agent] = info
        if pending is not None:
            pending.info["deciding"] = True
        self.agents = [] if episode.over else list(episode.agents)
        if self._padded:
            self._pad(episode, results)
        if self._shows:
            self.render()
        return results

    def _clear(self) -> None:
        super()._clear()
        self.agents = []

    def _of_those_present(self, episode: Rounds, actions: Mapping[str, Any]) -> dict[str, Any]:
        """Take out the actions of agents of the roster that have not been seen yet or are gone."""
        roster, agents = self._plan.roster, episode.agents
        return {
            agent: action
            for agent, action in actions.items()
            if agent not in roster or (agent in agents and agents[agent].info.get("present"))
        }

    def _pad(self, episode: Rounds, results: Results) -> None:
        """Have everybody of the roster be there, and end together."""
        observations, rewards, terminations, truncations, infos = results
        for agent in self.possible_agents:
            record = episode.record(agent)
            assert record is not None
            if agent in episode.gone or not record.info["present"]:
                acted = agent in infos and infos[agent]["acted"]
                observations[agent] = record.binding.blank()
                infos[agent] = {**record.unseen(), "deciding": False, "acted": acted}
                rewards.setdefault(agent, 0.0)
            terminations[agent], truncations[agent] = episode.terminated, episode.truncated
            part: Any
            for part in results:
                if agent in part:  # to stand in the order of the roster
                    part[agent] = part.pop(agent)
        if not episode.over:
            self.agents = list(self.possible_agents)

    def _hand_out(self, record: Record) -> Any:
        """The observation of an agent, which nobody else gets to see: each return makes its own."""
        observation = record.observation
        if observation is None:
            return record.binding.blank()
        if record.handed_out is observation:  # it could not be observed anew
            return duplicate(observation)
        record.handed_out = observation
        return observation
