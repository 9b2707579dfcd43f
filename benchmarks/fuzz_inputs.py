"""Valid inputs of every kind, and what reads each."""

from __future__ import annotations

import contextlib
import gzip
import io
import json
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter

from benchmarks.fuzz_spoil import spoil, spoil_packed
from triaxcal.model.directions import directions
from triaxcal_drivers.can.driver import CanDecoder
from triaxcal_drivers.can.layout import stream_layout
from triaxcal_drivers.can.model import CanProfile, CanStream, PdoStream
from triaxcal_drivers.catalogue import BUILT_IN, load_bundle
from triaxcal_drivers.interface import RawBatch
from triaxcald.cli.commands import main as command
from triaxcald.recording import schema
from triaxcald.recording.reader import Recording
from triaxcald.simulation.bench import load_device, simulate
from triaxcald.station.config import load_station

ROOT = Path(__file__).parents[1]
MESSAGES = 40  # of the raw records of an example; some seconds


@dataclass(frozen=True)
class Kind:
    """``files`` are the contents of a folder; the one that is spoiled is the first. ``read`` takes the folder."""

    name: str
    files: Callable[[], dict[str, bytes]]
    read: Callable[[Path, random.Random], int]
    structural: bool = True
    share: int = 4  # of the inputs; what takes long has less


STATION = """format = "triaxcal.station/1"
name = "bench"
folder = "out"
reference = 1.0002
[plan]
poses = 14
hold_s = 1.0
[limits]
rms_g = 1e-4
"""
CAN_UNIT = """[[units]]
name = "a"
profile = "triax-ref-can.toml"
serial = "4711"
signs = [-1, -1, -1]
bus = { interface = "virtual", channel = "a", node_id = 5, options = { receive_own_messages = true } }
"""
MODBUS_UNIT = """[[units]]
name = "b"
profile = "triax-ref-modbus"
bus = { host = "127.0.0.1", port = 502 }
"""
DEVICE = """format = "triaxcal.device/1"
profile = "triax-ref-modbus"
serial = 4711
speed = 20.0
seed = 3
eeprom = "unit.eeprom"
bus = { host = "127.0.0.1", port = 0 }
[sensor]
noise_g = 1e-4
effects = { second_order_nonlinearity = { x = 5e-4, y = -4e-4, z = 3e-4 } }
[surroundings]
temperature_c = 25.0
ramp_c_per_s = 0.01
[fixture]
poses = 14
hold_s = 2.0
"""


def _station(first: str, units: str) -> dict[str, bytes]:
    """A station of these units, and the files of their profiles."""
    names = ("triax-ref-can.toml", "triax-ref-can.dbc", "triax-ref-modbus.toml")
    held = {name: (BUILT_IN / name).read_bytes() for name in names}
    held["station.toml"] = (STATION + units.replace('-modbus"', '-modbus.toml"')).encode()
    return {first: held.pop(first), **held}


@cache
def _streams() -> dict[str, CanStream]:
    """Of the built-in CAN profile: as it is, laid out by its DBC, and laid out by its EDS."""
    streams = cast(CanProfile, load_bundle(Path("triax-ref-can")).profile).streams
    channels = {f"u{axis}": f"0x2300:0{i}" for i, axis in enumerate("xyz", 1)}
    pdo = {"layout": "pdo", "eds": "triax-ref-can.eds", "counter": "0x2300:04", "channels": channels}
    return {".dbc": streams["readings"], ".eds": PdoStream.model_validate(pdo)}


def _description(suffix: str) -> dict[str, bytes]:
    name = f"triax-ref-can{suffix}"
    return {name: (BUILT_IN / name).read_bytes()}


def _lay_out(suffix: str, folder: Path, rng: random.Random) -> int:
    ((name, data),) = ((p.name, p.read_bytes()) for p in folder.iterdir())
    stream = _streams()[suffix]
    layout = stream_layout(stream, {name: data}, where="fuzz")
    CanDecoder(layout, rate_hz=100.0).feed(RawBatch.of([(0, 389, 0, bytes(range(8))), (1, 645, 0, bytes(8))]))
    return 0


