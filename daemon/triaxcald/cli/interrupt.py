"""Ctrl-C, SIGTERM and SIGHUP: the first cancels the work, which then puts things in order; more change nothing."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Coroutine
from typing import Any, TypeVar

from triaxcald.cli.console import say

T = TypeVar("T")
SIGNALS = [s for n in ("SIGINT", "SIGTERM", "SIGHUP") if (s := getattr(signal, n, None)) is not None]


class Interrupted(Exception):
    """The work was cancelled; ``notes`` are what it left to say, such as the state of a device."""

    def __init__(self, notes: tuple[str, ...]) -> None:
        super().__init__("; ".join(("interrupted", *notes)))
        self.notes = notes


def run_interruptible(work: Coroutine[Any, Any, T]) -> T:
    """Runs ``work`` in an event loop. Raises Interrupted where it was cancelled and did not make a result of that."""
    return asyncio.run(_guarded(work))


async def _guarded(work: Coroutine[Any, Any, T]) -> T:
    task = asyncio.ensure_future(work)
    caught: list[int] = []

    def stop(number: int) -> None:
        if caught:
            say("triaxcal: putting things in order, please wait")
        else:
            task.cancel()
        caught.append(number)

    loop = asyncio.get_running_loop()
    heeded = [n for n in SIGNALS if n == signal.SIGINT or signal.getsignal(n) is not signal.SIG_IGN]  # as by nohup
    for number in heeded:
        loop.add_signal_handler(number, stop, number)
    try:
        return await task
    except asyncio.CancelledError as e:
        if caught:
            raise Interrupted(tuple(getattr(e, "__notes__", ()))) from None
        raise
    finally:
        for number in heeded:
            loop.remove_signal_handler(number)
