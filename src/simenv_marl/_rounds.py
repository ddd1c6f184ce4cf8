"""Episodes in rounds: all agents are rewarded and observed together, and each has at most one action.

A round answers each decision as it arises with the action given for its agent, once, and ends at the first
decision whose action is missing or used already. Simultaneous moves and turns are the same thing here: a round
with actions for everybody, and a round with one action.
"""

from __future__ import annotations

from collections.abc import Mapping
from threading import get_ident
from typing import Any, Final

from ._driver import EVALUATING, RUNNING, attended, unattended
from ._episode import UNNAMED, Episode
from ._record import Record, not_finite, number
from .decision import DIFFERENCES
from .errors import UnknownAgentError
from .simulation import RULE, Sentinel

MISSING: Final = Sentinel("MISSING")


class Rounds(Episode):
    """An episode that is played round by round, and not turn by turn."""

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
        if (RUNNING or EVALUATING) and attended():
            with unattended():
                self.play(actions)
            return
        self._driver.enter()
        left = self._checked(actions, pending)
        if actions:
            self.turns += 1
        for record in (*self.agents.values(), *self.parting):
            record.acted = False
        self.parting = []
        try:
            # Whoever steps an environment from inside a mapping is told so: until the end nothing is pending.
            self.pending = None
            following = self._answer(pending, left)
            if following is None:
                return
            if self.turns == self._max_turns and actions:
                self._foresee(following, settle=False)
                self._finish(truncated=True)
            else:
                self._foresee(following)
                self.pending = following
        except BaseException as error:
            self._fail(error)
            raise

    def _checked(self, actions: Mapping[str, Any], pending: Record) -> dict[str, Any]:
        """The actions, checked as far as they can be before anything moves."""
        checked, agents = {}, self.agents
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
        agents, take = self.agents, left.pop
        driver = self._driver
        assert driver is not None
        while (action := take(record.agent, MISSING)) is not MISSING:
            if action is not RULE:
                binding: Any = record.binding
                if record.mask is not None and not binding.allowed(action, record.mask):
                    break
                convert = binding.convert
                action = convert(action) if record.choices is None else [record.choices[action]]
            self._latest = record
            record.acted = True
            if not record.decided:  # seen for the first time, and acting at once
                arguments = record.arguments()
                assert arguments is not None
                record.join(*arguments)
                arguments = None
            if record.followed_up:
                record.follow_up()
            while True:
                resume = driver.resume
                binding, args, kwargs = resume(action)
                agent: Any = UNNAMED
                if binding in self._swift:
                    # What ``_take`` does, for the calls of most models: of one argument, all of it always legal.
                    (first,) = args
                    name_agent = binding.name_agent
                    agent = binding.agent if name_agent is None else name_agent(first)
                    known = agents.get(agent) if type(agent) is str else None
                    if known is not None and known.binding is binding:
                        self._latest = record = known
                        record.hold(args, kwargs)
                        break
                action = self._take(binding, args, kwargs, agent)
                # Else they would keep alive what the model lets go meanwhile.
                binding = args = kwargs = first = agent = None
                if self.over:
                    return None
                if self.pending is not None:
                    record, self.pending = self.pending, None
                    break
        return record

    def _arise(self, record: Record, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        record.arise(args, kwargs)
        self.pending = record
        binding = record.binding
        if self.clock is None and binding.legal is None and binding.point.alone:
            self._swift[binding] = record

    def _foresee(self, pending: Record | None, *, settle: bool = True) -> None:
        """Find out on which calls the live agents are to be seen; reward and observe them, unless told otherwise."""
        calls: dict[Record, tuple[Any, ...]] = {}
        for record, args in self._announced():
            if record is not pending and record not in calls:  # of several calls the next one counts
                record.hold(args, {})
                calls[record] = args
        if settle:
            self._settle_all(pending, calls)

    def _settle_all(self, pending: Record | None, calls: dict[Record, tuple[Any, ...]]) -> None:
        """Reward and observe all live agents, as far as the calls are known on which they decide."""
        thread = get_ident()
        plain = {binding for binding in self._plan.active if binding.legal is None and self.clock is None}
        for record in self.agents.values():
            args: Any = calls.get(record)
            kwargs: dict[str, Any] = {}
            if args is None:
                arguments = record.arguments()
                if arguments is None:
                    record.reward, record.info = 0.0, {}
                    continue
                args, kwargs = arguments
            self._latest = record
            binding = record.binding
            if kwargs or len(args) != 1 or not record.decided or binding not in plain:
                record.settle(args, kwargs)
                if record is not pending:
                    record.choices = None  # which are asked for again when it decides
                continue
            # The same, for the calls of most models: of one argument, with nothing but the mappings to be seen to.
            (first,) = args
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
