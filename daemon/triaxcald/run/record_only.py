"""Recordings of units and of buses, and nothing else, for as long as anybody
likes; they may be lost meanwhile, and come back."""

from __future__ import annotations

import asyncio
import time
from abc import ABC, abstractmethod
from collections.abc import Awaitable, Callable, Collection, Iterable, Mapping
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

import triaxcal_drivers as td
from triaxcald import text
from triaxcald.errors import DEVICE, DONE, RecordingError, exit_code_of
from triaxcald.provision.identity import IdentityRead, WrongUnit
from triaxcald.recording.bus import bus_record, phase_of
from triaxcald.recording.schema import BUS_RECORD, CALIBRATION, RAW, STATION_FILE
from triaxcald.recording.writer import LOOK_S, Kind, RecordingWriter, ended_because
from triaxcald.run.error_reasons import reason_of, trace_of
from triaxcald.run.session import Segments, UnitSession, new_writer
from triaxcald.run.together import while_sound, whole_on_a_thread
from triaxcald.schema.codes import Code
from triaxcald.software import versions
from triaxcald.station.buses import BusPlace
from triaxcald.station.collection import Progress, Recorded
from triaxcald.station.config import Station
from triaxcald.station.listening import Listened, RawRecords, ReconnectingBus
from triaxcald.station.lock import locked
from triaxcald.station.reconnect import RetryPolicy
from triaxcald.text import NOTHING_YET
from triaxcald.utc import file_stamp


@dataclass(frozen=True)
class Kept:
    """Result of the recording of a unit or a bus.

    ``counts`` are those of the unit's readings or of the bus's frames. They span
    ``seconds`` of the unit's own time and ``host_seconds`` of the host's. ``gaps``
    interruptions took ``gaps_s``; ``lost`` raw records did not reach the disk.
    ``unconfirmed`` raw records came after the last confirmation of the unit, and are
    in no other count. ``error`` is one line if the recording failed, ``trace`` the
    traceback of an internal error.
    """

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
    data_quality: tuple[str, ...] = ()


class State(Enum):
    WAITING, RECORDING, ENDED = "waiting", "recording", "ended"


