"""A CAN bus behind a raw socket of Linux (SocketCAN), with what the kernel
knows of each frame: its time, whether frames were lost before it, who sent it.

From below: the interface as the kernel has it (rtnetlink), an adapter's clock,
frames as the bytes that the kernel gives and takes, the socket's set-up and its
errors, reception, the bus. python-can has a receiver for it too; that one asks
the kernel for no count of what it lost, keeps its small buffer, and makes an
object of each frame.
"""

from __future__ import annotations

import errno
import math
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass

from triaxcal_drivers.can.adapter import BUS_OFF, ControllerState, Frame, Identifier
from triaxcal_drivers.can.model import SocketCanOptions
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.hints import nearest
from triaxcal_drivers.interface import RawFlag

_CAN_TYPE = 280  # ARPHRD_CAN
_FD_BYTES = 72  # a frame's, and so the interface's mtu with CAN FD
_UP = 1

_NETLINK_HEADER = struct.Struct("=IHHII")  # length, type, flags, sequence, port
_INTERFACE = struct.Struct("=BxHiII")  # family, type, index, flags, change
_ATTRIBUTE = struct.Struct("=HH")  # length, type
_NESTED = 0x3FFF  # without the bits that say nested or of network byte order
_NEW_LINK, _GET_LINK, _NETLINK_ERROR, _REQUEST = 16, 18, 2, 1
_NAME, _MTU, _LINK_INFO, _INFO_DATA = 3, 4, 18, 2
_BIT_TIMING, _STATE, _CONTROL_MODE, _RESTART_MS = 1, 4, 5, 6
_LISTEN_ONLY = 2
_REPLY_BYTES = 1 << 16  # a link's attributes take some 2 kB
_REPLY_S = 1.0  # the kernel answers at once


@dataclass(frozen=True)
class Link:
    """``state`` and ``bitrate`` (bit/s) are None for an interface without a
    controller, such as vcan; ``restart_ms`` is how long after bus-off the
    controller is started again, 0 for never."""

    name: str
    can: bool
    up: bool
    fd: bool
    state: ControllerState | None = None
    bitrate: int | None = None
    listen_only: bool = False
    restart_ms: int = 0


def read_link(name: str) -> Link:
    """Asks the kernel, some 50 µs. Raises OSError: with ENODEV where there is
    no such interface."""
    try:
        index = socket.if_nametoindex(name)
    except OSError as e:  # without a number, before Python 3.14
        raise OSError(errno.ENODEV, os.strerror(errno.ENODEV)) from e
    request = _INTERFACE.pack(socket.AF_UNSPEC, 0, index, 0, 0)
    header = _NETLINK_HEADER.pack(_NETLINK_HEADER.size + len(request), _GET_LINK, _REQUEST, 1, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, socket.NETLINK_ROUTE) as netlink:
        netlink.settimeout(_REPLY_S)
        netlink.send(header + request)
        return link_of(netlink.recv(_REPLY_BYTES))


def link_of(reply: bytes) -> Link:
    """Link of a message RTM_NEWLINK. Raises OSError for an error message."""
    length, kind, *_ = _NETLINK_HEADER.unpack_from(reply)
    if kind == _NETLINK_ERROR:
        (code,) = struct.unpack_from("=i", reply, _NETLINK_HEADER.size)
        raise OSError(-code, "the kernel does not tell about this interface")
    if kind != _NEW_LINK:
        raise OSError(f"the kernel answered with message {kind}, expected {_NEW_LINK}")
    _, device, _, flags, _ = _INTERFACE.unpack_from(reply, _NETLINK_HEADER.size)
    about = dict(_attributes(reply[_NETLINK_HEADER.size + _INTERFACE.size : length]))
    controller = dict(_attributes(dict(_attributes(about.get(_LINK_INFO, b""))).get(_INFO_DATA, b"")))
    if device != _CAN_TYPE:
        controller = {}
    state = controller.get(_STATE)
    return Link(
        about.get(_NAME, b"").rstrip(b"\0").decode(),
        device == _CAN_TYPE,
        bool(flags & _UP),
        _number(about.get(_MTU)) >= _FD_BYTES,
        None if state is None else _state(_number(state)),
        _number(controller.get(_BIT_TIMING)) or None,
        bool(_number(controller.get(_CONTROL_MODE), 4) & _LISTEN_ONLY),
        _number(controller.get(_RESTART_MS)),
    )


