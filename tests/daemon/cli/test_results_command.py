"""`triaxcal results`: a row for each run, on the console, as a table and as a document."""

from __future__ import annotations

import csv
import gzip
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import pyarrow.parquet as pq
import pytest

from benchmarks.results_index import fill
from triaxcald.documents import to_text
from triaxcald.schema.columns import COLUMNS, NAMES, Kind
from triaxcald.schema.results import Results

Run = Callable[..., Any]
SCHEMA = json.loads((Path(__file__).parents[3] / "docs/reference/results.schema.json").read_text())
FIGURES = {"rms_g": 1.25e-05, "max_abs_g": 2e-5, "cross_validated_rms_g": None, "noise_floor_g": 1e-5}
THREE = [-2.5, -2.25, -2.0]
PASSED = {
    "format": "triaxcal.outcome/1",
    "run": "01970000-0000-7000-8000-000000000001",
    "unit": "left",
    "serial": "1042",
    "station": "bench, the second",
    "started": "2026-01-31T12:00:00.000+00:00",
    "ended": "2026-01-31T12:03:00.500+00:00",
    "work": {
        "serial": "1042", "operator": "Jürgen", "order": "WO-7", "batch": None, "part_number": None,
        "fixture": None, "slot": "left", "attempt": 2, "reason": 'he said "again"',
    },
    "recording": "left-1042-a.mcap",
    "verdict": "pass",
    "code": "within_limits",
    "reason": "within the limits",
    "exit_code": 0,
    "device_state": "new_verified",
    "limits": {"rms_g": 6e-05, "cross_validated_rms_g": None, "verification_rms_g": 6e-05},
    "measured": {
        "poses": 26, "before": FIGURES, "after": FIGURES, "terms": ["linear", "warm_up"],
        "calibration": {
            "scale_factor": THREE, "misalignment": [0.25, 0.5, None], "bias": [0.0, 1e-3, 2e-3],
            "standard_error": {"scale_factor": [1e-6] * 3, "misalignment": [1e-6] * 3, "bias": [1e-6] * 3},
        },
    },
    "verification": {"before_rms_g": 0.0068, "after_rms_g": 1.5e-05},
}  # fmt: skip
OLD = {
    "format": "triaxcal.outcome/1", "unit": "right", "serial": None, "station": "bench",
    "ended": "2025-12-31T23:59:59.000+00:00", "verdict": "aborted", "reason": "nothing answers",
    "exit_code": 4, "device_state": "unknown",
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "out"
    folder.mkdir()
    (folder / "left-1042-a.outcome.json").write_text(to_text(PASSED))
    (folder / "left-1042-a.mcap").touch()
    (folder / "left-1042-a.certificate.json").touch()
    (folder / "right-b.outcome.json").write_text(to_text(OLD))
    return folder


def cells(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_the_table_has_a_line_a_run_byte_for_byte(folder: Path, tmp_path: Path, triaxcal: Run) -> None:
    done = triaxcal("results", folder, "-o", tmp_path / "runs.csv")
    assert (done.code, done.out, done.err) == (0, "2 runs: 1 pass, 1 aborted (1 within_limits)\n", "")
    lines = (tmp_path / "runs.csv").read_bytes().decode().split("\n")
    assert lines[0] == ",".join(NAMES)
    digest = lines[1].rpartition(",")[2]
    assert lines[1] == (
        ",bench,right,,,,,,,,,,,,2025-12-31T23:59:59.000+00:00,,aborted,,nothing answers,4,unknown,"
        + "," * (NAMES.index("outcome") - NAMES.index("settles"))
        + f"right-b.outcome.json,{digest}"
    )
    assert lines[2].startswith(
        '01970000-0000-7000-8000-000000000001,"bench, the second",left,left,1042,1042,Jürgen,WO-7,,,,2,'
        '"he said ""again""",2026-01-31T12:00:00.000+00:00,2026-01-31T12:03:00.500+00:00,180.5,pass,within_limits,'
        "within the limits,0,new_verified,,26,1.25e-05,1.25e-05,6e-05,,,,0.0068,1.5e-05,6e-05,linear; warm_up,"
        "-2.5,1e-06,-2.25,1e-06,-2.0,1e-06,0.25,1e-06,0.5,1e-06,,1e-06,0.0,1e-06,0.001,1e-06,0.002,1e-06,"
        "left-1042-a.mcap,left-1042-a.certificate.json,,left-1042-a.outcome.json,"
    )
    assert lines[3:] == [""]


def test_the_same_table_comes_packed_and_as_parquet(tmp_path: Path, triaxcal: Run) -> None:
    fill(tmp_path, 60)
    for name in ("runs.csv", "runs.csv.gz", "runs.parquet"):
        assert triaxcal("results", tmp_path, "-o", tmp_path / name).code == 0
    plain = (tmp_path / "runs.csv").read_bytes()
    assert gzip.decompress((tmp_path / "runs.csv.gz").read_bytes()) == plain
    table = pq.read_table(tmp_path / "runs.parquet")
    assert table.column_names == list(NAMES)
    types = {Kind.TEXT: "string", Kind.TEXTS: "string", Kind.WHOLE: "int64", Kind.NUMBER: "double"}
    assert [str(field.type) for field in table.schema] == [types[c.kind] for c in COLUMNS]
    assert [{name: "" if cell is None else str(cell) for name, cell in row.items()} for row in table.to_pylist()] == (
        cells(plain.decode())
    )


def test_the_document_is_that_of_its_model(folder: Path, triaxcal: Run) -> None:
    done = triaxcal("results", folder, "--json")
    assert (done.code, done.err) == (0, "")
    jsonschema.validate(done.json, SCHEMA)
    read = Results.read(done.json)
    assert read is not None
    assert read.document() == done.json
    assert (done.json["verdicts"], done.json["codes"]) == ({"pass": 1, "aborted": 1}, {"within_limits": 1})
    old, passed = done.json["runs"]
    assert list(old) == list(NAMES)
    assert {name for name, cell in old.items() if cell is not None} == {
        "station", "unit", "ended", "verdict", "reason", "exit_code", "device_state", "outcome", "outcome_sha256",
    }  # fmt: skip
    assert (passed["terms"], passed["order"], passed["work_reason"]) == (
        ["linear", "warm_up"],
        "WO-7",
        'he said "again"',
    )
    assert (passed["recording"], passed["report"]) == ("left-1042-a.mcap", None)


def test_a_document_and_a_table_may_be_had_at_once(folder: Path, tmp_path: Path, triaxcal: Run) -> None:
    done = triaxcal("results", folder, "--json", "-o", tmp_path / "runs.csv")
    assert len(done.json["runs"]) == len(cells((tmp_path / "runs.csv").read_text())) == 2


def test_the_console_has_a_row_a_run_and_a_summary(folder: Path, triaxcal: Run) -> None:
    done = triaxcal("results", folder)
    assert done.code == 0
    *rows, summary = done.out.splitlines()
    assert summary == "2 runs: 1 pass, 1 aborted (1 within_limits)"
    shown = [[cell.strip() for cell in row.strip("│").split("│")] for row in rows if row.startswith("│")]
    assert shown == [
        ["2025-12-31 23:59", "right", "—", "—", "STOPPED", "—", "—"],
        ["2026-01-31 12:00", "left", "1042", "2", "PASS", "12.5", "15.0"],
    ]
    assert max(map(len, done.out.splitlines())) <= 80


def test_of_very_many_runs_the_console_has_the_last(
    folder: Path, triaxcal: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("triaxcald.cli.results.SHOWN_MOST", 1)
    out = triaxcal("results", folder).out
    assert "the last 1 of 2 runs" in out
    assert ("2026-01-31" in out, "2025-12-31" in out) == (True, False)
    assert out.endswith("\n2 runs: 1 pass, 1 aborted (1 within_limits)\n")


@pytest.mark.parametrize(
    ("options", "runs"),
    [
        (["--since", "2026-01-31"], 1), (["--since", "2025-12-31"], 2), (["--since", "2026-02-01"], 0),
        (["--until", "2025-12-31"], 1), (["--until", "2025-12-30"], 0), (["--until", "2026-01-31T12:00"], 1),
        (["--until", "2026-01-31T12:00:00.001"], 2), (["--since", "2026-01-31T13:00+01:00"], 1),
        (["--since", "2026-01-31T12:00:00.001Z"], 0), (["--serial", "1042"], 1), (["--serial", "104"], 0),
        (["--code", "within_limits"], 1), (["--code", "absent"], 0),
        (["--since", "0001-01-01T00:00+14:00", "--until", "9999-12-31"], 2),
    ],
    ids=str,
)  # fmt: skip
def test_options_choose_runs(folder: Path, triaxcal: Run, options: list[str], runs: int) -> None:
    done = triaxcal("results", folder, *options, "--json")
    assert (done.code, len(done.json["runs"])) == (0, runs)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--since", "yesterday"], "--since: expected a date or a time"),
        (["--until", "2026-02-30"], "--until: expected a date or a time"),
        (["--until", ""], "--until: expected a date or a time"),
        (["--since", "2026-02-01", "--until", "2026-01-31"], "--since: expected a time before --until"),
        (["--code", "within_limit"], "did you mean within_limits?"),
        (["--code", "zzz"], "there are within_limits, no_limit"),
        (["-o", "runs.xlsx"], "expected a name that ends in .csv, .csv.gz, .parquet"),
        (["-o", "none/runs.csv"], "there is no folder none"),
    ],
    ids=str,
)
def test_a_wrong_option_is_one_line(folder: Path, triaxcal: Run, options: list[str], words: str) -> None:
    done = triaxcal("results", folder, *options)
    assert (done.code, done.out) == (2, "")
    assert words in done.err
    assert done.err.count("\n") == 1
    assert not (folder / "triaxcal.sqlite").exists()


@pytest.mark.parametrize("name", ["none", "file", "\0"], ids=["none", "file", "nul"])
def test_what_is_no_folder_is_one_line(tmp_path: Path, triaxcal: Run, name: str) -> None:
    (tmp_path / "file").touch()
    done = triaxcal("results", f"{tmp_path}/{name}")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)


