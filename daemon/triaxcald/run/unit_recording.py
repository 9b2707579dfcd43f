"""A unit that is recorded."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from triaxcal_drivers.interface import Device
from triaxcal_drivers.profile import READINGS
from triaxcald.inputs import CALIBRATION
from triaxcald.provision.identity import IdentityRead
from triaxcald.recording.schema import RAW
from triaxcald.recording.writer import RecordingWriter
from triaxcald.run.recording import AtRecording, Kept, State, UnitStatus
from triaxcald.run.session import Segments, UnitSession
from triaxcald.station.collection import Recorded
from triaxcald.station.coming_back import Patience


class UnitRecording(AtRecording):
    """One unit's recording, at ``path_of`` its identity, in ``segments`` where
    they are given; ``identified`` is told who it is, once it is there."""

    kind = "unit"

    def __init__(
        self,
        session: UnitSession,
        path_of: Callable[[IdentityRead], Path],
        identified: Callable[[UnitSession, IdentityRead], None] = lambda *_: None,
        segments: Segments | None = None,
    ) -> None:
        super().__init__(session.name)
        self._session, self._path_of, self._identified, self._segments = session, path_of, identified, segments
        self._recorded = Recorded(CALIBRATION, session.place.bundle, session.place.address)

    @property
    def status(self) -> UnitStatus:
        recorded, writer = self._recorded, self._writer
        return UnitStatus(
            self.name,
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

    def leave(self) -> None:
        super().leave()
        self._session.leave()

    async def _work(self, seconds: float | None, patience: Patience) -> None:
        session, found = self._session, list[IdentityRead]()

        async def identify(device: Device) -> None:
            found[:] = [await session.identify(device)]

        async with session.place.opened(patience, self._waits, identify) as device:
            (identity,) = found
            self._identified(session, identity)
            self._path = self._path_of(identity)

            async def record(writer: RecordingWriter) -> None:
                session.progress.stage(session.name, "recording")
                returning = session.returning(device, identity, patience, self._is_lost)
                await self._recorded.for_seconds(returning, writer, seconds)

            make = partial(session.writer, self._path, identity, segments=self._segments)
            await self._recorded_by(make, record, self._path if self._segments else None)

    def _result(self) -> Kept:
        readings, recorded = self._recorded.streams[READINGS], self._recorded
        return Kept(
            self.name, self._path, dict(readings.counts), readings.seconds, recorded.gaps, recorded.gaps_s, self._lost
        )
