"""The end at once, without unwinding: what is still done before it, what is
said, and the exit code.

It comes from a signal handler, in the midst of whatever the main thread was
doing. What it calls therefore takes no lock that the main thread could hold,
and waits for nothing without a bound.
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
"""For all that is still to be done, together: a disk that works has long
finished a recording by then."""


class Left(NamedTuple):
    """What the end leaves behind, in words; ``in_doubt`` where nobody can vouch
    for what a device holds."""

    note: str
    in_doubt: bool = False


Action = Callable[[float], Left | None]
"""Is given the time (`time.monotonic`) until which it may take. Raises nothing."""

_actions: dict[object, Action] = {}


def add_action(key: object, action: Action) -> None:
    """To be done at the end at once, until `discard_action`."""
    _actions[key] = action


def discard_action(key: object) -> None:
    _actions.pop(key, None)


@contextmanager
def at_abort(action: Action) -> Iterator[None]:
    """What is to be done where the process is ended at once in this context."""
    key = object()
    add_action(key, action)
    try:
        yield
    finally:
        discard_action(key)


def abort(reason: str) -> NoReturn:
    """Ends the process: 130, or 4 where a device is in doubt; one line on
    standard error."""
    said, code = [reason], INTERRUPTED
    try:
        ignore_stop_signals()
        until_s = time.monotonic() + CLOSING_S
        for action in reversed(list(_actions.values())):
            if (left := action(until_s)) is not None:
                said.append(left.note)
                code = DEVICE if left.in_doubt else code
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
    """A line to standard error, also in the midst of a write to it; nowhere,
    where it is closed or nobody reads."""
    steer(f"{printable(line)}\n")


def steer(text: str) -> None:
    """The same of a text of our own as it is, which the terminal may obey."""
    with suppress(AttributeError, OSError, ValueError):
        descriptor = sys.stderr.fileno()
        if select.select([], [descriptor], [], 0)[1]:
            os.write(descriptor, text.encode(sys.stderr.encoding, "backslashreplace"))
