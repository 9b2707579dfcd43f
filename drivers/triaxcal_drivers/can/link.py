"""A CAN interface of Linux as the kernel has it (rtnetlink): whether it is up,
its bit rate, its controller's state."""

from __future__ import annotations

import errno
import os
import socket
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from triaxcal_drivers.can.error_frame import ControllerState

_CAN_TYPE = 280  # ARPHRD_CAN
_FD_BYTES = 72  # a frame's, and so the interface's mtu with CAN FD
_UP = 1

_HEADER = struct.Struct("=IHHII")  # length, type, flags, sequence, port
_INTERFACE = struct.Struct("=BxHiII")  # family, type, index, flags, change
_ATTRIBUTE = struct.Struct("=HH")  # length, type
_NESTED = 0x3FFF  # without the bits that say nested or of network byte order
_NEW_LINK, _GET_LINK, _ERROR, _REQUEST = 16, 18, 2, 1
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
    header = _HEADER.pack(_HEADER.size + len(request), _GET_LINK, _REQUEST, 1, 0)
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, socket.NETLINK_ROUTE) as netlink:
        netlink.settimeout(_REPLY_S)
        netlink.send(header + request)
        return link_of(netlink.recv(_REPLY_BYTES))


def link_of(reply: bytes) -> Link:
    """Of a message RTM_NEWLINK. Raises OSError where it is an error message."""
    length, kind, *_ = _HEADER.unpack_from(reply)
    if kind == _ERROR:
        (code,) = struct.unpack_from("=i", reply, _HEADER.size)
        raise OSError(-code, "the kernel does not tell about this interface")
    if kind != _NEW_LINK:
        raise OSError(f"the kernel answered with message {kind}, expected {_NEW_LINK}")
    _, device, _, flags, _ = _INTERFACE.unpack_from(reply, _HEADER.size)
    about = dict(_attributes(reply[_HEADER.size + _INTERFACE.size : length]))
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
