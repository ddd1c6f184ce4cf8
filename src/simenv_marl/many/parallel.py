"""Work on many simulations in several processes.

``spread`` runs work that needs nothing from earlier work in processes of joblib, local or remote. A ``WorkerPool`` has
processes of its own, in which objects live on between calls.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from importlib import import_module
from math import ceil
from multiprocessing.connection import Connection, wait
from multiprocessing.context import BaseContext
from time import monotonic
from types import FunctionType
from typing import Any, Final

import numpy as np

from ..core.packing import pack, pack_outcome, pack_plainly, unpack, unpack_outcome
from ..errors import (
    MissingExtraError,
    OptionValueError,
    WorkerError,
    annotate,
    describe_error,
    short_repr,
    warn_user,
)

EXTRAS: Final = {"joblib": "many", "tqdm": "many", "matplotlib": "plots"}
"""The extra that installs a package. All other packages belong to ``experiments``."""


def import_extra(module: str, feature: str) -> Any:
    """Import a module that an extra installs, or raise an error that says which feature needs which extra."""
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        extra = EXTRAS.get(package, "experiments")
        raise MissingExtraError(f"{feature} needs {package}: install simenv-marl[{extra}] ({error})") from None


def progress_bar(total: int, unit: str = "simulation", done: int = 0) -> Any:
    """Return a progress bar over ``total`` units, of which some are done already."""
    return import_extra("tqdm.auto", "progress=True").tqdm(total=total, unit=unit, initial=done)


# -- processes of joblib --------------------------------------------------------------------------


def spread(
    work: Callable[..., Any],
    arguments: tuple[Any, ...],
    seeds: Sequence[Any],
    workers: int,
    least: int,
    share: int = 4,
) -> Iterator[tuple[int, Any]]:
    """Call ``work``, a function of this package, in worker processes: for each part of the seeds (or of other items).

    With -1 workers there are as many as joblib's backend has. A process gets about ``share`` parts, none of which is
    smaller than ``least`` as long as every process gets some seeds.

    Yields:
        The number of seeds of a part, and the function's result; in the order of the seeds.
    """
    joblib = import_extra("joblib", f"workers={workers}")
    processes = max(1, joblib.effective_n_jobs(workers))
    size = max(1, ceil(len(seeds) / (share * processes)), min(least, ceil(len(seeds) / processes)))
    parts = [list(seeds[start : start + size]) for start in range(0, len(seeds), size)]
    parcel = _pack_with_names((work, arguments))
    try:
        parallel = joblib.Parallel(n_jobs=workers, batch_size=1, return_as="generator")
    except ValueError:  # this backend returns nothing before all work is done
        parallel = joblib.Parallel(n_jobs=workers, batch_size=1)
    # Errors are packed in the worker, because each backend would pass them on in its own way.
    outcomes = parallel(joblib.delayed(pack_outcome)(pack, _work, parcel, part) for part in parts)
    try:
        for part, outcome in zip(parts, outcomes, strict=True):
            result, error = unpack_outcome(outcome)
            if error is not None:
                raise error
            yield len(part), result
    finally:
        if hasattr(outcomes, "close"):  # cancels the remaining work when the caller stops reading results
            with warnings.catch_warnings():  # joblib warns that it cancels
                warnings.simplefilter("ignore")
                outcomes.close()


_IN_SCRIPT: Final = re.compile(rb"__main__\.([A-Za-z_]\w*)")

_received: Final[set[str]] = set()
"""The names in this process's main module that came from another process's script."""


def _pack_with_names(thing: Any) -> bytes:
    """Pickle an object for workers, with the functions of this process's script that it refers to by dotted name."""
    parcel, main = pack((thing, {})), sys.modules["__main__"]
    named = {name.decode(): getattr(main, name.decode(), None) for name in set(_IN_SCRIPT.findall(parcel))}
    named = {name: found for name, found in named.items() if isinstance(found, (type, FunctionType))}
    return pack((thing, named)) if named else parcel


def _work(parcel: bytes, seeds: list[Any]) -> Any:
    """Call the function, in a worker. The functions it refers to by name are put into the main module."""
    (work, arguments), named = unpack(parcel)
    main = sys.modules["__main__"]
    for name, found in named.items():
        if name in _received or not hasattr(main, name):
            setattr(main, name, found)
            _received.add(name)
    return work(*arguments, seeds)


# -- processes of their own -----------------------------------------------------------------------

SECONDS_TO_CLOSE: Final = 10.0
"""The seconds that a worker may take to close its object and to end."""

EXIT: Final = b""
"""The message that asks a worker to end."""


def serve(pipe: Connection, other_end: Connection | None) -> None:
    """Answer messages in a worker, each a packed pair: a callable that makes an object, then methods, and arguments.

    ``other_end`` is the user's end of the pipe, if a fork has copied it.
    """
    with suppress(ValueError):  # not in the main thread
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the user's process, which decides what to do
    if other_end is not None:
        other_end.close()
    made: Any = None

    def answer(message: bytes) -> Any:
        nonlocal made
        method, arguments = unpack(message)
        if made is not None:
            return getattr(made, method)(*arguments)
        made = method(*arguments)
        return None

    try:
        while (message := pipe.recv_bytes()) != EXIT:
            pipe.send_bytes(pack_outcome(pack_plainly, answer, message))
    except (EOFError, OSError):  # the user's process has ended
        pass
    finally:
        if made is not None:
            made.abandon()


