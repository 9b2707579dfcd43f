"""Sequences of a profile, and whose unit it is."""

import pytest

from triaxcal_drivers.errors import DeviceAbsent, DeviceSilent, RegisterRefused
from triaxcal_drivers.profile import PollStep, ReconnectStep, Register, Sequences, WaitStep, WriteStep
from triaxcald.provision.access import SequenceStalled, reconnect, run_sequence
from triaxcald.provision.identity import WrongUnit, check_identity

UNLOCK = WriteStep(write="unlock_key", value=0x5A17)


def with_unlock(bench, *steps):
    """The bench's bundle with another unlock sequence."""
    profile = bench.profile.model_copy(update={"sequences": Sequences(unlock=steps)})
    return bench.bundle.__class__(profile, b"")


async def test_steps_are_carried_out_in_order(bench) -> None:
    await run_sequence(bench.link, bench.bundle, "unlock")
    assert bench.device.log == [("write", "unlock_key"), ("read", "status")]
    assert bench.unit.read("status", bench.device.now_s) == b"\x00\x01"


async def test_store_is_polled_until_the_unit_is_no_longer_busy(bench) -> None:
    await run_sequence(bench.link, bench.bundle, "unlock")
    started_s = bench.device.now_s
    await run_sequence(bench.link, bench.bundle, "store")
    assert 0.05 <= bench.device.now_s - started_s < 0.1
    assert bench.stored.write_counter == 4


async def test_an_empty_sequence_does_nothing(bench) -> None:
    await run_sequence(bench.link, with_unlock(bench), "unlock")
    assert bench.device.log == []


async def test_a_wait_lasts_its_time(bench) -> None:
    await run_sequence(bench.link, with_unlock(bench, WaitStep(wait_s=1.5)), "unlock")
    assert bench.device.now_s == pytest.approx(2.5)


async def test_a_poll_that_never_comes_true_ends_at_its_deadline_and_says_what_it_saw(bench) -> None:
    bundle = with_unlock(bench, UNLOCK, PollStep(poll="status", until=3, timeout_s=0.5))
    with pytest.raises(SequenceStalled) as caught:
        await run_sequence(bench.link, bundle, "unlock")
    assert str(caught.value) == "unlock: register status holds 1 after 0.5 s, expected 3"
    assert 1.5 <= bench.device.now_s < 1.6


async def test_a_mask_leaves_the_other_bits_out_of_account(bench) -> None:
    bundle = with_unlock(bench, UNLOCK, PollStep(poll="status", mask=0x12, until=0))
    await run_sequence(bench.link, bundle, "unlock")
    assert bench.device.operations == 2


async def test_a_poll_bears_silence_until_its_deadline(bench) -> None:
    await bench.device.close()
    with pytest.raises(DeviceSilent, match="no reply from register status"):
        await run_sequence(bench.link, with_unlock(bench, PollStep(poll="status", until=0)), "unlock")
    assert bench.device.now_s >= 3.0


async def test_a_reset_brings_the_unit_back_on_a_new_connection(bench) -> None:
    await run_sequence(bench.link, bench.bundle, "reset")
    assert bench.device.log.count(("open", "")) > 1  # it was silent for 100 ms
    assert await bench.device.read("serial_number") == b"\x00\x00\x00\x07"


async def test_a_reconnect_waits_for_an_answer_where_opening_asks_nobody(bench) -> None:
    bench.device.opens_blindly = True
    await run_sequence(bench.link, bench.bundle, "reset")
    assert await bench.device.read("serial_number") == b"\x00\x00\x00\x07"


async def test_a_reset_that_is_not_acknowledged_is_a_reset(bench) -> None:
    def lose_the_reply(operation: int, done: bool) -> None:
        if done and bench.device.log[-1] == ("write", "reset"):
            raise DeviceSilent("no reply")

    bench.device.trouble = lose_the_reply
    await run_sequence(bench.link, bench.bundle, "reset")
    assert bench.unit.started_s > 1.0


async def test_a_device_that_refuses_while_it_starts_is_waited_for(bench) -> None:
    def refuse_at_first(operation: int, done: bool) -> None:
        if bench.device.log[-1][0] == "read" and bench.device.now_s < 2.5:
            raise RegisterRefused("starting", register=bench.device.log[-1][1], code=4)

    bench.device.trouble = refuse_at_first
    await reconnect(bench.link, bench.profile)
    assert 2.5 <= bench.device.now_s < 3.0


async def test_a_lost_reply_without_a_reconnect_to_follow_is_an_error(bench) -> None:
    await bench.device.close()
    with pytest.raises(DeviceSilent):
        await run_sequence(bench.link, with_unlock(bench, UNLOCK), "unlock")


async def test_a_device_that_stays_away_ends_the_reconnect_at_its_deadline(bench) -> None:
    bench.device.dead = True
    bundle = with_unlock(bench, ReconnectStep(reconnect=True, timeout_s=2.0))
    with pytest.raises(DeviceAbsent):
        await run_sequence(bench.link, bundle, "unlock")
    assert 3.0 <= bench.device.now_s < 3.5


async def test_the_identity_is_read_with_its_raw_numbers(bench) -> None:
    identity = await check_identity(bench.link, bench.bundle, "7")
    assert identity.serial == "0007"
    assert identity.values == {"vendor_id": 0x54524941, "product_code": 0x7A01}


async def test_another_product_is_refused(bench) -> None:
    expecting = bench.profile.identity.model_copy(update={"expect": {"product_code": 0x7A02}})
    bundle = bench.bundle.__class__(bench.profile.model_copy(update={"identity": expecting}), b"")
    with pytest.raises(WrongUnit) as caught:
        await check_identity(bench.link, bundle, None)
    assert str(caught.value) == (
        "the unit on triax-ref-memory is no TRIAX-REF: register product_code holds 0x7a01, expected 0x7a02"
    )


@pytest.mark.parametrize("expected", ["0001", "70", "SN7"])
async def test_another_serial_number_is_refused(bench, expected: str) -> None:
    with pytest.raises(WrongUnit, match=f"the unit on triax-ref-memory is serial 0007, expected {expected}"):
        await check_identity(bench.link, bench.bundle, expected)


async def test_a_serial_number_cannot_be_expected_of_a_device_that_has_none(bench) -> None:
    nameless = bench.profile.identity.model_copy(update={"serial_register": None})
    bundle = bench.bundle.__class__(bench.profile.model_copy(update={"identity": nameless}), b"")
    with pytest.raises(WrongUnit, match=r"tells no serial \(its profile has no serial_register\), expected 0007"):
        await check_identity(bench.link, bundle, "0007")
    assert (await check_identity(bench.link, bundle, None)).serial is None


async def test_a_serial_number_of_bits_that_are_no_number_is_refused_in_words(
    bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As an erased EEPROM holds them where the register is a float."""
    registers = {**bench.profile.registers, "serial_number": Register(type="float32")}
    bundle = bench.bundle.__class__(bench.profile.model_copy(update={"registers": registers}), b"")
    held = bench.link.read

    async def read(name: str) -> bytes:
        return b"\xff" * 4 if name == "serial_number" else await held(name)

    monkeypatch.setattr(bench.link, "read", read)
    with pytest.raises(WrongUnit, match="register serial_number holds ffffffff, which is no float32 number"):
        await check_identity(bench.link, bundle, None)
