"""log import."""

from __future__ import annotations

import argparse

from triaxcal_drivers.loading import load_bundle
from triaxcal_drivers.logs.kinds import NAMES, Kind, opened
from triaxcald.cli.arguments import writable
from triaxcald.cli.console import emit, say
from triaxcald.errors import InputError
from triaxcald.imports import text


def import_command(a: argparse.Namespace) -> int:
    writable(a.output)
    bundle = load_bundle(a.profile)
    driver = bundle.profile.driver
    if driver != "can":
        raise InputError(f"{a.profile}: driver '{driver}' has no logs that can be imported, expected can")
    with opened(a.log) as log:
        if not isinstance(log.kind, Kind):
            raise InputError(f"{a.log}: an {log.kind} file, which holds no frames of a bus; expected {NAMES}")
        from triaxcald.imports.of_can import import_can  # numpy and what writes recordings

        made = import_can(log, bundle, a.output, node=a.node, channel=a.channel)
    for line in (text.left_out(made.document), *text.remarks(made.document)):
        if line:
            say(line)
    if a.json:
        emit({"format": "triaxcal.import/1", "output": str(a.output), "duration_s": made.seconds, **made.document})
    else:
        print(text.summary(a.output, made.document, made.seconds))
    return 0
