"""What the Modbus part of a profile refuses, and where a bus says its unit is."""

import json
import re

import pytest

from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.modbus.model import ModbusBus
from triaxcal_drivers.modbus.protocol import SerialLine, TcpAddress
from triaxcal_drivers.toml_text import validate


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('layout = "fifo"', 'layout = "ring"', "streams.queue: input tag 'ring' found"),
        ('layout = "fifo"\n', "", "streams.queue"),
        ("record_capacity = 2", "record_capacity = 40", "streams.queue takes 162 words, more than one read gives"),
        ("record_words = 4", "record_words = 3", "counter reaches past the record's 3 words"),
        ("remaining = 1", "remaining = 2", "header.remaining = 2 lies in the records, which start at 2"),
        ("address = 0x6B", "address = 0xFFFE", "streams.readings: 3 words from 65534 leave the table"),
        ("address = 0x6B", "address = 0x10000", "input should be less than or equal to 65535"),
        ('layout = "fifo"\naddress = 0x20', 'layout = "fifo"\ntable = "holding"\naddress = 0x6B',
         "two of them start at the same address"),
        ('pair = { address = 1, type = "uint32"', 'pair = { address = 1, type = "int24"',
         "registers.pair: type int24 is none of Modbus: use int32"),
        ('pair = { address = 1,', "pair = { address = 65535,", "address 65535 leaves no room for uint32"),
        ('table = "input", access = "ro"', 'table = "input"', "an input register is read-only"),
        ('pair = {', 'one = { address = 9, type = "float32", role = "bias.x" }\n'
         'two = { address = 10, type = "float32", role = "bias.y" }\npair = {',
         "registers.two: address 10 lies in one, which takes 2 words from 9 on"),
        ('name = "by-hand"', 'name = "by-hand"\nmax_write_words = 1', "is longer than one request may be"),
        ('pair = {', 'sn = { address = 9, type = "ascii", access = "ro" }\npair = {',
         'registers.sn: type = "ascii" and length (in bytes) go together'),
        ('pair = {', 'sn = { address = 9, type = "uint16", length = 2 }\npair = {',
         'registers.sn: type = "ascii" and length (in bytes) go together'),
        ('pair = {', 'sn = { address = 9, type = "ascii", length = 4 }\npair = {',
         'registers.sn: a register of type "ascii" is read-only'),
        ('pair = {', 'sn = { address = 9, type = "ascii", length = 4, access = "ro", role = "bias.x" }\npair = {',
         'registers.sn: a register of type "ascii" has no role but serial_number'),
        ('pair = {', 'sn = { address = 9, type = "ascii", length = 4, access = "ro", scale = 2.0 }\npair = {',
         'registers.sn: scale is for numbers'),
        ('pair = {', 'sn = { address = 65535, type = "ascii", length = 3, access = "ro" }\npair = {',
         "registers.sn: address 65535 leaves no room for ascii"),
        ('level = { table = "input", access = "ro", address = 8, type = "uint16" }',
         'level = { table = "input", access = "ro", address = 8, type = "ascii", length = 2 }',
         "identity.expect: register level holds text"),
        ('name = "by-hand"', 'name = "by-hand"\nmax_read_words = 126', "max_read_words: input should be less than"),
    ],
)  # fmt: skip
def test_a_fault_in_the_profile_is_one_line(bundle, old, new, message):
    with pytest.raises(ProfileError, match=re.escape(message)) as caught:
        bundle((old, new))
    assert str(caught.value).startswith("by-hand.toml")
    assert "\n" not in str(caught.value)


def test_streams_without_three_axes_are_refused(bundle):
    axes = '{ ux = { word = 0, type = "int16" }, uy = { word = 1, type = "int16" }, uz = { word = 2, type = "int16" } }'
    with pytest.raises(ProfileError, match=r"channels\.uz is missing: channels must have ux, uy and uz"):
        bundle((axes, '{ ux = { word = 0, type = "int16" }, uy = { word = 1, type = "int16" } }'))


def test_a_polled_block_is_as_long_as_its_last_channel_needs(bundle):
    end = " }\n\n[streams.queue]"
    longer = ('uz = { word = 2, type = "int16" }' + end, 'uz = { word = 5, type = "float64" }' + end)
    assert bundle(longer).profile.streams["readings"].words == 9
    assert bundle().profile.streams["queue"].words == 10


def bus(**settings) -> ModbusBus:
    return validate(ModbusBus, settings, json.dumps(settings).encode(), where="station.toml: bus")


def test_a_bus_is_a_tcp_address_or_a_serial_line():
    assert bus(host="10.0.0.7").where == TcpAddress("10.0.0.7", 502)
    assert bus(host="127.0.0.1", port=0).where == TcpAddress("127.0.0.1", 0)  # any free one, for a unit served
    assert bus(serial_port="/dev/ttyUSB0", baudrate=115200, parity="N", stopbits=2).where == SerialLine(
        "/dev/ttyUSB0", 115200, "N", 2
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({}, 'give either host = "…" (Modbus TCP) or serial_port = "…" (RTU)'),
        ({"host": "a", "serial_port": "b"}, "not both"),
        ({"hots": "a"}, "hots: unknown key; did you mean 'host'?"),
        ({"host": "a", "port": 65536}, "port: input should be less than or equal to 65535, not 65536"),
        ({"serial_port": "a", "parity": "even"}, "parity: input should be 'N', 'E' or 'O', not 'even'"),
        ({"host": "a", "unit_id": 256}, "unit_id: input should be less than or equal to 255, not 256"),
    ],
)
def test_a_bus_that_is_neither_or_both_or_misspelt_is_refused(settings, message):
    with pytest.raises(ProfileError, match=re.escape(message)):
        bus(**settings)


@pytest.mark.parametrize(
    ("line", "gap_s"),
    [
        (SerialLine("p", 9600, "E", 1), 3.5 * 11 / 9600),
        (SerialLine("p", 19200, "N", 1), 3.5 * 10 / 19200),
        (SerialLine("p", 115200, "E", 1), 1.75e-3),
    ],
)
def test_frames_are_kept_apart_by_three_and_a_half_characters(line, gap_s):
    """MODBUS over Serial Line V1.02, 2.5.1.1; above 19200 baud 1.75 ms whatever the rate."""
    assert line.frame_gap_s == pytest.approx(gap_s)
