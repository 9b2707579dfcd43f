"""The one interface behind which every device stands, be it on CAN, on Modbus
or in a recording.

A driver is code for one transport. It validates its own part of a profile,
opens devices, and makes decoders. A decoder is pure: raw batches in, samples
out, no I/O, the same from a live bus and from a recording.
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import IntFlag
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from triaxcal_drivers.profile import Bundle, Profile
from triaxcal_drivers.two_senders import ExtraAnswer


class RawFlag(IntFlag):
    """Flags of a raw record, set by the receiver."""

    EXTENDED_ID = 1
    REMOTE = 2  # of a CAN FD frame, which cannot be remote: its sender was error passive
    ERROR = 4  # CAN error frame; Modbus exception reply
    FD = 8
    LOST_BEFORE = 16  # records were lost just before this one: see the `Gap`
    INVALID = 32  # reply of the wrong length, function or address
    BIT_RATE_SWITCH = 64  # of a CAN FD frame: its data came at the faster rate
    SENT = 128  # this host sent it


EXTENDED_KEY = 1 << 32
"""Added to an extended identifier: a standard one may have the same number."""


BUSY_S = 6.0
"""Longest wait for a busy device: longer than any EEPROM takes, and short enough that a
provisioning and its undo, with a reconnection each, end within 30 s."""
BUSY_PAUSE_S = 0.02


@dataclass(frozen=True)
class Gap:
    """Records that were sent, or would have been, and are not in a stream.

    Host time ``from_ns`` is of the last record before it, or of the moment at
    which the gap was noticed where there was none; ``to_ns`` of the first
    record after it, which carries `RawFlag.LOST_BEFORE`, and None while nothing
    has come again. ``lost`` counts the records where somebody counted them.
    """

    from_ns: int
    to_ns: int | None
    cause: str
    lost: int | None = None


@dataclass(frozen=True)
class RawBatch:
    """Records as they came off the bus, undecoded.

    ``time_ns`` (n,) int64 host receive time since the epoch; ``source`` (n,)
    uint32 CAN identifier, or for Modbus ``function << 16 | first address``;
    ``flags`` (n,) uint8 of `RawFlag`; ``length`` (n,) uint16 bytes of each
    record; ``payload`` the records' bytes, one after the other (CAN data;
    Modbus register bytes as on the wire, most significant first). ``gap`` is
    what was lost just before the first record; a batch without records may
    have one that is not over. ``unconfirmed``: that these records are the
    unit's was never confirmed, and another unit answered later. A recording's
    reader says so; a device does not know.
    """

    time_ns: NDArray[np.int64]
    source: NDArray[np.uint32]
    flags: NDArray[np.uint8]
    length: NDArray[np.uint16]
    payload: bytes
    gap: Gap | None = None
    unconfirmed: bool = False

    def __post_init__(self) -> None:
        n = len(self.time_ns)
        if not (len(self.source) == len(self.flags) == len(self.length) == n):
            raise ValueError("RawBatch: columns differ in length")
        if int(self.length.sum()) != len(self.payload):
            raise ValueError("RawBatch: payload is not as long as its records")

    def __len__(self) -> int:
        return len(self.time_ns)

    @property
    def identifiers(self) -> NDArray[np.int64]:
        """(n,) CAN identifiers, extended ones apart by `EXTENDED_KEY`."""
        extended = (self.flags & RawFlag.EXTENDED_ID) != 0
        return np.asarray(self.source.astype(np.int64) + extended * EXTENDED_KEY)

    def after(self, gap: Gap | None) -> RawBatch:
        """The same records with a gap before the first; None if the gap was reported
        before."""
        flags = self.flags.copy()
        flags[:1] |= np.uint8(RawFlag.LOST_BEFORE)
        return replace(self, flags=flags, gap=gap)

    def part(self, start: int, stop: int) -> RawBatch:
        """The records from ``start`` to before ``stop``."""
        if (start, stop) == (0, len(self)):
            return self
        ends = np.concatenate([[0], np.cumsum(self.length, dtype=np.int64)])
        piece = slice(start, stop)
        return RawBatch(
            self.time_ns[piece],
            self.source[piece],
            self.flags[piece],
            self.length[piece],
            self.payload[int(ends[start]) : int(ends[stop])],
            self.gap if start == 0 else None,
            self.unconfirmed,
        )

    @staticmethod
    def joined(batches: Sequence[RawBatch]) -> RawBatch:
        """One after the other as one. Their gaps are lost: the flags tell of
        them. One that is ``unconfirmed`` makes the whole so."""
        if len(batches) == 1:
            return batches[0]
        return RawBatch(
            np.concatenate([b.time_ns for b in batches]),
            np.concatenate([b.source for b in batches]),
            np.concatenate([b.flags for b in batches]),
            np.concatenate([b.length for b in batches]),
            b"".join(b.payload for b in batches),
            unconfirmed=any(b.unconfirmed for b in batches),
        )

    @staticmethod
    def of(records: Sequence[tuple[int, int, int, bytes]]) -> RawBatch:
        """A batch of (time_ns, source, flags, data) records."""
        time_ns, source, flags, data = zip(*records, strict=True) if records else ((), (), (), ())
        return RawBatch(
            np.array(time_ns, dtype=np.int64),
            np.array(source, dtype=np.uint32),
            np.array(flags, dtype=np.uint8),
            np.array([*map(len, data)], dtype=np.uint16),
            b"".join(data),
        )


@dataclass(frozen=True)
class SampleBlock:
    """Decoded samples of one stream, in order.

    ``time_ns`` (n,) int64: the device's own time base (its time stamp, else
    counter times period, else host receive time), laid on the host epoch at the
    first sample. ``counter`` (n,) int64, unwrapped. ``readings`` (n,3) in the
    profile's output unit (for a corrected stream: g). ``channels`` the
    auxiliary ones, each (n,). The counts are of this block: samples missing by
    the counter, repeated samples dropped, samples that could not be put
    together from their parts, records with an error flag, records of the stream
    that came whole and are too short for their message or otherwise not
    as it is defined, samples that the device itself says are not valid, and
    those whose readings are no finite numbers, all three of which are dropped;
    restarts of the device that its counter or stamps show, and nothing else had
    told. ``two_senders``: the latest records are those of two units.
    ``arrival_ns`` (n,) host time at which each came, less its age in a FIFO, where
    records may come without samples; else None.
    """

    time_ns: NDArray[np.int64]
    counter: NDArray[np.int64]
    readings: NDArray[np.float64]
    channels: Mapping[str, NDArray[np.float64]]
    missing: int = 0
    duplicates: int = 0
    incomplete: int = 0
    errors: int = 0
    invalid: int = 0
    not_finite: int = 0
    restarts: int = 0
    malformed: int = 0
    two_senders: bool = False
    arrival_ns: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.time_ns)

    def only(self, rows: NDArray[np.bool_]) -> SampleBlock:
        """Some of the samples; the counts stay."""
        channels = {name: values[rows] for name, values in self.channels.items()}
        return replace(
            self,
            time_ns=self.time_ns[rows],
            counter=self.counter[rows],
            readings=self.readings[rows],
            channels=channels,
            arrival_ns=None if self.arrival_ns is None else self.arrival_ns[rows],
        )


class Decoder(Protocol):
    """Turns one stream's raw records into samples; keeps what it needs between
    batches.

    The samples are the same however the records are cut into batches.
    """

    def feed(self, batch: RawBatch) -> SampleBlock: ...


class Device(Protocol):
    """An opened unit. Registers go by their names in the profile, as raw bytes
    in the order on the wire."""

    async def open(self) -> None:
        """Raises BusError, DeviceAbsent."""

    async def close(self) -> None: ...

    def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]:
        """Raw records of the named streams until the iterator is closed.

        Nothing is among them that was sampled before the call, in a device's
        FIFO or a receive buffer: an operator starts a recording, and what the
        unit did before is no pose.

        Raises DeviceSilent when nothing has come for the profile's
        ``silence_timeout_s``, DeviceRestarted where the unit says so, BusError.
        Whoever wants to go on closes the device, opens it and begins a new
        stream; a stream does not come back by itself.
        """

    async def read(self, register: str) -> bytes:
        """One request. Raises RegisterRefused (DeviceBusy among them),
        DeviceSilent, BusError."""

    async def write(self, register: str, raw: bytes, *, timeout_s: float | None = None) -> None:
        """One request; ``timeout_s`` takes the place of the profile's
        ``reply_timeout_s``. Raises as `read` does.

        A driver that can tell has a method ``listen`` as `Listens` does, one on CAN
        a method ``send`` as `Sends` does."""


class Listens(Protocol):
    """A device that tells of answers too many."""

    async def listen(self, seconds: float) -> list[ExtraAnswer]:
        """Waits so long by the host's clock. Returns the answers since the last
        call that no request explains: of a second unit at the same address, or
        to another program."""


class Sends(Protocol):
    """A device that takes CAN frames."""

    async def send(self, identifier: int, data: bytes, *, extended: bool = False) -> None:
        """Raises BusError."""


class Driver(Protocol):
    """The interface of a driver: a class named by an entry point of the group
    ``triaxcal.drivers``.

    A ``bus_model`` states by a method ``claim`` what one process claims while it works
    with a unit (see `triaxcal_drivers.claim`); without it all
    settings together name the device. A driver may name the ``packages`` that
    it imports only when a device is opened, so that `triaxcal devices` can say
    which are not there. By a method ``loads(bundle, bus)`` it may say what each
    stream takes of a line on which units are asked in turn
    (`LineLoad`, by stream).
    """

    profile_model: type[Profile]
    bus_model: type[BaseModel]

    def device(self, bundle: Bundle, bus: Any) -> Device:
        """``bus`` is an instance of ``bus_model``: where the unit is."""

    def decoder(self, bundle: Bundle, stream: str) -> Decoder:
        """Raises ProfileError where the profile's files do not hold what it
        names."""


@dataclass(frozen=True)
class LineLoad:
    """Load of a unit on a shared line.

    ``line`` is the name of the line, ``settings`` are its settings, which must be
    equal for all its units. A unit's stream takes ``reads_per_s``
    reads, or frames, each of which keeps the line for ``read_s`` at least.
    """

    line: str
    settings: str
    reads_per_s: float
    read_s: float

    @property
    def share(self) -> float:
        """Of the line's time; above 1 the line cannot carry it."""
        return self.reads_per_s * self.read_s
