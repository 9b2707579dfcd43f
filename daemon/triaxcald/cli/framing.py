"""frame: units on one fixture in the frame of its faces."""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

import triaxcal as tc
from triaxcald import documents
from triaxcald.cli.console import emit, say, show, table
from triaxcald.cli.showing import fit_settings, read_recording, telling_data_quality, warn
from triaxcald.cli.syntax import writable
from triaxcald.errors import DONE, OUTSIDE, InputError
from triaxcald.files import write_text
from triaxcald.framing import Source, frame_document, own_source, source_under
from triaxcald.inputs import Measured, read_document, require_unit

OWN = "own"
NO_FACE = "*"

Labels = list[tuple[str, float | None]]


def frame_command(a: argparse.Namespace) -> int:
    writable(a.output)
    names = list(a.recording)
    if names.count("-") > 1:
        raise InputError("-: standard input can be one recording, not several")
    calibrations = _for_each(a.calibration, names, "--calibration") or [OWN] * len(names)
    labels = _for_each(a.faces, names, "--faces", one_for_all=True) or _planned(a.plan, names)
    assumed = tc.frames.Assumed(a.seating_error, a.table_tilt, a.turn_error)
    sources: list[Source] = []
    standings: list[tc.frames.Standing] = []
    for name, calibration, given in zip(names, calibrations, labels, strict=True):
        with _of(name):
            source, standing = _placed(a, name, calibration, [s.name for s in sources], given, assumed)
            sources.append(source)
            standings.append(standing)
    result = tc.frames.frames(standings, datum=tc.frames.Datum(a.datum) if a.datum else None)
    document = frame_document(sources, result)
    if a.output:
        write_text(a.output, documents.to_text(document))
    if a.json:
        emit(document)
    else:
        _show(sources, result)
        for unit in document["units"]:
            prefix = f"{unit['name']}: " if len(sources) > 1 else ""
            warn([f"{prefix}{line}" for line in [*unit["warnings"], *unit["data_quality"]]])
        warn(document["warnings"])
    worst = float(max(unit.standard_error.max() for unit in result.units))
    if a.limit is not None and not worst <= a.limit:
        say(f"outside the limit: standard error {worst:.3g} rad, limit {a.limit:.3g}")
        return OUTSIDE
    if result.agree is False:
        say(f"not one fixture: the units disagree on its faces, p {tc.number_format.probability(result.lack_of_fit_p)}")
        return OUTSIDE
    return DONE


def _for_each(given: list[Any] | None, names: Sequence[str], option: str, *, one_for_all: bool = False) -> list[Any]:
    if not given:
        return []
    if one_for_all and len(given) == 1:
        return given * len(names)
    if len(given) != len(names):
        once = "once, or once for each recording" if one_for_all else "once for each recording"
        raise InputError(f"{option}: given {len(given)} times for {len(names)} recordings; expected {once}")
    return given


def _planned(path: str | None, names: Sequence[str]) -> list[Labels | None]:
    if path is None:
        return [None] * len(names)
    document = read_document(path)
    if document.get("format") != "triaxcal.plan/1":
        raise InputError(f"{path}: format: expected triaxcal.plan/1{tc.interchange.but_is(document)}")
    poses = document.get("poses")
    if not isinstance(poses, list) or not poses:
        raise InputError(f"{path}: poses: expected a list of poses")
    labels: Labels = []
    for i, pose in enumerate(poses):
        label = pose.get("label") if isinstance(pose, dict) else None
        if not isinstance(label, str):
            raise InputError(f"{path}: poses[{i}].label: expected a label as +X")
        labels.append((label, None))
    return [labels] * len(names)


@contextmanager
def _of(name: str) -> Iterator[None]:
    """Says which recording it is that something is wrong with."""
    try:
        yield
    except tc.Refused as e:
        raise tc.Refused(f"{name}: {e}", wanted=e.wanted) from e
    except tc.InvalidData as e:
        raise InputError(f"{name}: {e}") from e


def _placed(
    a: argparse.Namespace,
    name: str,
    calibration: str,
    taken: Sequence[str],
    given: Labels | None,
    assumed: tc.frames.Assumed,
) -> tuple[Source, tc.frames.Standing]:
    """Poses of a recording, split at half turns.

    On a level table a turn and a knock differ in their length alone. If labels state
    the number of poses, that many of the longest disturbances were turns.
    """
    measured = read_recording(a, name, turn_s=tc.poses.TURN_S)
    with telling_data_quality(measured):
        source = _source(a, measured, name, calibration, taken)
        try:
            return source, _stand(source, given, assumed)
        except tc.frames.Miscounted:
            for turn_s in _lengths(measured):
                with suppress(tc.InvalidData, tc.Refused):
                    assert measured.parted is not None
                    source = _source(a, measured.parted(turn_s), name, calibration, taken)
                    return source, _stand(source, given, assumed)
            raise


