"""A CANopen node on a virtual bus, by literal frames."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import can
import pytest

from tests.devices.canopen import CanopenNode, packed
from tests.devices.habits import Habits
from tests.devices.memory import Electronics
from tests.devices.motion import Motion
from tests.devices.place import Place, Trouble
from tests.devices.sdo import SdoServer

READ_SERIAL, SERIAL = "40 18 10 04 00 00 00 00", "43 18 10 04 67 12 00 00"
RESET = "2B 10 2F 02 53 52 00 00"
PATIENCE_S = 180.0


class Master:
    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus

    def send(self, cob_id: int, data: str) -> None:
        self._bus.send(can.Message(arbitration_id=cob_id, data=bytes.fromhex(data), is_extended_id=False))

    def expect(self, cob_id: int, data: str) -> None:
        """The next frame."""
        message = self._bus.recv(PATIENCE_S)
        assert message is not None
        assert (message.arbitration_id, message.data.hex()) == (cob_id, bytes.fromhex(data).hex())

    def next_of(self, cob_id: int) -> bytes:
        """The next frame of that identifier."""
        while True:
            message = self._bus.recv(PATIENCE_S)
            assert message is not None
            if message.arbitration_id == cob_id:
                return bytes(message.data)


@contextmanager
def served(
    habits: Habits | None = None, trouble: Trouble | None = None, **settings: Any
) -> Iterator[tuple[CanopenNode, Master]]:
    node = CanopenNode(SdoServer(Place(Electronics(habits or Habits()), trouble)), **settings)
    with can.Bus(node.bus["channel"], "virtual", ignore_config=True) as bus, node:
        yield node, Master(bus)


def test_it_says_that_it_is_there_and_answers() -> None:
    with served() as (_, master):
        master.expect(0x705, "00")
        master.send(0x605, READ_SERIAL)
        master.expect(0x585, SERIAL)


def test_requests_to_other_nodes_and_short_ones_are_not_answered() -> None:
    with served(node_id=9) as (node, master):
        master.expect(0x709, "00")
        master.send(0x605, READ_SERIAL)
        master.send(0x609, READ_SERIAL[:20])
        master.send(0x609, READ_SERIAL)
        master.expect(0x589, SERIAL)
        assert node.sdo.place.requests == 1


@pytest.mark.parametrize("command", ["81 05", "81 00"])
def test_a_node_reset_restarts_the_device(command: str) -> None:
    with served(Habits(unlock=False)) as (node, master):
        master.expect(0x705, "00")
        master.send(0x605, "23 00 24 01 AD 69 1A C0")
        master.expect(0x585, "60 00 24 01 00 00 00 00")
        master.send(0x000, command)
        master.expect(0x705, "00")
        master.send(0x605, "40 00 24 01 00 00 00 00")
        master.expect(0x585, "43 00 24 01 9A 99 19 C0")
        assert node.sdo.place.unit.restarts == 1


def test_a_reset_of_communication_leaves_the_registers() -> None:
    with served(Habits(unlock=False)) as (node, master):
        master.expect(0x705, "00")
        master.send(0x605, "23 00 24 01 AD 69 1A C0")
        master.expect(0x585, "60 00 24 01 00 00 00 00")
        master.send(0x000, "82 05")
        master.expect(0x705, "00")
        assert node.sdo.place.unit.in_use["scale_factor_x"].hex() == "c01a69ad"


def test_a_restart_is_acknowledged_and_followed_by_the_boot_up_message() -> None:
    with served(Habits(restart_s=0.02)) as (_, master):
        master.expect(0x705, "00")
        master.send(0x605, RESET)
        master.expect(0x585, "60 10 2F 02 00 00 00 00")
        master.expect(0x705, "00")


def test_a_stopped_node_answers_no_sdo() -> None:
    with served() as (_, master):
        master.expect(0x705, "00")
        master.send(0x000, "02 05")
        master.send(0x605, READ_SERIAL)
        master.send(0x000, "80 05")
        master.send(0x605, "40 18 10 02 00 00 00 00")
        master.expect(0x585, "43 18 10 02 7C 3A 00 00")


def test_the_heartbeat_tells_the_state() -> None:
    with served(heartbeat_s=0.01) as (_, master):
        master.expect(0x705, "00")
        assert master.next_of(0x705) == b"\x7f"
        master.send(0x000, "01 05")
        while (beat := master.next_of(0x705)) == b"\x7f":
            pass
        assert beat == b"\x05"


def test_replies_are_late_lost_and_doubled() -> None:
    trouble = Trouble(late=frozenset({1}), late_s=0.02, lose_reply=frozenset({2}), duplicate=frozenset({3}))
    with served(trouble=trouble) as (_, master):
        master.expect(0x705, "00")
        for _ in range(2):
            master.send(0x605, "40 18 10 02 00 00 00 00")
        master.send(0x605, READ_SERIAL)
        replies = sorted(master.next_of(0x585).hex(" ").upper() for _ in range(3))
        assert replies == ["43 18 10 02 7C 3A 00 00", SERIAL, SERIAL]


def test_samples_come_while_it_is_operational() -> None:
    motion = Motion(lambda _: (0.0, 0.0, -2.42 * 1.03))
    with served(motion=motion, rate_hz=200.0) as (_, master):
        master.expect(0x705, "00")
        master.send(0x000, "01 05")
        first, second = (int.from_bytes(master.next_of(0x185), "little") for _ in range(2))
        assert (second >> 60) - (first >> 60) in (1, -15)
        # -2.4926 V in units of 10/2^19 V is -130684, or 0xE0184 in 20 bits.
        assert first & ((1 << 60) - 1) == 0xE0184 << 40


@pytest.mark.parametrize(
    ("values", "bits"),
    [
        ((1.0, 2.0, 3.0), "00003_00002_00001"),
        ((-1.0, 0.0, -524287.0), "80001_00000_fffff"),
        ((524288.0, float("nan"), 0.0), "00000_80000_80000"),
    ],
)
def test_three_numbers_of_20_bits_and_a_counter_fill_a_frame(values: tuple[float, float, float], bits: str) -> None:
    assert packed(values, 1.0, 0x1A) == bytes.fromhex("a" + bits.replace("_", ""))[::-1]
