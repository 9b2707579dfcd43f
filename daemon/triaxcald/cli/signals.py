"""SIGINT, SIGTERM and SIGHUP from the first line of the program to its last.

Work that runs in an event loop is cancelled by the first signal, which has it
put things in order, and again by the second; the third ends the process at
once. Before and without such work the first one does, as there is nothing to
put in order. No signal raises an exception: at a random place that would come
out as a trace back, or not at all.

Where the interpreter does not return, no handler of Python runs, and a process
beside this one (`triaxcald.cli.watcher`) ends it after the third signal.

To a service SIGHUP says that its file has changed, to a command on a terminal
that the terminal is gone.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NoReturn

from triaxcald.abort import STOP_SIGNALS, abort, tell
from triaxcald.cli.watcher import Watcher


class StopSignals:
    """Counts the signals that came, and does what each asks for."""

    def __init__(self, watcher: Watcher | None = None) -> None:
        self.caught: list[int] = []
        self.watcher = watcher
        self._cancel: Callable[[], bool] | None = None
        self._reload: Callable[[], None] | None = None

    def heed(self) -> dict[int, Any]:
        """Install the handlers; returns the previous ones. SIGTERM and SIGHUP stay
        ignored if they were (`nohup`)."""
        heeded = [n for n in STOP_SIGNALS if n == signal.SIGINT or signal.getsignal(n) is not signal.SIG_IGN]
        return {number: signal.signal(number, self._strike) for number in heeded}

    def cancel_by(self, cancel: Callable[[], bool]) -> None:
        """Let the first and the second signal call ``cancel``, also after the work;
        ``cancel`` returns whether work remains."""
        self._cancel = cancel

    def reload_by(self, reload: Callable[[], None]) -> None:
        """Let every SIGHUP call ``reload`` and stop nothing. With a terminal SIGHUP
        keeps its meaning."""
        if not _on_a_terminal():
            self._reload = reload
            if self.watcher is not None:
                self.watcher.tell_reloads()

    def _strike(self, number: int, _: object) -> None:
        if self._reload is not None and number == getattr(signal, "SIGHUP", None) and not self.caught:
            self._reload()
            return
        self.caught.append(number)
        if self._cancel is None:
            self._abort("interrupted")
        if len(self.caught) > 2:
            self._abort("interrupted; ended at once")
        at_work = self._cancel()
        if len(self.caught) == 2 and at_work:
            tell("triaxcal: putting things in order, please wait; a third signal ends it at once")

    def _abort(self, reason: str) -> NoReturn:
        if self.watcher is not None:
            self.watcher.tell_ending()
        abort(reason)


def _on_a_terminal() -> bool:
    """That is to say, whether one controls this process, and may go away."""
    try:
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
    except OSError:
        return False
    return True


_process: StopSignals | None = None


def heed_stop_signals() -> None:
    """Handle stop signals until the end of the process."""
    global _process
    _process = StopSignals(Watcher.started())
    _process.heed()


@contextmanager
def stop_signals() -> Iterator[StopSignals]:
    """The process's own; where another program runs the work, such as a test,
    some for as long as it takes."""
    if _process is not None:
        yield _process
        return
    signals = StopSignals()
    before = signals.heed()
    try:
        yield signals
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
