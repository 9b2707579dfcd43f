"""Arguments that several commands share, and a parser whose errors are one
line."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

from triaxcal.model.gravity import HEIGHTS_M
from triaxcal.model.samples import Moment
from triaxcal_drivers.nearest import closest
from triaxcald.errors import InputError
from triaxcald.files import require_writable
from triaxcald.printable import printable
from triaxcald.tables.naming import TIME_UNITS, parse_columns

RECORDING = ".mcap or .segments.json, a table (.csv, .csv.gz, .txt, .parquet) or - for text on standard input"


class OneLineParser(argparse.ArgumentParser):
    """Says what is wrong in one line and ends with 2. Options may stand
    anywhere between files."""

    _mixing = False

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """A command's own arguments, which its parent hands on by this method."""
        if self._mixing or self._subparsers is not None:
            return super().parse_known_args(args, namespace)
        self._mixing = True
        try:
            found, left = self.parse_known_intermixed_args(args, namespace)
        finally:
            self._mixing = False
        if left:
            unknown = next((word for word in left if word.startswith("--")), "").partition("=")[0]
            close = closest(unknown.lstrip("-"), (o[2:] for o in self._option_string_actions if o.startswith("--")))
            hint = f"; did you mean --{close}?" if close else ""
            self.error(f"unrecognized arguments: {' '.join(left)}{hint}")
        return found, left

    def error(self, message: str) -> NoReturn:
        for option, example in (("--sign", "-,-,-"), ("--faces", "-X,-X"), ("--datum", "-Z,-X")):
            if option in message and "expected one argument" in message:
                message += f"; write it with an equals sign: {option}={example}"
        sys.stderr.write(printable(f"{self.prog}: {message}") + "\n")
        sys.exit(2)


def parsed(parser: OneLineParser, arguments: Sequence[str]) -> argparse.Namespace:
    chosen = argparse.Namespace()
    _, left = parser.parse_known_args(arguments, chosen)
    if left:
        parser.error(f"unrecognized arguments: {' '.join(left)}")
    return chosen


def signs(text: str) -> tuple[int, int, int]:
    parts = [p.strip() for p in text.split(",")]
    known = {"+": 1, "-": -1, "+1": 1, "-1": -1, "1": 1, "−": -1}
    if len(parts) != 3 or any(p not in known for p in parts):
        raise argparse.ArgumentTypeError(f"expected three signs as in -,-,+, not '{text}'")
    return known[parts[0]], known[parts[1]], known[parts[2]]


def moment(text: str) -> Moment | float:
    """`end`, `mean`, or seconds from the first sample."""
    if text in (Moment.END, Moment.MEAN):
        return Moment(text)
    try:
        return not_negative(text)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"expected end, mean or seconds of at least 0, not '{text}'") from None


def positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not (0 < value < float("inf")):
        raise argparse.ArgumentTypeError(f"expected a positive number, not '{text}'")
    return value


def not_negative(text: str) -> float:
    return within(text, 0.0, sys.float_info.max, "a number of at least 0")


def duration(text: str) -> float:
    """Seconds; a letter says which unit it is in: s, m, h, d."""
    seconds = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
    number, unit = (text[:-1], text[-1]) if text[-1:] in seconds else (text, "s")
    try:
        return positive(number) * seconds[unit]
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"expected a time as 90s, 15m, 12h or 30d, not '{text}'") from None


def size(text: str) -> int:
    """Bytes; a letter says which unit they are in: k, M, G (powers of 1024)."""
    factors = {"k": 2**10, "M": 2**20, "G": 2**30}
    number, factor = (text[:-1], factors[text[-1]]) if text[-1:] in factors else (text, 1)
    try:
        return round(positive(number) * factor)
    except argparse.ArgumentTypeError:
        raise argparse.ArgumentTypeError(f"expected a size as 500k, 256M or 2G, not '{text}'") from None


def port(text: str) -> int:
    if not text.isdecimal() or int(text) > 65535:
        raise argparse.ArgumentTypeError(f"expected a port between 0 and 65535, 0 for any, not '{text}'")
    return int(text)


def latitude(text: str) -> float:
    return within(text, -90.0, 90.0, "degrees between -90 and 90")


def height(text: str) -> float:
    return within(text, *HEIGHTS_M, f"metres between {HEIGHTS_M[0]:g} and {HEIGHTS_M[1]:g}")


