"""A batch of raw records as a message, column by column.

Through the message as recordings declare it every number becomes a Python
object first, which takes longer than all else that is done to a record; so it
is written and read by `schema.RAW_COLUMNS`, in which a column is bytes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

import triaxcal_drivers as td
from triaxcald.recording import schema

_STEP_MOST_NS = 2**31 - 1


class Fields(NamedTuple):
    """What a raw batch has by field, its columns still as bytes; empty where it
    has none of a field."""

    first: int = 0
    phase: bytes = b""
    time_ns: bytes = b""
    source: bytes = b""
    flags: bytes = b""
    length: bytes = b""
    payload: bytes = b""
    start_ns: int = 0
    step_ns: bytes = b""


_values = attrgetter(*Fields._fields)
_COLUMNS: Mapping[str, str] = {"time_ns": "<u8", "source": "<u4", "length": "<u4", "step_ns": "<i4"}
_WIDTHS = {name: np.dtype(kind).itemsize for name, kind in _COLUMNS.items()}


def encode_raw(first: int, phase: str, batch: td.RawBatch) -> bytes:
    """``first`` is the running index of the batch's first record among all that
    were offered.

    Frames of a bus have the first time and the steps from each to the next,
    which take a quarter of the room, where all steps are below 2.1 s; records
    of a unit have their times as they are, as they always had.
    """
    start_ns, time_ns, step_ns = 0, b"", b""
    step = np.diff(batch.time_ns) if phase.startswith(schema.BUS_PHASE) else None
    if step is not None and len(batch) and batch.time_ns[0] > 0 and np.all(np.abs(step) <= _STEP_MOST_NS):
        start_ns, step_ns = int(batch.time_ns[0]), step.astype("<i4").tobytes()
    else:
        time_ns = batch.time_ns.astype("<u8").tobytes()
    message = schema.RAW_COLUMNS(
        first=first,
        phase=phase.encode(),
        time_ns=time_ns,
        source=batch.source.astype("<u4").tobytes(),
        flags=batch.flags.tobytes(),
        length=batch.length.astype("<u4").tobytes(),
        payload=batch.payload,
        start_ns=start_ns,
        step_ns=step_ns,
    )
    return bytes(message.SerializeToString())


def decode_raw(data: bytes) -> tuple[int, str, td.RawBatch]:
    """(running index of the first record, phase, batch). Raises ValueError
    where ``data`` is none."""
    fields = fields_of(data)
    return fields.first, fields.phase.decode(), batch_of([fields])


def fields_of(data: bytes) -> Fields:
    """Raises ValueError where ``data`` is no message."""
    try:
        message = schema.RAW_COLUMNS.FromString(data)
    except DecodeError as e:
        raise ValueError("not a message RawBatch") from e
    message.DiscardUnknownFields()
    fields = Fields._make(_values(message))
    # What another writer may make of the same has another size: a field given
    # twice or with nothing in it, a column not packed, a field of a later
    # version.
    ours = message.ByteSize() == len(data)
    if ours and not any(len(getattr(fields, name)) % width for name, width in _WIDTHS.items()):
        return fields
    return _of_another_writer(data)


def batch_of(messages: Sequence[Fields]) -> td.RawBatch:
    """The records of messages, one after the other. Raises ValueError where one
    of them does not hold what it should."""
    time_ns = _times_ns(messages[0]) if len(messages) == 1 else _all_times_ns(messages)
    counts = np.array([len(m.flags) for m in messages])
    most = max(max(len(m.flags), len(m.time_ns) // 8, len(m.step_ns) // 4) for m in messages)
    if most > schema.MAX_RECORDS:
        raise ValueError(f"{most} records in one message, expected at most {schema.MAX_RECORDS}")
    length = np.frombuffer(b"".join(m.length for m in messages), dtype="<u4")
    if np.any(length > np.iinfo(np.uint16).max):
        raise ValueError(f"a record of {length.max()} bytes, expected at most {np.iinfo(np.uint16).max}")
    batch = td.RawBatch(
        time_ns,
        np.frombuffer(b"".join(m.source for m in messages), dtype="<u4").astype(np.uint32),
        np.frombuffer(b"".join(m.flags for m in messages), dtype=np.uint8),
        length.astype(np.uint16),
        b"".join(m.payload for m in messages),
    )
    if not _each_is_whole(messages, counts, length):
        raise ValueError("columns of a message differ in length")
    return batch


def _each_is_whole(messages: Sequence[Fields], counts: NDArray[np.int64], length: NDArray[np.uint32]) -> bool:
    """Whether no message lacks what another has too much."""
    whole = all(len(m.source) == len(m.length) == 4 * len(m.flags) for m in messages)
    ends = np.concatenate([[0], np.cumsum(length, dtype=np.int64)])[np.concatenate([[0], np.cumsum(counts)])]
    return whole and np.array_equal(np.diff(ends), [len(m.payload) for m in messages])


def _all_times_ns(messages: Sequence[Fields]) -> NDArray[np.int64]:
    """Raises ValueError where a message has not as many as records."""
    if all(not m.start_ns and len(m.time_ns) == 8 * len(m.flags) for m in messages):
        return np.frombuffer(b"".join(m.time_ns for m in messages), dtype="<u8").astype(np.int64)
    each = [_times_ns(m) for m in messages]
    if any(len(times) != len(m.flags) for times, m in zip(each, messages, strict=True)):
        raise ValueError("columns of a message differ in length")
    return np.concatenate(each)


def _times_ns(fields: Fields) -> NDArray[np.int64]:
    if not fields.start_ns:
        return np.frombuffer(fields.time_ns, dtype="<u8").astype(np.int64)
    if fields.time_ns:
        raise ValueError("times in two ways, expected one of them")
    steps = np.frombuffer(fields.step_ns, dtype="<i4").astype(np.int64)
    # A start beyond int64 wraps, as such a time in the column does.
    start = np.array([fields.start_ns], dtype=np.uint64).astype(np.int64)
    return np.cumsum(np.concatenate((start, steps)))


def _of_another_writer(data: bytes) -> Fields:
    """By the message as recordings declare it. Raises ValueError."""
    message = schema.parse("RawBatch", data)
    columns = {name: np.array(getattr(message, name), dtype=kind).tobytes() for name, kind in _COLUMNS.items()}
    return Fields(
        first=message.first,
        phase=message.phase.encode(),
        flags=message.flags,
        payload=message.payload,
        start_ns=message.start_ns,
        **columns,
    )
