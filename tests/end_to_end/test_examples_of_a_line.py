"""The examples of `examples/line`, as processes of their own beside a simulated unit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from triaxcald.audit import audit

EXAMPLES = Path(__file__).parents[2] / "examples" / "line"
PLAN = {"poses": 14, "hold_s": 1.0, "check_poses": 3}
LIMITS = {"rms_g": 5e-5, "verification_rms_g": 5e-5}

pytestmark = pytest.mark.slow


def ran(script: str, *arguments: Any, **environment: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *([EXAMPLES / script] if script else [])]
    return subprocess.run(
        [*map(str, command), *map(str, arguments)],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=240,
    )


def test_verdicts_come_one_a_line(workshop: Any) -> None:
    with workshop.serve(workshop.device()) as served:
        unit = {"name": "left", "serial": "9999", "bus": served.bus}
        station = workshop.station(unit, plan=PLAN, limits=LIMITS)
        good = ran("verdicts.py", station, "--serial", "left=4711")
        other = ran("verdicts.py", station, "--serial", "left=4712")
    assert (good.returncode, good.stdout) == (0, "PASS     left 4711: within_limits\n")
    assert (other.returncode, other.stdout) == (4, "STOPPED  left 4712: wrong_unit\n")
    (recording,) = workshop.folder.glob("*.mcap")
    assert audit(recording).differences == ()  # though the station file names another serial number


def test_openhtf_reports_measurements_with_units_and_limits(workshop: Any) -> None:
    pytest.importorskip("openhtf", reason="OpenHTF is not installed")
    with workshop.serve(workshop.device()) as served:
        station = workshop.station({"name": "left", "bus": served.bus}, plan=PLAN, limits=LIMITS)
        good = ran("openhtf_station.py", station, "4711")
        record = json.loads((workshop.folder / "results.json").read_bytes())
        other = ran("openhtf_station.py", station, "4712")
        failed = json.loads((workshop.folder / "results.json").read_bytes())
    assert good.returncode == 0, good.stderr
    assert (record["outcome"], record["dut_id"]) == ("PASS", "4711")
    measured = {name: m for phase in record["phases"] for name, m in phase["measurements"].items()}
    for name in "fit_rms", "own_output_rms":
        assert measured[name]["units"]["suffix"] == "g"
        assert measured[name]["validators"] == ["0 <= x <= 5e-05"]
        assert 0 < measured[name]["measured_value"] < 5e-5
    assert measured["code"]["measured_value"] == "within_limits"
    assert other.returncode == 1
    assert failed["outcome"] in ("FAIL", "ERROR")
    codes = [m["measured_value"] for phase in failed["phases"] for n, m in phase["measurements"].items() if n == "code"]
    assert codes == ["wrong_unit"]


def test_pytest_has_a_test_for_each_slot(workshop: Any) -> None:
    with workshop.serve(workshop.device()) as served:
        absent = {"name": "right", "bus": {"host": "127.0.0.1", "port": 1}}
        station = workshop.station(
            {"name": "left", "bus": served.bus}, absent, plan={**PLAN, "comes_back_s": 0.5}, limits=LIMITS
        )
        arguments = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", EXAMPLES / "test_units.py")
        done = ran("", *arguments, f"--junitxml={workshop.folder / 'units.xml'}", STATION=str(station))
    assert done.returncode == 1, done.stdout
    report = (workshop.folder / "units.xml").read_text()
    assert 'tests="2"' in report
    assert 'failures="1"' in report
    assert '<property name="code" value="within_limits" />' in report
    assert '<property name="code" value="absent" />' in report
