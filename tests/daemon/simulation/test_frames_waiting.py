"""What is left to fetch on a bus of software: in python-can's queues, and in sockets by Linux's tables."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import can
import pytest

from triaxcal_drivers.can.model import CanBus
from triaxcald.simulation.can_unit import BEHIND_BYTES, BEHIND_FRAMES, reader_is_behind, waiting_bytes

FRAME = can.Message(arbitration_id=0x185, is_extended_id=False, data=bytes(8))


@pytest.fixture
def ends(request: pytest.FixtureRequest) -> Iterator[tuple[can.BusABC, can.BusABC]]:
    channel = request.node.name
    with can.Bus(channel, "virtual") as ours, can.Bus(channel, "virtual") as theirs:
        yield ours, theirs


def test_a_virtual_bus_is_behind_until_its_reader_has_fetched(ends: tuple[can.BusABC, can.BusABC]) -> None:
    ours, theirs = ends
    settings = CanBus(interface="virtual", channel="any", node_id=5)
    for _ in range(BEHIND_FRAMES):
        ours.send(FRAME)
    assert not reader_is_behind(settings, ours)
    ours.send(FRAME)
    assert reader_is_behind(settings, ours)
    theirs.recv(0)
    assert not reader_is_behind(settings, ours)


@pytest.mark.skipif(not Path("/proc/net/udp").exists(), reason="this system does not say what sockets hold")
def test_a_multicast_bus_is_behind_until_its_reader_has_fetched(ends: tuple[can.BusABC, can.BusABC]) -> None:
    with socket.socket(type=socket.SOCK_DGRAM) as reader, socket.socket(type=socket.SOCK_DGRAM) as sender:
        reader.bind(("127.0.0.1", 0))
        port = reader.getsockname()[1]
        settings = CanBus(interface="udp_multicast", channel="239.74.163.2", node_id=5, options={"port": port})
        assert waiting_bytes(port) == 0
        sent = 0
        while not reader_is_behind(settings, ends[0]):
            assert sent < 1000
            sender.sendto(bytes(100), ("127.0.0.1", port))
            sent += 1
        assert waiting_bytes(port) > BEHIND_BYTES
        for _ in range(sent):
            reader.recv(200)
        assert not reader_is_behind(settings, ends[0])


def test_of_a_bus_that_tells_nothing_nobody_is_behind(ends: tuple[can.BusABC, can.BusABC]) -> None:
    for _ in range(BEHIND_FRAMES + 1):
        ends[0].send(FRAME)
    assert not reader_is_behind(CanBus(interface="socketcan", channel="can0", node_id=5), ends[0])
