"""The numbers of a stream in its messages, whatever their encoding."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.logs.times import LONGEST_NS
from triaxcal_drivers.mcap.cdr import CdrReader, members
from triaxcal_drivers.mcap.definitions import message_types
from triaxcal_drivers.mcap.schema import DEFINITION_MOST, MessageSchema

SECONDS = ("sec", "secs", "seconds")
NANOSECONDS = ("nanosec", "nsec", "nsecs", "nanos", "nanoseconds")

Read = Callable[[bytes], tuple[list[float], int | None]]
"""The numbers asked for, and the time stamp in nanoseconds. Raises
ValueError."""


def reader(schema: MessageSchema, paths: Sequence[str], time: str | None, where: str) -> Read:
    """Raises ProfileError; ModuleNotFoundError without rosbags."""
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
    told = f"'{schema.encoding}' by {schema.language or 'no definition'}"
    raise ProfileError(f"{where}: messages encoded as {told}, expected cdr (ros2msg, ros2idl), json or protobuf")


def _cdr(schema: MessageSchema, paths: list[list[str]], stamp: list[str] | None, where: str) -> Read:
    outermost, types = message_types(schema.name, schema.language, schema.definition, where)
    inside = members(types, outermost, stamp) if stamp else set()
    parts = [p for names in (SECONDS, NANOSECONDS) for p in names if p in inside][:2]
    stamps = [[*stamp, part] for part in parts] if stamp and len(parts) == 2 else [stamp] if stamp else []
    read = CdrReader(outermost, types, [*paths, *stamps], where).read

    def numbers(data: bytes) -> tuple[list[float], int | None]:
        found = read(data)
        told = found[len(paths) :]
        return found[: len(paths)], _stamp_ns(*told) if told else None

    return numbers


def _stamp_ns(seconds: float, nanoseconds: float | None = None) -> int:
    """Of a stamp's two parts; of one number where that is all: a float is
    seconds, a whole number nanoseconds. Raises ValueError."""
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
    """Raises ValueError."""
    found = [_at(message, path) for path in paths]
    if not all(isinstance(value, int | float) for value in found):
        raise ValueError("no number")
    try:
        found = [float(value) for value in found]
    except OverflowError as e:
        raise ValueError("a number beyond all measure") from e
    if stamp is None:
        return found, None
    told = _at(message, stamp)
    if isinstance(told, int | float):
        return found, _stamp_ns(told)
    parts = [next((v for name in names if (v := _inside(told, name)) is not None), None) for names in
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
    """The field, or the element, of that name; None where there is none."""
    if isinstance(message, dict):
        return message.get(part)
    if part.isdecimal():
        try:
            return message[int(part)]
        except (IndexError, TypeError, KeyError):
            return None
    return getattr(message, part, None) if hasattr(message, "DESCRIPTOR") else None