def test_an_empty_folder_has_no_runs_and_stays_empty(tmp_path: Path, triaxcal: Run) -> None:
    done = triaxcal("results", tmp_path)
    assert (done.code, done.out, done.err) == (0, "no runs\n", "")
    assert triaxcal("results", tmp_path, "--json").json["runs"] == []
    assert list(tmp_path.iterdir()) == []


def test_what_is_left_out_is_counted(folder: Path, triaxcal: Run) -> None:
    for i in range(5):
        (folder / f"bad-{i}.outcome.json").write_text("[" * 5000)
    done = triaxcal("results", folder)
    assert done.code == 0
    assert done.err.count("\n") == 1
    assert "bad-0.outcome.json, bad-1.outcome.json, bad-2.outcome.json and 2 more" in done.err
    assert triaxcal("results", folder, "--json").json["skipped"] == [f"bad-{i}.outcome.json" for i in range(5)]


def test_words_of_an_outcome_do_not_steer_the_terminal(tmp_path: Path, triaxcal: Run) -> None:
    hostile = OLD | {"unit": "a\x1b[2J\nb", "serial": "\u202e1", "reason": "\x1b]0;x\x07"}
    (tmp_path / "a.outcome.json").write_text(to_text(hostile))
    for options in ((), ("--json",)):
        out = triaxcal("results", tmp_path, *options).out
        assert not {"\x1b", "\u202e", "\x07"} & set(out)


