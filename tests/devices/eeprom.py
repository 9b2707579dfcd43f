"""An EEPROM that is written byte by byte, wears, and whose power can fail between any two bytes. No I/O."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field


class PowerFailed(Exception):
    """The byte at which the power was to fail has been reached."""


@dataclass
class _Job:
    """Bytes on their way: byte i is in at ``began_s`` + ``seconds`` · (i + 1) / n."""

    offsets: list[int]
    began_s: float
    seconds: float
    bank: dict[int, int] | None
    """Where they wait for the last one, if they are to arrive as a whole."""
    count: int = 1
    done: int = 0

    def ended(self, now: float) -> bool:
        return now >= self.began_s + self.seconds

    def due(self, now: float) -> int:
        n = len(self.offsets)
        if self.ended(now):
            return n
        return math.floor(n * (now - self.began_s) / self.seconds + 1e-9)  # not one short for a rounding error


@dataclass(eq=False)
class Eeprom:
    """``wear``: how often each byte was written; ``bytes_written`` since it was armed, or ever; ``jobs_done``."""

    contents: bytearray
    cut_at_byte: int | None = None
    wear: list[int] = field(default_factory=list)
    bytes_written: int = 0
    jobs_done: int = 0
    _job: _Job | None = None

    def __post_init__(self) -> None:
        self.wear = self.wear or [0] * len(self.contents)

    @property
    def busy(self) -> bool:
        return self._job is not None

    def begin(self, offsets: Sequence[int], now: float, seconds: float, *, whole: bool = False) -> None:
        """What was under way before is given up; ``whole``: the bytes arrive together, with the last one."""
        self._job = _Job([*offsets], now, seconds, {} if whole else None)

    def append(self, offsets: Sequence[int], now: float, seconds: float) -> None:
        """After what is under way."""
        if self._job is None:
            self.begin(offsets, now, seconds)
        else:
            self._job.offsets += offsets
            self._job.seconds += seconds
            self._job.count += 1

    def abandon(self) -> None:
        self._job = None

    def program(self, wanted: bytes, now: float) -> None:
        """Write the bytes that are due, as they are in ``wanted``. Raises PowerFailed."""
        job = self._job
        if job is None:
            return
        while job.done < job.due(now):
            self._fail_if_reached()
            self._put(job, job.offsets[job.done], wanted)
            self._fail_if_reached()
        if job.ended(now):
            self._job = None
            self.jobs_done += job.count

    def twin(self) -> Eeprom:
        """One that goes its own way from here."""
        return copy.deepcopy(self)

    def _fail_if_reached(self) -> None:
        if self.bytes_written == self.cut_at_byte:
            self.cut_at_byte = None  # it fails once
            self._job = None
            raise PowerFailed

    def _put(self, job: _Job, at: int, wanted: bytes) -> None:
        job.done += 1
        self.bytes_written += 1
        self.wear[at] += 1
        if job.bank is None:
            self.contents[at] = wanted[at]
            return
        job.bank[at] = wanted[at]
        if job.done == len(job.offsets):
            for place, value in job.bank.items():
                self.contents[place] = value
