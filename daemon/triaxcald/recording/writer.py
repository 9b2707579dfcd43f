"""Writes a recording on a thread of its own, so that no disk delays a bus."""

from __future__ import annotations

import asyncio
import hashlib
import json
import math
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Literal, Self

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer as McapWriter

import triaxcal_drivers as td
from triaxcald.abort import AbortNotice, add_action, discard_action
from triaxcald.errors import DiskError, ProvisionError, RecordingError, TwoAnswer
from triaxcald.files import exists_already, require_new, synchronise
from triaxcald.memory import ran_out_of_memory
from triaxcald.recording import disk, schema
from triaxcald.recording.manifest import Document, End, Inventory, Sign
from triaxcald.recording.schema import encode_raw

# The file of a recording while it is written, by one thread.

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
        self._end: End | None = None
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
        self._mcap.flush()  # type: ignore[no-untyped-call]  # first the records that the attachment rests on
        self._mcap.add_attachment(time_ns, time_ns, name, media_type, data)
        self.flush()

    def seal(self, time_ns: int, name: str, media_type: str, make: Callable[[Document], bytes]) -> None:
        """The last attachment, made from the inventory of all before it."""
        data = make(self.inventory.document())
        self._end = End(name, media_type, time_ns, data)
        self._mcap.flush()  # type: ignore[no-untyped-call]  # as `attach`, but for the inventory, which is complete
        self._mcap.add_attachment(time_ns, time_ns, name, media_type, data)
        self.flush()

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

    def finish(self, sign: Sign | None = None) -> None:
        """The signature of a sealed recording, the indexes and the end of the file,
        which is on the disk then, and closed. Raises what ``sign`` raises."""
        if self._begun_ns is not None:
            self._tell_begun(self._begun_ns)
        closing = {schema.RAW_RECORD: self.digest.record()}
        if self._end is not None:
            digest = hashlib.sha256(self._end.data).hexdigest()
            closing[schema.END_RECORD] = {"name": self._end.name, "sha256": digest}
        if sign is None or self._end is None:
            self._write_end(closing)
            return
        with sign(self.inventory.sealed(self._end, closing)) as made:
            at_ns = self._end.time_ns
            self._mcap.add_attachment(at_ns, at_ns, made.name, made.media_type, made.data)
            self._write_end(closing)

    def _write_end(self, closing: Mapping[str, Mapping[str, str]]) -> None:
        for name, record in closing.items():
            self._mcap.add_metadata(name, dict(record))
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


# The thread that writes, and the queue before it.

LOOK_S = 1.0
"""Period in which an idle writer checks the age of its segment; earlier if written data
is due for the operating system."""

BEHIND_S = 5.0
"""Time after the last lost batch until the disk counts as fast enough again: a slightly
slow disk loses a batch now and then."""


