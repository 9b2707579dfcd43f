"""apply."""

from __future__ import annotations

import argparse
import gzip
import io
from pathlib import Path

import triaxcal as tc
from triaxcald.applied import Applied, applied
from triaxcald.cli.console import say
from triaxcald.cli.showing import reading_of, warn
from triaxcald.cli.syntax import writable
from triaxcald.errors import InputError
from triaxcald.files import new_beside
from triaxcald.inputs import CALIBRATION, read_document
from triaxcald.recording.export import write_csv
from triaxcald.tables.arrow import write_parquet

FRAME = "in the sensor's own frame (triaxcal frame turns it into a housing's)"
KINDS = (".csv", ".csv.gz", ".parquet")


def apply_command(a: argparse.Namespace) -> int:
    if not a.output.name.endswith(KINDS):
        raise InputError(f"{a.output}: expected a name that ends in {', '.join(KINDS)}")
    writable(a.output)
    if a.own_recording and a.phase != CALIBRATION:
        raise InputError(f"--own-recording: the {a.phase} phase has no times of the recording that was fitted")
    calibration = tc.Calibration.from_dict(read_document(a.calibration), where=a.calibration)
    found = applied(
        calibration,
        a.recording,
        uncertainty=a.uncertainty,
        own_recording=a.own_recording,
        phase=a.phase,
        reading=reading_of(a, a.recording, calibration),
        output_unit=a.output_unit or "",
    )
    for remark in found.remarks:
        say(f"{a.recording}: {remark}")
    with new_beside(a.output) as path:
        samples = _written(found, path, a.output.name)
    warn(found.cautions)
    how = f"{', '.join(calibration.terms)}, in {calibration.reference_unit}, {FRAME}"
    say(f"{a.output}: {tc.number_format.number_of(samples, 'sample')}, {how}")
    return 0


def _written(found: Applied, path: Path, name: str) -> int:
    if name.endswith(".parquet"):
        return write_parquet(path, found.blocks, found.start_ns)
    with path.open("wb") as file:
        packed = gzip.GzipFile(filename="", fileobj=file, mode="wb", mtime=0) if name.endswith(".gz") else file
        with io.TextIOWrapper(packed, "utf-8", newline="\n") as out:
            return write_csv(out, found.blocks, found.start_ns)
