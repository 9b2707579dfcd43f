"""The bytes of a table, a few MiB at a time: of a file, a gzip file, a pipe or
standard input."""

from __future__ import annotations

import gzip
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import triaxcal_drivers as td
from triaxcald.errors import InputError

BLOCK = 2**22
EXPANSION_MOST = 200
"""So many times what is read of it may a gzip file unpack to, and one block.
Text of numbers comes to a third or a tenth, with two hundred columns that never
change to a hundredth; nothing but one and the same, to a thousandth."""


def label_of(name: str) -> str:
    return "standard input" if name == "-" else name


def blocks(source: Path | str | BinaryIO, label: str) -> Iterator[bytes]:
    """Of a file, ``.gz`` unpacked, of standard input (``-``) or of a stream.
    Raises InputError."""
    if not isinstance(source, Path | str):
        yield from _of(source, label)
    elif str(source) == "-":
        yield from _of(sys.stdin.buffer, label)
    else:
        packed = str(source).endswith(".gz")
        try:
            with td.files.open_file(Path(source), pipe=not packed) as file:
                if packed:
                    with gzip.GzipFile(fileobj=file) as unzipped:
                        yield from _of(unzipped, label, file)
                else:
                    yield from _of(file, label)
        except OSError as e:
            raise InputError(f"{label}: cannot be read: {e.strerror or e}") from e


def whole_lines(first: bytes) -> bytes:
    """Of the first block: it may end within a line, and within a letter."""
    return first[: first.rfind(b"\n") + 1] or first if len(first) >= BLOCK else first


def _of(stream: BinaryIO | gzip.GzipFile, label: str, packed: BinaryIO | None = None) -> Iterator[bytes]:
    unpacked = 0
    while block := _block(stream, label):
        unpacked += len(block)
        if packed is not None and unpacked > EXPANSION_MOST * packed.tell() + BLOCK:
            raise InputError(f"{label}: unpacks to more than {EXPANSION_MOST} times its size")
        yield block


def _block(stream: BinaryIO | gzip.GzipFile, label: str) -> bytes:
    try:
        return stream.read(BLOCK)
    except EOFError:
        raise InputError(f"{label}: the gzip data end too early, expected a whole file") from None
    except (gzip.BadGzipFile, zlib.error) as e:
        raise InputError(f"{label}: not readable as gzip: {e}") from e
