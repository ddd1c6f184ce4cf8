"""Errors cross to other processes as they are."""

import asyncio
import json
import os
import sys
import traceback
from dataclasses import dataclass
from pickle import PicklingError
from types import GetSetDescriptorType, MemberDescriptorType

import numpy as np
import pytest
from gymnasium import spaces

from simenv_marl import branch, make_step, simulate_many, single_env, vector_env
from simenv_marl.core.packing import RemoteTraceback, pack_error, unpack_error
from simenv_marl.errors import BranchError, InvalidActionError, WorkerError, error_text
from tests.worlds.counters import FORK, FORKS

# -- errors of all kinds ------------------------------------------------------------------------------


class Keywords(Exception):
    """Is not made of its arguments."""

    def __init__(self, *, count):
        super().__init__("it is odd")
        self.count = count


class Many(ValueError):
    def __init__(self, one, two, three):
        super().__init__(f"{one} {two}")
        self.one, self.two, self.three = one, two, three

    def __str__(self):
        return f"{self.one}, {self.two} and {self.three}"


class New(Exception):
    def __new__(cls, number, text):
        made = super().__new__(cls, text)
        made.number = number
        return made


class Slotted(Exception):
    __slots__ = ("__private", "nothing", "unset", "value")

    def __init__(self, value):
        self.value, self.nothing, self.__private = value, None, value + 1

    def __str__(self):
        return f"{self.value} {self.__private} {self.nothing}"


@dataclass(frozen=True)
class Frozen(Exception):
    value: int


class WithPath(OSError):
    def __init__(self, path, reason):
        super().__init__(5, reason, path)
        self.reason = reason


class Reduced(Exception):
    """Says itself how it is pickled."""

    def __init__(self, name, lock):
        super().__init__(name, lock)
        self.lock = lock

    def __reduce__(self):
        return Reduced, (self.args[0], None)

    def __str__(self):
        return self.args[0]


class Dropping(Exception):
    def __getstate__(self):
        return {}


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


def from_none():
    error = caused(Many(1, 2, 3), None)
    error.__context__ = KeyError("x")
    return error


def circular():
    one, other = ValueError("one"), Many(1, 2, 3)
    other.__context__ = one
    return caused(one, other)


def grouped():
    one = caused(noted(raised(open, "/nowhere"), "a note"), Many(1, 2, 3))
    group = ExceptionGroup("several", [one, ExceptionGroup("inner", [Keywords(count=3)]), one])
    one.__cause__.__context__ = group
    return group


ERRORS = {
    "plain": lambda: ValueError("bad", 3),
    "attributes": lambda: Keywords(count=7),
    "many": lambda: Many(1, "two", None),
    "new": lambda: New(3, "text"),
    "slots": lambda: Slotted(4),
    "frozen": lambda: Frozen(1),
    "key": lambda: raised({}.__getitem__, "key"),
    "file": lambda: raised(open, "/nowhere/at all"),
    "two files": lambda: raised(os.rename, "/nowhere/one", "/nowhere/other"),
    "blocking": lambda: BlockingIOError(11, "busy", 5),
    "path": lambda: WithPath("/some/where", "no reason"),
    "surrogates": lambda: raised(open, "/nowhere/\udce9"),
    "surrogates in text": lambda: ValueError("\ud800 and \udfff"),
    "stop": lambda: StopIteration({"value": 3}),
    "exit": lambda: SystemExit(3),
    "attribute": lambda: raised(getattr, object(), "missing"),
    "attribute of a stream": lambda: raised(getattr, sys.stdout, "missing"),
    "name": lambda: raised(eval, "missing_name"),
    "module": lambda: raised(__import__, "no_such_module"),
    "decode": lambda: raised(b"\xff".decode),
    "translate": lambda: UnicodeTranslateError("text", 1, 2, "why"),
    "syntax": lambda: raised(compile, "1 +\n", "file.py", "exec"),
    "json": lambda: raised(json.loads, "{"),
    "cancelled": lambda: asyncio.CancelledError("why"),
    "linalg": lambda: raised(np.linalg.inv, np.zeros((2, 2))),
    "ufunc": lambda: raised(np.add, "x", None),
    "reduced": lambda: Reduced("by itself", sys.stdout),
    "dropping": lambda: Dropping("it is"),
    "family": lambda: Family("all", [Keywords(count=3), KeyError("x")]),
    "base group": lambda: BaseExceptionGroup("several", [KeyboardInterrupt(), Many(1, 2, 3)]),
    "group": grouped,
    "notes": lambda: noted(Many(1, 2, 3), "one", "\ud800"),
    "chain": chained,
    "circle": circular,
    "from None": from_none,
    "unspeakable": Unspeakable,
    "ours": lambda: InvalidActionError("it is not legal"),
}
"""By name: errors that cross as they are."""


def members_of(error):
    """What an error has that is no attribute of the usual kind."""
    found = {}
    for kind in type(error).__mro__:
        for name, member in vars(kind).items():
            hidden = name.startswith("__") or name in ("obj", "args", "exceptions")
            if isinstance(member, (MemberDescriptorType, GetSetDescriptorType)) and not hidden:
                found[name] = getattr(error, name, "unset")
    return found


def assert_alike(one, other, *, raised=False):
    """What came is what went, with all that belongs to it. Where it was raised, it has further notes and causes."""
    assert type(one) is type(other)
    assert error_text(one) == error_text(other)
    assert members_of(one) == members_of(other)
    assert {**vars(one), "lock": 0, "__notes__": 0} == {**vars(other), "lock": 0, "__notes__": 0}
    notes = getattr(one, "__notes__", [])
    assert getattr(other, "__notes__", [])[: len(notes)] == notes
    if raised:
        assert "in run" in str(other.__cause__)
    elif isinstance(one, BaseExceptionGroup):
        for mine, theirs in zip(one.exceptions, other.exceptions, strict=True):
            assert_alike(mine, theirs)
    elif type(one) is not Reduced:
        assert repr(one.args) == repr(other.args) or type(one) is Unspeakable


