"""One unit's way down the line: record, certify, provision, verify. Everything goes into its recording."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from triaxcal.errors import Refused, TriaxcalError
from triaxcal_drivers.errors import DriverError, RegisterValueError
from triaxcal_drivers.interface import Device
from triaxcal_drivers.profile import CORRECTED, READINGS
from triaxcald.certificate import Certified, certify, software
from triaxcald.documents import Document, to_text
from triaxcald.errors import DaemonError, InputError, RecordingError, StationError
from triaxcald.files import write_text
from triaxcald.inputs import CALIBRATION, PROFILE, VERIFICATION
from triaxcald.pipeline import Pipeline
from triaxcald.provision.access import RecordedDevice, RegisterAccess
from triaxcald.provision.identity import IdentityRead, check_identity
from triaxcald.provision.procedure import ProvisionReport, provision
from triaxcald.provision.restore import restore
from triaxcald.provision.snapshot import Snapshot
from triaxcald.recording.writer import RecordingWriter
from triaxcald.report.page import render_report
from triaxcald.report.stream import StreamOverview, thin
from triaxcald.station.collection import Collection, Progress
from triaxcald.station.config import Place, Station
from triaxcald.verification import Verification, verification_document, verify

CERTIFICATE, VERIFICATION_FILE, STATION_FILE = "certificate.json", "verification.json", "station.toml"
RESTORED = "old calibration restored and verified"
REGISTERS_BEFORE, REGISTERS_AFTER = "registers-before.json", "registers-after.json"

_DRAWING = threading.Lock()
"""The pictures' style is the process's own: one report is drawn at a time."""


@dataclass(frozen=True)
class Outcome:
    """How one unit's run ended. ``exit_code`` as the command line owes it; ``error`` one line where it failed."""

    unit: str
    exit_code: int
    recording: Path | None = None
    certificate: Path | None = None
    report: Path | None = None
    certified: Certified | None = None
    verification: Document | None = None
    provisioned: ProvisionReport | None = None
    error: str | None = None
    wanted: tuple[str, ...] = ()


