"""A CAN bus behind a raw socket of Linux (SocketCAN), with what the kernel
knows of each frame: its time, whether frames were lost before it, who sent it.

python-can has a receiver for it too; that one asks the kernel for no count of
what it lost, keeps its small buffer, and makes an object of each frame.
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
from collections.abc import Collection, Mapping
from contextlib import suppress

from triaxcal_drivers.can import error_frame, raw_frame, raw_socket
from triaxcal_drivers.can.adapter import Frame, Identifier
from triaxcal_drivers.can.error_frame import ControllerState
from triaxcal_drivers.can.link import Link, can_interfaces, read_link
from triaxcal_drivers.can.model import SocketCanOptions
from triaxcal_drivers.can.raw_socket import reason
from triaxcal_drivers.can.reception import Reception
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import RawFlag
from triaxcal_drivers.nearest import nearest

AT_ONCE = 1024
"""Frames that `receive` gives at most: of a tenth of a second, of a full bus."""
GATHER_S, GATHER_MOST_S = 0.005, 0.1
"""What comes within this time of a frame comes with it, for fewer wake-ups; not
while an answer is awaited. The longer the fewer come."""
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
        return self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) // raw_socket.FRAME_BYTES

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
        """What waits. The kernel tells of a failure before the frames that came
        before it, and once."""
        frames: list[Frame] = []
        receive, frame_of = self._socket.recvmsg, self._reception.frame
        while len(frames) < AT_ONCE:
            try:
                raw, ancillary, flags, _ = receive(raw_frame.FD_BYTES, _ANCILLARY, socket.MSG_DONTWAIT)
            except BlockingIOError:
                break
            except OSError as e:
                if self._failure is not None:
                    break
                self._failure = reason(e, self._name)
                continue
            frame = frame_of(raw, ancillary, flags)
            if frame.flags & _ERROR and frame.source & error_frame.BUS_OFF:
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
            memory = self._socket.getsockopt(socket.SOL_SOCKET, raw_socket.MEMORY, _MEMORY_COUNTS.size)
        except OSError:  # before Linux 4.12
            return 0
        return self._reception.missed(_MEMORY_COUNTS.unpack(memory)[-1])

    def only(self, identifiers: Collection[Identifier] | None) -> None:
        """The kernel filters; what waits already stays. Raises BusError."""
        own = identifiers is None or self._options.receive_own_messages
        with self._sending:
            self._check()
            try:
                self._socket.setsockopt(socket.SOL_CAN_RAW, raw_socket.FILTER, raw_frame.filters_of(identifiers))
                self._socket.setsockopt(socket.SOL_CAN_RAW, raw_socket.OWN, int(own))
            except OSError as e:
                raise BusError(reason(e, self._name)) from e

    def send(self, identifier: int, data: bytes, *, extended: bool = False) -> None:
        """A frame of more than eight bytes is a CAN FD frame. Waits up to
        `SEND_S` for room in the interface's queue."""
        if self._options.listen_only:
            raise BusError(f"socketcan {self._name} is opened listen-only: nothing is sent")
        try:
            raw = raw_frame.bytes_of(identifier, data, extended=extended, fd=self._fd)
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
    sock = raw_socket.unbound(name)
    try:
        link = _usable_link(name, settings, bitrate)
        fd = link.fd if settings.fd is None else settings.fd
        raw_socket.set_up(sock, settings, fd=fd)
        raw_socket.make_room(sock, name, settings, link.bitrate or bitrate or raw_socket.FASTEST)
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
            f"`ip link set {name} type can … fd on`, of a vcan `ip link set {name} mtu {raw_frame.FD_BYTES}`"
        )
    return link


def _fault(link: Link) -> str | None:
    """Of a link that is up, and yet gives no frames."""
    if link.state is ControllerState.BUS_OFF and not link.restart_ms:
        return (
            f"socketcan {link.name}: it is bus-off, and nothing starts it again: `ip link set {link.name} type can "
            f"restart`, or down and `ip link set {link.name} up type can restart-ms 100` for ever"
        )
    return None
