"""Episodes as files: an environment is saved, and another process goes on from the same decision.

A file has a line of JSON for the recipe of the environment, and one for each answer::

    {"episode": 1, "view": "aec", "seed": 7, "simulation": {"name": "shop.Shop"}, ...}
    {"agent": "buyer_0", "seen": "3f0b...", "action": 2}
    {"agent": "seller_0", "seen": "91d2...", "mask": "77ac...", "action": 0, "by": "policy"}
    {"exit": "buyer_0"}
    {"agent": "buyer_1", "seen": "b60e..."}

``seen`` and ``mask`` are digests of the observation and of the legal actions. The last line is the
pending decision, the end, or the error of the model.
"""

from __future__ import annotations

import os
from collections import deque
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple, Unpack
from uuid import uuid4

from .core import (
    GO_ON,
    Branched,
    DeferredPolicy,
    Mode,
    Model,
    Plan,
    Points,
    Recording,
    Replay,
    Reseeded,
    Session,
    ViewOptions,
    Where,
    preserve_generators,
    same,
)
from .envs import VIEWS
from .envs.single import PlannerEnv, plan_of
from .errors import (
    EpisodeFileError,
    SimEnvError,
    StoreError,
    ViewError,
    close_after,
    describe_error,
    short_repr,
)
from .files.lines import Lines, to_line
from .files.reader import malformed, read_episodes
from .files.recipes import FORMAT, Json, arguments_of, changes_since, recipe_of
from .files.tapes import FileTape, end_of, head_of, recorder
from .files.values import decode_value
from .simulation import Action, Sentinel

SIMULATE: Final = "simulate"
"""In place of the view, in a file of a branch of an episode without a user."""

_EXIT: Final = Sentinel("EXIT")
"""Among answers: the ``None`` step of an agent that has ended."""


def save_episode(env: Any, path: str | os.PathLike[str], *, unnamed: bool = False) -> None:
    """Write the episode of an environment to a file, from which ``load_episode`` goes on.

    The file has the recipe of the environment by dotted names, the seed, and all answers, as lines
    of JSON. To make digests of all observations, another simulation repeats the episode.

    Args:
        env: An environment of one simulation, in any view, with or without wrappers, which are not
            written; also a clone, or a branch in a policy. A decision is pending, or the episode
            has ended.
        path: The file. An existing one is replaced.
        unnamed: Whether to leave open whatever has no dotted name, such as a lambda. It must then
            be given to ``load_episode``.

    Raises:
        EpisodeFileError: Something has no name, an action or an option is no data, or the
            simulation does not repeat the episode. Nothing is written.
        ViewError: It is not an environment of one simulation, or is one that a policy is given and
            is no branch or clone yet.
        ResetNeededError: There is no episode.
        BranchError: The episode has no complete tape.
        StoreError: The file cannot be written.
    """
    view = getattr(env, "unwrapped", env)
    kind = getattr(view, "kind", "")
    if isinstance(view, PlannerEnv) and view.is_branch:
        plan = view.session.plan
        policies = (plan.options.policies or {}).values()
        is_alone = not (plan.has_user or any(isinstance(each, DeferredPolicy) for each in policies))
        kind = view.session.kind or (SIMULATE if is_alone else "")
    if kind not in (*VIEWS, SIMULATE):
        raise ViewError(
            f"save_episode needs an environment of one simulation, not {short_repr(env)}. Of the"
            " environment that a policy is given, it saves branches and clones, but not in"
            " simulate_many and in vector environments: simulate has the same episode"
        )
    session = view.session
    recording = session.recording()
    if view.episode.pending is None and not view.episode.over:
        raise session.refusal()
    lines = [head_of(recipe_of(session.plan, unnamed), kind, recording.seed, recording.options)]
    file = getattr(getattr(session.episode, "tape", None), "path", None)
    is_own = session.where is Where.USER and not isinstance(view, PlannerEnv)  # not its parent's
    if is_own and file is not None and file.exists():  # with ``record=``
        lines += [line for number, line in Lines(file).read() if number > 1]
        if all(line.keys().isdisjoint(("end", "error")) for line in lines):
            lines.append(end_of(view.episode))
    else:
        lines += _repeated(view, recording)
    _write(Path(path), lines)


