"""A unit that is recorded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

from triaxcal_drivers.interface import Device
from triaxcal_drivers.profile import READINGS
from triaxcald.provision.identity import IdentityRead
from triaxcald.recording.schema import CALIBRATION
from triaxcald.recording.writer import RecordingWriter
from triaxcald.run.recording import AtRecording, State, UnitStatus
from triaxcald.run.session import Segments, UnitSession
from triaxcald.station.collection import Recorded
from triaxcald.station.coming_back import Patience
from triaxcald.text import NOTHING_YET


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
        self._recorded = Recorded(CALIBRATION, session.place.bundle, session.place.address)
        super().__init__(session.name, self._recorded, session.progress)
        self._session, self._path_of, self._identified, self._segments = session, path_of, identified, segments

    @property
    def status(self) -> UnitStatus:
        """Recorded is a unit of which samples come: what its FIFO held before is
        discarded meanwhile, which may take a minute."""
        status = super().status
        if status.state is State.RECORDING and not status.counts["samples"]:
            return replace(status, state=State.WAITING, trouble=NOTHING_YET)
        return status

    @property
    def _counts(self) -> dict[str, int]:
        return dict(self._recorded.streams[READINGS].counts)

    @property
    def _seconds(self) -> float:
        return self._recorded.streams[READINGS].seconds

    @property
    def _host_seconds(self) -> float | None:
        return self._recorded.streams[READINGS].host_seconds

    @property
    def _latest(self) -> dict[str, float]:
        return dict(self._recorded.latest)

    def _waits(self, patience: Patience, trouble: Exception) -> None:
        self._is_lost(str(trouble))
        self._session.waits(patience, trouble)

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

        async with session.place.opened(patience, partial(self._waits, patience), identify) as device:
            (identity,) = found
            self._identified(session, identity)
            self._path = self._path_of(identity)

            async def record(writer: RecordingWriter) -> None:
                session.progress.stage(session.name, "recording")
                confirmation = session.confirmation(device, identity, writer, self._recorded)
                returning = session.returning(device, identity, patience, self._is_lost, confirmation)
                try:
                    async with confirmation.phase():
                        await self._recorded.for_seconds(returning, writer, seconds)
                finally:
                    self._wrong, self._unconfirmed = confirmation.wrong, confirmation.unconfirmed

            make = partial(session.writer, self._path, identity, segments=self._segments)
            await self._recorded_by(make, record, self._path if self._segments else None)
