"""Rebuilds the manifest of a recording in segments from the files beside it.

A manifest that cannot be used prevents no recording. It is renamed, never deleted,
and a new one lists the segments on the disk.
"""

from __future__ import annotations

import os
import re
import stat
from collections import Counter
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Message
from mcap.records import Metadata as MetadataRecord

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import RecordingError
from triaxcald.files import unused
from triaxcald.recording import schema
from triaxcald.recording.manifest import Manifest, Segment, State, numbered_files, parsed_manifest
from triaxcald.recording.mcap_records import (
    MAGIC,
    Summary,
    check_magic,
    chunk_data,
    chunk_records,
    parse,
    size_of,
    summary_of,
    unparsed_at,
    written_to,
)
from triaxcald.recording.reader import Recording, digest_of
from triaxcald.recording.schema import decode_raw

_KEPT = ".replaced"
_DIGITS = re.compile(r"[0-9]{1,18}")
_SHA256 = re.compile(r"[0-9a-f]{64}")

Place = Mapping[str, str]
"""A segment's metadata about its place: its number, the running index of its first
record, and the name and digest of the previous segment."""


class Opened(NamedTuple):
    """A manifest that a recording can continue. ``warning`` tells the fault of the
    manifest on the disk, ``kept`` is the new name of that file."""

    manifest: Manifest
    warning: str | None = None
    kept: str | None = None


def open_manifest(path: Path) -> Opened:
    """The manifest at ``path``. It is rebuilt from the segments if it is missing,
    cannot be used, or does not list the files on the disk. The only change on the
    disk is the new name of a replaced manifest. Raises OSError."""
    # No manifest: rebuild it without reading whole segments.
    if not os.path.lexists(path):
        rebuilt = _from_files(path, reading=False)
        return Opened(rebuilt, f"{path}: was missing; {_rebuilt_from(rebuilt)}" if rebuilt.segments else None)
    # A manifest that can be read is compared with the files, another one is rebuilt.
    try:
        found = parsed_manifest(path)
    except RecordingError as e:
        rebuilt, wrong = _from_files(path), str(e)
    else:
        rebuilt, wrong = _reconciled(found)
        if not wrong:
            return Opened(found)
        wrong = f"{path}: {wrong}"
    # Keep the old manifest under a new name.
    renamed = unused(path.with_name(path.name + _KEPT))
    path.rename(renamed)
    return Opened(rebuilt, f"{wrong}; it is kept as {renamed.name}; {_rebuilt_from(rebuilt)}", renamed.name)


def _rebuilt_from(rebuilt: Manifest) -> str:
    return f"the manifest was rebuilt from {tc.number_format.number_of(len(rebuilt.segments), 'segment')}"


def with_last_on_disk(manifest: Manifest) -> Manifest:
    """The manifest with its last segment as it is on the disk, if that segment was not
    closed. Its state never prevents a recording. Raises OSError."""
    if not manifest.segments or manifest.segments[-1].state != "open":
        return manifest
    last = manifest.segments[-1]
    path = manifest.path_of(last)
    # A segment without any record is dropped.
    if not os.path.lexists(path) or _nothing_reached(path):
        with suppress(FileNotFoundError):
            path.unlink()
        return replace(manifest, segments=manifest.segments[:-1])
    found = _with_digest(path, _on_disk(path, last))
    # The process may have been killed after the file recorded unconfirmed records and
    # before the manifest did.
    return replace(manifest, segments=_with_unconfirmed(manifest.with_last(found).segments))


def _with_unconfirmed(segments: tuple[Segment, ...]) -> tuple[Segment, ...]:
    """Marks unconfirmed records in earlier segments. A file records the running index
    from which on records are unconfirmed up to its end; that index may lie in an
    earlier segment."""
    found = list(segments)
    for at, segment in enumerate(segments):
        if (first := segment.unconfirmed) is None:
            continue
        for i, earlier in enumerate(found[: at + 1]):
            if earlier.end > first:
                starts = [max(n, earlier.first) for n in (first, earlier.unconfirmed) if n is not None]
                found[i] = replace(earlier, unconfirmed=min(starts))
    return tuple(found)


# Files that belong to the recording.


