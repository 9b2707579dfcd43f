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
from triaxcal_drivers.modbus.model import FifoStream, ModbusBus, ModbusProfile, ModbusRegister, PollStream, Read
from triaxcal_drivers.modbus.protocol import (
    GATEWAY_CODES,
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    READ_HOLDING,
    READ_INPUT,
    WRITE_MULTIPLE,
    WRITE_SINGLE,
    DamagedReply,
    MalformedReply,
    Misanswered,
    ModbusRefusal,
)
from triaxcal_drivers.registers import ASCII, size_of
from triaxcal_drivers.two_senders import ExtraAnswer

_BATCH_REPLIES = 32
"""A stream yields its records after so many replies, even if more wait in the
device."""
_DISCARD_S = 60.0
"""Longest time for emptying a FIFO that does not report its content: it may fill as
fast as it is read. 4096 records of 20 bytes take 48 s at 19200 baud."""
_DOUBLINGS = 10
"""Most doublings of the pause before the next request to a unit that does not answer:
a thousand time-outs."""

_CONTRADICTIONS, _POLLS = 3, 20
"""A second unit answers if `_CONTRADICTIONS` of the last `_POLLS` polls have a reply
without a request and with other bytes than the previous reply. A single one may be
a very late reply, or one to a request that a gateway repeated."""

_EMPTY = "it answers, but its FIFO stays empty"
_RETRY = 0.1
"""Share of ``latest_s`` after which a failed request for a lasting value is repeated:
five times before the value is too old, and not before each sample."""

Record = tuple[int, int, int, bytes]


@dataclass
class _Lasting:
    """State of a request for lasting values; ``due_s`` by the loop's clock."""

    read: Read
    due_s: float


@dataclass
class _PolledStream:
    """State of a polled stream. ``due_s`` is the time of the next request by the loop's
    clock, ``last_sample_s`` that of the last sample by the unit's own time; ``next``
    numbers the next request for a sample."""

    name: str
    stream: PollStream | FifoStream
    reads: Sequence[Read]
    lasting: Sequence[_Lasting]
    due_s: float
    last_sample_s: float
    next: int = 0
    cause: str = "no reply"
    unanswered: int = 0
    """Consecutive requests without a reply."""
    again: bool = False
    """Whether to repeat the request at once: noise damaged its reply, and the previous
    reply was whole."""

    @property
    def source(self) -> int:
        return self.reads[0].source

    def refusal(self, e: ModbusRefusal, read: Read) -> str:
        """An exception, with its place if there are several, and what it may mean."""
        several = len(self.reads) + len(self.lasting) > 1
        where = f" to function {read.function} at 0x{read.address:04X}" if several else ""
        if e.code == ILLEGAL_ADDRESS and read.unrequested:
            return f"{e}{where}; it may lack the registers between the channels, which max_gap = 0 leaves out"
        return f"{e}{where}"


