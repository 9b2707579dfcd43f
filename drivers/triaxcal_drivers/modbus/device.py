"""A Modbus unit: polls its streams, reads and writes its registers."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass

from triaxcal_drivers.errors import (
    BusError,
    DeviceAbsent,
    DeviceBusy,
    DeviceSilent,
    ProfileError,
    RegisterRefused,
    RegisterValueError,
    SecondAnswer,
)
from triaxcal_drivers.host_clock import HOST
from triaxcal_drivers.interface import RawBatch, RawFlag
from triaxcal_drivers.modbus.line import ModbusClient
from triaxcal_drivers.modbus.model import FifoStream, ModbusBus, ModbusProfile, ModbusRegister, PollStream, words_of
from triaxcal_drivers.modbus.protocol import (
    GATEWAY_CODES,
    READ_HOLDING,
    READ_INPUT,
    MalformedReply,
    Misanswered,
    ModbusRefusal,
    Spoiled,
)
from triaxcal_drivers.registers import TYPES
from triaxcal_drivers.two_senders import ExtraAnswer

_BATCH_REPLIES = 32
"""A stream hands out what it has after so many replies, though more may be
waiting in the device."""
_DISCARD_S = 60.0
"""A FIFO that does not say how much is in it is read for so long until it is
empty: it may fill as fast as it is read. 4096 records of 20 bytes take 48 s at
19200 baud."""
_DOUBLINGS = 10
"""Of the pause before a unit that does not answer is asked again: a thousand
time-outs at most."""

_CONTRADICTIONS, _POLLS = 3, 20
"""So many of the last polls with a reply that no request explains, and that has
other bytes than the one before it: another unit sends them. A single one may
be a very late reply, or one that a gateway asked for again."""

_EMPTY = "it answers, but its FIFO stays empty"

Record = tuple[int, int, int, bytes]


@dataclass
class _Polled:
    """A stream while it is polled. ``due_s`` is of the loop's time, ``heard_s``
    of the unit's own time."""

    name: str
    stream: PollStream | FifoStream
    due_s: float
    heard_s: float
    trouble: str = "no reply"
    unanswered: int = 0
    """Requests in a row to which no reply came."""
    again: bool = False
    """Whether the last reply was spoiled and the one before was not: it is
    asked for again at once."""

    @property
    def source(self) -> int:
        return self.stream.function << 16 | self.stream.address


