"""The electronics of a device: registers, the copy in use, the EEPROM, power. No I/O; time is an argument.

Raw bytes are most significant first. ``now`` is in seconds of any clock that does not go back.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, TypeVar

from tests.devices.eeprom import Eeprom, PowerFailed
from tests.devices.habits import Habits
from tests.devices.table import (
    CHECKSUM,
    FACTORY,
    NINE,
    OLD,
    RESET_COMMAND,
    STORE_COMMAND,
    UNLOCK_KEY,
    Entry,
    calibration_names,
    checksum_of,
    registers_of,
)

T = TypeVar("T")
Kind = Literal["read", "write"]
Why = Literal["unknown", "read-only", "write-only", "length", "value", "locked", "busy", "failed"]
UNLOCKED, CHECKSUM_WRONG, NOT_STORED, STORING = 0x01, 0x02, 0x08, 0x10
SERIAL_NUMBER, PRODUCT_CODE = 4711, 0x3A7C


class Silent(Exception):
    """The device does not answer this request."""


class Refused(Exception):
    """The device answers that it will not; ``code`` where it has one of its own, else the transport's."""

    def __init__(self, why: Why, code: int | None = None) -> None:
        super().__init__(why)
        self.why = why
        self.code = code


@dataclass(frozen=True)
class Request:
    """A request that reached the electronics: ``raw`` written or read; ``answer`` "ok", "silent" or why refused."""

    kind: Kind
    register: str
    raw: bytes
    at_s: float
    answer: str