@cache
def _table() -> bytes:
    """Still for a second in each of fourteen poses."""
    a = np.repeat([v for _, v in directions(14)], 30, axis=0)
    a = a + 1e-4 * np.random.default_rng(1).standard_normal(a.shape)
    rows = "".join(
        f"{i / 30:.6f},{x:.6f},{y:.6f},{z:.6f},{20 + i / 900:.2f}\n" for i, (x, y, z) in enumerate(a.tolist())
    )
    return f"# a table\nt_s,ux,uy,uz,temp_c\n{rows}".encode()


def _foreign_table() -> bytes:
    """The same as a spreadsheet in German writes it."""
    lines = _table().decode().splitlines()[2:]
    rows = "".join(line.replace(",", ";").replace(".", ",") + ";\r\n" for line in lines)
    return f"Protokoll\r\n\r\nZeit [s];X [V];Y [V];Z [V];Temp [°C];\r\n{rows}".encode("cp1252")


def _parquet() -> bytes:
    values = np.loadtxt(io.BytesIO(_table()), delimiter=",", skiprows=2)
    out = io.BytesIO()
    pd.DataFrame(values, columns=["time", "ax", "ay", "az", "temp"]).to_parquet(out)
    return out.getvalue()


def _calibration() -> dict[str, bytes]:
    document = {
        "format": "triaxcal.calibration/1",
        "terms": ["linear", "temperature_bias"],
        "units": {"output": "V", "reference": "g"},
        "scale_factor": [1.01, 0.99, 1.002],
        "misalignment": [1e-3, -2e-3, 5e-4],
        "bias": [1e-3, 2e-3, -1e-3],
        "effects": {"temperature_bias": {a: {"value": 1e-4, "standard_error": 1e-6, "unit": "g/K"} for a in "xyz"}},
        "channel_reference": {"temp_c": 25.0},
        "reference": 1.0,
        "standard_error": {"scale_factor": [1e-5] * 3, "misalignment": [1e-5] * 3, "bias": [1e-5] * 3},
        "residual": {"rms_g": 1e-5, "max_abs_g": 2e-5, "noise_floor_g": 1e-5, "lack_of_fit_p": 0.4},
        "poses": [{"start_s": 0.0, "end_s": 1.0, "mean": [0.0, 0.0, 1.0], "residual_g": 1e-6, "used": True}],
        "unit": {"name": "a", "serial": "4711"},
    }
    return {"cal.json": json.dumps(document, indent=1).encode(), "a.csv": _table()}


@cache
def _recording() -> bytes:
    """The beginning of a golden one, in chunks without compression and with no CRC that a spoiled byte would fail."""
    out = io.BytesIO()
    writer = McapWriter(
        out, chunk_size=2**14, compression=CompressionType.NONE, enable_crcs=False, enable_data_crcs=False
    )
    writer.start(profile=schema.PROFILE)
    with Recording.open(ROOT / "recordings" / "can-second-order.mcap") as source:
        for name, values in source.metadata.items():
            writer.add_metadata(name, values)
        for name in source.attachments:
            if not name.endswith(".html"):
                writer.add_attachment(0, 0, name, source.attachments.media_types[name], source.attachments[name])
        ids: dict[str, int] = {}
        for number, (topic, message) in enumerate(source.messages()):
            if number >= MESSAGES:
                break
            if topic not in ids:
                kind = schema.SCHEMAS[dict(schema.CHANNELS).get(topic, "Event")]
                ids[topic] = writer.register_channel(
                    topic, "protobuf", writer.register_schema(kind.name, "protobuf", b"")
                )
            writer.add_message(ids[topic], message.log_time, message.data, message.publish_time, message.sequence)
    writer.finish()  # type: ignore[no-untyped-call]
    return out.getvalue()


