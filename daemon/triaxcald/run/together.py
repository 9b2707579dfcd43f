"""Units at work side by side, each of which comes to its own end and holds no
other up."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Iterable
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


async def whole_on_a_thread(work: Callable[[], T]) -> T:
    """What ``work`` gives, which is waited for in any case: a cancellation
    meanwhile strikes at the next await."""
    thread, struck = asyncio.ensure_future(asyncio.to_thread(work)), False
    while not thread.done():
        try:
            await asyncio.wait([thread])
        except asyncio.CancelledError:
            struck = True
    if struck and (task := asyncio.current_task()) is not None:
        task.cancel()
    return thread.result()
