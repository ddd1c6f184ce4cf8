"""The single view: one agent, and so a Gymnasium environment."""

from __future__ import annotations

import copy
import weakref
from typing import Any

import gymnasium as gym

from .._episode import Episode
from .._plan import Plan
from .._record import Record
from .._session import Session, checked_seed, seed_space
from ..errors import ViewError


class SimulationEnv(gym.Env[Any, Any]):
    """A simulation as a Gymnasium environment of one agent. Made by ``single_env`` and ``generate_env``.

    Attributes:
        observation_space, action_space: The agent's spaces, of this environment alone.
    """

    def __init__(self, plan: Plan) -> None:
        """Make the environment of a plan.

        Raises:
            ViewError: Not just one agent is active, or its name is only known when it decides.
            SimEnvError: Something else in the plan cannot work.
        """
        self.check(plan)
        self._plan = plan
        self._agent = str(plan.active[0].agent)
        self._session = Session(plan)
        weakref.finalize(self, self._session.abandon)
        definition = plan.active[0].definition
        self.observation_space = copy.deepcopy(definition.observation_space)
        self.action_space = copy.deepcopy(definition.action_space)
        self.metadata = self.metadata_of(plan)
        self.render_mode = plan.options.render_mode
        self._episode: Episode | None = None
        self._record: Record

    @staticmethod
    def check(plan: Plan) -> None:
        """Make sure that a plan allows this view.

        Raises:
            ViewError: It does not.
        """
        if len(plan.active) != 1 or plan.active[0].agent is None:
            points = ", ".join(binding.point.name for binding in plan.active)
            raise ViewError(
                "the single view needs one active decision point, whose agent has a name of its own; active are"
                f" {points}. Name one in points=, answer the others with policies=, or use aec_env"
            )

    @staticmethod
    def metadata_of(plan: Plan) -> dict[str, Any]:
        """What the environments of a plan say about themselves."""
        return {"name": f"{plan.name.lower()}_v0", "render_modes": plan.render_modes}

    @property
    def simulation(self) -> Any:
        """The simulation that this environment runs."""
        return self._session.simulation

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Reset the simulation and run it to its first decision.

        Args:
            seed: Seeds the environment's generator and its spaces, and is what the simulation's ``reset``
                gets. None: the simulation gets a seed drawn from the generator.
            options: Handed to the simulation's ``reset``, where that takes them.

        Returns:
            The observation and the info.

        Raises:
            NoDecisionError: The simulation ended without a decision.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        seed = checked_seed(seed)
        super().reset(seed=seed)
        self._episode = None
        self._episode = episode = self._session.start(seed, options, self.np_random)
        if seed is not None:
            seed_space(self.observation_space, seed, self._agent)
            seed_space(self.action_space, seed, self._agent)
        self._record = record = episode.agents[self._agent]
        return record.observation, record.info

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Answer the pending decision and run to the next one.

        Args:
            action: In the action space, or ``RULE``.

        Returns:
            Observation, reward (a python float), terminated, truncated, info.

        Raises:
            InvalidActionError: The action is not legal. The environment stands where it stood.
            ResetNeededError: There is no episode to go on with.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        episode = self._episode
        if episode is None:
            raise self._session.not_running()
        episode.turn(action)
        record = self._record
        return record.observation, record.reward, episode.terminated, episode.truncated, record.info

    def render(self) -> Any:
        """Render the simulation in ``render_mode``."""
        return self._session.render()

    def close(self) -> None:
        """End the episode and unwind the simulation; a later ``reset`` begins anew.

        Raises:
            BaseException: What the simulation raises while it unwinds.
        """
        self._episode = None
        self._session.close()
