"""Work on many simulations in several processes.

``spread`` runs work that needs nothing from earlier work in processes of joblib, local or remote. A
``WorkerPool`` has processes of its own, in which objects live on between calls.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext, suppress
from importlib import import_module
from math import ceil
from multiprocessing.connection import Connection, wait
from multiprocessing.context import BaseContext
from time import monotonic
from types import FunctionType, SimpleNamespace
from typing import Any, Final

import numpy as np

from ..core import COUNTS, count, pack, pack_outcome, pack_plainly, unpack, unpack_outcome
from ..errors import (
    MissingExtraError,
    OptionValueError,
    WorkerError,
    annotate,
    describe_error,
    short_repr,
    warn_user,
)

EXTRAS: Final = {
    "joblib": "many",
    "tqdm": "many",
    "matplotlib": "plots",
    "pyDOE": "design",
    "SALib": "design",
    "openai": "language",
    "starlette": "play",
    "uvicorn": "play",
    "websockets": "play",
}
"""The extra that installs a package. All other packages belong to ``experiments``."""


def import_extra(module: str, feature: str) -> Any:
    """Import a module that an extra installs, or raise an error that says which feature needs which extra."""
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        extra = EXTRAS.get(package, "experiments")
        raise MissingExtraError(
            f"{feature} needs {package}: install simenv-marl[{extra}] ({error})"
        ) from None


NO_BAR: Final[Any] = SimpleNamespace(update=lambda number=1: None)
"""A progress bar that shows nothing."""


def progress_bar(total: int, progress: bool, unit: str = "simulation", done: int = 0) -> Any:
    """Return a context with a progress bar over ``total`` units, of which some are done.

    Without ``progress``, none.
    """
    if not progress:
        return nullcontext(NO_BAR)
    return import_extra("tqdm.auto", "progress=True").tqdm(total=total, unit=unit, initial=done)


# -- processes of joblib --------------------------------------------------------------------------


def spread(
    work: Callable[..., Any],
    arguments: tuple[Any, ...],
    items: Sequence[Any],
    workers: int,
    least: int,
    bar: Any,
    share: int = 4,
) -> list[Any]:
    """Call ``work``, a function of this package, for all items in this process, or for parts of them in workers.

    It gets the arguments, the items, and a progress bar. Results have the order of the items. -1
    workers are as many as joblib's backend has. A worker gets about ``share`` parts of at least
    ``least`` items, unless one would get none.
    """
    if not workers or not items:
        return [work(*arguments, items, bar)]
    joblib = import_extra("joblib", f"workers={workers}")
    processes = max(1, joblib.effective_n_jobs(workers))
    size = max(1, ceil(len(items) / (share * processes)), min(least, ceil(len(items) / processes)))
    parts = [items[start : start + size] for start in range(0, len(items), size)]
    parcel, home = _pack_with_names((work, arguments)), os.getpid()
    try:
        parallel = joblib.Parallel(n_jobs=workers, batch_size=1, return_as="generator")
    except ValueError:  # this backend returns nothing before all work is done
        parallel = joblib.Parallel(n_jobs=workers, batch_size=1)
    # Errors are packed in the worker, because each backend would pass them on in its own way.
    outcomes = parallel(
        joblib.delayed(pack_outcome)(pack, _work, parcel, home, part) for part in parts
    )
    results = []
    try:
        for part, outcome in zip(parts, outcomes, strict=True):
            result, error = unpack_outcome(outcome)
            if error is not None:
                raise error
            found, counts = result
            results.append(found)
            for token, numbers in counts.items():
                count(token, **numbers)
            bar.update(len(part))
    finally:
        if hasattr(outcomes, "close"):  # cancels the remaining work
            with warnings.catch_warnings():  # joblib warns that it cancels
                warnings.simplefilter("ignore")
                outcomes.close()
    return results


_IN_SCRIPT: Final = re.compile(rb"__main__\.([A-Za-z_]\w*)")

_received: Final[set[str]] = set()
"""The names in this process's main module that came from another process's script."""


def _pack_with_names(thing: Any) -> bytes:
    """Pickle an object for workers, with the functions of this process's script that it refers to by dotted name."""
    parcel, main = pack((thing, {})), sys.modules["__main__"]
    named = {
        name.decode(): getattr(main, name.decode(), None) for name in _IN_SCRIPT.findall(parcel)
    }
    named = {
        name: found for name, found in named.items() if isinstance(found, (type, FunctionType))
    }
    return pack((thing, named)) if named else parcel


