"""The whole procedure over the real drivers, against the reference unit on a bus."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.can.driver import CanDriver
from triaxcal_drivers.can.model import CanBus
from triaxcal_drivers.catalogue import load_bundle
from triaxcal_drivers.interface import Device
from triaxcal_drivers.modbus.driver import ModbusDriver
from triaxcal_drivers.profile import Bundle
from triaxcald.errors import ProvisionError
from triaxcald.provision.access import RegisterAccess, RegisterLink
from triaxcald.provision.procedure import Provisioning, restore
from triaxcald.provision.registers import build_image, explain
from triaxcald.provision.state import DeviceState
from triaxcald.simulation.can_unit import CanUnit
from triaxcald.simulation.modbus_unit import ModbusUnit
from triaxcald.simulation.time_base import RealTimeBase
from triaxcald.simulation.unit import ConstantPhysics, Faults, ReferenceUnit, Stored, factory_calibration

COEFFICIENTS = {"scale_factor.x": -2.41, "scale_factor.y": -2.39, "scale_factor.z": -2.405, "bias.x": 0.0125,
                "misalignment.z": 0.002, "temperature_bias.y": 1e-4, "reference_temperature": 23.0}  # fmt: skip


@asynccontextmanager
async def on_can(unit: ReferenceUnit) -> AsyncIterator[tuple[Device, Bundle]]:
    bundle = load_bundle(Path("triax-ref-can"))
    bus = CanBus(interface="virtual", channel="provision", node_id=5)
    async with CanUnit(unit, RealTimeBase(), bus):
        device = CanDriver().device(bundle, bus)
        await device.open()
        yield device, bundle
        await device.close()


@asynccontextmanager
async def on_modbus(unit: ReferenceUnit) -> AsyncIterator[tuple[Device, Bundle]]:
    bundle = load_bundle(Path("triax-ref-modbus"))
    async with ModbusUnit(unit, RealTimeBase()) as served:
        device = ModbusDriver().device(bundle, served.bus)
        await device.open()
        yield device, bundle
        await device.close()


Serve = Callable[[ReferenceUnit], AbstractAsyncContextManager[tuple[Device, Bundle]]]
both = pytest.mark.parametrize("serve", [on_can, on_modbus])


def provisioning(device: Device, bundle: Bundle, folder: Path, record: Any = None) -> Provisioning:
    return Provisioning(
        RegisterLink(device, bundle.profile, record),
        bundle,
        build_image(bundle.profile, COEFFICIENTS, date_days=20_000),
        unit="left",
        folder=folder,
        expected_serial="0007",
        where="the bench",
    )


def reference_unit(faults: Faults | None = None) -> ReferenceUnit:
    return ReferenceUnit(ConstantPhysics(), serial_number=7, faults=faults)


@both
async def test_a_calibration_arrives_over_the_bus_and_can_be_undone(tmp_path: Path, serve: Serve) -> None:
    unit = reference_unit()
    async with serve(unit) as (device, bundle):
        p = provisioning(device, bundle, tmp_path)
        await p.examine()
        await p.write()
        assert dict(p.after.raw) == p.image.raw
        rows = {row.register: row for row in explain(bundle, p.after)}
        assert rows["calibration_crc"].crc_ok
        assert rows["bias_x"].value == pytest.approx(0.0125, rel=1e-7)
        stored = Stored.from_image(unit.eeprom)
        assert stored.valid
        assert stored.write_counter == 1
        assert stored.calibration["reference_temperature"] == bytes.fromhex("41b80000")
        await restore(p.link, bundle, p.before)
    assert Stored.from_image(unit.eeprom).calibration == factory_calibration()


@both
@pytest.mark.parametrize(
    ("faults", "failed"),
    [
        (Faults(refuse_registers=frozenset({"bias_x"})), "failed at writing bias_x"),
        (Faults(corrupt_write={"bias_x": 4}), "failed at reading back: register bias_x"),
        (
            Faults(forget_store=True),
            "failed at identity after the reset: after the restart the registers hold the old calibration",
        ),
    ],
)
async def test_a_failure_over_the_bus_ends_with_the_old_calibration(
    tmp_path: Path, serve: Serve, faults: Faults, failed: str
) -> None:
    unit = reference_unit(faults)
    async with serve(unit) as (device, bundle):
        p = provisioning(device, bundle, tmp_path)
        await p.examine()
        with pytest.raises(ProvisionError, match=failed):
            await p.write()
    assert p.held.state is DeviceState.OLD
    assert Stored.from_image(unit.eeprom).calibration == factory_calibration()


@both
@pytest.mark.parametrize("last", ["bias_x", "store"])
async def test_a_cancellation_over_the_bus_ends_with_the_old_calibration(
    tmp_path: Path, serve: Serve, last: str
) -> None:
    unit = reference_unit()
    async with serve(unit) as (device, bundle):

        def cancel(access: RegisterAccess) -> None:
            if (access.kind, access.register) == ("write", last) and task.cancelling() == 0:
                task.cancel()

        p = provisioning(device, bundle, tmp_path, record=cancel)
        await p.examine()
        task = asyncio.create_task(p.write())
        with pytest.raises(asyncio.CancelledError):
            await task
        assert p.held.state is DeviceState.OLD
        assert await device.read("bias_x") == bytes(4)
    assert Stored.from_image(unit.eeprom).calibration == factory_calibration()
