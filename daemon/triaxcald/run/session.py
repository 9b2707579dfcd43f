"""One unit of a station while somebody works with it: who it is, where its
recording goes, and its coming back."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import triaxcal_drivers as td
from triaxcald import text
from triaxcald.errors import InputError
from triaxcald.files import in_a_name
from triaxcald.provision.access import RegisterLink
from triaxcald.provision.correction import AT_START, correcting_registers, to_bytes
from triaxcald.provision.identity import IdentityRead, identified
from triaxcald.provision.registers import Snapshot, take_snapshot
from triaxcald.recording.manifest import SEGMENT_BYTES, SEGMENT_S, Retention
from triaxcald.recording.schema import PROFILE_FILE, STATION_FILE, preview_channels
from triaxcald.recording.writer import RecordingWriter
from triaxcald.run.error_reasons import code_of
from triaxcald.schema.codes import Code, Stage
from triaxcald.software import drawn_with, software, versions
from triaxcald.station.collection import Progress, Recorded
from triaxcald.station.config import Place, SerialsSeen, Station
from triaxcald.station.output_check import Confirmation
from triaxcald.station.reconnect import HOLE_S, ReconnectingDevice, RetryPolicy, Streaming
from triaxcald.station.starting import StartingDevice
from triaxcald.utc import file_stamp


@dataclass(frozen=True)
class Segments:
    """A recording in segments of so many bytes and seconds, of which
    ``retention`` takes the oldest away, each after ``bury`` has signed that it does."""

    size_bytes: int = SEGMENT_BYTES
    time_s: float = SEGMENT_S
    retention: Retention | None = None
    bury: Callable[[str, str, str], None] | None = None


def new_writer(path: Path, segments: Segments | None, **settings: Any) -> RecordingWriter:
    """A writer with the ``settings`` of a `RecordingWriter`, in ``segments`` if given.
    Raises RecordingError."""
    if segments is None:
        return RecordingWriter(path, **settings)
    from triaxcald.recording.segments import SegmentedWriter  # which reads recordings too

    return SegmentedWriter(path, **settings, **vars(segments))


class UnitSession:
    """Work with one unit of a station. ``progress`` informs the operator, ``serials``
    refuses a serial number that occurs twice, ``clock_ns`` is the host's time since
    the epoch."""

    def __init__(
        self,
        station: Station,
        place: Place,
        progress: Progress,
        *,
        serials: SerialsSeen | None = None,
        clock_ns: Callable[[], int] = time.time_ns,
    ) -> None:
        self.station, self.place, self.progress, self.clock_ns = station, place, progress, clock_ns
        self.serials = serials or SerialsSeen()
        self.name = place.unit.name
        self.profile = place.bundle.profile

    def leave(self) -> None:
        """Release the serial number, which another place of the station may get."""
        self.serials.discard(self.name)

    def waits(self, policy: RetryPolicy, trouble: Exception) -> None:
        """Report that the unit is lost and retried."""
        self.progress.lost(
            self.name, code_of(trouble) or Code.ABSENT, text.waited_for(str(trouble), endless=policy.endless)
        )

    def reconnecting(
        self,
        device: td.Device,
        identity: IdentityRead,
        policy: RetryPolicy,
        lost: Callable[[str | None], None] = lambda _: None,
        confirmation: Confirmation | None = None,
    ) -> Streaming:
        """The device with reconnection. The same unit has to answer after it and, by
        ``confirmation``, has to stay. ``lost`` receives the reason of an interruption,
        and None when it is over."""

        async def identify() -> None:
            same = partial(self._require_same, device, identity)
            await (same() if confirmation is None else confirmation.returned(same))

        def tell(trouble: str | None) -> None:
            lost(trouble)
            if trouble is None:
                self.progress.back(self.name)
            else:
                self.progress.lost(self.name, Code.LOST, text.waited_for(trouble, endless=policy.endless))

        # A unit with rare samples is silent only after the time of its profile.
        hole_s = max(HOLE_S, self.profile.sampling.silence_timeout_s)
        reconnecting = ReconnectingDevice(device, identify, policy, tell, hole_s=hole_s)
        return reconnecting if confirmation is None else confirmation.of(reconnecting)

    def confirmation(
        self, device: td.Device, identity: IdentityRead, writer: RecordingWriter | None, recorded: Recorded
    ) -> Confirmation:
        """Confirmation of a unit that was just identified, before ``recorded`` takes
        its records."""
        if isinstance(device, StartingDevice):
            device.writer = writer
        told = self.profile.identity
        asked = partial(self._require_same, device, identity) if told.serial_register or told.expect else None
        return Confirmation(asked, writer, recorded, lambda why: self.progress.note(self.name, text.unidentified(why)))

    async def _require_same(self, device: td.Device, identity: IdentityRead) -> None:
        """Raises WrongUnit, TwoAnswer."""
        expected, bundle = identity.serial or self.place.unit.serial, self.place.bundle
        link = RegisterLink(device, self.profile, name=self.place.device_name)
        # One request without the link's retries: the reconnection retries itself.
        await identified(link, bundle, expected, where=self.place.address, device=device)

    async def identify(self, device: td.Device) -> IdentityRead:
        self.progress.stage(self.name, Stage.IDENTITY)
        link, where = RegisterLink(device, self.profile, name=self.place.device_name), self.place.address
        identity = await identified(link, self.place.bundle, self.place.unit.serial, where=where)
        self.serials.add(identity.serial, self.name, where)
        return identity

    async def registers(self, device: td.Device) -> Snapshot:
        """All calibration registers, as they are in use. Raises WrongUnit,
        DriverError."""
        return await take_snapshot(RegisterLink(device, self.profile, name=self.place.device_name), self.place.bundle)

    async def correcting_registers(self, device: td.Device) -> dict[str, bytes] | None:
        """The registers by which the device corrects its readings now, where its
        profile has a form of correction. Raises WrongUnit, DriverError."""
        if not (names := correcting_registers(self.profile)):
            return None
        link = RegisterLink(device, self.profile, name=self.place.device_name)
        return dict((await take_snapshot(link, self.place.bundle, names)).raw)

    def recording_name(self, identity: IdentityRead) -> str:
        return f"{self.name}-{in_a_name(identity.serial or 'unknown')}-{file_stamp(self.clock_ns())}.mcap"

    def recording_path(self, identity: IdentityRead) -> Path:
        folder = self.station.folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as e:
            raise InputError(f"{folder}: no folder for recordings: {e.strerror}") from e
        return folder / self.recording_name(identity)

    def writer(
        self,
        path: Path,
        identity: IdentityRead,
        *,
        ends_with: str = "",
        segments: Segments | None = None,
        more: Mapping[str, Mapping[str, str]] | None = None,
        at_start: Mapping[str, bytes] | None = None,
    ) -> RecordingWriter:
        """A writer with station file, profile and the registers ``at_start`` attached,
        and ``more`` metadata. Raises RecordingError."""
        unit = {"name": self.name, "serial": identity.serial or "", "signs": ",".join(map(str, self.place.signs))}
        settings: dict[str, Any] = {
            "metadata": {
                "station": {"name": self.station.file.name},
                "unit": unit,
                "software": {**(software() if ends_with else versions()), **drawn_with()},
                **(more or {}),
            },
            "preview_channels": preview_channels(self.profile),
            "preview_unit": self.profile.output.unit,
            "clock_ns": self.clock_ns,
        }
        if segments is None:
            settings["ends_with"] = ends_with
        writer = new_writer(path, segments, **settings)
        writer.attach(STATION_FILE, "application/toml", self.station.text)
        writer.attach(PROFILE_FILE, "application/toml", self.place.bundle.text)
        for name, data in self.place.bundle.files.items():
            writer.attach(f"profile/{name}", "application/octet-stream", data)
        if at_start is not None:
            writer.attach(AT_START, "application/json", to_bytes(at_start))
        return writer