def _work(parcel: bytes, home: int, items: list[Any]) -> tuple[Any, dict[str, dict[str, float]]]:
    """Call the function, in a worker.

    Return its result, and what policies have counted, unless it is at ``home``.

    The functions it refers to by name are put into the main module.
    """
    is_away = os.getpid() != home
    if is_away:
        COUNTS.clear()
    (work, arguments), named = unpack(parcel)
    main = sys.modules["__main__"]
    for name, found in named.items():
        if name in _received or not hasattr(main, name):
            setattr(main, name, found)
            _received.add(name)
    return work(*arguments, items, NO_BAR), COUNTS if is_away else {}


# -- processes of their own -----------------------------------------------------------------------

SECONDS_TO_CLOSE: Final = 10.0
"""The seconds that a worker may take to close its object and to end."""

EXIT: Final = b""
"""The message that asks a worker to end."""


def serve(pipe: Connection, other_end: Connection | None) -> None:
    """Answer messages in a worker, each a packed pair: a callable that makes an object, then methods, and arguments.

    ``other_end`` is the user's end of the pipe, if a fork has copied it.
    """
    # Ctrl-C goes to the user's process, which decides what to do
    signal.signal(signal.SIGINT, signal.SIG_IGN)
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
    """A process with some of the simulations, as its user sees it, who has one end of its pipe."""

    def __init__(self, context: Any, number: int, part: range) -> None:
        """Start the process."""
        self.name = f"worker {number} (of the sub-environments {part.start} to {part.stop - 1})"
        self.pipe, theirs = context.Pipe()
        copied = self.pipe if context.get_start_method() == "fork" else None
        name = f"simenv_marl {self.name}"
        self._process = context.Process(target=serve, args=(theirs, copied), name=name, daemon=True)
        try:
            self._process.start()
        except BaseException:
            self.pipe.close()
            raise
        finally:
            theirs.close()

    def send(self, message: bytes) -> None:
        """Send a message, or raise ``WorkerError`` if the worker is dead."""
        try:
            self.pipe.send_bytes(message)
        except OSError:
            raise self._died() from None

    def receive(self, seconds: float | None = None) -> tuple[Any, BaseException | None] | None:
        """Wait for the answer: a result, or None and an error.

        Return None if it does not come within some seconds.
        """
        if not wait([self.pipe, self._process.sentinel], seconds):
            return None
        try:
            if not self.pipe.poll():
                raise EOFError
            parcel = self.pipe.recv_bytes()
        except (EOFError, OSError):
            raise self._died() from None
        result, error = unpack_outcome(parcel)
        if error is not None:
            annotate(error, f"simenv_marl: in {self.name}")
        return result, error

    def _died(self) -> WorkerError:
        """Make the error that says how the worker died."""
        self._process.join(1.0)  # the pipe closes a moment before the process ends
        code = self._process.exitcode
        how = "closed its pipe" if code is None else f"died with exit code {code}"
        script = (
            '. In a script, make environments with workers under `if __name__ == "__main__":`,'
            " because each worker"
            " imports the script"
            if code == 1  # an error has ended it before it could send a message
            else ""
        )
        return WorkerError(
            f"{self.name} {how}; it was killed, or a simulation ended the process. reset() starts"
            f" new workers{script}"
        )

    def stop(self, seconds: float) -> None:
        """End the process, by force if it does not end within some seconds."""
        self.pipe.close()
        process = self._process
        process.join(seconds)
        for force in (process.terminate, process.kill):
            if process.exitcode is None:
                force()
                process.join(1.0)
        if process.exitcode is not None:
            process.close()


