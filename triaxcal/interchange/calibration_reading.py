"""Reading of a calibration document, of any writer: the sensor, its errors, and the
prior of a bias update. Errors name the file and the field.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects import TEMPERATURE, Effect, effect_of
from triaxcal.effects.contract import covariate_of
from triaxcal.errors import InvalidData
from triaxcal.estimate.calibration import Calibration, Origin, ReferenceEpoch, Residual, Unmodelled
from triaxcal.inputs.bias_update import Earlier
from triaxcal.interchange.calibration_document import GROUPS, WEIGHT
from triaxcal.model.samples import Moment
from triaxcal.model.sensor import LINEAR, Sensor
from triaxcal.uncertainty.combined import Source
from triaxcal.units import reference_unit_of

# The errors of a calibration in its document: standard errors and correlations.

ROUNDED = 1e-4
"""Tolerance of correlations: documents round them to a millionth, so the smallest
eigenvalue may be below zero."""


def linear_errors_of(part: Mapping[str, Any], *, where: str) -> Floats:
    """(9,) standard errors of scale factors, misalignments and biases. Raises
    InvalidData."""
    errors = part.get("standard_error")
    out = []
    for name in GROUPS:
        values = _numbers(errors.get(name) if isinstance(errors, Mapping) else None)
        if values.shape != (3,) or not np.all(values >= 0):
            raise InvalidData(f"{where}: standard_error.{name}: expected three numbers of at least 0")
        out.append(values)
    return np.concatenate(out)


def effect_errors_of(part: Mapping[str, Any], sensor: Sensor, *, where: str) -> Floats:
    """(p,) standard errors of the effects' coefficients. Raises InvalidData."""
    out = []
    for effect, _ in sensor.effects:
        for k in effect.coefficients:
            value = _numbers(part["effects"][effect.name][k.name].get("standard_error"))
            if value.shape or not value >= 0:
                name = f"effects.{effect.name}.{k.name}.standard_error"
                raise InvalidData(f"{where}: {name}: expected a number of at least 0")
            out.append(float(value))
    return np.array(out)


def correlation_of(part: Mapping[str, Any], sensor: Sensor, *, where: str) -> Floats | None:
    """The correlation matrix (9+p,9+p) in the order of `Calibration.parameters`; None
    if the document has none. Raises InvalidData.

    Values without a standard error have no correlation: zeros.
    """
    if "correlation" not in part:
        return None
    expected = [f"{name}.{axis}" for name in GROUPS for axis in "xyz"]
    expected += [f"{effect.name}.{k.name}" for effect, _ in sensor.effects for k in effect.coefficients]
    names = part.get("parameters", expected)
    if not isinstance(names, list) or sorted(map(str, names)) != sorted(expected):
        raise InvalidData(f"{where}: parameters: expected the names of all {len(expected)} coefficients")
    matrix = _numbers(part["correlation"])
    n = len(expected)
    sound = matrix.shape == (n, n) and np.all(np.abs(matrix) <= 1 + ROUNDED)
    sound = sound and np.all(np.abs(matrix - matrix.T) <= ROUNDED)
    if not sound or np.linalg.eigvalsh(matrix)[0] < -ROUNDED * n:
        raise InvalidData(f"{where}: correlation: expected a correlation matrix of {n} rows")
    order = [names.index(name) for name in expected]
    return np.asarray(matrix[np.ix_(order, order)])


