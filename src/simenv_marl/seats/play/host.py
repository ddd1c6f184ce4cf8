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
from functools import partial
from multiprocessing.connection import Connection
from secrets import randbelow
from threading import Lock
from time import monotonic
from typing import Any, Final

from ...core import Decision
from ...errors import (
    InvalidActionError,
    OptionValueError,
    SimEnvError,
    describe_error,
    short_repr,
)
from ...simulation import check_seconds
from ..descriptions import JSON, at_decision
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

SEEDS: Final = 2**31
"""The number of seeds."""

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
        send: Callable[[tuple[int | None, JSON]], None],
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
        self._stop()

    def _stop(self) -> None:
        """Stop the exploration and the rule, before a person changes the game."""
        self.abandon()
        self.delegated: Counter[str] = Counter()
        self.skipping: str | None = None

    def abandon(self) -> None:
        """End the exploration, before the game changes."""
        if self.exploring is not None:
            self.exploring.abandon()

    def _tell(self, message: Message | None, number: int | None = None) -> None:
        """Send a message, also from the thread of an exploration."""
        with self._lock:
            self._send((number, jsonable(message)))

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
            self._decide(None, "limit")
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
        self._tell(reply, number)
        return changed

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
        person = seat or "The facilitator"
        if do in TOOLS and not self.rules.allow(seat):
            raise InvalidActionError("this seat has no tools: ask the facilitator")
        if do in WITH_MOMENT and message.get("moment", game.moment) != game.moment:
            self._tell(self.snapshot())
            return False
        match message:
            case {"do": "rule"}:
                self._check_turn(seat, message)
                self._decide(None, "rule")
            case {"do": "act" | "try", "action": action} if action is not None:
                form = self._check_turn(seat, message)["form"]
                self._check_action(action, form)
                if do == "act":
                    self._decide(action, "person")
                elif isinstance(self.exploring, Futures):
                    self.abandon()
                    self.exploring.add(action)
            case {"do": "delegate", "n": int(number)} if 0 <= number <= 100_000:
                self.delegated[seat or ("" if game.now is None else game.now["agent"])] = number
                self.skipping = None
            case {"do": "skip"}:
                self.skipping = seat
            case {"do": "undo"}:
                earlier = [turn for turn in game.turns_of(seat) if turn < game.turn]
                self._jump(person, max(earlier, default=0))
            case {"do": "redo"} if game.can_go_back:
                self._stop()
                game.go_back()
                self.event = f"{person} went back to the game before the restart."
            case {"do": "redo"}:
                later = [turn for turn in game.turns_of(seat) if turn > game.turn]
                self._jump(person, min(later, default=len(game.timeline)))
            case {"do": "jump", "n": int(turn)} if 0 <= turn <= len(game.timeline):
                self._jump(person, turn)
            case {"do": "restart", "n": int(seed)} if 0 <= seed < SEEDS:
                self._restart(person, seed)
            case {"do": "restart", "n": None}:
                self._restart(person, randbelow(SEEDS))
            case {"do": "again"} if game.over and (not seat or self.rules.tools != "facilitator"):
                self._restart(person, randbelow(SEEDS))
            case {"do": "horizon", "n": int() | float() as length} if 0 < length <= 1e9:
                by_time = message.get("by") == "time"
                self.abandon()
                hold = message.get("hold", 1)
                if hold is not None and not (type(hold) is int and 1 <= hold <= 100):
                    raise OptionValueError(f"hold must be 1 to 100 or null, not {short_repr(hold)}")
                length = length if by_time else min(int(length), 100)
                self._horizon = Horizon(by_time, length, hold)
                self.exploring = None
            case _:
                raise OptionValueError(f"the game cannot follow {short_repr(message)}")
        return True

    def _check_turn(self, seat: str, message: Message) -> Row:
        """Return the pending decision, if it is the one of a seat that its message means."""
        now = self.game.now
        if now is None or message.get("turn") != now["turn"]:
            raise InvalidActionError("another decision is pending by now")
        if now["agent"] != seat:
            raise InvalidActionError(f"it is not your turn: {now['agent']} decides")
        return now

    def _check_action(self, action: Any, form: Message) -> None:
        """Check an action as JSON, so that an illegal one does not end the exploration.

        Raises:
            InvalidActionError: It is not legal, with a text for people.
        """
        try:
            at_decision(self.game.env, "play", partial(check_legal, action))
        except InvalidActionError as error:
            complaint = complaint_about(form, action).get("text")
            raise InvalidActionError(complaint or str(error)) from error

    def _decide(self, action: Any, by: str) -> None:
        self.abandon()
        self.game.decide(action, by)
        self.event = ""

    def _jump(self, person: str, turn: int) -> None:
        game = self.game
        before = game.turn
        self._stop()
        game.jump(turn)
        if game.turn != before:
            way = "went back" if game.turn < before else "went on"
            place = "the end"
            if game.now is not None:
                when = self._when(game.now)
                place = f"decision {game.turn + 1}" + (f", {when}" if when else "")
            self.event = f"{person} {way} to {place}."

    def _restart(self, person: str, seed: int) -> None:
        self._stop()
        self.game.restart(seed)
        self.event = f"{person} began another game, with seed {seed}."

    def _when(self, row: Row) -> str:
        unit = self.rules.time_unit or "time"
        return "" if row["time"] is None else f"{unit} {shown(row['time'])}"

    def _start_clock(self) -> bool:
        """Begin the time limit of the pending decision, once a person is there."""
        limit = self.rules.limit
        moment = self.game.moment
        if limit is None or not self.occupied or self.game.now is None or self._timed == moment:
            return False
        self._timed = moment
        self.deadline = monotonic() + limit
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
        if self.exploring is None or self.exploring.moment != game.moment:
            self.abandon()
            if game.now is not None:
                game.make_checkpoint()
                self._start_clock()
            self._picture = picture_of(game.env) if game.over in ENDS else None
            self.exploring = self._explore()
        yield self.snapshot()
        if self.exploring is None:
            return
        if game.checkpoints:  # else the clones are of this thread
            self.exploring.start(self._tell)
        else:
            yield from self.exploring.explore()

    def _explore(self) -> Exploration | None:
        """Return the exploration of this moment: of futures, or at the end of the rule's game."""
        game = self.game
        if game.now is not None:
            here = game.checkpoints.get(game.turn)
            return Futures(game.env if here is None else here.env, game, game.now, self._horizon)
        if game.over not in ENDS:
            return None
        if game.checkpoints:
            first = game.checkpoints[min(game.checkpoints)]
            return Comparison(first.env, game, first.returns)
        env = game.make_env()
        env.reset(seed=game.seed)
        return Comparison(env, game, {})

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
        past = game.timeline[: game.turn]
        seats = [agent for agent in game.agents if game.plays(agent)]
        late = Counter(row["agent"] for row in game.timeline if row.get("by") == "limit")
        return {
            "type": "state",
            "title": self.rules.title,
            "time_unit": self.rules.time_unit,
            "tools": self.rules.tools,
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
            "history": [self._past(row) for row in past[-MOST_ROWS:]],
            "views": self._views(),
            "courses": self._courses(seats) if game.over else {},
            "left": self._seconds_left(),
            "late": late,
            "picture": self._picture,
            "notice": game.notice,
            "event": self.event,
            "back": game.can_go_back,
        }

    def _pending(self) -> Message | None:
        now = self.game.now
        if now is None:
            return None
        last = None
        for row in self.game.timeline[: self.game.turn]:
            if row["agent"] == now["agent"] and row["by"] == "person":
                last = row["action"]
        return now | {"when": self._when(now), "last": last}

    def _past(self, row: Row) -> Message:
        return {key: row[key] for key in ROW_KEYS} | {"when": self._when(row)}

    def _views(self) -> Message:
        """Return the latest situation of each agent, with the past values of its numbers."""
        rows = self.game.timeline[: self.game.turn + 1]
        views: Message = {}
        for row in reversed(rows[-MOST_VALUES * 16 :]):
            agent = row["agent"]
            if agent not in views and len(views) < MOST_SEATS:
                entries = [entry | {"past": []} for entry in row["situation"]]
                views[agent] = {"when": self._when(row), "situation": entries}
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
            totals = [row["before"] for row in self.game.timeline if row["agent"] == agent]
            courses[agent] = [*totals, self.game.returns.get(agent, 0.0)]
        return courses


def check_legal(action: Any, decision: Decision) -> None:
    """Raise an ``InvalidActionError`` if an action of a decision, as JSON, is not legal."""
    decision.validate(action_of(decision.action_space, action))


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
