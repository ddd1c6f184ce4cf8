"""A game: an episode with its past, and checkpoints to go back to."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple, NotRequired, TypedDict

from ... import aec_env, clone
from ...core import EpisodeOptions, Points, Policy
from ...envs import SimulationAECEnv
from ...errors import (
    InvalidActionError,
    OptionValueError,
    SimEnvError,
    describe_error,
    did_you_mean,
)
from ...simulation import Action, Model
from ..descriptions import at_decision
from .deciders import Deciders
from .forms import Message, action_of, jsonable, pending_decision, words_of
from .recording import Episode, Recorder, read

CHECKPOINTS: Final = 24
"""The largest number of checkpoints. Each one is a process."""

RECORDED: Final = ("turn", "agent", "number", "action", "words", "by", "seen", "time")
"""The keys of a decision in a recording."""

REPEATED: Final = ("agent", "before", "seen", "time")
"""The keys of a decision that are the same when it is reached again."""


class Row(TypedDict):
    """A decision of the game, as JSON."""

    turn: int
    agent: str
    number: int
    """The number of the decision among those of its agent, from 1."""
    before: float
    """The agent's return before the decision."""
    seen: str
    """The digest of the observation."""
    time: float | None
    situation: list[Message]
    form: Message
    action: NotRequired[Action]
    """The action as JSON; None for the rule. A pending decision has none."""
    by: NotRequired[str]
    """Who decided: "person", "policy", "rule", or "limit" for the rule after the time limit."""
    words: NotRequired[str]
    """The action in the words of the decision. Of the rule, "" until its action is known."""
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
        seats: The agents that people play; none: all agents without a policy.
        seed: The seed of the episode.
        points: The decision points, as ``aec_env`` takes them.
        policies: Policies of agents that no person plays, as ``simulate`` takes them.
        options: The options of ``aec_env``.
        record: The file of the recording. The last episode in it goes on.
        new: Whether to begin another episode instead.
        can_fork: Whether checkpoints can be made. Else the way back is a replay.
        checkpoints: The checkpoints, by turn.
        resumed: Whether a recorded episode goes on.
        root: The environment that was made for the game.
        env: The environment at the pending decision: ``root`` or a clone.
        agents: The known agents, and the name of the policy that decides for each, or "".
        timeline: The decisions, also those after the pending one that were undone.
        turn: The place of the pending decision in the timeline.
        moment: A number that each change of the pending decision increases.
        now: The pending decision as JSON; None at the end.
        over: Why the episode is over: "terminated", "truncated" or an error. "": it is not.
        returns: The return of each agent so far.
        latest: The turn of the latest decision of each agent.
        previous: The episode before the latest restart, until a decision is taken.
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
    can_fork: bool = True
    checkpoints: dict[int, Checkpoint] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Begin an episode, or go on with the recorded one.

        Raises:
            OptionValueError: An argument has an invalid value, or the episode cannot begin.
            StoreError: The recording cannot be read.
        """
        self.root = self.env = self.make_env()
        self.deciders = Deciders(self.simulation, self.policies, self.points, self.options)
        recorded = []
        if self.record is not None and self.record.exists() and not self.new:
            recorded = read(self.record)
        self.resumed = bool(recorded)
        if recorded and not self.seats:
            self.seats = recorded[-1].header.get("seats", ())
        roster = self.root.session.plan.roster
        agents: list[str] = getattr(self.root, "possible_agents", [])
        for seat in set(self.seats).difference(agents or self.seats):
            raise OptionValueError(
                f"there is no agent {seat!r}; the agents are {agents}{did_you_mean(seat, agents)}"
            )
        self.agents: dict[str, str] = {}
        named = [key for key in self.policies if isinstance(key, str) and "." not in key]
        for agent in dict.fromkeys([*self.seats, *agents, *named]):
            point = roster.get(agent)
            self._meet(agent, "" if point is None else point.hook.name)
        self.recorder = None if self.record is None else Recorder(self.record)
        self.previous: Episode | None = None
        self.timeline: list[Row] = []
        self.turn = 0
        self.moment = 0
        self.now: Message | None = None
        if recorded:
            self._resume(recorded)
        else:
            self.restart(self.seed)
            self.previous = None
        if self.notice or (self.over and not recorded):
            raise OptionValueError(f"{self.name} cannot be played: {self.over or self.notice}")

    def make_env(self) -> SimulationAECEnv:
        """Make an environment of the game's simulation."""
        modes = aec_env(self.simulation, self.points).metadata["render_modes"]
        shown = [mode for mode in ("rgb_array", "ansi") if mode in modes]
        options = EpisodeOptions(render_mode=shown[0] if shown else None)
        return aec_env(self.simulation, self.points, **(options | self.options))

    def plays(self, agent: str) -> bool:
        """Return whether the agent's seat is for a person."""
        return agent in self.seats if self.seats else not self.agents.get(agent)

    def close(self) -> None:
        """Close all environments."""
        self.forget(-1)
        self.env.close()
        self.root.close()

    # -- episodes ---------------------------------------------------------------------------------

    def restart(self, seed: int) -> None:
        """Begin another episode. ``go_back`` returns to the present one."""
        lines = [line_of(row) for row in self.timeline if "action" in row]
        self.previous = Episode(self._header(), lines, self.turn)
        self._begin(seed)
        self._record(self._header())

    def go_back(self) -> None:
        """Return to the episode before the latest restart."""
        if self.previous is not None:
            previous, self.previous = self.previous, None
            self._load(previous)
            self._record({"back": True, "turn": self.turn})

    def _header(self) -> Message:
        header: Message = {"simulation": self.name, "seed": self.seed, "seats": list(self.seats)}
        for name, value in self.options.items():
            if name in ("skip_forced", "max_steps"):
                header[name] = value
        return header

    def _begin(self, seed: int) -> None:
        self.forget(-1)
        self.seed = seed
        self.notice = ""
        self.timeline = []
        self._return_to(0)

    def _resume(self, episodes: list[Episode]) -> None:
        """Go on with the last recorded episode.

        Raises:
            OptionValueError: The simulation does not repeat it.
        """
        latest = episodes[-1]
        problem = f"the recording {self.record} cannot be resumed"
        remedy = "begin another game by --new, or use another file"
        header = self._header()
        for key in ("simulation", "skip_forced", "max_steps"):
            recorded, present = latest.header.get(key), header.get(key)
            if str(recorded).replace(":", ".") != str(present).replace(":", "."):
                raise OptionValueError(
                    f"{problem}: its {key} is {recorded}, not {present}; {remedy}"
                )
        try:
            self._load(latest)
        except InvalidActionError as error:
            raise OptionValueError(f"{problem}: {error}; {remedy}") from error
        if len(episodes) > 1 and not latest.decisions:
            self.previous = episodes[-2]

    def _load(self, episode: Episode) -> None:
        """Repeat the decisions of an episode.

        Raises:
            InvalidActionError: The simulation does not repeat it.
        """
        self._begin(episode.header["seed"])
        for line in episode.decisions:
            row = None if self.now is None else self.timeline[self.turn]
            if row is None or (row["agent"], row["seen"]) != (line["agent"], line["seen"]):
                raise InvalidActionError(
                    f"the simulation does not repeat decision {line['turn']} of {line['agent']}"
                )
            self._take(line["action"], line["by"])
        if episode.turn != self.turn:
            self._go_to(episode.turn)

    # -- decisions --------------------------------------------------------------------------------

    def decide(self, action: Action, by: str) -> None:
        """Take the pending decision.

        Args:
            action: The action as JSON; None for the rule.
            by: The origin of the decision, as in ``Row``.

        Raises:
            InvalidActionError: The action is not legal. The decision stays pending.
        """
        line = line_of(self._take(action, by))
        self.previous = None
        if self.over:
            line |= {"end": self.over, "returns": self.returns}
            absent = [seat for seat in self.seats if seat not in self.latest]
            if absent:
                names = ", ".join(absent)
                others = ", ".join(self.latest)
                self.notice = f"No decision was one of {names}; {others} decided."
        self._record(line)

    def answer(self) -> None:
        """Take the pending decision by the policy of its agent, or else by the rule."""
        row = self.timeline[self.turn]
        action: Action = None
        by = "rule"
        if self.agents.get(row["agent"]):
            by = "policy"
            try:
                action = self.deciders.answer(self.env)
            except Exception as error:
                self._fail(f"the policy of {row['agent']} has failed: {describe_error(error)}")
                return
        try:
            self.decide(action, by)
        except InvalidActionError as error:
            self._fail(f"the policy of {row['agent']} has answered illegally: {error}")

    def _take(self, action: Action, by: str) -> Row:
        row = self.timeline[self.turn]
        self._step(row["agent"], action)
        self.forget(self.turn)
        del self.timeline[self.turn + 1 :]
        words = "" if action is None else words_of(row["form"], action)
        row |= {"action": action, "by": by, "words": words, "reward": None}
        self._arrive(self.turn + 1)
        return row

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
            self._fail(describe_error(error))
            return None

    def _fail(self, problem: str) -> None:
        self.over = problem
        self.now = None
        self.moment += 1

    # -- the way back -----------------------------------------------------------------------------

    def jump(self, turn: int) -> None:
        """Go to the end, or to the latest decision of a person up to a turn."""
        before = self.turn
        if turn < len(self.timeline) or "action" not in self.timeline[-1]:
            stops = [row["turn"] for row in self.timeline if self.plays(row["agent"])] or [0]
            earlier = [stop for stop in stops if stop <= turn]
            turn = max(earlier, default=stops[0])
        self._go_to(turn)
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

    # -- arrivals ---------------------------------------------------------------------------------

    def _arrive(self, turn: int) -> None:
        """Note the reward of the agent that decides next, and the agents that have ended."""
        self.turn = turn
        self.moment += 1
        self.now = None
        end = ""
        while self.env.agents and not self.over:
            agent = self.env.agent_selection
            _, reward, terminated, truncated, info = self.env.last(observe=False)
            self._add_reward(agent, reward, info)
            if not (terminated or truncated):
                self._note_pending(agent)
                return
            end = "truncated" if truncated else "terminated"
            self.env.step(None)
        self.over = self.over or end

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
        pending = self._attempt(at_decision, self.env, "play", pending_decision)
        if pending is None:
            return
        row: Row = {
            "turn": self.turn,
            "agent": agent,
            "number": pending["number"],
            "before": self.returns[agent],
            "seen": pending["seen"],
            "time": pending["time"],
            "situation": pending["situation"],
            "form": pending["form"],
        }
        if self.turn < len(self.timeline):
            former = self.timeline[self.turn]
            if any(row[key] != former[key] for key in REPEATED):
                del self.timeline[self.turn :]
                self.notice = (
                    "The simulation does not repeat itself: its randomness does not all come from"
                    " the seed."
                )
        if self.turn == len(self.timeline):
            self.timeline.append(row)
        self.now = pending
        self.latest[agent] = self.turn
        if agent not in self.agents:
            deciding = self.env.episode.agents[agent]
            self._meet(agent, deciding.point.hook.name)

    def _meet(self, agent: str, point: str) -> None:
        self.agents[agent] = self.deciders.name_for(agent, point)

    def _record(self, line: Message) -> None:
        if self.recorder is not None:
            self.notice = self.recorder.add(line) or self.notice


def line_of(row: Row) -> Message:
    """Return the line of a decision in a recording."""
    return {key: value for key, value in row.items() if key in RECORDED}
