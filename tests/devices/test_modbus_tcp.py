"""Modbus TCP frames by hand, over a socket."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.devices.habits import Habits
from tests.devices.memory import Electronics
from tests.devices.modbus import ModbusUnit
from tests.devices.modbus_tcp import GARBAGE, ModbusTcp
from tests.devices.place import Place, Reply, Trouble

READ_SERIAL = "0000 0006 01 03 0000 0002"
SERIAL = "0000 0007 01 03 04 00001267"
RESET = "0000 0006 01 06 0024 5253"


class Master:
    def __init__(self, port: int) -> None:
        self._socket = socket.create_connection(("127.0.0.1", port), timeout=180)

    def send(self, *frames: str) -> None:
        self._socket.sendall(bytes.fromhex("".join(frames)))

    def receive(self, size: int) -> str:
        received = b""
        while len(received) < size and (more := self._socket.recv(size - len(received))):
            received += more
        return received.hex()

    def ask(self, frame: str, expected: str) -> None:
        self.send(frame)
        assert self.receive(len(bytes.fromhex(expected))) == bytes.fromhex(expected).hex()

    def close(self) -> None:
        self._socket.close()


@contextmanager
def served(trouble: Trouble | None = None, habits: Habits | None = None) -> Iterator[tuple[ModbusTcp, Master]]:
    with ModbusTcp(ModbusUnit(Place(Electronics(habits or Habits()), trouble))) as server:
        master = Master(server.port)
        yield server, master
        master.close()


def test_registers_are_read_and_written() -> None:
    with served() as (server, master):
        master.ask("0001" + READ_SERIAL, "0001" + SERIAL)
        master.ask("0002 0000 0006 01 06 0020 C0DE", "0002 0000 0006 01 06 0020 C0DE")
        master.ask("0003 0000 000B 01 10 0100 0002 04 C01A69AD", "0003 0000 0006 01 10 0100 0002")
        master.ask("0004 0000 0006 01 03 0100 0002", "0004 0000 0007 01 03 04 C01A69AD")
        master.ask("FFFF 0000 0006 01 03 0001 0001", "FFFF 0000 0003 01 83 02")
        assert server.unit.place.unit.in_use["scale_factor_x"].hex() == "c01a69ad"


def test_frames_may_come_in_pieces_and_together() -> None:
    with served() as (_, master):
        frame = "0001" + READ_SERIAL
        master.send(frame[:9])
        master.ask(frame[9:] + "0002" + READ_SERIAL, "0001" + SERIAL + "0002" + SERIAL)


def test_other_units_are_not_answered_for() -> None:
    with served() as (server, master):
        master.send("0001 0000 0006 02 03 0000 0002")
        master.ask("0002" + READ_SERIAL, "0002" + SERIAL)
        assert server.unit.place.requests == 1


def test_what_is_no_modbus_ends_the_connection() -> None:
    with served() as (_, master):
        master.send("0001 0001 0006 01 03 0000 0002")
        assert master.receive(1) == ""


def test_a_lost_reply_leaves_the_next_one() -> None:
    with served(Trouble(lose_reply=frozenset({1}), lose_request=frozenset({2}))) as (server, master):
        master.send("0001" + READ_SERIAL, "0002" + READ_SERIAL)
        master.ask("0003" + READ_SERIAL, "0003" + SERIAL)
        assert len(server.unit.place.unit.log) == 2


def test_a_late_reply_comes_after_the_next_one() -> None:
    with served(Trouble(late=frozenset({1}), late_s=0.1)) as (_, master):
        master.ask("0001" + READ_SERIAL + "0002" + READ_SERIAL, "0002" + SERIAL + "0001" + SERIAL)


def test_a_reply_comes_twice() -> None:
    with served(Trouble(duplicate=frozenset({1}))) as (_, master):
        master.ask("0001" + READ_SERIAL, ("0001" + SERIAL) * 2)


@pytest.mark.parametrize(
    ("garbage", "frame"),
    [
        ("function", "0001 0000 0007 01 04 04 00001267"),
        ("length", "0001 0000 0006 01 03 04 000012"),
        ("transaction", "0002 0000 0007 01 03 04 00001267"),
        ("unit", "0001 0000 0007 02 03 04 00001267"),
        ("protocol", "0001 0001 0007 01 03 04 00001267"),
        ("truncated", "0001 0000 00"),
        ("noise", "ff00 55aa 0001 fe"),
    ],
)
def test_a_reply_comes_damaged(garbage: str, frame: str) -> None:
    with served(Trouble(garble=frozenset({1}), garbage=(garbage,))) as (_, master):
        master.ask("0001" + READ_SERIAL, frame)
        master.ask("0002" + READ_SERIAL, "0002" + SERIAL)
    assert garbage in GARBAGE


def test_garbage_that_there_is_not_is_named() -> None:
    with pytest.raises(ValueError, match="no garbage 'checksum'"):
        ModbusTcp(ModbusUnit(Place(Electronics()))).framed(Reply(b"\x03", 0.0, "checksum"), 1)


def test_a_fault_of_the_server_itself_comes_out() -> None:
    def talk() -> None:
        with served(Trouble(garble=1.0, garbage=("checksum",))) as (server, master):
            master.send("0001" + READ_SERIAL)
            server.settle()

    with pytest.raises(ValueError, match="no garbage 'checksum'"):
        talk()


@pytest.mark.parametrize("done", [True, False])
def test_a_connection_is_reset_before_or_after_the_work(done: bool) -> None:
    with served(Trouble(drop=frozenset({2}), drop_done=done)) as (server, master):
        master.ask("0001" + READ_SERIAL, "0001" + SERIAL)
        master.send("0002" + READ_SERIAL)
        with pytest.raises(ConnectionResetError):
            master.receive(1)
        assert len(server.unit.place.unit.log) == 1 + done
        again = Master(server.port)
        again.ask("0003" + READ_SERIAL, "0003" + SERIAL)
        again.close()


def test_a_restart_drops_connections_and_refuses_others_for_a_while() -> None:
    with served(Trouble(restart_drops=True, refuse_connections_s=3600.0)) as (server, master):
        master.ask("0001" + RESET, "0001" + RESET)
        with pytest.raises(ConnectionResetError):
            master.receive(1)
        with pytest.raises(ConnectionRefusedError):
            Master(server.port)


def test_connections_are_taken_again_after_a_while() -> None:
    with served(Trouble(restart_drops=True, refuse_connections_s=0.02)) as (server, master):
        master.ask("0001" + RESET, "0001" + RESET)
        with pytest.raises(ConnectionResetError):
            master.receive(1)
        server.settle()
        again = Master(server.port)
        again.ask("0002" + READ_SERIAL, "0002" + SERIAL)
        again.close()


def test_another_unit_answers_from_a_request_on() -> None:
    with served() as (server, master):
        server.unit.place.swap_at(2, Electronics(serial_number=4712))
        master.ask("0001" + READ_SERIAL, "0001" + SERIAL)
        master.ask("0002" + READ_SERIAL, "0002 0000 0007 01 03 04 00001268")
