"""A short look at a device's readings and its corrected output at the same
moments."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Sequence
from contextlib import aclosing, asynccontextmanager, closing, suppress
from typing import Any, Protocol, cast

import numpy as np

from triaxcal_drivers.catalogue import driver_named
from triaxcal_drivers.errors import DriverError
from triaxcal_drivers.host_clock import HOST
from triaxcal_drivers.interface import Device, RawBatch, SampleBlock
from triaxcal_drivers.profile import CORRECTED, READINGS, Bundle
from triaxcal_drivers.stall_clock import StallTolerantClock
from triaxcald.errors import TwoAnswer
from triaxcald.provision.identity import BlankIdentity, WrongUnit
from triaxcald.provision.registers import SanityWarning, Snapshot, departure_g, departure_warnings
from triaxcald.recording.writer import RecordingWriter
from triaxcald.station.reconnect import ABSENT, Exchanged, Streaming

SAMPLES = 20
"""Their median is not moved by a knock, and at the slowest usual rate they take
two seconds."""


async def live_output_warnings(device: Device, bundle: Bundle, snapshot: Snapshot) -> list[SanityWarning]:
    """None where the device has no corrected output, or where it does not come."""
    if CORRECTED not in bundle.profile.streams:
        return []
    blocks: dict[str, list[SampleBlock]] = {READINGS: [], CORRECTED: []}
    with suppress(DriverError, TimeoutError):
        await _collect(device, bundle, blocks)
    readings, outputs = (_joined(blocks[name]) for name in (READINGS, CORRECTED))
    _, mine, theirs = np.intersect1d(readings[0], outputs[0], return_indices=True)
    channels = {name: values[mine] for name, values in readings[2].items()}
    off_g = departure_g(bundle.profile, snapshot, readings[1][mine], outputs[1][theirs], channels)
    return departure_warnings(off_g)


async def _collect(device: Device, bundle: Bundle, blocks: dict[str, list[SampleBlock]]) -> None:
    driver, sampling = driver_named(bundle.profile.driver), bundle.profile.sampling
    decoders = {name: driver.decoder(bundle, name) for name in blocks}
    # So long even if one of the two never comes.
    limit_s = sampling.silence_timeout_s + 2 * SAMPLES / sampling.rate_hz
    with closing(StallTolerantClock(asyncio.get_running_loop())) as clock:
        async with clock.timeout(limit_s), aclosing(cast(Any, device.stream(list(blocks)))) as stream:
            async for batch in stream:
                for name, decoder in decoders.items():
                    blocks[name].append(decoder.feed(batch))
                if min(sum(map(len, held)) for held in blocks.values()) >= SAMPLES:
                    return


def _joined(blocks: list[SampleBlock]) -> tuple[Any, Any, dict[str, Any]]:
    """Counters (n,), readings (n,3) and channels of all blocks."""
    if not blocks:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), {}
    channels = {name: np.concatenate([b.channels[name] for b in blocks]) for name in blocks[0].channels}
    return np.concatenate([b.counter for b in blocks]), np.concatenate([b.readings for b in blocks]), channels


# Asks a unit again, while it is recorded, whether it is still the one that it was:
# behind a gateway it can be exchanged without a gap in its stream.

EVERY_S = 45.0
"""Once a minute is promised; the rest of it is for a request that goes
unanswered."""
RETRY_S = 10.0
"""After a request that went unanswered; doubled up to `EVERY_S`, so that a unit
that answers nothing while it streams is not disturbed for nothing."""
SURE_S = 0.2
"""Between two readings of a wrong identity: a single one ends no recording."""
STARTING_S = 3.0
"""So long a unit that starts may show a blank identity: a device has loaded its
registers in a second or two."""
LAST_ATTEMPTS = 3
"""At the end of a phase nobody asks later: a lost reply is not the last word."""
LAST_S = 2.0
"""So long a recording that is stopped is held up for it."""


class Marked(Protocol):
    """What the recorded records have come to so far, to be brought back where
    the later ones turn out to be of another unit."""

    def mark(self) -> object: ...

    def back_to(self, mark: Any) -> None: ...


class Confirmation:
    """Who a unit is, asked again while it is recorded.

    ``identify`` reads who answers, and raises WrongUnit where that is another
    unit; None where the unit has no register that says so, and then nothing is
    asked. ``tell`` is told once of a unit that does not answer. ``wrong`` is
    what the other unit was noticed by.
    """

    def __init__(
        self,
        identify: Callable[[], Awaitable[None]] | None,
        writer: RecordingWriter | None,
        recorded: Marked,
        tell: Callable[[str], None] = lambda _: None,
        now_ns: Callable[[], int] = HOST.now_ns,
    ) -> None:
        self.wrong: WrongUnit | None = None
        self._two: TwoAnswer | None = None
        self._identify, self._writer, self._recorded = identify, writer, recorded
        self._tell, self._now_ns = tell, now_ns
        self._told = self._marked = self._interrupted = False
        self._turn, self._soon = asyncio.Lock(), asyncio.Event()
        self._asking: asyncio.Task[None] | None = None
        self._confirmed = self._here()

    def _here(self) -> tuple[int, int, object]:
        """Up to now: running index of the raw records, host time, and what they
        have come to."""
        return 0 if self._writer is None else self._writer.offered, self._now_ns(), self._recorded.mark()

    @property
    def unconfirmed(self) -> int:
        """How many raw records have been marked as unconfirmed."""
        return self._writer.offered - self._confirmed[0] if self._marked and self._writer is not None else 0

    async def returned(self, identify: Callable[[], Awaitable[None]]) -> None:
        """Identifies a unit that was lost and is opened again. Raises Exchanged
        where records have come since the right one was confirmed and another
        unit answers, unless the right one does at the second reading. Else
        raises what ``identify`` does."""
        async with self._turn:
            try:
                await identify()
            except TwoAnswer as e:
                self._two = e
                raise
            except WrongUnit as e:
                if self._confirmed[0] == self._here()[0]:
                    raise
                try:
                    await _once_more(identify, e)
                except WrongUnit:
                    raise Exchanged(str(e)) from e
            if self.wrong is None:
                self._confirmed = self._here()

    async def ask(self) -> bool:
        """Whether the unit has answered. What came up to the request is the
        right unit's where it answers as such."""
        if self._identify is None or self.wrong is not None:
            return True
        async with self._turn:
            before = self._here()
            try:
                try:
                    await self._identify()
                except WrongUnit as e:
                    await _once_more(self._identify, e)
            except WrongUnit as e:
                self.wrong = e
            except TwoAnswer as e:
                self._two = e
                raise
            except ABSENT as e:  # silent, busy or refusing is not wrong
                self._note(str(e))
                return False
            else:
                self._confirmed = max(before, self._confirmed, key=lambda c: c[0])
            return True

    def _note(self, trouble: str) -> None:
        if self._told:
            return
        self._told = True
        self._tell(trouble)
        if self._writer is not None:
            self._writer.event("identity_unanswered", {"error": trouble})

    def of(self, device: Streaming) -> Confirmed:
        """The device, whose stream ends with WrongUnit once another unit is
        noticed."""
        return Confirmed(device, self)

    @asynccontextmanager
    async def phase(self) -> AsyncIterator[None]:
        """While one phase is recorded. At its end, also when it is cancelled,
        the unit is asked once more. Where another unit is noticed, also beside
        the right one, all that came since the unit was confirmed is marked as
        unconfirmed. Raises WrongUnit, TwoAnswer."""
        try:
            yield
        except WrongUnit as e:
            self.wrong = e
        except asyncio.CancelledError:
            with suppress(TimeoutError):
                async with asyncio.timeout(LAST_S):
                    await self._ask_at_the_end()
            if self.wrong is None:
                raise
        except Exception:
            if (why := self.wrong or self._two) is not None:
                self.disown(why)
            raise
        else:
            await self._ask_at_the_end()
        if self.wrong is not None:
            self.disown(self.wrong)
            raise self.wrong

    async def _ask_at_the_end(self) -> None:
        for _ in range(LAST_ATTEMPTS):
            if await self.ask():
                return

    def disown(self, why: Exception) -> None:
        """Marks what came since the unit was confirmed as unconfirmed. Raises
        RecordingError."""
        if self._writer is None:
            return
        first, confirmed_ns, mark = self._confirmed
        if self._writer.offered == first or self._marked:
            return
        self._marked = True
        self._recorded.back_to(mark)
        self._writer.unconfirmed(first, {"confirmed_ns": confirmed_ns, "error": str(why)})

    def heed(self, batch: RawBatch) -> None:
        """Raises WrongUnit once another unit is noticed, and what else the asking
        has failed with. While the unit is lost it is not asked; after a hole in
        its stream it is asked at once."""
        if batch.gap is not None:
            self._interrupted = batch.gap.to_ns is None
            if not self._interrupted:
                self._soon.set()
        if self.wrong is not None:
            raise self.wrong
        if self._asking is not None and self._asking.done():
            self._asking.result()

    @asynccontextmanager
    async def keeping_on(self) -> AsyncIterator[None]:
        """Asks now and then, beside the stream."""
        if self._identify is None:
            yield
            return
        asking = self._asking = asyncio.ensure_future(self._keep_asking())
        try:
            yield
        finally:
            self._asking = None
            asking.cancel()
            await asyncio.wait([asking])
            if not asking.cancelled():
                asking.exception()  # heard of by then

    async def _keep_asking(self) -> None:
        pause_s, retry_s = EVERY_S, RETRY_S
        while self.wrong is None:
            with suppress(TimeoutError):
                async with asyncio.timeout(pause_s):
                    await self._soon.wait()
            self._soon.clear()
            pause_s = EVERY_S
            if self._interrupted:
                continue
            if await self.ask():
                retry_s = RETRY_S
            else:
                pause_s, retry_s = retry_s, min(2 * retry_s, EVERY_S)


async def _once_more(identify: Callable[[], Awaitable[None]], wrong: WrongUnit) -> None:
    """After a wrong identity was read. Raises it unless the right one is read
    `SURE_S` later; a blank one may be read for `STARTING_S` before, as of a unit
    that is starting. Raises what ``identify`` does where nothing but blanks
    have been read and the unit is absent."""
    blank = isinstance(wrong, BlankIdentity)
    for _ in range(round(STARTING_S / SURE_S) if blank else 1):
        await asyncio.sleep(SURE_S)
        try:
            await identify()
        except BlankIdentity:
            continue
        except ABSENT:
            if blank:
                raise
            raise wrong from None
        return
    raise wrong


class Confirmed:
    """To be had by `Confirmation.of`."""

    def __init__(self, device: Streaming, confirmation: Confirmation) -> None:
        self._device, self._confirmation = device, confirmation

    def complain(self, trouble: Exception) -> None:
        self._device.complain(trouble)

    async def stream(self, names: Sequence[str]) -> AsyncGenerator[RawBatch, None]:
        stream = cast(Any, self._device.stream(names))
        async with self._confirmation.keeping_on(), aclosing(stream):
            async for batch in stream:
                yield batch
                self._confirmation.heed(batch)
