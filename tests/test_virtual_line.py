"""Recordings whose figures are judged are of the same samples on every run of the tests."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.virtual_line import described, virtual_line
from triaxcal_drivers.interface import RawBatch
from triaxcald.inputs import CALIBRATION
from triaxcald.recording.reader import Recording

SECONDS = 20


def _raw(path: Path) -> list[RawBatch]:
    with Recording.open(path) as recording:
        return list(recording.raw(CALIBRATION))


@pytest.mark.parametrize(("name", "serial"), [("can", "4711"), ("modbus", "4712")])
def test_a_unit_recorded_once_more_sends_the_same_bytes_at_the_same_times(
    finished_run: Any, workshop: Any, triaxcal: Callable[..., Any], name: str, serial: str
) -> None:
    profile = f"triax-ref-{name}"
    bus = {"can": {"interface": "virtual", "channel": "again", "node_id": 5}, "modbus": {"host": "::1", "port": 502}}
    station = workshop.station({"profile": profile, "serial": serial, "bus": bus[name]})
    again = workshop.folder / "again.mcap"
    with virtual_line(described(finished_run.folder / f"{name}.toml")):
        done = triaxcal("record", station, "-o", again, "--seconds", SECONDS)
    assert done.code == 0, done.err
    first, second = _raw(finished_run.recording(name)), _raw(again)
    for column in ("time_ns", "source", "flags", "length"):
        was, now = (np.concatenate([getattr(b, column) for b in batches]) for batches in (first, second))
        assert len(now) > 100
        assert was[: len(now)].tolist() == now.tolist(), column
    was_sent, now_sent = (b"".join(b.payload for b in batches) for batches in (first, second))
    assert len(now_sent) > 100 * SECONDS * 10
    assert was_sent[: len(now_sent)] == now_sent
