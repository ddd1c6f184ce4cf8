"""A clone in a forked process, as its view sees it: a session that asks the process, and a mirror of the episode."""

from __future__ import annotations

import copy
import os
import pickle
import socket
from collections.abc import Callable
from contextlib import suppress
from errno import EMFILE
from functools import partial
from typing import Any

from ..errors import BranchError, ClosedError, annotate, describe_error, short_repr, warn_user
from .agent import Agent
from .context import ExclusiveLock
from .episode import EpisodeState
from .forks import Fork, exhausted, send
from .host import FIELDS, MOVES, State, layers_of, pack_env, pack_reply, state_of, unpack_env
from .packing import pack, pack_plainly, unpack, unpack_error
from .policies import Where
from .session import Session


class Mirror(EpisodeState):
    """The episode of a clone, as its view sees it: the agents, and what is pending, as of the latest reply."""

    __slots__ = ("remote",)

    def __init__(self, remote: ForkedSession, state: State) -> None:
        """Mirror a state that lists all agents."""
        self.remote = remote
        clock = None if state.time is None else partial(getattr, remote, "time")
        super().__init__(remote.plan, remote.seed or 0, clock, in_rounds=state.in_rounds)
        self.where = remote.where
        self.unreported_end, self.last_time = state.unreported_end, state.last_time
        self.load(state)

    def load(self, state: State) -> None:
        """Take over a state. What the view itself notes in an episode stays."""
        self.over, self.turns, self.remote.time = state.over, state.turns, state.time
        self.terminated, self.truncated = state.terminated, state.truncated
        for name, point, values in state.agents:
            agent = self.agent(name)
            if agent is None:
                agent = Agent(name, self.plan.points[point], self.plan, self.clock)
            for field, value in zip(FIELDS, values, strict=True):
                setattr(agent, field, value)
            if agent.ended:
                self.agents.pop(name, None)
            (self.ended if agent.ended else self.agents)[name] = agent
        nobody: Any = None  # only their names matter
        self.others.update(dict.fromkeys(state.others, nobody))
        self.just_ended = [self.ended[name] for name in state.just_ended]
        self.pending = None if state.pending is None else self.agents[state.pending]

    def single_out(self, agent: Agent) -> None:
        """Do nothing: the clone's process has done it."""

    def step(self, action: Any, entered: bool = False) -> None:
        """Take a step in the clone's process."""
        if self.pending is None:
            self.report_end()
            return
        self.unreported_end = False
        self.remote.request("step", action)


