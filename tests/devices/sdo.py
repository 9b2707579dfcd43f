"""What a CANopen unit answers to SDO requests: frames to frames, written from CiA 301. No I/O."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from tests.devices.memory import Electronics, Refused
from tests.devices.place import Exchange, Place, Reply

GARBAGE = ("index", "function", "length", "node", "truncated", "noise")
NOISE = bytes.fromhex("ff00 55aa 0001 fe00")
TOGGLE, SIZE_TOLD, EXPEDITED, LAST = 0x10, 0x01, 0x02, 0x01
ABORTS = {
    "unknown": 0x06020000, "read-only": 0x06010002, "write-only": 0x06010001, "length": 0x06070010,
    "value": 0x06090030, "locked": 0x08000021, "busy": 0x08000022, "failed": 0x06060000,
}  # fmt: skip
NO_SUB_INDEX, UNKNOWN_COMMAND, TOGGLE_NOT_ALTERNATED = 0x06090011, 0x05040001, 0x05030000
FACTS = {
    (0x1000, 0): (0).to_bytes(4, "little"),
    (0x1001, 0): b"\0",
    (0x1008, 0): b"three axes, good and bad",
    (0x1018, 0): b"\x04",
}
"""Read-only objects besides the registers; the device name is too long for an expedited transfer."""

Object = tuple[int, int]


@dataclass
class _Transfer:
    """A segmented transfer under way: what is still to be sent, or has come so far."""

    object: Object
    data: bytes
    upload: bool
    toggle: int = 0


class SdoServer:
    """The SDO server of the unit at a place. With ``segmented`` it sends short objects in segments too."""

    def __init__(self, place: Place, *, segmented: bool = False) -> None:
        self.place = place
        self.segmented = segmented
        self._transfer: _Transfer | None = None

    def exchange(self, frame: bytes, now: float) -> Exchange:
        """``frame`` of eight bytes, as a client sends it."""
        if len(frame) != 8:
            return Exchange()
        if frame[0] >> 5 == 4:
            self._transfer = None
            return Exchange()
        asked = self._object(frame)
        return self.place.exchange(
            now, lambda unit: self._answer(unit, frame, now), lambda refused: self._abort(asked, refused)
        )

    def _object(self, frame: bytes) -> Object:
        """Segments do not say whose they are."""
        if frame[0] >> 5 in (0, 3) and self._transfer is not None:
            return self._transfer.object
        index, subindex = struct.unpack("<HB", frame[1:4])
        return index, subindex

    def _abort(self, asked: Object, refused: Refused) -> bytes:
        self._transfer = None
        code = refused.code or ABORTS[refused.why]
        if refused.why == "unknown" and any(asked[0] == index for index, _ in self._objects(self.place.unit)):
            code = NO_SUB_INDEX
        return struct.pack("<BHBI", 0x80, *asked, code)

    def _answer(self, unit: Electronics, frame: bytes, now: float) -> tuple[bytes, float]:
        match frame[0] >> 5:
            case 1:
                return self._initiate_download(unit, frame, now)
            case 0:
                return self._download_segment(unit, frame, now)
            case 2:
                return self._initiate_upload(unit, frame, now), 0.0
            case 3:
                return self._upload_segment(frame), 0.0
        raise Refused("failed", UNKNOWN_COMMAND)

    def _initiate_download(self, unit: Electronics, frame: bytes, now: float) -> tuple[bytes, float]:
        asked, command = self._object(frame), frame[0]
        after_s = 0.0
        if command & EXPEDITED:
            size = 4 - (command >> 2 & 3) if command & SIZE_TOLD else 4
            after_s = self._write(unit, asked, frame[4 : 4 + size], now)
        else:
            self._name(unit, asked)
            self._transfer = _Transfer(asked, b"", upload=False)
        return struct.pack("<BHB4x", 0x60, *asked), after_s

    def _download_segment(self, unit: Electronics, frame: bytes, now: float) -> tuple[bytes, float]:
        transfer = self._under_way(frame, upload=False)
        transfer.data += frame[1 : 8 - (frame[0] >> 1 & 7)]
        answer = bytes([0x20 | transfer.toggle]) + bytes(7)
        transfer.toggle ^= TOGGLE
        after_s = 0.0
        if frame[0] & LAST:
            self._transfer = None
            after_s = self._write(unit, transfer.object, transfer.data, now)
        return answer, after_s

    def _initiate_upload(self, unit: Electronics, frame: bytes, now: float) -> bytes:
        asked = self._object(frame)
        data = FACTS.get(asked) or self._read(unit, asked, now)
        if len(data) <= 4 and not self.segmented:
            return struct.pack("<BHB4s", 0x43 | (4 - len(data)) << 2, *asked, data)
        self._transfer = _Transfer(asked, data, upload=True)
        return struct.pack("<BHBI", 0x41, *asked, len(data))

    def _read(self, unit: Electronics, asked: Object, now: float) -> bytes:
        """Least significant byte first; a VISIBLE_STRING from its first character on."""
        name = self._name(unit, asked)
        data = unit.read(name, now)
        return data if unit.table[name].type == "ascii" else data[::-1]

    def _upload_segment(self, frame: bytes) -> bytes:
        transfer = self._under_way(frame, upload=True)
        segment, transfer.data = transfer.data[:7], transfer.data[7:]
        command = transfer.toggle | (7 - len(segment)) << 1 | (LAST if not transfer.data else 0)
        transfer.toggle ^= TOGGLE
        if not transfer.data:
            self._transfer = None
        return struct.pack("<B7s", command, segment)

    def _under_way(self, frame: bytes, *, upload: bool) -> _Transfer:
        if self._transfer is None or self._transfer.upload is not upload:
            raise Refused("failed", UNKNOWN_COMMAND)
        if frame[0] & TOGGLE != self._transfer.toggle:
            raise Refused("failed", TOGGLE_NOT_ALTERNATED)
        return self._transfer

    def _write(self, unit: Electronics, asked: Object, data: bytes, now: float) -> float:
        if asked in FACTS:
            raise Refused("read-only")
        return unit.write(self._name(unit, asked), data[::-1], now)

    def _name(self, unit: Electronics, asked: Object) -> str:
        if asked not in self._objects(unit):
            raise Refused("unknown")
        return self._objects(unit)[asked]

    @staticmethod
    def _objects(unit: Electronics) -> dict[Object, str]:
        return {entry.object: name for name, entry in unit.table.items()}


def framed(reply: Reply, node_id: int) -> tuple[int, bytes]:
    """The reply as (COB-ID, data), damaged as it asks."""
    data, garbage = reply.data, reply.garbage
    cob_id = 0x580 + node_id + (garbage == "node")
    match garbage:
        case None | "node":
            return cob_id, data
        case "index":
            return cob_id, struct.pack("<BH", data[0], struct.unpack("<H", data[1:3])[0] + 1) + data[3:]
        case "function":
            return cob_id, bytes([data[0] ^ 0x20]) + data[1:]
        case "length":
            return cob_id, data[:7]
        case "truncated":
            return cob_id, data[:3]
        case "noise":
            return cob_id, NOISE
    raise ValueError(f"CANopen has no garbage '{garbage}', only {', '.join(GARBAGE)}")
