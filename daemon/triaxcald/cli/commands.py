"""Runs one command of the line: finds its module, and calls it so that errors become
exit codes (`triaxcald.cli.exit_codes`)."""

from __future__ import annotations

import argparse
import gc
import io
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import triaxcal_drivers as td
from triaxcald.cli.keys_syntax import register_keys
from triaxcald.cli.many_syntax import register_many
from triaxcald.cli.syntax import OneLineParser, keep_apart, parsed, register
from triaxcald.memory import require_address_space

BAD_INPUT = 2
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
"""Settings of the libraries of linear algebra, which they read when they are
loaded. Figures must not depend on how many threads a computer has."""


def parser() -> OneLineParser:
    top = OneLineParser(prog="triaxcal", description="Calibrates three-axis accelerometers.")
    top.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = top.add_subparsers(dest="command", required=True, metavar="COMMAND")
    register(commands)
    register_many(commands)
    register_keys(commands)
    return top


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        say_version()
        parser.exit()


def say_version() -> None:
    from importlib.metadata import version  # a third of the time that this takes

    print(f"triaxcal {version('triaxcal')}", flush=True)


def main(arguments: Sequence[str]) -> int:
    """Runs one command; gives its exit code. Errors are one line on standard
    error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # a terminal that knows no µ shall not end the work
    top = parser()
    if not arguments:
        top.print_help()
        return 0
    try:
        _require_command(top, arguments[0])
        chosen = parsed(top, arguments)
    except SystemExit as e:
        return int(e.code or 0)
    except OSError as e:  # what was asked for is the version, and standard output does not take it
        from triaxcald.cli.exit_codes import not_written

        return not_written(e, 0)
    require_address_space()
    from triaxcald.cli.exit_codes import run  # what an error may be of, and what shows it

    return run(lambda: keep_apart(chosen), _working(chosen))


def _require_command(top: OneLineParser, word: str) -> None:
    """Ends with what may have been meant where there is no such command."""
    known = next(a.choices for a in top._actions if isinstance(a, argparse._SubParsersAction))
    if word.startswith("-") or word in known:
        return
    close = td.hints.closest(word, known)
    hint = f"did you mean '{close}'?" if close else f"there are {', '.join(known)}"
    top.error(f"no command '{word}'; {hint}")


def _working(chosen: argparse.Namespace) -> Callable[[], int]:
    """The command, imported when it is called."""

    def work() -> int:
        os.environ.update(dict.fromkeys(THREADS, "1"))
        module, _, name = chosen.run.partition(":")
        command = getattr(import_module(f"triaxcald.cli.{module}"), name)
        if "scipy" in sys.modules or chosen.computes:
            from triaxcald.computer import compute_with_one_thread

            compute_with_one_thread()
        if not gc.isenabled():  # as the program begins
            gc.freeze()
            gc.enable()
        from triaxcald.cli.console import telling_progress

        with telling_progress():
            code: int = command(chosen)
        return code

    return work
