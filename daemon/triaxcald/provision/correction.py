"""The correction that a device makes by registers of a linear shape
(``[correction] form`` of its profile): what it holds, and what is to be written."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import InputError, RecordingError

AT_START = "registers-at-start.json"
"""Attachment of a recording: the registers by which the device corrected its
readings."""
IN_DOCUMENT = "registers_at_start"
"""Key of the same in a calibration document."""


def has_form(profile: td.Profile) -> bool:
    return profile.correction is not None and profile.correction.form is not None


def correcting_registers(profile: td.Profile) -> tuple[str, ...]:
    """The readable registers that make up the correction; none without a form."""
    if not has_form(profile):
        return ()
    roles = (*td.roles.CORRECTION_ROLES, td.roles.REFERENCE_ROLE)
    return tuple(name for name, r in profile.registers.items() if r.role in roles and r.access != "wo")


def free_coefficients(profile: td.Profile) -> tuple[str, ...]:
    """The coefficients that have a register to write."""
    return tuple(r.role for r in profile.registers.values() if r.role in td.roles.CORRECTION_ROLES and r.access == "rw")


def nominal_correction(profile: td.Profile) -> tc.estimate.LinearCorrection:
    """Of a device without a calibration."""
    assert profile.correction is not None
    diagonal = dict(zip(td.roles.DIAGONAL_ROLES, profile.nominal_diagonal, strict=True))
    return tc.estimate.LinearCorrection(
        diagonal, after=profile.correction.form == "matrix-after", output_per_g=profile.correction.output_per_g
    )


def held_correction(profile: td.Profile, raw: Mapping[str, bytes]) -> tc.estimate.LinearCorrection | None:
    """By the raw bytes of the device's registers; None where one holds no finite
    number. Raises RegisterValueError for bytes of a wrong length."""
    values: dict[str, float] = {}
    reference_c = 0.0
    for name, data in raw.items():
        register = profile.registers.get(name)
        if register is None or register.role is None:
            continue
        value = float(profile.decode(name, data))
        if not math.isfinite(value):
            return None
        if register.role == td.roles.REFERENCE_ROLE:
            reference_c = value
        elif register.role in td.roles.CORRECTION_ROLES:
            values[register.role] = value
    nominal = nominal_correction(profile)
    return tc.estimate.LinearCorrection(
        {**nominal.values, **values}, nominal.after, nominal.output_per_g, reference_c
    )  # fmt: skip


def removed_from(profile: td.Profile, poses: list[tc.Pose], raw: Mapping[str, bytes] | None) -> list[tc.Pose]:
    """Poses of the readings before the device's correction by the registers ``raw``;
    the same where the profile says that the readings are those. Raises Refused where
    that cannot be told."""
    if not profile.reads_corrected:
        return poses
    return tc.estimate.uncorrected(poses, _known(profile, raw))


def _known(profile: td.Profile, raw: Mapping[str, bytes] | None) -> tc.estimate.LinearCorrection:
    """The correction in recorded readings. Raises Refused."""
    if not raw:
        raise tc.Refused(
            f"the readings are corrected by the device's registers, and the recording has no {AT_START}: what it read "
            "before the correction cannot be told"
        )
    held = held_correction(profile, raw)
    if held is None:
        raise tc.Refused("a calibration register of the device holds no number: its output does not tell the reading")
    return held


def require_unchanged(raw: Mapping[str, bytes], at_start: Mapping[str, bytes] | None) -> None:
    """Raises Refused if registers of the device, ``raw``, were written since the
    readings began that were corrected by them."""
    changed = [name for name, data in (at_start or {}).items() if name in raw and raw[name] != data]
    if changed:
        raise tc.Refused(
            f"the register{'s' if len(changed) > 1 else ''} {', '.join(changed)} changed since the readings began, "
            "which were corrected by them; nothing was written: measure again"
        )


def start_of_fit(profile: td.Profile, raw: Mapping[str, bytes] | None) -> tc.estimate.LinearCorrection:
    """Where the fit of the coefficients begins: at what the device holds, or at the
    nominal ones of a device that holds nothing usable."""
    nominal = nominal_correction(profile)
    held = held_correction(profile, raw) if raw else None
    if held is None or not _is_usable(held, nominal):
        fixed = {} if held is None else {n: v for n, v in held.values.items() if n not in free_coefficients(profile)}
        reference_c = nominal.reference_c if held is None else held.reference_c
        return tc.estimate.LinearCorrection(
            {**nominal.values, **fixed}, nominal.after, nominal.output_per_g, reference_c
        )  # fmt: skip
    return held


def _is_usable(held: tc.estimate.LinearCorrection, nominal: tc.estimate.LinearCorrection) -> bool:
    """Whether each gain is one of such a device."""
    for name in td.roles.DIAGONAL_ROLES:
        size = abs(nominal.values[name])
        # A rotation may leave little on the diagonal; the row has it all the same.
        row = [held.values.get(f"{name[:-1]}{axis}", 0.0) for axis in td.roles.AXES]
        if not size / td.SCALE_FACTOR_RATIO <= math.hypot(*row) <= size * td.SCALE_FACTOR_RATIO:
            return False
    return True


def register_values(profile: td.Profile, correction: tc.estimate.LinearCorrection) -> dict[str, float]:
    """The coefficients that have a register to write, by role, and the reference
    temperature."""
    wanted = {role: correction.values.get(role, 0.0) for role in free_coefficients(profile)}
    return {**wanted, td.roles.REFERENCE_ROLE: correction.reference_c}


def with_values(correction: tc.estimate.LinearCorrection, held: Mapping[str, float]) -> tc.estimate.LinearCorrection:
    """With the values (by role) that the registers hold after rounding."""
    own = {role: value for role, value in held.items() if role in td.roles.CORRECTION_ROLES}
    reference_c = held.get(td.roles.REFERENCE_ROLE, correction.reference_c)
    return tc.estimate.LinearCorrection(
        {**correction.values, **own}, correction.after, correction.output_per_g, reference_c
    )  # fmt: skip


def samples_before(profile: td.Profile, block: td.SampleBlock, raw: Mapping[str, bytes] | None) -> td.SampleBlock:
    """Samples of the readings before the device's correction, as `removed_from` has
    poses. Raises Refused."""
    if not profile.reads_corrected or not len(block):
        return block
    held = _known(profile, raw)
    temperature = block.channels.get(tc.effects.TEMPERATURE)
    if temperature is None and held.thermal:
        raise tc.Refused("the device corrects by temperature, and its readings have none")
    at_c = np.full(len(block), held.reference_c) if temperature is None else temperature
    return replace(
        block, readings=held.before(block.readings, np.asarray(at_c, dtype=np.float64))[0].astype(np.float64)
    )


def to_hex(raw: Mapping[str, bytes]) -> dict[str, str]:
    return {name: data.hex() for name, data in raw.items()}


def to_bytes(raw: Mapping[str, bytes]) -> bytes:
    """As attached to a recording."""
    return (json.dumps(to_hex(raw), indent=2) + "\n").encode()


def from_attachments(attachments: Mapping[str, bytes], where: str) -> dict[str, bytes] | None:
    """None where the recording has none. Raises RecordingError."""
    if AT_START not in attachments:
        return None
    try:
        return from_hex(json.loads(attachments[AT_START]))
    except (ValueError, TypeError, AttributeError) as e:
        raise RecordingError(f"{where}: {AT_START}: not registers as hexadecimal bytes") from e


def from_document(document: Mapping[str, Any], where: str) -> dict[str, bytes] | None:
    """Of a calibration document; None where it has none. Raises InputError."""
    if (held := document.get(IN_DOCUMENT)) is None:
        return None
    try:
        return from_hex(held)
    except (ValueError, TypeError, AttributeError) as e:
        raise InputError(f"{where}: {IN_DOCUMENT}: not registers as hexadecimal bytes") from e


def from_hex(held: Any) -> dict[str, bytes]:
    """Raises ValueError, TypeError or AttributeError for anything but bytes by
    register."""
    return {str(name): bytes.fromhex(data) for name, data in held.items()}
