"""One unit's way down the line: record, certify, provision, verify. Everything goes into its recording."""

from __future__ import annotations

import asyncio
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from triaxcal.errors import Refused, TriaxcalError
from triaxcal_drivers.errors import DriverError, RegisterValueError
from triaxcal_drivers.interface import Device
from triaxcal_drivers.profile import CORRECTED, READINGS
from triaxcald.certificate import Certified, certify, software
from triaxcald.documents import Document, to_text
from triaxcald.errors import DaemonError, InputError, RecordingError
from triaxcald.files import write_text
from triaxcald.inputs import CALIBRATION, PROFILE, STATION_FILE, VERIFICATION
from triaxcald.pipeline import Pipeline
from triaxcald.provision.identity import IdentityRead, check_identity
from triaxcald.provision.procedure import ProvisionReport
from triaxcald.recording.writer import RecordingWriter
from triaxcald.report.page import render_report
from triaxcald.report.stream import overview_of
from triaxcald.station.collection import Collection, Progress
from triaxcald.station.config import Place, Station
from triaxcald.station.write_back import NEW_UNCHECKED, NEW_UNJUDGED, NEW_VERIFIED, UNCERTAIN, WriteBack, corrected
from triaxcald.verification import Verification

CERTIFICATE = "certificate.json"
INTERRUPTED, FAILED = 130, 4

_DRAWING = threading.Lock()
"""The pictures' style is the process's own: one report is drawn at a time."""


@dataclass(frozen=True)
class Outcome:
    """How one unit's run ended. ``exit_code`` as the command line owes it; ``error`` one line where it failed.

    ``device_state`` says in words what the device holds, None where nothing was written. ``lost`` counts records that
    did not get to the disk.
    """

    unit: str
    exit_code: int
    recording: Path | None = None
    certificate: Path | None = None
    report: Path | None = None
    certified: Certified | None = None
    verification: Document | None = None
    provisioned: ProvisionReport | None = None
    device_state: str | None = None
    error: str | None = None
    wanted: tuple[str, ...] = ()
    lost: int = 0


