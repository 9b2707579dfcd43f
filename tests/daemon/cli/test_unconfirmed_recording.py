"""A recording of which most is unconfirmed, as another unit answered: commands say that first, and advise no poses."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import PROFILE_FILE, STATION_FILE
from triaxcald.recording.segments import SegmentedWriter
from triaxcald.recording.writer import RecordingWriter

Run = Callable[..., Any]
WHY = "two units answer at node 5 on socketcan can0: 0777, 0888"
BATCH = 100


def _copied(source: Path, target: Path, confirmed: float, why: str | None = WHY) -> Path:
    """The calibration phase of a recording, of which that part is confirmed."""
    kind = SegmentedWriter if target.stem.endswith("segmented") else RecordingWriter
    with Recording.open(source) as held, kind(target, metadata=held.metadata, preview_channels=None, waits=True) as new:
        for name, data in held.attachments.items():
            if name in (STATION_FILE, PROFILE_FILE) or name.startswith("profile/"):
                new.attach(name, held.attachments.media_types[name], data)
        for batch in held.raw("calibration"):
            for i in range(0, len(batch), BATCH):
                new.raw("calibration", batch.part(i, min(i + BATCH, len(batch))))
        first = int(new.offered * confirmed)
        new.unconfirmed(first - first % BATCH, {} if why is None else {"error": why})
    return target.with_suffix(".segments.json") if kind is SegmentedWriter else target


@pytest.mark.parametrize("name", ["one.mcap", "segmented.mcap"])
@pytest.mark.parametrize("confirmed", [0.0, 0.2])
@pytest.mark.parametrize("command", ["fit", "diagnose", "poses"])
def test_that_another_unit_answered_is_said_first_and_no_pose_is_advised(
    finished_run: Any, triaxcal: Run, tmp_path: Path, command: str, confirmed: float, name: str
) -> None:
    path = _copied(finished_run.can, tmp_path / name, confirmed)
    done = triaxcal(command, path)
    assert done.code == (0 if command == "poses" else 3)
    first, *others = done.err.splitlines()
    assert first.startswith(f"{path}: ")
    assert "unconfirmed" in first
    assert WHY in first
    assert not any("too short" in line or "add the poses" in line or "never rests" in line for line in others)


def test_what_answered_need_not_be_known(finished_run: Any, triaxcal: Run, tmp_path: Path) -> None:
    path = _copied(finished_run.can, tmp_path / "one.mcap", 0.0, why=None)
    assert "another unit answered" in triaxcal("poses", path).err.splitlines()[0]


def test_frame_advises_no_poses_of_it_either(
    finished_run: Any, triaxcal: Run, tmp_path: Path, calibrations: Path
) -> None:
    path = _copied(finished_run.can, tmp_path / "one.mcap", 0.0)
    for calibration in "own", str(calibrations / "linear.json"):
        done = triaxcal("frame", path, "--calibration", calibration)
        assert (done.code, WHY in done.err.splitlines()[0]) == (3, True)
        assert "add the poses" not in done.err


def test_a_recording_of_which_most_is_confirmed_is_read_as_ever(
    finished_run: Any, triaxcal: Run, tmp_path: Path
) -> None:
    done = triaxcal("fit", _copied(finished_run.can, tmp_path / "one.mcap", 0.9))
    assert done.code == 0
    assert WHY not in done.err
    assert "unconfirmed_records" in done.err
