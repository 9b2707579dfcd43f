"""Writing back and verifying by physics: no way out leaves the device with a calibration that nobody vouches for."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field

from triaxcal.errors import Refused, TriaxcalError
from triaxcal_drivers.errors import DriverError
from triaxcal_drivers.interface import Device
from triaxcal_drivers.profile import CORRECTED
from triaxcald.documents import Document, to_text
from triaxcald.errors import DaemonError, RecordingError, StationError
from triaxcald.inputs import VERIFICATION
from triaxcald.provision.access import RecordedDevice, RegisterAccess
from triaxcald.provision.image import RegisterImage
from triaxcald.provision.procedure import ProvisionReport, provision, to_its_end
from triaxcald.provision.restore import restore
from triaxcald.provision.snapshot import Snapshot
from triaxcald.recording.writer import RecordingWriter
from triaxcald.station.collection import Collection
from triaxcald.station.config import Place, StationFile
from triaxcald.verification import OUTSIDE, UNJUDGED, WITHIN, WORSE, Verification, verification_document, verified

VERIFICATION_FILE = "verification.json"
REGISTERS_BEFORE, REGISTERS_AFTER = "registers-before.json", "registers-after.json"
UNTOUCHED, RESTORED = "old calibration untouched", "old calibration restored and verified"
NEW_VERIFIED = "the device holds the new calibration, verified"
NEW_UNJUDGED = "the device holds the new calibration, read back; its output is not judged, as the station has no limit"
NEW_UNCHECKED = "the device holds the new calibration, not verified by physics: it has no corrected stream"
UNCERTAIN = "NOT restored"
"""What a state begins with where nobody can vouch for what the device holds."""


@dataclass
class WriteBack:
    """``state`` says in words what the device holds, None while nothing was tried. ``collect`` fetches check poses."""

    place: Place
    file: StationFile
    writer: RecordingWriter
    collect: Callable[[Collection], Awaitable[None]]
    state: str | None = None
    report: ProvisionReport | None = field(default=None, init=False)
    verification: Document | None = field(default=None, init=False)

    async def run(self, device: Device, image: RegisterImage, serial: str | None, tumble: Collection) -> None:
        """Whatever is raised on the way, the old calibration has been put back before, or `state` says why not."""
        try:
            report = self.report = await provision(
                device,
                self.place.bundle,
                image,
                expected_serial=serial,
                record=_Recorder(self.writer),
                where=self.place.address,
            )
        except BaseException as e:
            self.state = getattr(e, "__notes__", [UNTOUCHED])[-1]
            raise
        self.state = f"{UNCERTAIN}: the new calibration is stored and not verified"
        try:
            self.writer.attach(REGISTERS_BEFORE, "application/json", _snapshot_text(report.before))
            self.writer.attach(REGISTERS_AFTER, "application/json", _snapshot_text(report.after))
            self.writer.event("provisioned", {"written": list(report.written)})
            verdict = await self._verify(tumble)
        except (DriverError, DaemonError, TriaxcalError) as e:
            await self._undo(device, report)
            raise StationError(f"verification failed: {e}") from e
        except BaseException:
            await self._undo(device, report)
            raise
        if verdict in (OUTSIDE, WORSE):
            await self._undo(device, report)
            self.writer.event("restored", {"state": self.state})
            if self.state != RESTORED:
                raise StationError(f"verification {verdict}")

    async def _verify(self, tumble: Collection) -> str:
        """What the device's own output is judged to be."""
        if CORRECTED not in self.place.bundle.profile.streams:
            self.state = NEW_UNCHECKED
            return UNJUDGED
        check = Collection(VERIFICATION, self.place.bundle, self.place.address)
        await self.collect(check)
        found = corrected(check, self.file.reference)
        document = self.verification = verification_document(
            corrected(tumble, self.file.reference),
            found,
            limit_g=self.file.limits.verification_rms_g,
            raw_sha256=check.digest.hexdigest(),
        )
        self.writer.attach(VERIFICATION_FILE, "application/json", to_text(document).encode())
        if found.rms_g is None:
            faults = ", ".join(dict.fromkeys(p.fault for p in found.untrusted))
            why = f"no check pose can be trusted: {len(found.poses)} left out ({faults})"
            raise Refused(why if found.poses else "there is no check pose")
        verdict = str(document["verdict"])
        self.state = {WITHIN: NEW_VERIFIED, UNJUDGED: NEW_UNJUDGED}.get(verdict, self.state)
        return verdict

    async def _undo(self, device: Device, report: ProvisionReport) -> None:
        recorded = RecordedDevice(device, _Recorder(self.writer, lenient=True))

        async def put_back() -> str:
            try:
                await restore(recorded, self.place.bundle, report.before, stored=True)
            except (DriverError, StationError) as e:
                return f"{UNCERTAIN}: {e}"
            return RESTORED

        self.state = await to_its_end(put_back())


def corrected(collection: Collection, reference: float) -> Verification:
    """What the device itself reported of a collection's poses."""
    return verified(collection.pipelines[CORRECTED], reference)


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