def _from_files(path: Path, *, reading: bool = True) -> Manifest:
    """The manifest of all segments beside ``path``. ``deleted`` counts the missing
    numbers before the last. An unreadable folder counts as empty unless ``reading``.
    Raises OSError."""
    try:
        found = _inspected(path, numbered_files(path))
    except PermissionError:
        if reading:
            raise
        found = []
    missing = found[-1].number - len(found) if found else 0
    return Manifest(path, _with_unconfirmed(tuple(found)), {"unknown": missing} if missing > 0 else {})


def _reconciled(manifest: Manifest) -> tuple[Manifest, str]:
    """The manifest of the files on the disk, and the differences in words; empty if
    there are none. The last segment may be missing if it is open, as the manifest
    lists it before it exists. Raises OSError."""
    try:
        there = numbered_files(manifest.path)
    except PermissionError:
        return manifest, ""
    # Listed segments that are missing.
    last = manifest.segments[-1:]
    missing = [s for s in manifest.segments if not os.path.lexists(manifest.path_of(s))]
    missing = [s for s in missing if s.state != "open" or (s,) != last]
    # Files that the manifest does not list.
    listed = {s.number for s in manifest.segments} | {
        number for number, name in there.items() if any(s.file == name for s in manifest.segments)
    }
    added = _inspected(manifest.path, {number: name for number, name in there.items() if number not in listed})
    # Segments that are listed as open though another one follows.
    left_open = [s for s in manifest.segments[: -1 if not added else None] if s.state == "open" and s not in missing]
    if not (missing or added or left_open):
        return manifest, ""
    # Drop the missing ones, inspect the open ones, and add the unlisted ones.
    kept = [s for s in manifest.segments if s not in missing]
    for segment in left_open:
        file = manifest.path_of(segment)
        kept[kept.index(segment)] = _with_digest(file, _on_disk(file, segment))
    merged = _with_unconfirmed(tuple(sorted([*kept, *added], key=lambda s: s.number)))
    # Name up to three files of each kind.
    wrong = [
        f"{what} {', '.join(s.file for s in some[:3])}{f' and {len(some) - 3} more' if len(some) > 3 else ''}"
        for what, some in (("lists missing", missing), ("does not list", added), ("lists as open", left_open))
        if some
    ]
    counts = Counter(manifest.deleted) + Counter({"missing": len(missing)})
    return replace(manifest, segments=merged, deleted=dict(counts)), "; ".join(wrong)


def _inspected(path: Path, names: Mapping[int, str]) -> list[Segment]:
    """The numbered files that are segments of the manifest ``path``, as they are on the
    disk, in order. Raises OSError."""
    found: list[tuple[Segment, Place]] = []
    for number, name in names.items():
        file = path.with_name(name)
        if not stat.S_ISREG(file.stat().st_mode if file.exists() else 0) or _nothing_reached(file):
            continue
        place = _place_in(file)
        if place is not None and place.get("number") != str(number):
            continue  # another recording has this name
        first = _number(place or {}, "first", found[-1][0].end if found else 0)
        found.append((_on_disk(file, Segment(name, number, first)), place or {}))
    return [_with_digest(path.with_name(s.file), replace(s, sha256=sha256)) for s, sha256 in _with_known_digests(found)]


def _with_known_digests(found: list[tuple[Segment, Place]]) -> list[tuple[Segment, str]]:
    """Each segment with its digest from when it was closed, which the next segment
    records, so that a later change is still found. Empty if there is none."""
    known = []
    for (segment, _), (_, after) in pairwise([*found, *([(found[-1][0], {})] if found else [])]):
        digest = after.get("previous_sha256", "") if after.get("previous") == segment.file else ""
        known.append((segment, digest if _SHA256.fullmatch(digest) else ""))
    return known


def _number(place: Place, key: str, default: int) -> int:
    return int(place[key]) if _DIGITS.fullmatch(place.get(key, "")) else default


# Contents of a file.


def _on_disk(path: Path, segment: Segment) -> Segment:
    """The segment as it is in its file, without the digest of the file. A finished file
    is described by its summary, another one by its records. Raises OSError."""
    try:
        found = _by_summary(path, segment) or _by_records(path, segment)
    except (RecordingError, ValueError):
        found = replace(segment, state="damaged", end=segment.first)
    status = path.stat()
    return replace(found, bytes=status.st_size, closed_ns=status.st_mtime_ns)


