"""audit, log: what they say of a recording."""

from __future__ import annotations

import csv
import io
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcald.recording.schema import decode_raw, encode_raw

Run = Callable[..., Any]


@pytest.mark.slow
def test_audit_says_that_all_is_the_same(finished_run: Any, triaxcal: Run) -> None:
    done = triaxcal("audit", finished_run.can, finished_run.modbus, "--json")
    assert (done.code, done.err) == (0, "")
    assert done.json["format"] == "triaxcal.audit/1"
    assert [a["recording"] for a in done.json["audits"]] == [str(finished_run.can), str(finished_run.modbus)]
    for audit in done.json["audits"]:
        assert {"certificate.json", "verification.json", "registers-after.json"} < set(audit["checked"])
        assert (audit["differences"], audit["notes"], audit["error"], audit["verdict"]) == ([], [], None, "pass")
    assert done.json["summary"] == {"recordings": 2, "agree": 2, "differ": 0, "unreadable": 0}


@pytest.mark.slow
def test_audit_ends_with_1_and_names_the_difference(
    finished_run: Any, rewrite: Callable[..., Path], triaxcal: Run
) -> None:
    path = rewrite(
        finished_run.can,
        attachment=lambda name, data: data.replace(b'"bench"', b'"Bench"') if name == "station.toml" else data,
    )
    done = triaxcal("audit", finished_run.can, path)
    assert done.code == 1
    assert done.out.startswith(f"{finished_run.can}: the same, byte for byte (outcome.json, certificate.json, ")
    assert done.out.endswith("\n2 recordings: 1 agrees, 1 differs\n")
    assert f"{path}: differs" in done.out
    assert '  certificate.json: station.name: stored "bench", computed again "Bench"' in done.out
    assert triaxcal("audit", path, "--json").code == 1


def test_info_tells_what_is_in_a_recording(finished_run: Any, triaxcal: Run) -> None:
    done = triaxcal("log", "info", finished_run.can, "--json")
    assert (done.code, done.err) == (0, "")
    info = done.json
    assert (info["format"], info["finished"], info["recovered"]) == ("triaxcal.recording/1", True, False)
    assert info["bytes"] == finished_run.can.stat().st_size
    assert set(info["raw"]) == {"calibration", "verification"}
    total = sum(p["records"] for p in info["raw"].values())
    assert int(info["metadata"]["raw"]["records"]) == total
    assert info["metadata"]["unit"] == {"name": "can", "serial": "4711", "signs": "-1,-1,-1"}
    assert set(info["attachments"]) == {
        "station.toml", "profile.toml", "profile/triax-ref-can.dbc", "certificate.json", "registers-before.json",
        "registers-after.json", "verification.json", "report.html", "outcome.json",
    }  # fmt: skip
    assert "finished: True" in triaxcal("log", "info", finished_run.can).out
    export = triaxcal("log", "export", finished_run.can)
    assert info["samples"]["calibration"]["readings"]["samples"] == len(export.out.splitlines()) - 1
    assert set(info["samples"]["verification"]) == {"readings", "corrected"}


def test_info_counts_the_samples_that_the_counter_lacks(
    finished_run: Any, rewrite: Callable[..., Path], triaxcal: Run
) -> None:
    """A batch of raw records is taken out: one sample at each end of it may have lost half of its frames."""
    taken: list[int] = []

    def without_the_tenth(topic: str, data: bytes) -> bytes:
        if topic != "/raw":
            return data
        first, phase, batch = decode_raw(data)
        taken.append(int(np.count_nonzero(batch.source == 0x185)))
        return encode_raw(first, phase, batch.part(0, 0)) if len(taken) == 10 else data

    path = rewrite(finished_run.can, message=without_the_tenth)
    readings = triaxcal("log", "info", path, "--json").json["samples"]["calibration"]["readings"]
    assert taken[9] > 2
    assert abs(readings["missing"] + readings.get("incomplete", 0) - taken[9]) <= 1


