"""Simulators of this machine, so that an error can name the one behind a wrong answer.

Each process of `triaxcal sim` has a file of its own beside the locks, and a lock
(flock) on it, which ends with the process. Nothing is asked of a device for this: what
answers may be a real unit. Without flock (outside POSIX), or where the folder cannot
be written, no simulator is named.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel

import triaxcal_drivers as td
from triaxcald.printable import printable
from triaxcald.provision.identity import same_serial
from triaxcald.station.lock import fcntl, folder

PREFIX, SUFFIX = "triaxcal-sim-", ".json"
FILE_BYTES = 1 << 18
"""Of a thousand units; any user can write into the folder."""
NAME_MOST = 4096  # of the path of a file
_ANYWHERE = ("0.0.0.0", "::")


@dataclass(frozen=True)
class Simulator:
    """A simulated unit: its ``file``, its serial number, and its place as
    `triaxcal_drivers.Claim` has it."""

    file: str
    serial: str
    device: str
    host: str | None
    pid: int

    @classmethod
    def of(cls, file: Path, serial: str, bus: BaseModel) -> Simulator:
        claim = td.claim_of(bus)
        return cls(str(file.absolute()), serial, claim.device, claim.host, os.getpid())

    def is_at(self, claim: td.Claim) -> bool:
        anywhere = self.host in _ANYWHERE and claim.host == td.canonical_host("127.0.0.1")
        return self.device == claim.device and (anywhere or self.host == claim.host)

    def __str__(self) -> str:
        return f"serial {self.serial} at {self.device} is simulated by {self.file} (pid {self.pid})"


@contextmanager
def announced(simulators: Sequence[Simulator]) -> Iterator[None]:
    """Other processes can tell these simulators until the context ends."""
    path = folder() / f"{PREFIX}{os.getpid()}{SUFFIX}"
    descriptor = None if fcntl is None else _written(path, [asdict(s) for s in simulators])
    try:
        yield
    finally:
        if descriptor is not None:
            with suppress(OSError):
                path.unlink()
            os.close(descriptor)


def _written(path: Path, content: Any) -> int | None:
    """The locked descriptor; None where that is not possible."""
    with suppress(OSError):
        path.unlink(missing_ok=True)  # of a killed process with the same number
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            os.write(descriptor, json.dumps(content).encode())
        except OSError:
            os.close(descriptor)
            raise
        return descriptor
    return None


def others_at(bus: BaseModel, expected_serial: str | None) -> list[Simulator]:
    """The simulators of other serial numbers than the expected one that live at the
    place."""
    claim, found = td.claim_of(bus), []
    with suppress(OSError):
        for path in sorted(folder().glob(f"{PREFIX}*{SUFFIX}")):
            found += [s for s in _read(path) if s.is_at(claim)]
    return [s for s in found if expected_serial is None or not same_serial(s.serial, expected_serial)]


def _read(path: Path) -> list[Simulator]:
    """Of a process that lives; none where the file has anything else."""
    if fcntl is None:
        return []
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError:
        return []
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        with suppress(ValueError, RecursionError, KeyError, TypeError, OSError):
            return [_simulator(held) for held in json.loads(os.pread(descriptor, FILE_BYTES, 0))]
    except OSError:
        pass
    finally:
        os.close(descriptor)
    return []


def _simulator(held: Any) -> Simulator:
    file, serial, device, host = (held[key] for key in ("file", "serial", "device", "host"))
    return Simulator(_text(file), _text(serial), _text(device), host and _text(host), int(held["pid"]))


def _text(held: object) -> str:
    """Raises TypeError."""
    if not isinstance(held, str):
        raise TypeError
    return printable(held[:NAME_MOST])
