"""The file of a recording while it is written, by one thread."""

from __future__ import annotations

import asyncio
import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Literal

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer as McapWriter

import triaxcal_drivers as td
from triaxcald.errors import DiskError, ProvisionError, TwoAnswer
from triaxcald.files import exists_already, synchronise
from triaxcald.recording import disk, schema
from triaxcald.recording.raw_batch import encode_raw
from triaxcald.recording.retention import Document, Inventory

CHUNK_NS = 1_000_000_000
"""After so long the operating system has a record. Counted from when it was
received, where that was now: a kill takes no more than a second."""
RECENT_NS = 1_000_000_000  # received longer ago, it is from a log, or the clock was set
FLUSH_BYTES = 2**20  # nor more of the file than this
SYNC_S = 10.0
"""So much a loss of power may take away. An fsync of a slow disk takes tenths of
a second, in which the queue fills; it holds several seconds of a busy bus."""


@dataclass(frozen=True)
class Head:
    """What a recording begins with: ``metadata`` are named records of strings,
    ``preview_channels`` those of its previews, None where it has none;
    ``ends_with`` is the format of the document that it ends with. Where records
    may be ``of_the_past``, as of a log that is converted, it begins with the
    first of those that are written first and ends with the last, whatever day
    it is."""

    metadata: Mapping[str, Mapping[str, str]]
    preview_channels: Sequence[str] | None = ()
    preview_unit: str = ""
    ends_with: str = ""
    of_the_past: bool = False
    preview: schema.PreviewEncoder = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "preview", schema.PreviewEncoder(self.preview_channels or ()))