def _number(attribute: bytes | None, offset: int = 0) -> int:
    return 0 if attribute is None else int(struct.unpack_from("=I", attribute, offset)[0])


def _state(number: int) -> ControllerState | None:
    states = list(ControllerState)
    return states[number] if number < len(states) else None


def _attributes(data: bytes) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + _ATTRIBUTE.size <= len(data):
        length, kind = _ATTRIBUTE.unpack_from(data, at)
        if length < _ATTRIBUTE.size:
            return
        yield kind & _NESTED, data[at + _ATTRIBUTE.size : at + length]
        at += (length + 3) & ~3


def can_interfaces() -> list[str]:
    """Names of the CAN interfaces that there are."""
    return sorted(name for _, name in socket.if_nameindex() if _is_can(name))


def _is_can(name: str) -> bool:
    try:
        return read_link(name).can
    except OSError:  # gone meanwhile
        return False


_WINDOW_NS = 10_000_000_000
"""A crystal's 50 ppm drift apart by half a millisecond meanwhile, which is less
than a USB adapter takes to hand a frame on."""
_STEP_NS = 1_000_000_000
"""No adapter keeps a frame so long: one of the two clocks was set."""
_LEARNT_NS = 10_000_000
"""Largest variation of an adapter's delay; a larger step back is one of the host's
clock."""


class HardwareClock:
    """Lays the stamps of an adapter's clock, wherever it starts, on the
    kernel's.

    The kernel has a frame some time after the adapter, never before. So the
    least difference of the two clocks in the last 10 to 20 s is taken for the
    difference itself. Times do not go back while that is learnt, but with the
    host's clock they do.
    """

    def __init__(self) -> None:
        self._least: int | None = None
        self._least_now = 0
        self._since_ns = 0
        self._last_ns = 0

    def time_ns(self, hardware_ns: int, kernel_ns: int) -> int:
        """Host time of one frame; frames in order."""
        apart = kernel_ns - hardware_ns
        if self._least is None or not -_STEP_NS < apart - self._least < _STEP_NS:
            self._least = self._least_now = apart
            self._since_ns = hardware_ns
        elif hardware_ns - self._since_ns >= _WINDOW_NS:
            self._least, self._least_now = min(self._least_now, apart), apart
            self._since_ns = hardware_ns
        else:
            self._least, self._least_now = min(self._least, apart), min(self._least_now, apart)
        time_ns = hardware_ns + self._least
        self._last_ns = self._last_ns if 0 < self._last_ns - time_ns < _LEARNT_NS else time_ns
        return self._last_ns


FD_BYTES = 72  # of a CAN FD frame; a classic one has 16
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
FILTERS_MOST = 512  # CAN_RAW_FILTER_MAX; the kernel refuses more

_EXTENDED, _EXTENDED_MASK, _STANDARD_MASK = 0x8000_0000, 0x1FFF_FFFF, 0x7FF
_BIT_RATE_SWITCH, _ERROR_PASSIVE = 0x01, 0x02
_LOCAL, _OWN = 0x04, 0x800  # MSG_DONTROUTE: of this host; MSG_CONFIRM: of this very socket

_HEADER = struct.Struct("=IBB")  # identifier with three flags, length, flags of a CAN FD frame
_FILTER = struct.Struct("=II")  # what the identifier has to be, where the mask has ones
_CLASSIC_FRAME, _FD_FRAME = struct.Struct("=IB3x8s"), struct.Struct("=IB3x64s")

