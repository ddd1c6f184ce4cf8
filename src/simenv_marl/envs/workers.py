"""Rows of simulations in worker processes: how the user starts, asks and ends them.

No wait here lasts for ever. A wait for an answer also ends when the worker dies, and a worker's pipe closes when its
user ends. The shared memory has no name, and there are no semaphores. So even a killed process leaves nothing behind.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from time import monotonic
from typing import Any, Final

import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import concatenate

from ..core.packing import pack_plainly, unpack_error
from ..errors import OptionValueError, WorkerError, annotate, describe_error, short_repr, warn_user
from .rows import SubEnvironments, Told
from .worker import EXIT, Recipe, is_shareable, share_memory, shared_batch, work

SECONDS_TO_CLOSE: Final = 10.0
"""The seconds that a worker may take to unwind its simulations and to end."""


class Worker:
    """A process with some of the simulations.

    Attributes:
        first, end: The number of its first simulation, and the number after that of its last one.
        name: Its name in messages.
    """

    def __init__(self, number: int, first: int, end: int) -> None:
        self.first, self.end = first, end
        self.name = f"worker {number} (of the sub-environments {first} to {end - 1})"
        self._pipe: Connection | None = None
        self._process: Any = None

    @property
    def there(self) -> bool:
        """Whether the process was started and has not been ended."""
        return self._pipe is not None

    def start(
        self, context: Any, inherited: list[Connection], recipe: bytes, memory: Any, setup: dict[str, Any]
    ) -> None:
        """Start the process. It sends a message when it is ready, or when it has failed."""
        ours, theirs = context.Pipe()
        setup = {**setup, "first": self.first, "end": self.end}
        forked = context.get_start_method() == "fork"
        self._process = context.Process(
            target=work,
            args=(theirs, [*inherited, ours] if forked else [], recipe, memory),
            kwargs=setup,
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
        """The pipe to the worker.

        Raises:
            WorkerError: The worker is dead.
        """
        if self._pipe is None:
            raise WorkerError(f"{self.name} is dead; reset() starts a new one")
        return self._pipe

    @property
    def sentinel(self) -> int:
        """The handle that becomes ready when the process ends."""
        return int(self._process.sentinel)

    def send(self, message: bytes) -> None:
        """Send a message to the worker.

        Raises:
            WorkerError: The worker is dead.
        """
        try:
            self.pipe.send_bytes(message)
        except OSError:
            raise self.died() from None
        except BaseException:  # a part of the message may have been sent
            self.end_now()
            raise

    def receive(self) -> Any:
        """Receive a message from the worker.

        Raises:
            WorkerError: The worker is dead.
        """
        try:
            return pickle.loads(self.pipe.recv_bytes())
        except (EOFError, OSError):
            raise self.died() from None
        except BaseException:
            self.end_now()
            raise

    def died(self) -> WorkerError:
        """Clean up after a dead worker. Return the error that says how it died."""
        process = self._process
        process.join(1.0)  # the pipe closes a moment before the process ends
        code = process.exitcode
        self.end_now()
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

    def end_now(self, seconds: float = 0.0) -> None:
        """End the process. Use force if it does not end by itself within some seconds."""
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
    """Rows in worker processes, with the interface of a ``Row``.

    Attributes:
        failed: Whether an error has left the sub-environments out of step, so that all must be reset.
        batch: The arrays into which the workers write their results.
    """

    def __init__(
        self, recipe: Recipe, common: SubEnvironments, mode: AutoresetMode, number: int, workers: int, context: Any
    ) -> None:
        """Start the workers.

        Raises:
            OptionValueError: There is no such context, or the arguments of the environment cannot be pickled.
            WorkerError: A worker died.
            BaseException: Any error of making a simulation.
        """
        self._context = _context(context)
        self._space, self._mode, self._number = common.single_observation_space, mode, number
        try:
            self._recipe = pack_plainly(recipe.spelt_out(common))
        except Exception as error:
            raise OptionValueError(
                "the simulation, its points or its options cannot be sent to another process"
                f" ({describe_error(error)}); pass a"
                " class or a factory of a module, or workers=0"
            ) from error
        self._memory = share_memory(self._space, number, self._context)
        self.batch = shared_batch(self._space, number, self._memory)
        self._rows: list[Any] = [None] * number
        self._shared = is_shareable(self._space)
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
        """Start the workers that do not run."""
        new = [worker for worker in self._workers if not worker.there]
        if not new:
            return
        setup = {"number": self._number, "mode": self._mode}
        for worker in new:
            inherited = [other.pipe for other in self._workers if other.there]
            worker.start(self._context, inherited, self._recipe, self._memory, setup)
        self._gather(new, 0)

    def _ask(self, method: str, arguments: Callable[[Worker], tuple[Any, ...] | None]) -> list[tuple[Worker, Any]]:
        """Call a method of the rows of all workers for which there are arguments, and wait for the answers.

        Raises:
            WorkerError: A worker is dead.
            BaseException: The error of the first worker that has raised one.
        """
        self._be_theirs()
        self._identity += 1
        messages = [(worker, arguments(worker)) for worker in self._workers]
        packed = [
            (worker, pack_plainly((self._identity, method, given))) for worker, given in messages if given is not None
        ]
        for worker, message in packed:
            worker.send(message)
        return self._gather([worker for worker, _ in packed], self._identity)

    def _be_theirs(self) -> None:
        """Make sure that the workers belong to this process.

        Raises:
            WorkerError: This process is a fork of the one to which they belong.
        """
        if os.getpid() != self._process:
            raise WorkerError(
                "the workers belong to the process from which this one was forked; make a new environment"
            )

    def _gather(self, asked: list[Worker], identity: int) -> list[tuple[Worker, Any]]:
        """Wait for answers.

        Raises:
            BaseException: The error of the first worker that has raised one.
        """
        results, errors = self._collect(asked, identity)
        for worker in asked:
            if worker in errors:
                raise errors[worker]
        return list(results.items())

    def _collect(
        self, asked: list[Worker], identity: int, seconds: float | None = None
    ) -> tuple[dict[Worker, Any], dict[Worker, BaseException]]:
        """Wait until all workers have answered or died, or until a timeout. Return their results and their errors."""
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
                    if worker.pipe not in ready and not worker.pipe.poll():  # died without an answer
                        raise worker.died()
                    answered, fine, answer = worker.receive()
                except WorkerError as error:
                    errors[worker] = error
                    continue
                if answered != identity:
                    continue  # the answer to a request whose wait was interrupted
                if fine:
                    results[worker] = answer
                else:
                    errors[worker] = unpack_error(answer)
                    annotate(errors[worker], f"simenv_marl: in {worker.name}")
        return {worker: results[worker] for worker in asked if worker in results}, errors

    # -- the interface of a row -------------------------------------------------------------------

    @property
    def ended(self) -> set[int]:
        """The numbers of the sub-environments whose episode has ended, with no new one begun."""
        batch = self.batch
        if self._mode == AutoresetMode.SAME_STEP or not (batch.terminations.any() or batch.truncations.any()):
            return set()
        return set(np.flatnonzero(batch.terminations | batch.truncations).tolist())

    @property
    def views(self) -> list[Any]:
        """Raise an error: the sub-environments are in other processes."""
        raise AttributeError("the sub-environments are in other processes; use call(), get_attr() and set_attr()")

    def reset(self, seeds: Sequence[int | None], options: dict[str, Any] | None, chosen: Sequence[int]) -> Told:
        """Do as ``Row.reset``, after a restart of the workers that have died."""
        self.failed = True

        def arguments(worker: Worker) -> tuple[Any, ...] | None:
            own = [number - worker.first for number in chosen if worker.first <= number < worker.end]
            return (seeds[worker.first : worker.end], options, own) if own else None

        self._hire()
        told = self._told(self._ask("reset", arguments))
        self.failed = False
        return told

    def check(self, actions: Sequence[Any]) -> None:
        """Do as ``Row.check``."""
        self._ask("check", lambda worker: (actions[worker.first : worker.end],))

    def step(self, actions: Sequence[Any]) -> Told:
        """Do as ``Row.step``."""
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
        """Do as ``Row.call``."""
        return [value for _, values in self._ask("call", lambda _: (name, args, kwargs)) for value in values]

    def set_attr(self, name: str, values: Sequence[Any]) -> None:
        """Do as ``Row.set_attr``."""
        self._ask("set_attr", lambda worker: (name, values[worker.first : worker.end]))

    def close(self) -> None:
        """Unwind all simulations and end the workers, by force after some seconds.

        Raises:
            BaseException: The first error that a simulation raises. The others are unwound nevertheless.
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
                warn_user(f"workers did not close within {SECONDS_TO_CLOSE} s and are killed", ResourceWarning)
            for worker, error in errors.items():
                if worker.there:  # otherwise it has died, and nothing is left to close
                    raise error
        finally:
            self.abandon()

    @property
    def suspended(self) -> bool:
        """Return False: no simulation runs in this process."""
        return False

    def abandon(self) -> None:
        """End the workers. A finalizer may call this; it raises no errors."""
        if os.getpid() != self._process:
            return  # the workers belong to the process of which this one is a fork
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
                f" of multiprocessing, not {short_repr(context)}"
            ) from None
    if not hasattr(context, "Process"):
        raise OptionValueError(f"context must be a name or a context of multiprocessing, not {short_repr(context)}")
    return context
