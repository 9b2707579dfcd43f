"""What `triaxcal apply` writes is a table that it reads, of whatever program its input was."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tests.daemon.tables.exports import EXPORTS, Export, N
from tests.daemon.tables.written import EVERY, asked, lines, read
from triaxcal.documents import Calibration
from triaxcald.applied import applied
from triaxcald.errors import InputError
from triaxcald.inputs import measure
from triaxcald.tables import native_csv
from triaxcald.tables.arrow import write_parquet
from triaxcald.tables.native_csv import write_csv
from triaxcald.tables.samples import Reading, read_table

KINDS = ("csv", "parquet")


@pytest.fixture
def calibration(tmp_path: Path) -> Calibration:
    document = {
        "format": "triaxcal.calibration/1", "scale_factor": [2.0, 2.1, 1.9], "misalignment": [6e-3, 4e-3, -6e-4],
        "bias": [5e-3, -3e-3, 4e-3], "effects": {}, "channel_reference": {},
    }  # fmt: skip
    (tmp_path / "cal.json").write_text(json.dumps(document))
    return Calibration.load(tmp_path / "cal.json")


def write_applied(calibration: Calibration, source: Path, out: Path, reading: Reading | None = None) -> Path:
    found = applied(calibration, str(source), reading=reading)
    if out.suffix == ".parquet":
        write_parquet(out, found.blocks, found.start_ns)
    else:
        with out.open("w", encoding="utf-8", newline="") as file:
            write_csv(file, found.blocks, found.start_ns)
    return out


def require_same_readings(source: Path, reading: Reading | None, again: Path) -> None:
    """Times to the microsecond: a float of the seconds since 1970 has no more."""
    given, found = read_table(str(source), reading).samples, read_table(str(again)).samples
    assert found.readings.tolist() == given.readings.tolist()
    assert np.abs(found.time_ns - given.time_ns).max() <= 1000
    assert {name: found.channels[name].tolist() for name in given.channels} == {
        name: values.tolist() for name, values in given.channels.items()
    }


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("export", EXPORTS, ids=lambda e: e.program)
def test_what_is_written_is_read_again_without_an_option_as_its_input_was(
    tmp_path: Path, calibration: Calibration, export: Export, kind: str
) -> None:
    source = tmp_path / f"export{export.suffix}"
    source.write_bytes(export.data)
    once = write_applied(calibration, source, tmp_path / f"once.{kind}", export.hint)
    require_same_readings(source, export.hint, once)
    twice = write_applied(calibration, once, tmp_path / f"twice.{kind}")
    require_same_readings(source, export.hint, twice)
    assert measure(str(twice)).windows is not None


QUOTED = '"a, b"'
BESIDE = {
    "dates and decimal commas in texts": (
        "Zeit;X [V];Y [V];Z [V];Temperatur [°C];Druck [bar]",
        [f"09.03.2024 14:05:00,{i:02d};{i % 7},1;0,2;0,9;22,{i % 4:02d};1,{i % 3}" for i in range(N)],
    ),
    "a label that changes rarely": (
        "time,ax,ay,az,step",
        [f"{row},{'up' if '0.3' in row else QUOTED}" for row in EVERY],
    ),
    "a quantity with gaps": ("time,ax,ay,az,gps", [f"{row},{i if i % 9 else ''}" for i, row in enumerate(EVERY)]),
    "a fault code among numbers": (
        "time,ax,ay,az,s",
        [f"{row},{'ERR' if i == 30 else i % 5}" for i, row in enumerate(EVERY)],
    ),
    "names that need quotes": ('time,ax,ay,az,"time, of the box"', [f"{row},{row[:4]}" for row in EVERY]),
    "a cell of two lines": ("time,ax,ay,az,note", [f'{row},"one\nof {i}"' for i, row in enumerate(EVERY)]),
    "names of ours": ("time,ux,uy,uz,ax,t_s,u_ax", [f"{row},no,b,1" for row in EVERY]),
}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", BESIDE)
def test_what_stood_beside_the_readings_does_not_matter(
    tmp_path: Path, calibration: Calibration, name: str, kind: str
) -> None:
    header, rows = BESIDE[name]
    source = tmp_path / "rec.csv"
    source.write_text(lines(rows, header))
    once = write_applied(calibration, source, tmp_path / f"once.{kind}")
    require_same_readings(source, None, once)
    require_same_readings(source, None, write_applied(calibration, once, tmp_path / f"twice.{kind}"))


def test_columns_that_are_called_as_ours_all_stay(tmp_path: Path, calibration: Calibration) -> None:
    path = tmp_path / "0.csv"
    path.write_text(lines(EVERY, "time,ax,ay,az"))
    for i in range(3):
        path = write_applied(calibration, path, tmp_path / f"{i + 1}.csv")
    names = path.read_text().partition("\n")[0].split(",")
    assert sorted(n for n in names if n.startswith("ax")) == [
        "ax", "ax (input)", "ax (input) (input)",
    ]  # fmt: skip


def test_a_gap_far_behind_the_first_block_is_one_too(
    tmp_path: Path, calibration: Calibration, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = tmp_path / "rec.csv"
    source.write_text(lines([f"{row},{i if i < 35 else ''}" for i, row in enumerate(EVERY)], "time,ax,ay,az,gps"))
    once = write_applied(calibration, source, tmp_path / "once.csv")
    monkeypatch.setattr(native_csv, "BLOCK", 1000)  # some ten lines
    require_same_readings(source, None, once)


@pytest.mark.parametrize("block", range(300, 310))
def test_a_block_may_end_within_a_letter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    rows = [f"{row},25,{'ä' * 40}" for row in EVERY]
    monkeypatch.setattr(native_csv, "BLOCK", block)
    assert list(read(tmp_path, lines(rows, OWN)).samples.channels) == ["temp_c"]


OWN = "t_s,ux,uy,uz,temp_c,step"


@pytest.mark.parametrize(
    ("rows", "header", "words"),
    [
        ([f"{row},2{i % 4}.5,{('left', 'right')[i % 2]}" for i, row in enumerate(EVERY)], OWN,
         "rows of several sensors in turn (column step: left, right); choose those of one: --where step=left"),
        ([f"{row},{'2x' if i == 7 else 25},up" for i, row in enumerate(EVERY)], OWN,
         "line 9: column temp_c: '2x', expected a finite number; 1 such lines"),
        ([f"{row},25,up" + ",7" * (i == 7) for i, row in enumerate(EVERY)], OWN, "line 9: 7 fields, expected 6"),
        ([f"{row},25,up" for row in EVERY[:5] + EVERY[:5]], OWN, "the time is before that of the line before"),
        ([f"{10 * i},{row[5:]},25,up" for i, row in enumerate(EVERY)], OWN,
         "column t_s: integers in steps of 10 in a unit that nothing states"),
        ([f"{row},{'2x' if i == 7 else 25},1" for i, row in enumerate(EVERY)], OWN,
         "line 9: field temp_c: '2x', expected a finite number"),
        ([f"{row},25,up" for row in EVERY], "t_s,ux,uy,uz,step,step", "'step' is in the header twice"),
    ],
)  # fmt: skip
def test_in_a_table_of_our_layout_with_texts_what_is_no_text_has_to_be_right(
    tmp_path: Path, rows: list[str], header: str, words: str
) -> None:
    assert words in asked(tmp_path, lines(rows, header))


def test_texts_in_a_table_of_our_layout_are_left_alone_and_said(tmp_path: Path) -> None:
    rows = [f'{row},2{i % 4}.5,"up, {i // 10}"' for i, row in enumerate(EVERY)]
    table = read(tmp_path, lines(rows, OWN))
    assert list(table.samples.channels) == ["temp_c"]
    assert "left out: step (no numbers)" in table.remarks
    assert len(read(tmp_path, lines(rows, OWN), Reading(where={"step": "up, 1"})).samples.time_ns) == 10


MIXED = [f'{row},"22,{i % 4}"' for i, row in enumerate(EVERY)]


@pytest.mark.parametrize("said", [{}, {"t": "time"}, {"t": "time", "temp_c": "T1"}])
def test_columns_that_are_not_read_do_not_decide_about_the_decimal_mark(tmp_path: Path, said: dict[str, str]) -> None:
    columns = {"ux": "ax", "uy": "ay", "uz": "az", **said}
    if said == {"t": "time"}:
        table = read(tmp_path, lines(MIXED, "time,ax,ay,az,T1"), Reading(columns))
        assert table.samples.readings[:, 1].tolist() == [0.2] * len(EVERY)
        assert table.remarks[1] == "left out: T1 (no numbers)"
    else:  # the time may be any column, or the one that is named has the other mark
        assert "numbers with a comma and with a point" in asked(
            tmp_path, lines(MIXED, "time,ax,ay,az,T1"), Reading(columns)
        )


def test_numbers_that_name_a_sensor_are_asked_about_with_either_mark(tmp_path: Path) -> None:
    rows = [f'{row},"{i % 2},0"' for i, row in enumerate(EVERY)]
    assert "rows of several sensors in turn (column sensor: 0,0, 1,0)" in asked(
        tmp_path, lines(rows, "t_s,ux,uy,uz,sensor")
    )
    assert read(tmp_path, lines(rows, "t_s,ux,uy,uz,weight")).samples.readings.shape == (len(EVERY), 3)


def _parquet(folder: Path, **columns: object) -> Path:
    readings = {axis: [0.1 * i + k for i in range(N)] for k, axis in enumerate(("ux", "uy", "uz"))}
    pd.DataFrame({"t_s": columns.pop("t_s"), **readings, **columns}).to_parquet(folder / "a.parquet")
    return folder / "a.parquet"


def test_in_parquet_the_times_of_our_layout_are_seconds_or_asked_about(tmp_path: Path) -> None:
    t_s = np.arange(N) * 0.5
    samples = read_table(str(_parquet(tmp_path, t_s=t_s, clock=np.arange(N) * 0.07))).samples
    assert not samples.channels
    assert samples.time_ns.tolist() == (t_s * 1e9).astype(int).tolist()
    for since_1970 in (np.arange(N) * 10, 1_709_993_100_000_000_000 + np.arange(N) * 10_000_000):
        with pytest.raises(InputError, match=r"column t_s: integers in steps of .* say which: --time-unit s, ms, us"):
            read_table(str(_parquet(tmp_path, t_s=since_1970)))


def test_a_table_that_only_has_our_names_is_another_program_s(tmp_path: Path) -> None:
    rows = [f"{i * 0.5},{row[5:]}".replace(",", ";") for i, row in enumerate(EVERY)]
    assert "column t_s: numbers in steps of 0.5 in a unit that nothing states" in asked(
        tmp_path, lines(rows, "t_s;ux;uy;uz")
    )
