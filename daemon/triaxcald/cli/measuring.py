"""poses, fit, diagnose, verify, plan."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.calibration import Calibration
from triaxcal.effects import CATALOGUE
from triaxcal.errors import InvalidData, Refused
from triaxcal.fit import fit
from triaxcal.loop import Loop, diagnose, magnitude_errors
from triaxcal.plan import FULL, PAPER, dilution, directions, most_wanted
from triaxcal.visibility import unseen_effects
from triaxcald import documents
from triaxcald.cli.arguments import add_json, add_recording, count, positive, signs, writable
from triaxcald.cli.console import emit, micro, say, table
from triaxcald.documents import number
from triaxcald.errors import InputError
from triaxcald.files import write_text
from triaxcald.inputs import Measured, measure, read_document
from triaxcald.report.page import render_report
from triaxcald.report.stream import StreamOverview, thin


def register(commands: Any) -> None:
    p = commands.add_parser("poses", help="find the still spans of a recording")
    add_recording(p)
    p.set_defaults(run=poses)
    p = commands.add_parser("fit", help="fit the linear model to a recording's still poses")
    add_recording(p)
    _add_results(p)
    p.set_defaults(run=fit_command)
    p = commands.add_parser("diagnose", help="find, add and judge effects that the linear model lacks")
    add_recording(p)
    _add_results(p)
    p.add_argument("--check", metavar="REC2", help="another recording, whose poses no fit sees")
    p.set_defaults(run=diagnose_command)
    p = commands.add_parser("verify", help="error of the magnitude in every pose under a calibration")
    p.add_argument("calibration", metavar="CAL.json")
    p.add_argument("recording", metavar="REC")
    p.add_argument("--limit", type=positive, metavar="G", help="exit 1 where the rms error is above this")
    add_json(p)
    p.set_defaults(run=verify_command)
    p = commands.add_parser("plan", help="a pose plan, and what it can and cannot see")
    p.add_argument("recording", metavar="REC", nargs="?", help="name the poses that are still worth adding to it")
    p.add_argument("--poses", type=count, metavar="14|26|N", help=f"default {FULL}")
    p.add_argument("--for", dest="effects", nargs="+", metavar="EFFECT", default=[], help="effects it has to show")
    p.add_argument("--sign", type=signs, metavar="S,S,S", help="of the scale factors of REC; write --sign=-,-,-")
    add_json(p)
    p.set_defaults(run=plan_command)


def _add_results(p: argparse.ArgumentParser) -> None:
    p.add_argument("-o", "--output", type=Path, metavar="CAL.json")
    p.add_argument("--report", type=Path, metavar="R.html")
    p.add_argument("--limit", type=positive, metavar="G", help="exit 1 where the rms residual is above this")


def poses(a: argparse.Namespace) -> int:
    measured = measure(a.recording)
    document = documents.poses_document(measured.poses)
    document["data_quality"] = measured.data_quality
    if a.json:
        emit(document)
        return 0
    table(
        f"{len(measured.poses)} still poses in {measured.name}",
        ["start s", "end s", "samples", "mean x", "mean y", "mean z", "standard error"],
        [
            [
                f"{p.start_s:.2f}",
                f"{p.end_s:.2f}",
                p.samples,
                *(f"{v:.7g}" for v in p.mean),
                " ".join(f"{v:.2g}" for v in p.standard_error),
            ]
            for p in measured.poses
        ],
    )
    _warn(measured.data_quality)
    return 0


def fit_command(a: argparse.Namespace) -> int:
    writable(a.output)
    writable(a.report)
    measured = measure(a.recording)
    calibration = fit(measured.poses, signs=_signs(a, measured), reference=a.reference)
    document = documents.calibration_document(calibration, output_unit=_unit(a, measured))
    document["data_quality"] = measured.data_quality
    _write(a, measured, document)
    if a.json:
        emit(document)
    else:
        show_calibration(calibration, _unit(a, measured))
        _warn([*calibration.warnings, *measured.data_quality])
    return _judge(a.limit, calibration.residual.rms_g)


def diagnose_command(a: argparse.Namespace) -> int:
    writable(a.output)
    writable(a.report)
    measured = measure(a.recording)
    check = measure(a.check).poses if a.check else None
    loop = diagnose(measured.poses, signs=_signs(a, measured), reference=a.reference, check=check)
    document = documents.loop_document(loop, data_quality=measured.data_quality, output_unit=_unit(a, measured))
    _write(a, measured, document)
    if a.json:
        emit(document)
    else:
        show_loop(loop)
        show_calibration(loop.after, _unit(a, measured))
        _warn([*loop.after.warnings, *measured.data_quality])
    return _judge(a.limit, loop.after.residual.rms_g)


def verify_command(a: argparse.Namespace) -> int:
    document = read_document(a.calibration)
    sensor, channel_reference, reference = documents.sensor_of(document, where=a.calibration)
    measured = measure(a.recording)
    if not measured.poses:
        raise Refused(f"{a.recording}: no still pose")
    errors, noise = magnitude_errors(sensor, measured.poses, channel_reference=channel_reference, reference=reference)
    rms = float(np.sqrt(np.mean(errors**2)))
    result = {
        "format": "triaxcal.verify/1",
        "rms_g": number(rms),
        "max_abs_g": number(float(np.max(np.abs(errors)))),
        "noise_floor_g": number(float(np.sqrt(np.mean(noise**2)))),
        "poses": [
            {
                "start_s": number(p.start_s),
                "end_s": number(p.end_s),
                "error_g": number(float(e)),
                "standard_error_g": number(float(s)),
            }
            for p, e, s in zip(measured.poses, errors, noise, strict=True)
        ],
    }
    if a.json:
        emit(result)
    else:
        table(
            f"|a| − {reference:g} g under {a.calibration}",
            ["start s", "error µg", "standard error µg"],
            [
                [f"{p.start_s:.2f}", f"{e * 1e6:+.1f}", micro(s)]
                for p, e, s in zip(measured.poses, errors, noise, strict=True)
            ],
        )
        print(f"rms {micro(rms)} µg, noise floor {micro(result['noise_floor_g'])} µg")  # type: ignore[arg-type]
    return _judge(a.limit, rms)


def plan_command(a: argparse.Namespace) -> int:
    known = [e.name for e in CATALOGUE]
    for name in a.effects:
        if name not in known:
            raise InputError(f"--for {name}: no effect of that name; known: {', '.join(known)}")
    if a.recording:
        return _plan_for_recording(a)
    try:
        plan = directions(a.poses or _enough_for(a.effects))
    except InvalidData as e:
        raise InputError(f"--poses: {e}") from e
    ups = np.array([v for _, v in plan])
    blind = unseen_effects(ups)
    document = {
        "format": "triaxcal.plan/1",
        "poses": [{"label": label, "up": documents.numbers(v)} for label, v in plan],
        "dilution": number(dilution(ups)),
        "blind_to": blind,
    }
    if a.json:
        emit(document)
    else:
        _show_poses(f"{len(plan)} poses", plan)
        print(f"worst parameter: {document['dilution']:.2f} standard errors of one pose")
        print(f"cannot show: {', '.join(blind) or 'nothing of the catalogue'}")
    missed = [e for e in a.effects if e in blind]
    if missed:
        raise Refused(f"a plan of {len(plan)} poses cannot show {', '.join(missed)}; take {FULL}")
    return 0


def _enough_for(effects: list[str]) -> int:
    if not effects:
        return FULL
    return next((n for n in (PAPER, FULL) if not set(effects) & set(unseen_effects(_ups(n)))), FULL)


def _ups(n: int) -> Floats:
    return np.array([v for _, v in directions(n)])


def _plan_for_recording(a: argparse.Namespace) -> int:
    measured = measure(a.recording)
    try:
        have = np.array([p.direction for p in fit(measured.poses, signs=_signs(a, measured)).poses])
        dilution_now: float | None = dilution(have)
        wanted = most_wanted(have, enough=1.0)
    except Refused as e:
        dilution_now = None
        by_label = dict(directions(FULL))
        wanted = [(label, by_label[label]) for label in e.wanted]
    document = {
        "format": "triaxcal.plan/1",
        "have": len(measured.poses),
        "dilution": number(dilution_now),
        "poses": [{"label": label, "up": documents.numbers(v)} for label, v in wanted],
    }
    if a.json:
        emit(document)
    else:
        _show_poses(f"poses worth adding to the {len(measured.poses)} of {measured.name}", wanted)
    return 0


def _show_poses(title: str, plan: list[tuple[str, Floats]]) -> None:
    rows = [[i + 1, label, *(f"{c:+.3f}" for c in v)] for i, (label, v) in enumerate(plan)]
    table(title, ["pose", "up", "x", "y", "z"], rows)


def _signs(a: argparse.Namespace, measured: Measured) -> tuple[int, int, int]:
    return a.sign or measured.signs or (1, 1, 1)


def _unit(a: argparse.Namespace, measured: Measured) -> str:
    return a.output_unit or (measured.profile.output.unit if measured.profile else "")


def _judge(limit: float | None, rms: float) -> int:
    if limit is not None and rms > limit:
        say(f"outside the limit: rms {rms:.3g} g, limit {limit:.3g} g")
        return 1
    return 0


def _warn(lines: list[str]) -> None:
    for line in lines:
        say(f"warning: {line}")


def _write(a: argparse.Namespace, measured: Measured, document: documents.Document) -> None:
    if a.output:
        write_text(a.output, documents.to_text(document))
    if a.report:
        limits = {"limits": {"rms_g": a.limit}} if a.limit else None
        page = render_report(document, title=measured.name, stream=_overview(a, measured), certificate=limits)
        write_text(a.report, page)


def _overview(a: argparse.Namespace, measured: Measured) -> StreamOverview | None:
    w = measured.windows
    if w is None:
        return None
    time_s, readings = thin((w.start_ns - int(w.start_ns[0])) * 1e-9, w.mean)
    spans = tuple((p.start_s, p.end_s) for p in measured.poses)
    return StreamOverview(time_s, readings, spans, _unit(a, measured))


def show_calibration(c: Calibration, unit: str) -> None:
    rows = []
    units = {"scale_factor": f"{unit or 'output'}/g", "misalignment": "rad", "bias": "g"}
    of_effects = {f"{e.name}.{k.name}": k.unit for e, _ in c.sensor.effects for k in e.coefficients}
    for name, value, error in zip(c.parameters, c.values, c.standard_errors, strict=True):
        rows.append([name, f"{value:.9g}", f"{error:.2g}", of_effects.get(name, units.get(name.split(".")[0], ""))])
    table("coefficients", ["", "value", "standard error", "unit"], rows)
    r = c.residual
    p = "—" if r.lack_of_fit_p is None else f"{r.lack_of_fit_p:.2g}"
    print(
        f"{len(c.poses)} poses: residual rms {micro(r.rms_g)} µg, cross-validated {micro(r.cross_validated_rms_g)} µg, "
        f"noise floor {micro(r.noise_floor_g)} µg, lack of fit p {p}"
    )


def show_loop(loop: Loop) -> None:
    b, f = loop.before.residual, loop.after.residual
    rows = [
        ["residual rms", micro(b.rms_g), micro(f.rms_g)],
        ["cross-validated rms", micro(b.cross_validated_rms_g), micro(f.cross_validated_rms_g)],
    ]
    if loop.held_out:
        rows.append(["held-out rms", micro(loop.held_out.before_rms_g), micro(loop.held_out.after_rms_g)])
    rows.append(["noise floor", micro(b.noise_floor_g), micro(f.noise_floor_g)])
    table("error of the magnitude, µg", ["", "before", "after"], rows)
    for finding in loop.findings:
        print(f"{finding.verdict}: {finding.effect} ({finding.reason})")
    if not loop.findings:
        print("no effect of the catalogue shows")
    if loop.unexplained.significant:
        print(f"unexplained: {micro(loop.unexplained.rms_g)} µg rms; {loop.unexplained.lead}")
    for line in loop.advice:
        print(f"advice: {line}")
