"""The account of a unit: every sample that it has sent is in its recording, or told of there as lost.

Samples are found in the recording twice: as the bytes that came off the bus, which says where each of them stands among
the marks of losses, and by the decoder, which says how many it counts as missing between two of them. A run of samples
that are not there, a hole, is told of by what stands between its two neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triaxcal_drivers.interface import RawBatch, RawFlag
from triaxcal_drivers.profile import CORRECTED, READINGS, Bundle
from triaxcald.decoded import DecodedStream
from triaxcald.inputs import bundle_of
from triaxcald.recording import schema
from triaxcald.recording.manifest import load_manifest
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import decode_raw

STREAMS = (READINGS, CORRECTED)
UNSAVED_S = 2.5
"""A kill takes what is not written yet: a second of records, and what is on its way from the bus."""
UNREAD_S = 2.5
"""Before a stop that was asked for: what is on its way from the bus, or waits in a unit until it is asked again."""
COUNT_V, COUNT_G = 10.0 / 2**23, 1e-6
"""What a count of the converter is, and one of the corrected output."""
WAYS = ("gaps", "count", "failed requests", "times", "recorder away")
"""By which a hole is told of: a gap's mark before the next record, the unit's own count, requests that brought nothing,
times that leave room for what is not there, a gap's mark where another process of the recorder goes on."""
RATE_OFF, ROOM = 0.1, 3
"""Times leave room where they are apart by so many periods as samples are missing, but for a tenth and for three: a
unit's clock is not the host's, and neither says when a restart was to the sample."""


@dataclass
class Replayed:
    """A unit's recording, all segments of it. Positions are running numbers of raw records: a mark at p + 0.5 stands
    between the records p and p + 1."""

    bundle: Bundle
    streams: dict[str, DecodedStream]
    decoded: dict[
        str, dict[bytes, tuple[int, int]]
    ]  # by its three numbers, the decoder's count and time of each sample
    places: dict[str, dict[bytes, int]]  # and after how many raw records it is whole
    lost_before: NDArray[np.float64]
    failed: NDArray[np.float64]
    interrupted: NDArray[np.float64]
    begun: NDArray[np.float64]  # where a process of the recorder begins
    events: list[tuple[str, Any]]
    left: dict[str, int]  # samples that a unit says are left in its FIFO, after the last reply
    twice: int
    unsaved: int  # raw records that did not get to the disk in time, as the file tells

    @property
    def gaps(self) -> int:
        return sum(kind == "gap" for kind, _ in self.events)


def replayed(manifest: Path, node: int | None) -> Replayed:
    """``node`` of a unit on CAN, None of one on Modbus. Raises RecordingError."""
    known = load_manifest(manifest)
    events: list[tuple[str, Any]] = []
    interrupted, begun, batches = list[float](), list[float](), list[RawBatch]()
    records = unsaved = 0
    bundle = None
    was_closed = True  # before the first segment nothing was cut short
    for segment in known.segments:
        with Recording.open(known.path_of(segment), unfinished=segment.state != "closed") as recording:
            bundle = bundle or bundle_of(recording)
            if not was_closed:
                begun.append(records - 0.25)
            was_closed = segment.state == "closed"
            for topic, message in recording.messages():
                if topic == schema.RAW:
                    batches.append(decode_raw(message.data)[2])
                    records += len(batches[-1])
                elif topic == schema.EVENTS:
                    event = schema.decode_event(message.data)
                    events.append((event.kind, event.detail))
                    if event.kind == "interrupted":
                        interrupted.append(records - 0.5)
                elif topic == schema.LOSS:
                    loss = schema.decode_loss(message.data)
                    unsaved += loss.records if loss.where == schema.RAW else 0
    assert bundle is not None
    flags = np.concatenate([b.flags for b in batches]) if batches else np.zeros(0, np.uint8)
    streams = {name: DecodedStream(bundle, name) for name in STREAMS}
    decoded, twice = dict[str, dict[bytes, tuple[int, int]]](), 0
    for name, stream in streams.items():
        decoded[name], again = _decoded(stream, batches, COUNT_V if name == READINGS else COUNT_G)
        twice += again
    if node is not None:
        places, left = {name: _on_can(batches, node, i) for i, name in enumerate(STREAMS)}, dict.fromkeys(STREAMS, 0)
    else:
        windows = {name: _on_modbus(batches, bundle, name) for name in STREAMS}
        places, left = {n: found for n, (found, _) in windows.items()}, {n: rest for n, (_, rest) in windows.items()}
    return Replayed(
        bundle, streams, decoded, places,
        np.flatnonzero(flags & RawFlag.LOST_BEFORE).astype(np.float64) - 0.5,
        np.flatnonzero(flags & (RawFlag.ERROR | RawFlag.INVALID)).astype(np.float64),
        np.array(interrupted), np.array(begun), events, left, twice, unsaved,
    )  # fmt: skip


