"""The parallel view: rounds, in which every agent has at most one action."""

from collections.abc import Mapping
from typing import Any

from pettingzoo import ParallelEnv

from ..core.episode import Episode, When
from ..core.plan import Plan
from ..core.spaces import duplicate
from ..simulation import Sentinel
from .base import View
from .padded import Results, of_present_agents, pad
from .pettingzoo_base import AgentsView


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

    def __init__(self, plan: Plan) -> None:
        """Make the environment of a plan.

        Raises:
            SimEnvError: Something in the plan cannot work.
        """
        super().__init__(plan)
        self.agents = []

    @staticmethod
    def metadata_of(plan: Plan) -> dict[str, Any]:
        """What the environments of a plan say about themselves."""
        return View.metadata_of(plan) | {"is_parallelizable": True}

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
        with self._session.claimed():
            episode = self._start(seed, options, When.RETURN)
            self.agents = [*episode.agents, *(agent.name for agent in episode.untold)]
            if self._shows:
                self.render()
            observations, _, _, _, infos = self._results(episode)
            return observations, infos

    def step(self, actions: Mapping[str, Any] | Sentinel) -> Results:
        """Play a round.

        Args:
            actions: By live agent: an action in its action space, or ``RULE``. ``RULE`` in place of the dict:
                for all of them. An empty dict is accepted after the end, too, and nothing comes of it.

        Returns:
            By agent: observations, rewards (python floats), terminations, truncations (python bools) and
            infos. ``infos[agent]["deciding"]`` tells whose decision is pending, ``["acted"]`` whether the
            agent's action was used. Agents that have ended are among them for the last time.

        Raises:
            UnknownAgentError: An action is for no live agent. The environment stands where it stood.
            InvalidActionError: An action is not legal. The environment stands where it stood.
            ResetNeededError: There is no episode to go on with.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        claim = self._session.claim
        if claim is not None and not claim.held:  # what comes of it is read under the claim, too
            with claim:
                return SimulationParallelEnv.step(self, actions)
        episode = self._session.episode
        if episode is None:
            raise self._session.refusal()
        if not self.agents and not actions and (episode.terminated or episode.truncated):
            return {}, {}, {}, {}, {}  # PettingZoo's own do so
        if isinstance(actions, Sentinel):
            actions = dict.fromkeys(episode.agents, actions)
        elif self._padded and isinstance(actions, Mapping):
            actions = of_present_agents(episode, self._plan.roster, actions)
        try:
            episode.play(actions)
        except BaseException:
            if episode.over:  # an error has ended it
                self.agents = []
            raise
        self.agents = [] if episode.over else list(episode.agents)
        results = self._results(episode)
        if self._shows:
            self.render()
        return results

    def _results(self, episode: Episode) -> Results:
        """What the agents have come to, by agent."""
        agents, ended = episode.agents, episode.just_ended
        if ended:
            agents = {agent.name: agent for agent in ended} | agents
        terminations, truncations = dict.fromkeys(agents, episode.terminated), dict.fromkeys(agents, episode.truncated)
        results: Results = {}, {}, terminations, truncations, {}
        observations, rewards, _, _, infos = results
        for name, agent in agents.items():
            observation = agent.observation
            if observation is agent.handed_out:  # it could not be observed anew, or never was
                observation = agent.point.blank() if observation is None else duplicate(observation)
            else:
                agent.handed_out = observation  # it is the caller's alone
            observations[name], rewards[name] = observation, agent.reward
            infos[name] = info = agent.info
            info["deciding"], info["acted"] = False, agent.acted
        for agent in ended:
            terminations[agent.name], truncations[agent.name] = True, False
        if episode.pending is not None:
            episode.pending.info["deciding"] = True
        if self._padded:
            pad(episode, self.possible_agents, results)
            if not episode.over:
                self.agents = list(self.possible_agents)
        return results

    def _clear(self) -> None:
        super()._clear()
        self.agents = []
