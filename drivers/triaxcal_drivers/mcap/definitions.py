"""Definitions of ROS 2 messages: the one file that imports rosbags.

Of two libraries that read them, mcap-ros2-support refuses capitals in the names
of fields, which real packages have. rosbags parses; its decoders, which it
makes by running generated Python, are not used.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

from triaxcal_drivers.errors import ProfileError

_IDL_PARTS = re.compile(r"^={80}\nIDL: .*\n", re.MULTILINE)
"""What stands between the files of a definition in IDL (rosbag2)."""

Fields = Sequence[tuple[str, "Described"]]
Described = tuple[str, Any]
"""``("base", name)``, ``("message", name)``, ``("array", (element, length))`` or
``("sequence", element)``."""


def message_types(name: str, language: str, definition: bytes, where: str) -> tuple[str, Mapping[str, Fields]]:
    """The fields of each message by its name, and the name of the outermost
    one. Raises ProfileError; ModuleNotFoundError without rosbags."""
    from rosbags.typesys import get_types_from_idl, get_types_from_msg
    from rosbags.typesys.base import TypesysError

    full = name if "/msg/" in name else name.replace("/", "/msg/", 1)
    try:
        text = definition.decode()
        if language == "ros2idl":
            parts = filter(str.strip, _IDL_PARTS.split(text))
            parsed = {n: fields for part in parts for n, fields in get_types_from_idl(part).items()}
        else:
            parsed = dict(get_types_from_msg(text, full))
    except (TypesysError, UnicodeDecodeError, RecursionError, ValueError, KeyError, AssertionError) as e:
        raise ProfileError(f"{where}: the definition of '{name}' ({language}) cannot be read") from e
    if full not in parsed:
        raise ProfileError(f"{where}: the definition of '{name}' does not hold it")
    return full, {str(n): [(f, _described(d)) for f, d in fields] for n, (_, fields) in parsed.items()}


def _described(desc: Any) -> Described:
    kind = desc[0].name
    if kind == "BASE":
        return "base", str(desc[1][0])
    if kind == "NAME":
        return "message", str(desc[1])
    element, length = desc[1]
    return ("array", (_described(element), int(length))) if kind == "ARRAY" else ("sequence", _described(element))
