"""A bench: a reference unit behind an in-memory Device, whose every operation can go wrong."""

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import ClassVar

import pytest

from triaxcal_drivers import registers as codec
from triaxcal_drivers.errors import DeviceAbsent, DeviceSilent, RegisterRefused
from triaxcal_drivers.profile import Bundle, Profile, Register
from triaxcal_drivers.registers import ByteOrder
from triaxcald.audit.differences import Difference
from triaxcald.audit.traffic import Said, Traffic, check
from triaxcald.outcome import registers_told
from triaxcald.provision.access import Clock, RegisterAccess, RegisterLink
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.registers import build_image
from triaxcald.provision.state import Held
from triaxcald.recording import schema
from triaxcald.simulation.unit import (
    CALIBRATION,
    CRC,
    TABLE,
    ConstantPhysics,
    Faults,
    ReferenceUnit,
    RegisterFault,
    Status,
    Stored,
    UnitSilent,
)

LIMITS = {
    "scale_factor": 10.0, "misalignment": 0.1, "bias": 0.5, "second_order": 0.01,
    "temperature_bias": 0.01, "temperature_scale_factor": 0.01,
}  # fmt: skip
ROLES = {"second_order": "second_order_nonlinearity"}


def registers() -> dict[str, Register]:
    held = {}
    for name, entry in TABLE.items():
        if name.startswith("stored_"):
            continue
        quantity, _, axis = name.rpartition("_")
        if quantity in LIMITS:
            limit = LIMITS[quantity]
            held[name] = Register(
                type="float32", role=f"{ROLES.get(quantity, quantity)}.{axis}", minimum=-limit, maximum=limit
            )
        else:
            known = ("reference_temperature", "calibration_date", "calibration_crc", "serial_number", "write_counter")
            held[name] = Register(type=entry.type, access=entry.access, role=name if name in known else None)
    held["reference_temperature"] = Register(
        type="float32", role="reference_temperature", unit="°C", minimum=-40.0, maximum=85.0
    )
    return held


def profile_data() -> dict[str, object]:
    return {
        "format": "triaxcal.profile/1",
        "name": "triax-ref-memory",
        "driver": "memory",
        "identity": {
            "vendor": "TRIAX",
            "product": "TRIAX-REF",
            "serial_register": "serial_number",
            "expect": {"vendor_id": 0x54524941, "product_code": 0x7A01},
        },
        "output": {"unit": "V", "nominal_scale_factor": (-2.4, -2.4, -2.4)},
        "sampling": {"rate_hz": 100.0},
        "streams": {"readings": {}},
        "registers": registers(),
        "sequences": {
            "unlock": ({"write": "unlock_key", "value": 0x5A17}, {"poll": "status", "mask": 1, "until": 1}),
            "store": ({"write": "store", "value": 0x65766173}, {"poll": "status", "mask": 16, "until": 0}),
            "lock": ({"write": "unlock_key", "value": 0}, {"poll": "status", "mask": 1, "until": 0}),
            "reset": ({"write": "reset", "value": 0xB007}, {"reconnect": True}),
        },
        "crc": {"register": "calibration_crc", "algorithm": "crc-16/modbus", "over": tuple(CALIBRATION[:-1])},
    }


class LittleEndianProfile(Profile):
    """A transport that sends the least significant byte first."""

    wire_order: ClassVar[ByteOrder] = "little"


def coefficients(scale: float, step: float) -> dict[str, float]:
    held = {"reference_temperature": 20.0 + scale}
    for i, quantity in enumerate(LIMITS):
        for j, axis in enumerate("xyz"):
            held[f"{ROLES.get(quantity, quantity)}.{axis}"] = step * (1 + 3 * i + j)
    return held | {f"scale_factor.{axis}": scale for axis in "xyz"}


OLD = coefficients(scale=-2.4, step=1e-4)
NEW = coefficients(scale=-2.41, step=2.3e-4)