class UnitRun:
    """The whole line for one unit of a station."""

    def __init__(
        self, station: Station, place: Place, progress: Progress, *, clock_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self.station, self.place, self.progress, self.clock_ns = station, place, progress, clock_ns
        self.name = place.unit.name
        self.profile = place.bundle.profile
        self._recording: Path | None = None
        self._certificate: Path | None = None
        self._page: Path | None = None
        self._certified: Certified | None = None
        self._write_back: WriteBack | None = None
        self._lost = 0

    async def run(self) -> Outcome:
        """Raises nothing, not even when it is cancelled: it says everything in the outcome."""
        try:
            async with self.place.opened() as device:
                identity = await self.identify(device)
                self._recording = self.recording_path(identity)
                with self.writer(self._recording, identity) as writer:
                    try:
                        code = await self._line(device, identity, writer)
                    except (TriaxcalError, DriverError, DaemonError) as e:
                        with suppress(RecordingError):
                            writer.event("failed", {"error": str(e)})
                        raise
                    finally:
                        self._lost = sum(writer.losses.values())
        except asyncio.CancelledError:
            return self._outcome(INTERRUPTED, "interrupted")
        except Refused as e:
            return self._outcome(3, str(e), e.wanted)
        except (TriaxcalError, RegisterValueError) as e:
            return self._outcome(3, str(e))
        except DriverError as e:
            return self._outcome(FAILED, str(e))
        except DaemonError as e:
            return self._outcome(e.exit_code, str(e))
        except Exception as e:  # noqa: BLE001 - the one place that supervises: other units must go on
            with suppress(OSError, ValueError):  # a closed standard error
                traceback.print_exc(file=sys.stderr)
            return self._outcome(FAILED, f"internal error: {e!r}")
        return self._outcome(code)

    def _outcome(self, code: int, error: str | None = None, wanted: tuple[str, ...] = ()) -> Outcome:
        """With what there is by now. Once writing has begun, an error also says what the device holds."""
        back = self._write_back
        state = back.state if back else None
        if error is not None:
            if state is not None and state not in error:
                error = f"{error}; {state}"
            if state is not None and (code != INTERRUPTED or state.startswith(UNCERTAIN)):
                code = FAILED
            error = f"unit {self.name}: {error}"
        return Outcome(
            unit=self.name,
            exit_code=code,
            recording=self._recording,
            certificate=self._certificate,
            report=self._page,
            certified=self._certified,
            verification=back.verification if back else None,
            provisioned=back.report if back else None,
            device_state=state,
            error=error,
            wanted=wanted,
            lost=self._lost,
        )

    async def identify(self, device: Device) -> IdentityRead:
        self.progress.stage(self.name, "reading identity")
        return await check_identity(device, self.place.bundle, self.place.unit.serial, where=self.place.address)

    def recording_path(self, identity: IdentityRead) -> Path:
        stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(self.clock_ns() / 1e9))
        folder = self.station.folder
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as e:
            raise InputError(f"{folder}: no folder for recordings: {e.strerror}") from e
        return folder / f"{self.name}-{identity.serial or 'unknown'}-{stamp}.mcap"

    def writer(self, path: Path, identity: IdentityRead) -> RecordingWriter:
        unit = {"name": self.name, "serial": identity.serial or "", "signs": ",".join(map(str, self.place.signs))}
        writer = RecordingWriter(
            path,
            metadata={
                "station": {"name": self.station.file.name},
                "unit": unit,
                "software": software(),
            },
            preview_channels=self._channels(),
            preview_unit=self.profile.output.unit,
            clock_ns=self.clock_ns,
        )
        writer.attach(STATION_FILE, "application/toml", self.station.text)
        writer.attach(PROFILE, "application/toml", self.place.bundle.text)
        for name, data in self.place.bundle.files.items():
            writer.attach(f"profile/{name}", "application/octet-stream", data)
        return writer

    def _channels(self) -> list[str]:
        names: dict[str, None] = {}
        for stream in self.profile.streams.values():
            names |= dict.fromkeys(n for n in getattr(stream, "channels", {}) if n not in ("ux", "uy", "uz"))
        return list(names)

    async def _line(self, device: Device, identity: IdentityRead, writer: RecordingWriter) -> int:
        """The exit code that the figures owe."""
        assert self._recording is not None
        plan, stem = self.station.file.plan, self._recording.with_suffix("")
        tumble = Collection(CALIBRATION, self.place.bundle, self.place.address)
        await self._collect(device, writer, tumble, READINGS, plan.poses)
        self.progress.stage(self.name, "fitting")
        poses = tumble.pipelines[READINGS].finish()
        certified = self._certified = await asyncio.to_thread(self._certify, tumble, poses, identity)
        writer.attach(CERTIFICATE, "application/json", to_text(certified.document).encode())
        self._certificate = write_text(Path(f"{stem}.certificate.json"), to_text(certified.document))
        code = 0 if certified.within_limits else 1
        if certified.image is not None and self.station.file.provisioning.write and certified.within_limits:

            async def collect(check: Collection) -> None:
                self.progress.stage(self.name, "verifying by physics")
                await self._collect(device, writer, check, CORRECTED, plan.check_poses)

            self.progress.stage(self.name, "writing the registers")
            back = self._write_back = WriteBack(self.place, self.station.file, writer, collect)
            await back.run(device, certified.image, identity.serial, tumble)
            code = 0 if back.state in (NEW_VERIFIED, NEW_UNJUDGED, NEW_UNCHECKED) else 1
        self.progress.stage(self.name, "writing the report")
        page = await asyncio.to_thread(self._report, certified, tumble.pipelines[READINGS])
        writer.attach("report.html", "text/html", page.encode())
        self._page = write_text(Path(f"{stem}.report.html"), page)
        return code

    def _certify(self, tumble: Collection, poses: list[Any], identity: IdentityRead) -> Certified:
        return certify(
            self.place.bundle,
            self.station.file,
            self.station.text,
            tumble.pipelines[READINGS],
            poses,
            tumble.digest,
            unit_name=self.name,
            serial=identity.serial,
            signs=self.place.signs,
            computed_with=software(),
        )

    async def _collect(
        self, device: Device, writer: RecordingWriter | None, collection: Collection, stream: str, wanted: int
    ) -> None:
        await collection.until_posed(
            device,
            writer,
            self.station.file.plan,
            stream=stream,
            wanted=wanted,
            nominal_scale_factor=self.profile.output.nominal_scale_factor if stream == READINGS else (1, 1, 1),
            tell=lambda state: self.progress.poses(self.name, collection.phase, state),
        )

    async def check(self) -> Verification:
        """Records nothing and writes nothing: only asks the device, in check poses, for its own corrected output."""
        async with self.place.opened() as device:
            await self.identify(device)
            self.progress.stage(self.name, "check poses")
            check = Collection(VERIFICATION, self.place.bundle, self.place.address)
            wanted = self.station.file.plan.check_poses
            await self._collect(device, None, check, CORRECTED, wanted)
            return corrected(check, self.station.file.reference)

    def _report(self, certified: Certified, pipeline: Pipeline) -> str:
        papers = dict(certified.document)
        if self._write_back and self._write_back.verification:
            papers["verification"] = self._write_back.verification
        if self._write_back:
            papers["device"] = self._write_back.state
        overview = overview_of(pipeline.windows, pipeline.poses(), self.profile.output.unit)
        with _DRAWING:
            return render_report(
                certified.document["result"],
                title=f"{papers['unit']['product']} {papers['unit']['serial']}",
                stream=overview,
                certificate=papers,
            )


async def run_station(station: Station, progress: Progress) -> list[Outcome]:
    """All units of a station at once; one that fails does not stop the others.

    When it is cancelled, every unit is put in order first; the outcomes then say 130.
    """
    units = [asyncio.ensure_future(UnitRun(station, place, progress).run()) for place in station.places]
    try:
        await asyncio.wait(units)
    except asyncio.CancelledError:
        for unit in units:
            unit.cancel()
        await asyncio.wait(units)
    return [unit.result() for unit in units]
