"""Reconnects lost units: retries with growing pauses, and records the gap in the
stream."""

from __future__ import annotations

import asyncio
import math
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Iterator, Sequence
from contextlib import AsyncExitStack, ExitStack, aclosing, asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Protocol, cast

import numpy as np
from numpy.typing import NDArray

import triaxcal_drivers as td
from triaxcald.errors import DeviceInUseElsewhere
from triaxcald.provision.identity import WrongUnit
from triaxcald.station.lock import locked

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 10.0
"""Pauses between attempts, doubled each time: a restarting unit answers within a
second or two, and an operator who plugs one in waits for the longest at most."""

TICK_S = 0.001
"""A remaining time below this counts as over: it covers the rounding of clocks and
of summed pauses."""

HOLE_S = 10.0
"""A silence of this length is a gap even without a reported loss: a laptop slept, a
process was stopped. A busy machine causes shorter ones, which a 16-bit counter at
1 kHz spans without ambiguity."""
AGAIN_S = 60.0
"""A complaint within this time after a reconnection shows that reconnecting did not
help: the next pause is longer. Complaints come within a few silence time-outs."""
UNHEARD = "nothing was received meanwhile"

ABSENT = (td.BusError, td.DeviceAbsent, td.DeviceSilent, td.RegisterRefused)
"""Errors that another attempt to open may resolve; a unit that is starting may
refuse a register."""
LOST = (*ABSENT, WrongUnit)
"""The same for a unit that was open before: the right unit may replace the wrong
one."""


class Exchanged(WrongUnit):
    """Another unit answers, and records have come since the last identification.

    Those records may be the other unit's, so there is no retry.
    """


class Streaming(Protocol):
    """The source of records of a collection."""

    def stream(self, names: Sequence[str]) -> AsyncIterator[td.RawBatch]: ...

    def complain(self, trouble: Exception) -> None: ...


class ActiveUnits:
    """Counts the active units of a station; a lost unit is not active."""

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
class RetryPolicy:
    """How long to retry a lost unit.

    Retries last at least ``least_s``, then until ``most_s`` or until no other unit
    is active; they never end where neither is given. ``in_use``: also retry while
    another process holds the unit.
    """

    least_s: float = 0.0
    most_s: float | None = None
    others: ActiveUnits | None = None
    in_use: bool = False

    @property
    def endless(self) -> bool:
        """Whether a unit is never given up."""
        return self.most_s is None and self.others is None

    def is_over(self, waited_s: float) -> bool:
        """Whether a unit is given up after ``waited_s``."""
        if self.most_s is not None and waited_s > self.most_s - TICK_S:
            return True
        return self.others is not None and waited_s >= self.least_s and self.others.nobody.is_set()

    async def rest(self, pause_s: float, waited_s: float) -> bool:
        """Wait for ``pause_s`` or less; False if the policy gives up after
        ``waited_s``."""
        if self.is_over(waited_s):
            return False
        if self.most_s is not None:
            pause_s = min(pause_s, self.most_s - waited_s)
        if self.others is None:
            await asyncio.sleep(pause_s)
            return True
        if waited_s < self.least_s:
            await asyncio.sleep(min(pause_s, self.least_s - waited_s))
            return True
        try:
            async with asyncio.timeout(pause_s):
                await self.others.nobody.wait()
        except TimeoutError:
            return True
        return False

    @contextmanager
    def waiting(self) -> Iterator[None]:
        if self.others is None:
            yield
        else:
            with self.others.waiting():
                yield


