"""A unit behind an asynchronous device without a bus, on a clock of its own: thousands of runs in seconds."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass
from typing import Any

from tests.devices.memory import Electronics, Refused
from tests.devices.modbus import CORRECTED, EXCEPTIONS, READ_INPUT, READINGS
from tests.devices.motion import Motion
from tests.devices.place import Exchange, Place

REQUEST_S = 0.001
"""What a request and its reply take on the way."""
Record = tuple[int, int, int, bytes]


class VirtualClock:
    """Time passes when somebody sleeps, and then at once."""

    def __init__(self, now_s: float = 0.0) -> None:
        self.now_s = now_s

    def now(self) -> float:
        return self.now_s

    async def sleep(self, seconds: float) -> None:
        """Also where a cancellation strikes."""
        self.now_s += max(seconds, 0.0)
        await asyncio.sleep(0)


@dataclass(frozen=True)
class Errors:
    """The exceptions that the adapter is to raise. ``refused`` is called with a message, register and code.

    ``silent``: no reply in time; ``absent``: nothing answers on opening; ``bus``: the connection was dropped;
    ``malformed``: a damaged reply; ``busy``: refused as busy, where that is another exception.
    """

    silent: type[Exception]
    absent: type[Exception]
    bus: type[Exception]
    malformed: type[Exception]
    refused: Callable[..., Exception]
    busy: Callable[..., Exception] | None = None


class InMemoryDevice:
    """``open``, ``close``, ``read``, ``write``, ``stream`` on the unit at ``place``.

    Registers go most significant byte first, or least with ``little_endian``. ``blind_open`` does not ask the unit,
    as on a bus; otherwise a connection does not survive a restart of it where the place's trouble says so. ``batch``
    makes what a stream yields of its records (time_ns, source, flags, payload). ``extra`` makes what `listen` gives of
    an answer too many: register, answer, and the answer before it.
    """

    def __init__(
        self,
        place: Place,
        errors: Errors,
        clock: VirtualClock,
        *,
        reply_timeout_s: float = 0.1,
        little_endian: bool = False,
        blind_open: bool = False,
        motion: Motion | None = None,
        batch: Callable[[list[Record]], Any] = list,
        extra: Callable[[str, bytes, bytes], Any] | None = None,
    ) -> None:
        self.place = place
        self._errors = errors
        self._clock = clock
        self._timeout_s = reply_timeout_s
        self._little_endian = little_endian
        self._blind_open = blind_open
        self._motion = motion or Motion()
        self._batch = batch
        self._extra_of = extra
        self._extra: list[tuple[float, str, bytes, bytes]] = []
        self._connection: tuple[int, int] | None = None
        self._restarted_s = -float("inf")
        self._restarts = self._incarnation()

    async def open(self) -> None:
        await self._clock.sleep(REQUEST_S)
        self._notice_restart()
        if self._clock.now() < self._restarted_s + self.place.trouble.refuse_connections_s:
            raise self._errors.bus("the connection was refused")
        if not self._blind_open:
            with self.place.lock:
                up = self.place.unit.up(self._clock.now())
            if not up:
                await self._clock.sleep(self._timeout_s)
                raise self._errors.absent("nothing answers")
        self._connection = self._incarnation()

    async def close(self) -> None:
        self._connection = None

    async def read(self, register: str) -> bytes:
        now = self._clock.now()
        raw = await self._ask(register, lambda unit: (unit.read(register, now), 0.0))
        return raw[::-1] if self._little_endian else raw

    async def write(self, register: str, raw: bytes, *, timeout_s: float | None = None) -> None:
        """``timeout_s`` takes the place of the reply time-out."""
        big, now = raw[::-1] if self._little_endian else raw, self._clock.now()
        await self._ask(register, lambda unit: (b"", unit.write(register, big, now)), timeout_s)

    async def stream(self, names: Sequence[str]) -> AsyncIterator[Any]:
        """Polls ``readings`` and ``corrected`` as a Modbus master would, until the iterator is closed."""
        while True:
            await self._clock.sleep(0.02)
            now = self._clock.now()
            if not self.place.unit.up(now):
                raise self._errors.silent("the stream has stopped")
            records = []
            for name in names:
                readings = name == "readings"
                values = (self._motion.shown if readings else self._motion.corrected)(self.place.unit, now)
                source = READ_INPUT << 16 | (READINGS if readings else CORRECTED)
                records.append((round(now * 1e9), source, 0, b"".join(self._motion.encode(values))))
            yield self._batch(records)

    async def _ask(
        self,
        register: str,
        carry_out: Callable[[Electronics], tuple[bytes, float]],
        timeout_s: float | None = None,
    ) -> bytes:
        await self._clock.sleep(0.0)  # where a cancellation strikes before the request
        if self._connection is None:
            raise self._errors.bus("the device is not open")
        self._notice_restart()
        if self.place.trouble.restart_drops and self._connection != self._incarnation():
            raise self._errors.bus("the connection was lost")
        refusal: dict[bytes, Refused] = {}

        def refuse(refused: Refused) -> bytes:
            token = b"refused %d" % len(refusal)
            refusal[token] = refused
            return token

        exchange = self.place.exchange(self._clock.now(), carry_out, refuse)
        await self._clock.sleep(REQUEST_S)  # and here after it
        return await self._received(register, exchange, refusal, timeout_s or self._timeout_s)

    async def listen(self, seconds: float) -> list[Any]:
        """The answers too many that have come by then."""
        await self._clock.sleep(seconds)
        due = [e for e in self._extra if e[0] <= self._clock.now()]
        self._extra = [e for e in self._extra if e[0] > self._clock.now()]
        return [self._extra_of(*e[1:]) for e in due] if self._extra_of else []

    async def _received(
        self, register: str, exchange: Exchange, refusal: dict[bytes, Refused], timeout_s: float
    ) -> bytes:
        if exchange.drop:
            self._connection = None
            raise self._errors.bus("the connection was lost")
        if not exchange.replies or min(r.after_s for r in exchange.replies) > timeout_s:
            await self._clock.sleep(timeout_s)
            raise self._errors.silent(f"no reply from register {register}")
        reply, *further = sorted(exchange.replies, key=lambda reply: reply.after_s)
        now = self._clock.now()
        order = -1 if self._little_endian else 1
        self._extra += [(now + r.after_s, register, r.data[::order], reply.data[::order]) for r in further]
        await self._clock.sleep(reply.after_s)
        if reply.garbage is not None:
            raise self._errors.malformed(f"register {register}: {reply.garbage}")
        if reply.data in refusal:
            refused = refusal[reply.data]
            code = refused.code or EXCEPTIONS[refused.why]
            kind = self._errors.busy if refused.why == "busy" and self._errors.busy else self._errors.refused
            raise kind(f"register {register}: {refused.why}", register=register, code=code)
        return reply.data

    def _incarnation(self) -> tuple[int, int]:
        return id(self.place.unit), self.place.unit.restarts

    def _notice_restart(self) -> None:
        with self.place.lock:
            self.place.unit.up(self._clock.now())
        if self._incarnation() != self._restarts:
            self._restarts, self._restarted_s = self._incarnation(), self._clock.now()