_KINDS = tuple(
    int(RawFlag.ERROR if error else RawFlag.EXTENDED_ID * extended | RawFlag.REMOTE * remote)
    for extended in (0, 1)
    for remote in (0, 1)
    for error in (0, 1)
)
"""`RawFlag` by the three highest bits of the identifier."""
_REMOTE, _SENT = int(RawFlag.REMOTE), int(RawFlag.SENT)
_FD, _SWITCHED = int(RawFlag.FD), int(RawFlag.BIT_RATE_SWITCH)


def frame_of(raw: bytes, message_flags: int) -> tuple[int, int, bytes]:
    """Identifier, flags of `RawFlag` and data of what `recvmsg` gave."""
    word, length, fd_flags = _HEADER.unpack_from(raw)
    flags = _KINDS[word >> 29]
    if message_flags & (_LOCAL | _OWN):
        flags |= _SENT
    if len(raw) == FD_BYTES:
        flags |= _FD
        if fd_flags & _BIT_RATE_SWITCH:
            flags |= _SWITCHED
        if fd_flags & _ERROR_PASSIVE:
            flags |= _REMOTE
        return word & _EXTENDED_MASK, flags, raw[8 : 8 + length]
    if flags & _REMOTE:
        return word & _EXTENDED_MASK, flags, bytes(length)
    return word & _EXTENDED_MASK, flags, raw[8 : 8 + length]


def bytes_of(identifier: int, data: bytes, *, extended: bool, fd: bool) -> bytes:
    """A data frame to be sent; one of more than eight bytes is a CAN FD frame.
    Raises ValueError where it is none."""
    most = _EXTENDED_MASK if extended else _STANDARD_MASK
    if not 0 <= identifier <= most:
        raise ValueError(f"identifier 0x{identifier:X}: expected at most 0x{most:X}")
    longest = 64 if fd else 8
    if len(data) not in FD_LENGTHS or len(data) > longest:
        kind = "of a CAN FD frame" if fd else "without CAN FD"
        raise ValueError(f"{len(data)} bytes of data: no length {kind}, which has up to {longest}")
    word = identifier | _EXTENDED * extended
    return (_CLASSIC_FRAME if len(data) <= 8 else _FD_FRAME).pack(word, len(data), data)


def filters_of(identifiers: Collection[Identifier] | None) -> bytes:
    """CAN_RAW_FILTER for data and remote frames of these identifiers; for all frames if
    None, or for more identifiers than the kernel accepts."""
    if identifiers is None or len(identifiers) > FILTERS_MOST:
        return _FILTER.pack(0, 0)
    return b"".join(
        _FILTER.pack(identifier | _EXTENDED, _EXTENDED_MASK | _EXTENDED)
        if extended
        else _FILTER.pack(identifier, _STANDARD_MASK | _EXTENDED)
        for identifier, extended in sorted(identifiers)
    )


BUFFER_S = 10.0
"""A process that is stopped, swapped out or starved for so long loses nothing.
The memory is taken only while frames wait."""
FASTEST = 1_000_000  # bit/s, of classic CAN: where nobody says how fast the bus is
FRAME_BITS = 111  # of a frame with a short identifier and eight bytes, none of them stuffed
FRAME_BYTES = 768  # that the kernel counts for a frame that waits: 256 and 512

DROPS, MEMORY = 40, 55  # SO_RXQ_OVFL, SO_MEMINFO
STAMPS, STAMPS_OLD = 64, 35  # SO_TIMESTAMPNS: of 64 bits everywhere since Linux 5.1, and as before
HARDWARE, HARDWARE_OLD = 65, 37  # SO_TIMESTAMPING likewise
FILTER, _ERROR_FILTER, _LOOPBACK, OWN, _ACCEPT_FD = 1, 2, 3, 4, 5  # CAN_RAW_…, at level SOL_CAN_RAW
_ALL_ERRORS = 0x1FFF_FFFF
BUFFER_BY_FORCE = 33  # SO_RCVBUFFORCE
_HARDWARE_FLAGS = 1 << 2 | 1 << 3 | 1 << 4 | 1 << 6  # stamps of reception, the adapter's as they are and the kernel's
_NUMBER = struct.Struct("=I")


