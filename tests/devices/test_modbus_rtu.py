"""Modbus RTU frames by hand, over a pseudo-terminal. The CRCs are pymodbus's."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.devices.habits import Habits
from tests.devices.memory import Electronics
from tests.devices.modbus import ModbusUnit
from tests.devices.modbus_rtu import GARBAGE, ModbusRtu
from tests.devices.place import Place, Trouble

READ_SERIAL, SERIAL = "01 03 0000 0002 C40B", "01 03 04 00001267 B779"


class Master:
    def __init__(self, path: str) -> None:
        self.line = os.open(path, os.O_RDWR | os.O_NOCTTY)

    def send(self, *frames: str) -> None:
        os.write(self.line, bytes.fromhex("".join(frames)))

    def ask(self, frame: str, expected: str) -> None:
        """Blocks until as much has come as is expected."""
        self.send(frame)
        received, wanted = b"", bytes.fromhex(expected)
        while len(received) < len(wanted):
            received += os.read(self.line, len(wanted) - len(received))
        assert received.hex() == wanted.hex()


@contextmanager
def served(trouble: Trouble | None = None, habits: Habits | None = None) -> Iterator[tuple[ModbusRtu, Master]]:
    with ModbusRtu(ModbusUnit(Place(Electronics(habits or Habits()), trouble))) as server:
        master = Master(server.path)
        yield server, master
        os.close(master.line)


def test_registers_are_read_and_written() -> None:
    with served() as (server, master):
        master.ask(READ_SERIAL, SERIAL)
        master.ask("01 06 0020 C0DE 5858", "01 06 0020 C0DE 5858")
        master.ask("01 10 0100 0002 04 C01A69AD 0C15", "01 10 0100 0002 4034")
        master.ask("01 03 0100 0002 C5F7", "01 03 04 C01A69AD 0819")
        master.ask("01 03 0001 0001 D5CA", "01 83 02 C0F1")
        assert server.unit.place.unit.in_use["scale_factor_x"].hex() == "c01a69ad"


def test_frames_may_come_in_pieces() -> None:
    with served() as (_, master):
        master.send(READ_SERIAL[:8])
        master.ask(READ_SERIAL[8:], SERIAL)


def test_a_request_with_a_wrong_checksum_is_not_heard() -> None:
    with served() as (server, master):
        master.send("01 03 0000 0002 C40C")
        server.settle()
        master.ask(READ_SERIAL, SERIAL)
        assert server.unit.place.requests == 1


def test_what_comes_with_a_damaged_request_is_not_taken_for_the_next_one() -> None:
    server = ModbusRtu(ModbusUnit(Place(Electronics())))
    server._buffer = bytes.fromhex("55" + READ_SERIAL)
    assert server._next_frame() is None
    assert server._buffer == b""


def test_the_line_survives_a_master_that_closes_it() -> None:
    with served() as (server, first):
        first.ask(READ_SERIAL, SERIAL)
        second = Master(server.path)
        second.ask(READ_SERIAL, SERIAL)
        os.close(second.line)
        first.ask(READ_SERIAL, SERIAL)


@pytest.mark.parametrize(
    ("garbage", "frame"),
    [
        ("checksum", "01 03 04 00001267 B786"),
        ("function", "01 04 04 00001267 B6CE"),
        ("length", "01 03 04 000012 C4F7"),
        ("unit", "02 03 04 00001267 8479"),
        ("truncated", "01 03 04"),
        ("noise", "ff00 55aa 0001 fe"),
    ],
)
def test_a_reply_comes_damaged(garbage: str, frame: str) -> None:
    with served(Trouble(garble=frozenset({1}), garbage=(garbage,))) as (_, master):
        master.ask(READ_SERIAL, frame)
        master.ask(READ_SERIAL, SERIAL)
    assert garbage in GARBAGE


def test_a_late_reply_comes_after_the_next_one() -> None:
    with served(Trouble(late=frozenset({1}), late_s=0.1)) as (_, master):
        master.ask(READ_SERIAL + "01 03 0100 0002 C5F7", "01 03 04 C019999A FDCF" + SERIAL)


def test_a_reply_comes_twice_or_not_at_all() -> None:
    with served(Trouble(duplicate=frozenset({1}), lose_reply=frozenset({2}))) as (_, master):
        master.ask(READ_SERIAL, SERIAL * 2)
        master.send("01 03 0100 0002 C5F7")
        master.ask(READ_SERIAL, SERIAL)
