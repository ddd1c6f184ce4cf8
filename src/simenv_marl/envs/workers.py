"""Rows of simulations in processes of their own, which share arrays with the process of their user.

Between the two goes one message for all the simulations of a worker, and one back. Observations, rewards and flags
lie in memory that both see; observations of a kind that has no array go along with the message.

Nothing here can wait for ever: whoever waits for a worker also waits for its death, and a worker whose user is gone
finds its pipe closed. The memory has no name and there are no semaphores, so that nothing is left behind even by a
process that is killed.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import prod
from multiprocessing.connection import Connection, wait
from time import monotonic
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import concatenate, create_empty_array
from numpy.typing import NDArray

from ..core.plan import Plan
from ..core.processes import pack_error, pack_plainly, unpack_error
from ..decision import registered_names
from ..errors import OptionValueError, WorkerError, annotate, warn_user
from .rows import Batch, Row, Seating, Told

SECONDS_TO_CLOSE: Final = 10.0
"""How long a worker may take to unwind its simulations and to end."""

EXIT: Final = b""
"""The message that asks a worker to end."""

_ALIGNMENT: Final = 64


# -- shared arrays --------------------------------------------------------------------------------


def shareable(space: spaces.Space[Any]) -> bool:
    """Whether batches of a space are arrays of one size, and nothing else."""
    if isinstance(space, spaces.Dict):
        return all(map(shareable, space.spaces.values()))
    if isinstance(space, spaces.Tuple):
        return all(map(shareable, space.spaces))
    return isinstance(space, (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary))


class Measure:
    """Adds up the size of arrays, where they are made one behind the other."""

    def __init__(self) -> None:
        self.size = 0

    def __call__(self, shape: Any, dtype: Any) -> NDArray[Any]:
        """Have room for an array."""
        self.size += _padded(shape, dtype)
        return np.zeros(shape, dtype)


class Arena(Measure):
    """Makes arrays one behind the other in memory that processes share."""

    def __init__(self, memory: Any) -> None:
        super().__init__()
        self._memory = memory

    def __call__(self, shape: Any, dtype: Any) -> NDArray[Any]:
        """Make an array of what lies there."""
        array = np.frombuffer(self._memory, dtype, prod(shape), self.size).reshape(shape)
        self.size += _padded(shape, dtype)
        return array


def _padded(shape: Any, dtype: Any) -> int:
    size: int = prod(shape) * np.dtype(dtype).itemsize
    return -(-size // _ALIGNMENT) * _ALIGNMENT


def _batch(space: spaces.Space[Any], number: int, make: Callable[..., NDArray[Any]]) -> Batch:
    """A batch whose arrays are made so, in an order that is always the same."""
    shared = shareable(space)
    observations = create_empty_array(space, number, make) if shared else create_empty_array(space, number)
    return Batch(observations, number, make)


def _part(batch: Any, share: slice) -> Any:
    """Some of the rows of batched observations, as views."""
    if isinstance(batch, dict):
        return {key: _part(value, share) for key, value in batch.items()}
    if isinstance(batch, tuple):
        return tuple(_part(value, share) for value in batch)
    return batch[share]


# -- what goes to a worker ------------------------------------------------------------------------


@dataclass(frozen=True)
class Recipe:
    """What the simulations of a worker are made of, as it was given to ``vector_env``."""

    simulation: Any
    points: Any
    options: Mapping[str, Any]
    view: str | None

    def plan(self) -> Plan:
        """Draw up a plan of it."""
        return Plan.draw_up(self.simulation, self.points, self.options)

    def spelt_out(self, seating: Seating) -> Recipe:
        """The same, with what only this process could find out: which points are registered, which agents there are."""
        points, options = self.points, dict(self.options)
        named = [named.point for named in seating.plan._named]
        if points is None and [point.name for point in named] == registered_names():
            points = registered_names()
        if not seating.single:
            options["possible_agents"] = seating.plan.options.possible_agents
        return Recipe(self.simulation, points, options, "single" if seating.single else "joint")


# -- in a worker ----------------------------------------------------------------------------------


def work(pipe: Connection, others: Iterable[Connection], recipe: Any, memory: Any, setup: dict[str, Any]) -> None:
    """The main function of a worker.

    Args:
        pipe: To its user.
        others: Ends of pipes that it has inherited and that are not its own.
        recipe: A pickled recipe.
        memory: What both share.
        setup: ``number`` of all simulations, ``first`` and ``end`` of the worker's own, ``mode``.
    """
    with suppress(ValueError):  # not in a main thread
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for its user, who then says what to do
    for other in others:
        other.close()
    row: Row | None = None
    try:
        try:
            row, sends_rows = _seated(pickle.loads(recipe), memory, **setup)
        except BaseException as error:
            _send(pipe, 0, error=error)
            return
        _send(pipe, 0)
        while (message := pipe.recv_bytes()) != EXIT:
            _serve(pipe, row, sends_rows, message)
    except (EOFError, OSError):  # its user is gone
        pass
    finally:
        if row is not None:
            row.abandon()


def _seated(recipe: Recipe, memory: Any, number: int, first: int, end: int, mode: AutoresetMode) -> tuple[Row, bool]:
    seating = Seating(recipe.plan(), recipe.view)
    space = seating.single_observation_space
    whole, share = _batch(space, number, Arena(memory)), slice(first, end)
    shared = shareable(space)
    observations = _part(whole.observations, share) if shared else create_empty_array(space, end - first)
    part = Batch(observations, end - first)
    part.rewards, part.terminations = whole.rewards[share], whole.terminations[share]
    part.truncations = whole.truncations[share]
    return Row(seating, part, mode, end - first, first), not shared


def _serve(pipe: Connection, row: Row, sends_rows: bool, message: bytes) -> None:
    identity = 0
    try:
        identity, method, arguments = pickle.loads(message)
        result = getattr(row, method)(*arguments)
        if method in ("reset", "step"):
            result = result, row.observed if sends_rows else None
        answer = pack_plainly((identity, True, result))
    except BaseException as error:
        _send(pipe, identity, error=error)
        return
    pipe.send_bytes(answer)


def _send(pipe: Connection, identity: int, *, error: BaseException | None = None) -> None:
    pipe.send_bytes(pickle.dumps((identity, error is None, None if error is None else pack_error(error)), 5))


# -- in the process of its user -------------------------------------------------------------------


class Worker:
    """A process with some of the simulations.

    Attributes:
        first, end: The numbers of its simulations: from the first to before the end.
        name: What it is called in messages.
    """

    def __init__(self, number: int, first: int, end: int) -> None:
        self.first, self.end = first, end
        self.name = f"worker {number} (of the sub-environments {first} to {end - 1})"
        self._pipe: Connection | None = None
        self._process: Any = None

    @property
    def there(self) -> bool:
        """Whether it can be asked."""
        return self._pipe is not None

    def start(
        self, context: Any, inherited: list[Connection], recipe: bytes, memory: Any, setup: dict[str, Any]
    ) -> None:
        """Start the process. It tells when it is ready, or why it will not be."""
        ours, theirs = context.Pipe()
        setup = {**setup, "first": self.first, "end": self.end}
        forked = context.get_start_method() == "fork"
        self._process = context.Process(
            target=work,
            args=(theirs, [*inherited, ours] if forked else [], recipe, memory, setup),
            name=f"simenv_marl {self.name}",
            daemon=True,
        )
        try:
            self._process.start()
        except BaseException:
            ours.close()
            self._process = None
            raise
        finally:
            theirs.close()
        self._pipe = ours

    @property
    def pipe(self) -> Connection:
        """The pipe to it.

        Raises:
            WorkerError: It is dead.
        """
        if self._pipe is None:
            raise WorkerError(f"{self.name} is dead; reset() puts another one in its place")
        return self._pipe

    @property
    def sentinel(self) -> int:
        """Becomes ready when the process ends."""
        return int(self._process.sentinel)

    def send(self, message: bytes) -> None:
        """Send it a message.

        Raises:
            WorkerError: It is dead.
        """
        try:
            self.pipe.send_bytes(message)
        except OSError:
            raise self.died() from None
        except BaseException:  # the message may be there in part
            self.end_now()
            raise

    def receive(self) -> Any:
        """Receive what it has sent.

        Raises:
            WorkerError: It is dead.
        """
        try:
            return pickle.loads(self.pipe.recv_bytes())
        except (EOFError, OSError):
            raise self.died() from None
        except BaseException:
            self.end_now()
            raise

    def died(self) -> WorkerError:
        """Bury it; the error that says how it died."""
        process = self._process
        process.join(1.0)  # its pipe closes a moment before it ends
        code = process.exitcode
        self.end_now()
        how = "closed its pipe" if code is None else f"died with exit code {code}"
        script = (
            '. In a script, environments with workers are made under `if __name__ == "__main__":`, because each worker'
            " runs the script once more"
            if code == 1  # of an error, before it could tell of one
            else ""
        )
        return WorkerError(
            f"{self.name} {how}; it was killed, or its simulations have ended the process. reset() puts another one"
            f" in its place{script}"
        )

    def end_now(self, seconds: float = 0.0) -> None:
        """End the process, by force unless it ends by itself within some seconds."""
        process, pipe = self._process, self._pipe
        self._process = self._pipe = None
        if pipe is not None:
            pipe.close()
        if process is None:
            return
        process.join(seconds)
        for force in (process.terminate, process.kill):
            if process.exitcode is None:
                force()
                process.join(1.0)
        if process.exitcode is not None:
            process.close()


class Workers:
    """Rows in processes: used like a ``Row``.

    Attributes:
        failed: Whether an error has left some simulations where the others are not, and all are to be reset.
        batch: What they write into.
    """

    def __init__(
        self, recipe: Recipe, seating: Seating, mode: AutoresetMode, number: int, workers: int, context: Any
    ) -> None:
        """Start the workers.

        Raises:
            OptionValueError: There is no such context, or what the environment is made of cannot be pickled.
            WorkerError: A worker died.
            BaseException: What making a simulation raises.
        """
        self._context = _context(context)
        self._space, self._mode, self._number = seating.single_observation_space, mode, number
        try:
            self._recipe = pack_plainly(recipe.spelt_out(seating))
        except Exception as error:
            raise OptionValueError(
                f"what the simulations are made of cannot be sent to another process ({type(error).__name__}: {error});"
                " give a class or a factory that a module holds, or workers=0"
            ) from error
        measure = Measure()
        _batch(self._space, number, measure)
        self._memory = self._context.RawArray("b", max(measure.size, 1))
        self.batch = _batch(self._space, number, Arena(self._memory))
        self._rows: list[Any] = [None] * number
        self._shared = shareable(self._space)
        self.failed = False
        self._identity = 0
        self._process = os.getpid()
        workers = min(workers, number)
        cuts = [number * part // workers for part in range(workers + 1)]
        self._workers = [Worker(part, cuts[part], cuts[part + 1]) for part in range(workers)]
        try:
            self._hire()
        except BaseException:
            self.abandon()
            raise

    def _hire(self) -> None:
        """Start the workers that are not there."""
        new = [worker for worker in self._workers if not worker.there]
        if not new:
            return
        setup = {"number": self._number, "mode": self._mode}
        for worker in new:
            inherited = [other.pipe for other in self._workers if other.there]
            worker.start(self._context, inherited, self._recipe, self._memory, setup)
        self._gather(new, 0)

    def _ask(self, method: str, arguments: Callable[[Worker], tuple[Any, ...] | None]) -> list[tuple[Worker, Any]]:
        """Ask all workers for which there are arguments, and wait for their answers.

        Raises:
            WorkerError: One is dead.
            BaseException: What the first raises that raises anything.
        """
        self._be_theirs()
        self._identity += 1
        asked = []
        messages = [(worker, arguments(worker)) for worker in self._workers]
        packed = [
            (worker, pack_plainly((self._identity, method, given))) for worker, given in messages if given is not None
        ]
        for worker, message in packed:
            worker.send(message)
            asked.append(worker)
        return self._gather(asked, self._identity)

    def _be_theirs(self) -> None:
        """Make sure that this is the process that they talk to.

        Raises:
            WorkerError: It is a fork of that.
        """
        if os.getpid() != self._process:
            raise WorkerError(
                "the workers are those of the process of which this one is a fork; make another environment"
            )

    def _gather(self, asked: list[Worker], identity: int) -> list[tuple[Worker, Any]]:
        """Wait for answers.

        Raises:
            BaseException: What the first worker raises that raises anything.
        """
        results, errors = self._collect(asked, identity)
        for worker in asked:
            if worker in errors:
                raise errors[worker]
        return list(results.items())

    def _collect(
        self, asked: list[Worker], identity: int, seconds: float | None = None
    ) -> tuple[dict[Worker, Any], dict[Worker, BaseException]]:
        """Wait until all have answered, have died or have let some seconds go by. Returns results, and errors."""
        until = None if seconds is None else monotonic() + seconds
        results: dict[Worker, Any] = {}
        errors: dict[Worker, BaseException] = {}
        while left := [worker for worker in asked if worker not in results and worker not in errors]:
            remaining = None if until is None else max(until - monotonic(), 0.0)
            ready = wait([part for worker in left for part in (worker.pipe, worker.sentinel)], remaining)
            if not ready:
                break
            for worker in left:
                if worker.pipe not in ready and worker.sentinel not in ready:
                    continue
                try:
                    if worker.pipe not in ready and not worker.pipe.poll():  # it has died, and has not answered before
                        raise worker.died()
                    answered, fine, answer = worker.receive()
                except WorkerError as error:
                    errors[worker] = error
                    continue
                if answered != identity:
                    continue  # to what was asked before its user was interrupted
                if fine:
                    results[worker] = answer
                else:
                    errors[worker] = unpack_error(answer)
                    annotate(errors[worker], f"simenv_marl: in {worker.name}")
        return {worker: results[worker] for worker in asked if worker in results}, errors

    # -- what a row does --------------------------------------------------------------------------

    @property
    def ended(self) -> set[int]:
        """The numbers of those whose episode has ended and has not begun anew."""
        batch = self.batch
        if self._mode == AutoresetMode.SAME_STEP or not (batch.terminations.any() or batch.truncations.any()):
            return set()
        return set(np.flatnonzero(batch.terminations | batch.truncations).tolist())

    @property
    def seats(self) -> list[Any]:
        """The environments of the simulations, which are not here."""
        raise AttributeError("the sub-environments are in other processes; use call(), get_attr() and set_attr()")

    def reset(self, seeds: Sequence[int | None], options: dict[str, Any] | None, chosen: Sequence[int]) -> Told:
        """As ``Row.reset``, and start those workers anew that have died."""
        self.failed = True

        def arguments(worker: Worker) -> tuple[Any, ...] | None:
            own = [number - worker.first for number in chosen if worker.first <= number < worker.end]
            return (seeds[worker.first : worker.end], options, own) if own else None

        self._hire()
        told = self._told(self._ask("reset", arguments))
        self.failed = False
        return told

    def check(self, actions: Sequence[Any]) -> None:
        """As ``Row.check``."""
        self._ask("check", lambda worker: (actions[worker.first : worker.end],))

    def step(self, actions: Sequence[Any]) -> Told:
        """As ``Row.step``."""
        self.failed = True
        told = self._told(self._ask("step", lambda worker: (actions[worker.first : worker.end],)))
        self.failed = False
        return told

    def _told(self, answers: list[tuple[Worker, Any]]) -> Told:
        told = []
        for worker, (infos, rows) in answers:
            told += [(worker.first + number, info) for number, info in infos]
            if rows is not None:
                self._rows[worker.first : worker.end] = rows
        if not self._shared:
            self.batch.observations = concatenate(self._space, self._rows, self.batch.observations)
        return told

    def call(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[Any]:
        """As ``Row.call``."""
        return [value for _, values in self._ask("call", lambda _: (name, args, kwargs)) for value in values]

    def set_attr(self, name: str, values: Sequence[Any]) -> None:
        """As ``Row.set_attr``."""
        self._ask("set_attr", lambda worker: (name, values[worker.first : worker.end]))

    def close(self) -> None:
        """Unwind all simulations and end the workers, by force after some seconds.

        Raises:
            BaseException: What the first simulation raises that raises anything; the others are unwound all the same.
        """
        self._be_theirs()
        try:
            self._identity += 1
            there = [worker for worker in self._workers if worker.there]
            for worker in there:
                with suppress(WorkerError):
                    worker.send(pack_plainly((self._identity, "close", ())))
            there = [worker for worker in there if worker.there]
            results, errors = self._collect(there, self._identity, SECONDS_TO_CLOSE)
            if len(results) + len(errors) < len(there):
                warn_user(f"workers did not close within {SECONDS_TO_CLOSE} s and are ended by force", ResourceWarning)
            for worker, error in errors.items():
                if worker.there:  # else it has died, and there is nothing left to be closed
                    raise error
        finally:
            self.abandon()

    @property
    def suspended(self) -> bool:
        """Whether a simulation still waits for an action here: none does."""
        return False

    def abandon(self) -> None:
        """End the workers; from a finalizer, too: raises nothing."""
        if os.getpid() != self._process:
            return  # they are those of the process of which this is a fork
        for worker in self._workers:
            if worker.there:
                with suppress(WorkerError):
                    worker.send(EXIT)
        until = monotonic() + SECONDS_TO_CLOSE
        for worker in self._workers:
            worker.end_now(max(until - monotonic(), 0.0))


def _context(context: Any) -> Any:
    if context is None:
        context = "spawn"
    if isinstance(context, str):
        try:
            return multiprocessing.get_context(context)
        except ValueError:
            raise OptionValueError(
                f"context must be one of {', '.join(map(repr, multiprocessing.get_all_start_methods()))}, or a context"
                f" of multiprocessing, not {context!r}"
            ) from None
    if not hasattr(context, "Process"):
        raise OptionValueError(f"context must be a name or a context of multiprocessing, not {context!r}")
    return context