class RecordingWriter:
    """An MCAP recording being written; every method but `drain` and `close`
    returns at once.

    ``metadata`` are named records of strings (run, station, unit, software).
    ``preview_channels`` is None where there are to be no previews. ``clock_ns``
    is the host's time since the epoch; chunks close by it, and at least every
    ``sync_s`` they are forced to the disk. At most ``queue_batches`` raw
    batches and preview blocks wait for the disk; what comes when the queue is
    full is dropped, counted in `losses` and noted in the file, unless the
    caller ``waits`` for room. Registers, events and attachments are few and
    never dropped. ``ends_with`` is the format of the document that `seal` will
    be given. A ``provisional`` file is removed by the caller where it does not
    come to its end, so that nothing is said of how far it is sound. Raw records
    may be ``of_the_past``, as `Head` has it.

    Where the disk has hardly room left, the file is ended while there is room
    for its end.

    Raises RecordingError, here and from every method: the file exists already
    or the disk has failed (DiskError).
    """

    def __init__(
        self,
        path: Path,
        *,
        metadata: Mapping[str, Mapping[str, str]],
        preview_channels: Sequence[str] | None = (),
        preview_unit: str = "",
        preview_hz: float = schema.PREVIEW_HZ,
        clock_ns: Callable[[], int] = time.time_ns,
        queue_batches: int = 256,
        ends_with: str = "",
        sync_s: float = SYNC_S,
        waits: bool = False,
        provisional: bool = False,
        of_the_past: bool = False,
    ) -> None:
        self.path = path
        self._provisional = provisional
        self.losses: dict[str, int] = {}
        self.warning: str | None = None
        """Fault of the earlier recording that this one continues."""
        self.ends_with = ends_with
        self._clock_ns, self._sync_s, self._waits = clock_ns, sync_s, waits
        self._decimators = {topic: schema.Decimator(preview_hz) for topic in schema.PREVIEWS}
        self._attached: set[str] = set()
        self._unreported: list[tuple[str, int, int]] = []  # topic, first, records
        self._failure: RecordingError | None = None
        self._closed = self._finished = False
        self._sign: Sign | None = None
        self._dropped_s = -math.inf  # when raw records were last lost
        self._order = threading.Lock()
        self._room = threading.Semaphore(queue_batches)
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._file = self._begin(Head(metadata, preview_channels, preview_unit, ends_with, of_the_past))
        self._offered = self._file.raw_end
        # The thread must not keep a failed process alive; `log recover` finishes the
        # file.
        self._thread = threading.Thread(target=self._run, name=f"recording {path.name}", daemon=True)
        self._thread.start()
        add_action(self, self._finish_at_abort)

    def _begin(self, head: Head) -> RecordingFile:
        require_new(self.path)
        if not self._provisional:
            disk.require_room(self.path)
        return RecordingFile(self.path, head, clock_ns=self._clock_ns, sync_s=self._sync_s)

    @property
    def current(self) -> Path:
        """Path of the file being written."""
        return self._file.path

    @property
    def queued(self) -> int:
        """Number of batches, blocks and events that wait for the disk."""
        return self._jobs.qsize()

    @property
    def keeps_for(self) -> str | None:
        """An unreadable document, because of which retention deletes nothing."""
        return None

    @property
    def is_behind(self) -> bool:
        """Whether the disk is too slow: raw records were lost within `BEHIND_S`, or the
        disk has made no progress since."""
        hangs = any(topic == schema.RAW for topic, _, _ in self._unreported)
        return hangs or time.monotonic() - self._dropped_s < BEHIND_S

    @property
    def resumes(self) -> td.Gap | None:
        """The open gap before this writer's first record, if it continues an earlier
        recording."""
        return None

    def raw(self, phase: str, batch: td.RawBatch) -> bool:
        """Hand over a batch; False if the queue is full and it is dropped."""
        self.check()
        with self._order:
            first = self._offered
            self._offered += len(batch)
            return self._offer(schema.RAW, first, len(batch), partial(self._write_raw, phase, first, batch))

    def preview(self, topic: schema.PreviewTopic, block: td.SampleBlock) -> bool:
        """Hand over the block's samples at the preview rate; False if the queue is full
        and they are dropped."""
        self.check()
        with self._order:
            picked = self._decimators[topic].pick(block)
            if not picked:
                return True
            return self._offer(topic, 0, len(picked), partial(self._write_preview, topic, block, picked))

    def register(
        self, name: str, operation: schema.Operation, raw: bytes, error: str = "", *, unanswered: bool = False
    ) -> None:
        self.check()
        access = schema.RegisterAccess(self._clock_ns(), name, operation, raw, error, unanswered)
        self._jobs.put(partial(self._write, schema.REGISTERS, access))

    def event(self, kind: str, detail: Mapping[str, Any] | None = None) -> None:
        """Write an event; ``detail`` is stored as JSON."""
        self.check()
        event = schema.Event(self._clock_ns(), kind, json.dumps(dict(detail or {}), sort_keys=True))
        self._jobs.put(partial(self._write, schema.EVENTS, event))

    @property
    def offered(self) -> int:
        """Running index after the last raw record handed over."""
        return self._offered

    def unconfirmed(self, first: int, detail: Mapping[str, Any]) -> None:
        """Mark the raw records from the running index ``first`` on as unconfirmed,
        because another unit answered later.

        A metadata record states it, which a reader finds without unpacking messages,
        and an event with ``detail``. No raw record may follow.
        """
        self.check()
        told = {"first": str(first), "end": str(self._offered)}
        self._jobs.put(partial(self._write_unconfirmed, first, told))
        self.event(schema.UNCONFIRMED, {**detail, "first": first, "records": self._offered - first})

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        self.check()
        if name in self._attached:
            raise RecordingError(f"{self.path}: there is an attachment '{name}' already")
        self._attached.add(name)
        self._jobs.put(partial(self._write_attachment, self._clock_ns(), name, media_type, data))

    def seal(self, name: str, media_type: str, make: Callable[[Document], bytes], sign: Sign | None = None) -> None:
        """Write the last attachment, made from the inventory of the file before it,
        ``sign`` it if given, and close the recording."""
        self.check()
        self._sign = sign
        time_ns = self._clock_ns()

        def write() -> None:
            self._report_losses()
            self._file.seal(time_ns, name, media_type, make)

        self._jobs.put(write)
        self.close()

    def drain(self) -> None:
        """Wait until the operating system has all earlier data."""
        self.check()
        done = threading.Event()
        self._jobs.put(self._flush)
        self._jobs.put(done.set)
        while not done.wait(0.05):
            self.check()

    @property
    def raw_sha256(self) -> str:
        """Digest of the raw records in the file; complete after `drain` or
        `close`."""
        return self._file.digest.hexdigest()

    @property
    def size(self) -> int:
        """Size of the file in bytes."""
        return self._file.size

    @property
    def closed(self) -> bool:
        return self._closed

    def close(self, because: EndedBecause | None = None) -> None:
        """Write the waiting data, an event with the reason ``because`` if given, the
        indexes and the end of the file."""
        if not self._closed:
            if because is not None and self._failure is None:
                self.event(ENDED, {"reason": because})
            self._closed = True
            self._jobs.put(None)
        self._thread.join()
        discard_action(self)
        if self._failure is not None:
            raise self._failure

    def _finish_at_abort(self, until_s: float) -> AbortNotice | None:
        self._closed = True
        self._jobs.put(None)
        self._thread.join(max(0.0, until_s - time.monotonic()))
        if self._provisional:
            return None
        if self._thread.is_alive():
            return AbortNotice(f"{self._reported_path} is not finished; triaxcal log recover mends it")
        return AbortNotice(str(self._failure) if self._failure else f"{self._reported_path} is finished")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._leave(value)
        except RecordingError as e:
            if value is None:
                raise
            value.add_note(str(e))  # the current error has priority

    @property
    def _reported_path(self) -> Path:
        """The file named in messages."""
        return self.path

    def _leave(self, error: BaseException | None) -> None:
        """Close at the end of the context, which ``error`` ended."""
        self.close()

    def check(self) -> None:
        if self._failure is not None:
            raise self._failure
        if self._closed:
            raise RecordingError(f"{self.path}: the recording is closed")

    def _offer(self, topic: str, first: int, records: int, job: Callable[[], None]) -> bool:
        if self._room.acquire(blocking=False) or (self._waits and self._wait_for_room()):
            self._jobs.put(partial(self._make_room, job))
            return True
        self.losses[topic] = self.losses.get(topic, 0) + records
        if topic == schema.RAW:
            self._dropped_s = time.monotonic()
        for i, (lost, lost_first, lost_records) in enumerate(self._unreported):
            if lost == topic and (topic != schema.RAW or lost_first + lost_records == first):
                self._unreported[i] = (topic, lost_first, lost_records + records)
                return False
        self._unreported.append((topic, first, records))
        return False

    def _wait_for_room(self) -> bool:
        while not self._room.acquire(timeout=0.05):
            self.check()
        return True

    # The methods below run on the writer's thread.

    def _run(self) -> None:
        try:
            while (job := self._next_job()) is not None:
                job()
                self._report_losses()
                self._look_after()
            self._report_losses()
            self._finish()
        except OSError as e:
            self._failure = disk.not_written(self._reported_path, e, self._sound_ns)
        except RecordingError as e:
            self._failure = e
        except Exception as e:
            if not ran_out_of_memory(e):
                raise
            self._failure = disk.out_of_memory(self._reported_path, e, self._sound_ns)
        finally:
            if self._failure is None and not self._finished:
                self._failure = RecordingError(f"{self.path}: the writer stopped on a fault of its own")
            self._file.abandon()

    @property
    def _sound_ns(self) -> int | None:
        return None if self._provisional else self._file.sound_ns

    def _finish(self) -> None:
        self._file.finish(self._sign)
        self._finished = True

    def _next_job(self) -> Callable[[], None] | None:
        while True:
            try:
                due_s = self._file.due_s
                return self._jobs.get(timeout=LOOK_S if due_s is None else min(LOOK_S, due_s))
            except queue.Empty:
                self._idle()

    def _idle(self) -> None:
        """Check file and segment after `LOOK_S` without a job."""
        self._file.require_there()
        self._look_after()
        self._flushed()

    def _look_after(self) -> None:
        if self._file.flush_when_due():
            self._flushed()

    def _flush(self) -> None:
        self._file.flush()
        self._flushed()

    def _flushed(self) -> None:
        if (free := self._file.lacks_room()) is not None:
            self._end_for_lack_of_room(free)

    def _end_for_lack_of_room(self, free: int) -> None:
        """End the recording because of a full disk. Raises DiskError."""
        detail = json.dumps({"reason": "disk", "free_bytes": free}, sort_keys=True)
        self._file.write(schema.EVENTS, schema.Event(self._file.told_ns, ENDED, detail))
        self._finish()
        raise disk.ended_early(self._reported_path, free, self._sound_ns)

    def _make_room(self, job: Callable[[], None]) -> None:
        job()
        self._room.release()

    def _report_losses(self) -> None:
        if not self._unreported:
            return
        with self._order:
            lost, self._unreported = self._unreported, []
        for topic, first, records in lost:
            loss = schema.Loss(self._clock_ns(), topic, first, records, "the queue to the disk was full")
            self._write(schema.LOSS, loss)

    def _write_raw(self, phase: str, first: int, batch: td.RawBatch) -> None:
        self._file.raw(phase, first, batch)

    def _write_preview(self, topic: str, block: td.SampleBlock, picked: Sequence[int]) -> None:
        self._file.preview(topic, block, picked)

    def _write(self, topic: str, value: schema.RegisterAccess | schema.Event | schema.Loss) -> None:
        self._file.write(topic, value)

    def _write_unconfirmed(self, first: int, told: Mapping[str, str]) -> None:
        self._file.metadata(schema.UNCONFIRMED, told)

    def _write_attachment(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        self._file.attach(time_ns, name, media_type, data)
