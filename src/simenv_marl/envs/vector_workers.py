"""Simulations of a vector environment in worker processes, each of which runs a ``SimulationBatch``.

No wait here lasts for ever. A wait for an answer also ends when the worker dies, and a worker's pipe closes when its
user ends.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import chain
from multiprocessing.connection import Connection, wait
from multiprocessing.context import BaseContext
from time import monotonic
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import create_empty_array

from ..core.packing import pack_outcome, pack_plainly, unpack, unpack_outcome
from ..errors import OptionValueError, WorkerError, annotate, describe_error, short_repr, warn_user
from .vector_batch import Infos, Results, SimulationBatch, State, SubEnvironmentType

SECONDS_TO_CLOSE: Final = 10.0
"""The seconds that a worker may take to unwind its simulations and to end."""

EXIT: Final = b""
"""The message that asks a worker to end."""


def serve(pipe: Connection, other_end: Connection | None) -> None:
    """Answer messages, each a packed pair of a method and its arguments, in a worker: make a batch, and call it.

    ``other_end`` is the user's end of the pipe, if a fork has copied it.
    """
    with suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the user's process, which decides what to do
    if other_end is not None:
        other_end.close()
    batch: SimulationBatch | None = None

    def answer(message: bytes) -> Any:
        nonlocal batch
        method, arguments = unpack(message)
        if batch is not None:
            return getattr(batch, method)(*arguments)
        parcel, *others = arguments
        batch = SimulationBatch(SubEnvironmentType(*unpack(parcel)), *others)
        return None

    try:
        while (message := pipe.recv_bytes()) != EXIT:
            pipe.send_bytes(pack_outcome(pack_plainly, answer, message))
    except (EOFError, OSError):  # the user's process has ended
        pass
    finally:
        if batch is not None:
            batch.abandon()


class Worker:
    """A process with some of the simulations, as its user sees it.

    Attributes:
        first, end: The number of its first simulation, and the number after that of its last one.
        name: Its name in messages.
        owes: Whether it has not yet answered the last message.
    """

    def __init__(self, number: int, first: int, end: int) -> None:
        self.first, self.end = first, end
        self.name = f"worker {number} (of the sub-environments {first} to {end - 1})"
        self.owes = False
        self._pipe: Any = None
        self._process: Any = None

    @property
    def alive(self) -> bool:
        """Whether the process was started and is not known to have ended."""
        return self._process is not None

    def start(self, context: Any) -> None:
        """Start the process."""
        ours, theirs = context.Pipe()
        forked = context.get_start_method() == "fork"
        process = context.Process(
            target=serve, args=(theirs, ours if forked else None), name=f"simenv_marl {self.name}", daemon=True
        )
        try:
            process.start()
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()
        self._pipe, self._process, self.owes = ours, process, False

    def send(self, message: bytes) -> None:
        """Send a message to the worker, after the answer to one whose wait was interrupted."""
        if self.owes:
            self.receive()
        if not self.alive:
            raise WorkerError(f"{self.name} is dead; reset() starts a new one")
        self.owes = True
        try:
            self._pipe.send_bytes(message)
        except OSError:
            raise self._died() from None
        except BaseException:  # a part of the message may have been sent
            self.stop()
            raise

    def answers_within(self, seconds: float | None) -> bool:
        """Wait until the worker answers or dies; return whether it did within that time."""
        return bool(wait([self._pipe, self._process.sentinel], seconds))

    def receive(self) -> tuple[Any, BaseException | None]:
        """Wait for the answer. Return the result, or None and the error, also if the worker is dead."""
        self.answers_within(None)
        try:
            if not self._pipe.poll():
                raise EOFError
            parcel = self._pipe.recv_bytes()
        except (EOFError, OSError):
            return None, self._died()
        except BaseException:  # a part of the answer may have been received
            self.stop()
            raise
        self.owes = False
        result, error = unpack_outcome(parcel)
        if error is not None:
            annotate(error, f"simenv_marl: in {self.name}")
        return result, error

    def _died(self) -> WorkerError:
        """Clean up after a dead worker. Return the error that says how it died."""
        process = self._process
        process.join(1.0)  # the pipe closes a moment before the process ends
        code = process.exitcode
        self.stop()
        how = "closed its pipe" if code is None else f"died with exit code {code}"
        script = (
            '. In a script, make environments with workers under `if __name__ == "__main__":`, because each worker'
            " imports the script"
            if code == 1  # an error has ended it before it could send a message
            else ""
        )
        return WorkerError(
            f"{self.name} {how}; it was killed, or a simulation ended the process. reset() starts a new one{script}"
        )

    def ask_to_end(self) -> None:
        """Ask the worker to unwind its simulations and to end. It sends no answer."""
        if self.alive:
            with suppress(OSError):
                self._pipe.send_bytes(EXIT)

    def stop(self, seconds: float = 0.0) -> None:
        """End the process, by force if it does not end within some seconds."""
        process, pipe = self._process, self._pipe
        self._process = self._pipe = None
        self.owes = False
        if process is None:
            return
        pipe.close()
        process.join(seconds)
        for force in (process.terminate, process.kill):
            if process.exitcode is None:
                force()
                process.join(1.0)
        if process.exitcode is not None:
            process.close()


class WorkerPool:
    """Workers with the interface of a ``SimulationBatch``.

    Attributes:
        states: The ``State`` of each sub-environment, an array of shape ``(number,)``.
        idle: True: no simulation runs in this process.
    """

    idle = True

    def __init__(self, kind: SubEnvironmentType, number: int, mode: AutoresetMode, workers: int, context: Any) -> None:
        """Start the workers, each with a part of the sub-environments."""
        self._context = _context(context)
        self._space, self._mode = kind.observation_space, mode
        self._observations = create_empty_array(self._space, number)
        self.states = np.full(number, State.NEW)
        self._process = os.getpid()
        try:
            self._parcel = pack_plainly(kind.arguments)
        except Exception as error:
            raise OptionValueError(
                "the simulation, its points or its options cannot be sent to another process"
                f" ({describe_error(error)}); pass a"
                " class or a factory of a module, or workers=0"
            ) from error
        workers = min(workers, number)
        cuts = [number * part // workers for part in range(workers + 1)]
        self._workers = [Worker(part, cuts[part], cuts[part + 1]) for part in range(workers)]
        try:
            self._hire()
        except BaseException:
            self.abandon()
            raise

    def _hire(self) -> None:
        """Start the workers that do not run."""
        new = [worker for worker in self._workers if not worker.alive]
        try:
            for worker in new:
                worker.start(self._context)
            self._ask("make", lambda each: (self._parcel, each.end - each.first, self._mode, each.first), new)
        except BaseException:
            for worker in new:
                worker.stop()
            raise

    def _ask(
        self, method: str, arguments: Callable[[Worker], tuple[Any, ...]], new: Sequence[Worker] | None = None
    ) -> list[Any]:
        """Call a method of all batches, or of those of new workers; return the results, or raise the first error."""
        self._check_process()
        asked = self._workers if new is None else new
        messages = [pack_plainly((method, arguments(worker))) for worker in asked]
        try:
            for worker, message in zip(asked, messages, strict=True):
                worker.send(message)
            answers = [worker.receive() for worker in asked]
        finally:
            if not all(worker.alive for worker in asked):
                self.states[self.states != State.NEW] = State.FAILED
        for _, error in answers:
            if error is not None:
                raise error
        return [result for result, _ in answers]

    def _check_process(self) -> None:
        if os.getpid() != self._process:
            raise WorkerError(
                "the workers belong to the process from which this one was forked; make a new environment"
            )

    # -- the interface of a batch -----------------------------------------------------------------

    def reset(
        self, seeds: Sequence[int | None], options: dict[str, Any] | None, chosen: Sequence[int]
    ) -> tuple[Any, Infos]:
        """Do as ``SimulationBatch.reset``, after a restart of the workers that have died."""
        before, self.states = self.states, np.where(self.states == State.NEW, State.NEW, State.FAILED)
        self._hire()

        def arguments(worker: Worker) -> tuple[Any, ...]:
            own = [number - worker.first for number in chosen if worker.first <= number < worker.end]
            return seeds[worker.first : worker.end], options, own

        answers = self._ask("reset", arguments)
        self.states = before
        self.states[chosen] = State.RUNNING
        observations, infos = zip(*answers, strict=True)
        return self._joined(observations), self._numbered(infos)

    def check(self, actions: Sequence[Any]) -> list[Any]:
        """Do as ``SimulationBatch.check``."""
        return list(chain.from_iterable(self._ask("check", lambda each: (actions[each.first : each.end],))))

    def step(self, actions: Sequence[Any]) -> Results:
        """Do as ``SimulationBatch.step``."""
        self.states[:] = State.FAILED  # unless all workers answer
        answers = self._ask("step", lambda each: (actions[each.first : each.end],))
        observations, *arrays, infos = zip(*answers, strict=True)
        rewards, terminations, truncations = map(np.concatenate, arrays)
        over = (terminations | truncations) & (self._mode != AutoresetMode.SAME_STEP)
        self.states[:] = np.where(over, State.ENDED, State.RUNNING)
        return self._joined(observations), rewards, terminations, truncations, self._numbered(infos)

    def _joined(self, parts: Sequence[Any]) -> Any:
        """Join the observations of all workers, in arrays that the next call overwrites."""
        self._observations = _join(self._space, parts, self._observations)
        return self._observations

    def _numbered(self, parts: Sequence[Infos]) -> Infos:
        """Join the infos of all workers, whose numbers begin at zero."""
        workers = zip(self._workers, parts, strict=True)
        return [(worker.first + number, info) for worker, part in workers for number, info in part]

    @property
    def views(self) -> list[Any]:
        """Raise an error: the sub-environments are in other processes."""
        raise AttributeError("the sub-environments are in other processes; use call(), get_attr() and set_attr()")

    def call(self, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[Any]:
        """Do as ``SimulationBatch.call``."""
        return list(chain.from_iterable(self._ask("call", lambda _: (name, args, kwargs))))

    def set_attr(self, name: str, values: Sequence[Any]) -> None:
        """Do as ``SimulationBatch.set_attr``."""
        self._ask("set_attr", lambda each: (name, values[each.first : each.end]))

    def close(self) -> None:
        """Do as ``SimulationBatch.close``, and end the workers, by force after some seconds."""
        self._check_process()
        deadline = monotonic() + SECONDS_TO_CLOSE
        asked = [worker for worker in self._workers if worker.alive and not worker.owes]
        try:
            for worker in asked:
                with suppress(WorkerError):
                    worker.send(pack_plainly(("close", ())))
            there = [worker for worker in asked if worker.alive]
            ready = [worker for worker in there if worker.answers_within(max(deadline - monotonic(), 0.0))]
            if len(ready) < len(there):
                warn_user(f"workers did not close within {SECONDS_TO_CLOSE} s and are killed", ResourceWarning)
            for worker in ready:
                _, error = worker.receive()
                if error is not None and worker.alive:  # nothing is left to close in one that is dead
                    raise error
        finally:
            self.abandon()

    def abandon(self) -> None:
        """End the workers. A finalizer may call this; it raises no errors."""
        if os.getpid() != self._process:
            return  # the workers belong to the process of which this one is a fork
        for worker in self._workers:
            worker.ask_to_end()
        deadline = monotonic() + SECONDS_TO_CLOSE
        for worker in self._workers:
            worker.stop(max(deadline - monotonic(), 0.0))


def _join(space: spaces.Space[Any], parts: Sequence[Any], out: Any) -> Any:
    """Join batches of a space into one, which is written into ``out`` where it consists of arrays."""
    if isinstance(space, spaces.Dict):
        return {key: _join(inner, [part[key] for part in parts], out[key]) for key, inner in space.spaces.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(_join(inner, [part[i] for part in parts], out[i]) for i, inner in enumerate(space.spaces))
    if isinstance(out, np.ndarray):
        return np.concatenate(parts, out=out)
    return tuple(chain.from_iterable(parts))


def _context(context: Any) -> Any:
    if isinstance(context, BaseContext):
        return context
    try:
        return multiprocessing.get_context("spawn" if context is None else context)
    except (TypeError, ValueError):
        raise OptionValueError(
            f"context must be one of {', '.join(map(repr, multiprocessing.get_all_start_methods()))}, or a context"
            f" of multiprocessing, not {short_repr(context)}"
        ) from None
