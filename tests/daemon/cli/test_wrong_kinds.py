"""A file of another kind than a command expects: one line says what it is and what was expected."""

from __future__ import annotations

import gzip
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.catalogue import BUILT_IN

Run = Callable[..., Any]
PROFILE = BUILT_IN / "triax-ref-can.toml"
STATION, DEVICE = "a station file (triaxcal.station/1)", "the file of a simulated device (triaxcal.device/1)"
TABLE = "t_s,ux,uy,uz\n" + "".join(f"{i / 100},1,2,3\n" for i in range(100))


@pytest.fixture
def files(finished_run: Any, workshop: Any, calibrations: Path) -> dict[str, Path]:
    """One of each kind. ``long`` is a document too long to be TOML."""
    write = workshop.write
    named = {
        "station": workshop.station({"bus": {"host": "127.0.0.1", "port": 1}}),
        "device": workshop.device(),
        "profile": PROFILE,
        "recording": finished_run.can,
        "calibration": calibrations / "linear.json",
        "long": write("long.json", json.dumps({"format": "triaxcal.loop/1", "x": "a" * 300_000})),
        "table": write("table.csv", TABLE),
        "packed": workshop.folder / "table.csv.gz",
        "named_mcap": write("table.mcap", TABLE),
    }
    named["packed"].write_bytes(gzip.compress(TABLE.encode()))
    return {name: Path(path) for name, path in named.items()}


CASES = [
    *((command, "device", f"{DEVICE}, expected {STATION}") for command in ("run {}", "registers {}")),
    ("record {} -o x.mcap", "device", f"{DEVICE}, expected {STATION}"),
    ("sim {}", "station", f"{STATION}, expected {DEVICE}"),
    ("run {}", "profile", f"a profile (triaxcal.profile/1), expected {STATION}"),
    ("sim {}", "profile", f"a profile (triaxcal.profile/1), expected {DEVICE}"),
    ("run {}", "recording", f"an MCAP file, expected {STATION}"),
    ("sim {}", "packed", f"a gzip file, expected {DEVICE}"),
    ("run {}", "calibration", f"a JSON document of format triaxcal.calibration/1, expected {STATION}"),
    ("run {}", "long", f"a JSON document of format triaxcal.loop/1, expected {STATION}"),
    ("run {}", "table", f"expected {STATION}"),
    *(
        (command, name, f"a JSON document of format {kind}, expected a recording")
        for command in ("fit {}", "poses {}", "diagnose {}")
        for name, kind in (("calibration", "triaxcal.calibration/1"), ("long", "triaxcal.loop/1"))
    ),
    ("fit {}", "station", "a TOML file of format triaxcal.station/1, expected a recording"),
    ("fit {}", "named_mcap", "not an MCAP file but text, expected a recording"),
    ("verify {} x.csv", "recording", "an MCAP file, expected a JSON document"),
    ("apply {} x.csv -o y.csv", "packed", "a gzip file, expected a JSON document"),
    ("rezero {} x.csv", "recording", "an MCAP file, expected a JSON document"),
    ("provision {} station.toml", "station", "a TOML file of format triaxcal.station/1, expected a JSON document"),
    ("audit {}", "packed", "not an MCAP file but a gzip file, expected a recording"),
    ("audit {}", "table", "not an MCAP file but text, expected a recording"),
    ("audit {}", "calibration", "not an MCAP file but a JSON document of format triaxcal.calibration/1"),
    ("log info {}", "station", "not an MCAP file but a TOML file of format triaxcal.station/1"),
    ("log import {} --profile triax-ref-can -o x.mcap", "calibration", "the file is a JSON document of format"),
]


@pytest.mark.parametrize(("command", "name", "words"), CASES)
def test_a_file_of_another_kind_is_named(
    files: dict[str, Path], triaxcal: Run, monkeypatch: pytest.MonkeyPatch, command: str, name: str, words: str
) -> None:
    monkeypatch.chdir(files["table"].parent)
    done = triaxcal(*(str(files[name]) if word == "{}" else word for word in command.split()))
    done.failed(2, str(files[name]), words)
    assert done.err.count("\n") == 1


def test_a_device_file_named_as_profile_is_called_that(files: dict[str, Path], workshop: Any, triaxcal: Run) -> None:
    station = workshop.station({"bus": {"host": "127.0.0.1", "port": 1}, "profile": str(files["device"])})
    triaxcal("run", station).failed(2, f"{DEVICE}, expected a profile (triaxcal.profile/1)")


def test_a_document_of_another_format_is_called_by_it(triaxcal: Run, workshop: Any) -> None:
    plan = workshop.write("plan.json", json.dumps({"format": "triaxcal.plan/1", "poses": []}))
    triaxcal("verify", plan, "x.csv").failed(2, "expected a triaxcal.calibration/1", "not triaxcal.plan/1")
    bare = workshop.write("bare.json", json.dumps({"format": "triaxcal.certificate/1"}))
    assert ", not " not in triaxcal("verify", bare, "x.csv").err
