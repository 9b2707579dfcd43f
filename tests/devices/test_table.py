"""Registers as bytes, by values from outside."""

from __future__ import annotations

import pytest

from tests.devices.habits import Habits
from tests.devices.table import NEW, OLD, crc16, registers_of


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (b"123456789", 0x4B37),  # the catalogue's check value
        (bytes.fromhex("11 03 00 6B 00 03"), 0x8776),  # the protocol guide's example: 76 87 on the wire
        (b"", 0xFFFF),
    ],
)
def test_the_checksum_is_that_of_modbus(data: bytes, expected: int) -> None:
    assert crc16(data) == expected


def test_numbers_become_ieee_754_or_millionths() -> None:
    assert OLD.image(Habits())["scale_factor_x"].hex() == "c019999a"  # -2.4
    assert OLD.image(Habits())["misalignment_x"].hex() == "3a83126f"  # 0.001
    assert OLD.image(Habits(number="int32"))["scale_factor_x"].hex() == "ffdb6100"  # -2400000
    assert NEW.image(Habits(date=True), date_days=20_000)["calibration_date"].hex() == "00004e20"


def test_the_checksum_lies_over_the_nine_in_order() -> None:
    image = OLD.image(Habits(date=True), date_days=1)
    nine = "c019999a c01851ec c01ae148 3a83126f bb03126f 3ac49ba6 3c23d70a bca3d70a 3cf5c28f"
    assert image["calibration_crc"] == crc16(bytes.fromhex(nine)).to_bytes(2, "big")


@pytest.mark.parametrize("habits", [Habits(counter=True, mirror=True, date=True), Habits(store_command=False)])
def test_no_two_registers_lie_at_one_place(habits: Habits) -> None:
    entries = registers_of(habits).values()
    words = [entry.address + i for entry in entries for i in range(entry.words)]
    assert len(words) == len(set(words))
    assert len({entry.object for entry in entries}) == len(entries)
