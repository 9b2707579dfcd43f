"""An event loop whose time is the test's: it jumps to the next timer where nothing else is to be done."""

from __future__ import annotations

import asyncio
import selectors
from collections.abc import Coroutine
from typing import Any, TypeVar

T = TypeVar("T")


class VirtualLoop(asyncio.SelectorEventLoop):
    """``now_s`` may be put on by hand, as if the loop had been held up; ``late_s`` holds it up at each timer."""

    def __init__(self) -> None:
        self.now_s = 1000.0
        self.late_s = 0.0
        super().__init__(_Jumping(self))

    def time(self) -> float:
        return self.now_s


class _Jumping(selectors.DefaultSelector):
    def __init__(self, loop: VirtualLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> Any:
        ready = super().select(0)
        if ready or timeout is None or timeout <= 0:
            return ready
        self._loop.now_s += timeout + self._loop.late_s
        return super().select(0)  # what came meanwhile is there, as late as the loop is


def run(work: Coroutine[Any, Any, T]) -> T:
    """In a loop of its own; ``asyncio.get_running_loop()`` is a `VirtualLoop` there."""
    with asyncio.Runner(loop_factory=VirtualLoop) as runner:
        return runner.run(work)


def virtual() -> VirtualLoop:
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualLoop)
    return loop
