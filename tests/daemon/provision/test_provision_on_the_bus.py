"""The whole procedure over the real drivers, against the reference unit on a bus."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path

import pytest

from triaxcal_drivers.can.driver import CanDriver
from triaxcal_drivers.can.model import CanBus
from triaxcal_drivers.interface import Device
from triaxcal_drivers.modbus.driver import ModbusDriver
from triaxcal_drivers.profile import Bundle, load_bundle
from triaxcald.errors import ProvisionError
from triaxcald.provision.access import RegisterAccess
from triaxcald.provision.explain import explain
from triaxcald.provision.image import build_image
from triaxcald.provision.procedure import provision
from triaxcald.provision.restore import restore
from triaxcald.simulation.can_unit import CanUnit
from triaxcald.simulation.memory import Stored, factory_calibration
from triaxcald.simulation.modbus_unit import ModbusUnit
from triaxcald.simulation.physics import ConstantPhysics
from triaxcald.simulation.time_base import RealTimeBase
from triaxcald.simulation.unit import Faults, ReferenceUnit

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


def reference_unit(faults: Faults | None = None) -> ReferenceUnit:
    return ReferenceUnit(ConstantPhysics(), serial_number=7, faults=faults)


@both
async def test_a_calibration_arrives_over_the_bus_and_can_be_undone(serve: Serve) -> None:
    unit = reference_unit()
    async with serve(unit) as (device, bundle):
        image = build_image(bundle.profile, COEFFICIENTS, date_days=20_000)
        report = await provision(device, bundle, image, expected_serial="0007")
        assert dict(report.after.raw) == image.raw
        rows = {row.register: row for row in explain(bundle, report.after)}
        assert rows["calibration_crc"].crc_ok
        assert rows["bias_x"].value == pytest.approx(0.0125, rel=1e-7)
        stored = Stored.from_image(unit.eeprom)
        assert stored.valid
        assert stored.write_counter == 1
        assert stored.calibration["reference_temperature"] == bytes.fromhex("41b80000")
        await restore(device, bundle, report.before)
    assert Stored.from_image(unit.eeprom).calibration == factory_calibration()


@both
@pytest.mark.parametrize(
    ("faults", "failed"),
    [
        (Faults(refuse_registers=frozenset({"bias_x"})), "failed at writing bias_x"),
        (Faults(corrupt_write={"bias_x": 4}), "failed at reading back: register bias_x"),
        (Faults(forget_store=True), "failed at reading back after the reset: register scale_factor_x"),
    ],
)
async def test_a_failure_over_the_bus_ends_with_the_old_calibration(serve: Serve, faults: Faults, failed: str) -> None:
    unit = reference_unit(faults)
    async with serve(unit) as (device, bundle):
        image = build_image(bundle.profile, COEFFICIENTS, date_days=20_000)
        with pytest.raises(ProvisionError) as caught:
            await provision(device, bundle, image, expected_serial="0007")
    assert failed in str(caught.value)
    assert str(caught.value).endswith("old calibration restored and verified")
    assert Stored.from_image(unit.eeprom).calibration == factory_calibration()


@both
@pytest.mark.parametrize("last", ["bias_x", "store"])
async def test_a_cancellation_over_the_bus_ends_with_the_old_calibration(serve: Serve, last: str) -> None:
    unit = reference_unit()
    async with serve(unit) as (device, bundle):
        image = build_image(bundle.profile, COEFFICIENTS, date_days=20_000)

        def cancel(access: RegisterAccess) -> None:
            if (access.kind, access.register) == ("write", last) and task.cancelling() == 0:
                task.cancel()

        task = asyncio.create_task(provision(device, bundle, image, expected_serial="0007", record=cancel))
        with pytest.raises(asyncio.CancelledError) as caught:
            await task
        assert caught.value.__notes__ == ["old calibration restored and verified"]
        assert await device.read("bias_x") == bytes(4)
    assert Stored.from_image(unit.eeprom).calibration == factory_calibration()
