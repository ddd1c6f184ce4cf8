"""A game: an episode with its past, and checkpoints to go back to."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

from ... import aec_env, clone
from ...core import EpisodeOptions, Point, Points, Policy
from ...envs import SimulationAECEnv
from ...errors import (
    InvalidActionError,
    OptionValueError,
    SimEnvError,
    describe_error,
    did_you_mean,
)
from ...files.lines import Lines
from ...files.reader import EpisodeLines, follow
from ...files.recipes import Json, recipe_of
from ...files.tapes import head_of
from ...files.values import encode_value
from ...simulation import Action, Model
from ..descriptions import at_decision
from .deciders import Deciders
from .forms import Message, action_of, jsonable, pending_decision, words_of
from .recording import answer_in, read

CHECKPOINTS: Final = 24
"""The largest number of checkpoints. Each one is a process."""

NOTED: Final = ("turn", "number", "words", "by", "time")
"""The keys of a decision that a recording has besides those of every file of an episode."""

REPEATED: Final = ("agent", "before", "seen", "time")
"""The keys of a decision that are the same when it is reached again."""


Row = Message
"""A decision of the game: a pending decision as JSON, and further keys.

``turn`` is its place in the timeline, and ``before`` the agent's return before it. Once it is
taken, it has its ``action`` as JSON (None for the rule), its ``words`` ("" for an unknown action of
the rule), its ``reward``, and who decided, ``by``: "person", "policy", "rule", or "limit" for the
rule after the time limit.
"""


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
        seats: The agents that people play; none: all agents without a policy.
        seed: The seed of the episode.
        points: The decision points, as ``aec_env`` takes them.
        policies: Policies of agents that no person plays, as ``simulate`` takes them.
        options: The options of ``aec_env``.
        record: The file of the recording. The last episode in it goes on.
        new: Whether to begin another episode instead.
        reset: The options of resets.
        can_fork: Whether checkpoints can be made. Else the way back is a replay.
        checkpoints: The checkpoints, by turn.
        episodes: The episodes, as the recording has them. The last one is played.
        resumed: Whether a recorded episode goes on.
        root: The environment that was made for the game.
        env: The environment at the pending decision: ``root`` or a clone.
        agents: The known agents, and the name of the policy that decides for each, or "".
        timeline: The decisions, also those after the pending one that were undone.
        turn: The place of the pending decision in the timeline.
        moment: A number that each change of the pending decision increases.
        over: Why the episode is over: "terminated", "truncated" or an error. "": it is not.
        returns: The return of each agent so far.
        latest: The turn of the latest decision of each agent.
        notice: A warning for the page.
    """

    simulation: Model
    name: str
    seats: Sequence[str]
    seed: int
    points: Points = None
    policies: Mapping[Any, Policy] = field(default_factory=dict)
    options: EpisodeOptions = field(default_factory=EpisodeOptions)
    record: Path | None = None
    new: bool = False
    reset: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        """Begin an episode, or go on with the recorded one.

        Raises:
            OptionValueError: An argument has an invalid value, or the episode cannot begin.
            StoreError: The recording cannot be read.
        """
        self.root = self.env = self.make_env()
        self.deciders = Deciders(self.simulation, self.policies, self.points, self.options)
        self.can_fork = True
        self.checkpoints: dict[int, Checkpoint] = {}
        self.timeline: list[Row] = []
        self.turn = 0
        self.moment = 0
        self.returns: dict[str, float] = {}
        self._unsaved: list[Json] = []  # the lines that could not be written yet
        self.episodes: list[EpisodeLines] = []
        if self.record is not None and self.record.exists() and not self.new:
            self.episodes = read(self.record)
        self.resumed = bool(self.episodes)
        if self.resumed and "play" not in self.episodes[-1].head:
            raise OptionValueError(
                f"{self.record} is no recording of a game: go on from there by `replay --play`"
            )
        if self.resumed and not self.seats:
            self.seats = self.episodes[-1].head["play"].get("seats", ())
        roster = self.root.session.plan.roster
        agents: list[str] = getattr(self.root, "possible_agents", [])
        for seat in set(self.seats).difference(agents or self.seats):
            raise OptionValueError(
                f"there is no agent {seat!r}; the agents are {agents}{did_you_mean(seat, agents)}"
            )
        self.agents: dict[str, str] = {}
        named = [key for key in self.policies if isinstance(key, str) and "." not in key]
        for agent in dict.fromkeys([*self.seats, *agents, *named]):
            self._meet(agent, roster.get(agent))
        if self.resumed:
            self._resume()
        else:
            self.restart(self.seed)
        if self.notice or (self.over and not self.resumed):
            raise OptionValueError(f"{self.name} cannot be played: {self.over or self.notice}")

    @property
    def now(self) -> Row | None:
        """The pending decision; None at the end."""
        return None if self.over else self.timeline[self.turn]

    @property
    def can_go_back(self) -> bool:
        """Whether nothing was decided since a restart."""
        return len(self.episodes) > 1 and not self.episodes[-1].decisions

    def make_env(self) -> SimulationAECEnv:
        """Make an environment of the game's simulation."""
        modes = aec_env(self.simulation, self.points).metadata["render_modes"]
        shown = [mode for mode in ("rgb_array", "ansi") if mode in modes]
        options = EpisodeOptions(render_mode=shown[0] if shown else None)
        return aec_env(self.simulation, self.points, **(options | self.options))

    def plays(self, agent: str) -> bool:
        """Return whether the agent's seat is for a person."""
        return agent in self.seats if self.seats else not self.agents.get(agent)

    def turns_of(self, seat: str) -> list[int]:
        """Return the turns of a seat; for "", the facilitator, those of all people."""
        is_own = (lambda agent: agent == seat) if seat else self.plays
        return [row["turn"] for row in self.timeline if is_own(row["agent"])]

    def close(self) -> None:
        """Close all environments."""
        self.forget(-1)
        self.env.close()
        self.root.close()

    # -- episodes ---------------------------------------------------------------------------------

    def restart(self, seed: int) -> None:
        """Begin another episode. ``go_back`` returns to the present one."""
        exits = self._begin(seed)
        self._record(self._head(), *exits)

    def go_back(self) -> None:
        """Return to the episode before the latest restart."""
        self._record({"back": True})
        self._load()

    def _head(self) -> Json:
        """Return the first line of the episode."""
        recipe: Json = {}
        if self.record is not None:  # whoever loads the file gives again what has no name
            recipe = recipe_of(self.root.session.plan, unnamed=True)
        game = {"simulation": self.name, "seats": list(self.seats)}
        return head_of(recipe, self.root.kind, self.seed, self.reset) | {"play": game}

    def _begin(self, seed: int) -> list[Json]:
        self.forget(-1)
        self.seed = seed
        self.notice = ""
        self.timeline = []
        return self._return_to(0)

    def _resume(self) -> None:
        """Go on with the last recorded episode.

        Raises:
            OptionValueError: The simulation does not repeat it.
        """
        problem = f"the recording {self.record} cannot be resumed"
        remedy = "begin another game by --new, or use another file"
        recorded, head = self.episodes[-1].head, self._head()
        pairs = {"simulation": (each["play"].get("simulation") for each in (recorded, head))}
        for key in ("skip_forced", "max_steps"):
            pairs[key] = (each["options"].get(key) for each in (recorded, head))
        for key, (before, now) in pairs.items():
            if str(before).replace(":", ".") != str(now).replace(":", "."):
                raise OptionValueError(f"{problem}: its {key} is {before}, not {now}; {remedy}")
        try:
            self._load()
        except InvalidActionError as error:
            raise OptionValueError(f"{problem}: {error}; {remedy}") from error

    def _load(self) -> None:
        """Repeat the decisions of the last episode.

        Raises:
            InvalidActionError: The simulation does not repeat it.
        """
        episode = self.episodes[-1]
        self._begin(episode.head["seed"])
        for line in episode.decisions:
            row = self.now
            if row is None or any(row[key] != line[key] for key in ("agent", "seen")):
                raise InvalidActionError(
                    f"the simulation does not repeat decision {line['turn']} of {line['agent']}"
                )
            if self.plays(row["agent"]) and not self.checkpoints:
                self.make_checkpoint()  # from which the rule's game begins
            self._take(answer_in(line), line["by"])
        if episode.turn != self.turn:
            self._go_to(episode.turn)

    def _record(self, *lines: Json) -> None:
        """Add lines to the episodes and their file, with those that could not be written before.

        The file is closed in between: clones need not copy it.
        """
        for line in lines:
            follow(self.episodes, 0, line)
        if self.record is None:
            return
        self._unsaved += lines
        try:
            Lines(self.record).append(*self._unsaved)
            self._unsaved.clear()
        except OSError as error:
            self.notice = f"The recording {self.record} cannot be written: {error}"

    # -- decisions --------------------------------------------------------------------------------

    def decide(self, action: Action, by: str) -> None:
        """Take the pending decision.

        Args:
            action: The action as JSON; None for the rule.
            by: The origin of the decision, as in ``Row``.

        Raises:
            InvalidActionError: The action is not legal. The decision stays pending.
        """
        space = self.env.action_space(self.timeline[self.turn]["agent"])
        row, exits = self._take(action, by)
        line = {key: row[key] for key in ("agent", "seen", "mask") if row[key] is not None}
        line["action"] = encode_value(action_of(space, action))
        line["play"] = {key: row[key] for key in NOTED}
        lines = [line, *exits]
        if self.over:
            key = "end" if self.over in ("terminated", "truncated") else "error"
            lines.append({key: self.over, "play": {"returns": {**self.returns}}})
            absent = [seat for seat in self.seats if seat not in self.latest]
            if absent:
                names = ", ".join(absent)
                others = ", ".join(self.latest)
                self.notice = f"No decision was one of {names}; {others} decided."
        self._record(*lines)

    def answer(self) -> None:
        """Take the pending decision by the policy of its agent, or else by the rule."""
        agent = self.timeline[self.turn]["agent"]
        is_policy = bool(self.agents[agent])
        try:
            action = self.deciders.answer(self.env) if is_policy else None
            self.decide(action, "policy" if is_policy else "rule")
        except InvalidActionError as error:
            self._fail(f"the policy of {agent} has answered illegally: {error}")
        except Exception as error:
            self._fail(f"the policy of {agent} has failed: {describe_error(error)}")

    def _take(self, action: Action, by: str) -> tuple[Row, list[Json]]:
        """Take the pending decision. Return its row, and the lines of ended agents."""
        row = self.timeline[self.turn]
        self._step(row["agent"], action)
        self.forget(self.turn)
        del self.timeline[self.turn + 1 :]
        words = "" if action is None else words_of(row["form"], action)
        row |= {"action": action, "by": by, "words": words, "reward": None}
        return row, self._arrive(self.turn + 1)

    def _step(self, agent: str, action: Action) -> None:
        self._attempt(self.env.step, action_of(self.env.action_space(agent), action))

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
            self._fail(describe_error(error))
            return None

    def _fail(self, problem: str) -> None:
        self.over = problem
        self.moment += 1

    # -- the way back -----------------------------------------------------------------------------

    def jump(self, turn: int) -> None:
        """Go to the end, or to the latest decision of a person up to a turn."""
        before = self.turn
        stops = self.turns_of("")
        stops += [len(self.timeline)] if "action" in self.timeline[-1] else []
        earlier = [stop for stop in stops if stop <= turn]
        self._go_to(max(earlier, default=min(stops, default=0)))
        if self.turn != before:
            self._record({"turn": self.turn})

    def _go_to(self, turn: int) -> None:
        """Go to a turn from the nearest checkpoint, or from the beginning."""
        starts = [start for start in self.checkpoints if start <= turn]
        self._return_to(max(starts, default=0))
        for row in self.timeline[self.turn : turn]:
            if self.over or self.timeline[self.turn] is not row:
                break  # the simulation does not repeat itself
            self._step(row["agent"], row["action"])
            self._arrive(self.turn + 1)

    def forget(self, turn: int) -> None:
        """Close the checkpoints after a turn."""
        for later in [start for start in self.checkpoints if start > turn]:
            self.checkpoints.pop(later).env.close()

    def make_checkpoint(self) -> None:
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

    def _return_to(self, turn: int) -> list[Json]:
        """Continue at a checkpoint. The beginning needs none."""
        previous = self.env
        self.over = ""
        self.latest = {row["agent"]: row["turn"] for row in self.timeline[:turn]}
        if turn in self.checkpoints:
            checkpoint = self.checkpoints[turn]
            self.env = clone(checkpoint.env)
            self.returns = {**checkpoint.returns}
        else:
            self.env = self.root
            self.returns = {}
            self._attempt(self.root.reset, self.seed, self.reset)
        if previous is not self.root:
            previous.close()
        return self._arrive(turn)

    # -- arrivals ---------------------------------------------------------------------------------

    def _arrive(self, turn: int) -> list[Json]:
        """Note the reward of the agent that decides next. Return the lines of ended agents."""
        exits: list[Json] = []
        self.turn = turn
        self.moment += 1
        end = "terminated"
        while self.env.agents and not self.over:
            agent = self.env.agent_selection
            _, reward, terminated, truncated, info = self.env.last(observe=False)
            self._add_reward(agent, reward, info)
            if not (terminated or truncated):
                self._note_pending(agent)
                return exits
            end = "truncated" if truncated else "terminated"
            self.env.step(None)
            exits.append({"exit": agent})
        self.over = self.over or end
        return exits

    def _add_reward(
        self,
        agent: str,
        reward: float,
        info: Mapping[str, Any],
    ) -> None:
        """Add the reward of an agent's previous decision to its return."""
        self.returns.setdefault(agent, 0.0)
        if agent not in self.latest:
            return
        row = self.timeline[self.latest[agent]]
        row["reward"] = reward
        self.returns[agent] = row["before"] + reward
        if row.get("action", "") is None and "rule_action" in info:
            row["words"] = words_of(row["form"], jsonable(info["rule_action"]))

    def _note_pending(self, agent: str) -> None:
        """Note the pending decision in the timeline, which may have it with its action."""
        row: Row | None = self._attempt(at_decision, self.env, "play", pending_decision)
        if row is None:
            return
        row |= {"turn": self.turn, "before": self.returns[agent]}
        former = self.timeline[self.turn] if self.turn < len(self.timeline) else row
        if any(row[key] != former[key] for key in REPEATED):
            del self.timeline[self.turn :]
            self.notice = (
                "The simulation does not repeat itself: its randomness does not all come from the"
                " seed."
            )
        if self.turn == len(self.timeline):
            self.timeline.append(row)
        self.latest[agent] = self.turn
        if agent not in self.agents:
            self._meet(agent, self.env.episode.agents[agent].point)

    def _meet(self, agent: str, point: Point | None) -> None:
        self.agents[agent] = self.deciders.name_for(agent, "" if point is None else point.hook.name)
