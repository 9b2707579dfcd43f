"""A short look at a device's readings and its corrected output at the same
moments."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Sequence
from contextlib import aclosing, asynccontextmanager, closing, suppress
from typing import Any, Protocol, cast

import numpy as np

import triaxcal_drivers as td
from triaxcald.errors import TwoAnswer
from triaxcald.provision.identity import BlankIdentity, WrongUnit
from triaxcald.provision.registers import SanityWarning, Snapshot, departure_g, departure_warnings
from triaxcald.recording.writer import RecordingWriter
from triaxcald.station.reconnect import ABSENT, Exchanged, Streaming

SAMPLES = 20
"""Their median is not moved by a knock, and at the slowest usual rate they take
two seconds."""


async def live_output_warnings(device: td.Device, bundle: td.Bundle, snapshot: Snapshot) -> list[SanityWarning]:
    """None where the device has no corrected output, or where it does not come."""
    if td.CORRECTED not in bundle.profile.streams:
        return []
    blocks: dict[str, list[td.SampleBlock]] = {td.READINGS: [], td.CORRECTED: []}
    with suppress(td.DriverError, TimeoutError):
        await _collect(device, bundle, blocks)
    readings, outputs = (_joined(blocks[name]) for name in (td.READINGS, td.CORRECTED))
    _, mine, theirs = np.intersect1d(readings[0], outputs[0], return_indices=True)
    channels = {name: values[mine] for name, values in readings[2].items()}
    off_g = departure_g(bundle.profile, snapshot, readings[1][mine], outputs[1][theirs], channels)
    return departure_warnings(off_g)


async def _collect(device: td.Device, bundle: td.Bundle, blocks: dict[str, list[td.SampleBlock]]) -> None:
    driver, sampling = td.driver_named(bundle.profile.driver), bundle.profile.sampling
    decoders = {name: driver.decoder(bundle, name) for name in blocks}
    # So long even if one of the two never comes.
    limit_s = sampling.silence_timeout_s + 2 * SAMPLES / sampling.rate_hz
    with closing(td.stall_clock.StallTolerantClock(asyncio.get_running_loop())) as clock:
        async with clock.timeout(limit_s), aclosing(cast(Any, device.stream(list(blocks)))) as stream:
            async for batch in stream:
                for name, decoder in decoders.items():
                    blocks[name].append(decoder.feed(batch))
                if min(sum(map(len, held)) for held in blocks.values()) >= SAMPLES:
                    return


def _joined(blocks: list[td.SampleBlock]) -> tuple[Any, Any, dict[str, Any]]:
    """Counters (n,), readings (n,3) and channels of all blocks."""
    if not blocks:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3)), {}
    channels = {name: np.concatenate([b.channels[name] for b in blocks]) for name in blocks[0].channels}
    return np.concatenate([b.counter for b in blocks]), np.concatenate([b.readings for b in blocks]), channels


# Confirms the identity of a unit during a recording: behind a gateway a unit can be
# exchanged without a gap in its stream.

EVERY_S = 45.0
"""Period of the confirmation. The documentation promises one a minute; the remaining
time covers an unanswered request."""
RETRY_S = 10.0
"""Pause after an unanswered request; doubled up to `EVERY_S`, since some units answer
nothing while they stream."""
SURE_S = 0.2
"""Time between two readings of a wrong identity: a single one ends no recording."""
STARTING_S = 3.0
"""Time in which a starting unit may show a blank identity: a device loads its
registers within a second or two."""
LAST_ATTEMPTS = 3
"""Requests at the end of a phase, since a reply may get lost and no later request
follows."""
LAST_S = 2.0
"""Time limit of the last confirmation of a stopped recording."""


class Checkpointed(Protocol):
    """Recorded counts with checkpoints, to discard records that turn out to be of
    another unit."""

    def checkpoint(self) -> object: ...

    def roll_back(self, checkpoint: Any) -> None: ...


class Confirmation:
    """Confirmation of a unit's identity during its recording.

    ``identify`` reads the identity, and raises WrongUnit if another unit answers;
    None if the unit has no register for it, so nothing is requested. ``tell``
    receives one message about a unit that does not answer. ``wrong`` is the error of
    a noticed exchange.
    """

    def __init__(
        self,
        identify: Callable[[], Awaitable[None]] | None,
        writer: RecordingWriter | None,
        recorded: Checkpointed,
        tell: Callable[[str], None] = lambda _: None,
        now_ns: Callable[[], int] = td.host_clock.HOST.now_ns,
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
        """The present point: running index of the raw records, host time, and
        checkpoint of the counts."""
        return 0 if self._writer is None else self._writer.offered, self._now_ns(), self._recorded.checkpoint()

    @property
    def unconfirmed(self) -> int:
        """Number of raw records that are marked as unconfirmed."""
        return self._writer.offered - self._confirmed[0] if self._marked and self._writer is not None else 0

    async def returned(self, identify: Callable[[], Awaitable[None]]) -> None:
        """Identify a unit after a reconnection.

        Raises Exchanged if records have come since the last confirmation and another
        unit answers at two readings. Raises the other errors of ``identify``.
        """
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
        """Request the identity; whether the unit has answered. The right answer
        confirms all records before the request."""
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
            except ABSENT as e:  # a silent, busy or refusing unit is not a wrong one
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
        """The device, whose stream raises WrongUnit once another unit is noticed."""
        return Confirmed(device, self)

    @asynccontextmanager
    async def phase(self) -> AsyncIterator[None]:
        """Confirms the unit at the end of a recorded phase, also of a cancelled one.

        If another unit is noticed, even together with the right one, all records
        since the last confirmation are marked as unconfirmed. Raises WrongUnit,
        TwoAnswer.
        """
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
        """Mark the records since the last confirmation as unconfirmed. Raises
        RecordingError."""
        if self._writer is None:
            return
        first, confirmed_ns, checkpoint = self._confirmed
        if self._writer.offered == first or self._marked:
            return
        self._marked = True
        self._recorded.roll_back(checkpoint)
        self._writer.unconfirmed(first, {"confirmed_ns": confirmed_ns, "error": str(why)})

    def heed(self, batch: td.RawBatch) -> None:
        """Take note of a batch. Raises WrongUnit once another unit is noticed, and
        other errors of the requests. No request is sent while the unit is lost; one is
        sent at once after a gap in its stream."""
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
        """Requests the identity periodically during the stream."""
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
                asking.exception()  # retrieved: `heed` has raised it

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
    """Repeat the reading of a wrong identity.

    Raises ``wrong`` unless the right identity is read `SURE_S` later. A starting
    unit may show a blank identity for `STARTING_S` first. If only blanks were read
    and the unit is absent, raises the error of ``identify``.
    """
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
    """The stream of a device with confirmation; made by `Confirmation.of`."""

    def __init__(self, device: Streaming, confirmation: Confirmation) -> None:
        self._device, self._confirmation = device, confirmation

    def complain(self, trouble: Exception) -> None:
        self._device.complain(trouble)

    async def stream(self, names: Sequence[str]) -> AsyncGenerator[td.RawBatch, None]:
        stream = cast(Any, self._device.stream(names))
        async with self._confirmation.keeping_on(), aclosing(stream):
            async for batch in stream:
                yield batch
                self._confirmation.heed(batch)
