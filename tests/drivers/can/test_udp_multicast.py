"""Our own socket on python-can's multicast bus: the same frames both ways."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable, Iterator, Sequence

import can
import msgpack
import pytest

from triaxcal_drivers.can.adapter import Adapter, Frame
from triaxcal_drivers.can.line import open_bus
from triaxcal_drivers.can.model import BusSettings
from triaxcal_drivers.can.python_can import PythonCan
from triaxcal_drivers.can.udp_multicast import DATAGRAM_BYTES, UdpMulticast
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import RawFlag

GROUP = "239.74.163.2"


@pytest.fixture
def port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("", 0))
        return int(bound.getsockname()[1])


def settings(port: int, **options: str | int | bool) -> BusSettings:
    return BusSettings(interface="udp_multicast", channel=GROUP, options={"port": port, **options})


@pytest.fixture
def adapter(port: int) -> Iterator[UdpMulticast]:
    try:
        opened = open_bus(settings(port))
        opened.send(0x7FF, b"")
    except BusError as e:
        pytest.skip(f"multicast does not work on this machine: {e}")
    assert isinstance(opened, UdpMulticast)
    assert [source for source, _, _ in some(opened, 1)] == [0x7FF]
    yield opened
    opened.close()


@pytest.fixture
def peer(port: int, adapter: UdpMulticast) -> Iterator[can.BusABC]:
    with can.Bus(GROUP, "udp_multicast", port=port, ignore_config=True) as bus:
        yield bus


MESSAGES = [
    (can.Message(arbitration_id=0x123, is_extended_id=False, data=bytes(range(8))), 0, bytes(range(8))),
    (can.Message(arbitration_id=0x123, is_extended_id=True, data=b"\1"), RawFlag.EXTENDED_ID, b"\1"),
    (can.Message(arbitration_id=5, is_extended_id=False, is_remote_frame=True, dlc=4), RawFlag.REMOTE, bytes(4)),
    (
        can.Message(arbitration_id=0x20, is_error_frame=True, is_extended_id=False, data=bytes(8)),
        RawFlag.ERROR,
        bytes(8),
    ),
    (can.Message(arbitration_id=1, is_extended_id=False, is_fd=True, data=bytes(64)), RawFlag.FD, bytes(64)),
    (
        can.Message(
            arbitration_id=1,
            is_extended_id=False,
            is_fd=True,
            bitrate_switch=True,
            error_state_indicator=True,
            data=b"\2",
        ),
        RawFlag.FD | RawFlag.BIT_RATE_SWITCH | RawFlag.REMOTE,
        b"\2",
    ),
]


DEADLINE_S = 180.0
"""For what takes milliseconds unless the machine is busy."""


def until(adapter: Adapter, enough: Callable[[Sequence[Frame]], bool]) -> list[Frame]:
    """What is received until it is ``enough``, or the deadline."""
    found: list[Frame] = []
    until_s = time.monotonic() + DEADLINE_S
    while not enough(found) and time.monotonic() < until_s:
        found += adapter.receive(0.1)
    return found


def some(adapter: Adapter, count: int) -> list[tuple[int, int, bytes]]:
    return [(f.source, int(f.flags), f.data) for f in until(adapter, lambda found: len(found) >= count)]


def test_frames_come_as_python_can_gives_them(adapter: UdpMulticast, peer: can.BusABC, port: int) -> None:
    beside = PythonCan(settings(port))
    for message, _, _ in MESSAGES:
        peer.send(message)
    wanted = [(message.arbitration_id, int(flags), data) for message, flags, data in MESSAGES]
    assert some(adapter, len(wanted)) == wanted
    assert some(beside, len(wanted)) == wanted
    beside.close()


def test_a_frame_has_the_time_of_its_reception(adapter: UdpMulticast, peer: can.BusABC) -> None:
    for last in (False, False, True):  # the kernel begins to stamp some time after the first socket asks for it
        before_ns = time.time_ns()
        peer.send(can.Message(arbitration_id=1, timestamp=1.0))
        readable, _, _ = select.select([adapter._socket], [], [], DEADLINE_S)
        assert readable
        there_ns = time.time_ns()
        time.sleep(0.05)  # the frame waits to be read
        (frame,) = until(adapter, bool)
        assert frame.time_ns >= before_ns - 10_000_000
        assert frame.time_ns <= there_ns + 10_000_000 or not last


def test_python_can_understands_what_it_sends(adapter: UdpMulticast, peer: can.BusABC) -> None:
    adapter.send(0x605, b"\x40\x18\x10\x04\0\0\0\0")
    adapter.send(0x1FFF_FFFF, b"\1", extended=True)
    received = [peer.recv(DEADLINE_S), peer.recv(DEADLINE_S)]
    assert [(m.arbitration_id, m.is_extended_id, bytes(m.data), m.dlc, m.is_fd) for m in received if m] == [
        (0x605, False, b"\x40\x18\x10\x04\0\0\0\0", 8, False),
        (0x1FFF_FFFF, True, b"\1", 1, False),
    ]
    assert [source for source, _, _ in some(adapter, 2)] == [0x605, 0x1FFF_FFFF], "it hears itself"


def test_without_can_fd_its_frames_are_left_out(adapter: UdpMulticast, peer: can.BusABC, port: int) -> None:
    classic = open_bus(settings(port, fd=False))
    assert isinstance(classic, UdpMulticast)
    for message, _, _ in MESSAGES:
        peer.send(message)
    assert [source for source, _, _ in some(classic, 4)] == [0x123, 0x123, 5, 0x20]
    classic.close()


SOUND = {
    "timestamp": 0.0, "arbitration_id": 1, "is_extended_id": False, "is_remote_frame": False, "is_error_frame": False,
    "channel": None, "dlc": 1, "data": b"\1", "is_fd": False, "bitrate_switch": False, "error_state_indicator": False,
}  # fmt: skip


@pytest.mark.parametrize(
    "datagram",
    [
        b"",
        b"hello",
        msgpack.packb(7),
        msgpack.packb({}),
        msgpack.packb({**SOUND, "arbitration_id": 0x800}),
        msgpack.packb({**SOUND, "arbitration_id": -1}),
        msgpack.packb({**SOUND, "arbitration_id": "1"}),
        msgpack.packb({**SOUND, "arbitration_id": 1.5}),
        msgpack.packb({**SOUND, "data": bytes(9)}),
        msgpack.packb({**SOUND, "data": "text"}),
        msgpack.packb({**SOUND, "data": None}),
        msgpack.packb({**SOUND, "data": bytes(11), "is_fd": True}),
        msgpack.packb({**SOUND, "is_remote_frame": True, "dlc": 2**40}),
        msgpack.packb({**SOUND, "is_remote_frame": True, "dlc": "4"}),
    ],
)
def test_a_datagram_that_is_no_frame_is_a_failure_in_a_line(
    adapter: UdpMulticast, peer: can.BusABC, port: int, datagram: bytes
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(datagram, (GROUP, port))
        with pytest.raises(BusError) as told:
            some(adapter, 1)
    assert str(told.value).startswith(f"receiving on udp_multicast {GROUP} failed: a datagram that is no ")
    assert "\n" not in str(told.value)


def test_what_the_kernel_loses_is_counted_at_the_next_frame(adapter: UdpMulticast, peer: can.BusABC) -> None:
    adapter._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8 * DATAGRAM_BYTES)
    sent = 2000
    for number in range(sent):
        peer.send(can.Message(arbitration_id=1, data=number.to_bytes(2, "big")))
    first = [f for _ in range(3) for f in adapter.receive(0.1)]  # then the buffer has room
    peer.send(can.Message(arbitration_id=2))
    *more, last = until(adapter, lambda found: any(f.source == 2 for f in found))
    assert last.source == 2
    received = [*first, *more]
    assert len(received) < sent
    assert sum(f.lost for f in [*received, last]) == sent - len(received)
    assert all(bool(f.flags & RawFlag.LOST_BEFORE) == (f.lost > 0) for f in [*received, last])


@pytest.mark.parametrize(("option", "value"), [("receive_own_messages", False), ("state", "ACTIVE")])
def test_other_options_are_python_cans(adapter: UdpMulticast, port: int, option: str, value: str | bool) -> None:
    opened = open_bus(settings(port, **{option: value}))
    opened.close()
    assert isinstance(opened, PythonCan)


@pytest.mark.parametrize("channel", ["10.0.0.1", "no such host.invalid", "::1"])
def test_what_is_no_group_is_refused_in_a_line(channel: str) -> None:
    with pytest.raises(BusError, match=rf"^cannot open udp_multicast {channel}: [^\n]+$"):
        open_bus(BusSettings(interface="udp_multicast", channel=channel))


def test_one_that_is_closed_says_so(adapter: UdpMulticast) -> None:
    adapter.close()
    with pytest.raises(BusError, match=r"^receiving on udp_multicast .* failed: [^\n]+$"):
        adapter.receive(0.0)
    with pytest.raises(BusError, match=r"^sending on udp_multicast .* failed: [^\n]+$"):
        adapter.send(1, b"")
