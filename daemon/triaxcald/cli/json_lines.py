"""Progress as one JSON object a line, for whoever collects logs."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any, TextIO

from triaxcald.printable import printable_json
from triaxcald.recording.schema import Phase
from triaxcald.station.guidance import Guide


def _now() -> datetime:
    return datetime.now(UTC)


class JsonLines:
    """``time`` (UTC), ``level`` (``info``, ``warning``, ``error``), ``event``,
    ``unit`` where it is of one, and what else there is to say, to standard
    error by default."""

    def __init__(self, out: TextIO | None = None, now: Callable[[], datetime] = _now) -> None:
        self._out, self._now = out or sys.stderr, now

    def stage(self, unit: str, text: str) -> None:
        self.say("info", "stage", unit=unit, message=text)

    def lost(self, unit: str, trouble: str) -> None:
        self.say("warning", "lost", unit=unit, message=trouble)

    def poses(self, unit: str, phase: Phase, guide: Guide) -> None:
        self.say("info", "poses", unit=unit, phase=phase, found=guide.found, wanted=guide.wanted, message=guide.hint)

    def say(self, level: str, event: str, **more: Any) -> None:
        """Nowhere, where nobody reads any more: no work may fail for it."""
        line = {"time": self._now().isoformat(timespec="milliseconds"), "level": level, "event": event, **more}
        with suppress(OSError, ValueError):
            self._out.write(printable_json(json.dumps(line, ensure_ascii=False, allow_nan=False)) + "\n")
            self._out.flush()
