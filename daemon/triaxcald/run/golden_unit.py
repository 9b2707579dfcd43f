"""The golden unit of a station: a unit that stays as it is, and shows whether a slot
still measures right. Its run verifies it; nothing is fitted and nothing is written."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald import text
from triaxcald.earlier_calibration import EarlierFile
from triaxcald.errors import InputError, RecordingError
from triaxcald.outcome import Code, Ending
from triaxcald.raw_to_poses import Pipeline
from triaxcald.recording.reader import Recording
from triaxcald.station.config import Place, Station, StationFile
from triaxcald.verification import (
    OUTSIDE,
    Apart,
    Verification,
    under_calibration,
    verification_document,
    verified,
)
from triaxcald.work import RECORD as WORK_RECORD

RECORD: Final = "golden"
"""Metadata record of a recording that verifies a golden unit: the ``stream``, and the
name of the ``calibration`` that its readings are taken under."""
ATTACHMENT: Final = "golden.json"
"""Under which the recording carries that calibration."""
PLAN: Final = 14
"""Poses of the plan whose first directions are asked for: faces and corners."""


def golden_calibration(station: Station) -> EarlierFile | None:
    """The calibration of the station's golden unit; None if it has none. Raises
    InputError if the file holds no calibration, or that of another unit."""
    golden = station.file.rules.golden
    if golden is None:
        return None
    where = f"{station.path}: rules.golden.calibration"
    try:
        file = EarlierFile.read(str(station.path.parent / golden.calibration))
    except (InputError, tc.TriaxcalError) as e:
        raise InputError(f"{where}: {e}") from e
    if file.serial is not None and not station.file.rules.of_golden(file.serial):
        raise InputError(f"{where}: {file.name} is of the unit with serial {file.serial}, not of {golden.serial}")
    return file


def check_directions(wanted: int) -> list[tc.planning.Direction]:
    """Directions that a golden unit is asked to take, spread over the sphere."""
    return tc.planning.directions(max(wanted, PLAN))[:wanted]


@dataclass(frozen=True)
class GoldenCheck:
    """What a golden unit is verified by: its own corrected output, or its readings
    under the calibration of ``file``. ``limit_g`` and ``apart_deg`` are those of the
    station, ``reference`` is in g."""

    own_output: str | None
    file: EarlierFile | None
    limit_g: float | None
    apart_deg: float
    reference: float

    @property
    def stream(self) -> str:
        return self.own_output if self.file is None and self.own_output is not None else td.READINGS

    @property
    def record(self) -> dict[str, str]:
        return {"stream": self.stream, **({} if self.file is None else {"calibration": self.file.name})}

    @staticmethod
    def at_place(station: Station, place: Place, serial: str | None) -> GoldenCheck | None:
        """For the unit of this serial number; None if it is not the golden one. Raises
        InputError, and Refused if the calibration is not of this unit."""
        if not station.file.rules.of_golden(serial):
            return None
        file = golden_calibration(station)
        assert file is not None
        own_output = place.bundle.profile.own_output
        if own_output is not None:
            file = None
        else:
            file.require_of(
                f"unit {place.unit.name}",
                serial=serial,
                signs=place.signs,
                reference_unit="g",
                output_unit=place.bundle.profile.output.unit,
            )
            file.require_channels(place)
        return _check(own_output, file, station.file)

    @staticmethod
    def of_recording(recording: Recording, station: StationFile, bundle: td.Bundle) -> GoldenCheck | None:
        """As the station had it; None if the recording is not of a golden unit. Raises
        RecordingError if its parts contradict each other."""
        record = recording.metadata.get(RECORD)
        unit, work = recording.metadata.get("unit", {}), recording.metadata.get(WORK_RECORD, {})
        golden = station.rules.of_golden(unit.get("serial") or work.get("serial"))
        if golden != (record is not None):
            says = "says" if golden else "does not say"
            raise RecordingError(f"metadata {RECORD}: {'missing' if golden else 'given'}, and rules.golden {says} so")
        if record is None:
            return None
        name = record.get("calibration")
        own_output = bundle.profile.own_output
        if (name is None) != (ATTACHMENT not in recording.attachments) or (name is None) != (own_output is not None):
            raise RecordingError(f"attachment {ATTACHMENT}: not as metadata {RECORD} and the profile have it")
        file = None if name is None else EarlierFile.parsed(recording.attachments[ATTACHMENT], name)
        return _check(own_output, file, station)

    def verify(self, pipelines: Mapping[str, Pipeline]) -> Verification:
        """Finishes the pipeline. Raises InputError if the calibration gives no finite
        errors, InvalidData if a channel is missing."""
        if self.file is None:
            return verified(pipelines[self.stream], self.reference)
        pipeline, model = pipelines[td.READINGS], self.file.calibration.fitted
        found = under_calibration(pipeline, model, self.reference)
        if not found.is_finite:
            raise InputError(f"{self.file.name}: its numbers and the readings give no finite magnitude")
        return found

    def document(self, found: Verification, raw_sha256: str) -> tc.interchange.Document:
        """The `triaxcal.verification/1`. Nothing is written between, so that the errors
        before and after are the same; there is no fit, so that every pose is apart."""
        apart = Apart(np.zeros((0, 3)), self.apart_deg)
        return verification_document(found, found, limit_g=self.limit_g, raw_sha256=raw_sha256, apart=apart)

    def ending(self, verification: Mapping[str, object]) -> Ending:
        """The verdict on the figures of the document alone, so an audit gives the
        same."""
        outside = verification["verdict"] == OUTSIDE
        code = Code.VERIFICATION_OUTSIDE if outside else Code.WITHIN_LIMITS
        return Ending.of(code, text.golden(verification, None if self.file is None else self.file.name))


def require_trusted(poses: Sequence[tc.Pose]) -> None:
    """Raises Refused if no pose can be trusted."""
    if not poses:
        raise tc.Refused("there is no check pose")
    if all(p.fault for p in poses):
        faults = ", ".join(dict.fromkeys(p.fault for p in poses))
        raise tc.Refused(f"no check pose can be trusted: {len(poses)} left out ({faults})")


def _check(own_output: str | None, file: EarlierFile | None, station: StationFile) -> GoldenCheck:
    return GoldenCheck(own_output, file, station.limits.verification_rms_g, station.plan.apart_deg, station.reference)
