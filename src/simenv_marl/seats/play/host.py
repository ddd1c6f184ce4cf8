"""The process of a game: it answers messages, lets the rule decide, and explores futures.

The server sends triples: the number of a connection, its seat (None: the server itself; "": the
facilitator), and a dict from the page (None: the end). The game answers with pairs: the number, and
an error or None. Pairs with the number None are for all pages. All that the pages show of the game
is in one message, the snapshot.
"""

import pickle
import signal
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from secrets import randbelow
from threading import Lock
from time import monotonic
from typing import Any, Final

from ...errors import (
    InvalidActionError,
    OptionValueError,
    SimEnvError,
    describe_error,
    short_repr,
)
from ...simulation import check_seconds
from ..descriptions import at_decision
from .forms import Message, action_of, complaint_about, jsonable, picture_of, shown
from .futures import Comparison, Exploration, Futures, Horizon
from .game import Game, Row

MOST_ROWS: Final = 60
"""The largest number of decisions that the page receives."""

MOST_VALUES: Final = 60
"""The largest number of past values of an entry that the page receives."""

MOST_SEATS: Final = 64
"""The largest number of agents whose situations the page receives."""

PAUSE: Final = 0.2
"""The seconds between two snapshots while the rule plays."""

ENDS: Final = {
    "": "",
    "terminated": "The simulation has come to its end.",
    "truncated": "Time is up.",
}
"""The reasons of an end without an error."""

TOOLS: Final = ("delegate", "skip", "undo", "redo", "jump", "restart", "horizon")
"""The messages of the drawer."""

WITH_MOMENT: Final = ("undo", "redo", "jump", "restart", "again")
"""The messages that count only at the moment that their page has shown."""

ROW_KEYS: Final = ("turn", "agent", "time", "action", "by", "words", "reward")
"""The keys of a past decision on the page."""


@dataclass
class Rules:
    """The options of a game besides its episode.

    Attributes:
        title: The title of the page.
        tools: Who has the tools: "all", "facilitator" or "none".
        limit: The time limit of a person's decision, in seconds.
        time_unit: The unit of the simulation's time, in the singular, such as "hour".
    """

    title: str
    tools: str = "all"
    limit: float | None = None
    time_unit: str = ""

    def __post_init__(self) -> None:
        """Check the options.

        Raises:
            OptionValueError: One of them has an invalid value.
        """
        if self.limit is not None:
            check_seconds(self.limit, "limit")
        if self.tools not in ("all", "facilitator", "none"):
            raise OptionValueError(
                f'tools must be "all", "facilitator" or "none", not {short_repr(self.tools)}'
            )

    def allow(self, seat: str) -> bool:
        """Return whether a seat has the tools."""
        return self.tools == ("all" if seat else "facilitator")


