"""What a profile says of a Modbus device, and where such a device is found."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from triaxcal_drivers.claim import Claim, canonical_port
from triaxcal_drivers.modbus.protocol import (
    MAX_READ_WORDS,
    MAX_WRITE_WORDS,
    READ_HOLDING,
    READ_INPUT,
    SerialLine,
    TcpAddress,
)
from triaxcal_drivers.profile import CHANNELS_MOST, READING_CHANNELS, STREAMS_MOST, Profile, Register, Strict
from triaxcal_drivers.registers import (
    ASCII,
    TYPES,
    WORD,
    CounterType,
    TimeType,
    WordType,
    in_words,
    next_in_words,
    size_of,
)

Order = Literal["big", "little"]
Table = Literal["input", "holding"]
Address = Annotated[int, Field(ge=0, le=0xFFFF)]
Word = Annotated[int, Field(ge=0, lt=MAX_READ_WORDS)]
_FUNCTIONS: Mapping[Table, int] = {"input": READ_INPUT, "holding": READ_HOLDING}
LATEST_MOST_S = 86_400.0  # a day: an older value says nothing of a sample
VALUES_MOST, CONDITIONS_MOST = 256, 16  # of a word that says what is valid; of such words


def words_of(type_: str) -> int:
    """Registers of 16 bits that a value of that type takes."""
    return TYPES[type_].size // WORD


@dataclass(frozen=True)
class Read:
    """One request of a stream for ``words`` registers from ``address`` on.

    ``latest_s``: the greatest age [s] of its values; None if each sample needs it.
    ``unrequested`` is the number of registers in it that no field of the profile names.
    """

    function: int
    address: int
    words: int
    latest_s: float | None = None
    unrequested: int = 0

    @property
    def source(self) -> int:
        """Of its replies in a `RawBatch`."""
        return self.function << 16 | self.address

    @property
    def renewed_s(self) -> float:
        """After this time its values are read again: the other half of ``latest_s`` is
        left for requests that fail, and for a busy line."""
        return 0.5 * (self.latest_s or 0.0)


@dataclass(frozen=True)
class Reads:
    """The requests of a stream: those for each sample in their order, and those for
    ``lasting`` values, with ``latest_s``."""

    of_sample: tuple[Read, ...]
    lasting: tuple[Read, ...] = ()


class _Number(Strict):
    """The value is ``raw * scale + offset``."""

    type: Annotated[WordType, Field(description="one of the register types")]
    scale: Annotated[float, Field(description="value = raw * scale + offset")] = 1.0
    offset: Annotated[float, Field(description="value = raw * scale + offset")] = 0.0
    unit: Annotated[str, Field(description="unit of its value")] = ""
    word_order: Annotated[Order | None, Field(description="where it differs from the profile's")] = None

    @model_validator(mode="after")
    def _sound(self) -> Self:
        if self.scale == 0:
            raise ValueError("scale must not be zero")
        return self


class Channel(_Number):
    """A number in a record."""

    word: Annotated[Word, Field(description="of a FIFO: first word, counted from the start of the record")]


class PollChannel(_Number):
    """A number in the block, or at an address of its own."""

    word: Annotated[Address | None, Field(description="of a block: first word, counted from the stream's address")] = (
        None
    )
    address: Annotated[Address | None, Field(description="first register outside the block, in place of word")] = None
    table: Annotated[Table | None, Field(description="of this address, where it differs from the stream's")] = None
    latest_s: Annotated[
        float | None,
        Field(
            gt=0,
            le=LATEST_MOST_S,
            description="greatest age of its value [s]: it is read so often, not with each sample",
        ),
    ] = None

    @model_validator(mode="after")
    def _in_one_place(self) -> Self:
        if (self.word is None) == (self.address is None):
            both = ", not both" if self.word is not None else ""
            raise ValueError(f"give word (counted from the stream's address) or address (from 0 as on the wire){both}")
        if self.table is not None and self.address is None:
            raise ValueError("table is for a channel with an address of its own: give address in place of word")
        return self


class Condition(Strict):
    """A sample counts only if this word holds one of ``values``."""

    word: Annotated[Address, Field(description="its word in the block or record")]
    values: Annotated[
        tuple[Annotated[int, Field(ge=0, le=0xFFFF)], ...],
        Field(
            strict=False,  # a list, which it is once a single condition has been looked for
            min_length=1,
            max_length=VALUES_MOST,
            description="numbers of a valid sample",
        ),
    ] = (1,)
    mask: Annotated[int | None, Field(gt=0, le=0xFFFF, description="bits that count; the others are taken as 0")] = None

    @property
    def type(self) -> WordType:
        return "uint16"

    @model_validator(mode="after")
    def _may_hold(self) -> Self:
        for value in self.values:
            if self.mask is not None and value & ~self.mask:
                raise ValueError(f"values: {value} has bits outside the mask {self.mask:#x}, and is never met")
        return self


def _listed(given: Any) -> Any:
    """A single condition as a list."""
    return [given] if isinstance(given, Mapping) else given


class Counter(Strict):
    """A sample counter; it wraps at 2^bits."""

    word: Annotated[Address, Field(description="its word in the block or record")]
    type: Annotated[CounterType, Field(description="its type")]
    bits: Annotated[int | None, Field(ge=4, le=32, description="where fewer than the type has")] = None

    @property
    def modulus_bits(self) -> int:
        return self.bits or 8 * TYPES[self.type].size


class TimeStamp(Strict):
    """The device's time of a sample, in ticks of ``unit_s``; it wraps with its
    type."""

    word: Annotated[Address, Field(description="its word in the block or record")]
    type: Annotated[TimeType, Field(description="its type")]
    unit_s: Annotated[float, Field(gt=0, description="seconds a tick: 1e-6, 0.001…")]


Part = Channel | PollChannel | Counter | TimeStamp | Condition
"""A field of a stream."""


def latest_s_of(part: Part) -> float | None:
    """Greatest age [s] of its value; None where each sample has its own."""
    return part.latest_s if isinstance(part, PollChannel) else None


class _Stream(Strict):
    table: Annotated[Table, Field(description="registers that are read: input or holding")] = "input"
    address: Annotated[Address, Field(description="first register, from 0 as on the wire")]
    poll_period_s: Annotated[float, Field(ge=0, le=60, description="from one read to the next")]
    channels: Mapping[str, Channel | PollChannel]
    counter: Annotated[Counter | None, Field(description="sample counter: tells missing and repeated samples")] = None
    time_stamp: Annotated[TimeStamp | None, Field(description="the device's time of a sample")] = None
    valid: Annotated[
        tuple[Condition, ...],
        BeforeValidator(_listed, json_schema_input_type=Condition | tuple[Condition, ...]),
        Field(
            strict=False,  # likewise
            max_length=CONDITIONS_MOST,
            description="word, or list of words, by which the unit says that a sample counts; all must hold",
        ),
    ] = ()

    @model_validator(mode="after")
    def _has_axes(self) -> Self:
        for name in READING_CHANNELS:
            if name not in self.channels:
                raise ValueError(f"channels.{name} is missing: channels must have ux, uy and uz")
        return self

    @property
    def function(self) -> int:
        """The function code that reads it."""
        return _FUNCTIONS[self.table]

    def fields(self) -> dict[str, Part]:
        """What the profile names in the replies, by the profile's keys."""
        fields: dict[str, Part] = {f"channels.{name}": channel for name, channel in self.channels.items()}
        if self.counter:
            fields["counter"] = self.counter
        if self.time_stamp:
            fields["time_stamp"] = self.time_stamp
        return fields | {f"valid.{i}": condition for i, condition in enumerate(self.valid)}


