"""Locks: one command at a time on a device and on a serial port, across processes and
users.

The kernel keeps a lock (flock) on a file for each and releases it at every end of
the process. The content of a file only names the holder; that of a killed process
has no meaning. The files lie in one folder for all users of the machine, and stay
there, since another process may be about to lock one. Without flock (outside POSIX)
only commands of one process exclude each other.
"""

from __future__ import annotations

import asyncio
import errno
import hashlib
import json
import os
import shlex
import socket
import stat
import sys
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import ExitStack, asynccontextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import triaxcal_drivers as td
from triaxcald.errors import DeviceInUse, DeviceInUseElsewhere, StationError

try:
    import fcntl as fcntl  # also for the other modules that lock files
except ImportError:
    fcntl = None  # type: ignore[assignment]

FOLDER_VARIABLE = "TRIAXCAL_LOCK_FOLDER"
"""Names the folder for processes that share neither /run/lock nor /tmp, as in
containers, or cannot write there. All of them need the same folder."""
_FOLDERS = ("/run/lock", "/tmp")
_LOOKUP_S = 2.0
"""A host name with a slower lookup is locked by its spelling; a connection to it will
fail as well."""
_TRIES, _PAUSE_S = 20, 0.01
"""A new holder writes its name right after locking; the wait for it is this long."""
_HOLDER_BYTES, _COMMAND_LENGTH = 4096, 200


@dataclass(frozen=True)
class Holder:
    """The process that has a lock, and since when, in local time."""

    pid: int
    command: str
    since: str

    @classmethod
    def this_process(cls) -> Holder:
        command = shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])
        return cls(os.getpid(), _printable(command), time.strftime("%Y-%m-%d %H:%M:%S %z"))

    @classmethod
    def said_in(cls, content: bytes) -> Holder | None:
        """None where nobody is named, or a process that has ended."""
        try:
            said = json.loads(content)
            holder = cls(int(said["pid"]), _printable(said["command"]), _printable(said["since"]))
            os.kill(holder.pid, 0)
        except PermissionError:  # it lives, and is another user's
            return holder
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError, OSError):
            return None
        return holder

    def __str__(self) -> str:
        itself = ", which is this process" if self.pid == os.getpid() else ""
        return f"`{self.command}`, pid {self.pid}{itself}, since {self.since}"


@dataclass
class _Held:
    """A lock of this process, with the number of its users. ``descriptor`` is
    None where there is no flock."""

    descriptor: int | None
    holder: Holder
    users: int = 1


_held: dict[str, _Held] = {}


@asynccontextmanager
async def locked(claim: td.Claim) -> AsyncIterator[None]:
    """Hold the claim until the context ends. Units of one process share its serial
    port.

    Raises DeviceInUse with the holder; StationError if the file of a lock cannot be
    made.
    """
    with ExitStack() as stack:
        if claim.serial_port is not None:
            await _lock(f"serial port {claim.serial_port}", stack, shared=True)
        for host in await _addresses(claim.host):
            await _lock(f"{claim.device}, host {host}" if host else claim.device, stack)
        yield


async def _lock(name: str, stack: ExitStack, *, shared: bool = False) -> None:
    for _ in range(_TRIES):
        if _taken(name, shared):
            stack.callback(_release, name)
            return
        await asyncio.sleep(_PAUSE_S)
    raise DeviceInUseElsewhere(f"{name} is in use by another process")


def _taken(name: str, shared: bool) -> bool:
    """Take a lock; False if it has to be tried again, because a new holder has not yet
    written its name."""
    held = _held.get(name)
    if held is not None and not shared:
        raise DeviceInUse(f"{name} is in use by {held.holder}")
    if held is not None:
        held.users += 1
        return True
    holder, descriptor = Holder.this_process(), None
    if fcntl is not None:
        path = folder() / file_name(name)
        try:
            descriptor = _flocked(path, {"lock": name, **asdict(holder)})
        except OSError as e:
            raise StationError(f"{name} cannot be locked: {path}: {e.strerror}{_remedy(e)}") from e
        except _Locked as e:
            if e.holder is None:
                return False
            raise DeviceInUseElsewhere(f"{name} is in use by {e.holder}") from None
    _held[name] = _Held(descriptor, holder)
    return True


