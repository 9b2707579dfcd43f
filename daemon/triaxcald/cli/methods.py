"""fit by other ways: a turning unit, poses of known attitude, refinement of
datasheet values."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from triaxcal.errors import Refused
from triaxcal.estimate.calibration import Calibration
from triaxcal.inputs.attitude import AttitudeFit, fit_attitudes
from triaxcal.inputs.datasheet import Datasheet, Refinement, refine
from triaxcal.inputs.turning.moments import Moments
from triaxcal.inputs.turning.rotation import RotationFit, fit_rotation
from triaxcal.interchange.calibration_document import Document
from triaxcal.interchange.calibration_reading import calibration_part, holds_at_of, sensor_of
from triaxcal.interchange.error_reading import correlation_of, effect_errors_of, linear_errors_of
from triaxcal.interchange.method_documents import attitudes_document, datasheet_document, turning_document
from triaxcal.number_format import number_of, probability
from triaxcald.attitudes import match, read_attitudes
from triaxcald.cli.console import micro, show, table
from triaxcald.cli.results import cross_validated, held_at, show_coefficients, temperature_of
from triaxcald.cli.showing import Choice, chosen, read_recording, telling_data_quality
from triaxcald.errors import InputError
from triaxcald.inputs import Measured, read_document, require_unit

POSES_ENOUGH = 9
DEFAULT_SIGNS = (
    "no --sign was given, so +,+,+ is taken: an output that falls where its axis points up needs a minus, "
    "and nothing in the data tells"
)
Way = tuple[Measured, Document, Calibration, Callable[[], None]]
"""What was measured, the document, the calibration, and how it is shown at the
console."""


def chosen_way(a: argparse.Namespace) -> Callable[[argparse.Namespace], Way] | None:
    """The way that the options ask for; None for still poses alone. Raises
    InputError for options without their way."""
    if a.attitude_error is not None and not a.attitudes:
        raise InputError("--attitude-error: there are no --attitudes")
    if a.datasheet_error is not None and not a.datasheet:
        raise InputError("--datasheet-error: there is no --datasheet")
    way = "--turning" if a.turning else "--attitudes" if a.attitudes else "--datasheet" if a.datasheet else None
    for option in ("reference_uncertainty", "thermometer_uncertainty", "thermal_sensitivity"):
        if way and getattr(a, option) is not None:
            raise InputError(f"--{option.replace('_', '-')}: with {way} there is no budget that it would count in")
    return _turning if a.turning else _attitudes if a.attitudes else _datasheet if a.datasheet else None


def signs_given(a: argparse.Namespace, measured: Measured) -> bool:
    """No residual shows that signs are wrong; where nobody gave them this is
    said."""
    return a.sign is not None or measured.signs is not None


def default_signs(a: argparse.Namespace, measured: Measured) -> list[str]:
    """The warning of signs that nobody gave."""
    return [] if signs_given(a, measured) else [DEFAULT_SIGNS]


@contextmanager
def telling_default_signs(a: argparse.Namespace, measured: Measured) -> Iterator[None]:
    """A refusal names poses, and which way is up depends on signs that nobody
    may have given."""
    try:
        yield
    except Refused as e:
        if e.wanted and not signs_given(a, measured):
            raise Refused(f"{e}; no --sign was given, so +,+,+ is taken", wanted=e.wanted) from e
        raise


def _turning(a: argparse.Namespace) -> Way:
    moments = Moments()
    measured = read_recording(a, a.recording, moments)
    choice = chosen(a, measured)
    with telling_data_quality(measured), telling_default_signs(a, measured):
        found = fit_rotation(moments, signs=choice.signs, reference=choice.reference)
    document = turning_document(found, output_unit=choice.output_unit, reference_unit=choice.reference_unit)
    calibration = found.calibration
    still = [p for p in measured.poses if not p.creep.any()]
    if len(still) >= POSES_ENOUGH:
        advice = f"there are {len(still)} still poses in it: without --turning the fit would use their quiet"
        document["warnings"] = [*document["warnings"], advice]
    return measured, document, calibration, lambda: _show_turning(found, choice)


def _show_turning(found: RotationFit, choice: Choice) -> None:
    show_coefficients(found.calibration, choice)
    if t := found.temperature:
        show(held_at(t.mean, t.lowest, t.highest, "samples"))
    r, small = found.calibration.residual, choice.small
    noise = ", ".join(f"{v:.3g}" for v in found.noise_g)
    show(f"{number_of(found.samples, 'sample')}, whose noise is {noise} {choice.reference_unit} in x, y, z")
    show(
        f"{found.stretches} stretches: |a| off by {small.in_full(r.rms_g)} rms, of which noise is "
        f"{small.in_full(r.noise_floor_g)}, lack of fit p {probability(r.lack_of_fit_p)}"
    )


def _attitudes(a: argparse.Namespace) -> Way:
    rows = read_attitudes(a.attitudes)
    measured = read_recording(a, a.recording)
    choice = chosen(a, measured)
    poses, rows = match(rows, measured.poses, path=a.attitudes, recording=measured.name)
    with telling_data_quality(measured):
        found = fit_attitudes(
            poses,
            np.array([row.up for row in rows]),
            names=[row.name for row in rows],
            signs=a.sign or measured.signs,
            reference=choice.reference,
            attitude_error_rad=a.attitude_error,
        )
    document = attitudes_document(found, output_unit=choice.output_unit, reference_unit=choice.reference_unit)
    return measured, document, found.calibration, lambda: _show_attitudes(found, choice)


def _show_attitudes(found: AttitudeFit, choice: Choice) -> None:
    c = found.calibration
    show_coefficients(c, choice)
    if said := temperature_of(c):
        show(said)
    table(
        "attitudes",
        ["", "start s", "off µrad", "off, standard errors", f"|a| off {choice.small}", "used"],
        [
            [
                row.name,
                f"{pose.pose.start_s:.1f}",
                micro(row.off_rad),
                f"{row.off:.1f}",
                choice.small.written(pose.residual_g),
                "yes" if pose.used else "no",
            ]
            for row, pose in zip(found.attitudes, c.poses, strict=True)
        ],
    )
    table(
        "rotation from the table's frame to the sensor's",
        ["", "x", "y", "z", "standard error µrad"],
        [
            [axis, *(f"{v:+.7f}" for v in line), micro(float(error))]
            for axis, line, error in zip("xyz", found.rotation, found.rotation_error_rad, strict=True)
        ],
    )
    how = "estimated from the residuals" if found.estimated else "as declared" if found.attitude_error_rad else "none"
    cost = float(np.max(c.standard_errors[:9] / found.noise_error))
    show(
        f"error of the attitudes by axis: {micro(found.attitude_error_rad)} µrad ({how}); with what residuals say it "
        f"raises the standard errors by a factor of up to {cost:.2f}"
    )
    small = choice.small
    r = c.residual
    show(
        f"{len(c.poses)} poses: |a| off by {small.in_full(r.rms_g)} rms, {cross_validated(r, small)}, noise floor "
        f"{small.in_full(r.noise_floor_g)}, lack of fit p {probability(r.lack_of_fit_p)}"
    )


def _datasheet(a: argparse.Namespace) -> Way:
    held = read_document(a.datasheet)
    measured = read_recording(a, a.recording)
    require_unit(held, measured, where=a.datasheet)
    choice = chosen(a, measured)
    said = a.reference or measured.reference or getattr(a, "latitude", None)
    datasheet, units = read_datasheet(
        held, where=a.datasheet, errors=a.datasheet_error, reference=choice.reference if said is not None else None
    )
    if a.sign and any(k * s < 0 for k, s in zip(datasheet.sensor.scale_factor, a.sign, strict=True)):
        raise InputError(f"--sign: the scale factors in {a.datasheet} have other signs")
    choice = replace(
        choice,
        reference=datasheet.reference,
        output_unit=choice.output_unit or units.get("output", ""),
        reference_unit=a.reference_unit or units.get("reference") or choice.reference_unit,
    )
    with telling_data_quality(measured), np.errstate(all="ignore"):  # numbers out of a file may be any
        found = refine(measured.poses, datasheet)
    document = datasheet_document(found, output_unit=choice.output_unit, reference_unit=choice.reference_unit)
    return measured, document, found.calibration, lambda: _show_datasheet(found, choice)


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


def _show_datasheet(found: Refinement, choice: Choice) -> None:
    c = found.calibration
    table(
        f"datasheet values, refined by {len(c.poses)} poses",
        ["", "datasheet", "standard error", "refined", "standard error", "shift, by chance 1", "poses' share", "from"],
        [
            [name, f"{old:.9g}", f"{error:.2g}", f"{new:.9g}", f"{now:.2g}", f"{shift:+.1f}", f"{share:.0%}", source]
            for name, old, error, new, now, shift, share, source in zip(
                c.parameters,
                found.datasheet.values,
                found.datasheet.standard_error,
                c.values,
                c.standard_errors,
                found.shift,
                found.share,
                found.sources,
                strict=True,
            )
        ],
    )
    r, small = c.residual, choice.small
    show(
        f"|a| off by {small.in_full(r.rms_g)} rms, noise floor {small.in_full(r.noise_floor_g)}; datasheet and poses "
        f"agree with p {probability(found.conflict_p)}"
    )
