"""Devices that correct by offsets, by gains and offsets, or by a matrix: calibrated three times, with their readings
before or after the correction."""

from __future__ import annotations

import csv
import json
import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from scipy.optimize import least_squares

from tests.devices.habits import Habits
from tests.devices.in_memory import Errors, InMemoryDevice, VirtualClock
from tests.devices.memory import Electronics
from tests.devices.motion import Motion, Triple
from tests.devices.place import Place as At
from tests.devices.profiles import Wording, profile_text, station_text
from tests.devices.table import registers_of
from triaxcal_drivers.errors import BusError, DeviceAbsent, DeviceBusy, DeviceSilent, RegisterRefused
from triaxcal_drivers.interface import RawBatch
from triaxcald.provision.access import Clock, RegisterLink
from triaxcald.run import session, write_back
from triaxcald.station import collection
from triaxcald.station.config import Place

START_S, HELD_S, TURN_S, POSES, NOISE = 1_772_442_000.0, 2.0, 0.5, 16, 5e-5
ERRORS = Errors(DeviceSilent, DeviceAbsent, BusError, DeviceSilent, RegisterRefused, DeviceBusy)
DIAGONAL, OFFSETS = ("matrix.xx", "matrix.yy", "matrix.zz"), ("offset.x", "offset.y", "offset.z")
MATRIX = tuple(f"matrix.{row}{column}" for row in "xyz" for column in "xyz")
SHAPES = {"offsets": OFFSETS, "gain and offset": (*DIAGONAL, *OFFSETS), "matrix and offset": (*MATRIX, *OFFSETS)}
SENSED = np.array([[1.021, 0.003, -0.006], [0.004, 0.987, 0.004], [-0.002, 0.005, 1.013]])
ZERO = np.array([0.021, -0.034, 0.018])
"""u = SENSED a + ZERO, in units of ``size`` per g."""
Form = Literal["matrix", "matrix-after"]


def direction(number: int) -> np.ndarray:
    """Evenly over the sphere, one after the other."""
    z = 1 - (2 * (number % POSES) + 1) / POSES
    angle, r = number % POSES * math.pi * (3 - math.sqrt(5)), math.sqrt(1 - z * z)
    return np.array([r * math.cos(angle), r * math.sin(angle), z])


