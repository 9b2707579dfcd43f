"""A CANopen node on a python-can bus: boot-up, NMT, heartbeat, SDO server, and a stream of samples."""

from __future__ import annotations

import math
import struct
import uuid
from collections.abc import Mapping
from typing import Any

import can

from tests.devices.motion import Motion, Triple
from tests.devices.sdo import SdoServer, framed
from tests.devices.serving import Serving

NMT, READINGS, CORRECTED, SDO_REQUESTS, NODE_GUARD = 0x000, 0x180, 0x280, 0x600, 0x700
BOOT_UP, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0x00, 0x04, 0x05, 0x7F
NMT_STATES = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}
RESET_NODE, RESET_COMMUNICATION = 0x81, 0x82
READINGS_UNIT_V, CORRECTED_UNIT_G = 10 / 2**19, 1e-5
_MOST = 2**19 - 1


class CanopenNode(Serving):
    """``motion`` is sent ``rate_hz`` times a second while the node is operational: one frame of readings, one of
    corrected samples, each x, y, z of 20 bits and a counter of 4, least significant first. ``announces``: a unit that
    takes the place of another boots and says so; otherwise it goes on where that one was, as behind a gateway."""

    def __init__(
        self,
        sdo: SdoServer,
        *,
        node_id: int = 5,
        interface: str = "virtual",
        channel: str | None = None,
        options: Mapping[str, Any] | None = None,
        motion: Motion | None = None,
        rate_hz: float = 50.0,
        heartbeat_s: float = 0.0,
        announces: bool = True,
    ) -> None:
        super().__init__()
        self.sdo = sdo
        self.node_id = node_id
        self.motion = motion
        self.rate_hz = rate_hz
        self.heartbeat_s = heartbeat_s
        self.announces = announces
        self.state = BOOT_UP
        self._where = (interface, channel or f"node-{uuid.uuid4()}", dict(options or {}))
        self._started: tuple[int, int] | None = None
        self._count = 0

    @property
    def bus(self) -> Mapping[str, Any]:
        """Where a master finds it, as a station file says it."""
        interface, channel, options = self._where
        return {"interface": interface, "channel": channel, "node_id": self.node_id, "options": options}

    def _open(self) -> None:
        interface, channel, options = self._where
        self._bus = can.Bus(channel, interface, ignore_config=True, **options)
        if self.heartbeat_s:
            self.later(self.heartbeat_s, self._beat, recurs=True)
        if self.motion is not None:
            self.later(1 / self.rate_hz, lambda: self._sample(self.now()), recurs=True)

    def _close(self) -> None:
        self._bus.shutdown()

    def _wake(self) -> None:
        """It looks up soon enough."""

    def _hear(self, patience_s: float) -> bool:
        self._notice_starts()
        message = self._bus.recv(patience_s)
        if message is None:
            return False
        if not (message.is_error_frame or message.is_remote_frame or message.is_extended_id):
            self._take(message)
        return True

    def _take(self, message: can.Message) -> None:
        data = bytes(message.data)
        if message.arbitration_id == NMT and len(data) == 2 and data[1] in (0, self.node_id):
            self._manage(data[0])
        elif message.arbitration_id == SDO_REQUESTS + self.node_id and self.state in (OPERATIONAL, PRE_OPERATIONAL):
            for reply in self.sdo.exchange(data, self.now()).replies:
                out = framed(reply, self.node_id)
                self.later(reply.after_s, lambda out=out: self._send(*out))  # type: ignore[misc]

    def _notice_starts(self) -> None:
        """Says that it is there after each start, and is pre-operational then."""
        place = self.sdo.place
        with place.lock:
            up, start = place.unit.up(self.now()), (id(place.unit), place.unit.restarts)
        if self._started is not None and start[0] != self._started[0] and not self.announces:
            self._started = start
        if start != self._started:
            self.state = BOOT_UP
        if up and self.state == BOOT_UP:
            self._started, self.state = start, PRE_OPERATIONAL
            self._send(NODE_GUARD + self.node_id, bytes([BOOT_UP]))

    def _manage(self, command: int) -> None:
        place = self.sdo.place
        with place.lock:
            if not place.unit.up(self.now()):
                return
            if command == RESET_NODE:
                place.unit.restart(self.now())
        self.state = BOOT_UP if command == RESET_COMMUNICATION else NMT_STATES.get(command, self.state)

    def _beat(self) -> None:
        if self.state != BOOT_UP:
            self._send(NODE_GUARD + self.node_id, bytes([self.state]))
        self.later(self.heartbeat_s, self._beat, recurs=True)

    def _sample(self, due_s: float) -> None:
        assert self.motion is not None
        place = self.sdo.place
        with place.lock:
            if self.state == OPERATIONAL and place.unit.up(due_s):
                self._count += 1
                shown, corrected = self.motion.shown(place.unit, due_s), self.motion.corrected(place.unit, due_s)
                self._send(READINGS + self.node_id, packed(shown, READINGS_UNIT_V, self._count))
                self._send(CORRECTED + self.node_id, packed(corrected, CORRECTED_UNIT_G, self._count))
        following_s = due_s + 1 / self.rate_hz
        self.later(max(following_s - self.now(), 1e-6), lambda: self._sample(following_s), recurs=True)

    def _send(self, cob_id: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=cob_id, data=data, is_extended_id=False))


def packed(values: Triple, unit: float, count: int) -> bytes:
    """Three signed numbers of 20 bits and the count's lowest four; what is too large or no number is -2**19."""
    bits = (count & 0xF) << 60
    for i, value in enumerate(values):
        fits = math.isfinite(value) and abs(value) <= _MOST * unit
        bits |= (round(value / unit) if fits else -(2**19)) % 2**20 << 20 * i
    return struct.pack("<Q", bits)
