"""The entry point ``modbus``, and from replies of a Modbus device to samples: raw
batches in, samples out. No I/O."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triaxcal_drivers.claim import canonical_port
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.hints import nearest
from triaxcal_drivers.interface import Decoder, Device, LineLoad, RawBatch, RawFlag, SampleBlock
from triaxcal_drivers.modbus.model import (
    Channel,
    Counter,
    FifoStream,
    ModbusBus,
    ModbusProfile,
    Order,
    PollStream,
    TimeStamp,
    words_of,
)
from triaxcal_drivers.modbus.protocol import SerialLine
from triaxcal_drivers.profile import READING_CHANNELS, Bundle
from triaxcal_drivers.registers import TYPES
from triaxcal_drivers.timeline import Arrivals, Clockwork, Placed, Timeline
from triaxcal_drivers.two_senders import Senders, by_counter, by_levels

# Replies of a Modbus device as samples.

Bytes = NDArray[np.uint8]


class ModbusDecoder:
    """Decodes one stream. A failed request (exception, silence, malformed
    reply) counts as an error."""

    def __init__(self, profile: ModbusProfile, stream: str) -> None:
        self._stream = profile.streams[stream]
        self._word_order: Order = profile.word_order
        self._swap_bytes = profile.byte_order == "little"
        self._period_ns = 1e9 / profile.sampling.rate_hz
        self._source = self._stream.function << 16 | self._stream.address
        self._timeline = Timeline(_clockwork(self._stream, self._period_ns))
        self._errors = self._errors_at_last = 0
        self._gaps = self._gaps_at_last = 0
        self._lost_raw: int | None = None
        self._lost = self._lost_at_last = 0
        self._senders = self._watched()

    def _watched(self) -> Senders | None:
        """By every sample of a FIFO, by the newest ones of a block that is
        polled; by stamps where there is no counter. None where there is
        neither."""
        counter, stamp = self._stream.counter, self._stream.time_stamp
        if counter and isinstance(self._stream, FifoStream):
            return Senders(1 << counter.modulus_bits, by_counter)
        if counter:
            return Senders(1 << counter.modulus_bits, partial(by_levels, period_ns=self._period_ns))
        if stamp:
            counts = 1 << min(8 * TYPES[stamp.type].size, 62)
            return Senders(counts, partial(by_levels, period_ns=stamp.unit_s * 1e9))
        return None

    def _two_senders(
        self, records: Bytes, counts: NDArray[np.int64] | None, arrival_ns: NDArray[np.int64], placed: Placed
    ) -> bool:
        if self._senders is None or counts is None:
            return False
        faults = placed.missing or placed.restarts or not placed.new.all()
        message = np.zeros(len(counts), np.int64)
        return self._senders.are_two(arrival_ns, message, counts, records.astype(np.float64), suspect=bool(faults))

    def feed(self, batch: RawBatch) -> SampleBlock:
        # Choose the whole replies to this stream's reads.
        own = batch.source == self._source
        failed = (batch.flags & (RawFlag.ERROR | RawFlag.INVALID) != 0) | (batch.length != 2 * self._stream.words)
        good = own & ~failed
        starts = (np.cumsum(batch.length, dtype=np.int64) - batch.length)[good]
        data = np.frombuffer(batch.payload, dtype=np.uint8)
        replies = data[starts[:, None] + np.arange(2 * self._stream.words)]
        if self._swap_bytes:
            replies = replies.reshape(len(replies), -1, 2)[:, :, ::-1].reshape(len(replies), -1)
        # Count the failures and gaps before each reply.
        host_ns = batch.time_ns[good]
        errors = np.cumsum(own & failed)[good]
        gaps = np.cumsum((batch.flags & RawFlag.LOST_BEFORE) != 0)
        gaps_before, all_gaps = self._gaps + gaps[good], self._gaps + (int(gaps[-1]) if len(gaps) else 0)
        total = int((own & failed).sum())
        # Divide the windows of a FIFO into records.
        if isinstance(self._stream, FifoStream):
            # A count beyond the window is an error.
            broken = self._number(replies, self._stream.header.count) > self._stream.record_capacity
            errors, total = errors + np.cumsum(broken), total + int(broken.sum())
            replies, host_ns, errors, gaps_before = (each[~broken] for each in (replies, host_ns, errors, gaps_before))
            records, arrivals_ns, skipped, of = self._records(self._stream, replies, host_ns)
        else:
            records, arrivals_ns = replies, host_ns
            skipped, of = np.zeros(len(replies), np.int64), np.arange(len(replies))
        block = self._samples(records, arrivals_ns, skipped, self._errors + errors[of], gaps_before[of], total)
        self._errors, self._gaps = self._errors + total, all_gaps
        return block

    def _records(
        self, stream: FifoStream, replies: Bytes, host_ns: NDArray[np.int64]
    ) -> tuple[Bytes, NDArray[np.int64], NDArray[np.int64], NDArray[np.intp]]:
        """Records of all windows in a row, and for each its time by the host's clock
        [ns], the number of samples lost before it, and the index of its window."""
        count = self._number(replies, stream.header.count)
        inside = np.arange(stream.record_capacity) < count[:, None]
        body = replies[:, 2 * stream.record_start :].reshape(
            len(replies), stream.record_capacity, 2 * stream.record_words
        )
        of, index = np.nonzero(inside)
        behind = count[of] - 1 - index  # number of later records in the device at that moment
        if stream.header.remaining is not None:
            behind = behind + self._number(replies, stream.header.remaining)[of]
        arrival_ns = host_ns[of] - np.rint(behind * self._period_ns).astype(np.int64)
        return body[inside], arrival_ns, self._skipped(stream, replies, of), of

    def _skipped(self, stream: FifoStream, replies: Bytes, of: NDArray[np.intp]) -> NDArray[np.int64]:
        """Number of samples lost to overflow before each record, by the device's own
        count."""
        if stream.header.lost is None or not len(replies):
            return np.zeros(len(of), np.int64)
        raw = self._number(replies, stream.header.lost)
        first = raw[0] if self._lost_raw is None else self._lost_raw
        lost = np.diff(raw, prepend=first) % 2**16
        lost[lost >= 2**15] = 0  # went back: the device restarted
        so_far = self._lost + np.cumsum(lost)
        self._lost_raw, self._lost = int(raw[-1]), int(so_far[-1])
        skipped = np.diff(so_far[of], prepend=self._lost_at_last)
        if len(of):
            self._lost_at_last = int(so_far[of[-1]])
        return skipped

    def _samples(
        self,
        records: Bytes,
        arrival_ns: NDArray[np.int64],
        skipped: NDArray[np.int64],
        errors_before: NDArray[np.int64],
        gaps_before: NDArray[np.int64],
        errors: int,
    ) -> SampleBlock:
        stream = self._stream
        # Failures and gaps since the previous record.
        broken = np.diff(errors_before, prepend=self._errors_at_last) > 0
        after_gap = np.diff(gaps_before, prepend=self._gaps_at_last) > 0
        if len(errors_before):
            self._errors_at_last, self._gaps_at_last = int(errors_before[-1]), int(gaps_before[-1])
        # Place the records in time by their counters and time stamps.
        counter = (
            self._value(records, stream.counter).astype(np.int64) & (1 << stream.counter.modulus_bits) - 1
            if stream.counter
            else None
        )
        stamp = self._value(records, stream.time_stamp).astype(np.int64) if stream.time_stamp else None
        placed = self._timeline.place(
            Arrivals(
                counter,
                stamp,
                skipped,
                arrival_ns,
                broken,
                after_gap,
            )
        )
        # Decode the channels of new records.
        kept = records[placed.new]
        with np.errstate(over="ignore", invalid="ignore"):  # a scale may be any
            values = {
                name: self._value(kept, channel).astype(np.float64) * channel.scale + channel.offset
                for name, channel in stream.channels.items()
            }
        return SampleBlock(
            placed.time_ns,
            placed.counter,
            np.stack([values.pop(name) for name in READING_CHANNELS], axis=1),
            values,
            missing=placed.missing,
            # Polls read the newest sample more often than it changes. A FIFO yields
            # each record once.
            duplicates=len(records) - len(kept) if isinstance(stream, FifoStream) else 0,
            errors=errors,
            restarts=placed.restarts,
            two_senders=self._two_senders(records, stamp if counter is None else counter, arrival_ns, placed),
        )

    @staticmethod
    def _number(replies: Bytes, word: int) -> NDArray[np.int64]:
        return replies[:, 2 * word].astype(np.int64) << 8 | replies[:, 2 * word + 1]

    def _value(self, records: Bytes, field: Channel | Counter | TimeStamp) -> NDArray[Any]:
        """The field's raw numbers (n,), in the field's own type."""
        words = records[:, 2 * field.word : 2 * (field.word + words_of(field.type))]
        order = (field.word_order if isinstance(field, Channel) else None) or self._word_order
        if order == "little":
            words = words.reshape(len(words), words_of(field.type), 2)[:, ::-1].reshape(words.shape)
        return TYPES[field.type].decode_all(words)


def _clockwork(stream: PollStream | FifoStream, period_ns: float) -> Clockwork:
    fifo = isinstance(stream, FifoStream)
    return Clockwork(
        period_ns,
        stream.counter.modulus_bits if stream.counter else None,
        8 * TYPES[stream.time_stamp.type].size if stream.time_stamp else None,
        stream.time_stamp.unit_s * 1e9 if stream.time_stamp else 1.0,
        stream.record_capacity if isinstance(stream, FifoStream) else 1,
        counted=fifo,
    )


# The entry point ``modbus``.


class ModbusDriver:
    """Modbus TCP and RTU."""

    profile_model = ModbusProfile
    bus_model = ModbusBus
    packages = ("pymodbus",)

    def device(self, bundle: Bundle, bus: Any) -> Device:
        if not isinstance(bus, ModbusBus):
            raise TypeError(f"expected a ModbusBus, not {type(bus).__name__}")
        from triaxcal_drivers.modbus.device import ModbusDevice  # pymodbus, which no recording needs

        return ModbusDevice(_profile(bundle), bus)

    def loads(self, bundle: Bundle, bus: Any) -> Mapping[str, LineLoad]:
        """Load of each stream. None over TCP and on a pseudo-terminal, whose speed no
        baud rate tells."""
        where = bus.where
        if not isinstance(where, SerialLine) or (port := canonical_port(where.port)).startswith("/dev/pts/"):
            return {}
        profile = _profile(bundle)
        return {
            name: LineLoad(port, where.settings, s.reads_per_s(profile.sampling.rate_hz), where.read_s(s.words))
            for name, s in profile.streams.items()
        }

    def decoder(self, bundle: Bundle, stream: str) -> Decoder:
        profile = _profile(bundle)
        if stream not in profile.streams:
            raise ProfileError(f"profile {profile.name}: no stream named '{stream}'{nearest(stream, profile.streams)}")
        return ModbusDecoder(profile, stream)


def _profile(bundle: Bundle) -> ModbusProfile:
    if not isinstance(bundle.profile, ModbusProfile):
        raise ProfileError(f"profile {bundle.profile.name} is for the driver '{bundle.profile.driver}', not 'modbus'")
    return bundle.profile
