"""Writing back and verifying by physics: no way out leaves the device with a
calibration that nobody vouches for."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald import text
from triaxcald.documents import to_text
from triaxcald.errors import DaemonError, DiskError, Implausible, StationError, TwoAnswer
from triaxcald.inputs import VERIFICATION
from triaxcald.provision.access import RegisterLink
from triaxcald.provision.correction import require_unchanged
from triaxcald.provision.identity import WrongUnit
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.registers import (
    LEAST,
    RegisterImage,
    SanityWarning,
    departure_g,
    departure_warnings,
    is_blank,
    require_readings_before,
)
from triaxcald.provision.state import DeviceState, Held
from triaxcald.recording.writer import RecordingWriter
from triaxcald.schema.codes import Stage
from triaxcald.software import new_run_id
from triaxcald.station.collection import Collection
from triaxcald.station.config import Place, Station
from triaxcald.station.power import power_cycle_asked
from triaxcald.station.starting import recorder
from triaxcald.verification import (
    OUTSIDE,
    UNJUDGED,
    WORSE,
    Apart,
    Verification,
    fitted_attitudes,
    verification_document,
    verified,
)

VERIFICATION_FILE = "verification.json"
REGISTERS_BEFORE, REGISTERS_AFTER = "registers-before.json", "registers-after.json"
FIRST_POSES = 4
"""Poses at the start of either stream of which at least one is in the other stream
too."""
REGISTERS_EARLIER = "registers-earlier.json"
"""Registers before an earlier, interrupted provisioning, which an undo restores."""


@dataclass
class WriteBack:
    """Writes a calibration into the device and verifies it.

    ``collect`` collects check poses, ``ask`` instructs the operator; ``force`` is
    the reason to continue in spite of `warnings`; ``run`` is the id of the run, and
    ``on_settled`` as in `Provisioning`. ``at_start`` are the registers by which the
    device corrected the readings of the calibration, if it did. ``verdict`` is that
    on the device's own output, None before it is judged.
    """

    place: Place
    station: Station
    writer: RecordingWriter
    collect: Callable[[Collection], Awaitable[None]]
    ask: Callable[[Stage, str], None]
    started: str
    force: str | None = None
    run: str = field(default_factory=new_run_id)
    at_start: Mapping[str, bytes] | None = None
    on_settled: Callable[[Held], None] = lambda _: None
    verification: tc.interchange.Document | None = field(default=None, init=False)
    verdict: str | None = field(default=None, init=False)
    warnings: Sequence[SanityWarning] = field(default=(), init=False)
    provisioning: Provisioning | None = field(default=None, init=False)

    async def examine(
        self, device: td.Device, image: RegisterImage, serial: str | None, acquisition: Collection
    ) -> Provisioning:
        """Identifies the unit and reads its registers; nothing is written.
        Raises Implausible, Refused, ProvisionError, StationError, DiskError."""
        link = RegisterLink(device, self.place.bundle.profile, recorder(self.writer), name=self.place.device_name)
        asked = power_cycle_asked(self.ask, link, self.place, self.station)
        p = Provisioning(
            link,
            self.place.bundle,
            image,
            unit=self.place.unit.name,
            folder=self.station.folder,
            expected_serial=serial,
            where=self.place.address,
            started=self.started,
            run=self.run,
            on_settled=self.on_settled,
            power_cycle=asked if self.station.file.provisioning.power_cycle else None,
        )
        await p.examine()
        self.provisioning = p
        require_readings_before(self.place.bundle.profile, p.found)
        if not p.carried:
            require_unchanged(p.found.raw, self.at_start)
        self.warnings = [*p.warnings, *await asyncio.to_thread(self._output_warnings, acquisition)]
        if self.warnings and self.force is None:
            raise Implausible(text.refused_by_sanity_warnings(self.warnings))
        self._attach(REGISTERS_BEFORE, p.found.raw)
        if p.carried:
            self._attach(REGISTERS_EARLIER, p.before.raw)
        return p

    async def check_alone(self, acquisition: Collection) -> None:
        """Verify the output of a device in which nothing is to be written. Raises
        StationError, DiskError."""
        try:
            self.verdict = await self._verify(acquisition)
        except (DiskError, WrongUnit, TwoAnswer):
            raise
        except (td.DriverError, DaemonError, tc.TriaxcalError) as e:
            raise StationError(f"verification failed: {e}") from e

    async def write(self, p: Provisioning, acquisition: Collection) -> None:
        """Write and verify. Before any error is raised the old calibration is restored,
        or `held` has the state of the device. Raises ProvisionError, StationError,
        DiskError."""
        with p.finishing():
            await p.write()
            await self._finish(p, acquisition)

    async def _finish(self, p: Provisioning, acquisition: Collection) -> None:
        try:
            self._attach(REGISTERS_AFTER, p.after.raw)
            self.writer.event("provisioned", {"written": list(p.written)})
            self.verdict = await self._verify(acquisition)
        except (DiskError, WrongUnit, TwoAnswer):  # raised unchanged
            await p.undo()
            raise
        except (td.DriverError, DaemonError, tc.TriaxcalError) as e:
            await p.undo()
            raise StationError(f"verification failed: {e}") from e
        except BaseException:
            await p.undo()
            raise
        if self.verdict in (OUTSIDE, WORSE):
            await p.undo()
            self.writer.event("restored", {"state": p.held.state.value})
            if p.held.state is not DeviceState.OLD:
                raise StationError(f"verification {self.verdict}, and the old calibration could not be put back")
            if (task := asyncio.current_task()) and task.cancelling():
                raise asyncio.CancelledError

    def _output_warnings(self, acquisition: Collection) -> list[SanityWarning]:
        assert self.provisioning is not None
        if td.CORRECTED not in acquisition.pipelines or is_blank(self.provisioning.found) or self.provisioning.carried:
            return []
        profile, found = self.place.bundle.profile, self.provisioning.found
        readings, outputs = acquisition.pipelines[td.READINGS].poses(), acquisition.pipelines[td.CORRECTED].poses()
        departures = [
            off_g
            for pairs in _alignments(readings, outputs)
            if (off_g := departure_g(profile, found, *_paired(pairs))) is not None
        ]
        return departure_warnings(min(departures, default=None))

    async def _verify(self, acquisition: Collection) -> str:
        """Verify the device's own output in check poses; the verdict."""
        if self.place.bundle.profile.own_output is None:
            return UNJUDGED
        check = Collection(VERIFICATION, self.place.bundle, self.place.address, ends_with=self.writer.ends_with)
        await self.collect(check)
        found, document = await asyncio.to_thread(self._judged, acquisition, check)
        self.verification = document
        self.writer.attach(VERIFICATION_FILE, "application/json", to_text(document).encode())
        if found.rms_g is None:
            faults = ", ".join(dict.fromkeys(p.fault for p in found.untrusted))
            why = f"no check pose can be trusted: {len(found.poses)} left out ({faults})"
            raise tc.Refused(why if found.poses else "there is no check pose")
        return str(document["verdict"])

    def _judged(self, acquisition: Collection, check: Collection) -> tuple[Verification, tc.interchange.Document]:
        reference = self.station.file.reference
        found = corrected(check, reference)
        fitted = fitted_attitudes(acquisition.pipelines[td.READINGS], self.place.signs)
        document = verification_document(
            corrected(acquisition, reference),
            found,
            limit_g=self.station.file.limits.verification_rms_g,
            raw_sha256=check.digest.hexdigest(),
            apart=Apart(fitted, self.station.file.plan.apart_deg),
        )
        return found, document

    def _attach(self, name: str, raw: Mapping[str, bytes]) -> None:
        held = {register: value.hex() for register, value in raw.items()}
        self.writer.attach(name, "application/json", (json.dumps(held, indent=2) + "\n").encode())


