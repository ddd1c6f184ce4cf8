"""Lines and frames: what is sent arrives, and what is no frame is refused."""

import json
from math import inf, isnan, nan

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from simenv_marl.errors import WireError
from simenv_marl.remote.wire import decode, encode

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text().filter(lambda key: key != "float"), inner),
    max_leaves=20,
)


@given(VALUES)
def test_what_is_sent_arrives(value):
    line = encode({"value": value})
    assert line.endswith(b"\n")
    assert line.count(b"\n") == 1
    json.loads(line, parse_constant=lambda constant: pytest.fail(constant))  # any JSON reader can read it
    found = decode(line)["value"]
    assert found == value
    assert repr(found) == repr(value)  # -0.0, and integers that are no floats


def test_numbers_that_are_not_finite():
    line = encode({"value": [nan, inf, -inf, np.float32(inf)]})
    assert json.loads(line)["value"] == [{"float": "nan"}, {"float": "inf"}, {"float": "-inf"}, {"float": "inf"}]
    found = decode(line)["value"]
    assert isnan(found[0])
    assert found[1:] == [inf, -inf, inf]
    assert decode(b'{"a": {"float": 3}, "b": {"float": "nan", "more": 1}}') == {
        "a": {"float": 3},
        "b": {"float": "nan", "more": 1},
    }


@pytest.mark.parametrize(
    ("value", "sent"),
    [
        (np.float64(0.1), "0.1"),
        (np.int64(3), "3"),
        (np.bool_(True), "true"),
        (np.arange(4).reshape(2, 2), "[[0,1],[2,3]]"),
        (np.array(2.5), "2.5"),
        ((1, "a"), '[1,"a"]'),
        ({"a": np.zeros(1)}, '{"a":[0.0]}'),
        ("ä\n\ud800", '"\\u00e4\\n\\ud800"'),
    ],
)
def test_what_numpy_and_python_have_is_sent_as_json(value, sent):
    assert encode({"value": value}) == f'{{"value":{sent}}}\n'.encode()


@pytest.mark.parametrize(
    ("value", "where"),
    [({1}, "not JSON"), ([1, [object()]], r"\[1\]\[0\]"), ({"a": {2: 3}}, "'a'"), (b"a", "b'a'"), (1j, "1j")],
)
def test_what_is_no_json_is_refused_with_its_place(value, where):
    with pytest.raises(WireError, match=where):
        encode({"value": value})


@pytest.mark.parametrize("line", [b"", b"NaN", b"[1]", b"3", b"{", b'{"a": Infinity}', b'{"a": "\xff"}', b"[" * 10**5])
def test_what_is_no_frame_is_refused(line):
    with pytest.raises(WireError):
        decode(line)


def test_a_number_of_many_digits_is_refused():
    with pytest.raises(WireError):
        decode(b'{"a": ' + b"1" * 10_000 + b"}")
