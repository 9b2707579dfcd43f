"""What every measuring command begins with: a recording, ours or as text, as poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from triaxcal.arrays import Floats
from triaxcal.model.directions import FULL, directions, spiral
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import SyntheticUnit, Tumble
from triaxcald.errors import InputError, RecordingError
from triaxcald.inputs import VERIFICATION, bundle_of, measure, parse_document, read_document
from triaxcald.recording.reader import Recording
from triaxcald.tables.samples import Reading


def test_a_recording_brings_its_profile_with_it(finished_run: Any) -> None:
    measured = measure(str(finished_run.can))
    assert len(measured.poses) >= 26
    assert measured.profile is not None
    assert measured.profile.output.unit == "V"
    assert measured.signs == (-1, -1, -1)
    assert measured.windows is not None
    assert set(measured.poses[0].channels) == {"temp_c", "status"}


def test_the_corrected_stream_and_the_verification_can_be_asked_for(finished_run: Any) -> None:
    measured = measure(str(finished_run.can), phase=VERIFICATION, stream="corrected")
    assert len(measured.poses) >= 3
    lengths = [np.linalg.norm(p.mean) for p in measured.poses]
    np.testing.assert_allclose(lengths, 1.0, atol=1e-4)


def _csv(n: int = 1200, hold: int = 200) -> str:
    rng = np.random.default_rng(5)
    rows = ["t_s,ux,uy,uz,temp_c"]
    for i in range(n):
        axis = i // hold % 3
        u = [(1.0 if k == axis else 0.0) + 1e-4 * rng.standard_normal() for k in range(3)]
        rows.append(f"{i * 0.01:.2f},{u[0]:.6f},{u[1]:.6f},{u[2]:.6f},{20 + axis}")
    return "\n".join(rows) + "\n"


def test_text_has_no_signs_and_says_what_came_twice(tmp_path: Path) -> None:
    lines = _csv().splitlines(keepends=True)
    path = tmp_path / "a.csv"
    path.write_text("".join([*lines[:300], lines[299], *lines[300:]]))
    measured = measure(str(path))
    assert measured.signs is None
    assert measured.profile is None
    assert len(measured.poses) == 6
    assert measured.data_quality[0] == "duplicate_samples: 1"  # one in a hundred shows a creep by chance
    assert [round(p.channels["temp_c"]) for p in measured.poses] == [20, 21, 22, 20, 21, 22]


def test_the_samples_of_a_text_are_judged_like_those_of_a_recording(tmp_path: Path) -> None:
    lines = _csv().splitlines(keepends=True)
    frozen = lines[451].split(",")[2]
    for i in range(451, 551):
        t, x, _, *rest = lines[i].split(",")
        lines[i] = ",".join([t, x, frozen, *rest])
    del lines[701:704]
    path = tmp_path / "a.csv"
    path.write_text("".join(lines))
    measured = measure(str(path))
    found = {q.split(":")[0]: q for q in measured.data_quality}
    assert found["stuck_output"].startswith(f"stuck_output: y repeats {float(frozen):.7g} for 100 samples")
    assert "in the pose that begins at 4." in found["stuck_output"]
    assert [p.fault for p in measured.poses if p.fault] == ["stuck_output"]
    assert found["missing_samples"] == "missing_samples: 3 of 1200 by the times, at 7.0 s"


def test_rows_that_came_twice_and_readings_that_did_are_one_line(tmp_path: Path) -> None:
    lines = _csv().splitlines(keepends=True)
    for i in range(20, 1200, 50):
        lines[i] = ",".join([lines[i].split(",")[0], *lines[i - 1].split(",")[1:]])
    path = tmp_path / "a.csv"
    path.write_text("".join([*lines[:300], lines[299], *lines[300:]]))
    assert [q for q in measure(str(path)).data_quality if not q.startswith("creeping")] == [
        "duplicate_samples: 1; 24 of 1199 samples repeat the one before on all axes"
    ]


def test_a_pose_that_creeps_is_said(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    lines = _csv(6000, hold=1000).splitlines()
    for i in range(1, 1001):
        t, x, *rest = lines[i].split(",")
        lines[i] = ",".join([t, f"{float(x) + 2e-7 * i:.7f}", *rest])
    path.write_text("\n".join(lines) + "\n")
    assert [q.split(":")[0] for q in measure(str(path)).data_quality] == ["creeping_pose"]


def test_too_little_for_one_window_is_an_error_of_one_line(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("t_s,ux,uy,uz\n0,1,2,3\n")
    with pytest.raises(InputError, match=r"a\.csv: "):
        measure(str(path))


def test_a_recording_without_its_profile_is_named(finished_run: Any, rewrite: Callable[..., Path]) -> None:
    path = rewrite(finished_run.can, attachment=lambda name, data: None if name == "profile.toml" else data)
    with Recording.open(path) as recording, pytest.raises(RecordingError, match=r"attachment profile\.toml: missing"):
        bundle_of(recording)


def test_the_profile_in_a_recording_has_its_files_with_it(finished_run: Any) -> None:
    with Recording.open(finished_run.can) as recording:
        assert set(bundle_of(recording).files) == {"triax-ref-can.dbc"}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"{", "line 1: not JSON: "),
        (b'{\n"a": 1,\n"b" 2}', "line 3: not JSON: "),
        (b"[1, 2]", "expected a JSON object"),
        (b"\xff\xfe", "not UTF-8 text (byte 0)"),
        (b"", "line 1: not JSON: "),
        (b"[" * 100_000, "not JSON: nested too deeply"),
    ],
)
def test_what_is_no_document_is_named_with_the_line(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "cal.json"
    path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_document(str(path))
    assert str(caught.value).startswith(str(path))
    assert words in str(caught.value)


def test_a_document_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"cal\.json: No such file or directory"):
        read_document(str(tmp_path / "cal.json"))
    with pytest.raises(InputError, match="Is a directory"):
        read_document(str(tmp_path))


def _tumbled(path: Path, rate_hz: float, hold_s: float, move_s: float, times: float = 1.0) -> str:
    """Poses as text, its times multiplied by ``times``."""
    unit = SyntheticUnit(
        Sensor(np.full(3, 2.0), np.zeros(3), np.zeros(3)), Tumble(spiral(6), hold_s, move_s), np.full(3, 2e-4), seed=1
    )
    t_s = np.arange(int(6 * (hold_s + move_s) * rate_hz)) / rate_hz
    return _written(path, t_s * times, unit.sample(t_s)[0])


def _written(path: Path, t_s: Floats, readings: Floats) -> str:
    rows = (f"{t:.6f},{x:.6f},{y:.6f},{z:.6f}\n" for t, (x, y, z) in zip(t_s, readings, strict=True))
    path.write_text("t_s,ux,uy,uz\n" + "".join(rows), "utf-8")
    return str(path)


@pytest.mark.parametrize(("rate_hz", "times"), [(25.0, 1e3), (200.0, 1e6), (200.0, 200.0), (1.0, 1.0)])
def test_times_that_may_be_in_another_unit_are_asked_about(tmp_path: Path, rate_hz: float, times: float) -> None:
    path = _tumbled(tmp_path / "unit.csv", rate_hz, 30.0 / rate_hz**0.5, 1.0, times)
    with pytest.raises(InputError, match=r"column t_s: integers in steps of .*--time-unit s, ms, us or ns"):
        measure(path)


@pytest.mark.parametrize(("rate_hz", "hold_s", "move_s"), [(1 / 60, 7200.0, 5.0), (0.1, 2400.0, 60.0), (1, 3600.0, 60)])
def test_a_slow_logger_is_read_as_it_says(tmp_path: Path, rate_hz: float, hold_s: float, move_s: float) -> None:
    path = _tumbled(tmp_path / "slow.csv", rate_hz, hold_s, move_s)
    measured = measure(path, reading=Reading(time_unit="s"))
    assert len(measured.poses) == 6
    assert measured.data_quality == []


def test_a_table_of_pose_means_is_poses_with_the_noise_that_it_states(tmp_path: Path) -> None:
    u = 2 * np.array([v for _, v in directions(FULL)])
    rows = [f"{x:.9f},{y:.9f},{z:.9f}" for x, y, z in u + np.random.default_rng(1).normal(0, 1e-4, u.shape)]
    path = tmp_path / "means.csv"
    path.write_text("\n".join(["x,y,z", *rows]))
    bare = measure(str(path), reading=Reading(pose_means=True))
    assert len(bare.poses) == len(u)
    assert bare.data_quality == ["unknown_noise: told from the residuals, so that no lack of fit can show"]
    path.write_text("\n".join(["x,y,z,se_ux,se_uy,se_uz", *(f"{row},1e-4,2e-4,3e-4" for row in rows)]))
    stated = measure(str(path), reading=Reading(pose_means=True))
    assert stated.data_quality == []
    np.testing.assert_allclose([p.standard_error for p in stated.poses], np.tile([1e-4, 2e-4, 3e-4], (len(u), 1)))
    path.write_text("\n".join(["x,y,z,se_ux", *(f"{row},1e-4" for row in rows)]))
    with pytest.raises(InputError, match="standard errors for 1 outputs, expected se_ux, se_uy, se_uz or none"):
        measure(str(path), reading=Reading(pose_means=True))


def test_a_table_of_milliseconds_gives_the_poses_that_seconds_give(tmp_path: Path) -> None:
    seconds = measure(_tumbled(tmp_path / "s.csv", 200.0, 3.0, 0.8))
    millis = measure(_tumbled(tmp_path / "ms.csv", 200.0, 3.0, 0.8, 1000.0), reading=Reading(time_unit="ms"))
    assert [p.start_s for p in millis.poses] == [p.start_s for p in seconds.poses]
    assert [p.mean.tolist() for p in millis.poses] == [p.mean.tolist() for p in seconds.poses]
    assert len(seconds.poses) == 6


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{"a": 1, "b": {"c": 1, "c": 2}}', "the key 'c' is given twice"),
        ('{"a": "\\ud800"}', "half of a surrogate pair"),
        ('{"a": ' + "9" * 5000 + "}", "not JSON that can be read"),
        ('{"a": ' * 100_000, "nested too deeply"),
        ("[1]", "expected a JSON object"),
    ],
)
def test_a_document_that_json_would_let_pass_or_choke_on_is_refused(text: str, words: str) -> None:
    with pytest.raises(InputError, match=f"^a.json: .*{words}"):
        parse_document(text.encode(), where="a.json")


def test_a_whole_surrogate_pair_is_a_character() -> None:
    assert parse_document(b'{"a": "\\ud83d\\ude00"}', where="a.json") == {"a": "\U0001f600"}


@pytest.mark.parametrize(
    ("header", "times", "is_wrong"),
    [
        ("t_s", lambda i: i / 100, False),
        ("t_s", lambda i: i / 95, False),
        ("t_s", lambda i: i / 112, True),
        ("t_s", lambda i: i / 70, True),
        ("t_s", lambda i: i // 20 * 20 / 130, True),  # of a batch, all samples bear its time
        ("t_s", lambda i: i // 25 * 25 / 100, False),
        ("time [ms]", lambda i: 1000 * i / 130, True),
        ("t_s", lambda i: i, False),  # an index
        ("sample", lambda i: i, False),
    ],
)
def test_times_that_contradict_the_rate_that_is_given_are_said(
    header: str, times: Callable[[int], float], is_wrong: bool, tmp_path: Path
) -> None:
    path = tmp_path / "a.csv"
    lines = _csv().splitlines()[1:1201]
    rows = [f"{times(i):.6f},{','.join(line.split(',')[1:4])}" for i, line in enumerate(lines)]
    path.write_text("\n".join([f"{header},ux,uy,uz", *rows]))
    found = {q.split(":")[0]: q for q in measure(str(path), reading=Reading(rate=100.0)).data_quality}
    assert ("rate" in found) == is_wrong
    assert "bursts" not in found, "they are counted at the rate"
