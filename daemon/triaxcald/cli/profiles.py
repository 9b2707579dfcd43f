"""devices check, devices new."""

from __future__ import annotations

import argparse

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.cli.console import emit, show, table
from triaxcald.imports.profile_check import check
from triaxcald.schema.profile_check import CalibrationOf, LogOf, ProfileCheck

SHOWN = 40
"""Kinds of frames in the table; a vehicle's bus has hundreds, and `--json` has all."""


def check_command(a: argparse.Namespace) -> int:
    bundle = td.load_bundle(a.profile)
    found = check(bundle, a.log, node=a.node, channel=a.channel)
    if a.json:
        emit(found.document())
    else:
        _show(found)
    return 1 if found.problems else 0


def new_command(a: argparse.Namespace) -> int:
    for line in td.new_profile(a.kind).splitlines():
        show(line)
    return 0


def _show(found: ProfileCheck) -> None:
    show(f"{found.profile} (driver {found.driver}{''.join(f', {name}' for name in found.files)}): {found.title or '—'}")
    if found.source:
        show(f"source: {found.source}")
    for stream in found.streams:
        messages = "".join(f", {m.name} {m.identifier}" for m in stream.messages)
        show(f"streams.{stream.name}: {stream.place}{messages}")
        table(f"streams.{stream.name}", ["channel", "place"], [[c.name, c.place] for c in stream.channels])
    if found.registers:
        table(
            "registers",
            ["name", "place", "type", "access", "unit", "role"],
            [[r.name, r.place, r.type, r.access, r.unit, r.role] for r in found.registers],
        )
    for name, steps in found.sequences.items():
        show(f"sequences.{name}: {'; '.join(steps)}")
    if found.calibration is not None:
        _show_calibration(found.calibration)
    if found.log is not None:
        _show_log(found.log)
    for note in found.notes:
        show(f"note: {note}")
    for problem in found.problems:
        show(f"problem: {problem.text}")
    if not found.problems:
        show("no problem found")


def _show_calibration(calibration: CalibrationOf) -> None:
    rows = []
    for one in calibration.roles:
        unit = "g" + (f"/{one.per}" if one.per else "")
        rows.append([one.role, one.name, _figure(one.least_g), _figure(one.most_g), _figure(one.resolution_g), unit])
    title = "what the registers could hold, as what it makes of 1 g"
    table(title, ["role", "register", "least", "most", "resolution", "unit"], rows)


def _show_log(log: LogOf) -> None:
    rows = [
        [f.identifier, f.kind, f.channel, f.count, _figure(f.rate_hz), _length(f.bytes_least, f.bytes_most),
         ", ".join(f.streams) or "nobody", f.canopen]
        for f in log.frames[:SHOWN]
    ]  # fmt: skip
    node = "" if log.node is None else f", node {log.node}"
    title = f"{log.file} ({log.kind}{node})"
    table(title, ["identifier", "kind", "channel", "count", "per s", "bytes", "used by", "CANopen"], rows)
    if len(log.frames) > SHOWN:
        show(f"… and {len(log.frames) - SHOWN} more, which --json has")
    for name, stream in log.streams.items():
        lost = "".join(f", {n} {kind}" for kind, n in stream.lost.items())
        rate = "" if stream.rate_hz is None else f", {stream.rate_hz:.4g} a second by the log"
        samples = tc.number_format.number_of(stream.samples, "sample")
        show(f"streams.{name}: {samples} in {stream.seconds:.2f} s{rate}{lost}")
        if stream.at_rest is not None:
            in_g = "" if stream.at_rest_g is None else f", {stream.at_rest_g:.4g} times the nominal output per g"
            poses = tc.number_format.number_of(stream.still_poses, "still pose")
            show(f"streams.{name}: |u| at rest {stream.at_rest:.5g}{in_g} (median of {poses})")
        if stream.constant:
            show(f"streams.{name}: constant: {', '.join(stream.constant)}")


def _figure(value: float | None) -> str:
    return "—" if value is None else f"{value:.4g}"


def _length(least: int, most: int) -> str:
    return str(least) if least == most else f"{least}–{most}"
