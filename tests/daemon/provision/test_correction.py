"""Where the readings may be corrected by the registers that are to be written, the profile says that they are not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.devices.bench import TRANSPORTS, Bench, Transport
from tests.devices.habits import Habits
from tests.devices.profiles import DBC_FILE, Driver, Timing, Wording, dbc_text, profile_text
from tests.devices.table import NEW, OLD, Coefficients
from triaxcal.errors import Refused
from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.profile import Profile
from triaxcald.provision.registers import Snapshot, not_neutral, require_readings_before

PATIENT = Timing(reply_s=10.0, silence_s=20.0, store_poll_s=20.0, reconnect_s=20.0)
KEY = '[correction] readings = "before"'
OPEN, STATED = Wording(corrected=False), Wording(corrected=False, readings="before")
NOMINAL = Coefficients((-2.4, -2.4, -2.4), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
ONES = replace(NOMINAL, scale_factor=(1.0, 1.0, 1.0))
every_transport = pytest.mark.parametrize("transport", TRANSPORTS)


def profile(wording: Wording, habits: Habits | None = None, driver: Driver = "modbus") -> Profile:
    text = profile_text(driver, habits or Habits(), wording=wording)
    return parse_bundle(text.encode(), {DBC_FILE: dbc_text().encode()}, where="profile.toml").profile


@every_transport
@pytest.mark.parametrize("arguments", [(), ("--dry-run",), ("--force", "as ordered")])
def test_nothing_is_written_over_a_calibration_by_which_the_readings_may_be_corrected(
    tmp_path: Path, triaxcal: Callable[..., Any], transport: Transport, arguments: tuple[str, ...]
) -> None:
    with Bench(tmp_path, triaxcal, transport, timing=PATIENT, wording=OPEN) as bench:
        done = bench.provision("--json", *arguments)
        assert done.code == 3
        assert KEY in done.err
        outcome = done.json["outcome"]
        assert (outcome["verdict"], outcome["device_state"], outcome["serial"]) == ("aborted", "untouched", "4711")
        assert all(request.kind == "read" for request in bench.unit.log)
        assert (bench.unit.eeprom, bench.unit.restarts) == (bench.old, 0)
        assert not list(tmp_path.glob("journal/*"))


@every_transport
def test_with_the_key_it_is_written_again_and_again(
    tmp_path: Path, triaxcal: Callable[..., Any], transport: Transport
) -> None:
    with Bench(tmp_path, triaxcal, transport, timing=PATIENT, wording=STATED) as bench:
        for _ in range(2):
            done = bench.provision("--json")
            assert done.code == 0, done.err
            assert bench.holds_new()


@pytest.mark.parametrize(
    ("habits", "before"),
    [
        (Habits(), NOMINAL),
        (Habits(), ONES),
        (Habits(number="int32", date=True), NOMINAL),
        (Habits(blank=0xFF), OLD),
        (Habits(blank=0x00), OLD),
    ],
)
def test_a_device_that_holds_no_calibration_needs_no_key_the_first_time(
    tmp_path: Path, triaxcal: Callable[..., Any], habits: Habits, before: Coefficients
) -> None:
    with Bench(tmp_path, triaxcal, habits=habits, timing=PATIENT, wording=OPEN, before=before) as bench:
        done = bench.provision("--json")
        assert done.code == 0, done.err
        assert bench.holds_new()
        again = bench.provision("--json")
        assert (again.code, bench.holds_new()) == (3, True)


def test_what_was_begun_is_finished_or_put_back_without_the_key(tmp_path: Path, triaxcal: Callable[..., Any]) -> None:
    habits = Habits(reset_command=False)
    with Bench(tmp_path, triaxcal, habits=habits, timing=PATIENT, wording=OPEN, before=NOMINAL) as bench:
        assert bench.provision().code == 0
        (journal,) = tmp_path.glob("journal/*.json")  # no restart has proven what is stored
        refused = bench.provision("--json")
        assert refused.code == 3
        assert (refused.json["outcome"]["device_state"], refused.json["outcome"]["journal"]) == (
            "unknown",
            str(journal),
        )
        assert "--resume" in refused.err
        assert journal.exists()
        assert triaxcal("provision", "--resume", bench.station).code == 0
        assert bench.holds_new()
        assert triaxcal("restore", journal, bench.station).code == 0
        assert bench.holds_old()


@pytest.mark.parametrize("driver", ["modbus", "can"])
@pytest.mark.parametrize(
    ("coefficients", "names"),
    [
        (NOMINAL, ()),
        (ONES, ()),
        (replace(NOMINAL, scale_factor=(-2.4, 1.0, -2.4 * (1 + 1e-7))), ()),
        (replace(NOMINAL, scale_factor=(-2.4, -2.4, -2.401)), ("scale_factor_z",)),
        (replace(NOMINAL, scale_factor=(2.4, -1.0, 0.0)), ("scale_factor_x", "scale_factor_y", "scale_factor_z")),
        (replace(NOMINAL, bias=(0.0, 1e-6, 0.0)), ("bias_y",)),
        (replace(NOMINAL, misalignment=(-1e-6, 0.0, 0.0)), ("misalignment_x",)),
        (replace(NOMINAL, bias=(-0.0, 0.0, 0.0)), ()),
        (replace(NOMINAL, bias=(float("nan"), 0.0, 0.0)), ("bias_x",)),
        (Coefficients((0.0,) * 3, (0.0,) * 3, (0.0,) * 3), ()),
        (NEW, tuple(f"{q}_{axis}" for q in ("scale_factor", "misalignment", "bias") for axis in "xyz")),
    ],
)
def test_a_register_is_neutral_where_the_device_would_change_nothing_by_it(
    driver: Driver, coefficients: Coefficients, names: tuple[str, ...]
) -> None:
    habits = Habits(date=True)
    raw = coefficients.image(habits, date_days=20_000)
    held = Snapshot({name: value if driver == "modbus" else value[::-1] for name, value in raw.items()})
    assert not_neutral(profile(OPEN, habits, driver), held) == names


@pytest.mark.parametrize(("wording", "refused"), [(OPEN, True), (STATED, False), (Wording(), False)])
def test_a_profile_says_it_by_the_key_or_by_a_second_stream(wording: Wording, refused: bool) -> None:
    snapshot = Snapshot(OLD.image(Habits()))
    if not refused:
        require_readings_before(profile(wording), snapshot)
        return
    with pytest.raises(Refused) as raised:
        require_readings_before(profile(wording), snapshot)
    assert KEY in str(raised.value)
    assert "scale_factor_y" in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('readings = "bevore"', "correction.readings: input should be 'before' or 'after', not 'bevore'"),
        ("readings = true", "correction.readings: input should be 'before' or 'after', not True"),
        ('reading = "before"', "correction.reading: unknown key; did you mean 'readings'"),
    ],
)
def test_another_word_for_the_readings_is_an_error(
    tmp_path: Path, triaxcal: Callable[..., Any], text: str, says: str
) -> None:
    wrong = profile_text("modbus", Habits(), wording=OPEN) + f"\n[correction]\n{text}\n"
    with pytest.raises(ProfileError, match=says):
        parse_bundle(wrong.encode(), {}, where="profile.toml")
    with Bench(tmp_path, triaxcal, timing=PATIENT, wording=OPEN) as bench:
        bench.profile.write_text(wrong)
        assert bench.provision().code == 2
        assert bench.unit.log == []