class ForkedSession(Session):
    """The session of a clone in a forked process.

    Attributes:
        time: The simulation's time as of the latest reply; None if it has none.
    """

    __slots__ = (
        "_fork",
        "_gone",
        "_limit",
        "_made_from",
        "_renewed",
        "_stepped",
        "_warned",
        "time",
    )

    def __init__(self, original: Session, fork: Fork, time_limit: float) -> None:
        """Take over a process in which the episode of a session goes on."""
        self.plan, self.bound_plan = original.plan, None
        self.where = Where.CLONE
        self.state, self.options, self.seed = "over", original.options, original.seed
        self.np_random_seed, self._np_random = (
            original.np_random_seed,
            copy.deepcopy(original._np_random),
        )
        self.exclusive = self.lock = ExclusiveLock()
        self._fork, self._limit = fork, time_limit
        # whose process forked this one's
        self._made_from = original if isinstance(original, ForkedSession) else None
        self._gone: str | None = None  # why the process is gone
        self._renewed = self._warned = False
        self._stepped: bool = self._made_from is not None and self._made_from._stepped
        self.episode: Any = None
        self.time: float | None = None
        fork.limit(time_limit)

    def begin(self, view: Any) -> None:
        """Mirror the episode of the view that was cloned."""
        if view._solo:  # from now on, it waits for one agent only
            self.request("begin")
        else:
            self._unpack("begin", pack_reply(None, None, state_of(view.episode, whole=True)))

    @property
    def simulation(self) -> Any:
        """Refuse it: it is in another process."""
        raise BranchError(
            "the simulation of a clone is in the clone's process; reach it with"
            " env.unwrapped.call(lambda env: env.unwrapped.simulation...), which returns a copy of"
            " the result"
        )

    # -- requests ----------------------------------------------------------------------------------

    def request(self, name: str, *args: Any, limit: float | None = None) -> Any:
        """Call a method of the clone's ``Host`` or session.

        Mirror the episode afterwards; return the result.

        Raises:
            BranchError: The process has ended, or takes too long and is ended.
            BaseException: Any exception there, with its traceback as a note.
        """
        with self.exclusive:
            if self._gone is not None or not self._fork.usable:
                raise self.refusal()
            self._stepped |= name in ("step", "start", "call")
            reply, descriptors = self._exchange(name, pack_plainly((name, args)), limit)
            if not reply:
                raise self.refusal()
            value = self._unpack(name, reply)
            if not descriptors:
                if name == "fork" and value is not None:  # it ends, because its connection was lost
                    self.request("reap", value)
                    raise exhausted(OSError(EMFILE, os.strerror(EMFILE)))
                return value
            return Fork(
                value, socket.socket(fileno=descriptors[0]), self._fork.life, is_child=False
            )

    def refusal(self) -> Exception:
        """Make the error that says why no action can be taken now."""
        if self.state == "closed":
            return ClosedError(
                "the clone is closed, and its process has ended; clone the environment again"
            )
        if self._gone is not None or not self._fork.usable:
            return BranchError(
                f"the clone is gone: {self._gone or 'it belongs to another process'}"
            )
        return super().refusal()

    def _exchange(self, name: str, message: bytes, limit: float | None) -> tuple[bytes, list[int]]:
        """Send a message.

        Return the reply, empty if the process is gone, and the descriptors before it.
        """
        fork, descriptors, reply = self._fork, list[int](), b""
        try:
            if limit is not None:
                fork.limit(limit)
            send(fork.connection, message)
            if name == "fork":
                descriptors = fork.receive_descriptors()
            reply = fork.receive()
            if limit is not None:
                fork.limit(self._limit)
        except TimeoutError:
            self._end(
                "it was ended, because it took longer than"
                f" {self._limit if limit is None else limit} s; "
            )
        except ConnectionError:
            pass
        except BaseException:  # an interrupt: the reply would be taken for the next one
            self._end("it was ended by an interrupt; ")
            raise
        if not reply:
            self._end("its process has died, ")
        return reply, descriptors

    def _unpack(self, name: str, reply: bytes) -> Any:
        """Mirror the state in a reply; return its value, or raise its error."""
        value, error, state, left_out = pickle.loads(reply)
        if left_out and not self._warned:
            self._warned = True
            warn_user(f"infos of clones lack what cannot be pickled: {', '.join(left_out)}")
        whole = MOVES.get(name)
        if state is not None:
            if isinstance(self.episode, Mirror) and not whole:
                self.episode.load(state)
            else:
                self.episode = Mirror(self, state)
        elif whole is not None:
            self.episode = None
        if error is None:
            return None if value is None else unpack(value)
        raised = unpack_error(error)
        annotate(raised, f"simenv_marl: in a clone, where it was raised by{raised.__cause__}")
        BaseException.__setattr__(raised, "__cause__", None)  # its class may be frozen
        raise raised

    def ask(self, name: str, *args: Any) -> Any:
        """Call a method of the simulation."""
        return self.request("ask", name, *args)

    def check_reseed(self) -> None:
        """Check that the simulation's future random numbers can be drawn anew."""
        self.request("check_reseed")

    def reseed(self, seed: int) -> None:
        """Draw the simulation's future random numbers anew, and those of the clone's process."""
        self.request("reseed", seed)

    def recording(self) -> Any:
        """Return what a replay of the episode needs."""
        return self.request("recording")

    def step_out(self) -> None:
        """Do nothing: the clone's process has done it."""

    def call(
        self,
        env: Any,
        function: Callable[..., Any],
        args: tuple[Any, ...],
        limit: float | None = None,
    ) -> Any:
        """Call a function in the clone's process, with the environment there in the state that it has here."""
        view, episode, parcel = env.unwrapped, self.episode, None
        noted = None if episode is None else (episode.unreported_end, episode.last_time)
        try:
            parcel = pack_env(env, [view], self)
        except Exception as error:
            if self._stepped or env is not view._outermost():
                raise BranchError(
                    "the wrappers of the clone cannot be sent to its process"
                    f" ({describe_error(error)}); call functions before its first step"
                ) from error
        self._renewed = True  # the function may reset the environment
        result, parcel = self.request("call", pack((function, args)), parcel, noted, limit=limit)
        if parcel is not None:
            layers = layers_of(env)
            for layer, state in zip(layers, unpack_env(parcel, layers, self), strict=False):
                vars(layer).clear()
                vars(layer).update(state)
        view._set_up()  # there may be another episode
        return result

    # -- episodes ----------------------------------------------------------------------------------

    def start(
        self,
        seed: int | None,
        options: dict[str, Any] | None,
        *,
        in_rounds: bool = False,
        script: Any = None,
    ) -> Any:
        """Reset the simulation in the clone's process."""
        self.options, self.seed = options, self.seed_for(seed)
        self.episode, self.state = None, "over"
        self._renewed = True
        self.request("start", self.seed, options, in_rounds)
        return self.episode

    def end(self) -> None:
        """Forget the episode. It ends when another begins, or with the process."""
        self.episode = None

    @property
    def idle(self) -> bool:
        """Whether the process has ended."""
        return self._gone is not None

    def close(self) -> None:
        """End the process. Unwind and close the simulation there if it was reset there."""
        try:
            if self._renewed and self._gone is None and self._fork.usable:
                self.request("close")
        finally:
            self.episode, self.state = None, "closed"
            self._end("it is closed; ")

    def abandon(self) -> None:
        """Close it, from a finalizer."""
        try:
            self.close()
        except Exception as error:
            warn_user(f"a clone that was abandoned raised {short_repr(error)}", ResourceWarning)

    def _end(self, why: str) -> None:
        """End the process, for a reason."""
        self.episode = None
        if self._gone is None:
            self._gone = why + self._fork.end()
            if self._made_from is not None:
                with suppress(Exception):  # the parent may be gone, or busy; then it waits later
                    self._made_from.request("reap", self._fork.process)
