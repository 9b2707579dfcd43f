"""python-can's messages as frames, and its clocks as the host's."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from typing import Any

import can
import pytest

from triaxcal_drivers.can.model import BusSettings, CanBus
from triaxcal_drivers.can.python_can import HostClock, PythonCan, open_python_can
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import RawFlag


@pytest.fixture
def channel(request: pytest.FixtureRequest) -> str:
    return str(request.node.name)


@pytest.fixture
def adapter(channel: str) -> Iterator[PythonCan]:
    made = PythonCan(CanBus(interface="virtual", channel=channel, node_id=5))
    yield made
    made.close()


@pytest.fixture
def peer(channel: str) -> Iterator[can.BusABC]:
    with can.Bus(channel, "virtual", ignore_config=True) as bus:
        yield bus


@pytest.mark.parametrize(
    ("message", "flags", "data"),
    [
        ({"arbitration_id": 0x185, "is_extended_id": False, "data": b"\1\2"}, 0, b"\1\2"),
        ({"arbitration_id": 0x18FF0005, "data": b""}, RawFlag.EXTENDED_ID, b""),
        ({"arbitration_id": 0x20, "is_extended_id": False, "is_error_frame": True}, RawFlag.ERROR, b""),
        ({"arbitration_id": 5, "is_extended_id": False, "is_remote_frame": True, "dlc": 3}, RawFlag.REMOTE, bytes(3)),
        (
            {
                "arbitration_id": 5,
                "is_extended_id": False,
                "is_fd": True,
                "bitrate_switch": True,
                "error_state_indicator": True,
                "data": bytes(12),
            },
            RawFlag.FD | RawFlag.BIT_RATE_SWITCH | RawFlag.REMOTE,
            bytes(12),
        ),
    ],
)
def test_a_message_is_a_frame_with_all_that_it_says(
    adapter: PythonCan, peer: can.BusABC, message: dict[str, Any], flags: int, data: bytes
) -> None:
    peer.send(can.Message(**message))
    (frame,) = adapter.receive(2.0)
    assert (frame.source, frame.flags, frame.data, frame.lost) == (message["arbitration_id"], flags, data, 0)


def test_all_that_waits_comes_at_once_and_nothing_where_nothing_does(adapter: PythonCan, peer: can.BusABC) -> None:
    for number in range(10):
        peer.send(can.Message(arbitration_id=number, data=b""))
    assert [frame.source for frame in adapter.receive(2.0)] == list(range(10))
    assert adapter.receive(0.0) == []


def test_what_is_sent_arrives_at_the_other_end(adapter: PythonCan, peer: can.BusABC) -> None:
    adapter.send(0x605, bytes.fromhex("40 18 10 01 00 00 00 00"))
    message = peer.recv(2.0)
    assert message is not None
    assert (message.arbitration_id, message.is_extended_id, message.data.hex()) == (0x605, False, "4018100100000000")


@pytest.mark.parametrize(("options", "echoes"), [({}, False), ({"receive_own_messages": True}, True)])
def test_what_it_sends_comes_back_where_it_says_so(
    channel: str, options: dict[str, bool], echoes: bool, peer: can.BusABC
) -> None:
    adapter = PythonCan(BusSettings(interface="virtual", channel=channel, options=options))
    adapter.only(None)
    adapter.send(0x123, b"\1")
    peer.send(can.Message(arbitration_id=0x124, is_extended_id=False))
    received = [frame for _ in range(2) for frame in adapter.receive(0.1)]
    adapter.close()
    assert adapter.echoes is echoes
    assert [(frame.source, frame.flags) for frame in received] == [(0x123, RawFlag.SENT)] * echoes + [(0x124, 0)]


def test_udp_multicast_gives_what_it_sends_unasked() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("", 0))
        port = bound.getsockname()[1]
    try:
        adapter = PythonCan(BusSettings(interface="udp_multicast", channel="239.74.163.2", options={"port": port}))
        adapter.send(0x123, b"\1")
    except BusError as e:
        pytest.skip(f"multicast does not work on this machine: {e}")
    received = adapter.receive(2.0)
    adapter.close()
    assert (adapter.echoes, [frame.source for frame in received]) == (True, [0x123])


def test_the_state_of_an_adapter_may_be_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """As PCAN's and SYSTEC's, which are asked by it to listen only."""
    given: dict[str, object] = {}
    monkeypatch.setattr(can, "Bus", lambda *_, **options: given.update(options))
    open_python_can(BusSettings(interface="pcan", channel="PCAN_USBBUS1").listening())
    assert given["state"] is can.BusState.PASSIVE


def test_a_bus_that_has_failed_says_so_in_a_line(adapter: PythonCan) -> None:
    adapter.close()
    with pytest.raises(BusError, match=r"^receiving on virtual .* failed: [^\n]+$"):
        adapter.receive(0.0)
    with pytest.raises(BusError, match=r"^sending on virtual .* failed: [^\n]+$"):
        adapter.send(1, b"")


def test_epoch_stamps_are_taken_as_they_are() -> None:
    now_ns = 1_700_000_000_000_000_000
    clock = HostClock(lambda: now_ns)
    assert abs(clock.time_ns(1_699_999_999.25) - (now_ns - 750_000_000)) < 500  # as exact as a float


def test_an_adapters_own_clock_is_laid_on_the_hosts() -> None:
    now_ns = [1_700_000_000_000_000_000]
    clock = HostClock(lambda: now_ns[0])
    first = clock.time_ns(12.5)
    assert first == now_ns[0]
    now_ns[0] += 900_000_000  # the host was late
    assert clock.time_ns(12.75) - first == 250_000_000


def test_an_adapters_clock_that_wraps_is_laid_on_the_hosts_anew() -> None:
    now_ns = [1_700_000_000_000_000_000]
    clock = HostClock(lambda: now_ns[0])
    clock.time_ns(4294.9)
    now_ns[0] += 100_000_000
    assert clock.time_ns(0.03) == now_ns[0]


def test_without_a_stamp_the_hosts_time_is_taken() -> None:
    now_ns = [1_700_000_000_000_000_000]
    clock = HostClock(lambda: now_ns[0])
    assert clock.time_ns(0.0) == now_ns[0]
    now_ns[0] += 5_000_000
    assert clock.time_ns(0.0) == now_ns[0]