@dataclass(frozen=True)
class Linear:
    """What a device makes of its readings: y = C (u - o), or y = C u - o."""

    form: Form
    roles: tuple[str, ...]
    nominal: float

    def parts(self, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        c = np.array([values.get(name, self.nominal * (name in DIAGONAL)) for name in MATRIX]).reshape(3, 3)
        return c, np.array([values.get(name, 0.0) for name in OFFSETS])

    def output(self, u: np.ndarray, values: Mapping[str, float]) -> np.ndarray:
        c, o = self.parts(values)
        return c @ (u - o) if self.form == "matrix" else c @ u - o

    def best_rms(self, size: float, per_g: float) -> float:
        """The least error of |a| over the sphere that any values leave."""
        rng = np.random.default_rng(1)
        a = rng.standard_normal((2000, 3))
        us = size * ((a / np.linalg.norm(a, axis=1, keepdims=True)) @ SENSED.T + ZERO)

        def off(p: np.ndarray) -> np.ndarray:
            c, o = self.parts(dict(zip(self.roles, p, strict=True)))
            y = (us - o) @ c.T if self.form == "matrix" else us @ c.T - o
            return np.asarray(np.linalg.norm(y, axis=1) / per_g - 1)

        start = [self.nominal if name in DIAGONAL else 0.0 for name in self.roles]
        return float(np.sqrt(np.mean(least_squares(off, start, x_scale="jac", xtol=1e-15, ftol=1e-15).fun ** 2)))


class Shown(Motion):
    """The motion of a unit that corrects by these registers; ``size`` is what it senses at 1 g."""

    def __init__(self, linear: Linear, size: float, *, after: bool) -> None:
        super().__init__(lambda now: tuple(self.sensed(now)), corrects_all=after)
        object.__setattr__(self, "linear", linear)
        object.__setattr__(self, "size", size)

    def sensed(self, now: float) -> np.ndarray:
        number, since_s = divmod(now - START_S, HELD_S + TURN_S)
        part = max(since_s - HELD_S, 0.0) / TURN_S
        a = (1 - part) * direction(int(number)) + part * direction(int(number) + 1)
        noise = random.Random(round(now * 1000))
        return self.size * (SENSED @ (a + [noise.gauss(0, NOISE) for _ in range(3)]) + ZERO)  # type: ignore[attr-defined]

    def corrected(self, unit: Electronics, now: float) -> Triple:
        x, y, z = self.linear.output(self.sensed(now), values_of(unit, unit.in_use)).tolist()  # type: ignore[attr-defined]
        return (x, y, z)


def values_of(unit: Electronics, image: Mapping[str, bytes]) -> dict[str, float]:
    return {e.role: e.decode(image[name]) for name, e in unit.table.items() if e.role in (*MATRIX, *OFFSETS)}


@dataclass
class Line:
    folder: Path
    linear: Linear
    after: bool
    size: float
    per_g: float
    first: Mapping[str, float]

    def __post_init__(self) -> None:
        self.habits = Habits(roles=self.linear.roles, checksum=False)
        table = registers_of(self.habits)
        names = {e.role: name for name, e in table.items() if e.role in self.linear.roles}
        stored = {names[role]: table[names[role]].encode(self.first[role]) for role in self.linear.roles}
        self.unit = Electronics(self.habits, stored)
        self.place, self.clock = At(self.unit), VirtualClock(START_S)
        self.motion = Shown(self.linear, self.size, after=self.after)

    def station(self, **more: Any) -> Path:
        wording = Wording(
            corrected=False,
            readings="after" if self.after else "before",
            nominal=self.per_g if self.after else self.size,
            form=self.linear.form,
            output_per_g=self.per_g,
        )
        (self.folder / "profile.toml").write_text(profile_text("modbus", self.habits, wording=wording))
        tables = {"plan": {"poses": POSES, "hold_s": 1.0, "repeat": False, "patience_s": 60.0}, **more}
        path = self.folder / "station.toml"
        path.write_text(station_text("profile.toml", {"host": "127.0.0.1", "port": 502}, tables=tables))
        return path

    @property
    def own_error_g(self) -> float:
        """rms over the sphere of what the device makes after a power cycle."""
        values = values_of(self.unit, self.unit.starts_with())
        rng = np.random.default_rng(2)
        a = rng.standard_normal((2000, 3))
        a /= np.linalg.norm(a, axis=1, keepdims=True)
        us = self.size * (a @ SENSED.T + ZERO)
        y = np.array([self.linear.output(u, values) for u in us])
        return float(np.sqrt(np.mean((np.linalg.norm(y, axis=1) / self.per_g - 1) ** 2)))


@pytest.fixture
def line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Line]:
    def make(
        shape: str,
        form: Form = "matrix",
        *,
        after: bool = True,
        neutral: bool = True,
        size: float = 1.0,
        per_g: float = 1.0,
    ) -> Line:
        linear = Linear(form, SHAPES[shape], per_g / size)
        rng = np.random.default_rng(7)
        first = {
            role: (linear.nominal * (role in DIAGONAL)) + (not neutral) * float(rng.normal(0, 0.02)) * (
                linear.nominal if role in MATRIX else (size if form == "matrix" else per_g)
            )
            for role in linear.roles
        }  # fmt: skip
        made = Line(tmp_path, linear, after, size, per_g, first)
        clock = Clock(made.clock.sleep, made.clock.now)
        monkeypatch.setattr(
            Place,
            "device",
            lambda _: InMemoryDevice(made.place, ERRORS, made.clock, motion=made.motion, batch=RawBatch.of),
        )
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
@pytest.mark.parametrize(
    ("shape", "form", "neutral", "size", "per_g"),  # every pair of two of these values
    [
        ("offsets", "matrix", True, 1.0, 1.0),
        ("offsets", "matrix-after", False, 9.80665, 9.80665),
        ("gain and offset", "matrix", False, 9.80665, 9.80665),
        ("gain and offset", "matrix-after", True, 1.0, 1.0),
        ("matrix and offset", "matrix", True, 9.80665, 9.80665),
        ("matrix and offset", "matrix-after", False, 1.0, 1.0),
    ],
)
def test_three_runs_leave_a_single_output_device_at_its_best(
    line: Callable[..., Line], triaxcal: Run, shape: str, form: Form, neutral: bool, size: float, per_g: float
) -> None:
    unit = line(shape, form, neutral=neutral, size=size, per_g=per_g)
    best, first = unit.linear.best_rms(size, per_g), unit.own_error_g
    assert first > 0.01
    states = []
    for _ in range(3):
        done = triaxcal("run", unit.station(), "--json")
        assert done.code == 0, done.err
        assert unit.own_error_g <= 1.1 * best + 3 * NOISE, done.err
        outcome = done.json["units"][0]["outcome"]
        states.append(outcome["device_state"])
        certificate = json.loads(Path(done.json["units"][0]["certificate"]).read_text())
        registers = certificate["registers"]
        assert registers["left_rms_g"] == pytest.approx(best, rel=0.1, abs=1e-8)
        assert registers["better"] == (outcome["device_state"] != "untouched")
        unit.unit.power_cycle(unit.clock.now())
    assert states == ["new_verified", "untouched", "untouched"]
    assert triaxcal("audit", done.json["units"][0]["recording"]).code == 0


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
def test_readings_before_the_correction_are_calibrated_likewise(
    line: Callable[..., Line], triaxcal: Run, shape: str
) -> None:
    unit = line(shape, after=False, neutral=False, size=2.4, per_g=9.80665)
    best = unit.linear.best_rms(2.4, 9.80665)
    for _ in range(2):
        done = triaxcal("run", unit.station(), "--json")
        assert done.code == 0, done.err
        assert unit.own_error_g <= 1.1 * best + 3 * NOISE
        assert triaxcal("audit", done.json["units"][0]["recording"]).code == 0


