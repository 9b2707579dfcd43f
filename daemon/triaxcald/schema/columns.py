"""One row for each run: the columns of `triaxcal results`, of the table `run` in
`triaxcal.sqlite` and of `triaxcal.results/1`, and where an outcome holds them.
Without the models: a run reads them."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum, auto
from typing import Final

Key = tuple[str | int, ...]


class Kind(Enum):
    """Kind of a cell."""

    TEXT = auto()
    TEXTS = auto()
    """A list of texts: a JSON text in SQL, joined by "; " in a table."""
    WHOLE = auto()
    NUMBER = auto()


@dataclass(frozen=True)
class Column:
    """``key`` is the place in the outcome; None where the index makes the cell.
    ``required`` columns are never empty."""

    name: str
    kind: Kind
    key: Key | None
    meaning: str
    required: bool = False


def _text(name: str, meaning: str, *key: str, required: bool = False) -> Column:
    return Column(name, Kind.TEXT, key or (name,), meaning, required)


def _figures() -> list[Column]:
    """Each figure of the fit and of the check poses: before, after, limit."""
    found = []
    for name, what, before, after in (
        ("rms", "rms of the fit's residual", ("measured", "before", "rms_g"), ("measured", "after", "rms_g")),
        (
            "cross_validated_rms", "cross-validated rms of the fit",
            ("measured", "before", "cross_validated_rms_g"), ("measured", "after", "cross_validated_rms_g"),
        ),
        (
            "verification_rms", "rms error of the device's own output",
            ("verification", "before_rms_g"), ("verification", "after_rms_g"),
        ),
    ):  # fmt: skip
        old, new = (
            ("with the old registers", "in the check poses")
            if name == "verification_rms"
            else ("before: of the linear model or the earlier calibration", "of the final calibration")
        )
        found += [
            Column(f"{name}_before_g", Kind.NUMBER, before, f"{what}, {old} [g]"),
            Column(f"{name}_g", Kind.NUMBER, after, f"{what}, {new} [g]"),
            Column(f"{name}_limit_g", Kind.NUMBER, ("limits", f"{name}_g"), f"limit of `{name}_g` [g]"),
        ]
    return found


def _coefficients() -> list[Column]:
    found = []
    for name, unit in (("scale_factor", "output/g"), ("misalignment", "rad"), ("bias", "g")):
        for i, axis in enumerate("xyz"):
            place: Key = ("measured", "calibration")
            column, error = f"{name}_{axis}", f"{name}_{axis}_standard_error"
            found += [
                Column(column, Kind.NUMBER, (*place, name, i), f"coefficient, also of a failed unit [{unit}]"),
                Column(error, Kind.NUMBER, (*place, "standard_error", name, i), f"standard error of `{column}`"),
            ]
    return found


COLUMNS: Final[tuple[Column, ...]] = (
    _text("run", "id of the run; empty before version 0.2"),
    _text("station", "name of the station", required=True),
    _text("unit", "name of the unit in the station file", required=True),
    _text("slot", "slot: name of the `[[units]]` entry", "work", "slot"),
    _text("serial", "serial number that the unit reported"),
    _text("work_serial", "expected serial number", "work", "serial"),
    _text("operator", "operator", "work", "operator"),
    _text("order", "work order", "work", "order"),
    _text("batch", "batch", "work", "batch"),
    _text("part_number", "part number", "work", "part_number"),
    _text("fixture", "fixture", "work", "fixture"),
    Column("attempt", Kind.WHOLE, ("work", "attempt"), "number of the attempt at the serial number, from 1"),
    _text("work_reason", "reason of a re-test", "work", "reason"),
    _text("started", "start of the work, UTC, ISO 8601"),
    _text("ended", "end of the work, UTC, ISO 8601", required=True),
    Column("duration_s", Kind.NUMBER, None, "from start to end [s]"),
    _text("verdict", "[verdict](outcome.md#verdict-and-code) on the unit", required=True),
    _text("code", "[reason for programs](outcome.md#verdict-and-code)"),
    _text("reason", "reason for people, one sentence", required=True),
    Column("exit_code", Kind.WHOLE, ("exit_code",), "exit code of the command for this unit"),
    _text("device_state", "[device state](outcome.md#device-state)", required=True),
    _text("settles", "id of the run that a `provision --resume` or `restore` settles"),
    Column("poses", Kind.WHOLE, ("measured", "poses"), "number of still poses"),
    *_figures(),
    Column("terms", Kind.TEXTS, ("measured", "terms"), "`linear`, and the effects of the final calibration"),
    *_coefficients(),
    _text("recording", "file name of the recording, if it is in the folder"),
    Column("certificate", Kind.TEXT, None, "file name of the certificate, if it is in the folder"),
    Column("report", Kind.TEXT, None, "file name of the report, if it is in the folder"),
    Column("outcome", Kind.TEXT, None, "file name of the outcome", True),
    Column("outcome_sha256", Kind.TEXT, None, "SHA-256 of its bytes", True),
)
NAMES: Final = tuple(column.name for column in COLUMNS)
