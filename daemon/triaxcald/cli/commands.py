"""All commands, and the one place where errors become exit codes."""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import version

from triaxcal.errors import Refused, TriaxcalError
from triaxcal_drivers.errors import DriverError, RegisterValueError
from triaxcal_drivers.extras import lacking
from triaxcald.cli.arguments import OneLineParser, keep_apart, parsed
from triaxcald.cli.console import say
from triaxcald.cli.interrupt import Interrupted
from triaxcald.errors import DaemonError
from triaxcald.exit_codes import BAD_INPUT, DONE, INTERRUPTED, REFUSED, exit_code_of

ROOMS = {
    "line": ("demo", "run", "sim", "record"),
    "measuring": ("poses", "verify"),
    "fitting": ("fit", "diagnose"),
    "applying": ("apply",),
    "framing": ("frame",),
    "planning": ("plan",),
    "provisioning": ("provision", "restore"),
    "devices": ("registers", "devices"),
    "recordings": ("audit", "log"),
}
"""The modules beside this one and their commands. Only what is asked for is imported: all would take longer than most
work."""


def parser(first: str = "") -> OneLineParser:
    """Knows the commands of the room of ``first``, the first argument; all of them where no room has it."""
    top = OneLineParser(prog="triaxcal", description="Calibrates three-axis accelerometers.")
    top.add_argument("--version", action="version", version=f"triaxcal {version('triaxcal')}")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    asked = [room for room, names in ROOMS.items() if first in names] or ([] if first == "--version" else ROOMS)
    for room in asked:
        import_module(f"triaxcald.cli.{room}").register(commands)
    return top


def main(arguments: Sequence[str]) -> int:
    """Runs one command; gives its exit code. Errors are one line on standard error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal that knows no µ shall not end the work
    try:
        chosen = parsed(parser(*arguments[:1]), arguments)
    except SystemExit as e:
        return int(e.code or 0)
    code: int = DONE
    try:
        keep_apart(chosen)
        code = chosen.run(chosen)
        sys.stdout.flush()
        return code
    except Refused as e:
        say(f"triaxcal: refused: {e}" + (f"; add the poses {', '.join(e.wanted)}" if e.wanted else ""))
        return REFUSED
    except RegisterValueError as e:
        say(f"triaxcal: refused: {e}; nothing was written")
        return REFUSED
    except ModuleNotFoundError as e:
        if (what := lacking(e)) is None:
            raise
        say(f"triaxcal: {what}")
        return BAD_INPUT
    except (TriaxcalError, DriverError, DaemonError) as e:
        say(f"triaxcal: {e}")
        return exit_code_of(e)
    except Interrupted as e:
        say(f"triaxcal: {e}")
        return INTERRUPTED
    except KeyboardInterrupt:
        say("triaxcal: interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        # Whoever read our output has gone; nothing more can be said there.
        _drop_output()
        return code
    except OSError as e:
        _drop_output()
        say(f"triaxcal: {e.filename or 'standard output'}: {e.strerror}")
        return max(code, BAD_INPUT)


def _drop_output() -> None:
    """What is still in the buffer, so that the interpreter does not stumble over it at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
