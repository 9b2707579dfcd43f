"""The events of a run on standard output, one JSON object a line
(`triaxcal.event/1`)."""

from __future__ import annotations

import json
import os
import queue
import select
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, TextIO

from triaxcald.printable import printable_json
from triaxcald.run.events import Events
from triaxcald.schema.codes import Stage

if TYPE_CHECKING:
    from triaxcald.recording.schema import Phase
    from triaxcald.schema.codes import Code
    from triaxcald.station.collection import Progress
    from triaxcald.station.guidance import Guide
    from triaxcald.station.tray import Instruction

DRAIN_S = 30.0
"""Longest wait at the end for a reader that does not read."""


class EventLines(Events):
    """Writes each event at once, on a thread of its own: a reader that is slow or gone
    stops no measurement. ``write`` takes the bytes of a line; it may block, and raises
    OSError. ``runs`` maps the slots to the ids of their runs."""

    def __init__(self, write: Callable[[bytes], object], tray: str, runs: Mapping[str, str]) -> None:
        self._write, self._seq = write, 0
        self.trouble: OSError | None = None
        """Why later events were not written."""
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="events", daemon=True)
        super().__init__(self._put, tray, runs, number=self._following)

    def __enter__(self) -> EventLines:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._seq:
            self.all_ended()
        self._lines.put(None)
        self._thread.join(DRAIN_S)

    def begun(self) -> None:
        self.started()

    def _following(self) -> int:
        self._seq += 1
        return self._seq

    def _put(self, event: dict[str, Any]) -> None:
        self._lines.put(printable_json(json.dumps(event, ensure_ascii=False, allow_nan=False)))

    def _work(self) -> None:
        while (line := self._lines.get()) is not None:
            try:
                self._write(f"{line}\n".encode())
            except (OSError, ValueError) as e:  # nobody reads any more; the work goes on
                self.trouble = e if isinstance(e, OSError) else None
                with suppress(OSError):
                    self._drop()
                return

    def _drop(self) -> None:
        """Later lines go nowhere."""
        while self._lines.get() is not None:
            pass


@contextmanager
def writes_to(stream: TextIO) -> Iterator[Callable[[bytes], object]]:
    """Writes to the file descriptor of a stream, past Python's buffers, whose lock a
    blocked write would keep from the end of the process. A stream that another program
    has put there may have no descriptor."""
    try:
        own = os.dup(stream.fileno())
    except (OSError, ValueError):
        yield lambda data: print(data.decode(), end="", file=stream, flush=True)
        return

    def write(data: bytes) -> None:
        while data:
            try:
                data = data[os.write(own, data) :]
            except BlockingIOError:  # a pipe that its owner has set so, and that is full
                select.select([], [own], [])

    try:
        yield write
    finally:
        os.close(own)


class Several:
    """Passes the progress on to several receivers."""

    def __init__(self, receivers: Sequence[Progress]) -> None:
        self._receivers = receivers

    def stage(self, unit: str, stage: Stage) -> None:
        for receiver in self._receivers:
            receiver.stage(unit, stage)

    def note(self, unit: str, text: str) -> None:
        for receiver in self._receivers:
            receiver.note(unit, text)

    def lost(self, unit: str, code: Code, reason: str) -> None:
        for receiver in self._receivers:
            receiver.lost(unit, code, reason)

    def back(self, unit: str) -> None:
        for receiver in self._receivers:
            receiver.back(unit)

    def poses(self, unit: str, phase: Phase, guide: Guide) -> None:
        for receiver in self._receivers:
            receiver.poses(unit, phase, guide)

    def instruction(self, instruction: Instruction | None) -> None:
        for receiver in self._receivers:
            receiver.instruction(instruction)
