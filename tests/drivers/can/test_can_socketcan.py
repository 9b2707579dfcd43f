"""What the kernel says of an interface, by literal bytes (attributes of the answer that Linux 6.1 gave for its slcan
driver at 500 kbit/s), and the receiver on a datagram socket of this machine, whose other end is the bus; on a kernel
with CAN it is tested in `tests/guest`. Bytes are written for little-endian machines, since the kernel writes in the
machine's order."""

from __future__ import annotations

import errno
import random
import socket
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from triaxcal_drivers.can import socketcan
from triaxcal_drivers.can.adapter import ControllerState, Frame
from triaxcal_drivers.can.model import CanBus, SocketCanOptions
from triaxcal_drivers.can.socketcan import (
    AT_ONCE,
    HardwareClock,
    Link,
    Reception,
    SocketCan,
    bytes_of,
    filters_of,
    link_of,
    open_socketcan,
    read_link,
)
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import RawFlag

pytestmark = [
    pytest.mark.skipif(sys.byteorder != "little", reason="the bytes are of a little-endian machine"),
    pytest.mark.skipif(sys.platform != "linux", reason="SocketCAN is Linux's"),
]

MS, S = 1_000_000, 1_000_000_000


@pytest.mark.parametrize("drift_ns", [400, -400])
def test_jitter_of_the_way_to_the_host_goes_and_drift_is_followed(drift_ns: int) -> None:
    """A frame each 10 ms for ten minutes, delays of 0.2 ms to 3 ms, a clock 40 ppm fast or slow that starts at 0."""
    generator = random.Random(5)
    clock, worst, last = HardwareClock(), 0, 0
    for i in range(60_000):
        arrived_ns = 1_700_000_000 * S + i * 10 * MS
        hardware_ns = i * 10 * MS + i * drift_ns
        kernel_ns = arrived_ns + 200_000 + generator.randrange(2_800_000)
        time_ns = clock.time_ns(hardware_ns, kernel_ns)
        assert time_ns >= last
        last = time_ns
        if i > 100:
            worst = max(worst, abs(time_ns - arrived_ns - 200_000))
    assert worst < 1 * MS  # the drift of 20 s, and not the 2.8 ms of the delays


def test_a_step_of_the_hosts_clock_is_followed_at_once() -> None:
    clock = HardwareClock()
    assert clock.time_ns(10 * S, 100 * S) == 100 * S
    for step_ns in (3600 * S, -3600 * S):
        assert clock.time_ns(11 * S, 101 * S + step_ns) == 101 * S + step_ns
        assert clock.time_ns(12 * S, 102 * S + step_ns) == 102 * S + step_ns


def test_an_adapters_clock_that_begins_anew_is_followed() -> None:
    clock = HardwareClock()
    clock.time_ns(4_000 * S, 100 * S)
    assert clock.time_ns(1 * S, 101 * S) == 101 * S


SOCKET = 1  # SOL_SOCKET
STAMP = (SOCKET, 64, bytes.fromhex("00F1536500000000 15CD5B0700000000"))
STAMP_NS = 1_700_000_000_123_456_789
MINUTE_NS = 60_000_000_000


def lost(count: int) -> tuple[int, int, bytes]:
    return SOCKET, 40, count.to_bytes(4, "little")


def frame(raw: str, *ancillary: tuple[int, int, bytes], flags: int = 0) -> Frame:
    return Reception(lambda: 5).frame(bytes.fromhex(raw), ancillary, flags)


@pytest.mark.parametrize(
    ("raw", "expected"),
    [
        ("23010000 02 000000 AABB000000000000", (0x123, 0, "AABB")),
        ("F0DECB9A 08 000000 0102030405060708", (0x1ACBDEF0, RawFlag.EXTENDED_ID, "0102030405060708")),
        ("23010040 04 000000 0000000000000000", (0x123, RawFlag.REMOTE, "00000000")),
        ("F0DECBDA 00 000000 0000000000000000", (0x1ACBDEF0, RawFlag.EXTENDED_ID | RawFlag.REMOTE, "")),
        ("44000020 08 000000 0010000000000000", (0x44, RawFlag.ERROR, "0010000000000000")),
    ],
)
def test_classic_frames(raw: str, expected: tuple[int, int, str]) -> None:
    source, flags, data = expected
    assert frame(raw, STAMP) == (STAMP_NS, source, flags, bytes.fromhex(data), 0)


@pytest.mark.parametrize(
    ("fd_flags", "flags"),
    [
        ("00", RawFlag.FD),
        ("01", RawFlag.FD | RawFlag.BIT_RATE_SWITCH),
        ("02", RawFlag.FD | RawFlag.REMOTE),
        ("07", RawFlag.FD | RawFlag.BIT_RATE_SWITCH | RawFlag.REMOTE),
    ],
)
def test_can_fd_frames(fd_flags: str, flags: int) -> None:
    raw = "23010000 0C" + fd_flags + "0000" + "000102030405060708090A0B" + "00" * 52
    assert frame(raw, STAMP) == (STAMP_NS, 0x123, flags, bytes(range(12)), 0)