def test_no_run_is_written_over_an_outcome_or_through_a_link(folder: Path, tmp_path: Path, triaxcal: Run) -> None:
    (tmp_path / "link.csv").symlink_to(tmp_path / "elsewhere.csv")
    done = triaxcal("results", folder, "-o", tmp_path / "link.csv")
    assert (done.code, (tmp_path / "elsewhere.csv").exists()) == (2, False)


def test_the_runs_of_a_station_are_those_of_its_outcomes(finished_run: Any, triaxcal: Run) -> None:
    done = triaxcal("results", finished_run.can.parent, "--json")
    assert (done.code, done.json["skipped"]) == (0, [])
    outcomes = {p.name: json.loads(p.read_bytes()) for p in finished_run.can.parent.glob("*.outcome.json")}
    assert {row["outcome"] for row in done.json["runs"]} == set(outcomes)
    for row in done.json["runs"]:
        outcome = outcomes[row["outcome"]]
        assert (row["unit"], row["serial"], row["verdict"]) == (outcome["unit"], outcome["serial"], "pass")
        assert row["rms_g"] == outcome["measured"]["after"]["rms_g"]
        assert row["verification_rms_g"] == outcome["verification"]["after_rms_g"]
        for kind in ("recording", "certificate", "report"):
            assert (finished_run.can.parent / row[kind]).exists()
