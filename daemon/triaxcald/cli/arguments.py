"""Arguments that several commands share, and a parser whose errors are one line."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import NoReturn

from triaxcald.errors import InputError


class OneLineParser(argparse.ArgumentParser):
    """Says what is wrong in one line and ends with 2."""

    def error(self, message: str) -> NoReturn:
        if "--sign" in message and "expected one argument" in message:
            message += "; write it with an equals sign: --sign=-,-,-"
        sys.stderr.write(f"{self.prog}: {message}\n")
        sys.exit(2)


def signs(text: str) -> tuple[int, int, int]:
    parts = [p.strip() for p in text.split(",")]
    known = {"+": 1, "-": -1, "+1": 1, "-1": -1, "1": 1, "−": -1}
    if len(parts) != 3 or any(p not in known for p in parts):
        raise argparse.ArgumentTypeError(f"expected three signs as in -,-,+, not '{text}'")
    return known[parts[0]], known[parts[1]], known[parts[2]]


def positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not (0 < value < float("inf")):
        raise argparse.ArgumentTypeError(f"expected a positive number, not '{text}'")
    return value


def count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, not '{text}'")
    return int(text)


def seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 0, not '{text}'")
    return int(text)


def add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")


def add_recording(parser: argparse.ArgumentParser, *, optional: bool = False) -> None:
    recording = parser.add_argument("recording", metavar="REC", help=".mcap, .csv, .csv.gz or - for standard input")
    if optional:
        recording.nargs, recording.required = "?", False
    parser.add_argument("--sign", type=signs, metavar="S,S,S", help="signs of the scale factors; write --sign=-,-,-")
    parser.add_argument("--output-unit", metavar="UNIT", help="unit of the readings, for the documents")
    parser.add_argument(
        "--reference",
        type=positive,
        metavar="R",
        help="magnitude of the reference vector in its own unit; default: the recording's, else 1 g",
    )
    parser.add_argument("--reference-unit", metavar="UNIT", help="that unit, for the documents")
    add_json(parser)


def writable(path: Path | None) -> None:
    """Fail before the work, not after it, where a result could not be written. Raises InputError."""
    if path is not None and not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
