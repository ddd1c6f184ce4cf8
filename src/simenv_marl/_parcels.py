"""Work that is spread over processes, here or elsewhere, and what crosses over to them.

What crosses are simulations, points, policies and options, as users have given them: by reference where they can be
imported, and by value where not, as in a script or a notebook. There decision functions are a matter of their own,
because they have to ask the environments of the process in which they are called.
"""

from __future__ import annotations

import io
import pickle
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from math import ceil
from types import FunctionType
from typing import Any
from uuid import uuid4
from weakref import WeakKeyDictionary, WeakValueDictionary

from ._wrappers import DECISION, EXPOSED, stands_in
from .decision import DecisionPoint, Definition, point_of, restored_point, unwrapped
from .errors import MissingExtraError, WorkerError, annotate
from .plugins import expose_to_plugins


def progress_bar(total: int) -> Any:
    """A bar that shows how many simulations have ended.

    Raises:
        MissingExtraError: tqdm is not installed.
    """
    try:
        from tqdm.auto import tqdm  # type: ignore[import-untyped]
    except ImportError:
        raise _missing("progress=True", "tqdm") from None
    return tqdm(total=total, unit="simulation")


def _missing(what: str, package: str) -> MissingExtraError:
    return MissingExtraError(f"{what} needs {package}: install simenv-marl[many]")


def spread(
    work: Callable[..., Any], arguments: tuple[Any, ...], seeds: Sequence[int], workers: int, least: int
) -> Iterator[tuple[int, Any]]:
    """Have worker processes do some work, each of a part of the seeds.

    Args:
        work: Called with the arguments and a list of seeds; a function of this package.
        arguments: What it is called with.
        seeds: All seeds.
        workers: How many processes; -1: as many as joblib's backend has.
        least: How many seeds are not to be parted, if every worker is to have some.

    Yields:
        How many seeds a part has, and what came of it; in the order of the seeds.

    Raises:
        MissingExtraError: joblib is not installed.
        WorkerError: An error in a worker cannot be brought here as itself.
        BaseException: What the work raises.
    """
    try:
        import cloudpickle  # noqa: F401
        import joblib
    except ImportError:
        raise _missing(f"workers={workers}", "joblib and cloudpickle") from None
    processes = max(1, joblib.effective_n_jobs(workers))
    size = max(1, ceil(len(seeds) / (4 * processes)), min(least, ceil(len(seeds) / processes)))
    parts = [list(seeds[start : start + size]) for start in range(0, len(seeds), size)]
    parcel = _packed((work, arguments))
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
                raise _unpacked(result)
            yield len(part), _unpacked(result)


@contextmanager
def _closing(results: Any) -> Iterator[None]:
    """Cancel what is still to be done where nobody wants to know its results any more."""
    try:
        yield
    finally:
        close = getattr(results, "close", None)
        if close is not None:
            with warnings.catch_warnings():  # that it cancels what it was to cancel
                warnings.simplefilter("ignore")
                close()


def _work(parcel: bytes, seeds: list[int]) -> tuple[bool, bytes]:
    """In a worker: do the work.

    Returns:
        Whether that has failed, and a parcel with what came of it or with the error, which joblib's backends would pass
        on each in its own guise.
    """
    try:
        work, arguments = _unpacked(parcel)
        return False, _packed(work(*arguments, seeds))
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        return True, _packed_error(error)


def _packed_error(error: BaseException) -> bytes:
    lines = "".join(traceback.format_exception(error))
    annotate(error, f"simenv_marl: in a worker process, where its traceback was\n{lines}")
    error.__cause__ = error.__context__ = error.__traceback__ = None
    try:
        parcel = _packed(error)
        if type(_unpacked(parcel)) is type(error):
            return parcel
    except Exception:  # whatever its pickling raises
        pass
    return _packed(WorkerError(f"in a worker process, an error that cannot be brought here as itself:\n{lines}"))


# -- what crosses ---------------------------------------------------------------------------------


def _packed(thing: Any) -> bytes:
    import cloudpickle

    class Pickler(cloudpickle.Pickler):
        """Packs decision functions so that they ask where they are unpacked."""

        def reducer_override(self, obj: Any) -> Any:
            reduced = _reduced(obj)
            return super().reducer_override(obj) if reduced is None else reduced

    buffer = io.BytesIO()
    Pickler(buffer).dump(thing)
    return buffer.getvalue()


def _reduced(thing: Any) -> tuple[Any, ...] | None:
    """How a thing crosses that would not be itself on the other side; None for all others."""
    if isinstance(thing, DecisionPoint):
        there = _found_at(thing.rule.__module__, thing.rule.__qualname__)
        known = point_of(there)
        if known is not None and known[0] is thing:
            return _point_at, (thing.rule.__module__, thing.rule.__qualname__)
        return _restore_point, (_token(thing), thing.parts())
    if not isinstance(thing, FunctionType):
        return None
    there = _found_at(thing.__module__, thing.__qualname__, bound=True)
    if there is thing:
        return None
    there = _found_at(thing.__module__, thing.__qualname__)
    if there is thing:
        return _found_at, (thing.__module__, thing.__qualname__)
    if there is not None and unwrapped(there) is thing:
        return _rule_at, (thing.__module__, thing.__qualname__)
    if stands_in(thing, DECISION):
        point, definition = point_of(thing)  # type: ignore[misc]
        return _restore_decision, (_token(thing), point, definition)
    if stands_in(thing, EXPOSED):
        return _restore_exposed, (_token(thing), thing.__globals__["rule"])
    return None


def _found_at(module: str, path: str, *, bound: bool = False) -> Any:
    """What a module has under a dotted name, without its binding unless told otherwise; None where that is nothing."""
    if module == "__main__" or module is None:
        return None
    try:
        thing = import_module(module)
        for name in path.split("."):
            thing = getattr(thing, name)
    except (ImportError, AttributeError):
        return None
    return thing if bound else getattr(thing, "__func__", thing)


def _rule_at(module: str, path: str) -> Any:
    return unwrapped(_found_at(module, path))


def _point_at(module: str, path: str) -> Any:
    return point_of(_found_at(module, path))[0]  # type: ignore[index]


def _unpacked(parcel: bytes) -> Any:
    return pickle.loads(parcel)


_tokens: WeakKeyDictionary[Any, str] = WeakKeyDictionary()
_known: WeakValueDictionary[str, Any] = WeakValueDictionary()
"""What has crossed, in either direction: coming back, it is what it was."""


def _token(thing: Any) -> str:
    token = _tokens.get(thing)
    if token is None:
        token = _tokens[thing] = uuid4().hex
        _known[token] = thing
    return token


def _restored(token: str, make: Callable[[], Any]) -> Any:
    thing = _known.get(token)
    if thing is None:
        thing = _known[token] = make()
        _tokens[thing] = token
    return thing


def _restore_point(token: str, parts: tuple[Any, ...]) -> DecisionPoint:
    point: DecisionPoint = _restored(token, lambda: restored_point(*parts))
    return point


def _restore_decision(token: str, point: DecisionPoint, definition: Definition | None) -> Any:
    return _restored(token, lambda: point.wrap(definition))


def _restore_exposed(token: str, function: Any) -> Any:
    return _restored(token, lambda: expose_to_plugins(function))
