"""Runs units side by side: each ends by itself and delays no other."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Iterable
from contextlib import suppress
from functools import partial
from typing import TypeVar

T = TypeVar("T")


async def side_by_side(work: Iterable[Awaitable[T]]) -> list[T]:
    """Results of all, in order. Each cancellation is passed on to every one, and
    their ends are awaited."""
    units = [asyncio.ensure_future(one) for one in work]
    while not all(unit.done() for unit in units):
        try:
            await asyncio.wait(units)
        except asyncio.CancelledError:
            for unit in units:
                unit.cancel()
    return [unit.result() for unit in units]


async def while_sound(work: Awaitable[None], check: Callable[[], None], every_s: float) -> None:
    """Await the work, and call ``check`` every ``every_s`` seconds. If ``check``
    raises, the work is cancelled and its end awaited."""
    task = asyncio.ensure_future(work)
    try:
        while not (await asyncio.wait([task], timeout=every_s))[0]:
            check()
    except BaseException:
        while not task.done():  # as often as this is cancelled
            task.cancel()
            with suppress(asyncio.CancelledError):
                await asyncio.wait([task])
        if not task.cancelled():
            task.exception()  # retrieved and dropped: the current error has priority
        raise
    await task


async def whole_on_a_thread(work: Callable[[], T]) -> T:
    """Result of ``work`` on a thread of its own, awaited in any case.

    The loop's own threads may all be busy with devices that hang. A cancellation
    takes effect at the next await afterwards, unless ``work`` raises.
    """
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def run() -> None:
        try:
            given = work()
        except BaseException as e:  # noqa: BLE001 - every error is raised in the awaiting task
            soon(loop, partial(done.set_exception, e))
        else:
            soon(loop, partial(done.set_result, given))

    threading.Thread(target=run, name="whole", daemon=True).start()
    struck = False
    while not done.done():
        try:
            await asyncio.wait([done])
        except asyncio.CancelledError:
            struck = True
    given = done.result()
    if struck and (task := asyncio.current_task()) is not None:
        task.cancel()
    return given


def soon(loop: asyncio.AbstractEventLoop, act: Callable[[], object]) -> None:
    """Call ``act`` in the loop, from any thread or a signal handler."""
    with suppress(RuntimeError):  # the loop has ended, so nobody waits
        loop.call_soon_threadsafe(act)
