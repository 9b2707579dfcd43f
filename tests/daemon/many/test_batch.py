"""batch: the figures of the command itself, a row each; files of others are left alone."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.many.conftest import CAN, TABLE, rows_of
from triaxcald.cli.many import published
from triaxcald.many import Done, open_table

Run = Callable[..., Any]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    made = tmp_path / "recordings"
    made.mkdir()
    shutil.copy(TABLE, made / "t.csv.gz")
    (made / "broken.mcap").write_text("no recording")
    return made


def test_fit_has_the_figures_of_fit_and_goes_on_past_a_broken_file(folder: Path, triaxcal: Run) -> None:
    table = folder / "fit.csv"  # among the recordings, and none
    done = triaxcal("batch", "fit", folder, "-o", table, "--sign=-,-,-")
    assert done.code == 2
    assert done.out == "2 recordings: 1 done, 1 failed\n"
    broken, row = rows_of(table)
    assert broken["error"] == f"{folder / 'broken.mcap'}: not an MCAP file but text, expected a recording (.mcap)"
    alone = triaxcal("fit", folder / "t.csv.gz", "--sign=-,-,-", "--json").json
    for name in ("scale_factor", "misalignment", "bias"):
        for i, axis in enumerate("xyz"):
            assert float(row[f"{name}_{axis}"]) == alone[name][i]
            assert float(row[f"{name}_{axis}_standard_error"]) == alone["standard_error"][name][i]
    assert float(row["rms_g"]) == alone["residual"]["rms_g"]
    assert int(row["poses"]) == len(alone["poses"])


def test_poses_has_the_poses_of_poses(folder: Path, triaxcal: Run) -> None:
    triaxcal("batch", "poses", folder, "-o", folder / "poses.csv")
    row = rows_of(folder / "poses.csv")[1]
    alone = triaxcal("poses", folder / "t.csv.gz", "--json").json["poses"]
    assert int(row["poses"]) == len(alone)
    assert (float(row["start_s"]), float(row["end_s"])) == (alone[0]["start_s"], alone[-1]["end_s"])
    rms = (sum(p["standard_error"][0] ** 2 for p in alone) / len(alone)) ** 0.5
    assert float(row["noise_x"]) == pytest.approx(rms, rel=1e-4)


@pytest.mark.slow
def test_diagnose_has_the_probabilities_of_diagnose(tmp_path: Path, triaxcal: Run) -> None:
    assert triaxcal("batch", "diagnose", CAN, "-o", tmp_path / "t.csv").code == 0
    [row] = rows_of(tmp_path / "t.csv")
    alone = triaxcal("diagnose", CAN, "--json").json
    assert json.loads(row["effects"]) == alone["probabilities"]
    assert json.loads(row["effect_coefficients"]) == alone["calibration"]["effects"]
    assert float(row["rms_before_g"]) == alone["before"]["rms_g"]
    assert float(row["rms_g"]) == alone["after"]["rms_g"]
    assert float(row["unexplained_probability"]) == alone["unexplained"]["probability"]
    assert row["call"] == alone["call"]


@pytest.mark.slow
def test_verify_takes_the_calibration_beside_each_recording(folder: Path, triaxcal: Run) -> None:
    triaxcal("fit", folder / "t.csv.gz", "-o", folder / "t.cal.json")
    table = folder / "verify.csv"
    done = triaxcal("batch", "verify", folder, "--calibration", "beside", "-o", table, "--limit", "1e-9")
    assert done.code == 2
    broken, row = rows_of(table)
    assert "no calibration is beside it, expected one of broken.cal.json" in broken["error"]
    alone = triaxcal("verify", folder / "t.cal.json", folder / "t.csv.gz", "--json").json
    assert float(row["rms_g"]) == alone["rms_g"]
    assert (row["exit_code"], row["calibration"]) == ("1", str(folder / "t.cal.json"))
    # Another calibration makes another row; nothing else does.
    again = triaxcal("batch", "verify", folder, "--calibration", "beside", "-o", table, "--limit", "1e-9", "--resume")
    assert rows_of(table) == [broken, row]
    triaxcal("fit", folder / "t.csv.gz", "-o", folder / "t.cal.json", "--reference", "9.80665")
    again = triaxcal("batch", "verify", folder, "--calibration", "beside", "-o", table, "--limit", "1e-9", "--resume")
    assert again.code == 2
    assert rows_of(table)[1]["calibration_sha256"] != row["calibration_sha256"]


@pytest.fixture
def applied(folder: Path, triaxcal: Run) -> Callable[..., Any]:
    triaxcal("fit", folder / "t.csv.gz", "-o", folder / "t.cal.json")
    (folder / "broken.mcap").unlink()

    def apply(*options: Any) -> Any:
        return triaxcal(
            "batch", "apply", folder, "--calibration", folder / "t.cal.json", "--to", folder / "out",
            "-o", folder / "apply.csv", *options,
        )  # fmt: skip

    return apply


def test_apply_writes_what_apply_writes(folder: Path, applied: Callable[..., Any], triaxcal: Run) -> None:
    assert applied().code == 0
    triaxcal("apply", folder / "t.cal.json", folder / "t.csv.gz", "-o", folder / "alone.csv")
    assert [p.name for p in (folder / "out").iterdir()] == ["t.csv"]
    assert (folder / "out" / "t.csv").read_bytes() == (folder / "alone.csv").read_bytes()
    [row] = rows_of(folder / "apply.csv")
    assert row["output"] == str(folder / "out" / "t.csv")
    assert int(row["samples"]) == (folder / "alone.csv").read_text().count("\n") - 1


def test_apply_leaves_a_file_that_was_there(folder: Path, applied: Callable[..., Any]) -> None:
    (folder / "out").mkdir()
    (folder / "out" / "t.csv").write_text("mine")
    done = applied()
    assert done.code == 2
    assert "exists already" in done.err
    assert (folder / "out" / "t.csv").read_text() == "mine"
    assert [p.name for p in (folder / "out").iterdir()] == ["t.csv"]


def test_apply_goes_on_with_its_own_work_alone(folder: Path, applied: Callable[..., Any]) -> None:
    applied()
    out = folder / "out" / "t.csv"
    first = out.read_bytes()
    assert applied("--resume").code == 0
    out.unlink()  # as if the kill had come between row and file
    assert applied("--resume").code == 0
    assert out.read_bytes() == first
    out.write_text("older")
    shutil.copy(TABLE, folder / "t.csv.gz")  # another modification time
    assert applied("--resume").code == 0
    assert out.read_bytes() == first
    assert applied().code == 2  # without the table nothing tells whose the file is


def test_two_recordings_of_one_name_are_not_written_to_one_file(folder: Path, applied: Callable[..., Any]) -> None:
    (folder / "below").mkdir()
    shutil.copy(TABLE, folder / "below" / "t.csv.gz")
    applied().failed(2, "would be written to", "below")
    assert not list((folder / "out").iterdir())


def test_an_attitude_file_goes_to_the_worker(folder: Path, triaxcal: Run) -> None:
    """It is read once, by whoever asks; its absence is found before the first recording."""
    triaxcal("batch", "fit", folder, "-o", folder / "t.csv", "--attitudes", folder / "no.csv").failed(2, "no.csv")
    assert not (folder / "t.csv.journal").exists()
    labels = ["+X", "-X"]
    (folder / "att.txt").write_text("label\n" + "\n".join(labels) + "\n")
    done = triaxcal("batch", "fit", folder / "t.csv.gz", "-o", folder / "t.csv", "--attitudes", folder / "att.txt")
    assert done.code in (2, 3)
    [row] = rows_of(folder / "t.csv")
    assert "att.txt" in row["error"] or "attitudes" in row["error"]


@pytest.mark.parametrize("links", [True, False])
def test_apply_needs_no_hard_links(
    folder: Path, applied: Callable[..., Any], links: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The answer of a file system without them is put in."""

    def link(*_: Any, **__: Any) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    if not links:
        monkeypatch.setattr(os, "link", link)
    assert applied().code == 0
    out = folder / "out" / "t.csv"
    assert out.stat().st_size > 1000
    assert [p.name for p in out.parent.iterdir()] == ["t.csv"]
    done = Done("r", {"exit_code": 0, "error": None, "recording": "r"}, written=(str(folder / "part"), str(out)))
    (folder / "part").write_text("another's")
    with open_table(None, "x", (), resume=False) as nowhere:
        refused = published(done, nowhere, None)
    assert (refused.exit_code, refused.error) == (2, f"{out}: exists already")
    assert not (folder / "part").exists()
    assert out.stat().st_size > 1000


