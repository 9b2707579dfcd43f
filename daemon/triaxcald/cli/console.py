"""The console: results on standard output, progress and warnings on standard error."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

from rich.console import Console
from rich.table import Table

import triaxcal as tc
from triaxcald.printable import printable, printable_json

# What a command is at, told on standard error while it takes long: one line that is
# written anew on a terminal, else a line every some seconds.

SILENT_S = 3.0
"""Work that is soon done is not told."""
BEAT_S = 0.5
"""Between two states of the line on a terminal: seconds go by visibly."""
PLAIN_S = 10.0
"""Between two lines in a log."""
ERASE = "\r\x1b[K"
WORDS = {
    tc.Stage.POSES: "looking for still spans",
    tc.Stage.FIT: "fitting the linear model",
    tc.Stage.EFFECTS: "comparing possible effects",
    tc.Stage.ERRORS: "computing uncertainties",
    tc.Stage.ADVICE: "looking for the poses that tell most",
}


class ProgressLine:
    """``write`` takes text as it is to be written; times are those of the
    ``clock`` in seconds. Any thread may call."""

    def __init__(self, write: Callable[[str], None], *, terminal: bool, clock: Callable[[], float] = time.monotonic):
        self._write, self._terminal, self._clock = write, terminal, clock
        self._lock = threading.RLock()  # a signal's handler may say something in the midst of a write
        self._what, self._shown = "", False
        self._done: float | None = None
        self._since_s = self._next_s = 0.0

    def at(self, what: str, done: float | None = None) -> None:
        """The command is at something, or has done this share of it."""
        with self._lock:
            if not self._what:
                self._since_s = self._clock()
                self._next_s = self._since_s + SILENT_S
            self._what, self._done = what, done
        self.beat()

    def beat(self) -> None:
        """Writes the line where it is time."""
        with self._lock:
            now = self._clock()
            if not self._what or now < self._next_s:
                return
            share = "" if self._done is None else f", {min(max(self._done, 0.0), 1.0):.0%}"
            line = printable(f"{self._what}{share} ({now - self._since_s:.0f} s)")
            self._write(f"{ERASE}{line}" if self._terminal else f"{line}\n")
            self._shown, self._next_s = self._terminal, now + (BEAT_S if self._terminal else PLAIN_S)

    def erase(self) -> None:
        """Erase the line, before other output to the terminal."""
        with self._lock:
            if self._shown:
                self._write(ERASE)
                self._shown = False

    def end(self) -> None:
        with self._lock:
            self.erase()
            self._what = ""


_line: ProgressLine | None = None


@contextmanager
def telling_progress() -> Iterator[None]:
    """Shows a progress line, which `at` and `progress` set, within the context."""
    global _line
    ended, line = threading.Event(), ProgressLine(_to_standard_error, terminal=sys.stderr.isatty())

    def beats() -> None:
        while not ended.wait(BEAT_S):
            line.beat()

    _line = line
    threading.Thread(target=beats, daemon=True, name="progress").start()
    try:
        yield
    finally:
        ended.set()
        line.end()
        _line = None


_silent = False


@contextmanager
def silent() -> Iterator[None]:
    """Within it `say` and `at` say nothing: at one of many recordings, whose row has
    what there is to say."""
    global _silent
    before, _silent = _silent, True
    try:
        yield
    finally:
        _silent = before


def at(what: str, done: float | None = None) -> None:
    """Show the present step of the command."""
    if _line is not None and not _silent:
        _line.at(what, done)


def progress(stage: tc.Stage, done: float | None = None) -> None:
    """Show the present step of the metrology (a `triaxcal.progress.Progress`)."""
    at(WORDS[stage], done)


def erased() -> None:
    """Something else is about to be written."""
    if _line is not None:
        _line.erase()


def _to_standard_error(text: str) -> None:
    with suppress(OSError, ValueError):
        sys.stderr.write(text)
        sys.stderr.flush()


LINE_MOST = 4000  # characters of a line; the longest of ours list a thousand poses' labels


def emit(document: Mapping[str, Any] | Sequence[Any]) -> None:
    """One JSON document on standard output, nothing else."""
    erased()
    sys.stdout.write(printable_json(json.dumps(document, indent=2, ensure_ascii=False, allow_nan=False)) + "\n")


def show(line: str) -> None:
    """A line of what came of the work, to standard output; what a file holds
    may be quoted in it, as in `say`."""
    erased()
    sys.stdout.write(printable(line) + "\n")


class Unshown(Exception):
    """Standard output does not take what came of work that has ended. ``code``
    is the work's own exit code, ``told`` what came of it in one line."""

    def __init__(self, error: OSError, code: int, told: str) -> None:
        super().__init__(told)
        self.error, self.code, self.told = error, code, told


@contextmanager
def showing(code: int, told: str) -> Iterator[None]:
    """Context of output about work that has changed a device: the exit code and the
    result are reported even if standard output fails. Raises Unshown."""
    try:
        yield
        sys.stdout.flush()
    except OSError as e:
        raise Unshown(e, code, told) from e


def say(text: str) -> None:
    """A line to standard error; nowhere, where that has been closed: no work
    may fail for it.

    What a file holds may be quoted in it: that can neither begin a second line
    nor steer the terminal.
    """
    if _silent:
        return
    erased()
    line = printable(text)
    if len(line) > LINE_MOST:
        line = f"{line[: LINE_MOST // 2]} … {line[-LINE_MOST // 2 :]}"
    with suppress(OSError, ValueError):
        sys.stderr.write(line + "\n")
        sys.stderr.flush()


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Print a table to standard output. Numbers are formatted by the caller; each text
    of a tuple gets a line of its own."""
    erased()
    shown = Table(title=printable(title), title_justify="left", header_style="bold")
    for i, name in enumerate(columns):
        shown.add_column(printable(name), justify="left" if i == 0 else "right", overflow="fold")
    for row in rows:
        shown.add_row(*map(_cell, row))
    width = None if sys.stdout.isatty() else 160
    _Output(file=sys.stdout, width=width, markup=False, highlight=False).print(shown)


def _cell(value: Any) -> str:
    if value is None:
        return "—"
    return "\n".join(map(printable, value)) if isinstance(value, tuple) else printable(str(value))


class _Output(Console):
    def on_broken_pipe(self) -> None:
        """rich would end the program, with a code that means something else
        here."""
        raise BrokenPipeError


def micro(value: float | None) -> str:
    """A number of g in µg."""
    return tc.units.ErrorUnit().written(value)
