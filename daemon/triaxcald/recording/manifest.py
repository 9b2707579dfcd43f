"""The manifest of a recording in segments (`triaxcal.segments/1`): which files
it consists of, in order, and which of them are kept."""

from __future__ import annotations

import hashlib
import json
import os
import re
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import asdict, dataclass, field, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import triaxcal_drivers as td
from triaxcald.errors import RecordingError
from triaxcald.files import write_durably
from triaxcald.recording.schema import RAW

FORMAT = "triaxcal.segments/1"
SUFFIX = ".segments.json"
MANIFEST_MOST = 64 * 2**20  # bytes; an entry has some 400: 18 years of hours, four months of minutes
NUMBER_MOST = 10**18 - 1  # file names have up to 18 digits
_REMEDY = "its segments can be read one by one, and the next `triaxcal record` to it rebuilds it"
State = Literal["open", "closed", "cut_short", "damaged"]


@dataclass(frozen=True)
class Segment:
    """One file. Running indices of raw records from ``first`` to before ``end``
    are its own, of which ``records`` are in it; ``start_ns`` and ``end_ns`` are
    host times of the first and the last, None where there are none;
    ``closed_ns`` is the host's clock when the last of the file was written,
    None in manifests of old. ``bytes`` and ``sha256`` are of the whole file,
    ``raw_sha256`` is the digest of its raw records. ``open``: it is being
    written, or was when the power failed; ``cut_short``: it was not
    finished; ``damaged``: nor can it be read, so that nobody knows how many
    records are in it. From the running index ``unconfirmed`` on, its records
    are unconfirmed; None where none is."""

    file: str
    number: int
    first: int
    state: State = "open"
    end: int = 0
    records: int = 0
    start_ns: int | None = None
    end_ns: int | None = None
    closed_ns: int | None = None
    bytes: int = 0
    sha256: str = ""
    raw_sha256: str = ""
    unconfirmed: int | None = None


@dataclass(frozen=True)
class Manifest:
    """``segments`` in order. ``deleted`` counts those that retention has taken
    away, which are in it no more, by reason."""

    path: Path
    segments: tuple[Segment, ...] = ()
    deleted: dict[str, int] = field(default_factory=dict)

    @property
    def next_number(self) -> int:
        return max([sum(self.deleted.values()), *(s.number for s in self.segments)]) + 1

    @property
    def taken(self) -> int:
        """The highest number that the name of a file beside it has."""
        with suppress(OSError):  # a folder that one may write to, and not read
            return max(numbered_files(self.path), default=0)
        return 0

    def path_of(self, segment: Segment) -> Path:
        return self.path.with_name(segment.file)

    def file_name(self, number: int) -> str:
        return f"{self.path.name.removesuffix(SUFFIX)}-{number:06d}.mcap"

    def with_last(self, segment: Segment) -> Manifest:
        """``segment`` in the place of the last one where that has its number,
        else behind it."""
        known = self.segments[:-1] if self.segments and self.segments[-1].number == segment.number else self.segments
        return replace(self, segments=(*known, segment))

    def unconfirmed_from(self, first: int) -> Manifest:
        """All records from the running index ``first`` on are unconfirmed, in
        whichever segment they are."""
        marked = [
            replace(s, unconfirmed=max(first, s.first)) if s.state == "open" or s.end > first else s
            for s in self.segments
        ]
        return replace(self, segments=tuple(marked))

    def without(self, taken: list[tuple[Segment, str]]) -> Manifest:
        """Of which some were deleted, each for a reason."""
        gone = {segment.number for segment, _ in taken}
        counts = Counter(self.deleted) + Counter(reason for _, reason in taken)
        return replace(self, segments=tuple(s for s in self.segments if s.number not in gone), deleted=dict(counts))

    def save(self) -> None:
        """Whole or not at all. Raises OSError."""
        document = {"format": FORMAT, "segments": [asdict(s) for s in self.segments], "deleted": self.deleted}
        write_durably(self.path, json.dumps(document, indent=1) + "\n")


def manifest_path(path: Path) -> Path:
    """Of the recording that is asked for as ``path``, an `.mcap` or the manifest
    itself."""
    return path if is_manifest(path) else path.with_name(path.name.removesuffix(".mcap") + SUFFIX)


def is_manifest(path: td.files.AnyPath | str) -> bool:
    return str(path).endswith(SUFFIX)


def numbered_files(path: Path) -> dict[int, str]:
    """The names in the folder of the manifest ``path`` that a segment of it may
    have, by number, in order. Raises OSError."""
    name = re.compile(re.escape(path.name.removesuffix(SUFFIX)) + r"-([0-9]{6,18})\.mcap")
    found = sorted((int(match[1]), match[0]) for match in map(name.fullmatch, os.listdir(path.parent)) if match)
    return dict(found)


def load_manifest(path: Path) -> Manifest:
    """Raises RecordingError, which also says what can be done."""
    try:
        return parsed_manifest(path)
    except RecordingError as e:
        if not os.path.lexists(path):
            raise
        raise RecordingError(f"{e}; {_REMEDY}") from e


