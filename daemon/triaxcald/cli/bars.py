"""Progress of the units of a station on standard error: a row a slot on a terminal,
else plain lines."""

from __future__ import annotations

import os
from collections.abc import Iterable
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from rich.console import Console, RenderableType
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Column
from rich.text import Text

from triaxcald.abort import add_action, discard_action, steer
from triaxcald.cli.console import say
from triaxcald.printable import printable
from triaxcald.text import IS_BACK, STAGES, VERDICTS, waits

if TYPE_CHECKING:
    from triaxcald.recording.schema import Phase
    from triaxcald.run.unit_run import Outcome
    from triaxcald.schema.codes import Code, Stage
    from triaxcald.station.guidance import Guide
    from triaxcald.station.tray import Instruction

NARROW = 60
"""Columns below which a row has no room for what the operator is to do."""
SHOW_CURSOR = "\x1b[?25h"


class _Shown(Console):
    def on_broken_pipe(self) -> None:
        """Stop the display after the reader has gone; rich would close standard output
        too and end the program."""
        self.quiet = True


class _Instructed(Progress):
    """Rows under a line that says how to turn the fixture."""

    instruction = ""

    def get_renderables(self) -> Iterable[RenderableType]:
        if self.instruction:
            yield Text(self.instruction, style="bold", no_wrap=True, overflow="ellipsis")
        yield from super().get_renderables()


class Bars:
    """A row for each slot, in the order of the station file, with the state of its
    unit. Plain lines without a terminal, in a narrow one, and with NO_COLOR."""

    def __init__(self, slots: Iterable[str] = ()) -> None:
        self._console = _Shown(stderr=True)
        self._live = self._console.is_terminal and self._console.width >= NARROW and not os.environ.get("NO_COLOR")
        wide = self._console.width >= 100
        self._progress = _Instructed(
            TextColumn("{task.fields[unit]}", markup=False, table_column=Column(no_wrap=True, max_width=16)),
            BarColumn(bar_width=20 if wide else 8),
            TextColumn("{task.completed:.0f}/{task.total:.0f} poses", table_column=Column(no_wrap=True)),
            TimeElapsedColumn(table_column=Column(no_wrap=True)),
            TextColumn(
                "{task.description}", markup=False, table_column=Column(no_wrap=True, overflow="ellipsis", ratio=1)
            ),
            console=self._console,
            disable=not self._live,
            expand=True,
            transient=True,  # the lines of the verdicts stay
        )
        self._tasks: dict[str, TaskID] = {}
        self._said: dict[str, str] = {}
        for slot in slots:
            self._task(slot)

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
        if self._live:
            steer(SHOW_CURSOR)

    def _task(self, unit: str) -> TaskID:
        if unit not in self._tasks:
            self._tasks[unit] = self._progress.add_task("", total=1, unit=printable(unit))
        return self._tasks[unit]

    def stage(self, unit: str, stage: Stage) -> None:
        self.note(unit, STAGES[stage])

    def note(self, unit: str, text: str) -> None:
        self._show(unit, description=printable(text))
        self._plain(unit, text)

    def lost(self, unit: str, code: Code, reason: str) -> None:
        self.note(unit, waits(reason))

    def back(self, unit: str) -> None:
        self.note(unit, IS_BACK)

    def poses(self, unit: str, phase: Phase, guide: Guide) -> None:
        what = "check poses" if phase == "verification" else "poses"
        # A unit on a fixture is turned by the fixture's instruction, not by its own.
        own = guide.next is None or guide.too_short or not self._progress.instruction
        state = f"{what}: {guide.text}" if own else what
        self._show(unit, completed=guide.found, total=guide.wanted, description=printable(state))
        # Seconds that go by are for a terminal; a log gets a line for each
        # pose, and where to turn next.
        if not guide.too_short:
            following = "" if guide.next is None or not own else f"; {guide.text}"
            self._plain(unit, f"{what}: {guide.found} of {guide.wanted} directions{following}")

    def instruction(self, instruction: Instruction | None) -> None:
        if instruction is None:
            self._progress.instruction = ""
            return
        self._progress.instruction = printable(f"{instruction.label} ({', '.join(instruction.slots)})")
        self._plain("the fixture", instruction.label)

    def ended(self, outcome: Outcome) -> None:
        """Show the verdict of a unit: its row keeps it, and a line has the reason."""
        verdict = VERDICTS[outcome.document["verdict"]]
        if (task := self._tasks.get(outcome.unit)) is not None:
            with suppress(OSError):
                self._progress.stop_task(task)
        self._show(outcome.unit, description=printable(f"{verdict} {outcome.document['reason']}"))
        line = printable(verdict_line(outcome))
        if self._live:
            with suppress(OSError):
                self._console.print(line, markup=False, highlight=False, soft_wrap=True)
        else:  # an error line names the program, as in other commands
            say(line if outcome.error is None else f"triaxcal: {line}")

    def _show(self, unit: str, **values: Any) -> None:
        with suppress(OSError):  # the terminal has gone; the work goes on
            self._progress.update(self._task(unit), **values)

    def _plain(self, unit: str, text: str) -> None:
        if not self._live and self._said.get(unit) != text:
            self._said[unit] = text
            say(f"{unit}: {text}")


def verdict_line(outcome: Outcome) -> str:
    """The verdict on a unit in one line, with the reason; of an aborted run also what
    the device holds, and what to do."""
    word = VERDICTS[outcome.document["verdict"]]
    if outcome.error is not None:
        poses = f"; add the poses {', '.join(outcome.wanted)}" if outcome.wanted else ""
        return f"{word} {outcome.error}{poses}"
    serial = outcome.document["serial"]
    return f"{word:<8} unit {outcome.unit}{f', serial {serial}' if serial else ''}: {outcome.document['reason']}"
