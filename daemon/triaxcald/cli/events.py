"""The events of a run on standard output, one JSON object a line
(`triaxcal.event/1`)."""

from __future__ import annotations

import json
import os
import queue
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any, TextIO

from triaxcald.printable import printable_json
from triaxcald.schema.codes import Stage
from triaxcald.utc import iso_time

if TYPE_CHECKING:
    from triaxcald.recording.schema import Phase
    from triaxcald.run.unit_run import Outcome
    from triaxcald.schema.codes import Code
    from triaxcald.station.collection import Progress
    from triaxcald.station.guidance import Guide
    from triaxcald.station.tray import Instruction

DRAIN_S = 30.0
"""Longest wait at the end for a reader that does not read."""


class EventLines:
    """Writes each event at once, on a thread of its own: a reader that is slow or gone
    stops no measurement. ``write`` takes the bytes of a line; it may block, and raises
    OSError. ``runs`` maps the slots to the ids of their runs."""

    def __init__(
        self,
        write: Callable[[bytes], object],
        tray: str,
        runs: Mapping[str, str],
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self._write, self._tray, self._runs, self._clock_ns = write, tray, runs, clock_ns
        self._seq = 0
        self._latest: dict[str, object] = {}
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="events", daemon=True)

    def __enter__(self) -> EventLines:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._seq:
            self._say("tray", None, state="ended")
        self._lines.put(None)
        self._thread.join(DRAIN_S)

    def begun(self) -> None:
        self._say("tray", None, state="started")

    # Progress.

    def stage(self, unit: str, stage: Stage) -> None:
        self._latest.pop(unit, None)
        self._say("stage", unit, stage=stage.value)

    def note(self, unit: str, text: str) -> None:
        """For people alone."""

    def lost(self, unit: str, code: Code, reason: str) -> None:
        self._say("lost", unit, code=code.value, reason=reason)

    def back(self, unit: str) -> None:
        self._say("back", unit)

    def poses(self, unit: str, phase: Phase, guide: Guide) -> None:
        following = guide.next
        event = {
            "found": guide.found,
            "wanted": guide.wanted,
            "next": None
            if following is None
            else {
                "label": following.label,
                "vector": [round(v, 6) for v in following.vector],
                "once_more": following.once_more,
            },
        }
        if self._latest.get(unit) != event:  # it comes several times a second
            self._latest[unit] = event
            self._say("poses", unit, **event)

    def instruction(self, instruction: Instruction | None) -> None:
        if instruction is not None:
            self._say(
                "instruction",
                None,
                label=instruction.label,
                face=instruction.face,
                vector=[round(v, 6) for v in instruction.vector],
                slots=list(instruction.slots),
            )

    def ended(self, outcome: Outcome) -> None:
        self._say("ended", outcome.unit, outcome=outcome.document)

    def _say(self, event: str, unit: str | None, **more: Any) -> None:
        self._seq += 1
        line = {
            "format": "triaxcal.event/1",
            "seq": self._seq,
            "time": iso_time(self._clock_ns()),
            "run": None if unit is None else self._runs.get(unit),
            "tray": self._tray,
            "unit": unit,
            "event": event,
            **more,
        }
        self._lines.put(printable_json(json.dumps(line, ensure_ascii=False, allow_nan=False)))

    def _work(self) -> None:
        while (line := self._lines.get()) is not None:
            try:
                self._write(f"{line}\n".encode())
            except (OSError, ValueError):  # nobody reads any more; the work goes on
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
            data = data[os.write(own, data) :]

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
