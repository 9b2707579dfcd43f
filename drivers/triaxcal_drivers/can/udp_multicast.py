"""python-can's `udp_multicast`, a CAN bus over IP multicast, on a socket of our
own under Linux.

Each frame is one datagram: a msgpack map with the fields of `can.Message`.
python-can's receiver wakes up for every frame and makes an object of it; this
one takes what has gathered, and knows how many datagrams the kernel has lost.
"""

from __future__ import annotations

import math
import os
import select
import socket
import struct
import threading
import time
from collections.abc import Collection
from contextlib import suppress
from typing import Any

import msgpack

from triaxcal_drivers.can.adapter import Frame, Identifier
from triaxcal_drivers.can.model import BusSettings
from triaxcal_drivers.can.socketcan import BUFFER_BY_FORCE, DROPS, FD_LENGTHS, STAMPS, STAMPS_OLD, Reception
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import RawFlag

OPTIONS = frozenset({"port", "hop_limit", "fd"})
"""Known options of python-can's bus."""
PORT = 43113  # python-can's default
AT_ONCE = 1024  # frames that `receive` gives at most
ANSWER_S = 0.1  # after something was sent an answer is awaited: nothing gathers
GATHER_LEAST_S, GATHER_MOST_S = 0.002, 0.1
"""Limits of the time for which frames are gathered: a wake-up costs as much as several
frames."""
GATHER_FRAMES = 32  # more at once save little, and fill the socket's buffer
FASTEST_HZ = 8000.0  # frames of a full CAN bus of 1 Mbit/s
BUFFER_BYTES = 1 << 24  # asked for; the kernel gives what it allows
DATAGRAM_BYTES = 1280  # that the kernel counts for a datagram that waits, at most
LONGEST = 4096  # of a datagram; a frame of CAN FD has some 250 bytes

_ANCILLARY = socket.CMSG_SPACE(16) + socket.CMSG_SPACE(4) if hasattr(socket, "CMSG_SPACE") else 0
_ZEROS = bytes(8)  # of which a remote frame has as many as it asks for
_EXTENDED_MOST, _STANDARD_MOST = 0x1FFF_FFFF, 0x7FF
_EXTENDED, _REMOTE, _ERROR = int(RawFlag.EXTENDED_ID), int(RawFlag.REMOTE), int(RawFlag.ERROR)
_FD, _SWITCHED, _LOST = int(RawFlag.FD), int(RawFlag.BIT_RATE_SWITCH), int(RawFlag.LOST_BEFORE)


