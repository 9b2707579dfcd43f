"""Files that somebody else may have made: opened without waiting, read up to a
size, kept inside their folder; and what a file is by its first bytes, for
messages of readers that expect another one."""

from __future__ import annotations

import errno
import os
import re
import stat
from collections.abc import Iterable
from pathlib import Path
from typing import BinaryIO, Protocol, Self, TypeAlias

HEAD = 8192
"""Bytes that are looked at: a document begins with its format, and a TOML file
names it above its tables, below comments at most."""

_ACTILIFE = (b"SQLite format 3\0", "an SQLite database, as ActiLife's .agd with counts of epochs")
_MAGICS = (
    (b"\x89MCAP", "an MCAP file"),
    (b"\x1f\x8b", "a gzip file"),
    (b"PAR1", "a Parquet file"),
    (b"PK\x03\x04", "a ZIP file, as spreadsheets are"),
    (b"\x89HDF\r\n\x1a\n", "an HDF5 file"),
    (b"\x93NUMPY", "a NumPy file"),
    (b"MDF ", "an MF4 file"),
    (b"LOGG", "a BLF file"),
    _ACTILIFE,
)
_GT3X = re.compile(rb"PK\x03\x04.{26}(?:log\.bin|activity\.bin|info\.txt|lux\.bin)", re.DOTALL)
"""The first entry of ActiGraph's archive."""
_WEARABLES = (
    (
        re.compile(rb"MD\xfc\x03"),
        "an Axivity file (.cwa)",
        "actipy (Python, with calibrate_gravity=False) or GGIRread (R)",
    ),
    (
        re.compile(rb"Device Identity[ \t]*\r?\n"),
        "a GENEActiv file (.bin)",
        "actipy (Python, with calibrate_gravity=False) or GGIRread (R)",
    ),
    (
        _GT3X,
        "an ActiGraph file (.gt3x)",
        "actipy (Python, with calibrate_gravity=False), pygt3x (Python) or read.gt3x (R)",
    ),
)
"""Files of wearables: how they begin, and packages that convert them to tables. actipy
calibrates by itself unless it is told not to."""
_NO_TEXT = re.compile(rb"[\0-\x08\x80-\xff]")  # within the first bytes of all of these, and of no text that begins so
_MAGIC_HEAD = 64
_MARK = b"\xef\xbb\xbf"
_JSON = re.compile(rb'\s*(\{\s*["}]|\[\s*\{)')
_JSON_FORMAT = re.compile(rb'\s*\{\s*"format"\s*:\s*"([\w.-]{1,40}/\d{1,4})"')
_TOML_FORMAT = re.compile(rb"""^[ \t]*format[ \t]*=[ \t]*["'](triaxcal\.[\w-]{1,40}/\d{1,4})["']""", re.MULTILINE)


def kind(data: bytes) -> str:
    """Kind of a file that begins with ``data``, with its article."""
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
    """Kind by a magic number or a format key; None for other text and unknown data.
    Without ``json`` or ``toml`` such a document is no special kind."""
    head = data[:HEAD]
    if found := _wearable(head):
        return found[0]
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


def _wearable(head: bytes) -> tuple[str, str] | None:
    return next(((name, packages) for begins, name, packages in _WEARABLES if begins.match(head)), None)


def converter(data: bytes) -> str:
    """What to do with a file of a wearable that begins with ``data``; else empty."""
    found = _wearable(data[:HEAD])
    if data.startswith(_ACTILIFE[0]):
        return "; export the raw samples of the .gt3x file"
    return f"; convert it to CSV with {found[1]}" if found else ""


def document_kind(data: bytes) -> str | None:
    """Kind of a document that names its format; None for all others."""
    found = special_kind(data)
    return found if found is not None and " of format " in found else None


class StoredPath(Protocol):
    """A file in a store that is no folder of this machine. It has the few methods of
    `Path` that readers need, and opens itself. All raise OSError."""

    @property
    def name(self) -> str: ...
    @property
    def parent(self) -> Self: ...
    def with_name(self, name: str) -> Self: ...
    def with_suffix(self, suffix: str) -> Self: ...
    def glob(self, pattern: str) -> Iterable[Self]: ...
    def open_binary(self) -> BinaryIO: ...


AnyPath: TypeAlias = Path | StoredPath


class TooLarge(OSError):
    """``head`` is what was read of a file of more than ``most`` bytes."""

    def __init__(self, most: int, head: bytes) -> None:
        super().__init__(errno.EFBIG, f"larger than the {size(most)} that such a file may have")
        self.head = head


def open_file(path: AnyPath, *, pipe: bool = False) -> BinaryIO:
    """A file to read from; with ``pipe`` also a pipe, where the user gave the
    name: `<(…)` of the shell is one.

    A device is not even opened, and a pipe that nobody writes to is empty
    instead of being waited for. Raises OSError with a reason to show.
    """
    if not isinstance(path, Path):
        return path.open_binary()
    try:
        _require_file(path.stat().st_mode, pipe)
        file = open(path, "rb", opener=_without_waiting)  # noqa: SIM115 -- the caller closes it
    except ValueError:  # a NUL, or a character that no file name has
        raise OSError(errno.EINVAL, "no file has such a name") from None
    try:
        _require_file(os.fstat(file.fileno()).st_mode, pipe)  # what was opened, whatever has come in its place
        os.set_blocking(file.fileno(), True)
    except BaseException:
        file.close()
        raise
    return file


def _without_waiting(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NONBLOCK)


def _require_file(mode: int, pipe: bool) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    if not (stat.S_ISREG(mode) or (pipe and stat.S_ISFIFO(mode))):
        raise OSError(errno.EINVAL, "a device or a pipe, expected a file")


def read_whole(path: AnyPath, most: int, *, pipe: bool = False) -> bytes:
    """All of a file of at most ``most`` bytes. Raises OSError with a reason to
    show, TooLarge for a larger one."""
    with open_file(path, pipe=pipe) as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise TooLarge(most, data)
    return data


def size(count: int) -> str:
    """A number of bytes for messages."""
    return f"{count // 2**20} MiB" if count >= 2**20 else f"{count // 2**10} KiB"


def inside(folder: Path, name: str) -> Path:
    """The file ``name`` of ``folder``, wherever symbolic links lead. Raises
    OSError where that is outside of it."""
    if "\0" in name:
        raise OSError(errno.EINVAL, "no file has such a name")
    try:
        path = (folder / name).resolve()
    except RuntimeError:  # before Python 3.13
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP)) from None
    if ".." in Path(name).parts or not path.is_relative_to(folder.resolve()):
        raise OSError(errno.EACCES, "outside the profile's folder, expected a file in it")
    return path