class WorkerPool:
    """Worker processes, each of which has an object with a part of the simulations.

    No wait lasts for ever: a wait for an answer also ends when the worker dies, and a worker's pipe
    closes when its user ends.

    Attributes:
        broken: Whether a worker has died, or a wait for an answer was interrupted. Then a reset
            starts all anew.
        failed: Whether an error has left the simulations at different steps, so that all of them
            need a reset.
        idle: True: no simulation runs in this process.
    """

    failed, idle = False, True

    def __init__(
        self,
        make: Callable[..., Any],
        arguments: tuple[Any, ...],
        number: int,
        workers: int,
        context: Any,
    ) -> None:
        """Start at most so many workers, each of which calls ``make`` with the arguments and a range of the numbers.

        ``make`` is a function of this package. It returns an object that has the methods ``close``
        and ``abandon``.
        """
        try:
            self._context = context
            if not isinstance(context, BaseContext):
                self._context = multiprocessing.get_context("spawn" if context is None else context)
        except (TypeError, ValueError):
            raise OptionValueError(
                "context must be one of"
                f" {', '.join(map(repr, multiprocessing.get_all_start_methods()))}, or a context"
                f" of multiprocessing, not {short_repr(context)}"
            ) from None
        cuts = [number * place // min(workers, number) for place in range(min(workers, number) + 1)]
        try:
            self._recipes = {
                part: pack_plainly((make, (*arguments, part)))
                for part in map(range, cuts, cuts[1:])
            }
        except Exception as error:
            raise OptionValueError(
                "the simulation, its points or its options cannot be sent to another process"
                f" ({describe_error(error)}); pass a class or a factory of a module, or workers=0"
            ) from error
        self._process = os.getpid()
        self._workers: list[Worker] = []
        self._start()

    def _start(self) -> None:
        """Start all workers, and have them make their objects."""
        self.broken = True
        try:
            for number, part in enumerate(self._recipes):
                self._workers.append(Worker(self._context, number, part))
            self._exchange(self._recipes.values())
            self.broken = False
        except BaseException:
            self.abandon()
            raise

    def _exchange(self, messages: Iterable[bytes]) -> list[Any]:
        """Send each worker its message, and return the answers of all, or raise the first error."""
        try:
            for worker, message in zip(self._workers, messages, strict=True):
                worker.send(message)
            answers: list[Any] = [worker.receive() for worker in self._workers]
        except BaseException:
            self.broken = self.failed = True
            raise
        for _, error in answers:
            if error is not None:
                raise error
        return [result for result, _ in answers]

    def ask(self, method: str, *arguments: Any) -> list[Any]:
        """Call a method of each worker's object; return the results, or raise the first error.

        Of lists and arrays, which have an item for each simulation, each worker gets its part.
        """
        if os.getpid() != self._process:
            raise WorkerError(
                "the workers belong to the process from which this one was forked; make a new"
                " environment"
            )
        if self.broken and method == "reset":
            self.abandon()
            self._start()
        elif self.broken:
            raise WorkerError(
                "a worker is dead, or a wait for it was interrupted; reset() starts new workers"
            )
        messages = []
        for part in self._recipes:
            own = [
                a[part.start : part.stop] if isinstance(a, (list, np.ndarray)) else a
                for a in arguments
            ]
            messages.append(pack_plainly((method, own)))
        moves = method in ("reset", "step")
        self.failed = self.failed or moves
        answers = self._exchange(messages)
        self.failed = self.failed and not moves
        return answers

    def close(self) -> None:
        """Close the objects and end the workers, by force after some seconds.

        Raise the first error of an object.
        """
        deadline = monotonic() + SECONDS_TO_CLOSE
        asked = [] if self.broken or os.getpid() != self._process else self._workers
        answers: list[Any] = []
        try:
            with suppress(WorkerError):  # nothing is left to close in a worker that is dead
                for worker in asked:
                    worker.send(pack_plainly(("close", ())))
                answers = [worker.receive(max(deadline - monotonic(), 0.0)) for worker in asked]
            if None in answers:
                warn_user(
                    f"workers did not close within {SECONDS_TO_CLOSE} s and are killed",
                    ResourceWarning,
                )
            for _, error in filter(None, answers):
                if error is not None:
                    raise error
        finally:
            self.abandon()

    def abandon(self) -> None:
        """End the workers. A finalizer may call this; it raises no errors."""
        if os.getpid() != self._process:
            return  # the workers belong to the process of which this one is a fork
        workers, self._workers = self._workers, []
        for worker in workers:
            with suppress(OSError):
                worker.pipe.send_bytes(EXIT)
        deadline = monotonic() + SECONDS_TO_CLOSE
        for worker in workers:
            worker.stop(max(deadline - monotonic(), 0.0))
