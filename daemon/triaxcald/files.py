"""Files written whole or not at all, and through no symbolic link: whoever can
make one shall not choose the file."""

from __future__ import annotations

import errno
import os
import re
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import BinaryIO

from triaxcald.abort import at_abort
from triaxcald.errors import InputError, RecordingError

_OF_THE_DISK = frozenset((errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS))


def is_of_the_disk(e: OSError) -> bool:
    """Whether the disk is full, fails, or takes no data."""
    return e.errno in _OF_THE_DISK


def require_recording(path: Path) -> None:
    """Raises RecordingError where no command would read a recording of that
    name."""
    if path.suffix != ".mcap":
        raise RecordingError(f"{path}: the name of a recording ends in .mcap")


def require_new(path: Path) -> None:
    """For a recording. Raises RecordingError where anything is there, if only a
    link to nothing."""
    if os.path.lexists(path):
        raise exists_already(path)


def exists_already(path: Path) -> RecordingError:
    return RecordingError(f"{path}: exists already; a recording is never overwritten")


def write_text(path: Path, text: str) -> Path:
    """As `write_bytes`, in UTF-8."""
    try:
        return write_bytes(path, text.encode())
    except UnicodeEncodeError as e:
        raise InputError(f"{path}: cannot be written: {e.object[e.start]!r} is no character") from e


def write_bytes(path: Path, data: bytes) -> Path:
    """Through a temporary file beside it; a pipe or a device (/dev/null,
    /dev/stdout) is written to as it is.

    Raises InputError, one line.
    """
    require_writable(path)
    try:
        if is_stream(path):
            path.write_bytes(data)
        else:
            replace_bytes(path, data)
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from e
    return path


def write_new(folder: Path, stem: str, suffix: str, text: str) -> Path:
    """To a file that did not exist: ``stem`` gets a number where it did. Raises
    InputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for number in count(1):
            path = folder / f"{stem}{f'-{number}' if number > 1 else ''}{suffix}"
            try:
                with new_file(path) as f:
                    f.write(text.encode())
                    f.flush()
                    os.fsync(f.fileno())
            except FileExistsError:
                continue
            return path
    except OSError as e:
        raise InputError(f"{folder}: cannot be written to: {e.strerror}") from e
    raise AssertionError("there is always another number")


_UNSAFE = re.compile(r"[^A-Za-z0-9._-]")


def in_a_name(text: str) -> str:
    """``text`` as part of a file's name: a device's serial number may be any."""
    return _UNSAFE.sub("_", text)


def unused(path: Path) -> Path:
    """Of that name, with a number where it is there already."""
    names = (path.with_stem(f"{path.stem}-{number}") if number > 1 else path for number in count(1))
    return next(name for name in names if not os.path.lexists(name))


def write_durably(path: Path, text: str) -> None:
    """Whole or not at all, and on the disk when it returns: it outlives a loss
    of power. Raises OSError."""
    replace_bytes(path, text.encode())
    synchronise(path.parent)


def overwrite(path: Path, offset: int, data: bytes) -> None:
    """Bytes within a file, on the disk when it returns. They need no new room, so a
    full disk takes them too. Raises OSError."""
    flags = os.O_WRONLY | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_BINARY", 0)
    with open(os.open(path, flags), "wb") as file:
        file.seek(offset)
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def synchronise(folder: Path) -> None:
    """The names in it are on the disk. Raises OSError."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def synchronise_file(path: Path) -> None:
    """What was written to it is on the disk. Raises OSError."""
    descriptor = os.open(path, os.O_RDWR | getattr(os, "O_CLOEXEC", 0))
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def require_writable(path: Path) -> None:
    """Raises InputError where ``path`` is a symbolic link to a file, or to
    nothing."""
    if path.is_symlink() and not is_stream(path):
        raise InputError(f"{path}: cannot be written: a symbolic link, expected a file of its own")


def is_stream(path: Path) -> bool:
    """Whether it is a pipe or a character device, wherever links lead, or one
    of the system's own names for whatever a descriptor stands for (/dev/stdout,
    /dev/fd/3)."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return False
    folder = os.path.realpath(path.parent)
    return stat.S_ISFIFO(mode) or stat.S_ISCHR(mode) or folder == "/dev" or folder.startswith("/proc/")


def replace_bytes(path: Path, data: bytes) -> None:
    """Through a temporary file beside it. Raises OSError."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    with new_file(temporary) as f:
        f.write(data)
        f.flush()
        os.fsync(f.fileno())
        f.close()
        os.replace(temporary, path)


@contextmanager
def new_beside(path: Path) -> Iterator[Path]:
    """A temporary file beside ``path``, empty, which takes its place where the
    context comes to its end, and is on the disk then; it is gone where the context
    does not. Raises OSError."""
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "no regular file, which alone can be replaced", str(path))
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    with new_file(temporary) as file:
        file.close()
        yield temporary
        synchronise_file(temporary)
        os.replace(temporary, path)
    synchronise(path.parent)


@contextmanager
def new_file(path: Path, mode: int = 0o666) -> Iterator[BinaryIO]:
    """A file that was not there before, from its first moment with no more than this
    mode. Nothing of it is left where the context does not come to its end.

    Raises FileExistsError and other OSError.
    """
    taken = os.path.lexists(path)

    def remove(_: float = 0.0) -> None:
        if not taken:
            with suppress(OSError):
                path.unlink(missing_ok=True)

    with at_abort(remove):
        try:
            with open(path, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as f:
                yield f
        except BaseException:
            remove()
            raise
