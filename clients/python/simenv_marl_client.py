"""The client of simenv_marl for models in Python that run in a process of their own.

For a model that needs another virtual environment or an older Python than the environment. This
file is the whole client: Python 3.8 or newer, POSIX, no dependencies. Copy it beside the model::

    client = Client(["shop.price"])

    def live(episode):
        town = Town(episode.seed, **episode.options)
        for day in range(30):
            town.price = client.decide("shop.price", "a", rule=lambda: 1.2 * town.cost, time=day,
            stock=town.stock) ...
        return town.cash

    if __name__ == "__main__":
        print(client.run(live, seed=7))

An environment starts the process with the numbers of two descriptors in ``SIMENV_MARL_FDS``.
Without that variable, the model's rule makes every decision.
"""

from __future__ import annotations

import functools
import json
import math
import os
import random
import threading
import traceback
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, NoReturn

_LONGEST = 16 << 20
_MOST_STOPS = 1000
_NOT_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


class Stop(BaseException):
    """Raised by decisions to unwind an episode that the environment has stopped.

    Do not catch it; ``finally`` runs.
    """


class Episode(NamedTuple):
    """One episode that the environment requests."""

    seed: int
    """The seed for all generators, from 0 to 2**31 - 1; random if the environment gives none."""

    options: dict[str, Any]
    """The options of the environment's ``reset``."""


