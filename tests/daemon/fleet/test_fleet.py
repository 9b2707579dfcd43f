"""Fleets of known truth: what is read, what the document says, the table, and the command."""

from __future__ import annotations

import csv
import json
import shutil
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.daemon.fleet.worlds import certificate, line, outcome, write
from triaxcald.cli.commands import main
from triaxcald.cli.fleet import _shown
from triaxcald.documents import to_text
from triaxcald.errors import InputError
from triaxcald.fleet import COLUMNS, Asked, Selection, fleet_document, fleets_of, read_runs, table_rows
from triaxcald.fleet.page import last_move, notices, percent, worst_study
from triaxcald.fleet.reading import certified_in
from triaxcald.recording.reader import Recording
from triaxcald.schema.fleet import FleetDocument

GOLDEN = Path(__file__).parents[3] / "recordings"
FIGURES = {"scale_factor": np.ones(3), "misalignment": np.zeros(3), "bias": np.zeros(3)}


def document_of(folder: Path, asked: Asked = Asked(), **selected: Any) -> dict[str, Any]:  # noqa: B008
    runs = read_runs(str(folder), Selection(**selected))
    made = fleet_document(fleets_of(runs), str(folder), runs.skipped, asked)
    return FleetDocument.model_validate(json.loads(json.dumps(made))).document()


@pytest.fixture(scope="module")
def lined(tmp_path_factory: pytest.TempPathFactory) -> Path:
    documents = line()
    chances = [0.9 if d["work"]["batch"] == "B2" else 0.02 for d in documents]
    return write(tmp_path_factory.mktemp("line"), documents, [certificate(p) for p in chances])


@pytest.fixture(scope="module")
def product(lined: Path) -> dict[str, Any]:
    (of,) = document_of(lined, Asked(limit_g=0.02))["products"]
    return of


def figure(product: dict[str, Any], name: str) -> dict[str, Any]:
    return next(f for f in product["figures"] if f["name"] == name)


# Reading.


def test_units_and_runs_are_counted(product: dict[str, Any]) -> None:
    assert (product["part_number"], product["units"], product["runs"], product["repeated"]) == ("TX-1", 60, 80, 10)
    assert product["factors"] == {"batch": 2, "station": 2, "fixture": 3, "slot": 2, "time": 12}
    assert product["certificates"] == 80


def test_the_file_of_the_index_gives_the_same(lined: Path, product: dict[str, Any], tmp_path: Path) -> None:
    (of,) = document_of(lined / "triaxcal.sqlite", Asked(limit_g=0.02))["products"]
    assert of == product
    alone = shutil.copy(lined / "triaxcal.sqlite", tmp_path / "copy.sqlite")
    (without,) = document_of(Path(f"sqlite:///{alone}"), Asked(limit_g=0.02))["products"]
    assert without["certificates"] == 0
    assert figure(without, "bias_x") == figure(product, "bias_x")


def test_what_is_no_folder_and_no_database_is_named(tmp_path: Path) -> None:
    (tmp_path / "x.sqlite").write_bytes(b"SQLite format 3\0" + bytes(100))
    for name in ("missing", "x.sqlite"):
        with pytest.raises(InputError, match=name):
            read_runs(str(tmp_path / name), Selection())
    with sqlite3.connect(tmp_path / "other.sqlite") as db:
        db.execute("CREATE TABLE run (a)")
    with pytest.raises(InputError, match="no table of runs"):
        read_runs(str(tmp_path / "other.sqlite"), Selection())


def test_runs_are_chosen_by_time_and_place(lined: Path) -> None:
    runs = read_runs(str(lined), Selection())
    middle = runs.rows[40]["at_us"]
    assert len(read_runs(str(lined), Selection(until_us=middle)).rows) == 40
    assert len(read_runs(str(lined), Selection(since_us=middle)).rows) == 40
    (of,) = document_of(lined, equal={"fixture": "F2"})["products"]
    assert "fixture" not in of["factors"]
    assert of["runs"] == sum(row["fixture"] == "F2" for row in runs.rows)
    assert document_of(lined, equal={"serial": "5003"})["runs"] == 3


@pytest.mark.parametrize("asked", ["5003", "005003"])
def test_a_serial_number_is_one_with_and_without_leading_zeros(tmp_path: Path, asked: str) -> None:
    write(tmp_path, [outcome(serial, day, FIGURES) for day, serial in enumerate(("5003", "005003", "50030"))])
    found = document_of(tmp_path, equal={"serial": asked})
    assert (found["units"], found["runs"]) == (1, 2)


