"""Extensions: handlers before, after and instead of a model's functions, without touching the model (paper).

Handlers are attached to functions, methods, generator and coroutine functions, iterables, and classes whose
instances iterate; for the whole process (``attach_handler``), for a while (``handlers``), or for an environment
alone (the option ``plugins``). What nobody extends costs nothing, or, exposed by ``expose_to_plugins``, one test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from sys import modules
from threading import RLock, get_ident
from types import FunctionType, MethodType, ModuleType
from typing import Any, Final, TypeVar

from ..core.switch import EVALUATING, PLUGGED
from ..decision import point_of, registered_names, unbind
from ..errors import HandlerError, PatchError, SimEnvError, UnknownTargetError
from .handlers import Attached, Call, FunctionTarget, IterableTarget, Target
from .hook import exposure
from .places import (
    HANDLED,
    ITERATED,
    Place,
    Purpose,
    found_at,
    held_at,
    lasting,
    leads_there,
    owner_at_hand,
    places_of,
    plain,
    resolve,
    title,
)

Thing = TypeVar("Thing")

Entry = tuple[Callable[..., Any], Any, str]
"""A handler, its target, and its position."""


def exposed_functions() -> list[str]:
    """The names of all that is exposed to plugins, or has handlers attached to it."""
    return sorted({target.name for target in Target.all if target.place is None or target.slot})


def decision_points() -> list[str]:
    """The dotted names of all decorated decision points, in the order of their decoration."""
    return registered_names()


def attached_handlers(env: Any = None) -> list[Entry]:
    """The handlers that are attached, by target in the order in which they run.

    Args:
        env: An environment, for the handlers of its option ``plugins``; None: for those of the whole process.

    Returns:
        For each the handler, the dotted name of its target, and its position.
    """
    if env is not None:
        entries: list[Entry] = env.unwrapped.plugins
        return entries
    targets = sorted(Target.all, key=lambda target: target.name)
    return [(a.handler, target.name, a.position) for target in targets for a in target.attached]


TARGET: Final = Purpose("target of handlers", UnknownTargetError, exposed_functions)

_LOCK: Final = RLock()
"""Held while handlers come and go. Calls look at what is made ready for them, and need none."""


# -- exposing -------------------------------------------------------------------------------------


def expose_to_plugins(function_or_iterable: Thing) -> Thing:
    """Let handlers be attached to a function or an iterable (paper, section 3.4).

    As a decorator inside the model, over or under ``staticmethod``, ``classmethod`` and ``make_step``, or from
    outside: ``Model.step = expose_to_plugins(Model.step)``. What is importable need not be exposed to have
    handlers attached to it, by its dotted name.

    Args:
        function_or_iterable: A function of any kind, an iterable, or a class whose instances are iterable.

    Returns:
        The exposed function, which keeps its looks, and is one also when it is exposed again; for an iterable
        what behaves like it in all respects; the class itself.

    Raises:
        PatchError: It is none of these, or a method that is bound to one object.
    """
    with _LOCK:
        exposed: Thing = _expose(function_or_iterable)
    return exposed


def _expose(thing: Any) -> Any:
    if isinstance(thing, type):
        _class_target(thing, for_good=True)
        return thing
    if _exposed_iterable(thing) is not None:
        return thing
    if isinstance(thing, (staticmethod, classmethod, FunctionType, MethodType)):
        return _expose_function(thing)
    if _iterates(thing):
        from .iterables import expose  # what it stands on imports asyncio, which costs a decision something

        return expose(thing)
    if callable(thing):
        name = f"{getattr(thing, '__module__', None) or '?'}.{title(thing)}"
        return FunctionTarget(thing, name).wrap(thing)
    raise PatchError(f"{thing!r} cannot be exposed to plugins: it is neither a function nor an iterable")


def _expose_function(thing: Any) -> Any:
    given, binding = unbind(thing)
    if exposure(given) is None:
        given = _exposed(given, binding)
    elif isinstance(thing, (staticmethod, classmethod)):
        return thing
    return given if binding is None else binding(given)


def _exposed(given: FunctionType, binding: type | None) -> Any:
    function = lasting(given)
    name = f"{function.__module__}.{function.__qualname__}"
    there = _at_own_name(name)
    if exposure(there) is not None and lasting(there) is function:
        return there
    target = FunctionTarget(function, name, bound=binding is not staticmethod)
    if given is not function:  # an environment has set a decision function there, for as long as it needs it
        place = Place.where(given)
        if place is not None:
            return plain(place.expose(target))
    return target.wrap(function)


def _at_own_name(name: str) -> Any:
    try:
        owner, attribute = resolve(name, TARGET)
    except (SimEnvError, ImportError):
        return None
    return plain(vars(owner).get(attribute))


def _iterates(thing: Any) -> bool:
    return isinstance(thing, Iterable) or (hasattr(type(thing), "__getitem__") and hasattr(type(thing), "__len__"))


# -- iterables ------------------------------------------------------------------------------------


def _exposed_iterable(thing: Any) -> Any:
    """What has been made of an iterable to expose it, if that is what a thing is; else None."""
    iterables: Any = modules.get(f"{__package__}.iterables")
    return thing if iterables is not None and type(thing) in iterables.KINDS else None


class _Value:
    """An iterable under a name of a module or class, in whose stead a proxy is set while it has handlers."""

    def __init__(self, owner: Any, attribute: str, iterable: Any, target: IterableTarget) -> None:
        from .iterables import proxy

        self._owner, self._attribute, self._iterable = owner, attribute, iterable
        self._proxy, self._users = proxy(iterable, target), 0
        self.stale = False

    def hold(self, level: int, wrap: Any) -> None:
        """Have the proxy set until as many calls of ``let_go``."""
        if self._users == 0:
            setattr(self._owner, self._attribute, self._proxy)
        self._users += 1

    def let_go(self, level: int) -> None:
        """Undo one ``hold``."""
        self._users -= 1
        if self._users == 0 and vars(self._owner).get(self._attribute) is self._proxy:
            setattr(self._owner, self._attribute, self._iterable)


# -- targets --------------------------------------------------------------------------------------


def find_target(target: Any) -> Target:
    """Find what handlers are to be attached to.

    Args:
        target: A function, an iterable or a class, or its dotted name.

    Raises:
        UnknownTargetError: The name leads to nothing.
        PatchError: It is not exposed, and cannot be patched.
    """
    if isinstance(target, str):
        try:
            owner, attribute = resolve(target, TARGET)
        except (UnknownTargetError, PatchError):
            named = [other for other in Target.all if other.name == target and other.place is None]
            if not named:
                raise
            return max(named, key=lambda other: other.number)  # exposed inside a function, under the latest's name
        return _look_at(target, owner, attribute)
    if isinstance(target, type):
        return _class_target(target)
    if _exposed_iterable(target) is not None:
        found: Target = target._self_target
        return found
    if not isinstance(target, (staticmethod, classmethod, FunctionType, MethodType)):
        raise PatchError(
            f"no handlers can be attached to {target!r}: expose it to plugins, and name what that returns; or give its"
            " dotted name"
        )
    function, _ = unbind(target)
    own: Target | None = exposure(function)
    if own is not None:
        return _at_hand(own)
    return _of_function(function)


def _at_hand(target: Target) -> Target:
    """The target of an exposed function, wherever that was fetched."""
    place = target.place
    if place is None or not place.stale:
        return _everywhere(target)
    put_there_for_good: bool = exposure(plain(vars(place.owner).get(place.attribute))) is target
    if put_there_for_good:
        target.place, target.patches = None, []
        return target
    return find_target(place.name)


def _everywhere(target: Target) -> Target:
    """See to it that an exposed function of a module is found where others had imported it before."""
    if target.place is None and not target.slot and isinstance(target, FunctionTarget):
        target.patches = []
        owner: Any = None
        with suppress(SimEnvError, ImportError):
            owner, attribute = resolve(target.name, TARGET)
        if isinstance(owner, ModuleType) and exposure(held_at(owner, attribute)) is target:
            place = Place.at(target.name, owner, attribute, TARGET)
            target.patches = [(place, HANDLED, target.wrap)]
    return target


def _of_function(function: FunctionType) -> Target:
    """The target of a function that is not exposed, which is to be found by its name or in a class."""
    place = Place.where(function)
    if place is not None:
        return _at(place)
    name = f"{function.__module__}.{function.__qualname__}"
    owner: Any = None
    attribute = function.__name__
    with suppress(SimEnvError, ImportError):
        owner, attribute = resolve(name, TARGET)
    if owner is None or lasting(plain(held_at(owner, attribute))) is not lasting(function):
        names = places_of(function)
        owner, attribute = names[0] if names else (owner_at_hand(function), function.__name__)
        name = f"{getattr(owner, '__qualname__', owner.__name__)}.{attribute}"
        name = f"{owner.__module__}.{name}" if isinstance(owner, type) else name
    return _look_at(name, owner, attribute)


def _look_at(name: str, owner: Any, attribute: str) -> Target:
    held = held_at(owner, attribute)
    if isinstance(held, type):
        return _class_target(held)
    if _exposed_iterable(held) is not None:
        return find_target(held)
    own: Target | None = exposure(plain(held))
    if own is not None and attribute in vars(owner):
        return _at_hand(own)
    if not isinstance(plain(held), FunctionType) and _iterates(held) and not isinstance(held, (str, bytes)):
        target = IterableTarget(name)
        value: Any = _Value(owner, attribute, held, target)
        target.place, target.patches = value, [(value, ITERATED, plain)]
        return target
    return _at(Place.at(name, owner, attribute, TARGET))


def _at(place: Place) -> Target:
    if place.exposure is not None:
        found: Target = _everywhere(place.exposure)
        return found
    if place.target is None:
        bound = place.binding is not staticmethod
        place.target = target = FunctionTarget(place.rule, place.name, like=place.function, bound=bound)
        target.place, target.patches = place, [(place, HANDLED, target.wrap)]
    own: Target = place.target
    return own


def _class_target(owner: type, *, for_good: bool = False) -> Target:
    """The target of a class whose instances iterate."""
    own = vars(owner).get("__simenv_marl_items__")
    if isinstance(own, IterableTarget):
        target = own
    else:
        name = f"{owner.__module__}.{owner.__qualname__}"
        if not hasattr(owner, "__iter__") and not hasattr(owner, "__next__"):
            raise PatchError(
                f"{name} is a class whose instances do not iterate; to extend its construction name {name}.__init__"
            )
        target = IterableTarget(name, f"is a class: for its construction name {name}.__init__")
        for attribute, wrap in (("__iter__", target.wrap_iter), ("__next__", target.wrap_next)):
            if hasattr(owner, attribute):
                place = Place.at(f"{name}.{attribute}", owner, attribute, TARGET)
                target.patches.append((place, ITERATED, wrap))
                target.place = target.place or place
    if for_good and target.place is not None:
        target.hold()
        target.place = None
        owner.__simenv_marl_items__ = target  # type: ignore[attr-defined]
    elif target.place is not None:
        other: IterableTarget | None = target.place.items
        if other is not None:
            return other
        target.place.items = target
    return target


# -- handlers -------------------------------------------------------------------------------------


def attach_handler(handler: Callable[..., Any], target: Any, position: str) -> None:
    """Attach a handler to a function, for the whole process (paper, section 3.4).

    Args:
        handler: Called with the arguments of the call as they were passed; ``*_next``: with those of the generator
            function, or the iterable. ``before`` may return ``ChangedArgs``; ``after`` gets the result as
            ``_result`` where it has a parameter of that name, and may return ``ChangedResult``; what ``instead``
            returns is the result. Those of one position run in the order in which they were attached; of several
            ``instead`` the latest alone runs, and then neither ``before`` nor ``after``.
        target: The function, or the dotted name of any importable one, whether it is exposed or not.
        position: "before", "after" or "instead"; for iterables and generator functions also "before_next",
            "after_next" or "instead_next".

    Raises:
        UnknownTargetError: The name leads to nothing.
        HandlerError: There is no such position, or the handler cannot be called like the target.
        PatchError: The target is not exposed, and cannot be patched.
    """
    with _LOCK:
        _attach(handler, target, position)


def _attach(handler: Any, target: Any, position: str) -> Attached:
    found = find_target(target)
    attached = Attached(handler, found, position)
    found.add(attached)
    return attached


def remove_handler(target: Any, position: str, handler: Callable[..., Any] | None = None) -> None:
    """Remove what ``attach_handler`` has attached.

    Args:
        target: The function, or its dotted name.
        position: The position.
        handler: The handler, of which the one that was attached last is removed; None: all at this position.

    Raises:
        UnknownTargetError: The name leads to nothing.
        HandlerError: There is no such handler.
    """
    with _LOCK:
        found = find_target(target)
        there = [a for a in found.attached if a.position == position and (handler is None or a.handler == handler)]
        if not there:
            what = "no handler" if handler is None else f"{title(handler)} not"
            at = ", ".join(sorted({a.position for a in found.attached})) or "nowhere"
            raise HandlerError(f"{what} attached {position!r} {found.name}; handlers are attached: {at}")
        for attached in there if handler is None else there[-1:]:
            found.remove(attached)


@contextmanager
def handlers(*entries: Entry) -> Iterator[None]:
    """Attach handlers for as long as a block runs.

    Args:
        *entries: For each, what ``attach_handler`` takes: handler, target, position.

    Raises:
        SimEnvError: As ``attach_handler``; none is attached then.
    """
    done: list[Attached] = []
    try:
        with _LOCK:
            for entry in entries:
                done.append(_attach(*checked_entry(entry)))
        yield
    finally:
        with _LOCK:
            for attached in reversed(done):
                if any(own is attached for own in attached.target.attached):  # not removed meanwhile
                    attached.target.remove(attached)


def checked_entry(entry: Any) -> Entry:
    """What is to be attached where, if it is of that form.

    Raises:
        HandlerError: It is not.
    """
    if not isinstance(entry, (tuple, list)) or len(entry) != 3:
        raise HandlerError(f"handlers are given as (handler, target, position), not {entry!r}")
    handler, target, position = entry
    return handler, target, position


# -- of one environment ---------------------------------------------------------------------------


class Plugins:
    """The handlers of the environments of one plan. Also the key under which targets know them."""

    def __init__(self, entries: Iterable[Any]) -> None:
        """Find the targets, and make sure that the handlers fit.

        Raises:
            SimEnvError: As ``attach_handler``.
        """
        self._attached: list[Attached] = []
        self._given: list[Any] = []
        self._users = 0
        with _LOCK:
            for entry in entries:
                handler, target, position = checked_entry(entry)
                self._given.append(target)
                self._attached.append(Attached(handler, find_target(target), position))

    @property
    def entries(self) -> list[Entry]:
        """For each the handler, the dotted name of its target, and its position."""
        return [(a.handler, a.target.name, a.position) for a in self._attached]

    @property
    def portable(self) -> list[Entry]:
        """The same as ``entries``, but for targets that are not named the same in another process."""
        return [
            (handler, target if leads_there(target) else given, position)
            for (handler, target, position), given in zip(self.entries, self._given, strict=True)
        ]

    @property
    def stale(self) -> bool:
        """Whether a target has been replaced by something else, while nothing was set there."""
        return any(place.stale for a in self._attached for place, _, _ in a.target.patches)

    def hold(self) -> None:
        """Have the handlers attached until as many calls of ``let_go``.

        Raises:
            PatchError: A target cannot be patched.
        """
        with _LOCK:
            self._users += 1
            if self._users > 1:
                return
            done = []
            try:
                for attached in self._attached:
                    attached.target.add(attached, self)
                    done.append(attached)
            except BaseException:
                self._users = 0
                for attached in done:
                    attached.target.remove(attached, self)
                raise

    def let_go(self) -> None:
        """Undo one ``hold``."""
        with _LOCK:
            self._users -= 1
            if self._users == 0:
                for attached in reversed(self._attached):
                    attached.target.remove(attached, self)


class Plugged:
    """The surrounding in which an environment's plugins take part in calls, and no others do."""

    def __init__(self, plugins: Plugins) -> None:
        self._plugins = plugins
        self._before: list[tuple[Any, bool]] = []

    def begin(self, seed: int) -> None:
        """They are the same in every episode."""

    def enter(self) -> None:
        """Let them take part in what runs in this thread."""
        thread = get_ident()
        # Another environment that is stepped from inside looks whether anything is around it only where somebody
        # runs or evaluates. No thread has this number.
        marked = ~thread not in EVALUATING
        if marked:
            EVALUATING[~thread] = {}
        self._before.append((PLUGGED.get(thread), marked))
        PLUGGED[thread] = self._plugins

    def leave(self) -> None:
        """Let those take part again that did before."""
        thread = get_ident()
        before, marked = self._before.pop()
        if marked:
            EVALUATING.pop(~thread, None)
        if before is None:
            PLUGGED.pop(thread, None)
        else:
            PLUGGED[thread] = before

    def around(self, run: Callable[[], Any]) -> Callable[[], Any]:
        """The simulation's main loop, in which they take part whatever thread it runs in."""
        plugins = self._plugins

        def run_with_plugins() -> Any:
            thread = get_ident()
            if PLUGGED.get(thread) is plugins:  # its user's thread, which is seen to whenever it is resumed
                return run()
            PLUGGED[thread] = plugins
            try:
                return run()
            finally:
                PLUGGED.pop(thread, None)

        return run_with_plugins