class Client:
    """The model's side of the wire. A process has one client.

    The thread that calls ``run`` makes all decisions.

    Attributes:
        connected: Whether there is an environment.
        stopped: Whether the environment has stopped the episode.
    """

    def __init__(self, points: Sequence[str], report_rules: bool = True) -> None:
        """Name the decision points, and open the pipes of the environment, if there is one.

        Args:
            points: The names of all decision points of the model.
            report_rules: Whether the environment is told what the model's rules decide. Rules that
                ask for other decisions need False.
        """
        self._points = list(points)
        self._reports = report_rules
        self._reseed: Callable[[int], Any] | None = None
        self._sending = bytearray()
        self._running = self.stopped = False
        self._gone = self._failed = False  # the environment is gone, or was not understood
        self._number = self._stops = 0
        # the thread that runs the model: its name, and an id that gevent does not replace
        self._thread = (0, "")
        self._rule_of = ""  # the point whose rule is running, if its decision is to be reported
        self._due = 0  # the number of the call whose rule has not told its decision
        descriptors = os.environ.pop("SIMENV_MARL_FDS", None)  # child processes are not connected
        self.connected = descriptors is not None
        if descriptors is not None:
            try:
                reading, self._writing = map(int, descriptors.split(","))
                for descriptor in (reading, self._writing):
                    os.set_inheritable(descriptor, False)
                self._reading = os.fdopen(reading, "rb")
            except (OSError, ValueError) as error:
                raise ValueError(
                    f"SIMENV_MARL_FDS must be two descriptors, R,W, and is {descriptors}"
                ) from error

    # -- episodes ---------------------------------------------------------------------------------

    def on_reseed(self, function: Callable[[int], Any]) -> Callable[[int], Any]:
        """Set the function that reseeds the model's generators in mid-episode.

        Call it before ``run``.
        """
        self._reseed = function
        return function

    def run(
        self, model: Callable[[Episode], Any], seed: int = 0, options: dict[str, Any] | None = None
    ) -> Any:
        """Run the model once for each requested episode, until the environment is gone.

        An exception that leaves the model is raised in the environment.

        Args:
            model: Runs one episode; what it returns is the episode's result.
            seed: The seed of the one episode that runs without an environment.
            options: The options of that episode.

        Returns:
            Without an environment, what the model has returned. Its exceptions leave ``run`` then.
        """
        if not self.connected:
            return model(Episode(seed, options or {}))
        self._thread = threading.get_native_id(), threading.current_thread().name
        able = {"decided": self._reports, "expect": True, "reseed": self._reseed is not None}
        self._send(
            {"hello": 1, "points": self._points, "can": [name for name in able if able[name]]}
        )
        while not self._gone:
            episode = self._next_episode()
            if episode is not None:
                self._play(model, episode)
        if self._failed:
            raise SystemExit(1)
        return None

    def _next_episode(self) -> Episode | None:
        frame = self._receive()
        if frame is None:
            return None
        start = frame.get("start")
        if not isinstance(start, dict):
            start = {"seed": "none"}
        seed = start.get("seed")
        if seed is None:
            seed = random.SystemRandom().randrange(1 << 31)
        if type(seed) is not int:
            self._fail(
                "the start of an episode with an integer as seed was expected, and this came:"
                f" {frame}"
            )
            return None
        self._number = self._stops = self._due = 0
        self._running, self.stopped = True, False
        return Episode(seed, start.get("options") or {})

    def _play(self, model: Callable[[Episode], Any], episode: Episode) -> None:
        try:
            self.end(model(episode))
        except Stop:
            pass
        except Exception as error:
            if self._reporting():  # else it is what has become of a Stop
                trace = "".join(traceback.format_exception(type(error), error, error.__traceback__))
                name = f"{type(error).__module__}.{type(error).__qualname__}"
                self._error(name.replace("builtins.", ""), str(error), trace)
        self._running = False

    def end(self, result: Any = None, truncated: bool = False) -> None:
        """End the episode before the model returns.

        Args:
            result: The result of the episode: JSON data, or arrays.
            truncated: Whether it ended by a time limit, not by the end of the task.
        """
        if self._reporting():
            self._send({"end": {"truncated": bool(truncated), "result": result}})
            self._running = False
            self._flush()

    def _refuse_thread(self, about: str) -> NoReturn:
        """Report the use in another thread to the environment.

        The error alone is not enough, because libraries often catch errors of callbacks.
        """
        text = (
            f"{about} in the thread {threading.current_thread().name!r}, but the model runs in the"
            f" thread {self._thread[1]!r}; pass what the decision needs to that thread, by a"
            " queue.Queue, and decide there"
        )
        self._error("RuntimeError", text, "".join(traceback.format_stack()))
        self._running = False
        raise RuntimeError(text)

    def _error(self, kind: str, text: str, trace: str) -> None:
        most, self._due = 1 << 16, 0
        self._send({"error": {"type": kind, "text": text[:most], "trace": trace[-most:]}})
        self._flush()

    def _fail(self, text: str) -> None:
        """End the communication: the environment is not understood from here on."""
        self._error("simenv_marl_client.WireError", text, "")
        self._gone = self._failed = True

    # -- decisions --------------------------------------------------------------------------------

    def decide(
        self,
        point: str,
        entity: str | int | None = None,
        *,
        rule: Callable[[], Any],
        time: float | None = None,
        **arguments: Any,
    ) -> Any:
        """Return the environment's decision, or what the rule decides.

        Args:
            point: The name of the decision point.
            entity: The entity that decides; None if there is only one.
            rule: The model's own rule. It is called if there is no environment, or if the
                environment leaves the decision to the rule.
            time: The model's time.
            **arguments: The arguments for the environment's mappings: JSON data, or arrays.

        Raises:
            Stop: The environment has stopped the episode.
        """
        return self._decide(point, entity, time, arguments, rule) if self.connected else rule()

    def decision(
        self,
        point: str,
        entity: Any = None,
        time: Any = None,
        arguments: Callable[..., Any] | None = None,
    ) -> Callable[[Any], Any]:
        """Make a function of the model a decision point: a decorator. The function is the rule.

        Args:
            point: The name of the decision point.
            entity: The entity that decides, or a callable that returns it.
            time: The model's time, or a callable that returns it.
            arguments: A callable that returns a dict of the arguments for the environment's
                mappings.

        All callables get the arguments of the function.
        """

        def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
            @functools.wraps(function)
            def decide(*args: Any, **kwargs: Any) -> Any:
                if not self.connected:
                    return function(*args, **kwargs)
                parts = [
                    part(*args, **kwargs) if callable(part) else part
                    for part in (entity, time, arguments)
                ]
                return self._decide(
                    point, parts[0], parts[1], parts[2] or {}, lambda: function(*args, **kwargs)
                )

            return decide

        return decorate

    def update(
        self,
        point: str,
        entity: str | int | None = None,
        *,
        time: float | None = None,
        **arguments: Any,
    ) -> None:
        """Report the current arguments of an entity, for its last observation and reward.

        Call it before the entity is removed, or before the end.
        """
        if self._reporting():
            self._send({"update": entity, **_call(point, time, arguments)})

    def remove(self, point: str, entity: str | int | None) -> None:
        """Report that an entity is gone and makes no more decisions."""
        if self._reporting():
            self._send({"remove": entity, "point": point})

    def expect(
        self,
        point: str,
        entity: str | int | None = None,
        *,
        time: float | None = None,
        **arguments: Any,
    ) -> None:
        """Report that an entity is going to decide, with the arguments that it has now.

        So agents that are born together are observed together, and act in one round of the parallel
        view. Call it for all of them before the first of them decides.
        """
        if self._reporting():
            self._send({"expect": [{"entity": entity, **_call(point, time, arguments)}]})

    def _reporting(self) -> bool:
        return self.connected and self._running and not self.stopped

    def _decide(
        self, point: str, entity: Any, time: Any, arguments: dict[str, Any], rule: Callable[[], Any]
    ) -> Any:
        if threading.get_native_id() != self._thread[0] and self._running:
            self._refuse_thread(f"a decision at {point}")
        if self.stopped:
            self._unwind()
        if not self._running:
            raise RuntimeError(f"a decision outside of an episode, at {point}")
        frame: dict[str, Any] = {"decide": self._number + 1}
        if entity is not None:
            frame["entity"] = entity
        frame.update(_call(point, time, arguments))
        self._send(frame)
        self._number += 1
        answer = self._answer()
        if "rule" not in answer:
            return answer["value"]
        if not self._reports:
            return rule()
        self._rule_of, self._due = point, self._number
        try:
            value = rule()
        finally:
            self._rule_of = ""
        self._due = 0
        self._send({"decided": self._number, "value": value})
        return value

    def _answer(self) -> dict[str, Any]:
        """Wait for the answer to the latest call."""
        while True:
            frame = self._receive()
            if frame is None or frame.get("stop") is True:
                self._unwind()
            if type(frame.get("reseed")) is int and self._reseed is not None:
                self._reseed(frame["reseed"])
                continue
            answered = type(frame.get("act")) is int and frame["act"] == self._number
            if answered and ("value" in frame or frame.get("rule") is True):
                return frame
            self._fail(f"the answer to call {self._number} was expected, and this came: {frame}")
            self._unwind()

    def _unwind(self) -> NoReturn:
        self.stopped = True
        self._stops += 1
        if self._stops > _MOST_STOPS:
            os.write(
                2,
                (
                    b"simenv_marl_client: the model catches Stop again and again, and does not"
                    b" unwind\n"
                ),
            )
            os._exit(1)
        raise Stop("the environment has stopped this episode")

    # -- lines ------------------------------------------------------------------------------------

    def _send(self, frame: dict[str, Any]) -> None:
        """Queue a frame for the next wait. A frame without a JSON form is refused whole."""
        if self._rule_of and "error" not in frame:
            raise RuntimeError(
                f"the rule of {self._rule_of} has asked for a decision, or reported on an entity;"
                " it must only decide, or make the client by Client(points, report_rules=False)"
            )
        line = _line(frame)
        if self._due:  # the rule has raised an exception, which the model has caught
            self._sending += _line({"decided": self._due, "value": None})
            self._due = 0
        self._sending += line

    def _flush(self) -> None:
        try:
            while self._sending and not self._gone:
                del self._sending[: os.write(self._writing, self._sending)]
        except BrokenPipeError:
            self._gone = True
            self._sending.clear()

    def _receive(self) -> dict[str, Any] | None:
        """Wait for the next frame; None if the environment is gone."""
        self._flush()
        line = b"" if self._gone else self._reading.readline(_LONGEST)
        if not line.endswith(b"\n"):
            if len(line) == _LONGEST:
                self._fail("a line of more than 16 MiB")
            self._gone = True
            return None
        try:
            frame = json.loads(line.decode(), object_hook=_number, parse_constant=_refuse)
            if isinstance(frame, dict):
                return frame
            error: Exception = ValueError("it is not an object")
        except (ValueError, RecursionError) as problem:
            error = problem
        self._fail(f"a line that is not JSON ({error}): {line[:200]!r}")
        return None