def _numbers(value: object) -> Floats:
    """The values as an array of finite numbers, else an empty one."""
    try:
        out = np.array(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        return np.zeros(0)
    return out if np.isfinite(out).all() else np.zeros(0)


_WITH_CALIBRATION = ("triaxcal.calibration/1", "triaxcal.loop/1", "triaxcal.certificate/1")


def calibration_part(document: Mapping[str, Any], *, where: str) -> Mapping[str, Any]:
    """The `triaxcal.calibration/1` in a calibration, loop or certificate
    document. Raises InvalidData."""
    inner: Any = document
    for key in ("result", "calibration"):
        if isinstance(inner, Mapping) and isinstance(inner.get(key), Mapping):
            inner = inner[key]
    if not isinstance(inner, Mapping) or inner.get("format") != "triaxcal.calibration/1":
        raise InvalidData(
            f"{where}: format: expected a triaxcal.calibration/1, .loop/1 or .certificate/1 document"
            + ("" if document.get("format") in _WITH_CALIBRATION else but_is(document))
        )
    return inner


def but_is(document: Mapping[str, Any]) -> str:
    """The end of a message: the format that a document names, if it does."""
    name = document.get("format")
    return f", not {name}" if isinstance(name, str) and re.fullmatch(r"[\w.-]{1,40}/\d{1,4}", name) else ""


def reference_unit_in(document: Mapping[str, Any], *, where: str, magnitude: float) -> str:
    """The unit of the reference in a calibration document, else the likely unit for
    its magnitude."""
    units = calibration_part(document, where=where).get("units")
    name = units.get("reference") if isinstance(units, Mapping) else None
    return name if isinstance(name, str) and name else reference_unit_of(magnitude)


def logged_in(document: Mapping[str, Any], *, where: str) -> dict[str, Floats]:
    """The channels (n,) that all used poses of a calibration document have, by the
    name of their covariate."""
    poses = calibration_part(document, where=where).get("poses")
    used = [p for p in poses if isinstance(p, Mapping) and p.get("used", True)] if isinstance(poses, list) else []
    found = [p.get("channels") for p in used]
    rows = [row if isinstance(row, Mapping) else {} for row in found]
    names = [str(n) for n in rows[0] if all(math.isfinite(number_in(row.get(n))) for row in rows)] if rows else []
    return {covariate_of(n): np.array([number_in(row[n]) for row in rows]) for n in names}


def expanded_uncertainty_in(document: Mapping[str, Any], *, where: str) -> float | None:
    """The expanded uncertainty of |a| in the unit of the reference; None if the
    document has none."""
    found: Any = calibration_part(document, where=where)
    for key in ("uncertainty", "magnitude", "expanded_g"):
        found = found.get(key) if isinstance(found, Mapping) else None
    value = number_in(found)
    return value if math.isfinite(value) else None


def _floats(value: Any) -> Floats:
    """An array of JSON numbers. Raises ValueError for other values."""
    found = np.asarray(value)
    if found.dtype.kind not in "iuf":
        raise ValueError(f"{value!r} is no number")
    return found.astype(float)


def sensor_of(document: Mapping[str, Any], *, where: str) -> tuple[Sensor, dict[str, float], float]:
    """Sensor, channel references and reference magnitude of a calibration
    document. Raises InvalidData."""
    part = calibration_part(document, where=where)
    # The values, as far as they are numbers.
    try:
        k, m, b = (_floats(part[name]) for name in ("scale_factor", "misalignment", "bias"))
        effects = []
        for name, entry in part.get("effects", {}).items():
            values = {n: float(_floats(v["value"])) for n, v in entry.items() if n != WEIGHT}
            effect, q = effect_of(name, values)
            missing = [n for n in (*(c.name for c in effect.coefficients), *effect.shape) if n not in entry]
            if missing:
                raise KeyError(f"effects.{name}.{missing[0]}")
            effects.append((effect, q))
        reference = {str(n): float(v) for n, v in part.get("channel_reference", {}).items()}
        magnitude = float(part.get("reference", 1.0))
    except KeyError as e:
        raise InvalidData(f"{where}: {e.args[0]}: missing, or no effect of that name is known") from e
    except (TypeError, ValueError, AttributeError, OverflowError) as e:
        raise InvalidData(f"{where}: not numbers where numbers belong ({e})") from e
    # Their shapes, and the effects of the model.
    if any(v.shape != (3,) or not np.isfinite(v).all() for v in (k, m, b)) or not np.all(k):
        raise InvalidData(
            f"{where}: scale_factor, misalignment, bias: expected three numbers each, none zero in the first"
        )
    listed = part.get("terms")
    terms = set(map(str, listed)) - {"linear"} if isinstance(listed, list) else set()
    if terms and not effects:  # the matrix alone is another calibration
        raise InvalidData(f"{where}: effects: no coefficients of {', '.join(sorted(terms))}, which terms has")
    _require_finite(effects, reference, magnitude, where)
    return Sensor(k, m, b, tuple(effects)), reference, magnitude


def calibration_of(document: Mapping[str, Any], *, where: str) -> Calibration:
    """The calibration in a calibration, loop or certificate document, as the model for
    other poses. Figures of the fit alone are NaN, as is a covariance that the document
    lacks. Raises InvalidData."""
    part = calibration_part(document, where=where)
    sensor, channel_reference, magnitude = sensor_of(document, where=where)
    unknown = math.nan
    return Calibration(
        sensor=sensor,
        covariance=covariance_of(part, sensor, where=where),
        reference=magnitude,
        channel_reference=channel_reference,
        residual=_residual(part),
        poses=(),
        condition=number_in(part.get("condition")),
        dilution=number_in(part.get("dilution")),
        birge_ratio=unknown,
        dof=unknown,
        weights={
            name: w
            for name, entry in part.get("effects", {}).items()
            if math.isfinite(w := number_in(entry.get(WEIGHT)))
        },
        unmodelled=unmodelled_of(part, where=where),
        holds_at=holds_at_of(part, where=where),
    )


def covariance_of(part: Mapping[str, Any], sensor: Sensor, *, where: str) -> Floats:
    """The covariance (p,p) of the parameters; NaN if the document has no standard
    errors. Without a correlation they count as independent. Raises InvalidData."""
    n = 9 + sum(len(q) for _, q in sensor.effects)
    if not isinstance(part.get("standard_error"), Mapping):
        return np.full((n, n), math.nan)
    coefficients = [part["effects"][e.name][k.name] for e, _ in sensor.effects for k in e.coefficients]
    if any(isinstance(v, Mapping) and v.get("standard_error") is None for v in coefficients):
        return np.full((n, n), math.nan)  # the poses determined a combination of coefficients alone
    sigma = np.concatenate([linear_errors_of(part, where=where), effect_errors_of(part, sensor, where=where)])
    correlation = correlation_of(part, sensor, where=where)
    if correlation is None:
        return np.diag(sigma**2)
    return np.asarray(correlation * np.outer(sigma, sigma))


def unmodelled_of(part: Mapping[str, Any], *, where: str) -> Unmodelled | None:
    """The unmodelled part, None if there is none. Raises InvalidData."""
    block = part.get("unmodelled")
    if block is None:
        return None
    known = block if isinstance(block, Mapping) else {}
    along, across = (number_in(known.get(k)) for k in ("along_g", "across_g"))
    if not (0 <= along < math.inf and 0 <= across < math.inf):
        raise InvalidData(f"{where}: unmodelled: expected along_g and across_g, numbers of at least 0")
    return Unmodelled(along, across)


def holds_at_of(part: Mapping[str, Any], *, where: str) -> ReferenceEpoch | None:
    """The reference epoch; None in a document without one, as those of 0.1. Raises
    InvalidData."""
    epoch = part.get("holds_at")
    if epoch is None:
        return None
    try:
        moment, t_s = Moment(epoch["moment"]), float(epoch["t_s"])
        time_s = float(epoch.get("since_middle_s", t_s))
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError):
        t_s = time_s = math.nan
    if not math.isfinite(t_s + time_s):
        raise InvalidData(f"{where}: holds_at: expected a moment (end, mean or seconds) and t_s in seconds")
    return ReferenceEpoch(moment, t_s, time_s)