def _repeated(view: Any, recording: Recording) -> list[Json]:
    """Return the lines of an episode, which another simulation repeats."""
    lines: list[Json] = []
    session = Session(view.session.plan)
    twin = type(view).of_session(session)
    replay = Replay(recording.tape)
    session.make_tapes(partial(FileTape, put=lines.append), replay)
    error = None
    try:
        with preserve_generators():  # because the model may draw from these
            try:
                _repeat(twin, recording.seed, recording.options, replay, recording.in_rounds)
                while view.kind == "aec" and twin.agents != view.agents:
                    twin.step(None)
            except Exception as problem:
                error = problem
            is_same = session.episode is not None and (
                session.episode.outcome is view.episode.outcome
                and same(session.recording().decision, recording.decision)
            )
            if replay or not is_same:
                raise EpisodeFileError(
                    f"{session.plan.name} does not repeat the episode with the same seed and"
                    " the same actions, so that nothing could load the file. Some of its random"
                    " numbers do not follow from the seed (try global_rng=True), or it depends on"
                    " the order of a set, or its code has changed"
                ) from error
            lines.append(
                end_of(view.episode) if error is None else {"error": describe_error(error)}
            )
    except BaseException as problem:
        close_after(problem, twin.close, "the repeated episode")
        raise
    twin.close()
    return lines


def _repeat(view: Any, seed: int, options: Any, replay: Replay, in_rounds: bool) -> None:
    """Repeat the episode of a replay in a view."""
    if isinstance(view, PlannerEnv):
        view.repeat_branch(seed, options, replay, in_rounds)
    else:
        view.reset(seed=seed, options=options)
    view.session.repeat(
        replay, lambda answer: view.step(None) if answer is _EXIT else view.repeat(answer)
    )


def _write(path: Path, lines: list[Json]) -> None:
    """Write lines to a file, which is never seen without some of them."""
    beside = path.with_name(f"{path.name}.{uuid4().hex[:8]}")
    try:
        beside.write_bytes(b"".join(map(to_line, lines)))
        beside.replace(path)
    except OSError as error:
        with suppress(OSError):
            beside.unlink()
        raise StoreError(f"{path} cannot be written: {describe_error(error)}") from error


# -- loading --------------------------------------------------------------------------------------


def load_episode(
    path: str | os.PathLike[str],
    *,
    simulation: Model = None,
    points: Points = None,
    **options: Unpack[ViewOptions],
) -> Any:
    """Make an environment that stands where a saved or recorded episode stands.

    Another simulation repeats the episode from its seed and its answers, and each observation and
    mask is compared with the file. After an error of the model, the environment stands before the
    user's last answer. A finished episode is loaded to its end.

    Args:
        path: The file of ``save_episode``, or of the option ``record``.
        simulation: Takes the place of the simulation that the file names, or leaves open.
        points: Take the place of the decision points that the file names.
        **options: Take the place of options of the file, such as ``policies``.

    Returns:
        An environment of the same view. Its ``unwrapped.latest`` is what the last ``reset`` or
        ``step`` has returned.

    Raises:
        EpisodeFileError: The file is malformed, or a name in it cannot be used; or a decision
            differs: the first one, and the likely reason.
        StoreError: The file cannot be read.
        SimEnvError: Another argument is invalid.
    """
    return EpisodeFile(path).load(simulation, points, **options)