def _with_digest(path: Path, segment: Segment) -> Segment:
    if not segment.sha256:
        with suppress(RecordingError):
            return replace(segment, sha256=digest_of(path))
    return segment


def _nothing_reached(path: Path) -> bool:
    """Whether only the name of the file reached the disk, as after a power failure
    right after its creation."""
    try:
        with td.files.open_file(path) as stream:
            return written_to(stream, size_of(stream)) == 0
    except PermissionError:
        return False


def _by_records(path: Path, segment: Segment) -> Segment:
    """The segment by all records of its file. Raises RecordingError."""
    with Recording.open(path, unfinished=True) as recording:
        digest, span = schema.RawDigest(), list[int]()
        for phase, batch in recording.joined_batches():
            digest.update(phase, batch)
            if len(batch):
                span = [min([*span, int(batch.time_ns.min())]), max([*span, int(batch.time_ns.max())])]
        lost = sum(loss.records for loss in recording.losses() if loss.where == schema.RAW)
        state: State = "closed" if recording.finished else "cut_short"
        unconfirmed = schema.unconfirmed_from(recording.metadata)
    return replace(
        segment, state=state, end=segment.first + digest.records + lost, records=digest.records,
        start_ns=span[0] if span else None, end_ns=span[1] if span else None, raw_sha256=digest.hexdigest(),
        unconfirmed=unconfirmed,
    )  # fmt: skip


def _place_in(path: Path) -> Place | None:
    """The file's record of its place among the segments; empty if it has none, None if
    the file cannot be read."""
    with suppress(RecordingError, OSError), td.files.open_file(path) as stream:
        check_magic(stream, str(path))
        size, offset = size_of(stream), len(MAGIC)
        # The metadata come before the first chunk.
        while offset < size:
            unparsed = unparsed_at(stream, str(path), offset, size)
            if unparsed.opcode == Opcode.METADATA:
                record = parse(unparsed, str(path))
                assert isinstance(record, MetadataRecord)
                if record.name == schema.SEGMENT_RECORD:
                    return dict(record.metadata)
            if unparsed.opcode in (Opcode.CHUNK, Opcode.DATA_END):
                return {}
            offset = unparsed.end
    return None


def _by_summary(path: Path, segment: Segment) -> Segment | None:
    """The segment by the summary of its file and the chunks with its first and last raw
    records; reading a week of segments whole would take minutes. None if the whole
    file has to be read. Raises RecordingError."""
    try:
        with td.files.open_file(path) as stream:
            name, size = str(path), size_of(stream)
            summary = summary_of(stream, name, size)
            if summary is None or schema.RAW_RECORD not in summary.metadata or schema.UNCONFIRMED in summary.metadata:
                return None
            record = parse(unparsed_at(stream, name, summary.metadata[schema.RAW_RECORD], size), name)
            counts = {summary.channels.get(i): n for i, n in summary.statistics.channel_message_counts.items()}
            if not isinstance(record, MetadataRecord) or counts.get(schema.LOSS, 0):
                return None
            records, sha256 = _number(record.metadata, "records", -1), record.metadata.get("sha256", "")
            span = _span_ns(stream, name, size, summary)
    except OSError as e:
        raise RecordingError(f"{path}: cannot be read: {e.strerror}") from e
    if records < 0 or not _SHA256.fullmatch(sha256) or (span is None) != (records == 0):
        return None
    return replace(
        segment, state="closed", end=segment.first + records, records=records,
        start_ns=span[0] if span else None, end_ns=span[1] if span else None, raw_sha256=sha256,
    )  # fmt: skip


def _span_ns(stream: BinaryIO, name: str, size: int, summary: Summary) -> tuple[int, int] | None:
    """Host times of the earliest and latest raw record [ns], by the first and the last
    chunk with raw records. Raises RecordingError."""
    raw = {i for i, topic in summary.channels.items() if topic == schema.RAW}
    chunks = [chunk for chunk in summary.chunks if raw & set(chunk.message_index_offsets)]
    times = list[int]()
    for offset in dict.fromkeys(chunk.chunk_start_offset for chunk in chunks[:1] + chunks[-1:]):
        for record in chunk_records(chunk_data(unparsed_at(stream, name, offset, size), name)):
            if isinstance(record, Message) and record.channel_id in raw:
                _, _, batch = decode_raw(record.data)
                times += batch.time_ns.tolist()
    return (min(times), max(times)) if times else None
