"""TOML of whoever wrote it as a model: bounded before it is parsed, and the first
fault of a profile, station or device file as one line, with the line it is in.

Time and memory of the parser go with the square of a key's parts, and it calls
itself for each level of nesting.
"""

from __future__ import annotations

import json
import re
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ValidationError

from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.files import TooLarge, read_whole, size, special_kind
from triaxcal_drivers.hints import clipped, nearest

SIZE_MOST = 256 * 2**10
"""Bytes. A profile of a hundred registers has 15 KiB, a unit in a station file
200 bytes."""
DEPTH_MOST = 16  # brackets within brackets; ours are at most 5 deep
PARTS_MOST = 16  # of a dotted key; ours have at most 4
WORD_MOST = 128  # characters of a bare key or a number, which has some 20

_TOKENS = re.compile(
    r'''(?P<text>"""(?:\\.|[^\\])*?"{3,5}|\'\'\'.*?\'{3,5}|"(?:\\.|[^"\\\n])*"|'[^'\n]*')'''
    r"""|\#[^\n]*|(?P<word>[\w+:-]+)|(?P<mark>[\[\]{}.])|(?P<space>[ \t]+)|(?P<other>\S|\n)""",
    re.DOTALL,
)


PROFILE, STATION, DEVICE, TRUST = "triaxcal.profile/1", "triaxcal.station/1", "triaxcal.device/1", "triaxcal.trust/1"
_CALLED = {
    PROFILE: "a profile",
    STATION: "a station file",
    DEVICE: "the file of a simulated device",
    TRUST: "a file of trusted keys",
}


def read_toml(path: Path, *, expected: str, pipe: bool = False) -> bytes:
    """All of a file of this format. Raises OSError with a reason to show."""
    try:
        return read_whole(path, SIZE_MOST, pipe=pipe)
    except TooLarge as e:
        if known := special_kind(e.head, toml=False):
            raise OSError(e.errno, f"{known}, expected {_called(expected)}") from None
        raise OSError(e.errno, f"larger than the {size(SIZE_MOST)} that {_CALLED[expected]} may have") from None


def parse_toml(text: bytes, *, where: str, expected: str | None = None) -> dict[str, Any]:
    """Raises ProfileError with the line at fault, or with what the text is where
    it is of another kind than ``expected``, one of the formats. A format that
    nobody knows is left to whoever validates."""
    if known := special_kind(text, toml=False):
        raise ProfileError(f"{where}: {known}, expected {_called(expected)}")
    data = _parsed(text, where, "" if expected is None else f"; expected {_called(expected)}")
    named = data.get("format")
    if expected is not None and isinstance(named, str) and named in _CALLED and named != expected:
        raise ProfileError(f"{where}: {_called(named)}, expected {_called(expected)}")
    return data


def _called(expected: str | None) -> str:
    return "TOML" if expected is None else f"{_CALLED[expected]} ({expected})"


def _parsed(text: bytes, where: str, expected: str) -> dict[str, Any]:
    try:
        shown = text.decode("utf-8")
        _bound(shown, where)
        return tomllib.loads(shown)
    except UnicodeDecodeError as e:
        raise ProfileError(f"{where}: not UTF-8 text (byte {e.start}){expected}") from e
    except ValueError as e:
        raise ProfileError(f"{where}: not TOML: {e}{expected}") from e


def _bound(text: str, where: str) -> None:
    """Raises ProfileError where the parser would be at it for long; what is no
    TOML at all is left to the parser."""
    if len(text) > SIZE_MOST:
        raise ProfileError(f"{where}: {len(text)} characters, expected at most {SIZE_MOST}")
    depth = parts = 0
    for token in _TOKENS.finditer(text):
        kind, mark = token.lastgroup, token["mark"]
        if token[0] in ("'", '"'):  # a text without an end, at which the parser ends too
            return
        parts = parts + (mark == ".") if kind in ("text", "word", "space") or mark == "." else 0
        depth = max(0, depth + (mark in ("[", "{")) - (mark in ("]", "}"))) if mark else depth
        fault = None
        if depth > DEPTH_MOST:
            fault = f"brackets nested more than {DEPTH_MOST} deep"
        elif parts >= PARTS_MOST:
            fault = f"a key of more than {PARTS_MOST} parts"
        elif kind == "word" and len(token[0]) > WORD_MOST:
            fault = f"a word or number of {len(token[0])} characters, expected at most {WORD_MOST}"
        if fault:
            raise ProfileError(f"{where}, line {text.count(chr(10), 0, token.start()) + 1}: {fault}")


