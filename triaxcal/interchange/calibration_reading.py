"""A calibration document of any writer as values: the sensor, its errors, and what is
known of the unit before a later recording. Errors name the file and the field.
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

# The errors of a calibration as its document holds them: standard errors, and how
# they go together.

ROUNDED = 1e-4
"""Documents round correlations to a millionth, so that the smallest eigenvalue
may come out below zero."""


def linear_errors_of(part: Mapping[str, Any], *, where: str) -> Floats:
    """(9,) standard errors of scale factors, misalignments and biases. Raises
    InvalidData."""
    held = part.get("standard_error")
    out = []
    for name in GROUPS:
        values = _numbers(held.get(name) if isinstance(held, Mapping) else None)
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
    """(9+p,9+p) in the order of `Calibration.parameters`; None where the
    document has none. Raises InvalidData.

    Values without a standard error go with nothing: zeros.
    """
    if "correlation" not in part:
        return None
    expected = [f"{name}.{axis}" for name in GROUPS for axis in "xyz"]
    expected += [f"{effect.name}.{k.name}" for effect, _ in sensor.effects for k in effect.coefficients]
    names = part.get("parameters", expected)
    if not isinstance(names, list) or sorted(map(str, names)) != sorted(expected):
        raise InvalidData(f"{where}: parameters: expected the names of all {len(expected)} coefficients")
    held = _numbers(part["correlation"])
    n = len(expected)
    sound = held.shape == (n, n) and np.all(np.abs(held) <= 1 + ROUNDED) and np.all(np.abs(held - held.T) <= ROUNDED)
    if not sound or np.linalg.eigvalsh(held)[0] < -ROUNDED * n:
        raise InvalidData(f"{where}: correlation: expected a correlation matrix of {n} rows")
    order = [names.index(name) for name in expected]
    return np.asarray(held[np.ix_(order, order)])


def _numbers(value: object) -> Floats:
    """Finite numbers, an empty array where they are none."""
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
    """For the end of a message: which format a document has, where it says."""
    named = document.get("format")
    return f", not {named}" if isinstance(named, str) and re.fullmatch(r"[\w.-]{1,40}/\d{1,4}", named) else ""


def reference_unit_in(document: Mapping[str, Any], *, where: str, magnitude: float) -> str:
    """The unit of the reference that a calibration document says, or what it
    must be by its magnitude."""
    units = calibration_part(document, where=where).get("units")
    said = units.get("reference") if isinstance(units, Mapping) else None
    return said if isinstance(said, str) and said else reference_unit_of(magnitude)


def logged_in(document: Mapping[str, Any], *, where: str) -> dict[str, Floats]:
    """The channels of the poses of a calibration document that were used, (n,)
    each, as covariates are named; none that one of these lacks."""
    poses = calibration_part(document, where=where).get("poses")
    used = [p for p in poses if isinstance(p, Mapping) and p.get("used", True)] if isinstance(poses, list) else []
    found = [p.get("channels") for p in used]
    rows = [row if isinstance(row, Mapping) else {} for row in found]
    names = [str(n) for n in rows[0] if all(math.isfinite(number_in(row.get(n))) for row in rows)] if rows else []
    return {covariate_of(n): np.array([number_in(row[n]) for row in rows]) for n in names}


def expanded_uncertainty_in(document: Mapping[str, Any], *, where: str) -> float | None:
    """Of |a|, in the unit of the reference; None where the document has none."""
    found: Any = calibration_part(document, where=where)
    for key in ("uncertainty", "magnitude", "expanded_g"):
        found = found.get(key) if isinstance(found, Mapping) else None
    value = number_in(found)
    return value if math.isfinite(value) else None


def _floats(value: Any) -> Floats:
    """Raises ValueError for what is no number in JSON."""
    found = np.asarray(value)
    if found.dtype.kind not in "iuf":
        raise ValueError(f"{value!r} is no number")
    return found.astype(float)


def sensor_of(document: Mapping[str, Any], *, where: str) -> tuple[Sensor, dict[str, float], float]:
    """Sensor, channel references and reference magnitude of a calibration
    document. Raises InvalidData."""
    part = calibration_part(document, where=where)
    try:
        k, m, b = (_floats(part[name]) for name in ("scale_factor", "misalignment", "bias"))
        effects = []
        for name, held in part.get("effects", {}).items():
            values = {n: float(_floats(v["value"])) for n, v in held.items() if n != WEIGHT}
            effect, q = effect_of(name, values)
            lacking = [n for n in (*(c.name for c in effect.coefficients), *effect.shape) if n not in held]
            if lacking:
                raise KeyError(f"effects.{name}.{lacking[0]}")
            effects.append((effect, q))
        reference = {str(n): float(v) for n, v in part.get("channel_reference", {}).items()}
        magnitude = float(part.get("reference", 1.0))
    except KeyError as e:
        raise InvalidData(f"{where}: {e.args[0]}: missing, or no effect of that name is known") from e
    except (TypeError, ValueError, AttributeError, OverflowError) as e:
        raise InvalidData(f"{where}: not numbers where numbers belong ({e})") from e
    if any(v.shape != (3,) or not np.isfinite(v).all() for v in (k, m, b)) or not np.all(k):
        raise InvalidData(
            f"{where}: scale_factor, misalignment, bias: expected three numbers each, none zero in the first"
        )
    named = part.get("terms")
    terms = set(map(str, named)) - {"linear"} if isinstance(named, list) else set()
    if terms and not effects:  # without its effects a matrix is another calibration
        raise InvalidData(f"{where}: effects: no coefficients of {', '.join(sorted(terms))}, which terms has")
    _require_finite(effects, reference, magnitude, where)
    return Sensor(k, m, b, tuple(effects)), reference, magnitude


def calibration_of(document: Mapping[str, Any], *, where: str) -> Calibration:
    """The calibration in a calibration, loop or certificate document, as the
    model of other poses. What only its fit could tell is not a number, and so
    is a covariance that the document does not hold. Raises InvalidData."""
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
            name: w for name, held in part.get("effects", {}).items() if math.isfinite(w := number_in(held.get(WEIGHT)))
        },
        unmodelled=unmodelled_of(part, where=where),
        holds_at=holds_at_of(part, where=where),
    )


def covariance_of(part: Mapping[str, Any], sensor: Sensor, *, where: str) -> Floats:
    """(p,p) of the parameters; not numbers where the document has no standard
    errors. Without a correlation they count as independent. Raises
    InvalidData."""
    n = 9 + sum(len(q) for _, q in sensor.effects)
    if not isinstance(part.get("standard_error"), Mapping):
        return np.full((n, n), math.nan)
    held = [part["effects"][e.name][k.name] for e, _ in sensor.effects for k in e.coefficients]
    if any(isinstance(v, Mapping) and v.get("standard_error") is None for v in held):
        return np.full((n, n), math.nan)  # only a combination of coefficients is known
    sigma = np.concatenate([linear_errors_of(part, where=where), effect_errors_of(part, sensor, where=where)])
    correlation = correlation_of(part, sensor, where=where)
    if correlation is None:
        return np.diag(sigma**2)
    return np.asarray(correlation * np.outer(sigma, sigma))


def unmodelled_of(part: Mapping[str, Any], *, where: str) -> Unmodelled | None:
    """Raises InvalidData."""
    held = part.get("unmodelled")
    if held is None:
        return None
    along, across = (number_in(held.get(k)) if isinstance(held, Mapping) else math.nan for k in ("along_g", "across_g"))
    if not (0 <= along < math.inf and 0 <= across < math.inf):
        raise InvalidData(f"{where}: unmodelled: expected along_g and across_g, numbers of at least 0")
    return Unmodelled(along, across)


def holds_at_of(part: Mapping[str, Any], *, where: str) -> ReferenceEpoch | None:
    """None where the document, as those of 0.1, does not say. Raises
    InvalidData."""
    held = part.get("holds_at")
    if held is None:
        return None
    try:
        moment, t_s = Moment(held["moment"]), float(held["t_s"])
        time_s = float(held.get("since_middle_s", t_s))
    except (LookupError, TypeError, ValueError, AttributeError, OverflowError):
        t_s = time_s = math.nan
    if not math.isfinite(t_s + time_s):
        raise InvalidData(f"{where}: holds_at: expected a moment (end, mean or seconds) and t_s in seconds")
    return ReferenceEpoch(moment, t_s, time_s)


def _residual(part: Mapping[str, Any]) -> Residual:
    held = part.get("residual")
    found = held if isinstance(held, Mapping) else {}
    optional = ("cross_validated_rms_g", "lack_of_fit_p", "weighted_rms", "reduced_chi2")
    known = {name: None if math.isnan(v := number_in(found.get(name))) else v for name in optional}
    return Residual(
        rms_g=number_in(found.get("rms_g")),
        max_abs_g=number_in(found.get("max_abs_g")),
        noise_floor_g=number_in(found.get("noise_floor_g")),
        **known,
    )


def number_in(value: object) -> float:
    """NaN for what is no number."""
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else math.nan


def _require_finite(
    effects: Sequence[tuple[Effect, Floats]], reference: Mapping[str, float], magnitude: float, where: str
) -> None:
    """JSON as Python reads it has NaN."""
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
    """(p,) standard uncertainties of the parameters by a document's ``budget``
    over their standard errors; 1 where either is not known."""
    out = []
    for name, error in zip(c.parameters, c.standard_errors, strict=True):
        expanded, coverage = (_in_budget(budget, key, name) for key in ("expanded", "coverage_factor"))
        out.append(1.0 if expanded is None or not coverage or not error > 0 else expanded / coverage / error)
    return np.array(out)


def _in_budget(budget: Mapping[str, Any], key: str, parameter: str) -> float | None:
    """A figure of the budget by parameter, None where it has none."""
    group, _, name = parameter.rpartition(".")
    try:
        of = budget[key]
        return float(of[group]["xyz".index(name)] if group in GROUPS else of["effects"][group][name])
    except (LookupError, TypeError, ValueError):
        return None


# A calibration document as what is known of a unit before a later recording
# (`triaxcal.inputs.bias_update`).


def earlier_in(document: Mapping[str, Any], origin: Origin, *, where: str) -> Earlier:
    """Of a calibration, loop or certificate document. Its covariance has what
    the budget has beside the fit. Raises InvalidData."""
    part = calibration_part(document, where=where)
    fitted = calibration_of(part, where=where)
    budget, following = part.get("uncertainty"), part.get("next_recording")
    raised = uncertainty_over_error(budget if isinstance(budget, Mapping) else {}, fitted)
    told = following if isinstance(following, Mapping) else {}
    start_to_start = number_in(told.get("start_to_start_g"))
    blind_to, alone = part.get("blind_to"), part.get("linear_only")
    warm = logged_in(part, where=where).get(TEMPERATURE)
    scatter, dof, noise = _scatter(part)
    return Earlier(
        replace(fitted, blind_to=tuple(map(str, blind_to)) if isinstance(blind_to, list) else ()),
        fitted.covariance * np.outer(raised, raised),
        scatter_g=scatter,
        residual_dof=dof,
        noise_g=noise,
        start_to_start=start_to_start if start_to_start >= 0 else None,
        measured=told.get("source") == Source.MEASURED.value,
        temperatures_c=None if warm is None else (float(warm.min()), float(warm.max())),
        origin=origin,
        linear_only=earlier_in(alone, origin, where=f"{where}: linear_only") if isinstance(alone, Mapping) else None,
    )


def _scatter(part: Mapping[str, Any]) -> tuple[float, float, float]:
    """By the residuals: a standard deviation of |a| that every pose had beside
    its noise, by how many degrees of freedom, and one that has the noise in it.
    An update hands on the first, which its few poses tell little of."""
    residual, updated, poses = (part.get(name) for name in ("residual", "rezero", "poses"))
    held = residual if isinstance(residual, Mapping) else {}
    used = sum(bool(p.get("used", True)) for p in poses if isinstance(p, Mapping)) if isinstance(poses, list) else 0
    if isinstance(updated, Mapping):
        known, dof = (max(number_in(updated.get(name)), 0.0) for name in ("scatter_g", "scatter_dof"))
        return known, dof, number_in(held.get("rms_g")) * math.sqrt(used / max(used - 3, 1))
    left = max(used - LINEAR, 0)
    variance = number_in(held.get("rms_g")) ** 2 * used / left if left else math.nan
    beside = variance - number_in(held.get("noise_floor_g")) ** 2
    return (math.sqrt(beside) if beside > 0 else 0.0), float(left), math.sqrt(variance)
