"""Writes a recording in segments, each of which can be read alone."""

from __future__ import annotations

import json
import os
import re
import threading
import time
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import numpy as np

import triaxcal_drivers as td
from triaxcald.errors import DiskError, RecordingError
from triaxcald.files import require_new
from triaxcald.recording import disk, schema
from triaxcald.recording.manifest import SEGMENT_BYTES as SEGMENT_BYTES
from triaxcald.recording.manifest import SEGMENT_S as SEGMENT_S
from triaxcald.recording.manifest import (
    Document,
    Manifest,
    Retention,
    Segment,
    Sign,
    Surplus,
    delete,
    manifest_path,
    surplus,
)
from triaxcald.recording.reader import digest_of
from triaxcald.recording.rebuild import open_manifest, with_last_on_disk
from triaxcald.recording.writer import Head, RecordingFile, RecordingWriter, ended_because

# Retention keeps a segment that an outcome or a certificate beside it names. An index
# of those documents tells which; each document is read once.

EVIDENCE = (".outcome.json", ".certificate.json")
"""Endings of the names of documents that may name a recording."""
EVIDENCE_MOST = 4 * 2**20  # bytes of one document, as for any document
SETTLED_NS = 2_000_000_000
"""Age [ns] from which an unchanged time stamp proves an unchanged file. A younger
file may change again within one tick of the file system's clock, so it is read
again."""
NAMES_MOST = 4096
"""Most names and digests that the index stores for one document; ours have a
dozen. A document with more is read each time."""
FILE_NAME_MOST = 255
DIGEST_DIGITS = 64  # of a SHA-256

_DIGEST = re.compile(r"[0-9a-f]{64}")
_SUFFIX = ".mcap"
_IS_HEX = np.isin(np.arange(256), np.frombuffer(b"0123456789abcdef", dtype=np.uint8))


class RetainedFiles(NamedTuple):
    """``kept`` are the files that stay. ``unread`` is a document or folder that
    cannot be read and may name any of them."""

    kept: frozenset[str]
    unread: str | None = None


class _Stamp(NamedTuple):
    """File status that changes with every change of the file."""

    device: int
    inode: int
    size: int
    modified_ns: int
    changed_ns: int

    @staticmethod
    def of(status: os.stat_result) -> _Stamp:
        return _Stamp(status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)

    @property
    def old_enough(self) -> bool:
        now_ns = time.time_ns()
        return all(abs(now_ns - at_ns) > SETTLED_NS for at_ns in (self.modified_ns, self.changed_ns))


class _Names(NamedTuple):
    """Names in one document: runs of hexadecimal digits as long as a digest, and the
    text before each `.mcap`, reversed for a search by prefix."""

    digests: frozenset[str]
    ends: frozenset[str]


@dataclass
class _CombinedNames:
    """The names in all indexed documents, arranged for searches."""

    digests: frozenset[str] = frozenset()
    long_runs: tuple[str, ...] = ()  # longer than a digest: one may contain it
    ends: tuple[str, ...] = ()  # sorted
    documents: tuple[str, ...] = ()  # names of all documents, sorted

    def names(self, segment: Segment) -> bool:
        # By file name: of the document itself, or in its text.
        if _begins_one(self.documents, f"{Path(segment.file).stem}.") or _begins_one(self.ends, segment.file[::-1]):
            return True
        # By digest: of the file, or of its raw records.
        digests = [digest for digest in (segment.sha256, segment.raw_sha256) if digest]
        return any(digest in self.digests or any(digest in run for run in self.long_runs) for digest in digests)


def _begins_one(ordered: tuple[str, ...], beginning: str) -> bool:
    """Whether one of the sorted texts begins so: the first that is not smaller is the
    only candidate."""
    at = bisect_left(ordered, beginning)
    return at < len(ordered) and ordered[at].startswith(beginning)