def replay_episode(path: str | os.PathLike[str], until: int | None = None) -> str:
    """Repeat an episode, and return its timeline as text.

    Args:
        path: The file.
        until: The number of decisions to repeat; those of policies that follow are repeated, too.
            None: all.

    Raises:
        SimEnvError: Any error of ``load_episode``.
    """
    file = EpisodeFile(path, until)
    timeline: list[str] = []
    view = file.load(timeline=timeline)
    kind = f"{file.head['view']}, in a branch" if file.is_branch else view.kind
    head = f"{view.session.plan.name}, view {kind}, seed {view.session.seed}"
    timeline.append(f"now: {_shown(end_of(view.episode))}")
    if file.failure:
        timeline.append(file.failure)
    view.close()
    return "\n".join((head, *timeline))


class Answered(NamedTuple):
    """A line of a file: its number, itself without the action, and the answer."""

    number: int
    line: Json
    answer: Action

    @property
    def is_by_user(self) -> bool:
        """Whether the user has answered a decision."""
        return "agent" in self.line and "by" not in self.line


class EpisodeFile:
    """The last episode of a file, up to the decision that pends there.

    Attributes:
        head: The first line.
        answers: The answers.
        failure: The user's answer that led to an error, which is left out, and the error.
    """

    def __init__(self, path: str | os.PathLike[str], until: int | None = None) -> None:
        """Read a file, up to so many decisions.

        Raises:
            EpisodeFileError: It is malformed.
            StoreError: It cannot be read.
        """
        self._path = path
        episode = read_episodes(path)[-1]
        self.answers: list[Answered] = []
        self._last: Json = {}  # the line of the pending decision, of the end or of an error
        self.failure = ""
        number = 1
        try:
            self.head = episode.head | {"reset": decode_value(episode.head.get("reset"))}
            kind = self.head["view"]
            self._view = None if kind == SIMULATE else VIEWS[kind]
            if self.head["episode"] != FORMAT or not isinstance(self.head["versions"], dict):
                raise ValueError("it is of another version")
            for number, line in episode.present:
                self._take(number, {**line})
        except Exception as error:
            raise malformed(path, number) from error
        if "error" in self._last:
            self._cut()
        if until is not None:
            self._stop_at(until)

    def _take(self, number: int, line: Json) -> None:
        """Take a line after the first one."""
        line.pop("play", None)
        if "reseed" in line:
            answer: Action = Reseeded(line["reseed"])
        elif "branch" in line:
            answer = Branched(line["branch"])
        elif "exit" in line:
            answer = _EXIT
        elif "action" in line and not self._last:
            answer = decode_value(line.pop("action"))
        elif line.keys() & {"agent", "end", "error"} and not self._last:
            self._last = line
            return
        else:
            raise ValueError("it is no line of an answer")
        self.answers.append(Answered(number, line, answer))

    @property
    def is_branch(self) -> bool:
        """Whether it is a branch of a planner."""
        return any("branch" in line for _, line, _ in self.answers)

    def _make(self, *arguments: Any) -> Any:
        """Make the environment, before its episode."""
        if self._view is not None:
            view = self._view(plan_of(*arguments))
            if not self.is_branch:
                return view
            session = view.hand_over()
        elif self.is_branch:
            session = Session(plan_of(*arguments, mode=Mode.SIMULATE))
        else:
            raise malformed(self._path, 1)
        return PlannerEnv.of_session(session, owned=True)

    def _cut(self) -> None:
        """Leave out the user's last answer, and whatever follows it."""
        error = self._last.get("error", "the process has ended")
        self._last = {}
        places = [place for place, each in enumerate(self.answers) if each.is_by_user]
        for place in places[-1:]:
            self.failure = f"then: {short_repr(self.answers[place].answer)}, and {error}"
            self._leave_out(place)

    def _stop_at(self, until: int) -> None:
        """Leave out the user's next answer after so many decisions, and whatever follows it."""
        decisions = 0
        for place, each in enumerate(self.answers):
            if each.is_by_user and decisions >= until:
                self._leave_out(place)
                self.failure = ""
                return
            decisions += "agent" in each.line

    def _leave_out(self, place: int) -> None:
        """Leave out an answer, and whatever follows it."""
        self._last = self.answers[place].line
        del self.answers[place:]

    def arguments(
        self, simulation: Model = None, points: Points = None, **options: Unpack[ViewOptions]
    ) -> tuple[Model, Points, dict[str, Any]]:
        """Return the simulation, the points and the options.

        Raises:
            EpisodeFileError: The first line is malformed, or a name in it cannot be used.
        """
        try:
            return arguments_of(self.head, simulation, points, options)
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            if isinstance(error, SimEnvError):
                raise
            raise malformed(self._path, 1) from error

    def load(
        self,
        simulation: Model = None,
        points: Points = None,
        timeline: list[str] | None = None,
        **options: Unpack[ViewOptions],
    ) -> Any:
        """Make the environment. ``timeline`` gets a text for each repeated decision."""
        view = self._make(*self.arguments(simulation, points, **options))
        try:
            problem = self._replay(view, timeline)
            if problem is not None:  # the process was killed before it could write that
                self._cut()
                problem = self._replay(view, None)
            if problem is not None:
                raise problem
        except BaseException as error:
            close_after(error, view.close, "the environment")
            raise
        return view

    def _replay(self, view: Any, timeline: list[str] | None) -> Exception | None:
        """Bring the environment to the last line. Return the error of an answer at the very end."""
        session = view.session
        plan = session.plan
        is_recorded = plan.options.record is not None and not self.is_branch
        make_tape = recorder(plan, view.kind) if is_recorded else FileTape
        end = Answered(1 + max((each.number for each in self.answers), default=1), self._last, None)
        expected = deque([*self.answers, end])

        def differ(line: Json) -> EpisodeFileError:
            return self._difference(plan, *expected[0][:2], line)

        def compare(line: Json) -> None:
            if expected[0] is end:
                return
            if expected[0].line != line:
                raise differ(line)
            answer = expected.popleft().answer
            if timeline is not None and "agent" in line:
                agent = session.episode.latest
                time = "" if agent.now is None else f"  at {agent.now:g}"
                action = short_repr(answer, 60)
                by = ", by its policy" if "by" in line else ""
                timeline.append(f"{len(timeline) + 1:6}{time}  {agent.name}: {action}{by}")

        def make(session: Session) -> FileTape:
            tape = make_tape(session)
            tape.compare(compare)
            return tape

        replay = Replay([*(each.answer for each in self.answers), GO_ON])
        session.make_tapes(make, replay)
        try:
            in_rounds = self._view is not None and self._view.in_rounds
            _repeat(view, self.head["seed"], self.head["reset"], replay, in_rounds)
        except EpisodeFileError:
            raise
        except Exception as error:
            if not self._last and (not replay or replay[0] is GO_ON):
                return error
            raise differ({"error": describe_error(error)}) from error
        finally:
            session.make_tapes(make_tape if is_recorded else None)
        view.episode.tape.compare(None)
        line = end_of(view.episode)
        if self._last and line != self._last:
            raise differ(line)
        return None

    def _difference(self, plan: Plan, number: int, recorded: Json, line: Json) -> EpisodeFileError:
        """Make the error for a line of the file, and the line that the environment has there."""
        problem = f"it was {_shown(recorded)}, and is {_shown(line)}"
        if _shown(recorded) == _shown(line):
            names = {"seen": "the observation", "mask": "the mask of legal actions"}
            differing = [text for key, text in names.items() if recorded.get(key) != line.get(key)]
            problem = f"{' and '.join(differing) or 'the answerer'} of {_shown(line)} differs"
        reasons = changes_since(self.head, plan) or [
            "has the model changed? It may also iterate over a set of strings, draw from a global"
            " generator (global_rng=True), or have been recorded with other floats of another"
            " machine"
        ]
        return EpisodeFileError(
            f"{self._path}, line {number}: the simulation does not repeat this decision: {problem}."
            f" Likely reasons: {'; '.join(reasons)}"
        )


def _shown(line: Json) -> str:
    """Return a line of a decision, an end or an error as words."""
    decision = f"a decision of {line['agent']!r}" if "agent" in line else ""
    return line.get("error") or decision or to_line(line).decode(errors="replace").strip()
