"""What a command imports before it works: its own room, and nothing that it does not need."""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

from triaxcald.cli.commands import main, parser

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


COMMANDS = [
    "demo", "run", "sim", "record", "poses", "fit", "diagnose", "apply", "verify", "frame", "plan", "provision",
    "restore", "registers", "devices", "audit", "batch", "log",
]  # fmt: skip
WORK = ["numpy", "scipy", "rich", "pydantic", "asyncio", "matplotlib", "can", "mcap", "pymodbus", "triaxcal"]


def leaves(top: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    for action in top._actions:
        if isinstance(action, argparse._SubParsersAction):
            for sub in action.choices.values():
                yield from leaves(sub) if sub._subparsers else [sub]


@pytest.mark.parametrize("command", list(leaves(parser())), ids=lambda p: p.prog)
def test_every_command_has_a_function_that_runs_it_and_help_that_says_what_it_does(
    command: argparse.ArgumentParser,
) -> None:
    module, _, name = command.get_default("run").partition(":")
    assert callable(getattr(import_module(f"triaxcald.cli.{module}"), name))
    assert command.description
    assert command.epilog is None or command.epilog.startswith(f"example: {command.prog} ")


def test_commands_that_compute_are_marked_where_they_are_declared() -> None:
    marked = {command.prog for command in leaves(parser()) if command.get_default("computes")}
    names = ("poses", "fit", "diagnose", "rezero", "apply", "verify", "frame", "plan", "serve", "audit", "fleet")
    many = ("poses", "fit", "diagnose", "verify", "apply")
    assert marked == {f"triaxcal {name}" for name in (*names, *(f"batch {name}" for name in many))}


def test_without_a_command_all_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    shown = capsys.readouterr().out
    assert [name for name in COMMANDS if not re.search(rf"^    {name}( |$)", shown, re.MULTILINE)] == []
    assert max(map(len, shown.splitlines())) <= 80


@pytest.mark.parametrize(
    "arguments", [("--version",), ("--help",), ("fit", "--help"), ("log", "export", "--help"), ("fitt",)]
)
def test_what_only_shows_help_loads_nothing_that_works(arguments: tuple[str, ...]) -> None:
    loaded = set(_python(LOADED, *arguments).stderr.split())
    assert "triaxcald.cli.commands" in loaded
    assert not loaded & set(WORK) - {"triaxcal"}


@pytest.mark.parametrize(
    ("word", "said"),
    [
        ("fitt", "no command 'fitt'; did you mean 'fit'?"),
        ("diagnos", "did you mean 'diagnose'?"),
        ("xyz", "there are demo,"),
    ],
)
def test_a_command_that_there_is_not_is_answered_with_the_nearest(
    word: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([word]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line


@pytest.mark.parametrize("module", ["provisioning", "stations", "measuring", "fitting"])
def test_a_command_begins_without_the_models_of_documents(module: str) -> None:
    models = "(m for m in sys.modules if m.startswith(('triaxcald.schema.', 'triaxcal.schema')))"
    code = f"import sys, triaxcald.cli.{module}; print(*{models})"
    done = _python(code)
    assert done.returncode == 0, done.stderr
    assert set(done.stdout.split()) <= {"triaxcald.schema.codes", "triaxcald.schema.columns"}


@pytest.mark.slow
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
    assert done.stderr == f"triaxcal: the module {missing} is missing; pip install triaxcal brings it\n"