def test_runs_that_measured_nothing_and_copies_do_not_count(tmp_path: Path) -> None:
    one = outcome("1", 0, FIGURES)
    aborted = outcome("2", 1, FIGURES) | {"verdict": "aborted", "code": "no_poses", "measured": None}
    provisioned = outcome("3", 2, FIGURES) | {"work": None, "contents": None}
    write(tmp_path, [one, one, aborted, provisioned])
    (tmp_path / "z.outcome.json").write_text("{}")
    found = document_of(tmp_path)
    assert (found["units"], found["runs"]) == (1, 1)
    assert found["skipped"] == ["z.outcome.json"]


def test_part_numbers_are_taken_apart_and_the_largest_comes_first(tmp_path: Path) -> None:
    parts = ["A", "B", "B", None]
    write(tmp_path, [outcome("1", day, FIGURES, part_number=part) for day, part in enumerate(parts)])
    assert [(p["part_number"], p["runs"]) for p in document_of(tmp_path)["products"]] == [("B", 2), (None, 1), ("A", 1)]


def test_a_certificate_is_cut_out_as_it_would_be_parsed() -> None:
    of = certificate(0.25)
    for text in (to_text(of), json.dumps(of), json.dumps(of, indent=4)):
        found = certified_in(text)
        assert found.effects["temperature_bias"].probability == 0.25
        assert found.effects["temperature_bias"].coefficients == {"x": (2.5e-6, 1e-6, "g/K")}
        assert found.effects["hysteresis"].probability is None
        assert set(found.effects) == {"temperature_bias", "hysteresis"}
        assert found.uncertainty == {"this_fit": 2.6e-5, "another_day": 4e-3}
    with pytest.raises(ValueError, match="no certificate"):
        certified_in("{}")


@pytest.mark.parametrize(
    "damaged",
    ["{", '{\n  "result": {\n    "findings": ' + "[" * 200_000, '{"result": ' * 200_000],
    ids=["cut", "part", "whole"],
)
def test_a_damaged_certificate_is_named(tmp_path: Path, damaged: str) -> None:
    write(tmp_path, [outcome("1", 0, FIGURES), outcome("2", 1, FIGURES)], [certificate(0.5)] * 2)
    broken = sorted(tmp_path.glob("*.certificate.json"))[0]
    broken.write_text(damaged)
    assert document_of(tmp_path)["skipped"] == [broken.name]


# What the document says.


def test_the_fixture_that_shifts_a_bias_is_named_by_its_p_value(product: dict[str, Any]) -> None:
    by = {c["factor"]: c for c in figure(product, "bias_y")["comparisons"]}
    assert by["fixture"]["location_p"] < 1e-3
    assert all(of["location_p"] is None or of["location_p"] > 0.05 for name, of in by.items() if name != "fixture")
    far = max(by["fixture"]["groups"], key=lambda g: abs(g["apart"]))
    assert far["name"] == "F2"
    assert figure(product, "bias_x")["comparisons"][2]["location_p"] > 0.05


def test_a_gauge_study_by_fixture_finds_its_size(product: dict[str, Any]) -> None:
    by = {study["factor"]: study for study in figure(product, "bias_y")["gauge"]}
    assert set(by) == {None, "fixture"}
    of = by["fixture"]
    assert (of["method"], of["parts"], of["appraisers"], of["measurements"]) == ("reml", 10, 3, 30)
    # A shift of one in three fixtures: 8 mg · √(1/3).
    assert of["components"]["reproducibility"]["sd"] == pytest.approx(8e-3 / np.sqrt(3), rel=0.1)
    assert of["components"]["repeatability"]["sd"] == pytest.approx(3e-5, rel=0.4)
    assert figure(product, "bias_x")["gauge"][0]["grr"] < 0.03