def _load_station(folder: Path, rng: random.Random) -> int:
    for place in load_station(folder / "station.toml").places:
        place.device()
        for stream in place.bundle.profile.streams:
            place.bundle.profile.by_role(stream)
    return 0


def _load_device(folder: Path, rng: random.Random) -> int:
    device = load_device(folder / "device.toml")
    unit = simulate(device, where="device.toml").unit
    with np.errstate(all="ignore"):
        unit.advance(1.0)
    return 0


def _run(folder: Path, rng: random.Random, *commands: Sequence[str]) -> int:
    words = rng.choice(commands)
    with contextlib.chdir(folder):
        return command(words)


def _zipped(folder: Path, rng: random.Random) -> int:
    """The spoiled table packed, and half of the time the packed bytes spoiled too."""
    path = folder / "a.csv.gz"
    data = bytearray(gzip.compress(path.read_bytes(), 1, mtime=0))
    if rng.random() < 0.5:
        spoil_packed(data, rng)
    path.write_bytes(data)
    return _run(folder, rng, ["poses", "a.csv.gz"])


_TABLE_COMMANDS = (*[["poses"]] * 12, ["fit", "-o", "out.json"], ["plan"], ["fit", "--turning"], ["diagnose"])
_READ = (["poses"], ["poses", "--skip-bad"], ["poses", "--rate", "30"], ["poses", "--pose-means"])
_RECORDING_COMMANDS = (["log", "info"], ["log", "recover"], ["log", "export", "-o", "o"], ["poses"], ["audit"])
KINDS = (
    Kind("CAN profile", partial(_station, "triax-ref-can.toml", CAN_UNIT), _load_station),
    Kind("Modbus profile", partial(_station, "triax-ref-modbus.toml", MODBUS_UNIT), _load_station),
    Kind("station", partial(_station, "station.toml", CAN_UNIT + MODBUS_UNIT), _load_station),
    Kind("device", lambda: {"device.toml": DEVICE.encode()}, _load_device),
    Kind("DBC", partial(_description, ".dbc"), partial(_lay_out, ".dbc")),
    Kind("EDS", partial(_description, ".eds"), partial(_lay_out, ".eds")),
    Kind("CSV", lambda: {"a.csv": _table()},
         lambda f, r: _run(f, r, *([*c, "a.csv"] for c in _TABLE_COMMANDS)), share=1),
    Kind("table", lambda: {"a.txt": _foreign_table()},
         lambda f, r: _run(f, r, *([*c, "a.txt"] for c in _READ)), share=1),
    Kind("Parquet", lambda: {"a.parquet": _parquet()}, lambda f, r: _run(f, r, *([*c, "a.parquet"] for c in _READ)),
         structural=False, share=1),
    Kind("CSV, gzip", lambda: {"a.csv.gz": _table()}, _zipped, share=2),
    Kind("calibration", _calibration, lambda f, r: _run(f, r, ["verify", "cal.json", "a.csv", "--json"],
         ["verify", "cal.json", "a.csv"], ["fit", "a.csv", "--passport", "cal.json", "-o", "out.json"]), share=2),
    Kind("attitudes", lambda: {"att.csv": b"label\n" + b"".join(f"{n}\n".encode() for n, _ in directions(14)),
         "a.csv": _table()}, lambda f, r: _run(f, r, ["fit", "a.csv", "--attitudes", "att.csv"]), share=1),
    Kind("recording", lambda: {"a.mcap": _recording()},
         lambda f, r: _run(f, r, *([*c[:2], "a.mcap", *c[2:]] for c in _RECORDING_COMMANDS)),
         structural=False, share=2),
)  # fmt: skip


def spoiled(kind: Kind, rng: random.Random) -> dict[str, bytes]:
    """The files of an example with the first of them changed once or a few times."""
    files = dict(kind.files())
    name = next(iter(files))
    data = bytearray(files[name])
    other = rng.choice(list(rng.choice(KINDS).files().values()))
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        spoil(data, rng, other, structural=kind.structural, tree=name.endswith(".json"))
    files[name] = bytes(data)
    return files
