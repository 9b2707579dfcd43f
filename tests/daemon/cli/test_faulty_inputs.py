"""A faulty input is one line on standard error with what and where, nothing on standard output, and exit code 2."""

from __future__ import annotations

import io
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal.model.directions import directions
from triaxcald.recording.mcap_records import MAGIC

Run = Callable[..., Any]
HEADER = "t_s,ux,uy,uz\n"
ROWS = "".join(f"{i / 100},1,2,3\n" for i in range(100))

CSV_FAULTS = [
    (HEADER + "0,1,2,nan\n" + ROWS, "line 2: field uz: 'nan', expected a finite number"),
    (HEADER + ROWS + "5,1,inf,3\n", "line 102: field uy: 'inf', expected a finite number"),
    (HEADER + "0,1,2,three\n", "line 2: field uz: 'three', expected a finite number"),
    (HEADER + "0,1,2,3\n\n1,,2,3\n", "line 4: field ux: empty, expected a number"),
    (HEADER + "0,1,2\n", "line 2: 3 fields, expected 4"),
    (HEADER + "0,1,2,3,4\n", "line 2: 5 fields, expected 4"),
    ("time,left,up,ahead\n" + ROWS, "no three outputs among the columns time, left, up, ahead; name them: --columns"),
    ("sample,ax,ay,az\n" + ROWS.replace("0.", ""), "column sample is an index, and nothing states a rate: --rate HZ"),
    (ROWS, "no header over 4 columns; name the columns by number: --columns t=1,ux=2,uy=3,uz=4"),
    ("t,x,y,z,temp\n" + ROWS, "line 1: 5 names, and 4 fields in the lines of numbers below"),
    ("All is well that ends well.\n", "no line with three numbers, expected a table of samples"),
    ("", "empty file, expected the header t_s,ux,uy,uz"),
    (HEADER, "line 1: no samples after the header"),
    ("# nothing\n", "no line with three numbers, expected a table of samples"),
    (HEADER + "0,1,2,3\n1,1,2,3\n", "column t_s: integers in steps of 1 in a unit that nothing states"),
    (HEADER + ROWS + "0.5,1,2,3\n", "line 102: field t_s: 0.5 follows 0.99, expected times that rise"),
    (HEADER + "0,1,2,3\n0,1,2,4\n", "line 3: field t_s: 0.0 comes twice with different values"),
    ("\0\0\0\0", "binary data, expected a text table"),
    (HEADER.encode() + b"0,1,2,\xff\n", "line 2: byte 0xff, expected UTF-8 text"),
]


def test_a_stream_that_never_rests_is_told_of_turning(tmp_path: Path, triaxcal: Run) -> None:
    t = np.arange(2000) * 0.01
    u = np.stack([np.sin(t), np.cos(1.3 * t), np.sin(0.7 * t)], axis=1)
    rows = "".join(f"{s:.2f},{x:.5f},{y:.5f},{z:.5f}\n" for s, (x, y, z) in zip(t, u, strict=True))
    (tmp_path / "turning.csv").write_text(HEADER + rows)
    found = triaxcal("fit", str(tmp_path / "turning.csv"))
    assert found.code == 3
    assert "turning.csv: the unit never rests; `triaxcal fit --turning`" in found.err


def test_options_for_tables_are_refused_for_recordings(tmp_path: Path, triaxcal: Run) -> None:
    triaxcal("fit", "a.mcap", "--rate", "100").failed(
        2, "a.mcap: --columns, --time-unit, --rate, --skip-bad, --where and"
    )
    triaxcal("fit", "a.csv", "--columns", "ax").failed(
        2, "expected ROLE=COLUMN as in t=time,ux=ax,uy=ay,uz=az, not 'ax'"
    )
    triaxcal("fit", "a.csv", "--where", "ACC").failed(2, "expected NAME=VALUE as in sensor=ACC, not 'ACC'")


