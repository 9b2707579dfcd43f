"""Runs a command's work, and says in one line what went wrong with it."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.cli.console import Unshown, say
from triaxcald.cli.interrupt import Interrupted
from triaxcald.errors import BAD_INPUT, DISK, DONE, INTERRUPTED, REFUSED, DaemonError, exit_code_of, severest
from triaxcald.memory import no_room_left, out_of_memory, ran_out_of_memory


def run(check: Callable[[], None], work: Callable[[], int]) -> int:
    """The exit code of ``work``, which is not begun where ``check`` raises."""
    try:
        return _run(check, work)
    except Exception as e:
        if not ran_out_of_memory(e) and not no_room_left():
            raise
        e.__traceback__ = e.__context__ = None  # and all that its frames hold
        say(f"triaxcal: {out_of_memory(e)}")
        return DISK


def _run(check: Callable[[], None], work: Callable[[], int]) -> int:
    code: int = DONE
    try:
        check()
        code = work()
        sys.stdout.flush()
        return code
    except tc.Refused as e:
        say(f"triaxcal: refused: {e}" + (f"; add the poses {', '.join(e.wanted)}" if e.wanted else ""))
        return REFUSED
    except td.RegisterValueError as e:
        say(f"triaxcal: refused: {e}; nothing was written")
        return REFUSED
    except ModuleNotFoundError as e:
        if ran_out_of_memory(e) or (what := td.hints.lacking(e)) is None:
            raise
        say(f"triaxcal: {what}")
        return BAD_INPUT
    except (tc.TriaxcalError, td.DriverError, DaemonError) as e:
        say(f"triaxcal: {e}")
        return exit_code_of(e)
    except Interrupted as e:
        say(f"triaxcal: {e}")
        return INTERRUPTED
    except KeyboardInterrupt:
        say("triaxcal: interrupted")
        return INTERRUPTED
    except Unshown as e:
        return not_written(e.error, e.code, e.told)
    except OSError as e:
        if ran_out_of_memory(e):
            raise
        return not_written(e, code)


def not_written(e: OSError, code: int, told: str = "") -> int:
    """The exit code where standard output, or a file, does not take what came
    of work that itself ends with ``code``; ``told`` is what came of it."""
    _drop_output()
    if isinstance(e, BrokenPipeError):  # whoever read our output has gone; nothing more can be said there
        return code
    say(f"triaxcal: {e.filename or 'standard output'}: {e.strerror}{f'; {told}' if told else ''}")
    return max(code, BAD_INPUT) if e.filename else severest((code, DISK))


def _drop_output() -> None:
    """Redirect the rest of the buffer, so that the interpreter does not fail on it at
    its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
