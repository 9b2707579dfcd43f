"""What the service says of itself to whoever watches machines."""

from __future__ import annotations

import asyncio
import time

from triaxcald.service.monitoring import LoopLateness

BLOCKED_S = 0.3


def test_a_call_that_blocks_the_event_loop_is_its_lateness_from_then_on() -> None:
    async def blocked() -> tuple[float, float]:
        lateness, turns = LoopLateness(), asyncio.Event()
        watching = asyncio.ensure_future(lateness.watch())
        await asyncio.sleep(0)
        time.sleep(BLOCKED_S)  # the defect itself
        while lateness.worst_s == 0.0:
            await asyncio.sleep(0)
        at_once = lateness.worst_s
        asyncio.get_running_loop().call_later(0.1, turns.set)
        await turns.wait()
        watching.cancel()
        return at_once, lateness.worst_s

    at_once, later = asyncio.run(blocked())
    assert at_once >= BLOCKED_S - 0.06
    assert later >= at_once
