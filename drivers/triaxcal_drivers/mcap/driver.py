"""Sensors whose samples are messages in MCAP files: their profile, the decoder of
a stream (one sample a message, in the order of the log), and the entry point
``mcap``.

The log tells the encoding of its messages; a recording stores it beside its profile
(`MessageSchema`). The decoders of rosbags are not used, as it makes them by running
generated Python. Of CDR, ROS 2's encoding, this file decodes the requested fields
alone. It skips all others and accepts no length beyond the message.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Self, cast

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.hints import clipped, nearest
from triaxcal_drivers.interface import Device, RawBatch, RawFlag, SampleBlock
from triaxcal_drivers.logs.dates import LONGEST_NS
from triaxcal_drivers.mcap.definitions import Described, Fields, message_types
from triaxcal_drivers.profile import (
    CHANNELS_MOST,
    READING_CHANNELS,
    STREAMS_MOST,
    Bundle,
    Profile,
    Strict,
    require_readings,
)

# Numbers in the messages of a stream, in any encoding.

FORMAT = "triaxcal.messages/1"
DEFINITION_MOST = 256 * 2**10  # bytes; the definition of a sensor's message with all its parts has some ten thousand


@dataclass(frozen=True)
class MessageSchema:
    """``encoding`` of the messages (cdr, json, protobuf), and ``language`` of their
    definition (ros2msg, ros2idl, protobuf, jsonschema). A stamp that
    ``stamp_stands_still`` is no time."""

    name: str
    encoding: str
    language: str
    definition: bytes
    stamp_stands_still: bool = False

    def to_bytes(self) -> bytes:
        document = {
            "format": FORMAT,
            "name": self.name,
            "encoding": self.encoding,
            "language": self.language,
            "definition": base64.b64encode(self.definition).decode(),
            "stamp_stands_still": self.stamp_stands_still,
        }
        return (json.dumps(document, indent=1) + "\n").encode()

    @staticmethod
    def of(data: bytes, where: str) -> MessageSchema:
        """Raises ProfileError."""
        try:
            held = json.loads(data)
            if held["format"] != FORMAT:
                raise ValueError(held["format"])
            name, encoding, language = (held[key] for key in ("name", "encoding", "language"))
            if not all(isinstance(text, str) for text in (name, encoding, language)):
                raise TypeError("texts")
            definition = base64.b64decode(held["definition"], validate=True)
            return MessageSchema(name, encoding, language, definition, bool(held["stamp_stands_still"]))
        except (ValueError, KeyError, TypeError, RecursionError, binascii.Error) as e:
            raise ProfileError(f"{where}: expected a description of messages ({FORMAT})") from e


_FORMATS = {
    "bool": "?", "byte": "B", "octet": "B", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H",
    "int32": "i", "uint32": "I", "int64": "q", "uint64": "Q", "float32": "f", "float64": "d",
}  # fmt: skip
_SIZES = {name: struct.calcsize(code) for name, code in _FORMATS.items()}
_ORDERS = {0: (">", 8), 1: ("<", 8), 6: (">", 4), 7: ("<", 4)}
"""Byte order and largest alignment by the second byte of a message, for plain CDR of
versions 1 and 2."""
DEEPEST = 32  # messages within messages; usual ones have three or four

_Requested = dict[str, Any]  # by field: the index of its number among the requested ones, or the requests within it


class CdrReader:
    """Reads the fields at ``paths`` of messages ``outermost``. The constructor raises
    ProfileError if a path leads to no number, or if a line of the definition up to the
    last of them cannot be read."""

    def __init__(self, outermost: str, types: Mapping[str, Fields], paths: Sequence[Sequence[str]], where: str) -> None:
        self._types, self._outermost = types, outermost
        self._count = len(paths)
        self._requested: _Requested = {}
        for place, path in enumerate(paths):
            _number(types, ("message", outermost), path, where)
            at = self._requested
            for part in path[:-1]:
                at = at.setdefault(part, {})
            at[path[-1]] = place
        _Definition(types, self._count, where).walk(("message", outermost), self._requested)

    def read(self, data: bytes) -> list[float]:
        """The numbers at the paths. Raises ValueError if the message does not match its
        definition."""
        if len(data) < 4 or data[0] != 0 or data[1] not in _ORDERS:
            raise ValueError("not plain CDR")
        walk = _Walk(self._types, data[4:], *_ORDERS[data[1]], [0.0] * self._count)
        try:
            walk.field(("message", self._outermost), self._requested, 0)
        except struct.error as e:
            raise ValueError("shorter than its definition") from e
        if walk.left:
            raise ValueError("shorter than its definition")
        return walk.found


class _Definition:
    """One pass through the definition, as `_Walk` goes through a message. All types up
    to the last requested number have to be known."""

    def __init__(self, types: Mapping[str, Fields], left: int, where: str) -> None:
        self._types, self._left, self._where = types, left, where
        self._skipped: set[str] = set()  # messages without a requested number; each is looked at once

    def walk(self, described: Described, requested: Any) -> None:
        """Raises ProfileError."""
        kind, detail = described
        if not self._left:
            return
        if kind == "unread":
            raise ProfileError(_unread(self._where, detail))
        if kind == "base":
            self._left -= isinstance(requested, int)
        elif kind == "message":
            if not isinstance(requested, dict):
                if detail in self._skipped:
                    return
                self._skipped.add(detail)
            if detail not in self._types:
                raise ProfileError(f"{self._where}: their definition lacks that of '{clipped(detail)}'")
            for name, inner in self._types[detail]:
                self.walk(inner, requested.get(name) if isinstance(requested, dict) else None)
        else:
            within = requested if isinstance(requested, dict) else {}
            self._elements(detail[0] if kind == "array" else detail, within)

    def _elements(self, element: Described, requested: _Requested) -> None:
        for inner in requested.values() or (None,):
            self.walk(element, inner)


def _unread(where: str, line: tuple[int, str]) -> str:
    return (
        f"{where}: line {line[0]} of their definition cannot be read, and the profile's fields stand in it or behind "
        f"it: '{clipped(line[1])}'; correct it in the package, or log the topic as JSON or Protobuf"
    )


def members(types: Mapping[str, Fields], outermost: str, path: Sequence[str]) -> set[str]:
    """Names of the fields of the message at ``path``; none if no message is there."""
    at: Described = ("message", outermost)
    for part in path:
        at = dict(types.get(at[1], ())).get(part, ("none", "")) if at[0] == "message" else ("none", "")
    return {name for name, _ in types.get(at[1], ()) if name} if at[0] == "message" else set()


def _number(types: Mapping[str, Fields], at: Described, path: Sequence[str], where: str) -> None:
    """Raises ProfileError if the path from ``at`` leads to no number."""
    for place, part in enumerate(path):
        kind, detail = at
        if kind == "message":
            fields = dict(types.get(detail, ()))
            unread = fields.pop("", None)
            if part not in fields and unread is not None:
                raise ProfileError(_unread(where, unread[1]))
            if part not in fields and detail not in types:
                raise ProfileError(f"{where}: their definition lacks that of '{clipped(detail)}'")
            if part not in fields:
                inside = f" in '{'.'.join(path[:place])}'" if place else ""
                raise ProfileError(f"{where}: no field '{part}'{inside}{nearest(part, fields)}")
            at = fields[part]
        elif kind in ("array", "sequence") and part.isdecimal():
            at = detail[0] if kind == "array" else detail
            if kind == "array" and int(part) >= detail[1]:
                raise ProfileError(f"{where}: '{'.'.join(path)}' is beyond the array's {detail[1]} elements")
        elif kind == "unread":
            raise ProfileError(_unread(where, detail))
        else:
            raise ProfileError(f"{where}: '{'.'.join(path[:place])}' has no field '{part}'")
    if at[0] == "unread":
        raise ProfileError(_unread(where, at[1]))
    if at[0] != "base" or at[1] not in _FORMATS:
        raise ProfileError(f"{where}: '{'.'.join(path)}' is no number")


class _Walk:
    """One pass through one message, up to the last requested field."""

    def __init__(
        self, types: Mapping[str, Fields], data: bytes, order: str, alignment: int, found: list[float]
    ) -> None:
        self._types, self._data, self._order, self._alignment = types, data, order, alignment
        self._at = 0
        self.found, self.left = found, len(found)

    def field(self, described: Described, requested: Any, depth: int) -> None:
        """Reads or skips one field. ``requested`` is the index of its number, or a dict
        of the requests within it. The walk ends after the last requested number."""
        if not self.left:
            return
        if depth > DEEPEST:
            raise ValueError("nested too deeply")
        kind, detail = described
        if kind == "base":
            self._base(detail, requested)
        elif kind == "message":
            for name, inner in self._types[detail]:
                self.field(inner, requested.get(name), depth + 1) if isinstance(requested, dict) else self.field(
                    inner, None, depth + 1
                )
        else:
            element, count = detail if kind == "array" else (detail, self._count())
            self._elements(element, count, requested if isinstance(requested, dict) else {}, depth)

    def _base(self, name: str, requested: Any) -> None:
        if name in ("string", "wstring"):
            length = self._count()
            self._step(length if name == "string" else 2 * length)
            return
        size = _SIZES.get(name)
        if size is None:
            raise ValueError(f"a field of type {name}")
        self._align(size)
        if isinstance(requested, int):
            (self.found[requested],) = struct.unpack_from(self._order + _FORMATS[name], self._data, self._at)
            self.left -= 1
        self._step(size)

    def _elements(self, element: Described, count: int, requested: _Requested, depth: int) -> None:
        size = _SIZES.get(element[1]) if element[0] == "base" else None
        if size and count and not requested:
            self._align(size)
            self._step(count * size)
            return
        if count > len(self._data):
            raise ValueError("a sequence that is longer than the message")
        for i in range(count):
            self.field(element, requested.get(str(i)), depth + 1)

    def _count(self) -> int:
        self._align(4)
        (count,) = struct.unpack_from(self._order + "I", self._data, self._at)
        self._at += 4
        return int(count)

    def _align(self, size: int) -> None:
        self._at += -self._at % min(size, self._alignment)

    def _step(self, count: int) -> None:
        self._at += count
        if self._at > len(self._data):
            raise ValueError("shorter than its definition")


SECONDS = ("sec", "secs", "seconds")
NANOSECONDS = ("nanosec", "nsec", "nsecs", "nanos", "nanoseconds")

Read = Callable[[bytes], tuple[list[float], int | None]]
"""The requested numbers, and the time stamp [ns]. Raises ValueError."""


def reader(schema: MessageSchema, paths: Sequence[str], time: str | None, where: str) -> Read:
    """A decoder for the fields at ``paths`` and the time stamp at ``time``. Raises
    ProfileError; ModuleNotFoundError without protobuf for its messages."""
    if len(schema.definition) > DEFINITION_MOST:
        raise ProfileError(f"{where}: a definition of more than {DEFINITION_MOST} bytes")
    split = [path.split(".") for path in paths]
    stamp = time.split(".") if time else None
    if schema.encoding == "cdr" and schema.language in ("ros2msg", "ros2idl"):
        return _cdr(schema, split, stamp, where)
    if schema.encoding == "json":
        return lambda data: _numbers(_json(data), split, stamp)
    if schema.encoding == "protobuf" and schema.language == "protobuf":
        message = _protobuf(schema, where)
        return lambda data: _numbers(_decoded(message, data), split, stamp)
    encoding = f"'{schema.encoding}' by {schema.language or 'no definition'}"
    raise ProfileError(f"{where}: messages encoded as {encoding}, expected cdr (ros2msg, ros2idl), json or protobuf")


def _cdr(schema: MessageSchema, paths: list[list[str]], stamp: list[str] | None, where: str) -> Read:
    outermost, types = message_types(schema.name, schema.language, schema.definition)
    # The stamp is a message with seconds and nanoseconds, or one number.
    inside = members(types, outermost, stamp) if stamp else set()
    parts = [p for names in (SECONDS, NANOSECONDS) for p in names if p in inside][:2]
    stamps = [[*stamp, part] for part in parts] if stamp and len(parts) == 2 else [stamp] if stamp else []
    read = CdrReader(outermost, types, [*paths, *stamps], where).read

    def numbers(data: bytes) -> tuple[list[float], int | None]:
        found = read(data)
        stamped = found[len(paths) :]
        return found[: len(paths)], _stamp_ns(*stamped) if stamped else None

    return numbers


def _stamp_ns(seconds: float, nanoseconds: float | None = None) -> int:
    """Time [ns] by the two parts of a stamp, or by one number: a float counts seconds,
    an integer nanoseconds. Raises ValueError."""
    try:
        if nanoseconds is not None:
            time_ns = int(seconds) * 1_000_000_000 + int(nanoseconds)
        elif isinstance(seconds, float):
            time_ns = round(seconds * 1e9)
        else:
            time_ns = seconds
    except OverflowError as e:
        raise ValueError("a time that is infinite") from e
    if not -LONGEST_NS < time_ns < LONGEST_NS:
        raise ValueError("a time beyond all measure")
    return time_ns


def _json(data: bytes) -> Any:
    try:
        return json.loads(data)
    except RecursionError as e:
        raise ValueError("nested too deeply") from e


def _protobuf(schema: MessageSchema, where: str) -> Any:
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message import DecodeError
    from google.protobuf.message_factory import GetMessageClass

    pool = DescriptorPool()
    try:
        for file in FileDescriptorSet.FromString(schema.definition).file:
            pool.Add(file)
        return GetMessageClass(pool.FindMessageTypeByName(schema.name))
    except (DecodeError, KeyError, TypeError) as e:
        raise ProfileError(f"{where}: the definition of '{schema.name}' (protobuf) cannot be read") from e


def _decoded(message: Any, data: bytes) -> Any:
    from google.protobuf.message import DecodeError

    try:
        return message.FromString(data)
    except DecodeError as e:
        raise ValueError("not as it is defined") from e


def _numbers(message: Any, paths: list[list[str]], stamp: list[str] | None) -> tuple[list[float], int | None]:
    """The numbers at the paths, and the time stamp [ns]. Raises ValueError."""
    found = [_at(message, path) for path in paths]
    if not all(isinstance(value, int | float) for value in found):
        raise ValueError("no number")
    try:
        found = [float(value) for value in found]
    except OverflowError as e:
        raise ValueError("a number beyond all measure") from e
    if stamp is None:
        return found, None
    # The stamp: one number, or a message with seconds and nanoseconds.
    stamped = _at(message, stamp)
    if isinstance(stamped, int | float):
        return found, _stamp_ns(stamped)
    parts = [next((v for name in names if (v := _inside(stamped, name)) is not None), None) for names in
             (SECONDS, NANOSECONDS)]  # fmt: skip
    if not all(isinstance(part, int | float) for part in parts):
        raise ValueError("no time stamp")
    return found, _stamp_ns(*parts)  # type: ignore[arg-type]


def _at(message: Any, path: list[str]) -> Any:
    for part in path:
        message = _inside(message, part)
        if message is None:
            raise ValueError(f"no field '{part}'")
    return message


def _inside(message: Any, part: str) -> Any:
    """The field of that name, or the element of that index; None if there is none."""
    if isinstance(message, dict):
        return message.get(part)
    if part.isdecimal():
        try:
            return message[int(part)]
        except (IndexError, TypeError, KeyError):
            return None
    return getattr(message, part, None) if hasattr(message, "DESCRIPTOR") else None


# The profile, the decoder and the entry point.

FieldPath = Annotated[
    str,
    Field(
        pattern=r"^[A-Za-z_][A-Za-z0-9_]*(\.([A-Za-z_][A-Za-z0-9_]*|[0-9]{1,6}))*$",
        max_length=256,
        description="fields from the message inwards, and places in arrays from 0: linear_acceleration.x, data.2",
    ),
]


class MessageChannel(Strict):
    """value = field * scale + offset."""

    field: Annotated[FieldPath, Field(description="its place in the message: imu.acceleration.x, data.2")]
    scale: Annotated[float, Field(description="value = field * scale + offset")] = 1.0
    offset: Annotated[float, Field(description="value = field * scale + offset")] = 0.0

    @model_validator(mode="after")
    def _not_zero(self) -> Self:
        if self.scale == 0:
            raise ValueError("scale must not be zero")
        return self


_NAMED = BeforeValidator(
    lambda given: {"field": given} if isinstance(given, str) else given, json_schema_input_type=str | MessageChannel
)


class MessageStream(Strict):
    """The messages of one topic, a sample each."""

    topic: Annotated[str, Field(description="whose messages are the samples")]
    time: Annotated[
        FieldPath | None,
        Field(
            description="the message's own time stamp: a stamp of seconds and nanoseconds, a number of seconds, or a "
            "whole number of nanoseconds; without it, or where it stands still, the time of logging"
        ),
    ] = None
    channels: Annotated[Mapping[str, Annotated[MessageChannel, _NAMED]], Field(max_length=CHANNELS_MOST)]

    @model_validator(mode="after")
    def _complete(self) -> Self:
        require_readings(self.channels)
        return self


class McapProfile(Profile):
    """A sensor whose samples are messages in MCAP files. There is no bus, so
    that it has no registers."""

    streams: Annotated[Mapping[str, MessageStream], Field(max_length=STREAMS_MOST)]
    registers: Annotated[Mapping[str, Any], Field(max_length=0, description="none: there is no bus")] = {}

    def optional_files(self) -> tuple[str, ...]:
        return tuple(map(schema_file, self.streams))


def schema_file(stream: str) -> str:
    """Name of the file with the encoding of a stream's messages. The import makes it
    from the log, and the recording carries it."""
    return f"{stream}.schema.json"


class McapBus(Strict):
    """There is none."""


class MessageDecoder:
    """Decodes one stream.

    **Time.** The time of a message is the log time of the first message plus the
    difference of their stamps; without stamps, its own log time.

    ``source`` is the number of the stream in the profile. Records of other streams
    are skipped. A message that does not match its definition counts as malformed.
    """

    def __init__(self, stream: MessageStream, read: Read, source: int) -> None:
        self._read, self._source = read, source
        self._names = tuple(stream.channels)
        self._scale = np.array([c.scale for c in stream.channels.values()])
        self._offset = np.array([c.offset for c in stream.channels.values()])
        self._count = 0
        self._origin_ns: int | None = None  # log time less stamp, of the first message

    def feed(self, batch: RawBatch) -> SampleBlock:
        times: list[int] = []
        rows: list[list[float]] = []
        errors = malformed = at = 0
        bad = int(RawFlag.ERROR | RawFlag.INVALID)
        columns: Any = zip(
            batch.time_ns.tolist(), batch.source.tolist(), batch.flags.tolist(), batch.length.tolist(), strict=True
        )
        for time_ns, source, flags, length in columns:
            data, at = batch.payload[at : at + length], at + length
            if flags & bad:
                errors += 1
            elif source == self._source:
                try:
                    found, stamp_ns = self._read(data)
                    times.append(self._time_ns(time_ns, stamp_ns))
                except ValueError:
                    malformed += 1
                    continue
                rows.append(found)
        return replace(self._block(times, rows), errors=errors, malformed=malformed)

    def _time_ns(self, logged_ns: int, stamp_ns: int | None) -> int:
        """Time of a sample [ns]. Raises ValueError if the stamps are too far apart."""
        if stamp_ns is None:
            return logged_ns
        if self._origin_ns is None:
            self._origin_ns = logged_ns - stamp_ns
        time_ns = self._origin_ns + stamp_ns
        if not -LONGEST_NS < time_ns < LONGEST_NS:
            raise ValueError("a time beyond all measure")
        return time_ns

    def _block(self, times: list[int], rows: list[list[float]]) -> SampleBlock:
        values = np.array(rows, dtype=np.float64).reshape(len(rows), len(self._names)) * self._scale + self._offset
        counter = self._count + np.arange(len(rows))
        self._count += len(rows)
        columns = [self._names.index(name) for name in READING_CHANNELS]
        auxiliary = {n: values[:, i] for i, n in enumerate(self._names) if n not in READING_CHANNELS}
        return SampleBlock(np.array(times, dtype=np.int64), counter, values[:, columns], auxiliary)


class McapDriver:
    """Messages that other programs logged in MCAP files. There is no device to open."""

    profile_model = McapProfile
    bus_model = McapBus

    def device(self, bundle: Bundle, bus: McapBus) -> Device:
        """Raises ProfileError, as there is no device."""
        raise ProfileError(
            f"profile {bundle.profile.name}: driver 'mcap' reads logs and no bus: `triaxcal log import` takes them"
        )

    def decoder(self, bundle: Bundle, stream: str) -> MessageDecoder:
        """Raises ProfileError if the messages lack a field that the profile names, or
        if their encoding is unknown."""
        profile = cast(McapProfile, bundle.profile)
        where = f"profile {profile.name}"
        if stream not in profile.streams:
            raise ProfileError(f"{where}: no stream '{stream}'{nearest(stream, profile.streams)}")
        name = schema_file(stream)
        if name not in bundle.files:
            raise ProfileError(
                f"{where}: the file '{name}', which says how messages are encoded, is made by `triaxcal log import`"
            )
        schema = MessageSchema.of(bundle.files[name], f"{where}: {name}")
        source = list(profile.streams).index(stream)
        return MessageDecoder(profile.streams[stream], stream_reader(profile, stream, schema), source)


def stream_reader(profile: McapProfile, name: str, schema: MessageSchema) -> Read:
    """Raises ProfileError."""
    stream = profile.streams[name]
    paths = [channel.field for channel in stream.channels.values()]
    time = None if schema.stamp_stands_still else stream.time
    return reader(schema, paths, time, f"profile {profile.name}, streams.{name}, messages '{schema.name}'")
