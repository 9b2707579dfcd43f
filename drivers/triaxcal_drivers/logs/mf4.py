"""ASAM MDF 4 with bus logging: the one file that imports asammdf.

asammdf follows the links in a file without a check and allocates memory by the sizes
in it. This module therefore checks all blocks first.
"""

from __future__ import annotations

import gc
import logging
import shutil
import struct
import sys
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray

from triaxcal_drivers.errors import LogError
from triaxcal_drivers.logs.can_frames import (
    CLASSIC_MOST,
    ERROR,
    EXTENDED,
    EXTENDED_MOST,
    FD,
    FD_MOST,
    REMOTE,
    SENT,
    SWITCHED,
    Account,
    LoggedFrame,
    Remark,
)
from triaxcal_drivers.logs.dates import LONGEST_NS

MAGICS = (b"MDF     ", b"UnFinMF ")
RECORDS_AT_ONCE = 8192
BLOCKS_MOST, LINKS_MOST = 200_000, 100_000
"""Most blocks of a file, and links of a block; a logger's file has some thousand
blocks."""
EXPANSION_MOST, ROOM = 64, 16 * 2**20
"""A file may unpack to `EXPANSION_MOST` times its size plus `ROOM` bytes."""

_BLOCK = struct.Struct("<4s4xQQ")  # kind, bytes, links
_ZIPPED = struct.Struct("<2sBxIQQ")  # kind, method, parameter, bytes unpacked, bytes
_GROUP = struct.Struct("<QQHH4xII")  # record id, records, flags, separator, bytes of a record, of its invalidation
_HEADER_AT = 64
_CHAINED = frozenset((b"##DG", b"##CG", b"##CN", b"##DL", b"##FH", b"##CH", b"##AT", b"##EV", b"##LD"))
"""Blocks whose first link leads to the next block of a chain. The second link of a
channel leads to its parts."""
_VARIABLE_LENGTH = 1  # flag of a group
_LOCAL_TIME = 1  # flag of the time in the header: its zone is unknown


def frames(stream: BinaryIO, account: Account) -> Iterator[LoggedFrame]:
    """Raises LogError; ModuleNotFoundError without asammdf."""
    finished = check_blocks(stream)
    stream.seek(0)
    with ExitStack() as stack:
        if not finished:  # asammdf finishes the file itself, so it gets a copy
            copy = stack.enter_context(tempfile.TemporaryFile())
            shutil.copyfileobj(stream, copy)
            copy.seek(0)
            stream = cast(BinaryIO, copy)
        mdf = _opened(stream)
        stack.callback(mdf.close)
        try:
            start_ns = int(mdf.header.abs_time)
            if mdf.header.time_flags & _LOCAL_TIME:
                account.remarks.add(Remark.DATE_WITHOUT_ZONE)
            yield from _in_order([_Group(mdf, number, start_ns, name) for number, name in _bus_groups(mdf, account)])
        except LogError:
            raise
        except Exception as e:  # asammdf has no common error class
            raise LogError(f"not an MF4 file that can be read: {_one_line(e)}") from e


def _opened(stream: BinaryIO) -> Any:
    """Opens asammdf's MDF. An instance whose constructor failed cannot be closed and
    prints an error when it is collected; that output is suppressed."""
    if sys.modules.get("asammdf", sys) is None:  # the command line hides it from python-can
        del sys.modules["asammdf"]
    from asammdf import MDF  # a second, and only an MF4 needs it

    logging.getLogger("asammdf").setLevel(logging.CRITICAL)  # its log entries repeat exceptions
    shown, sys.unraisablehook = sys.unraisablehook, lambda _: None
    try:
        return MDF(cast(Any, stream))
    except Exception as e:  # noqa: BLE001 - asammdf has no common error class
        why = _one_line(e)
        traceback.clear_frames(e.__traceback__)
        gc.collect()
        raise LogError(f"not an MF4 file that can be read: {why}") from None
    finally:
        sys.unraisablehook = shown


def _one_line(e: Exception) -> str:
    return " ".join(str(e).split())[:200] or type(e).__name__


def _bus_groups(mdf: Any, account: Account) -> Iterator[tuple[int, str]]:
    """Numbers of the groups with frames, and the name of their channel."""
    for number, group in enumerate(mdf.groups):
        if not group.channel_group.cycles_nr:
            continue
        names = {channel.name for channel in group.channels}
        found = next((n for n in ("CAN_DataFrame", "CAN_RemoteFrame", "CAN_ErrorFrame") if n in names), None)
        if found is None:
            account.other("record of an MF4 group without CAN frames", int(group.channel_group.cycles_nr))
        else:
            yield number, found


@dataclass
class _Block:
    """Frames of a group in its order; those from ``at`` on are left."""

    time_ns: NDArray[np.int64]
    frames: list[LoggedFrame]
    at: int = 0


