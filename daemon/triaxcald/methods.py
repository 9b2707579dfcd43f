"""Calibrations that come by other ways than still poses of unknown attitude:
their documents, and datasheets as read.

All are `triaxcal.calibration/1`, with what the way adds under a key of its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from triaxcal.inputs.attitude import AttitudeFit
from triaxcal.inputs.datasheet import Datasheet, Refinement
from triaxcal.inputs.turning.rotation import RotationFit
from triaxcal.interchange.calibration_document import (
    LINEAR,
    Document,
    by_parameter,
    calibration_document,
    residual_document,
)
from triaxcal.interchange.calibration_reading import calibration_part, holds_at_of, sensor_of
from triaxcal.interchange.error_reading import correlation_of, effect_errors_of, linear_errors_of
from triaxcal.rounding import UNCERTAINTY_DIGITS, number, numbers, probability, uncertainty
from triaxcald.errors import InputError


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


def read_datasheet(
    document: Mapping[str, Any], *, where: str, errors: tuple[float, float, float] | None, reference: float | None
) -> tuple[Datasheet, Mapping[str, str]]:
    """The datasheet values in a calibration, loop or certificate document, and
    its units.

    ``errors`` stand for the document's, and for its correlation: of the scale
    factors relative to them, of the misalignments in rad, of the biases in the
    unit of the reference. ``reference`` is the magnitude in the poses, where it
    is not the document's. Raises InputError.
    """
    sensor, channel_reference, own = sensor_of(document, where=where)
    part = calibration_part(document, where=where)
    if reference is not None and not 0.9 < reference / own < 1.1:
        raise InputError(f"--reference {reference:g}: {where} was made for {own:g}, in another unit it seems")
    if errors is not None:
        relative, angle, bias = errors
        linear = np.concatenate([np.abs(sensor.scale_factor) * relative, np.full(3, angle), np.full(3, bias)])
        correlation = None
    elif "standard_error" not in part:
        raise InputError(f"{where}: standard_error: missing; expected them, or --datasheet-error")
    else:
        linear = linear_errors_of(part, where=where)
        correlation = correlation_of(part, sensor, where=where)
    standard_error = np.concatenate([linear, effect_errors_of(part, sensor, where=where)])
    if not np.any(standard_error > 0):
        whose = f"{where}: standard_error" if errors is None else "--datasheet-error"
        raise InputError(f"{whose}: all are 0, so that nothing is left to refine")
    units = part.get("units")
    held = {str(k): str(v) for k, v in units.items()} if isinstance(units, Mapping) else {}
    magnitude = own if reference is None else reference
    return Datasheet(
        sensor, standard_error, channel_reference, magnitude, correlation, holds_at_of(part, where=where)
    ), held
