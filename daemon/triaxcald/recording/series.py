"""A recording in segments, read as one."""

from __future__ import annotations

import hashlib
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import triaxcal_drivers as td
from triaxcald.errors import RecordingError
from triaxcald.recording import schema
from triaxcald.recording.contents import Contents, TopicMessage
from triaxcald.recording.manifest import Manifest, Segment, is_manifest, load_manifest
from triaxcald.recording.reader import Attachments, Recording

_BLOCK = 2**20
_MEANT_BY = {"unit": ("name", "serial", "signs"), schema.BUS_RECORD: ("name", "channel")}
"""What of the metadata says whose records they are, and how they are read."""


class Series(Contents):
    """All segments that are there, one open at a time. Metadata and attachments
    are those of the first.

    Each segment is compared with the manifest when it is read, and with the
    first unless they need not be ``alike``: records mean the same in all of
    them. Raises RecordingError: one is missing, or is not as it was.
    """

    def __init__(self, path: Path, *, alike: bool = True) -> None:
        self.name = str(path)
        self._alike = alike
        self.manifest: Manifest = load_manifest(path)
        if not self.manifest.segments:
            raise RecordingError(f"{path}: no segment is left of this recording")
        for segment in self.manifest.segments:
            self._require_there(segment)
        self._unconfirmed = [
            range(s.unconfirmed, s.end if s.state != "open" else sys.maxsize)
            for s in self.manifest.segments
            if s.unconfirmed is not None
        ]
        self._first = self._opened(self.manifest.segments[0])
        own = (schema.SEGMENT_RECORD, schema.RAW_RECORD)
        self.metadata = {name: record for name, record in self._first.metadata.items() if name not in own}
        self.attachments: Attachments = self._first.attachments

    def close(self) -> None:
        self._first.close()

    @property
    def size(self) -> int:
        return sum(segment.bytes for segment in self.manifest.segments)

    @property
    def any_unconfirmed(self) -> bool:
        return bool(self._unconfirmed)

    def is_confirmed(self, first: int) -> bool:
        return not any(first in indices for indices in self._unconfirmed)

    def messages(self, topic: str | None = None) -> Iterator[TopicMessage]:
        yield from self._first.messages(topic)
        for segment in self.manifest.segments[1:]:
            with self._opened(segment) as recording:
                if self._alike:
                    self._require_alike(recording, segment)
                yield from recording.messages(topic)

    def _require_there(self, segment: Segment) -> None:
        path = self.manifest.path_of(segment)
        try:
            size = path.stat().st_size
        except OSError as e:
            raise RecordingError(f"{self.name}: segment {segment.file}: {e.strerror}") from e
        if segment.state != "open" and size != segment.bytes:
            raise RecordingError(
                f"{self.name}: segment {segment.file}: {size} bytes, expected {segment.bytes}; it was changed since"
            )

    def _require_alike(self, recording: Recording, segment: Segment) -> None:
        """What is in a segment means what it does in the first: the station
        file may have changed in between, and with it profile, signs or bus. One
        that ended before its first record may lack attachments."""
        first, ours, theirs = self.manifest.segments[0].file, self.metadata, recording.metadata
        named = [
            f"{key} of the {record}"
            for record, keys in _MEANT_BY.items()
            for key in keys
            if theirs.get(record, {}).get(key) != ours.get(record, {}).get(key)
        ]
        there = set(self.attachments) & set(recording.attachments) - {schema.STATION_FILE}
        named += [name for name in sorted(there) if not _alike(recording.attachments[name], self.attachments[name])]
        if named:
            raise RecordingError(
                f"{self.name}: segment {segment.file}: {', '.join(named)}: not as in {first}; "
                "read the segments before and after such a change one by one"
            )

    def _opened(self, segment: Segment) -> Recording:
        path = self.manifest.path_of(segment)
        if segment.state != "open" and digest_of(path) != segment.sha256:
            raise RecordingError(f"{self.name}: segment {segment.file}: was changed since it was recorded")
        return Recording.open(path, unfinished=segment.state != "closed")


def _alike(one: bytes, other: bytes) -> bool:
    """Of two files of a profile: comments and blanks of TOML mean nothing."""
    try:
        return one == other or tomllib.loads(one.decode()) == tomllib.loads(other.decode())
    except (ValueError, RecursionError):
        return False


def digest_of(path: Path) -> str:
    """SHA-256 of the whole file. Raises RecordingError."""
    try:
        digest = hashlib.sha256()
        with td.files.open_file(path) as file:
            while block := file.read(_BLOCK):
                digest.update(block)
        return digest.hexdigest()
    except OSError as e:
        raise RecordingError(f"{path}: cannot be read: {e.strerror}") from e


def open_recording(path: Path, *, unfinished: bool = False, alike: bool = True) -> Recording | Series:
    """One file, or all that a manifest names, as `Recording` and `Series` have
    them. Raises RecordingError."""
    return Series(path, alike=alike) if is_manifest(path) else Recording.open(path, unfinished=unfinished)


def is_recording(name: str) -> bool:
    """Whether a file of that name is a recording of ours, and not a table."""
    return name.endswith(".mcap") or is_manifest(name)
