"""Units that send one line of text a sample over TCP: ``counter,x,y,z``."""

import asyncio
import time
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import closing

import numpy as np

from triaxcal_drivers.claim import Claim
from triaxcal_drivers.errors import DeviceAbsent, DeviceSilent, RegisterRefused
from triaxcal_drivers.interface import RawBatch, RawFlag, SampleBlock
from triaxcal_drivers.profile import Bundle, Profile, Strict
from triaxcal_drivers.stall_clock import StallTolerantClock


class LinesStream(Strict):
    scale: float = 1.0


class LinesProfile(Profile):
    streams: Mapping[str, LinesStream]


class LinesBus(Strict):
    host: str
    port: int

    def claim(self) -> Claim:
        return Claim(f"lines unit, TCP port {self.port}", host=self.host)


class LinesDecoder:
    """Pure: the samples are the same however the lines are cut into batches."""

    def __init__(self, scale: float, rate_hz: float) -> None:
        self._scale, self._period_ns = scale, 1e9 / rate_hz
        self._first: tuple[int, int] | None = None  # counter and host time of the first sample
        self._last = -1

    def feed(self, batch: RawBatch) -> SampleBlock:
        rows, missing, duplicates, errors, at = [], 0, 0, 0, 0
        for time_ns, length in zip(batch.time_ns.tolist(), batch.length.tolist(), strict=True):
            fields = batch.payload[at : at + length].split(b",")
            at += length
            try:
                counter, *xyz = int(fields[0]), *map(float, fields[1:4])
            except ValueError:
                errors += 1
                continue
            if len(xyz) != 3 or not np.isfinite(xyz).all():
                errors += 1
                continue
            if self._first is None:
                self._first, self._last = (counter, time_ns), counter - 1
            if counter <= self._last:
                duplicates += 1
                continue
            missing += counter - self._last - 1
            self._last = counter
            rows.append((counter, *xyz))
        table = np.array(rows, dtype=float).reshape(-1, 4)
        counter = table[:, 0].astype(np.int64)
        first, time_ns = self._first or (0, 0)
        return SampleBlock(
            time_ns=time_ns + np.rint((counter - first) * self._period_ns).astype(np.int64),
            counter=counter,
            readings=table[:, 1:] * self._scale,
            channels={},
            missing=missing,
            duplicates=duplicates,
            errors=errors,
        )


class LinesDevice:
    def __init__(self, profile: Profile, bus: LinesBus) -> None:
        self._profile, self._bus = profile, bus
        self._writer: asyncio.StreamWriter | None = None

    async def open(self) -> None:
        try:
            self._reader, self._writer = await asyncio.open_connection(self._bus.host, self._bus.port)
        except OSError as e:
            raise DeviceAbsent(f"nothing answers at {self._bus.host}:{self._bus.port}: {e.strerror}") from e

    async def close(self) -> None:
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    async def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]:
        await self.close()  # a new connection has no lines in its buffers
        await self.open()
        rest, wait_s = b"", self._profile.sampling.silence_timeout_s
        with closing(StallTolerantClock(asyncio.get_running_loop())) as clock:
            while True:
                try:
                    async with clock.timeout(wait_s):
                        data = await self._reader.read(65536)
                except TimeoutError:
                    raise DeviceSilent(f"no line for {wait_s:g} s") from None
                if not data:
                    raise DeviceSilent("the unit closed the connection")
                now_ns = time.time_ns()
                *lines, rest = (rest + data).split(b"\n")
                if lines:
                    yield RawBatch.of([(now_ns, 0, RawFlag(0), line) for line in lines])

    async def read(self, register: str) -> bytes:
        raise RegisterRefused(f"register {register}: this unit has none", register=register, code=0)

    async def write(self, register: str, raw: bytes) -> None:
        raise RegisterRefused(f"register {register}: this unit has none", register=register, code=0)


class LinesDriver:
    """What the entry point names."""

    profile_model = LinesProfile
    bus_model = LinesBus

    def device(self, bundle: Bundle, bus: LinesBus) -> LinesDevice:
        return LinesDevice(bundle.profile, bus)

    def decoder(self, bundle: Bundle, stream: str) -> LinesDecoder:
        profile = bundle.profile
        assert isinstance(profile, LinesProfile)
        return LinesDecoder(profile.streams[stream].scale, profile.sampling.rate_hz)