# -- seeing what happens --------------------------------------------------------------------------


@contextmanager
def trace(*targets: Any) -> Iterator[list[Call]]:
    """Record the calls of a model's functions, in the order in which they begin.

    Args:
        *targets: The functions, as ``attach_handler`` takes them; none: all that are exposed or have handlers, and
            all decorated decision points.

    Returns:
        A context manager whose value is the list of calls. An entry has the attributes ``target``, ``arguments``
        and ``result``, which are strings; the result is None until the call ends.

    Raises:
        SimEnvError: As ``attach_handler``.
    """
    calls: list[Call] = []

    def record(target: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Call:
        call = Call.of(target, args, kwargs)
        calls.append(call)
        return call

    done: list[Target] = []
    try:
        with _LOCK:
            for target in dict.fromkeys(map(find_target, targets) if targets else _everything()):
                if not isinstance(target, FunctionTarget):
                    continue
                target.add(record)
                done.append(target)
        yield calls
    finally:
        with _LOCK:
            for target in done:
                target.remove(record)


def _everything() -> Iterator[Target]:
    for target in list(Target.all):
        if target.place is None or target.slot:
            yield _at_hand(target)
    for name in registered_names():
        with suppress(SimEnvError, ImportError):  # decorated inside a function, as models of tests are
            target = find_target(name)
            if point_of(plain(found_at(*resolve(name, TARGET)))) is not None:
                yield target
