"""A model of a device with two calibration registers, and of the line to it, in which chosen faults strike.

Small enough that a provisioning takes some milliseconds: `test_orders_of_faults` goes through all orders of faults.
It shares no code with the drivers or with `tests.devices`.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from triaxcal_drivers.errors import DeviceSilent, RegisterRefused
from triaxcal_drivers.profile import Bundle, Profile, Register
from triaxcal_drivers.two_senders import ExtraAnswer
from triaxcald.provision.access import Clock

Fault = Literal[
    "lost", "duplicated", "late", "torn", "reverted on lock", "ignored", "forgotten", "second unit answers", "flipped"
]  # fmt: skip
FAULTS: tuple[Fault, ...] = (
    "lost", "duplicated", "late", "torn", "reverted on lock", "ignored", "forgotten", "second unit answers",
)  # fmt: skip
Operation = Literal["unlock", "write", "store", "lock", "reset", "read"]
REGISTERS = ("bias_x", "bias_y")
OLD = {"bias_x": b"\x00\x10", "bias_y": b"\x00\x20"}
NEW = {"bias_x": b"\x01\x11", "bias_y": b"\x01\x22"}
OTHERS = {"bias_x": b"\x03\x33", "bias_y": b"\x03\x44"}
"""What a second unit holds."""
KEY, STORE, RESET = b"\xc0\xde", b"\x00\x01", b"\x00\x02"
SERIAL, SECOND_SERIAL = 777, 888
TIMEOUT_S, REQUEST_S, SECOND_S = 0.1, 0.001, 0.04
STRIKES: dict[Fault, tuple[Operation, ...]] = {
    "torn": ("store",),
    "flipped": ("store",),
    "reverted on lock": ("lock",),
    "ignored": ("unlock", "write", "store", "lock", "reset"),
    "forgotten": ("store",),
}
"""Operations at which a fault of the device can strike; a fault of the line can strike at any."""
HABITS: tuple[Fault, ...] = ("reverted on lock", "forgotten")
"""Faults that go on once they have struck. What was ignored is ignored again, if it comes again."""


@dataclass(frozen=True)
class Kind:
    """Which commands a device has."""

    store: bool = True
    reset: bool = True
    counter: bool = True
    lock: bool = True


def bundle_of(kind: Kind) -> Bundle:
    registers: dict[str, dict[str, Any]] = {
        "serial_number": {"type": "uint16", "role": "serial_number", "access": "ro"},
        "unlock_key": {"type": "uint16", "access": "wo"},
        "store": {"type": "uint16", "access": "wo"},
        "reset": {"type": "uint16", "access": "wo"},
        "bias_x": {"type": "uint16", "role": "bias.x"},
        "bias_y": {"type": "uint16", "role": "bias.y"},
    }
    if kind.counter:
        registers["write_counter"] = {"type": "uint16", "role": "write_counter", "access": "ro"}
    sequences: dict[str, Any] = {}
    if kind.lock:
        sequences["unlock"] = ({"write": "unlock_key", "value": 0xC0DE},)
        sequences["lock"] = ({"write": "unlock_key", "value": 0},)
    if kind.store:
        sequences["store"] = ({"write": "store", "value": 1},)
    if kind.reset:
        sequences["reset"] = ({"write": "reset", "value": 2}, {"reconnect": True, "timeout_s": 1.0})
    profile = Profile.model_validate(
        {
            "format": "triaxcal.profile/1",
            "name": "model",
            "driver": "model",
            "identity": {"vendor": "none", "product": "model", "serial_register": "serial_number"},
            "output": {"unit": "V"},
            "sampling": {"rate_hz": 100.0},
            "streams": {"readings": {}},
            "registers": {name: Register(**entry) for name, entry in registers.items()},
            "sequences": sequences,
        }
    )
    return Bundle(profile, repr(kind).encode())


class Silent(Exception):
    """No answer comes."""


class Refused(Exception):
    """The device is locked."""


@dataclass
class Unit:
    """``eeprom`` is the truth; ``shadow`` what the device believes to be stored, and falls back to when it drops
    what was not."""

    kind: Kind
    serial: int
    eeprom: dict[str, bytes]
    counter: int = 5
    habits: set[str] = field(default_factory=set)
    writes: int = 0

    def __post_init__(self) -> None:
        self.start()

    def start(self) -> None:
        self.ram, self.shadow = dict(self.eeprom), dict(self.eeprom)
        self.locked = self.kind.lock

    def read(self, register: str) -> bytes:
        if register in self.ram:
            return self.ram[register]
        return {"serial_number": self.serial, "write_counter": self.counter}[register].to_bytes(2, "big")

    def write(self, register: str, raw: bytes, fault: Fault | None) -> None:
        """Raises Refused, Silent."""
        if fault == "ignored":
            self.habits.add(f"ignores {register} {raw.hex()}")
        elif fault in HABITS:
            self.habits.add(fault)
        if f"ignores {register} {raw.hex()}" in self.habits:
            return
        if register == "unlock_key":
            if raw != KEY and "reverted on lock" in self.habits:
                self.ram = dict(self.shadow)
            self.locked = raw != KEY
        elif register == "reset":
            self.start()
        elif self.locked:
            raise Refused
        elif register == "store":
            self._store(fault)
        else:
            self.writes += 1
            self.ram[register] = raw
            if not self.kind.store:
                self._store(fault)

    def _store(self, fault: Fault | None) -> None:
        self.counter += 1
        self.shadow = dict(self.ram)
        if fault == "torn":  # the counter first; the supply fails in the midst, and the device starts from that
            self.eeprom["bias_x"] = self.ram["bias_x"]
            self.start()
            raise Silent
        if "forgotten" not in self.habits:
            self.eeprom = dict(self.ram)
        if fault == "flipped":  # the bit by which the first probe differs
            self.eeprom["bias_x"] = bytes([self.ram["bias_x"][0], self.ram["bias_x"][1] ^ 1])


class ModelDevice:
    """``faults`` strike in their order, each at its next operation after the one before; ``at`` says at which one of
    those, counted from 0."""

    def __init__(self, kind: Kind, faults: Sequence[Fault], at: Sequence[int] = ()) -> None:
        self.kind = kind
        self.unit = Unit(kind, SERIAL, dict(OLD))
        self.second: Unit | None = None
        self.now_s = 0.0
        self._faults = deque(zip(faults, (*at, *[0] * len(faults)), strict=False))
        self._passed = 0
        self._extra: list[tuple[float, ExtraAnswer]] = []

    @property
    def struck_all(self) -> bool:
        return not self._faults

    def calm(self) -> None:
        """From now on nothing strikes, and the second unit is gone. What the device does by habit it goes on doing."""
        self._faults.clear()
        self.second = None
        self._extra.clear()

    @property
    def clock(self) -> Clock:
        return Clock(self._sleep, lambda: self.now_s)

    async def _sleep(self, seconds: float) -> None:
        self.now_s += max(seconds, 0.0)

    async def open(self) -> None: ...

    async def close(self) -> None:
        self._extra.clear()

    def stream(self, names: Sequence[str]) -> AsyncIterator[Any]:
        raise NotImplementedError

    async def listen(self, seconds: float) -> list[ExtraAnswer]:
        self.now_s += seconds
        due = [extra for at_s, extra in self._extra if at_s <= self.now_s]
        self._extra = [e for e in self._extra if e[0] > self.now_s]
        return due

    async def read(self, register: str) -> bytes:
        return await self._ask(register, "read", lambda unit, fault: unit.read(register))

    async def write(self, register: str, raw: bytes, *, timeout_s: float | None = None) -> None:
        operation: Operation = "write"
        if register == "unlock_key":
            operation = "unlock" if raw == KEY else "lock"
        elif register in ("store", "reset"):
            operation = register  # type: ignore[assignment]

        def carry_out(unit: Unit, fault: Fault | None) -> bytes:
            unit.write(register, raw, fault)
            return b""

        await self._ask(register, operation, carry_out)

    def _strikes(self, operation: Operation) -> Fault | None:
        if not self._faults:
            return None
        fault, passes = self._faults[0]
        stores = operation == "store" or (not self.kind.store and operation == "write")
        applies = stores if STRIKES.get(fault) == ("store",) else operation in STRIKES.get(fault, (operation,))
        if not applies:
            return None
        if self._passed < passes:
            self._passed += 1
            return None
        self._faults.popleft()
        self._passed = 0
        return fault

    async def _ask(
        self, register: str, operation: Operation, carry_out: Callable[[Unit, Fault | None], bytes]
    ) -> bytes:
        self.now_s += REQUEST_S
        fault = self._strikes(operation)
        if fault == "second unit answers":
            self.second = Unit(self.kind, SECOND_SERIAL, dict(OTHERS))
        if fault == "lost":
            await self._silence(register)
        answers = [self._answer(self.unit, fault, carry_out)]
        if fault == "duplicated":
            answers.append(self._answer(self.unit, None, carry_out))
        if self.second is not None:
            answers.append(self._answer(self.second, None, carry_out))
        answers = [a for a in answers if a is not None]
        if fault == "late" or not answers:
            await self._silence(register)
        first, *further = answers
        assert first is not None
        self._extra += [(self.now_s + SECOND_S, ExtraAnswer(register, a or b"", first)) for a in further]
        if first == b"refused":
            raise RegisterRefused("locked", register=register, code=1)
        return first

    def _answer(
        self, unit: Unit, fault: Fault | None, carry_out: Callable[[Unit, Fault | None], bytes]
    ) -> bytes | None:
        try:
            return carry_out(unit, fault)
        except Refused:
            return b"refused"
        except Silent:
            return None

    async def _silence(self, register: str) -> None:
        self.now_s += TIMEOUT_S
        await asyncio.sleep(0)
        raise DeviceSilent(f"no reply from register {register}")
