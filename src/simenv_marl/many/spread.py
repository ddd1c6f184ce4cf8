"""Work on many simulations that is spread over processes, here or elsewhere, by joblib."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from math import ceil
from types import FunctionType
from typing import Any, Final

from ..core.processes import pack, pack_error, unpack, unpack_error
from .extras import needed


def progress_bar(total: int, unit: str = "simulation", done: int = 0) -> Any:
    """A bar that shows how many simulations have ended, or whatever else is counted.

    Args:
        total: How many there are.
        unit: What is counted.
        done: How many of them had ended before.

    Raises:
        MissingExtraError: tqdm is not installed.
    """
    return needed("tqdm.auto", "progress=True", extra="many").tqdm(total=total, unit=unit, initial=done)


def spread(
    work: Callable[..., Any],
    arguments: tuple[Any, ...],
    seeds: Sequence[Any],
    workers: int,
    least: int,
    share: int = 4,
) -> Iterator[tuple[int, Any]]:
    """Have worker processes do some work, each of a part of the seeds.

    Args:
        work: Called with the arguments and a list of seeds; a function of this package.
        arguments: What it is called with.
        seeds: All seeds, or whatever else is to be parted.
        workers: How many processes; -1: as many as joblib's backend has.
        least: How many seeds are not to be parted, if every worker is to have some.
        share: How many parts there are for each process.

    Yields:
        How many seeds a part has, and what came of it; in the order of the seeds.

    Raises:
        MissingExtraError: joblib is not installed.
        WorkerError: An error in a worker cannot be brought here as itself.
        BaseException: What the work raises.
    """
    joblib = needed("joblib", f"workers={workers}", extra="many")
    processes = max(1, joblib.effective_n_jobs(workers))
    size = max(1, ceil(len(seeds) / (share * processes)), min(least, ceil(len(seeds) / processes)))
    parts = [list(seeds[start : start + size]) for start in range(0, len(seeds), size)]
    parcel = packed_with_names((work, arguments))
    try:
        parallel = joblib.Parallel(n_jobs=workers, batch_size=1, return_as="generator")
    except ValueError:  # this backend tells nothing before everything is done
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
    """Pack something for workers, with what is told of in it by a dotted name that only this process's script has.

    Raises:
        Exception: What pickling it raises.
    """
    parcel, main = pack((thing, {})), sys.modules["__main__"]
    named = {name.decode(): getattr(main, name.decode(), None) for name in set(_IN_SCRIPT.findall(parcel))}
    named = {name: found for name, found in named.items() if isinstance(found, (type, FunctionType))}
    return pack((thing, named)) if named else parcel


_IN_SCRIPT: Final = re.compile(rb"__main__\.([A-Za-z_]\w*)")

_lent: Final[set[str]] = set()
"""What stands in this process's main module, and was put there for names that come from another one."""


def _unpacked(parcel: bytes) -> Any:
    """In a worker: what was packed. What it names stands in the main module from now on."""
    thing, named = unpack(parcel)
    main = sys.modules["__main__"]
    for name, found in named.items():
        if name in _lent or not hasattr(main, name):
            setattr(main, name, found)
            _lent.add(name)
    return thing


@contextmanager
def _closing(results: Any) -> Iterator[None]:
    """Cancel what is still to be done where its results are not awaited any more."""
    try:
        yield
    finally:
        close = getattr(results, "close", None)
        if close is not None:
            with warnings.catch_warnings():  # that it cancels what it was to cancel
                warnings.simplefilter("ignore")
                close()


def _work(parcel: bytes, seeds: list[Any]) -> tuple[bool, bytes]:
    """In a worker: do the work.

    Returns:
        Whether that has failed, and a parcel with what came of it or with the error, which joblib's backends would pass
        on each in its own guise.
    """
    try:
        work, arguments = _unpacked(parcel)
        return False, pack(work(*arguments, seeds))
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return True, pack_error(error)
