"""A bus that is recorded: all its frames, for later, of no unit."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from triaxcald import text
from triaxcald.recording.bus import bus_record, phase_of
from triaxcald.recording.schema import BUS_RECORD, STATION_FILE
from triaxcald.recording.writer import RecordingWriter
from triaxcald.run.recording import AtRecording, State
from triaxcald.run.session import Segments, new_writer, stamp
from triaxcald.software import versions
from triaxcald.station.buses import BusPlace
from triaxcald.station.collection import Progress
from triaxcald.station.coming_back import Patience
from triaxcald.station.config import Station
from triaxcald.station.listening import Listened, ReturningBus


class BusRecording(AtRecording):
    """The recording of one bus, at what ``path_of`` gives once it is open, in
    ``segments`` where they are given. ``progress`` shows the operator how it
    goes, ``clock_ns`` is the host's time since the epoch."""

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

    async def _work(self, seconds: float | None, patience: Patience) -> None:
        is_lost = partial(self._is_lost, patience)
        async with self._place.opened(patience, lambda trouble: is_lost(str(trouble))) as listener:
            self._path = self._path_of()

            async def record(writer: RecordingWriter) -> None:
                self._progress.stage(self.name, "recording")
                await self._listened.for_seconds(ReturningBus(listener, patience, is_lost), writer, seconds)

            make = partial(self._new_writer, self._path)
            await self._recorded_by(make, record, self._path if self._segments else None)

    def _is_lost(self, patience: Patience, trouble: str | None) -> None:
        self._state = State.RECORDING if trouble is None else State.WAITING
        self._trouble = trouble
        if trouble is None:
            self._progress.stage(self.name, text.BUS_IS_BACK)
        else:
            self._progress.lost(self.name, text.waited_for(trouble, endless=patience.endless))

    def _new_writer(self, path: Path) -> RecordingWriter:
        """With the station file in it. Raises RecordingError."""
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
    return f"{bus}-{stamp(time_ns)}.mcap"
