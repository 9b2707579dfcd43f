"""Kinds of log files, told by their first bytes, and the frames in a log."""

from __future__ import annotations

import errno
import gzip
import io
import shutil
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

from triaxcal_drivers.errors import LogError
from triaxcal_drivers.files import converter, open_file, special_kind
from triaxcal_drivers.logs import asc, blf, candump, mf4, pcap, trc
from triaxcal_drivers.logs.can_frames import BYTE_ORDER_MARK, Account, LoggedFrame

HEAD = 8192  # bytes that tell the kind
GZIP = b"\x1f\x8b"
MCAP = b"\x89MCAP0\r\n"
EXPANSION_MOST, ROOM = 64, 2**20
"""A compressed file may unpack to `EXPANSION_MOST` times its size plus `ROOM` bytes."""
LINES_LOOKED_AT = 20  # of a text, in search of one that tells its kind


@dataclass(frozen=True)
class Kind:
    """``name`` is for messages. ``seeks``: the reader does not read the file from start
    to end."""

    name: str
    frames: Callable[[BinaryIO, Account], Iterator[LoggedFrame]]
    seeks: bool = False


BLF = Kind("BLF", blf.frames)
ASC = Kind("ASC", asc.frames)
CANDUMP = Kind("candump", candump.frames)
TRC = Kind("TRC", trc.frames)
MF4 = Kind("MF4", mf4.frames, seeks=True)
PCAP = Kind("pcap", pcap.frames)
MCAP_KIND = "MCAP"
NAMES = "BLF, ASC, candump, TRC, MF4, pcap, pcapng or MCAP"


def kind_of(head: bytes) -> Kind | str | None:
    """Kind of a file by its first bytes; `MCAP_KIND` for a file of messages instead of
    bus frames."""
    if head.startswith(blf.MAGIC):
        return BLF
    if head.startswith(mf4.MAGICS):
        return MF4
    if head.startswith(pcap.MAGICS):
        return PCAP
    if head.startswith(MCAP):
        return MCAP_KIND
    return _of_text(head)


def _of_text(head: bytes) -> Kind | None:
    lines = [line.strip() for line in head.removeprefix(BYTE_ORDER_MARK).split(b"\n")[:LINES_LOOKED_AT] if line.strip()]
    if len(head) == HEAD and len(lines) > 1:
        lines = lines[:-1]  # the last one may be incomplete
    if any(trc.HEAD.match(line) for line in lines):
        return TRC
    if any(asc.HEAD.match(line) for line in lines):
        return ASC
    if any(candump.recognises(line) for line in lines):
        return CANDUMP
    return TRC if any(trc.LINE.match(line) and b")" in line for line in lines) else None


@dataclass
class Log:
    """An opened log."""

    name: str
    kind: Kind | str
    stream: BinaryIO

    def frames(self, account: Account) -> Iterator[LoggedFrame]:
        """All frames. Raises LogError, in one line with the file's name."""
        assert isinstance(self.kind, Kind)
        try:
            yield from self.kind.frames(self.stream, account)
        except LogError as e:
            raise LogError(f"{self.name}: {e}") from e
        except (EOFError, gzip.BadGzipFile, zlib.error) as e:
            account.note("the gzip file", str(e) or "damaged")
        except OSError as e:
            raise LogError(f"{self.name}: cannot be read: {e.strerror or e}") from e


@contextmanager
def opened(path: Path) -> Iterator[Log]:
    """Opens a log, compressed with gzip or not. Raises LogError."""
    try:
        file = open_file(path)
    except OSError as e:
        raise LogError(f"{path}: cannot be read: {e.strerror}") from e
    with file:
        stream = file
        # Uncompress and tell the kind.
        try:
            if _head(file, len(GZIP)) == GZIP:
                stream = cast(BinaryIO, _unpacked(file, path))
            head = _head(stream, HEAD)
        except (OSError, EOFError, zlib.error) as e:
            raise LogError(f"{path}: cannot be read: {_reason(e)}") from e
        kind = kind_of(head)
        if kind is None:
            hint = "; the file is empty" if not head else ""
            if known := special_kind(head):
                hint = f"; the file is {known}{converter(head)}"
            raise LogError(f"{path}: no log of a known kind, expected {NAMES}{hint}")
        # A reader that seeks needs an uncompressed copy.
        seeks = kind.seeks if isinstance(kind, Kind) else True
        if stream is not file and seeks:
            with tempfile.TemporaryFile() as whole:
                try:
                    shutil.copyfileobj(stream, whole)
                except (OSError, EOFError, zlib.error) as e:
                    raise LogError(f"{path}: cannot be read: {_reason(e)}") from e
                whole.seek(0)
                yield Log(str(path), kind, cast(BinaryIO, whole))
        else:
            yield Log(str(path), kind, stream)


def _reason(e: Exception) -> str:
    return (e.strerror if isinstance(e, OSError) else None) or str(e)


def _head(stream: BinaryIO, count: int) -> bytes:
    """The first bytes; the next read returns them again."""
    return cast(io.BufferedReader, stream).peek(count)[:count]


def _unpacked(file: BinaryIO, path: Path) -> io.BufferedReader:
    most = EXPANSION_MOST * path.stat().st_size + ROOM
    return io.BufferedReader(_Bounded(gzip.GzipFile(fileobj=file, mode="rb"), most))


class _Bounded(io.RawIOBase):
    """Reads a gzip file. Raises OSError if it unpacks to more than ``most`` bytes."""

    def __init__(self, source: gzip.GzipFile, most: int) -> None:
        self._source, self._left = source, most

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: object) -> int:
        view = memoryview(buffer)  # type: ignore[arg-type]
        data = self._source.read(len(view))
        self._left -= len(data)
        if self._left < 0:
            raise OSError(errno.EFBIG, f"unpacks to more than {EXPANSION_MOST} times the file")
        view[: len(data)] = data
        return len(data)