@pytest.mark.parametrize("verdict", ["aborted", "fail"])
def test_a_run_that_failed_is_in_no_gauge_study_and_no_drift(tmp_path: Path, verdict: str) -> None:
    documents = line(40, repeats=4, shift=0.0)
    clean = document_of(write(tmp_path / "clean", documents), Asked(limit_g=0.02))["products"][0]
    mine = [d for d in documents if d["serial"] == "5000"]
    last = json.loads(json.dumps(mine[-1]))
    last |= {"verdict": verdict, "code": "implausible", "run": "another", "ended": "2027-01-30T08:00:00.000+00:00"}
    last["measured"]["calibration"]["bias"][0] += 0.5
    of = document_of(write(tmp_path / "with", [*documents, last]), Asked(limit_g=0.02))["products"][0]
    assert (clean["left_out"], of["left_out"]) == (0, 1)
    for key in ("gauge", "drift"):
        assert figure(of, "bias_x")[key] == figure(clean, "bias_x")[key]
    assert of["recalibration"] == clean["recalibration"]
    # The coefficients of a failed unit are its own; of a stopped run nobody knows what was measured.
    same = figure(of, "bias_x")["distribution"] == figure(clean, "bias_x")["distribution"]
    assert same == (verdict == "aborted")


def test_an_aborted_run_stands_for_a_unit_without_another(tmp_path: Path) -> None:
    alone = outcome("1", 0, FIGURES) | {"verdict": "aborted", "code": "implausible"}
    (of,) = document_of(write(tmp_path, [alone, outcome("2", 1, FIGURES)]))["products"]
    assert figure(of, "bias_x")["n"] == 2


def test_of_a_unit_with_many_runs_a_gauge_study_takes_pairs(tmp_path: Path) -> None:
    documents = line(6, repeats=70, repeated=6, shift=0.0)
    (of,) = document_of(write(tmp_path, documents), Asked(limit_g=0.02))["products"]
    assert of["runs"] == 420
    (study,) = [study for study in figure(of, "bias_x")["gauge"] if study["factor"] is None]
    assert 6 * 40 < study["measurements"] <= 6 * 50
    assert study["components"]["repeatability"]["sd"] == pytest.approx(3e-5, rel=0.2)
    assert figure(of, "bias_x")["drift"]["span_days"] > 1000


def test_a_group_that_was_not_compared_is_not_the_farthest(tmp_path: Path) -> None:
    documents = line()
    odd = json.loads(json.dumps(documents[-1]))
    odd |= {"serial": "9", "run": "odd"}
    odd["work"] |= {"serial": "9", "fixture": "F9"}
    odd["measured"]["calibration"]["bias"][1] += 0.5
    (of,) = document_of(write(tmp_path, [*documents, odd]))["products"]
    by = next(c for c in figure(of, "bias_y")["comparisons"] if c["factor"] == "fixture")
    assert max(by["groups"], key=lambda g: abs(g["apart"]))["name"] == "F9"
    assert any("Bias y differs by fixture, most at F2" in text for text in notices(of))


def test_a_mean_is_said_to_move_only_where_more_signals_come_than_by_chance(tmp_path: Path) -> None:
    documents = line(200, repeated=0, shift=0.0)
    few = document_of(write(tmp_path / "few", documents))["products"][0]
    charts = [f["charts"] for f in few["figures"] if f["charts"] and f["charts"]["cusum"]["count"]]
    assert charts
    assert [last_move(c) for c in charts] == [None] * len(charts)
    for d in documents[100:]:
        d["measured"]["calibration"]["bias"][0] += 0.02
    (moved,) = document_of(write(tmp_path / "moved", documents))["products"]
    last = last_move(figure(moved, "bias_x")["charts"])
    assert last is not None
    assert any(f"the mean last moved about {last['time'][:10]}" in text for text in notices(moved))