@pytest.mark.parametrize("message_flags", [0x04, 0x804])
def test_frames_of_this_host_are_flagged(message_flags: int) -> None:
    assert frame("23010000 00 000000 0000000000000000", flags=message_flags).flags == RawFlag.SENT


def test_stamps_of_all_kinds_are_read_and_the_hosts_time_taken_where_there_is_none() -> None:
    empty = "23010000 00 000000 0000000000000000"
    nothing = bytes(16)
    assert frame(empty).time_ns == 5
    assert frame(empty, (SOCKET, 35, STAMP[2])).time_ns == STAMP_NS
    assert frame(empty, (SOCKET, 65, STAMP[2] + nothing + nothing)).time_ns == STAMP_NS
    assert frame(empty, (SOCKET, 37, STAMP[2] + nothing + nothing)).time_ns == STAMP_NS


def test_an_adapters_clock_is_laid_on_the_hosts() -> None:
    reception = Reception()

    def time_ns(kernel_ns: int, hardware_ns: int) -> int:
        stamps = [divmod(ns, 1_000_000_000) for ns in (kernel_ns, 0, hardware_ns)]
        value = b"".join(part.to_bytes(8, "little") for stamp in stamps for part in stamp)
        return reception.frame(bytes(16), [(SOCKET, 65, value)], 0).time_ns

    assert time_ns(MINUTE_NS + 300, 1000) == MINUTE_NS + 300
    assert time_ns(MINUTE_NS + 2100, 3000) == MINUTE_NS + 2100
    assert time_ns(MINUTE_NS + 9000, 4000) == MINUTE_NS + 3100


def test_each_loss_is_told_once_by_the_frame_after_it() -> None:
    reception = Reception()
    raw = bytes.fromhex("23010000 00 000000 0000000000000000")
    told = [reception.frame(raw, given, 0) for given in ([], [lost(3)], [lost(3)], [lost(10)])]
    assert [f.lost for f in told] == [0, 3, 0, 7]
    assert [f.flags for f in told] == [0, RawFlag.LOST_BEFORE, 0, RawFlag.LOST_BEFORE]
    assert reception.missed(10) == 0
    assert reception.missed(14) == 4


def test_a_count_that_begins_anew_goes_on() -> None:
    reception = Reception()
    raw = bytes(16)
    assert reception.frame(raw, [lost(0xFFFF_FFFE)], 0).lost == 0xFFFF_FFFE
    assert reception.frame(raw, [lost(3)], 0).lost == 5
    assert reception.missed(2) == 0xFFFF_FFFF


def test_a_frame_to_be_sent_has_the_bytes_of_the_kernels_structure() -> None:
    assert bytes_of(0x123, b"\xaa\xbb", extended=False, fd=False) == bytes.fromhex("23010000 02000000 AABB000000000000")
    assert bytes_of(0x1ACBDEF0, b"", extended=True, fd=True) == bytes.fromhex("F0DECB9A 00000000 0000000000000000")
    assert bytes_of(0x7FF, bytes(12), extended=False, fd=True) == bytes.fromhex("FF070000 0C000000" + "00" * 64)


@pytest.mark.parametrize(
    ("identifier", "data", "extended", "message"),
    [
        (0x800, b"", False, "identifier 0x800: expected at most 0x7FF"),
        (0x2000_0000, b"", True, "identifier 0x20000000: expected at most 0x1FFFFFFF"),
        (0x1, bytes(9), False, "9 bytes of data: no length without CAN FD, which has up to 8"),
    ],
)
def test_what_no_frame_can_hold_is_refused(identifier: int, data: bytes, extended: bool, message: str) -> None:
    with pytest.raises(ValueError) as e:
        bytes_of(identifier, data, extended=extended, fd=False)
    assert str(e.value) == message


def test_filters_match_data_and_remote_frames_of_one_kind_of_identifier() -> None:
    assert filters_of([(0x1ACBDEF0, True), (0x123, False)]) == bytes.fromhex(
        "23010000 FF070080"  # whatever the remote bit is
        "F0DECB9A FFFFFF9F"
    )
    assert filters_of([]) == b""
    assert filters_of(None) == bytes(8)
    assert filters_of([(i, True) for i in range(513)]) == bytes(8)
    assert len(filters_of([(i, True) for i in range(512)])) == 512 * 8


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
    waiting.join(timeout=180)
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
    assert socketcan.reason(OSError(code, ""), "can0") == message


