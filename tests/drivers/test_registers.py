"""Numbers to raw bytes and back, and the types of raw numbers, by literal bytes."""

import math
import re
import struct
import zlib
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from triaxcal_drivers.errors import RegisterValueError
from triaxcal_drivers.profile import Register
from triaxcal_drivers.registers import TYPES, crc, decode, encode, in_words, next_in_words, raw_number, step

LITERAL = {
    "int8": (-2, "FE"),
    "uint8": (0xFE, "FE"),
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
    assert [(n, next_in_words(n)) for n in TYPES if not in_words(n)] == [
        ("int8", "int16"),
        ("uint8", "uint16"),
        ("int24", "int32"),
        ("uint24", "uint32"),
    ]


def test_types_are_all_different():
    shown = sorted((t.size, t.lowest, t.highest) for t in TYPES.values())
    assert all(a != b for a, b in pairwise(shown))


def test_crc_16_modbus_has_the_catalogued_check_value():
    assert crc("crc-16/modbus", b"123456789") == 0x4B37


def test_crc_16_modbus_of_a_frame_that_circulates_with_the_protocol():
    """Request for three holding registers at 0x6B of unit 17; the CRC 76 87 is sent low byte first."""
    assert crc("crc-16/modbus", bytes.fromhex("11 03 00 6B 00 03")).to_bytes(2, "little") == b"\x76\x87"


def test_crc_16_modbus_followed_by_itself_is_zero():
    body = b"scale factor"
    assert crc("crc-16/modbus", body + crc("crc-16/modbus", body).to_bytes(2, "little")) == 0


def test_crc_of_nothing_is_the_initial_value():
    assert crc("crc-16/modbus", b"") == 0xFFFF
    assert crc("crc-32", b"") == 0


def test_crc_32_has_the_catalogued_check_value():
    assert crc("crc-32", b"123456789") == 0xCBF43926 == zlib.crc32(b"123456789")


@given(st.integers(-30000, 30000), st.floats(1e-3, 1e3), st.floats(-100, 100), ORDERS, st.sampled_from([1, -1]))
def test_scale_and_offset_turn_raw_numbers_into_values_and_back(raw, scale, offset, order, sign):
    register = Register(type="int16", scale=sign * scale, offset=offset)
    data = raw.to_bytes(2, order, signed=True)
    value = decode(register, data, order=order, name="r")
    assert value == pytest.approx(raw * sign * scale + offset)
    assert encode(register, value, order=order, name="r") == data


def test_a_value_between_two_steps_goes_to_the_nearer():
    register = Register(type="int16", scale=0.01)
    assert encode(register, 21.504, order="big", name="r") == (2150).to_bytes(2, "big")
    assert encode(register, 21.506, order="big", name="r") == (2151).to_bytes(2, "big")


@pytest.mark.parametrize("value", [-0.5001, 0.5001, math.inf, -math.inf, 1e30])
def test_a_value_outside_the_limits_is_refused(value):
    register = Register(type="float32", minimum=-0.5, maximum=0.5, unit="g")
    with pytest.raises(RegisterValueError, match=r"^register bias_x: .* g is outside its limits -0\.5 to 0\.5$"):
        encode(register, value, order="big", name="bias_x")


@pytest.mark.parametrize("value", [-0.5, 0.5, 0.0])
def test_the_limits_themselves_are_allowed(value):
    register = Register(type="float32", minimum=-0.5, maximum=0.5)
    assert decode(register, encode(register, value, order="big", name="r"), order="big", name="r") == value


def test_a_limit_of_zero_is_a_limit():
    with pytest.raises(RegisterValueError, match="outside its limits"):
        encode(Register(type="int16", minimum=0.0), -1, order="big", name="r")
    with pytest.raises(RegisterValueError, match="outside its limits"):
        encode(Register(type="int16", maximum=0.0), 1, order="big", name="r")


def test_whole_numbers_are_decoded_whole():
    """2^53 + 1 is no float: an identity must not come back changed."""
    raw = struct.pack(">Q", 2**53 + 1)
    assert decode(Register(type="uint64"), raw, order="big", name="serial_number") == 2**53 + 1


@pytest.mark.parametrize(
    ("type_", "scale", "value", "step_"),
    [
        ("int16", 1e-3, 0.2, 1e-3),
        ("int32", -(2.0**-20), 0.2, 2.0**-20),
        ("float32", 1e-6, 1e-6, 1e-6 * 2.0**-23),
    ],
)
def test_the_step_of_a_register_is_that_of_its_type_in_the_unit_of_the_register(type_, scale, value, step_):
    assert step(Register(type=type_, scale=scale), value) == pytest.approx(step_, rel=1e-12)


EDGES = [
    0,
    1,
    -1,
    2**53 - 1,
    2**53,
    2**53 + 1,
    -(2**53) - 1,
    2**62 + 1,
    2**63 - 1,
    -(2**63),
    2**63,
    2**63 + 1,
    2**64 - 1,
]


@pytest.mark.parametrize("order", ["big", "little"])
@pytest.mark.parametrize(("scale", "offset"), [(1.0, 0.0), (1, 0), (-1.0, 0.0), (3.0, -7.0), (2, 2**53 + 1)])
@pytest.mark.parametrize(
    ("type_", "number"),
    [(t, n) for t, low, high in (("int64", -(2**63), 2**63), ("uint64", 0, 2**64)) for n in EDGES if low <= n < high],
)
def test_integers_of_64_bits_are_exact_both_ways(type_, number, scale, offset, order):
    raw = struct.pack(("<" if order == "little" else ">") + {"int64": "q", "uint64": "Q"}[type_], number)
    register = Register(type=type_, scale=scale, offset=offset)
    value = decode(register, raw, order=order, name="r")
    assert isinstance(value, int)
    assert value == number * int(scale) + int(offset)
    assert encode(register, value, order=order, name="r") == raw
    assert raw_number(register, raw, order=order, name="r") == number


@pytest.mark.parametrize(("value", "raw"), [(6, 2), (7, 2), (8, 3), (-8, -3), (4.5, 2)])
def test_an_integer_between_two_steps_goes_to_the_nearer(value, raw):
    register = Register(type="int16", scale=3.0)
    assert encode(register, value, order="big", name="r") == raw.to_bytes(2, "big", signed=True)


@pytest.mark.parametrize("value", [2**64, -1, 2.0**64])
def test_an_integer_beyond_its_type_is_refused(value):
    with pytest.raises(RegisterValueError, match="does not fit uint64"):
        encode(Register(type="uint64"), value, order="big", name="r")


def test_a_limit_is_as_exact_as_the_register():
    register = Register(type="uint64", minimum=2**53 + 1, maximum=2**53 + 3)
    for beyond in (2**53, 2**53 + 4):
        with pytest.raises(RegisterValueError, match="outside its limits"):
            encode(register, beyond, order="big", name="r")
    assert encode(register, 2**53 + 1, order="big", name="r") == (2**53 + 1).to_bytes(8, "big")


@pytest.mark.parametrize(
    ("type_", "scale", "raw", "number"),
    [
        ("uint64", 0.001, struct.pack(">Q", 2**53 + 1), 2**53 + 1),
        ("int16", 0.5, struct.pack(">h", -3), -3),
        ("float32", 2.0, struct.pack(">f", 777.0), 777),
        ("float32", 1.0, b"\xff" * 4, None),
        ("float64", 1.0, struct.pack(">d", math.inf), None),
    ],
)
def test_a_raw_number_is_what_the_device_counts(type_, scale, raw, number):
    assert raw_number(Register(type=type_, scale=scale, offset=1.0), raw, order="big", name="r") == number
