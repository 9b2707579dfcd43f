"""Units that are lost and come back: opened again with ever longer pauses, the
gap in their stream told."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Iterator, Sequence
from contextlib import aclosing, contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, cast

import numpy as np

from triaxcal_drivers.errors import BusError, DeviceAbsent, DeviceSilent, RegisterRefused
from triaxcal_drivers.host_clock import HOST
from triaxcal_drivers.interface import Device, Gap, RawBatch, RawFlag
from triaxcald.provision.identity import WrongUnit

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 10.0
"""Between attempts, doubled each time: a unit that restarts is there again in a
second or two, and an operator who plugs one in waits no longer than this."""

LOST = (BusError, DeviceAbsent, DeviceSilent, RegisterRefused, WrongUnit)
"""What another attempt may mend. A unit that is starting may refuse a register;
for the wrong unit the right one may be put there again."""


class Streaming(Protocol):
    """What a collection takes records from."""

    def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]: ...


class AtWork:
    """How many units of a station are at work; those that are lost are not."""

    def __init__(self, units: int) -> None:
        self._units = units
        self.nobody = asyncio.Event()

    def leave(self) -> None:
        """A unit has ended, or is lost."""
        self._units -= 1
        if self._units <= 0:
            self.nobody.set()

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """While a unit is lost."""
        self.leave()
        try:
            yield
        finally:
            self._units += 1
            self.nobody.clear()


@dataclass(frozen=True)
class Patience:
    """How long a lost unit is waited for.

    At least ``least_s``; then until ``most_s``, or until no other unit is at
    work, for ever where neither is given.
    """

    least_s: float = 0.0
    most_s: float | None = None
    others: AtWork | None = None

    async def rest(self, pause_s: float, waited_s: float) -> float | None:
        """Waits ``pause_s``, or less; so long did it, or None where the unit is
        given up after ``waited_s``."""
        if self.most_s is not None:
            if waited_s >= self.most_s:
                return None
            pause_s = min(pause_s, self.most_s - waited_s)
        if self.others is None:
            await asyncio.sleep(pause_s)
            return pause_s
        if waited_s < self.least_s:
            pause_s = min(pause_s, self.least_s - waited_s)
            await asyncio.sleep(pause_s)
            return pause_s
        try:
            async with asyncio.timeout(pause_s):
                await self.others.nobody.wait()
        except TimeoutError:
            return pause_s
        return None

    @contextmanager
    def waiting(self) -> Iterator[None]:
        if self.others is None:
            yield
        else:
            with self.others.waiting():
                yield


async def until_open(
    attempt: Callable[[], Awaitable[None]], patience: Patience, tell: Callable[[Exception], None]
) -> None:
    """Attempts again until it works. Raises the last trouble of `LOST` once
    patience ends; ``tell`` is told each one that is new."""
    pause_s, waited_s, told = FIRST_PAUSE_S, 0.0, ""
    try:
        await attempt()
        return
    except LOST as e:
        trouble = e
    with patience.waiting():
        while True:
            if str(trouble) != told:
                told = str(trouble)
                tell(trouble)
            rested_s = await patience.rest(pause_s, waited_s)
            if rested_s is None:
                raise trouble
            waited_s += rested_s
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
            try:
                await attempt()
                return
            except LOST as e:
                trouble = e


class Returning:
    """A device whose streams go on after an interruption.

    ``identify`` is asked after each return, and raises WrongUnit where another
    unit answers; ``tell`` is told what is the matter, and None when it is over.
    """

    def __init__(
        self,
        device: Device,
        identify: Callable[[], Awaitable[None]],
        patience: Patience,
        tell: Callable[[str | None], None],
        now_ns: Callable[[], int] = HOST.now_ns,
    ) -> None:
        self._device, self._identify, self._patience, self._tell = device, identify, patience, tell
        self._now_ns = now_ns

    async def stream(self, names: Sequence[str]) -> AsyncGenerator[RawBatch, None]:
        """As the device's own. An interruption begins with a batch without
        records whose gap is not over; the first record after it that is no
        error ends the gap. Raises what the device's stream does once patience
        ends."""
        last_ns: int | None = None
        gap: Gap | None = None
        while True:
            try:
                async with aclosing(cast(Any, self._device.stream(names))) as stream:
                    async for batch in stream:
                        if gap is not None and (good := _first_good(batch)) is not None:
                            gap = Gap(gap.from_ns, int(batch.time_ns[good]), gap.cause)
                            batch, gap = batch.after(gap), None
                            self._tell(None)
                        if len(batch):
                            last_ns = int(batch.time_ns[-1])
                        yield batch
                return
            except LOST as e:
                trouble = e
            if gap is None:
                gap = Gap(self._now_ns() if last_ns is None else last_ns, None, str(trouble))
                yield RawBatch.of([]).after(gap)
            await until_open(self._again, self._patience, lambda e: self._tell(str(e)))

    async def _again(self) -> None:
        await self._device.close()
        await self._device.open()
        await self._identify()


def _first_good(batch: RawBatch) -> int | None:
    good = np.flatnonzero((batch.flags & (RawFlag.ERROR | RawFlag.INVALID)) == 0)
    return int(good[0]) if len(good) else None
