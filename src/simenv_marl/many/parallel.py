"""Work on many simulations in several processes, local or remote, with joblib."""

from __future__ import annotations

import re
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from math import ceil
from types import FunctionType
from typing import Any, Final

from ..core.packing import pack, pack_outcome, unpack, unpack_outcome
from ..errors import MissingExtraError

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


def spread(
    work: Callable[..., Any],
    arguments: tuple[Any, ...],
    seeds: Sequence[Any],
    workers: int,
    least: int,
    share: int = 4,
) -> Iterator[tuple[int, Any]]:
    """Call ``work`` with the arguments and a part of the seeds (or of other items) in worker processes, for all parts.

    Args:
        work: A function of this package.
        arguments: Its arguments before the seeds.
        seeds: All seeds.
        workers: The number of worker processes. -1: as many as joblib's backend has.
        least: The smallest size of a part, as long as every worker gets some seeds.
        share: The number of parts per process.

    Yields:
        The number of seeds of a part, and the function's result; in the order of the seeds.
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


def _work(parcel: bytes, seeds: list[Any]) -> Any:
    """Call the function, in a worker."""
    work, arguments = _unpack_with_names(parcel)
    return work(*arguments, seeds)


# -- names of a script ----------------------------------------------------------------------------

_IN_SCRIPT: Final = re.compile(rb"__main__\.([A-Za-z_]\w*)")

_received: Final[set[str]] = set()
"""The names in this process's main module that came from another process's script."""


def packed_with_names(thing: Any) -> bytes:
    """Pickle an object for workers, with the functions of this process's script that it refers to by dotted name."""
    parcel, main = pack((thing, {})), sys.modules["__main__"]
    named = {name.decode(): getattr(main, name.decode(), None) for name in set(_IN_SCRIPT.findall(parcel))}
    named = {name: found for name, found in named.items() if isinstance(found, (type, FunctionType))}
    return pack((thing, named)) if named else parcel


def _unpack_with_names(parcel: bytes) -> Any:
    """Unpickle an object, in a worker. The functions it refers to by name are put into the main module."""
    thing, named = unpack(parcel)
    main = sys.modules["__main__"]
    for name, found in named.items():
        if name in _received or not hasattr(main, name):
            setattr(main, name, found)
            _received.add(name)
    return thing
