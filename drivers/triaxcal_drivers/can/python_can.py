"""A CAN bus behind python-can, whatever the interface."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from contextlib import suppress
from typing import Any

import can

from triaxcal_drivers.can.adapter import Frame, Identifier
from triaxcal_drivers.can.model import BusSettings
from triaxcal_drivers.errors import BusError
from triaxcal_drivers.interface import RawFlag

_AT_ONCE = 256
"""Frames that are taken without a pause; more would keep those that wait for
the first of them."""
_OFF_CLOCK_NS = 10_000_000_000
_EXTENDED, _REMOTE, _ERROR = int(RawFlag.EXTENDED_ID), int(RawFlag.REMOTE), int(RawFlag.ERROR)
_FD, _SWITCHED, _SENT = int(RawFlag.FD), int(RawFlag.BIT_RATE_SWITCH), int(RawFlag.SENT)
_ECHO = frozenset(("udp_multicast", "gs_usb"))
"""Interfaces that give what they send, asked for or not."""


class HostClock:
    """Message time stamps as nanoseconds of the host's epoch.

    python-can gives seconds as a float, good to about 0.2 µs at today's date.
    Interfaces differ in where they start from: socketcan and udp_multicast have
    the kernel's time of reception, virtual the time of sending, kvaser, vector
    and pcan an adapter's clock laid on the epoch; gs_usb, serial and some
    others an adapter's clock that starts at 0 and may wrap. A stamp more than
    10 s off the host's clock is therefore read as the adapter's: from there on
    its differences count, starting from the host's time. Where there is no
    stamp, the host's time is taken.
    """

    def __init__(self, now_ns: Callable[[], int] = time.time_ns) -> None:
        self._now_ns = now_ns
        self._offset_ns = 0

    def time_ns(self, timestamp_s: float) -> int:
        now_ns = self._now_ns()
        if timestamp_s <= 0:
            return now_ns
        stamp_ns = round(timestamp_s * 1e9)
        if abs(stamp_ns + self._offset_ns - now_ns) > _OFF_CLOCK_NS:
            self._offset_ns = now_ns - stamp_ns
        return stamp_ns + self._offset_ns


def open_python_can(settings: BusSettings) -> can.BusABC:
    """Blocking; python-can's configuration files are not read. Raises
    BusError."""
    options: dict[str, Any] = dict(settings.options)
    if settings.bitrate is not None:
        options["bitrate"] = settings.bitrate
    if isinstance(state := options.get("state"), str) and state in can.BusState.__members__:
        options["state"] = can.BusState[state]
    try:
        return can.Bus(settings.channel, settings.interface, ignore_config=True, **options)
    except (can.CanError, OSError, ValueError, TypeError, ImportError, NotImplementedError) as e:
        raise BusError(f"cannot open {settings.interface} {settings.channel}: {_reason(e)}") from e


_SOCKETCAN_ERRORS = frozenset({"socketcan", "gs_usb", "socketcand", "udp_multicast", "virtual"})
"""Interfaces with error frames as in the kernel; others, such as pcan, have codes of
their own."""


class PythonCan:
    """An `Adapter`. Raises BusError where the bus cannot be opened."""

    def __init__(self, settings: BusSettings) -> None:
        self._where = f"{settings.interface} {settings.channel}"
        self._clock = HostClock()
        self.echoes = settings.interface in _ECHO or bool(settings.options.get("receive_own_messages"))
        self.socketcan_errors = settings.interface in _SOCKETCAN_ERRORS
        self._bus = open_python_can(settings)

    def receive(self, timeout_s: float) -> list[Frame]:
        frames: list[Frame] = []
        try:
            while len(frames) < _AT_ONCE and (message := self._bus.recv(0.0 if frames else timeout_s)) is not None:
                frames.append(self._frame(message))
        except (can.CanError, OSError, ValueError) as e:  # the latter two: a closed socket
            if not frames:
                raise BusError(f"receiving on {self._where} failed: {_reason(e)}") from e
        return frames

    def _frame(self, message: can.Message) -> Frame:
        flags = (
            _EXTENDED * message.is_extended_id
            | _REMOTE * (message.is_remote_frame or message.error_state_indicator)
            | _ERROR * message.is_error_frame
            | _FD * message.is_fd
            | _SWITCHED * message.bitrate_switch
            | _SENT * (not message.is_rx)
        )
        data = bytes(message.dlc) if message.is_remote_frame else bytes(message.data)
        return Frame(self._clock.time_ns(message.timestamp), message.arbitration_id, flags, data)

    def only(self, identifiers: Collection[Identifier] | None) -> None:
        """No filter: the interfaces differ in what their filters remove, error frames
        among it."""

    def send(self, identifier: int, data: bytes, *, extended: bool = False) -> None:
        try:
            self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=extended))
        except (can.CanError, OSError, ValueError) as e:
            raise BusError(f"sending on {self._where} failed: {_reason(e)}") from e

    def missed(self) -> int:
        """python-can counts none."""
        return 0

    def close(self) -> None:
        with suppress(can.CanError, OSError):  # it is gone already
            self._bus.shutdown()


def _reason(e: Exception) -> str:
    return " ".join(str(e).split()) or type(e).__name__
