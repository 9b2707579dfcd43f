"""The profiles of commercial devices, on devices that are written from what their vendors publish: each is calibrated,
and the truth is found."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

from tests import vendor_devices as vendors
from tests.canopen_node import MappedNode
from tests.vendor_devices import Sender, Sensor
from triaxcal_drivers.catalogue import BUILT_IN

pytestmark = pytest.mark.slow
Run = Callable[..., Any]
PLAN = {"poses": 14, "hold_s": 0.6, "check_poses": 3, "comes_back_s": 60.0, "patience_s": 300.0}
ON_CAN = {
    "witmotion-can": vendors.WitMotionCan,
    "bosch-mm710": vendors.BoschMm710,
    "xsens-mti-600": vendors.XsensMti600,
    "sbg-ellipse": vendors.SbgEllipse,
    "honeywell-tars": vendors.HoneywellTars,
}
PER_G = {"xsens-mti-600": vendors.G, "sbg-ellipse": vendors.G, "honeywell-tars": vendors.G, "ifm-jn2100": 1000.0}
TMM61_AS_DELIVERED = {(0x1800, 2): 1, (0x1800, 5): 0, (0x1A00, 0): 2, (0x1A00, 1): 0x60100010, (0x1A00, 2): 0x60200010}


def node(channel: str, number: int, profile: str, per_g: float, first: tuple[int, int], **more: Any) -> MappedNode:
    """A CANopen node with three accelerations from object ``first`` on. It turns by its samples."""
    sensor = Sensor(lambda: unit.sent * Sender.PERIOD_S)
    held: dict[str, list[float]] = {}

    def value_of(index: int, subindex: int, _: float) -> int:
        axis = (index - first[0]) + (subindex - first[1])
        if not 0 <= axis <= 2 or index & 0xFF00 != first[0] & 0xFF00:
            return 20
        if axis == 0:
            held["g"] = sensor.output_g()
        return round(per_g * held["g"][axis])

    unit = MappedNode(channel, number, BUILT_IN / f"{profile}.eds", value_of, **more)
    return unit


def require_truth(profile: str, outcome: Mapping[str, Any], offset_g: float = 0.0) -> None:
    """Each of the nine parameters within four of its standard errors."""
    found = outcome["measured"]["calibration"]
    per_g = PER_G.get(profile, 1.0)
    truth = {
        "scale_factor": per_g * np.array(vendors.SCALE),
        "misalignment": np.array(vendors.MISALIGNMENT),
        "bias": np.array(vendors.BIAS_G) + offset_g / np.array(vendors.SCALE),
    }
    for name, true in truth.items():
        off = (np.array(found[name]) - true) / np.array(found["standard_error"][name])
        assert np.abs(off).max() < 4, (profile, name, off)


def test_every_device_on_can_is_calibrated_on_one_bus(workshop: Any, triaxcal: Run) -> None:
    channel = f"vendors-{os.getpid()}"
    bus = {"interface": "virtual", "channel": channel}
    units: list[dict[str, Any]] = []
    with contextlib.ExitStack() as stack:
        for number, (profile, device) in enumerate(ON_CAN.items(), 1):
            address = {"source_address": 0xE2} if profile == "honeywell-tars" else {"node_id": number}
            units.append({"name": profile, "profile": profile, "bus": {**bus, **address}})
            stack.enter_context(device(channel))
        tmm61 = node(channel, 40, "sick-tmm61", 4096, (0x3102, 1), delivered=TMM61_AS_DELIVERED)
        jn2100 = node(channel, 41, "ifm-jn2100", 1000, (0x5D10, 0), delivered={}, tpdo=3)
        for profile, unit in (("sick-tmm61", tmm61), ("ifm-jn2100", jn2100)):
            stack.enter_context(unit)
            units.append({"name": profile, "profile": profile, "bus": {**bus, "node_id": unit.node.id}})
        station = workshop.station(*units, plan=PLAN, provisioning={"write": False})
        done = triaxcal("run", station, "--json")
    assert done.code == 0, done.err
    for unit in done.json["units"]:
        require_truth(unit["unit"], unit["outcome"])
        recording = next(workshop.folder.rglob(unit["outcome"]["recording"]))
        quality = triaxcal("poses", recording, "--json").json["data_quality"]
        # Only that one counts its samples; the others' pauses are those of the threads that play them. Before its first
        # temperature, which comes once a second, no sample is whole.
        lost = [line for line in quality if line.startswith("missing_samples")]
        if unit["unit"] == "xsens-mti-600":
            assert not [line for line in lost if int(line.split()[1]) > 101], lost


def test_an_analog_device_that_shows_2_5_volts_at_0_g_is_calibrated(workshop: Any, triaxcal: Run) -> None:
    text = (BUILT_IN / "moxa-e1240.toml").read_text("utf-8")
    text = text.replace("\n[sampling]", "nominal_offset = 2.5\n\n[sampling]")
    with vendors.MoxaE1240() as device:
        profile = workshop.write("analog.toml", text).name
        station = workshop.station({"profile": profile, "bus": device.bus}, plan=PLAN, provisioning={"write": False})
        done = triaxcal("run", station, "--json")
    assert done.code == 0, done.err
    require_truth("moxa-e1240", done.json["units"][0]["outcome"], offset_g=2.5)


def test_a_device_with_offsets_only_keeps_its_calibration_in_a_second_run(workshop: Any, triaxcal: Run) -> None:
    """WT901C485: its only output is corrected by what is written."""
    errors_g = []
    with vendors.WitMotion485() as device:
        for _ in range(2):
            station = workshop.station({"profile": "witmotion-485", "bus": device.bus}, plan=PLAN)
            done = triaxcal("run", station, "--json")
            assert done.code in (0, 1), done.err
            outcome = done.json["units"][0]["outcome"]
            assert outcome["serial"] == device.SERIAL.decode()
            device.restart()  # as its supply does
            errors_g.append(own_error_g(device))
    assert device.stored != {5: 0, 6: 0, 7: 0}
    best = best_error_g()
    assert all(error < 1.1 * best + 3e-4 for error in errors_g), (errors_g, best)


SPHERE = np.array([vendors.direction(k) for k in range(vendors.POSES)])


def sensed_g(a: np.ndarray) -> np.ndarray:
    mx, my, mz = vendors.MISALIGNMENT
    r = np.array([[1, mz, my], [0, 1, mx], [0, 0, 1]])
    return np.asarray(np.array(vendors.SCALE) * (a @ r.T + vendors.BIAS_G))


def own_error_g(device: vendors.WitMotion485) -> float:
    offsets = 1e-4 * np.array([device.stored[address] for address in (5, 6, 7)], np.uint16).view(np.int16)
    return float(np.sqrt(np.mean((np.linalg.norm(sensed_g(SPHERE) - offsets, axis=1) - 1) ** 2)))


def best_error_g() -> float:
    found = least_squares(lambda o: np.linalg.norm(sensed_g(SPHERE) - o, axis=1) - 1, np.zeros(3))
    return float(np.sqrt(np.mean(found.fun**2)))


@pytest.mark.parametrize("path", sorted(BUILT_IN.glob("*.toml")), ids=lambda path: path.stem)
def test_a_shipped_profile_of_a_device_names_its_source(path: Path) -> None:
    ours = path.stem.startswith(("triax-ref", "generic"))
    assert ours != ('\nsource = "' in path.read_text("utf-8"))
