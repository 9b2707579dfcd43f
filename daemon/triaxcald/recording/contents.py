"""What a recording holds, be it one file or many."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import TracebackType
from typing import NamedTuple, Self, TypeVar

from mcap.records import Message

import triaxcal_drivers as td
from triaxcald.errors import RecordingError
from triaxcald.recording import schema
from triaxcald.recording.raw_batch import Fields, batch_of, decode_raw, fields_of

T = TypeVar("T")
JOINED = 1 << 15
"""Raw records that are decoded at once: so many that the cost of a call no
longer counts, and less than a MiB."""
JOINED_BYTES = 8 * 2**20
"""So much is held at most, whatever the messages say of their records: those of
64 bytes, twice over."""


class TopicMessage(NamedTuple):
    topic: str
    message: Message


class Contents(ABC):
    """A context manager. ``metadata`` by record, ``attachments`` by name.

    Every iterator raises RecordingError.
    """

    name: str
    metadata: dict[str, dict[str, str]]
    attachments: Mapping[str, bytes]

    @abstractmethod
    def is_confirmed(self, first: int) -> bool:
        """Whether the raw records of the message that begins with this running
        index are the unit's for all that is known."""

    @property
    @abstractmethod
    def any_unconfirmed(self) -> bool: ...

    def unconfirmed_records(self) -> int:
        """How many raw records are unconfirmed."""
        if not self.any_unconfirmed:
            return 0
        return sum(len(batch) for _, batch in self.joined_batches() if batch.unconfirmed)

    @abstractmethod
    def messages(self, topic: str | None = None) -> Iterator[TopicMessage]:
        """Every message with its topic, undecoded, in the order of the file;
        those of one ``topic`` where it is given."""

    @abstractmethod
    def close(self) -> None: ...

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def phases(self) -> list[str]:
        """In the order in which they began."""
        return list(dict.fromkeys(phase for phase, _ in self.joined_batches()))

    def raw(self, phase: str) -> Iterator[td.RawBatch]:
        """The phase's raw records in the order in which they came, some
        `JOINED` at a time: a live bus hands out few. Without those that are
        unconfirmed: nothing is computed from them."""
        return (batch for _, batch in self._raw(phase.encode()) if not batch.unconfirmed)

    def joined_batches(self) -> Iterator[tuple[str, td.RawBatch]]:
        """All raw records with their phase, likewise, but also those that are
        unconfirmed; the batch says so."""
        return self._raw()

    def raw_batches(self) -> Iterator[tuple[str, td.RawBatch]]:
        """The same in the batches in which they were recorded, of which the
        phases take turns."""
        for first, phase, batch in self._decoded(schema.RAW, decode_raw):
            yield phase, batch if self.is_confirmed(first) else replace(batch, unconfirmed=True)

    def _raw(self, phase: bytes | None = None) -> Iterator[tuple[str, td.RawBatch]]:
        waiting, records, size = list[tuple[int, Fields]](), 0, 0
        for message, fields in self._read(schema.RAW, fields_of):
            if phase is not None and fields.phase != phase:
                continue
            if waiting and not self._belong_together(waiting[0][1], fields):
                yield self._joined(waiting)
                waiting, records, size = [], 0, 0
            waiting.append((message.log_time, fields))
            records, size = records + len(fields.flags), size + len(message.data)
            if records >= JOINED or size >= JOINED_BYTES:
                yield self._joined(waiting)
                waiting, records, size = [], 0, 0
        if waiting:
            yield self._joined(waiting)

    def _belong_together(self, one: Fields, other: Fields) -> bool:
        return one.phase == other.phase and self.is_confirmed(one.first) == self.is_confirmed(other.first)

    def _joined(self, waiting: Sequence[tuple[int, Fields]]) -> tuple[str, td.RawBatch]:
        """Of messages of one phase that are all confirmed, or none of them.
        Raises RecordingError, which names the message at fault."""
        time_ns, first = waiting[0]
        phase = self._decode(schema.RAW, time_ns, first.phase.decode)
        try:
            batch = batch_of([fields for _, fields in waiting])
            return phase, batch if self.is_confirmed(first.first) else replace(batch, unconfirmed=True)
        except ValueError:
            for time_ns, fields in waiting:
                self._decode(schema.RAW, time_ns, partial(batch_of, [fields]))
            raise

    @property
    def ends_with(self) -> str:
        """The format of the document that the whole recording ends with; empty
        where it ends with none."""
        return self.metadata[schema.FORMAT_RECORD].get(schema.ENDS_WITH, "")

    def raw_digest(self) -> schema.RawDigest:
        """Of all raw records; the metadata record ``raw`` says what it was when
        they were written."""
        digest = schema.RawDigest(self.ends_with)
        for phase, batch in self.joined_batches():
            digest.update(phase, batch)
        return digest

    def register_accesses(self) -> Iterator[schema.RegisterAccess]:
        return self._decoded(schema.REGISTERS, schema.decode_register_access)

    def events(self) -> Iterator[schema.Event]:
        return self._decoded(schema.EVENTS, schema.decode_event)

    def losses(self) -> Iterator[schema.Loss]:
        return self._decoded(schema.LOSS, schema.decode_loss)

    def _decoded(self, topic: str, decode: Callable[[bytes], T]) -> Iterator[T]:
        return (value for _, value in self._read(topic, decode))

    def _read(self, topic: str, decode: Callable[[bytes], T]) -> Iterator[tuple[Message, T]]:
        for _, message in self.messages(topic):
            yield message, self._decode(topic, message.log_time, partial(decode, message.data))

    def _decode(self, topic: str, time_ns: int, decode: Callable[[], T]) -> T:
        """Raises RecordingError."""
        try:
            return decode()
        except ValueError as e:
            raise RecordingError(f"{self.name}: {topic} at {time_ns} ns: {e}") from e
