"""Files in object stores and on web servers, by URL: the one file that imports
fsspec. They are read in blocks, without a local copy where the store can seek."""

from __future__ import annotations

import errno
import fnmatch
import io
import os
import posixpath
import shutil
import tempfile
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple, Self
from urllib.parse import unquote, urlsplit

import triaxcal_drivers as td
from triaxcald.errors import InputError

BLOCK: Final = 2**20
"""Bytes of one request. A recording is read several times over: what fits in `BLOCKS`
is asked for once."""
BLOCKS: Final = 24
"""Blocks of one file in memory: a recording of two hours at 1 kHz."""
_BUFFER: Final = 2**16  # the reader asks for some bytes at a time
_STAMPS: Final = (
    "ETag", "etag", "md5", "mtime", "LastModified", "Last-Modified", "last_modified", "updated", "created",
)  # fmt: skip
"""Keys of what stores tell of a file that change with its contents, the best first."""


def is_url(name: str) -> bool:
    scheme, mark, _ = name.partition("://")
    return bool(mark) and scheme.replace("+", "").isalnum()


def path_of(name: str) -> td.files.AnyPath:
    """The file of that name: a path, or a URL of a store. Raises InputError."""
    if not is_url(name):
        return Path(name)
    if name.startswith("file://"):
        try:
            return Path(unquote(urlsplit(name).path))
        except ValueError as e:
            raise InputError(f"{name}: {e}") from e
    return StoreFile(name)


class Listed(NamedTuple):
    """A file in a store. ``stamp`` changes with its contents."""

    url: str
    size: int | None
    stamp: str


class StoreFile:
    """A file of a store, as `triaxcal_drivers.files.StoredPath`. Blocks that were read
    stay with it; a file that changes meanwhile is an error, where the store tells."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._blocks: _Blocks | None = None

    def __str__(self) -> str:
        return self._url

    def __reduce__(self) -> tuple[type[Self], tuple[str]]:
        return type(self), (self._url,)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StoreFile) and other._url == self._url

    def __hash__(self) -> int:
        return hash(self._url)

    @property
    def name(self) -> str:
        return posixpath.basename(self._split()[0])

    @property
    def parent(self) -> Self:
        before, query = self._split()
        return type(self)(posixpath.dirname(before) + query)

    def with_name(self, name: str) -> Self:
        before, query = self._split()
        return type(self)(f"{posixpath.dirname(before)}/{name}{query}")

    def with_suffix(self, suffix: str) -> Self:
        return self.with_name(f"{self.name.rpartition('.')[0] or self.name}{suffix}")

    def _split(self) -> tuple[str, str]:
        """The URL before its query, and the query; only the web has one."""
        if not self._url.startswith(("http://", "https://")):
            return self._url, ""
        before, mark, query = self._url.partition("?")
        return before, mark + query

    def glob(self, pattern: str) -> Iterator[Self]:
        """Files in this folder whose names match."""
        with _told(self._url):
            fs, path = _file_system(self._url)
            for found in fs.ls(path, detail=False):
                if fnmatch.fnmatchcase(posixpath.basename(found), pattern):
                    yield type(self)(fs.unstrip_protocol(found))

    def listed(self) -> Listed:
        """Raises OSError."""
        with _told(self._url):
            fs, path = _file_system(self._url)
            return _listed(self._url, fs.info(path))

    def open_binary(self) -> BinaryIO:
        """Raises OSError, also where it is read."""
        if self._blocks is None:
            self._blocks = _Blocks(self._url)
        return io.BufferedReader(_Reader(self._blocks), _BUFFER)


class _Blocks:
    """The file's bytes by blocks, the latest `BLOCKS` of them in memory."""

    def __init__(self, url: str) -> None:
        self._url = url
        with _told(url):
            fs, path = _file_system(url)
            self._file = _seekable(fs.open(path, "rb", block_size=BLOCK, cache_type="none"))
            self.size: int = self._file.seek(0, os.SEEK_END)
        self._held: OrderedDict[int, bytes] = OrderedDict()

    def block(self, number: int) -> bytes:
        if number in self._held:
            self._held.move_to_end(number)
            return self._held[number]
        with _told(self._url):
            self._file.seek(number * BLOCK)
            data: bytes = self._file.read(min(BLOCK, self.size - number * BLOCK))
        self._held[number] = data
        if len(self._held) > BLOCKS:
            self._held.popitem(last=False)
        return data


