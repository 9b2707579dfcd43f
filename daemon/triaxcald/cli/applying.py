"""apply."""

from __future__ import annotations

import argparse
import gzip
import io
from pathlib import Path
from typing import Any

from triaxcal.documents import Calibration
from triaxcald.applied import Applied, applied
from triaxcald.cli.arguments import writable
from triaxcald.cli.console import say
from triaxcald.cli.showing import warn
from triaxcald.errors import InputError
from triaxcald.files import new_beside
from triaxcald.inputs import CALIBRATION, read_document
from triaxcald.recording.columns import write_parquet
from triaxcald.recording.export import write_csv

KINDS = (".csv", ".csv.gz", ".parquet")


def register(commands: Any) -> None:
    p = commands.add_parser(
        "apply",
        help="calibrated readings of a recording",
        description="Writes the samples of a recording with the calibrated readings ax, ay, az in the unit of the "
        "reference vector (g, unless the calibration names another), effects included.",
        epilog="example: triaxcal apply CAL.json recording.csv -o calibrated.csv",
    )
    p.add_argument("calibration", metavar="CAL", help="a calibration, loop or certificate document")
    p.add_argument("recording", metavar="REC", help=".mcap, .csv, .csv.gz or - for standard input")
    p.add_argument("-o", "--output", metavar="OUT", type=Path, required=True, help=f"{', '.join(KINDS)}")
    p.add_argument("--uncertainty", action="store_true", help="also u_ax, u_ay, u_az: what the calibration leaves open")
    p.add_argument(
        "--own-recording", action="store_true",
        help="REC is the recording that was calibrated: effects of time at each of its times",
    )  # fmt: skip
    p.add_argument("--phase", default=CALIBRATION, choices=["calibration", "verification"], help="of an .mcap")
    p.set_defaults(run=apply_command)


def apply_command(a: argparse.Namespace) -> int:
    if not a.output.name.endswith(KINDS):
        raise InputError(f"{a.output}: expected a name that ends in {', '.join(KINDS)}")
    writable(a.output)
    calibration = Calibration.from_dict(read_document(a.calibration), where=a.calibration)
    found = applied(calibration, a.recording, uncertainty=a.uncertainty, own_recording=a.own_recording, phase=a.phase)
    with new_beside(a.output) as path:
        samples = _written(found, path, a.output.name)
    warn(found.missing)
    say(f"{a.output}: {samples} samples, {', '.join(calibration.terms)}, in {calibration.reference_unit}")
    return 0


def _written(found: Applied, path: Path, name: str) -> int:
    if name.endswith(".parquet"):
        return write_parquet(path, found.blocks, found.start_ns)
    with path.open("wb") as file:
        packed = gzip.GzipFile(fileobj=file, mode="wb", mtime=0) if name.endswith(".gz") else file
        with io.TextIOWrapper(packed, "utf-8", newline="\n") as out:
            return write_csv(out, found.blocks, found.start_ns)