class PollStream(_Stream):
    """Registers that hold the newest sample; read once a poll period.

    They are a block, read by one request. With ``max_gap`` it is read in parts: more
    unnamed registers than these are not read, and a part is no longer than one request
    may be.
    """

    layout: Annotated[Literal["poll"], Field(description="poll: registers with the newest sample")]
    channels: Annotated[
        Mapping[str, PollChannel],
        Field(max_length=CHANNELS_MOST, description="ux, uy and uz; any further ones by their names"),
    ]
    max_gap: Annotated[
        int | None,
        Field(
            ge=0,
            lt=MAX_READ_WORDS,
            description="so many registers that nothing here names may be read along between two that are named; "
            "0: none; without it the block is read by one request",
        ),
    ] = None

    @model_validator(mode="after")
    def _axes_are_new(self) -> Self:
        for name in READING_CHANNELS:
            if self.channels[name].latest_s is not None:
                raise ValueError(f"channels.{name}: latest_s is for other channels: each sample has its own ux, uy, uz")
        return self

    @property
    def words(self) -> int:
        """Words from the start of the block to the end of its last field that each
        sample needs."""
        return max(
            (
                field.word + words_of(field.type)
                for field in self.fields().values()
                if field.word is not None and latest_s_of(field) is None
            ),
            default=0,
        )

    def place(self, field: Part) -> tuple[int, int]:
        """Function and address by which a field is read."""
        if isinstance(field, PollChannel) and field.address is not None:
            return _FUNCTIONS[field.table or self.table], field.address
        assert field.word is not None
        return self.function, self.address + field.word

    def reads(self, most_words: int) -> Reads:
        """Parts of a block have at most ``most_words`` words."""
        named: dict[tuple[float | None, int], set[tuple[int, int]]] = {}
        for field in self.fields().values():
            function, start = self.place(field)
            named.setdefault((latest_s_of(field), function), set()).add((start, start + words_of(field.type)))
        reads = []
        for latest_s, function in sorted(named, key=lambda of: (of[0] or 0.0, of[1] != self.function)):
            fields = named[latest_s, function]
            runs = fields
            if self.max_gap is None and latest_s is None and function == self.function:
                inside = {(a, b) for a, b in fields if self.address <= a and b <= self.address + self.words}
                runs = fields - inside | ({(self.address, self.address + self.words)} if inside else set())
            for start, end in _joined(runs, self.max_gap or 0, most_words):
                held = {at for a, b in fields if start <= a and b <= end for at in range(a, b)}
                reads.append(Read(function, start, end - start, latest_s, end - start - len(held)))
        return Reads(
            tuple(read for read in reads if read.latest_s is None),
            tuple(read for read in reads if read.latest_s is not None),
        )

    def reads_per_s(self, rate_hz: float) -> float:
        """A read for each sample, and none more often than the poll period
        says."""
        return min(rate_hz, 1 / self.poll_period_s) if self.poll_period_s else rate_hz


