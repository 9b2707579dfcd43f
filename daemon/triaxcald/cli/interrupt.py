"""Work in an event loop that stop signals cancel."""

from __future__ import annotations

import asyncio
import signal
import socket
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

from triaxcald.cli.console import say
from triaxcald.cli.signals import StopSignals, stop_signals
from triaxcald.cli.watcher import Watcher
from triaxcald.memory import out_of_memory, ran_out_of_memory
from triaxcald.run.together import soon

T = TypeVar("T")
_BEAT_S = 0.5
"""A loop that nothing wakes at a signal looks about so often."""


class Interrupted(Exception):
    """The work was cancelled by a signal, ``number`` the first; ``notes`` are
    what it left to say, such as the state of a device."""

    def __init__(self, number: int, notes: tuple[str, ...]) -> None:
        super().__init__("; ".join(("interrupted", *notes)))
        self.number, self.notes = number, notes


def run_interruptible(work: Awaitable[T], reload: Callable[[], None] | None = None) -> T:
    """Runs ``work`` in an event loop. Raises Interrupted where it was cancelled
    and did not make a result of that. ``reload`` is called in the loop at each
    SIGHUP, which then stops nothing, unless the process is on a terminal.

    What it still has running in threads goes on, and is not waited for.
    """
    with stop_signals() as signals:
        return asyncio.run(_guarded(work, signals, reload))


async def _guarded(work: Awaitable[T], signals: StopSignals, reload: Callable[[], None] | None) -> T:
    loop = asyncio.get_running_loop()
    loop.set_default_executor(_Unawaited())
    loop.set_exception_handler(_told)
    task = asyncio.ensure_future(work)

    def cancel() -> bool:
        soon(loop, task.cancel)
        return not task.done()

    with _woken(loop, signals.watcher):
        signals.cancel_by(cancel)
        if reload is not None:
            signals.reload_by(partial(soon, loop, reload))
        try:
            return await task
        except asyncio.CancelledError as e:
            if signals.caught:
                raise Interrupted(signals.caught[0], _notes(e)) from None
            raise


def _told(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Report an error in a callback, which no task awaits; a lack of memory in one
    line."""
    error = context.get("exception")
    if isinstance(error, BaseException) and ran_out_of_memory(error):
        say(f"triaxcal: {out_of_memory(error)}")
    else:
        loop.default_exception_handler(context)


class _Unawaited(ThreadPoolExecutor):
    """A computation or a bus driver that has been given up may take long; the
    loop's end does not wait for it."""

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        super().shutdown(wait=False, cancel_futures=cancel_futures)


@contextmanager
def _woken(loop: asyncio.AbstractEventLoop, watcher: Watcher | None) -> Iterator[None]:
    """Signals wake the loop. Their handlers alone do not, where one strikes as
    the loop is about to fall asleep."""
    if watcher is None:
        with _woken_by_itself(loop):
            yield
        return
    beats: list[asyncio.TimerHandle] = []

    def beat() -> None:
        beats[:] = [loop.call_later(_BEAT_S, beat)]

    def hear() -> None:
        if not watcher.hear():  # somebody has killed it
            loop.remove_reader(watcher)
            beat()

    loop.add_reader(watcher, hear)
    try:
        yield
    finally:
        loop.remove_reader(watcher)
        for handle in beats:
            handle.cancel()


@contextmanager
def _woken_by_itself(loop: asyncio.AbstractEventLoop) -> Iterator[None]:
    near, far = socket.socketpair()
    with near, far:
        near.setblocking(False)
        far.setblocking(False)
        loop.add_reader(near, near.recv, 4096)
        before = signal.set_wakeup_fd(far.fileno(), warn_on_full_buffer=False)
        try:
            yield
        finally:
            signal.set_wakeup_fd(before)
            loop.remove_reader(near)


def _notes(e: BaseException | None) -> tuple[str, ...]:
    """Notes of the exception and of those that it replaced: a second cancellation
    replaces the first."""
    notes: dict[str, None] = {}
    while e is not None:
        notes |= dict.fromkeys(getattr(e, "__notes__", ()))
        e = e.__cause__ or e.__context__
    return tuple(notes)
