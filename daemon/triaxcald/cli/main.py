"""The command line ``triaxcal``: which commands there are, and what exit code each failure owes."""

from __future__ import annotations

import sys


def entry() -> None:
    """Console script. Needs the extra ``station``; says so where it is not installed."""
    try:
        from triaxcald.cli.commands import main
    except ModuleNotFoundError as e:
        sys.stderr.write(f"triaxcal: the module {e.name} is missing; pip install 'triaxcal[station]' brings it\n")
        sys.exit(2)
    sys.exit(main(sys.argv[1:]))
