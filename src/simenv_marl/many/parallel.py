"""Work on many simulations in several processes.

``spread`` runs work that needs nothing from earlier work in processes of joblib, local or remote. A
``WorkerPool`` starts processes in which objects live on between calls.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext, suppress
from importlib import import_module
from math import ceil, inf
from multiprocessing.connection import Connection
from multiprocessing.context import BaseContext
from tempfile import mkstemp
from threading import Event, Thread
from time import monotonic
from typing import Any, Final, TypeVar

import numpy as np

from ..core import (
    COUNTS,
    Peer,
    count,
    pack,
    pack_outcome,
    pack_plainly,
    pack_request,
    serve,
    unpack,
    unpack_outcome,
)
from ..errors import (
    MissingExtraError,
    OptionValueError,
    WorkerError,
    annotate,
    describe_error,
    short_repr,
    warn_user,
)
from .alone import run_alone
from .loads import Load, loaded

Result = TypeVar("Result")

EXTRAS: Final = {
    "joblib": "many",
    "tqdm": "many",
    "matplotlib": "plots",
    "pyDOE": "design",
    "SALib": "design",
    "openai": "language",
    "openenv": "openenv",
    "stable_baselines3": "clients",
    "starlette": "play",
    "uvicorn": "play",
    "websockets": "play",
}
"""The extra that installs a package. All other packages belong to ``experiments``."""


def import_extra(module: str, feature: str) -> Any:
    """Import a module that an extra installs.

    Args:
        module: The name of the module.
        feature: The feature that needs it, for the error.

    Raises:
        MissingExtraError: The module is missing. The message names the extra.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        extra = EXTRAS.get(package, "experiments")
        raise MissingExtraError(
            f"{feature} needs {package}: install simenv-marl[{extra}], in a checkout by"
            f" pip install '.[{extra}]' ({error})"
        ) from None


class ProgressBar:
    """A progress bar that shows nothing.

    Attributes:
        missing: The number of units by which it has not moved, although it should have.
    """

    missing = 0

    def update(self, number: int = 1) -> None:
        """Move the bar."""


NO_BAR: Final = ProgressBar()


def progress_bar(
    total: int,
    progress: bool,
    unit: str = "simulation",
    done: int = 0,
) -> Any:
    """Make a context with a ``ProgressBar``.

    Args:
        total: The number of units.
        progress: Whether to show a bar, by ``tqdm``.
        unit: The name of a unit.
        done: The number of units that are done already.
    """
    if not progress:
        return nullcontext(NO_BAR)
    tqdm = import_extra("tqdm.auto", "progress=True").tqdm
    return tqdm(total=total, unit=unit, initial=done)


class _SharedBar(ProgressBar):
    """The bar of a worker, which writes a byte for each unit to a file of the parent.

    On another machine there is no such file, and units are missing.
    """

    def __init__(self, path: str) -> None:
        self._path = path

    def update(self, number: int = 1) -> None:
        """Move the bar."""
        try:
            file = os.open(self._path, os.O_WRONLY | os.O_APPEND)
        except OSError:
            self.missing += number
        else:
            os.write(file, bytes(number))
            os.close(file)


@contextmanager
def _shared(bar: ProgressBar) -> Iterator[str]:
    """Move a bar by the size of a file, whose path is for a ``_SharedBar``. No bar: no file."""
    if bar is NO_BAR:
        yield ""
        return
    ended = Event()
    file, path = mkstemp()  # Windows lets workers open it

    def watch() -> None:
        number = 0
        is_over = False
        while not is_over:
            is_over = ended.wait(0.2)
            size = os.fstat(file).st_size
            if size > number:  # tqdm measures the time since its last update
                bar.update(size - number)
            number = size

    thread = Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield path
    finally:
        ended.set()
        thread.join()
        os.close(file)
        os.remove(path)


# -- processes of joblib --------------------------------------------------------------------------