class MemoryDevice:
    """A Device over a ReferenceUnit; every operation takes 1 ms of unit time, a missing reply 0.2 s.

    ``trouble`` is called with the number of the operation, before it is carried out (``done`` False) and
    after; it may raise. A connection does not survive a restart of the unit, as on the strictest of buses.
    """

    def __init__(self, unit: ReferenceUnit, *, little_endian: bool = False) -> None:
        self.unit = unit
        self.little_endian = little_endian
        self.now_s = 1.0
        self.operations = 0
        self.log: list[tuple[str, str]] = []
        self.dead = False
        self.trouble: Callable[[int, bool], None] = lambda operation, done: None
        self.opens_blindly = False  # as on a bus where opening does not ask the unit
        self._connected_to: float | None = unit.started_s

    async def open(self) -> None:
        await self._operate("open", "")
        if not self.opens_blindly and (self.dead or not self.unit.alive(self.now_s)):
            self.now_s += 0.2
            raise DeviceAbsent("nothing answers")
        self._connected_to = self.unit.started_s

    async def close(self) -> None:
        self._connected_to = None

    async def read(self, register: str) -> bytes:
        await self._operate("read", register)
        raw = self._ask(register, lambda: self.unit.read(register, self.now_s))
        self.trouble(self.operations, True)
        await asyncio.sleep(0)
        return raw[::-1] if self.little_endian else raw

    async def write(self, register: str, raw: bytes, *, timeout_s: float | None = None) -> None:
        await self._operate("write", register)
        big = raw[::-1] if self.little_endian else raw
        self._ask(register, lambda: self.unit.write(register, big, self.now_s))
        self.trouble(self.operations, True)
        await asyncio.sleep(0)

    async def _operate(self, kind: str, register: str) -> None:
        self.now_s += 0.001
        self.operations += 1
        self.log.append((kind, register))
        self.trouble(self.operations, False)
        await asyncio.sleep(0)  # where a cancellation strikes

    def _ask(self, register: str, question):
        if self.dead or self._connected_to != self.unit.started_s:
            self.now_s += 0.2
            raise DeviceSilent(f"no reply from register {register}")
        try:
            return question()
        except UnitSilent:
            self.now_s += 0.2
            raise DeviceSilent(f"no reply from register {register}") from None
        except RegisterFault as e:
            raise RegisterRefused(f"register {register}: {e.kind}", register=register, code=1) from e

    async def sleep(self, seconds: float) -> None:
        self.now_s += seconds
        await asyncio.sleep(0)

    def exchange(self, unit: ReferenceUnit) -> None:
        """Somebody puts another unit in its place."""
        self.unit, self._connected_to = unit, unit.started_s
        self.log.clear()

    @property
    def clock(self) -> Clock:
        return Clock(self.sleep, lambda: self.now_s)

    @property
    def written(self) -> list[str]:
        return [register for kind, register in self.log if kind == "write" and register in CALIBRATION]