def unbound(name: str) -> socket.socket:
    if not hasattr(socket, "AF_CAN"):
        raise BusError(f"cannot open socketcan {name}: this system has no SocketCAN, which Linux has")
    try:
        return socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    except OSError as e:
        raise BusError(f"cannot open {reason(e, name)}") from e


def set_up(sock: socket.socket, settings: SocketCanOptions, *, fd: bool) -> None:
    """Set the options of a socket before it is bound, so that they hold for every
    frame."""
    raw, every = socket.SOL_CAN_RAW, socket.SOL_SOCKET
    sock.setsockopt(raw, _ERROR_FILTER, _NUMBER.pack(_ALL_ERRORS))
    sock.setsockopt(raw, _LOOPBACK, int(settings.local_loopback))
    sock.setsockopt(raw, OWN, int(settings.receive_own_messages))
    if fd:
        sock.setsockopt(raw, _ACCEPT_FD, 1)
    sock.setsockopt(every, DROPS, 1)
    wanted = (HARDWARE, HARDWARE_OLD) if settings.hardware_timestamps else (STAMPS, STAMPS_OLD)
    value = _HARDWARE_FLAGS if settings.hardware_timestamps else 1
    try:
        sock.setsockopt(every, wanted[0], value)
    except OSError:
        sock.setsockopt(every, wanted[1], value)


def make_room(sock: socket.socket, name: str, settings: SocketCanOptions, bitrate: int) -> None:
    """Set the receive buffer: exactly that of an option, else enough for `BUFFER_S` of
    a full bus, as far as the system allows."""
    asked = settings.receive_buffer
    size = asked or min(round(BUFFER_S * bitrate / FRAME_BITS * FRAME_BYTES), 1 << 29)
    half = math.ceil(size / 2)  # the kernel takes twice as much as it is asked for
    with suppress(OSError):
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, half)
        if sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) < size:
            sock.setsockopt(socket.SOL_SOCKET, BUFFER_BY_FORCE, half)
    given = sock.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    if asked is not None and given < asked:
        raise BusError(
            f"cannot open socketcan {name}: receive_buffer {asked} is more than this system allows ({given} bytes): "
            f"`sysctl net.core.rmem_max={half}`, or the capability CAP_NET_ADMIN"
        )


def reason(e: OSError, name: str) -> str:
    """Meaning of a system error here, and its remedy."""
    where = f"socketcan {name}"
    code = e.errno
    if code in (errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT):
        return f"{where}: this kernel has no CAN, or not loaded: `modprobe can_raw` (errno {code})"
    if code == errno.ENETDOWN:
        return f"{where}: the link is down: `ip link set {name} up`"
    if code in (errno.ENODEV, errno.ENXIO):
        known = can_interfaces()
        there = nearest(name, known) or "; there is no CAN interface"
        return f"{where}: there is no such interface{there}: plug it in, or `ip link add`, and `ip link set {name} up`"
    if code in (errno.EPERM, errno.EACCES):
        return f"{where}: not permitted: run it as a user with the capability CAP_NET_RAW"
    if code == errno.ENOBUFS:
        return f"{where}: nothing more can be sent, its queue is full: no other node acknowledges, or the bus is off"
    return f"{where}: {os.strerror(code) if code else e}"


_NS = 1_000_000_000
_COUNT = struct.Struct("=I")
_COUNTED = 1 << 32  # the count begins anew
_TIME, _TIME_OLD = struct.Struct("=qq"), struct.Struct("@ll")
_LOST_BEFORE = int(RawFlag.LOST_BEFORE)