def spread(
    work: Callable[..., Result],
    arguments: tuple[object, ...],
    items: Sequence[Any],
    workers: int,
    least: int,
    bar: ProgressBar,
    share: int = 4,
    lost: Callable[[Any, WorkerError], Result] | None = None,
) -> list[Result]:
    """Work on items in this process, or on parts of them in processes of joblib.

    Args:
        work: A function of this package. It takes the arguments, the items and a progress bar.
        arguments: Its arguments.
        items: The items.
        workers: The number of processes. 0: this process. -1: as many as joblib's backend has.
        least: The smallest number of items in a part, unless a worker would get none.
        bar: The progress bar.
        share: About how many parts each worker gets.
        lost: Returns the result for an item whose process has died twice. None: the first death is
            an error. If all of several items are lost, that is an error, too.

    Returns:
        The result of each part, in the order of the items.
    """
    if not workers or not items:
        with loaded(len(items), 1):
            return [work(*arguments, items, bar)]
    joblib = import_extra("joblib", f"workers={workers}")
    processes = max(1, joblib.effective_n_jobs(workers))
    fewest = min(least, ceil(len(items) / processes))
    size = max(1, ceil(len(items) / (share * processes)), fewest)
    waiting = deque(items[start : start + size] for start in range(0, len(items), size))
    parcel = pack((work, arguments))
    backend, _ = joblib.parallel.get_active_backend()
    form = "generator" if backend.supports_return_generator else "list"
    # Outcomes are packed in the worker, because each backend passes errors on in its own way.
    settings = {"batch_size": 1, "return_as": form, "pre_dispatch": "n_jobs"}
    call = joblib.delayed(pack_outcome)
    results: list[Result] = []
    news: list[WorkerError] = []
    with _shared(bar) as path:
        task = _work, parcel, os.getpid(), path
        loads = [Load(len(items), processes)]  # for the first part
        while waiting:
            begun: deque[Sequence[Any]] = deque()
            parallel = joblib.Parallel(n_jobs=workers, **settings)
            outcomes = parallel(
                call(*task, loads.pop() if loads else None, part) for part in _moved(waiting, begun)
            )
            try:
                for outcome in outcomes:
                    results.append(_received(outcome, path))
                    begun.popleft()
            except BrokenProcessPool:
                if lost is None:
                    raise
            finally:
                if form == "generator":
                    with warnings.catch_warnings(action="ignore"):  # joblib warns that it cancels
                        outcomes.close()  # cancels the remaining work
            again = [item for part in begun for item in part]
            for item, outcome in zip(
                again, run_alone((*task, None), again, processes), strict=True
            ):
                if outcome is not None:
                    results.append(_received(outcome, path))
                elif lost is not None:
                    news.append(WorkerError(f"the process of {item!r} has died twice"))
                    results.append(lost(item, news[-1]))
    if 1 < len(items) == len(news):
        raise news[0]
    return results


def _moved(waiting: deque[Result], begun: deque[Result]) -> Iterator[Result]:
    """Yield items of a queue, each when it has moved to another."""
    while waiting:
        begun.append(waiting.popleft())
        yield begun[-1]


def _received(outcome: bytes, path: str) -> Any:
    """Return the result of ``_work``, or raise its error. ``path`` is for a ``_SharedBar``."""
    returned, error = unpack_outcome(outcome)
    if error is not None:
        raise error
    result, counts, missing = returned
    for token, numbers in counts.items():
        count(token, **numbers)
    if missing:
        _SharedBar(path).update(missing)
    return result


def _work(
    parcel: bytes,
    home: int,
    path: str,
    load: Load | None,
    items: Sequence[object],
) -> tuple[object, dict[str, dict[str, float]], int]:
    """Work on a part of the items, in a worker. ``path`` is for its ``_SharedBar``.

    Returns:
        The result; the counts of policies; and the number of units that the bar misses. In the
        process ``home``, no counts, because they are in its ``COUNTS`` already.
    """
    is_away = os.getpid() != home
    if is_away:
        COUNTS.clear()
    work, arguments = unpack(parcel)
    bar = _SharedBar(path) if path else NO_BAR
    with nullcontext() if load is None else loaded(*load):
        return work(*arguments, items, bar), COUNTS if is_away else {}, bar.missing


# -- processes of a pool --------------------------------------------------------------------------

Outcomes = dict[int, tuple[Any, BaseException | None]]
"""By the number of a worker, its result, or None and its error."""

SECONDS_TO_CLOSE: Final = 10.0
"""The seconds that a worker may take to close its object and to end."""


def _serve(connection: Connection, other_end: Connection | None, recipe: bytes) -> None:
    """Make an object in a worker, and serve it in a list.

    Args:
        connection: The connection to the user.
        other_end: The user's end, if a fork has copied it.
        recipe: The packed function that makes the object, and its arguments.
    """
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # because multiprocessing ends workers by it
    if other_end is not None:
        other_end.close()
    served: list[Any] = []

    def make() -> None:
        function, arguments = unpack(recipe)
        served.append(function(*arguments))

    try:
        serve(connection, served, make)
    finally:
        for each in served:
            each.abandon()


