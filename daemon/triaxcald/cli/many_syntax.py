"""The commands at many recordings and outcomes, with their arguments and help."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from triaxcald.cli.syntax import (
    add_applying,
    add_command,
    add_error_limit,
    add_json,
    add_measuring,
    add_moment,
    add_odds,
    add_residual_limit,
    add_table,
    add_uncertainty,
    add_ways,
    count,
    positive,
    size,
)

WHICH = "REC|FOLDER|GLOB|MANIFEST|URL"


def register_many(commands: Any) -> None:
    _audit(commands)
    _batch(commands)
    _fleet(commands)


def add_many(p: Any, table: bool = False) -> None:
    """Which recordings, where the work runs, and where the rows go; ``table``: they
    have to go somewhere."""
    p.add_argument(
        "recordings", metavar=WHICH, nargs="+",
        help="recordings, folders, patterns, manifests (.list: a path or URL a line), and URLs (s3://…)",
    )  # fmt: skip
    p.add_argument(
        "-o", "--output", type=Path, metavar="TABLE", required=table,
        help=".parquet, .csv, .csv.gz or .sqlite: a row for each recording, stored as it comes",
    )  # fmt: skip
    p.add_argument(
        "--resume", action="store_true", help="finish TABLE: recordings that have not changed since are not done again"
    )
    where = p.add_mutually_exclusive_group()
    where.add_argument(
        "--jobs", type=count, metavar="N", help="processes on this machine, 1 for this one; default: a core each"
    )
    where.add_argument("--scheduler", metavar="ADDRESS", help="of a Dask cluster, as tcp://10.0.0.5:8786")
    p.add_argument(
        "--memory", type=size, metavar="SIZE",
        help="that a process may take, as 500M; default: 300M for each but this one",
    )  # fmt: skip


def _audit(commands: Any) -> None:
    p = add_command(
        commands, "audit", "many:audit_command", "recompute results from recordings and compare",
        "A summary follows several; one unreadable file hides no other.", "audit recordings/ -o audits.parquet",
        computes=True,
    )  # fmt: skip
    add_many(p)
    _add_other_versions(p)
    _add_signatures(p)
    add_json(p)


def _add_signatures(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--trust", metavar="FILE", type=Path,
        help="with the trusted keys; default: trust.toml in the recording's folder or above it",
    )  # fmt: skip
    p.add_argument("--allow-unsigned", action="store_true", help="unsigned recordings, and keys unknown, may pass")
    p.add_argument("--chain", action="store_true", help="look for recordings that were removed or inserted, too")
    p.add_argument("--head", metavar="DIGEST", help="with --chain: of an entry that it had, by an earlier audit")


def _add_other_versions(p: argparse.ArgumentParser) -> None:
    """Of an audit: recordings that other versions made."""
    p.add_argument(
        "--within", metavar="X", type=positive,
        help="figures of another triaxcal, numpy or scipy may be off by so much of their uncertainty, as 0.01",
    )  # fmt: skip
    p.add_argument(
        "--as-made", action="store_true",
        help="audit under the versions that made the recording, in an environment built of --wheels",
    )  # fmt: skip
    p.add_argument("--wheels", metavar="FOLDER", type=Path, help="with wheels of these versions; nothing is downloaded")


def _batch(commands: Any) -> None:
    batch = commands.add_parser("batch", help="a command at many recordings, into one table")
    parts = batch.add_subparsers(dest="part", required=True, metavar="poses|fit|diagnose|verify|apply")
    p = _part(parts, "poses", "count the still poses of many recordings, and their noise")
    add_measuring(p)
    add_table(p)
    p = _part(parts, "fit", "fit the linear model to each of many recordings")
    add_measuring(p)
    add_ways(p)
    add_uncertainty(p)
    add_residual_limit(p)
    add_table(p)
    p = _part(parts, "diagnose", "diagnose each of many recordings by itself")
    add_measuring(p)
    add_uncertainty(p)
    add_moment(p)
    add_odds(p)
    add_residual_limit(p)
    add_table(p)
    p = _part(parts, "verify", "verify many recordings under a calibration", "--calibration beside")
    _add_calibration(p)
    add_measuring(p)
    add_error_limit(p)
    add_table(p)
    p = _part(parts, "apply", "write calibrated readings of many recordings", "--calibration beside --to calibrated")
    _add_calibration(p)
    p.add_argument(
        "--to", type=Path, metavar="FOLDER", required=True,
        help="for NAME.csv of each recording; one that is there is not overwritten",
    )  # fmt: skip
    p.add_argument("--format", dest="kind", choices=("csv", "csv.gz", "parquet"), default="csv", help="of these files")
    add_applying(p)
    add_table(p)


def _part(parts: Any, name: str, help_line: str, options: str = "") -> Any:
    example = f"batch {name} recordings/ {options} -o {name}.parquet".replace("  ", " ")
    p = add_command(parts, name, "batch:batch_command", help_line, "", example, computes=True)
    add_many(p, table=True)
    return p


def _add_calibration(p: Any) -> None:
    p.add_argument(
        "--calibration", metavar="CAL|beside", required=True,
        help="a calibration, loop or certificate document; beside: of each recording NAME.cal.json, else "
        "NAME.calibration.json or NAME.certificate.json",
    )  # fmt: skip


def _fleet(commands: Any) -> None:
    p = add_command(
        commands, "fleet", "fleet:fleet_command", "what only many units show: scatter, drift, charts, gauge studies",
        "Reads the outcomes of a folder, or a service's database, and the certificates beside them.",
        "fleet out --report fleet.html --table fleet.csv",
        computes=True,
    )  # fmt: skip
    p.add_argument(
        "source", metavar="FOLDER|DATABASE",
        help="folder of outcomes, triaxcal.sqlite, or postgresql://USER@HOST/NAME with the runs of all its stations",
    )  # fmt: skip
    p.add_argument("--since", metavar="TIME", help="runs that began at or after this date or time, as for results")
    p.add_argument("--until", metavar="TIME", help="runs that began before this time, or on or before this date")
    for name, what in (
        ("part-number", "part number"), ("batch", "batch"), ("station", "station"), ("fixture", "fixture"),
        ("slot", "slot"), ("operator", "operator"), ("order", "work order"), ("serial", "serial number"),
    ):  # fmt: skip
        p.add_argument(f"--{name}", metavar="TEXT", help=f"runs of this {what} alone")
    p.add_argument(
        "--limit", type=positive, metavar="G",
        help="of the error of |a| at the end of a recalibration interval; default: that of the latest run",
    )  # fmt: skip
    p.add_argument(
        "--probability", type=_share, default=0.05, metavar="P",
        help="that the error is beyond the limit then; default 0.05",
    )  # fmt: skip
    p.add_argument(
        "-o", "--output", type=Path, metavar="ODDS.json",
        help="odds of each effect for the next unit of one part number, as --odds of run and diagnose takes them",
    )  # fmt: skip
    p.add_argument("--report", type=Path, metavar="PAGE.html", help="the page, in one file")
    p.add_argument("--table", type=Path, metavar="TABLE", help="a row a unit and figure: .csv, .csv.gz or .parquet")
    add_json(p)


def _share(text: str) -> float:
    """Between 0 and 1."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1:
        raise argparse.ArgumentTypeError(f"expected a number between 0 and 1, not '{text}'")
    return value