class FifoHeader(Strict):
    """Words at the start of a FIFO window."""

    count: Annotated[Word, Field(description="word that holds the number of records in this window")]
    remaining: Annotated[Word | None, Field(description="word: records left in the device after it")] = None
    lost: Annotated[Word | None, Field(description="word: samples lost to overflow so far; wraps")] = None


def _joined(runs: Iterable[tuple[int, int]], gap: int, most: int) -> list[tuple[int, int]]:
    """Runs of registers from the first one to before the last, in order; those joined
    that have at most ``gap`` registers between them, and ``most`` together."""
    joined: list[tuple[int, int]] = []
    for start, end in sorted(runs):
        if joined and start - joined[-1][1] <= gap and max(end, joined[-1][1]) - joined[-1][0] <= most:
            joined[-1] = joined[-1][0], max(end, joined[-1][1])
        else:
            joined.append((start, end))
    return joined


class FifoStream(_Stream):
    """A window on the device's FIFO; reading it takes the records out."""

    layout: Annotated[Literal["fifo"], Field(description="fifo: a window on a FIFO")]
    channels: Annotated[
        Mapping[str, Channel],
        Field(max_length=CHANNELS_MOST, description="ux, uy and uz; any further ones by their names"),
    ]
    header: FifoHeader
    record_start: Annotated[Word, Field(description="word at which the first record begins")]
    record_words: Annotated[int, Field(ge=3, le=MAX_READ_WORDS, description="words of a record")]
    record_capacity: Annotated[int, Field(ge=1, le=MAX_READ_WORDS, description="records in a window")]

    @model_validator(mode="after")
    def _fits(self) -> Self:
        for name, field in self.fields().items():
            assert field.word is not None  # as of every record
            if field.word + words_of(field.type) > self.record_words:
                raise ValueError(f"{name} reaches past the record's {self.record_words} words")
        for name, word in self.header.model_dump().items():
            if word is not None and word >= self.record_start:
                raise ValueError(f"header.{name} = {word} lies in the records, which start at {self.record_start}")
        return self

    @property
    def words(self) -> int:
        return self.record_start + self.record_words * self.record_capacity

    def reads(self, most_words: int) -> Reads:
        """One, for the window."""
        return Reads((Read(self.function, self.address, self.words),))

    def reads_per_s(self, rate_hz: float) -> float:
        """Of full windows: so many keep the FIFO from filling up."""
        return rate_hz / self.record_capacity


Stream = Annotated[PollStream | FifoStream, Field(discriminator="layout")]