class _Group:
    """One group's frames, block by block."""

    def __init__(self, mdf: Any, number: int, start_ns: int, name: str) -> None:
        self._mdf, self._number, self._start_ns, self._name = mdf, number, start_ns, name
        self._records = int(mdf.groups[number].channel_group.cycles_nr)
        source = mdf.groups[number].channel_group.acq_source
        self._channel = source.name if source is not None and source.name else "1"

    def blocks(self) -> Iterator[list[LoggedFrame]]:
        for first in range(0, self._records, RECORDS_AT_ONCE):
            signal = self._mdf.get(
                self._name, group=self._number, record_offset=first, record_count=RECORDS_AT_ONCE, raw=False
            )
            seconds = np.asarray(signal.timestamps, dtype=np.float64)
            yield self._frames(_times_ns(self._start_ns, seconds), signal.samples)

    def _frames(self, time_ns: NDArray[np.int64], samples: Any) -> list[LoggedFrame]:
        column = _Columns(samples, self._name)
        source = column.whole("ID").astype(np.int64)
        extended = (column.whole("IDE") != 0) | (source > EXTENDED_MOST)
        fd = column.whole("EDL") != 0
        passive = (column.whole("ESI") != 0) & fd
        switched = (column.whole("BRS") != 0) & fd
        flags = EXTENDED * extended + FD * fd + REMOTE * passive + SWITCHED * switched + SENT * column.sent()
        if self._name == "CAN_ErrorFrame":
            flags = np.full(len(source), ERROR)
        elif self._name == "CAN_RemoteFrame":
            flags = flags + REMOTE
        data = column.octets(remote=self._name == "CAN_RemoteFrame")
        channels = column.channels(self._channel)
        rows = zip(time_ns.tolist(), (source & EXTENDED_MOST).tolist(), flags.tolist(), data, channels, strict=True)
        return [LoggedFrame(*row) for row in rows]


def _times_ns(start_ns: int, seconds: NDArray[np.float64]) -> NDArray[np.int64]:
    """Times [ns]; -1, which is no time, for a value that is no number or too large."""
    valid = np.abs(seconds) < LONGEST_NS / 1e9
    return np.where(valid, start_ns + np.rint(np.where(valid, seconds, 0) * 1e9).astype(np.int64), -1)


class _Columns:
    """Columns of a group's frames, by the part of their names after the point."""

    def __init__(self, samples: Any, name: str) -> None:
        self._samples, self._name = samples, name
        self._named = set(samples.dtype.names or ())

    def whole(self, part: str) -> NDArray[Any]:
        """An integer column; zeros if the group has none of that name."""
        if f"{self._name}.{part}" not in self._named:
            return np.zeros(len(self._samples), dtype=np.int64)
        return np.asarray(self._samples[f"{self._name}.{part}"]).astype(np.int64)

    def sent(self) -> NDArray[np.bool_]:
        if f"{self._name}.Dir" not in self._named:
            return np.zeros(len(self._samples), dtype=np.bool_)
        direction = np.asarray(self._samples[f"{self._name}.Dir"])
        words = direction.dtype.kind in "SU"
        return np.asarray(np.char.lower(direction.astype("U")) == "tx" if words else direction.astype(np.int64) != 0)

    def octets(self, *, remote: bool) -> list[bytes]:
        if remote:
            return [bytes(min(max(n, 0), CLASSIC_MOST)) for n in self.whole("DLC").tolist()]
        if f"{self._name}.DataBytes" not in self._named:
            return [b""] * len(self._samples)
        held = np.ascontiguousarray(self._samples[f"{self._name}.DataBytes"], dtype=np.uint8)
        if held.ndim == 1:  # frames of one byte
            held = held[:, None]
        width = min(held.shape[1], FD_MOST)
        part = "DataLength" if f"{self._name}.DataLength" in self._named else "DLC"
        lengths = np.clip(self.whole(part), 0, width).tolist()
        whole = held[:, :width].tobytes()
        return [whole[i * width : i * width + n] for i, n in enumerate(lengths)]

    def channels(self, otherwise: str) -> Sequence[str]:
        if f"{self._name}.BusChannel" not in self._named:
            return [otherwise] * len(self._samples)
        return [str(n) for n in self.whole("BusChannel").tolist()]


def _in_order(groups: Sequence[_Group]) -> Iterator[LoggedFrame]:
    """All frames in order of time, with one block of each group in memory. Frames of a
    group keep their order."""
    # One block of each group.
    waiting: list[tuple[Iterator[list[LoggedFrame]], _Block]] = []
    for group in groups:
        _next_block(group.blocks(), waiting)
    while waiting:
        # Up to the earliest end of a block, no later block can have an earlier frame.
        until = min(int(block.time_ns[-1]) for _, block in waiting)
        ready: list[tuple[int, LoggedFrame]] = []
        left: list[tuple[Iterator[list[LoggedFrame]], _Block]] = []
        for blocks, block in waiting:
            last = int(block.time_ns[-1]) == until
            end = len(block.frames) if last else int(np.searchsorted(block.time_ns, until, side="right"))
            ready += zip(block.time_ns[block.at : end].tolist(), block.frames[block.at : end], strict=True)
            block.at = max(end, block.at)
            # Replace a finished block by the next one of its group.
            if block.at < len(block.frames):
                left.append((blocks, block))
            else:
                _next_block(blocks, left)
        ready.sort(key=lambda pair: pair[0])
        yield from (frame for _, frame in ready)
        waiting = left