M = TypeVar("M", bound=BaseModel)


def validate(model: type[M], data: Mapping[str, Any], text: bytes, *, where: str) -> M:
    """``data`` as ``model``; the first fault as a ProfileError of one line."""
    try:
        # As JSON, because strict mode takes a TOML array for a tuple only
        # there.
        return model.model_validate_json(json.dumps(data, default=str))
    except ValidationError as e:
        errors = e.errors()
        first = next((x for x in errors if x["type"] == "extra_forbidden"), errors[0])
        loc = first["loc"]
        # The last part may be a key, or a place, that the data lack.
        lacked = first["type"] == "missing" or (bool(loc) and loc[-1] in _keys_at(model, loc[:-1]))
        path = [str(p) for p in loc if not _is_tag(p, data, loc, lacked=lacked)]
        line = _line_of(text, path)
        message = first["msg"].removeprefix("Value error, ")
        if first["type"] == "extra_forbidden":
            message = f"unknown key{nearest(path[-1], _keys_at(model, first['loc'][:-1]))}"
        elif first["type"] == "missing":
            message = "missing"
        else:
            given = first.get("input")
            if isinstance(given, (str, int, float, bool)):
                message += f", not {clipped(repr(given))}"
        at = f", line {line}" if line else ""
        field = f"{'.'.join(map(clipped, path))}: " if path else ""
        raise ProfileError(f"{where}{at}: {field}{message[0].lower()}{message[1:]}") from e


def _is_tag(part: int | str, data: Any, loc: tuple[int | str, ...], *, lacked: bool) -> bool:
    """Whether a part of pydantic's location is the name of a union member
    rather than a key of the data."""
    at = data
    for p in loc:
        inside = (isinstance(at, Mapping) and p in at) or (
            isinstance(at, (list, tuple)) and isinstance(p, int) and p < len(at)
        )
        if p is part and not inside:
            return p is not loc[-1] or not lacked
        if inside:
            at = at[p]
    return False


def _keys_at(annotation: Any, loc: tuple[int | str, ...]) -> set[str]:
    """The keys that ``annotation`` allows at ``loc``, all union members
    together."""
    if typing.get_origin(annotation) is Annotated:
        return _keys_at(typing.get_args(annotation)[0], loc)
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return set().union(*(_keys_at(a, loc) for a in typing.get_args(annotation)))
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        fields = {f.alias or n: f.annotation for n, f in annotation.model_fields.items()}
        if not loc:
            return set(fields)
        if loc[0] in fields:
            return _keys_at(fields[str(loc[0])], loc[1:])
        return _keys_at(annotation, loc[1:])  # a union member's tag
    arguments = typing.get_args(annotation)
    if arguments and loc:
        return _keys_at(arguments[-1] if arguments[-1] is not Ellipsis else arguments[0], loc[1:])
    return set()


def _line_of(text: bytes, path: list[str]) -> int | None:
    """The line of the last key of ``path`` that the text shows, found by table
    headers and keys."""
    table: list[str] = []
    best: tuple[int, int] | None = None
    counts: dict[str, int] = {}
    for number, line in enumerate(text.decode("utf-8", "replace").splitlines(), 1):
        bare = line.strip()
        if header := re.match(r"\[(\[?)([^\]]+)\]", bare):
            table = [p.strip().strip("\"'") for p in header[2].split(".")]
            if header[1]:
                counts[header[2]] = counts.get(header[2], -1) + 1
                table.append(str(counts[header[2]]))
            keys = table
        elif assigned := re.match(r"([A-Za-z0-9_.\"'-]+)\s*=", bare):
            keys = table + [p.strip("\"'") for p in assigned[1].split(".")]
        else:
            continue
        depth = len(keys)
        if keys == path[:depth]:
            inline = sum(1 for p in path[depth:] if re.search(rf"\b{re.escape(p)}\b", bare))
            if best is None or depth + inline > best[0]:
                best = (depth + inline, number)
    return best[1] if best else None
