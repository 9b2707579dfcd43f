"""Register bytes against struct, against the catalogue of CRCs, and there and back."""

import math
import struct
import zlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from triaxcal_drivers.errors import RegisterValueError
from triaxcal_drivers.profile import Register
from triaxcal_drivers.registers import SIZES, crc, decode, encode, step

INTEGERS = [t for t in SIZES if "int" in t]
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


@pytest.mark.parametrize(
    ("type_", "value", "raw"),
    [
        ("int16", -2, "FFFE"),
        ("uint16", 0x5A17, "5A17"),
        ("int24", -1, "FFFFFF"),
        ("uint24", 0x010203, "010203"),
        ("int32", -(2**31), "80000000"),
        ("uint32", 0x65766173, "65766173"),
        ("int64", -1, "FFFFFFFFFFFFFFFF"),
        ("uint64", 2**63, "8000000000000000"),
        ("float32", -2.4, "C019999A"),
        ("float64", 1.0, "3FF0000000000000"),
    ],
)
def test_values_have_the_bytes_of_their_type_in_either_order(type_, value, raw):
    register = Register(type=type_)
    big = bytes.fromhex(raw)
    assert encode(register, value, order="big", name="r") == big
    assert encode(register, value, order="little", name="r") == big[::-1]
    assert decode(register, big, order="big", name="r") == pytest.approx(value, rel=1e-7)
    assert decode(register, big[::-1], order="little", name="r") == pytest.approx(value, rel=1e-7)


@given(st.sampled_from(INTEGERS), ORDERS, st.data())
def test_integers_come_back_as_they_went(type_, order, data):
    bits = 8 * SIZES[type_]
    low, high = (0, 2**bits - 1) if type_.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
    # Values pass through a float on the way: above 2^53 not every whole number is one.
    value = int(float(data.draw(st.integers(max(low, -(2**53)), min(high, 2**53)))))
    register = Register(type=type_)
    assert decode(register, encode(register, value, order=order, name="r"), order=order, name="r") == value


@given(st.floats(width=32, allow_nan=False, allow_infinity=False), ORDERS)
def test_float32_values_come_back_as_they_went(value, order):
    register = Register(type="float32")
    assert decode(register, encode(register, value, order=order, name="r"), order=order, name="r") == value


@given(st.floats(-1e30, 1e30))
def test_a_float32_register_holds_the_nearest_number_it_can(value):
    register = Register(type="float32")
    back = decode(register, encode(register, value, order="big", name="r"), order="big", name="r")
    assert abs(back - value) <= max(abs(value) * 2**-24, 2**-150)


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


@pytest.mark.parametrize("type_", INTEGERS)
def test_a_value_beyond_the_type_is_refused(type_):
    bits = 8 * SIZES[type_]
    high = 2**bits if type_.startswith("u") else 2 ** (bits - 1)
    low = -1 if type_.startswith("u") else -(2 ** (bits - 1)) - 1
    for value in (high, low if bits < 64 else -(2.0**65)):
        with pytest.raises(RegisterValueError, match=f"register r: .* does not fit {type_}"):
            encode(Register(type=type_), value, order="big", name="r")


@pytest.mark.parametrize("type_", ["float32", "float64", "int16", "int24"])
def test_what_is_no_finite_number_does_not_fit(type_):
    for value in (math.nan, math.inf, -math.inf):
        with pytest.raises(RegisterValueError, match=f"does not fit {type_}"):
            encode(Register(type=type_), value, order="big", name="r")


def test_a_value_that_rounds_to_infinity_does_not_fit_float32():
    with pytest.raises(RegisterValueError, match="does not fit float32"):
        encode(Register(type="float32"), 3.5e38, order="big", name="r")


@pytest.mark.parametrize("type_", SIZES)
def test_bytes_of_the_wrong_length_are_refused(type_):
    for length in (0, SIZES[type_] - 1, SIZES[type_] + 1):
        with pytest.raises(RegisterValueError, match=rf"register r: {length} bytes, expected {SIZES[type_]} \({type_}"):
            decode(Register(type=type_), bytes(length), order="big", name="r")


def test_whole_numbers_are_decoded_whole():
    """2^53 + 1 is no float: an identity must not come back changed."""
    raw = struct.pack(">Q", 2**53 + 1)
    assert decode(Register(type="uint64"), raw, order="big", name="serial_number") == 2**53 + 1


@pytest.mark.parametrize(
    ("type_", "scale", "value", "step_"),
    [
        ("int16", 1e-3, 0.2, 1e-3),
        ("int32", -(2.0**-20), 0.2, 2.0**-20),
        ("float32", 1.0, 1.0, 2.0**-23),
        ("float32", 1.0, -2.41, 2.0**-22),
        ("float32", 1e-6, 1e-6, 1e-6 * 2.0**-23),
        ("float64", 1.0, 1.0, 2.0**-52),
    ],
)
def test_the_step_of_a_register_is_the_distance_to_the_next_value_that_it_can_hold(type_, scale, value, step_):
    register = Register(type=type_, scale=scale)
    assert step(register, value) == pytest.approx(step_, rel=1e-12)
    raw = int.from_bytes(encode(register, value, order="big", name="r"), "big")
    size = SIZES[type_]
    beside = decode(register, (raw + 1).to_bytes(size, "big"), order="big", name="r")
    assert abs(beside - decode(register, raw.to_bytes(size, "big"), order="big", name="r")) == pytest.approx(step_)