class ModbusRegister(Register):
    table: Annotated[Table, Field(description="holding or input")] = "holding"
    address: Annotated[Address, Field(description="first word, from 0 as on the wire")]
    word_order: Annotated[Order | None, Field(description="where it differs from the profile's")] = None

    byte_order: Annotated[
        Order | None, Field(description="of bytes in a word, where it differs from the profile's")
    ] = None

    @property
    def words(self) -> int:
        """Registers of 16 bits that it takes."""
        return -(-size_of(self) // WORD)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if self.type != ASCII and not in_words(self.type):
            longer = next_in_words(self.type)
            raise ValueError(f"type {self.type} is none of Modbus" + (f": use {longer}" if longer else ""))
        if self.address + self.words > 0x10000:
            raise ValueError(f"address {self.address} leaves no room for {self.type}")
        if self.table == "input" and self.access != "ro":
            raise ValueError('an input register is read-only: set access = "ro"')
        return self


class ModbusProfile(Profile):
    """A Modbus device. Orders: "big" is most significant first, of words in a
    value, of bytes in a word."""

    streams: Annotated[dict[str, Stream], Field(max_length=STREAMS_MOST)]
    registers: dict[str, ModbusRegister] = Field(default_factory=dict)
    word_order: Annotated[Order, Field(description="of words in a value; big: most significant first")] = "big"
    byte_order: Annotated[Order, Field(description="of bytes in a word; big: most significant first")] = "big"
    max_read_words: Annotated[int, Field(ge=1, le=MAX_READ_WORDS, description="most words of a read")] = MAX_READ_WORDS
    max_write_words: Annotated[int, Field(ge=1, le=MAX_WRITE_WORDS, description="most words of a write")] = (
        MAX_WRITE_WORDS
    )
    busy_codes: Annotated[
        tuple[int, ...],
        Field(description="exception codes by which a request is refused for now, and may be repeated"),
    ] = (5, 6)
    single_write: Annotated[bool, Field(description="write registers of one word with function 6, not 16")] = False

    @model_validator(mode="after")
    def _blocks_fit(self) -> Self:
        for name in self.streams:
            self._require_sound_reads(name)
        for name, register in self.registers.items():
            if register.words > (self.max_read_words if register.access == "ro" else self._most_words):
                raise ValueError(f"registers.{name}: {register.type} is longer than one request may be")
        self._require_apart()
        # A reply is told by its function and first address. Lasting values may be for
        # several streams.
        claimed: dict[int, tuple[str, Read]] = {}
        for name in self.streams:
            reads = self.reads(name)
            for read in (*reads.of_sample, *reads.lasting):
                other, theirs = claimed.setdefault(read.source, (name, read))
                if theirs is not read and (theirs.latest_s is None or read.latest_s is None):
                    who = f"streams.{name}: two of its requests" if other == name else "streams: two of them"
                    raise ValueError(f"{who} start at the same address, {read.address} (0x{read.address:04X})")
        return self

    def reads(self, stream: str) -> Reads:
        """The requests of a stream."""
        return self.streams[stream].reads(self.max_read_words)

    def _require_sound_reads(self, name: str) -> None:
        reads = self.reads(name)
        for read in (*reads.of_sample, *reads.lasting):
            if read.words > self.max_read_words:
                parts = "; max_gap = 0 reads it in parts" if read.unrequested else ""
                raise ValueError(
                    f"streams.{name} takes {read.words} words, more than one read gives "
                    f"(max_read_words {self.max_read_words}){parts}"
                )
            if read.address + read.words > 0x10000:
                raise ValueError(f"streams.{name}: {read.words} words from {read.address} leave the table")

    @property
    def _most_words(self) -> int:
        return min(self.max_read_words, self.max_write_words)

    def _require_apart(self) -> None:
        """Words may have several names; two roles in one place are a mistake."""
        placed = sorted((r.table, r.address, name) for name, r in self.registers.items() if r.role)
        for (table, at, one), (other_table, start, other) in itertools.pairwise(placed):
            words = self.registers[one].words
            if table == other_table and start < at + words:
                raise ValueError(
                    f"registers.{other}: address {start} lies in {one}, which takes {words} words from {at} on"
                )


class ModbusBus(Strict):
    """Where the unit is: over TCP at ``host``, or RTU on ``serial_port``."""

    host: Annotated[str | None, Field(pattern=r"^[^\x00]*$")] = None
    port: Annotated[int, Field(ge=0, le=65535, description="0: a simulated unit takes any free one")] = 502
    serial_port: str | None = None
    baudrate: Annotated[int, Field(ge=300, le=4_000_000)] = 19200
    parity: Literal["N", "E", "O"] = "E"
    stopbits: Literal[1, 2] = 1
    unit_id: Annotated[int, Field(ge=0, le=255)] = 1

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if (self.host is None) == (self.serial_port is None):
            raise ValueError(
                'give either host = "…" (Modbus TCP) or serial_port = "…" (RTU)' + (", not both" if self.host else "")
            )
        return self

    @property
    def where(self) -> TcpAddress | SerialLine:
        if self.serial_port is not None:
            return SerialLine(self.serial_port, self.baudrate, self.parity, self.stopbits)
        return TcpAddress(self.host or "", self.port)

    def claim(self) -> Claim:
        """A serial line is one process's; a gateway's units may be different
        processes'."""
        if self.serial_port is not None:
            port = canonical_port(self.serial_port)
            return Claim(f"Modbus unit {self.unit_id} on {port}", serial_port=port)
        return Claim(f"Modbus unit {self.unit_id}, TCP port {self.port}", host=self.host)
