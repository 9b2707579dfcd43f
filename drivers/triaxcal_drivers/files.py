"""Files that somebody else may have made: opened without waiting, read up to a
size, kept inside their folder."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import BinaryIO


class TooLarge(OSError):
    """``head`` is what was read of a file of more than ``most`` bytes."""

    def __init__(self, most: int, head: bytes) -> None:
        super().__init__(errno.EFBIG, f"larger than the {size(most)} that such a file may have")
        self.head = head


def open_file(path: Path, *, pipe: bool = False) -> BinaryIO:
    """A file to read from; with ``pipe`` also a pipe, where the user gave the
    name: `<(…)` of the shell is one.

    A device is not even opened, and a pipe that nobody writes to is empty
    instead of being waited for. Raises OSError with a reason to show.
    """
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


def read_whole(path: Path, most: int, *, pipe: bool = False) -> bytes:
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
