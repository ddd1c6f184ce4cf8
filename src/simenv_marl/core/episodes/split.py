"""Calls that decide for many entities at once, and questions of tasks that wait together."""

from __future__ import annotations

from asyncio import Task
from collections import deque
from collections.abc import Generator, Iterable
from dataclasses import dataclass, field
from inspect import isgenerator
from types import coroutine
from typing import Protocol

from ...errors import AgentError, SimulationError
from ...hooks.hook import BOUND
from ...hooks.stacks import Interceptor
from ...simulation import RULE, Action, Model, Observation
from ..plans.plan import Plan
from ..plans.point import Args, Kwargs, Policy
from ..plans.policies import AskedAgent, AskedEpisode, EpisodePolicy, Info, Where, waits
from ..switching.awaiting import Answer, Answers
from ..switching.driver import Driver, Event, Observer
from ..switching.loops import Question
from ..values.spaces import duplicate
from .agent import Agent, DecisionHandler, RunningEpisode


class SplittingEpisode(RunningEpisode, Protocol):
    """The episode, as the handlers of calls that are split use it."""

    def begin_split(self, call: SplitCall) -> None:
        """Decide the items of a call, before the simulation moves."""


class SplitHandler:
    """Handles the calls at a decision point whose definition splits them."""

    reports_itself = True

    def __init__(self, items: DecisionHandler) -> None:
        """Handle calls of a point. ``items`` handles the decision of each item."""
        self._items = items
        self._point = items.point
        self.report = items.report

    def handle(self, episode: SplittingEpisode, args: Args, kwargs: Kwargs) -> Model:
        """Split a call, and handle its first item. The episode handles the others."""
        split = self._point.split
        items = [] if split is None else list(split(*args, **kwargs))
        if not items:
            return RULE
        call = SplitCall(self._items, items, args, kwargs)
        episode.begin_split(call)
        _, item_args, item_kwargs = call.event()
        del call
        return self._items.handle(episode, item_args, item_kwargs)

    def deliver(
        self, send: Interceptor | None, reply: Model, *args: Model, **kwargs: Model
    ) -> Model:
        """On the simulation's side, turn the replies to the items into the value of the call.

        ``send`` reports the decisions of the rule.
        """
        replies = reply.pop()  # the user's side keeps no reference to the items
        items = reply.pop()
        kind = self._point.hook.kind
        gather = coroutine(self._gather) if kind == "coroutine" else self._gather
        value: Model = gather(send, items, replies, args, kwargs)
        if kind != "function":
            return value
        try:
            next(value)
        except StopIteration as end:
            return end.value
        raise AssertionError("a function does not wait")

    def _gather(
        self,
        send: Interceptor | None,
        items: list[Model],
        replies: list[Model],
        args: Args,
        kwargs: Kwargs,
    ) -> Generator[Model, Model, Model]:
        """Return the value of the call. Run the rule once, when an item first needs it."""
        point = self._point
        hook = point.hook
        is_left_to_rule = all(reply is RULE for reply in replies)
        by_rule: list[tuple[Model, Args, Kwargs]] = []
        decisions: list[Model] = []
        result: Model = RULE
        for place, (item, reply) in enumerate(zip(items, replies, strict=True)):
            decision = reply
            if reply is RULE:
                if result is RULE:
                    result = yield from _value(hook.rule(*args, **kwargs), hook.kind)
                if is_left_to_rule and (result is RULE or send is None):
                    return result
                if result is RULE:
                    raise SimulationError(
                        f"the rule of {hook.name}, in another process, decides for all items of a"
                        " call or for none; answer all of them by RULE, or none"
                    )
                part = point.part
                decision = part(result, item, *args, **kwargs) if part else result[place]
                by_rule.append((decision, (item, *args), kwargs))
            elif point.deliver is not None:
                value = point.deliver(reply, item, *args, **kwargs)
                decision = yield from _value(value, hook.kind)
            decisions.append(decision)
        if send is not None and by_rule:
            send(tuple(by_rule), BOUND)
        if is_left_to_rule:
            return result
        if point.gather is None:
            return decisions
        return point.gather(items, decisions, *args, **kwargs)