def _decoded(
    stream: DecodedStream, batches: Sequence[RawBatch], count: float
) -> tuple[dict[bytes, tuple[int, int]], int]:
    """And how many came twice."""
    found: dict[bytes, tuple[int, int]] = {}
    samples = 0
    for batch in batches:
        block = stream.feed(batch)
        numbers = np.rint(block.readings / count).astype("<i4")
        samples += len(block)
        places = zip(block.counter.tolist(), block.time_ns.tolist(), strict=True)
        found.update(zip(map(bytes, numbers), places, strict=True))
    return found, samples - len(found)


def _on_can(batches: Sequence[RawBatch], node: int, stream: int) -> dict[bytes, int]:
    """TPDO1 and TPDO2 are the readings: x, y, counter; z, temperature, counter, status. 3 and 4 are the corrected
    output likewise."""
    first, second = (0x180 + 0x200 * stream + node, 0x280 + 0x200 * stream + node)
    waiting: dict[bytes, bytes] = {}
    found: dict[bytes, int] = {}
    record = 0
    for batch in batches:
        at = 0
        for source, length in zip(batch.source.tolist(), batch.length.tolist(), strict=True):
            data = batch.payload[at : at + length]
            if source == first and length == 8:
                waiting[data[6:8]] = data
            elif source == second and length == 8 and (xy := waiting.pop(data[5:7], None)) is not None:
                found[_wide(xy[0:3]) + _wide(xy[3:6]) + _wide(data[0:3])] = record
            at += length
            record += 1
    return found


def _wide(number: bytes) -> bytes:
    """24 bits as 32, least significant byte first."""
    return number + (b"\xff" if number[2] & 0x80 else b"\0")


def _on_modbus(batches: Sequence[RawBatch], bundle: Bundle, name: str) -> tuple[dict[bytes, int], int]:
    """A window of the FIFO: how many records, how many are left, how many were lost, and the records: counter, time
    stamp, x, y, z of 32 bits, temperature. And how many the last one says are left."""
    stream = bundle.profile.streams[name]
    asked = 4 << 16 | stream.address
    found: dict[bytes, int] = {}
    record = left = 0
    for batch in batches:
        at = 0
        for source, flags, length in zip(
            batch.source.tolist(), batch.flags.tolist(), batch.length.tolist(), strict=True
        ):
            data = batch.payload[at : at + length]
            if source == asked and not flags & (RawFlag.ERROR | RawFlag.INVALID) and length == 2 * stream.words:
                for i in range(min(int.from_bytes(data[:2]), 12)):
                    xyz = data[6 + 20 * i + 6 : 6 + 20 * i + 18]
                    found.setdefault(b"".join(xyz[k : k + 4][::-1] for k in (0, 4, 8)), record)
                left = int.from_bytes(data[2:4])
            at += length
            record += 1
    return found, left


@dataclass
class Account:
    """Of one stream of one unit, in samples.

    ``before`` was sent before the recording began, ``after`` when it was about to end. ``lost`` are told of, by `WAYS`;
    ``silent`` are not, and ``remarks`` say where. ``miscounted``: by how many the decoder's count is off, of holes that
    neither restart nor absence explains. ``foreign`` samples the unit has never sent; ``astray`` came from the decoder,
    and are not among the bytes.
    """

    sent: int = 0
    recorded: int = 0
    before: int = 0
    after: int = 0
    lost: dict[str, int] = field(default_factory=lambda: dict.fromkeys(WAYS, 0))
    silent: int = 0
    miscounted: int = 0
    foreign: int = 0
    astray: int = 0
    remarks: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class _Hole:
    """The samples between those of the numbers ``left`` and ``right``, as the unit sent them."""

    left: int
    right: int

    @property
    def size(self) -> int:
        return self.right - self.left - 1


@dataclass(frozen=True)
class _Told:
    """By the decoder, of a hole: how many samples are missing, and how many periods its two neighbours are apart."""

    counted: int
    periods: float

    def leaves_room(self, samples: int) -> bool:
        return self.periods >= (1 - RATE_OFF) * samples - ROOM


def account(
    sent: NDArray[np.void], stream: str, recording: Replayed, killed_ns: Sequence[int], stopped_ns: int
) -> Account:
    """``sent`` in order, as `benchmarks.soak.units` writes it; ``killed_ns`` and ``stopped_ns`` are when the recorder
    was killed, and when it was asked to stop."""
    keys = [bytes(key) for key in sent[stream].astype("<i4")]
    decoded, places = recording.decoded[stream], recording.places[stream]
    rate_hz = recording.bundle.profile.sampling.rate_hz
    made = Account(sent=len(keys), foreign=len(decoded.keys() - set(keys)), astray=len(decoded.keys() - places.keys()))
    there = [i for i, key in enumerate(keys) if key in decoded]
    made.recorded = len(there)
    if not there:
        made.silent = len(keys)
        made.remarks.append(f"{stream}: nothing of {len(keys)} samples is in the recording")
        return made
    made.before = there[0]
    end = sent[there[-1] + 1 + recording.left[stream] :]
    _judge_end(made, end["time_ns"], len(keys) - there[-1] - 1, places.get(keys[there[-1]], -1), recording, stopped_ns)
    for left, right in pairwise(there):
        hole = _Hole(left, right)
        (before, before_ns), (after, after_ns) = decoded[keys[left]], decoded[keys[right]]
        if hole.size or after - before != 1:
            at = (places.get(keys[left], -1), places.get(keys[right], -1))
            told = _Told(after - before - 1, (after_ns - before_ns) * rate_hz / 1e9)
            _judge(made, hole, told, at, sent, stream, recording, killed_ns)
    return made