def _call(point: str, time: float | None, arguments: dict[str, Any]) -> dict[str, Any]:
    """Return the common part of frames about an entity."""
    for name in ("entity", "point", "time"):
        if name in arguments:
            raise ValueError(
                f"{name!r} cannot be the name of an argument at {point}: the call has it besides"
            )
    return (
        {"point": point, "args": arguments}
        if time is None
        else {"point": point, "time": time, "args": arguments}
    )


def _line(frame: dict[str, Any]) -> bytes:
    try:
        text = json.dumps(frame, allow_nan=False, default=_data, separators=(",", ":"))
    except ValueError:  # some number is not finite
        text = json.dumps(_finite(frame), allow_nan=False, separators=(",", ":"))
    line = text.encode() + b"\n"
    if len(line) > _LONGEST:
        raise ValueError(f"a line of {len(line)} bytes cannot be sent; 16 MiB is the most")
    return line


def _data(value: Any) -> Any:
    """Return the JSON data of arrays and of numbers of NumPy."""
    if hasattr(value, "tolist"):
        return value.tolist()
    raise TypeError(f"{value!r} cannot be sent: it is not JSON data")


def _finite(value: Any) -> Any:
    """Return JSON data in which numbers that are not finite are represented."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else {"float": repr(float(value))}
    return value if value is None or isinstance(value, (bool, int, str)) else _finite(_data(value))


def _number(found: dict[str, Any]) -> Any:
    """Return the non-finite number that an object represents, or the object itself."""
    name = found.get("float")
    return _NOT_FINITE.get(name, found) if len(found) == 1 and isinstance(name, str) else found


def _refuse(constant: str) -> NoReturn:
    raise ValueError(f"{constant} is not in JSON")
