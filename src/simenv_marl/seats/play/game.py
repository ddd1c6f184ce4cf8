"""The process of a game: its simulation, its decisions, and checkpoints to go back to.

The server sends triples: the number of a connection, its seat (None: the server itself), and a dict
from the page (None: the end). The game answers with pairs: the number, and an error or None. Pairs
with the number None are for all pages. Work that takes time is a generator, which the game leaves
between two steps of the simulation when a message has come.
"""

import json
import signal
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic
from typing import Any, Final, NamedTuple, NotRequired, TypedDict

from ... import aec_env, clone
from ...envs import SimulationAECEnv
from ...errors import (
    InvalidActionError,
    OptionValueError,
    SimEnvError,
    describe_error,
    did_you_mean,
    short_repr,
)
from ...simulation import Action, Model, check_seconds
from ..descriptions import JSON, at_decision
from .forms import Message, action_of, jsonable, pending_decision, picture_of
from .futures import MOST_MEASURES, Futures

CHECKPOINTS: Final = 24
"""The largest number of checkpoints. Each one is a process."""

MOST_ROWS: Final = 150
"""The largest number of decisions that the page receives."""

PAUSE: Final = 0.2
"""The seconds between two states that the page receives while the rule plays."""

RECORDED: Final = ("turn", "agent", "action", "by", "seen", "time")
"""The keys of a decision in a recording."""

ENDS: Final = ("", "terminated", "truncated")
"""The values of ``Game.over`` without an error."""


class Row(TypedDict):
    """A decision of the game, as JSON."""

    turn: int
    agent: str
    before: float
    """The agent's return before the decision."""
    seen: str
    """The digest of the observation."""
    time: float | None
    values: list[JSON]
    """The first entries of the observation."""
    action: NotRequired[Action]
    """The action as JSON; None for the rule. A pending decision has none."""
    by: NotRequired[str]
    """Who decided: "person", "rule", or "limit" for the rule after the time limit."""
    reward: NotRequired[float | None]


class Checkpoint(NamedTuple):
    """A clone at a former decision, and the returns of the agents there."""

    env: SimulationAECEnv
    returns: dict[str, float]