def _next_block(blocks: Iterator[list[LoggedFrame]], waiting: list[tuple[Iterator[list[LoggedFrame]], _Block]]) -> None:
    """Adds the next block of a group. Among the groups, a frame whose time goes back is
    ordered by the latest time before it."""
    frames = next(blocks, [])
    if frames:
        times = np.array([f.time_ns for f in frames], dtype=np.int64)
        waiting.append((blocks, _Block(np.maximum.accumulate(times), frames)))


def check_blocks(stream: BinaryIO) -> bool:
    """Checks all blocks that the header leads to. Returns whether the writer finished
    the file. Raises LogError, with the place, if a file of this size cannot have
    such blocks."""
    size = stream.seek(0, 2)
    stream.seek(0)
    version = stream.read(_HEADER_AT)
    if len(version) < _HEADER_AT or int.from_bytes(version[28:30], "little") < 400:
        raise LogError("MDF before version 4, expected MDF 4 (.mf4)")
    finished = version[:8] == MAGICS[0]
    _BlockCheck(stream, size, finished=finished).walk()
    return finished


class _BlockCheck:
    def __init__(self, stream: BinaryIO, size: int, *, finished: bool) -> None:
        self._stream, self._size, self._finished = stream, size, finished
        self._unpacked = 0
        self._records: list[tuple[int, int]] = []  # offset of a group, size of its records
        self._next: dict[int, list[int]] = {}

    def walk(self) -> None:
        # Visit every block once.
        todo, seen = [_HEADER_AT], {_HEADER_AT}
        while todo:
            at = todo.pop()
            for link in self._links(at):
                if link and link not in seen:
                    seen.add(link)
                    todo.append(link)
            if len(seen) > BLOCKS_MOST:
                raise LogError(f"more than {BLOCKS_MOST} blocks")
        # Check the sizes of compressed blocks and of record groups.
        if self._unpacked > EXPANSION_MOST * self._size + ROOM:
            raise LogError(f"its blocks unpack to more than {EXPANSION_MOST} times the file")
        for at, needed in self._records:
            if self._finished and needed > self._unpacked:
                raise LogError(f"byte {at}: a group of {needed} bytes, and there are {self._unpacked} in the file")
        self._require_ends()

    def _links(self, at: int) -> tuple[int, ...]:
        if at + _BLOCK.size > self._size:
            raise LogError(f"byte {at}: the file ends before a block that it names")
        self._stream.seek(at)
        head = self._stream.read(_BLOCK.size)
        kind, length, count = _BLOCK.unpack(head)
        if not kind.startswith(b"##"):
            raise LogError(f"byte {at}: expected a block (##)")
        if at + length > self._size and (self._finished or kind != b"##DT"):
            raise LogError(f"byte {at}: the file ends in a block")
        if count > LINKS_MOST or (length and _BLOCK.size + 8 * count > length):
            raise LogError(f"byte {at}: a block of {length} bytes with {count} links")
        links = struct.unpack(f"<{count}Q", self._read(8 * count, at))
        self._add_size(kind, length - _BLOCK.size - 8 * count, at)
        if kind in _CHAINED:
            self._next[at] = [link for link in links[: 2 if kind == b"##CN" else 1] if link]
        return links

    def _add_size(self, kind: bytes, held: int, at: int) -> None:
        """Adds the size that the block unpacks to, or that its group claims."""
        if kind == b"##DZ":
            self._unpacked += _ZIPPED.unpack(self._read(_ZIPPED.size, at))[3]
        elif kind == b"##CG":
            _, records, flags, _, record, invalid = _GROUP.unpack(self._read(_GROUP.size, at))
            self._records.append((at, records * (1 if flags & _VARIABLE_LENGTH else max(1, record + invalid))))
        else:
            self._unpacked += max(0, held)

    def _read(self, count: int, at: int) -> bytes:
        data = self._stream.read(count)
        if len(data) < count:
            raise LogError(f"byte {at}: the file ends in a block")
        return data

    def _require_ends(self) -> None:
        """Checks that no chain leads back to itself, by a topological sort."""
        # Count the links to each block.
        links_to = dict.fromkeys(self._next, 0)
        for links in self._next.values():
            for link in links:
                if link in links_to:
                    links_to[link] += 1
        # Remove blocks without a link to them; those of a circle remain.
        todo = [at for at, count in links_to.items() if not count]
        done = 0
        while todo:
            at = todo.pop()
            done += 1
            for link in self._next[at]:
                if link in links_to:
                    links_to[link] -= 1
                    if not links_to[link]:
                        todo.append(link)
        if done < len(links_to):
            raise LogError(
                f"byte {min(at for at, count in links_to.items() if count)}: blocks that lead back to themselves"
            )
