"""The events that a simulation sends, and how its episode handles them.

The simulation sends a tuple ``(event, args, kwargs)``. Each kind of event has a class. Its method
``arise(episode, args, kwargs)`` returns the reply to the simulation, or ``WAIT`` if the episode waits for an action or
is over.

| event | what happened | what the episode does |
|---|---|---|
| ``Agent`` | the only agent of a decision point decides | settle the agent and wait |
| ``Decision`` | an agent that ``agent=`` names decides | find the agent or let it join; then the same |
| ``Answered`` | an agent whose policy answers decides | observe the agent and ask the policy |
| ``Removed`` | a function of ``removed_by=`` is called | settle its agents for the last time and remove them |
| ``Ended`` | the simulation calls ``end_agent`` | settle that agent for the last time and remove it |
| ``Told`` | a rule has decided | note the corresponding action |
| ``Finished`` | ``run`` has returned | end all agents |
| ``Failed``, ``Refused`` | the simulation has raised; a decision was refused | raise the error |
| ``Stalled`` | a callback has raised, and the C code that called it does not end | raise the error |
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
    """A decision of an agent that ``agent=`` names, or of the only agent of a point if a policy answers for it."""

    __slots__ = ()

    def arise(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Find the agent, or let it join."""
        name_agent = self.name_agent
        if name_agent is None:
            return episode.dispatch(self, self.agent, args, kwargs)
        name = name_agent(*args, **kwargs) if kwargs else name_agent(*args)
        try:
            agent = episode.agents.get(name)
        except TypeError:  # not hashable, and so no name
            agent = None
        if agent is None or agent.point is not self:
            return episode.dispatch(self, name, args, kwargs)
        return agent.arise(episode, args, kwargs)


class Answered(BoundPoint):
    """A decision at a point where policies answer for all agents."""

    __slots__ = ()

    def arise(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Let the policy answer."""
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
        of: A tuple for each decision point whose agents it ends: the point; a callable that takes the call's arguments
            and names the agent, or None; the class whose instances are such agents, or None if it is not known.
        deliver, told: None, because the call always runs the function, and its result is not reported.
    """

    __slots__ = ("of", "point")

    deliver = told = None

    def __init__(self, point: DecisionPoint) -> None:
        self.point = point
        self.of: list[tuple[BoundPoint, Callable[..., Any] | None, type | None]] = []

    def arise(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Give the agents their last rewards and observations while their entities are whole; then run the call."""
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
        deliver, told: None, because the call always runs the function, and its result is not reported.
    """

    deliver = told = None

    def arise(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """End the agent's episode if it is a live agent of the environment."""
        name = kwargs["name"] if "name" in kwargs else args[1]
        agent = episode.agents.get(name) if isinstance(name, str) else None
        if agent is not None:
            episode.finish_agent(agent)
        return RULE


class Told:
    """A decision that the rule of a point has made.

    Attributes:
        point: The decision point.
        deliver, told: None, because the simulation continues with its own decision.
    """

    __slots__ = ("point",)

    deliver = told = None

    def __init__(self, point: BoundPoint) -> None:
        self.point = point

    def arise(self, episode: Episode, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Note the action that corresponds to the decision. ``args``: the decision, its call's args and kwargs."""
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
        """End the episode of all agents. The box holds the value that ``run`` returned."""
        episode.running = False
        episode.finish(truncated=box.pop() is TRUNCATED)
        return WAIT


class Failed:
    """The simulation's ``run`` has raised."""

    def arise(self, episode: Episode, box: list[Any], _: Any) -> Any:
        """Raise the error in the box."""
        episode.running, episode.failed_in_model = False, True
        raise box.pop()


class Refused:
    """A decision function was called where the simulation cannot wait, such as in a thread that it started.

    Attributes:
        deliver, told: None, because the simulation does not continue.
    """

    deliver = told = None

    def arise(self, episode: Episode, args: Any, kwargs: Any) -> Any:
        """Raise the error that describes this call."""
        episode.failed_in_model = True
        raise episode.driver.refusal()


class Stalled:
    """A callback has raised, and the C code that called it does not end: see ``CallbackGuard``.

    Attributes:
        deliver, told: None, because the simulation does not continue.
    """

    deliver = told = None

    def arise(self, episode: Episode, box: list[Any], _: Any) -> Any:
        """Raise the error in the box. The simulation is still suspended and must be unwound."""
        episode.failed_in_model = True
        raise box.pop()


FINISHED: Final = Finished()
FAILED: Final = Failed()
STALLED: Final = Stalled()
REFUSED: Final = Refused()
