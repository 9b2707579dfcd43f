"""What the page needs of a `triaxcal.calibration/1` or `triaxcal.loop/1`, read without trust.

Nothing in a document is required: a report on a refused or damaged result must still come out, with a dash
where a value is missing.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from triaxcald.report.figures import clean, effect_title, number

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Residual:
    """Errors of the magnitude in g, and the probability that pure noise leaves as much."""

    rms_g: float | None = None
    max_abs_g: float | None = None
    cross_validated_rms_g: float | None = None
    noise_floor_g: float | None = None
    lack_of_fit_p: float | None = None


@dataclass(frozen=True)
class Stage:
    """The model at one step of the loop: its errors and, where known, the residual of every pose in g."""

    label: str
    residual: Residual
    held_out_rms_g: float | None = None
    pose_residual_g: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Coefficient:
    name: str
    value: float | None
    standard_error: float | None
    unit: str


@dataclass(frozen=True)
class Pose:
    """`direction` is the unit vector of up in the sensor's frame; `mean` in output units."""

    number: int
    start_s: float | None
    end_s: float | None
    mean: Vector | None
    direction: Vector | None
    before_residual_g: float | None
    residual_g: float | None
    studentized: float | None
    leverage: float | None
    used: bool

    @property
    def middle_s(self) -> float | None:
        return None if self.start_s is None or self.end_s is None else 0.5 * (self.start_s + self.end_s)


@dataclass(frozen=True)
class Finding:
    effect: str
    verdict: str
    in_model: bool
    p_value: float | None
    coefficients: tuple[Coefficient, ...]
    alternatives: tuple[str, ...]
    reason: str | None
    remedy: str | None


@dataclass(frozen=True)
class Unexplained:
    significant: bool
    p_value: float | None
    rms_g: float | None
    lead: str | None


@dataclass(frozen=True)
class HeldOut:
    before_rms_g: float | None
    after_rms_g: float | None
    noise_floor_g: float | None
    poses: int | None


@dataclass(frozen=True)
class Outcome:
    """Everything the page shows of one document. `stages` run from the plain model to the final one;
    `searched` tells a loop, which looked for effects, from a fit, which did not.
    """

    refused: str | None
    searched: bool
    stages: tuple[Stage, ...]
    held_out: HeldOut | None
    findings: tuple[Finding, ...]
    unexplained: Unexplained | None
    linear: tuple[Coefficient, ...]
    effects: tuple[tuple[str, tuple[Coefficient, ...]], ...]
    matrix: tuple[Vector, ...] | None
    centre: Vector | None
    output_unit: str
    reference_unit: str
    poses: tuple[Pose, ...]
    condition: float | None
    blind_to: tuple[str, ...]
    warnings: tuple[str, ...]
    data_quality: tuple[str, ...]
    advice: tuple[str, ...]
    limits: Mapping[str, float | None]

    @property
    def final(self) -> Residual:
        return self.stages[-1].residual if self.stages else Residual()

    @property
    def poses_used(self) -> int:
        return sum(pose.used for pose in self.poses)


def read_document(document: Mapping[str, object]) -> Outcome:
    """The outcome that `document` describes; whatever is missing or of the wrong kind counts as missing."""
    looped = str(document.get("format", "")).startswith("triaxcal.loop/")
    calibration = mapping(document.get("calibration")) if looped else document
    matrix, centre = _matrix(calibration.get("matrix")), vector(calibration.get("centre"))
    poses = tuple(_poses(calibration, matrix, centre))
    held_out = _held_out(document)
    effects = mapping(calibration.get("effects"))
    terms = {*texts(calibration.get("terms")), *effects}
    units = calibration.get("units")
    return Outcome(
        refused=_refusal(document, calibration),
        searched=looped,
        stages=_stages(document, calibration, poses, held_out),
        held_out=held_out,
        findings=tuple(_findings(document.get("findings"), terms)),
        unexplained=_unexplained(document.get("unexplained")),
        linear=tuple(_linear(calibration, units)),
        effects=tuple((name, _coefficients(values)) for name, values in effects.items()),
        matrix=matrix,
        centre=centre,
        output_unit=_output_unit(units),
        reference_unit=str(mapping(units).get("reference") or "g"),
        poses=poses,
        condition=number(calibration.get("condition")),
        blind_to=texts(calibration.get("blind_to")),
        warnings=texts(calibration.get("warnings")),
        data_quality=texts(document.get("data_quality")),
        advice=texts(document.get("advice")),
        limits={name: number(value) for name, value in mapping(document.get("limits")).items()},
    )


def mapping(value: object) -> Mapping[str, object]:
    return value if isinstance(value, Mapping) else {}


def texts(value: object) -> tuple[str, ...]:
    """A list of sentences or names; an entry with keys becomes `key: value; key: value`."""
    entries = value if isinstance(value, (list, tuple)) else [] if value is None else [value]
    return tuple(_words(entry) for entry in entries if entry is not None)


def vector(value: object) -> Vector | None:
    """Three finite numbers, or None."""
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) != 3:
        return None
    x, y, z = (number(component) for component in value)
    return None if x is None or y is None or z is None else (x, y, z)


def _words(entry: object) -> str:
    if isinstance(entry, Mapping):
        return "; ".join(f"{key}: {value}" for key, value in entry.items())
    return str(entry)


def _matrix(value: object) -> tuple[Vector, ...] | None:
    rows = [vector(row) for row in value] if isinstance(value, (list, tuple)) else []
    complete = tuple(row for row in rows if row is not None)
    return complete if len(rows) == len(complete) == 3 else None


def _output_unit(units: object) -> str:
    if isinstance(units, str):
        return units
    known = mapping(units)
    return str(known.get("output") or known.get("centre") or "output unit")


