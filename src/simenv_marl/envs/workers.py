"""Rows of simulations in processes of their own: how their user starts them, asks them, and brings them to an end.

Nothing here can wait for ever: a wait for a worker also is one for its death, and a worker whose user is gone finds its
pipe closed. The memory has no name and there are no semaphores, so that nothing is left behind even by a process that
is killed.
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

from ..core.processes import pack_plainly, unpack_error
from ..errors import OptionValueError, WorkerError, annotate, shown, told, warn_user
from .rows import SubEnvironments, Told
from .worker import EXIT, Recipe, is_shareable, share_memory, shared_batch, work

SECONDS_TO_CLOSE: Final = 10.0
"""How long a worker may take to unwind its simulations and to end."""


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
        self, recipe: Recipe, common: SubEnvironments, mode: AutoresetMode, number: int, workers: int, context: Any
    ) -> None:
        """Start the workers.

        Raises:
            OptionValueError: There is no such context, or what the environment is made of cannot be pickled.
            WorkerError: A worker died.
            BaseException: What making a simulation raises.
        """
        self._context = _context(context)
        self._space, self._mode, self._number = common.single_observation_space, mode, number
        try:
            self._recipe = pack_plainly(recipe.spelt_out(common))
        except Exception as error:
            raise OptionValueError(
                f"what the simulations are made of cannot be sent to another process ({told(error)});"
                " give a class or a factory that a module holds, or workers=0"
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
        messages = [(worker, arguments(worker)) for worker in self._workers]
        packed = [
            (worker, pack_plainly((self._identity, method, given))) for worker, given in messages if given is not None
        ]
        for worker, message in packed:
            worker.send(message)
        return self._gather([worker for worker, _ in packed], self._identity)

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
    def views(self) -> list[Any]:
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
        """Whether something is still to be ended here: nothing is."""
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
                f" of multiprocessing, not {shown(context)}"
            ) from None
    if not hasattr(context, "Process"):
        raise OptionValueError(f"context must be a name or a context of multiprocessing, not {shown(context)}")
    return context