class ModbusDevice:
    """One unit on one connection. Register access and polling share it, one
    request at a time.

    Registers go most significant byte first, whatever the word order of the
    profile. ``now_ns`` is the host's clock, for the receive times.
    ``discarded`` counts the records that were in FIFOs before streams were
    opened.
    """

    def __init__(self, profile: ModbusProfile, bus: ModbusBus, *, now_ns: Callable[[], int] = HOST.now_ns) -> None:
        self._profile = profile
        self._bus = bus
        self._now_ns = now_ns
        self._client: ModbusClient | None = None
        self._owed_s = 0.0
        self._asked = ""
        self.discarded = 0

    async def open(self) -> None:
        await self.close()
        timeout_s = self._profile.sampling.reply_timeout_s
        self._client = await ModbusClient.joined(
            self._bus.where, unit_id=self._bus.unit_id, reply_timeout_s=timeout_s, owed_s=self._owed_s
        )
        try:
            await self._probe(self._client)
        except BaseException:
            await self.close()
            raise

    async def close(self) -> None:
        client, self._client = self._client, None
        if client is not None:
            self._owed_s = client.owed_s
            await client.close()

    async def _probe(self, client: ModbusClient) -> None:
        """Any answer of the unit shows that it is there, an exception too.
        Takes no samples from it."""
        function, address, count = self._probe_request()
        for last in (False, True):
            try:
                await client.read(function, address, count)
            except MalformedReply:
                return
            except (ModbusRefusal, DeviceSilent) as e:
                cause = _cause(e) if isinstance(e, DeviceSilent) else self._no_contact(e)
                if cause is None:
                    return
                if last and isinstance(e, Misanswered):
                    raise DeviceAbsent(str(e)) from e
                if last:
                    raise DeviceAbsent(f"nothing answers at {client.where}: {cause}") from e
            else:
                return

    def _no_contact(self, e: ModbusRefusal) -> str | None:
        """What a gateway says of a unit that it has not reached; None where the
        exception is the unit's own."""
        if e.code not in GATEWAY_CODES or e.code in self._profile.busy_codes:
            return None
        return f"no contact: {e}"

    def _probe_request(self) -> tuple[int, int, int]:
        names = [self._profile.identity.serial_register, *self._profile.identity.expect]
        for name in [n for n in names if n] + list(self._profile.registers):
            register = self._profile.registers[name]
            if register.access != "wo":
                return _function(register), register.address, words_of(register.type)
        stream = self._profile.streams["readings"]
        return stream.function, stream.address, stream.record_start if isinstance(stream, FifoStream) else 1

    async def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]:
        """Replies of the named streams, polled in turn. A failed request is a
        record too: an exception's code, a malformed reply as it came, nothing
        for a missing reply. A reply from an empty FIFO is none: the unit
        answers, and brings nothing. What FIFOs hold by now is discarded first.

        Raises DeviceSilent, BusError; SecondAnswer if two units answer the
        polls; ProfileError where the profile has no such stream.
        """
        loop = asyncio.get_running_loop()
        for name in names:
            if name not in self._profile.streams:
                raise ProfileError(f"profile {self._profile.name}: no stream named '{name}'")
        for name in names:
            await self._discard(self._polled(name))
        polled = [self._polled(name) for name in names]
        contradictions = deque[bool](maxlen=_POLLS)
        while polled:
            await asyncio.sleep(min(p.due_s for p in polled) - loop.time())
            for p in [p for p in polled if p.due_s <= loop.time()]:
                p.due_s = max(p.due_s + p.stream.poll_period_s, loop.time())
                records = await self._drain(p)
                yield RawBatch.of(records)
                contradictions.append(any(not e.same for e in await self.listen(0.0)))
                if sum(contradictions) >= _CONTRADICTIONS:
                    raise SecondAnswer(f"two units answer at {self._connected().where}")
                self._check_heard(p, polled)
                if p.again:
                    p.due_s = loop.time()
                elif p.unanswered and not self._connected().alone:
                    p.due_s = max(p.due_s, loop.time() + self._pause_s(p))

    def _check_heard(self, p: _Polled, polled: Sequence[_Polled] = ()) -> None:
        """Raises DeviceSilent, with the stream where another one of those
        ``polled`` goes on."""
        own_s, patience_s = self._connected().own_s, self._profile.sampling.silence_timeout_s
        silent_s = own_s - p.heard_s
        if silent_s < patience_s:
            return
        said = f"{self._connected().where}: stream {p.name} has been silent for {silent_s:.1f} s: {p.trouble}"
        if any(own_s - q.heard_s < patience_s / 2 for q in polled):
            raise DeviceSilent(said, stream=p.name, source=p.source, silent_s=silent_s)
        raise DeviceSilent(said)

    def _pause_s(self, p: _Polled) -> float:
        """Before a unit that does not answer is asked again: twice as long each
        time, so that it takes ever less of a line that it shares, but not
        beyond the moment at which it counts as silent. A lost reply costs no
        pause."""
        patience_s = self._profile.sampling.reply_timeout_s
        until_silent_s = p.heard_s + self._profile.sampling.silence_timeout_s - self._connected().own_s
        pause_s = patience_s * (float(2 ** min(p.unanswered - 1, _DOUBLINGS)) - 1)
        return max(min(pause_s, until_silent_s - patience_s), 0.0)

    def _polled(self, name: str) -> _Polled:
        now_s = asyncio.get_running_loop().time()
        return _Polled(name, self._profile.streams[name], now_s, self._connected().own_s)

    async def _discard(self, p: _Polled) -> None:
        """Takes out of a stream's FIFO what it held at the first reply; whole
        windows. Raises DeviceSilent."""
        if not isinstance(p.stream, FifoStream):
            return
        loop = asyncio.get_running_loop()
        counted = p.stream.header.remaining is not None
        deadline_s = math.inf if counted else loop.time() + _DISCARD_S
        left: float = math.inf
        while left > 0 and loop.time() < deadline_s:
            flags, data = await self._request(p)
            taken, remaining = self._held(p.stream, data) if not flags else (0, math.inf)
            if taken > p.stream.record_capacity:  # no count of this device's
                taken, remaining = 0, math.inf
            left = min(left - taken, remaining) if counted else remaining
            self.discarded += taken
            if taken:
                p.heard_s = self._connected().own_s
            elif left > 0:
                p.trouble = p.trouble if flags else _EMPTY
                self._check_heard(p)
                await asyncio.sleep(p.stream.poll_period_s)

    async def _drain(self, p: _Polled) -> list[Record]:
        """One read of a stream, or reads until its FIFO is empty, but not for
        ever."""
        records: list[Record] = []
        for _ in range(_BATCH_REPLIES):
            asked_ns, asked_s = self._now_ns(), self._connected().attention_s
            flags, data = await self._request(p)
            taken, remaining = self._held(p.stream, data) if not flags else (0, 0)
            if flags or taken:
                records.append((self._came_ns(asked_ns, asked_s), p.source, flags, data))
            if taken:
                p.heard_s = self._connected().own_s
            elif not flags:
                p.trouble = _EMPTY
            if not remaining:
                return records
        p.due_s = 0.0  # more is waiting: come back at once
        return records

    def _came_ns(self, asked_ns: int, asked_s: float) -> int:
        """When the reply came, for all that is known. Where this process was
        kept from looking it has waited unread: what the unit did meanwhile is
        later than the reply."""
        waited_s = self._connected().attention_s - asked_s
        now_ns = self._now_ns()
        return min(now_ns, asked_ns + round(waited_s * 1e9)) if math.isfinite(waited_s) else now_ns

    async def _request(self, p: _Polled) -> tuple[RawFlag, bytes]:
        unanswered, p.unanswered, p.again = p.unanswered, 0, False
        try:
            data = await self._connected().read(p.stream.function, p.stream.address, p.stream.words)
        except ModbusRefusal as e:
            no_contact = self._no_contact(e)
            p.trouble = no_contact or str(e)
            p.unanswered = unanswered + 1 if no_contact else 0
            return RawFlag.ERROR, bytes([e.code])
        except MalformedReply as e:
            p.trouble = "malformed replies"
            return RawFlag.INVALID, e.pdu
        except DeviceSilent as e:
            p.trouble = _cause(e) if isinstance(e, Misanswered) else "no reply"
            p.unanswered = unanswered + 1
            p.again = isinstance(e, Spoiled) and not unanswered
            return RawFlag.ERROR, b""
        return RawFlag(0), data

    def _held(self, stream: PollStream | FifoStream, data: bytes) -> tuple[int, int]:
        """Records in a reply, and records left in the device."""
        if not isinstance(stream, FifoStream):
            return 1, 0

        def number(word: int) -> int:
            return int.from_bytes(data[2 * word : 2 * word + 2], self._profile.byte_order)

        count = number(stream.header.count)
        if stream.header.remaining is not None:
            return count, number(stream.header.remaining)
        return count, int(count >= stream.record_capacity)

    async def listen(self, seconds: float) -> list[ExtraAnswer]:
        """Waits so long by the host's clock. Returns the replies since the last
        call that no request explains."""
        await asyncio.sleep(seconds)
        if self._client is None:
            return []
        entry = self._profile.registers.get(self._asked)

        def told(pdu: bytes) -> bytes:
            """The bytes of the register that was asked for last, if it may be
            its reply."""
            if entry is None or pdu[0] != _function(entry) or len(pdu) != 2 + 2 * words_of(entry.type):
                return pdu
            return self._ordered(entry, pdu[2:])

        return [
            ExtraAnswer(self._asked, told(e.answer), None if e.first is None else told(e.first))
            for e in self._client.extra()
        ]

    async def read(self, register: str) -> bytes:
        entry = self._register(register)
        self._asked = register
        try:
            raw = await self._connected().read(_function(entry), entry.address, words_of(entry.type))
        except ModbusRefusal as e:
            raise self._refused(register, "read", e) from e
        except MalformedReply as e:
            raise BusError(f"register {register}: {e}") from e
        return self._ordered(entry, raw)

    async def write(self, register: str, raw: bytes, *, timeout_s: float | None = None) -> None:
        """Raises RegisterValueError where ``raw`` is not as long as the
        register; nothing is sent then."""
        entry = self._register(register)
        size = TYPES[entry.type].size
        if len(raw) != size:
            raise RegisterValueError(f"register {register}: {len(raw)} bytes, expected {size} ({entry.type})")
        if entry.table == "input":
            raise RegisterValueError(f"register {register}: an input register cannot be written")
        self._asked = register
        single = self._profile.single_write and words_of(entry.type) == 1
        try:
            await self._connected().write(entry.address, self._ordered(entry, raw), single=single, timeout_s=timeout_s)
        except ModbusRefusal as e:
            raise self._refused(register, "written", e) from e
        except MalformedReply as e:
            raise BusError(f"register {register}: {e}") from e

    def _refused(self, register: str, done: str, e: ModbusRefusal) -> RegisterRefused | DeviceSilent:
        where = f"{self._connected().where}: register {register} (0x{self._register(register).address:04X})"
        if no_contact := self._no_contact(e):
            return DeviceSilent(f"{where} cannot be {done}: {no_contact}")
        kind = DeviceBusy if e.code in self._profile.busy_codes else RegisterRefused
        return kind(f"{where} cannot be {done}: {e}", register=register, code=e.code)

    def _register(self, name: str) -> ModbusRegister:
        if name not in self._profile.registers:
            raise ProfileError(f"profile {self._profile.name}: no register named '{name}'")
        return self._profile.registers[name]

    def _ordered(self, register: ModbusRegister, raw: bytes) -> bytes:
        """From most significant first to the device's order, or back: the same
        exchange both ways."""
        words = [raw[i : i + 2] for i in range(0, len(raw), 2)]
        if (register.word_order or self._profile.word_order) == "little":
            words.reverse()
        if self._profile.byte_order == "little":
            words = [w[::-1] for w in words]
        return b"".join(words)

    def _connected(self) -> ModbusClient:
        if self._client is None:
            raise BusError("the device is not open")
        return self._client


def _function(register: ModbusRegister) -> int:
    return READ_INPUT if register.table == "input" else READ_HOLDING


def _cause(e: DeviceSilent) -> str:
    return str(e).partition(": ")[2]
