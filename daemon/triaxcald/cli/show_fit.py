"""Results of a fit and a diagnosis, for the console."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence

import triaxcal as tc
from triaxcald.caveats import assumption
from triaxcald.cli.console import show, table
from triaxcald.cli.showing import FitSettings, counted

WIDTH = 80
WORTH_A_LINE = 0.01
"""Effects of less probability are in the document alone."""


def show_calibration(c: tc.estimate.Calibration, settings: FitSettings) -> None:
    b = tc.uncertainty.budget(c, settings.stated)
    show_coefficients(c, settings, b.parameters)
    if said := temperature_of(c):
        show(said)
    r, small = c.residual, settings.small
    poses = counted(len(c.poses), sum(not p.used for p in c.poses))
    show(
        f"{poses}: {cross_validated(r, small)}, {weighted(r)}residual rms {small.in_full(r.rms_g)}, noise floor "
        f"{small.in_full(r.noise_floor_g)}, lack of fit p {tc.number_format.probability(r.lack_of_fit_p)}"
    )
    show_budget(b, settings)


def cross_validated(r: tc.estimate.Residual, small: tc.units.ErrorUnit) -> str:
    if r.cross_validated_rms_g is None:
        return "not cross-validated (without one of the poses the others carry no fit)"
    return f"cross-validated {small.in_full(r.cross_validated_rms_g)}"


def weighted(r: tc.estimate.Residual) -> str:
    if r.weighted_rms is None:
        return ""
    chi2 = "" if r.reduced_chi2 is None else f" (χ² per degree of freedom {tc.number_format.plain(r.reduced_chi2, 2)})"
    return f"residuals of {tc.number_format.plain(r.weighted_rms, 2)} standard errors rms{chi2}, "


def temperature_of(c: tc.estimate.Calibration) -> str:
    """Temperature for which the values of a model without temperature hold; empty for
    other models."""
    of_poses = [p.pose.channels.get(tc.effects.TEMPERATURE, math.nan) for p in c.poses if p.used]
    modelled = any(tc.effects.TEMPERATURE in effect.needs for effect, _ in c.sensor.effects)
    if modelled or not of_poses or not all(map(math.isfinite, of_poses)):
        return ""
    return held_at(sum(of_poses) / len(of_poses), min(of_poses), max(of_poses), "poses")


def held_at(mean: float, lowest: float, highest: float, of: str) -> str:
    """Sentence about the temperature for which the values hold: the mean over the poses
    or samples ``of`` the fit."""
    low, middle, high = (f"{v:.4g}" for v in (lowest, mean, highest))
    spread = "" if low == high else f", the mean of the {of} ({low} to {high} °C)"
    return f"scale factor, misalignment and bias are those at {tc.effects.TEMPERATURE} = {middle} °C{spread}"


def show_coefficients(
    c: tc.estimate.Calibration, settings: FitSettings, whole: tc.uncertainty.Combined | None = None
) -> None:
    """``whole`` is their uncertainty with all that the budget has, where there
    is one."""
    rows = []
    unit = settings.reference_unit
    of_scale = f"{settings.output_unit or 'output'}/{tc.units.grouped(unit)}"
    units = {"scale_factor": of_scale, "misalignment": "rad", "bias": unit}
    of_effects = {
        f"{e.name}.{k.name}": tc.units.in_units_of(k.unit, unit) for e, _ in c.sensor.effects for k in e.coefficients
    }
    for i, (name, value, error) in enumerate(zip(c.parameters, c.values, c.standard_errors, strict=True)):
        if name.startswith(f"{tc.effects.Empirical().name}."):  # dozens, which mean nothing one by one
            continue
        of = of_effects.get(name, units.get(name.split(".")[0], ""))
        expanded = [f"± {tc.rounding.concise_error(whole.expanded[i], of)}"] if whole else []
        rows.append([name, tc.rounding.concise(float(value), float(error), of), *expanded])
    for effect, _ in c.sensor.effects:
        for name in effect.shape:
            value, known, of = c.coefficients_of(effect.name)[name]
            rows.append([f"{effect.name}.{name}", tc.rounding.concise(value, known, of), *(["—"] if whole else [])])
    expanded_at = [f"expanded ({whole.level:.0%})"] if whole else []
    if tc.effects.Empirical().name in c.terms:
        show(
            f"{tc.effects.Empirical().name}: a smooth function of the direction, whose coefficients are in the document"
        )
    table("coefficients", ["", "value (standard error)", *expanded_at], rows)
    if held := tc.interchange.holds_of(c):
        show(f"scale factor, misalignment and bias hold {'; '.join(held)}")


def _percent(share: float) -> str:
    return "< 1%" if 0 < share < 0.01 else f"{share:.0%}"


def show_budget(b: tc.uncertainty.Budget, settings: FitSettings) -> None:
    small = settings.small
    rows = [
        [line.source, line.evaluation, small.written(line.magnitude), _percent(b.share(line))] for line in b.components
    ]
    whole = b.magnitude
    rows.append(["combined", "", small.written(float(whole.standard)), ""])
    rows.append(
        [f"expanded ({whole.level:.0%}, k = {float(whole.coverage):.2f})", "", small.written(float(whole.expanded)), ""]
    )
    table(f"uncertainty of the magnitude, {small}", ["source", "type", "standard", "share"], rows)
    by = tc.text.remedy(b.dominant.halved_by, small.figure)
    show(f"dominant: {b.dominant.source}; to halve it: {by} (combined then {small.in_full(b.magnitude_if_halved)})")
    if assumed := assumption(tc.interchange.assumed_in(b.dominant.basis), settings.reference_unit):
        show(f"{b.dominant.source}: {assumed}")
    for source in b.not_evaluated:
        show(f"not evaluated: {tc.text.not_evaluated(source, small.figure)}")


def show_summary(lines: Sequence[str]) -> None:
    """The four lines of a diagnosis (`triaxcal.text.diagnosis.lines`)."""
    for name, line in zip(("verdict", "cause", "error", "next"), lines, strict=True):
        text_of = f"{name:<9}{line}"
        for part in textwrap.wrap(text_of, WIDTH, subsequent_indent=" " * 9, break_long_words=False):
            show(part)


def text_of_held_out(held: tc.estimate.HoldOut, small: tc.units.ErrorUnit) -> str:
    before, after, floor = map(small.in_full, (held.before_rms_g, held.after_rms_g, held.noise_floor_g))
    return f"held out rms {before} before, {after} after, noise floor {floor} ({held.poses} poses)"


def chance_of(probability: float | None) -> str:
    return "likely, not calibrated" if probability is None else tc.text.diagnosis.chance(probability)


def show_loop(loop: tc.diagnosis.Loop, settings: FitSettings) -> None:
    """Errors, what acts with which probability, and the advice in full."""
    show_before_after(loop, settings.small)
    told = loop.stated
    likely = [[name, chance_of(told[name])] for name, p in loop.probabilities.items() if p >= WORTH_A_LINE]
    rest = [["nothing", tc.text.diagnosis.chance(loop.found.nothing)]]
    rest += [["something that no known effect describes", tc.text.diagnosis.chance(loop.found.unexplained.probability)]]
    table("what acts", ["", "probability"], [*likely, *rest])
    for finding in loop.findings:
        show(f"{finding.verdict}: {finding.effect} ({tc.text.diagnosis.reason(finding, loop.refusal)})")
    for line in tc.text.diagnosis.advice(loop, settings.small):
        show(f"to do: {line}")
    for line in tc.text.diagnosis.notes(loop, settings.small):
        show(f"note: {line}")


def show_before_after(loop: tc.diagnosis.Loop, small: tc.units.ErrorUnit) -> None:
    """Errors before and after, over the same poses, what tells most first; and
    the excluded poses with their residuals."""
    both = loop.before.residual, loop.after.residual
    used = sum(p.used for p in loop.after.poses)
    rows = []
    if loop.held_out:
        held = loop.held_out.before_rms_g, loop.held_out.after_rms_g
        rows.append([f"held-out rms, {small}", *map(small.written, held)])
    rows += [
        [f"cross-validated rms, {small}", *(small.written(r.cross_validated_rms_g) for r in both)],
        ["residuals, standard errors rms", *(_ratio(r.weighted_rms) for r in both)],
        ["χ² per degree of freedom", *(_ratio(r.reduced_chi2) for r in both)],
        [f"residual rms, {small}", *(small.written(r.rms_g) for r in both)],
        [f"noise floor, {small}", *(small.written(r.noise_floor_g) for r in both)],
    ]
    table(
        f"error of the magnitude in the {tc.number_format.number_of(used, 'pose')} of the fit",
        ["", "before", "after"],
        rows,
    )
    pairs = zip(loop.before.poses, loop.after.poses, strict=True)
    excluded = [[*_of_pose(before, after, small)] for before, after in pairs if not after.used]
    if excluded:
        table(f"excluded poses: residual, {small}", ["begins at", "before", "after", "why"], excluded)


def _of_pose(before: tc.estimate.PoseResult, after: tc.estimate.PoseResult, small: tc.units.ErrorUnit) -> Iterator[str]:
    yield f"{after.pose.start_s:.1f} s"
    yield from (small.written(p.residual_g) if math.isfinite(p.residual_g) else "—" for p in (before, after))
    yield after.pose.fault or str(after.excluded)


def _ratio(value: float | None) -> str:
    return "—" if value is None else tc.number_format.plain(value, 2)
