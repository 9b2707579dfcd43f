"""The extraction for many frames at once, judged by cantools' own decoding of one frame."""

import cantools.database.can as cantools_can
import numpy as np
import pytest
from cantools.database.conversion import BaseConversion
from hypothesis import given
from hypothesis import strategies as st

from triaxcal_drivers.can.dbc import dbc_messages
from triaxcal_drivers.can.message import Signal


@st.composite
def signals(draw: st.DrawFn) -> tuple[cantools_can.Signal, int]:
    """A signal anywhere in a message, and the message's length in bytes; CAN FD's lengths included."""
    length_bytes = draw(st.sampled_from([1, 2, 3, 7, 8, 8, 8, 12, 64]))
    is_float = length_bytes >= 2 and draw(st.booleans())
    widths = [w for w in (16, 32, 64) if w <= 8 * length_bytes] if is_float else range(1, min(64, 8 * length_bytes) + 1)
    width = draw(st.sampled_from(list(widths)))
    first = draw(st.integers(0, 8 * length_bytes - width))
    big = draw(st.booleans())
    start = 8 * (first // 8) + 7 - first % 8 if big else first
    scale = draw(st.sampled_from([1, 2, 0.01, 1.1920928955078125e-06, -0.5]))
    made = cantools_can.Signal(
        "S", start, width, "big_endian" if big else "little_endian", not is_float and draw(st.booleans()),
        conversion=BaseConversion.factory(scale=scale, offset=draw(st.sampled_from([0, -40, 0.5])), is_float=is_float),
    )  # fmt: skip
    return made, length_bytes


@given(signals(), st.data())
def test_every_signal_reads_as_cantools_reads_it(drawn: tuple[cantools_can.Signal, int], data: st.DataObject) -> None:
    theirs, length = drawn
    frames = data.draw(st.lists(st.binary(min_size=length, max_size=length), min_size=1, max_size=5))
    ours = Signal(
        "S", theirs.start, theirs.length, theirs.byte_order == "big_endian", theirs.is_signed,
        theirs.is_float, float(theirs.scale), float(theirs.offset),
    )  # fmt: skip
    message = cantools_can.Message(1, "M", length, [theirs])
    octets = np.frombuffer(b"".join(frames), dtype=np.uint8).reshape(len(frames), length)
    raw = [message.decode(f, scaling=False)["S"] for f in frames]
    np.testing.assert_array_equal(ours.raw(octets).tolist(), raw)
    with np.errstate(invalid="ignore", over="ignore"):
        scaled = [float(message.decode(f)["S"]) for f in frames]
        np.testing.assert_allclose(ours.values(octets), scaled, rtol=1e-15, atol=1e-12)
    assert ours.size <= length


@pytest.mark.parametrize(
    ("line", "frame", "value"),
    [
        # Motorola order, as the DBC numbers it: the top bit of byte 1, going down into byte 2
        ('SG_ S : 15|16@0- (1,0) [0|0] "" X', "00 ff fe 00 00 00 00 00", -2.0),
        # Intel order, from the middle of byte 0 over nine bits: 0b1_0000_1010
        ('SG_ S : 4|9@1+ (0.5,10) [0|0] "" X', "a0 10 00 00 00 00 00 00", 0x10A * 0.5 + 10),
        # a 24-bit two's complement number, least significant byte first
        ('SG_ S : 0|24@1- (1,0) [0|0] "" X', "00 00 80 00 00 00 00 00", -8388608.0),
    ],
)
def test_a_dbc_line_reads_as_its_definition_says(line: str, frame: str, value: float) -> None:
    dbc = f"BO_ 100 M: 8 X\n {line}\n".encode()
    (message,) = dbc_messages(dbc, base_node_id=None, where="m.dbc")
    data = np.frombuffer(bytes.fromhex(frame), dtype=np.uint8)[None, :]
    assert message.signals["S"].values(data).tolist() == [value]


def test_a_dbc_float_reads_as_ieee_754() -> None:
    dbc = b'BO_ 100 M: 8 X\n SG_ S : 0|32@1- (2,0) [0|0] "" X\n\nSIG_VALTYPE_ 100 S : 1;\n'
    (message,) = dbc_messages(dbc, base_node_id=None, where="m.dbc")
    data = np.frombuffer(bytes.fromhex("9a 99 19 c0 00 00 00 00"), dtype=np.uint8)[None, :]
    assert message.signals["S"].values(data)[0] == pytest.approx(-4.8, rel=1e-7)