def call(served: list[Any], method: str, *args: object) -> Any:
    """In a worker, call a method of its object."""
    return getattr(served[0], method)(*args)


class Worker(Peer):
    """A process with a part of the simulations.

    Attributes:
        name: Its number, and the numbers of its simulations.
        gone: How it has died. Empty while it lives.
    """

    def __init__(self, context: Any, number: int, part: range, recipe: bytes) -> None:
        """Start the process."""
        self.gone = ""
        self.name = f"worker {number} (of the sub-environments {part.start} to {part.stop - 1})"
        connection, theirs = context.Pipe()
        super().__init__(connection)
        copied = connection if context.get_start_method() == "fork" else None
        self._process = context.Process(
            target=_serve,
            args=(theirs, copied, recipe),
            name=f"simenv_marl {self.name}",
            daemon=True,
        )
        with theirs:
            try:
                with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
                    self._process.start()  # from 3.12 on, Python warns of threads beside a fork
            except BaseException:
                connection.close()
                raise

    def lost(self) -> WorkerError:
        """Make the error that says how the worker died."""
        self._process.join(1.0)  # its connection closes a moment before it ends
        code = self._process.exitcode
        how = "closed its pipe" if code is None else f"died with exit code {code}"
        self.gone = f"{self.name} {how}"
        hint = ""
        if code == 1:  # an error has ended it before it could send a message
            hint = (
                '. In a script, make environments with workers under `if __name__ == "__main__":`,'
                " because each worker imports the script. With step_timeout=, C code may have taken"
                " too long; then its stack is in stderr"
            )
        return WorkerError(
            f"{self.gone}; it was killed, or a simulation ended the process. reset() starts"
            f" new workers{hint}"
        )

    def stop(self, seconds: float) -> None:
        """End the process, by force if it does not end within some seconds."""
        self.connection.close()
        process = self._process
        with suppress(ValueError):  # it was closed before an interrupt
            process.join(seconds)
            process.kill()  # which does nothing if it has ended
            process.join()
            process.close()


