"""Episodes in rounds: all agents are rewarded and observed together, and each has at most one action.

A round answers each decision as it arises with the action given for its agent, once, and ends at the first
decision whose action is missing or used already. Simultaneous moves and turns are the same thing here: a round
with actions for everybody, and a round with one action.
"""

from __future__ import annotations

from collections.abc import Mapping
from threading import get_ident
from typing import Any, Final

from greenlet import getcurrent

from ..decision import DIFFERENCES
from ..errors import InvalidActionError, UnknownAgentError
from ..simulation import RULE, Sentinel
from .agent import Record, not_finite, number
from .episode import LOST, MOST_TAKEN, UNNAMED, Episode
from .plan import Plan
from .switch import EVALUATING, RUNNING, unattended

MISSING: Final = Sentinel("MISSING")


class Rounds(Episode):
    """An episode that is played round by round, and not turn by turn."""

    def __init__(self, plan: Plan, simulation: Any, *others: Any) -> None:
        """Prepare an episode, as ``Episode`` does."""
        # By binding, how its agents are named, where nothing but the mappings is to be seen to.
        self._quick: dict[Any, Any] = {}
        if getattr(simulation, "time", None) is None:
            self._quick = {
                binding: binding.name_agent
                for binding in plan.active
                if binding.name_agent is not None
                and binding.legal is None
                and binding.point.alone
                and not binding.tells
            }
        super().__init__(plan, simulation, *others)
        self._announces = getattr(simulation, "expected_calls", None) is not None

    def play(self, actions: Mapping[str, Any]) -> None:
        """Answer decisions with actions, each once, up to the first whose action is missing; or to the end.

        Then all live agents are rewarded and observed.

        Args:
            actions: By agent: an action, or ``RULE``.

        Raises:
            UnknownAgentError: An action is for nobody who lives. Nothing has moved.
            InvalidActionError: An action is not legal. Nothing has moved. One that only becomes illegal by
                its turn counts as missing.
            EpisodeOverError: No decision is pending.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        pending = self.pending
        if pending is None or self._driver is None:
            raise self.nothing_pending()
        if (RUNNING or EVALUATING) and self._attended():
            with unattended():
                self.play(actions)
            return
        if getcurrent() is not self._driver.caller:
            self._driver.enter()
        left = self._checked(actions, pending)
        taken = left.copy()  # of actions that are nobody else's any more
        try:
            # Whoever steps an environment from inside a mapping is told so: until the end nothing is pending.
            self.pending = None
            self.taken.append(taken)
            if len(self.taken) == MOST_TAKEN:
                self.taken = LOST
            if actions:
                self.turns += 1
            for record in self.agents.values():
                record.acted = False
            if self.parting:
                for record in self.parting:
                    record.acted = False
                self.parting = []
            following = self._answer(pending, left)
            if following is None:
                return
            if self.turns == self._most_turns and actions:
                self._foresee(following, settle=False)
                self._finish(truncated=True)
            elif self._announces:
                self._foresee(following)
                self.pending = following
            else:
                self._settle_all(following)
                self.pending = following
        except BaseException as error:
            self.pending, self.over = None, True
            self._fail(error)
            raise

    def replay(self, taken: list[Any]) -> None:
        """Play the rounds of another episode once more, as ``Episode.replay`` does."""
        for actions in taken:
            self.play(actions)

    def check(self, actions: Mapping[str, Any]) -> None:
        """Check the actions of a round as ``play`` does, and do nothing else.

        Raises:
            UnknownAgentError, InvalidActionError, EpisodeOverError: As ``play`` raises them.
        """
        if self.pending is None:
            raise self.nothing_pending()
        self._checked(actions, self.pending)

    def _checked(self, actions: Mapping[str, Any], pending: Record) -> dict[str, Any]:
        """The actions, checked as far as they can be before anything moves."""
        checked, agents = {}, self.agents
        if type(actions) is not dict and not isinstance(actions, Mapping):
            raise InvalidActionError(f"a round takes a dict of actions by agent, not {actions!r}")
        for agent, action in actions.items():
            record = agents.get(agent)
            if record is None:
                raise UnknownAgentError(f"there is an action for {agent!r}, which is no live agent: {self._names()}")
            if action is not RULE:
                binding = record.binding
                if type(action) is not int or not binding.first <= action < binding.end:
                    action = binding.checked(action, agent, record.mask if record is pending else None)
            checked[agent] = action
        return checked

    def _answer(self, record: Record, left: dict[str, Any]) -> Record | None:
        """Answer decisions as long as there are actions for them.

        Args:
            record: Whose decision is pending.
            left: The actions, which are taken out.

        Returns:
            Whose decision is left unanswered; None if the episode is over.
        """
        agents, quick, take = self.agents, self._quick, left.pop
        driver = self._driver
        assert driver is not None
        binding: Any
        args: Any
        kwargs: Any
        known: Any
        try:
            while (reply := self._reply(record, take(record.agent, MISSING))) is not MISSING:
                while True:
                    resume = driver.resume
                    binding, args, kwargs = resume(reply)
                    agent: Any = UNNAMED
                    name_agent = quick.get(binding)
                    if name_agent is not None:
                        # What ``_take`` and ``_reply`` do, for entities of most models, whom all is always legal.
                        (first,) = args
                        agent = name_agent(first)
                        known = agents.get(agent) if type(agent) is str else None
                        if known is not None and known.decided and known.binding is binding:
                            self._latest = known
                            if known._weakly is None or known._weakly() is not first:
                                known.hold(args, kwargs)
                            action = take(agent, MISSING)
                            if action is MISSING:
                                return known  # type: ignore[no-any-return]
                            known.acted = True
                            if action is RULE:
                                reply = action
                            else:
                                convert = binding.convert
                                reply = convert(action)
                            args = first = None  # else they would keep alive what the model lets go meanwhile
                            continue
                    reply = self._take(binding, args, kwargs, agent)
                    args = kwargs = first = None
                    if self.over:
                        return None
                    if self.pending is not None:
                        record, self.pending = self.pending, None
                        break
            return record
        except BaseException:
            args = kwargs = first = None  # else the error would keep them alive
            raise

    def _reply(self, record: Record, action: Any) -> Any:
        """The reply to the decision of an agent, ``MISSING`` if there is no legal action for it any more."""
        binding = record.binding
        if action is MISSING or (
            action is not RULE and record.mask is not None and not binding.allowed(action, record.mask)
        ):
            return MISSING
        self._latest = record
        if action is not RULE:
            action = binding.convert(action) if record.choices is None else [record.choices[action]]
        record.acted = True
        if not record.decided:  # seen for the first time, and acting at once
            arguments = record.arguments()
            assert arguments is not None
            record.join(*arguments)
        if record.followed_up:
            record.follow_up()
        return action

    def _arise(self, record: Record, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        record.arise(args, kwargs)
        self.pending = record

    def _foresee(self, pending: Record | None, *, settle: bool = True) -> None:
        """Find out on which calls the live agents are to be seen; reward and observe them, unless told otherwise."""
        seen = {pending}
        for record, args in self._announced():
            if record not in seen:  # of several calls the next one counts
                seen.add(record)
                record.hold(args, {})
        if settle:
            self._settle_all(pending)

    def _settle_all(self, pending: Record | None) -> None:
        """Reward and observe all live agents, as far as the calls are known on which they decide."""
        thread, quick = get_ident(), self._quick
        for record in self.agents.values():
            binding, weakly = record.binding, record._weakly
            if weakly is None or not record.decided or binding not in quick:
                self._settle(record, pending)
                continue
            # The same, for entities of most models, with nothing but the mappings to be seen to.
            first = weakly()
            if first is None:
                record.reward, record.info = 0.0, {}
                continue
            self._latest = record
            reward_mapping, observe, cast = binding.reward, binding.observe, binding.cast
            if DIFFERENCES:
                EVALUATING[thread] = record.memory
            reward = reward_mapping(first)
            if type(reward) is not float:
                reward = number(reward)
            if reward - reward != 0.0:
                raise not_finite(record, reward)
            record.reward = reward
            record.observation = cast(observe(first))
            record.info = {}
        EVALUATING.pop(thread, None)

    def _settle(self, record: Record, pending: Record | None) -> None:
        arguments = record.arguments()
        if arguments is None:
            record.reward, record.info = 0.0, record.unseen()
            return
        self._latest = record
        record.settle(*arguments)
        if record is not pending:
            record.choices = None  # which are asked for again when it decides
