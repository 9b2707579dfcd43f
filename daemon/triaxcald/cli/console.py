"""The console: results on standard output, progress and warnings on standard error."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text

import triaxcal as tc
from triaxcald.abort import add_action, discard_action, steer
from triaxcald.printable import printable, printable_json
from triaxcald.text import waits

if TYPE_CHECKING:
    from triaxcald.recording.schema import Phase
    from triaxcald.station.guidance import Guide
    from triaxcald.station.tray import Instruction


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


def at(what: str, done: float | None = None) -> None:
    """Show the present step of the command."""
    if _line is not None:
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


class _Shown(Console):
    def on_broken_pipe(self) -> None:
        """Stop the display after the reader has gone; rich would close standard output
        too and end the program."""
        self.quiet = True


class _Instructed(Progress):
    """Bars under a line that says how to turn the fixture."""

    instruction = ""

    def get_renderables(self) -> Iterable[RenderableType]:
        if self.instruction:
            yield Text(self.instruction, style="bold")
        yield from super().get_renderables()


SHOW_CURSOR = "\x1b[?25h"


class Bars:
    """Progress bars, one a unit; plain lines where standard error is no
    terminal."""

    def __init__(self) -> None:
        self._console = _Shown(stderr=True)
        self._progress = _Instructed(
            TextColumn("{task.fields[unit]:<8}", markup=False),
            BarColumn(bar_width=26),
            TextColumn("{task.completed:.0f}/{task.total:.0f} poses"),
            TimeElapsedColumn(),
            TextColumn("{task.description}", markup=False),
            console=self._console,
            disable=not self._console.is_terminal,
        )
        self._tasks: dict[str, TaskID] = {}
        self._said: dict[str, str] = {}

    def __enter__(self) -> Bars:
        add_action(self, self._show_cursor_at_abort)
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self._progress.stop()
        discard_action(self)

    def _show_cursor_at_abort(self, _: float) -> None:
        """The bars hide it. Anything else of theirs could wait for a lock that
        the main thread holds."""
        if self._console.is_terminal:
            steer(SHOW_CURSOR)

    def _task(self, unit: str) -> TaskID:
        if unit not in self._tasks:
            self._tasks[unit] = self._progress.add_task("", total=1, unit=printable(unit))
        return self._tasks[unit]

    def stage(self, unit: str, what: str) -> None:
        self._show(unit, description=printable(what))
        self._plain(unit, what)

    def lost(self, unit: str, trouble: str) -> None:
        self.stage(unit, waits(trouble))

    def poses(self, unit: str, phase: Phase, guide: Guide) -> None:
        what = "check poses" if phase == "verification" else "poses"
        turn = guide.hint.startswith("next")
        # A unit on a fixture is turned by the fixture's instruction, not by its own.
        hint = "" if turn and self._progress.instruction else f": {guide.hint}"
        self._show(unit, completed=guide.found, total=guide.wanted, description=printable(what + hint))
        # Seconds that go by are for a terminal; a log gets a line for each
        # pose, and where to turn next.
        if not guide.hint.startswith("hold still"):
            then = f"; {guide.hint}" if turn and hint else ""
            self._plain(unit, f"{what}: {guide.found} of {guide.wanted} directions{then}")

    def instruction(self, instruction: Instruction | None) -> None:
        if instruction is None:
            self._progress.instruction = ""
            return
        self._progress.instruction = printable(f"{instruction.label} ({', '.join(instruction.slots)})")
        self._plain("the fixture", instruction.label)

    def _show(self, unit: str, **values: Any) -> None:
        with suppress(OSError):  # the terminal has gone; the work goes on
            self._progress.update(self._task(unit), **values)

    def _plain(self, unit: str, text: str) -> None:
        if not self._console.is_terminal and self._said.get(unit) != text:
            self._said[unit] = text
            say(f"{unit}: {text}")