@dataclass
class _Retries:
    """State of the retries of a lost unit: the first attempt comes at once, the next
    ones with growing pauses."""

    policy: RetryPolicy
    tell: Callable[[Exception], None]
    attempted: bool = False
    pause_s: float = FIRST_PAUSE_S
    begun_s: float = field(default_factory=lambda: asyncio.get_running_loop().time())
    told: str = ""

    @property
    def waited_s(self) -> float:
        """Time since the loss [s], with the attempts themselves and with a unit that
        opens but sends no usable record."""
        return asyncio.get_running_loop().time() - self.begun_s

    def say(self, trouble: Exception) -> None:
        if str(trouble) != self.told:
            self.told = str(trouble)
            self.tell(trouble)

    async def until(
        self, attempt: Callable[[], Awaitable[None]], mended: tuple[type[Exception], ...], trouble: Exception
    ) -> None:
        """Repeat ``attempt`` until it succeeds.

        Each new error is reported before the next attempt. Raises the last error
        once the policy gives up; raises any error not in ``mended`` at once.
        """
        while True:
            if self.attempted and self.policy.is_over(self.waited_s):
                raise trouble
            self.say(trouble)
            if self.attempted and not await self._rest():
                raise trouble
            self.attempted = True
            try:
                await attempt()
                return
            except Exchanged:
                raise
            except mended as e:
                trouble = e

    async def pause_of_silent(self, silent: td.DeviceSilent) -> float:
        """Time [s] for which only the other streams are read, before the ``silent``
        one is requested again. Raises ``silent`` once the policy gives up."""
        self.say(silent)
        if not await self.policy.rest(0.0, self.waited_s):
            raise silent
        return self._next_pause_s()

    async def _rest(self) -> bool:
        """Wait until the next attempt; False if the policy gives up."""
        return await self.policy.rest(self._next_pause_s(), self.waited_s)

    def _next_pause_s(self) -> float:
        pause_s = self.pause_s
        self.pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
        return pause_s


@dataclass
class _Interruption:
    """An open gap. ``awaited`` is the one silent source while others send; None if
    all are silent."""

    gap: td.Gap
    awaited: int | None = None

    def ended(self, batch: td.RawBatch, good: NDArray[np.intp]) -> td.RawBatch | None:
        """The batch with the closed gap before it, if one of its ``good`` records
        ends the interruption; else None."""
        back = good if self.awaited is None else good[batch.source[good] == self.awaited]
        if not len(back):
            return None
        lost = batch.gap.lost if batch.gap is not None else None
        return batch.after(td.Gap(self.gap.from_ns, int(batch.time_ns[back[0]]), self.gap.cause, lost))


async def until_open(
    attempt: Callable[[], Awaitable[None]],
    policy: RetryPolicy,
    tell: Callable[[Exception], None],
    mended: tuple[type[Exception], ...] = ABSENT,
) -> None:
    """Repeat ``attempt`` until it succeeds.

    ``tell`` receives each new error that leads to a retry. Raises the last error
    once the policy gives up; raises any error not in ``mended`` at once.
    """
    try:
        await attempt()
    except mended as e:
        with policy.waiting():
            await _Retries(policy, tell, attempted=True).until(attempt, mended, e)


@asynccontextmanager
async def claimed(
    claim: td.Claim, policy: RetryPolicy | None, tell: Callable[[Exception], None]
) -> AsyncIterator[None]:
    """Hold the claim until the context ends.

    Raises DeviceInUse: at once, or once ``policy`` gives up if it retries that.
    """
    async with AsyncExitStack() as stack:

        async def attempt() -> None:
            await stack.enter_async_context(locked(claim))

        if policy is not None and policy.in_use:
            await until_open(attempt, policy, tell, (DeviceInUseElsewhere,))
        else:
            await attempt()
        yield


