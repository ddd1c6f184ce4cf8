"""The joint view: a Gymnasium environment with one agent that takes all decisions."""

from collections.abc import Collection, Mapping, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
from gymnasium import spaces

from ..core import (
    MASK,
    Action,
    ActionCode,
    Agent,
    EpisodeState,
    Info,
    Observation,
    Plan,
    Space,
    checked_actions,
    duplicate,
    preferences,
)
from ..errors import InvalidActionError, ViewError, short_repr
from ..simulation import RULE, optional_method
from .agents import UnitedView, add_costs
from .base import StepResult


class Joint:
    """The agents of a plan, combined into one agent.

    Attributes:
        roster: The decision points of the agents, by agent.
        observation_space, action_space: The combined spaces.
    """

    def __init__(self, plan: Plan) -> None:
        """Combine the spaces, or raise ``ViewError`` if they cannot be flattened."""
        self.roster = plan.roster
        observations = {}
        actions = {}
        for name, point in self.roster.items():
            # Copies, because agents may share a space, and each draws from its own generator.
            observations[name] = deepcopy(point.definition.observation_space)
            actions[name] = deepcopy(point.definition.action_space)
        self.observation_space: Space = spaces.Dict(observations)
        self.action_space: Space = spaces.Dict(actions)
        self._flatten = plan.options.flatten
        if not self._flatten:
            return
        flat = {name: _flat(space) for name, space in observations.items()}
        self._flat_observations = {name for name in flat if flat[name] is not observations[name]}
        self.observation_space = _concatenate(flat)
        # Where agents with a Discrete stand beside agents with a Box.
        self._codes: dict[str, ActionCode] = {}
        if any(isinstance(space, spaces.Box) for space in actions.values()):
            for name, space in actions.items():
                if isinstance(space, spaces.Discrete):
                    actions[name], self._codes[name] = preferences(space)
        self.action_space = _concatenate(actions, discrete=True)
        # The index of each agent's action in the flattened one.
        self._places: dict[str, int | slice] = {}
        begin = 0
        for name, space in actions.items():
            end = begin + (space.shape[0] if space.shape else 1)
            self._places[name] = slice(begin, end) if space.shape else begin
            begin = end

    def actions(
        self,
        agents: Mapping[str, Agent | None],
        action: Action,
    ) -> dict[str, Action]:
        """Return the actions of live agents, given by name. None: it has not appeared yet.

        Raises:
            InvalidActionError: The action lacks one, or has another form.
        """
        live = [name for name in self.roster if name in agents]
        if action is RULE:
            return dict.fromkeys(live, RULE)
        if self._flatten:
            if not isinstance(action, np.ndarray) or action.shape != self.action_space.shape:
                raise InvalidActionError(
                    f"the joint action {short_repr(action)} is not in"
                    f" {short_repr(self.action_space)}; with flatten=True, it is a NumPy array"
                )
            parts = {name: action[self._places[name]] for name in live}
            for name in self._codes.keys() & parts.keys():
                agent = agents[name]
                mask = None if agent is None else agent.mask
                parts[name] = self._codes[name].decode(parts[name], mask)
            return parts
        if not isinstance(action, Mapping) or set(action) != set(self.roster):
            keys = list(action) if isinstance(action, Mapping) else action
            raise InvalidActionError(
                f"a joint action is a dict with an action for each of {', '.join(self.roster)};"
                f" given: {short_repr(keys)}"
            )
        return {name: action[name] for name in live}

    def read(self, episode: EpisodeState) -> StepResult:
        """Return the results of a reset or a step.

        An agent that has ended keeps its last observation. The reward is the sum of all rewards.
        """
        agents = [episode.agents.get(name) or episode.ended[name] for name in self.roster]
        used = () if episode.round is None else episode.round.acted
        observation, info = self.see(agents, episode.pending, used)
        paid = (*episode.just_ended, *episode.agents.values())
        reward = episode.earned
        if reward is None:
            reward = sum([agent.reward for agent in paid], 0.0)
        add_costs(info, paid)
        return observation, reward, episode.terminated, episode.truncated, info

    def see(
        self, agents: Sequence[Agent | None], deciding: Agent | None, acted: Collection[str]
    ) -> tuple[Observation, Info]:
        """Return the observation of the agents of the roster, and an info.

        Args:
            agents: The agents. None in place of one that has not appeared.
            deciding: The agent that decides.
            acted: The names of the agents whose action was used.
        """
        observations = {}
        masks = {}
        for (name, point), agent in zip(self.roster.items(), agents, strict=True):
            observations[name] = point.blank() if agent is None else agent.hand_out()
            if agent is not None and agent.mask is not None:
                masks[name] = duplicate(agent.mask)
        joined: Observation = observations
        if self._flatten:
            for name in self._flat_observations:
                space = self.roster[name].definition.observation_space
                observations[name] = spaces.flatten(space, observations[name])
            parts = list(observations.values())
            joined = np.concatenate(parts).astype(self.observation_space.dtype)
        info: Info = {MASK: masks} if masks else {}
        info["deciding"] = "" if deciding is None else deciding.name
        info["acted"] = {name: name in acted for name in self.roster}
        return joined, info


