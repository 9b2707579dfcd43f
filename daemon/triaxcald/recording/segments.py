"""Writes a recording in segments, each of which can be read alone."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from triaxcal_drivers.host_clock import HOST
from triaxcal_drivers.interface import Gap, RawBatch
from triaxcald.errors import DiskError, RecordingError
from triaxcald.files import require_new
from triaxcald.recording import disk, schema
from triaxcald.recording.ending import ended_because
from triaxcald.recording.evidence import evidence_in
from triaxcald.recording.file import Head, RecordingFile
from triaxcald.recording.inventory import Document
from triaxcald.recording.manifest import Manifest, Segment, manifest_path
from triaxcald.recording.rebuild import open_manifest, settled
from triaxcald.recording.retention import SEGMENT_BYTES as SEGMENT_BYTES
from triaxcald.recording.retention import SEGMENT_S as SEGMENT_S
from triaxcald.recording.retention import Retention, Surplus, delete, surplus
from triaxcald.recording.series import digest_of
from triaxcald.recording.writer import RecordingWriter

REBUILT = "manifest_rebuilt"  # an event
AWAY = "nothing was being recorded meanwhile"
DAMAGED = "what was recorded before is damaged, and nothing was being recorded meanwhile"


class SegmentedWriter(RecordingWriter):
    """As `RecordingWriter`, into one file after the other: a new one begins when
    the last has ``size_bytes`` or is ``time_s`` old. ``manifest`` is the file
    that names them; where it is there already, the recording goes on behind
    what it names, and where it cannot be used, behind the segments that are
    there. ``path`` is the manifest, or an `.mcap` of that name.

    Attachments that come before the first raw record are in every segment.
    ``retention`` takes the oldest segments away; ``deleted`` are those, and
    events of the current segment say it too. Their age is counted by the clock
    and by ``steady_ns``, a line that no setting of the clock moves: the younger
    counts, so that a clock set forward takes nothing away. Left as a context
    manager it says by an event why it ended.
    """

    def __init__(
        self,
        path: Path,
        *,
        metadata: Mapping[str, Mapping[str, str]],
        size_bytes: int = SEGMENT_BYTES,
        time_s: float = SEGMENT_S,
        retention: Retention | None = None,
        steady_ns: Callable[[], int] = HOST.now_ns,
        **options: Any,
    ) -> None:
        self.manifest = manifest_path(path)
        self.deleted: list[Surplus] = []
        self._size_bytes, self._time_ns = size_bytes, round(time_s * 1e9)
        self._retention, self._steady_ns = retention, steady_ns
        self._evidence = evidence_in(self.manifest.parent)
        self._began_ns = self._retained_ns = steady_ns()
        self._closed_ns: dict[int, int] = {}  # by number, on the steady line
        self._kept: list[tuple[int, str, str, bytes]] = []
        self._recorded = self._told_low = False
        self._unread: str | None = None
        """A document that cannot be read, and keeps what else would go."""
        super().__init__(self.manifest, metadata=metadata, **options)

    def seal(self, name: str, media_type: str, make: Callable[[Document], bytes]) -> None:
        raise RecordingError(f"{self.manifest}: a recording in segments ends with no document")

    @property
    def resumes(self) -> Gap | None:
        return self._resumes

    @property
    def keeps_for(self) -> str | None:
        return self._unread

    @property
    def _told(self) -> Path:
        return self._file.path

    def _leave(self, error: BaseException | None) -> None:
        self.close(ended_because(error))

    def _begin(self, head: Head) -> RecordingFile:
        self._head = replace(head, metadata={name: dict(record) for name, record in head.metadata.items()})
        try:
            opened = open_manifest(self.manifest)
            self._segments, self.warning = settled(opened.manifest), opened.warning
            ends = [s.end_ns for s in self._segments.segments if s.end_ns is not None]
            damaged = bool(self._segments.segments) and self._segments.segments[-1].state == "damaged"
            self._resumes = Gap(ends[-1], None, DAMAGED if damaged else AWAY) if ends else None
            before, gone = self._segments, self._room_made()
            file = self._next(before)
            if opened.warning is not None:
                file.write(schema.EVENTS, self._event(REBUILT, {"because": opened.warning, "kept_as": opened.kept}))
            if gone:
                file.write(schema.EVENTS, self._deleted(gone))
            return file
        except OSError as e:
            raise disk.not_created(self.manifest, e) from e

    def _room_made(self) -> list[Surplus]:
        """What had to go so that there is room for a file and its end; nothing
        goes where that would not do. Raises DiskError."""
        free, chosen = disk.free_bytes(self.manifest.parent), self._surplus()
        if free is None or free >= disk.END_BYTES:
            return []
        if free + sum(one.segment.bytes for one in chosen) < disk.END_BYTES:
            raise self._with_document(disk.no_room(self.manifest, free))
        return self._take_away(chosen)

    # What follows runs on the writer's thread, but for the first segment.

    def _next(self, before: Manifest | None = None) -> RecordingFile:
        """Behind what was there ``before``, where not all of it is left. Raises
        OSError, RecordingError."""
        before = before or self._segments
        known, number = before.segments, before.next_number
        if not known or os.path.lexists(before.path.with_name(before.file_name(number))):
            number = max(number, before.taken + 1)
        first = max((s.end for s in known), default=0)
        told = {"number": str(number), "first": str(first), "of": self.manifest.name}
        if known:
            told |= {"previous": known[-1].file, "previous_sha256": known[-1].sha256}
        head = replace(self._head, metadata={**self._head.metadata, schema.SEGMENT_RECORD: told})
        segment = Segment(self._segments.file_name(number), number, first)
        path = self._segments.path_of(segment)
        require_new(path)
        # Before the file is: one that no manifest names would be in the way for ever.
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
            self._told_low = False
            self._retain()

    def _idle(self) -> None:
        """Nothing comes: earlier segments grow old, and others fill the disk."""
        super()._idle()
        if not 0 <= self._steady_ns() - self._retained_ns < self._time_ns:
            self._retain()

    def _flushed(self) -> None:
        super()._flushed()
        if not self._told_low and self._lacks() and not self._retain():
            self._told_low = True
            wanted = self._retention.free_bytes if self._retention else 0
            unread = {} if self._unread is None else {"unread": self._unread}
            self._file.write(schema.EVENTS, self._event("disk_low", {"wanted_bytes": wanted, **unread}))

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
        """Unless older segments make room. Raises DiskError."""
        if self._retain():
            return
        try:
            super()._end_for_lack_of_room(free)
        except DiskError as e:
            raise self._with_document(e) from None

    def _with_document(self, e: DiskError) -> DiskError:
        """Also with what keeps segments that could make room."""
        return DiskError(f"{e}; nothing was deleted, as {self._unread} cannot be read") if self._unread else e

    def _lacks(self) -> bool:
        """Whether less of the disk is free than is to be."""
        free = disk.free_bytes(self.manifest.parent)
        return self._retention is not None and free is not None and free < self._retention.free_bytes

    def _age_ns(self, segment: Segment) -> int | None:
        """By the clock, or on the steady line where that is less: since it was
        closed by this writer, at least since this writer began."""
        closed_ns = segment.end_ns if segment.closed_ns is None else segment.closed_ns
        if closed_ns is None:
            return None
        steadily_ns = self._closed_ns.get(segment.number, min(closed_ns, self._began_ns))
        return min(self._clock_ns() - closed_ns, self._steady_ns() - steadily_ns)

    def _retain(self) -> list[Surplus]:
        """What it has taken away, also said in the file."""
        gone = self._take_away(self._surplus())
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
        self._unread = unread if unread is not None and choose(kept=()) else None
        return choose(kept=kept)

    def _take_away(self, chosen: list[Surplus]) -> list[Surplus]:
        """Those that are gone."""
        gone = delete(self._segments, chosen)
        if gone:
            self._segments = self._segments.without([(one.segment, one.reason) for one in gone])
            self._segments.save()
            self.deleted += gone
        return gone

    def _deleted(self, gone: list[Surplus]) -> schema.Event:
        return self._event("deleted", {"segments": [_told(one) for one in gone]})

    def _event(self, kind: str, detail: Mapping[str, Any]) -> schema.Event:
        return schema.Event(self._clock_ns(), kind, json.dumps(detail, sort_keys=True))

    def _write_attachment(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        if not self._recorded:
            self._kept.append((time_ns, name, media_type, data))
        super()._write_attachment(time_ns, name, media_type, data)

    def _write_unconfirmed(self, first: int, told: Mapping[str, str]) -> None:
        """Also of segments that are closed already, in the manifest: the bytes
        of their files stay as they are."""
        super()._write_unconfirmed(first, told)
        self._segments = self._segments.unconfirmed_from(first)
        self._segments.save()

    def _write_raw(self, phase: str, first: int, batch: RawBatch) -> None:
        self._recorded = True
        if not self._file.digest.records:  # the age of a segment counts from here: before was silence
            self._begun_ns = self._clock_ns()
        super()._write_raw(phase, first, batch)


def _told(one: Surplus) -> dict[str, Any]:
    s = one.segment
    return {"file": s.file, "because": one.reason, "bytes": s.bytes, "start_ns": s.start_ns, "end_ns": s.end_ns}
