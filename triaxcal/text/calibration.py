"""A calibration in a few lines, and the conditions under which its nine parameters are
all of a reading."""

from __future__ import annotations

import html as markup
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence

from triaxcal.effects import TEMPERATURE
from triaxcal.effects.contract import (
    DERIVED,
    DURATION,
    RUN,
    SINCE_START,
    TIME,
    Effect,
    channel_of,
    is_derived,
    lag_in,
    rate_of,
)
from triaxcal.estimate.calibration import Calibration, ReferenceEpoch, Residual
from triaxcal.model.samples import Moment
from triaxcal.number_format import number_of, plain
from triaxcal.poses.pose import Pose
from triaxcal.rounding import concise
from triaxcal.units import ErrorUnit, grouped, in_units_of

# Under which conditions a calibration's nine parameters are all of a reading.


def holds(effects: Iterable[Effect], reference: Mapping[str, float], *, several: bool = False) -> tuple[str, ...]:
    """The conditions under which a reading has nothing of these effects, so
    that scale factor, misalignment and bias are all of it. ``reference`` is
    whence the conditions count; ``several``: recordings, each with its own
    clock."""
    out: list[str] = []
    for effect in effects:
        of_conditions = (_at(n, reference.get(n, 0.0), several) for n in effect.needs if n != RUN)
        out += [effect.absent] if effect.absent else of_conditions
    return tuple(dict.fromkeys(out))


def as_at(moment: ReferenceEpoch) -> str:
    """The moment of a recording for which a correction holds that knows no
    time."""
    which = {Moment.END: "the end", Moment.MEAN: "the mean of the poses"}.get(moment.moment)
    return f"as at {plain(moment.t_s, 6)} s of the recording" + (f" ({which})" if which else "")


def use(effects: Iterable[Effect], *, linear_only: bool) -> str:
    """How readings u become specific force a. ``linear_only``: the best linear
    calibration is in the document too."""
    if not tuple(effects):
        return "a = matrix (u - centre)"
    linear = "; linear_only is the best linear calibration" if linear_only else ""
    return f"matrix and centre alone are not the calibration: it has effects, which triaxcal apply adds{linear}"


def _at(name: str, value: float, several: bool) -> str:
    if name == SINCE_START:
        return "long after the start"
    if name == TIME and several:
        return "at the middle of each recording's poses"
    if name in DERIVED:
        unit = {TIME: " s", DURATION: " s"}.get(name, "")
        return f"at {name} = {plain(value, 6)}{unit}"
    if is_derived(name):
        lag = lag_in(name)
        return f"while {channel_of(lag[0] if lag else name.removesuffix(rate_of('')))} does not change"
    return f"at {channel_of(name)} = {plain(value, 6)}{' °C' if name == TEMPERATURE else ''}"


# A calibration in a few lines.


def short(c: Calibration, output_unit: str, reference_unit: str) -> str:
    """The model, its coefficients and its residual."""
    rows = [f"{name:<14}{value}" for name, value in _linear(c, output_unit, reference_unit)]
    return "\n".join([f"Calibration: {', '.join(c.terms)}", *(f"  {r}" for r in (*rows, *_quality(c, reference_unit)))])


def summary(c: Calibration, output_unit: str, reference_unit: str, warnings: Iterable[str]) -> str:
    """The same with the effects' coefficients, all standard errors, and the
    warnings."""
    lines = [f"Calibration: {', '.join(c.terms)}"]
    lines += [f"  {name:<34}{figure}" for name, figure in _all(c, output_unit, reference_unit)]
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
        f"<tr><td>{markup.escape(name)}</td><td>{markup.escape(figure)}</td></tr>"
        for name, figure in _all(c, output_unit, reference_unit)
    )
    lines = [*_quality(c, reference_unit), *(f"warning: {w}" for w in warnings)]
    below = "".join(f"<li>{markup.escape(line)}</li>" for line in lines)
    return f"<p>Calibration: {markup.escape(', '.join(c.terms))}</p><table>{rows}</table><ul>{below}</ul>"


def _units(output_unit: str, reference_unit: str) -> dict[str, str]:
    scale_factor = f"{output_unit or 'output'}/{grouped(reference_unit)}"
    return {"scale factor": scale_factor, "misalignment": "rad", "bias": reference_unit}


def _linear(c: Calibration, output_unit: str, reference_unit: str) -> list[tuple[str, str]]:
    figures = [figure for _, figure in _all(c, output_unit, reference_unit)]
    names = _units(output_unit, reference_unit)
    return [(name, "  ".join(figures[3 * k : 3 * k + 3])) for k, name in enumerate(names)]


def _all(c: Calibration, output_unit: str, reference_unit: str) -> list[tuple[str, str]]:
    """Name and figure of every coefficient, and of the effects' shapes."""
    units = [unit for unit in _units(output_unit, reference_unit).values() for _ in "xyz"]
    found = [
        (name, concise(float(value), float(error), unit))
        for name, value, error, unit in zip(c.parameters[:9], c.values[:9], c.standard_errors[:9], units, strict=True)
    ]
    for effect, _ in c.sensor.effects:
        for name, (value, error, unit) in c.coefficients_of(effect.name).items():
            found.append((f"{effect.name}.{name}", concise(value, error, in_units_of(unit, reference_unit))))
    return found


def _errors(r: Residual, small: ErrorUnit) -> Iterator[str]:
    """What tells most first."""
    if r.cross_validated_rms_g is not None:
        yield f"cross-validated rms {small.in_full(r.cross_validated_rms_g)}"
    if r.weighted_rms is not None:
        chi2 = "" if r.reduced_chi2 is None else f" (χ² per degree of freedom {plain(r.reduced_chi2, 2)})"
        yield f"residuals of {plain(r.weighted_rms, 2)} standard errors rms{chi2}"
    yield f"residual rms {small.in_full(r.rms_g)}"
    yield f"noise floor {small.in_full(r.noise_floor_g)}"


def _quality(c: Calibration, reference_unit: str) -> list[str]:
    small, r = ErrorUnit.of(reference_unit, c.reference), c.residual
    lines = []
    if not math.isnan(r.rms_g):
        lines.append(", ".join(_errors(r, small)))
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
