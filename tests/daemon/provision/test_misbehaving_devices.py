"""What is said of a device that misbehaves is what its memory cells hold."""

from __future__ import annotations

import runpy
import threading
from functools import partial
from pathlib import Path

import pytest

from tests.devices.bench import Bench
from tests.devices.habits import Habits
from tests.devices.rows import ROWS, Row
from triaxcald.cli import provisioning
from triaxcald.schema.codes import Stage

SCRIPT = Path(__file__).parents[3] / "docs/reference/misbehaving-devices.py"


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Longer than any row is silent or busy that comes back."""
    monkeypatch.setattr("triaxcald.provision.access.RECONNECT_S", 2.5)
    monkeypatch.setattr("triaxcal_drivers.BUSY_S", 2.5)


@pytest.mark.slow
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.does)
def test_what_is_said_of_a_device_that(row: Row, tmp_path: Path, triaxcal, monkeypatch: pytest.MonkeyPatch) -> None:
    with Bench(tmp_path, triaxcal, row.transport, **row.settings) as bench:
        if row.supply:

            def ask(stage: Stage, _: str) -> None:
                if stage is Stage.POWER_OFF:
                    threading.Timer(0.3, bench.power_cycle).start()

            monkeypatch.setattr(provisioning, "_ask", ask)
        done = bench.provision("--json", *row.arguments)
        outcome = done.json["outcome"]
        said = f"{outcome['reason']} {done.err}"
        seen = (_held(bench), outcome["device_state"], done.code)
        assert seen == (row.holds, row.state, row.exit_code), said
        assert row.says in said


def _held(bench: Bench) -> str:
    return "old" if bench.holds_old() else "new" if bench.holds_new() else "neither"


def test_the_page_about_them_shows_these_rows() -> None:
    names = runpy.run_path(str(SCRIPT))
    assert names["PAGE"].read_text("utf-8") == names["page"](), "run make docs"


@pytest.mark.slow
def test_a_second_provisioning_proves_no_more_of_a_device_that_ignores_its_restart(tmp_path: Path, triaxcal) -> None:
    with Bench(tmp_path, triaxcal, habits=Habits(reset_ignored=True, forget_store=True)) as bench:
        again = partial(triaxcal, "provision", "--resume", bench.station, "--json")
        for provision in (partial(bench.provision, "--json"), again):
            done = provision()
            assert done.code == 0, done.err
            assert done.json["outcome"]["device_state"] == "new_unverified"
        bench.power_cycle()
        assert bench.holds_old()