@dataclass(frozen=True)
class UnitStatus:
    """Status of the recording of a unit or a bus. ``trouble`` is the reason of a
    wait, ``last_ns`` the host time of the last record, ``latest`` the last values of
    the other channels; ``queued`` batches wait for the disk; the rest as in `Kept`."""

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
    """One of the parallel recordings of a process, of the unit or bus ``name``. Its
    records pass through ``records``; ``progress`` informs the operator."""

    kind: Kind

    def __init__(self, name: str, records: RawRecords, progress: Progress) -> None:
        self.name, self._records, self._progress = name, records, progress
        self._path: Path | None = None
        self._written: Path | None = None
        """The last file of the recording."""
        self._writer: RecordingWriter | None = None
        self._lost = 0
        self._state = State.WAITING
        self._trouble: str | None = None
        self._leaves = self._was_behind = False
        self._wrong: WrongUnit | None = None
        """The error of a noticed exchange of the unit, more important than a stop."""
        self._unconfirmed = 0
        self._kept_for: str | None = None

    @property
    def status(self) -> UnitStatus:
        """Status, from any thread. A recording that loses records because the disk is
        too slow counts as waiting."""
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

    @property
    def _data_quality(self) -> tuple[str, ...]:
        """As of `Kept`."""
        return ()

    @abstractmethod
    async def _work(self, seconds: float | None, policy: RetryPolicy) -> None:
        """The work of `run`, which may raise."""

    def _result(self) -> Kept:
        """The result so far."""
        records = self._records
        return Kept(
            self.name, self._path, self._counts, self._seconds, records.gaps, records.gaps_s, self._lost,
            kind=self.kind, host_seconds=self._host_seconds, unconfirmed=self._unconfirmed,
            data_quality=self._data_quality,
        )  # fmt: skip

    def leave(self) -> None:
        """Treat a later cancellation as a requested end."""
        self._leaves = True

    async def run(self, seconds: float | None, policy: RetryPolicy) -> Kept:
        """Record for ``seconds`` (None: without end), or until the policy gives up.
        Raises nothing, not even when cancelled."""
        try:
            await self._work(seconds, policy)
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
            # One stream is complete, but another one is still lost.
            return replace(self._result(), exit_code=DEVICE, error=f"{self.kind} {self.name}: {self._trouble}")
        finally:
            self._state = State.ENDED

    async def _recorded_by(
        self,
        make: Callable[[], RecordingWriter],
        record: Callable[[RecordingWriter], Awaitable[None]],
        manifest: Path | None,
    ) -> None:
        """Make a writer and let ``record`` work with it. The finished file is complete
        and states why it ended. This process claims the ``manifest`` meanwhile.
        Raises DeviceInUse if another process has it."""
        async with AsyncExitStack() as claimed:
            if manifest is not None:
                await claimed.enter_async_context(locked(td.Claim(f"recording {manifest.resolve()}")))
            await self._written_by(make, record)

    async def _written_by(
        self, make: Callable[[], RecordingWriter], record: Callable[[RecordingWriter], Awaitable[None]]
    ) -> None:
        """Open and close the writer on a thread: finding the end of an interrupted
        segment and writing an end may take long."""
        with await whole_on_a_thread(make) as writer:
            self._writer, self._state, self._trouble = writer, State.RECORDING, None
            if writer.warning is not None:
                self._progress.note(self.name, f"warning: {writer.warning}")
            try:
                # A disk may also fail while a unit is lost and sends nothing.
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
            self._progress.lost(self.name, Code.DISK, text.DISK_IS_BEHIND)
        elif self._was_behind and not is_behind:
            self._progress.note(self.name, text.DISK_KEEPS_UP)
        if document is not None and document != self._kept_for:
            self._progress.note(self.name, text.nothing_deleted(document))
        self._was_behind, self._kept_for = is_behind, document

    async def _end(self, writer: RecordingWriter, e: BaseException) -> None:
        """Close the file with its reason. A failure of the disk is being raised
        already."""
        with suppress(RecordingError):
            if not isinstance(e, asyncio.CancelledError):
                writer.event("failed", {"error": reason_of(e)})
            because = ended_because(None if self._asked(e) else e, self.kind)
            await whole_on_a_thread(partial(writer.close, because))

    def _cause(self, e: BaseException) -> BaseException:
        """The cause of an end: a noticed exchange of the unit has priority over a
        stop."""
        return self._wrong if self._wrong is not None and isinstance(e, asyncio.CancelledError) else e

    def _asked(self, e: BaseException) -> bool:
        return self._leaves and isinstance(e, asyncio.CancelledError)


# The parallel recordings of a process, which may change while it runs.


