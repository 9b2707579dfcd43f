"""What a command is at, told on standard error while it takes long: one line
that is written anew on a terminal, else a line every some seconds."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from triaxcal.progress import Stage
from triaxcald.printable import printable

SILENT_S = 3.0
"""Work that is soon done is not told."""
BEAT_S = 0.5
"""Between two states of the line on a terminal: seconds go by visibly."""
PLAIN_S = 10.0
"""Between two lines in a log."""
ERASE = "\r\x1b[K"
WORDS = {
    Stage.POSES: "looking for still spans",
    Stage.FIT: "fitting the linear model",
    Stage.EFFECTS: "comparing possible effects",
    Stage.ERRORS: "computing uncertainties",
    Stage.ADVICE: "looking for the poses that tell most",
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
        """Before anything else is written to the terminal."""
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
    """Of what `at` and `progress` are told inside."""
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


def at(what: str, done: float | None = None) -> None:
    """What the command is at, in words."""
    if _line is not None:
        _line.at(what, done)


def progress(stage: Stage, done: float | None = None) -> None:
    """The same of the metrology, as a `triaxcal.progress.Progress`."""
    at(WORDS[stage], done)


def erased() -> None:
    """Something else is about to be written."""
    if _line is not None:
        _line.erase()


def _to_standard_error(text: str) -> None:
    with suppress(OSError, ValueError):
        sys.stderr.write(text)
        sys.stderr.flush()