def within(text: str, low: float, high: float, wanted: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not low <= value <= high:
        raise argparse.ArgumentTypeError(f"expected {wanted}, not '{text}'")
    return value


def count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 1, not '{text}'")
    return int(text)


def seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a whole number of at least 0, not '{text}'")
    return int(text)


def add_force(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--force", metavar="REASON", help="write though what the device holds is implausible; the reason is recorded"
    )


def add_json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="one JSON document on standard output")


def add_recording(parser: argparse.ArgumentParser, *, optional: bool = False, several: str = "") -> None:
    """``several`` says of what there may be several recordings."""
    recording = parser.add_argument(
        "recording", metavar="REC", help=f"{RECORDING}; {several}" if several else RECORDING
    )
    if optional:
        recording.nargs, recording.required = "?", False
    if several:
        recording.nargs = "+"
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
    add_table(parser)


def add_table(parser: argparse.ArgumentParser) -> None:
    """How a table is to be read that is no recording of ours."""
    g = parser.add_argument_group("tables", "text with separators, or Parquet; what is clear is guessed and said")
    g.add_argument(
        "--columns", type=_columns, metavar="t=T,ux=X,uy=Y,uz=Z",
        help="columns by name, or by number from 1 where there is no header; also channels, as temp_c=T1",
    )  # fmt: skip
    g.add_argument("--time-unit", choices=TIME_UNITS, help="of the column of time; index: samples, with --rate")
    g.add_argument("--rate", type=positive, metavar="HZ", help="samples a second, where no times are told")
    g.add_argument("--pose-means", action="store_true", help="each row is the mean of a pose, and needs no time")
    g.add_argument("--skip-bad", action="store_true", help="leave lines out that lack a number; they are counted")
    g.add_argument(
        "--where", type=_condition, action="append", metavar="NAME=VALUE", help="only the rows with that in the column"
    )


def _columns(text: str) -> dict[str, str]:
    try:
        return parse_columns(text)
    except ValueError as e:
        raise argparse.ArgumentTypeError(str(e)) from None


def _condition(text: str) -> tuple[str, str]:
    name, equals, value = (part.strip() for part in text.partition("="))
    if not equals or not name:
        raise argparse.ArgumentTypeError(f"expected NAME=VALUE as in sensor=ACC, not '{text}'")
    return name, value


def add_uncertainty(parser: argparse.ArgumentParser) -> None:
    """What is known of the reference and the thermometer, for the budget."""
    parser.add_argument(
        "--latitude", type=latitude, metavar="DEG", help="with --height: gravity there is the reference"
    )
    parser.add_argument("--height", type=height, metavar="M", help="above sea level")
    parser.add_argument(
        "--reference-uncertainty", type=not_negative, metavar="U", help="its standard uncertainty, in its unit"
    )
    parser.add_argument(
        "--thermometer-uncertainty", type=not_negative, metavar="K", help="its standard uncertainty, in kelvin"
    )
    parser.add_argument(
        "--thermal-sensitivity",
        type=not_negative,
        metavar="S",
        help="by how much 1 K changes the bias of such units, in references, and their scale factors, relatively",
    )


def writable(path: Path | None) -> None:
    """Fail before the work, not after it, where a result could not be written.
    Raises InputError."""
    if path is None:
        return
    if not path.parent.is_dir():
        raise InputError(f"{path}: there is no folder {path.parent}")
    require_writable(path)


def keep_apart(chosen: argparse.Namespace) -> None:
    """Raises InputError, before anything is read or written, where a file is to
    be written over one that is read, or two files over each other."""
    written = {
        f"--{name}": path for name in ("output", "report") if isinstance(path := getattr(chosen, name, None), Path)
    }
    read = [v for name, value in vars(chosen).items() if f"--{name}" not in written for v in _paths(value)]
    for option, path in written.items():
        if path.is_file() and any(v.is_file() and v.samefile(path) for v in read):
            raise InputError(f"{option}: {path}: it would overwrite what is read; write to another file")
    if len(written) > len({path.absolute() for path in written.values()}):
        raise InputError(f"--output, --report: {path}: one would overwrite the other; write to two files")


def _paths(value: object) -> list[Path]:
    if isinstance(value, list):
        return [p for v in value for p in _paths(v)]
    return [Path(value)] if isinstance(value, (str, Path)) and "\0" not in str(value) else []