@pytest.mark.parametrize(("content", "words"), CSV_FAULTS)
@pytest.mark.parametrize("command", ["fit", "-"])
def test_a_faulty_csv(
    tmp_path: Path, triaxcal: Run, monkeypatch: pytest.MonkeyPatch, content: str | bytes, words: str, command: str
) -> None:
    raw = content if isinstance(content, bytes) else content.encode()
    out = tmp_path / "cal.json"
    if command == "-":
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(raw)))
        triaxcal("diagnose", "-", "-o", out, "--json").failed(2, "standard input: ", words)
    else:
        path = tmp_path / "a.csv"
        path.write_bytes(raw)
        triaxcal("fit", path, "-o", out, "--report", tmp_path / "r.html").failed(2, f"{path}: ", words)
        path.unlink()
    assert list(tmp_path.iterdir()) == []


def test_a_gzip_file_that_ends_too_early_or_is_none(tmp_path: Path, triaxcal: Run) -> None:
    path = tmp_path / "a.csv.gz"
    path.write_bytes(b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x00\xff")
    triaxcal("poses", path).failed(2, f"{path}: the gzip data end too early")
    path.write_text(HEADER + ROWS)
    triaxcal("poses", path).failed(2, f"{path}: not readable as gzip")


def _reading_commands(path: Path) -> list[list[Any]]:
    cal = path.with_name("cal.json")
    return [
        ["poses", path], ["fit", path], ["fit", path, "-o", cal], ["diagnose", path], ["plan", path],
        ["verify", path.with_name("good.json"), path], ["audit", path], ["log", "export", path],
        ["log", "export", path, "-o", path.with_name("out.csv")],
    ]  # fmt: skip


@pytest.fixture
def good(calibrations: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(calibrations / "linear.json", tmp_path / "good.json"))


def _each_fails(path: Path, triaxcal: Run, words: str) -> None:
    before = sorted(path.parent.iterdir())
    for command in _reading_commands(path):
        triaxcal(*command).failed(2, str(path), words)
    assert sorted(path.parent.iterdir()) == before


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.0, 0.3, 0.999])
def test_a_recording_that_was_cut_short(finished_run: Any, good: Path, triaxcal: Run, share: float) -> None:
    whole = finished_run.can.read_bytes()
    path = good.with_name("cut.mcap")
    path.write_bytes(whole[: int(len(whole) * share)])
    _each_fails(path, triaxcal, "log recover" if share else "")