@dataclass(eq=False)
class EvidenceIndex:
    """Index of the documents in one folder. Each call reads only new and changed
    documents. Any thread may call."""

    folder: Path
    reads: int = 0
    """Number of documents read so far."""
    _by_document: dict[str, tuple[_Stamp, _Names | None]] = field(default_factory=dict)
    _combined_names: _CombinedNames = field(default_factory=_CombinedNames)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def of(self, manifest: Manifest) -> RetainedFiles:
        """The files that an outcome or a certificate beside the manifest names, by
        name or by digest. All files if such a document cannot be read, with the
        name of that document."""
        every = frozenset(s.file for s in manifest.segments)
        with self._lock:
            try:
                unread = self._update()
                if unread is not None:
                    return RetainedFiles(every, unread)
                # Documents with too many names are searched as text.
                texts = self._texts(name for name, (_, names) in self._by_document.items() if names is None)
                kept = {s.file for s in manifest.segments if self._combined_names.names(s) or _is_in(s, texts)}
                odd = [s for s in manifest.segments if s.file not in kept and not _is_indexed(s)]
                # So are all documents for a segment whose digest has another form.
                if odd:
                    texts = self._texts(self._by_document)
                    kept |= {s.file for s in odd if _is_in(s, texts)}
            except _Unread as e:
                return RetainedFiles(every, str(e))
            return RetainedFiles(frozenset(kept))

    def _update(self) -> str | None:
        """Updates the index. Returns what cannot be read; None if all can."""
        found: dict[str, tuple[_Stamp, _Names | None]] = {}
        try:
            with os.scandir(self.folder) as entries:
                names = sorted(entry.name for entry in entries if entry.name.endswith(EVIDENCE))
        except FileNotFoundError:
            names = []
        except OSError:
            return str(self.folder)
        # Take over the entries of unchanged documents and read the others.
        changed = False
        for name in names:
            path = self.folder / name
            try:
                stamp = _Stamp.of(path.stat())
                known = self._by_document.get(name)
                if known is not None and known[0] == stamp and stamp.old_enough:
                    found[name] = known
                    continue
                found[name] = stamp, _names_in(self._data(name))
                changed = True
            except OSError:
                if os.path.lexists(path):  # else it was deleted meanwhile
                    return name
        # Combine the names of all documents anew if any document changed.
        if changed or found.keys() != self._by_document.keys():
            self._by_document = found
            self._combined_names = _combined(found)
        return None

    def _data(self, name: str) -> bytes:
        self.reads += 1
        return td.files.read_whole(self.folder / name, EVIDENCE_MOST)

    def _texts(self, names: Iterable[str]) -> list[str]:
        """Raises _Unread."""
        texts = []
        for name in names:
            try:
                texts.append(self._data(name).decode("utf-8", "replace"))
            except OSError:
                if os.path.lexists(self.folder / name):
                    raise _Unread(name) from None
        return texts


class _Unread(Exception):
    """An existing document cannot be read."""


def _names_in(data: bytes) -> _Names | None:
    """None if there are more than `NAMES_MOST`."""
    digests = frozenset(_digests_in(data))
    text = data.decode("utf-8", "replace")
    ends = set()
    at = text.find(_SUFFIX)
    while at >= 0:
        end = at + len(_SUFFIX)
        # A file name has no slash and at most `FILE_NAME_MOST` bytes.
        ends.add(text[max(0, end - FILE_NAME_MOST) : end].rpartition("/")[2][::-1])
        if len(ends) + len(digests) > NAMES_MOST:
            return None
        at = text.find(_SUFFIX, end)
    return _Names(digests, frozenset(ends)) if len(digests) <= NAMES_MOST else None


def _digests_in(data: bytes) -> list[str]:
    """Runs of hexadecimal digits that are at least as long as a digest. Ten times as
    fast as a regular expression, which starts again at every digit of a number."""
    edges = np.flatnonzero(np.diff(_IS_HEX[np.frombuffer(data, dtype=np.uint8)].astype(np.int8), prepend=0, append=0))
    starts, ends = edges[::2], edges[1::2]
    long = ends - starts >= DIGEST_DIGITS
    return [data[a:b].decode() for a, b in zip(starts[long].tolist(), ends[long].tolist(), strict=True)]


def _combined(found: dict[str, tuple[_Stamp, _Names | None]]) -> _CombinedNames:
    indexed = [names for _, names in found.values() if names is not None]
    runs = frozenset().union(*(names.digests for names in indexed))
    ends = frozenset().union(*(names.ends for names in indexed))
    long_runs = tuple(run for run in runs if len(run) > DIGEST_DIGITS)
    return _CombinedNames(runs, long_runs, tuple(sorted(ends)), tuple(sorted(found)))