class ModbusDevice:
    """One unit on one connection. Register access and polling share the connection, one
    request at a time.

    Register values have the most significant byte first, whatever the word order of
    the profile. ``now_ns`` is the host's clock for the receive times. ``discarded``
    counts the records that were in FIFOs before their streams were opened.
    """

    def __init__(self, profile: ModbusProfile, bus: ModbusBus, *, now_ns: Callable[[], int] = HOST.now_ns) -> None:
        self._profile = profile
        self._bus = bus
        self._now_ns = now_ns
        self._client: ModbusClient | None = None
        self._owed_s = 0.0
        self._requested = ""
        self._carried_out: set[int] = set()
        """The functions for writing that the unit has answered with more than that it
        lacks them."""
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
        """Checks that the unit answers; an exception is an answer too. Takes no
        samples. Raises DeviceAbsent."""
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
        """A gateway's report of a unit that it has not reached; None if the exception
        is the unit's own."""
        if e.code not in GATEWAY_CODES or e.code in self._profile.busy_codes:
            return None
        return f"no contact: {e}"

    def _probe_request(self) -> tuple[int, int, int]:
        """Function, address and count of a read without side effects: of a register, or
        of the head of a stream's window."""
        names = [self._profile.identity.serial_register, *self._profile.identity.expect]
        for name in [n for n in names if n] + list(self._profile.registers):
            register = self._profile.registers[name]
            if register.access != "wo":
                return _function(register), register.address, register.words
        stream = self._profile.streams["readings"]
        return stream.function, stream.address, stream.record_start if isinstance(stream, FifoStream) else 1

    async def stream(self, names: Sequence[str]) -> AsyncIterator[RawBatch]:
        """Replies of the named streams, polled in turn. A failed request is a record
        too: the code of an exception, the bytes of a malformed reply, no bytes for a
        missing reply. A reply from an empty FIFO is no record. The present content of
        FIFOs is discarded first.

        Raises DeviceSilent, BusError; SecondAnswer if two units answer the
        polls; ProfileError where the profile has no such stream.
        """
        loop = asyncio.get_running_loop()
        for name in names:
            if name not in self._profile.streams:
                raise ProfileError(f"profile {self._profile.name}: no stream named '{name}'")
        for name in names:
            await self._discard(self._polling(name))
        # Poll each stream when it is due.
        polled = [self._polling(name) for name in names]
        self._share_lasting(polled)
        contradictions = deque[bool](maxlen=_POLLS)
        while polled:
            await asyncio.sleep(min(p.due_s for p in polled) - loop.time())
            for p in [p for p in polled if p.due_s <= loop.time()]:
                p.due_s = max(p.due_s + p.stream.poll_period_s, loop.time())
                records = await (self._drain(p, p.stream) if isinstance(p.stream, FifoStream) else self._cycle(p))
                yield RawBatch.of(records)
                # Replies without a request come from a second unit with this address.
                contradictions.append(any(not e.same for e in await self.listen(0.0)))
                if sum(contradictions) >= _CONTRADICTIONS:
                    raise SecondAnswer(f"two units answer at {self._connected().where}")
                self._check_silence(p, polled)
                # Repeat at once, or pause, as the last reply tells.
                if p.again:
                    p.due_s = loop.time()
                elif p.unanswered and not self._connected().alone:
                    p.due_s = max(p.due_s, loop.time() + self._pause_s(p))

    def _check_silence(self, p: _PolledStream, polled: Sequence[_PolledStream] = ()) -> None:
        """Raises DeviceSilent if the stream is silent for too long. The error names the
        stream if another one of those ``polled`` continues."""
        own_s, timeout_s = self._connected().own_s, self._profile.sampling.silence_timeout_s
        silent_s = own_s - p.last_sample_s
        if silent_s < timeout_s:
            return
        message = f"{self._connected().where}: stream {p.name} has been silent for {silent_s:.1f} s: {p.cause}"
        if any(own_s - q.last_sample_s < timeout_s / 2 for q in polled):
            raise DeviceSilent(message, stream=p.name, source=p.source, silent_s=silent_s)
        raise DeviceSilent(message)

    def _pause_s(self, p: _PolledStream) -> float:
        """Pause before the next request to a unit that does not answer. It doubles each
        time, so the unit takes ever less of a shared line, but it never lasts beyond
        the moment at which the unit counts as silent. The first missing reply causes
        no pause."""
        timeout_s = self._profile.sampling.reply_timeout_s
        until_silent_s = p.last_sample_s + self._profile.sampling.silence_timeout_s - self._connected().own_s
        pause_s = timeout_s * (float(2 ** min(p.unanswered - 1, _DOUBLINGS)) - 1)
        return max(min(pause_s, until_silent_s - timeout_s), 0.0)

    def _polling(self, name: str) -> _PolledStream:
        now_s = asyncio.get_running_loop().time()
        reads = self._profile.reads(name)
        lasting = [_Lasting(read, now_s) for read in reads.lasting]
        own_s = self._connected().own_s
        return _PolledStream(name, self._profile.streams[name], reads.of_sample, lasting, now_s, own_s)

    @staticmethod
    def _share_lasting(polled: Sequence[_PolledStream]) -> None:
        """Equal requests of several streams become one."""
        shared: dict[Read, _Lasting] = {}
        for p in polled:
            p.lasting = [shared.setdefault(lasting.read, lasting) for lasting in p.lasting]

    async def _discard(self, p: _PolledStream) -> None:
        """Removes from a stream's FIFO the records that it had at the first reply, in
        whole windows. Raises DeviceSilent."""
        if not isinstance(p.stream, FifoStream):
            return
        loop = asyncio.get_running_loop()
        counted = p.stream.header.remaining is not None
        deadline_s = math.inf if counted else loop.time() + _DISCARD_S
        left: float = math.inf
        while left > 0 and loop.time() < deadline_s:
            flags, data = await self._request(p, p.reads[0])
            taken, remaining = self._record_counts(p.stream, data) if not flags else (0, math.inf)
            if taken > p.stream.record_capacity:  # not a count of this device
                taken, remaining = 0, math.inf
            left = min(left - taken, remaining) if counted else remaining
            self.discarded += taken
            if taken:
                p.last_sample_s = self._connected().own_s
            elif left > 0:
                p.cause = p.cause if flags else _EMPTY
                self._check_silence(p)
                await asyncio.sleep(p.stream.poll_period_s)

    async def _cycle(self, p: _PolledStream) -> list[Record]:
        """Reads the lasting values that are due, then what makes a sample, and ends at
        the first request of these that fails: the sample is lost. It goes on there at
        the next call if that request is to be repeated at once."""
        loop = asyncio.get_running_loop()
        records: list[Record] = []
        for lasting in p.lasting if p.next == 0 else ():
            if lasting.due_s > loop.time():
                continue
            record = await self._record(p, lasting.read)
            failed = bool(record[2])
            pause_s = _RETRY * (lasting.read.latest_s or 0.0) if failed else lasting.read.renewed_s
            lasting.due_s = loop.time() + pause_s
            records.append(record)
        while p.next < len(p.reads):
            record = await self._record(p, p.reads[p.next])
            records.append(record)
            if record[2]:
                p.next = p.next if p.again else 0
                return records
            p.next += 1
        p.next = 0
        p.last_sample_s = self._connected().own_s
        return records

    async def _record(self, p: _PolledStream, read: Read) -> Record:
        """One request, as its record."""
        requested_ns, requested_s = self._now_ns(), self._connected().clock_s
        flags, data = await self._request(p, read)
        return self._arrival_ns(requested_ns, requested_s), read.source, flags, data

    async def _drain(self, p: _PolledStream, stream: FifoStream) -> list[Record]:
        """Reads a FIFO until it is empty, at most `_BATCH_REPLIES` times."""
        records: list[Record] = []
        for _ in range(_BATCH_REPLIES):
            record = await self._record(p, p.reads[0])
            _, _, flags, data = record
            taken, remaining = self._record_counts(stream, data) if not flags else (0, 0)
            if flags or taken:
                records.append(record)
            if taken:
                p.last_sample_s = self._connected().own_s
            elif not flags:
                p.cause = _EMPTY
            if not remaining:
                return records
        p.due_s = 0.0  # more is waiting: come back at once
        return records

    def _arrival_ns(self, requested_ns: int, requested_s: float) -> int:
        """Latest possible time of the reply [ns]. If this process was kept from
        running, the reply waited unread, so the time of the clock may be too late."""
        waited_s = self._connected().clock_s - requested_s
        now_ns = self._now_ns()
        return min(now_ns, requested_ns + round(waited_s * 1e9)) if math.isfinite(waited_s) else now_ns

    async def _request(self, p: _PolledStream, read: Read) -> tuple[RawFlag, bytes]:
        """Flags and bytes of one reply. Records the cause of a failure in ``p``."""
        unanswered, p.unanswered, p.again = p.unanswered, 0, False
        try:
            data = await self._connected().read(read.function, read.address, read.words)
        except ModbusRefusal as e:
            no_contact = self._no_contact(e)
            p.cause = no_contact or p.refusal(e, read)
            p.unanswered = unanswered + 1 if no_contact else 0
            return RawFlag.ERROR, bytes([e.code])
        except MalformedReply as e:
            p.cause = "malformed replies"
            return RawFlag.INVALID, e.pdu
        except DeviceSilent as e:
            p.cause = _cause(e) if isinstance(e, Misanswered) else "no reply"
            p.unanswered = unanswered + 1
            p.again = isinstance(e, DamagedReply) and not unanswered
            return RawFlag.ERROR, b""
        return RawFlag(0), data

    def _record_counts(self, stream: FifoStream, data: bytes) -> tuple[int, int]:
        """Number of records in a reply, and of records left in the device."""

        def number(word: int) -> int:
            return int.from_bytes(data[2 * word : 2 * word + 2], self._profile.byte_order)

        count = number(stream.header.count)
        if stream.header.remaining is not None:
            return count, number(stream.header.remaining)
        return count, int(count >= stream.record_capacity)

    async def listen(self, seconds: float) -> list[ExtraAnswer]:
        """Waits for ``seconds`` by the host's clock. Returns the replies since the last
        call that belong to no request."""
        await asyncio.sleep(seconds)
        if self._client is None:
            return []
        entry = self._profile.registers.get(self._requested)

        def as_register(pdu: bytes) -> bytes:
            """The bytes of the last requested register if this may be its reply."""
            if entry is None or pdu[0] != _function(entry) or len(pdu) != 2 + 2 * entry.words:
                return pdu
            return self._ordered(entry, pdu[2:])

        return [
            ExtraAnswer(self._requested, as_register(e.answer), None if e.first is None else as_register(e.first))
            for e in self._client.extra()
        ]

    async def read(self, register: str) -> bytes:
        entry = self._register(register)
        self._requested = register
        try:
            raw = await self._connected().read(_function(entry), entry.address, entry.words)
        except ModbusRefusal as e:
            raise self._refused(register, "read", e) from e
        except MalformedReply as e:
            raise BusError(f"register {register}: {e}") from e
        return self._ordered(entry, raw)

    async def write(self, register: str, raw: bytes, *, timeout_s: float | None = None) -> None:
        """Raises RegisterValueError, without sending, if ``raw`` has not the length of
        the register."""
        entry = self._register(register)
        size = size_of(entry)
        if len(raw) != size:
            raise RegisterValueError(f"register {register}: {len(raw)} bytes, expected {size} ({entry.type})")
        if entry.table == "input":
            raise RegisterValueError(f"register {register}: an input register cannot be written")
        self._requested = register
        function = WRITE_SINGLE if self._profile.single_write and entry.words == 1 else WRITE_MULTIPLE
        data, single = self._ordered(entry, raw), function == WRITE_SINGLE
        try:
            await self._connected().write(entry.address, data, single=single, timeout_s=timeout_s)
        except ModbusRefusal as e:
            lacks = f": {self._lacking(function, entry)}" if e.code == ILLEGAL_FUNCTION else ""
            self._carried_out |= {function} if not lacks else set()
            raise self._refused(register, "written", e, lacks) from e
        except MalformedReply as e:
            raise BusError(f"register {register}: {e}") from e
        except DeviceSilent as e:
            # A unit that has answered a function has it: its silence has another cause.
            if function in self._carried_out or isinstance(e, Misanswered):
                raise
            where = self._place_of(register)
            raise DeviceSilent(f"{where} cannot be written: {_cause(e)}: {self._lacking(function, entry)}") from e
        self._carried_out.add(function)

    def _lacking(self, function: int, register: ModbusRegister) -> str:
        """What a missing function is, in the terms of the device and of the profile."""
        silent = f"no answer to function {function}"
        if function == WRITE_SINGLE:
            return f"{silent}; does the device support only {WRITE_MULTIPLE}? (single_write = false)"
        if self._profile.single_write:
            return (
                f"{silent}, which alone writes the {register.words} words of a {register.type}; "
                f"single_write is for registers of one word"
            )
        return f"{silent}; does the device support only {WRITE_SINGLE}? (single_write)"

    def _refused(self, register: str, done: str, e: ModbusRefusal, lacks: str = "") -> RegisterRefused | DeviceSilent:
        where = self._place_of(register)
        if no_contact := self._no_contact(e):
            return DeviceSilent(f"{where} cannot be {done}: {no_contact}")
        kind = DeviceBusy if e.code in self._profile.busy_codes else RegisterRefused
        return kind(f"{where} cannot be {done}: {e}{lacks}", register=register, code=e.code)

    def _place_of(self, register: str) -> str:
        return f"{self._connected().where}: register {register} (0x{self._register(register).address:04X})"

    def _register(self, name: str) -> ModbusRegister:
        if name not in self._profile.registers:
            raise ProfileError(f"profile {self._profile.name}: no register named '{name}'")
        return self._profile.registers[name]

    def _ordered(self, register: ModbusRegister, raw: bytes) -> bytes:
        """Converts from the most significant byte first to the device's order. The same
        exchange converts back."""
        words = [raw[i : i + 2] for i in range(0, len(raw), 2)]
        is_text = register.type == ASCII  # which has characters in order, not words
        if (register.word_order or self._profile.word_order) == "little" and not is_text:
            words.reverse()
        if (register.byte_order or self._profile.byte_order) == "little":
            words = [w[::-1] for w in words]
        return b"".join(words)[: size_of(register)]

    def _connected(self) -> ModbusClient:
        if self._client is None:
            raise BusError("the device is not open")
        return self._client


def _function(register: ModbusRegister) -> int:
    return READ_INPUT if register.table == "input" else READ_HOLDING


def _cause(e: DeviceSilent) -> str:
    return str(e).partition(": ")[2]
