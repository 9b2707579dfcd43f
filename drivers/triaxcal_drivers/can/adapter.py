"""The adapter of a CAN bus: an open socket or device that sends and receives."""

from __future__ import annotations

from collections.abc import Collection
from typing import NamedTuple, Protocol

Identifier = tuple[int, bool]
"""A CAN identifier and whether it is an extended one."""


class Frame(NamedTuple):
    """A received frame. ``time_ns`` is host time of its reception, ``source``
    its identifier (of an error frame its class, as SocketCAN has them),
    ``flags`` of `RawFlag`; ``lost`` frames are known to have been lost just
    before it. A remote frame has as many zero bytes as it asks for."""

    time_ns: int
    source: int
    flags: int
    data: bytes
    lost: int = 0


class Adapter(Protocol):
    """One open bus. Its calls block: one thread receives, any may send, and
    `close` ends both."""

    @property
    def echoes(self) -> bool:
        """Whether `receive` gives what `send` sends too, once all frames are
        asked for."""

    @property
    def socketcan_errors(self) -> bool:
        """Whether the identifiers and data of error frames are SocketCAN's; else
        they are of a layout of the adapter's own."""

    def receive(self, timeout_s: float) -> list[Frame]:
        """Received frames in order; none if none comes within ``timeout_s``. Raises
        BusError if the bus has failed: interface gone or down, adapter unplugged."""

    def only(self, identifiers: Collection[Identifier] | None) -> None:
        """Frames of these identifiers and error frames are enough from now on;
        None for all, those that it sends among them where it `echoes`. An
        adapter that cannot filter gives more."""

    def send(self, identifier: int, data: bytes, *, extended: bool = False) -> None:
        """Raises BusError."""

    def missed(self) -> int:
        """Frames that are known to be lost, and that no received frame has told
        of yet."""

    def close(self) -> None:
        """Raises nothing."""
