"""`triaxcal.poses/1` and `triaxcal.calibration/1`: the JSON documents that others
script against.

A method other than still poses adds its results under a key of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from triaxcal import text
from triaxcal.arrays import Floats
from triaxcal.estimate.calibration import (
    BiasUpdate,
    Calibration,
    Exclusion,
    PoseResult,
    ReferenceEpoch,
    Residual,
    Unmodelled,
)
from triaxcal.inputs.attitude import AttitudeFit
from triaxcal.inputs.datasheet import Refinement
from triaxcal.inputs.rotation import RotationFit
from triaxcal.poses.pose import Pose
from triaxcal.rounding import (
    UNCERTAINTY_DIGITS,
    chance,
    correlation,
    direction,
    error,
    in_standard_errors,
    number,
    numbers,
    probability,
    uncertainty,
)
from triaxcal.uncertainty import Budget, Stated, budget
from triaxcal.uncertainty.combined import NextRecording, Scopes, next_recording
from triaxcal.uncertainty.statements import Basis, UnmodelledTemperature
from triaxcal.units import ErrorUnit, grouped, in_units_of

Document = dict[str, Any]
GROUPS = ("scale_factor", "misalignment", "bias")
WEIGHT = "weight"
"""The key of an effect's weight in a model average, next to its coefficients."""
_LEFT_OUT = {Exclusion.OUTLIER: "spoiled", Exclusion.CALLER: "caller", Exclusion.UNKNOWN_HISTORY: "unknown_history"}
"""The values of documents of 0.1, next to ``excluded``; else the name of the fault."""


def poses_document(poses: Sequence[Pose]) -> Document:
    """`triaxcal.poses/1`."""
    return {
        "format": "triaxcal.poses/1",
        "poses": [
            {
                "start_s": number(p.start_s),
                "end_s": number(p.end_s),
                "samples": p.samples,
                "mean": numbers(p.mean),
                "standard_error": numbers(p.standard_error, UNCERTAINTY_DIGITS),
                "channels": {name: number(v) for name, v in p.channels.items()},
            }
            for p in poses
        ],
    }


def residual_document(residual: Residual, reference: float = 1.0) -> Document:
    """The residual block, rounded for the magnitude of the reference."""
    return {
        "rms_g": error(residual.rms_g, reference),
        "max_abs_g": error(residual.max_abs_g, reference),
        "cross_validated_rms_g": error(residual.cross_validated_rms_g, reference),
        "noise_floor_g": error(residual.noise_floor_g, reference),
        "lack_of_fit_p": probability(residual.lack_of_fit_p),
        "weighted_rms": in_standard_errors(residual.weighted_rms),
        "reduced_chi2": in_standard_errors(residual.reduced_chi2),
    }


def coefficients_document(coefficients: Mapping[str, tuple[float, float | None, str]], reference_unit: str) -> Document:
    """The coefficients of one effect; null for an undetermined standard error."""
    return {
        name: {
            "value": number(value),
            "standard_error": None if deviation is None else uncertainty(deviation),
            "unit": in_units_of(unit, reference_unit),
        }
        for name, (value, deviation, unit) in coefficients.items()
    }


def holds_of(c: Calibration) -> list[str]:
    """The conditions, in words, under which scale factor, misalignment and bias are the
    whole model; empty without effects."""
    several = any(p.pose.run.of > 1 for p in c.poses)
    return list(text.holds([effect for effect, _ in c.sensor.effects], c.channel_reference, several=several))


