"""Units on the faces of a fixture: what goes into their common frame, and the
document that comes out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

import triaxcal as tc
from triaxcald.errors import InputError
from triaxcald.inputs import Measured

ANGLE_DIGITS = 8
GRID_RAD = 1e-12
ROUND_TURN_DEG = 360.0


@dataclass(frozen=True)
class Source:
    """One unit: its recording, the sensor that turns readings into g, and up in
    its poses.

    ``calibration`` is ``own``, or the file that it was read from; ``fitted``
    the calibration in the former case.
    """

    name: str
    measured: Measured
    calibration: str
    sensor: tc.Sensor
    found: tc.frames.Verticals
    output_unit: str
    reference_unit: str
    fitted: tc.estimate.Calibration | None = None
    warnings: tuple[str, ...] = ()


def own_source(
    name: str, measured: Measured, fitted: tc.estimate.Calibration, *, output_unit: str, reference_unit: str
) -> Source:
    """A unit whose calibration was fitted to the recording itself."""
    return Source(
        name,
        measured,
        "own",
        fitted.sensor,
        tc.frames.verticals(fitted),
        output_unit,
        reference_unit,
        fitted,
        tuple(map(tc.text.caution, fitted.cautions)),
    )


def source_under(
    name: str, measured: Measured, document: Mapping[str, Any], *, where: str, output_unit: str, reference_unit: str
) -> Source:
    """A unit with a calibration document. Raises InputError, InvalidData."""
    sensor, channel_reference, reference = tc.interchange.sensor_of(document, where=where)
    covariance, warnings = covariance_of(document, sensor, where=where)
    moment = tc.interchange.holds_at_of(tc.interchange.calibration_part(document, where=where), where=where)
    absurd = f"{where}: its numbers and the readings of {measured.name} give no finite direction of up"
    try:
        with np.errstate(all="ignore"):  # numbers out of a file may be any; what comes of them is judged
            found = tc.frames.verticals_under(
                sensor,
                measured.poses,
                covariance,
                channel_reference=channel_reference,
                reference=reference,
                moment=moment.clocks if moment else None,
            )
    except np.linalg.LinAlgError:
        raise InputError(absurd) from None
    if not (np.isfinite(found.direction).all() and np.isfinite(found.covariance).all()):
        raise InputError(absurd)
    return Source(name, measured, where, sensor, found, output_unit, reference_unit, None, tuple(warnings))


def covariance_of(document: Mapping[str, Any], sensor: tc.Sensor, *, where: str) -> tuple[tc.Floats, list[str]]:
    """(p,p) of the parameters of a calibration document, and warnings. Raises
    InputError."""
    part = tc.interchange.calibration_part(document, where=where)
    if "standard_error" not in part:
        count = 9 + sum(len(c) for _, c in sensor.effects)
        return np.zeros((count, count)), [f"{where} holds no standard errors: the calibration counts as exact"]
    sigma = np.concatenate(
        [tc.interchange.linear_errors_of(part, where=where), tc.interchange.effect_errors_of(part, sensor, where=where)]
    )
    correlation = tc.interchange.correlation_of(part, sensor, where=where)
    if correlation is None:
        return np.diag(sigma**2), [f"{where} holds no correlation: its standard errors count as independent"]
    return correlation * np.outer(sigma, sigma), []


def frame_document(sources: Sequence[Source], frames: tc.frames.Frames) -> tc.interchange.Document:
    units = [_unit(source, unit) for source, unit in zip(sources, frames.units, strict=True)]
    pairs = [(i, j) for i in range(len(units)) for j in range(i + 1, len(units))]
    return {
        "format": "triaxcal.frame/1",
        "datum": frames.datum.name,
        "units": units,
        "between": [_between(sources, frames, i, j) for i, j in pairs],
        "fixture": _fixture(frames.fixture),
        "agreement": {
            "agree": frames.agree,
            "chi2": tc.rounding.uncertainty(frames.chi2) if frames.left else None,
            "degrees_of_freedom": frames.left,
            "p_value": tc.rounding.probability(frames.lack_of_fit_p),
            "inflation": tc.rounding.uncertainty(frames.birge_ratio),
        },
        "warnings": [tc.text.caution(caution) for caution in frames.cautions],
    }


def _angles(values: Any) -> list[Any]:
    """Angles are differences of unit vectors: beyond the grid they differ from
    processor to processor."""
    return tc.rounding.numbers(np.round(np.asarray(values, dtype=float) / GRID_RAD) * GRID_RAD, ANGLE_DIGITS)


def _angle(value: float | None) -> float | None:
    return None if value is None else tc.rounding.number(round(value / GRID_RAD) * GRID_RAD, ANGLE_DIGITS)


def _unit(source: Source, unit: tc.frames.UnitFrame) -> tc.interchange.Document:
    standing, measured = unit.standing, source.measured
    factor = unit.coverage_factor()
    fitted = source.fitted
    return {
        "name": source.name,
        **({"unit": dict(measured.unit)} if measured.unit else {}),
        "recording": measured.name,
        "calibration": source.calibration,
        "terms": ["linear", *(effect.name for effect, _ in source.sensor.effects)],
        "output_unit": source.output_unit,
        "reference_unit": source.reference_unit,
        **(
            {
                "rms_g": tc.rounding.uncertainty(fitted.residual.rms_g),
                "noise_floor_g": tc.rounding.uncertainty(fitted.residual.noise_floor_g),
            }
            if fitted
            else {}
        ),
        "rotation": tc.rounding.numbers(unit.rotation),
        "rotation_vector_rad": _angles(unit.rotation_vector),
        "standard_error_rad": tc.rounding.numbers(unit.standard_error, tc.rounding.UNCERTAINTY_DIGITS),
        "degrees_of_freedom": tc.rounding.numbers(unit.dof, tc.rounding.UNCERTAINTY_DIGITS),
        "coverage_factor": tc.rounding.numbers(factor, tc.rounding.UNCERTAINTY_DIGITS),
        "expanded_rad": tc.rounding.numbers(factor * unit.standard_error, tc.rounding.UNCERTAINTY_DIGITS),
        "covariance_rad2": tc.rounding.numbers(unit.covariance, tc.rounding.UNCERTAINTY_DIGITS),
        "matrix_body": tc.rounding.numbers(unit.rotation @ source.sensor.matrix),
        "centre": tc.rounding.numbers(source.sensor.centre),
        "nearest_axes": _nearest_axes(unit.rotation),
        "mounting_assumed": standing.labelling.assumed,
        "poses": _poses(source, unit),
        "table": _table(unit),
        "seating_error_rad": tc.rounding.uncertainty(standing.seating),
        "seating_degrees_of_freedom": standing.seating_dof,
        "data_quality": list(measured.data_quality),
        "warnings": [*source.warnings, *map(tc.text.caution, (*standing.labelling.cautions, *standing.cautions))],
    }


def _nearest_axes(rotation: tc.Floats) -> list[str]:
    """The body's axis nearest to each of the sensor's."""
    nearest = tc.frames.TURNS[int(np.argmax(np.einsum("tij,ij->t", tc.frames.TURNS, rotation)))]
    return [
        tc.frames.LABELS[int(np.argmax([tc.frames.axis_of(label) @ nearest[:, k] for label in tc.frames.LABELS]))]
        for k in range(3)
    ]


def _poses(source: Source, unit: tc.frames.UnitFrame) -> list[tc.interchange.Document]:
    labelling, found = unit.standing.labelling, source.found
    out = []
    for i, pose in enumerate(found.poses):
        label, heading = labelling.labels[i], labelling.headings[i]
        up = unit.rotation @ found.direction[i]
        off = float(np.linalg.norm(np.cross(tc.frames.axis_of(label), up))) if label else None
        out.append(
            {
                "start_s": tc.rounding.number(pose.start_s),
                "end_s": tc.rounding.number(pose.end_s),
                "label": label,
                "heading_deg": None
                if heading is None
                else tc.rounding.number(float(np.degrees(heading)) % ROUND_TURN_DEG),
                "up": _angles(up),
                "from_face_rad": _angle(off),
                "used": bool(found.used[i]),
            }
        )
    return out


def _table(unit: tc.frames.UnitFrame) -> tc.interchange.Document:
    standing = unit.standing
    table = standing.table
    ends = [np.radians(1.0) / 2 * t.magnitude for t in standing.tilts if t.resolved]
    return {
        "tilt_rad": _angle(table.tilt),
        "standard_error_rad": tc.rounding.uncertainty(table.standard_error),
        "source": table.source,
        "shows": table.shows,
        "p_value": tc.rounding.probability(table.p_value),
        "up": None if table.vector is None else _angles(table.vector),
        "turn_remainder_rad_per_deg": tc.rounding.uncertainty(max(ends)) if ends else None,
        "faces": [
            {
                "label": t.label,
                "resolved": t.resolved,
                "poses": len(t.poses),
                "tilt_rad": _angles(unit.rotation @ standing.basis[k] @ t.tilt) if t.resolved else None,
                "magnitude_rad": _angle(t.magnitude) if t.resolved else None,
                "standard_error_rad": tc.rounding.uncertainty(t.standard_error) if t.resolved else None,
            }
            for k, t in enumerate(standing.tilts)
        ],
    }


def _between(sources: Sequence[Source], frames: tc.frames.Frames, i: int, j: int) -> tc.interchange.Document:
    vector, covariance = frames.between(i, j)
    return {
        "from": sources[i].name,
        "to": sources[j].name,
        "rotation": tc.rounding.numbers(frames.units[j].rotation.T @ frames.units[i].rotation),
        "rotation_vector_rad": _angles(vector),
        "standard_error_rad": tc.rounding.numbers(
            np.sqrt(np.maximum(np.diag(covariance), 0.0)), tc.rounding.UNCERTAINTY_DIGITS
        ),
    }


def _fixture(fixture: tc.frames.Fixture) -> tc.interchange.Document:
    def quantity(q: tc.frames.Quantity) -> tc.interchange.Document:
        return {"value": _angle(q.value), "standard_error": tc.rounding.uncertainty(q.standard_error)}

    return {
        "faces": [
            {
                "face": tc.frames.opposite(label),
                "up": label,
                "normal": _angles(-fixture.up[k]),
                "error_rad": _angles(-fixture.error[k]),
                "standard_error_rad": tc.rounding.numbers(
                    np.where(fixture.standard_error[k] > GRID_RAD, fixture.standard_error[k], 0.0),
                    tc.rounding.UNCERTAINTY_DIGITS,
                ),
            }
            for k, label in enumerate(fixture.faces)
        ],
        "independent_errors": 2 * len(fixture.faces) - 3,
        "squareness_rad": {axes: quantity(q) for axes, q in fixture.squareness.items()},
        "parallelism_rad": {axis: [quantity(q) for q in both] for axis, both in fixture.parallelism.items()},
        "datum_standard_error_rad": None
        if fixture.offset is None
        else tc.rounding.numbers(fixture.offset, tc.rounding.UNCERTAINTY_DIGITS),
    }