def parsed_manifest(path: Path) -> Manifest:
    """As `load_manifest`. Raises RecordingError, which says only what is wrong."""
    return Manifest(path, *_parsed(path))


def segments_listed(path: td.files.AnyPath) -> tuple[Segment, ...]:
    """Those of a manifest, wherever that is. Raises RecordingError."""
    return _parsed(path)[0]


def _parsed(path: td.files.AnyPath) -> tuple[tuple[Segment, ...], dict[str, int]]:
    """Segments, and how many were deleted, by reason."""
    try:
        document = json.loads(td.files.read_whole(path, MANIFEST_MOST))
    except OSError as e:
        raise RecordingError(f"{path}: cannot be read: {e.strerror}") from e
    except (ValueError, RecursionError) as e:
        raise RecordingError(f"{path}: not JSON, expected a {FORMAT} document") from e
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        said = document.get("format") if isinstance(document, dict) else None
        raise RecordingError(f"{path}: format {json.dumps(said)[:40]}, expected '{FORMAT}'")
    listed, deleted = document.get("segments"), document.get("deleted", {})
    if not isinstance(listed, list) or not isinstance(deleted, dict):
        raise RecordingError(f"{path}: segments: expected a list, and deleted an object")
    segments = tuple(_segment(entry, f"{path}: segments[{i}]") for i, entry in enumerate(listed))
    if any(later.number <= earlier.number for earlier, later in pairwise(segments)):
        raise RecordingError(f"{path}: segments: expected numbers that rise")
    if len({s.file for s in segments}) < len(segments):
        raise RecordingError(f"{path}: segments: a file is named twice")
    counts = {str(reason): _count(n, f"{path}: deleted") for reason, n in deleted.items()}
    if sum(counts.values()) > NUMBER_MOST:
        raise RecordingError(f"{path}: deleted: expected at most {NUMBER_MOST} segments")
    return segments, counts


_KINDS: dict[str, Any] = {f.name: f.type for f in fields(Segment)}


def _segment(entry: Any, where: str) -> Segment:
    if not isinstance(entry, dict):
        raise RecordingError(f"{where}: expected an object")
    held: dict[str, Any] = {}
    for name, kind in _KINDS.items():
        value = entry.get(name)
        if kind == "str":
            held[name] = _text(value, f"{where}: {name}")
        elif name == "state":
            if value not in get_args(State):
                raise RecordingError(f"{where}: {name}: expected one of {', '.join(get_args(State))}")
            held[name] = value
        elif not (value is None and kind == "int | None"):
            held[name] = _count(value, f"{where}: {name}")
    file = held["file"]
    if Path(file).name != file or not file.endswith(".mcap") or not _can_be_a_name(file):
        raise RecordingError(f"{where}: file: expected the name of an .mcap beside it")
    segment = Segment(**held)
    if segment.number > NUMBER_MOST:
        raise RecordingError(f"{where}: number: expected at most {NUMBER_MOST}")
    if segment.state != "open" and segment.end < segment.first + segment.records:
        raise RecordingError(f"{where}: end: expected at least first and records, {segment.first + segment.records}")
    return segment


def _can_be_a_name(file: str) -> bool:
    try:
        return b"\0" not in os.fsencode(file)
    except UnicodeEncodeError:  # half of a pair, which JSON can write
        return False


def _text(value: Any, where: str) -> str:
    if not isinstance(value, str) or len(value) > 255:
        raise RecordingError(f"{where}: expected a text")
    return value


def _count(value: Any, where: str) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**63:
        raise RecordingError(f"{where}: expected a number from 0 on")
    return value


# Which segments of a recording are kept, and which make room.

SEGMENT_BYTES, SEGMENT_S = 256 * 2**20, 3600.0
"""What damage to one file costs at most, and the least that retention takes: an
hour of a busy bus is some hundred MiB."""
Reason = Literal["age", "disk"]


@dataclass(frozen=True)
class Retention:
    """Segments that were closed more than ``keep_s`` ago go (None: no age is too
    much); and the oldest go while less than ``free_bytes`` of the disk are
    free."""

    keep_s: float | None = None
    free_bytes: int = 0


class Surplus(NamedTuple):
    segment: Segment
    reason: Reason


def surplus(
    segments: Sequence[Segment],
    retention: Retention,
    *,
    age_ns: Callable[[Segment], int | None],
    free_bytes: int | None,
    kept: Collection[str],
) -> list[Surplus]:
    """What has to go, the oldest first. The one that is being written stays,
    and so do the files ``kept``. ``age_ns`` is None for one that does not say
    from when it is: it is as old as any. ``free_bytes`` of the disk, None where
    that is not known."""
    found: list[Surplus] = []
    free = retention.free_bytes if free_bytes is None else free_bytes
    for segment in segments:
        if segment.state == "open" or segment.file in kept:
            continue
        if retention.keep_s is not None and _too_old(age_ns(segment), retention.keep_s):
            found.append(Surplus(segment, "age"))
        elif free < retention.free_bytes:
            found.append(Surplus(segment, "disk"))
        else:
            continue
        free += segment.bytes
    return found