def calibration_document(
    c: Calibration,
    *,
    output_unit: str = "",
    reference_unit: str = "g",
    stated: Stated | None = None,
    budgeted: bool = True,
) -> Document:
    """`triaxcal.calibration/1`.

    ``reference_unit`` names the unit of the reference vector; keys keep their ``_g``
    in any unit. ``stated`` has uncertainties that no recording shows. ``budgeted`` adds
    the budget, which exists for a fit to still poses."""
    errors = dict(zip(c.parameters, c.standard_errors, strict=True))
    evaluated = budget(c, stated) if budgeted else None

    def group(name: str) -> list[Any]:
        return numbers([errors[f"{name}.{axis}"] for axis in "xyz"], UNCERTAINTY_DIGITS)

    def linear_only(linear: Calibration) -> Document:
        return calibration_document(linear, output_unit=output_unit, reference_unit=reference_unit, stated=stated)

    return {
        "format": "triaxcal.calibration/1",
        "terms": list(c.terms),
        "units": _units(output_unit, reference_unit),
        "reference": number(c.reference),
        "channel_reference": {name: number(v) for name, v in c.channel_reference.items()},
        "holds_at": _holds_at(c.holds_at),
        "holds": holds_of(c),
        "scale_factor": numbers(c.sensor.scale_factor),
        "misalignment": numbers(c.sensor.misalignment),
        "bias": numbers(c.sensor.bias),
        "use": text.use([effect for effect, _ in c.sensor.effects], linear_only=c.linear_only is not None),
        "matrix": numbers(c.sensor.matrix),
        "centre": numbers(c.sensor.centre),
        "effects": {
            effect.name: coefficients_document(c.coefficients_of(effect.name), reference_unit)
            | ({WEIGHT: chance(c.weights[effect.name])} if effect.name in c.weights else {})
            for effect, _ in c.sensor.effects
        },
        "standard_error": {name: group(name) for name in GROUPS},
        "parameters": list(c.parameters),
        "correlation": correlation(c.covariance),
        **({} if c.unmodelled is None else {"unmodelled": _unmodelled(c.unmodelled)}),
        **({"uncertainty": budget_document(c, evaluated, reference_unit)} if evaluated else {}),
        "next_recording": None if evaluated is None else next_recording_document(next_recording(c, evaluated)),
        **({} if evaluated is None else {"expanded_uncertainty_g": _scopes(c, evaluated)}),
        "residual": residual_document(c.residual, c.reference),
        "poses": _poses(c),
        "trends": c.slopes,
        "condition": uncertainty(c.condition),
        "dilution": uncertainty(c.dilution),
        "blind_to": list(c.blind_to),
        "warnings": [text.caution(caution) for caution in c.cautions],
        **({} if c.linear_only is None else {"linear_only": linear_only(c.linear_only)}),
        **({} if c.update is None else _rezero(c.update, len(c.poses), c.reference)),
    }


def _rezero(update: BiasUpdate, poses: int, reference: float) -> Document:
    earlier = update.earlier
    return {
        "rezero": {
            "before": residual_document(update.before, reference),
            "shift": numbers(update.shift),
            "expected_shift": numbers(update.shift_error, UNCERTAINTY_DIGITS),
            "scatter_g": uncertainty(update.scatter_g),
            "scatter_dof": uncertainty(update.scatter_dof),
        },
        "origin": {
            "calibration": {"name": earlier.calibration or None, "sha256": earlier.sha256},
            "recording": {"name": earlier.recording or None},
            "poses": poses,
        },
    }


def _units(output_unit: str, reference_unit: str) -> Document:
    return {
        "output": output_unit,
        "reference": reference_unit,
        "scale_factor": f"{output_unit or 'output'}/{grouped(reference_unit)}",
        "misalignment": "rad",
        "bias": reference_unit,
    }


def _poses(c: Calibration) -> list[Document]:
    out = [_pose_result(p, c.reference) for p in c.poses]
    if c.update is not None:
        for pose, before in zip(out, c.update.before_residual_g, strict=True):
            pose["before_residual_g"] = error(float(before), c.reference)
    return out


def _pose_result(p: PoseResult, reference: float) -> Document:
    return {
        "start_s": number(p.pose.start_s),
        "end_s": number(p.pose.end_s),
        "mean": numbers(p.pose.mean),
        "direction": direction(p.direction),
        "residual_g": error(p.residual_g, reference),
        "standard_error_g": uncertainty(p.standard_error_g),
        "studentized": in_standard_errors(p.studentized),
        "leverage": uncertainty(p.leverage),
        "used": p.used,
        "excluded": p.excluded,
        **({} if p.outlier_probability is None else {"outlier_probability": chance(p.outlier_probability)}),
        **({"left_out": _LEFT_OUT.get(p.excluded, p.pose.fault)} if p.excluded else {}),
        "channels": {name: number(v) for name, v in p.pose.channels.items()},
    }


