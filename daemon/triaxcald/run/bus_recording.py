"""A bus that is recorded: all its frames, for later, of no unit."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from triaxcald import text
from triaxcald.certificate import software
from triaxcald.errors import RecordingError
from triaxcald.exit_codes import exit_code_of
from triaxcald.inputs import STATION_FILE
from triaxcald.recording.bus import bus_record, phase_of
from triaxcald.recording.ending import ended_because
from triaxcald.recording.schema import BUS_RECORD, RAW
from triaxcald.recording.segments import SegmentedWriter
from triaxcald.recording.writer import RecordingWriter
from triaxcald.run.endings import aborted
from triaxcald.run.recording import Kept, State, UnitStatus
from triaxcald.run.session import Segments, stamp
from triaxcald.station.buses import BusPlace
from triaxcald.station.collection import Progress
from triaxcald.station.coming_back import Patience
from triaxcald.station.config import Station
from triaxcald.station.listening import Listened, ReturningBus

if TYPE_CHECKING:
    from triaxcal_drivers.can.listener import BusListener


class BusRecording:
    """The recording of one bus, at what ``path_of`` gives once it is open, in
    ``segments`` where they are given. ``progress`` shows the operator how it
    goes, ``clock_ns`` is the host's time since the epoch."""

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
        self._station, self._place, self._progress = station, place, progress
        self._path_of, self._segments, self._clock_ns = path_of, segments, clock_ns
        self._listened = Listened(phase_of(place.settings.channel))
        self._path: Path | None = None
        self._writer: RecordingWriter | None = None
        self._lost = 0
        self._state = State.WAITING
        self._trouble: str | None = None

    @property
    def status(self) -> UnitStatus:
        """From any thread."""
        listened, writer = self._listened, self._writer
        return UnitStatus(
            self._place.name,
            self._state,
            self._trouble,
            self._path if writer is None else writer.current,
            listened.digest.records,
            listened.counts,
            listened.gaps,
            listened.gaps_s,
            writer.losses.get(RAW, 0) if writer is not None else self._lost,
            listened.last_ns,
            {},
            kind="bus",
        )

    async def run(self, seconds: float | None, patience: Patience) -> Kept:
        """For so many ``seconds`` of the host's time, for ever where None, or
        until the bus is given up. Raises nothing, not even when it is
        cancelled."""
        try:
            async with self._place.opened(patience, lambda trouble: self._is_lost(str(trouble))) as listener:
                self._path = self._path_of()
                with self._new_writer(self._path) as writer:
                    await self._record(listener, writer, seconds, patience)
        except (Exception, asyncio.CancelledError) as e:  # noqa: BLE001 - the one place that supervises a bus
            return self._kept(e)
        else:
            return self._kept(None)
        finally:
            self._state = State.ENDED

    def _is_lost(self, trouble: str | None) -> None:
        name = self._place.name
        self._state = State.RECORDING if trouble is None else State.WAITING
        self._trouble = trouble
        if trouble is None:
            self._progress.stage(name, text.BUS_IS_BACK)
        else:
            self._progress.lost(name, trouble)

    def _new_writer(self, path: Path) -> RecordingWriter:
        """With the station file in it. Raises RecordingError."""
        bus = self._place.settings
        told = {"name": self._place.name, "bitrate": "" if bus.bitrate is None else str(bus.bitrate)}
        settings: dict[str, Any] = {
            "metadata": {
                "station": {"name": self._station.file.name},
                BUS_RECORD: bus_record(bus.interface, bus.channel, **told),
                "software": software(),
            },
            "preview_channels": None,
            "clock_ns": self._clock_ns,
        }
        if self._segments is None:
            writer = RecordingWriter(path, **settings)
        else:
            writer = SegmentedWriter(path, **settings, **vars(self._segments))
        writer.attach(STATION_FILE, "application/toml", self._station.text)
        return writer

    async def _record(
        self, listener: BusListener, writer: RecordingWriter, seconds: float | None, patience: Patience
    ) -> None:
        self._writer, self._state, self._trouble = writer, State.RECORDING, None
        try:
            self._progress.stage(self._place.name, "recording")
            await self._listened.for_seconds(ReturningBus(listener, patience, self._is_lost), writer, seconds)
        except (Exception, asyncio.CancelledError) as e:
            self._end(writer, e)
            raise
        else:
            writer.close("asked")
        finally:
            self._lost, self._writer = writer.losses.get(RAW, 0), None

    def _end(self, writer: RecordingWriter, e: BaseException) -> None:
        """Says why, and finishes the file; where the disk has failed, that is
        on its way already."""
        with suppress(RecordingError):
            if not isinstance(e, asyncio.CancelledError):
                writer.event("failed", {"error": aborted(e, None).reason})
            writer.close(ended_because(e))

    def _kept(self, e: BaseException | None) -> Kept:
        listened, name = self._listened, self._place.name
        kept = Kept(
            name,
            self._path,
            listened.counts,
            listened.seconds,
            listened.gaps,
            listened.gaps_s,
            self._lost,
            kind="bus",
        )
        if e is None:
            return kept
        return replace(kept, exit_code=exit_code_of(e), error=f"bus {name}: {aborted(e, None).reason}")


def bus_recording_name(bus: str, time_ns: int) -> str:
    return f"{bus}-{stamp(time_ns)}.mcap"
