"""The command line ``triaxcal``: which commands there are, and what exit code each failure owes."""

from __future__ import annotations

import os
import sys


def entry() -> None:
    """Console script. Needs the extra ``station``; says so where it is not installed."""
    try:
        from triaxcald.cli.commands import main

        code = main(sys.argv[1:])
    except ModuleNotFoundError as e:
        sys.stderr.write(f"triaxcal: the module {e.name} is missing; pip install 'triaxcal[station]' brings it\n")
        sys.exit(2)
    _leave_nothing_unsaid()
    sys.exit(code)


def _leave_nothing_unsaid() -> None:
    """Flushes what was said to standard error; where that has been closed, the interpreter shall not stumble over it.

    It would end with 120, whatever the command had to say by its exit code.
    """
    try:
        sys.stderr.flush()
    except (OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