def test_what_a_killed_worker_left_of_a_file_goes(folder: Path, applied: Callable[..., Any]) -> None:
    (folder / "out").mkdir()
    for name in (".t.csv.0123abcd.part", ".other.csv.0123abcd.part"):
        (folder / "out" / name).write_text("half")
    assert applied().code == 0
    assert sorted(p.name for p in (folder / "out").iterdir()) == [".other.csv.0123abcd.part", "t.csv"]


@pytest.mark.parametrize("asked", ["t.csv.gz", ".", "*.csv.gz"])
def test_apply_leaves_no_recording_out_in_silence(
    folder: Path, applied: Callable[..., Any], triaxcal: Run, asked: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    arguments = ("--calibration", "t.cal.json", "--to", ".", "-o", folder.parent / "t.csv")
    triaxcal("batch", "apply", asked, *arguments).failed(2, "lies in --to")


def test_no_recording_at_all_is_2(folder: Path, triaxcal: Run) -> None:
    (folder / "below").mkdir()
    table = folder / "below" / "fit.csv"  # the only file in this folder
    assert triaxcal("batch", "poses", folder / "t.csv.gz", "-o", table).code == 0
    before = table.read_bytes()
    triaxcal("batch", "poses", table.parent, "-o", table).failed(2, "no recording is left")
    assert table.read_bytes() == before


@pytest.mark.parametrize("name", ["t.csv", "t.sqlite"])
def test_a_scheduler_that_does_not_answer_leaves_the_finished_table(folder: Path, triaxcal: Run, name: str) -> None:
    (folder / "empty").mkdir()
    assert triaxcal("batch", "poses", folder / "t.csv.gz", "-o", folder / name).code == 0
    before = (folder / name).read_bytes()
    asked = ("batch", "poses", folder / "empty", folder / "t.csv.gz", "-o", folder / name)
    triaxcal(*asked, "--scheduler", "tcp://127.0.0.1:1").failed(2, "no Dask scheduler answers")
    assert (folder / name).read_bytes() == before
    assert not (folder / f"{name}.journal").exists()


@pytest.mark.parametrize("options", [(), ("--resume",)], ids=str)
def test_a_recording_is_not_overwritten_by_the_table(folder: Path, triaxcal: Run, options: tuple[str, ...]) -> None:
    before = (folder / "t.csv.gz").read_bytes()
    for _ in range(2):
        triaxcal("batch", "poses", folder / "broken.mcap", "-o", folder / "t.csv.gz", *options).failed(2, "no column")
    assert (folder / "t.csv.gz").read_bytes() == before
