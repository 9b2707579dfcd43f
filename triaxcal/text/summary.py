"""A calibration in a few lines."""

from __future__ import annotations

import html as markup
import math
from collections.abc import Iterable, Sequence

import numpy as np

from triaxcal.effects.contract import SINCE_START, TIME
from triaxcal.estimate.calibration import Calibration
from triaxcal.number_format import number_of
from triaxcal.poses.pose import Pose
from triaxcal.text.holds import holds
from triaxcal.units import ErrorUnit, grouped, in_units_of


def short(c: Calibration, output_unit: str, reference_unit: str) -> str:
    """The model, its coefficients and its residual."""
    rows = [f"{name:<14}{value} {unit}" for name, value, unit in _linear(c, output_unit, reference_unit)]
    return "\n".join([f"Calibration: {', '.join(c.terms)}", *(f"  {r}" for r in (*rows, *_quality(c, reference_unit)))])


def summary(c: Calibration, output_unit: str, reference_unit: str, warnings: Iterable[str]) -> str:
    """The same with the effects' coefficients, all standard errors, and the
    warnings."""
    lines = [f"Calibration: {', '.join(c.terms)}"]
    lines += [
        f"  {name:<34}{value:>+16.9g} {error:<14} {unit}"
        for name, value, error, unit in _all(c, output_unit, reference_unit)
    ]
    lines += [f"  {line}" for line in _quality(c, reference_unit)]
    lines += [f"  warning: {line}" for line in warnings]
    return "\n".join(lines)


def poses(found: Sequence[Pose], data_quality: Iterable[str]) -> str:
    """How many, when, and what spoils the raw stream."""
    faulty = sum(bool(p.fault) for p in found)
    count = f"{len(found)} still {'pose' if len(found) == 1 else 'poses'}"
    when = f" from {found[0].start_s:.1f} to {found[-1].end_s:.1f} s" if found else ""
    lines = [f"{count}{when}" + (f", {faulty} of them excluded" if faulty else "")]
    return "\n".join([*lines, *(f"  {line}" for line in data_quality)])


TOLD = 2.0
"""Times the expected error, from which on the ratio is told: noise alone makes
more in one of twenty recordings of a single pose, and never in nine poses."""


def verification(poses: str, rms: float, noise_floor: float, expected: float, reference: tuple[str, float]) -> str:
    """The error in poses of another recording, beside what noise and the
    calibration's uncertainty make there."""
    small = ErrorUnit.of(*reference)
    line = f"{poses}: rms {small.in_full(rms)}, noise floor {small.in_full(noise_floor)}"
    if math.isnan(expected):
        return line
    line = f"{line}, {small.in_full(expected)} expected of noise and the calibration's uncertainty"
    return f"{line}: the error is {rms / expected:.2g} times that" if rms > TOLD * expected else line


def html(c: Calibration, output_unit: str, reference_unit: str, warnings: Iterable[str]) -> str:
    """The same as a table for a notebook."""
    rows = "".join(
        f"<tr><td>{markup.escape(name)}</td><td>{value:+.9g}</td><td>{error}</td><td>{markup.escape(unit)}</td></tr>"
        for name, value, error, unit in _all(c, output_unit, reference_unit)
    )
    lines = [*_quality(c, reference_unit), *(f"warning: {w}" for w in warnings)]
    below = "".join(f"<li>{markup.escape(line)}</li>" for line in lines)
    return f"<p>Calibration: {markup.escape(', '.join(c.terms))}</p><table>{rows}</table><ul>{below}</ul>"


def _linear(c: Calibration, output_unit: str, reference_unit: str) -> list[tuple[str, str, str]]:
    s, output = c.sensor, output_unit or "output"
    return [
        ("scale factor", _vector(s.scale_factor), f"{output}/{grouped(reference_unit)}"),
        ("misalignment", _vector(s.misalignment), "rad"),
        ("bias", _vector(s.bias), reference_unit),
    ]


def _all(c: Calibration, output_unit: str, reference_unit: str) -> list[tuple[str, float, str, str]]:
    """Name, value, standard error and unit of every coefficient, and of the
    effects' shapes."""
    units = [unit for _, _, unit in _linear(c, output_unit, reference_unit) for _ in "xyz"]
    found = [
        (name, float(value), _error(float(error)), unit)
        for name, value, error, unit in zip(c.parameters[:9], c.values[:9], c.standard_errors[:9], units, strict=True)
    ]
    for effect, _ in c.sensor.effects:
        for name, (value, error, unit) in c.coefficients_of(effect.name).items():
            found.append((f"{effect.name}.{name}", value, _error(error), in_units_of(unit, reference_unit)))
    return found


def _quality(c: Calibration, reference_unit: str) -> list[str]:
    small, r = ErrorUnit.of(reference_unit, c.reference), c.residual
    lines = []
    if not math.isnan(r.rms_g):
        crossed = r.cross_validated_rms_g
        beside = "" if crossed is None else f", cross-validated {small.in_full(crossed)}"
        lines.append(f"residual rms {small.in_full(r.rms_g)}{beside}, noise floor {small.in_full(r.noise_floor_g)}")
    if c.poses:
        excluded = sum(not p.used for p in c.poses)
        lines.append(number_of(len(c.poses), "pose") + (f", {excluded} of them excluded" if excluded else ""))
    effects = [effect for effect, _ in c.sensor.effects]
    several = any(p.pose.run.of > 1 for p in c.poses)
    if held := holds(effects, c.channel_reference, several=several):
        lines.append(f"the linear parameters hold {', '.join(held)}")
    if c.holds_at is not None and any({TIME, SINCE_START} & set(e.needs) for e, _ in c.sensor.effects):
        lines.append(f"effects of time hold at {c.holds_at.t_s:.1f} s of its recording ({c.holds_at.moment.value})")
    return lines


def _vector(values: Sequence[float] | np.ndarray) -> str:
    return "[" + "  ".join(f"{v:+.7g}" for v in values) + "]"


def _error(value: float | None) -> str:
    return "" if value is None or math.isnan(value) else f"± {value:.2g}"
