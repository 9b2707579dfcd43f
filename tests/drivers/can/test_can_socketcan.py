"""The receiver on a datagram socket of this machine, whose other end is the bus; on a kernel with CAN it is tested in
`tests/guest`."""

from __future__ import annotations

import errno
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from triaxcal_drivers.can import socketcan as raw_socket
from triaxcal_drivers.can.model import CanBus, SocketCanOptions
from triaxcal_drivers.can.socketcan import AT_ONCE, SocketCan, open_socketcan
from triaxcal_drivers.errors import BusError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="SocketCAN is Linux's")


@pytest.fixture
def ends() -> Iterator[tuple[SocketCan, socket.socket]]:
    ours, bus = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    adapter = SocketCan(ours, "can7")
    yield adapter, bus
    adapter.close()
    bus.close()


def raw(number: int) -> bytes:
    return bytes.fromhex("23010000 08 000000") + number.to_bytes(8, "little")


def test_what_waits_comes_at_once_in_its_order(ends: tuple[SocketCan, socket.socket]) -> None:
    adapter, bus = ends
    for number in range(5):
        bus.send(raw(number))
    assert [int.from_bytes(frame.data, "little") for frame in adapter.receive(1.0)] == [0, 1, 2, 3, 4]
    assert adapter.receive(0.0) == []


def test_more_than_fits_comes_in_turns(ends: tuple[SocketCan, socket.socket]) -> None:
    adapter, bus = ends
    fed = threading.Thread(target=lambda: [bus.send(raw(number)) for number in range(2 * AT_ONCE)])
    fed.start()
    frames, largest = [], 0
    while len(frames) < 2 * AT_ONCE:
        more = adapter.receive(5.0)
        assert more
        largest = max(largest, len(more))
        frames += more
    fed.join()
    assert [int.from_bytes(frame.data, "little") for frame in frames] == list(range(2 * AT_ONCE))
    assert largest <= AT_ONCE


def test_what_is_sent_has_the_kernels_bytes(ends: tuple[SocketCan, socket.socket]) -> None:
    adapter, bus = ends
    adapter.send(0x601, b"\x40\x18\x10\x01")
    adapter.send(0x18DAF101, b"\x01", extended=True)
    assert bus.recv(72) == bytes.fromhex("01060000 04000000 4018100100000000")
    assert bus.recv(72) == bytes.fromhex("01F1DA98 01000000 0100000000000000")
    with pytest.raises(BusError, match="socketcan can7: cannot send identifier 0x800: expected at most 0x7FF"):
        adapter.send(0x800, b"")


def test_closing_ends_the_wait_of_another_thread(ends: tuple[SocketCan, socket.socket]) -> None:
    adapter, _ = ends
    waiting = threading.Thread(target=adapter.receive, args=(3600.0,))
    waiting.start()
    adapter.close()
    waiting.join(timeout=30)
    assert not waiting.is_alive()
    with pytest.raises(BusError, match="socketcan can7 has been closed"):
        adapter.receive(0.0)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (errno.EAFNOSUPPORT, "socketcan can0: this kernel has no CAN, or not loaded: `modprobe can_raw` (errno 97)"),
        (errno.ENETDOWN, "socketcan can0: the link is down: `ip link set can0 up`"),
        (errno.EPERM, "socketcan can0: not permitted: run it as a user with the capability CAP_NET_RAW"),
        (errno.ENOTCONN, "socketcan can0: Transport endpoint is not connected"),
    ],
)
def test_errors_of_the_system_say_what_mends_them(code: int, message: str) -> None:
    assert raw_socket.reason(OSError(code, ""), "can0") == message


def test_an_interface_that_is_not_there_is_told_with_those_that_are(monkeypatch: pytest.MonkeyPatch) -> None:
    for known, there in ([], "there is no CAN interface"), (["can0", "vcan0"], "did you mean 'can0'?"):
        monkeypatch.setattr(raw_socket, "can_interfaces", lambda known=known: known)
        told = raw_socket.reason(OSError(errno.ENODEV, ""), "can9")
        assert told.startswith(f"socketcan can9: there is no such interface; {there}")
        assert "\n" not in told


def test_options_of_python_can_are_taken_and_unknown_ones_refused_by_name() -> None:
    given = {"fd": True, "receive_own_messages": True, "local_loopback": False}
    options = SocketCanOptions.of(given)
    assert (options.fd, options.receive_own_messages, options.local_loopback) == (True, True, False)
    with pytest.raises(BusError, match="cannot open socketcan can0: options of socketcan: fdd: unknown key; did you"):
        open_socketcan("can0", {"fdd": True})
    with pytest.raises(ValueError, match="options of socketcan: recieve_buffer: unknown key; did you mean 'receive_b"):
        CanBus(interface="socketcan", channel="can0", node_id=5, options={"recieve_buffer": 1})
    CanBus(interface="virtual", channel="x", node_id=5, options={"recieve_buffer": 1})


def test_the_buffer_holds_ten_seconds_of_a_full_bus_where_the_system_allows_it() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sock:
        raw_socket.make_room(sock, "can0", SocketCanOptions(receive_buffer=100_000), 500_000)
        assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == 100_000
        raw_socket.make_room(sock, "can0", SocketCanOptions(), 50_000)
        ten_seconds = 50_000 / 111 * 10 * 768
        allowed = 2 * int(Path("/proc/sys/net/core/rmem_max").read_text())
        given = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        assert given >= min(ten_seconds, allowed)
        assert given <= max(ten_seconds + 2, 212_992)
