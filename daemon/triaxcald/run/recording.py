"""Units that are recorded and nothing else, for as long as anybody likes; they
may be lost meanwhile, and come back."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Literal, Protocol

from triaxcal_drivers.interface import Device
from triaxcal_drivers.profile import READINGS
from triaxcald.errors import RecordingError
from triaxcald.exit_codes import DONE, exit_code_of
from triaxcald.inputs import CALIBRATION
from triaxcald.provision.identity import IdentityRead
from triaxcald.recording.ending import ended_because
from triaxcald.recording.schema import RAW
from triaxcald.recording.writer import RecordingWriter
from triaxcald.run.endings import aborted
from triaxcald.run.session import Segments, UnitSession
from triaxcald.run.together import side_by_side, whole_on_a_thread
from triaxcald.station.collection import Recorded
from triaxcald.station.coming_back import Patience

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


class AtRecording(Protocol):
    """One of the recordings that a process makes side by side."""

    @property
    def status(self) -> UnitStatus: ...

    async def run(self, seconds: float | None, patience: Patience) -> Kept: ...


class UnitRecording:
    """One unit's recording, at ``path_of`` its identity, in ``segments`` where
    they are given; ``identified`` is told who it is, once it is there."""

    def __init__(
        self,
        session: UnitSession,
        path_of: Callable[[IdentityRead], Path],
        identified: Callable[[UnitSession, IdentityRead], None] = lambda *_: None,
        segments: Segments | None = None,
    ) -> None:
        self._session, self._path_of, self._identified, self._segments = session, path_of, identified, segments
        self._recorded = Recorded(CALIBRATION, session.place.bundle, session.place.address)
        self._path: Path | None = None
        self._writer: RecordingWriter | None = None
        self._lost = 0
        self._state = State.WAITING
        self._trouble: str | None = None

    @property
    def status(self) -> UnitStatus:
        """From any thread."""
        recorded, writer = self._recorded, self._writer
        return UnitStatus(
            self._session.name,
            self._state,
            self._trouble,
            self._path if writer is None else writer.current,
            recorded.digest.records,
            dict(recorded.streams[READINGS].counts),
            recorded.gaps,
            recorded.gaps_s,
            writer.losses.get(RAW, 0) if writer is not None else self._lost,
            recorded.last_ns,
            dict(recorded.latest),
        )

    def _waits(self, trouble: Exception) -> None:
        self._is_lost(str(trouble))
        self._session.waits(trouble)

    def _is_lost(self, trouble: str | None) -> None:
        self._state = State.RECORDING if trouble is None else State.WAITING
        self._trouble = trouble

    async def run(self, seconds: float | None, patience: Patience) -> Kept:
        """Until there are so many ``seconds`` of samples, for ever where None,
        or until the unit is given up. Raises nothing, not even when it is
        cancelled."""
        session, found = self._session, list[IdentityRead]()

        async def identify(device: Device) -> None:
            found[:] = [await session.identify(device)]

        try:
            async with session.place.opened(patience, self._waits, identify) as device:
                (identity,) = found
                self._identified(session, identity)
                self._path = self._path_of(identity)
                # Finding the end of a segment that was cut off may take a while.
                with await whole_on_a_thread(
                    partial(session.writer, self._path, identity, segments=self._segments)
                ) as writer:
                    await self._record(device, identity, writer, seconds, patience)
        except (Exception, asyncio.CancelledError) as e:  # noqa: BLE001 - the one place that supervises a unit
            return self._kept(e)
        else:
            return self._kept(None)
        finally:
            self._state = State.ENDED

    async def _record(
        self,
        device: Device,
        identity: IdentityRead,
        writer: RecordingWriter,
        seconds: float | None,
        patience: Patience,
    ) -> None:
        session, self._writer = self._session, writer
        try:
            session.progress.stage(session.name, "recording")
            self._is_lost(None)
            returning = session.returning(device, identity, patience, self._is_lost)
            await self._recorded.for_seconds(returning, writer, seconds)
        except (Exception, asyncio.CancelledError) as e:
            await self._end(writer, e)
            raise
        else:
            await whole_on_a_thread(partial(writer.close, "asked"))
        finally:
            self._lost, self._writer = writer.losses.get(RAW, 0), None

    async def _end(self, writer: RecordingWriter, e: BaseException) -> None:
        """Says why, and finishes the file; where the disk has failed, that is
        on its way already."""
        with suppress(RecordingError):
            if not isinstance(e, asyncio.CancelledError):
                writer.event("failed", {"error": aborted(e, None).reason})
            await whole_on_a_thread(partial(writer.close, ended_because(e)))

    def _kept(self, e: BaseException | None) -> Kept:
        readings, unit = self._recorded.streams[READINGS], self._session.name
        kept = Kept(
            unit,
            self._path,
            dict(readings.counts),
            readings.seconds,
            self._recorded.gaps,
            self._recorded.gaps_s,
            self._lost,
        )
        if e is None:
            return kept
        ending = aborted(e, None)
        return replace(kept, exit_code=exit_code_of(e), error=f"unit {unit}: {ending.reason}")


async def record_units(
    recordings: Sequence[AtRecording],
    seconds: float | None,
    patience: Patience,
    ended: Callable[[Kept], None] = lambda _: None,
) -> list[Kept]:
    """All units and buses at once; one that ends does not stop the others, and
    ``ended`` is told of each. When it is cancelled every one is; what was
    recorded is whole."""

    async def work(recording: AtRecording) -> Kept:
        kept = await recording.run(seconds, patience)
        ended(kept)
        return kept

    return await side_by_side(map(work, recordings))