def _lengths(measured: Measured) -> list[float]:
    """Durations of the disturbances that did not change the readings, the longest
    first."""
    if measured.windows is None:
        return []
    found = {span.since_s for span in tc.poses.find_spans(measured.windows, turn_s=0.0)}
    return sorted(found | {math.inf}, reverse=True)


def _source(a: argparse.Namespace, measured: Measured, name: str, calibration: str, taken: Sequence[str]) -> Source:
    settings = fit_settings(a, measured)
    unit = measured.unit or {}
    called = unit.get("serial") or re.sub(r"(\.csv\.gz|\.csv|\.mcap)$", "", Path(name).name)
    if called in taken:
        called = next(f"{called} ({n})" for n in range(2, len(taken) + 3) if f"{called} ({n})" not in taken)
    if calibration == OWN:
        fitted = tc.estimate.fit(measured.poses, signs=settings.signs, reference=settings.reference)
        return own_source(
            called, measured, fitted, output_unit=settings.output_unit, reference_unit=settings.reference_unit
        )
    document = read_document(calibration)
    sensor, _, reference = tc.interchange.sensor_of(document, where=calibration)
    signs = a.sign or measured.signs
    if signs and any(k * s < 0 for k, s in zip(sensor.scale_factor, signs, strict=True)):
        whose = "--sign" if a.sign else f"{name}: signs"
        raise InputError(f"{whose}: the scale factors in {calibration} have other signs")
    if a.reference and not math.isclose(a.reference, reference, rel_tol=1e-9):
        raise InputError(f"--reference {a.reference:g}: {calibration} was made for {reference:g}")
    require_unit(document, measured, where=calibration)
    if not measured.poses:
        raise tc.Refused("no still pose", wanted=tc.frames.LABELS)
    return source_under(
        called,
        measured,
        document,
        where=calibration,
        output_unit=settings.output_unit,
        reference_unit=a.reference_unit or tc.units.reference_unit_of(reference),
    )


def _stand(source: Source, given: Labels | None, assumed: tc.frames.Assumed) -> tc.frames.Standing:
    found = source.found
    labelling: tc.frames.Labelling
    if given is None:
        labelling = tc.frames.recognise(found.direction, found.used)
    else:
        known = {label for label, _ in tc.planning.directions()} | {NO_FACE}
        strange = [label for label, _ in given if label not in known and not label.startswith("N")]
        if strange:
            raise InputError(f"label {strange[0]}: no such side; known: {', '.join(tc.frames.LABELS)}, * for no face")
        labelling = tc.frames.labelled(found.direction, found.used, [x for x, _ in given], [h for _, h in given])
    return tc.frames.stand(found, labelling, assumed)


def _show(sources: Sequence[Source], result: tc.frames.Frames) -> None:
    rotations, stood = [], []
    for source, unit in zip(sources, result.units, strict=True):
        errors = unit.standard_error
        expanded = errors * unit.coverage_factor()
        for k, axis in enumerate("xyz"):
            vector = unit.rotation_vector[k]
            rotations.append(
                [
                    "" if k else source.name,
                    axis,
                    _mrad(vector),
                    _mrad(errors[k]),
                    _mrad(expanded[k]),
                    f"{np.degrees(vector):.4f}",
                ]
            )
        seen, standing = unit.standing.table, unit.standing
        tilt = [_mrad(seen.tilt), _mrad(seen.standard_error), seen.source]
        stood.append([source.name, ", ".join(standing.faces), *tilt, _mrad(standing.seating)])
    table(
        f"rotation vector from the sensor's frame to the body's, datum {result.datum.name}, mrad",
        ["unit", "about", "value", "standard error", "expanded (95 %)", "value °"],
        rotations,
    )
    table("tilt of the table, mrad", ["unit", "sides up", "tilt", "standard error", "from", "seating error"], stood)
    fixture = result.fixture
    faces = [
        [tc.frames.opposite(label), *(f"{_mrad(-e)} ± {_mrad(s)}" for e, s in zip(error, errors, strict=True))]
        for label, error, errors in zip(fixture.faces, fixture.error, fixture.standard_error, strict=True)
    ]
    table("errors of the faces' outward normals, mrad ± standard error", ["face", "x", "y", "z"], faces)
    for axes, q in fixture.squareness.items():
        show(f"squareness {axes}: {_mrad(q.value)} ± {_mrad(q.standard_error)} mrad")
    if fixture.offset is not None:
        known = _mrad(float(np.max(fixture.offset)))
        show(f"the datum against the frame that the fixture's maker meant: ± {known} mrad about an axis at most")
    if result.left:
        show(f"do the units agree on the faces: p {result.lack_of_fit_p:.2g} in {result.left} degrees of freedom")


def _mrad(value: float | None) -> str:
    return "—" if value is None else f"{value * 1e3:.4f}"
