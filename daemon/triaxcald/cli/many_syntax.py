"""The commands at many recordings, with their arguments and help."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from triaxcald.cli.syntax import add_command, add_json, count, size

WHICH = "REC|FOLDER|GLOB|LIST|URL"


def register_many(commands: Any) -> None:
    _audit(commands)


def add_many(p: Any, table: bool = False) -> None:
    """Which recordings, where the work runs, and where the rows go; ``table``: they
    have to go somewhere."""
    p.add_argument(
        "recordings", metavar=WHICH, nargs="+",
        help="recordings, folders, patterns, lists (.list) with a path or URL a line, and URLs (s3://…)",
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
    add_json(p)
