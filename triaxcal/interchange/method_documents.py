"""Documents of calibrations by other methods than still poses of unknown
attitude.

All are `triaxcal.calibration/1`, with what the method adds under a key of its
own.
"""

from __future__ import annotations

from triaxcal.inputs.attitude import AttitudeFit
from triaxcal.inputs.datasheet import Refinement
from triaxcal.inputs.turning.rotation import RotationFit
from triaxcal.interchange.calibration_document import (
    LINEAR,
    Document,
    by_parameter,
    calibration_document,
    residual_document,
)
from triaxcal.rounding import UNCERTAINTY_DIGITS, number, numbers, probability, uncertainty


def turning_document(found: RotationFit, *, output_unit: str, reference_unit: str) -> Document:
    document = calibration_document(
        found.calibration, output_unit=output_unit, reference_unit=reference_unit, budgeted=False
    )
    t = found.temperature
    document["temperature_c"] = (
        None if t is None else {"mean": number(t.mean), "lowest": number(t.lowest), "highest": number(t.highest)}
    )
    document["samples"] = found.samples
    document["stretches"] = found.stretches
    document["noise_g"] = numbers(found.noise_g, UNCERTAINTY_DIGITS)
    document["noise_unseen_share"] = uncertainty(found.unseen_share)
    return document


def attitudes_document(found: AttitudeFit, *, output_unit: str, reference_unit: str) -> Document:
    c = found.calibration
    document = calibration_document(c, output_unit=output_unit, reference_unit=reference_unit, budgeted=False)
    document["attitudes"] = {
        "error_rad": uncertainty(found.attitude_error_rad),
        "estimated": found.estimated,
        "error_standard_error_rad": uncertainty(found.attitude_error_uncertainty_rad),
        "if_estimated": None if found.if_estimated is None else _if_estimated(found.if_estimated),
        "rotation": numbers(found.rotation),
        "rotation_standard_error_rad": numbers(found.rotation_error_rad, UNCERTAINTY_DIGITS),
        "standard_error_if_exact": {
            name: numbers(found.noise_error[3 * i : 3 * i + 3], UNCERTAINTY_DIGITS) for i, name in enumerate(LINEAR)
        },
        "rows": [
            {
                "name": row.name,
                "up": numbers(row.up),
                "off_rad": uncertainty(row.off_rad),
                "off_standard_errors": uncertainty(row.off),
                "used": pose.used,
            }
            for row, pose in zip(found.attitudes, c.poses, strict=True)
        ],
    }
    return document


def _if_estimated(found: AttitudeFit) -> Document:
    c = found.calibration
    return {
        "error_rad": uncertainty(found.attitude_error_rad),
        "error_standard_error_rad": uncertainty(found.attitude_error_uncertainty_rad),
        **{name: numbers(getattr(c.sensor, name)) for name in LINEAR},
        "standard_error": {
            name: numbers(c.standard_errors[3 * i : 3 * i + 3], UNCERTAINTY_DIGITS) for i, name in enumerate(LINEAR)
        },
        "rotation": numbers(found.rotation),
        "rotation_standard_error_rad": numbers(found.rotation_error_rad, UNCERTAINTY_DIGITS),
        "residual": residual_document(c.residual, c.reference),
    }


def datasheet_document(found: Refinement, *, output_unit: str, reference_unit: str) -> Document:
    c = found.calibration
    document = calibration_document(c, output_unit=output_unit, reference_unit=reference_unit, budgeted=False)
    document["passport"] = {
        "conflict_p": probability(found.conflict_p),
        "changed": [c.parameters[i] for i in found.changed],
        "changed_alone": found.changed_alone if found.changed else None,
        "value": by_parameter(c, [number(float(v)) for v in found.datasheet.values]),
        "standard_error": by_parameter(c, [uncertainty(float(v)) for v in found.datasheet.standard_error]),
        "shift_standard_errors": by_parameter(c, [uncertainty(float(v)) for v in found.shift]),
        "share_of_poses": by_parameter(c, [uncertainty(float(v)) for v in found.share]),
        "source": by_parameter(c, found.sources),
    }
    return document