def test_the_console_has_the_gauge_figure_of_the_page(
    lined: Path, product: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    of = figure(product, "bias_y")
    alone, worst = of["gauge"][0]["grr"], worst_study(of)
    assert worst is not None
    assert worst["grr"] != alone
    assert main(["fleet", str(lined), "--limit", "0.02"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any("Bias y" in text and "fixture" in text and percent(worst["grr"]) in text for text in lines)
    assert not any("Bias y" in text and percent(alone) in text for text in lines)


def test_charts_state_their_run_lengths(product: dict[str, Any]) -> None:
    charts = figure(product, "bias_x")["charts"]
    assert charts["individuals"]["run_length"] == pytest.approx(152.7, abs=0.1)
    assert charts["ewma"]["run_length"] == pytest.approx(499.7, abs=0.2)
    assert charts["cusum"]["run_length"] == pytest.approx(465.4, abs=0.2)
    assert charts["cusum"]["expected"] == pytest.approx(60 / 465.4, rel=0.01)


def test_capability_is_that_of_the_service(lined: Path, product: dict[str, Any]) -> None:
    from triaxcald.service.quality import quality_of

    rows = read_runs(str(lined), Selection()).rows
    theirs = next(c for c in quality_of(rows)["characteristics"] if c["name"] == "rms_g")
    ours = figure(product, "rms_g")["capability"]
    assert ours["ppk"] == theirs["ppk"]
    assert ours["ppk_interval"] == theirs["ppk_interval"]
    assert figure(product, "bias_x")["capability"] is None


def test_effects_are_counted_by_their_probability(product: dict[str, Any]) -> None:
    of = {effect["effect"]: effect for effect in product["effects"]}
    assert of["temperature_bias"]["units"] == 60
    assert of["temperature_bias"]["expected"] == pytest.approx(30 * 0.9 + 30 * 0.02, rel=1e-3)
    assert of["temperature_bias"]["likely"] == 30
    batch = next(c for c in of["temperature_bias"]["comparisons"] if c["factor"] == "batch")
    assert batch["location_p"] < 1e-6
    assert of["hysteresis"]["likely"] == 60  # a finding whose probability is not calibrated
    assert figure(product, "temperature_bias.x")["n"] == 60


def test_an_empty_world_shows_no_difference(tmp_path: Path) -> None:
    shown = 0
    for seed in range(5):
        (of,) = document_of(write(tmp_path / str(seed), line(40, seed, repeated=0, shift=0.0)))["products"]
        ps = [c[key] for f in of["figures"] for c in f["comparisons"] for key in ("location_p", "scatter_p")]
        shown += min(p for p in ps if p is not None) < 0.05
    assert shown <= 1


@pytest.mark.slow
def test_a_walk_of_the_biases_gives_the_interval(tmp_path: Path) -> None:
    """|a| moves by one bias in a direction: with 0.1 mg a √day the 2 mg are exceeded in 5 % after some 100 days."""
    folder = write(tmp_path, line(40, 3, repeats=4, repeated=40, shift=0.0, walk=1e-4))
    (of,) = document_of(folder, Asked(limit_g=2e-3))["products"]
    drift = figure(of, "bias_x")["drift"]
    assert drift["movement"] == "random_walk"
    assert drift["rate_interval"][0] < 1e-4 < drift["rate_interval"][1]
    expected = (2e-3 / 1.96 / 1e-4) ** 2
    assert of["recalibration"]["days"] == pytest.approx(expected, rel=0.3)
    low, high = of["recalibration"]["interval"]
    assert low < expected < high


def test_without_units_that_repeat_there_is_neither_study_nor_interval(tmp_path: Path) -> None:
    (of,) = document_of(write(tmp_path, line(12, repeated=0)), Asked(limit_g=1.0))["products"]
    assert of["recalibration"] is None
    assert all(f["gauge"] == [] and f["drift"] is None for f in of["figures"])


def test_units_without_a_serial_number_are_in_no_distribution(tmp_path: Path) -> None:
    nameless = outcome("1", 0, FIGURES)
    nameless["serial"] = nameless["work"]["serial"] = None
    write(tmp_path, [nameless, outcome("2", 1, FIGURES)])
    (of,) = document_of(tmp_path)["products"]
    assert (of["units"], of["runs"]) == (1, 2)
    assert figure(of, "bias_x")["n"] == 1


# The table, and the command.


def test_the_table_has_a_row_for_each_unit_and_figure(lined: Path) -> None:
    fleets = fleets_of(read_runs(str(lined), Selection()))
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in table_rows(fleets)]
    assert len(rows) == 60 * len(fleets[0].figures)
    of = {(row["serial"], row["figure"]): row for row in rows}
    assert of["5000", "bias_y"]["runs"] == 3
    assert of["5000", "bias_y"]["standard_error"] == pytest.approx(3e-5)
    assert of["5000", "rms_g"]["standard_error"] is None
    deviations = [row["deviation"] for row in rows if row["figure"] == "bias_x"]
    assert np.median(deviations) == pytest.approx(0.0, abs=0.02)


def test_the_command_prints_the_document_and_writes_the_table(
    lined: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "fleet.parquet"
    code = main(["fleet", str(lined), "--fixture", "F2", "--table", str(table), "--json"])
    told = json.loads(capsys.readouterr().out)
    assert (code, told["format"], told["selected"]) == (0, "triaxcal.fleet/1", {"--fixture": "F2"})
    import pyarrow.parquet as pq

    assert pq.read_table(table).num_rows == sum(f["n"] for f in told["products"][0]["figures"])


def test_the_command_tells_what_stands_out(lined: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table = tmp_path / "fleet.csv"
    assert main(["fleet", str(lined), "--limit", "0.02", "--table", str(table)]) == 0
    told = capsys.readouterr().out
    assert "60 units in 80 runs, 10 measured more than once" in told
    assert "Bias y differs by fixture, most at F2" in told
    with table.open(newline="", encoding="utf-8") as file:
        assert next(csv.reader(file)) == [*COLUMNS]


@pytest.mark.parametrize(
    "wrong",
    [
        ["--probability", "1"],
        ["--table", "x.txt"],
        ["--since", "then"],
        ["--since", "2026-02-01", "--until", "2026-01-01"],
    ],
)
def test_wrong_options_are_refused(lined: Path, wrong: list[str]) -> None:
    assert main(["fleet", str(lined), *wrong]) == 2


@pytest.mark.parametrize(
    "url", ["postgresql://u:hidden@h:abc/x", "postgresql://u:hidden@[::1/x", "mysql://u:hidden@h/x", "no url://hidden"]
)
def test_a_wrong_address_of_a_database_is_bad_input(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fleet", url]) == 2
    told = capsys.readouterr().err
    assert "the database: expected" in told
    assert "hidden" not in told


def test_a_database_is_shown_without_its_password() -> None:
    shown = _shown("postgresql://u:hidden@[::1]:5432/line?password=hidden&sslmode=require")
    assert (shown, _shown("sqlite:///a?b"), _shown("folder")) == (
        "postgresql://u:***@[::1]:5432/line", "sqlite:///a?b", "folder",
    )  # fmt: skip


def test_an_empty_folder_is_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fleet", str(tmp_path)]) == 2
    assert "no run has measured anything" in capsys.readouterr().err


def test_a_filter_that_no_run_passes_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    odds = tmp_path / "odds.json"
    assert main(["fleet", str(tmp_path), "--part-number", "TX-1", "-o", str(odds)]) == 2
    assert "no run of --part-number TX-1 has measured anything" in capsys.readouterr().err
    assert not odds.exists()


# Effects of places, and odds.


def test_a_fixture_that_shifts_a_bias_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write(tmp_path / "runs", line(units=150, repeated=0))
    page = tmp_path / "fleet.html"
    assert main(["fleet", str(folder), "--json", "--report", str(page)]) == 0
    (product,) = json.loads(capsys.readouterr().out)["products"]
    (place,) = product["places"]
    assert (place["kind"], place["place"], place["since"], place["figure"]) == (
        "fixture", "F2", None, "a shift of bias.y",
    )  # fmt: skip
    assert place["probability"] > 0.99
    assert (place["verdict"], place["until"], place["since_interval"]) == ("named", None, None)
    assert [(p["kind"], p["name"]) for p in place["places"]] == [("fixture", "F2")]
    assert place["text"] in page.read_text(encoding="utf-8")


def test_units_teach_odds_that_diagnose_accepts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Recording.open(GOLDEN / "modbus-temperature-bias.mcap") as recording:
        paper = json.loads(recording.attachments["certificate.json"])
    documents = line(units=8, repeated=0)
    folder = write(tmp_path / "runs", documents, [paper] * len(documents))
    odds = tmp_path / "odds.json"
    assert main(["fleet", str(folder), "-o", str(odds), "--json"]) == 0
    learned = json.loads(odds.read_text())
    assert (learned["format"], learned["part_number"], learned["units"]) == ("triaxcal.odds/1", "TX-1", 8)
    others = [of["odds"] for name, of in learned["effects"].items() if name != "temperature_bias"]
    assert learned["effects"]["temperature_bias"]["odds"] > 5 * max(others)
    capsys.readouterr()
    assert main(["diagnose", str(GOLDEN / "paper-unit.csv.gz"), "--sign=-,-,-", "--odds", str(odds), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)["odds"]
    assert (said["part_number"], said["units"]) == ("TX-1", 8)


def test_odds_are_of_one_part_number_and_need_certificates(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    documents = line(units=4, repeated=0)
    folder = write(tmp_path / "runs", documents)
    assert main(["fleet", str(folder), "-o", str(tmp_path / "odds.json")]) == 2
    assert "no certificates" in capsys.readouterr().err
    documents[0]["work"]["part_number"] = "TX-2"
    folder = write(tmp_path / "two", documents)
    assert main(["fleet", str(folder), "-o", str(tmp_path / "odds.json")]) == 2
    assert "--part-number" in capsys.readouterr().err
    assert not (tmp_path / "odds.json").exists()