def _residual(part: Mapping[str, Any]) -> Residual:
    block = part.get("residual")
    found = block if isinstance(block, Mapping) else {}
    optional = ("cross_validated_rms_g", "lack_of_fit_p", "weighted_rms", "reduced_chi2")
    known = {name: None if math.isnan(v := number_in(found.get(name))) else v for name in optional}
    return Residual(
        rms_g=number_in(found.get("rms_g")),
        max_abs_g=number_in(found.get("max_abs_g")),
        noise_floor_g=number_in(found.get("noise_floor_g")),
        **known,
    )


def number_in(value: object) -> float:
    """The number, NaN for any other value."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


def _require_finite(
    effects: Sequence[tuple[Effect, Floats]], reference: Mapping[str, float], magnitude: float, where: str
) -> None:
    """Raises InvalidData. Python's JSON reader accepts NaN."""
    for effect, values in effects:
        if not np.isfinite(values).all():
            raise InvalidData(f"{where}: effects.{effect.name}: expected finite numbers")
        for need in effect.needs:
            if need not in reference:
                raise InvalidData(f"{where}: channel_reference.{need}: missing; the effect {effect.name} needs it")
    for name, value in reference.items():
        if not math.isfinite(value):
            raise InvalidData(f"{where}: channel_reference.{name}: expected a finite number")
    if not 0 < magnitude < math.inf:
        raise InvalidData(f"{where}: reference: expected a positive number")


