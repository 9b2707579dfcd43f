"""log import."""

from __future__ import annotations

import argparse
from contextlib import nullcontext

from triaxcal_drivers.loading import load_bundle
from triaxcal_drivers.logs.kinds import Kind, opened
from triaxcald.cli.arguments import writable
from triaxcald.cli.console import emit, say, show
from triaxcald.errors import InputError
from triaxcald.files import require_new, require_recording
from triaxcald.imports import text
from triaxcald.imports.of_recording import is_own, own_log


def import_command(a: argparse.Namespace) -> int:
    writable(a.output)
    require_new(a.output)
    require_recording(a.output)
    bundle = load_bundle(a.profile)
    driver = bundle.profile.driver
    if driver not in ("can", "mcap"):
        raise InputError(f"{a.profile}: driver '{driver}' has no logs that can be imported, expected can or mcap")
    if driver == "mcap" and a.node is not None:
        raise InputError("--node: of a CAN bus; the profile's driver is 'mcap'")
    own = driver == "can" and is_own(a.log)
    with nullcontext(own_log(a.log)) if own else opened(a.log) as log:
        if isinstance(log.kind, Kind) != (driver == "can"):
            name = log.kind.name if isinstance(log.kind, Kind) else log.kind
            held = "frames of CAN" if driver == "can" else "messages"
            raise InputError(f"{a.log}: {name}, which holds no {held}; the profile's driver is '{driver}'")
        if driver == "can":
            from triaxcald.imports.of_can import import_can  # each with what it needs alone

            made = import_can(log, bundle, a.output, node=a.node, channel=a.channel)
        else:
            from triaxcald.imports.of_mcap import import_mcap

            made = import_mcap(log, bundle, a.output, channel=a.channel)
    for line in (text.left_out(made.document), *text.remarks(made.document, made.seconds)):
        if line:
            say(line)
    if a.json:
        emit({"format": "triaxcal.import/1", "output": str(a.output), "duration_s": made.seconds, **made.document})
    else:
        show(text.summary(a.output, made.document, made.seconds))
    return 0
