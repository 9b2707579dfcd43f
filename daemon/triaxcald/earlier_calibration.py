"""The calibration file whose biases a later recording renews: read, and refused
where it is of another unit or another reference."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.inputs import document_bytes, parse_document
from triaxcald.provision.identity import same_serial
from triaxcald.station.config import Place, Station

ATTACHMENT = "rezero.json"
"""Under which a recording carries the file."""
RECORD = "rezero"
"""The metadata record that names it."""


@dataclass(frozen=True)
class EarlierFile:
    """``document`` is a calibration, loop or certificate document, ``data`` the
    bytes that it was read from."""

    name: str
    data: bytes
    document: Mapping[str, Any]
    calibration: tc.Calibration

    @classmethod
    def read(cls, path: str) -> EarlierFile:
        """Raises InputError, InvalidData."""
        return cls.parsed(document_bytes(path), path)

    @classmethod
    def parsed(cls, data: bytes, name: str) -> EarlierFile:
        document = parse_document(data, where=name)
        return cls(Path(name).name, data, document, tc.Calibration.from_dict(document, where=name))

    @property
    def serial(self) -> str | None:
        """Of the unit that it is of, where it says."""
        unit = self.document.get("unit")
        serial = unit.get("serial") if isinstance(unit, Mapping) else None
        return serial if isinstance(serial, str) and serial else None

    def known(self, recording: str = "") -> tc.inputs.Earlier:
        """What it says of the unit before a ``recording``."""
        digest = hashlib.sha256(self.data).hexdigest()
        return tc.documents.earlier_of(self.calibration, self.name, sha256=digest, recording=recording)

    def require_of(
        self,
        what: str,
        *,
        serial: str | None = None,
        signs: Sequence[int] | None = None,
        reference: float | None = None,
        reference_unit: str | None = None,
        output_unit: str = "",
    ) -> None:
        """Raises Refused where it is not of the unit, the signs of scale
        factors, the reference or the unit of the outputs of ``what``, as far as
        both say."""
        c = self.calibration
        if serial and self.serial and not same_serial(self.serial, serial):
            raise tc.Refused(f"{self.name}: is of the unit with serial {self.serial}; {what} is of {serial}")
        for axis, k, sign in zip("xyz", c.scale_factor, signs or (), strict=bool(signs)):
            if k * sign < 0:
                raise tc.Refused(f"{self.name}: scale_factor.{axis} is {k:.4g}, of another sign than that of {what}")
        own = c.fitted.reference
        if reference is not None and not math.isclose(reference, own, rel_tol=1e-9):
            raise tc.Refused(
                f"{self.name}: was made for the reference {own:.9g}, and that of {what} is {reference:.9g}"
            )
        if reference_unit and not tc.units.same_unit(reference_unit, c.reference_unit):
            raise tc.Refused(
                f"{self.name}: the reference is in {c.reference_unit}, and that of {what} in {reference_unit}"
            )
        if output_unit and c.output_unit and not tc.units.same_unit(output_unit, c.output_unit):
            raise tc.Refused(f"{self.name}: is of outputs in {c.output_unit}, and those of {what} are in {output_unit}")

    def require_of_place(self, place: Place, reference: float, serial: str | None) -> None:
        """The same of a unit of a station, whose ``reference`` is in g; and
        where it does not say how uncertain it is, or needs a channel that the
        unit does not send."""
        tc.inputs.require_known(self.known())
        self.require_of(
            f"unit {place.unit.name}",
            serial=serial,
            signs=place.signs,
            reference=reference,
            reference_unit="g",
            output_unit=place.bundle.profile.output.unit,
        )
        self.require_channels(place)

    def require_channels(self, place: Place) -> None:
        """Raises Refused if the calibration needs a channel that the unit does not
        send."""
        sent = getattr(place.bundle.profile.streams[td.READINGS], "channels", None)
        needed = [
            tc.effects.channel_of(n) for n in self.calibration.fitted.channel_reference if not tc.effects.is_derived(n)
        ]
        if sent is not None and (missing := [name for name in needed if name not in sent]):
            raise tc.Refused(f"{self.name}: needs {', '.join(missing)}, which unit {place.unit.name} does not send")


def earlier_by_unit(paths: Sequence[str], station: Station) -> dict[str, EarlierFile]:
    """The file of each unit of a station, by the unit's name: by serial number
    where there are several. Raises InputError; Refused where a unit has none,
    or a file no unit."""
    if not paths:
        return {}
    files = [EarlierFile.read(path) for path in paths]
    if len(files) == len(station.places) == 1:
        found = {station.places[0].unit.name: files[0]}
    else:
        found = {}
        for file in files:
            places = [p for p in station.places if _is_of(file, p)]
            if len(places) != 1 or places[0].unit.name in found:
                raise tc.Refused(
                    f"{file.name}: is not of one unit of {station.path} alone by its serial number "
                    f"({file.serial or 'none'}); of several units each has its own file"
                )
            found[places[0].unit.name] = file
        if lacking := [p.unit.name for p in station.places if p.unit.name not in found]:
            raise tc.Refused(f"{station.path}: no calibration to renew the biases of: {', '.join(lacking)}")
    for place in station.places:
        found[place.unit.name].require_of_place(place, station.file.reference, place.unit.serial)
    return found


def _is_of(file: EarlierFile, place: Place) -> bool:
    serial = place.unit.serial
    return bool(file.serial and serial and same_serial(file.serial, serial))
