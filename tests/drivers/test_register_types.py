"""Every type of the table: literal bytes, range, rounding, steps, and the same numbers one by one or all at once."""

import math
import re
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from triaxcal_drivers.errors import RegisterValueError
from triaxcal_drivers.profile import Register
from triaxcal_drivers.registers import TYPES, decode, encode, in_words, next_in_words, step

LITERAL = {
    "int16": (-2, "FFFE"),
    "uint16": (0x5A17, "5A17"),
    "int24": (-3, "FFFFFD"),
    "uint24": (0x010203, "010203"),
    "int32": (-(2**31), "80000000"),
    "uint32": (0x65766173, "65766173"),
    "int64": (-4, "FFFFFFFFFFFFFFFC"),
    "uint64": (2**63, "8000000000000000"),
    "float32": (-2.5, "C0200000"),
    "float64": (1.0, "3FF0000000000000"),
}
"""A number of each type and its bytes, by the type's definition: a new type adds its line."""

each_type = pytest.mark.parametrize("name", TYPES)
ORDERS = st.sampled_from(["big", "little"])


def bytes_of(name, value, order="big"):
    return encode(Register(type=name), value, order=order, name="r")


def number(name, data, order="big"):
    return decode(Register(type=name), data, order=order, name="r")


def within(name):
    """Floats that the type can come near to, one in two near its ends or zero."""
    type_ = TYPES[name]
    low, high = float(type_.lowest), float(type_.highest)
    ends = [low, low / 2, low / 3, high / 3, high / 2, math.nextafter(high, 0)]
    # Of 64 bits the highest number is no float: what is below it by a float is in.
    anywhere = st.floats(low, math.nextafter(high, 0))
    return st.one_of(anywhere, st.sampled_from(ends), st.floats(max(low, -9.0), min(high, 9.0)))


@each_type
def test_a_number_has_the_bytes_that_the_definition_of_its_type_gives(name):
    value, digits = LITERAL[name]
    data = bytes.fromhex(digits)
    assert len(data) == TYPES[name].size
    assert bytes_of(name, value) == data
    assert bytes_of(name, value, "little") == data[::-1]
    assert number(name, data) == number(name, data[::-1], "little") == value


@each_type
@given(data=st.data(), order=ORDERS)
def test_any_bytes_come_back_as_they_were(name, data, order):
    size = TYPES[name].size
    raw = data.draw(st.binary(min_size=size, max_size=size))
    value = number(name, raw, order)
    if math.isfinite(value) and value == float(value):  # a value is written from a float
        assert number(name, bytes_of(name, value, order), order) == value


@pytest.mark.slow
@each_type
@given(data=st.data())
def test_a_number_goes_to_the_nearest_that_the_type_holds(name, data):
    value = data.draw(within(name))
    back = number(name, bytes_of(name, value))
    assert abs(back - value) <= TYPES[name].step(max(value, back, key=abs)) / 2


@each_type
def test_the_ends_of_the_range_are_in_it_and_what_is_beyond_does_not_fit(name):
    type_ = TYPES[name]
    for end, sign in ((type_.lowest, -1), (type_.highest, 1)):
        step_ = type_.step(end)
        beyond = end + sign * (int(step_) if step_ == int(step_) else step_)  # of 64 bits an end is no float
        assert type_.decode(type_.encode(end)) == end
        with pytest.raises((OverflowError, ValueError)):
            type_.encode(beyond)
        for outside in (2.0 * beyond, sign * math.inf):
            said = f"^register r: {re.escape(repr(outside))} does not fit {name}$"
            with pytest.raises(RegisterValueError, match=said):
                bytes_of(name, outside)


@each_type
def test_what_is_no_number_does_not_fit(name):
    with pytest.raises(RegisterValueError, match=f"does not fit {name}$"):
        bytes_of(name, math.nan)


@each_type
def test_bytes_of_the_wrong_length_are_refused(name):
    size = TYPES[name].size
    for length in (0, size - 1, size + 1):
        with pytest.raises(RegisterValueError, match=rf"register r: {length} bytes, expected {size} \({name}"):
            number(name, bytes(length))


@each_type
@pytest.mark.parametrize("value", [0.0, 0.003, 0.3, 1.0, 5.7, 100.0, 3000.25])
def test_the_step_is_the_distance_to_the_next_number_of_the_type(name, value):
    value = min(value, TYPES[name].highest / 2)
    data = bytes_of(name, value)
    beside = (int.from_bytes(data, "big") + 1).to_bytes(len(data), "big")
    assert number(name, beside) - number(name, data) == pytest.approx(TYPES[name].step(value), rel=1e-12)
    assert step(Register(type=name, scale=-0.5), -0.5 * value) == pytest.approx(TYPES[name].step(value) / 2)


@each_type
@given(data=st.data())
def test_many_at_once_are_the_same_numbers_as_one_by_one(name, data):
    size = TYPES[name].size
    rows = data.draw(st.lists(st.binary(min_size=size, max_size=size), max_size=5))
    found = TYPES[name].decode_all(np.array([list(r) for r in rows], np.uint8).reshape(-1, size))
    one_by_one = [TYPES[name].decode(r) for r in rows]
    assert all(a == b or (a != a and b != b) for a, b in zip(found.tolist(), one_by_one, strict=True))


def test_a_type_that_fills_no_words_has_the_next_that_does():
    assert [(n, next_in_words(n)) for n in TYPES if not in_words(n)] == [("int24", "int32"), ("uint24", "uint32")]


def test_types_are_all_different():
    shown = sorted((t.size, t.lowest, t.highest) for t in TYPES.values())
    assert all(a != b for a, b in pairwise(shown))
