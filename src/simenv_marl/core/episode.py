"""One episode of one simulation: the one place that knows what happens when.

An episode may be *about to begin*, *pending* (a decision has arisen and waits for its answer), *moving*
(the simulation runs, or its policies and mappings do) or *over*. Once it is over it stays over.

What happens, in this order, when a decision arises::

    simulation                   episode (on its user's stack)
    ----------                   -----------------------------
    calls a decision function
      suspended         ------>  who decides? ``agent=`` names the agent
                                 nobody, or RULE: back to the simulation, where the rule decides
                                 reward of the agent's action before (the first of an episode is dropped)
                                 mask, observation
                                 a policy answers: back to the simulation with its action
                                 else: pending, until ``turn`` brings the user's action
                                 action checked, mapped to the decision
      returns           <------  ... and back to the simulation
    returns from ``run``
      over              ------>  of each agent: last reward, last observation, flags

Views read the records of agents; none of them computes an observation or a reward.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from threading import get_ident
from typing import Any, Final

from greenlet import getcurrent

from ..decision import DIFFERENCES
from ..errors import (
    AgentError,
    EpisodeOverError,
    NoDecisionError,
    ReentrancyError,
    annotate,
    warn_user,
)
from ..simulation import RULE, TRUNCATED, Sentinel
from .agent import Record, not_finite, number
from .bindings import Binding, Removal, Ruled
from .greenlets import GreenletDriver
from .plan import Plan
from .spaces import duplicate, same
from .switch import (
    EVALUATING,
    FAILED,
    FINISHED,
    REFUSED,
    RUNNING,
    STUCK,
    Driver,
    Offspring,
    SimulationExit,
    attended,
    interrupted,
    unattended,
)
from .threads import ThreadDriver

UNWINDING_TRIES: Final = 1000
"""How often a simulation that is to be unwound may decide or swallow before it is given up. A SimPy model loses one of
its processes at each try."""

UNNAMED: Final = Sentinel("UNNAMED")
NAMED_AT_CALL: Final = Sentinel("NAMED_AT_CALL")

MOST_TAKEN: Final = 200_000
"""How many actions are kept for a replay. A simulation that never ends is not to fill the memory."""


class _Lost(list[Any]):
    """Stands in for actions that became too many."""

    def append(self, action: Any) -> None:
        """Keep nothing."""


LOST: Final = _Lost()

DRIVERS: Final[Mapping[str, Callable[..., Driver]]] = {"greenlet": GreenletDriver, "thread": ThreadDriver}


class Episode:
    """One run of a simulation, from its reset to its end. Holds nothing of the environment.

    Attributes:
        pending: The agent whose decision waits for an answer; None while the simulation moves and when the
            episode is over.
        agents: The live agents of the environment, by name, in the order in which they joined.
        gone: Those whose episode has ended before the simulation's.
        parting: Those of them whose end no view has entered yet.
        over: Whether the episode is over.
        terminated, truncated: How it ended; both False until then, and where an error has ended it.
        turns: How many actions the environment's user has given.
        taken: These actions, copied where they could change.
        consulted: What policies have answered. Either is ``LOST`` once it would have become too long.
        clock: Returns the simulation's time; None where it has none.
    """

    _make_record: type[Record] = Record

    def __init__(
        self,
        plan: Plan,
        simulation: Any,
        seed: int | None,
        offspring: Offspring | None = None,
        foretold: deque[Any] | None = None,
    ) -> None:
        """Prepare an episode of a simulation that has been reset.

        Args:
            plan: What the environment is made of.
            simulation: The simulation.
            seed: What it was reset with, for those who read an error's notes.
            offspring: The threads that the simulation has started so far; None: it was never used before.
            foretold: What policies are to answer before they are asked themselves, where an episode is replayed.
        """
        self.pending: Record | None = None
        self.agents: dict[str, Record] = {}
        self.gone: dict[str, Record] = {}
        self.parting: list[Record] = []
        self.over = self.terminated = self.truncated = False
        self.turns = 0
        self.taken: list[Any] = []
        self.consulted: list[Any] = []
        self._foretold = foretold
        # By binding: whose decision it is, where nothing but the mappings is to be seen to.
        self._swift: dict[Any, Any] = {}
        self._answered: dict[str, Record] = {}  # those for whom policies answer
        self._latest: Record | None = None
        self._plan, self._simulation, self._seed = plan, simulation, seed
        self._most_turns = plan.options.max_steps or -1  # never reached
        # When either an episode is truncated or its actions are no longer kept.
        self._max_turns = MOST_TAKEN if self._most_turns < 0 else min(self._most_turns, MOST_TAKEN)
        self._failed_in_model = False
        self.clock = getattr(simulation, "time", None)
        for agent, binding in plan.roster.items():
            self.agents[agent] = self._make_record(agent, binding, None, self.clock)
        make_driver = DRIVERS[plan.options.driver]
        self._driver: Driver | None = make_driver(self._main_loop(), plan.bindings, offspring or Offspring())

    def begin(self) -> None:
        """Run the simulation to its first decision.

        Raises:
            NoDecisionError: There is no decision for the environment's user.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        driver = self._driver
        assert driver is not None
        with self._kept_apart():
            try:
                reply = None
                while self.pending is None and not self.over:
                    reply = self._take(*driver.resume(reply))
                if not self.over:
                    pending, self.pending = self.pending, None
                    self._foresee(pending)
                    self.pending = pending
            except BaseException as error:
                self.pending, self.over = None, True
                self._fail(error)
                raise
        if self.pending is None and not self._plan.unanswered:
            raise NoDecisionError(
                f"{type(self._simulation).__name__}.run() came to its end without a decision of"
                f" {', '.join(binding.point.name for binding in self._plan.active)}; does the simulation call the"
                " decision functions as attributes of their class or module?"
            )

    def _main_loop(self) -> Callable[[], Any]:
        run: Callable[[], Any] = self._simulation.run
        return run

    def _attended(self) -> bool:
        """Whether another environment's simulation runs around us."""
        return attended()

    def _kept_apart(self) -> AbstractContextManager[None]:
        """Keep what runs apart from such a simulation."""
        return unattended()

    # -- decisions --------------------------------------------------------------------------------

    def turn(self, action: Any) -> None:
        """Answer the pending decision and run to the next one that the user is to answer, or to the end.

        Args:
            action: An action of the pending agent, or ``RULE``.

        Raises:
            InvalidActionError: The action is not legal. Nothing has moved.
            EpisodeOverError: No decision is pending.
            BaseException: Whatever the model, a mapping or a policy raises.
        """
        agent: Any
        record: Any = self.pending
        driver = self._driver
        if record is None or driver is None:
            raise self.nothing_pending()
        if (RUNNING or EVALUATING) and self._attended():  # inside another environment's simulation
            with unattended():
                self.turn(action)
            return
        if getcurrent() is not driver.caller:
            driver.enter()
        binding: Any = record.binding
        try:
            if type(action) is int and binding.first <= action < binding.end:
                convert = binding.convert
                reply = convert(action)
            elif action is RULE:
                reply = action
            else:
                reply = binding.reply(action, record.agent, record.mask, record.choices)
                action = duplicate(action)
        except Exception as error:
            self._annotate(error)
            raise
        try:
            self.pending = None
            self.turns = turns = self.turns + 1
            taken = self.taken
            taken.append(action)
            if record.followed_up:
                record.follow_up()
            while True:
                # Functions are fetched from attributes before they are called: calling them there is slower.
                resume = driver.resume
                binding, args, kwargs = resume(reply)
                agent = UNNAMED
                record = self._swift.get(binding)
                if record is NAMED_AT_CALL:
                    (first,) = args
                    name_agent = binding.name_agent
                    agent = name_agent(first)
                    record = self.agents.get(agent) if type(agent) is str else None
                    if record is not None and (record.binding is not binding or not record.decided):
                        record = None
                if record is not None and turns != self._max_turns:
                    # What ``_take`` and ``Record.settle`` do, for the calls of most models: of one argument, with
                    # nothing but the mappings to be seen to.
                    self._latest = record
                    (first,) = args
                    if agent is UNNAMED:
                        record._args, record._kwargs = args, kwargs
                    elif record._weakly is None or record._weakly() is not first or record._kwargs:
                        record.hold(args, kwargs)
                    if DIFFERENCES:
                        EVALUATING[get_ident()] = record.memory
                    reward_mapping, observe, cast = binding.reward, binding.observe, binding.cast
                    reward = reward_mapping(first)
                    if type(reward) is not float:
                        reward = number(reward)
                    if reward - reward != 0.0:
                        raise not_finite(record, reward)
                    record.reward = reward
                    record.observation = cast(observe(first))
                    if DIFFERENCES:
                        EVALUATING.pop(get_ident(), None)
                    record.info = {}
                    self.pending = record
                    return
                reply = self._take(binding, args, kwargs, agent)
                if self.pending is not None or self.over:
                    return
                # Else they would keep alive what the model lets go meanwhile.
                binding = args = kwargs = first = agent = record = None
        except BaseException as error:
            self.pending, self.over = None, True  # whatever comes in between: an interrupt, the end of the stack
            binding = args = kwargs = first = None  # else the error would keep them alive
            self._fail(error)
            raise

    def go_on(self, binding: Any, args: Any, kwargs: Any) -> None:
        """Go on with an event, as ``turn`` does, to the next decision that the user is to answer or to the end."""
        try:
            while True:
                reply = self._take(binding, args, kwargs)
                if self.pending is not None or self.over or self._driver is None:
                    return
                binding = args = kwargs = None  # else they would keep alive what the model lets go meanwhile
                resume = self._driver.resume
                binding, args, kwargs = resume(reply)
        except BaseException as error:
            binding = args = kwargs = None
            self._fail(error)
            raise

    def nothing_pending(self) -> Exception:
        """The error that says why no action can be taken now."""
        if self.over:
            return EpisodeOverError("the episode is over; call reset() to begin the next one")
        return ReentrancyError("the environment was used from inside its own simulation or mappings")

    def _take(self, binding: Any, args: Any, kwargs: Any, agent: Any = UNNAMED) -> Any:
        """See to an event: make its decision pending, or return the reply to it, or end the episode."""
        if type(binding) is not Binding:
            if type(binding) is Removal:
                return self._release(binding, args, kwargs)
            if type(binding) is Ruled:
                return self._learn_of(binding.binding, *args)
            if binding is REFUSED and self._driver is not None:
                self._failed_in_model = True
                raise self._driver.refusal()
            result = [args]
            args = None  # this frame must not hold an error that is about to have it in its traceback
            return self._end(binding, result)
        if agent is UNNAMED:
            agent = binding.agent or binding.name_agent(*args, **kwargs)
        if agent is None:
            return RULE
        record = self.agents.get(agent) if type(agent) is str else None
        if record is None or record.binding is not binding:
            record = self._meet(agent, binding)
        self._latest = record
        if record.policy is not None:
            return self._consult(record, args, kwargs)
        record.hold(args, kwargs)
        self._arise(record, args, kwargs)
        return None

    def _arise(self, record: Record, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """A decision of the environment's user has arisen."""
        if self.turns == self._most_turns:
            self._finish(truncated=True)
            return
        if self.turns == self._max_turns:
            self._max_turns, self.taken = self._most_turns, LOST
        record.settle(args, kwargs)
        binding = record.binding
        if self.clock is None and binding.legal is None and binding.point.alone and not binding.tells_of_many:
            self._swift[binding] = NAMED_AT_CALL if binding.agent is None else record
        self.pending = record

    def _meet(self, agent: Any, binding: Binding) -> Record:
        """Find or make the record of an agent that is not known as one of the environment's own here."""
        if not isinstance(agent, str):
            raise AgentError(f"agent= of {binding.point.name} must name a string or None, not {agent!r}")
        record = self._answered.get(agent) or self.agents.get(agent)
        if record is None:
            if agent in self.gone:
                raise AgentError(
                    f"the agent {agent!r} decides at {binding.point.name} after its end; let agent= give each entity"
                    " a name of its own, and removed_by= name what really ends it"
                )
            record = self._enroll(agent, binding)
        elif record.binding is not binding:
            raise AgentError(
                f"the agent {agent!r} decides at {record.binding.point.name} and at {binding.point.name};"
                " an agent has one decision point: give each point's agents names of their own"
            )
        return record

    def _enroll(self, agent: str, binding: Binding) -> Record:
        """Make the record of an agent that is there for the first time, and find out who answers for it."""
        policy = self._plan.policies.get(agent) or binding.policy
        if policy is None and self._plan.unanswered:
            policy = RULE
        elif policy is None and self._plan.complete:
            policy = self._undeclared(agent, binding)
        record = self._make_record(agent, binding, policy, self.clock)
        (self.agents if policy is None else self._answered)[agent] = record
        return record

    def _undeclared(self, agent: str, binding: Binding) -> Any:
        if self._plan.options.undeclared == "rule":
            return RULE
        raise AgentError(
            f"the agent {agent!r}, which decides at {binding.point.name}, is not declared in possible_agents; declare"
            ' it, or let its rule decide with undeclared="rule"'
        )

    def _consult(self, record: Record, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Have a policy answer."""
        if record.policy is RULE:
            return RULE
        record.observe(args, kwargs)
        foretold, choices, consulted = self._foretold, record.choices, self.consulted
        action = foretold.popleft() if foretold else record.policy(record.observation, record.info)
        if len(consulted) == MOST_TAKEN:
            self.consulted = LOST
        self.consulted.append(duplicate(action))
        record.follow_up()
        return RULE if action is RULE else record.binding.reply(action, record.agent, record.mask, choices)

    def _learn_of(self, binding: Binding, decision: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """A rule has decided, and somebody wants to know what."""
        agent: Any = binding.agent or binding.name_agent(*args, **kwargs)
        record = (self.agents.get(agent) or self._answered.get(agent)) if type(agent) is str else None
        if record is not None and record.binding is binding:
            self._latest = record
            record.decided_by_rule(decision, args, kwargs)
            if record.news:  # there is more in its next info than the swift way would put there
                self._swift.pop(binding, None)

    def record(self, agent: str) -> Record | None:
        """What is known of an agent of the environment, whether it lives or is gone."""
        return self.agents.get(agent) or self.gone.get(agent)

    def replay(self, taken: list[Any]) -> None:
        """Give the actions of another episode once more.

        Raises:
            BaseException: Whatever the model or a mapping raises.
        """
        for action in taken:
            self.turn(action)

    def stands_as(self, other: Episode) -> bool:
        """Whether the pending decision looks just like that of another episode."""
        mine, theirs = self.pending, other.pending
        if mine is None or theirs is None:
            return mine is theirs
        return (
            mine.agent == theirs.agent
            and list(self.agents) == list(other.agents)
            and same(mine.observation, theirs.observation)
            and same(mine.mask, theirs.mask)
        )

    # -- agents announced beforehand --------------------------------------------------------------

    def _foresee(self, pending: Record | None) -> None:
        """Get to know agents before they decide, where the simulation knows the calls to come."""
        for record, args in self._announced():
            if record is not pending and not record.decided:
                record.hold(args, {})
                record.observe(args, {})
                record.choices = None  # which are asked for again when it decides
        if self.clock is None and not any(binding.legal or binding.padded for binding in self._plan.active):
            return
        for record in self.agents.values():
            if record.observation is None:  # there are learners to whom the infos of the reset tell all keys
                record.info = record.unseen()

    def _announced(self) -> Iterable[tuple[Record, tuple[Any, ...]]]:
        """The live agents that the simulation says are going to decide, with the arguments of their calls."""
        expected = getattr(self._simulation, "expected_calls", None)
        if expected is None:
            return ()
        announced = []  # a generator could not pass on a StopIteration
        agents = self.agents
        for binding in self._plan.active:
            name_agent = binding.name_agent
            for call in expected(binding.point.name):
                args = call if type(call) is tuple else tuple(call)
                agent = binding.agent if name_agent is None else name_agent(*args)
                record = agents.get(agent) if type(agent) is str else None
                if record is None or record.binding is not binding:
                    if agent is None or agent in self.gone or agent in self._answered:
                        continue
                    record = self._meet(agent, binding)
                    if record.policy is not None:
                        continue
                announced.append((record, args))
        return announced

    def _names(self) -> str:
        names = list(self.agents)
        return ", ".join(names[:10]) + (f" and {len(names) - 10} more" if len(names) > 10 else "")

    # -- ends -------------------------------------------------------------------------------------

    def _end(self, kind: Any, result: list[Any]) -> None:
        """The simulation's ``run`` has returned or failed."""
        self._let_go_of_driver()
        value = result.pop()
        if kind is FAILED:
            self._failed_in_model = True
            try:
                raise value
            finally:
                del value
        self._finish(truncated=value is TRUNCATED)

    def _release(self, removal: Removal, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """End the episode of the agents that the model is about to remove, while they are still whole."""
        latest = self._latest
        for binding, agent in removal.agents(args, kwargs):
            record = self.agents.get(agent)
            if record is None or record.binding is not binding:
                continue
            self._conclude(record)
            record.ended = True
            if binding.agent is not None:
                self._swift.pop(binding, None)
            self.gone[agent] = self.agents.pop(agent)
            self.parting.append(record)
        self._latest = latest  # after whose decision the model now goes on
        return RULE

    def _conclude(self, record: Record) -> None:
        """Give an agent its last reward and its last observation."""
        self._latest = record
        arguments = record.arguments()
        if arguments is None:  # it was never seen, or the model has let it go
            record.reward, record.info = 0.0, record.unseen()
        else:
            record.settle(*arguments, last=True)
        record.forget()

    def _finish(self, *, truncated: bool) -> None:
        """End the episode of every agent."""
        self.pending = None
        for record in self.agents.values():
            self._conclude(record)
        self.over, self.truncated, self.terminated = True, truncated, not truncated

    def _fail(self, error: BaseException) -> None:
        """End the episode for an error, which says where it came from."""
        self.pending, self.over = None, True
        interrupted()
        self._annotate(error)
        try:
            problems = self._unwind()
        except Warning as warning:  # where these are errors; another one must not take its place
            problems = [warning]
        for problem in problems:
            annotate(error, f"simenv_marl: and the simulation, when it was unwound, raised {problem!r}")

    def _annotate(self, error: BaseException) -> None:
        record = self._latest
        if record is None:
            where = "before the first decision"
        else:
            number = self.turns if self._failed_in_model else self.turns + 1
            where = "in the model, after" if self._failed_in_model else "at"
            where += f" decision {number}, of {record.agent!r} at {record.binding.point.name}"
        annotate(error, f"simenv_marl: {where}; seed {self._seed}")

    def close(self) -> None:
        """Unwind the simulation, if it is suspended; answer none of its decisions.

        Raises:
            ReentrancyError: The simulation is moving.
            WrongThreadError: It is suspended in another thread.
            BaseException: What the simulation raises in its ``stop`` or while it unwinds.
        """
        if self._driver is not None and self._driver.lost():
            self._let_go_of_driver()
            self.over = True
        if self.pending is None and not self.over:
            raise self.nothing_pending()
        if self._driver is not None:
            self._driver.enter()
        self.pending, self.over = None, True
        for problem in self._unwind():
            self._annotate(problem)
            raise problem

    @property
    def unwound(self) -> bool:
        """Whether the episode is over, and nothing is left of it in the simulation."""
        return self.over and self._driver is None

    def abandon(self) -> None:
        """Unwind the simulation when its environment is gone, from wherever that is noticed."""
        if self.pending is None and not self.over:
            return  # the process ends while it is moving in another thread, which ends with it
        self.pending, self.over = None, True
        if self._driver is not None and not self._driver.reachable():
            self._let_go_of_driver()  # its own thread unwinds it, as soon as that switches again
        for problem in self._unwind():
            warn_user(f"a simulation that was abandoned raised {problem!r}", ResourceWarning)

    def _unwind(self) -> list[BaseException]:
        """Raise ``SimulationExit`` in the suspended simulation until it is gone. Returns what else it raised."""
        driver = self._driver
        problems: list[BaseException] = []
        if driver is None:
            return problems
        with self._kept_apart():
            try:
                stop = getattr(self._simulation, "stop", None)
                if stop is not None:
                    stop()
            except BaseException as error:
                problems.append(error)
            for _ in range(UNWINDING_TRIES):
                kind, value, _ = driver.throw()
                if kind is STUCK:
                    break
                if kind is FAILED and not _is_exit(value):
                    problems.append(value)
                if kind is FAILED or kind is FINISHED:
                    self._let_go_of_driver()
                    return problems
        driver.give_up()
        self._driver = None
        refusal = (
            f"has neither decided anything nor ended for {value} s; it is left running in its thread until it decides"
            " again, and until then an episode that is begun shares the simulation with it"
            if kind is STUCK
            else f"refuses to end: it went on after {UNWINDING_TRIES} times SimulationExit was raised in it; it is left"
            " suspended. Let it re-raise what it does not know"
        )
        warn_user(f"{type(self._simulation).__name__} {refusal}.", ResourceWarning)
        return problems

    def _let_go_of_driver(self) -> None:
        driver, self._driver = self._driver, None
        if driver is not None:
            driver.forget()


def _is_exit(error: BaseException | None) -> bool:
    """Whether an error is the exit that was raised in a simulation, passed on in whatever guise."""
    seen = set()  # causes may go in circles
    while error is not None and not isinstance(error, SimulationExit) and id(error) not in seen:
        if isinstance(error, BaseExceptionGroup) and all(_is_exit(member) for member in error.exceptions):
            return True
        seen.add(id(error))
        error = error.__cause__
    return isinstance(error, SimulationExit)