def test_info_of_a_recording_whose_profile_cannot_be_used_says_why(
    finished_run: Any, rewrite: Callable[..., Path], triaxcal: Run
) -> None:
    path = rewrite(
        finished_run.can,
        attachment=lambda name, data: data.replace(b'"can"', b'"con"') if name == "profile.toml" else data,
    )
    done = triaxcal("log", "info", path, "--json")
    assert done.code == 0
    assert "no driver named 'con'; did you mean 'can'?" in done.json["samples"]["fault"]


def test_export_is_csv_that_reads_back_as_the_same_numbers(finished_run: Any, triaxcal: Run) -> None:
    done = triaxcal("log", "export", finished_run.modbus)
    assert done.code == 0
    rows = list(csv.reader(io.StringIO(done.out)))
    assert rows[0] == ["t_s", "ux", "uy", "uz", "temp_c"]
    values = np.array(rows[1:], dtype=float)
    assert done.err == f"{len(values)} samples; none lost\n"
    assert values[0, 0] == 0.0
    np.testing.assert_allclose(np.diff(values[:, 0]), 0.01, atol=2e-6)
    counts = values[:, 1:4] * 2**23 / 10
    np.testing.assert_allclose(counts, np.rint(counts), atol=1e-6)


def test_export_of_the_corrected_output_in_the_verification(finished_run: Any, tmp_path: Path, triaxcal: Run) -> None:
    out = tmp_path / "a.csv"
    done = triaxcal("log", "export", finished_run.can, "-o", out, "--stream", "corrected", "--phase", "verification")
    assert (done.code, done.out) == (0, "")
    values = np.loadtxt(out, delimiter=",", skiprows=1)
    length = np.linalg.norm(values[:, 1:4], axis=1)
    assert abs(np.median(length) - 1) < 1e-4
    before = out.read_bytes()
    triaxcal("log", "export", finished_run.can, "-o", out).failed(2, f"{out}: cannot be written: File exists")
    assert out.read_bytes() == before


def test_export_knows_its_streams(finished_run: Any, triaxcal: Run) -> None:
    triaxcal("log", "export", finished_run.can, "--stream", "reading").failed(
        2, "--stream reading: the recording has readings, corrected"
    )


@pytest.fixture
def readings_alone(tmp_path: Path, triaxcal: Run) -> Path:
    """Twenty samples of the readings, and no check poses."""
    log, rec = tmp_path / "a.log", tmp_path / "rec.mcap"
    frames = (
        f"({1_700_000_000 + i / 100:.6f}) can0 {identifier:03X}#{(head + struct.pack('<H', i) + tail).hex()}\n"
        for i in range(20)
        for identifier, head, tail in ((0x185, bytes(6), b""), (0x285, bytes(5), bytes(1)))
    )
    log.write_text("".join(frames))
    assert triaxcal("log", "import", log, "--profile", "triax-ref-can", "-o", rec).code == 0
    return rec


def test_export_of_a_phase_that_is_not_there_names_those_that_are(
    readings_alone: Path, tmp_path: Path, triaxcal: Run
) -> None:
    out = tmp_path / "a.csv"
    done = triaxcal("log", "export", readings_alone, "--phase", "verification", "-o", out)
    done.failed(2, f"--phase verification: {readings_alone} has calibration")
    assert not out.exists()
    assert triaxcal("log", "export", readings_alone, "-o", out).code == 0


def test_export_of_a_stream_that_never_came_names_those_that_did(
    readings_alone: Path, tmp_path: Path, triaxcal: Run
) -> None:
    out = tmp_path / "a.csv"
    done = triaxcal("log", "export", readings_alone, "--stream", "corrected", "-o", out)
    done.failed(2, "--stream corrected: ", "no sample of it in its phase calibration; samples: calibration readings")
    assert not out.exists()