class UdpMulticast:
    """An `Adapter`. Raises BusError where the group cannot be joined."""

    def __init__(self, settings: BusSettings) -> None:
        self._where = f"{settings.interface} {settings.channel}"
        options: dict[str, Any] = dict(settings.options)
        self._fd = bool(options.get("fd", True))
        self._to = (str(settings.channel), int(options.get("port", PORT)))
        try:
            self._socket, self._to_address = _joined(*self._to, int(options.get("hop_limit", 1)))
        except (OSError, ValueError, OverflowError) as e:
            raise BusError(f"cannot open {self._where}: {_reason(e)}") from e
        self._reception = Reception()
        self._closed = self._flows = False
        self._sent_s = -math.inf
        self._gather_s, self._gather_most_s = GATHER_LEAST_S, self._gather_most()
        self._receiving, self._sending = threading.Lock(), threading.Lock()
        self._waiting = select.poll()
        self._waiting.register(self._socket, select.POLLIN)

    @property
    def echoes(self) -> bool:
        return True

    @property
    def socketcan_errors(self) -> bool:
        return True

    def _gather_most(self) -> float:
        """Half the buffer holds what a full bus brings meanwhile."""
        held = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF) / DATAGRAM_BYTES
        return max(GATHER_LEAST_S, min(GATHER_MOST_S, held / 2 / FASTEST_HZ))

    def receive(self, timeout_s: float) -> list[Frame]:
        with self._receiving:
            if self._closed:
                raise BusError(f"receiving on {self._where} failed: it has been closed")
            gathers = time.monotonic() - self._sent_s > ANSWER_S
            if gathers and self._flows:  # more will have come: no waking up for the first of it
                time.sleep(min(self._gather_s, timeout_s))
                frames = self._drain()
            elif self._waiting.poll(math.ceil(timeout_s * 1000)) and not self._closed:
                if gathers:
                    time.sleep(self._gather_s)
                frames = self._drain()
            else:
                frames = []
            self._flows = bool(frames)
        if len(frames) > GATHER_FRAMES:
            self._gather_s = max(GATHER_LEAST_S, self._gather_s / 2)
        elif frames and len(frames) < GATHER_FRAMES // 4:
            self._gather_s = min(self._gather_most_s, self._gather_s * 2)
        return frames

    def _drain(self) -> list[Frame]:
        """Waiting frames. Raises BusError if the first datagram is no frame."""
        frames: list[Frame] = []
        receive = self._socket.recvmsg
        while len(frames) < AT_ONCE:
            try:
                raw, ancillary, _, _ = receive(LONGEST, _ANCILLARY, socket.MSG_DONTWAIT)
                frame = self._frame(raw, ancillary)
            except BlockingIOError:
                break
            except (OSError, ValueError) as e:
                if not frames:
                    raise BusError(f"receiving on {self._where} failed: {_reason(e)}") from e
                break
            if frame is not None:
                frames.append(frame)
        return frames

    def _frame(self, raw: bytes, ancillary: list[tuple[int, int, bytes]]) -> Frame | None:
        """None for a frame of CAN FD on a bus without. Raises ValueError."""
        time_ns, lost = self._reception.stamped(ancillary)
        try:
            told = msgpack.unpackb(raw)
            source, data, fd = told["arbitration_id"], told["data"], told["is_fd"]
            extended, remote, error = told["is_extended_id"], told["is_remote_frame"], told["is_error_frame"]
            sound = 0 <= source <= (_EXTENDED_MOST if extended else _STANDARD_MOST)
            sound = sound and (len(data) in FD_LENGTHS if fd else len(data) <= 8)
            flags = (_EXTENDED if extended else 0) | (_REMOTE if remote else 0) | (_ERROR if error else 0)
            if fd:
                flags |= _FD | (_SWITCHED if told["bitrate_switch"] else 0)
                flags |= _REMOTE if told["error_state_indicator"] else 0
            if remote:
                data = _ZEROS[: told["dlc"]]
                sound = sound and len(data) == told["dlc"]
        except (ValueError, KeyError, TypeError, msgpack.UnpackException) as e:
            raise ValueError("a datagram that is no message of python-can") from e
        if not sound or not isinstance(source, int) or not isinstance(data, bytes):
            raise ValueError("a datagram that is no CAN frame")
        if fd and not self._fd:
            return None
        return Frame(time_ns, source, flags | _LOST if lost else flags, data, lost)

    def only(self, identifiers: Collection[Identifier] | None) -> None:
        """No filter: the group brings every frame."""

    def send(self, identifier: int, data: bytes, *, extended: bool = False) -> None:
        if not 0 <= identifier <= (_EXTENDED_MOST if extended else _STANDARD_MOST) or len(data) > 8:
            raise BusError(f"sending on {self._where} failed: 0x{identifier:X} with {len(data)} bytes is no CAN frame")
        message = {
            "timestamp": time.time(),
            "arbitration_id": identifier,
            "is_extended_id": extended,
            "is_remote_frame": False,
            "is_error_frame": False,
            "channel": None,
            "dlc": len(data),
            "data": bytes(data),
            "is_fd": False,
            "bitrate_switch": False,
            "error_state_indicator": False,
        }
        with self._sending:
            self._sent_s = time.monotonic()
            try:
                self._socket.sendto(msgpack.packb(message, use_bin_type=True), self._to_address)
            except OSError as e:
                raise BusError(f"sending on {self._where} failed: {_reason(e)}") from e

    def missed(self) -> int:
        """Those that the kernel lost are told with the next frame."""
        return 0

    def close(self) -> None:
        self._closed = True
        with self._receiving, self._sending, suppress(OSError):
            self._socket.close()


def _joined(group: str, port: int, hop_limit: int) -> tuple[socket.socket, Any]:
    """A socket that is in the group, and the address to send to. Raises
    OSError."""
    failure: OSError = OSError(f"{group} is no multicast address")
    for family, kind, _, _, address in socket.getaddrinfo(group, port, type=socket.SOCK_DGRAM):
        sock = socket.socket(family, kind)
        try:
            _set_up(sock, family, hop_limit)
            sock.bind(("", port))
            if family == socket.AF_INET:
                request = socket.inet_pton(family, str(address[0])) + struct.pack("@I", socket.INADDR_ANY)
                sock.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, request)
            else:
                request = socket.inet_pton(family, str(address[0]).partition("%")[0]) + struct.pack("@I", 0)
                sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_JOIN_GROUP, request)
            return sock, address
        except OSError as e:
            sock.close()
            failure = e
    raise failure


def _set_up(sock: socket.socket, family: int, hop_limit: int) -> None:
    hops = struct.pack("@I", hop_limit)
    if family == socket.AF_INET:
        sock.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, hops)
    else:
        sock.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, hops)
    # Several programs are on one group, and all of them get every datagram.
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
    for option in (socket.SO_RCVBUF, BUFFER_BY_FORCE):
        with suppress(OSError):
            sock.setsockopt(socket.SOL_SOCKET, option, BUFFER_BYTES // 2)
    with suppress(OSError):  # without it nobody tells of a loss
        sock.setsockopt(socket.SOL_SOCKET, DROPS, 1)
    try:
        sock.setsockopt(socket.SOL_SOCKET, STAMPS, 1)
    except OSError:
        sock.setsockopt(socket.SOL_SOCKET, STAMPS_OLD, 1)


def _reason(e: Exception) -> str:
    return (os.strerror(e.errno) if isinstance(e, OSError) and e.errno else str(e)) or type(e).__name__