def _judge(
    made: Account, hole: _Hole, told: _Told, at: tuple[int, int], sent: NDArray[np.void], stream: str,
    recording: Replayed, killed_ns: Sequence[int],
) -> None:  # fmt: skip
    def between(marks: NDArray[np.float64], first: float = at[0], last: float = at[1]) -> bool:
        return bool(((marks > first) & (marks < last)).any())

    begun = recording.begun[(recording.begun > at[0]) & (recording.begun < at[1])]
    gap, failed = between(recording.lost_before), between(recording.failed)
    restarted = sent["start_s"][hole.left] != sent["start_s"][hole.right]
    if not restarted and not gap and not len(begun):
        made.miscounted += abs(told.counted - hole.size)
    if not hole.size:
        return
    silent = 0
    if len(begun) and gap:
        way = "recorder away"
        silent = _kept_too_short(hole, at[0], float(begun[0]), sent, recording, killed_ns)
    elif gap:
        way = "gaps"
    elif told.counted >= hole.size:
        way = "count"
    elif failed:
        way = "failed requests"
    elif told.leaves_room(hole.size):
        way = "times"
    else:
        way, silent = "count", hole.size - max(told.counted, 0)
    made.lost[way] += hole.size - silent
    made.silent += silent
    if silent:
        before, after = sent[hole.left], sent[hole.right]
        made.remarks.append(
            f"{stream}: {silent} of {hole.size} after count {before['counter']}, before {after['counter']}, "
            f"{before['time_ns'] / 1e9:.3f} s to {after['time_ns'] / 1e9:.3f} s; the decoder counts {told.counted} in "
            f"{told.periods:.1f} periods; restarted {bool(restarted)}, recorder {'killed' if len(begun) else 'at work'}"
        )


def _kept_too_short(
    hole: _Hole, first: float, begun: float, sent: NDArray[np.void], recording: Replayed, killed_ns: Sequence[int]
) -> int:
    """How many that were sent long before a kill are not there, and nothing tells of them."""
    marks = (recording.lost_before, recording.failed, recording.interrupted)
    if any(((m > first) & (m < begun - 0.2)).any() for m in marks):  # not the mark behind the beginning
        return 0
    times = sent["time_ns"][hole.left + 1 : hole.right]
    killed = [t for t in killed_ns if t > int(sent["time_ns"][hole.left])]
    return int((times < min(killed) - UNSAVED_S * 1e9).sum()) if killed else 0


def _judge_end(
    made: Account, times_ns: NDArray[np.int64], after: int, at: int, recording: Replayed, stopped_ns: int
) -> None:
    """``times_ns`` of the samples after the last one that is there, without those left in the unit, which ``after``
    counts too."""
    due = int((times_ns < stopped_ns - UNREAD_S * 1e9).sum())
    made.after = after - due
    if not due:
        return
    if (recording.interrupted > at).any() or (recording.lost_before > at).any():
        made.lost["gaps"] += due
    elif (recording.failed > at).any():
        made.lost["failed requests"] += due
    else:
        made.silent += due
        made.remarks.append(f"the last {due} samples before the end are not in the recording")


def manifest_faults(manifest: Path) -> list[str]:
    """What does not agree in a recording: files, their digests, their order, and the event that says why it ended.
    Raises RecordingError where a segment cannot be read."""
    known = load_manifest(manifest)
    faults = []
    for before, after in pairwise(known.segments):
        if after.first != before.end:
            faults.append(f"{after.file} begins at record {after.first}, the one before ends at {before.end}")
    for segment in known.segments:
        path = known.path_of(segment)
        with Recording.open(path, unfinished=segment.state != "closed") as recording:
            digest = recording.raw_digest()
            told = recording.metadata.get(schema.RAW_RECORD, {})
            if digest.hexdigest() != segment.raw_sha256 or digest.records != segment.records:
                faults.append(f"{segment.file} has not the records that the manifest names")
            if segment.state == "closed" and told.get("sha256") != digest.hexdigest():
                faults.append(f"{segment.file} has not the records that it names itself")
    strange = {p.name for p in manifest.parent.glob(f"{manifest.name.split('.')[0]}-*.mcap")}
    strange -= {s.file for s in known.segments}
    faults += [f"{name} is in no manifest" for name in sorted(strange)]
    if known.segments and known.segments[-1].state != "closed":
        faults.append(f"{known.segments[-1].file} is {known.segments[-1].state}, and the recorder was stopped in order")
    return faults
