"""Units that are lost and come back: opened again with ever longer pauses, the
gap in their stream told."""

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

from triaxcal_drivers.claim import Claim
from triaxcal_drivers.errors import BusError, DeviceAbsent, DeviceRestarted, DeviceSilent, RegisterRefused
from triaxcal_drivers.host_clock import HOST
from triaxcal_drivers.interface import Device, Gap, RawBatch, RawFlag
from triaxcald.errors import DeviceInUseElsewhere
from triaxcald.provision.identity import WrongUnit
from triaxcald.station.lock import locked

FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 10.0
"""Between attempts, doubled each time: a unit that restarts is there again in a
second or two, and an operator who plugs one in waits no longer than this."""

TICK_S = 0.001
"""With less left there is nothing to wait for: clocks and sums of pauses are
off by less."""

HOLE_S = 10.0
"""Nothing for so long is a gap, though nobody was told of a loss: a laptop
slept, a process was stopped. Shorter holes leave a counter of 16 bits at 1 kHz
in no doubt, and a busy machine makes them."""
AGAIN_S = 60.0
"""A complaint so soon after an opening says that this has mended nothing, and
the next one waits for longer; it comes within some silence time-outs."""
UNHEARD = "nothing was received meanwhile"

ABSENT = (BusError, DeviceAbsent, DeviceSilent, RegisterRefused)
"""What another attempt to open a unit may mend; one that is starting may refuse
a register."""
LOST = (*ABSENT, WrongUnit)
"""And of one that was there: for the wrong unit the right one may be put there
again."""


class Exchanged(WrongUnit):
    """Another unit answers, and records have come since the right one was last
    identified. They may be the other unit's, so the unit is not waited for."""


class Streaming(Protocol):
    """What a collection takes records from."""

    def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]: ...

    def complain(self, trouble: Exception) -> None: ...


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
    work, for ever where neither is given. ``in_use``: also where another
    process has it.
    """

    least_s: float = 0.0
    most_s: float | None = None
    others: AtWork | None = None
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
        """Waits ``pause_s``, or less. False where the unit is given up after
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
class _Waiting:
    """How far the waiting for a lost unit has gone: the first attempt is made
    at once, the next ones ever more rarely."""

    patience: Patience
    tell: Callable[[Exception], None]
    attempted: bool = False
    pause_s: float = FIRST_PAUSE_S
    begun_s: float = field(default_factory=lambda: asyncio.get_running_loop().time())
    told: str = ""

    @property
    def waited_s(self) -> float:
        """Attempts take time too, and so does a unit that opens and sends
        nothing of use."""
        return asyncio.get_running_loop().time() - self.begun_s

    def say(self, trouble: Exception) -> None:
        if str(trouble) != self.told:
            self.told = str(trouble)
            self.tell(trouble)

    async def until(
        self, attempt: Callable[[], Awaitable[None]], mended: tuple[type[Exception], ...], trouble: Exception
    ) -> None:
        """Attempts until it works. Raises the last trouble once patience ends,
        which is told only where it is waited for; and at once what is none of
        those that an attempt may have ``mended``."""
        while True:
            if self.attempted and self.patience.is_over(self.waited_s):
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

    async def beside(self, silent: DeviceSilent) -> float:
        """So long the other streams go on without the ``silent`` one before
        that is asked again. Raises it once patience ends."""
        self.say(silent)
        if not await self.patience.rest(0.0, self.waited_s):
            raise silent
        return self._next_pause_s()

    async def _rest(self) -> bool:
        """Until the next attempt; whether there is to be one."""
        return await self.patience.rest(self._next_pause_s(), self.waited_s)

    def _next_pause_s(self) -> float:
        pause_s = self.pause_s
        self.pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
        return pause_s


@dataclass
class _Interruption:
    """A gap that is not over. ``awaited`` is the source that is silent while
    others bring their records, None where none does."""

    gap: Gap
    awaited: int | None = None

    def ended(self, batch: RawBatch, good: NDArray[np.intp]) -> RawBatch | None:
        """The batch with the gap before it, where one of its ``good`` records
        ends the interruption."""
        back = good if self.awaited is None else good[batch.source[good] == self.awaited]
        if not len(back):
            return None
        lost = batch.gap.lost if batch.gap is not None else None
        return batch.after(Gap(self.gap.from_ns, int(batch.time_ns[back[0]]), self.gap.cause, lost))


async def until_open(
    attempt: Callable[[], Awaitable[None]],
    patience: Patience,
    tell: Callable[[Exception], None],
    mended: tuple[type[Exception], ...] = ABSENT,
) -> None:
    """Attempts again until it works. Raises the last trouble of those that an
    attempt may have ``mended`` once patience ends; ``tell`` is told each one
    that is new and waited for."""
    try:
        await attempt()
    except mended as e:
        with patience.waiting():
            await _Waiting(patience, tell, attempted=True).until(attempt, mended, e)


@asynccontextmanager
async def claimed(claim: Claim, patience: Patience | None, tell: Callable[[Exception], None]) -> AsyncIterator[None]:
    """Has what is claimed until the context ends. Raises DeviceInUse; once
    ``patience`` ends where that is for such too."""
    async with AsyncExitStack() as stack:

        async def attempt() -> None:
            await stack.enter_async_context(locked(claim))

        if patience is not None and patience.in_use:
            await until_open(attempt, patience, tell, (DeviceInUseElsewhere,))
        else:
            await attempt()
        yield


