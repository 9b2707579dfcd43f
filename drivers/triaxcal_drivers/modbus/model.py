"""What a profile says of a Modbus device, and where such a device is found."""

from __future__ import annotations

import itertools
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

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


def words_of(type_: str) -> int:
    """Registers of 16 bits that a value of that type takes."""
    return TYPES[type_].size // WORD


class Channel(Strict):
    """A number in a reply or record; the value is ``raw * scale + offset``."""

    word: Annotated[Word, Field(description="first word, counted from the start of the reply or record")]
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


class Counter(Strict):
    """A sample counter; it wraps at 2^bits."""

    word: Annotated[Word, Field(description="its word in the block or record")]
    type: Annotated[CounterType, Field(description="its type")]
    bits: Annotated[int | None, Field(ge=4, le=32, description="where fewer than the type has")] = None

    @property
    def modulus_bits(self) -> int:
        return self.bits or 8 * TYPES[self.type].size


class TimeStamp(Strict):
    """The device's time of a sample, in ticks of ``unit_s``; it wraps with its
    type."""

    word: Annotated[Word, Field(description="its word in the block or record")]
    type: Annotated[TimeType, Field(description="its type")]
    unit_s: Annotated[float, Field(gt=0, description="seconds a tick: 1e-6, 0.001…")]


class _Stream(Strict):
    table: Annotated[Table, Field(description="registers that are read: input or holding")] = "input"
    address: Annotated[Address, Field(description="first register, from 0 as on the wire")]
    poll_period_s: Annotated[float, Field(ge=0, le=60, description="from one read to the next")]
    channels: Annotated[
        dict[str, Channel],
        Field(max_length=CHANNELS_MOST, description="ux, uy and uz; any further ones by their names"),
    ]
    counter: Annotated[Counter | None, Field(description="sample counter: tells missing and repeated samples")] = None
    time_stamp: Annotated[TimeStamp | None, Field(description="the device's time of a sample")] = None

    @model_validator(mode="after")
    def _has_axes(self) -> Self:
        for name in READING_CHANNELS:
            if name not in self.channels:
                raise ValueError(f"channels.{name} is missing: channels must have ux, uy and uz")
        return self

    @property
    def function(self) -> int:
        """The function code that reads it."""
        return READ_INPUT if self.table == "input" else READ_HOLDING

    def _fields(self) -> dict[str, Channel | Counter | TimeStamp]:
        fields: dict[str, Channel | Counter | TimeStamp] = {
            f"channels.{name}": channel for name, channel in self.channels.items()
        }
        if self.counter:
            fields["counter"] = self.counter
        if self.time_stamp:
            fields["time_stamp"] = self.time_stamp
        return fields

    @property
    def _span(self) -> int:
        """Words from the start of a record to the end of its last field."""
        return max(f.word + words_of(f.type) for f in self._fields().values())


class PollStream(_Stream):
    """A block of registers that holds the newest sample; read once a poll
    period."""

    layout: Annotated[Literal["poll"], Field(description="poll: a block with the newest sample")]

    @property
    def words(self) -> int:
        return self._span

    def reads_per_s(self, rate_hz: float) -> float:
        """A read for each sample, and none more often than the poll period
        says."""
        return min(rate_hz, 1 / self.poll_period_s) if self.poll_period_s else rate_hz


class FifoHeader(Strict):
    """Words at the start of a FIFO window."""

    count: Annotated[Word, Field(description="word that holds the number of records in this window")]
    remaining: Annotated[Word | None, Field(description="word: records left in the device after it")] = None
    lost: Annotated[Word | None, Field(description="word: samples lost to overflow so far; wraps")] = None


class FifoStream(_Stream):
    """A window on the device's FIFO; reading it takes the records out."""

    layout: Annotated[Literal["fifo"], Field(description="fifo: a window on a FIFO")]
    header: FifoHeader
    record_start: Annotated[Word, Field(description="word at which the first record begins")]
    record_words: Annotated[int, Field(ge=3, le=MAX_READ_WORDS, description="words of a record")]
    record_capacity: Annotated[int, Field(ge=1, le=MAX_READ_WORDS, description="records in a window")]

    @model_validator(mode="after")
    def _fits(self) -> Self:
        for name, field in self._fields().items():
            if field.word + words_of(field.type) > self.record_words:
                raise ValueError(f"{name} reaches past the record's {self.record_words} words")
        for name, word in self.header.model_dump().items():
            if word is not None and word >= self.record_start:
                raise ValueError(f"header.{name} = {word} lies in the records, which start at {self.record_start}")
        return self

    @property
    def words(self) -> int:
        return self.record_start + self.record_words * self.record_capacity

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
        for name, stream in self.streams.items():
            if stream.words > self.max_read_words:
                raise ValueError(
                    f"streams.{name} takes {stream.words} words, more than one read gives "
                    f"(max_read_words {self.max_read_words})"
                )
            if stream.address + stream.words > 0x10000:
                raise ValueError(f"streams.{name}: {stream.words} words from {stream.address} leave the table")
        for name, register in self.registers.items():
            if register.words > (self.max_read_words if register.access == "ro" else self._most_words):
                raise ValueError(f"registers.{name}: {register.type} is longer than one request may be")
        self._require_apart()
        sources = [(s.function, s.address) for s in self.streams.values()]
        if len(set(sources)) < len(sources):
            raise ValueError("streams: two of them start at the same address")
        return self

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
