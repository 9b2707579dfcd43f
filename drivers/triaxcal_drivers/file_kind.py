"""What a file is, by its first bytes: for messages of readers that expect
another one."""

from __future__ import annotations

import re

HEAD = 8192
"""Bytes that are looked at: a document begins with its format, and a TOML file
names it above its tables, below comments at most."""

_MAGICS = (
    (b"\x89MCAP", "an MCAP file"),
    (b"\x1f\x8b", "a gzip file"),
    (b"PAR1", "a Parquet file"),
    (b"PK\x03\x04", "a ZIP file, as spreadsheets are"),
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
    (b"\x93NUMPY", "a NumPy file"),
    (b"MDF ", "an MF4 file"),
    (b"LOGG", "a BLF file"),
)
_NO_TEXT = re.compile(rb"[\0-\x08\x80-\xff]")  # within the first bytes of all of these, and of no text that begins so
_MAGIC_HEAD = 64
_MARK = b"\xef\xbb\xbf"
_JSON = re.compile(rb'\s*(\{\s*["}]|\[\s*\{)')
_JSON_FORMAT = re.compile(rb'\s*\{\s*"format"\s*:\s*"([\w.-]{1,40}/\d{1,4})"')
_TOML_FORMAT = re.compile(rb"""^[ \t]*format[ \t]*=[ \t]*["'](triaxcal\.[\w-]{1,40}/\d{1,4})["']""", re.MULTILINE)


def kind(data: bytes) -> str:
    """What a file that begins with ``data`` is, with its article."""
    if known := special_kind(data):
        return known
    head = data[:HEAD]
    if not head:
        return "an empty file"
    try:
        text = head.decode()
    except UnicodeDecodeError as e:
        cut_off = e.reason == "unexpected end of data"
        text = "" if cut_off else "\0"
    return "a binary file of no known kind" if "\0" in text else "text"


def special_kind(data: bytes, *, json: bool = True, toml: bool = True) -> str | None:
    """The same where a mark tells it; None of other text and of what nobody
    knows. Without ``json`` or ``toml`` such a document is no special kind."""
    head = data[:HEAD]
    if _NO_TEXT.search(head[:_MAGIC_HEAD]):
        for magic, name in _MAGICS:
            if head.startswith(magic):
                return name
    head = head.removeprefix(_MARK)
    if _JSON.match(head):
        named = _JSON_FORMAT.match(head)
        of = f" of format {named[1].decode()}" if named else ""
        return f"a JSON document{of}" if json else None
    named = _TOML_FORMAT.search((b"\n" + head).split(b"\n[", 1)[0])
    return f"a TOML file of format {named[1].decode()}" if named and toml else None


def document_kind(data: bytes) -> str | None:
    """The same of a document that names its format; None of all others."""
    found = special_kind(data)
    return found if found is not None and " of format " in found else None