@dataclass
class Game:
    """An episode with its past.

    Attributes:
        simulation: The simulation, as ``aec_env`` takes it.
        name: The name of the simulation.
        seats: The agents that people play; none: all agents.
        seed: The seed of the episode.
        limit: The time limit of a person's decision, in seconds.
        record: The file of the recording.
        can_fork: Whether checkpoints can be made. Else the way back is a replay.
        horizon: The number of an agent's decisions in its futures.
        occupied: The seats that people have.
        checkpoints: The checkpoints, by turn.
        root: The environment that was made for the game.
        env: The environment at the pending decision: ``root`` or a clone.
        agents: The known agents.
        timeline: The decisions, also those after the pending one that were undone.
        turn: The place of the pending decision in the timeline.
        now: The pending decision as JSON; None at the end.
        over: Why the episode is over: "terminated", "truncated" or an error. "": it is not.
        returns: The return of each agent so far.
        latest: The turn of the latest decision of each agent.
        futures: The futures of the pending decision, once they are explored.
        deadline: When the rule decides, in seconds of ``monotonic``; None: there is no limit.
        delegated: How many of its next decisions each seat leaves to the rule.
        skipping: The seat until whose next decision the rule plays for free seats.
        notice: A warning for the page.
    """

    simulation: Model
    name: str
    seats: Sequence[str]
    seed: int
    limit: float | None = None
    record: Path | None = None
    can_fork: bool = True
    horizon: int = 8
    occupied: Collection[str] = ()
    checkpoints: dict[int, Checkpoint] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Begin an episode.

        Raises:
            OptionValueError: An argument has an invalid value, or the episode cannot begin.
        """
        if self.limit is not None:
            check_seconds(self.limit, "limit")
        modes = aec_env(self.simulation).metadata["render_modes"]
        mode = next((mode for mode in ("rgb_array", "ansi") if mode in modes), None)
        self.root = self.env = aec_env(self.simulation, render_mode=mode)
        agents: list[str] = getattr(self.root, "possible_agents", [])
        for seat in set(self.seats).difference(agents or self.seats):
            raise OptionValueError(
                f"there is no agent {seat!r}; the agents are {agents}{did_you_mean(seat, agents)}"
            )
        self.agents = dict.fromkeys(self.seats or agents)
        self.restart(self.seed)
        if self.over or self.notice:
            raise OptionValueError(f"{self.name} cannot be played: {self.over or self.notice}")

    def restart(self, seed: int) -> None:
        """Begin another episode."""
        self.forget(-1)
        self.seed = seed
        self.notice = ""
        self.timeline: list[Row] = []
        self._stop_rule()
        self._return_to(0)
        self._record(
            {
                "simulation": self.name,
                "seed": seed,
                "seats": list(self.agents),
            }
        )

    def decide(self, action: Action, by: str) -> None:
        """Take the pending decision.

        Args:
            action: The action as JSON; None for the rule.
            by: The origin of the decision, as in ``Row``.

        Raises:
            InvalidActionError: The action is not legal. The decision stays pending.
        """
        row = self.timeline[self.turn]
        self._step(row["agent"], action)
        self.forget(self.turn)
        del self.timeline[self.turn + 1 :]
        row |= {"action": action, "by": by, "reward": None}
        line = {key: value for key, value in row.items() if key in RECORDED}
        self._arrive(self.turn + 1)
        if self.over:
            line |= {"end": self.over, "returns": self.returns}
            absent = [seat for seat in self.seats if seat not in self.latest]
            if absent:
                names = ", ".join(absent)
                others = ", ".join(self.latest)
                self.notice = f"No decision was one of {names}; {others} decided."
        self._record(line)

    def jump(self, turn: int) -> None:
        """Go to the end, or to the latest decision of a person up to a turn.

        The way leads from the nearest checkpoint, or from the beginning.
        """
        if turn < len(self.timeline) or "action" not in self.timeline[-1]:
            stops = [row["turn"] for row in self.timeline if self.plays(row["agent"])] or [0]
            earlier = [stop for stop in stops if stop <= turn]
            turn = max(earlier, default=stops[0])
        starts = [start for start in self.checkpoints if start <= turn]
        self._return_to(max(starts, default=0))
        for row in self.timeline[self.turn : turn]:
            if self.over or self.timeline[self.turn] is not row:
                break  # the simulation does not repeat itself
            self._step(row["agent"], row["action"])
            self._arrive(self.turn + 1)
        self._stop_rule()

    def forget(self, turn: int) -> None:
        """Close the checkpoints after a turn."""
        for later in [start for start in self.checkpoints if start > turn]:
            self.checkpoints.pop(later).env.close()

    def plays(self, agent: str) -> bool:
        """Return whether the agent's seat is for a person."""
        return not self.seats or agent in self.seats

    def _stop_rule(self) -> None:
        self.delegated: Counter[str] = Counter()
        self.skipping: str | None = None  # the seat for whose next decision the rule plays on

    def _step(self, agent: str, action: Action) -> None:
        space = self.env.action_space(agent)
        self._attempt(self.env.step, action_of(space, action))

    def _attempt(self, function: Callable[..., Any], *args: object) -> Any:
        """Call a function of the environment; an error ends the episode.

        Raises:
            InvalidActionError: The function refuses an action. The episode goes on.
        """
        try:
            return function(*args)
        except InvalidActionError:
            raise
        except Exception as error:
            self.over = describe_error(error)
            return None

    def _return_to(self, turn: int) -> None:
        """Continue at a checkpoint. The beginning needs none."""
        checkpoint = self.checkpoints.get(turn)
        previous = self.env
        if checkpoint is None:
            self.env = self.root
            self.returns: dict[str, float] = {}
        else:
            self.env = clone(checkpoint.env)
            self.returns = {**checkpoint.returns}
        self.over = ""
        self.latest = {row["agent"]: row["turn"] for row in self.timeline[:turn]}
        if checkpoint is None:
            self._attempt(self.root.reset, self.seed)
        if previous is not self.root:
            previous.close()
        self._arrive(turn)

    def _arrive(self, turn: int) -> None:
        """Note the reward of the agent that decides next, and the agents that have ended."""
        self.turn = turn
        self.now: Message | None = None
        self.deadline: float | None = None
        self.futures: Futures | None = None
        self.picture: Message | None = None
        end = ""
        while self.env.agents and not self.over:
            agent = self.env.agent_selection
            _, reward, terminated, truncated, _ = self.env.last(observe=False)
            self._add_reward(agent, reward)
            if not (terminated or truncated):
                self._note_pending(agent)
                return
            end = "truncated" if truncated else "terminated"
            self.env.step(None)
        self.over = self.over or end

    def _add_reward(self, agent: str, reward: float) -> None:
        """Add the reward of an agent's previous decision to its return."""
        self.returns.setdefault(agent, 0.0)
        if agent in self.latest:
            row = self.timeline[self.latest[agent]]
            row["reward"] = reward
            self.returns[agent] = row["before"] + reward

    def _note_pending(self, agent: str) -> None:
        """Note the pending decision in the timeline, which may have it with its action."""
        pending = self._attempt(at_decision, self.env, "play", pending_decision)
        if pending is None:
            return
        row: Row = {
            "turn": self.turn,
            "agent": agent,
            "before": self.returns[agent],
            "seen": pending["seen"],
            "time": pending["time"],
            "values": [value for _, value in pending["observation"][:MOST_MEASURES]],
        }
        if self.turn < len(self.timeline):
            previous = self.timeline[self.turn]
            if previous | row != previous:
                del self.timeline[self.turn :]
                self.notice = (
                    "The simulation does not repeat itself: its randomness does not all come from"
                    " the seed."
                )
        if self.turn == len(self.timeline):
            self.timeline.append(row)
        self.now = pending
        self.latest[agent] = self.turn
        if not self.seats:
            self.agents[agent] = None

    def _record(self, line: Message) -> None:
        """Append a line to the recording, which is closed in between: clones need not copy it."""
        if self.record is None:
            return
        try:
            with self.record.open("a", encoding="utf-8") as file:
                file.write(json.dumps(jsonable(line)) + "\n")
        except OSError as error:
            self.notice = f"The recording {self.record} cannot be written: {error}"

    # -- messages ----------------------------------------------------------------------------------

    def serve(self, connection: Connection) -> None:
        """Answer messages until the end, or until the connection is closed."""
        with suppress(EOFError):
            while True:
                self._work_until_changed(connection)
        self.root.close()

    def _work_until_changed(self, connection: Connection) -> None:
        for update in self.work():
            if update is not None:
                connection.send((None, update))
            if self._changed(connection, 0.0):
                return
        while not self._changed(connection, self._seconds_left()):
            pass

    def _changed(self, connection: Connection, timeout: float | None) -> bool:
        """Decide if the time is up, else answer a message; return whether the game has changed.

        Raises:
            EOFError: The message is the end, or the connection is closed.
        """
        if self.now is not None and self._seconds_left() == 0.0:
            self.decide(None, "limit")
            return True
        if not connection.poll(timeout):
            return False
        number, seat, message = connection.recv()
        if message is None:
            raise EOFError
        reply = None
        try:
            changed = self.handle(seat, message)
        except Exception as error:
            changed = not isinstance(error, ValueError)
            reply = {"type": "error", "text": _message_of(error)}
        connection.send((number, reply))
        return changed

    def handle(self, seat: str | None, message: Message) -> bool:
        """Handle a message from a seat, or from the server if that is None.

        Returns:
            Whether the message has changed the game.

        Raises:
            InvalidActionError: It is not the seat's turn, or the action is not legal.
            OptionValueError: The message is not one of the page.
        """
        if seat is None:
            self.occupied = message["taken"]
            self._start_clock()
            return self.skipping is not None
        if message.get("do") in ("act", "rule", "try"):
            self._check_turn(message.get("turn"), seat)
        match message:
            case {"do": "rule"}:
                self.decide(None, "rule")
            case {"do": "act", "action": action} if action is not None:
                self.decide(action, "person")
            case {"do": "try", "action": action} if action is not None:
                if self.futures is not None:
                    self.futures.add(action)
            case {"do": "delegate", "n": int(number)} if 0 <= number <= 100_000:
                self.delegated[seat] = number
                self.skipping = None
            case {"do": "skip"}:
                self.skipping = seat
            case {"do": "undo"}:
                earlier = self._turns(seat, range(self.turn))
                self.jump(max(earlier, default=0))
            case {"do": "redo"}:
                end = len(self.timeline)
                later = self._turns(seat, range(self.turn + 1, end))
                self.jump(min(later, default=end))
            case {"do": "jump", "n": int(number)} if 0 <= number <= len(self.timeline):
                self.jump(number)
            case {"do": "restart", "n": int(seed)} if 0 <= seed < 2**31:
                self.restart(seed)
            case {"do": "horizon", "n": int(number)} if 0 < number <= 100:
                self.horizon = number
                self.futures = None
            case _:
                raise OptionValueError(f"the game cannot follow {short_repr(message)}")
        return True

    def _turns(self, seat: str, turns: range) -> list[int]:
        return [turn for turn in turns if self.timeline[turn]["agent"] == seat]

    def _check_turn(self, turn: object, seat: str) -> None:
        if self.now is None or turn != self.turn:
            raise InvalidActionError("another decision is pending by now")
        if self.now["agent"] != seat:
            raise InvalidActionError(f"it is not your turn: {self.now['agent']} decides")

    def _start_clock(self) -> None:
        """Begin the time limit of the pending decision, once a person is there."""
        is_stopped = self.now is not None and self.deadline is None
        if self.limit and self.occupied and is_stopped:
            self.deadline = monotonic() + self.limit

    def _seconds_left(self) -> float | None:
        if self.deadline is None:
            return None
        return max(0.0, self.deadline - monotonic())

    # -- work --------------------------------------------------------------------------------------

    def work(self) -> Iterator[Message | None]:
        """Let the rule decide for seats without a person; then explore the futures.

        Yields:
            None after each step of a simulation, or a message for all pages.
        """
        latest = monotonic()
        while self.now is not None and self._leaves_to_rule(self.now["agent"]):
            self.decide(None, "rule")
            yield None
            if monotonic() > latest + PAUSE:
                latest = monotonic()
                yield self.snapshot()
        if self.now is not None:
            self._make_checkpoint()
            if self.futures is None:
                self.futures = Futures(
                    self.env,
                    self.now,
                    self.turn,
                    self.horizon,
                    self.seed,
                )
            self._start_clock()
        if self.over in ENDS:
            self.picture = picture_of(self.env)
        yield self.snapshot()
        if self.futures is not None:
            yield from self.futures.explore()

    def _leaves_to_rule(self, agent: str) -> bool:
        if not self.plays(agent):
            return True
        if self.skipping == agent:
            self.skipping = None
        if self.delegated[agent]:
            self.delegated[agent] -= 1
            return True
        return self.skipping is not None and agent not in self.occupied

    def _make_checkpoint(self) -> None:
        """Make a checkpoint of the pending decision. If there are too many, thin out the oldest."""
        if not self.can_fork or self.turn in self.checkpoints:
            return
        try:
            twin = clone(self.env, method="fork")
            self.checkpoints[self.turn] = Checkpoint(twin, {**self.returns})
        except SimEnvError:
            self.can_fork = False
        if len(self.checkpoints) > CHECKPOINTS:
            for turn in sorted(self.checkpoints)[1 : CHECKPOINTS // 2 : 2]:
                self.checkpoints.pop(turn).env.close()

    def snapshot(self) -> Message:
        """Return the message with the state of the game, without its futures."""
        return {
            "type": "state",
            "simulation": self.name,
            "seed": self.seed,
            "seats": list(self.agents),
            "turn": self.turn,
            "length": sum("action" in row for row in self.timeline),
            "pending": self.now,
            "over": self.over,
            "returns": self.returns,
            "history": self.timeline[max(0, self.turn - MOST_ROWS) : self.turn + 1],
            "left": self._seconds_left(),
            "late": Counter(row["agent"] for row in self.timeline if row.get("by") == "limit"),
            "picture": self.picture,
            "notice": self.notice,
        }


def _message_of(error: Exception) -> str:
    if isinstance(error, SimEnvError):
        return str(error)
    return describe_error(error)


def run_game(
    connection: Connection,
    find: Callable[[], Model],
    options: dict[str, Any],
) -> None:
    """Play in this process, which the server has started, until the connection is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the server ends this process
    try:
        game = Game(find(), **options)
    except Exception as error:
        connection.send((None, {"type": "failed", "text": _message_of(error)}))
        return
    with suppress(ConnectionError):
        game.serve(connection)