def causes_of(error):
    """The causes of an error that a traceback shows, without the error."""
    found = []
    while error is not None and all(error is not known for known in found):
        found.append(error)
        error = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    return found[1:]


@pytest.mark.parametrize("make", ERRORS.values(), ids=ERRORS)
def test_errors_cross_with_all_that_belongs_to_them(make):
    error = make()
    again = unpack_error(pack_error(error))
    assert again is not error
    assert_alike(error, again)
    assert type(again.__cause__) is RemoteTraceback
    for known in (error, *causes_of(error)):
        assert type(known).__name__ in str(again.__cause__)
    assert_alike(error, unpack_error(pack_error(again)))  # and once more
    traceback.format_exception(again)


def test_what_an_attribute_is_missing_of_stays_where_it_is():
    error = raised(getattr, [1, 2, 3], "missing")
    assert error.obj == [1, 2, 3]
    again = unpack_error(pack_error(error))
    assert (again.name, again.obj) == ("missing", None)


class Recalcitrant(Unspeakable):
    def __reduce__(self):
        raise PicklingError("no")


@pytest.mark.parametrize("error", [Many("some", "thing", "more"), Recalcitrant()], ids=["unpicklable", "recalcitrant"])
def test_what_cannot_cross_is_told_of_with_its_notes_and_causes(error):
    noted(caused(error, raised(open, "/nowhere")), "a note").held = (part for part in ())
    again = unpack_error(pack_error(error))
    assert type(again) is WorkerError
    assert f"cannot be pickled: {type(error).__name__}: {error_text(error)}" in str(again)
    assert again.__notes__ == ["a note"]
    assert "/nowhere" in str(again.__cause__)
    group = unpack_error(pack_error(noted(ExceptionGroup("several", [error, Keywords(count=3)]), "another")))
    assert type(group) is WorkerError
    assert "cannot be pickled: ExceptionGroup: several (2 sub-exceptions)" in str(group)
    assert group.__notes__ == ["another"]
    assert type(error).__name__ in str(group.__cause__)
    outer = Many(1, 2, 3)
    outer.__context__ = error
    assert_alike(outer, unpack_error(pack_error(outer)))


@pytest.mark.parametrize("notes", ["text", 3, None, ("one", "two"), {}, [3, "one"], [[]]], ids=str)
def test_notes_that_are_no_list_of_texts_are_no_obstacle(notes):
    error = ValueError("noted")
    error.__notes__ = notes
    again = unpack_error(pack_error(error))
    assert (type(again), again.args) == (ValueError, ("noted",))
    texts = [note for note in notes if isinstance(note, str)] if isinstance(notes, (list, tuple)) else []
    assert getattr(again, "__notes__", []) == texts


def test_a_long_chain_crosses():
    error = ValueError(0)
    for number in range(1, 3000):
        error = caused(ValueError(number), error)
    again = unpack_error(pack_error(error))
    assert_alike(error, again)
    assert "ValueError: 0\n" in str(again.__cause__)


# -- from simulations ---------------------------------------------------------------------------------


class Model:
    """Raises what its first decision names."""

    def reset(self, seed=None, options=None):
        self.seed = seed

    def run(self):
        raise list(ERRORS.values())[self.decide()]()

    def decide(self):
        return 0


POINTS = {
    f"{__name__}.Model.decide": make_step(
        observation_space=spaces.Discrete(3),
        observation_space_mapping=lambda model: 0,
        action_space=spaces.Discrete(len(ERRORS)),
        action_space_mapping=int,
        reward_mapping=lambda model: 0.0,
    )
}


@FORKS
def test_errors_come_from_workers_and_from_branches_as_themselves():
    envs = vector_env(Model, POINTS, num_envs=2, workers=1, context=FORK)
    env = single_env(Model, POINTS)
    env.reset(seed=0)
    for number, name in enumerate(ERRORS):
        error = ERRORS[name]()
        envs.reset(seed=0)
        with pytest.raises(BaseException) as caught:
            envs.step([number] * 2)
        assert_alike(error, caught.value, raised=True)
        assert any("worker 0" in note for note in caught.value.__notes__) or name == "frozen"
        with pytest.raises(Exception) as caught:
            branch(env, lambda twin, _, number=number: twin.step(number), 1, method="fork")
        fatal = not isinstance(error, Exception)
        assert (type(caught.value) is BranchError) is fatal
        assert_alike(error, caught.value.__cause__ if fatal else caught.value, raised=True)
    envs.close()
    env.close()


# Where work is given up, joblib ends a thread of its own in any case.
@pytest.mark.filterwarnings("ignore:Exception in thread ExecutorManager:pytest.PytestUnhandledThreadExceptionWarning")
@pytest.mark.parametrize("name", ["chain", "group", "slots", "reduced"])
def test_errors_come_from_joblibs_workers_as_themselves(name):
    joblib = pytest.importorskip("joblib")
    number = list(ERRORS).index(name)
    policies = {next(iter(POINTS)): lambda observations: [number] * len(observations)}
    try:
        with pytest.raises(Exception) as caught:
            simulate_many(Model, policies, points=POINTS, seeds=range(2), workers=2)
    finally:
        joblib.externals.loky.get_reusable_executor().shutdown(wait=True)
    assert_alike(ERRORS[name](), caught.value, raised=True)