class ReconnectingDevice:
    """A device whose streams continue after an interruption.

    ``identify`` is called after each reconnection. It raises WrongUnit if another
    unit answers and a retry makes sense, Exchanged if none does. ``tell`` receives
    the reason of an interruption, and None when it is over. More than ``hole_s``
    without a record is a gap.
    """

    def __init__(
        self,
        device: td.Device,
        identify: Callable[[], Awaitable[None]],
        policy: RetryPolicy,
        tell: Callable[[str | None], None],
        now_ns: Callable[[], int] = td.host_clock.HOST.now_ns,
        *,
        hole_s: float = HOLE_S,
    ) -> None:
        self._device, self._identify, self._policy, self._tell = device, identify, policy, tell
        self._now_ns, self._hole_s = now_ns, hole_s
        self._complaint: Exception | None = None

    def complain(self, trouble: Exception) -> None:
        """Report that the device sends wrong data; it is then reconnected as if it
        were lost."""
        self._complaint = trouble

    async def stream(self, names: Sequence[str]) -> AsyncGenerator[td.RawBatch, None]:
        """The device's batches, with its interruptions as gaps.

        An interruption begins with an empty batch whose gap is open; the first
        valid record ends the gap. Until then the retries continue, even if the
        device opens in between. If one stream is silent, the others continue, and
        its first record ends the gap. A silence longer than ``hole_s`` is a gap
        too. Raises the error of the device's stream once the policy gives up;
        Exchanged at once.
        """
        clock = asyncio.get_running_loop()
        last_ns: int | None = None
        returned_ns = self._now_ns()
        interruption: _Interruption | None = None
        retries = self._retries()
        asked, until_s = list(names), math.inf
        with ExitStack() as suspended:
            while True:
                try:
                    async with aclosing(self._of_some(asked, until_s)) as stream:
                        async for batch in stream:
                            good = _good(batch)
                            ended = None if interruption is None else interruption.ended(batch, good)
                            if ended is not None:
                                batch, interruption = ended, None
                                suspended.close()
                                self._tell(None)
                            for part in _parted(batch, good, last_ns, self._hole_s):
                                yield part
                            if len(good):
                                last_ns = int(batch.time_ns[good[-1]])
                            self._raise_complaint(interruption)
                    if asked == list(names):
                        return
                    asked, until_s = list(names), math.inf
                    continue
                except LOST as e:
                    trouble: Exception = e
                if interruption is None:
                    interruption = _Interruption(td.Gap(self._since_ns(trouble, last_ns), None, str(trouble)))
                    anew = self._complaint is None or isinstance(trouble, td.DeviceRestarted)
                    if anew or self._now_ns() - returned_ns > AGAIN_S * 1e9:
                        retries = self._retries()
                    retries.told = ""
                    suspended.enter_context(self._policy.waiting())
                    retries.say(trouble)
                    yield td.RawBatch.of([]).after(interruption.gap)
                if isinstance(trouble, td.DeviceSilent) and trouble.stream in asked:
                    interruption.awaited = trouble.source
                    asked = [name for name in asked if name != trouble.stream]
                    if asked:
                        until_s = clock.time() + await retries.pause_of_silent(trouble)
                        continue
                asked, until_s = list(names), math.inf
                await retries.until(self._again, LOST, trouble)
                self._complaint, returned_ns = (
                    None,
                    self._now_ns(),
                )  # a complaint made meanwhile concerns the old connection

    async def _of_some(self, names: Sequence[str], until_s: float) -> AsyncGenerator[td.RawBatch, None]:
        """These streams of the device, up to ``until_s`` of the loop's clock."""
        clock = asyncio.get_running_loop()
        async with aclosing(cast(Any, self._device.stream(names))) as stream:
            async for batch in stream:
                yield batch
                if clock.time() >= until_s:
                    return

    def _raise_complaint(self, interruption: _Interruption | None) -> None:
        """Raise a pending complaint.

        A silent stream is the better known cause and drops the complaint, unless
        that reports a restart.
        """
        known = interruption is not None and interruption.awaited is not None
        if known and not isinstance(self._complaint, td.DeviceRestarted):
            self._complaint = None
        elif self._complaint is not None:
            raise self._complaint

    def _since_ns(self, trouble: Exception, last_ns: int | None) -> int:
        """Start of the silence [ns]: of all streams, or of the one silent stream."""
        since_ns = self._now_ns() if last_ns is None else last_ns
        if isinstance(trouble, td.DeviceSilent) and trouble.source is not None:
            return min(since_ns, self._now_ns() - round(trouble.silent_s * 1e9))
        return since_ns

    def _retries(self) -> _Retries:
        return _Retries(self._policy, lambda trouble: self._tell(str(trouble)))

    async def _again(self) -> None:
        await self._device.close()
        await self._device.open()
        await self._identify()


def _good(batch: td.RawBatch) -> NDArray[np.intp]:
    """Indices of the valid records."""
    return np.flatnonzero((batch.flags & (td.RawFlag.ERROR | td.RawFlag.INVALID)) == 0)


def _parted(batch: td.RawBatch, good: NDArray[np.intp], last_ns: int | None, hole_s: float) -> Iterator[td.RawBatch]:
    """The batch, split at its holes."""
    if not len(good):
        yield batch
        return
    times = batch.time_ns[good]
    before = np.concatenate([[times[0] if last_ns is None else last_ns], times[:-1]])
    holes = np.flatnonzero((times - before > hole_s * 1e9) & ((batch.flags[good] & td.RawFlag.LOST_BEFORE) == 0))
    gaps = {int(good[i]): td.Gap(int(before[i]), int(times[i]), UNHEARD) for i in holes}
    for start, stop in pairwise(sorted({0, *gaps, len(batch)})):
        part = batch.part(start, stop)
        yield part.after(gaps[start]) if start in gaps else part
