"""audit, log."""

from __future__ import annotations

import argparse
import dataclasses
import io
import sys
from pathlib import Path
from typing import Any

from triaxcal_drivers.profile import READINGS
from triaxcald.cli.arguments import add_json
from triaxcald.cli.console import emit, say
from triaxcald.errors import InputError
from triaxcald.files import new_file
from triaxcald.inputs import CALIBRATION, bundle_of
from triaxcald.pipeline import Pipeline
from triaxcald.recording.export import write_csv
from triaxcald.recording.info import describe
from triaxcald.recording.reader import Recording
from triaxcald.recording.recover import recover


def register(commands: Any) -> None:
    p = commands.add_parser("audit", help="recompute results from recordings and compare")
    p.add_argument("recordings", metavar="REC|FOLDER|GLOB", nargs="+", type=Path)
    add_json(p)
    p.set_defaults(run=audit_command)
    log = commands.add_parser("log", help="a recording's contents; mend one; write CSV")
    parts = log.add_subparsers(dest="part", required=True, metavar="info|recover|export")
    p = parts.add_parser("info", help="what a recording holds")
    p.add_argument("recording", metavar="REC", type=Path)
    add_json(p)
    p.set_defaults(run=info_command)
    p = parts.add_parser("recover", help="mend a recording that was cut short, and say what was lost")
    p.add_argument("recording", metavar="REC", type=Path)
    p.add_argument("-o", "--output", type=Path, help="default: REC with .recovered before .mcap")
    add_json(p)
    p.set_defaults(run=recover_command)
    p = parts.add_parser("export", help="write the samples as CSV")
    p.add_argument("recording", metavar="REC", type=Path)
    p.add_argument("-o", "--output", type=Path, help="default: standard output")
    p.add_argument("--stream", default=READINGS)
    p.add_argument("--phase", default=CALIBRATION, choices=["calibration", "verification"])
    p.set_defaults(run=export_command)


def audit_command(a: argparse.Namespace) -> int:
    from triaxcald.audit import audit_each, text, worst  # the whole line, which no `log` needs

    audited = []
    for one in audit_each(a.recordings):
        audited.append(one)
        if one.audit is None:
            say(f"triaxcal: {one.error}")
        elif not a.json:
            print(text.heading(one.audit))
            for line in map(text.difference, one.audit.differences):
                print(f"  {line}")
            for line in text.notes(one.audit.notes):
                print(f"  note: {line}")
    if a.json:
        emit({"format": "triaxcal.audit/1", "audits": [text.document(x) for x in audited],
              "summary": text.counts(audited)})  # fmt: skip
    elif len(audited) > 1:
        print(text.summary(audited))
    return worst(audited)


def info_command(a: argparse.Namespace) -> int:
    document = describe(a.recording)
    if a.json:
        emit(document)
    else:
        _show(document)
    return 0


def _show(value: Any, indent: str = "") -> None:
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
        if isinstance(inner, (dict, list)) and inner:
            print(f"{indent}{key}:")
            _show(inner, indent + "  ")
        else:
            print(f"{indent}{key}: {'—' if inner in (None, {}, []) else inner}")


def recover_command(a: argparse.Namespace) -> int:
    out = a.output or a.recording.with_suffix(".recovered" + a.recording.suffix)
    recovery = recover(a.recording, out)
    if a.json:
        emit({"format": "triaxcal.recovery/1", "output": str(out), **dataclasses.asdict(recovery)})
    else:
        print(f"{out}: written")
        _show(dataclasses.asdict(recovery), "  ")
    return 0


def export_command(a: argparse.Namespace) -> int:
    with Recording.open(a.recording) as recording:
        bundle = bundle_of(recording)
        if a.stream not in bundle.profile.streams:
            raise InputError(f"--stream {a.stream}: the recording has {', '.join(bundle.profile.streams)}")
        pipeline = Pipeline(bundle, a.stream)
        blocks = (pipeline.feed(batch) for batch in recording.raw(a.phase))
        if a.output is None:
            rows = write_csv(sys.stdout, blocks)
        else:
            try:
                with new_file(a.output) as file, io.TextIOWrapper(file, "utf-8") as out:
                    rows = write_csv(out, blocks)
            except OSError as e:
                raise InputError(f"{a.output}: cannot be written: {e.strerror}") from e
    lost = ", ".join(f"{n} {kind}" for kind, n in pipeline.counts.items() if n and kind != "samples")
    say(f"{rows} samples; {lost or 'none lost'}")
    return 0