class Worker:
    """A process with some of the simulations, as its user sees it.

    Attributes:
        part: The numbers of its simulations.
        recipe: The message that makes its object.
        name: Its name in messages.
        pipe: The user's end of the pipe. None if the process does not run.
        owes: Whether it has not yet answered the last message.
    """

    def __init__(self, number: int, part: range, recipe: bytes) -> None:
        self.part, self.recipe = part, recipe
        self.name = f"worker {number} (of the sub-environments {part.start} to {part.stop - 1})"
        self.owes = False
        self.pipe: Any = None
        self._process: Any = None

    @property
    def alive(self) -> bool:
        """Whether the process was started and is not known to have ended."""
        return self._process is not None

    def start(self, context: Any) -> None:
        """Start the process."""
        ours, theirs = context.Pipe()
        copied = ours if context.get_start_method() == "fork" else None
        process = context.Process(target=serve, args=(theirs, copied), name=f"simenv_marl {self.name}", daemon=True)
        try:
            process.start()
        except BaseException:
            ours.close()
            raise
        finally:
            theirs.close()
        self.pipe, self._process, self.owes = ours, process, False

    def send(self, message: bytes) -> None:
        """Send a message to the worker, after the answer to one whose wait was interrupted."""
        if self.owes:
            self.receive()
        if not self.alive:
            raise WorkerError(f"{self.name} is dead; reset() starts a new one")
        self.owes = True
        try:
            self.pipe.send_bytes(message)
        except OSError:
            raise self._died() from None
        except BaseException:  # a part of the message may have been sent
            self.stop()
            raise

    def answers_within(self, seconds: float | None) -> bool:
        """Wait until the worker answers or dies; return whether it did within that time."""
        return bool(wait([self.pipe, self._process.sentinel], seconds))

    def receive(self) -> tuple[Any, BaseException | None]:
        """Wait for the answer. Return the result, or None and the error, also if the worker is dead."""
        self.answers_within(None)
        try:
            if not self.pipe.poll():
                raise EOFError
            parcel = self.pipe.recv_bytes()
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

    def stop(self, seconds: float = 0.0) -> None:
        """End the process, by force if it does not end within some seconds."""
        process, pipe = self._process, self.pipe
        self._process = self.pipe = None
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
    """Worker processes, each of which has an object with a part of the simulations.

    No wait lasts for ever: a wait for an answer also ends when the worker dies, and a worker's pipe closes when its
    user ends.

    Attributes:
        intact: Set to False if a worker is found dead.
        idle: True: no simulation runs in this process.
    """

    intact = idle = True

    def __init__(
        self, make: Callable[..., Any], arguments: tuple[Any, ...], number: int, workers: int, context: Any
    ) -> None:
        """Start at most so many workers, each of which calls ``make`` with the arguments and a range of the numbers.

        ``make`` is a function of this package. It returns an object that has the methods ``close`` and ``abandon``.
        """
        self._process = os.getpid()
        self._workers: list[Worker] = []
        try:
            self._context = context
            if not isinstance(context, BaseContext):
                self._context = multiprocessing.get_context("spawn" if context is None else context)
        except (TypeError, ValueError):
            raise OptionValueError(
                f"context must be one of {', '.join(map(repr, multiprocessing.get_all_start_methods()))}, or a context"
                f" of multiprocessing, not {short_repr(context)}"
            ) from None
        workers = min(workers, number)
        for place in range(workers):
            part = range(number * place // workers, number * (place + 1) // workers)
            try:
                recipe = pack_plainly((make, (*arguments, part)))
            except Exception as error:
                raise OptionValueError(
                    "the simulation, its points or its options cannot be sent to another process"
                    f" ({describe_error(error)}); pass a class or a factory of a module, or workers=0"
                ) from error
            self._workers.append(Worker(place, part, recipe))
        self._start_missing()

    @property
    def _owned(self) -> bool:
        """Whether this process has started the workers, and is not a fork of the one that has."""
        return os.getpid() == self._process

    def _start_missing(self) -> None:
        """Start the workers that do not run."""
        new = [worker for worker in self._workers if not worker.alive]
        try:
            for worker in new:
                worker.start(self._context)
            self._exchange(new, [worker.recipe for worker in new])
        except BaseException:
            for worker in new:
                worker.stop()
            raise

    def _exchange(self, workers: Sequence[Worker], messages: Sequence[bytes]) -> list[Any]:
        """Send each worker its message, and return the answers of all, or raise the first error."""
        for worker, message in zip(workers, messages, strict=True):
            worker.send(message)
        answers = [worker.receive() for worker in workers]
        for _, error in answers:
            if error is not None:
                raise error
        return [result for result, _ in answers]

    def ask(self, method: str, *arguments: Any) -> list[Any]:
        """Call a method of each worker's object; return the results, or raise the first error.

        Of lists and arrays, which have an item for each simulation, each worker gets its part. For a reset, workers
        that have died are replaced.
        """
        if not self._owned:
            raise WorkerError(
                "the workers belong to the process from which this one was forked; make a new environment"
            )
        if method == "reset":
            self._start_missing()
        messages = []
        for worker in self._workers:
            part = slice(worker.part.start, worker.part.stop)
            own = [each[part] if isinstance(each, (list, np.ndarray)) else each for each in arguments]
            messages.append(pack_plainly((method, own)))
        try:
            return self._exchange(self._workers, messages)
        finally:
            self.intact = self.intact and all(worker.alive for worker in self._workers)

    def close(self) -> None:
        """Close the objects and end the workers, by force after some seconds. Raise the first error of an object."""
        deadline = monotonic() + SECONDS_TO_CLOSE
        asked = [worker for worker in self._workers if worker.alive and not worker.owes and self._owned]
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
        workers = [worker for worker in self._workers if worker.alive and self._owned]
        for worker in workers:
            with suppress(OSError):
                worker.pipe.send_bytes(EXIT)
        deadline = monotonic() + SECONDS_TO_CLOSE
        for worker in workers:
            worker.stop(max(deadline - monotonic(), 0.0))
