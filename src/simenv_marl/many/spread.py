"""Spreads the work on many simulations over processes, local or remote, with joblib."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from math import ceil
from types import FunctionType
from typing import Any, Final

from ..core.packing import pack, pack_error, unpack, unpack_error
from ..errors import MissingExtraError

EXTRAS: Final = {"joblib": "many", "tqdm": "many", "matplotlib": "plots"}
"""The extra that installs a package. All other packages belong to ``experiments``."""


def import_extra(module: str, feature: str) -> Any:
    """Import a module that an extra installs.

    Args:
        module: The dotted name of the module.
        feature: The feature that needs it, for the error message.

    Raises:
        MissingExtraError: The module is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        extra = EXTRAS.get(package, "experiments")
        raise MissingExtraError(f"{feature} needs {package}: install simenv-marl[{extra}] ({error})") from None


def progress_bar(total: int, unit: str = "simulation", done: int = 0) -> Any:
    """Return a progress bar that counts simulations, or other units.

    Args:
        total: The number of units.
        unit: The name of the unit.
        done: The number of units that are done already.

    Raises:
        MissingExtraError: tqdm is not installed.
    """
    return import_extra("tqdm.auto", "progress=True").tqdm(total=total, unit=unit, initial=done)


def spread(
    work: Callable[..., Any],
    arguments: tuple[Any, ...],
    seeds: Sequence[Any],
    workers: int,
    least: int,
    share: int = 4,
) -> Iterator[tuple[int, Any]]:
    """Run a function in worker processes, each call on a part of the seeds.

    Args:
        work: A function of this package. It is called with the arguments and a list of seeds.
        arguments: The arguments.
        seeds: All seeds, or other items to divide.
        workers: The number of worker processes. -1: as many as joblib's backend has.
        least: The smallest size of a part, as long as every worker gets some seeds.
        share: The number of parts per process.

    Yields:
        The number of seeds of a part, and the function's result; in the order of the seeds.

    Raises:
        MissingExtraError: joblib is not installed.
        WorkerError: An error in a worker could not be sent here as itself.
        BaseException: Any exception of the function.
    """
    joblib = import_extra("joblib", f"workers={workers}")
    processes = max(1, joblib.effective_n_jobs(workers))
    size = max(1, ceil(len(seeds) / (share * processes)), min(least, ceil(len(seeds) / processes)))
    parts = [list(seeds[start : start + size]) for start in range(0, len(seeds), size)]
    parcel = packed_with_names((work, arguments))
    try:
        parallel = joblib.Parallel(n_jobs=workers, batch_size=1, return_as="generator")
    except ValueError:  # this backend returns nothing before all work is done
        parallel = joblib.Parallel(n_jobs=workers, batch_size=1)
    results = parallel(joblib.delayed(_work)(parcel, part) for part in parts)
    with _closing(results):
        remaining = iter(results)
        for part in parts:
            failed, result = next(remaining)
            if failed:
                raise unpack_error(result)
            yield len(part), unpack(result)


def packed_with_names(thing: Any) -> bytes:
    """Pickle an object for workers, with the functions of this process's script that it refers to by dotted name.

    Raises:
        Exception: Any exception of pickling it.
    """
    parcel, main = pack((thing, {})), sys.modules["__main__"]
    named = {name.decode(): getattr(main, name.decode(), None) for name in set(_IN_SCRIPT.findall(parcel))}
    named = {name: found for name, found in named.items() if isinstance(found, (type, FunctionType))}
    return pack((thing, named)) if named else parcel


_IN_SCRIPT: Final = re.compile(rb"__main__\.([A-Za-z_]\w*)")

_lent: Final[set[str]] = set()
"""Objects that were put into this process's main module, for names that come from another process's script."""


def _unpacked(parcel: bytes) -> Any:
    """Unpickle an object, in a worker. The functions it refers to by name are put into the main module."""
    thing, named = unpack(parcel)
    main = sys.modules["__main__"]
    for name, found in named.items():
        if name in _lent or not hasattr(main, name):
            setattr(main, name, found)
            _lent.add(name)
    return thing


@contextmanager
def _closing(results: Any) -> Iterator[None]:
    """Cancel the remaining work when the caller stops reading results."""
    try:
        yield
    finally:
        close = getattr(results, "close", None)
        if close is not None:
            with warnings.catch_warnings():  # joblib warns that it cancels
                warnings.simplefilter("ignore")
                close()


def _work(parcel: bytes, seeds: list[Any]) -> tuple[bool, bytes]:
    """Run the function, in a worker.

    Returns:
        Whether it failed, and a pickle of its result or of the error. The error is pickled here because each of
        joblib's backends would pass it on in its own way.
    """
    try:
        work, arguments = _unpacked(parcel)
        return False, pack(work(*arguments, seeds))
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return True, pack_error(error)
