"""Work at one recording, wherever it runs: its result is a row, whatever happens."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import Any, Final, Generic, TypeVar

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.computer import compute_with_one_thread
from triaxcald.errors import DEVICE, DONE, DaemonError, exit_code_of
from triaxcald.many.sources import Source, Unusable
from triaxcald.memory import bounded, out_of_memory, ran_out_of_memory
from triaxcald.recording.reader import digest_of
from triaxcald.schema.columns import Kind
from triaxcald.stores import path_of

T = TypeVar("T")
Cell = str | int | float | None
Row = dict[str, Cell]


@dataclass(frozen=True)
class Column(Generic[T]):
    """A column of a table of many recordings, and its cell of what work has found."""

    name: str
    kind: Kind
    meaning: str
    value: Callable[[T], Cell]


def _of_the_engine(_: object) -> Cell:
    """Filled by `attempt`."""
    return None


def _common(name: str, kind: Kind, meaning: str) -> Column[Any]:
    return Column(name, kind, meaning, _of_the_engine)


COMMON_BEFORE: Final = (
    _common("recording", Kind.TEXT, "path or URL of the recording"),
    _common("exit_code", Kind.WHOLE, "exit code of the command for this recording"),
)
COMMON_AFTER: Final = (
    _common("error", Kind.TEXT, "why there is no result; else empty"),
    _common("seconds", Kind.NUMBER, "time that it took [s]"),
    _common("size", Kind.WHOLE, "size of the file [bytes]"),
    _common(
        "stamp",
        Kind.TEXT,
        "modification time [ns since 1970], or the store's ETag; after a `+` a digest of those of files beside it",
    ),
    _common("sha256", Kind.TEXT, "SHA-256 of the file; empty where it could not be read"),
    _common("software", Kind.TEXT, "version of triaxcal that computed the row"),
    _common("settings", Kind.TEXT, "digest of command and options"),
)


@dataclass(frozen=True)
class Finding:
    """What came of work at one recording. ``lines`` are for the console, ``document``
    for `--json`. ``written`` is a temporary file and the name that it gets once the
    row is stored."""

    cells: Mapping[str, Cell]
    exit_code: int = DONE
    lines: tuple[str, ...] = ()
    document: Mapping[str, Any] | None = None
    written: tuple[str, str] | None = None


Work = Callable[[td.files.AnyPath], Finding]
"""Raises errors of the three packages. It must be importable by a worker, with
everything it needs as arguments."""


@dataclass(frozen=True)
class Settings:
    """``digest`` of command and options; ``software`` is the version that is to
    compute, ``memory`` the bytes that a process may take, None for any."""

    digest: str
    software: str = field(default_factory=lambda: version("triaxcal"))
    memory: int | None = None


@dataclass(frozen=True)
class Done:
    """A row and what else came of one recording."""

    name: str
    row: Row
    lines: tuple[str, ...] = ()
    document: Mapping[str, Any] | None = None
    written: tuple[str, str] | None = None

    @property
    def exit_code(self) -> int:
        return int(self.row["exit_code"] or 0)

    @property
    def error(self) -> str | None:
        error = self.row["error"]
        return None if error is None else str(error)


class WrongVersion(DaemonError):
    """A worker has another version of triaxcal than this process."""


_one_at_a_time = threading.Lock()
"""The limit of memory is the process's: threads of a worker wait for each other."""


def attempt(work: Work, source: Source, settings: Settings, *, supervised: bool = True) -> Done:
    """Raises WrongVersion; every other error is the recording's row, one that nobody
    foresaw only if the work is ``supervised``."""
    here = version("triaxcal")
    if here != settings.software:
        raise WrongVersion(f"a worker has triaxcal {here}, expected {settings.software}")
    with _one_at_a_time:
        return _attempt(work, source, settings, here, supervised)


def _attempt(work: Work, source: Source, settings: Settings, here: str, supervised: bool) -> Done:
    began_s = time.monotonic()
    path = path_of(source.name)
    digest: str | None = None
    error: Exception | None = None
    try:
        _warm()
        with bounded(settings.memory):
            finding = work(path)
            digest = digest_of(path)
    except tc.Refused as e:
        wanted = f"; add the poses {', '.join(e.wanted)}" if e.wanted else ""
        finding, error = failed(f"{source.name}: refused: {e}{wanted}", exit_code_of(e)), e
    except (tc.TriaxcalError, td.DriverError, DaemonError) as e:
        finding = failed(str(e) if source.name in str(e) else f"{source.name}: {e}", exit_code_of(e))
        error = e
    except Exception as e:
        if ran_out_of_memory(e):
            e.__traceback__ = e.__context__ = None  # and all that its frames hold
            finding = failed(f"{source.name}: {out_of_memory(e)}", exit_code_of(e))
        elif isinstance(e, ModuleNotFoundError) and (lacking := td.hints.lacking(e)):
            finding = failed(f"{source.name}: {lacking}", 2)
        elif not supervised:
            raise
        else:
            finding = failed(f"{source.name}: internal error: {type(e).__name__}: {e}", DEVICE)
    if error is not None and not _of_this_process(error):
        with suppress(Exception), bounded(settings.memory):  # stores have errors of their own
            digest = digest_of(path)
    row = {
        "recording": source.name,
        "exit_code": finding.exit_code,
        "error": None,
        **finding.cells,
        "seconds": round(time.monotonic() - began_s, 3),
        "size": source.size,
        "stamp": source.stamp,
        "sha256": digest,
        "software": here,
        "settings": settings.digest,
    }
    return Done(source.name, row, finding.lines, finding.document, finding.written)


def _of_this_process(e: BaseException | None) -> bool:
    """Whether it lacks a package, or may not read a file: another process, or another
    time, may come out otherwise."""
    while e is not None:
        if isinstance(e, ImportError | PermissionError | td.DriverMissing):
            return True
        e = e.__cause__ or e.__context__
    return False


def failed(error: str, exit_code: int) -> Finding:
    return Finding({"error": error}, exit_code)


def unusable(of: Unusable | Source, error: str, exit_code: int, settings: Settings) -> Done:
    """The row of what names no recording, or of one at which workers die."""
    stamp, size = (of.stamp, of.size) if isinstance(of, Source) else (None, None)
    row: Row = {
        "recording": of.name, "exit_code": exit_code, "error": error, "size": size, "stamp": stamp,
        "software": settings.software, "settings": settings.digest,
    }  # fmt: skip
    return Done(of.name, row)


_warmed = False


def _warm() -> None:
    """Let the linear algebra take its buffers before memory is bounded: it ends the
    process where it finds none."""
    global _warmed
    if not _warmed:
        import numpy as np
        import scipy.linalg

        compute_with_one_thread()
        square = np.eye(64) + 0.5
        scipy.linalg.cho_factor(square @ square)
        np.linalg.svd(square)
        _warmed = True