class RecordingFile:
    """An MCAP recording being written. ``raw_end`` is the running index after
    the last raw record; ``sound_ns`` the time, by ``clock_ns``, up to which the
    operating system has everything, and ``sound_end`` the running index there.

    Raises OSError, here and from every method but `abandon`; RecordingError
    where the file cannot be created, or exists already.
    """

    def __init__(self, path: Path, head: Head, *, clock_ns: Callable[[], int], sync_s: float, first: int = 0) -> None:
        self.path = path
        self.digest = schema.RawDigest(head.ends_with)
        self.inventory = Inventory()
        self.span_ns: tuple[int, int] | None = None
        self.raw_end = self.sound_end = first
        self.sound_ns = self._synced_ns = clock_ns()
        self.size = 0
        self._head, self._clock_ns, self._sync_ns = head, clock_ns, round(sync_s * 1e9)
        self._chunks = 0
        self._waiting_ns: int | None = None  # when the oldest record not yet flushed was written
        self._end: dict[str, str] = {}
        self._begun_ns: int | None = self.sound_ns  # None once the file says so
        try:
            self._file = _create(path)
        except FileExistsError:
            raise exists_already(path) from None
        except OSError as e:
            raise disk.not_created(path, e) from e
        try:
            self._mcap = McapWriter(self._file, enable_data_crcs=True)
            self._write_head()
            with suppress(PermissionError):  # a folder that one may write to, and not read
                synchronise(path.parent)
        except OSError as e:
            self.abandon()
            with suppress(OSError):
                path.unlink()
            raise disk.not_created(path, e) from e

    @property
    def told_ns(self) -> int:
        """The time of what is told of the recording itself."""
        return self.span_ns[1] if self._head.of_the_past and self.span_ns else self._clock_ns()

    def raw(self, phase: str, first: int, batch: td.RawBatch) -> None:
        if self._begun_ns is not None and len(batch):
            self._tell_begun(min(self._begun_ns, int(batch.time_ns.min())))
        if len(batch) and self._waiting_ns is None:
            now_ns, received_ns = self._clock_ns(), int(batch.time_ns[0])
            self._waiting_ns = received_ns if 0 <= now_ns - received_ns < RECENT_NS else now_ns
        for piece in schema.cut(batch):
            time_ns = int(piece.time_ns[-1]) if len(piece) else self._clock_ns()
            self._add(schema.RAW, time_ns, encode_raw(first, phase, piece))
            self.digest.update(phase, piece)
            first += len(piece)
        self.raw_end = max(self.raw_end, first)
        if len(batch):
            begin, end = int(batch.time_ns.min()), int(batch.time_ns.max())
            earlier = self.span_ns or (begin, end)
            self.span_ns = min(earlier[0], begin), max(earlier[1], end)

    def preview(self, topic: str, block: td.SampleBlock, picked: Sequence[int]) -> None:
        for i in picked:
            self._add(topic, int(block.time_ns[i]), self._head.preview.encode(block, i))

    def write(self, topic: str, value: schema.RegisterAccess | schema.Event | schema.Loss) -> None:
        if isinstance(value, schema.Loss) and value.where == schema.RAW:
            self.raw_end = max(self.raw_end, value.first + value.records)
        self._add(topic, value.time_ns, schema.encode(value))

    def metadata(self, name: str, record: Mapping[str, str]) -> None:
        self.inventory.metadata(name, record)
        self._mcap.add_metadata(name, dict(record))
        self.flush()

    def attach(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        self.inventory.attachment(name, media_type, time_ns, data)
        self._mcap.add_attachment(time_ns, time_ns, name, media_type, data)
        self.flush()

    def seal(self, time_ns: int, name: str, media_type: str, make: Callable[[Document], bytes]) -> None:
        """The last attachment, made from the inventory of all before it."""
        data = make(self.inventory.document())
        self.attach(time_ns, name, media_type, data)
        self._end = {"name": name, "sha256": hashlib.sha256(data).hexdigest()}

    def flush(self) -> None:
        """The operating system has everything; now and then, the disk too."""
        self._mcap.flush()  # type: ignore[no-untyped-call]
        self.require_there()
        now_ns = self._clock_ns()
        if not 0 <= now_ns - self._synced_ns < self._sync_ns:
            os.fsync(self._file.fileno())
            self._synced_ns = now_ns
        self._chunks += self._waiting_ns is not None
        self._waiting_ns = None
        self.size, self.sound_ns, self.sound_end = self._file.tell(), now_ns, self.raw_end

    def require_there(self) -> None:
        disk.require_there(self._file.fileno())

    @property
    def due_s(self) -> float | None:
        """In how long a flush is due, by the clock; None where nothing waits."""
        if self._waiting_ns is None:
            return None
        return max(0.0, (self._waiting_ns + CHUNK_NS - self._clock_ns()) * 1e-9)

    def flush_when_due(self) -> bool:
        """Whether it was."""
        if self._waiting_ns is None:
            return False
        # A clock set back counts as due.
        due = not 0 <= self._clock_ns() - self._waiting_ns < CHUNK_NS or self._file.tell() - self.size >= FLUSH_BYTES
        if due:
            self.flush()
        return due

    def lacks_room(self) -> int | None:
        """How many bytes are free on the disk, where they are no longer enough
        to end the file properly after another chunk."""
        free = disk.free_bytes(self._file.fileno())
        return free if free is not None and free < disk.END_BYTES + disk.CHUNK_BYTES * self._chunks else None

    def finish(self) -> None:
        """The indexes and the end of the file, which is on the disk then, and
        closed."""
        if self._begun_ns is not None:
            self._tell_begun(self._begun_ns)
        raw = {"records": str(self.digest.records), "sha256": self.digest.hexdigest()}
        self._mcap.add_metadata(schema.RAW_RECORD, raw)
        if self._end:
            self._mcap.add_metadata(schema.END_RECORD, self._end)
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())
        self.size = self._file.tell()
        disk.require_there(self._file.fileno())
        self._file.close()
        with suppress(PermissionError):
            synchronise(self.path.parent)

    def abandon(self) -> None:
        """Closes the file as it was after the last flush, without its end.
        Raises nothing."""
        raw = getattr(self._file, "raw", None)
        if raw is None or raw.closed:
            return
        with suppress(OSError):
            os.ftruncate(raw.fileno(), self.size)
        with suppress(OSError):
            raw.close()  # past the buffer, whose rest belongs to a chunk that is not whole

    def _write_head(self) -> None:
        self._mcap.start(profile=schema.PROFILE)
        own = {"format": schema.FORMAT} | ({schema.ENDS_WITH: self._head.ends_with} if self._head.ends_with else {})
        for name, record in {schema.FORMAT_RECORD: own, **self._head.metadata}.items():
            self.inventory.metadata(name, record)
            self._mcap.add_metadata(name, dict(record))
        self._channel_ids = self._declare()
        if not self._head.of_the_past:
            self._tell_begun(self._clock_ns())
        self.flush()  # schemas and channels are in the first chunk: have it on disk at once

    def _tell_begun(self, time_ns: int) -> None:
        self.write(schema.EVENTS, schema.Event(time_ns, "recording_started", "{}"))
        self._begun_ns = None

    def _declare(self) -> dict[str, int]:
        """Registers schemas and channels in the order that fixes their ids; the
        channels' ids by topic."""
        ids = {}

        def channel(topic: str, kind: schema.Schema, schema_id: int, said: dict[str, str]) -> None:
            ids[topic] = self._mcap.register_channel(topic, MessageEncoding.Protobuf, schema_id, said)
            described = (kind.name, SchemaEncoding.Protobuf, kind.data)
            self.inventory.channel(topic, MessageEncoding.Protobuf, said, described)

        for topic, name in schema.CHANNELS:
            kind = schema.SCHEMAS[name]
            channel(topic, kind, self._mcap.register_schema(kind.name, SchemaEncoding.Protobuf, kind.data), {})
        if self._head.preview_channels is not None:
            kind = self._head.preview.kind
            schema_id = self._mcap.register_schema(kind.name, SchemaEncoding.Protobuf, kind.data)
            for topic, unit in zip(schema.PREVIEWS, (self._head.preview_unit, "g"), strict=True):
                channel(topic, kind, schema_id, {"unit": unit})
        return ids

    def _add(self, topic: str, time_ns: int, data: bytes) -> None:
        if self._waiting_ns is None:
            self._waiting_ns = self._clock_ns()
        self.inventory.message(topic, time_ns, time_ns, data)
        self._mcap.add_message(self._channel_ids[topic], time_ns, data, time_ns)


def _create(path: Path) -> BinaryIO:
    return open(path, "xb")


# Why a recording came to its end, as its last event says it.

ENDED = "ended"
EndedBecause = Literal["asked", "signal", "disk", "unit gave up", "bus gave up", "failed"]
Kind = Literal["unit", "bus"]


def ended_because(error: BaseException | None, of: Kind = "unit") -> EndedBecause:
    """``error`` is what the recording was left with, None where it was to end;
    ``of`` what was recorded."""
    match error:
        case None:
            return "asked"
        case DiskError():
            return "disk"
        case asyncio.CancelledError() | KeyboardInterrupt():
            return "signal"
        case td.DriverError() | ProvisionError() | TwoAnswer():
            return "unit gave up" if of == "unit" else "bus gave up"
        case _:
            return "failed"
