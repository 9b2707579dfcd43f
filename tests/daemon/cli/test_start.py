"""What a command imports before it works: its own room, and nothing that it does not need."""

from __future__ import annotations

import argparse
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from triaxcald.cli.commands import ROOMS, parser

RECORDING = Path(__file__).parents[3] / "recordings" / "can-second-order.mcap"
LOADED = """
import sys
from triaxcald.cli.commands import main
code = main(sys.argv[1:])
sys.stderr.write(" ".join(sys.modules))
sys.exit(code)
"""
WALLED = """
import sys
sys.modules[sys.argv.pop(1)] = None
from triaxcald.cli.main import entry
entry()
"""


def _python(code: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_has_the_commands_that_it_is_imported_for(room: str) -> None:
    commands = argparse.ArgumentParser().add_subparsers()
    import_module(f"triaxcald.cli.{room}").register(commands)
    assert tuple(commands.choices) == ROOMS[room]


def test_without_a_command_all_are_listed() -> None:
    assert [name in parser().format_help() for names in ROOMS.values() for name in names] == [True] * 16


@pytest.mark.parametrize(
    ("command", "walls"),
    [
        (("poses", RECORDING), ("scipy.stats", "scipy.optimize", "matplotlib", "jinja2", "pymodbus")),
        (("diagnose", RECORDING, "--json"), ("scipy.stats", "matplotlib", "jinja2", "pymodbus")),
        (("plan",), ("scipy.stats", "matplotlib", "jinja2", "can", "pymodbus")),
        (("--version",), ("scipy.stats", "matplotlib", "can", "mcap", "pymodbus", "pydantic")),
    ],
)
def test_a_command_does_not_load_what_it_does_not_need(command: tuple[str | Path, ...], walls: tuple[str, ...]) -> None:
    done = _python(LOADED, *command)
    assert done.returncode == 0
    loaded = set(done.stderr.split())
    assert "triaxcald.cli.commands" in loaded
    assert not loaded & set(walls)


@pytest.mark.parametrize("missing", ["rich.console", "pydantic", "mcap.records"])
def test_a_missing_module_is_said_in_one_line(missing: str) -> None:
    done = _python(WALLED, missing, "poses", RECORDING)
    assert done.returncode == 2
    assert done.stderr == f"triaxcal: the module {missing} is missing; pip install 'triaxcal[station]' brings it\n"
