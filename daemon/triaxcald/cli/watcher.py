"""A small process beside this one, which ends it where Python cannot.

A signal handler of Python waits until the main thread comes back to the
interpreter, and so does every thread that waits for its lock. Linear algebra
that finds no memory may not come back for a quarter of an hour. The system's
own part of the handler runs all the same, and writes the number of each signal
to the watcher (`signal.set_wakeup_fd`). After the third one, that process kills
this one unless it has ended or says that it is ending.

The watcher sends each number back, which wakes the event loop.
"""

from __future__ import annotations

import os
import select
import signal
import time
from contextlib import suppress

from triaxcald.abort import CLOSING_S, STOP_SIGNALS, ignore_stop_signals

LAST = 3  # the signal that ends the process at once
UNHEARD_S = 1.5
"""Time for Python to handle the last signal: the process must end within 2 s."""
ENDING_S = CLOSING_S + 4.0
"""Time for a process that has handled the signal to finish its files, even on a busy
machine."""
_RELOADS, _ENDING = 128, 129  # bytes that are no signal
_KILLED = b"triaxcal: killed: a third signal, and Python did not return; triaxcal log recover mends a recording\n"


class Watcher:
    """This process's end. ``fileno`` is where the numbers come back."""

    def __init__(self, told: int, back: int) -> None:
        self._told, self._back = told, back

    @classmethod
    def started(cls) -> Watcher | None:
        """None where there can be none. The process may have no other threads
        yet."""
        if not hasattr(os, "fork"):
            return None
        heard, told = os.pipe()
        back, echo = os.pipe()
        parent = os.getpid()
        try:
            child = os.fork()
        except OSError:  # no more processes
            for descriptor in (heard, told, back, echo):
                os.close(descriptor)
            return None
        if child == 0:
            _watch(heard, echo, parent)
        os.close(echo)  # but not ``heard``: to write to a watcher that was killed is no error then
        for descriptor in (told, back):
            os.set_blocking(descriptor, False)
        signal.set_wakeup_fd(told, warn_on_full_buffer=False)
        return cls(told, back)

    def fileno(self) -> int:
        return self._back

    def hear(self) -> bool:
        """Takes what has come back. False where the watcher is gone."""
        try:
            return os.read(self._back, 4096) != b""
        except BlockingIOError:
            return True

    def tell_reloads(self) -> None:
        """From now on SIGHUP stops nothing, until another signal has come."""
        self._tell(_RELOADS)

    def tell_ending(self) -> None:
        """Python has heard of the last signal."""
        self._tell(_ENDING)

    def _tell(self, what: int) -> None:
        with suppress(OSError):
            os.write(self._told, bytes([what]))


def _watch(heard: int, echo: int, parent: int) -> None:
    """The life of the watcher. Never returns, whatever happens."""
    try:
        ignore_stop_signals()
        os.setsid()  # no terminal of its own, which could hang up
        # Who waits for the end of an output must not wait for the watcher's,
        # nor the watcher for its own.
        for begin, end in ((0, heard), (heard + 1, echo), (echo + 1, 4096)):
            os.closerange(begin, end)
        os.set_blocking(echo, False)
        _count(heard, echo, parent)
    finally:
        os._exit(0)


def _count(heard: int, echo: int, parent: int) -> None:
    """Returns when ``parent`` has ended, by itself or not."""
    stops, reloads, ending = 0, False, False
    last_s = 0.0
    while True:
        left_s = last_s + (ENDING_S if ending else UNHEARD_S) - time.monotonic() if stops >= LAST else None
        if left_s is not None and left_s <= 0:
            _kill(parent)
            return
        if not select.select([heard], [], [], left_s)[0]:
            continue
        numbers = os.read(heard, 4096)
        if not numbers:
            return
        for number in sorted(numbers):  # as Python heeds those that come at once
            if number == _RELOADS:
                reloads = True
            elif number == _ENDING:
                ending = True
            elif number in STOP_SIGNALS and not (reloads and not stops and number == signal.SIGHUP):
                stops += 1
                last_s = time.monotonic() if stops <= LAST else last_s
        with suppress(OSError):  # full: nobody need take them
            os.write(echo, numbers)


def _kill(parent: int) -> None:
    if os.getppid() != parent:
        return
    with suppress(OSError):  # where the system has no such folder
        error = os.open(f"/proc/{parent}/fd/2", os.O_WRONLY | os.O_NONBLOCK | os.O_NOCTTY | os.O_APPEND)
        os.write(error, _KILLED)
    with suppress(OSError):
        os.kill(parent, signal.SIGKILL)
