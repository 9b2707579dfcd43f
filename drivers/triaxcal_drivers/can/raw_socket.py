"""A raw CAN socket of Linux, set up, and what its errors mean."""

from __future__ import annotations

import errno
import math
import os
import socket
import struct
from contextlib import suppress

from triaxcal_drivers.can.link import can_interfaces
from triaxcal_drivers.can.model import SocketCanOptions
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.nearest import nearest

BUFFER_S = 10.0
"""A process that is stopped, swapped out or starved for so long loses nothing.
The memory is taken only while frames wait."""
FASTEST = 1_000_000  # bit/s, of classic CAN: where nobody says how fast the bus is
FRAME_BITS = 111  # of a frame with a short identifier and eight bytes, none of them stuffed
FRAME_BYTES = 768  # that the kernel counts for a frame that waits: 256 and 512

DROPS, MEMORY = 40, 55  # SO_RXQ_OVFL, SO_MEMINFO
STAMPS, STAMPS_OLD = 64, 35  # SO_TIMESTAMPNS: of 64 bits everywhere since Linux 5.1, and as before
HARDWARE, HARDWARE_OLD = 65, 37  # SO_TIMESTAMPING likewise
FILTER, _ERROR_FILTER, _LOOPBACK, OWN, _FD = 1, 2, 3, 4, 5  # CAN_RAW_…, at level SOL_CAN_RAW
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
    """Before it is bound: nothing is received otherwise than asked for."""
    raw, every = socket.SOL_CAN_RAW, socket.SOL_SOCKET
    sock.setsockopt(raw, _ERROR_FILTER, _NUMBER.pack(_ALL_ERRORS))
    sock.setsockopt(raw, _LOOPBACK, int(settings.local_loopback))
    sock.setsockopt(raw, OWN, int(settings.receive_own_messages))
    if fd:
        sock.setsockopt(raw, _FD, 1)
    sock.setsockopt(every, DROPS, 1)
    wanted = (HARDWARE, HARDWARE_OLD) if settings.hardware_timestamps else (STAMPS, STAMPS_OLD)
    value = _HARDWARE_FLAGS if settings.hardware_timestamps else 1
    try:
        sock.setsockopt(every, wanted[0], value)
    except OSError:
        sock.setsockopt(every, wanted[1], value)


def make_room(sock: socket.socket, name: str, settings: SocketCanOptions, bitrate: int) -> None:
    """For `BUFFER_S` of a full bus, or as far as the system lets an ordinary
    user; what was asked for by an option, exactly."""
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
    """What the errors of the system mean here, and what mends them."""
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
