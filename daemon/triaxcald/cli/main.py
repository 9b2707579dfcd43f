"""Start and end of the process of the command line ``triaxcal``."""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
from typing import NoReturn

from triaxcald.abort import ignore_stop_signals
from triaxcald.cli.signals import heed_stop_signals
from triaxcald.memory import large_apart, out_of_memory, ran_out_of_memory
from triaxcald.printable import printable

LAST_THREADS_S = 1.0
"""Time to end for threads that have nothing to do, or are about to close a bus."""


def entry() -> NoReturn:
    """Console script. Says what is not installed in one line."""
    _open_what_is_closed()
    heed_stop_signals()
    _keep_from_python_can()
    large_apart()
    gc.disable()  # until the command has what it works with: modules are no garbage
    try:
        from triaxcald.cli.commands import main

        code = main(sys.argv[1:])
    except Exception as e:
        if ran_out_of_memory(e):
            sys.stderr.write(printable(f"triaxcal: {out_of_memory(e)}") + "\n")
            code = 5
        elif isinstance(e, ModuleNotFoundError):
            sys.stderr.write(f"triaxcal: the module {e.name} is missing; pip install triaxcal brings it\n")
            code = 2
        else:
            raise
    _leave_nothing_unsaid()
    _end(code)


def _open_what_is_closed() -> None:
    """A standard stream that the caller has closed (``>&-``) is /dev/null.

    Python has None in its place, and the next file to be opened, a recording or
    a port, would get its number: what others write there would go into it.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        if getattr(sys, name) is None:
            descriptor = os.open(os.devnull, os.O_RDWR)  # the lowest that is free: ``number``
            os.set_inheritable(descriptor, True)
            stream = open(descriptor, "w" if number else "r", encoding="utf-8", closefd=False)  # noqa: SIM115 - for good
            setattr(sys, name, stream)


def _keep_from_python_can() -> None:
    """python-can imports asammdf, and all that this brings, wherever it is
    installed: seconds before each command on a bus, none of which needs it.

    `triaxcal_drivers.logs.mf4` takes the mark away again.
    """
    sys.modules.setdefault("asammdf", None)  # type: ignore[arg-type]


def _end(code: int) -> NoReturn:
    """The interpreter's own end gives signals back to the system, which would
    spoil the exit code, and waits for every thread, one that hangs in a bus
    driver or reckons what nobody wants any more too."""
    ignore_stop_signals()
    others = [t for t in threading.enumerate() if t is not threading.current_thread() and not t.daemon]
    until_s = time.monotonic() + LAST_THREADS_S
    for thread in others:
        thread.join(max(0.0, until_s - time.monotonic()))
    if any(thread.is_alive() for thread in others):
        os._exit(code)
    gc.freeze()  # the end looks for garbage, in a tenth of a second, where all of it goes
    sys.exit(code)


def _leave_nothing_unsaid() -> None:
    """Flushes what was said to standard error; where that has been closed, the
    interpreter shall not stumble over it.

    It would end with 120, whatever the command had to say by its exit code.
    """
    try:
        sys.stderr.flush()
    except (OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
