import pytest

from triaxcald.errors import ProvisionError
from triaxcald.provision.identity import WrongUnit
from triaxcald.provision.procedure import restore
from triaxcald.provision.registers import RegisterImage, build_image, take_snapshot
from triaxcald.provision.state import DeviceState, Evidence
from triaxcald.simulation.unit import CALIBRATION, ConstantPhysics, Faults, ReferenceUnit, Stored


@pytest.mark.parametrize("little_endian", [False, True])
async def test_a_calibration_is_in_use_and_stored_after_provisioning(make_bench, little_endian: bool) -> None:
    bench = make_bench(little_endian=little_endian)
    report = await bench.provision()
    bench.assert_holds(bench.new)
    assert bench.stored.write_counter == 4
    assert report.stored
    assert report.identity.serial == "0007"
    assert dict(report.after.raw) == bench.image.raw
    assert tuple(report.written) == report.differing
    assert (report.held.state, report.held.evidence) == (DeviceState.NEW_VERIFIED, Evidence.RESTART)
    assert bench.journals == []


async def test_the_checksum_is_written_last(bench) -> None:
    await bench.provision()
    *written, probe = bench.device.written
    assert written[-1] == "calibration_crc"
    assert written.count("calibration_crc") == 1
    assert probe == "scale_factor_x", "off by a bit, and gone with the restart"


def with_one_bias_changed(bench) -> RegisterImage:
    changed = {**bench.old_coefficients, "bias.x": 0.125}
    return build_image(bench.profile, changed, date_days=bench.old_date_days)


async def test_only_what_differs_is_written(bench) -> None:
    bench.image = with_one_bias_changed(bench)
    report = await bench.provision()
    assert bench.device.written == ["bias_x", "calibration_crc", "bias_x"]
    assert report.written == ["bias_x", "calibration_crc"]
    bench.assert_holds({**bench.old, **{name: bench.image.raw[name] for name in report.written}})


async def test_a_device_that_holds_the_image_is_restarted_and_not_worn(bench) -> None:
    await bench.provision()
    report = await bench.provision()
    assert report.written == []
    assert report.held.state is DeviceState.NEW_VERIFIED
    assert bench.stored.write_counter == 4
    assert ("write", "reset") in bench.device.log
    bench.assert_holds(bench.new)


async def test_an_image_that_is_in_use_but_was_never_stored_gets_stored(bench) -> None:
    bench.image = with_one_bias_changed(bench)
    bench.put_in_ram("bias_x", 0.125)
    report = await bench.provision()
    assert report.written == ["bias_x", "calibration_crc"]
    bench.assert_stored(bench.image.raw)


async def test_a_dry_run_reads_and_says_what_would_be_written(bench) -> None:
    report = await bench.provision(dry_run=True)
    assert {kind for kind, _ in bench.device.log} == {"read"}
    assert report.written == []
    assert "bias_x" in report.differing
    assert report.held.state is DeviceState.UNTOUCHED
    bench.assert_holds(bench.old)
    assert bench.stored.write_counter == 3


async def test_another_serial_number_is_refused_before_anything_is_written(bench) -> None:
    with pytest.raises(WrongUnit) as caught:
        await bench.provision(expected_serial="0001", where="can0 node 5")
    assert str(caught.value) == "the unit on can0 node 5 is serial 0007, expected 0001"
    assert caught.value.exit_code == 4
    assert {kind for kind, _ in bench.device.log} == {"read"}


async def test_every_access_is_recorded_with_its_bytes(bench) -> None:
    await bench.provision()
    done = [(a.kind, a.register) for a in bench.records]
    assert done == [entry for entry in bench.device.log if entry[0] != "open"]
    *written, (probed, probe) = [
        (a.register, a.raw) for a in bench.records if a.kind == "write" and a.register in CALIBRATION
    ]
    assert dict(written) == {name: bench.image.raw[name] for name in bench.device.written}
    assert probe not in (bench.image.raw[probed], bench.old[probed])


async def test_a_refused_access_is_recorded_with_its_error(make_bench) -> None:
    bench = make_bench(faults=Faults(refuse_registers=frozenset({"bias_y"})))
    with pytest.raises(ProvisionError):
        await bench.provision()
    assert [(a.register, a.error) for a in bench.records if a.error] == [("bias_y", "register bias_y: locked")]


async def test_a_station_can_undo_a_whole_provisioning(bench) -> None:
    report = await bench.provision()
    await restore(bench.link, bench.bundle, report.before)
    bench.assert_holds(bench.old)
    assert bench.stored.write_counter == 5


async def test_restoring_what_is_there_already_does_not_wear_the_device(bench) -> None:
    before = await take_snapshot(bench.device, bench.bundle)
    await restore(bench.link, bench.bundle, before)
    bench.assert_holds(bench.old)
    assert bench.stored.write_counter == 3
    assert bench.device.written == ["scale_factor_x"], "to show the restart"


def another_unit(bench) -> ReferenceUnit:
    return ReferenceUnit(ConstantPhysics(), serial_number=8, stored=Stored(bench.new, 4).image())


async def test_another_unit_on_the_same_address_is_never_given_the_old_calibration(bench) -> None:
    report = await bench.provision()
    bench.device.exchange(another_unit(bench))
    with pytest.raises(WrongUnit, match="serial 0008, expected 0007"):
        await restore(bench.link, bench.bundle, report.before)
    assert {kind for kind, _ in bench.device.log} == {"read"}


async def test_nor_is_one_that_is_put_there_while_the_unit_restarts(bench) -> None:
    report = await bench.provision()
    other = another_unit(bench)

    def exchange_on_restart(operation: int, done: bool) -> None:
        if done and bench.device.log[-1] == ("write", "reset"):
            bench.device.exchange(other)

    bench.device.trouble = exchange_on_restart
    with pytest.raises(WrongUnit, match="serial 0008, expected 0007"):
        await restore(bench.link, bench.bundle, report.before)
    assert {kind for kind, _ in bench.device.log} == {"open", "read"}


async def test_a_unit_exchanged_before_the_last_reading_is_not_taken_for_the_provisioned_one(bench) -> None:
    other = another_unit(bench)

    def exchange_on_restart(operation: int, done: bool) -> None:
        if done and bench.device.log[-1] == ("write", "reset"):
            bench.device.exchange(other)

    bench.device.trouble = exchange_on_restart
    with pytest.raises(ProvisionError) as caught:
        await bench.provision()
    wrong = "the unit on the bench is serial 0008, expected 0007"
    assert str(caught.value) == f"provisioning failed at identity after the reset: {wrong}"
    assert bench.held.state is DeviceState.NEW_UNVERIFIED
    assert bench.journals == ["TRIAX-REF-0007.json"]
    assert {kind for kind, _ in bench.device.log} == {"open", "read"}


async def test_what_cannot_be_written_back_is_not_stored_and_is_named(bench) -> None:
    report = await bench.provision()
    bench.unit.faults = Faults(corrupt_write={"bias_x": 0x01})
    with pytest.raises(ProvisionError, match="of the old calibration, bias_x will not come back"):
        await restore(bench.link, bench.bundle, report.before)
    assert bench.stored.write_counter == 4
    assert ("write", "store") not in bench.device.log[-40:]


async def test_a_restoring_whose_store_is_forgotten_does_not_pass(bench) -> None:
    report = await bench.provision()
    bench.unit.faults = Faults(forget_store=True)
    with pytest.raises(ProvisionError, match=r"of the old calibration, .*bias_x.* will not come back"):
        await restore(bench.link, bench.bundle, report.before)
    bench.assert_holds(bench.new)