class SimulationJointEnv(UnitedView):
    """A simulation as a Gymnasium environment with one agent that takes all decisions.

    ``joint_env`` makes it. A step is a round of the parallel view with an action for each agent.
    The reward is the sum of their rewards. All agents must be known when the environment is made:
    agents with strings as names, agents in ``possible_agents``, and agents that the simulation's
    ``expected_calls`` announces after a reset.

    Attributes:
        observation_space, action_space: ``Dict`` spaces by agent. With ``flatten=True``:
            one-dimensional ``Box`` spaces, which concatenate the spaces of the agents (the paper's
            two-dimensional action space). ``Discrete`` and one-dimensional ``MultiDiscrete`` action
            spaces become one ``MultiDiscrete``. Beside a ``Box``, a ``Discrete`` action becomes a
            preference in [-1, 1] for each of its actions (the largest legal one is taken), and a
            ``Discrete`` observation a vector of 0 and 1.
        joint: The agents, combined into one.
    """

    kind = "joint"
    in_rounds = True
    _agent_name = "joint"
    _unite = Joint

    def set_up(self) -> None:
        """Combine the agents. If a simulation announces them, reset one to find them."""
        session = self.session
        if not session.plan.complete:
            if optional_method(session.simulation, "expected_calls", "point") is None:
                points = ", ".join(
                    point.hook.name for point in session.plan.active if point.agent is None
                )
                raise ViewError(
                    "all agents must be known when the environment is made, and a callable names"
                    f" those of {points}; declare them with possible_agents=, let the simulation"
                    " announce them (expected_calls), or name the one agent of a single view with"
                    " agent="
                )
            agents = session.start(0, None, in_rounds=True).agents
            roster = {name: agent.point for name, agent in agents.items()}
            session.declare(session.plan.declared(roster))
        self._roster = session.plan.roster
        self.joint = session.plan.derive(Joint)

    def step(self, action: Action) -> StepResult:
        """Play a round with an action for each agent.

        Args:
            action: An action in the action space, with an action for each agent (actions of
                ended agents are not used). ``RULE``, or ``RULE`` instead of an agent's action, lets
                the rule decide.

        Returns:
            Observation, sum of the rewards (a Python float), terminated, truncated, info. An agent
            that has ended keeps its last observation. ``info["deciding"]`` is the name of the agent
            whose decision is pending. ``info["acted"]`` tells for each agent whether its action was
            used. If the simulation has a clock, ``info["time"]`` is its time, and
            ``info["elapsed"]`` the time since the previous step.

        Raises:
            InvalidActionError: The action is not legal, or lacks an agent. The environment does not
                change.
            BaseException: Any other error of ``SimulationAECEnv.step``.
        """
        episode = self.session.episode
        if episode is None or (self._lock and not self._lock.held):
            return self._step_in_lock(SimulationJointEnv.step, action)
        return self._move(episode, self.joint.actions(episode.agents, action))

    def begin(self, episode: EpisodeState) -> tuple[Observation, Info]:
        """Return the observation and the info of a reset."""
        self._last_time = None
        observation, *_, info = self.read(episode)
        return observation, info

    def read(self, episode: EpisodeState) -> StepResult:
        """Return the results of a step."""
        results = self.joint.read(episode)
        self._add_to(results[-1], episode)
        if episode.over:
            self.warn_of_losses(episode)
        return results

    def validate(self, action: Action) -> Action:
        """Validate a joint action, as far as possible before the simulation moves."""
        episode = self.episode
        if episode.pending is None:
            return {}
        actions = self.joint.actions(episode.agents, action)
        if any(part is RULE for part in actions.values()):
            raise InvalidActionError(
                "RULE is not an action in vector environments; use joint_env, or policies="
            )
        checked_actions(episode, actions)
        return actions


def _flat(space: Space) -> Space:
    """Return a ``Discrete`` as the vector that Gymnasium flattens it to. Others stay."""
    return spaces.flatten_space(space) if isinstance(space, spaces.Discrete) else space


def _concatenate(named: Mapping[str, Any], *, discrete: bool = False) -> Space:
    """Return the space of concatenated vectors. ``discrete``: they may all be discrete, too."""
    parts = named.values()
    kinds = (spaces.Discrete, spaces.MultiDiscrete)
    if discrete and all(isinstance(space, kinds) and np.ndim(space.start) < 2 for space in parts):
        sizes = [
            np.atleast_1d(space.nvec if isinstance(space, kinds[1]) else space.n) for space in parts
        ]
        starts = [np.atleast_1d(space.start) for space in parts]
        return spaces.MultiDiscrete(np.concatenate(sizes), start=np.concatenate(starts))
    # A Discrete comes last, because it may stand beside vectors.
    for name, space in sorted(named.items(), key=lambda item: isinstance(item[1], spaces.Discrete)):
        if not isinstance(space, spaces.Box) or len(space.shape) != 1:
            raise ViewError(
                "flatten=True needs one-dimensional Box and Discrete spaces, or actions that are"
                f" all discrete, not {space} of {name!r}"
            )
    return spaces.flatten_space(spaces.Tuple(parts))
