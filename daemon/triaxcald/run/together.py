"""Units at work side by side, each of which comes to its own end and holds no
other up."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Coroutine, Iterable
from contextlib import suppress
from functools import partial
from typing import Any, TypeVar

T = TypeVar("T")


async def side_by_side(work: Iterable[Coroutine[Any, Any, T]]) -> list[T]:
    """What each gives, in their order. When this is cancelled every one of them
    is, again each time, and waited for."""
    units = [asyncio.ensure_future(one) for one in work]
    while not all(unit.done() for unit in units):
        try:
            await asyncio.wait(units)
        except asyncio.CancelledError:
            for unit in units:
                unit.cancel()
    return [unit.result() for unit in units]


async def while_sound(work: Awaitable[None], check: Callable[[], None], every_s: float) -> None:
    """Until the work ends, or ``check`` raises, which looks every so many
    seconds; the work is cancelled then, and waited for."""
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
            task.exception()  # what is on its way already weighs more
        raise
    await task


async def whole_on_a_thread(work: Callable[[], T]) -> T:
    """What ``work`` gives, which is waited for in any case, on a thread of its
    own: those that the loop has may all be busy with devices that hang. A
    cancellation meanwhile strikes at the next await, unless ``work`` raises."""
    loop = asyncio.get_running_loop()
    done: asyncio.Future[T] = loop.create_future()

    def run() -> None:
        try:
            given = work()
        except BaseException as e:  # noqa: BLE001 - whatever it is, it is raised where it is waited for
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
    """In the loop, from any thread or a signal's handler."""
    with suppress(RuntimeError):  # the loop has ended, and nobody waits any more
        loop.call_soon_threadsafe(act)