class WorkerPool:
    """Worker processes. Each has an object with a part of the simulations.

    No wait lasts for ever: a wait for an answer also ends when the worker dies, and a worker's
    connection closes when its user ends.

    Attributes:
        failed: Whether an error has left the simulations at different steps, so that all of them
            need a reset.
        restarts: The number of workers that were replaced after their death.
    """

    restarts = 0

    def __init__(
        self,
        make: Callable[..., object],
        arguments: tuple[object, ...],
        number: int,
        workers: int,
        context: BaseContext | str | None,
    ) -> None:
        """Start the workers. Each makes an object.

        Args:
            make: A function of this package that returns an object with the methods ``close`` and
                ``abandon``.
            arguments: Its arguments, before the last one: a range of the simulations' numbers.
            number: The number of simulations.
            workers: The largest number of workers.
            context: A context of multiprocessing, or the name of its start method. None: spawn.

        Raises:
            OptionValueError: The context is invalid, or the arguments cannot be pickled.
        """
        try:
            if not isinstance(context, BaseContext):
                context = multiprocessing.get_context("spawn" if context is None else context)
        except (TypeError, ValueError):
            methods = multiprocessing.get_all_start_methods()
            raise OptionValueError(
                f"context must be one of {methods}, or a context of multiprocessing, not"
                f" {short_repr(context)}"
            ) from None
        workers = min(workers, number)
        cuts = [number * place // workers for place in range(workers + 1)]
        self._parts = list(map(range, cuts, cuts[1:]))
        try:
            self._recipes = [pack_plainly((make, (*arguments, part))) for part in self._parts]
        except Exception as error:
            raise OptionValueError(
                "the simulation, its points or its options cannot be sent to another process"
                f" ({describe_error(error)}); pass a class or a factory of a module, or workers=0"
            ) from error
        self._context = context
        self._home = os.getpid()
        self._workers: list[Worker] = []
        self._is_broken = True  # a worker is dead, or owes an answer because of an interrupt
        self.failed = False
        self._start()

    @property
    def idle(self) -> bool:
        """Whether this process has no workers."""
        return not self._workers

    def _start(self) -> None:
        """Start all workers, and have them make their objects."""
        try:
            for number, part in enumerate(self._parts):
                self._workers.append(Worker(self._context, number, part, self._recipes[number]))
            self._results(self._exchange(dict.fromkeys(range(len(self._parts)), b"")))
        except BaseException:
            self.abandon()
            raise
        self._is_broken = False

    def _exchange(self, requests: Mapping[int, bytes], seconds: float = inf) -> Outcomes:
        """Send workers, given by number, their requests, if these are not empty.

        Return the result or the error of each. If one has died, the pool is broken.

        Raises:
            TimeoutError: Not all of them came within some seconds. The pool is broken.
        """
        deadline = monotonic() + seconds
        outcomes: Outcomes = {}
        try:
            for number, request in requests.items():
                with suppress(WorkerError):  # ``receive`` raises it again
                    if request:
                        self._workers[number].send(request)
            for number in requests:
                try:
                    response = self._workers[number].receive(deadline - monotonic())
                except WorkerError as error:
                    self._break()
                    outcomes[number] = None, error
                else:
                    outcomes[number] = unpack_outcome(response)
        except BaseException:
            self._break()
            raise
        return outcomes

    def _break(self) -> None:
        """Note that the workers cannot go on until a reset."""
        self._is_broken = True
        self.failed = True

    def _results(self, outcomes: Outcomes) -> list[Any]:
        """Return the results in the order of the workers, or raise the first error."""
        results = []
        for number, (result, error) in sorted(outcomes.items()):
            if error is not None:
                if not self._workers[number].gone:
                    annotate(error, f"simenv_marl: in {self._workers[number].name}")
                raise error
            results.append(result)
        return results

    def ask(self, method: str, *arguments: object) -> list[Any]:
        """Call a method of each worker's object.

        Args:
            method: The name of the method. ``reset`` starts new workers after a death.
            *arguments: Its arguments. Of lists and arrays, which have an item for each simulation,
                each worker gets its part.

        Returns:
            The result of each worker.

        Raises:
            WorkerError: A worker has died, or belongs to another process.
            BaseException: The first error of an object.
        """
        if os.getpid() != self._home:
            raise WorkerError(
                "the workers belong to the process from which this one was forked; make a new"
                " environment"
            )
        if self._is_broken and method == "reset":
            self.abandon()
            self._start()
        if self._is_broken:
            raise WorkerError(
                "a worker is dead, or a wait for it was interrupted; reset() starts new workers"
            )
        shares = [[_share_of(argument, part) for argument in arguments] for part in self._parts]
        moves = method in ("reset", "step")
        if moves:
            self.failed = True  # until all simulations have moved
        results = self._ask_all(method, shares)
        if moves:
            self.failed = False
        return results

    def _ask_all(self, method: str, shares: Sequence[Sequence[Any]]) -> list[Any]:
        """Call a method of each worker's object, with a share of the arguments for each."""
        requests = [pack_request(call, method, *share) for share in shares]
        return self._results(self._exchange(dict(enumerate(requests))))

    def close(self) -> None:
        """Close the objects and end the workers, by force after some seconds.

        Raises:
            BaseException: The first error of an object.
        """
        try:
            if not self._is_broken and os.getpid() == self._home:
                requests = dict.fromkeys(range(len(self._workers)), pack_request(call, "close"))
                self._results(self._exchange(requests, SECONDS_TO_CLOSE))
        except (WorkerError, TimeoutError) as error:
            if not self._is_broken:
                raise
            if isinstance(error, TimeoutError):  # a dead worker has nothing to close
                warn_user(
                    f"workers did not close within {SECONDS_TO_CLOSE} s and are killed",
                    ResourceWarning,
                )
        finally:
            self.abandon()

    def abandon(self) -> None:
        """End the workers. A finalizer may call this; it raises no errors."""
        if os.getpid() != self._home:
            self._workers = []  # because this process is a fork, and its parent has the workers
        for worker in self._workers:
            with suppress(OSError):
                worker.connection.send_bytes(b"")  # asks it to end
        deadline = monotonic() + SECONDS_TO_CLOSE
        while self._workers:  # a second call, after an interrupt, stops those that are left
            self._workers[-1].stop(max(deadline - monotonic(), 0.0))
            self._workers.pop()


def _share_of(argument: Any, part: range) -> Any:
    """Return a worker's part of a list or an array. Other arguments are for all workers."""
    if isinstance(argument, (list, np.ndarray)):
        return argument[part.start : part.stop]
    return argument