def _seekable(file: Any) -> Any:
    """The file, or a temporary copy of one that can only be read from its beginning."""
    try:
        file.seek(0, os.SEEK_END)
        return file
    except (ValueError, OSError, NotImplementedError, TypeError):  # no size, or a stream
        copy = tempfile.TemporaryFile()  # noqa: SIM115 - for as long as its blocks
        shutil.copyfileobj(file, copy, BLOCK)
        return copy


class _Reader(io.RawIOBase):
    """A file object over blocks that several may share."""

    def __init__(self, blocks: _Blocks) -> None:
        self._blocks, self._at = blocks, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        base = {os.SEEK_SET: 0, os.SEEK_CUR: self._at, os.SEEK_END: self._blocks.size}[whence]
        self._at = max(0, base + offset)
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        if self._at >= self._blocks.size:
            return 0
        number, begin = divmod(self._at, BLOCK)
        piece = self._blocks.block(number)[begin : begin + len(buffer)]
        if not piece:
            raise OSError(errno.EIO, "the store gives fewer bytes than it lists")
        buffer[: len(piece)] = piece
        self._at += len(piece)
        return len(piece)


def files_under(url: str, endings: tuple[str, ...]) -> list[Listed]:
    """Files with such names below a folder of a store, in order. Raises OSError."""
    with _told(url):
        fs, path = _file_system(url)
        found = fs.find(path, detail=True)
        return [
            _listed(fs.unstrip_protocol(name), info) for name, info in sorted(found.items()) if name.endswith(endings)
        ]


def files_in(folder: StoreFile) -> dict[str, Listed]:
    """Files of a folder of a store by name, by one request or a few. Raises OSError."""
    url = str(folder)
    with _told(url):
        fs, path = _file_system(url)
        found = fs.ls(path, detail=True)
        return {
            posixpath.basename(info["name"]): _listed(fs.unstrip_protocol(info["name"]), info)
            for info in found
            if info.get("type") != "directory"
        }


def files_like(url: str) -> list[Listed]:
    """Files whose names match a pattern, in order. Raises OSError."""
    with _told(url):
        fs, path = _file_system(url)
        found = fs.glob(path, detail=True)
        return [
            _listed(fs.unstrip_protocol(name), info)
            for name, info in sorted(found.items())
            if info.get("type") != "directory"
        ]


def _listed(url: str, info: Mapping[str, Any]) -> Listed:
    size = info.get("size")
    stamp = next((str(info[key]) for key in _STAMPS if info.get(key) is not None), "")
    return Listed(url, size if isinstance(size, int) else None, stamp.strip('"'))


def _file_system(url: str) -> tuple[Any, str]:
    """The store of a URL, and the path in it. Listings are not kept: a worker lives
    longer than they hold. Raises ModuleNotFoundError, InputError."""
    from fsspec.core import url_to_fs

    try:
        fs, path = url_to_fs(url, use_listings_cache=False)
    except ValueError as e:
        raise InputError(f"{url}: {e}") from e
    return fs, path


@contextmanager
def _told(url: str) -> Iterator[None]:
    """Turns what stores raise into OSError with one line. Raises InputError where the
    package of a kind of store is not installed."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except ImportError as e:
        if isinstance(e, ModuleNotFoundError) and td.hints.lacking(e):
            raise
        lacking = td.hints.lacking(e.__cause__) if isinstance(e.__cause__, ModuleNotFoundError) else None
        raise InputError(f"{url}: {lacking or _one_line(e)}") from e
    except FileNotFoundError as e:
        raise FileNotFoundError(errno.ENOENT, "there is no such file in the store") from e
    except PermissionError as e:
        raise PermissionError(errno.EACCES, f"the store refuses: {_one_line(e)}") from e
    except Exception as e:  # each kind of store has errors of its own
        if type(e).__name__ == "NoCredentialsError":  # botocore's, which is no OSError
            raise PermissionError(errno.EACCES, f"the store needs credentials: {_one_line(e)}") from e
        raise OSError(errno.EIO, f"the store failed: {_one_line(e)}") from e


def _one_line(e: BaseException) -> str:
    return " ".join(str(e).split()) or type(e).__name__
