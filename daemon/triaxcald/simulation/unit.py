"""The reference unit TRIAX-REF, simulated: converter, registers, correction.
Pure; time is an argument."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntFlag
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from triaxcald.simulation.memory import (
    CALIBRATION,
    CRC,
    FIRMWARE_VERSION,
    LOCK,
    PRODUCT_CODE,
    RESTART,
    SAVE,
    TABLE,
    UNLOCK,
    VENDOR_ID,
    Stored,
    checksum,
    factory_calibration,
)
from triaxcald.simulation.physics import Physics

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
        restart."""
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
        self._settle(unit_time_s)
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
        """All samples due since the last call; none while the unit restarts or
        once it is dead."""
        self._settle(unit_time_s)
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
            v = counts * (FULL_SCALE_V / FULL_SCALE_COUNTS) / self._axes("scale_factor")
            v -= self._axes("bias") + self._axes("temperature_bias") * dT
            s = v
            for _ in range(4):
                s = (v - self._axes("second_order") * s**2) / (1 + self._axes("temperature_scale_factor") * dT)
            ax, ay, az = self._axes("misalignment")
            # R = [[1, az, ay], [0, 1, ax], [0, 0, 1]], solved from below
            z = s[:, 2]
            y = s[:, 1] - ax * z
            x = s[:, 0] - az * y - ay * z
            micro_g = np.rint(np.stack([x, y, z], axis=1) * 1e6)
            limit = 2**31 - 1
            limited: NDArray[np.int32] = np.clip(np.nan_to_num(micro_g, nan=-limit), -limit, limit).astype(np.int32)
        return limited

    def _axes(self, quantity: str) -> NDArray[np.float64]:
        return np.array([TABLE[f"{quantity}_{a}"].decode(self._ram[f"{quantity}_{a}"]) for a in "xyz"])