def _refusal(document: Mapping[str, object], calibration: Mapping[str, object]) -> str | None:
    if document.get("refused"):
        return _words(document["refused"])
    if vector(calibration.get("scale_factor")) is None:
        return "The document holds no calibration."
    return None


def _residual(value: object) -> Residual | None:
    known = mapping(value)
    return Residual(*(number(known.get(field.name)) for field in fields(Residual))) if known else None


def _unexplained(value: object) -> Unexplained | None:
    known = mapping(value)
    if not known:
        return None
    lead = known.get("lead")
    return Unexplained(
        bool(known.get("significant")),
        number(known.get("p_value")),
        number(known.get("rms_g")),
        None if lead is None else _words(lead),
    )


def _held_out(document: Mapping[str, object]) -> HeldOut | None:
    known = mapping(document.get("held_out"))
    if not known:
        return None
    poses = number(known.get("poses"))
    return HeldOut(
        number(known.get("before_rms_g")),
        number(known.get("after_rms_g")),
        number(known.get("noise_floor_g")),
        None if poses is None else int(poses),
    )


def _findings(value: object, terms: set[str]) -> Iterator[Finding]:
    for entry in value if isinstance(value, (list, tuple)) else []:
        known = mapping(entry)
        effect = str(known.get("effect", ""))
        reason, remedy = known.get("reason"), known.get("remedy")
        yield Finding(
            effect=effect,
            verdict=str(known.get("verdict", "")),
            in_model=effect in terms,
            p_value=number(known.get("p_value")),
            coefficients=_coefficients(known.get("coefficients")),
            alternatives=texts(known.get("alternatives")),
            reason=None if reason is None else _words(reason),
            remedy=None if remedy is None else _words(remedy),
        )


def _coefficients(value: object) -> tuple[Coefficient, ...]:
    def one(name: str, entry: object) -> Coefficient:
        known = mapping(entry) if isinstance(entry, Mapping) else {"value": entry}
        unit = str(known.get("unit") or "")
        return Coefficient(str(name), number(known.get("value")), number(known.get("standard_error")), unit)

    return tuple(one(name, entry) for name, entry in mapping(value).items())


def _linear(calibration: Mapping[str, object], units: object) -> Iterator[Coefficient]:
    errors, known_units = mapping(calibration.get("standard_error")), mapping(units)
    usual = {"scale_factor": f"{_output_unit(units)}/g", "misalignment": "rad", "bias": "g"}
    for name, symbol in (("scale_factor", "k"), ("misalignment", "α"), ("bias", "b")):
        values, value_errors = vector(calibration.get(name)), vector(errors.get(name))
        for i, axis in enumerate("xyz"):
            yield Coefficient(
                f"{effect_title(name)} {axis} ({symbol}{axis})",
                None if values is None else values[i],
                None if value_errors is None else value_errors[i],
                str(known_units.get(name) or usual[name]),
            )


def _poses(
    calibration: Mapping[str, object], matrix: tuple[Vector, ...] | None, centre: Vector | None
) -> Iterator[Pose]:
    entries = calibration.get("poses")
    for i, entry in enumerate(entries if isinstance(entries, (list, tuple)) else [], start=1):
        known = mapping(entry)
        mean = vector(known.get("mean"))
        yield Pose(
            number=i,
            mean=mean,
            direction=vector(known.get("direction")) or _direction(mean, matrix, centre),
            used=known.get("used") is None or bool(known["used"]),
            **{
                name: number(known.get(name))
                for name in ("start_s", "end_s", "before_residual_g", "residual_g", "studentized", "leverage")
            },
        )


def _direction(mean: Vector | None, matrix: tuple[Vector, ...] | None, centre: Vector | None) -> Vector | None:
    if mean is None or matrix is None or centre is None:
        return None
    up = np.asarray(matrix) @ (np.asarray(mean) - np.asarray(centre))
    length = float(np.linalg.norm(up))
    return None if length == 0.0 else vector((up / length).tolist())


def _stages(
    document: Mapping[str, object],
    calibration: Mapping[str, object],
    poses: tuple[Pose, ...],
    held_out: HeldOut | None,
) -> tuple[Stage, ...]:
    """Before, after each adopted effect whose finding carries a `residual`, and after the last one."""
    after = _residual(document.get("after")) or _residual(calibration.get("residual"))
    before = _residual(document.get("before"))
    last = Stage(
        "After" if before else "This model",
        after or Residual(),
        held_out.after_rms_g if held_out else None,
        _series([pose.residual_g for pose in poses]),
    )
    if before is None:
        return (last,) if after else ()
    first = Stage(
        "Before",
        before,
        held_out.before_rms_g if held_out else None,
        _series([pose.before_residual_g for pose in poses]),
    )
    if after is None:
        return (first,)
    if before == after:
        return (Stage("This model", after, last.held_out_rms_g, last.pose_residual_g),)
    return (first, *_steps(document.get("findings"), len(poses)), last)


def _steps(findings: object, pose_count: int) -> Iterator[Stage]:
    adopted = [
        known
        for known in map(mapping, findings if isinstance(findings, (list, tuple)) else [])
        if known.get("verdict") == "adopted"
    ]
    for known in adopted[:-1]:
        residual, per_pose = _residual(known.get("residual")), known.get("pose_residual_g")
        series = _series([number(value) for value in per_pose]) if isinstance(per_pose, list) else None
        if residual:
            label = clean("+ " + effect_title(str(known.get("effect", ""))).lower())
            yield Stage(label, residual, None, series if series is None or series.size == pose_count else None)


def _series(values: Sequence[float | None]) -> NDArray[np.float64] | None:
    """Residuals as an array with NaN for a missing one; None when all are missing."""
    array = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    return None if array.size == 0 or bool(np.isnan(array).all()) else array
