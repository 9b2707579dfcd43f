"""The texts fit the devices: the program takes them, and finds in them what the devices hold."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

from tests.devices import canopen
from tests.devices.habits import Habits
from tests.devices.profiles import DBC_FILE, Driver, Timing, Wording, dbc_text, profile_text
from tests.devices.table import NEW, registers_of
from triaxcal_drivers.catalogue import driver_named, parse_bundle
from triaxcal_drivers.interface import RawBatch
from triaxcal_drivers.profile import Bundle

EVERYTHING = Habits(counter=True, mirror=True, date=True, number="int32")
NOTHING = Habits(
    store_command=False, reset_command=False, unlock=False, status=False, checksum=False, word_order="little"
)


def parsed(driver: Driver, habits: Habits, wording: Wording | None = None) -> Bundle:
    files = {DBC_FILE: dbc_text().encode()}
    return parse_bundle(profile_text(driver, habits, wording=wording).encode(), files, where="profile.toml")


@pytest.mark.parametrize("driver", ["modbus", "can"])
@pytest.mark.parametrize("habits", [Habits(), EVERYTHING, NOTHING])
def test_a_profile_names_every_register_of_the_device(driver: Driver, habits: Habits) -> None:
    profile = parsed(driver, habits).profile
    assert list(profile.registers) == list(registers_of(habits))
    assert (profile.crc is not None) is habits.checksum
    sequences = profile.sequences
    has = [bool(steps) for steps in (sequences.unlock, sequences.lock, sequences.store, sequences.reset)]
    assert has == [habits.unlock, habits.unlock, habits.store_command, habits.reset_command]


@pytest.mark.parametrize("habits", [Habits(), EVERYTHING])
def test_program_and_device_agree_on_the_bytes_of_a_register(habits: Habits) -> None:
    profile = parsed("modbus", habits).profile
    image = NEW.image(habits)
    assert profile.encode("scale_factor_y", NEW.scale_factor[1]) == image["scale_factor_y"]
    assert profile.encode("bias_z", NEW.bias[2]) == image["bias_z"]


def test_a_profile_can_be_wrong_about_its_device() -> None:
    wording = Wording(limits=False, word_order="little", product_code=1, serial=False, corrected=False)
    profile: Any = parsed("modbus", Habits(), wording).profile
    assert profile.registers["bias_x"].minimum is None
    assert profile.word_order == "little"
    assert profile.identity.expect == {"product_code": 1}
    assert profile.identity.serial_register is None
    assert list(profile.streams) == ["readings"]


def test_waits_are_those_asked_for() -> None:
    timing = Timing(reply_s=0.2, store_reply_s=3.0, store_wait_s=4.0, reset_wait_s=5.0, reconnect_s=6.0)
    text = tomllib.loads(profile_text("modbus", Habits(status=False), timing))
    assert text["sampling"]["reply_timeout_s"] == 0.2
    assert text["sequences"]["store"] == [{"write": "store", "value": 0x65766173, "timeout_s": 3.0}, {"wait_s": 4.0}]
    assert text["sequences"]["reset"][1:] == [{"wait_s": 5.0}, {"reconnect": True, "timeout_s": 6.0}]


def test_the_frames_of_a_node_decode_by_its_dbc() -> None:
    bundle = parsed("can", Habits())
    decoder = driver_named("can").decoder(bundle, "corrected")
    frames = [canopen.packed((0.5, -0.25, 1.0 + i), canopen.CORRECTED_UNIT_G, i) for i in range(3)]
    source = canopen.CORRECTED + 5
    block = decoder.feed(RawBatch.of([(1_000 + i, source, 0, frame) for i, frame in enumerate(frames)]))
    assert block.readings.tolist() == [pytest.approx([0.5, -0.25, 1.0 + i]) for i in range(3)]
    assert (block.missing, block.incomplete) == (0, 0)