@dataclass
class Bench:
    """The unit holds ``old``; ``image`` is the new calibration; ``folder`` is the station's."""

    folder: Path
    little_endian: bool = False
    faults: Faults = field(default_factory=Faults)
    serial_number: int = 7

    def __post_init__(self) -> None:
        model = LittleEndianProfile if self.little_endian else Profile
        self.profile = model.model_validate(profile_data())
        self.bundle = Bundle(self.profile, b"")
        self.old_coefficients, self.old_date_days = OLD, 19_000
        self.image = build_image(self.profile, NEW, date_days=20_000)
        self.old, self.new = self._calibration(OLD, self.old_date_days), self._calibration(NEW, 20_000)
        self.unit = ReferenceUnit(
            ConstantPhysics(),
            serial_number=self.serial_number,
            stored=Stored(self.old, write_counter=3).image(),
            faults=self.faults,
        )
        self.device = MemoryDevice(self.unit, little_endian=self.little_endian)
        self.records: list[RegisterAccess] = []
        self.link = self.connected()
        self.provisioning: Provisioning | None = None

    def connected(self) -> RegisterLink:
        """As a process that has just begun finds the device."""
        return RegisterLink(self.device, self.profile, self.records.append, clock=self.device.clock)

    def _calibration(self, values: dict[str, float], date_days: int) -> dict[str, bytes]:
        raw = build_image(self.profile, values, date_days=date_days).raw
        return {name: raw[name][::-1] if self.little_endian else raw[name] for name in CALIBRATION}

    async def provision(
        self, *, expected_serial: str | None = "0007", dry_run: bool = False, where: str = "the bench", **more
    ) -> Provisioning:
        p = self.provisioning = Provisioning(
            self.link,
            self.bundle,
            self.image,
            unit="left",
            folder=self.folder,
            expected_serial=expected_serial,
            where=where,
            **more,
        )
        started_problem, returned = len(self.records), False
        await p.examine(restart=not dry_run)
        if not dry_run:
            try:
                await p.write()
                returned = True
            finally:
                p.finish()
                self.assert_traffic_shows(p, self.records[started_problem:], aborted=not returned)
        return p

    def assert_traffic_shows(self, p: Provisioning, records: list[RegisterAccess], *, aborted: bool) -> None:
        assert self.differences(p, records, aborted=aborted) == []

    def differences(self, p: Provisioning, records: Sequence[RegisterAccess], *, aborted: bool) -> list[Difference]:
        """Of what the device is said to hold, by the rules of an audit."""
        accesses = [schema.RegisterAccess(0, a.register, a.kind, a.raw, a.error or "", a.unanswered) for a in records]
        traffic = Traffic(accesses, self.profile)
        said = Said(
            before=p.found.raw,
            earlier=p.before.raw if p.carried else None,
            after=None if aborted else p.after.raw,
            image=self.image,
            told=registers_told(p).document(),
            held=p.held,
            forced=True,
            aborted=aborted,
            provisioned=None if aborted else list(p.written),
        )
        return check(traffic, said, f"{self.serial_number:04d}")

    @property
    def held(self) -> Held:
        """What the last provisioning says that the device holds."""
        assert self.provisioning is not None
        return self.provisioning.held

    @property
    def journals(self) -> list[str]:
        """Files in the station's journal."""
        return sorted(path.name for path in self.folder.glob("journal/*"))

    @property
    def stored(self) -> Stored:
        return Stored.from_image(self.unit.eeprom)

    def assert_holds(self, calibration: dict[str, bytes]) -> None:
        """In use, stored, whole and locked."""
        self.assert_stored(calibration)
        at_s = self.device.now_s + 1.0
        assert {name: self.unit.read(name, at_s) for name in CALIBRATION} == calibration
        assert Status(int.from_bytes(self.unit.read("status", at_s), "big")) == 0

    def assert_stored(self, calibration: dict[str, bytes]) -> None:
        assert self.unit.alive(self.device.now_s) in (True, False)  # carries out a store that has come due
        assert self.stored.valid
        assert self.stored.calibration == calibration

    def put_in_ram(self, name: str, value: float) -> None:
        """Somebody tried a value, sealed it, and did not store it."""
        at_s = self.device.now_s
        self.unit.write("unlock_key", bytes.fromhex("5a17"), at_s)
        self.unit.write(name, TABLE[name].encode(value), at_s)
        covered = b"".join(self.unit.read(n, at_s) for n in CALIBRATION[:-1])
        self.unit.write(CRC, codec.crc("crc-16/modbus", covered).to_bytes(2, "big"), at_s)
        self.unit.write("unlock_key", bytes(2), at_s)


@pytest.fixture
def make_bench(tmp_path: Path) -> Callable[..., Bench]:
    return partial(Bench, tmp_path)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)
