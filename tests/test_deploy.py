"""The files in deploy/ start the command that this project has, with options that it takes."""

from __future__ import annotations

import configparser
import json
import shlex
import shutil
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from triaxcald.cli.commands import parser

DEPLOY = Path(__file__).parents[1] / "deploy"
UNIT = DEPLOY / "triaxcal-record.service"


@pytest.fixture(scope="module")
def unit() -> configparser.ConfigParser:
    read = configparser.ConfigParser(interpolation=None, strict=True)
    read.optionxform = str  # type: ignore[assignment, method-assign]
    read.read(UNIT)
    return read


def test_the_service_starts_a_command_that_there_is(unit: configparser.ConfigParser) -> None:
    program, *command = shlex.split(unit["Service"]["ExecStart"])
    assert Path(program).name == "triaxcal"
    chosen = parser().parse_args(command)
    assert (chosen.command, chosen.metrics, chosen.log_format) == ("record", 9464, "json")
    assert chosen.segment_time == 3600, "one file would grow for ever, and is not finished by a kill"
    assert chosen.keep_free > 0


@pytest.mark.slow
def test_a_recorder_loads_nothing_that_draws() -> None:
    """Under the service's sandbox matplotlib finds no folder to write to, and it takes memory for months."""
    code = (
        "import sys, triaxcald.cli.record, triaxcald.run.record_only, triaxcald.run.session\n"
        "import triaxcald.service.supervisor\n"
        "sys.exit('matplotlib' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=180).returncode == 0


def test_the_container_starts_the_same_command(unit: configparser.ConfigParser) -> None:
    lines = (DEPLOY / "Dockerfile").read_text().replace("\\\n", "").splitlines()
    (command,) = (json.loads(line.removeprefix("CMD ")) for line in lines if line.startswith("CMD "))
    assert command == shlex.split(unit["Service"]["ExecStart"])[1:]


def test_the_image_is_built_from_what_the_package_is_and_nothing_else() -> None:
    """An environment and the history would make it ten times as large, since each step of it stays."""
    ignored, *rules = [line for line in (DEPLOY.parent / ".dockerignore").read_text().splitlines() if line[0] != "#"]
    project = tomllib.loads((DEPLOY.parent / "pyproject.toml").read_text())
    packages = project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]
    wanted = {Path(package).parts[0] for package in packages} | {project["project"]["readme"], "pyproject.toml"}
    assert ignored == "*"
    assert {rule[1:] for rule in rules if rule[0] == "!"} == wanted | set(project["project"]["license-files"])


def test_bad_files_are_not_started_again_and_an_interruption_is_no_failure(unit: configparser.ConfigParser) -> None:
    service = unit["Service"]
    assert (service["RestartPreventExitStatus"], service["SuccessExitStatus"]) == ("2", "130")
    assert service["Type"] == "notify"
    assert float(service["WatchdogSec"]) > 0


def test_the_service_may_write_locks_where_there_is_a_folder_for_them(unit: configparser.ConfigParser) -> None:
    """systemd starts nothing (226) where a path without the dash is not there."""
    assert unit["Service"]["ReadWritePaths"].split() == ["-/run/lock", "/tmp"]


def test_systemd_takes_the_unit(tmp_path: Path) -> None:
    systemd = shutil.which("systemd-analyze")
    if systemd is None:
        pytest.skip("this machine has no systemd-analyze")
    text = UNIT.read_text().replace("/opt/triaxcal/bin/triaxcal", "/bin/true").replace("User=triaxcal", "User=root")
    (tmp_path / UNIT.name).write_text(text)
    done = subprocess.run([systemd, "verify", str(tmp_path / UNIT.name)], capture_output=True, text=True, timeout=180)
    about_it = [line for line in done.stderr.splitlines() if UNIT.name in line]
    assert about_it == []


def test_a_reload_is_the_signal_that_the_command_takes_for_one_and_needs_no_other_program(
    unit: configparser.ConfigParser, tmp_path: Path
) -> None:
    waiting = "from signal import *; signal(SIGHUP, SIG_DFL); print(flush=True); pause()"  # nohup has it ignored
    with subprocess.Popen([sys.executable, "-c", waiting], text=True, stdout=subprocess.PIPE) as recorder:
        try:
            assert recorder.stdout is not None
            recorder.stdout.readline()
            without_programs = {"MAINPID": str(recorder.pid), "PATH": str(tmp_path)}
            subprocess.run(shlex.split(unit["Service"]["ExecReload"]), env=without_programs, check=True, timeout=180)
            assert recorder.wait(60) == -signal.SIGHUP
        finally:
            recorder.kill()
