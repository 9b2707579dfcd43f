"""Makes the golden recordings anew: simulated units of known truth, run down the whole line.

    python recordings/make.py

Samples come through real protocol stacks in real time, so a new recording differs from the old one in length and in
noise, not in truth. Each recording has a `.truth.json` beside it.
"""

from __future__ import annotations

import asyncio
import gzip
import json
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from triaxcald.cli.bars import Bars
from triaxcald.run.unit_run import TrayRun
from triaxcald.simulation.bench import DeviceFile, SyntheticPhysics, physics_of, simulate
from triaxcald.station.config import load_station

HERE = Path(__file__).parent
STATION = """\
format = "triaxcal.station/1"
name = "golden"

[plan]
poses = 26
hold_s = 1.2
check_poses = 6

[limits]
rms_g = 6e-5
verification_rms_g = 6e-5

[[units]]
name = "{name}"
profile = "{profile}"
bus = {bus}
"""
UNITS: dict[str, dict[str, Any]] = {
    "can-second-order": {
        "profile": "triax-ref-can",
        "seed": 20,
        "bus": {"interface": "virtual", "channel": "golden", "node_id": 5},
        "sensor": {"effects": {"second_order_nonlinearity": {"x": 6e-4, "y": -4e-4, "z": 5e-4}}},
    },
    "modbus-temperature-bias": {
        "profile": "triax-ref-modbus",
        "seed": 22,
        "bus": {"host": "127.0.0.1", "port": 0, "unit_id": 1},
        "sensor": {"effects": {"temperature_bias": {"x": 4e-5, "y": 5e-5, "z": -6e-5}}},
        "surroundings": {"swing_c": 6.0, "swing_period_s": 17.0},
    },
}


def device_of(name: str) -> DeviceFile:
    return DeviceFile.model_validate(
        {
            "format": "triaxcal.device/1",
            "serial": 1001 + list(UNITS).index(name),
            "speed": 10.0,
            "fixture": {"hold_s": 2.4, "move_s": 0.8},
            **UNITS[name],
        },
        strict=False,
    )


async def make(name: str) -> None:
    device = device_of(name)
    with tempfile.TemporaryDirectory() as folder, Bars() as bars:
        async with simulate(device, where=name).serve() as server:
            bus = dict(device.bus)
            if "port" in bus:
                bus["port"] = server.bus.port
            inline = "{ " + ", ".join(f"{k} = {json.dumps(v)}" for k, v in bus.items()) + " }"
            path = Path(folder) / "station.toml"
            path.write_text(STATION.format(name=name, profile=device.profile, bus=inline))
            (outcome,) = await TrayRun(load_station(path), bars)
        if outcome.exit_code or outcome.recording is None:
            sys.exit(f"{name}: exit code {outcome.exit_code}: {outcome.error}")
        shutil.copy(outcome.recording, HERE / f"{name}.mcap")
    write_truth(name, device)


def write_truth(name: str, device: DeviceFile) -> None:
    truth = device.sensor
    document = {
        "scale_factor": truth.scale_factor,
        "misalignment": truth.misalignment,
        "bias": truth.bias,
        "effects": {effect: dict(values) for effect, values in truth.effects.items()},
    }
    (HERE / f"{name}.truth.json").write_text(json.dumps(document, indent=2) + "\n")


def make_paper_unit() -> None:
    """The unit of the paper's table 1 in its 14 poses, as text: 5 s a pose, 1.5e-5 g noise of a pose mean."""
    device = DeviceFile.model_validate(
        {
            "format": "triaxcal.device/1",
            "profile": "triax-ref-can",
            "bus": {},
            "seed": 14,
            "sensor": {"noise_g": 1.5e-5 * np.sqrt(500).item()},
            "fixture": {"poses": 14, "hold_s": 5.0, "move_s": 1.0},
        },
        strict=False,
    )
    physics: SyntheticPhysics = physics_of(device)
    t_s = np.arange(0, 14 * (5.0 + 1.0), 0.01)
    volts, temperature_c = physics.sample(t_s)
    with gzip.GzipFile(HERE / "paper-unit.csv.gz", "wb", mtime=0) as out:
        out.write(b"t_s,ux,uy,uz,temp_c\n")
        for t, u, temp in zip(t_s, volts, temperature_c, strict=True):
            out.write(f"{t:.2f},{u[0]:.6f},{u[1]:.6f},{u[2]:.6f},{temp:.2f}\n".encode())
    write_truth("paper-unit", device)


if __name__ == "__main__":
    wanted = sys.argv[1:] or ["paper-unit", *UNITS]
    if "paper-unit" in wanted:
        make_paper_unit()
    for each in UNITS:
        if each in wanted:
            asyncio.run(make(each))