@pytest.mark.slow
def test_a_recording_with_a_flipped_byte_anywhere(finished_run: Any, tmp_path: Path, triaxcal: Run) -> None:
    """Every byte of a finished recording is under a checksum."""
    whole = bytearray(finished_run.can.read_bytes())
    path = tmp_path / "flipped.mcap"
    for at in range(0, len(whole), len(whole) // 40):
        whole[at] ^= 1
        path.write_bytes(whole)
        triaxcal("audit", path).failed(2, str(path))
        whole[at] ^= 1
    path.write_bytes(whole)
    assert triaxcal("audit", path).code == 0


def test_a_flipped_byte_fails_every_command(finished_run: Any, good: Path, triaxcal: Run) -> None:
    whole = bytearray(finished_run.can.read_bytes())
    whole[len(whole) // 2] ^= 1
    path = good.with_name("flipped.mcap")
    path.write_bytes(whole)
    _each_fails(path, triaxcal, "")


def test_a_flipped_magic_number(finished_run: Any, good: Path, triaxcal: Run) -> None:
    path = good.with_name("magic.mcap")
    path.write_bytes(b"x" + finished_run.can.read_bytes()[1:])
    _each_fails(path, triaxcal, "MCAP")


@pytest.mark.parametrize("content", [b"t_s,ux,uy,uz\n0,1,2,3\n", MAGIC + b"\0" * 100, MAGIC + MAGIC])
def test_what_is_no_recording(good: Path, triaxcal: Run, content: bytes) -> None:
    path = good.with_name("none.mcap")
    path.write_bytes(content)
    _each_fails(path, triaxcal, "")
    triaxcal("log", "info", path).failed(2, str(path))


def test_a_recording_of_somebody_else(good: Path, triaxcal: Run) -> None:
    from mcap.writer import Writer

    path = good.with_name("other.mcap")
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        writer.finish()
    _each_fails(path, triaxcal, "not a recording of triaxcal: its header says profile 'ros2'")
    triaxcal("log", "info", path).failed(2, str(path))
    triaxcal("log", "recover", path).failed(2, str(path))


def test_what_is_not_there_or_a_folder(good: Path, triaxcal: Run) -> None:
    path = good.with_name("missing.mcap")
    _each_fails(path, triaxcal, "No such file or directory")
    folder = good.with_name("folder.mcap")
    folder.mkdir()
    _each_fails(folder, triaxcal, "Is a directory")
    triaxcal("poses", good.with_name("missing.csv")).failed(2, "missing.csv: cannot be read: No such file")


CAL_FAULTS = [
    ("{", "line 1: not JSON"),
    ("[]", "expected a JSON object"),
    ("{}", "format: expected a triaxcal.calibration/1"),
    ('{"format": "triaxcal.calibration/1"}', "scale_factor: missing"),
    ('{"format": "triaxcal.calibration/1", "scale_factor": [1, 2], "misalignment": [0, 0, 0], "bias": [0, 0, 0]}',
     "expected three numbers each"),
    ('{"format": "triaxcal.calibration/1", "scale_factor": [1, 1, 1], "misalignment": [0, 0, 0], "bias": [0, 0, NaN]}',
     "expected three numbers each"),
]  # fmt: skip


@pytest.mark.parametrize(("content", "words"), CAL_FAULTS)
def test_a_faulty_calibration(finished_run: Any, workshop: Any, triaxcal: Run, content: str, words: str) -> None:
    path = workshop.write("cal.json", content)
    triaxcal("verify", path, finished_run.can, "--json").failed(2, f"{path}", words)
    station = workshop.station({"bus": {"host": "127.0.0.1", "port": 1}})
    triaxcal("provision", path, station, "--json").failed(2, f"{path}", words)


def test_a_calibration_by_temperature_needs_the_temperature(finished_run: Any, tmp_path: Path, triaxcal: Run) -> None:
    path, csv = tmp_path / "cal.json", tmp_path / "a.csv"
    path.write_text(
        '{"format": "triaxcal.calibration/1", "scale_factor": [1, 1, 1], "misalignment": [0, 0, 0], "bias": [0, 0, 0],'
        ' "effects": {"temperature_bias": {"x": {"value": 1e-4}, "y": {"value": 1e-4}, "z": {"value": 1e-4}}},'
        ' "channel_reference": {"temp_c": 25}}'
    )
    csv.write_text(HEADER + "".join(f"{i / 100},{i % 7 * 1e-5},0,1\n" for i in range(500)))
    triaxcal("verify", path, csv).failed(2, "temp_c")


@pytest.fixture
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Still for 1.6 s in each of fourteen poses; in a folder of its own."""
    a = np.repeat([v for _, v in directions(14)], 80, axis=0)
    a = a + 1e-4 * np.random.default_rng(1).standard_normal(a.shape)
    path = tmp_path_factory.mktemp("short") / "fourteen.csv"
    path.write_text(HEADER + "".join(f"{i / 50},{x:.6f},{y:.6f},{z:.6f}\n" for i, (x, y, z) in enumerate(a)))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("option", ["-o", "--report"])
@pytest.mark.parametrize("where", ["missing/x", "file/x", "folder"])
def test_a_place_where_no_result_can_go(short: Path, tmp_path: Path, triaxcal: Run, option: str, where: str) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for command in ("fit", "diagnose"):
        triaxcal(command, short, option, tmp_path / where, "--json").failed(2, f"{tmp_path / where}: ")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]


def test_a_full_disk_for_the_result(finished_run: Any, tmp_path: Path, triaxcal: Run) -> None:
    full = tmp_path / "full"
    full.symlink_to("/dev/full")
    triaxcal("fit", finished_run.can, "-o", full, "--json").failed(2, f"{full}: cannot be written: No space left")
    triaxcal("log", "export", finished_run.can, "-o", full).failed(2, f"{full}: cannot be written: ")
    assert full.is_symlink()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fitt"], "no command 'fitt'; did you mean 'fit'?"),
        (["fit"], "the following arguments are required: REC"),
        (["fit", "a.csv", "--sign=-,-"], "expected three signs as in -,-,+, not '-,-'"),
        (["fit", "a.csv", "--sign=a,b,c"], "expected three signs"),
        (["fit", "a.csv", "--reference", "0"], "expected a positive number, not '0'"),
        (["fit", "a.csv", "--reference", "nan"], "expected a positive number, not 'nan'"),
        (["fit", "a.csv", "--limit", "-1"], "expected a positive number, not '-1'"),
        (["fit", "a.csv", "--limit", "much"], "expected a positive number, not 'much'"),
        (["plan", "--poses", "8"], "--poses: a plan of 8 poses cannot carry nine parameters"),
        (["plan", "--poses", "0"], "expected a whole number of at least 1, not '0'"),
        (["plan", "--poses", "1e3"], "expected a whole number of at least 1, not '1e3'"),
        (["plan", "--for", "flat_earth"], "--for flat_earth: no effect of that name; known: "),
        (
            ["plan", "--for", "remanence"],
            "--for remanence: expected an effect of direction, time or a channel; this one goes with the pose before",
        ),
        (["plan", "--for", "temperature_lag"], "this one goes with what a channel was before, for which any plan does"),
        (["record", "station.toml"], "the following arguments are required: -o"),
        (["log"], "the following arguments are required: info|recover|delete|export"),
        (["sim", "none.toml"], "none.toml: No such file or directory"),
        (["run", "none.toml"], "none.toml: No such file or directory"),
        (["demo", "--seed", "x"], "argument --seed: expected a whole number of at least 0, not 'x'"),
    ],
)
def test_a_wrong_command_line(triaxcal: Run, arguments: list[str], words: str) -> None:
    triaxcal(*arguments).failed(2, words)


def test_refused_data_say_which_poses_would_mend_them(tmp_path: Path, triaxcal: Run) -> None:
    path = tmp_path / "a.csv"
    path.write_text(HEADER + "".join(f"{i / 100},{i % 7 * 1e-5},0,1\n" for i in range(500)))
    for command in (["fit"], ["diagnose"], ["fit", "--json"]):
        triaxcal(command[0], path, *command[1:], "-o", tmp_path / "cal.json").failed(3, "refused: ", "add the poses ")
    assert list(tmp_path.iterdir()) == [path]


def test_help_is_no_error(triaxcal: Run) -> None:
    done = triaxcal("--help")
    assert (done.code, done.err) == (0, "")
    for command in ("demo", "run", "sim", "record", "poses", "fit", "diagnose", "verify", "plan", "provision",
                    "registers", "audit", "log", "devices"):  # fmt: skip
        assert f"\n    {command}" in done.out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fit", "a.csv", "-o", "a.csv"], "--output: a.csv: it would overwrite what is read"),
        (["fit", "a.csv", "--report", "./a.csv"], "--report: a.csv: it would overwrite what is read"),
        (["diagnose", "a.csv", "--check", "b.csv", "--report", "b.csv"], "--report: b.csv: it would overwrite what is"),
        (["diagnose", "a.csv", "b.csv", "-o", "b.csv"], "--output: b.csv: it would overwrite what is read"),
        (["fit", "a.csv", "-o", "same", "--report", "same"], "--output, --report: same: one would overwrite the other"),
    ],
)
def test_nothing_is_written_over_what_is_read(
    tmp_path: Path, triaxcal: Run, monkeypatch: pytest.MonkeyPatch, arguments: list[str], words: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a.csv", "b.csv"):
        Path(name).write_text(HEADER + ROWS)
    triaxcal(*arguments).failed(2, words)
    assert {p.name: p.read_text() for p in tmp_path.iterdir()} == dict.fromkeys(("a.csv", "b.csv"), HEADER + ROWS)