@dataclass(eq=False)
class SplitCall:
    """A call whose items are being decided.

    Attributes:
        handler: Handles the decision of each item.
        items: The items.
        args: The positional arguments of the call.
        kwargs: Its keyword arguments.
        replies: The replies to the first items.
        decided: The item that each agent has decided first.
    """

    handler: DecisionHandler
    items: list[Model]
    args: Args
    kwargs: Kwargs
    replies: list[Model] = field(default_factory=list)
    decided: dict[Agent, Model] = field(default_factory=dict)

    def event(self) -> Event:
        """Return the event of the first item without a reply."""
        kwargs = self.kwargs
        point = self.handler.point
        if point.gives_answers:
            answers = [point.answer_of(reply) for reply in self.replies]
            kwargs = {**kwargs, "_answers": answers}
        return self.handler, (self.items[len(self.replies)], *self.args), kwargs

    def next_event(self, reply: Model, agent: Agent | None) -> Event | None:
        """Note the reply to an item, and the agent that decided last.

        Return the event of the next one, or None at the end.
        """
        item = self.items[len(self.replies)]
        self.replies.append(reply)
        has_named = reply is not RULE and self.handler.point.agent is None
        if has_named and agent is not None and self.decided.setdefault(agent, item) is not item:
            agent.note_several()
        return None if len(self.replies) == len(self.items) else self.event()

    def reply(self) -> Model:
        """Return the reply to the call."""
        return [self.items, self.replies]


def _value(value: Model, kind: str) -> Generator[Model, Model, Model]:
    """Return the decision of a function of a kind, after it has waited for it."""
    if kind == "function":
        return value
    return (yield from value if isgenerator(value) else value.__await__())


# -- tasks that wait ------------------------------------------------------------------------------


class _GatheringHandler(Observer):
    """Handles the questions of tasks that wait together."""

    def handle(self, episode: Model, args: Args, kwargs: Kwargs) -> Model:
        """Have the policies asked at once, and reply to the first question."""
        (questions,) = args
        is_asked = episode.where is Where.USER and not episode.replay
        if is_asked and not questions[0].deferred:
            answers = Answers()
            try:
                for question in questions:
                    episode.blame(question.agent)
                    answers.add(question, question.begin())
                while answers:
                    question, answer = answers.take()
                    question.note(answer)
            finally:
                answers.cancel()
        episode.begin_split(Gathered(questions))
        return questions[0].handle(episode, (), BOUND)


class TaskQuestion(EpisodePolicy, Question, Observer):
    """The question of a task to a policy that waits. It takes the policy's place, once answered.

    Attributes:
        agent: The agent that decides.
        task: The task.
        begin: Asks the policy.
        answered: The answer. None until it has come.
    """

    handler = _GatheringHandler()

    def __init__(self, policy: Model, episode: Model, agent: Agent, task: Task[Model]) -> None:
        self.policy: Model = policy
        self.agent = agent
        self.task = task
        self.deferred = policy.deferred
        observation = duplicate(agent.raw_observation)
        self.begin = policy.prepare(episode, agent, observation, agent.info, later=True)
        self.answered: Answer | None = None

    def note(self, answer: Answer) -> None:
        """Note the answer, which has come."""
        self.answered = answer

    def answer(
        self, episode: AskedEpisode, agent: AskedAgent, observation: Observation, info: Info
    ) -> Action:
        """Return the answer. If the policy was not asked, let it or its substitute answer now."""
        if self.answered is None:
            return self.policy.answer(episode, agent, observation, info)
        return self.answered.result()

    def handle(self, episode: Model, args: Args, kwargs: Kwargs) -> Model:
        """Reply to the question."""
        return episode.answer_by(self, self.agent)


def question_of(
    episode: Model, driver: Driver, agent: Agent, policy: Policy
) -> TaskQuestion | None:
    """Make the question for which a task of the model waits. None where none can wait.

    Raises:
        AgentError: Another task waits for an answer of the same agent.
    """
    if not (isinstance(policy, EpisodePolicy) and policy.waits):
        return None
    tasks = driver.tasks
    task = tasks.current(driver.loop)
    if task is None or agent.point.hook.kind != "coroutine":
        return None
    for other in tasks.questions(driver.loop):
        if other.agent is agent:
            raise AgentError(
                f"the agent {agent.name!r} decides in two tasks that wait,"
                f" {other.task.get_name()} and {task.get_name()}; let agent= name each"
                " differently, or one task wait for the other"
            )
    return TaskQuestion(policy, episode, agent, task)


def has_waiting(plan: Plan) -> bool:
    """Return whether a policy of a plan waits."""
    return any(map(waits, (plan.options.policies or {}).values()))


class Gathered:
    """Questions that are answered one after the other, as the items of a call are."""

    def __init__(self, questions: Iterable[TaskQuestion]) -> None:
        self.questions = deque(questions)
        self._replies: list[Model] = []

    def next_event(self, reply: Model, agent: Agent | None) -> Event | None:
        """Note the reply to a question; return the event of the next one, or None at the end."""
        self._replies.append(reply)
        self.questions.popleft()
        return (self.questions[0], (), BOUND) if self.questions else None

    def reply(self) -> Model:
        """Return the replies."""
        return self._replies