def _scopes(c: Calibration, evaluated: Budget) -> Document:
    """Expanded uncertainties of |a|, by the readings for which they hold."""
    scopes = Scopes.of(c, evaluated, next_recording(c, evaluated))
    return {name.replace("'", "").replace(" ", "_"): uncertainty(value) for name, value in scopes.named.items()}


def _unmodelled(part: Unmodelled) -> Document:
    """Uncertainty in addition to the standard errors and their correlation."""
    return {"along_g": uncertainty(part.along), "across_g": uncertainty(part.across)}


def _holds_at(moment: ReferenceEpoch | None) -> Document | None:
    if moment is None:
        return None
    clock = {} if moment.time_s == moment.t_s else {"since_middle_s": number(moment.time_s)}
    return {"moment": moment.moment.value, "t_s": number(moment.t_s), **clock}


def next_recording_document(following: NextRecording) -> Document:
    return {
        "expanded_uncertainty_g": uncertainty(following.expanded_uncertainty),
        "start_to_start_g": uncertainty(following.start_to_start),
        "source": following.source.value,
    }


def by_parameter(c: Calibration, values: Sequence[Any]) -> Document:
    """Values in the order of `Calibration.parameters`, in the groups of a document."""
    by_name = dict(zip(c.parameters, values, strict=True))
    groups: Document = {name: [by_name[f"{name}.{axis}"] for axis in "xyz"] for name in GROUPS}
    effects = {e.name: {k.name: by_name[f"{e.name}.{k.name}"] for k in e.coefficients} for e, _ in c.sensor.effects}
    return groups | ({"effects": effects} if effects else {})


def budget_document(c: Calibration, b: Budget, reference_unit: str = "g") -> Document:
    """Expanded uncertainties and their components; the lines of the budget have
    standard uncertainties."""

    def by_name(values: Floats) -> Document:
        return by_parameter(c, [uncertainty(float(v)) for v in values])

    magnitude, small = b.magnitude, ErrorUnit.of(reference_unit, c.reference)
    return {
        "level": b.parameters.level,
        "expanded": by_name(b.parameters.expanded),
        "coverage_factor": by_name(b.parameters.coverage),
        "magnitude": {
            "standard_g": uncertainty(float(magnitude.standard)),
            "coverage_factor": uncertainty(float(magnitude.coverage)),
            "expanded_g": uncertainty(float(magnitude.expanded)),
        },
        "budget": [
            {
                "source": line.source,
                "evaluation": line.evaluation,
                "degrees_of_freedom": uncertainty(line.dof),
                **by_name(line.parameters),
                "magnitude_g": uncertainty(line.magnitude),
                "share": uncertainty(b.share(line)),
                "how": text.basis(line.basis),
                **({"assumes": list(effects)} if (effects := assumed_in(line.basis)) else {}),
            }
            for line in b.components
        ],
        "dominant": b.dominant.source,
        "halved_by": text.remedy(b.dominant.halved_by, small.figure),
        "magnitude_if_halved_g": uncertainty(b.magnitude_if_halved),
        "not_evaluated": [text.not_evaluated(source, small.figure) for source in b.not_evaluated],
    }


def assumed_in(basis: Basis) -> tuple[str, ...]:
    """The effects with an assumed size in a component of the budget
    (`triaxcal.uncertainty.Component`)."""
    return basis.effects if isinstance(basis, UnmodelledTemperature) and not basis.stated else ()


# Documents of calibrations by other methods than still poses of unknown attitude.


def turning_document(found: RotationFit, *, output_unit: str, reference_unit: str) -> Document:
    """A calibration from a turning unit."""
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
    """A calibration from known attitudes."""
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
            name: numbers(found.noise_error[3 * i : 3 * i + 3], UNCERTAINTY_DIGITS) for i, name in enumerate(GROUPS)
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
        **{name: numbers(getattr(c.sensor, name)) for name in GROUPS},
        "standard_error": {
            name: numbers(c.standard_errors[3 * i : 3 * i + 3], UNCERTAINTY_DIGITS) for i, name in enumerate(GROUPS)
        },
        "rotation": numbers(found.rotation),
        "rotation_standard_error_rad": numbers(found.rotation_error_rad, UNCERTAINTY_DIGITS),
        "residual": residual_document(c.residual, c.reference),
    }


def datasheet_document(found: Refinement, *, output_unit: str, reference_unit: str) -> Document:
    """A refinement of datasheet values."""
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
