"""Abort: ends the process at once, without unwinding, after registered actions, one
message and with the right exit code.

A signal handler calls it, in the middle of any work of the main thread. Actions
therefore take no lock that the main thread could hold, and every wait is bounded.
"""

from __future__ import annotations

import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import NamedTuple, NoReturn

from triaxcald.printable import printable

STOP_SIGNALS = [s for n in ("SIGINT", "SIGTERM", "SIGHUP") if (s := getattr(signal, n, None)) is not None]
DEVICE, INTERRUPTED = 4, 130
CLOSING_S = 1.0
"""Time limit of all actions together; a working disk finishes a recording in much
less."""


class AbortNotice(NamedTuple):
    """Message about what an abort leaves behind; ``in_doubt`` if the state of a device
    is not settled."""

    note: str
    in_doubt: bool = False


Action = Callable[[float], AbortNotice | None]
"""Receives its deadline (`time.monotonic`). Raises nothing."""

_actions: dict[object, Action] = {}


def add_action(key: object, action: Action) -> None:
    """Register an action of an abort, until `discard_action`."""
    _actions[key] = action


def discard_action(key: object) -> None:
    _actions.pop(key, None)


@contextmanager
def at_abort(action: Action) -> Iterator[None]:
    """Runs ``action`` if the process is aborted within this context."""
    key = object()
    add_action(key, action)
    try:
        yield
    finally:
        discard_action(key)


def abort(reason: str) -> NoReturn:
    """End the process with exit code 130, or 4 if a device is in doubt, and one line
    on standard error."""
    said, code = [reason], INTERRUPTED
    try:
        ignore_stop_signals()
        until_s = time.monotonic() + CLOSING_S
        for action in reversed(list(_actions.values())):
            if (notice := action(until_s)) is not None:
                said.append(notice.note)
                code = DEVICE if notice.in_doubt else code
        tell(f"triaxcal: {'; '.join(said)}")
    finally:
        os._exit(code)


def ignore_stop_signals() -> None:
    """Ignores stop signals to the end of the process.

    Python reports a signal that came just before as an unraisable `OSError`
    ("ignored due to race condition"). That report is dropped: the process ends
    anyway.
    """
    report = sys.unraisablehook

    def all_others(unraisable: sys.UnraisableHookArgs) -> None:
        if unraisable.object is not None or not isinstance(unraisable.exc_value, OSError):
            report(unraisable)

    sys.unraisablehook = all_others
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def tell(line: str) -> None:
    """Write a line to standard error, even during another write to it; drop it if the
    stream is closed or its reader does not keep up."""
    steer(f"{printable(line)}\n")


def steer(text: str) -> None:
    """Write our own text unchanged, with control sequences for the terminal."""
    with suppress(AttributeError, OSError, ValueError):
        descriptor = sys.stderr.fileno()
        if select.select([], [descriptor], [], 0)[1]:
            os.write(descriptor, text.encode(sys.stderr.encoding, "backslashreplace"))