def _too_old(age_ns: int | None, keep_s: float) -> bool:
    return age_ns is None or age_ns > keep_s * 1e9


def delete(manifest: Manifest, chosen: Iterable[Surplus]) -> list[Surplus]:
    """Those that are gone; one that cannot be removed stays, and the next may
    go. What is still in the manifest, and not on the disk, is gone too."""
    gone = []
    for one in chosen:
        try:
            manifest.path_of(one.segment).unlink(missing_ok=True)
        except OSError:
            continue
        gone.append(one)
    return gone


# What a recording holds, as digests: so that an outcome can name it, and an audit
# can miss nothing. No I/O.

Document = dict[str, Any]


class End(NamedTuple):
    """The document that a recording ends with, as an attachment."""

    name: str
    media_type: str
    time_ns: int
    data: bytes


@dataclass(frozen=True)
class SealedContents:
    """All that a recording of a run holds but its signature: what is signed.

    ``contents`` is the inventory with the last document. ``raw_batches`` counts the
    messages of raw records, ``raw_chain`` is the head of their hash chain: from 32
    zero bytes on, each link is the SHA-256 of the link before and of the SHA-256 of
    the message. ``metadata`` are the records before the last document, ``closing``
    those after it. ``document`` is the last document.
    """

    contents: Document
    raw_batches: int
    raw_chain: str
    metadata: Mapping[str, Mapping[str, str]]
    closing: Mapping[str, Mapping[str, str]]
    document: bytes


class SignatureMade(NamedTuple):
    """A signature as an attachment."""

    name: str
    media_type: str
    data: bytes


Sign = Callable[[SealedContents], AbstractContextManager[SignatureMade]]
"""Signs a recording. The context lasts until the file is whole and on the disk; if it
ends with an error, the recording counts as not signed. Raises RecordingError."""


class Inventory:
    """Grows with a recording, record by record, in the order of the file."""

    def __init__(self) -> None:
        self.records: dict[str, Mapping[str, str]] = {}
        """The metadata records by name."""
        self._attachments: list[Document] = []
        self._metadata: list[Document] = []
        self._raw_batches, self._raw_chain = 0, bytes(hashlib.sha256().digest_size)
        self._topics: dict[str, tuple[int, hashlib._Hash]] = {}
        self._declared: dict[str, set[str]] = {}

    def channel(self, topic: str, encoding: str, metadata: Mapping[str, str], kind: tuple[str, str, bytes]) -> None:
        """A topic as it is declared; ``kind`` is its schema's name, encoding
        and data. Each way counts once."""
        said = [topic, encoding, *(f"{key}\0{value}" for key, value in sorted(metadata.items())), *kind[:2]]
        text = "\0".join(said).encode() + b"\0" + kind[2]
        self._declared.setdefault(topic, set()).add(hashlib.sha256(text).hexdigest())

    def attachment(self, name: str, media_type: str, time_ns: int, data: bytes) -> None:
        self._attachments.append(_attachment(name, media_type, time_ns, data))

    def metadata(self, name: str, record: Mapping[str, str]) -> None:
        self.records[name] = dict(record)
        text = "".join(f"{key}\0{value}\0" for key, value in sorted(record.items()))
        self._metadata.append({"name": name, "sha256": hashlib.sha256(text.encode()).hexdigest()})

    def message(self, topic: str, log_time_ns: int, publish_time_ns: int, data: bytes) -> None:
        count, digest = self._topics.get(topic) or (0, hashlib.sha256())
        digest.update(struct.pack("<QQQ", log_time_ns, publish_time_ns, len(data)))
        digest.update(data)
        self._topics[topic] = count + 1, digest
        if topic == RAW:
            self._raw_batches += 1
            self._raw_chain = hashlib.sha256(self._raw_chain + hashlib.sha256(data).digest()).digest()

    def document(self) -> Document:
        """Attachments in the order of the file, metadata by name, messages by
        topic."""
        topics = sorted(self._topics.items())
        return {
            "attachments": list(self._attachments),
            "metadata": sorted(self._metadata, key=lambda m: str(m["name"])),
            "topics": [
                {"name": name, "messages": n, "sha256": d.hexdigest(), "declared": self._declaration(name)}
                for name, (n, d) in topics
            ],
        }

    def sealed(self, end: End, closing: Mapping[str, Mapping[str, str]]) -> SealedContents:
        """With the document ``end``, which is not in the inventory, and the metadata
        records ``closing`` that follow it."""
        contents = self.document()
        contents["attachments"].append(_attachment(*end))
        return SealedContents(
            contents, self._raw_batches, self._raw_chain.hex(), dict(self.records), {**closing}, end.data
        )

    def _declaration(self, topic: str) -> str:
        return hashlib.sha256("".join(sorted(self._declared.get(topic, ()))).encode()).hexdigest()


def _attachment(name: str, media_type: str, time_ns: int, data: bytes) -> Document:
    return {"name": name, "media_type": media_type, "time_ns": time_ns, "sha256": hashlib.sha256(data).hexdigest()}