class Roster:
    """The running recordings. Each records for ``seconds`` (None: without end), or
    until the policy gives up. One that ends does not stop the others; ``ended``
    receives its result."""

    def __init__(
        self, seconds: float | None, policy: RetryPolicy, ended: Callable[[Kept], None] = lambda _: None
    ) -> None:
        self._seconds, self._policy, self._ended = seconds, policy, ended
        self._work: dict[str, tuple[AtRecording, asyncio.Task[Kept]]] = {}
        self._changes = 0
        self._changed = asyncio.Event()
        self._stopped = False

    def statuses(self) -> list[UnitStatus]:
        """Status of the last recording of each name. From any thread."""
        return [one.status for one, _ in tuple(self._work.values())]

    def at_work(self) -> set[str]:
        return {name for name, (_, task) in self._work.items() if not task.done()}

    def ended_with(self, code: int) -> set[str]:
        """Names whose last recording ended with that exit code."""
        return {
            name
            for name, (_, task) in self._work.items()
            if task.done() and not task.cancelled() and task.result().exit_code == code
        }

    def begin(self, recordings: Iterable[AtRecording]) -> None:
        """Begin recordings, none with the name of a running one; begins nothing once
        all are stopped."""
        if self._stopped:
            return
        for one in recordings:
            self._work[one.name] = one, asyncio.ensure_future(self._record(one))
        self._changed.set()

    async def change(self, leaving: Collection[str], beginning: Iterable[AtRecording]) -> None:
        """End and remove the recordings ``leaving``, then begin the others, unless all
        are stopped by then."""
        self._changes += 1
        try:
            going = [self._work[name] for name in leaving if name in self._work]
            for one, task in going:
                one.leave()
                task.cancel()
            if going:
                await asyncio.wait([task for _, task in going])
            for one, _ in going:
                del self._work[one.name]
            if not self._stopped:
                self.begin(beginning)
        finally:
            self._changes -= 1
            self._changed.set()

    async def finish(self) -> list[Kept]:
        """Results of all recordings, once none is running. Each cancellation is passed
        on to every recording, and their ends are awaited, so every file is
        complete."""
        while True:
            pending = [task for _, task in self._work.values() if not task.done()]
            if not pending and not self._changes:
                # A recording that was cancelled before its first step has no result.
                return [task.result() for _, task in self._work.values() if not task.cancelled()]
            self._changed.clear()
            changed = asyncio.ensure_future(self._changed.wait())
            try:
                await asyncio.wait([*pending, changed], return_when=asyncio.FIRST_COMPLETED)
            except asyncio.CancelledError:
                self._stopped = True
                for _, task in tuple(self._work.values()):  # a change may have begun some since
                    task.cancel()
            finally:
                changed.cancel()

    async def _record(self, one: AtRecording) -> Kept:
        kept = await one.run(self._seconds, self._policy)
        self._ended(kept)
        return kept


# Recording of a bus: all its frames, assigned to no unit.


