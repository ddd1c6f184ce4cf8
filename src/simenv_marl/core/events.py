"""What comes from a simulation, and what becomes of it in its episode.

A call that crosses from the simulation is ``(event, args, kwargs)``. Of each kind of event there is a class, whose
method ``arise(episode, args, kwargs)`` returns the reply to the simulation, or ``WAIT``: the episode waits for an
action, or is over.

| event | what has happened | what becomes of it |
|---|---|---|
| ``Agent`` | the one agent of a point decides | it is settled, and the episode waits |
| ``Decision`` | an agent decides that ``agent=`` names | it is found or joins; and then the same |
| ``Answered`` | an agent decides for which a policy answers | it is observed, and the policy is asked |
| ``Removed`` | a function of ``removed_by=`` is called | its agents are settled for the last time and leave |
| ``Ended`` | the simulation calls ``end_agent`` | that agent is settled for the last time and leaves |
| ``Told`` | a rule has decided | its action is noted |
| ``Finished`` | ``run`` has returned | all agents end |
| ``Failed``, ``Refused`` | the simulation has raised; a decision was refused | the error is raised |
| ``Stalled`` | a callback has raised, and the C code that called it goes on and on | the error is raised |
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from ..decision import DecisionPoint
from ..simulation import RULE, TRUNCATED
from .agent import WAIT
from .bound import BoundPoint

if TYPE_CHECKING:
    from .episode import Episode


class Decision(BoundPoint):
    """A decision of the agent that ``agent=`` names, or of the one agent of a point where a policy answers for it."""

    __slots__ = ()

    def arise(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Find the agent, or let it join."""
        name_agent = self.name_agent
        if name_agent is None:
            return episode.dispatch(self, self.agent, args, kwargs)
        name = name_agent(*args, **kwargs) if kwargs else name_agent(*args)
        try:
            agent = episode.agents.get(name)
        except TypeError:  # it is no name at all
            agent = None
        if agent is None or agent.point is not self:
            return episode.dispatch(self, name, args, kwargs)
        return agent.arise(episode, args, kwargs)


class Answered(BoundPoint):
    """A decision of a point whose agents are all answered by a policy."""

    __slots__ = ()

    def arise(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Have the policy answer."""
        name = self.agent or self.name_agent(*args, **kwargs)
        agent = episode.answered.get(name) if type(name) is str else None
        if agent is None or agent.point is not self:
            return episode.dispatch(self, name, args, kwargs)
        episode.latest = agent
        return episode.consult(agent, args, kwargs)


class Removed:
    """A call of a function that ends the episode of agents.

    Attributes:
        point: The function.
        of: The points whose agents it ends; for each a callable of the call's arguments that names the agent, or None;
            and then the class whose instances are such agents, if it is known.
        deliver, told: None: the call always runs the function, and nothing is told of its result.
    """

    __slots__ = ("of", "point")

    deliver = told = None

    def __init__(self, point: DecisionPoint) -> None:
        self.point = point
        self.of: list[tuple[BoundPoint, Callable[..., Any] | None, type | None]] = []

    def arise(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Give the agents their last rewards and observations while they are whole, and let the call go on."""
        for point, name in self._named(episode, args, kwargs):
            agent = episode.agents.get(name)
            if agent is not None and agent.point is point:
                episode.finish_agent(agent)
        return RULE

    def _named(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[tuple[BoundPoint, Any]]:
        named: list[tuple[BoundPoint, Any]] = []  # a generator could not pass on a StopIteration
        for point, name, owner in self.of:
            if name is not None:
                named.append((point, name(*args, **kwargs)))
            elif args and (owner is None or isinstance(args[0], owner)):
                found = point.agent or point.name_agent(args[0])
                named.append((point, episode.named_before(point, args[0]) if found is None else found))
        return named


class Ended:
    """A call of the simulation's ``end_agent``.

    Attributes:
        deliver, told: None: the call always goes on, and nothing is told of its result.
    """

    deliver = told = None

    def arise(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """End the agent's episode, if it is a live agent of the environment."""
        name = kwargs["name"] if "name" in kwargs else args[1]
        agent = episode.agents.get(name) if isinstance(name, str) else None
        if agent is not None:
            episode.finish_agent(agent)
        return RULE


class Told:
    """A decision that the rule of a point has taken.

    Attributes:
        point: The decision point.
        deliver, told: None: the simulation just goes on.
    """

    __slots__ = ("point",)

    deliver = told = None

    def __init__(self, point: BoundPoint) -> None:
        self.point = point

    def arise(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Note which action it corresponds to. The arguments are the decision, and those of its call."""
        decision, call_args, call_kwargs = args
        point = self.point
        name = point.agent or point.name_agent(*call_args, **call_kwargs)
        agent = (episode.agents.get(name) or episode.answered.get(name)) if type(name) is str else None
        if agent is not None and agent.point is point:
            episode.latest = agent
            offered, agent.offered = agent.offered, None
            agent.rule_action = action = point.rule_action(decision, call_args, call_kwargs, offered)
            agent.tells = point.tells and action is not None


class Finished:
    """The simulation's ``run`` has returned."""

    def arise(self, episode: Episode, box: list[Any], _: Any) -> Any:
        """End the episode of all agents. The box holds what ``run`` has returned."""
        episode.running = False
        episode.finish(truncated=box.pop() is TRUNCATED)
        return WAIT


class Failed:
    """The simulation's ``run`` has raised."""

    def arise(self, episode: Episode, box: list[Any], _: Any) -> Any:
        """Raise the error, which the box holds."""
        episode.running, episode.failed_in_model = False, True
        raise box.pop()


class Refused:
    """A decision was asked for where the simulation cannot wait, as in a thread that it has started.

    Attributes:
        deliver, told: None: the simulation does not go on.
    """

    deliver = told = None

    def arise(self, episode: Episode, args: Any, kwargs: Any) -> Any:
        """Raise the error that says so."""
        episode.failed_in_model = True
        raise episode.driver.refusal()


class Stalled:
    """A callback has raised, and the C code that has called it does not come to its end: see ``CallbackGuard``.

    Attributes:
        deliver, told: None: the simulation does not go on.
    """

    deliver = told = None

    def arise(self, episode: Episode, box: list[Any], _: Any) -> Any:
        """Raise the error, which the box holds. What is left in the simulation is still to unwind."""
        episode.failed_in_model = True
        raise box.pop()


FINISHED: Final = Finished()
FAILED: Final = Failed()
STALLED: Final = Stalled()
REFUSED: Final = Refused()
