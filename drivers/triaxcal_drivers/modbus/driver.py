"""The entry point ``modbus``, and from replies of a Modbus device to samples: raw
batches in, samples out. No I/O."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triaxcal_drivers.claim import canonical_port
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.hints import nearest
from triaxcal_drivers.interface import Decoder, Device, LineLoad, RawBatch, RawFlag, SampleBlock
from triaxcal_drivers.modbus.model import (
    Condition,
    FifoStream,
    ModbusBus,
    ModbusProfile,
    Order,
    Part,
    PollStream,
    Read,
    latest_s_of,
    words_of,
)
from triaxcal_drivers.modbus.protocol import SerialLine
from triaxcal_drivers.profile import READING_CHANNELS, Bundle
from triaxcal_drivers.registers import TYPES
from triaxcal_drivers.timeline import Arrivals, Clockwork, Placed, Timeline
from triaxcal_drivers.two_senders import Senders, by_counter, by_levels

# Replies of a Modbus device as samples.

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]

_NEVER_NS = -(2**62)
"""Time of a value that has not come: so long before any sample that it is too old."""


@dataclass(frozen=True)
class _Replies:
    """Replies to the requests for samples, in order: number of the request, whether it
    failed, host time, failures and gaps before it, and bytes (n, longest).

    ``latest`` are the newest values of each other request before it (n, bytes), and
    ``latest_ns`` (n, requests) their times.
    """

    part: Ints
    failed: NDArray[np.bool_]
    host_ns: Ints
    errors: Ints
    gaps: Ints
    data: Bytes
    latest: tuple[Bytes, ...]
    latest_ns: Ints

    def __len__(self) -> int:
        return len(self.part)

    def __getitem__(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> _Replies:
        return _Replies(
            self.part[rows],
            self.failed[rows],
            self.host_ns[rows],
            self.errors[rows],
            self.gaps[rows],
            self.data[rows],
            tuple(values[rows] for values in self.latest),
            self.latest_ns[rows],
        )

    def followed_by(self, other: _Replies) -> _Replies:
        if not len(self):
            return other
        return _Replies(
            np.concatenate([self.part, other.part]),
            np.concatenate([self.failed, other.failed]),
            np.concatenate([self.host_ns, other.host_ns]),
            np.concatenate([self.errors, other.errors]),
            np.concatenate([self.gaps, other.gaps]),
            np.concatenate([self.data, other.data]),
            tuple(np.concatenate(both) for both in zip(self.latest, other.latest, strict=True)),
            np.concatenate([self.latest_ns, other.latest_ns]),
        )


class ModbusDecoder:
    """Decodes one stream. A failed request (exception, silence, malformed
    reply) counts as an error.

    **Several requests.** A sample is made of the replies to one cycle, from the first
    request to the last; one whose reply was damaged may be repeated at once. A
    cycle that lacks a reply, has a gap in it, or takes longer than the time-outs of
    its requests, counts as one ``incomplete`` sample; what came of it is in no
    other. The host's time of a sample is midway between its first and last reply.

    **Values that last** (``latest_s``) are the newest ones before the first
    request of the sample. Where one has not come, or is too old, the sample
    counts as ``incomplete``. One that is not ``valid`` counts as ``invalid``.
    """

    def __init__(self, profile: ModbusProfile, stream: str) -> None:
        self._stream = profile.streams[stream]
        self._word_order: Order = profile.word_order
        self._swap_bytes = profile.byte_order == "little"
        self._period_ns = 1e9 / profile.sampling.rate_hz
        reads = profile.reads(stream)
        self._parts, self._lasting = reads.of_sample, reads.lasting
        timeout_ns = profile.sampling.reply_timeout_s * 1e9
        self._spread_ns = round((len(self._parts) - 1) * timeout_ns)
        self._at_once_ns = round(0.5 * timeout_ns)
        """A damaged reply is noticed before its time-out is over."""
        self._open: _Replies | None = None
        """Of the latest cycle, if it may go on."""
        self._latest = [(_NEVER_NS, np.zeros(2 * read.words, np.uint8)) for read in self._lasting]
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
        replies, total = self._replies(batch)
        cycles, records, incomplete = self._cycles(replies)
        first, last = cycles
        host_ns = first.host_ns + (last.host_ns - first.host_ns) // 2
        fresh = self._fresh(first, host_ns)
        each = _Arrived(host_ns, np.zeros(len(records), np.int64), last.errors, last.gaps, fresh)
        if isinstance(self._stream, FifoStream):
            records, each, broken = self._divided(self._stream, records, each)
            total += broken
        block = self._samples(records, first.latest, each)
        self._errors += total
        return replace(block, errors=total, incomplete=block.incomplete + incomplete)

    def _divided(self, stream: FifoStream, windows: Bytes, each: _Arrived) -> tuple[Bytes, _Arrived, int]:
        """The records in the windows of a FIFO, and the number of windows with a count
        beyond the window, which is an error."""
        broken = self._number(windows, stream.header.count) > stream.record_capacity
        whole = ~broken
        errors, gaps = (each.errors + np.cumsum(broken))[whole], each.gaps[whole]
        records, host_ns, skipped, of = self._records(stream, windows[whole], each.host_ns[whole])
        fresh = np.ones(len(records), dtype=bool)
        return records, _Arrived(host_ns, skipped, errors[of], gaps[of], fresh), int(broken.sum())

    def _replies(self, batch: RawBatch) -> tuple[_Replies, int]:
        """The replies to this stream's requests for samples, and the number of its
        requests that failed."""
        # Find each request's replies.
        failed = (batch.flags & (RawFlag.ERROR | RawFlag.INVALID)) != 0
        part, own = np.full(len(batch), -1), np.zeros(len(batch), dtype=bool)
        for number, read in enumerate(self._parts):
            mine = batch.source == read.source
            part[mine] = number
            failed |= mine & (batch.length != 2 * read.words)
        for read in self._lasting:
            own |= batch.source == read.source
        own |= part >= 0
        # Count the failures and gaps before each reply.
        errors = self._errors + np.cumsum(own & failed)
        gaps = self._gaps + np.cumsum((batch.flags & RawFlag.LOST_BEFORE) != 0)
        self._gaps = int(gaps[-1]) if len(gaps) else self._gaps
        # Take the bytes.
        octets = np.frombuffer(batch.payload, dtype=np.uint8)
        starts = np.cumsum(batch.length, dtype=np.int64) - batch.length

        def bytes_of(rows: NDArray[np.intp], read: Read) -> Bytes:
            data = octets[starts[rows, None] + np.arange(2 * read.words)]
            if self._swap_bytes:
                data = data.reshape(len(rows), read.words, 2)[:, :, ::-1].reshape(data.shape)
            return np.asarray(data)

        rows = np.flatnonzero(part >= 0)
        data = np.zeros((len(rows), 2 * max(read.words for read in self._parts)), np.uint8)
        for number, read in enumerate(self._parts):
            whole = np.flatnonzero((part[rows] == number) & ~failed[rows])
            data[whole, : 2 * read.words] = bytes_of(rows[whole], read)
        # Find the newest lasting values before each.
        latest, latest_ns = [], np.zeros((len(rows), len(self._lasting)), np.int64)
        for i, read in enumerate(self._lasting):
            # Another stream may ask for a longer or shorter part of the same registers.
            came = np.flatnonzero((batch.source == read.source) & ~failed & (batch.length == 2 * read.words))
            time_ns = np.append(self._latest[i][0], batch.time_ns[came])
            values = np.concatenate([self._latest[i][1][None], bytes_of(came, read)])
            before = np.searchsorted(came, rows)
            latest.append(values[before])
            latest_ns[:, i] = time_ns[before]
            self._latest[i] = int(time_ns[-1]), values[-1]
        replies = _Replies(
            part[rows], failed[rows], batch.time_ns[rows], errors[rows], gaps[rows], data, tuple(latest), latest_ns
        )
        return replies, int((own & failed).sum())

    def _cycles(self, replies: _Replies) -> tuple[tuple[_Replies, _Replies], Bytes, int]:
        """The first and the last reply of each whole cycle, the bytes of all its
        replies (n, bytes), and the number of cycles that are not whole."""
        if len(self._parts) == 1:  # each good reply is a whole cycle
            whole = replies[~replies.failed] if replies.failed.any() else replies
            return (whole, whole), whole.data, 0
        held = replies if self._open is None else self._open.followed_by(replies)
        self._open = None
        good = ~held.failed
        begins, late = self._begins(held)
        cycle = np.cumsum(begins) - 1
        # Those with a good reply to each request are whole, if they came in time.
        came = np.bincount(cycle[good], minlength=cycle.max(initial=-1) + 1)
        rows = np.flatnonzero(good & (came[cycle] == len(self._parts)))
        of = rows.reshape(-1, len(self._parts))
        in_time = held.host_ns[of[:, -1]] - held.host_ns[of[:, 0]] <= self._spread_ns
        of = of[in_time & ~np.isin(cycle[of[:, 0]], cycle[late])]
        # Count the others of which something came; the last one may go on.
        lost = came > 0
        lost[cycle[of[:, 0]]] = False
        if len(held) and 0 < came[-1] < len(self._parts):
            lost[-1] = False
            self._open = held[cycle == cycle[-1]]
        data = [held.data[of[:, i], : 2 * read.words] for i, read in enumerate(self._parts)]
        return (held[of[:, 0]], held[of[:, -1]]), np.concatenate(data, axis=1), int(lost.sum())

    def _begins(self, held: _Replies) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        """Which replies begin a cycle, and which of the others come too late for it.

        Those go on with the one before: they are to a later request of the cycle, or to
        the same one, repeated after a failure. After a time-out that is too late.
        """
        begins, late = np.ones(len(held), dtype=bool), np.zeros(len(held), dtype=bool)
        step, failed = np.diff(held.part), held.failed
        again = (step == 0) & failed[:-1] & ~failed[1:]
        begins[1:] = ~(again | (step > 0)) | (held.part[1:] == 0) | (np.diff(held.gaps) > 0)
        waited_ns = np.diff(held.host_ns, prepend=held.host_ns[:1])
        late[1:] = again & ~begins[1:] & (waited_ns[:-1] > self._at_once_ns)
        return begins, late

    def _fresh(self, first: _Replies, host_ns: Ints) -> NDArray[np.bool_]:
        """Whether the lasting values of each sample are new enough for it."""
        if not self._lasting:
            return np.ones(len(host_ns), dtype=bool)
        most_ns = np.array([round((read.latest_s or 0.0) * 1e9) for read in self._lasting], np.int64)
        return np.asarray((host_ns[:, None] - first.latest_ns <= most_ns).all(axis=1))

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

    def _samples(self, records: Bytes, latest: Sequence[Bytes], a: _Arrived) -> SampleBlock:
        stream = self._stream
        # Failures and gaps since the previous record.
        broken = np.diff(a.errors, prepend=self._errors_at_last) > 0
        after_gap = np.diff(a.gaps, prepend=self._gaps_at_last) > 0
        if len(a.errors):
            self._errors_at_last, self._gaps_at_last = int(a.errors[-1]), int(a.gaps[-1])
        # Place the records in time by their counters and time stamps.
        counter = (
            self._value(records, latest, stream.counter).astype(np.int64) & (1 << stream.counter.modulus_bits) - 1
            if stream.counter
            else None
        )
        stamp = self._value(records, latest, stream.time_stamp).astype(np.int64) if stream.time_stamp else None
        placed = self._timeline.place(Arrivals(counter, stamp, a.skipped, a.host_ns, broken, after_gap))
        # Choose new records that are complete and valid.
        kept, beside = records[placed.new], [values[placed.new] for values in latest]
        fresh = a.fresh[placed.new]
        valid = np.ones(len(kept), dtype=bool)
        for condition in stream.valid:
            valid &= self._holds(condition, kept, beside)
        # Decode their channels.
        with np.errstate(over="ignore", invalid="ignore"):  # a scale may be any
            values = {
                name: self._value(kept, beside, channel).astype(np.float64) * channel.scale + channel.offset
                for name, channel in stream.channels.items()
            }
        block = SampleBlock(
            placed.time_ns,
            placed.counter,
            np.stack([values.pop(name) for name in READING_CHANNELS], axis=1),
            values,
            missing=placed.missing,
            # Polls read the newest sample more often than it changes. A FIFO yields
            # each record once.
            duplicates=len(records) - len(kept) if isinstance(stream, FifoStream) else 0,
            incomplete=int((~fresh).sum()),
            invalid=int((fresh & ~valid).sum()),
            restarts=placed.restarts,
            two_senders=self._two_senders(records, stamp if counter is None else counter, a.host_ns, placed),
            arrival_ns=a.host_ns[placed.new],
        )
        counts = fresh & valid
        return block if counts.all() else block.only(counts)

    @staticmethod
    def _number(replies: Bytes, word: int) -> NDArray[np.int64]:
        return replies[:, 2 * word].astype(np.int64) << 8 | replies[:, 2 * word + 1]

    def _holds(self, condition: Condition, records: Bytes, latest: Sequence[Bytes]) -> NDArray[np.bool_]:
        held = self._value(records, latest, condition).astype(np.int64)
        return np.isin(held if condition.mask is None else held & condition.mask, condition.values)

    def _value(self, records: Bytes, latest: Sequence[Bytes], field: Part) -> NDArray[Any]:
        """The field's raw numbers (n,), in the field's own type."""
        number, start = self._place(field)
        words = (records if number is None else latest[number])[:, start : start + 2 * words_of(field.type)]
        order = getattr(field, "word_order", None) or self._word_order
        if order == "little":
            words = words.reshape(len(words), words_of(field.type), 2)[:, ::-1].reshape(words.shape)
        return TYPES[field.type].decode_all(words)

    def _place(self, field: Part) -> tuple[int | None, int]:
        """Where a field's first byte is: in the records, or in the lasting values of
        the request of that number."""
        if isinstance(self._stream, FifoStream):
            assert field.word is not None
            return None, 2 * field.word
        function, address = self._stream.place(field)
        latest_s = latest_s_of(field)
        end = address + words_of(field.type)
        at = 0
        for number, read in enumerate(self._parts if latest_s is None else self._lasting):
            same = (read.function, read.latest_s) == (function, latest_s)
            if same and read.address <= address and end <= read.address + read.words:
                inside = 2 * (address - read.address)
                return (None, at + inside) if latest_s is None else (number, inside)
            at += 2 * read.words
        raise AssertionError(f"no request for {field}")  # each is made of its fields


@dataclass(frozen=True)
class _Arrived:
    """Of each record: time by the host's clock [ns], samples lost before it, failures
    and gaps before it, and whether its lasting values are new enough."""

    host_ns: Ints
    skipped: Ints
    errors: Ints
    gaps: Ints
    fresh: NDArray[np.bool_]


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
        return {name: self._load(profile, name, port, where) for name in profile.streams}

    @staticmethod
    def _load(profile: ModbusProfile, name: str, port: str, where: SerialLine) -> LineLoad:
        """A read is all of a sample, with its share of the lasting values."""
        per_s, reads = profile.streams[name].reads_per_s(profile.sampling.rate_hz), profile.reads(name)
        read_s = sum(where.read_s(read.words) for read in reads.of_sample)
        read_s += sum(where.read_s(read.words) * min(1.0, 1 / (read.renewed_s * per_s)) for read in reads.lasting)
        return LineLoad(port, where.settings, per_s, read_s)

    def decoder(self, bundle: Bundle, stream: str) -> Decoder:
        profile = _profile(bundle)
        if stream not in profile.streams:
            raise ProfileError(f"profile {profile.name}: no stream named '{stream}'{nearest(stream, profile.streams)}")
        return ModbusDecoder(profile, stream)


def _profile(bundle: Bundle) -> ModbusProfile:
    if not isinstance(bundle.profile, ModbusProfile):
        raise ProfileError(f"profile {bundle.profile.name} is for the driver '{bundle.profile.driver}', not 'modbus'")
    return bundle.profile
