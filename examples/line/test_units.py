"""pytest: a tray is calibrated once, each slot is a test. `STATION=station.toml pytest test_units.py`."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

STATION = Path(os.environ["STATION"])
SLOTS = [unit["name"] for unit in tomllib.loads(STATION.read_text())["units"]]


@pytest.fixture(scope="session")
def outcomes() -> dict:
    """The outcome of each slot."""
    command = [sys.executable, "-m", "triaxcald.cli", "run", str(STATION), "--events"]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    events = map(json.loads, done.stdout.splitlines())
    assert done.returncode != 2, "a wrong argument or a rule: nothing began, and standard error has the reason"
    return {event["unit"]: event["outcome"] for event in events if event["event"] == "ended"}


@pytest.mark.parametrize("slot", SLOTS)
def test_unit(slot: str, outcomes: dict, record_property) -> None:
    outcome = outcomes[slot]
    record_property("serial", outcome["serial"])
    record_property("code", outcome["code"])
    if outcome["measured"]:
        record_property("rms_g", outcome["measured"]["after"]["rms_g"])
    assert outcome["verdict"] == "pass", outcome["reason"]
