"""Standard streams that are closed, full or read by nobody: what a command has done, and its exit code, stand."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.cli.test_device_commands import CAL
from triaxcald.simulation.unit import Faults, Stored, factory_calibration

PROGRAM = Path(sys.executable).with_name("triaxcal")
OLD = Stored(factory_calibration())
CLOSED = """
import os, sys
from triaxcald.cli.main import _open_what_is_closed
_open_what_is_closed()
descriptor = os.open(sys.argv[1], os.O_CREAT | os.O_WRONLY)
print("said")
print("said", file=sys.stderr)
os.system("echo said; echo said >&2")
assert sys.stdin.read() == ""
assert descriptor > 2
"""


def _run(*command: Any, closed: tuple[int, ...] = (), **more: Any) -> subprocess.CompletedProcess[str]:
    streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **more}
    return subprocess.run(
        list(map(str, command)), preexec_fn=partial(_close, closed), text=True, timeout=180, check=False, **streams
    )


def _close(numbers: tuple[int, ...]) -> None:
    for number in numbers:
        os.close(number)


@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
def test_what_is_said_to_a_closed_stream_goes_into_no_file_that_is_opened_later(
    tmp_path: Path, closed: tuple[int, ...]
) -> None:
    path = tmp_path / "a"
    done = _run(sys.executable, "-c", CLOSED, path, closed=closed)
    assert done.returncode == 0, done.stderr
    assert path.read_bytes() == b""


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["plan"], ["plan", "--json"], ["devices"]])
@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2)])
def test_a_closed_stream_is_as_dev_null(arguments: list[str], closed: tuple[int, ...]) -> None:
    done = _run(PROGRAM, *arguments, closed=closed)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["plan"], ["plan", "--json"], ["--version"]])
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_standard_output_that_takes_no_more_is_an_error_of_one_line(arguments: list[str], unbuffered: str) -> None:
    with open("/dev/full", "w") as full:
        done = _run(PROGRAM, *arguments, stdout=full, env={**os.environ, "PYTHONUNBUFFERED": unbuffered})
    assert (done.returncode, done.stderr) == (5, "triaxcal: standard output: No space left on device\n")


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [["plan"], ["plan", "--json"]])
def test_a_reader_that_has_gone_is_no_error(arguments: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    done = _run(PROGRAM, *arguments, stdout=writing)
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [[], ["--json"]])
def test_registers_that_were_written_are_said_where_standard_output_takes_no_more(
    workshop: Any, arguments: list[str]
) -> None:
    cal = workshop.write("cal.json", json.dumps(CAL))
    with workshop.serve(workshop.device()) as served, open("/dev/full", "w") as full:
        done = _run(PROGRAM, "provision", cal, workshop.station({"bus": served.bus}), *arguments, stdout=full)
        assert Stored.from_image(served.unit.eeprom).calibration != OLD.calibration
    assert done.returncode == 5
    assert done.stderr.startswith("triaxcal: standard output: No space left on device; ")
    assert "written and stored; the device holds the new calibration, read back after a restart\n" in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("arguments", [[], ["--json"]])
@pytest.mark.parametrize("reader", ["full", "gone"])
def test_a_device_that_fails_is_said_whatever_becomes_of_standard_output(
    workshop: Any, arguments: list[str], reader: str
) -> None:
    cal = workshop.write("cal.json", json.dumps(CAL))
    if reader == "full":
        writing = os.open("/dev/full", os.O_WRONLY)
    else:
        reading, writing = os.pipe()
        os.close(reading)
    with workshop.serve(workshop.device(), Faults(forget_store=True)) as served:
        done = _run(PROGRAM, "provision", cal, workshop.station({"bus": served.bus}), *arguments, stdout=writing)
    os.close(writing)
    assert done.returncode == 4
    assert done.stderr.startswith("triaxcal: provisioning failed at identity after the reset: ")


@pytest.mark.slow
@pytest.mark.parametrize(("reader", "words"), [("full", "standard output: No space left on device"), ("gone", "")])
def test_events_that_nobody_takes_are_an_error_unless_the_reader_has_gone(
    workshop: Any, reader: str, words: str
) -> None:
    if reader == "full":
        writing = os.open("/dev/full", os.O_WRONLY)
    else:
        reading, writing = os.pipe()
        os.close(reading)
    station = workshop.station({"bus": {"host": "127.0.0.1", "port": 1}}, plan={"comes_back_s": 0.0})
    done = _run(PROGRAM, "run", station, "--events", stdout=writing)
    os.close(writing)
    assert done.returncode == 4
    lines = [line for line in done.stderr.splitlines() if "standard output" in line]
    assert len(lines) == bool(words)
    assert words in done.stderr