class Returning:
    """A device whose streams go on after an interruption.

    ``identify`` is asked after each return. It raises WrongUnit where another
    unit answers and the right one may be waited for, Exchanged where it may not.
    ``tell`` is told what is the matter, and None when it is over.
    More than ``hole_s`` without a record is a gap.
    """

    def __init__(
        self,
        device: Device,
        identify: Callable[[], Awaitable[None]],
        patience: Patience,
        tell: Callable[[str | None], None],
        now_ns: Callable[[], int] = HOST.now_ns,
        *,
        hole_s: float = HOLE_S,
    ) -> None:
        self._device, self._identify, self._patience, self._tell = device, identify, patience, tell
        self._now_ns, self._hole_s = now_ns, hole_s
        self._complaint: Exception | None = None

    def complain(self, trouble: Exception) -> None:
        """Of what the stream gave last: the device sends, but not what it is to
        send. It is opened anew, as if it were lost."""
        self._complaint = trouble

    async def stream(self, names: Sequence[str]) -> AsyncGenerator[RawBatch, None]:
        """As the device's own. An interruption begins with a batch without
        records whose gap is not over; the first record after it that is no
        error ends the gap. Until then the unit is waited for, however often it
        opens meanwhile. Where one stream is silent, the others go on, and the
        first record of that one ends the gap. A hole is a gap too. Raises what
        the device's stream does once patience ends; Exchanged at once."""
        clock = asyncio.get_running_loop()
        last_ns: int | None = None
        returned_ns = self._now_ns()
        interruption: _Interruption | None = None
        waiting = self._waiting()
        asked, until_s = list(names), math.inf
        with ExitStack() as at_rest:
            while True:
                try:
                    async with aclosing(self._of_some(asked, until_s)) as stream:
                        async for batch in stream:
                            good = _good(batch)
                            ended = None if interruption is None else interruption.ended(batch, good)
                            if ended is not None:
                                batch, interruption = ended, None
                                at_rest.close()
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
                    interruption = _Interruption(Gap(self._since_ns(trouble, last_ns), None, str(trouble)))
                    anew = self._complaint is None or isinstance(trouble, DeviceRestarted)
                    if anew or self._now_ns() - returned_ns > AGAIN_S * 1e9:
                        waiting = self._waiting()
                    waiting.told = ""
                    at_rest.enter_context(self._patience.waiting())
                    waiting.say(trouble)
                    yield RawBatch.of([]).after(interruption.gap)
                if isinstance(trouble, DeviceSilent) and trouble.stream in asked:
                    interruption.awaited = trouble.source
                    asked = [name for name in asked if name != trouble.stream]
                    if asked:
                        until_s = clock.time() + await waiting.beside(trouble)
                        continue
                asked, until_s = list(names), math.inf
                await waiting.until(self._again, LOST, trouble)
                self._complaint, returned_ns = None, self._now_ns()  # what was said meanwhile was of the one before

    async def _of_some(self, names: Sequence[str], until_s: float) -> AsyncGenerator[RawBatch, None]:
        """These streams of the device, until then by the loop's clock."""
        clock = asyncio.get_running_loop()
        async with aclosing(cast(Any, self._device.stream(names))) as stream:
            async for batch in stream:
                yield batch
                if clock.time() >= until_s:
                    return

    def _raise_complaint(self, interruption: _Interruption | None) -> None:
        """Of what was sent, unless the cause is known better: a stream that is
        silent beside the others. A restart is more than that."""
        known = interruption is not None and interruption.awaited is not None
        if known and not isinstance(self._complaint, DeviceRestarted):
            self._complaint = None
        elif self._complaint is not None:
            raise self._complaint

    def _since_ns(self, trouble: Exception, last_ns: int | None) -> int:
        """Since when nothing has come, or nothing of the stream that is silent
        while others bring their records."""
        since_ns = self._now_ns() if last_ns is None else last_ns
        if isinstance(trouble, DeviceSilent) and trouble.source is not None:
            return min(since_ns, self._now_ns() - round(trouble.silent_s * 1e9))
        return since_ns

    def _waiting(self) -> _Waiting:
        return _Waiting(self._patience, lambda trouble: self._tell(str(trouble)))

    async def _again(self) -> None:
        await self._device.close()
        await self._device.open()
        await self._identify()


def _good(batch: RawBatch) -> NDArray[np.intp]:
    """Where the records are that are no errors."""
    return np.flatnonzero((batch.flags & (RawFlag.ERROR | RawFlag.INVALID)) == 0)


def _parted(batch: RawBatch, good: NDArray[np.intp], last_ns: int | None, hole_s: float) -> Iterator[RawBatch]:
    """The batch in parts, from each hole to the next."""
    if not len(good):
        yield batch
        return
    times = batch.time_ns[good]
    before = np.concatenate([[times[0] if last_ns is None else last_ns], times[:-1]])
    holes = np.flatnonzero((times - before > hole_s * 1e9) & ((batch.flags[good] & RawFlag.LOST_BEFORE) == 0))
    gaps = {int(good[i]): Gap(int(before[i]), int(times[i]), UNHEARD) for i in holes}
    for start, stop in pairwise(sorted({0, *gaps, len(batch)})):
        part = batch.part(start, stop)
        yield part.after(gaps[start]) if start in gaps else part
