"""What a person sees: results on standard output, progress and warnings on
standard error."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Table

from triaxcal.units import ErrorUnit
from triaxcald.abort import add_action, discard_action, steer
from triaxcald.cli.progress import erased
from triaxcald.printable import printable, printable_json
from triaxcald.text import waits

LINE_MOST = 4000  # characters of a line; the longest of ours list a thousand poses' labels

if TYPE_CHECKING:  # every command says something, few show poses
    from triaxcald.recording.schema import Phase
    from triaxcald.station.guidance import Guide


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
    """For what is shown of work that has changed a device: its exit code and
    what came of it are said, whatever becomes of standard output. Raises
    Unshown."""
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
    """To standard output; columns of numbers are the caller's text, and a tuple
    has a line for each of its texts."""
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
    return ErrorUnit().written(value)


class _Shown(Console):
    def on_broken_pipe(self) -> None:
        """Nobody looks any more; rich would take standard output away too, and
        end the program."""
        self.quiet = True


SHOW_CURSOR = "\x1b[?25h"


class Bars:
    """Progress bars, one a unit; plain lines where standard error is no
    terminal."""

    def __init__(self) -> None:
        self._console = _Shown(stderr=True)
        self._progress = Progress(
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
        self._show(unit, completed=guide.found, total=guide.wanted, description=printable(f"{what}: {guide.hint}"))
        # Seconds that go by are for a terminal; a log gets a line for each
        # pose, and where to turn next.
        if not guide.hint.startswith("hold still"):
            hint = f"; {guide.hint}" if guide.hint.startswith("next") else ""
            self._plain(unit, f"{what}: {guide.found} of {guide.wanted}{hint}")

    def _show(self, unit: str, **values: Any) -> None:
        with suppress(OSError):  # the terminal has gone; the work goes on
            self._progress.update(self._task(unit), **values)

    def _plain(self, unit: str, text: str) -> None:
        if not self._console.is_terminal and self._said.get(unit) != text:
            self._said[unit] = text
            say(f"{unit}: {text}")