def _is_indexed(segment: Segment) -> bool:
    """Whether the index covers every digest of the segment."""
    return all(_DIGEST.fullmatch(d) for d in (segment.sha256, segment.raw_sha256) if d)


def _is_in(segment: Segment, texts: Iterable[str]) -> bool:
    names = [name for name in (segment.file, segment.sha256, segment.raw_sha256) if name]
    return any(name in text for text in texts for name in names)


_indexes: WeakValueDictionary[Path, EvidenceIndex] = WeakValueDictionary()
_indexes_lock = threading.Lock()


def evidence_in(folder: Path) -> EvidenceIndex:
    """Index of a folder; all writers of this process share it."""
    with _indexes_lock:
        key = folder.absolute()
        index = _indexes.get(key)
        if index is None:
            index = _indexes[key] = EvidenceIndex(key)
        return index


Bury = Callable[[str, str, str], None]
"""Signs that a file is about to be deleted: its SHA-256, its name and the reason.
Raises RecordingError, OSError."""

REBUILT = "manifest_rebuilt"  # an event
AWAY = "nothing was being recorded meanwhile"
DAMAGED = "what was recorded before is damaged, and nothing was being recorded meanwhile"


class SegmentedWriter(RecordingWriter):
    """A `RecordingWriter` that writes one file after the other. A new segment begins
    when the current one has ``size_bytes`` or is ``time_s`` old. ``manifest`` is the
    file that lists the segments. If it exists, the recording continues after the
    segments that it lists; if it cannot be used, after the segments on the disk.
    ``path`` is the manifest, or an `.mcap` of that name.

    Every segment has the attachments written before the first raw record.
    ``retention`` deletes the oldest segments, each after ``bury`` has signed that it
    does. ``deleted`` lists them, and so do events in the current segment. The age of a
    segment is the smaller one of its ages by the clock and by ``steady_ns``, a time
    that no setting of the clock moves, so a clock set forward deletes nothing. As a
    context manager, the writer records by an event why it ended.
    """

    def __init__(
        self,
        path: Path,
        *,
        metadata: Mapping[str, Mapping[str, str]],
        size_bytes: int = SEGMENT_BYTES,
        time_s: float = SEGMENT_S,
        retention: Retention | None = None,
        bury: Bury | None = None,
        steady_ns: Callable[[], int] = td.host_clock.HOST.now_ns,
        **options: Any,
    ) -> None:
        self.manifest = manifest_path(path)
        self.deleted: list[Surplus] = []
        self._size_bytes, self._time_ns = size_bytes, round(time_s * 1e9)
        self._retention, self._steady_ns, self._bury = retention, steady_ns, bury
        self._evidence = evidence_in(self.manifest.parent)
        self._began_ns = self._retained_ns = steady_ns()
        self._closed_ns: dict[int, int] = {}  # by number, by the steady clock
        self._kept: list[tuple[int, str, str, bytes]] = []
        self._recorded = self._low_reported = False
        self._unread: str | None = None
        self._unsigned: str | None = None
        """Why the deletion of a segment could not be signed, if one could not."""
        self._in_chain: set[Path] = set()  # segments with a tombstone, which may still be there
        """Document that cannot be read; it keeps segments that would be deleted."""
        super().__init__(self.manifest, metadata=metadata, **options)

    def seal(self, name: str, media_type: str, make: Callable[[Document], bytes], sign: Sign | None = None) -> None:
        raise RecordingError(f"{self.manifest}: a recording in segments ends with no document")

    @property
    def resumes(self) -> td.Gap | None:
        return self._resumes

    @property
    def keeps_for(self) -> str | None:
        return self._unread

    @property
    def _reported_path(self) -> Path:
        return self._file.path

    def _leave(self, error: BaseException | None) -> None:
        self.close(ended_because(error))

    def _begin(self, head: Head) -> RecordingFile:
        self._head = replace(head, metadata={name: dict(record) for name, record in head.metadata.items()})
        try:
            # Continue the manifest on the disk, or one rebuilt from the segments.
            opened = open_manifest(self.manifest)
            self._segments, self.warning = with_last_on_disk(opened.manifest), opened.warning
            ends = [s.end_ns for s in self._segments.segments if s.end_ns is not None]
            damaged = bool(self._segments.segments) and self._segments.segments[-1].state == "damaged"
            self._resumes = td.Gap(ends[-1], None, DAMAGED if damaged else AWAY) if ends else None
            # Make room before the first file of this writer.
            before, gone = self._segments, self._delete_for_room()
            file = self._next(before)
            # Record what happened in the new segment.
            if opened.warning is not None:
                file.write(schema.EVENTS, self._event(REBUILT, {"because": opened.warning, "kept_as": opened.kept}))
            if gone:
                file.write(schema.EVENTS, self._deleted(gone))
            return file
        except OSError as e:
            raise disk.not_created(self.manifest, e) from e

    def _delete_for_room(self) -> list[Surplus]:
        """Deletes segments until there is room for a file and its end; returns them.
        Deletes none if even all do not suffice. Raises DiskError."""
        free, chosen = disk.free_bytes(self.manifest.parent), self._surplus()
        if free is None or free >= disk.END_BYTES:
            return []
        if free + sum(one.segment.bytes for one in chosen) < disk.END_BYTES:
            raise self._with_reason(disk.no_room(self.manifest, free))
        gone = self._delete(chosen)
        if not gone and self._unsigned:
            raise self._with_reason(disk.no_room(self.manifest, free))
        return gone

    # The following runs on the writer's thread, except for the first segment.

    def _next(self, before: Manifest | None = None) -> RecordingFile:
        """The next segment. It continues ``before``, the manifest before a deletion, if
        given. Raises OSError, RecordingError."""
        before = before or self._segments
        # Choose a free number and the running index of the first record.
        known, number = before.segments, before.next_number
        if not known or os.path.lexists(before.path.with_name(before.file_name(number))):
            number = max(number, before.taken + 1)
        first = max((s.end for s in known), default=0)
        place = {"number": str(number), "first": str(first), "of": self.manifest.name}
        if known:
            place |= {"previous": known[-1].file, "previous_sha256": known[-1].sha256}
        head = replace(self._head, metadata={**self._head.metadata, schema.SEGMENT_RECORD: place})
        segment = Segment(self._segments.file_name(number), number, first)
        path = self._segments.path_of(segment)
        require_new(path)
        # Save the manifest before the file exists: a file that no manifest lists would
        # block its name for ever.
        self._segments = self._segments.with_last(segment)
        self._segments.save()
        file = RecordingFile(path, head, clock_ns=self._clock_ns, sync_s=self._sync_s, first=first)
        for attachment in self._kept:
            file.attach(*attachment)
        return file

    def _look_after(self) -> None:
        super()._look_after()
        old = self._file.digest.records and not 0 <= self._clock_ns() - self._begun_ns < self._time_ns
        if old or self._file.size >= self._size_bytes:
            self._finish()
            self._finished = False
            self._file = self._next()
            self._low_reported = False
            self._retain()

    def _idle(self) -> None:
        """Applies the retention without new records: earlier segments grow old, and
        other programs fill the disk."""
        super()._idle()
        if not 0 <= self._steady_ns() - self._retained_ns < self._time_ns:
            self._retain()

    def _flushed(self) -> None:
        super()._flushed()
        if not self._low_reported and self._lacks_room() and not self._retain():
            self._low_reported = True
            wanted = self._retention.free_bytes if self._retention else 0
            why = {"unread": self._unread, "unsigned": self._unsigned}
            why = {name: told for name, told in why.items() if told is not None}
            self._file.write(schema.EVENTS, self._event("disk_low", {"wanted_bytes": wanted, **why}))

    def _finish(self) -> None:
        super()._finish()
        file, last = self._file, self._segments.segments[-1]
        start_ns, end_ns = file.span_ns or (None, None)
        try:
            sha256 = digest_of(file.path)
        except RecordingError as e:  # moved away, or the disk was taken from under it
            raise DiskError(str(e)) from e
        closed = replace(
            last, state="closed", end=file.raw_end, records=file.digest.records, start_ns=start_ns, end_ns=end_ns,
            closed_ns=self._clock_ns(), bytes=file.size, sha256=sha256,
            raw_sha256=file.digest.hexdigest(),
        )  # fmt: skip
        self._closed_ns[last.number] = self._steady_ns()
        self._segments = self._segments.with_last(closed)
        self._segments.save()

    def _end_for_lack_of_room(self, free: int) -> None:
        """Ends the recording unless older segments make room. Raises DiskError."""
        if self._retain():
            return
        try:
            super()._end_for_lack_of_room(free)
        except DiskError as e:
            raise self._with_reason(e) from None

    def _with_reason(self, e: DiskError) -> DiskError:
        """Adds what prevented a deletion, if anything: a document, or that nothing can
        be signed."""
        if self._unread:
            return DiskError(f"{e}; nothing was deleted, as {self._unread} cannot be read")
        return (
            DiskError(f"{e}; nothing was deleted, as no deletion can be signed: {self._unsigned}")
            if self._unsigned
            else e
        )

    def _lacks_room(self) -> bool:
        """Whether less of the disk is free than the retention demands."""
        free = disk.free_bytes(self.manifest.parent)
        return self._retention is not None and free is not None and free < self._retention.free_bytes

    def _age_ns(self, segment: Segment) -> int | None:
        """Age by the clock or by the steady clock, whichever is less. The steady age
        counts from the end of the segment, or from the start of this writer if an
        earlier writer closed it."""
        closed_ns = segment.end_ns if segment.closed_ns is None else segment.closed_ns
        if closed_ns is None:
            return None
        steadily_ns = self._closed_ns.get(segment.number, min(closed_ns, self._began_ns))
        return min(self._clock_ns() - closed_ns, self._steady_ns() - steadily_ns)

    def _retain(self) -> list[Surplus]:
        """Deletes surplus segments, records it by an event, and returns them."""
        gone = self._delete(self._surplus())
        if gone:
            self._file.write(schema.EVENTS, self._deleted(gone))
        return gone

    def _surplus(self) -> list[Surplus]:
        self._retained_ns = self._steady_ns()
        if self._retention is None:
            return []
        kept, unread = self._evidence.of(self._segments)
        choose = partial(
            surplus, self._segments.segments, self._retention, age_ns=self._age_ns,
            free_bytes=disk.free_bytes(self.manifest.parent),
        )  # fmt: skip
        # An unreadable document matters only if it keeps a segment that would go.
        self._unread = unread if unread is not None and choose(kept=()) else None
        return choose(kept=kept)

    def _delete(self, chosen: list[Surplus]) -> list[Surplus]:
        """Deletes segments; returns those that were deleted."""
        gone = delete(self._segments, chosen if self._bury is None else self._buried(chosen, self._bury))
        if gone:
            self._segments = self._segments.without([(one.segment, one.reason) for one in gone])
            self._segments.save()
            self.deleted += gone
        return gone

    def _buried(self, chosen: list[Surplus], bury: Bury) -> Iterator[Surplus]:
        """Segments whose deletion is signed. One for which nothing is signed stays."""
        self._unsigned = None
        for one in chosen:
            path = self._segments.path_of(one.segment)
            if os.path.lexists(path) and path not in self._in_chain:
                try:
                    # Not the digest that the manifest states, which is not signed.
                    bury(digest_of(path), path.name, one.reason)
                except (RecordingError, OSError) as e:
                    self._unsigned = str(e)
                    continue
                self._in_chain.add(path)
            yield one

    def _deleted(self, gone: list[Surplus]) -> schema.Event:
        return self._event("deleted", {"segments": [_detail_of(one) for one in gone]})

    def _event(self, kind: str, detail: Mapping[str, Any]) -> schema.Event:
        return schema.Event(self._clock_ns(), kind, json.dumps(detail, sort_keys=True))

    def _write_attachment(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        if not self._recorded:
            self._kept.append((time_ns, name, media_type, data))
        super()._write_attachment(time_ns, name, media_type, data)

    def _write_unconfirmed(self, first: int, told: Mapping[str, str]) -> None:
        """Marks records of closed segments too, in the manifest: the bytes of closed
        files do not change."""
        super()._write_unconfirmed(first, told)
        self._segments = self._segments.unconfirmed_from(first)
        self._segments.save()

    def _write_raw(self, phase: str, first: int, batch: td.RawBatch) -> None:
        self._recorded = True
        if not self._file.digest.records:  # the age of a segment counts from its first record
            self._begun_ns = self._clock_ns()
        super()._write_raw(phase, first, batch)


def _detail_of(one: Surplus) -> dict[str, Any]:
    s = one.segment
    return {"file": s.file, "because": one.reason, "bytes": s.bytes, "start_ns": s.start_ns, "end_ns": s.end_ns}