@pytest.mark.slow
def test_a_recording_cut_short_is_mended_and_the_loss_is_counted(
    finished_run: Any, tmp_path: Path, triaxcal: Run
) -> None:
    whole = finished_run.can.read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[: len(whole) // 5])
    assert triaxcal("log", "info", path, "--json").json["finished"] is False
    done = triaxcal("log", "recover", path, "--json")
    assert (done.code, done.err) == (0, "")
    assert done.json["format"] == "triaxcal.recovery/1"
    assert done.json["output"] == str(tmp_path / "cut.recovered.mcap")
    assert done.json["cut_short"] is True
    info = triaxcal("log", "info", done.json["output"], "--json").json
    assert (info["finished"], info["recovered"]) == (True, True)
    assert done.json["raw_records"] == info["raw"]["calibration"]["records"] > 0
    assert triaxcal("poses", done.json["output"], "--json").json["poses"]
    triaxcal("log", "recover", path).failed(2, f"{tmp_path / 'cut.recovered.mcap'}: exists already")
    assert triaxcal("log", "recover", path, "-o", tmp_path / "b.mcap").code == 0
    triaxcal("audit", tmp_path / "b.mcap").failed(2, "outcome.json: missing; the recording holds no result to audit")


def test_of_an_empty_file_nothing_is_recovered_and_nobody_is_told_to_try(tmp_path: Path, triaxcal: Run) -> None:
    path = tmp_path / "empty.mcap"
    path.touch()
    for command in (["log", "info"], ["diagnose"]):
        triaxcal(*command, path).failed(2, f"{path}: the file is empty; nothing was recorded")
    triaxcal("log", "recover", path, "--json").failed(3, f"{path}: nothing to recover")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("out", ["missing/b.mcap", "file/b.mcap"])
def test_a_place_where_nothing_can_be_mended_to(finished_run: Any, tmp_path: Path, triaxcal: Run, out: str) -> None:
    (tmp_path / "file").touch()
    triaxcal("log", "recover", finished_run.can, "-o", tmp_path / out).failed(2, f"{tmp_path / out}: ")


@pytest.mark.slow
def test_a_whole_recording_recovers_without_a_loss(finished_run: Any, tmp_path: Path, triaxcal: Run) -> None:
    out = tmp_path / "again.mcap"
    recovery = triaxcal("log", "recover", finished_run.can, "-o", out, "--json").json
    assert not any(recovery[k] for k in ("cut_short", "raw_missing", "raw_dropped", "bytes_dropped", "chunks_failed"))
    done = triaxcal("audit", out, "--json")
    assert done.code == 0
    assert done.json["audits"][0]["notes"][0] == "the recording was cut short or damaged, and mended"


@pytest.mark.slow
def test_no_recording_hides_another(finished_run: Any, tmp_path: Path, triaxcal: Run) -> None:
    good, cut, other = tmp_path / "a.mcap", tmp_path / "b.mcap", tmp_path / "deeper" / "c.mcap"
    other.parent.mkdir()
    whole = finished_run.modbus.read_bytes()
    for path, data in ((good, whole), (cut, whole[:100_000]), (other, whole)):
        path.write_bytes(data)
    good.with_suffix(".outcome.json").write_text("{}")
    done = triaxcal("audit", tmp_path)
    assert done.code == 2
    assert done.out.splitlines()[-1] == "3 recordings: 1 agrees, 1 differs, 1 could not be audited"
    assert f"{good}: differs" in done.out
    assert "  a.outcome.json: the file beside the recording is not the one in it" in done.out
    assert done.err.startswith(f"triaxcal: {cut}: the file ends, not finished, ")
    assert done.err.count("\n") == 1
    listed = triaxcal("audit", tmp_path / "*.mcap", good, tmp_path / "no.mcap", tmp_path / "x*", "--json")
    assert listed.code == 2
    assert [a["recording"] for a in listed.json["audits"]] == [
        str(good), str(cut), str(tmp_path / "no.mcap"), str(tmp_path / "x*"),
    ]  # fmt: skip
    assert [bool(a["error"]) for a in listed.json["audits"]] == [False, True, True, True]
    assert triaxcal("audit", good).code == 1
    (tmp_path / "empty").mkdir()
    triaxcal("audit", tmp_path / "empty").failed(2, f"{tmp_path / 'empty'}: Is a directory, without a recording")