class Reception:
    """Reception of one socket, frames in order. A frame without a time stamp gets the
    host's time."""

    def __init__(self, now_ns: Callable[[], int] = time.time_ns) -> None:
        self._now_ns = now_ns
        self._told = 0  # of the kernel's count, with a frame
        self._hardware = HardwareClock()

    def frame(self, raw: bytes, ancillary: Sequence[tuple[int, int, bytes]], message_flags: int) -> Frame:
        """The kernel counts at a frame's arrival all that it had lost by then;
        the difference to the frame before was lost between the two."""
        source, flags, data = frame_of(raw, message_flags)
        time_ns, lost = self.stamped(ancillary)
        if lost:
            flags |= _LOST_BEFORE
        return Frame(time_ns, source, flags, data, lost)

    def stamped(self, ancillary: Sequence[tuple[int, int, bytes]]) -> tuple[int, int]:
        """The host's time, and how many were lost since the one before."""
        time_ns = lost = 0
        for _, kind, value in ancillary:
            if kind == STAMPS:
                seconds, rest = _TIME.unpack(value)
                time_ns = seconds * _NS + rest
            elif kind == DROPS:
                (count,) = _COUNT.unpack(value)
                lost = (count - self._told) % _COUNTED
                self._told = count
            else:
                time_ns = self._time_ns(kind, value)
        return time_ns or self._now_ns(), lost

    def missed(self, count: int) -> int:
        """Frames of the kernel's ``count`` that no frame has told."""
        return (count - self._told) % _COUNTED

    def _time_ns(self, kind: int, value: bytes) -> int:
        """Time of an optional stamp; 0 if it is none."""
        if kind == STAMPS_OLD:
            seconds, rest = _TIME_OLD.unpack(value)
            return int(seconds * _NS + rest)
        if kind in (HARDWARE, HARDWARE_OLD):  # the kernel's, nothing, the adapter's
            layout = _TIME if kind == HARDWARE else _TIME_OLD
            kernel_ns, _, hardware_ns = (seconds * _NS + rest for seconds, rest in layout.iter_unpack(value))
            return self._hardware.time_ns(hardware_ns, kernel_ns) if hardware_ns and kernel_ns else kernel_ns
        return 0


AT_ONCE = 1024
"""Frames that `receive` gives at most: of a tenth of a second, of a full bus."""
GATHER_S, GATHER_MOST_S = 0.005, 0.1
"""Time for which frames are gathered, to save wake-ups, except while an answer is
awaited; longer at a low rate."""
GATHER_FEW, GATHER_MANY = 32, 256  # frames: from the former on another wake-up hardly counts
ANSWER_S = 0.1  # after something was sent
SEND_S = 0.1  # in which a queue of ten frames, as interfaces have, gets empty even at 20 kbit/s
RETRY_S = 0.001
CHECK_S = 1.0  # of silence, before the kernel is asked whether the bus is off

_MEMORY_COUNTS = struct.Struct("=9I")  # the last of them counts what was lost
_STAMP_BYTES, _COUNT_BYTES = 48, 4
_ANCILLARY = socket.CMSG_SPACE(_STAMP_BYTES) + socket.CMSG_SPACE(_COUNT_BYTES) if hasattr(socket, "CMSG_SPACE") else 0
_ERROR = int(RawFlag.ERROR)


