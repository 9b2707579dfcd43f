"""A device that corrects the only output that it has, by the registers that a run would write."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import pytest

from tests.devices.habits import Habits
from tests.devices.in_memory import Errors, InMemoryDevice, VirtualClock
from tests.devices.memory import SERIAL_NUMBER, Electronics
from tests.devices.motion import Motion, Triple, correct
from tests.devices.place import Place as At
from tests.devices.profiles import Wording, profile_text, station_text
from tests.devices.table import Coefficients
from triaxcal_drivers.errors import BusError, DeviceAbsent, DeviceBusy, DeviceSilent, RegisterRefused
from triaxcal_drivers.interface import RawBatch
from triaxcald.provision.access import Clock, RegisterLink
from triaxcald.run import session, write_back
from triaxcald.station import collection
from triaxcald.station.config import Place

START_S, HELD_S, TURN_S, POSES, NOISE = 1_772_442_000.0, 2.0, 0.5, 16, 5e-5
SERIAL = 2**53 + 1  # no float holds it
ERRORS = Errors(DeviceSilent, DeviceAbsent, BusError, DeviceSilent, RegisterRefused, DeviceBusy)
KEY = '[correction] readings = "before"'
NEUTRAL = Coefficients((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
TRUE = Coefficients((1.021, 0.987, 1.013), (0.004, -0.006, 0.003), (0.021, -0.034, 0.018))
"""Of the sensor, in g per g: 30 mg off without a correction."""


def direction(number: int) -> Triple:
    """Evenly over the sphere, one after the other."""
    z = 1 - (2 * (number % POSES) + 1) / POSES
    angle = number % POSES * math.pi * (3 - math.sqrt(5))
    r = math.sqrt(1 - z * z)
    return (r * math.cos(angle), r * math.sin(angle), z)


def sensed(a: Triple) -> Triple:
    """u = K (R a + b), R = [[1, az, ay], [0, 1, ax], [0, 0, 1]]."""
    (x, y, z), k, m, b = a, TRUE.scale_factor, TRUE.misalignment, TRUE.bias
    turned = (x + m[2] * y + m[1] * z, y + m[0] * z, z)
    return (k[0] * (turned[0] + b[0]), k[1] * (turned[1] + b[1]), k[2] * (turned[2] + b[2]))


def tumbling(now: float) -> Triple:
    """From pose to pose, with white noise that is the same each time."""
    number, since_s = divmod(now - START_S, HELD_S + TURN_S)
    one, other = direction(int(number)), direction(int(number) + 1)
    part = max(since_s - HELD_S, 0.0) / TURN_S
    noise = random.Random(round(now * 1000))
    x, y, z = (u + part * (v - u) + noise.gauss(0, NOISE) for u, v in zip(one, other, strict=True))
    return sensed((x, y, z))


class Line:
    """The station of one unit, with everything on a clock of its own."""

    def __init__(self, folder: Path, habits: Habits, *, before: Coefficients, corrects_all: bool) -> None:
        self.folder, self.habits = folder, habits
        self.unit = Electronics(
            habits, before.image(habits), SERIAL if habits.serial_type == "uint64" else SERIAL_NUMBER
        )
        self.place = At(self.unit)
        self.clock = VirtualClock(START_S)
        self.motion = Motion(tumbling, corrects_all=corrects_all)

    def station(self, readings: Literal["before"] | None = None, **more: Any) -> Path:
        wording = Wording(corrected=False, readings=readings, nominal=1.0)
        (self.folder / "profile.toml").write_text(profile_text("modbus", self.habits, wording=wording))
        tables = {"plan": {"poses": POSES, "hold_s": 1.0, "repeat": False, "patience_s": 60.0}, **more}
        path = self.folder / "station.toml"
        path.write_text(station_text("profile.toml", {"host": "127.0.0.1", "port": 502}, tables=tables))
        return path

    def device(self) -> Any:
        return InMemoryDevice(self.place, ERRORS, self.clock, motion=self.motion, batch=RawBatch.of)

    @property
    def own_error_g(self) -> float:
        """rms of the magnitude of what the device's registers make of its sensor, in all poses."""
        entries, image = self.unit.table, self.unit.starts_with()
        off = [math.dist(correct(sensed(direction(i)), entries, image), (0, 0, 0)) - 1 for i in range(POSES)]
        return math.sqrt(sum(e * e for e in off) / POSES)


@pytest.fixture
def line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Line]:
    def make(habits: Habits | None = None, *, before: Coefficients = NEUTRAL, corrects_all: bool = True) -> Line:
        made = Line(tmp_path, habits or Habits(), before=before, corrects_all=corrects_all)
        clock = Clock(made.clock.sleep, made.clock.now)
        monkeypatch.setattr(Place, "device", lambda _: made.device())
        for module in (session, write_back):
            monkeypatch.setattr(
                module, "RegisterLink", lambda *given, **more: RegisterLink(*given, **more, clock=clock)
            )
        for name, value in (("LOOK_SAMPLES_S", 2.0), ("LOOK_HOST_S", 0.0), ("LOOK_SHARE", 0.0)):
            monkeypatch.setattr(collection, name, value)
        return made

    return make


Run = Callable[..., Any]


@pytest.mark.slow
def test_a_second_run_does_not_take_the_calibration_from_a_device_that_corrects_its_only_output(
    line: Callable[..., Line], triaxcal: Run
) -> None:
    unit = line()
    assert unit.own_error_g > 0.02
    first = triaxcal("run", unit.station(), "--json")
    assert first.code == 0, first.err
    calibrated, image = unit.own_error_g, unit.unit.starts_with()
    assert calibrated < 1e-4
    requests, before = len(unit.unit.log), set(unit.folder.glob("*.mcap"))
    second = triaxcal("run", unit.station(), "--json")
    assert second.code == 3
    assert KEY in second.err
    assert second.json["units"][0]["outcome"]["device_state"] == "untouched"
    assert all(r.kind == "read" for r in unit.unit.log[requests:])
    assert set(unit.folder.glob("*.mcap")) == before  # nobody has turned it for nothing
    assert (unit.own_error_g, unit.unit.starts_with()) == (calibrated, image)


@pytest.mark.slow
def test_a_device_that_is_known_to_deliver_raw_readings_is_calibrated_again(
    line: Callable[..., Line], triaxcal: Run
) -> None:
    habits = Habits(serial_type="uint64")
    unit = line(habits, corrects_all=False, before=Coefficients((1.5, 0.8, 1.1), (0.01, 0.02, 0.03), (0.1, 0.2, 0.3)))
    assert triaxcal("run", unit.station(), "--json").code == 3  # as its registers are not neutral at first
    for _ in range(2):
        done = triaxcal("run", unit.station("before"), "--json")
        assert done.code == 0, done.err
        outcome = done.json["units"][0]["outcome"]
        assert (outcome["device_state"], outcome["serial"]) == ("new_verified", str(SERIAL))
        assert triaxcal("audit", done.json["units"][0]["recording"]).code == 0
        assert unit.own_error_g < 1e-4
    entries, image = unit.unit.table, unit.unit.starts_with()
    assert [entries[f"bias_{axis}"].decode(image[f"bias_{axis}"]) for axis in "xyz"] == pytest.approx(
        TRUE.bias, abs=1e-4
    )


@pytest.mark.slow
def test_a_run_that_is_not_to_write_measures_as_ever(line: Callable[..., Line], triaxcal: Run) -> None:
    unit = line(before=TRUE)
    done = triaxcal("run", unit.station(provisioning={"write": False}), "--json")
    assert done.code == 0, done.err
    assert all(r.kind == "read" for r in unit.unit.log)
