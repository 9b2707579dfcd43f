"""Results as a person reads them at the console, and in which units."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from triaxcal.calibration import Calibration
from triaxcal.errors import Refused
from triaxcal.gravity import local_gravity_g
from triaxcal.loop import Loop
from triaxcal.uncertainty import Budget, Combined, Stated, budget
from triaxcald.cli.console import say, table
from triaxcald.errors import InputError
from triaxcald.inputs import Measured
from triaxcald.units import ErrorUnit, grouped, in_units_of, reference_unit_of


@dataclass(frozen=True)
class Choice:
    """How a recording is to be read: the user's word, else the recording's own, else the default."""

    signs: tuple[int, int, int]
    reference: float
    output_unit: str
    reference_unit: str
    stated: Stated

    @property
    def small(self) -> ErrorUnit:
        return ErrorUnit.of(self.reference_unit, self.reference)


def chosen(a: argparse.Namespace, measured: Measured) -> Choice:
    """Raises InputError where what was said of the reference does not go together."""
    latitude, height = getattr(a, "latitude", None), getattr(a, "height", None)
    if (latitude is None) != (height is None):
        raise InputError("--latitude, --height: give both, or neither")
    if latitude is not None and a.reference:
        raise InputError("--reference: --latitude and --height say it already; give one or the other")
    if latitude is not None and a.reference_unit not in (None, "g"):
        raise InputError(f"--reference-unit {a.reference_unit}: --latitude and --height give the reference in g")
    local = None if latitude is None or height is None else local_gravity_g(latitude, height)[0]
    reference = a.reference or local or measured.reference or 1.0
    return Choice(
        a.sign or measured.signs or (1, 1, 1),
        reference,
        a.output_unit or (measured.profile.output.unit if measured.profile else ""),
        a.reference_unit or reference_unit_of(reference),
        _stated(a, measured),
    )


def _stated(a: argparse.Namespace, measured: Measured) -> Stated:
    """What the recording's station says holds where the user says nothing, but for another reference."""
    latitude, height = getattr(a, "latitude", None), getattr(a, "height", None)
    own = measured.stated or Stated()
    thermometer = getattr(a, "thermometer_uncertainty", None)
    said = Stated.at(
        latitude,
        height,
        getattr(a, "reference_uncertainty", None),
        thermometer_k=own.thermometer_k if thermometer is None else thermometer,
    )
    if said.reference is None and a.reference is None:
        return replace(said, reference=own.reference, reference_source=own.reference_source)
    return said


def show_calibration(c: Calibration, choice: Choice) -> None:
    b = budget(c, choice.stated)
    show_coefficients(c, choice, b.parameters)
    r, small = c.residual, choice.small
    p = "—" if r.lack_of_fit_p is None else f"{r.lack_of_fit_p:.2g}"
    print(
        f"{len(c.poses)} poses: residual rms {small.in_full(r.rms_g)}, cross-validated "
        f"{small.in_full(r.cross_validated_rms_g)}, noise floor {small.in_full(r.noise_floor_g)}, "
        f"lack of fit p {p}"
    )
    show_budget(b, choice)


def show_coefficients(c: Calibration, choice: Choice, whole: Combined | None = None) -> None:
    """``whole`` is their uncertainty with all that the budget has, where there is one."""
    rows = []
    unit = choice.reference_unit
    of_scale = f"{choice.output_unit or 'output'}/{grouped(unit)}"
    units = {"scale_factor": of_scale, "misalignment": "rad", "bias": unit}
    of_effects = {f"{e.name}.{k.name}": in_units_of(k.unit, unit) for e, _ in c.sensor.effects for k in e.coefficients}
    for i, (name, value, error) in enumerate(zip(c.parameters, c.values, c.standard_errors, strict=True)):
        expanded = [f"± {whole.expanded[i]:.2g}"] if whole else []
        of = of_effects.get(name, units.get(name.split(".")[0], ""))
        rows.append([name, f"{value:.9g}", f"{error:.2g}", *expanded, of])
    told = [f"expanded ({whole.level:.0%})"] if whole else []
    table("coefficients", ["", "value", "standard error", *told, "unit"], rows)
    held = ", ".join(f"{name} = {value:g}" for name, value in c.channel_reference.items())
    if held:
        print(f"they hold at {held}")


def _percent(share: float) -> str:
    return "< 1%" if 0 < share < 0.01 else f"{share:.0%}"


def show_budget(b: Budget, choice: Choice) -> None:
    small = choice.small
    rows = [
        [line.source, line.evaluation, small.told(line.magnitude), _percent(b.share(line))] for line in b.components
    ]
    whole = b.magnitude
    rows.append(["combined", "", small.told(float(whole.standard)), ""])
    rows.append(
        [f"expanded ({whole.level:.0%}, k = {float(whole.coverage):.2f})", "", small.told(float(whole.expanded)), ""]
    )
    table(f"uncertainty of the magnitude, {small}", ["source", "type", "standard", "share"], rows)
    by = small.in_words(b.dominant.halved_by)
    print(f"dominant: {b.dominant.source}; to halve it: {by} (combined then {small.in_full(b.magnitude_if_halved)})")
    for line in b.not_evaluated:
        print(f"not evaluated: {line}")


def show_loop(loop: Loop, choice: Choice) -> None:
    b, f, small = loop.before.residual, loop.after.residual, choice.small
    rows = [
        ["residual rms", small.told(b.rms_g), small.told(f.rms_g)],
        ["cross-validated rms", small.told(b.cross_validated_rms_g), small.told(f.cross_validated_rms_g)],
    ]
    if loop.held_out:
        rows.append(["held-out rms", small.told(loop.held_out.before_rms_g), small.told(loop.held_out.after_rms_g)])
    rows.append(["noise floor", small.told(b.noise_floor_g), small.told(f.noise_floor_g)])
    table(f"error of the magnitude, {small}", ["", "before", "after"], rows)
    for finding in loop.findings:
        print(f"{finding.verdict}: {finding.effect} ({small.in_words(finding.reason)})")
    if not loop.findings:
        print("no effect of the catalogue shows")
    if loop.unexplained.significant:
        lead = small.in_words(loop.unexplained.lead)
        print(f"unexplained: {small.in_full(loop.unexplained.rms_g)} rms; {lead}")
    for line in loop.advice:
        print(f"advice: {small.in_words(line)}")


def judge(limit: float | None, rms: float) -> int:
    if limit is not None and not rms <= limit:
        say(f"outside the limit: rms {rms:.3g}, limit {limit:.3g}")
        return 1
    return 0


def warn(lines: Iterable[str]) -> None:
    for line in lines:
        say(f"warning: {line}")


@contextmanager
def telling_data_quality(measured: Measured) -> Iterator[None]:
    """What spoils a recording may be why it is refused."""
    try:
        yield
    except Refused:
        warn(measured.data_quality)
        raise