class SocketCan:
    """An `Adapter` on a socket that is open and bound; `open_socketcan` makes
    one. ``buffer_frames`` is how many frames may wait."""

    def __init__(
        self, sock: socket.socket, name: str, options: SocketCanOptions | None = None, *, fd: bool = False
    ) -> None:
        self._socket, self._name, self._fd = sock, name, fd
        self._options = options or SocketCanOptions()
        self._reception = Reception()
        self._missed = 0  # when it was closed
        self._failure: str | None = None
        self._closed, self._bus_off = False, False
        self._gather_s = GATHER_S
        self._sent_s, self._heard_s = -math.inf, time.monotonic()
        self._receiving, self._sending = threading.Lock(), threading.Lock()
        self._end = os.eventfd(0, os.EFD_CLOEXEC)
        self._waiting = select.poll()
        self._waiting.register(sock, select.POLLIN)
        self._waiting.register(self._end, select.POLLIN)

    @property
    def echoes(self) -> bool:
        return self._options.local_loopback

    @property
    def socketcan_errors(self) -> bool:
        return True

    @property
    def buffer_frames(self) -> int:
        return self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // FRAME_BYTES

    def receive(self, timeout_s: float) -> list[Frame]:
        with self._receiving:
            self._check()
            woken = self._waiting.poll(math.ceil(timeout_s * 1000))
            if self._closed:
                return []
            frames = self._woken() if woken else []
            self._look(heard=bool(frames))
            if not frames:
                self._check()
            return frames

    def _woken(self) -> list[Frame]:
        gathers = time.monotonic() - self._sent_s > ANSWER_S
        if gathers:
            time.sleep(self._gather_s)
        frames = self._drain()
        if len(frames) > GATHER_MANY:
            self._gather_s = max(GATHER_S, self._gather_s / 2)
        elif gathers and len(frames) < GATHER_FEW:
            self._gather_s = min(GATHER_MOST_S, self._gather_s * 2)
        return frames

    def _drain(self) -> list[Frame]:
        """Waiting frames. The kernel reports a failure once, ahead of the frames before
        it."""
        frames: list[Frame] = []
        receive, frame_of = self._socket.recvmsg, self._reception.frame
        while len(frames) < AT_ONCE:
            try:
                raw, ancillary, flags, _ = receive(FD_BYTES, _ANCILLARY, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            except OSError as e:
                if self._failure is not None:
                    break
                self._failure = reason(e, self._name)
                continue
            frame = frame_of(raw, ancillary, flags)
            if frame.flags & _ERROR and frame.source & BUS_OFF:
                self._bus_off = True
            frames.append(frame)
        return frames

    def _check(self) -> None:
        if self._closed:
            raise BusError(f"socketcan {self._name} has been closed")
        if self._failure is not None:
            raise BusError(self._failure)

    def _look(self, *, heard: bool) -> None:
        """Asks the kernel about the link after an error frame that says bus-off,
        and in silence: that frame may have been lost."""
        now_s = time.monotonic()
        if heard:
            self._heard_s = now_s
        if self._bus_off or now_s - self._heard_s >= CHECK_S:
            self._bus_off, self._heard_s = False, now_s
            with suppress(OSError):  # no such interface: the socket tells
                self._failure = self._failure or _fault(read_link(self._name))

    def missed(self) -> int:
        """Frames that the kernel has lost and no received frame has reported:
        the next one will, and at the end there is none."""
        with self._receiving:
            return self._missed if self._closed else self._count_missed()

    def _count_missed(self) -> int:
        try:
            memory = self._socket.getsockopt(socket.SOL_SOCKET, MEMORY, _MEMORY_COUNTS.size)
        except OSError:  # before Linux 4.12
            return 0
        return self._reception.missed(_MEMORY_COUNTS.unpack(memory)[-1])

    def only(self, identifiers: Collection[Identifier] | None) -> None:
        """The kernel filters; what waits already stays. Raises BusError."""
        own = identifiers is None or self._options.receive_own_messages
        with self._sending:
            self._check()
            try:
                self._socket.setsockopt(socket.SOL_CAN_RAW, FILTER, filters_of(identifiers))
                self._socket.setsockopt(socket.SOL_CAN_RAW, OWN, int(own))
            except OSError as e:
                raise BusError(reason(e, self._name)) from e

    def send(self, identifier: int, data: bytes, *, extended: bool = False) -> None:
        """A frame of more than eight bytes is a CAN FD frame. Waits up to
        `SEND_S` for room in the interface's queue."""
        if self._options.listen_only:
            raise BusError(f"socketcan {self._name} is opened listen-only: nothing is sent")
        try:
            raw = bytes_of(identifier, data, extended=extended, fd=self._fd)
        except ValueError as e:
            raise BusError(f"socketcan {self._name}: cannot send {e}") from e
        with self._sending:
            self._check()
            self._sent_s = time.monotonic()
            try:
                self._send(raw)
            except OSError as e:
                raise BusError(reason(e, self._name)) from e

    def _send(self, raw: bytes) -> None:
        until_s = self._sent_s + SEND_S
        while True:
            try:
                self._socket.send(raw)
                return
            except OSError as e:
                if e.errno != errno.ENOBUFS or time.monotonic() >= until_s:
                    raise
            time.sleep(RETRY_S)  # the kernel tells by no event when there is room

    def close(self) -> None:
        """Ends a `receive` that waits."""
        if self._closed:
            return
        self._closed = True
        with suppress(OSError):
            os.eventfd_write(self._end, 1)
        with self._receiving, self._sending:
            if self._end >= 0:
                self._missed = self._count_missed()
                self._socket.close()
                os.close(self._end)
                self._end = -1


def open_socketcan(name: str, options: Mapping[str, object], bitrate: int | None = None) -> SocketCan:
    """Interface ``name``, which has to be up. ``bitrate`` in bit/s has to be
    the interface's, which the system sets. Raises BusError, which names what
    mends it."""
    try:
        settings = SocketCanOptions.of(options)
    except ValueError as e:
        raise BusError(f"cannot open socketcan {name}: {e}") from e
    sock = unbound(name)
    try:
        link = _usable_link(name, settings, bitrate)
        fd = link.fd if settings.fd is None else settings.fd
        set_up(sock, settings, fd=fd)
        make_room(sock, name, settings, link.bitrate or bitrate or FASTEST)
        sock.bind((name,))
        if failed := sock.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
            raise OSError(failed, os.strerror(failed))
        if link.listen_only:
            settings = settings.model_copy(update={"listen_only": True})
        return SocketCan(sock, name, settings, fd=fd)
    except OSError as e:
        sock.close()
        raise BusError(f"cannot open {reason(e, name)}") from e
    except BaseException:
        sock.close()
        raise


def _usable_link(name: str, settings: SocketCanOptions, bitrate: int | None) -> Link:
    link = read_link(name)
    if not link.can:
        raise BusError(f"cannot open socketcan {name}: no CAN interface{nearest(name, can_interfaces())}")
    if not link.up:
        raise OSError(errno.ENETDOWN, "")
    if fault := _fault(link):
        raise BusError(f"cannot open {fault}")
    if None not in (bitrate, link.bitrate) and bitrate != link.bitrate:
        raise BusError(
            f"cannot open socketcan {name}: it runs at {link.bitrate} bit/s, expected {bitrate}: "
            f"`ip link set {name} down`, `ip link set {name} up type can bitrate {bitrate}`"
        )
    if settings.fd and not link.fd:
        raise BusError(
            f"cannot open socketcan {name}: fd is asked for, and the interface carries no CAN FD: "
            f"`ip link set {name} type can … fd on`, of a vcan `ip link set {name} mtu {FD_BYTES}`"
        )
    return link


def _fault(link: Link) -> str | None:
    """Message about a link that is up but gives no frames."""
    if link.state is ControllerState.BUS_OFF and not link.restart_ms:
        return (
            f"socketcan {link.name}: it is bus-off, and nothing starts it again: `ip link set {link.name} type can "
            f"restart`, or down and `ip link set {link.name} up type can restart-ms 100` for ever"
        )
    return None