def uncertainty_over_error(budget: Mapping[str, Any], c: Calibration) -> Floats:
    """(p,) ratios of the standard uncertainties of the parameters in a document's
    ``budget`` to their standard errors; 1 if either is unknown."""
    out = []
    for name, error in zip(c.parameters, c.standard_errors, strict=True):
        expanded, coverage = (_in_budget(budget, key, name) for key in ("expanded", "coverage_factor"))
        out.append(1.0 if expanded is None or not coverage or not error > 0 else expanded / coverage / error)
    return np.array(out)


def _in_budget(budget: Mapping[str, Any], key: str, parameter: str) -> float | None:
    """A figure of the budget for a parameter, None if it is missing."""
    group, _, name = parameter.rpartition(".")
    try:
        figures = budget[key]
        return float(figures[group]["xyz".index(name)] if group in GROUPS else figures["effects"][group][name])
    except (LookupError, TypeError, ValueError):
        return None


# A calibration document as the prior of a bias update (`triaxcal.inputs.bias_update`).


def earlier_in(document: Mapping[str, Any], origin: Origin, *, where: str) -> Earlier:
    """The earlier calibration in a calibration, loop or certificate document. Its
    covariance contains the budget's components in addition to the fit. Raises
    InvalidData."""
    part = calibration_part(document, where=where)
    fitted = calibration_of(part, where=where)
    budget, following = part.get("uncertainty"), part.get("next_recording")
    ratio = uncertainty_over_error(budget if isinstance(budget, Mapping) else {}, fitted)
    predicted = following if isinstance(following, Mapping) else {}
    start_to_start = number_in(predicted.get("start_to_start_g"))
    blind_to, linear = part.get("blind_to"), part.get("linear_only")
    temperature_c = logged_in(part, where=where).get(TEMPERATURE)
    scatter, dof, noise = _scatter(part)
    return Earlier(
        replace(fitted, blind_to=tuple(map(str, blind_to)) if isinstance(blind_to, list) else ()),
        fitted.covariance * np.outer(ratio, ratio),
        scatter_g=scatter,
        residual_dof=dof,
        noise_g=noise,
        start_to_start=start_to_start if start_to_start >= 0 else None,
        measured=predicted.get("source") == Source.MEASURED.value,
        temperatures_c=None if temperature_c is None else (float(temperature_c.min()), float(temperature_c.max())),
        origin=origin,
        linear_only=earlier_in(linear, origin, where=f"{where}: linear_only") if isinstance(linear, Mapping) else None,
    )


def _scatter(part: Mapping[str, Any]) -> tuple[float, float, float]:
    """From the residuals: the excess standard deviation of |a| in a pose, its degrees
    of freedom, and the standard deviation with the noise. An update passes on the
    excess of its earlier calibration, as its few poses determine little of it."""
    residual, updated, poses = (part.get(name) for name in ("residual", "rezero", "poses"))
    figures = residual if isinstance(residual, Mapping) else {}
    used = sum(bool(p.get("used", True)) for p in poses if isinstance(p, Mapping)) if isinstance(poses, list) else 0
    if isinstance(updated, Mapping):
        known, dof = (max(number_in(updated.get(name)), 0.0) for name in ("scatter_g", "scatter_dof"))
        return known, dof, number_in(figures.get("rms_g")) * math.sqrt(used / max(used - 3, 1))
    left = max(used - LINEAR, 0)
    variance = number_in(figures.get("rms_g")) ** 2 * used / left if left else math.nan
    excess = variance - number_in(figures.get("noise_floor_g")) ** 2
    return (math.sqrt(excess) if excess > 0 else 0.0), float(left), math.sqrt(variance)
