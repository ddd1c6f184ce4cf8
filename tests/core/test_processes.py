"""Errors cross to other processes as they are."""

import os
import sys
import traceback
from dataclasses import dataclass
from pickle import PicklingError
from types import GetSetDescriptorType, MemberDescriptorType

import numpy as np
import pytest

from simenv_marl.core.copies.packing import RemoteTraceback, pack_error, unpack_error
from simenv_marl.errors import WorkerError, error_text


class Many(ValueError):
    def __init__(self, one, two, three):
        super().__init__(f"{one} {two}")
        self.one, self.two, self.three = one, two, three

    def __str__(self):
        return f"{self.one}, {self.two} and {self.three}"


class Slotted(Exception):
    __slots__ = ("__private", "nothing", "unset", "value")

    def __init__(self, value):
        self.value, self.nothing, self.__private = value, None, value + 1

    def __str__(self):
        return f"{self.value} {self.__private} {self.nothing}"


@dataclass(frozen=True)
class Frozen(Exception):
    value: int


class Reduced(Exception):
    """Says itself how it is pickled."""

    def __init__(self, name, lock):
        super().__init__(name, lock)
        self.lock = lock

    def __reduce__(self):
        return Reduced, (self.args[0], None)

    def __str__(self):
        return self.args[0]


class Family(ExceptionGroup):
    def derive(self, excs):
        return Family(self.message, excs)


class Unspeakable(Exception):
    def __str__(self):
        raise LookupError("no looks, please")

    __repr__ = __str__


def raised(function, *args):
    try:
        function(*args)
    except BaseException as error:
        return error
    raise AssertionError


def noted(error, *notes):
    for note in notes:
        error.add_note(note)
    return error


def caused(error, cause):
    error.__cause__ = cause
    return error


def chained():
    def work():
        try:
            {}["first"]
        except KeyError:
            open("/nowhere/second")  # noqa: SIM115

    return caused(Many(1, 2, 3), raised(work))


def grouped():
    one = caused(noted(raised(open, "/nowhere"), "a note"), Many(1, 2, 3))
    group = ExceptionGroup("several", [one, ExceptionGroup("inner", [Many(4, 5, 6)]), one])
    one.__cause__.__context__ = group
    return group


ERRORS = {
    "plain": lambda: ValueError("bad", 3),
    "many": lambda: Many(1, "two", None),
    "frozen": lambda: Frozen(1),
    "two files": lambda: raised(os.rename, "/nowhere/one", "/nowhere/other"),
    "surrogates": lambda: raised(open, "/nowhere/\udce9"),
    "stop": lambda: StopIteration({"value": 3}),
    "attribute of a stream": lambda: raised(getattr, sys.stdout, "missing"),
    "decode": lambda: raised(b"\xff".decode),
    "syntax": lambda: raised(compile, "1 +\n", "file.py", "exec"),
    "ufunc": lambda: raised(np.add, "x", None),
    "reduced": lambda: Reduced("by itself", sys.stdout),
    "family": lambda: Family("all", [Many(4, 5, 6), KeyError("x")]),
    "base group": lambda: BaseExceptionGroup("several", [KeyboardInterrupt(), Many(1, 2, 3)]),
    "group": grouped,
    "notes": lambda: noted(Many(1, 2, 3), "one", "\ud800"),
    "chain": chained,
    "unspeakable": Unspeakable,
}
"""By name: errors that cross as they are."""


def members_of(error):
    """What an error has that is no attribute of the usual kind.

    Python 3.11 itself pickles no ``name`` of an AttributeError.
    """
    found = {}
    for kind in type(error).__mro__:
        for name, member in vars(kind).items():
            hidden = name.startswith("__") or name in ("obj", "args", "exceptions", "name")
            if isinstance(member, (MemberDescriptorType, GetSetDescriptorType)) and not hidden:
                found[name] = getattr(error, name, "unset")
    return found


def assert_alike(one, other):
    """What came is what went, with all that belongs to it."""
    assert type(one) is type(other)
    assert error_text(one) == error_text(other)
    assert members_of(one) == members_of(other)
    assert {**vars(one), "lock": 0, "__notes__": 0} == {**vars(other), "lock": 0, "__notes__": 0}
    assert getattr(one, "__notes__", []) == getattr(other, "__notes__", [])
    if isinstance(one, BaseExceptionGroup):
        for mine, theirs in zip(one.exceptions, other.exceptions, strict=True):
            assert_alike(mine, theirs)
    elif type(one) is not Reduced:
        assert repr(one.args) == repr(other.args) or type(one) is Unspeakable


@pytest.mark.parametrize("make", ERRORS.values(), ids=ERRORS)
def test_errors_from_worker_processes_keep_notes_and_causes(make):
    error = make()
    again = unpack_error(pack_error(error))
    assert again is not error
    assert_alike(error, again)
    assert type(again.__cause__) is RemoteTraceback
    for known in filter(None, (error, error.__cause__)):
        assert type(known).__name__ in str(again.__cause__)
    assert_alike(error, unpack_error(pack_error(again)))  # and once more
    traceback.format_exception(again)


class Recalcitrant(Unspeakable):
    def __reduce__(self):
        raise PicklingError("no")


@pytest.mark.parametrize(
    "error",
    [Many("some", "thing", "more"), Recalcitrant(), Slotted(4)],
    ids=["unpicklable", "pickling fails", "slots"],
)
def test_unpicklable_errors_of_worker_processes_arrive_as_text_with_notes(error):
    noted(caused(error, raised(open, "/nowhere")), "a note").held = (part for part in ())
    again = unpack_error(pack_error(error))
    assert type(again) is WorkerError
    assert f"cannot be pickled: {type(error).__name__}: {error_text(error)}" in str(again)
    assert again.__notes__ == ["a note"]
    assert "/nowhere" in str(again.__cause__)
    group = unpack_error(
        pack_error(noted(ExceptionGroup("several", [error, Many(4, 5, 6)]), "another"))
    )
    assert type(group) is WorkerError
    assert "cannot be pickled: ExceptionGroup: several (2 sub-exceptions)" in str(group)
    assert group.__notes__ == ["another"]
    assert type(error).__name__ in str(group.__cause__)
    outer = Many(1, 2, 3)
    outer.__context__ = error
    assert_alike(outer, unpack_error(pack_error(outer)))


@pytest.mark.parametrize("notes", ["text", 3, None, ("one", "two"), {}, [3, "one"], [[]]], ids=str)
def test_errors_with_malformed_notes_arrive_from_worker_processes(notes):
    error = ValueError("noted")
    error.__notes__ = notes
    again = unpack_error(pack_error(error))
    assert (type(again), again.args) == (ValueError, ("noted",))
    texts = (
        [note for note in notes if isinstance(note, str)]
        if isinstance(notes, (list, tuple))
        else []
    )
    assert getattr(again, "__notes__", []) == texts