def test_an_interface_that_is_not_there_is_told_with_those_that_are(monkeypatch: pytest.MonkeyPatch) -> None:
    for known, there in ([], "there is no CAN interface"), (["can0", "vcan0"], "did you mean 'can0'?"):
        monkeypatch.setattr(socketcan, "can_interfaces", lambda known=known: known)
        told = socketcan.reason(OSError(errno.ENODEV, ""), "can9")
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
        socketcan.make_room(sock, "can0", SocketCanOptions(receive_buffer=100_000), 500_000)
        assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) == 100_000
        socketcan.make_room(sock, "can0", SocketCanOptions(), 50_000)
        ten_seconds = 50_000 / 111 * 10 * 768
        allowed = 2 * int(Path("/proc/sys/net/core/rmem_max").read_text())
        given = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        assert given >= min(ten_seconds, allowed)
        assert given <= max(ten_seconds + 2, 212_992)


INTERFACE = "0000 1801 02000000 C1000100 00000000"  # of type CAN, number 2, up
ETHERNET = "0000 0100 02000000 41000000 00000000"
NAME = "0900 0300 63616E3000 000000"  # can0
MTU, MTU_FD = "0800 0400 10000000", "0800 0400 48000000"
KIND = "0800 0100 63616E00"
BIT_TIMING = "2400 0100 20A10700" + "00" * 28
STATE = "0800 0400 {:02X}000000"
CONTROL_MODE = "0C00 0500 00000000 {:02X}000000"
RESTART = "0800 0600 {:02X}000000"


def message(*attributes: str, kind: str = "1000", interface: str = INTERFACE) -> bytes:
    body = bytes.fromhex(interface + "".join(attributes))
    return (16 + len(body)).to_bytes(4, "little") + bytes.fromhex(f"{kind} 0000 01000000 B8020000") + body


def nested(number: int, *attributes: str, mark: int = 0) -> str:
    inner = bytes.fromhex("".join(attributes))
    return ((4 + len(inner)).to_bytes(2, "little") + (number | mark).to_bytes(2, "little") + inner).hex()


def controller(state: int = 0, mode: int = 0, restart: int = 0, mark: int = 0) -> str:
    data = [BIT_TIMING, STATE.format(state), CONTROL_MODE.format(mode), RESTART.format(restart)]
    return nested(18, KIND, nested(2, *data, mark=mark), mark=mark)


def test_an_interface_with_a_controller() -> None:
    assert link_of(message(NAME, MTU, controller())) == Link(
        "can0", can=True, up=True, fd=False, state=ControllerState.ACTIVE, bitrate=500_000
    )


def test_listen_only_restart_and_can_fd() -> None:
    link = link_of(message(NAME, MTU_FD, controller(mode=0x22, restart=100)))
    assert (link.fd, link.listen_only, link.restart_ms) == (True, True, 100)
    assert link_of(message(NAME, MTU_FD, controller(mode=0x20))).listen_only is False


@pytest.mark.parametrize(("number", "state"), [*enumerate(ControllerState), (6, None)])
def test_states(number: int, state: ControllerState | None) -> None:
    assert link_of(message(NAME, MTU, controller(state=number))).state == state


def test_attributes_that_are_marked_as_nested_are_read_likewise() -> None:
    assert link_of(message(NAME, MTU, controller(state=3, mark=0x8000))).state == ControllerState.BUS_OFF


def test_a_virtual_interface_has_no_controller() -> None:
    kind = "0900 0100 7663616E00 000000"
    assert link_of(message("0A00 0300 7663616E3000 0000", MTU_FD, nested(18, kind))) == Link(
        "vcan0", can=True, up=True, fd=True
    )


def test_an_interface_that_is_down_or_of_another_kind() -> None:
    assert not link_of(message(NAME, MTU, interface="0000 1801 02000000 80000000 00000000")).up
    ethernet = link_of(message("0900 0300 6574683000 000000", controller(), interface=ETHERNET))
    assert (ethernet.name, ethernet.can, ethernet.bitrate) == ("eth0", False, None)


def test_an_error_of_the_kernel_is_raised_and_broken_attributes_end_it() -> None:
    with pytest.raises(OSError) as e:
        link_of(message(kind="0200", interface="EDFFFFFF" + "00" * 16))
    assert e.value.errno == errno.ENODEV
    assert link_of(message(NAME, "0000 0400 10000000")).name == "can0"


@pytest.mark.skipif(sys.platform != "linux", reason="rtnetlink is Linux's")
def test_the_kernel_of_this_machine_tells_of_its_loopback() -> None:
    link = read_link("lo")
    assert (link.name, link.can) == ("lo", False)
    with pytest.raises(OSError) as e:
        read_link("no-such-link")
    assert e.value.errno == errno.ENODEV