def corrected(collection: Collection, reference: float) -> Verification:
    """The device's own output in the poses of a collection."""
    stream = collection.bundle.profile.own_output
    assert stream is not None
    return verified(collection.pipelines[stream], reference)


def _alignments(readings: Sequence[tc.Pose], outputs: Sequence[tc.Pose]) -> Iterator[list[tuple[tc.Pose, tc.Pose]]]:
    """Pairs of overlapping poses of the two streams, for each possible time shift.

    Each stream counts its seconds from its own first sample, and either may begin
    some poses later.
    """
    (r0, r1), (c0, c1) = (np.array([(p.start_s, p.end_s) for p in s]).reshape(-1, 2).T for s in (readings, outputs))
    apart_s = np.subtract.outer(r0, c0)
    for shift_s in np.unique(np.r_[0.0, apart_s[:FIRST_POSES].ravel(), apart_s[:, :FIRST_POSES].ravel()]):
        shared_s = np.minimum.outer(r1, c1 + shift_s) - np.maximum.outer(r0, c0 + shift_s)
        over = np.argwhere(shared_s >= 0.5 * np.maximum.outer(r1 - r0, c1 - c0))
        if len(over) >= LEAST:
            yield [(readings[i], outputs[j]) for i, j in over]


def _paired(pairs: Sequence[tuple[tc.Pose, tc.Pose]]) -> tuple[tc.Floats, tc.Floats, dict[str, tc.Floats]]:
    """Means (n,3) of both streams, and the channels (n,) that every pose has."""
    names = set.intersection(*(set(r.channels) for r, _ in pairs)) if pairs else set()
    return (
        np.array([r.mean for r, _ in pairs]).reshape(-1, 3),
        np.array([c.mean for _, c in pairs]).reshape(-1, 3),
        {name: np.array([r.channels[name] for r, _ in pairs]) for name in names},
    )
