"""Recordings of units and of buses, and nothing else, for as long as anybody
likes; they may be lost meanwhile, and come back."""

from __future__ import annotations

import asyncio
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Mapping
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Literal

from triaxcal_drivers.claim import Claim
from triaxcald.errors import RecordingError
from triaxcald.exit_codes import DONE, exit_code_of
from triaxcald.recording.ending import ended_because
from triaxcald.recording.schema import RAW
from triaxcald.recording.writer import RecordingWriter
from triaxcald.run.endings import aborted
from triaxcald.run.together import whole_on_a_thread
from triaxcald.station.coming_back import Patience
from triaxcald.station.lock import locked

Kind = Literal["unit", "bus"]


@dataclass(frozen=True)
class Kept:
    """What the recording of a unit, or of a bus, has come to. ``counts`` are of
    the unit's readings, which span ``seconds``, or of the bus's frames; in
    ``gaps`` gaps it was lost for ``gaps_s``, and ``lost`` raw records did not
    get to the disk. ``error`` is one line where it failed."""

    unit: str
    path: Path | None
    counts: dict[str, int]
    seconds: float = 0.0
    gaps: int = 0
    gaps_s: float = 0.0
    lost: int = 0
    exit_code: int = DONE
    error: str | None = None
    kind: Kind = "unit"


class State(Enum):
    WAITING, RECORDING, ENDED = "waiting", "recording", "ended"


@dataclass(frozen=True)
class UnitStatus:
    """How the recording of a unit, or of a bus, stands. ``trouble`` is what is
    the matter with one that is waited for; ``last_ns`` host time of the last
    record, ``latest`` the last values of its other channels; the rest as in
    `Kept`."""

    unit: str
    state: State
    trouble: str | None
    path: Path | None
    records: int
    counts: Mapping[str, int]
    gaps: int
    gaps_s: float
    lost: int
    last_ns: int | None
    latest: Mapping[str, float]
    kind: Kind = "unit"


class AtRecording(ABC):
    """One of the recordings that a process makes side by side, of a unit or a
    bus of that ``name``."""

    kind: Kind

    def __init__(self, name: str) -> None:
        self.name = name
        self._path: Path | None = None
        self._writer: RecordingWriter | None = None
        self._lost = 0
        self._state = State.WAITING
        self._trouble: str | None = None
        self._leaves = False

    @property
    @abstractmethod
    def status(self) -> UnitStatus:
        """From any thread."""

    @abstractmethod
    async def _work(self, seconds: float | None, patience: Patience) -> None:
        """As `run`, but for what it raises."""

    @abstractmethod
    def _result(self) -> Kept:
        """What it has come to so far."""

    def leave(self) -> None:
        """Nobody wants it any more: a cancellation from now on ends it as one
        that has been asked to end."""
        self._leaves = True

    async def run(self, seconds: float | None, patience: Patience) -> Kept:
        """Until there are so many ``seconds``, for ever where None, or until it
        is given up. Raises nothing, not even when it is cancelled."""
        try:
            await self._work(seconds, patience)
        except (Exception, asyncio.CancelledError) as e:  # noqa: BLE001 - the one place that supervises a recording
            if self._asked(e):
                return self._result()
            error = f"{self.kind} {self.name}: {aborted(e, None).reason}"
            return replace(self._result(), exit_code=exit_code_of(e), error=error)
        else:
            return self._result()
        finally:
            self._state = State.ENDED

    async def _recorded_by(
        self,
        make: Callable[[], RecordingWriter],
        record: Callable[[RecordingWriter], Awaitable[None]],
        manifest: Path | None,
    ) -> None:
        """Has a writer made and ``record`` work with it; the file is whole in
        the end, and says why it ended. A ``manifest`` is this process's alone
        meanwhile. Raises DeviceInUse where it is another's."""
        async with AsyncExitStack() as claimed:
            if manifest is not None:
                await claimed.enter_async_context(locked(Claim(f"recording {manifest.resolve()}")))
            await self._written_by(make, record)

    async def _written_by(
        self, make: Callable[[], RecordingWriter], record: Callable[[RecordingWriter], Awaitable[None]]
    ) -> None:
        """To find the end of a segment that was cut off, and to write an end,
        may take a while."""
        with await whole_on_a_thread(make) as writer:
            self._writer, self._state, self._trouble = writer, State.RECORDING, None
            try:
                await record(writer)
            except (Exception, asyncio.CancelledError) as e:
                await self._end(writer, e)
                raise
            else:
                await whole_on_a_thread(partial(writer.close, ended_because(None)))
            finally:
                self._lost, self._writer = writer.losses.get(RAW, 0), None

    async def _end(self, writer: RecordingWriter, e: BaseException) -> None:
        """Where the disk has failed, that is on its way already."""
        with suppress(RecordingError):
            if not isinstance(e, asyncio.CancelledError):
                writer.event("failed", {"error": aborted(e, None).reason})
            await whole_on_a_thread(partial(writer.close, ended_because(None if self._asked(e) else e)))

    def _asked(self, e: BaseException) -> bool:
        return self._leaves and isinstance(e, asyncio.CancelledError)
