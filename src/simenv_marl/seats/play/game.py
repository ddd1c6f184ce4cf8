"""The process with the simulation: its decisions, checkpoints to go back to, and futures while people think.

A message from the server has the number of a connection, its seat (None: the server itself), and a
dict from the page (None: the end). Each is answered with the number, and with an error or None;
what all see has the number None. What takes time is a generator, which is left between two steps of
the simulation when a message has come.
"""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import closing, suppress
from itertools import islice
from pathlib import Path
from time import monotonic
from typing import Any, Final

import numpy as np

from ... import RULE, aec_env, clone
from ...errors import (
    InvalidActionError,
    OptionValueError,
    SimEnvError,
    describe_error,
    did_you_mean,
    short_repr,
)
from .forms import (
    MOST,
    action_of,
    candidates_of,
    entries_of,
    jsonable,
    pending_decision,
    picture_of,
    write,
)

FUTURES: Final = 16  # in which each candidate is tried out
CHECKPOINTS: Final = 24  # at most: each is a process
SHOWN: Final = 150  # decisions that the page gets

# a decision, as the page and the recording have it; "before" is the agent's return before it
Row = dict[str, Any]


class Game:
    """An episode with its past: a line of decisions, a place in it, and checkpoints."""

    def __init__(
        self,
        simulation: Any,
        *,
        name: str,
        seats: Sequence[str],
        seed: int,
        limit: float | None,
        record: Path | None,
    ) -> None:
        """Begin an episode. Without ``seats``, people play all agents."""
        if limit is not None and not 0 < limit < 1e6:
            raise OptionValueError(f"limit must be a positive number of seconds, not {limit}")
        modes = aec_env(simulation).metadata["render_modes"]
        mode = next((mode for mode in ("rgb_array", "ansi") if mode in modes), None)
        self.root = aec_env(simulation, render_mode=mode)
        known: list[str] = getattr(self.root, "possible_agents", [])
        for seat in set(seats).difference(known or seats):
            raise OptionValueError(
                f"there is no agent {seat!r}; the agents are {known}{did_you_mean(seat, known)}"
            )
        self.name, self.given, self.limit, self.record = name, seats, limit, record
        self.known = dict.fromkeys(self.given or known)
        self.taken: Collection[str] = ()  # the seats that people have
        self.late: Counter[str] = Counter()  # decisions that the rule took because of the limit
        self.checkpoints: dict[int, Any] = {}
        self.ends: dict[str, tuple[int, float]] = {}  # of agents: when, and their returns
        self.env, self.horizon, self.forks = self.root, 8, True
        self.restart(seed)
        if self.failure or self.notice:
            raise OptionValueError(f"{name} cannot be played: {self.failure or self.notice}")

    def restart(self, seed: int) -> None:
        """Begin another episode."""
        self.forget(-1)
        self.seed, self.notice = seed, ""
        self.line: list[Row] = []
        # how many decisions of a seat are left to the rule
        self.delegated: Counter[str] = Counter()
        self.skipping: str | None = None  # the seat for whose next decision the rule plays on
        self._return_to(None)
        head = {"simulation": self.name, "seed": seed, "seats": list(self.known)}
        self.notice = write(self.record, head) or self.notice

    def decide(self, action: Any, by: str) -> None:
        """Take the pending decision, by JSON or None for the rule.

        After an ``InvalidActionError``, it is pending.
        """
        row = self.line[self.turn]
        self._step(row["agent"], action)
        self.forget(self.turn)
        del self.line[self.turn + 1 :]
        row |= {"action": action, "by": by, "reward": None}
        kept = {key: row[key] for key in ("turn", "agent", "action", "by", "seen", "time")}
        self._arrive(self.turn + 1)
        end = {"end": self.over, "returns": self.returns()} if self.over else {}
        absent = [seat for seat in self.given if seat not in self.latest]
        if self.over and absent:
            self.notice = (
                f"No decision was one of {', '.join(absent)}; {', '.join(self.latest)} decided."
            )
        self.notice = write(self.record, kept | end) or self.notice

    def jump(self, turn: int) -> None:
        """Go to the end, or to a person's decision at or before a turn: from a checkpoint, or from the beginning."""
        persons = [row["turn"] for row in self.line if self.plays(row["agent"])]
        if turn < len(self.line) or "action" not in self.line[-1]:
            turn = max(
                (place for place in persons if place <= turn), default=min(persons, default=0)
            )
        self._return_to(max((key for key in self.checkpoints if key <= turn), default=None))
        for row in self.line[self.turn : turn]:
            if not self.over and self.line[self.turn] is row:  # else it does not repeat itself
                self._step(row["agent"], row["action"])
                self._arrive(self.turn + 1)
        self.delegated, self.skipping = Counter(), None

    def forget(self, turn: int) -> None:
        """Close the checkpoints after a turn."""
        for later in [key for key in self.checkpoints if key > turn]:
            self.checkpoints.pop(later).close()

    def plays(self, agent: str) -> bool:
        """Whether the agent's seat is for a person."""
        return not self.given or agent in self.given

    def returns(self) -> dict[str, float]:
        """The return of each agent so far."""
        going = {agent: self.line[place]["before"] for agent, place in self.latest.items()}
        return going | {agent: total for agent, (_, total) in self.ends.items()}

    def _step(self, agent: str, action: Any) -> None:
        self._attempt(
            self.env.step,
            RULE if action is None else action_of(self.env.action_space(agent), action),
        )

    def _attempt(self, function: Callable[..., Any], argument: Any) -> Any:
        """Call a function of the environment.

        An error ends the episode, unless it refuses an action.
        """
        try:
            return function(argument)
        except InvalidActionError:
            raise
        except Exception as error:
            self.failure = describe_error(error)

    def _return_to(self, key: int | None) -> None:
        """Continue at a checkpoint, or at the beginning."""
        old, self.env = self.env, self.root if key is None else clone(self.checkpoints[key])
        self.ends = (
            {} if key is None else {agent: end for agent, end in self.ends.items() if end[0] <= key}
        )
        self.latest: dict[str, int] = {row["agent"]: row["turn"] for row in self.line[: key or 0]}
        self.failure = ""
        if key is None:
            self._attempt(self.root.reset, self.seed)
        if old is not self.root:
            old.close()
        self._arrive(key or 0)

    def _arrive(self, turn: int) -> None:
        """Stand at a turn, which is pending or the end: reward who acted before, and let agents go that have ended."""
        env, self.turn, self.over = self.env, turn, self.failure
        self.now: dict[str, Any] | None = None
        self.deadline: float | None = None
        self.fan: list[dict[str, Any]] = []
        self.told: dict[str, Any] = {"note": ""}  # with the rule's action, if it is known
        self.picture: dict[str, Any] | None = None
        while env.agents and not self.failure:
            agent = env.agent_selection
            _, reward, terminated, truncated, _ = env.last(observe=False)
            before = self._reward(agent, reward)
            if not (terminated or truncated):
                self.now = self._attempt(env.unwrapped.call, pending_decision)
                self.over = self.failure
                if self.now is not None:
                    self._stand_at({"turn": turn, "agent": agent, "before": before}, self.now)
                break
            self.ends[agent] = turn, before
            self.over = "truncated" if truncated else "terminated"
            env.step(None)

    def _stand_at(self, row: Row, now: dict[str, Any]) -> None:
        """Note the pending decision in the line, where it may be already, with its action."""
        turn, agent = row["turn"], row["agent"]
        row |= {
            "seen": now["seen"],
            "time": now["time"],
            "values": [value for _, value in now["observation"][:MOST]],
        }
        there = self.line[turn : turn + 1]
        if there != [(there[0] if there else {}) | row]:
            self.line[turn:] = [row]
            if there:
                self.notice = "The simulation does not repeat itself: its randomness does not all come from the seed."
        self.latest[agent] = turn
        self.known |= {} if self.given else {agent: None}

    def _reward(self, agent: str, reward: float) -> float:
        """Add the reward of an agent's previous action to it, and return the agent's return."""
        if agent not in self.latest:
            return 0.0
        row = self.line[self.latest[agent]]
        row["reward"] = reward
        return float(row["before"] + reward)

    # -- messages ----------------------------------------------------------------------------------

    def serve(self, connection: Any) -> None:
        """Answer messages until the connection is closed."""
        work, working = self.work(), True
        while True:
            update = next(work, {"type": "done"}) if working else None
            working = working and (update is None or update["type"] != "done")
            if working and update is not None:
                connection.send((None, update))
            left = None if self.deadline is None else max(0.0, self.deadline - monotonic())
            if self.now is not None and left == 0:
                self.late[self.now["agent"]] += 1
                self.decide(None, "limit")
            elif connection.poll(0 if working else left):
                number, seat, message = connection.recv()
                if message is None:
                    self.root.close()
                    return
                reply: dict[str, Any] | None = None
                try:
                    changed = self.handle(seat, message)
                except Exception as error:
                    text = str(error) if isinstance(error, SimEnvError) else describe_error(error)
                    reply, changed = (
                        {"type": "error", "text": text},
                        not isinstance(error, ValueError),
                    )
                connection.send((number, reply))
                if not changed:
                    continue
            else:
                continue
            work, working = self.work(), True

    def handle(self, seat: str | None, message: dict[str, Any]) -> bool:
        """Do what a message says; return whether this has changed the game."""
        do = message.get("do")
        if seat is None:
            self.taken = message["taken"]
            self._set_deadline()
            return self.skipping is not None
        if do in ("act", "rule", "try"):
            if self.now is None or message.get("turn") != self.turn:
                raise InvalidActionError("another decision is pending by now")
            if self.now["agent"] != seat:
                raise InvalidActionError(f"it is not your turn: {self.now['agent']} decides")
            action = message.get("action") if do != "rule" else None
            if action is None and do != "rule":
                raise InvalidActionError("the message has no action")
            if do == "try":
                self._try(action)
            else:
                self.decide(action, "person" if do == "act" else "rule")
        elif do == "delegate":
            self.delegated[seat], self.skipping = _whole(message, 0, 100_000), None
        elif do == "skip":
            self.skipping = seat
        elif do in ("undo", "redo"):
            own = [
                row["turn"]
                for row in self.line
                if row["agent"] == seat and row["turn"] != self.turn
            ]
            before = max((turn for turn in own if turn < self.turn), default=0)
            self.jump(
                before
                if do == "undo"
                else min((t for t in own if t > self.turn), default=len(self.line))
            )
        elif do == "jump":
            self.jump(_whole(message, 0, len(self.line)))
        elif do == "restart":
            self.restart(_whole(message, 0, 2**31 - 1))
        elif do == "horizon":
            self.horizon, self.fan = _whole(message, 1, 100), []
        else:
            raise OptionValueError(f"the game does not know {short_repr(do)}")
        return True

    def _try(self, action: Any) -> None:
        """Add a candidate, if it is legal."""
        with closing(clone(self.env)) as twin:
            twin.step(action_of(twin.action_space(twin.agent_selection), action))
        if len(self.fan) < MOST and all(known["action"] != action for known in self.fan):
            self.fan.append({"action": action, "courses": []})

    def _set_deadline(self) -> None:
        """Give the person whose decision is pending the time of the limit, which begins when a person is there."""
        if self.limit and self.now is not None and self.deadline is None and self.taken:
            self.deadline = monotonic() + self.limit

    # -- what takes time ---------------------------------------------------------------------------

    def work(self) -> Iterator[dict[str, Any] | None]:
        """Let the rule decide where no person does.

        Then show the decision, and try out what may be decided.
        """
        shown = monotonic()
        while self.now is not None and self._leaves_to_rule(self.now["agent"]):
            self.decide(None, "rule")
            yield None
            if monotonic() > shown + 0.2:
                shown = monotonic()
                yield self.snapshot()
        if self.now is not None:
            if self.forks and self.turn not in self.checkpoints:
                self._keep()
            space = self.env.action_space(self.now["agent"])
            listed = [None, *candidates_of(space, self.now["mask"])]
            self.fan = self.fan or [{"action": action, "courses": []} for action in listed]
            self._set_deadline()
        self.picture = None if self.failure else picture_of(self.env)
        yield self.snapshot()
        if self.now is not None:
            yield from self._think(self.now["agent"])

    def _leaves_to_rule(self, agent: str) -> bool:
        if not self.plays(agent):
            return True
        if self.skipping == agent:
            self.skipping = None
        if self.delegated[agent]:
            self.delegated[agent] -= 1
            return True
        return self.skipping is not None and agent not in self.taken

    def _keep(self) -> None:
        """Keep a checkpoint of the pending decision. The older they are, the fewer are kept."""
        try:
            self.checkpoints[self.turn] = clone(self.env, method="fork")
        except SimEnvError:
            self.forks = False  # from now on, the way back is a replay
        for key in (
            sorted(self.checkpoints)[1 : CHECKPOINTS // 2 : 2]
            if len(self.checkpoints) > CHECKPOINTS
            else ()
        ):
            self.checkpoints.pop(key).close()

    def _think(self, agent: str) -> Iterator[dict[str, Any] | None]:
        """Try out the candidates, in futures that are the same for all of them."""
        seeds: list[Any] = [
            (self.seed * 1_000_003 + self.turn * 1009 + place) % 2**31 for place in range(FUTURES)
        ]
        try:
            clone(self.env, seed=seeds[0]).close()
        except Exception as error:
            self.told["note"], seeds = f"One future, in which chance is known: {error!s}", [None]
        for place, seed in enumerate(seeds):
            for candidate in [one for one in self.fan if len(one["courses"]) <= place]:
                course: list[list[float]] = []
                try:
                    yield from self._play_future(agent, candidate["action"], seed, course)
                except Exception as error:
                    self.told["note"] = f"A future has failed: {describe_error(error)[:300]}"
                candidate["courses"].append(
                    course or [[0.0, *self._measured(self.env.observe(agent))]]
                )
            yield self._fans()

    def _play_future(
        self, agent: str, action: Any, seed: int | None, course: list[list[float]]
    ) -> Iterator[None]:
        """Play a future.

        Yield after each step. Add to the course, after each decision of the agent, what is
        measured.

        This is the agent's return, and the numbers that it observes.
        """
        with closing(clone(self.env, seed=seed, time_limit=30.0)) as twin:
            twin.step(RULE if action is None else action_of(twin.action_space(agent), action))
            while twin.agents:
                name = twin.agent_selection
                observation, reward, terminated, truncated, info = twin.last(observe=name == agent)
                ended = terminated or truncated
                if name == agent:
                    before = course[-1][0] if course else 0.0
                    course.append([before + reward, *self._measured(observation)])
                    if action is None and "rule_action" in info:
                        self.told.setdefault("rule", jsonable(info["rule_action"]))
                    if ended or len(course) >= self.horizon:
                        return
                yield
                twin.step(None if ended else RULE)

    def _measures(self) -> dict[int, str]:
        """Return the names of the numbers in the pending decision's observation, by their places in it."""
        entries = enumerate(self.now["observation"] if self.now else ())
        numbers = ((place, name) for place, (name, value) in entries if type(value) in (int, float))
        return dict(islice(numbers, MOST))

    def _measured(self, observation: Any) -> list[float]:
        values = entries_of(observation)
        return [float(values[place][1]) for place in self._measures()]

    def _fans(self) -> dict[str, Any]:
        """Return the median and the 80 % band of each candidate after each decision, for all that is measured."""
        fans = []
        for candidate in self.fan:
            courses = [
                course + course[-1:] * (self.horizon - len(course))
                for course in candidate["courses"]
            ]
            numbers = np.nan_to_num(courses)
            bands = (
                np.quantile(numbers, (0.1, 0.5, 0.9), axis=0).transpose(2, 0, 1).round(6).tolist()
                if courses
                else []
            )
            fans.append({"action": candidate["action"], "n": len(courses), "bands": bands})
        shown = {"measures": ["return", *self._measures().values()], "candidates": fans}
        return {"type": "fan", "turn": self.turn, "horizon": self.horizon} | shown | self.told

    def snapshot(self) -> dict[str, Any]:
        """Return all that the page shows but the futures, as JSON."""
        return {
            "type": "state",
            "simulation": self.name,
            "seed": self.seed,
            "seats": list(self.known),
            "turn": self.turn,
            "length": len(self.line) - (bool(self.line) and "action" not in self.line[-1]),
            "pending": self.now,
            "over": self.over,
            "returns": self.returns(),
            "history": self.line[max(0, self.turn - SHOWN) : self.turn + 1],
            "left": None if self.deadline is None else max(0.0, self.deadline - monotonic()),
            "late": self.late,
            "picture": self.picture,
            "notice": self.notice,
        }


def _whole(message: Mapping[str, Any], low: int, high: int) -> int:
    """Return the number ``n`` of a message, or raise ``OptionValueError``."""
    value = message.get("n")
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise OptionValueError(
            f"n must be a whole number from {low} to {high}, not {short_repr(value)}"
        )
    return value


def run_game(connection: Any, find: Callable[[], Any], options: dict[str, Any]) -> None:
    """Play in this process, which the server has started, until it closes the connection."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the server ends this process
    try:
        game = Game(find(), **options)
    except Exception as error:
        text = str(error) if isinstance(error, SimEnvError) else describe_error(error)
        connection.send((None, {"type": "failed", "text": text}))
        return
    with suppress(EOFError, ConnectionError):
        game.serve(connection)