class Host:
    """A game, and the people at it.

    Attributes:
        game: The game.
        rules: Its options.
        occupied: The seats that people have.
        deadline: When the rule decides, in seconds of ``monotonic``, if there is a limit.
        delegated: How many of its next decisions each seat leaves to the rule.
        skipping: The seat until whose next decision the rule plays for free seats.
        event: What a person has done besides deciding, for all pages.
        exploring: The exploration of the present moment.
    """

    def __init__(
        self,
        game: Game,
        rules: Rules,
        send: Callable[[tuple[int | None, Message | None]], None],
    ) -> None:
        """Take over a game.

        Args:
            game: The game.
            rules: The options.
            send: Sends a pair to the server.
        """
        self.game = game
        self.rules = rules
        self.occupied: Collection[str] = ()
        self.deadline = 0.0
        self._timed = -1  # the moment to which the deadline belongs
        self.event = ""
        self.exploring: Exploration | None = None
        self._send = send
        self._lock = Lock()
        self._horizon = Horizon()
        self._picture: Message | None = None
        self._moment = -1
        self._stop_rule()

    def _stop_rule(self) -> None:
        self.delegated: Counter[str] = Counter()
        self.skipping: str | None = None

    def _tell(self, message: Message | None, number: int | None = None) -> None:
        """Send a message, also from the thread of an exploration."""
        safe: Any = None if message is None else jsonable(message)
        with self._lock:
            self._send((number, safe))

    # -- messages ----------------------------------------------------------------------------------

    def serve(self, connection: Connection) -> None:
        """Answer messages until the end, or until the connection is closed."""
        with suppress(EOFError):
            while True:
                self._work_until_changed(connection)
        self.abandon()
        self.game.close()

    def _work_until_changed(self, connection: Connection) -> None:
        for update in self.work():
            if update is not None:
                self._tell(update)
            if self._changed(connection, 0.0):
                return
        while not self._changed(connection, self._seconds_left()):
            pass

    def _changed(self, connection: Connection, timeout: float | None) -> bool:
        """Decide if the time is up, else answer a message; return whether the game has changed.

        Raises:
            EOFError: The message is the end, or the connection is closed.
        """
        if self.game.now is not None and self._seconds_left() == 0.0:
            self._tell({"type": "busy", "on": True})
            self.abandon()
            self.game.decide(None, "limit")
            return True
        if not connection.poll(timeout):
            return False
        number, seat, message = connection.recv()
        if message is None:
            raise EOFError
        reply: Message | None = None
        try:
            changed = self.handle(seat, message)
        except Exception as error:
            changed = not isinstance(error, ValueError)
            reply = {"type": "error", "text": message_of(error)}
            reply |= self._complaint(seat, message, error)
        self._tell(reply, number)
        return changed

    def _complaint(
        self,
        seat: str | None,
        message: Message,
        error: Exception,
    ) -> Message:
        """Say in words what is wrong with an illegal action, at its field."""
        now = self.game.now
        if now is None or now["agent"] != seat or message.get("turn") != self.game.turn:
            return {}
        if message.get("action") is None or not isinstance(error, InvalidActionError):
            return {}
        return complaint_about(now["form"], message["action"])

    def handle(self, seat: str | None, message: Message) -> bool:
        """Handle a message from a seat, the facilitator or the server.

        Returns:
            Whether the message has changed the game.

        Raises:
            InvalidActionError: It is not the seat's turn, or the action is not legal.
            OptionValueError: The message is not one of the page.
        """
        game = self.game
        if seat is None:
            self.occupied = message["taken"]
            if self._start_clock():
                self._tell(self.snapshot())
            return self.skipping is not None
        do = message.get("do")
        if do in ("act", "rule", "try"):
            self._check_turn(message.get("turn"), seat)
        if do in TOOLS and not self.rules.allow(seat):
            raise InvalidActionError("this seat has no tools: ask the facilitator")
        if do in WITH_MOMENT and message.get("moment", game.moment) != game.moment:
            self._tell(self.snapshot())
            return False
        match message:
            case {"do": "rule"}:
                self._decide(None, "rule")
            case {"do": "act", "action": action} if action is not None:
                self._decide(action, "person")
            case {"do": "try", "action": action} if action is not None:
                self._try(action)
            case {"do": "delegate", "n": int(number)} if 0 <= number <= 100_000:
                self.delegated[seat or self._pending_seat()] = number
                self.skipping = None
            case {"do": "skip"}:
                self.skipping = seat
            case {"do": "undo"}:
                earlier = self._turns(seat, range(game.turn))
                self._jump(max(earlier, default=0), seat)
            case {"do": "redo"}:
                self._redo(seat)
            case {"do": "jump", "n": int(number)} if 0 <= number <= len(game.timeline):
                self._jump(number, seat)
            case {"do": "restart" | "again"}:
                self._restart(seat, message)
            case {"do": "horizon", "n": int() | float() as length} if 0 < length <= 1e9:
                by_time = message.get("by") == "time"
                if not by_time and length > 100:
                    raise OptionValueError("Enter a whole number of decisions from 1 to 100.")
                self.abandon()
                self._horizon.set(by_time, length)
                self._moment = -1
            case _:
                raise OptionValueError(f"the game cannot follow {short_repr(message)}")
        return True

    def _decide(self, action: Any, by: str) -> None:
        if action is not None:
            at_decision(self.game.env, "play", Legal(action))
        self.abandon()
        self.game.decide(action, by)
        self.event = ""

    def _try(self, action: Any) -> None:
        """Add a candidate to the futures.

        Raises:
            InvalidActionError: The action is not legal.
        """
        futures = self.exploring
        if isinstance(futures, Futures):
            at_decision(self.game.env, "play", Legal(action))
            self.abandon()
            self.exploring = futures.resumed(futures.env)
            self.exploring.add(action)

    def _redo(self, seat: str) -> None:
        game = self.game
        end = len(game.timeline)
        if game.can_go_back:
            self.abandon()
            game.go_back()
            self._stop_rule()
            self.event = f"{_called(seat)} went back to the game before the restart."
            return
        later = self._turns(seat, range(game.turn + 1, end))
        self._jump(min(later, default=end), seat)

    def _jump(self, turn: int, seat: str) -> None:
        game = self.game
        before = game.turn
        self.abandon()
        game.jump(turn)
        self._stop_rule()
        if game.turn != before:
            way = "went back" if game.turn < before else "went on"
            self.event = f"{_called(seat)} {way} to {self._place()}."

    def _place(self) -> str:
        """Return where the game stands, in words."""
        game = self.game
        if game.now is None:
            return "the end"
        when = self._when(game.now["time"])
        return f"decision {game.turn + 1}" + (f", {when}" if when else "")

    def _when(self, time: object) -> str:
        unit = self.rules.time_unit or "time"
        return "" if time is None else f"{unit} {shown(time)}"

    def _restart(self, seat: str, message: Message) -> None:
        """Begin another game, with a seed of the message or a random one.

        Raises:
            OptionValueError: The seed is none, or the game is not over.
        """
        seed = message.get("n")
        if message["do"] == "again":
            seed = None
            if not self.game.over or (self.rules.tools == "facilitator" and seat):
                raise OptionValueError("only the facilitator begins another game")
        if seed in (None, ""):
            seed = randbelow(2**31)
        if type(seed) is not int or not 0 <= seed < 2**31:
            raise OptionValueError(
                f"Enter a whole number from 0 to {2**31 - 1}, or none for a random one."
            )
        self.abandon()
        self.game.restart(seed)
        self._stop_rule()
        self.event = f"{_called(seat)} began another game, with seed {seed}."

    def _turns(self, seat: str, turns: range) -> list[int]:
        """Return the turns of a seat; for the facilitator, those of all people."""
        agents = [self.game.timeline[turn]["agent"] for turn in turns]
        return [
            turn
            for turn, agent in zip(turns, agents, strict=True)
            if (agent == seat if seat else self.game.plays(agent))
        ]

    def _pending_seat(self) -> str:
        return "" if self.game.now is None else str(self.game.now["agent"])

    def _check_turn(self, turn: object, seat: str) -> None:
        now = self.game.now
        if now is None or turn != self.game.turn:
            raise InvalidActionError("another decision is pending by now")
        if now["agent"] != seat:
            raise InvalidActionError(f"it is not your turn: {now['agent']} decides")

    def _start_clock(self) -> bool:
        """Begin the time limit of the pending decision, once a person is there."""
        game = self.game
        if game.now is None or not self.occupied or self.rules.limit is None:
            return False
        if self._timed == game.moment:
            return False
        self._timed = game.moment
        self.deadline = monotonic() + self.rules.limit
        return True

    def _seconds_left(self) -> float | None:
        if self._timed != self.game.moment:
            return None
        return max(0.0, self.deadline - monotonic())

    # -- work --------------------------------------------------------------------------------------

    def work(self) -> Iterator[Message | None]:
        """Let the rule and policies decide for seats without a person; then explore.

        Yields:
            None after each step of a simulation, or a message for all pages.
        """
        game = self.game
        latest = monotonic()
        while game.now is not None and self._leaves_to_rule(game.now["agent"]):
            self.abandon()
            game.answer()
            yield None
            if monotonic() > latest + PAUSE:
                latest = monotonic()
                yield self.snapshot()
        if game.moment != self._moment:
            self.abandon()
            self._moment = game.moment
            self._picture = None
            if game.now is not None:
                game.make_checkpoint()
                self._start_clock()
            if game.over in ENDS:
                self._picture = picture_of(game.env)
            self.exploring = self._explore()
        yield self.snapshot()
        if self.exploring is None:
            return
        if game.can_fork:
            self.exploring.start(self._tell)
        else:
            yield from self.exploring.explore()

    def _explore(self) -> Exploration | None:
        """Return the exploration of this moment: of futures, or at the end of the rule's game."""
        game = self.game
        checkpoint = game.checkpoints.get(game.turn)
        env = game.env if checkpoint is None else checkpoint.env
        if game.now is not None:
            pending = game.now | {"moment": game.moment}
            return Futures(env, game.deciders, pending, self._horizon, game.seed)
        if game.over not in ENDS:
            return None
        returns: dict[str, float] = {}
        if game.checkpoints:
            first = game.checkpoints[min(game.checkpoints)]
            env, returns = first
        else:
            env = game.make_env()
            env.reset(seed=game.seed)
        return Comparison(env, game.deciders, returns, game.moment)

    def abandon(self) -> None:
        """End the exploration, before the game changes."""
        if self.exploring is not None:
            self.exploring.abandon()

    def _leaves_to_rule(self, agent: str) -> bool:
        if not self.game.plays(agent):
            return True
        if self.skipping == agent:
            self.skipping = None
        if self.delegated[agent]:
            self.delegated[agent] -= 1
            return True
        return self.skipping is not None and agent not in self.occupied

    # -- the snapshot ------------------------------------------------------------------------------

    def snapshot(self) -> Message:
        """Return the message with all that the pages show, without its futures."""
        game = self.game
        rows = game.timeline[: game.turn + 1]
        decided = [row for row in rows if "action" in row and row["turn"] < game.turn]
        seats = [agent for agent in game.agents if game.plays(agent)]
        by_limit = [row["agent"] for row in game.timeline if row.get("by") == "limit"]
        return {
            "type": "state",
            "title": self.rules.title,
            "time_unit": self.rules.time_unit,
            "tools": self.rules.tools,
            "simulation": game.name,
            "seed": game.seed,
            "resumed": game.resumed,
            "seats": seats,
            "policies": {agent: name for agent, name in game.agents.items() if name},
            "turn": game.turn,
            "moment": game.moment,
            "length": sum("action" in row for row in game.timeline),
            "pending": self._pending(),
            "over": game.over,
            "ending": ENDS.get(game.over, f"The game cannot go on: {game.over}"),
            "returns": {**game.returns},
            "history": [self._past(row) for row in decided[-MOST_ROWS:]],
            "views": self._views(rows),
            "courses": self._courses(seats) if game.over else {},
            "left": self._seconds_left(),
            "limit": self.rules.limit,
            "late": Counter(by_limit),
            "picture": self._picture,
            "notice": game.notice,
            "event": self.event,
            "back": game.can_go_back,
        }

    def _pending(self) -> Message | None:
        now = self.game.now
        if now is None:
            return None
        own = [row for row in self.game.timeline[: self.game.turn] if row["agent"] == now["agent"]]
        last = [row["action"] for row in own if row["by"] == "person"]
        return now | {"when": self._when(now["time"]), "last": last[-1] if last else None}

    def _past(self, row: Row) -> Message:
        shown_row = {key: value for key, value in row.items() if key in ROW_KEYS}
        return shown_row | {"when": self._when(row["time"])}

    def _views(self, rows: list[Row]) -> Message:
        """Return the latest situation of each agent, with the past values of its numbers."""
        views: Message = {}
        for row in reversed(rows[-MOST_VALUES * 16 :]):
            agent = row["agent"]
            if agent not in views and len(views) < MOST_SEATS:
                entries = [entry | {"past": []} for entry in row["situation"]]
                views[agent] = {"when": self._when(row["time"]), "situation": entries}
            numbers = {entry["label"]: entry["number"] for entry in row["situation"]}
            for entry in views.get(agent, {"situation": ()})["situation"]:
                number = numbers.get(entry["label"])
                if number is not None and len(entry["past"]) < MOST_VALUES:
                    entry["past"].insert(0, number)
        return views

    def _courses(self, seats: list[str]) -> Message:
        """Return the totals of seats after each of their decisions."""
        courses: Message = {}
        for agent in seats[:MOST_SEATS]:
            rows = [row for row in self.game.timeline if row["agent"] == agent]
            totals = [row["before"] for row in rows]
            courses[agent] = [*totals, self.game.returns.get(agent, 0.0)]
        return courses


class Legal:
    """Refuses an action of a decision, given as JSON, that is not legal."""

    def __init__(self, action: Any) -> None:
        self.action = action

    def __call__(self, decision: Any) -> None:
        """Raise an ``InvalidActionError`` if the action is not legal."""
        decision.validate(action_of(decision.action_space, self.action))


def _called(seat: str) -> str:
    return seat or "The facilitator"


def message_of(error: Exception) -> str:
    """Return the text of an error for people."""
    if isinstance(error, SimEnvError):
        return str(error)
    return describe_error(error)


def run_game(connection: Connection, parcel: bytes) -> None:
    """Play in this process, which the server has started, until the connection is closed.

    ``parcel``: a packed function that makes the game and its rules.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the server ends this process
    try:
        game, rules = pickle.loads(parcel)()
    except Exception as error:
        connection.send((None, {"type": "failed", "text": message_of(error)}))
        return
    with suppress(ConnectionError):
        Host(game, rules, connection.send).serve(connection)
