"""What a device does with its memory, well or badly: one knob a line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

StoreReply = Literal["ok", "none, done", "none, not done", "busy, done", "busy, not done", "refused"]
"""How the store command is answered, and whether it is carried out."""


@dataclass(frozen=True)
class Habits:
    """The defaults are a device that does everything right. Times are in seconds of the device's clock."""

    # Which registers there are.
    store_command: bool = True
    """Written registers are in RAM until a store command; False: every write goes straight to the EEPROM."""
    reset_command: bool = True
    """A register restarts the device."""
    unlock: bool = True
    """Calibration and store are refused until a key is written, and again after a restart."""
    when_locked: Literal["refuses", "ignores"] = "refuses"
    """ignores: acknowledged, but nothing is done."""
    counter: bool = False
    """A register counts the stores (of a device without a store command: the writes)."""
    status: bool = True
    """A status register: bit 0 unlocked, 1 stored checksum wrong, 3 RAM differs from EEPROM, 4 storing."""
    mirror: bool = False
    """Read-only registers show the stored copy."""
    checksum: bool = True
    """A register for CRC-16/MODBUS over the nine, most significant byte first; the master writes it."""
    date: bool = False
    """A register for the calibration date, days since 1970-01-01; not under the checksum."""
    roles: tuple[str, ...] = ()
    """In place of the nine: registers of a correction of another form, by their roles."""
    number: Literal["float32", "int32"] = "float32"
    """Type of the nine registers; as int32 in units of 1e-6."""
    serial_type: Literal["uint32", "uint64", "int64", "ascii"] = "uint32"
    """Type of the serial number; "ascii" is text of 12 characters."""
    byte_order: Literal["big", "little"] = "big"
    """Modbus: of the two characters in a register of text."""
    word_order: Literal["big", "little"] = "big"
    """Modbus: the order of the words of a value on the wire."""

    lacks_function: int | None = None
    """Modbus: a function that it does not support."""
    when_lacking: Literal["refuses", "silent"] = "refuses"
    """refuses: by exception 1."""

    # How it stores.
    store_seconds: float = 0.0
    """So long a store takes, byte by byte evenly; without a store command, every write."""
    store_blocks: bool = False
    """The store command is answered only when the store is done."""
    while_storing: Literal["silent", "busy", "answers"] = "answers"
    """What becomes of requests during a store."""
    busy_code: int | None = None
    """Code of a busy answer; None: Modbus exception 6, SDO abort 0x08000022."""
    store_reply: StoreReply | tuple[StoreReply, ...] = "ok"
    """Of each store command; a tuple: of the first, the second and so on, the last for all further ones."""
    second_store_spoils: bool = False
    """A store command during a store ends it with every other register taken."""
    atomic_store: bool = False
    """The stored copy is replaced as a whole by the last byte of a store."""
    store_skips_equal: bool = False
    """A store leaves bytes alone that are equal already."""
    checksum_checked: bool = False
    """A store is refused while the checksum register does not match the RAM."""
    cut_at_byte: int | None = None
    """The power fails once so many EEPROM bytes have been written: 0, on the attempt to write the first."""
    power_back_s: float = math.inf
    """So long after it failed the power comes back by itself; otherwise by `power_on`."""

    # What it takes and shows.
    forget_store: bool | frozenset[str] = False
    """Acknowledged, but the EEPROM keeps the old bytes: of all registers, or of those named."""
    read_back: Literal["memory", "cached"] = "memory"
    """cached: what was written is shown, by mirror and by directly stored registers, though the EEPROM lacks it."""
    refuses: frozenset[str] = frozenset()
    """Registers whose write is refused."""
    stuck: frozenset[str] = frozenset()
    """Registers that acknowledge a write and keep what they hold."""
    flips: Mapping[str, int] = field(default_factory=dict)
    """Registers that read back with that bit flipped; bit 0 is the least significant."""
    alternates: frozenset[str] = frozenset()
    """Registers of which every other read has the lowest bit flipped."""

    # How it starts.
    blank: int | None = None
    """The EEPROM is fresh from the factory: every byte 0xFF, or 0x00."""
    stored_checksum_wrong: bool = False
    """The checksum in the EEPROM at first does not match."""
    on_wrong_checksum: Literal["uses it", "factory"] = "uses it"
    """What a start puts in use where the stored checksum does not match."""
    resets_to: Literal["stored", "factory"] = "stored"
    """What a restart puts in use."""
    restart_s: float = 0.0
    """So long after a restart it answers nothing."""
    reset_reply: bool = True
    """The reset command is acknowledged before the device restarts."""
    reset_ignored: bool = False
    """It is acknowledged, and nothing is done."""

    def __post_init__(self) -> None:
        if not self.checksum and (self.checksum_checked or self.stored_checksum_wrong):
            raise ValueError("checksum_checked and stored_checksum_wrong need a checksum")

    def reply_to_store(self, number: int) -> StoreReply:
        """Of the store command of that number, from 0."""
        replies = (self.store_reply,) if isinstance(self.store_reply, str) else self.store_reply
        return replies[min(number, len(replies) - 1)]

    def forgets(self, register: str) -> bool:
        return register in self.forget_store if isinstance(self.forget_store, frozenset) else self.forget_store
