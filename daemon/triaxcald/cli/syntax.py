"""All commands with their arguments and help. Imports nothing that works: a
command's own module is imported to run it.

``run`` of what is parsed names module and function ("fitting:fit_command"),
``computes`` whether the command needs linear algebra."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NoReturn

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.files import require_writable
from triaxcald.printable import printable
from triaxcald.schema.codes import Code
from triaxcald.tables.naming import TIME_UNITS, parse_columns
from triaxcald.work import wrong

# Arguments that several commands share, and a parser whose errors are one line.

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
            close = td.hints.closest(
                unknown.lstrip("-"), (o[2:] for o in self._option_string_actions if o.startswith("--"))
            )
            hint = f"; did you mean --{close}?" if close else ""
            if not any(word.startswith("-") for word in left) and self._takes_one_recording():
                hint = f"; {self.prog} takes one recording, `triaxcal diagnose` several of one unit together"
            self.error(f"unrecognized arguments: {' '.join(left)}{hint}")
        return found, left

    def _takes_one_recording(self) -> bool:
        return any(action.dest == "recording" and action.nargs in (None, "?") for action in self._actions)

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


def moment(text: str) -> tc.Moment | float:
    """`end`, `mean`, or seconds from the first sample."""

    if text in (tc.Moment.END, tc.Moment.MEAN):
        return tc.Moment(text)
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
    return within(text, *tc.HEIGHTS_M, f"metres between {tc.HEIGHTS_M[0]:g} and {tc.HEIGHTS_M[1]:g}")


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


def whole(text: str) -> int:
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
    add_measuring(parser)
    add_json(parser)
    add_table(parser)


def add_measuring(parser: argparse.ArgumentParser) -> None:
    """What the readings are and what they measure."""
    parser.add_argument("--sign", type=signs, metavar="S,S,S", help="signs of the scale factors; write --sign=-,-,-")
    parser.add_argument("--output-unit", metavar="UNIT", help="unit of the readings, for the documents")
    parser.add_argument(
        "--reference",
        type=positive,
        metavar="R",
        help="magnitude of the reference vector in its own unit; default: the recording's, else 1 g",
    )
    parser.add_argument("--reference-unit", metavar="UNIT", help="that unit, for the documents")


def add_table(parser: argparse.ArgumentParser) -> None:
    """Options for reading a table."""
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
    """Options about the reference and the thermometer, for the budget."""
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


def words(text: str) -> str:
    """A text that goes into a document, as the type of an argument. Raises
    ArgumentTypeError."""
    try:
        text.encode()
    except UnicodeEncodeError:  # bytes of the command line that are no UTF-8
        raise argparse.ArgumentTypeError("expected text in UTF-8") from None
    return text


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


LABEL = re.compile(r"(\*|(?:[+-][XYZ]){1,3}|N[0-9]+)(?:@(-?[0-9]+(?:\.[0-9]+)?))?")
LEAST_SQUARES = "least_squares"
PHASES = ("calibration", "verification")
READINGS = "readings"


def register(commands: Any) -> None:
    """Add the commands in the order in which a newcomer meets them."""
    _line(commands)
    _on_recordings(commands)
    _planning(commands)
    _devices(commands)
    _access(commands)
    _logs(commands)


def add_command(
    commands: Any, name: str, run: str, help_line: str, more: str = "", example: str = "", *, computes: bool = False
) -> Any:
    """``more`` follows the line in the command's own help, and the ``example``
    stands below the options. One that ``computes`` loads the linear algebra
    before it reads a file, while there is room for it: OpenBLAS that finds none
    later ends the process with 1."""
    p = commands.add_parser(
        name,
        help=help_line,
        description=f"{help_line[:1].upper()}{help_line[1:]}." + (f" {more}" if more else ""),
        epilog=f"example: triaxcal {example}" if example else None,
    )
    p.set_defaults(run=run, computes=computes)
    return p


def add_odds(p: Any, more: str = "") -> None:
    p.add_argument(
        "--odds", metavar="FILE", help=f"odds of each effect, learned from units of the type (`fleet -o`){more}"
    )


def _line(commands: Any) -> None:
    p = add_command(
        commands, "demo", "stations:demo_command", "the whole line on two simulated units, in about a minute",
        "A CAN and a Modbus unit with hidden effects are recorded, calibrated, written, power-cycled and verified.",
        "demo --out demo-out",
    )  # fmt: skip
    p.add_argument("--out", type=Path, default=Path("demo-out"), metavar="DIR", help="default: demo-out")
    p.add_argument("--seed", type=whole, default=1, help="of the units' hidden effects, noise and poses; default: 1")
    p.add_argument(
        "--page",
        action="store_true",
        help="on the page of a station, which runs a tray by itself",
    )
    p.add_argument("--port", type=port, default=8484, help="of the page; default: 8484")
    add_json(p)
    p = add_command(
        commands, "run", "stations:run_command", "the whole line on the devices of a station file",
        "Guides the operator from pose to pose; records, calibrates, writes the registers and verifies them.",
        "run station.toml",
    )  # fmt: skip
    p.add_argument("station", metavar="STATION.toml", type=Path)
    p.add_argument(
        "--rezero", action="append", metavar="CAL",
        help="renew the three biases of this calibration alone, by plan.rezero_poses poses; of several units once each",
    )  # fmt: skip
    add_odds(p, "; in place of those that the station names")
    _add_work(p)
    add_force(p)
    add_json(p)
    p.add_argument(
        "--events", action="store_true", help="one JSON object a line on standard output, as the work goes on"
    )
    p = add_command(
        commands, "serve", "serve:serve_command", "the service and the page of a station",
        "People scan, turn and see PASS or FAIL in a browser; programs use the interface under /api/1. Runs, units and "
        "figures are in triaxcal.sqlite in the station's folder, or in PostgreSQL.",
        "serve station.toml", computes=True,
    )  # fmt: skip
    p.add_argument("station", metavar="STATION.toml", type=Path)
    p.add_argument("--host", default="127.0.0.1", help="address to listen at; default: 127.0.0.1, this machine alone")
    p.add_argument("--port", type=port, default=8484, help="default: 8484; 0 takes one that is free")
    p.add_argument("--database", metavar="URL", help="of PostgreSQL; default: triaxcal.sqlite in the station's folder")
    p.add_argument("--cert", metavar="FILE", type=Path, help="certificate (PEM), needed beyond this machine")
    p.add_argument("--key", metavar="FILE", type=Path, help="its key (PEM)")
    p.add_argument("--backup", metavar="FILE", type=Path, help="copy the database, also of a service at work, and end")
    p = add_command(
        commands, "sim", "stations:sim_command", "serve simulated units on their buses until stopped",
        "Several units are on one fixture, with one clock. It turns by itself; with --follow an operator turns it, who "
        "does what a run says: after the reaction_s of a device file's [fixture], 1 s by default, and in 1 of 50 turns "
        "to a wrong side.",
        "sim can.toml modbus.toml --follow events.jsonl",
    )  # fmt: skip
    p.add_argument("devices", metavar="DEVICE.toml", type=Path, nargs="+")
    p.add_argument(
        "--follow", metavar="FILE|-|URL",
        help="turn the units and switch their supplies as the events of `run --events` say, from a file that grows, a "
        "FIFO, standard input, or a station's service (http://…)",
    )  # fmt: skip
    p = add_command(
        commands, "record", "record:record_command", "record only",
        "A unit that is absent or lost is waited for; the gap is in the recording. A bus of the station is recorded "
        "with all its frames, for `log import`.",
        "record station.toml -o rec.mcap --seconds 120",
    )  # fmt: skip
    p.add_argument("station", metavar="STATION.toml", type=Path)
    p.add_argument(
        "-o", "--output", type=Path, required=True, metavar="REC.mcap|FOLDER",
        help="a recording, which must not exist; or a folder, which must: all units and buses, each into its own file",
    )  # fmt: skip
    p.add_argument(
        "--seconds", type=positive, metavar="S",
        help="of the samples' time, of a bus by the clock; default: until interrupted",
    )  # fmt: skip
    p.add_argument("--unit", help="or bus, where the station has more than one; default, with a FOLDER: all of them")
    p.add_argument(
        "--give-up-after", type=not_negative, metavar="S", help="of waiting for a unit or a bus; default: without end"
    )
    p.add_argument("--no-start", action="store_true", help="send no start sequence of the profile")
    p.add_argument(
        "--segment-size", type=size, metavar="SIZE", help="a new file after so much, as 256M, with a manifest"
    )
    p.add_argument("--segment-time", type=duration, metavar="TIME", help="a new file after so long, as 1h")
    p.add_argument("--keep", type=duration, metavar="TIME", help="delete segments older than this, as 30d")
    p.add_argument("--keep-free", type=size, metavar="SIZE", help="delete the oldest while less of the disk is free")
    p.add_argument(
        "--metrics", type=port, metavar="PORT", help="numbers for Prometheus and a health page on the loopback"
    )
    p.add_argument("--log-format", choices=("text", "json"), default="text", help="of progress; json: an object a line")
    p = add_command(
        commands, "results", "results:results_command", "one row for each run in a station's folder",
        "Shows the runs, or writes them with all their columns to a table.",
        "results out --since 2026-01-01 -o runs.csv",
    )  # fmt: skip
    p.add_argument("folder", metavar="FOLDER", type=Path)
    p.add_argument(
        "--since", metavar="TIME", help="runs that began at or after this date or time: ISO 8601, UTC without an offset"
    )
    p.add_argument("--until", metavar="TIME", help="runs that began before this time, or on or before this date")
    p.add_argument("--serial", help="runs of this serial number, reported or expected")
    p.add_argument("--code", type=_code, metavar="CODE", help="runs that ended with this code, as fit_outside")
    p.add_argument(
        "--rebuild", action="store_true",
        help="read all outcomes anew, and make the rows of the database from them",
    )  # fmt: skip
    p.add_argument(
        "--database",
        metavar="URL",
        help="with --rebuild: rows of the station in PostgreSQL, postgresql://USER@HOST/NAME",
    )
    p.add_argument("-o", "--output", type=Path, metavar="TABLE", help=".csv, .csv.gz or .parquet")
    add_json(p)


def _code(text: str) -> str:
    try:
        return str(Code(text))
    except ValueError:
        close = td.hints.closest(text, map(str, Code))
        hint = f"did you mean {close}?" if close else f"there are {', '.join(Code)}"
        raise argparse.ArgumentTypeError(f"no code '{text}'; {hint}") from None


def _add_work(p: argparse.ArgumentParser) -> None:
    """What the units are measured for."""
    g = p.add_argument_group("work", "stored in recording, outcome and events; by default as in the station file")
    g.add_argument(
        "--serial", action="append", type=_slot_serial, default=[], metavar="SLOT=SERIAL",
        help="expected serial number of a slot; of several slots once each",
    )  # fmt: skip
    for name, help_line in (
        ("operator", "operator"),
        ("order", "work order"),
        ("batch", "batch"),
        ("part-number", "part number"),
        ("fixture", "fixture"),
        ("reason", "reason of a re-test"),
    ):
        g.add_argument(f"--{name}", type=_work_text, metavar="TEXT", help=help_line)


def _work_text(text: str) -> str:
    if fault := wrong(text):
        raise argparse.ArgumentTypeError(fault)
    return text


def _slot_serial(text: str) -> tuple[str, str]:
    slot, equals, serial = text.partition("=")
    if not equals or not slot:
        raise argparse.ArgumentTypeError(f"expected SLOT=SERIAL as in left=1042, not '{text}'")
    return slot, _work_text(serial)


def _on_recordings(commands: Any) -> None:
    p = add_command(
        commands, "poses", "measuring:poses", "find the still spans of a recording",
        "Means and standard errors are in the output's unit, times in seconds from the first sample. No threshold is "
        "set: the noise is learned from the recording.", "poses rec.csv",
        computes=True,
    )  # fmt: skip
    add_recording(p)
    p = add_command(
        commands, "fit", "fitting:fit_command", "fit the linear model to a recording's still poses",
        "Scale factors, misalignments [rad] and biases [g] with their standard errors; at least 9 poses, better 14.",
        "fit rec.csv --sign=-,-,- -o cal.json --report fit.html",
        computes=True,
    )  # fmt: skip
    add_recording(p)
    add_ways(p)
    _add_results(p)
    p = add_command(
        commands, "diagnose", "fitting:diagnose_command", "find, add and judge effects that the linear model lacks",
        "Nonlinearity, temperature, drift, hysteresis and more, with the error of the magnitude [g] before and after.",
        "diagnose rec.csv --check other.csv -o cal.json --report loop.html",
        computes=True,
    )  # fmt: skip
    add_recording(p, several="several are of one unit, in order of time")
    _add_results(p)
    p.add_argument(
        "--units", action="store_true", help="each recording is of another unit: judge each, then whether they agree"
    )
    p.add_argument("--verbose", action="store_true", help="tables too: errors, probabilities, coefficients, budget")
    add_moment(p)
    add_odds(p)
    p.add_argument("--check", metavar="REC2", help="another recording of the same unit, whose poses no fit sees")
    p = add_command(
        commands, "rezero", "fitting:rezero_command", "renew the three biases of a calibration by a few poses",
        "Scale factors, misalignments and effects are kept; three distinct poses are needed, four are better.",
        "rezero cal.json rec.csv --poses 4 -o cal2.json",
        computes=True,
    )  # fmt: skip
    p.add_argument("calibration", metavar="CAL", help="a calibration, loop or certificate document")
    add_recording(p)
    p.add_argument("--poses", type=count, metavar="N", help="the first N distinct poses; default: all")
    _add_files(p)
    p = add_command(
        commands, "apply", "measuring:apply_command", "calibrated readings of a recording",
        "Writes its samples with ax, ay, az behind them, in the unit of the reference vector (g, unless the "
        "calibration names another), effects included.", "apply cal.json rec.csv -o calibrated.csv",
        computes=True,
    )  # fmt: skip
    p.add_argument("calibration", metavar="CAL", help="a calibration, loop or certificate document")
    p.add_argument("recording", metavar="REC", help=RECORDING)
    p.add_argument("-o", "--output", metavar="OUT", type=Path, required=True, help=".csv, .csv.gz or .parquet")
    add_applying(p)
    add_table(p)
    p = add_command(
        commands, "verify", "measuring:verify_command", "error of the magnitude in every pose under a calibration",
        "Errors are |a| less the reference, in its unit, with the standard error that noise gives each.",
        "verify cal.json rec.csv --limit 2e-4",
        computes=True,
    )  # fmt: skip
    p.add_argument("calibration", metavar="CAL.json")
    add_recording(p)
    add_error_limit(p)
    _frame(commands)


def add_moment(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--at", type=moment, metavar="end|mean|SECONDS",
        help="of the recording: the moment for which effects of time hold elsewhere (default: end)",
    )  # fmt: skip


def add_applying(p: argparse.ArgumentParser) -> None:
    p.add_argument("--uncertainty", action="store_true", help="also u_ax, u_ay, u_az: what the calibration leaves open")
    p.add_argument(
        "--own-recording", action="store_true",
        help="REC is the recording that was calibrated: effects of time at each of its times",
    )  # fmt: skip
    p.add_argument("--phase", default=PHASES[0], choices=PHASES, help="of an .mcap")
    p.add_argument("--output-unit", metavar="UNIT", help="unit of REC's outputs, whatever its header says")


def add_error_limit(p: argparse.ArgumentParser) -> None:
    p.add_argument("--limit", type=positive, metavar="G", help="exit 1 where the rms error is above this, in g")


def add_ways(parser: argparse.ArgumentParser) -> None:
    ways = parser.add_mutually_exclusive_group()
    ways.add_argument("--turning", action="store_true", help="the unit turned and never rested: fit all samples")
    ways.add_argument("--attitudes", metavar="ATT.csv", help="which way was up in each pose, from a turntable")
    ways.add_argument(
        "--datasheet", "--passport", metavar="CAL.json",
        help="values known from before, to be refined by the poses",
    )  # fmt: skip
    parser.add_argument(
        "--attitude-error", type=_attitude_error, metavar="RAD",
        help="standard error of the attitudes by axis; default: estimated",
    )  # fmt: skip
    parser.add_argument(
        "--datasheet-error", "--passport-error", type=_three_errors, metavar="REL,RAD,G",
        help="standard errors of the datasheet's scale factors (relative), misalignments, biases; default: its own",
    )  # fmt: skip


def _attitude_error(text: str) -> float:
    return within(text, 0.0, 0.3, "radians between 0 and 0.3")


def _three_errors(text: str) -> tuple[float, float, float]:
    try:
        relative, angle, bias = (not_negative(part) for part in text.split(","))
    except (ValueError, argparse.ArgumentTypeError):
        message = f"expected three numbers of at least 0 as in 1e-3,1e-3,5e-3, not '{text}'"
        raise argparse.ArgumentTypeError(message) from None
    return relative, angle, bias


def _add_results(p: argparse.ArgumentParser) -> None:
    add_uncertainty(p)
    _add_files(p)


def _add_files(p: argparse.ArgumentParser) -> None:
    p.add_argument("-o", "--output", type=Path, metavar="CAL.json", help="the document; not a file that is read")
    p.add_argument("--report", type=Path, metavar="R.html", help="the same for people, in one file")
    add_residual_limit(p)


def add_residual_limit(p: argparse.ArgumentParser) -> None:
    p.add_argument("--limit", type=positive, metavar="G", help="exit 1 where the rms residual is above this, in g")


def _frame(commands: Any) -> None:
    p = add_command(
        commands, "frame", "framing:frame_command", "units on one fixture in the frame of its faces",
        "Rotations from each sensor's frame to the fixture's, in rad.", "frame left.csv right.csv --datum=-Z,-X",
        computes=True,
    )  # fmt: skip
    add_recording(p, several="one of each unit")
    p.add_argument(
        "--calibration",
        action="append",
        metavar="CAL.json|own",
        help="one for each REC in order; default: each is fitted from its own recording",
    )
    known = p.add_mutually_exclusive_group()
    known.add_argument(
        "--faces",
        action="append",
        type=_faces,
        metavar="L,L,…",
        help="sides that were up in order of time, +X@90 with the heading in degrees, * for no face; once for all REC "
        "or once for each; write --faces=-X,… with the equals sign",
    )
    known.add_argument("--plan", metavar="PLAN.json", help="a triaxcal.plan/1 document: its labels in order")
    p.add_argument(
        "--datum",
        type=_datum,
        metavar="FACE,FACE",
        help="primary and secondary face, as --datum=-Z,-X; default least_squares",
    )
    p.add_argument("--table-tilt", type=_angle, metavar="RAD", help="how far the table may be from level, at most")
    p.add_argument("--seating-error", type=_angle, metavar="RAD", help="standard error of one seating of the fixture")
    p.add_argument("--turn-error", type=_angle, default=0.0, metavar="RAD", help="standard error of a turn; default 0")
    p.add_argument("--limit", type=positive, metavar="RAD", help="exit 1 where a standard error is above this")
    p.add_argument("-o", "--output", type=Path, metavar="FRAME.json", help="the document")


def _faces(text: str) -> list[tuple[str, float | None]]:
    """Labels, each with its heading in rad."""
    out: list[tuple[str, float | None]] = []
    for word in text.split(","):
        match = LABEL.fullmatch(word.strip().upper())
        if not match:
            raise argparse.ArgumentTypeError(f"expected labels as in +X,+X,-X@180,*, not '{word}'")
        out.append((match[1], None if match[2] is None else math.radians(float(match[2]))))
    return out


def _datum(text: str) -> tuple[str, str] | None:
    """Two faces; None for the least-squares frame."""
    if text == LEAST_SQUARES:
        return None
    faces = [part.strip().upper() for part in text.split(",")]
    square = len(faces) == 2 and all(re.fullmatch("[+-][XYZ]", f) for f in faces) and faces[0][1] != faces[1][1]
    if not square:
        wanted = f"expected {LEAST_SQUARES}, or two faces at right angles as in -Z,-X, not '{text}'"
        raise argparse.ArgumentTypeError(wanted)
    return faces[0], faces[1]


def _angle(text: str) -> float:
    return within(text, 0.0, math.nextafter(1.0, 0.0), "an angle of 0 to 1 rad")


def _planning(commands: Any) -> None:
    p = add_command(
        commands, "plan", "planning:plan_command", "a pose plan, and what it can and cannot see",
        "With a recording: the poses that are still worth adding to it.", "plan --poses 26",
        computes=True,
    )  # fmt: skip
    p.add_argument(
        "--poses", type=count, metavar="14|26|N", help="distinct directions, the first repeated at the end; 26"
    )
    p.add_argument("--for", dest="effects", nargs="+", metavar="EFFECT", default=[], help="effects it has to show")
    add_recording(p, optional=True)


def _devices(commands: Any) -> None:
    p = add_command(
        commands, "provision", "provisioning:provision_command",
        "write a calibration to the device's registers and verify it",
        "Unlocks, writes what differs, stores, restarts and reads back; what the device holds is said at every way "
        "out.", "provision cal.json station.toml --dry-run",
    )  # fmt: skip
    p.add_argument("calibration", metavar="CAL.json", nargs="?")
    p.add_argument("station", metavar="STATION.toml", type=Path)
    p.add_argument("--unit", help="where the station has more than one")
    p.add_argument("--dry-run", action="store_true", help="read and compare, write nothing")
    p.add_argument("--resume", action="store_true", help="finish a provisioning that was cut short, by its journal")
    _add_power_cycle(p)
    add_force(p)
    add_json(p)
    p = add_command(
        commands, "restore", "provisioning:restore_command",
        "put the registers back that a recording or a journal has kept", "", "restore rec.mcap station.toml",
    )  # fmt: skip
    p.add_argument("source", metavar="REC|JOURNAL", type=Path)
    p.add_argument("station", metavar="STATION.toml", type=Path)
    p.add_argument("--unit", help="where the station has more than one; by default the one of that name in the source")
    _add_power_cycle(p)
    add_json(p)
    p = add_command(
        commands, "registers", "devices:registers_command", "read and explain the device's calibration registers",
        "", "registers station.toml",
    )  # fmt: skip
    p.add_argument("station", metavar="STATION.toml", type=Path)
    p.add_argument("--unit", help="where the station has more than one")
    add_json(p)
    p = add_command(
        commands, "devices", "devices:devices_command",
        "drivers, profiles and effects found, broken ones with their reason",
    )  # fmt: skip
    add_json(p)
    parts = p.add_subparsers(dest="part", metavar="[check|new]")
    p = add_command(
        parts, "check", "profiles:check_command", "show what resolves of a profile, and what a log holds by it",
        "LOG is one that log import takes, or a recording of a unit. Exit 1 if there are problems.",
        "devices check imu.toml drive.blf",
    )  # fmt: skip
    p.add_argument("profile", metavar="PROFILE", type=Path)
    p.add_argument("log", metavar="LOG", type=Path, nargs="?")
    _add_selection(p)
    add_json(p)
    p = add_command(
        parts, "new", "profiles:new_command", "print a commented profile to begin with",
        "", "devices new can-dbc > my-device.toml",
    )  # fmt: skip
    p.add_argument("kind", choices=NEW_PROFILES, metavar="|".join(NEW_PROFILES), help="bus and layout of the samples")


NEW_PROFILES = ("can-dbc", "can-pdo", "modbus-poll", "modbus-fifo")


def _add_selection(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--channel", metavar="NAME",
        help="the bus, where the log has the unit's frames on several; of MCAP the number of the channel",
    )  # fmt: skip
    p.add_argument(
        "--node", type=whole, metavar="N",
        help="the unit's node, where identifiers shift with it, or its source address (J1939), where several send",
    )  # fmt: skip


def _add_power_cycle(p: argparse.ArgumentParser) -> None:
    p.add_argument(
        "--power-cycle", action="store_true", help="have the supply switched off and on where nothing else verifies"
    )


ROLES = ("reader", "operator", "engineer")


def _access(commands: Any) -> None:
    people = commands.add_parser("people", help="who may sign in to a station's service")
    parts = people.add_subparsers(dest="part", required=True, metavar="add|list|pin|role|disable|enable")
    for part, help_line, more in (
        ("add", "add a person", ""),
        ("list", "show the people and their roles", ""),
        ("pin", "give a person another PIN", "Sessions of the person end."),
        ("role", "give a person another role", "It counts at once."),
        ("disable", "keep a person from signing in", "Sessions of the person end."),
        ("enable", "let a disabled person sign in again", ""),
    ):
        example = {"list": "people list", "role": "people role Ada engineer", "add": "people add Ada --role operator"}
        p = add_command(
            parts, part, f"people:people_{part}", help_line, more,
            f"{example.get(part, f'people {part} Ada')} --station station.toml",
        )  # fmt: skip
        if part != "list":
            p.add_argument("name", metavar="NAME", help="1 to 64 printable characters")
        if part == "role":
            p.add_argument("role", metavar="|".join(ROLES), choices=ROLES)
        if part == "add":
            p.add_argument("--role", choices=ROLES, required=True, help="each may do what those before it may")
        if part in ("add", "pin"):
            p.add_argument(
                "--pin-file", metavar="FILE|-",
                help="with the PIN, 4 to 64 characters; - for standard input; default: ask at the terminal",
            )  # fmt: skip
        _add_database(p)
    token = commands.add_parser("token", help="which programs may use a station's service")
    parts = token.add_subparsers(dest="part", required=True, metavar="new|list|revoke")
    p = add_command(
        parts, "new", "people:token_new", "make a token for a program",
        "The token alone is on standard output; it is shown this once.",
        "token new mes --role operator --station station.toml",
    )  # fmt: skip
    p.add_argument("name", metavar="NAME", help="of the program, 1 to 64 printable characters")
    p.add_argument("--role", choices=ROLES, required=True, help="each may do what those before it may")
    _add_database(p)
    p = add_command(
        parts, "list", "people:token_list", "show the tokens by their names", "", "token list --station station.toml"
    )
    _add_database(p)
    p = add_command(
        parts, "revoke", "people:token_revoke", "refuse a token from now on", "",
        "token revoke mes --station station.toml",
    )  # fmt: skip
    p.add_argument("name", metavar="NAME")
    _add_database(p)


def _add_database(p: argparse.ArgumentParser) -> None:
    p.add_argument("--station", metavar="STATION.toml", type=Path, required=True, help="whose service it is")
    p.add_argument(
        "--database", metavar="URL",
        help="of PostgreSQL, as for serve; default: triaxcal.sqlite in the station's folder",
    )  # fmt: skip


def _logs(commands: Any) -> None:
    log = commands.add_parser("log", help="a recording's contents; mend one; write CSV; take over other logs")
    parts = log.add_subparsers(dest="part", required=True, metavar="info|recover|delete|export|import")
    p = add_command(
        parts, "info", "recordings:info_command", "show the contents of a recording", "", "log info rec.mcap"
    )
    p.add_argument("recording", metavar="REC", type=Path)
    p.add_argument(
        "--count", action="store_true",
        help="count every record and sample; by default of more than 1,000,000 raw records only what the index has",
    )  # fmt: skip
    add_json(p)
    p = add_command(
        parts, "recover", "recordings:recover_command", "mend a recording that was cut short, and say what was lost",
        "", "log recover rec.mcap",
    )  # fmt: skip
    p.add_argument("recording", metavar="REC", type=Path)
    p.add_argument("-o", "--output", type=Path, help="default: REC with .recovered before .mcap")
    add_json(p)
    p = add_command(
        parts, "delete", "recordings:delete_command", "delete recordings of a station, and sign that and why",
        "The outcome stays, and so does the tombstone in the chain.",
        "log delete old.mcap --station station.toml --reason 'older than ten years'",
    )  # fmt: skip
    p.add_argument("recordings", metavar="REC", nargs="+", type=Path)
    p.add_argument("--station", metavar="STATION.toml", type=Path, required=True, help="whose key signs it")
    p.add_argument("--reason", metavar="TEXT", type=words, required=True)
    add_json(p)
    p = add_command(
        parts, "export", "recordings:export_command", "write the samples as CSV", "", "log export rec.mcap -o rec.csv"
    )
    p.add_argument("recording", metavar="REC", type=Path)
    p.add_argument("-o", "--output", type=Path, help="default: standard output")
    p.add_argument("--stream", default=READINGS, help="or corrected: the device's own output, in g")
    p.add_argument("--phase", default=PHASES[0], choices=PHASES, help="verification: the check poses after writing")
    p = add_command(
        parts, "import", "recordings:import_command", "make a recording of a log that others recorded",
        "BLF, ASC, candump, TRC, MF4, pcap and pcapng of SocketCAN, or MCAP with messages of ROS 2, JSON or protobuf, "
        "told by the file's first bytes; packed with gzip or not.",
        "log import drive.blf --profile imu.toml -o rec.mcap",
    )  # fmt: skip
    p.add_argument("log", metavar="LOG", type=Path)
    p.add_argument("--profile", metavar="P", type=Path, required=True, help="of the device whose frames are in it")
    p.add_argument("-o", "--output", metavar="REC.mcap", type=Path, required=True)
    _add_selection(p)
    add_json(p)
