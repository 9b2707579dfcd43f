"""TOML of whoever wrote it, bounded before it is parsed: time and memory of the
parser go with the square of a key's parts, and it calls itself for each level
of nesting."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Any

from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.file_kind import special_kind
from triaxcal_drivers.files import TooLarge, read_whole, size

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


PROFILE, STATION, DEVICE = "triaxcal.profile/1", "triaxcal.station/1", "triaxcal.device/1"
_CALLED = {PROFILE: "a profile", STATION: "a station file", DEVICE: "the file of a simulated device"}


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
