"""Writes one unit's recording, on a thread of its own so that no disk ever
holds up a bus."""

from __future__ import annotations

import hashlib
import json
import os
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, Self

from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import Writer as McapWriter

from triaxcal_drivers.interface import RawBatch, SampleBlock
from triaxcald.abort import Left, add_action, discard_action
from triaxcald.errors import DiskError, RecordingError
from triaxcald.recording import schema
from triaxcald.recording.inventory import Document, Inventory

CHUNK_NS = 1_000_000_000  # no record waits longer than this for the operating system to have it


class RecordingWriter:
    """An MCAP recording being written; every method but `drain` and `close`
    returns at once.

    ``metadata`` are named records of strings (run, station, unit, software).
    ``clock_ns`` is the host's time since the epoch; chunks close by it. At most
    ``queue_batches`` raw batches and preview blocks wait for the disk; what
    comes when the queue is full is dropped, counted in `losses` and noted in
    the file. Registers, events and attachments are few and never dropped.
    ``ends_with`` is the format of the document that `seal` will be given.

    Raises RecordingError, here and from every method: the file exists already
    or the disk has failed.
    """

    def __init__(
        self,
        path: Path,
        *,
        metadata: Mapping[str, Mapping[str, str]],
        preview_channels: Sequence[str] = (),
        preview_unit: str = "",
        preview_hz: float = schema.PREVIEW_HZ,
        clock_ns: Callable[[], int] = time.time_ns,
        queue_batches: int = 256,
        ends_with: str = "",
    ) -> None:
        self.path = path
        self.losses: dict[str, int] = {}
        self._clock_ns = clock_ns
        self._preview = schema.PreviewEncoder(preview_channels)
        self._decimators = {topic: schema.Decimator(preview_hz) for topic in schema.PREVIEWS}
        self.ends_with = ends_with
        self._digest = schema.RawDigest(ends_with)
        self._end: dict[str, str] = {}
        self._inventory = Inventory()
        self._offered = 0
        self._attached: set[str] = set()
        self._unreported: list[tuple[str, int, int]] = []  # topic, first, records
        self._failure: RecordingError | None = None
        self._closed = False
        self._flushed_ns: int | None = None  # when the oldest record not yet flushed was written
        self._order = threading.Lock()
        self._room = threading.Semaphore(queue_batches)
        self._jobs: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        head = {name: dict(record) for name, record in metadata.items()}
        try:
            self._file = _create(path)
            self._mcap = McapWriter(self._file, enable_data_crcs=True)
            self._write_head(head, preview_unit)
        except FileExistsError:
            raise RecordingError(f"{path}: exists already; a recording is never overwritten") from None
        except OSError as e:
            raise RecordingError(f"{path}: cannot be created: {e.strerror}") from e
        # A caller that dies without closing must not be kept alive by it; `log
        # recover` finishes the file.
        self._thread = threading.Thread(target=self._run, name=f"recording {path.name}", daemon=True)
        self._thread.start()
        add_action(self, self._finish_at_abort)

    def raw(self, phase: schema.Phase, batch: RawBatch) -> bool:
        """Whether there was room for the batch."""
        self._check()
        with self._order:
            first = self._offered
            self._offered += len(batch)
            return self._offer(schema.RAW, first, len(batch), partial(self._write_raw, phase, first, batch))

    def preview(self, topic: schema.PreviewTopic, block: SampleBlock) -> bool:
        """Keeps the block's samples at the preview rate; whether there was room
        for them."""
        self._check()
        with self._order:
            picked = self._decimators[topic].pick(block)
            if not picked:
                return True
            return self._offer(topic, 0, len(picked), partial(self._write_preview, topic, block, picked))

    def register(
        self, name: str, operation: schema.Operation, raw: bytes, error: str = "", *, unanswered: bool = False
    ) -> None:
        self._check()
        access = schema.RegisterAccess(self._clock_ns(), name, operation, raw, error, unanswered)
        self._jobs.put(partial(self._write, schema.REGISTERS, access))

    def event(self, kind: str, detail: Mapping[str, Any] | None = None) -> None:
        """``detail`` goes in as JSON."""
        self._check()
        event = schema.Event(self._clock_ns(), kind, json.dumps(dict(detail or {}), sort_keys=True))
        self._jobs.put(partial(self._write, schema.EVENTS, event))

    def attach(self, name: str, media_type: str, data: bytes) -> None:
        self._check()
        if name in self._attached:
            raise RecordingError(f"{self.path}: there is an attachment '{name}' already")
        self._attached.add(name)
        self._jobs.put(partial(self._write_attachment, self._clock_ns(), name, media_type, data))

    def seal(self, name: str, media_type: str, make: Callable[[Document], bytes]) -> None:
        """The last attachment, made from the inventory of all that is in the
        file before it; closes the recording."""
        self._check()
        time_ns = self._clock_ns()

        def write() -> None:
            self._report_losses()
            data = make(self._inventory.document())
            self._write_attachment(time_ns, name, media_type, data)
            self._end = {"name": name, "sha256": hashlib.sha256(data).hexdigest()}

        self._jobs.put(write)
        self.close()

    def drain(self) -> None:
        """Waits until the operating system has all that was given before."""
        self._check()
        done = threading.Event()
        self._jobs.put(self._flush)
        self._jobs.put(done.set)
        while not done.wait(0.05):
            self._check()

    @property
    def raw_sha256(self) -> str:
        """Digest of the raw records in the file; complete after `drain` or
        `close`."""
        return self._digest.hexdigest()

    def close(self) -> None:
        """Writes what is waiting, the indexes and the end of the file."""
        if not self._closed:
            self._closed = True
            self._jobs.put(None)
        self._thread.join()
        discard_action(self)
        if self._failure is not None:
            raise self._failure

    def _finish_at_abort(self, until_s: float) -> Left:
        self._closed = True
        self._jobs.put(None)
        self._thread.join(max(0.0, until_s - time.monotonic()))
        if self._thread.is_alive():
            return Left(f"{self.path} is not finished; triaxcal log recover mends it")
        return Left(str(self._failure) if self._failure else f"{self.path} is finished")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.close()
        except RecordingError as e:
            if value is None:
                raise
            value.add_note(str(e))  # what is on its way already weighs more

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure
        if self._closed:
            raise RecordingError(f"{self.path}: the recording is closed")

    def _offer(self, topic: str, first: int, records: int, job: Callable[[], None]) -> bool:
        if self._room.acquire(blocking=False):
            self._jobs.put(partial(self._make_room, job))
            return True
        self.losses[topic] = self.losses.get(topic, 0) + records
        for i, (lost, lost_first, lost_records) in enumerate(self._unreported):
            if lost == topic and (topic != schema.RAW or lost_first + lost_records == first):
                self._unreported[i] = (topic, lost_first, lost_records + records)
                return False
        self._unreported.append((topic, first, records))
        return False

    # What follows runs on the writer's thread, but for the head.

    def _run(self) -> None:
        ended = False
        try:
            while (job := self._next_job()) is not None:
                job()
                self._report_losses()
                self._flush_when_due()
            self._write_end()
            ended = True
        except OSError as e:
            self._failure = DiskError(f"{self.path}: writing failed: {e.strerror or e}")
        finally:
            if not ended and self._failure is None:
                self._failure = RecordingError(f"{self.path}: the writer stopped on a fault of its own")
            with suppress(OSError):  # the disk's failure is known by now
                self._file.close()

    def _next_job(self) -> Callable[[], None] | None:
        while True:
            try:
                return self._jobs.get(timeout=CHUNK_NS / 1e9 if self._flushed_ns is not None else None)
            except queue.Empty:
                self._flush_when_due()

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

    def _flush_when_due(self) -> None:
        now_ns = self._clock_ns()
        # A clock set back counts as due.
        if self._flushed_ns is not None and not 0 <= now_ns - self._flushed_ns < CHUNK_NS:
            self._flush()

    def _flush(self) -> None:
        self._mcap.flush()  # type: ignore[no-untyped-call]
        self._flushed_ns = None

    def _write_head(self, metadata: Mapping[str, dict[str, str]], unit: str) -> None:
        self._mcap.start(profile=schema.PROFILE)
        own = {"format": schema.FORMAT} | ({schema.ENDS_WITH: self.ends_with} if self.ends_with else {})
        for name, record in {schema.FORMAT_RECORD: own, **metadata}.items():
            self._inventory.metadata(name, record)
            self._mcap.add_metadata(name, record)
        self._channel_ids = _declare(self._mcap, self._inventory, self._preview.kind, unit)
        self._write(schema.EVENTS, schema.Event(self._clock_ns(), "recording_started", "{}"))
        self._flush()  # schemas and channels are in the first chunk: have it on disk at once

    def _write_raw(self, phase: str, first: int, batch: RawBatch) -> None:
        for piece in schema.cut(batch):
            time_ns = int(piece.time_ns[-1]) if len(piece) else self._clock_ns()
            self._add(schema.RAW, time_ns, schema.encode_raw(first, phase, piece))
            self._digest.update(phase, piece)
            first += len(piece)

    def _write_preview(self, topic: str, block: SampleBlock, picked: Sequence[int]) -> None:
        for i in picked:
            self._add(topic, int(block.time_ns[i]), self._preview.encode(block, i))

    def _write(self, topic: str, value: schema.RegisterAccess | schema.Event | schema.Loss) -> None:
        self._add(topic, value.time_ns, schema.encode(value))

    def _write_attachment(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        self._inventory.attachment(name, media_type, time_ns, data)
        self._mcap.add_attachment(time_ns, time_ns, name, media_type, data)
        self._flush()

    def _add(self, topic: str, time_ns: int, data: bytes) -> None:
        if self._flushed_ns is None:
            self._flushed_ns = self._clock_ns()
        self._inventory.message(topic, time_ns, time_ns, data)
        self._mcap.add_message(self._channel_ids[topic], time_ns, data, time_ns)

    def _write_end(self) -> None:
        self._report_losses()
        raw = {"records": str(self._digest.records), "sha256": self._digest.hexdigest()}
        self._mcap.add_metadata(schema.RAW_RECORD, raw)
        if self._end:
            self._mcap.add_metadata(schema.END_RECORD, self._end)
        self._mcap.finish()  # type: ignore[no-untyped-call]
        self._file.flush()
        os.fsync(self._file.fileno())


def _create(path: Path) -> BinaryIO:
    return open(path, "xb")


def _declare(mcap: McapWriter, inventory: Inventory, preview: schema.Schema, unit: str) -> dict[str, int]:
    """Registers schemas and channels in the order that fixes their ids; the
    channels' ids by topic."""
    ids = {}

    def channel(topic: str, kind: schema.Schema, schema_id: int, said: dict[str, str]) -> None:
        ids[topic] = mcap.register_channel(topic, MessageEncoding.Protobuf, schema_id, said)
        inventory.channel(topic, MessageEncoding.Protobuf, said, (kind.name, SchemaEncoding.Protobuf, kind.data))

    for topic, name in schema.CHANNELS:
        kind = schema.SCHEMAS[name]
        channel(topic, kind, mcap.register_schema(kind.name, SchemaEncoding.Protobuf, kind.data), {})
    schema_id = mcap.register_schema(preview.name, SchemaEncoding.Protobuf, preview.data)
    for topic, topic_unit in zip(schema.PREVIEWS, (unit, "g"), strict=True):
        channel(topic, preview, schema_id, {"unit": topic_unit})
    return ids