@dataclass(eq=False)
class Electronics:
    """One unit. ``stored`` is what its EEPROM holds at first, `OLD` unless given.

    For judging: ``log`` of the requests that reached it, ``restarts`` after the first start, ``stores`` begun by
    command, ``needless_stores`` among them of what was stored already, ``equal_writes``: directly stored registers
    that were written with what they held.
    """

    habits: Habits = field(default_factory=Habits)
    stored: Mapping[str, bytes] | None = None
    serial_number: int | str = SERIAL_NUMBER
    product_code: int = PRODUCT_CODE

    def __post_init__(self) -> None:
        self.table: dict[str, Entry] = registers_of(self.habits)
        self.names = calibration_names(self.habits)
        self.log: list[Request] = []
        self.equal_writes: list[str] = []
        self.restarts = self.stores = self.needless_stores = 0
        self._offset = {}
        size = 0
        for name in self.names:
            self._offset[name] = size
            size += self.table[name].size
        self.memory = Eeprom(bytearray(self._first_contents()), self.habits.cut_at_byte)
        self._powered, self._back_s, self._up_s = True, math.inf, -math.inf
        self._store_commands = self._reads = 0
        self._asked: dict[str, bytes] = {}  # of the EEPROM since the start: what it is believed to hold
        self._start()

    # The truth.

    @property
    def eeprom(self) -> dict[str, bytes]:
        """The stored bytes by register, as they were at the last request."""
        contents = self.memory.contents
        return {name: bytes(contents[at : at + self.table[name].size]) for name, at in self._offset.items()}

    @property
    def in_use(self) -> dict[str, bytes]:
        """What the device works with, and shows unless it errs in reading."""
        return dict(self._ram)

    def starts_with(self) -> dict[str, bytes]:
        """What would be in use after a power cycle, a store under way having come to its end."""
        twin = copy.copy(self)
        twin.memory, twin._ram, twin._asked = self.memory.twin(), dict(self._ram), dict(self._asked)
        twin.advance(math.inf)
        twin.power_cycle(0.0)
        return twin.in_use

    def holds(self, image: Mapping[str, bytes]) -> bool:
        """Whether `starts_with` is the image."""
        held = self.starts_with()
        return all(held[name] == raw for name, raw in image.items())

    def wear_of(self, register: str) -> int:
        """How often the most written byte of the register was written."""
        return max(self.memory.wear[at] for at in self._span(register))

    @property
    def written(self) -> list[str]:
        """Calibration registers whose writing was acknowledged, in order."""
        return [r.register for r in self.log if r.kind == "write" and r.answer == "ok" and r.register in self._offset]

    @property
    def stored_checksum_matches(self) -> bool:
        held = self.eeprom
        return CHECKSUM not in held or checksum_of(held) == held[CHECKSUM]

    # Power and time.

    def arm(self, cut_at_byte: int | None) -> None:
        """The power is to fail once so many more EEPROM bytes have been written; None: not at all."""
        self.memory.cut_at_byte, self.memory.bytes_written = cut_at_byte, 0

    def power_off(self, now: float) -> None:
        self.advance(now)
        self._lose_power(now)
        self._back_s = math.inf

    def power_on(self, now: float) -> None:
        if not self._powered:
            self._powered = True
            self.restart(now)

    def power_cycle(self, now: float) -> None:
        self.power_off(now)
        self.power_on(now)

    def restart(self, now: float) -> None:
        """A store under way ends where it is."""
        self.advance(now)
        if self._powered:
            self.memory.abandon()
            self._up_s = now + self.habits.restart_s
            self.restarts += 1
            self._start()

    def up(self, now: float) -> bool:
        """Whether it has power and has started."""
        self.advance(now)
        return self._powered and now >= self._up_s

    def advance(self, now: float) -> None:
        """Let time pass: a store goes on, the power comes back."""
        if self.memory.busy:
            try:
                self.memory.program(self._wanted(), now)
            except PowerFailed:
                self._lose_power(now)
            if not self.habits.store_command and self.habits.read_back == "memory":
                held = self.eeprom
                self._ram.update({name: held[name] for name in self._asked})
        if not self._powered and self._back_s <= now < math.inf:
            self.power_on(self._back_s)

    # Registers.

    def read(self, register: str, now: float) -> bytes:
        """Raises Silent, Refused."""
        return self._heard("read", register, b"", now, lambda: self._read(register))

    def write(self, register: str, raw: bytes, now: float) -> float:
        """Gives how many seconds later the answer goes out. Raises Silent, Refused."""
        return self._heard("write", register, raw, now, lambda: self._write(register, raw, now))

    def _heard(self, kind: Kind, register: str, raw: bytes, now: float, carry_out: Callable[[], T]) -> T:
        if not self.up(now):
            raise Silent
        answer = "ok"
        try:
            if self.memory.busy:
                self._refuse_while_storing((kind, register) == ("write", "store"))
            result = carry_out()
            raw = result if isinstance(result, bytes) else raw
        except Refused as e:
            answer = e.why
            raise
        except Silent:
            answer = "silent"
            raise
        finally:
            self.log.append(Request(kind, register, raw, now, answer))
        return result

    def _refuse_while_storing(self, second_store: bool) -> None:
        if self.habits.while_storing == "answers":
            return
        if second_store and self.habits.second_store_spoils:
            self._spoil()
        if self.habits.while_storing == "silent":
            raise Silent
        raise Refused("busy", self.habits.busy_code)

    def _read(self, register: str) -> bytes:
        entry = self._entry(register)
        if entry.access == "wo":
            raise Refused("write-only")
        number = int.from_bytes(self._held(register, entry), "big")
        if register in self.habits.flips:
            number ^= 1 << self.habits.flips[register]
        if register in self.habits.alternates:
            self._reads += 1
            number ^= self._reads % 2
        return number.to_bytes(entry.size, "big")

    def _held(self, register: str, entry: Entry) -> bytes:
        if register in self._offset:
            return self._ram[register]
        if register.startswith("stored_"):
            shown = self._asked if self.habits.read_back == "cached" else {}
            return {**self.eeprom, **shown}[register.removeprefix("stored_")]
        if isinstance(self.serial_number, str) and register == "serial_number":
            return entry.encode(self.serial_number)
        facts: dict[str, Callable[[], int]] = {
            "serial_number": lambda: int(self.serial_number),
            "product_code": lambda: self.product_code,
            "write_counter": lambda: self.memory.jobs_done,
            "status": self._status,
        }
        return facts[register]().to_bytes(entry.size, "big", signed=entry.type == "int64")

    def _status(self) -> int:
        return (
            UNLOCKED * self._unlocked
            | CHECKSUM_WRONG * (not self.stored_checksum_matches)
            | NOT_STORED * (self._ram != self.eeprom)
            | STORING * self.memory.busy
        )

    def _write(self, register: str, raw: bytes, now: float) -> float:
        entry = self._entry(register)
        if entry.access == "ro":
            raise Refused("read-only")
        if len(raw) != entry.size:
            raise Refused("length")
        if register == "unlock_key":
            self._unlocked = int.from_bytes(raw, "big") == UNLOCK_KEY
        elif register == "reset":
            self._reset(raw, now)
        elif not self._unlocked:
            if self.habits.when_locked == "refuses":
                raise Refused("locked")
        elif register == "store":
            return self._store(raw, now)
        else:
            self._take(register, raw, now)
        return 0.0

    def _entry(self, register: str) -> Entry:
        if register not in self.table:
            raise Refused("unknown")
        return self.table[register]

    def _reset(self, raw: bytes, now: float) -> None:
        if int.from_bytes(raw, "big") != RESET_COMMAND:
            raise Refused("value")
        if self.habits.reset_ignored:
            return
        self.restart(now)
        if not self.habits.reset_reply:
            raise Silent

    def _take(self, register: str, raw: bytes, now: float) -> None:
        if register in self.habits.refuses:
            raise Refused("failed")
        if register in self.habits.stuck:
            return
        if self.habits.store_command or self.habits.read_back == "cached":
            self._ram[register] = raw
        if not self.habits.store_command:
            if self.eeprom[register] == raw:
                self.equal_writes.append(register)
            self._asked[register] = raw
            self.memory.append(self._offsets([register]), now, self.habits.store_seconds)
            self._require_power(now)

    def _store(self, raw: bytes, now: float) -> float:
        if int.from_bytes(raw, "big") != STORE_COMMAND:
            raise Refused("value")
        if self.habits.checksum_checked and checksum_of(self._ram) != self._ram[CHECKSUM]:
            raise Refused("value")
        if self.memory.busy and self.habits.second_store_spoils:
            self._spoil()
            return 0.0
        reply = self.habits.reply_to_store(self._store_commands)
        self._store_commands += 1
        if reply in ("ok", "none, done", "busy, done"):
            self._begin_store(now)
        if reply.startswith("none"):
            raise Silent
        if reply.startswith("busy"):
            raise Refused("busy", self.habits.busy_code)
        if reply == "refused":
            raise Refused("failed")
        return self.habits.store_seconds if self.habits.store_blocks else 0.0

    # The EEPROM.

    def _begin_store(self, now: float) -> None:
        self.stores += 1
        self.needless_stores += self._ram == self.eeprom
        self._asked = dict(self._ram)
        self.memory.begin(self._offsets(self.names), now, self.habits.store_seconds, whole=self.habits.atomic_store)
        self._require_power(now)

    def _offsets(self, registers: list[str] | tuple[str, ...]) -> list[int]:
        offsets = [at for name in registers if not self.habits.forgets(name) for at in self._span(name)]
        if self.habits.store_skips_equal:
            wanted = self._wanted()
            offsets = [at for at in offsets if self.memory.contents[at] != wanted[at]]
        return offsets

    def _span(self, register: str) -> range:
        return range(self._offset[register], self._offset[register] + self.table[register].size)

    def _require_power(self, now: float) -> None:
        self.advance(now)
        if not self._powered:
            raise Silent

    def _wanted(self) -> bytes:
        """What is to be in the EEPROM: the copy in RAM as it is now, or what was written directly."""
        source = self._ram if self.habits.store_command else {**self.eeprom, **self._asked}
        return b"".join(source[name] for name in self.names)

    def _spoil(self) -> None:
        for name in self.names[::2]:
            self.memory.contents[self._offset[name] : self._span(name).stop] = self._ram[name]
        self.memory.abandon()

    def _lose_power(self, now: float) -> None:
        self.memory.abandon()
        self._powered = False
        self._back_s = now + self.habits.power_back_s

    def _start(self) -> None:
        wrong = not self.stored_checksum_matches and self.habits.on_wrong_checksum == "factory"
        factory = wrong or (self.habits.resets_to == "factory" and self.restarts > 0)
        self._ram = FACTORY.image(self.habits) if factory else self.eeprom
        self._asked = {}
        self._unlocked = not self.habits.unlock

    def _first_contents(self) -> bytes:
        image = dict(OLD.image(self.habits) if self.stored is None else self.stored)
        if self.habits.stored_checksum_wrong:
            image[CHECKSUM] = bytes(b ^ 0xFF for b in checksum_of({name: image[name] for name in NINE}))
        if self.habits.blank is not None:
            image = {name: bytes([self.habits.blank]) * self.table[name].size for name in self.names}
        return b"".join(image[name] for name in self.names)
