"""What a recording asks of the disk it is written to, and what is said where
the disk fails."""

from __future__ import annotations

import errno
import os
from datetime import UTC, datetime
from pathlib import Path

from triaxcald import memory
from triaxcald.errors import DiskError, RecordingError
from triaxcald.files import is_of_the_disk

END_BYTES, CHUNK_BYTES = 4 * 2**20, 256
"""So much room the end of a file takes at most, and more for each of its chunks:
the last chunk is of a mebibyte or two, and each has its index."""


def free_bytes(path: Path | int) -> int | None:
    """What may still be written where ``path``, or an open descriptor, is; None
    where the system does not say."""
    if not hasattr(os, "statvfs"):
        return None
    try:
        found = os.statvfs(path)
    except OSError:
        return None
    # What is kept back for the superuser is there for him.
    blocks = found.f_bfree if os.geteuid() == 0 else found.f_bavail
    return blocks * found.f_frsize if found.f_blocks else None


def require_there(descriptor: int) -> None:
    """Raises OSError where the open file has no name any more: what is written
    to it is lost when it is closed."""
    if os.fstat(descriptor).st_nlink == 0:
        raise FileNotFoundError(errno.ENOENT, "the file, or its folder, was removed")


def not_created(path: Path, e: OSError) -> RecordingError:
    kind = DiskError if is_of_the_disk(e) else RecordingError
    return kind(f"{path}: cannot be created: {e.strerror}")


def require_room(path: Path) -> None:
    """For a file and its end: who is started again and again would fill the disk
    to its last byte. Raises DiskError."""
    free = free_bytes(path.parent)
    if free is not None and free < END_BYTES:
        raise no_room(path, free)


def no_room(path: Path, free: int) -> DiskError:
    return DiskError(f"{path}: cannot be created: {free} bytes are free on the disk, {END_BYTES} are needed")


def not_written(path: Path, e: OSError, sound_ns: int | None) -> DiskError:
    """``sound_ns`` is the host's time up to which everything is in the file;
    None where the file is removed."""
    left = "nothing of it is left" if sound_ns is None else f"sound up to {_utc(sound_ns)}"
    return DiskError(f"{path}: writing failed: {e.strerror or e}; {left}")


def out_of_memory(path: Path, e: Exception, sound_ns: int | None) -> DiskError:
    left = "nothing of it is left" if sound_ns is None else f"sound up to {_utc(sound_ns)}"
    return DiskError(f"{path}: writing failed: {memory.out_of_memory(e)}; {left}")


def ended_early(path: Path, free: int, sound_ns: int | None) -> DiskError:
    """The file was ended while there was room for its end."""
    if sound_ns is None:
        return DiskError(f"{path}: cannot be written: {free} bytes are free on the disk; nothing of it is left")
    return DiskError(f"{path}: ended, as {free} bytes are free on the disk; whole up to {_utc(sound_ns)}")


def _utc(time_ns: int) -> str:
    return f"{datetime.fromtimestamp(time_ns / 1e9, UTC):%Y-%m-%dT%H:%M:%SZ}"