@pytest.mark.slow
def test_registers_that_changed_since_the_readings_began_are_not_written(
    line: Callable[..., Line], triaxcal: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    unit = line("offsets")
    finish = collection.Collection.until_posed

    async def changed(self: Any, *given: Any, **more: Any) -> Any:
        found = await finish(self, *given, **more)
        unit.unit._ram["offset_x"] = unit.unit.table["offset_x"].encode(0.01)
        return found

    monkeypatch.setattr(collection.Collection, "until_posed", changed)
    done = triaxcal("run", unit.station(), "--json")
    assert done.code == 3
    assert "offset_x changed since the readings began" in done.err
    assert unit.unit.written == []


@pytest.mark.slow
def test_a_recording_is_fitted_before_the_correction_of_the_device(line: Callable[..., Line], triaxcal: Run) -> None:
    unit = line("offsets", neutral=False)
    done = triaxcal("run", unit.station(provisioning={"write": False}), "--json")
    recording = done.json["units"][0]["recording"]
    fitted = triaxcal("fit", recording, "--json")
    assert fitted.code == 0, fitted.err
    c = np.diag(SENSED)
    assert fitted.json["scale_factor"] == pytest.approx(c, abs=1e-3)
    assert fitted.json["bias"] == pytest.approx(ZERO, abs=1e-3)


@pytest.mark.slow
def test_a_fitted_file_is_written_by_hand_while_the_registers_are_those_of_the_recording(
    line: Callable[..., Line], triaxcal: Run, tmp_path: Path
) -> None:
    unit = line("offsets", neutral=False)
    station = unit.station(provisioning={"write": False})
    recording = triaxcal("run", station, "--json").json["units"][0]["recording"]
    file = tmp_path / "fitted.json"
    assert triaxcal("fit", recording, "-o", file).code == 0
    held = json.loads(file.read_text())["registers_at_start"]
    assert set(held) == {"offset_x", "offset_y", "offset_z"}

    # The calibration is of the readings before the correction, and so is `apply`.
    applied = triaxcal("apply", file, recording, "-o", tmp_path / "applied.csv")
    assert applied.code == 0, applied.err
    lines = [line for line in (tmp_path / "applied.csv").read_text().splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    a = np.array([[float(row[name]) for name in ("ax", "ay", "az")] for row in rows])
    assert np.median(np.linalg.norm(a, axis=1)) == pytest.approx(1.0, abs=1e-3)

    dry = triaxcal("provision", file, station, "--dry-run", "--json")
    assert dry.code == 0, dry.err
    told = dry.json["correction"]
    assert told["own_rms_g"]["predicted"] < told["own_rms_g"]["before"]
    assert told["left_rms_g"] == pytest.approx(unit.linear.best_rms(1.0, 1.0), rel=0.1)
    assert set(told["fixed"]) == {*MATRIX}
    assert unit.unit.written == []
    before = unit.unit._ram["offset_x"]
    unit.unit._ram["offset_x"] = unit.unit.table["offset_x"].encode(0.01)
    assert triaxcal("provision", file, station).code == 3
    assert unit.unit.written == []
    unit.unit._ram["offset_x"] = before
    done = triaxcal("provision", file, station)
    assert done.code == 0, done.err
    assert unit.own_error_g <= 1.1 * unit.linear.best_rms(1.0, 1.0) + 3 * NOISE
