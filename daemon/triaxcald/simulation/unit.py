"""The reference unit TRIAX-REF, simulated: converter, registers, correction.
Pure; time is an argument."""

from __future__ import annotations

import asyncio
import math
import struct
import zlib
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from enum import IntFlag
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

import triaxcal_drivers as td
from triaxcald.abort import at_abort
from triaxcald.errors import InputError
from triaxcald.files import require_writable, write_bytes

# What the simulated unit's sensor sees: voltages and a temperature as functions of
# time.


class Physics(Protocol):
    def sample(self, unit_time_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The sensor's output (n, 3) in V before the converter, and its
        temperature (n,) in °C.

        Times are in the unit's time base, ascending, each asked for once.
        """

    def restarted(self, unit_time_s: float) -> None:
        """The unit starts again, as after its registers were written."""


@dataclass(frozen=True)
class ConstantPhysics:
    """The same voltages [V] and temperature [°C] for ever."""

    volts: tuple[float, float, float] = (0.0, 0.0, -2.4)
    temperature_c: float = 25.0

    def sample(self, unit_time_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        n = len(unit_time_s)
        return np.tile(np.array(self.volts, dtype=np.float64), (n, 1)), np.full(n, self.temperature_c)

    def restarted(self, unit_time_s: float) -> None:
        """It stands where it stood."""


# The reference unit's registers as data, and its memory: the RAM copy in use and
# the stored copy.

Access = Literal["ro", "rw", "wo"]

VENDOR_ID, PRODUCT_CODE, FIRMWARE_VERSION = 0x54524941, 0x7A01, 0x00010000
UNLOCK, LOCK, SAVE, RESTART = 0x5A17, 0, 0x65766173, 0xB007


@dataclass(frozen=True)
class Entry:
    type: Literal["uint16", "uint32", "float32"]
    access: Access

    @property
    def size(self) -> int:
        return td.registers.TYPES[self.type].size

    def encode(self, value: float) -> bytes:
        """Most significant byte first."""
        if self.type == "float32":
            return struct.pack(">f", value)
        return int(value).to_bytes(self.size, "big")

    def decode(self, raw: bytes) -> float:
        if self.type == "float32":
            return float(struct.unpack(">f", raw)[0])
        return int.from_bytes(raw, "big")


_PER_AXIS = (*td.roles.LINEAR, "second_order", "temperature_bias", "temperature_scale_factor")

CRC = "calibration_crc"
COVERED = (*(f"{name}_{axis}" for name in _PER_AXIS for axis in td.roles.AXES),
           "reference_temperature", "calibration_date")  # fmt: skip
"""The calibration registers that the checksum covers, in its order."""
CALIBRATION = (*COVERED, CRC)

_INTEGERS: dict[str, Literal["uint16", "uint32"]] = {"calibration_date": "uint32", CRC: "uint16"}

TABLE: Mapping[str, Entry] = {
    "vendor_id": Entry("uint32", "ro"),
    "product_code": Entry("uint32", "ro"),
    "firmware_version": Entry("uint32", "ro"),
    "serial_number": Entry("uint32", "ro"),
    "status": Entry("uint16", "ro"),
    "write_counter": Entry("uint32", "ro"),
    "unlock_key": Entry("uint16", "wo"),
    "store": Entry("uint32", "wo"),
    "reset": Entry("uint16", "wo"),
    **{name: Entry(_INTEGERS.get(name, "float32"), "rw") for name in CALIBRATION},
    **{"stored_" + name: Entry(_INTEGERS.get(name, "float32"), "ro") for name in CALIBRATION},
}
"""Every register of the unit by name; ``stored_`` + name mirrors the stored
copy."""


def checksum(copy: Mapping[str, bytes]) -> bytes:
    """The calibration_crc that belongs to a copy of the calibration registers,
    as raw bytes."""
    return td.registers.crc("crc-16/modbus", b"".join(copy[name] for name in COVERED)).to_bytes(2, "big")


def factory_calibration() -> dict[str, bytes]:
    """The nominal scale factor and the reference temperature; nothing else,
    dated 1970-01-01."""
    values = {f"{td.roles.SCALE_FACTOR}_{axis}": -2.4 for axis in td.roles.AXES} | {"reference_temperature": 25.0}
    copy = {name: TABLE[name].encode(values.get(name, 0.0)) for name in COVERED}
    return copy | {CRC: checksum(copy)}


@dataclass(frozen=True)
class Stored:
    """The stored copy: calibration registers as raw bytes, times stored, and
    whether it was read whole."""

    calibration: Mapping[str, bytes]
    write_counter: int = 0
    intact: bool = True

    @property
    def valid(self) -> bool:
        return self.intact and checksum(self.calibration) == self.calibration[CRC]

    def image(self) -> bytes:
        """The bytes of the EEPROM: calibration registers in order, write
        counter, CRC-32 over both."""
        body = b"".join(self.calibration[name] for name in CALIBRATION) + self.write_counter.to_bytes(4, "big")
        return body + zlib.crc32(body).to_bytes(4, "big")

    @staticmethod
    def from_image(image: bytes) -> Stored:
        """What the unit finds at start-up. An image that is damaged, or of
        another length, is not intact."""
        sizes = [TABLE[name].size for name in CALIBRATION]
        expected = sum(sizes) + 8
        whole = image[:expected].ljust(expected, b"\xff")  # an erased cell reads as ones
        copy, at = {}, 0
        for name, size in zip(CALIBRATION, sizes, strict=True):
            copy[name] = whole[at : at + size]
            at += size
        intact = len(image) == expected and zlib.crc32(whole[:-4]).to_bytes(4, "big") == whole[-4:]
        return Stored(copy, int.from_bytes(whole[at : at + 4], "big"), intact)


FULL_SCALE_V, FULL_SCALE_COUNTS = 10.0, 2**23
INVALID_CORRECTED = -(2**31)
"""The corrected output of a unit whose stored calibration is damaged; on CAN it
is sent as 0x800000."""
STORE_S, RESTART_S = 0.05, 0.1
_DUE_S = 1e-9  # a sample is due this early, so that rounding of k/rate does not put it off

FaultKind = Literal["unknown", "read_only", "write_only", "locked", "bad_value"]


class Status(IntFlag):
    UNLOCKED = 1
    CRC_INVALID = 2
    OVER_RANGE = 4
    NOT_STORED = 8
    BUSY = 16


class RegisterFault(Exception):
    """The unit refuses a read or a write; ``kind`` says why, the transport says
    it in its own code."""

    def __init__(self, kind: FaultKind, register: str) -> None:
        super().__init__(f"{register}: {kind}")
        self.kind = kind
        self.register = register


class UnitSilent(Exception):
    """The unit does not answer: it restarts or is dead. The transport sends no
    reply."""


@dataclass(frozen=True)
class Faults:
    """Faults that a real unit can have.

    ``refuse_registers``: writes to them are refused. ``forget_store``: a store
    is acknowledged and the stored copy stays as it was. ``corrupt_write``: the
    low byte of that register is xor-ed when it is written. ``die_at_s``: from
    that unit time on it is silent for ever. ``die_on_write``: likewise on a
    write to that register, which is not carried out.
    """

    refuse_registers: frozenset[str] = frozenset()
    forget_store: bool = False
    corrupt_write: Mapping[str, int] = field(default_factory=dict)
    die_at_s: float | None = None
    die_on_write: str | None = None


@dataclass(frozen=True)
class SampleRun:
    """Samples in order. ``counter`` (n,) wraps at 2^16; ``unit_time_s`` (n,);
    ``counts`` (n, 3) of the converter, 24 bit; ``temperature_raw`` (n,) in 0.01
    °C; ``corrected`` (n, 3) in 1e-6 g, INVALID_CORRECTED where the calibration
    is damaged, else within ±(2^31 − 1); ``status`` (n,) of `Status`."""

    counter: NDArray[np.uint16]
    unit_time_s: NDArray[np.float64]
    counts: NDArray[np.int32]
    temperature_raw: NDArray[np.int16]
    corrected: NDArray[np.int32]
    status: NDArray[np.uint16]

    def __len__(self) -> int:
        return len(self.counter)


class ReferenceUnit:
    """Powered up and running since ``lower_time_s``, where sample 0 is taken;
    ``stored`` is an `eeprom`.

    Every time given is in the unit's time base and not before an earlier one. A
    write acts on the samples of the next `advance`: call it first where those
    before the write are wanted with the old registers. Samples not fetched
    before a restart are lost.
    """

    def __init__(
        self,
        physics: Physics,
        *,
        serial_number: int,
        stored: bytes | None = None,
        rate_hz: float = 100.0,
        lower_time_s: float = 0.0,
        faults: Faults | None = None,
    ) -> None:
        self.physics = physics
        self.serial_number = serial_number
        self.rate_hz = rate_hz
        self.faults = faults or Faults()
        self._stored = Stored(factory_calibration()) if stored is None else Stored.from_image(stored)
        self._died_s = math.inf if self.faults.die_at_s is None else self.faults.die_at_s
        self._start(lower_time_s)

    def _start(self, unit_time_s: float) -> None:
        self._started_s = unit_time_s
        if unit_time_s > 0:
            self.physics.restarted(unit_time_s)
        self._ram = dict(self._stored.calibration)
        self._damaged = not self._stored.valid
        self._unlocked = False
        self._storing: tuple[float, Stored] | None = None
        self._next = 0
        self._over_range = False

    @property
    def started_s(self) -> float:
        """Unit time of sample 0 since the last start; changes with every
        restart. Infinite while the supply is off."""
        return self._started_s

    @property
    def eeprom(self) -> bytes:
        """What survives a loss of power, as of the last call that named a time."""
        return self._stored.image()

    def alive(self, unit_time_s: float) -> bool:
        """Whether the unit answers: not while it restarts, nor once it is dead."""
        self._settle(unit_time_s)
        return self._started_s <= unit_time_s + _DUE_S and unit_time_s < self._died_s

    def power_cycle(self, unit_time_s: float) -> None:
        """Power goes and comes back: what was not stored by now is lost."""
        self.switch_off(unit_time_s)
        self.switch_on(unit_time_s)

    def switch_off(self, unit_time_s: float) -> None:
        """The supply goes: silent until `switch_on`. What was not stored by now is
        lost."""
        self._settle(unit_time_s)
        self._storing, self._started_s = None, math.inf

    def switch_on(self, unit_time_s: float) -> None:
        """The supply comes; nothing happens where it is there."""
        if self._started_s == math.inf:
            self._start(unit_time_s + RESTART_S)

    def read(self, name: str, unit_time_s: float) -> bytes:
        """A register's raw bytes, most significant first. Raises RegisterFault,
        UnitSilent."""
        if not self.alive(unit_time_s):
            raise UnitSilent
        if name not in TABLE:
            raise RegisterFault("unknown", name)
        entry = TABLE[name]
        if entry.access == "wo":
            raise RegisterFault("write_only", name)
        if name in self._ram:
            return self._ram[name]
        if name.startswith("stored_"):
            return self._stored.calibration[name.removeprefix("stored_")]
        values = {
            "vendor_id": VENDOR_ID,
            "product_code": PRODUCT_CODE,
            "firmware_version": FIRMWARE_VERSION,
            "serial_number": self.serial_number,
            "status": self._status() | Status.OVER_RANGE * self._over_range,
            "write_counter": self._stored.write_counter,
        }
        return entry.encode(values[name])

    def write(self, name: str, raw: bytes, unit_time_s: float) -> None:
        """Write raw bytes, most significant first. Raises RegisterFault,
        UnitSilent."""
        if not self.alive(unit_time_s):
            raise UnitSilent
        if name not in TABLE:
            raise RegisterFault("unknown", name)
        entry = TABLE[name]
        if entry.access == "ro":
            raise RegisterFault("read_only", name)
        if name == self.faults.die_on_write:
            self._died_s = unit_time_s
            raise UnitSilent
        if name in self.faults.refuse_registers or (name in ("store", *CALIBRATION) and not self._unlocked):
            raise RegisterFault("locked", name)
        if len(raw) != entry.size:
            raise RegisterFault("bad_value", name)
        if name in self._ram:
            self._write_calibration(name, raw)
        else:
            self._command(name, int.from_bytes(raw, "big"), unit_time_s)

    def _write_calibration(self, name: str, raw: bytes) -> None:
        if not math.isfinite(TABLE[name].decode(raw)):
            raise RegisterFault("bad_value", name)
        self._ram[name] = raw[:-1] + bytes([raw[-1] ^ self.faults.corrupt_write.get(name, 0)])

    def _command(self, name: str, value: int, unit_time_s: float) -> None:
        if name == "unlock_key" and value in (UNLOCK, LOCK):
            self._unlocked = value == UNLOCK
        elif name == "reset" and value == RESTART:
            self.power_cycle(unit_time_s)
        elif name == "store" and value == SAVE:
            if self._storing:  # refused for the state it is in, like a write while locked
                raise RegisterFault("locked", name)
            if checksum(self._ram) != self._ram[CRC]:
                raise RegisterFault("bad_value", name)
            counter = (self._stored.write_counter + 1) % 2**32
            self._storing = (unit_time_s + STORE_S, Stored(dict(self._ram), counter))
        else:
            raise RegisterFault("bad_value", name)

    def _settle(self, unit_time_s: float) -> None:
        """Carry out what has come due: the end of a store, if the unit lived to
        see it."""
        if self._storing and self._storing[0] <= min(unit_time_s, self._died_s) + _DUE_S:
            if not self.faults.forget_store:
                self._stored = self._storing[1]
            self._storing = None

    def _status(self) -> int:
        return (
            Status.UNLOCKED * self._unlocked
            | Status.CRC_INVALID * self._damaged
            | Status.NOT_STORED * (self._ram != self._stored.calibration)
            | Status.BUSY * (self._storing is not None)
        )

    def advance(self, unit_time_s: float) -> SampleRun:
        """All samples due since the last call; none while the unit restarts or has no
        supply, or once it is dead."""
        self._settle(unit_time_s)
        if self._started_s == math.inf:
            return self._take(np.arange(0))
        last_s = min(unit_time_s + _DUE_S, math.nextafter(self._died_s, -math.inf))
        due = max(self._next, math.floor((last_s - self._started_s) * self.rate_hz) + 1)
        counter = np.arange(self._next, due, dtype=np.int64)
        self._next = due
        return self._take(counter)

    def _take(self, counter: NDArray[np.int64]) -> SampleRun:
        time_s = self._started_s + counter / self.rate_hz
        volts, temperature_c = self.physics.sample(time_s)
        exact = np.rint(volts * (FULL_SCALE_COUNTS / FULL_SCALE_V))
        counts = np.clip(exact, -FULL_SCALE_COUNTS, FULL_SCALE_COUNTS - 1).astype(np.int32)
        temperature_raw = np.clip(np.rint(temperature_c * 100), -(2**15), 2**15 - 1).astype(np.int16)
        over = (exact != counts).any(axis=1)
        if len(over):
            self._over_range = bool(over[-1])
        status = np.where(over, int(Status.OVER_RANGE), 0) | self._status()
        return SampleRun(
            (counter % 2**16).astype(np.uint16),
            time_s,
            counts,
            temperature_raw,
            self._corrected(counts, temperature_raw),
            status.astype(np.uint16),
        )

    def _corrected(self, counts: NDArray[np.int32], temperature_raw: NDArray[np.int16]) -> NDArray[np.int32]:
        """What the unit's firmware makes of its own readings, from the RAM
        registers; (n, 3) in 1e-6 g."""
        if self._damaged:
            return np.full(counts.shape, INVALID_CORRECTED, dtype=np.int32)
        with np.errstate(all="ignore"):  # registers may hold nonsense, a scale factor of 0 included
            dT = temperature_raw[:, None] / 100 - TABLE["reference_temperature"].decode(
                self._ram["reference_temperature"]
            )
            v = counts * (FULL_SCALE_V / FULL_SCALE_COUNTS) / self._axes(td.roles.SCALE_FACTOR)
            v -= self._axes(td.roles.BIAS) + self._axes("temperature_bias") * dT
            s = v
            for _ in range(4):
                s = (v - self._axes("second_order") * s**2) / (1 + self._axes("temperature_scale_factor") * dT)
            ax, ay, az = self._axes(td.roles.MISALIGNMENT)
            # R = [[1, az, ay], [0, 1, ax], [0, 0, 1]], solved from below
            z = s[:, 2]
            y = s[:, 1] - ax * z
            x = s[:, 0] - az * y - ay * z
            micro_g = np.rint(np.stack([x, y, z], axis=1) * 1e6)
            limit = 2**31 - 1
            limited: NDArray[np.int32] = np.clip(np.nan_to_num(micro_g, nan=-limit), -limit, limit).astype(np.int32)
        return limited

    def _axes(self, quantity: str) -> NDArray[np.float64]:
        return np.array([TABLE[f"{quantity}_{a}"].decode(self._ram[f"{quantity}_{a}"]) for a in td.roles.AXES])


# The EEPROM of a simulated unit as a file, so that it survives the process.

LOOK_S = 0.05
EEPROM_MOST = 4096
"""Bytes; the unit's has 90. What is longer is somebody's file, and not to be
written over."""


def read_eeprom(path: Path) -> bytes | None:
    """None where there is no such file yet; it must be one that can be written.
    Raises InputError."""
    require_writable(path)
    try:
        return td.files.read_whole(path, EEPROM_MOST)
    except FileNotFoundError:
        return None
    except OSError as e:
        raise InputError(f"{path}: {e.strerror}") from e


def write_eeprom(path: Path, image: bytes) -> None:
    """Whole or not at all. Raises InputError."""
    write_bytes(path, image)


@asynccontextmanager
async def keep_eeprom(unit: ReferenceUnit, path: Path | None) -> AsyncIterator[None]:
    """Writes the unit's EEPROM to ``path`` whenever it changes, until the
    context ends."""
    if path is None:
        yield
        return

    def keep(_: float) -> None:
        with suppress(InputError):
            write_eeprom(path, unit.eeprom)

    task = asyncio.create_task(_follow(unit, path))
    with at_abort(keep):
        try:
            yield
        finally:
            if not task.cancel():
                task.result()
            write_eeprom(path, unit.eeprom)


async def _follow(unit: ReferenceUnit, path: Path) -> None:
    held = read_eeprom(path)
    while True:
        if unit.eeprom != held:
            held = unit.eeprom
            write_eeprom(path, held)
        await asyncio.sleep(LOOK_S)
