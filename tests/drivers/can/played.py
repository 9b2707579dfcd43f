"""In the place of what is behind a CAN bus."""

from __future__ import annotations

import queue
from collections.abc import Collection
from dataclasses import dataclass, field

from triaxcal_drivers.can.adapter import Frame, Identifier
from triaxcal_drivers.errors import BusError


@dataclass
class Played:
    """An adapter that receives what the test gives it. ``wanted`` is None for
    all identifiers."""

    waiting: queue.Queue[list[Frame] | BusError] = field(default_factory=queue.Queue)
    wanted: set[Identifier] | None = field(default_factory=set)
    sent: list[tuple[int, str]] = field(default_factory=list)
    closed: bool = False
    echoes: bool = False
    socketcan_errors: bool = True

    def receive(self, timeout_s: float) -> list[Frame]:
        try:
            given = self.waiting.get(timeout=timeout_s)
        except queue.Empty:
            return []
        if isinstance(given, BusError):
            raise given
        return given

    def only(self, identifiers: Collection[Identifier] | None) -> None:
        self.wanted = None if identifiers is None else set(identifiers)

    def send(self, identifier: int, data: bytes, *, extended: bool = False) -> None:
        self.sent.append((identifier, data.hex(" ")))

    def missed(self) -> int:
        return 7

    def close(self) -> None:
        self.closed = True
