"""A process that is killed while it writes registers leaves a journal, and that is all that it takes."""

from __future__ import annotations

import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.devices.bench import TRANSPORTS, Bench, Transport
from tests.devices.habits import Habits
from tests.devices.place import Trouble
from tests.devices.profiles import Timing
from tests.devices.table import NINE

SLOW = Trouble(late=1.0, late_s=0.03)
"""So that there is a middle to be killed in."""


@pytest.mark.slow
@pytest.mark.parametrize("finish", ["resume", "restore"])
@pytest.mark.parametrize("transport", TRANSPORTS)
def test_it_is_finished_or_taken_back_by_another(
    tmp_path: Path, triaxcal: Callable[..., Any], start: Callable[..., Any], wait_until: Callable[..., None],
    free_port: int, multicast_fault: str | None, transport: Transport, finish: str,
) -> None:  # fmt: skip
    habits = Habits(store_command=False, reset_command=transport != "rtu")
    if transport == "canopen" and multicast_fault is not None:
        pytest.skip(f"multicast does not work on this machine: {multicast_fault}")
    between_processes = {"interface": "udp_multicast", "channel": "239.74.163.3", "options": {"port": free_port}}
    node = between_processes if transport == "canopen" else {}
    with Bench(tmp_path, triaxcal, transport, habits, SLOW, Timing(reply_s=5.0, silence_s=10.0), node=node) as bench:
        process = start("provision", bench.calibration, bench.station)
        wait_until(lambda: len(set(bench.unit.written) & set(NINE)) >= 3)
        process.send(signal.SIGKILL)
        process.wait()
        bench.server.settle()  # what the dead process has asked is answered to nobody
        assert bench.holds_mixture()
        journal = tmp_path / "journal" / "misbehaving_unit-4711.json"
        assert journal.exists()
        if finish == "resume":
            done = triaxcal("provision", "--resume", bench.station)
            assert bench.holds_new(), done.err
        else:
            done = triaxcal("restore", journal, bench.station)
            assert bench.holds_old(), done.err
        assert done.code == 0, done.err