class BusRecording(AtRecording):
    """Recording of one bus. ``path_of`` gives the path once the bus is open;
    ``segments`` splits the recording. ``progress`` informs the operator, ``clock_ns``
    is the host's time since the epoch."""

    kind = "bus"

    def __init__(
        self,
        station: Station,
        place: BusPlace,
        progress: Progress,
        path_of: Callable[[], Path],
        segments: Segments | None = None,
        *,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        listened = Listened(phase_of(place.settings.channel))
        super().__init__(place.name, listened, progress)
        self._station, self._place = station, place
        self._path_of, self._segments, self._clock_ns = path_of, segments, clock_ns
        self._listened = listened

    @property
    def _counts(self) -> dict[str, int]:
        return self._listened.counts

    @property
    def _seconds(self) -> float:
        return self._listened.seconds

    async def _work(self, seconds: float | None, policy: RetryPolicy) -> None:
        is_lost = partial(self._is_lost, policy)
        async with self._place.opened(policy, lambda trouble: is_lost(str(trouble))) as listener:
            self._path = self._path_of()

            async def record(writer: RecordingWriter) -> None:
                self._progress.note(self.name, "recording")
                await self._listened.for_seconds(ReconnectingBus(listener, policy, is_lost), writer, seconds)

            make = partial(self._new_writer, self._path)
            await self._recorded_by(make, record, self._path if self._segments else None)

    def _is_lost(self, policy: RetryPolicy, trouble: str | None) -> None:
        self._state = State.RECORDING if trouble is None else State.WAITING
        self._trouble = trouble
        if trouble is None:
            self._progress.note(self.name, text.BUS_IS_BACK)
        else:
            self._progress.lost(self.name, Code.LOST, text.waited_for(trouble, endless=policy.endless))

    def _new_writer(self, path: Path) -> RecordingWriter:
        """A writer with the station file as attachment. Raises RecordingError."""
        bus = self._place.settings
        told = {"name": self._place.name, "bitrate": "" if bus.bitrate is None else str(bus.bitrate)}
        settings: dict[str, Any] = {
            "metadata": {
                "station": {"name": self._station.file.name},
                BUS_RECORD: bus_record(bus.interface, bus.channel, **told),
                "software": versions(),
            },
            "preview_channels": None,
            "clock_ns": self._clock_ns,
        }
        writer = new_writer(path, self._segments, **settings)
        writer.attach(STATION_FILE, "application/toml", self._station.text)
        return writer


def bus_recording_name(bus: str, time_ns: int) -> str:
    return f"{bus}-{file_stamp(time_ns)}.mcap"


# Recording of a unit.


class UnitRecording(AtRecording):
    """Recording of one unit. ``path_of`` gives the path from its identity,
    ``segments`` splits the recording; ``identified`` receives the identity."""

    kind = "unit"

    def __init__(
        self,
        session: UnitSession,
        path_of: Callable[[IdentityRead], Path],
        identified: Callable[[UnitSession, IdentityRead], None] = lambda *_: None,
        segments: Segments | None = None,
    ) -> None:
        self._recorded = Recorded(CALIBRATION, session.place.bundle, session.place.address)
        super().__init__(session.name, self._recorded, session.progress)
        self._session, self._path_of, self._identified, self._segments = session, path_of, identified, segments

    @property
    def status(self) -> UnitStatus:
        """Status; a unit counts as waiting until samples come. Discarding the old
        contents of its FIFO may take a minute."""
        status = super().status
        if status.state is State.RECORDING and not status.counts["samples"]:
            return replace(status, state=State.WAITING, trouble=NOTHING_YET)
        return status

    @property
    def _counts(self) -> dict[str, int]:
        return dict(self._recorded.streams[td.READINGS].counts)

    @property
    def _seconds(self) -> float:
        return self._recorded.streams[td.READINGS].seconds

    @property
    def _host_seconds(self) -> float | None:
        return self._recorded.streams[td.READINGS].host_seconds

    @property
    def _data_quality(self) -> tuple[str, ...]:
        return tuple(self._recorded.streams[td.READINGS].faults())

    @property
    def _latest(self) -> dict[str, float]:
        return dict(self._recorded.latest)

    def _waits(self, policy: RetryPolicy, trouble: Exception) -> None:
        self._is_lost(str(trouble))
        self._session.waits(policy, trouble)

    def _is_lost(self, trouble: str | None) -> None:
        self._state = State.RECORDING if trouble is None else State.WAITING
        self._trouble = trouble

    def leave(self) -> None:
        super().leave()
        self._session.leave()

    async def _correcting_registers(self, device: td.Device) -> dict[str, bytes] | None:
        """Those of the session; a device that refuses them is recorded all the same."""
        try:
            return await self._session.correcting_registers(device)
        except td.RegisterRefused as e:
            self._progress.note(self.name, f"warning: the registers that correct the readings are not recorded: {e}")
            return None

    async def _work(self, seconds: float | None, policy: RetryPolicy) -> None:
        session, found = self._session, list[IdentityRead]()

        async def identify(device: td.Device) -> None:
            found[:] = [await session.identify(device)]

        async with session.place.opened(policy, partial(self._waits, policy), identify) as device:
            (identity,) = found
            self._identified(session, identity)
            self._path = self._path_of(identity)

            async def record(writer: RecordingWriter) -> None:
                session.progress.note(session.name, "recording")
                confirmation = session.confirmation(device, identity, writer, self._recorded)
                reconnecting = session.reconnecting(device, identity, policy, self._is_lost, confirmation)
                try:
                    async with confirmation.phase():
                        await self._recorded.for_seconds(reconnecting, writer, seconds)
                finally:
                    self._wrong, self._unconfirmed = confirmation.wrong, confirmation.unconfirmed

            at_start = await self._correcting_registers(device)
            make = partial(session.writer, self._path, identity, segments=self._segments, at_start=at_start)
            await self._recorded_by(make, record, self._path if self._segments else None)
