"""Whether a device with a journal is as the provisioning that was cut short left it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import pytest

from tests.devices.habits import Habits
from tests.devices.profiles import profile_text
from tests.devices.table import NEW, OLD
from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.profile import Profile
from triaxcald.provision.journal import Entry, Step, was_cut_short
from triaxcald.provision.registers import Snapshot, image_of

HABITS = Habits()
BEFORE, WANTED = OLD.image(HABITS), NEW.image(HABITS)
BLANK = {name: b"\xff" * len(raw) for name, raw in BEFORE.items()}
NAMES = list(BEFORE)
HALF_WRITTEN = {**BEFORE, NAMES[0]: WANTED[NAMES[0]]}


@cache
def profile(*, serial: bool = True) -> Profile:
    made = parse_bundle(profile_text("modbus", HABITS).encode(), {}, where="a profile").profile
    return made if serial else made.model_copy(update={"identity": replaced(made)})


def replaced(made: Profile) -> object:
    return made.identity.model_copy(update={"serial_register": None})


def cut_short(found: dict[str, bytes], *, step: Step = "writing", serial: bool = True, restarted: bool = True) -> bool:
    of = profile(serial=serial)
    entry = Entry("unit", "4711" if serial else None, "ab" * 32, "", dict(BEFORE), dict(WANTED), step)
    return was_cut_short(entry, of, Snapshot(found), image_of(of, WANTED), restarted)


def test_a_mixture_of_old_and_new_is() -> None:
    assert cut_short(HALF_WRITTEN)
    assert cut_short(HALF_WRITTEN, serial=False)


def test_the_old_calibration_after_a_restart_is_not() -> None:
    assert not cut_short(BEFORE)


def test_the_old_calibration_in_use_may_not_be_what_is_stored() -> None:
    assert cut_short(BEFORE, restarted=False)


def test_a_calibration_that_somebody_has_made_since_is_not() -> None:
    other = replace(NEW, bias=(0.031, 0.002, -0.004)).image(HABITS)
    assert not cut_short(other)


@pytest.mark.parametrize("serial", [True, False])
def test_a_blank_unit_is_the_same_one_only_where_its_serial_number_says_so(serial: bool) -> None:
    assert cut_short(BLANK, serial=serial) == serial
