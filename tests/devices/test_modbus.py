"""Modbus PDUs by hand, from the application protocol."""

from __future__ import annotations

import pytest

from tests.devices.habits import Habits
from tests.devices.memory import Electronics
from tests.devices.modbus import ModbusUnit
from tests.devices.motion import Motion
from tests.devices.place import Place, Trouble

UNLOCK = "06 0020 C0DE"


def ask(unit: ModbusUnit, pdu: str, now: float = 0.0) -> str:
    (reply,) = unit.exchange(bytes.fromhex(pdu), now).replies
    return reply.data.hex()


def modbus(habits: Habits | None = None, trouble: Trouble | None = None, motion: Motion | None = None) -> ModbusUnit:
    return ModbusUnit(Place(Electronics(habits or Habits()), trouble), motion)


@pytest.mark.parametrize(
    ("request_pdu", "reply"),
    [
        ("03 0000 0002", "03 04 00001267"),  # serial number 4711
        ("03 0000 0004", "03 08 00001267 00003A7C"),  # and product code
        ("03 0100 0002", "03 04 C019999A"),
        ("03 0004 0001", "03 02 0000"),
        (UNLOCK, UNLOCK),
        ("10 0020 0001 02 C0DE", "10 0020 0001"),
        ("83", "83 01"),  # no such function
        ("2B 0E 01 00 00", "AB 01"),
        ("03 0001 0001", "83 02"),  # half a register
        ("03 0000 0001", "83 02"),
        ("03 0004 0004", "83 02"),  # a gap after it
        ("03 0022 0002", "83 02"),  # write only
        ("04 0000 0002", "84 02"),  # it measures nothing
        ("03 0000 0000", "83 03"),
        ("03 0000 007E", "83 03"),
        ("10 0020 0001 04 C0DE", "90 03"),
        ("06 0100 C01A", "86 02"),  # half of one, for writing
        ("10 0000 0002 04 00000001", "90 02"),  # read only
        ("10 0100 0002 04 C01A69AD", "90 04"),  # locked
        ("06 0024 0000", "86 03"),  # no reset command
    ],
)
def test_a_request_has_its_reply(request_pdu: str, reply: str) -> None:
    assert ask(modbus(), request_pdu) == bytes.fromhex(reply).hex()


def test_a_function_that_it_lacks_is_refused_or_unanswered() -> None:
    write = "10 0020 0001 02 C0DE"
    assert ask(modbus(Habits(lacks_function=16)), write) == "9001"
    assert ask(modbus(Habits(lacks_function=16)), UNLOCK) == bytes.fromhex(UNLOCK).hex()
    silent = modbus(Habits(lacks_function=16, when_lacking="silent"))
    assert not silent.exchange(bytes.fromhex(write), 0.0).replies


def test_a_block_of_whole_registers_is_written_in_order() -> None:
    unit = modbus()
    ask(unit, UNLOCK)
    assert ask(unit, "10 0100 0004 08 C01A69AD C0190B0F") == "1001000004"
    assert unit.place.unit.written == ["scale_factor_x", "scale_factor_y"]
    assert ask(unit, "03 0100 0004") == "0308c01a69adc0190b0f"


def test_words_may_come_least_significant_first() -> None:
    unit = modbus(Habits(word_order="little"))
    assert ask(unit, "03 0000 0002") == "0304" + "12670000"
    ask(unit, UNLOCK)
    ask(unit, "10 0100 0002 04 69ADC01A")
    assert unit.place.unit.in_use["scale_factor_x"].hex() == "c01a69ad"


@pytest.mark.parametrize("code", [None, 0x05, 0x0A, 0x0B])
def test_a_busy_device_or_gateway_says_so_with_its_code(code: int | None) -> None:
    unit = modbus(trouble=Trouble(busy=1.0, busy_code=code))
    assert ask(unit, "03 0000 0002") == f"83{code or 6:02x}"
    assert unit.place.unit.log == []


def test_a_store_that_blocks_is_answered_late() -> None:
    unit = modbus(Habits(unlock=False, store_blocks=True, store_seconds=8.0))
    (reply,) = unit.exchange(bytes.fromhex("10 0022 0002 04 65766173"), 0.0).replies
    assert (reply.data.hex(), reply.after_s) == ("1000220002", 8.0)


def test_the_newest_sample_is_read_as_it_is_and_corrected() -> None:
    # u = K b + K R a with the registers at first, for a = (0, 0, 1): u = K (b + (ay, ax, 1))
    readings = (-2.4 * (0.01 - 0.002), -2.38 * (-0.02 + 0.001), -2.42 * (0.03 + 1.0))
    motion = Motion(lambda now: readings if now == 7.0 else (0.0, 0.0, 0.0), number="int32")
    unit = modbus(motion=motion)
    assert ask(unit, "04 0000 0006", 7.0) == "040c" + "ffffb500" + "0000b0a4" + "ffd9f748"
    assert ask(unit, "04 0040 0006", 7.0) == "040c" + "00000000" * 2 + "000f4240"
    assert ask(unit, "04 0000 0002", 7.0) == "0404" + "ffffb500"
    assert ask(unit, "04 0002 0002", 7.0) == "8402"


def test_its_axes_may_lie_apart_and_other_registers_beside_them() -> None:
    motion = Motion(lambda _: (1e-6, 2e-6, 3e-6), number="int32", apart=True, beside={0x80: lambda now: int(now)})
    unit = modbus(motion=motion)
    assert [ask(unit, f"04 000{2 * i} 0002") for i in range(3)] == [f"0404{i:08x}" for i in (1, 2, 3)]
    assert ask(unit, "04 0000 0001") == "04020000"
    assert ask(unit, "04 0080 0001", 7.0) == "04020007"
    for refused in ("04 0000 0003", "04 0000 0006", "04 0001 0001", "04 0006 0002", "04 0080 0002"):
        assert ask(unit, refused) == "8402"


def test_a_device_may_correct_with_other_registers_than_its_own() -> None:
    unit = modbus(motion=Motion(lambda _: (0.0, 0.0, -2.5), follows_registers=False, number="int32"))
    assert ask(unit, "04 0040 0006") == "040c" + "00000000" * 2 + "000f4240"


def test_a_scale_factor_of_zero_gives_no_number() -> None:
    unit = modbus(Habits(unlock=False), motion=Motion(number="int32"))
    ask(unit, "10 0100 0002 04 00000000")
    assert ask(unit, "04 0040 0006") == "040c" + "80000000" * 3
