"""Register bytes against struct, against the catalogue of CRCs, and there and back."""

import math
import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from triaxcal_drivers.errors import RegisterValueError
from triaxcal_drivers.profile import Register
from triaxcal_drivers.registers import crc, decode, encode, raw_number, step

ORDERS = st.sampled_from(["big", "little"])


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