def _release(name: str) -> None:
    held = _held[name]
    held.users -= 1
    if held.users:
        return
    del _held[name]
    if held.descriptor is not None:
        with suppress(OSError):
            os.ftruncate(held.descriptor, 0)
        os.close(held.descriptor)


def _remedy(e: OSError) -> str:
    """Hint for a lock file that cannot be made. No other folder is tried: a command
    for which this one is read-only, as in a container, would then use the device at
    the same time as one that can write to it."""
    if e.errno == errno.EEXIST:
        return ""
    if os.environ.get(FOLDER_VARIABLE):
        return f"; {FOLDER_VARIABLE} has to name a folder to which every command on this station can write"
    return f"; set {FOLDER_VARIABLE}, for every command on this station alike, to a folder that can be written to"


class _Locked(Exception):
    """Somebody else has the lock; ``holder`` is None where it is not known who."""

    def __init__(self, holder: Holder | None) -> None:
        super().__init__()
        self.holder = holder


def _flocked(path: Path, content: Mapping[str, Any]) -> int:
    """The descriptor that has the lock. Raises _Locked, OSError."""
    with ExitStack() as stack:
        descriptor = _opened(path)
        stack.callback(os.close, descriptor)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise _Locked(Holder.said_in(os.pread(descriptor, _HOLDER_BYTES, 0))) from None
        if not _is_at(path, descriptor):
            raise _Locked(None)  # the folder was just cleaned: the lock is on a deleted file
        with suppress(OSError):  # a full disk takes the holder's name away, not the lock
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, json.dumps(content).encode(), 0)
        stack.pop_all()
    return descriptor


def _opened(path: Path) -> int:
    """The lock's file, which any user may write; made where there is none.

    The folder is anybody's: a link in the file's place is not followed, and a
    file with another name is not touched. Only a file that is not there is
    opened with O_CREAT, which Linux refuses for other users' files in such
    folders.
    """
    flags = os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC
    while True:
        with suppress(FileNotFoundError):
            descriptor = os.open(path, flags)
            break
        with suppress(FileExistsError):
            descriptor = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o666)
            os.fchmod(descriptor, 0o666)  # whatever the umask
            break
    status = os.fstat(descriptor)
    if not stat.S_ISREG(status.st_mode) or status.st_nlink > 1:
        os.close(descriptor)
        raise FileExistsError(errno.EEXIST, "this is no lock file")
    return descriptor


def _is_at(path: Path, descriptor: int) -> bool:
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(path))
    except FileNotFoundError:
        return False


def file_name(name: str) -> str:
    return f"triaxcal-{hashlib.sha256(os.fsencode(name)).hexdigest()[:32]}.lock"


def folder() -> Path:
    """The folder of this machine's locks: the same for all users, whatever their
    rights."""
    chosen = os.environ.get(FOLDER_VARIABLE)
    if chosen:
        return Path(chosen)
    return next((Path(name) for name in _FOLDERS if _for_everybody(name)), Path(_FOLDERS[-1]))


def _for_everybody(name: str) -> bool:
    try:
        mode = os.stat(name).st_mode
    except OSError:
        return False
    return stat.S_ISDIR(mode) and mode & 0o1777 == 0o1777


async def _addresses(host: str | None) -> Sequence[str | None]:
    """The host's addresses, each of which is locked, so that its names and its
    addresses exclude each other."""
    if host is None or not td.is_name(host):
        return [host]
    try:
        async with asyncio.timeout(_LOOKUP_S):
            found = await asyncio.get_running_loop().getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):  # TimeoutError is an OSError
        return [host]
    return sorted({td.canonical_host(str(address[0])) for *_, address in found})


def _printable(text: object) -> str:
    """Printable text on one line: any user can write into the file of a lock."""
    return "".join(c if c.isprintable() else "?" for c in str(text))[:_COMMAND_LENGTH]