class UnitRun:
    """The whole line for one unit of a station."""

    def __init__(
        self, station: Station, place: Place, progress: Progress, *, clock_ns: Callable[[], int] = time.time_ns
    ) -> None:
        self.station, self.place, self.progress, self.clock_ns = station, place, progress, clock_ns
        self.name = place.unit.name
        self.profile = place.bundle.profile

    async def run(self) -> Outcome:
        """Never raises for what a unit, a bus or the data do; says it in the outcome."""
        path: Path | None = None
        try:
            async with self.place.opened() as device:
                identity = await self.identify(device)
                path = self.recording_path(identity)
                with self.writer(path, identity) as writer:
                    try:
                        return await self._line(device, identity, writer, path)
                    except (TriaxcalError, DriverError, DaemonError) as e:
                        writer.event("failed", {"error": str(e)})
                        raise
        except Refused as e:
            return Outcome(self.name, 3, path, error=f"{self.place.where}: {e}", wanted=e.wanted)
        except TriaxcalError as e:
            return Outcome(self.name, 3, path, error=f"{self.place.where}: {e}")
        except RegisterValueError as e:
            return Outcome(self.name, 3, path, error=f"{self.place.where}: {e}; nothing was written")
        except DriverError as e:
            return Outcome(self.name, 4, path, error=f"{self.place.where}: {e}")
        except DaemonError as e:
            return Outcome(self.name, e.exit_code, path, error=f"{self.place.where}: {e}")

    async def identify(self, device: Device) -> IdentityRead:
        self.progress.stage(self.name, "reading identity")
        return await check_identity(device, self.place.bundle, self.place.unit.serial, where=self.place.where)

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

    async def _line(self, device: Device, identity: IdentityRead, writer: RecordingWriter, path: Path) -> Outcome:
        plan = self.station.file.plan
        tumble = Collection(CALIBRATION, self.place.bundle)
        await self._collect(device, writer, tumble, READINGS, plan.poses)
        self.progress.stage(self.name, "fitting")
        poses = tumble.pipelines[READINGS].finish()
        certified = await asyncio.to_thread(self._certify, tumble, poses, identity)
        writer.attach(CERTIFICATE, "application/json", to_text(certified.document).encode())
        stem = path.with_suffix("")
        outcome = Outcome(
            self.name,
            0 if certified.within_limits else 1,
            path,
            write_text(Path(f"{stem}.certificate.json"), to_text(certified.document)),
            certified=certified,
        )
        provisioned, verification = None, None
        if certified.image is not None and self.station.file.provisioning.write and certified.within_limits:
            provisioned, verification = await self._write_back(device, writer, certified, tumble, identity)
            if verification and verification["verdict"] == "outside limits":
                outcome = Outcome(**{**vars(outcome), "exit_code": 1})
        self.progress.stage(self.name, "writing the report")
        page = await asyncio.to_thread(self._report, certified, tumble.pipelines[READINGS], verification)
        writer.attach("report.html", "text/html", page.encode())
        return Outcome(
            **{
                **vars(outcome),
                "report": write_text(Path(f"{stem}.report.html"), page),
                "provisioned": provisioned,
                "verification": verification,
            }
        )

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
            check = Collection(VERIFICATION, self.place.bundle)
            wanted = self.station.file.plan.check_poses
            await self._collect(device, None, check, CORRECTED, wanted)
            return self._corrected(check)

    async def _write_back(
        self, device: Device, writer: RecordingWriter, certified: Certified, tumble: Collection, identity: IdentityRead
    ) -> tuple[ProvisionReport, Document | None]:
        assert certified.image is not None
        self.progress.stage(self.name, "writing the registers")
        try:
            report = await provision(
                device,
                self.place.bundle,
                certified.image,
                expected_serial=identity.serial,
                record=_Recorder(writer),
                where=self.place.where,
            )
        except RecordingError as e:  # the disk, while the device was at work; the notes say in what state it is
            raise StationError("; ".join([str(e), *getattr(e, "__notes__", [])])) from e
        writer.attach(REGISTERS_BEFORE, "application/json", _snapshot_text(report.before))
        writer.attach(REGISTERS_AFTER, "application/json", _snapshot_text(report.after))
        writer.event("provisioned", {"written": list(report.written)})
        if CORRECTED not in self.profile.streams:
            return report, None
        try:
            document = await self._verify(device, writer, tumble)
        except (DriverError, DaemonError, TriaxcalError, asyncio.CancelledError) as e:
            state = await self._undo(device, writer, report)
            if isinstance(e, asyncio.CancelledError):
                raise
            raise StationError(f"verification failed: {e}; {state}") from e
        if document["verdict"] == "outside limits":
            state = await self._undo(device, writer, report)
            writer.event("restored", {"state": state})
            if state != RESTORED:
                raise StationError(f"verification outside limits; {state}")
        return report, document

    async def _undo(self, device: Device, writer: RecordingWriter, report: ProvisionReport) -> str:
        recorded = RecordedDevice(device, _Recorder(writer, lenient=True))
        try:
            await asyncio.shield(restore(recorded, self.place.bundle, report.before, stored=True))
        except (DriverError, StationError) as e:
            return f"NOT restored: {e}"
        return RESTORED

    async def _verify(self, device: Device, writer: RecordingWriter, tumble: Collection) -> Document:
        self.progress.stage(self.name, "verifying by physics")
        file = self.station.file
        check = Collection(VERIFICATION, self.place.bundle)
        await self._collect(device, writer, check, CORRECTED, file.plan.check_poses)
        document = verification_document(
            self._corrected(tumble), self._corrected(check), limit_g=file.limits.verification_rms_g,
            raw_sha256=check.digest.hexdigest(),
        )  # fmt: skip
        writer.attach(VERIFICATION_FILE, "application/json", to_text(document).encode())
        return document

    def _corrected(self, phase: Collection) -> Verification:
        return verify(phase.pipelines[CORRECTED].finish(), self.station.file.reference)

    def _report(self, certified: Certified, pipeline: Pipeline, verification: Document | None) -> str:
        papers = dict(certified.document)
        if verification:
            papers["verification"] = verification
        with _DRAWING:
            return render_report(
                certified.document["result"],
                title=f"{papers['unit']['product']} {papers['unit']['serial']}",
                stream=overview(pipeline, self.profile.output.unit),
                certificate=papers,
            )


def overview(pipeline: Pipeline, unit: str) -> StreamOverview | None:
    """The stream for a picture, from the windows' means."""
    windows = pipeline.windows
    if windows is None:
        return None
    start = int(windows.start_ns[0])
    time_s, readings = thin((windows.start_ns - start) * 1e-9, windows.mean)
    spans = tuple((p.start_s, p.end_s) for p in pipeline.poses())
    return StreamOverview(time_s, readings, spans, unit)


class _Recorder:
    """Records register accesses; once the disk has failed, silently none, so that the device can be put back."""

    def __init__(self, writer: RecordingWriter, *, lenient: bool = False) -> None:
        self._writer, self._lenient = writer, lenient

    def __call__(self, access: RegisterAccess) -> None:
        try:
            self._writer.register(access.register, access.kind, access.raw, access.error or "")
        except RecordingError:
            if not self._lenient:
                self._lenient = True
                raise


def _snapshot_text(snapshot: Snapshot) -> bytes:
    return (json.dumps({name: raw.hex() for name, raw in snapshot.raw.items()}, indent=2) + "\n").encode()


async def run_station(station: Station, progress: Progress) -> Sequence[Outcome]:
    """All units of a station at once; one that fails does not stop the others."""
    return await asyncio.gather(*(UnitRun(station, place, progress).run() for place in station.places))
