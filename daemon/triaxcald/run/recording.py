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

from triaxcal_drivers.claim import Claim
from triaxcald import text
from triaxcald.errors import RecordingError
from triaxcald.exit_codes import DEVICE, DONE, exit_code_of
from triaxcald.provision.identity import WrongUnit
from triaxcald.recording.ending import Kind, ended_because
from triaxcald.recording.schema import RAW
from triaxcald.recording.writer import LOOK_S, RecordingWriter
from triaxcald.run.reasons import reason_of, trace_of
from triaxcald.run.together import while_sound, whole_on_a_thread
from triaxcald.station.collection import Progress
from triaxcald.station.coming_back import Patience
from triaxcald.station.lock import locked
from triaxcald.station.raw_records import RawRecords


@dataclass(frozen=True)
class Kept:
    """What the recording of a unit, or of a bus, has come to. ``counts`` are of
    the unit's readings, which span ``seconds`` of the unit's own time and
    ``host_seconds`` of the host's, or of the bus's frames; in ``gaps`` gaps it
    was lost for ``gaps_s``, and ``lost`` raw records did not get to the disk.
    ``unconfirmed`` raw records came after the unit was last confirmed to be
    there, and are in no count but that. ``error`` is one line where it failed,
    and ``trace`` says where in this program, where the fault is its own."""

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
    trace: str | None = None
    host_seconds: float | None = None
    unconfirmed: int = 0


class State(Enum):
    WAITING, RECORDING, ENDED = "waiting", "recording", "ended"


@dataclass(frozen=True)
class UnitStatus:
    """How the recording of a unit, or of a bus, stands. ``trouble`` is what is
    the matter with one that is waited for; ``last_ns`` host time of the last
    record, ``latest`` the last values of its other channels; ``queued`` batches
    wait for the disk; the rest as in `Kept`."""

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
    queued: int = 0


class AtRecording(ABC):
    """One of the recordings that a process makes side by side, of a unit or a
    bus of that ``name``, whose records go through ``records``. ``progress``
    shows the operator how it goes."""

    kind: Kind

    def __init__(self, name: str, records: RawRecords, progress: Progress) -> None:
        self.name, self._records, self._progress = name, records, progress
        self._path: Path | None = None
        self._written: Path | None = None
        """The last file of it."""
        self._writer: RecordingWriter | None = None
        self._lost = 0
        self._state = State.WAITING
        self._trouble: str | None = None
        self._leaves = self._was_behind = False
        self._wrong: WrongUnit | None = None
        """By which another unit was noticed, which weighs more than a stop."""
        self._unconfirmed = 0
        self._kept_for: str | None = None

    @property
    def status(self) -> UnitStatus:
        """From any thread. One that loses what comes, as the disk does not keep
        up, is waited for."""
        records, writer = self._records, self._writer
        state, trouble = self._state, self._trouble
        if state is State.RECORDING and writer is not None and writer.is_behind:
            state, trouble = State.WAITING, text.DISK_IS_BEHIND
        return UnitStatus(
            self.name,
            state,
            trouble,
            self._written if writer is None else writer.current,
            records.digest.records,
            self._counts,
            records.gaps,
            records.gaps_s,
            self._lost if writer is None else writer.losses.get(RAW, 0),
            records.last_ns,
            self._latest,
            self.kind,
            0 if writer is None else writer.queued,
        )

    @property
    @abstractmethod
    def _counts(self) -> dict[str, int]:
        """As of `Kept`."""

    @property
    @abstractmethod
    def _seconds(self) -> float:
        """As of `Kept`."""

    @property
    def _host_seconds(self) -> float | None:
        """As of `Kept`."""
        return None

    @property
    def _latest(self) -> dict[str, float]:
        return {}

    @abstractmethod
    async def _work(self, seconds: float | None, patience: Patience) -> None:
        """As `run`, but for what it raises."""

    def _result(self) -> Kept:
        """What it has come to so far."""
        records = self._records
        return Kept(
            self.name, self._path, self._counts, self._seconds, records.gaps, records.gaps_s, self._lost,
            kind=self.kind, host_seconds=self._host_seconds, unconfirmed=self._unconfirmed,
        )  # fmt: skip

    def leave(self) -> None:
        """Nobody wants it any more: a cancellation from now on ends it as one
        that has been asked to end."""
        self._leaves = True

    async def run(self, seconds: float | None, patience: Patience) -> Kept:
        """Until there are so many ``seconds``, for ever where None, or until it
        is given up. Raises nothing, not even when it is cancelled."""
        try:
            await self._work(seconds, patience)
        except (Exception, asyncio.CancelledError) as raised:  # noqa: BLE001 - the one place that supervises a recording
            e = self._cause(raised)
            if self._asked(e):
                return self._result()
            self._trouble = reason_of(e)
            error = f"{self.kind} {self.name}: {self._trouble}"
            return replace(self._result(), exit_code=exit_code_of(e), error=error, trace=trace_of(e))
        else:
            if self._trouble is None:
                return self._result()
            # One stream brought all that was asked for, another is not back.
            return replace(self._result(), exit_code=DEVICE, error=f"{self.kind} {self.name}: {self._trouble}")
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
            if writer.warning is not None:
                self._progress.stage(self.name, f"warning: {writer.warning}")
            try:
                # A disk fails while a unit is lost, and nothing comes, too.
                await while_sound(record(writer), partial(self._look_after, writer), LOOK_S)
            except (Exception, asyncio.CancelledError) as e:
                await self._end(writer, self._cause(e))
                raise
            else:
                await whole_on_a_thread(partial(writer.close, ended_because(None, self.kind)))
            finally:
                self._lost, self._written, self._writer = writer.losses.get(RAW, 0), writer.current, None

    def _look_after(self, writer: RecordingWriter) -> None:
        """Raises RecordingError."""
        writer.check()
        is_behind, document = writer.is_behind, writer.keeps_for
        if is_behind and not self._was_behind:
            self._progress.lost(self.name, text.DISK_IS_BEHIND)
        elif self._was_behind and not is_behind:
            self._progress.stage(self.name, text.DISK_KEEPS_UP)
        if document is not None and document != self._kept_for:
            self._progress.stage(self.name, text.nothing_deleted(document))
        self._was_behind, self._kept_for = is_behind, document

    async def _end(self, writer: RecordingWriter, e: BaseException) -> None:
        """Where the disk has failed, that is on its way already."""
        with suppress(RecordingError):
            if not isinstance(e, asyncio.CancelledError):
                writer.event("failed", {"error": reason_of(e)})
            because = ended_because(None if self._asked(e) else e, self.kind)
            await whole_on_a_thread(partial(writer.close, because))

    def _cause(self, e: BaseException) -> BaseException:
        """A stop is not why it ended where another unit was noticed then."""
        return self._wrong if self._wrong is not None and isinstance(e, asyncio.CancelledError) else e

    def _asked(self, e: BaseException) -> bool:
        return self._leaves and isinstance(e, asyncio.CancelledError)
