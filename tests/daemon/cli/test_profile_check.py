"""devices check: what resolves of a profile, and what is wrong with it by a log, of a sensor whose truth is known."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from mcap.writer import Writer
from numpy.typing import NDArray

from triaxcald.documents import to_text
from triaxcald.schema.profile_check import ProfileCheck

Run = Callable[..., Any]
T0 = 1_700_000_000.0
RATE = 50.0
PER_G = np.array([8000.0, -8200.0, 8100.0])  # counts
BIAS = np.array([0.03, -0.02, 0.05])  # g
DIRECTIONS = np.array([[0, 0, 1], [1, 0, 0], [0, -1, 0], [0.6, 0.8, 0], [0, 0, -1]])
AT_REST_G = float(np.median(np.linalg.norm(DIRECTIONS + BIAS, axis=1)))
STILL_S, MOVE_S = 8, 2

DBC = """VERSION ""
BU_: IMU
BO_ 389 Accel: 8 IMU
 SG_ AX : 0|16@1- (1,0) [0|0] "" IMU
 SG_ AY : 16|16@1- (1,0) [0|0] "" IMU
 SG_ AZ : 32|16@1- (1,0) [0|0] "" IMU
 SG_ Temp : 48|8@1+ (1,-40) [0|0] "" IMU
 SG_ Ok : 56|8@1+ (1,0) [0|0] "" IMU
BO_ 900 Other: 8 IMU
 SG_ BX : 0|16@1- (1,0) [0|0] "" IMU
 SG_ BY : 16|16@1- (1,0) [0|0] "" IMU
 SG_ BZ : 32|16@1- (1,0) [0|0] "" IMU
"""
PROFILE = """format = "triaxcal.profile/1"
name = "imu"
driver = "can"
[identity]
vendor = "v"
product = "p"
[output]
unit = "counts"
nominal_scale_factor = [8192, -8192, 8192]
[sampling]
rate_hz = 50
[streams.readings]
layout = "dbc"
file = "imu.dbc"
channels = { ux = "AX", uy = "AY", uz = "AZ", temp_c = "Temp", ok = "Ok" }
"""


def readings() -> NDArray[np.float64]:
    """Counts (n,3): still in each direction, with a turn in between."""
    rng = np.random.default_rng(5)
    rows = []
    for k, direction in enumerate(DIRECTIONS):
        rows += [direction] * int(STILL_S * RATE)
        after = DIRECTIONS[(k + 1) % len(DIRECTIONS)]
        steps = np.linspace(0, 1, int(MOVE_S * RATE))[:, None]
        way = direction * (1 - steps) + after * steps + 0.3 * np.sin(40 * steps) * np.array([1, 0.5, -1])
        rows += list(way)
    a = np.array(rows)
    return np.round((a + BIAS) * PER_G + rng.normal(0, 8, a.shape))


def frames() -> list[can.Message]:
    made = []
    for k, u in enumerate(readings()):
        time_s = T0 + k / RATE
        data = struct.pack("<3hBB", *map(int, u), 65 + k // 500, 1)
        made.append(can.Message(timestamp=time_s, arbitration_id=389, is_extended_id=False, data=data, channel=0))
        if k % 10 == 0:
            made.append(can.Message(timestamp=time_s + 1e-3, arbitration_id=0x123, is_extended_id=True, data=b"\1\2"))
        if k % 50 == 0:
            made.append(
                can.Message(timestamp=time_s + 2e-3, arbitration_id=0x705, is_extended_id=False, is_remote_frame=True)
            )
    return made


COUNTS = {"0x185": 2500, "0x123x": 250, "0x705": 50}


@pytest.fixture
def imu(tmp_path: Path) -> Callable[..., Path]:
    def write(*changes: tuple[str, str], profile: str = PROFILE) -> Path:
        for old, new in changes:
            assert old in profile
            profile = profile.replace(old, new)
        (tmp_path / "imu.dbc").write_text(DBC)
        (tmp_path / "imu.toml").write_text(profile)
        return tmp_path / "imu.toml"

    return write


@pytest.fixture
def log(tmp_path: Path) -> Callable[[str], Path]:
    def write(name: str) -> Path:
        with can.Logger(tmp_path / name) as logger:
            for message in frames():
                logger.on_message_received(message)
        return tmp_path / name

    return write


def codes(document: dict[str, Any]) -> list[str]:
    return [problem["code"] for problem in document["problems"]]


@pytest.mark.parametrize("name", ["a.log", "a.blf", "a.asc"])
def test_a_log_that_fits_is_without_problems(triaxcal: Run, imu: Any, log: Any, name: str) -> None:
    done = triaxcal("devices", "check", imu(), log(name), "--json")
    assert (done.code, codes(done.json)) == (0, [])
    read = ProfileCheck.read(done.json)
    assert read is not None
    assert to_text(read.document()) == to_text(done.json)
    rows = {row["identifier"]: row for row in done.json["log"]["frames"]}
    assert {name: row["count"] for name, row in rows.items()} == COUNTS
    assert rows["0x185"]["streams"] == ["readings"]
    assert rows["0x123x"]["streams"] == rows["0x705"]["streams"] == []
    assert [rows[name]["kind"] for name in COUNTS] == ["data", "data", "remote"]
    assert rows["0x185"]["rate_hz"] == pytest.approx(RATE, rel=1e-3)
    found = done.json["log"]["streams"]["readings"]
    assert (found["samples"], found["constant"]) == (2500, ["ok"])
    assert found["rate_hz"] == pytest.approx(RATE, rel=1e-3)
    assert found["still_poses"] >= len(DIRECTIONS) - 1
    assert found["at_rest_g"] == pytest.approx(AT_REST_G, abs=0.03)  # scale factors are off by up to 0.024
    assert found["channels"]["temp_c"] == {"least": 25.0, "most": 29.0}


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ([("8192, -8192, 8192", "835.1, -835.1, 835.1")], ["at_rest"]),  # per m/s², which is no g
        ([("8192, -8192, 8192", "16384, -16384, 16384")], ["at_rest"]),  # another measuring range
        ([("rate_hz = 50", "rate_hz = 100")], ["rate"]),
        ([('uz = "AZ"', 'uz = "Ok"')], ["constant_reading"]),
        ([('"AX", uy = "AY", uz = "AZ", temp_c = "Temp", ok = "Ok"', '"BX", uy = "BY", uz = "BZ"')], ["no_frames"]),
        ([("channels =", "valid = { signal = \"Ok\", values = [0] }\nchannels =")], ["no_samples"]),
        ([("[streams.readings]", '[streams.corrected]\nlayout = "dbc"\nfile = "imu.dbc"\n'
           'channels = { ux = "BX", uy = "BY", uz = "BZ" }\n[streams.readings]')], ["no_frames"]),
        ([("[streams.readings]", '[registers.gain_x]\nobject = "0x2000:01"\ntype = "int16"\nscale = 0.1\n'
           'role = "scale_factor.x"\n[streams.readings]')], ["register_range"]),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_a_problem(
    triaxcal: Run, imu: Any, log: Any, changes: list[tuple[str, str]], wanted: list[str]
) -> None:
    words = ("devices", "check", imu(*changes), log("a.log"))
    done = triaxcal(*words, "--json")
    assert (done.code, done.err, codes(done.json)) == (1, "", wanted)
    shown = triaxcal(*words)
    assert shown.code == 1
    assert [line for line in shown.out.splitlines() if line.startswith("problem: ")] == [
        f"problem: {problem['text']}" for problem in done.json["problems"]
    ]


def test_several_nodes_are_a_problem_until_one_is_named(triaxcal: Run, imu: Any, log: Any, tmp_path: Path) -> None:
    profile = imu(('file = "imu.dbc"', 'file = "imu.dbc"\nbase_node_id = 5'))
    path = log("a.log")
    other = [line.replace(" 185#", " 186#") for line in path.read_text().splitlines()[:20] if " 185#" in line]
    path.write_text("\n".join(other) + "\n" + path.read_text())
    done = triaxcal("devices", "check", profile, path, "--json")
    assert (done.code, "several_units" in codes(done.json)) == (1, True)
    done = triaxcal("devices", "check", profile, path, "--node", 5, "--json")
    assert (done.code, done.json["log"]["node"]) == (0, 5)


MESSAGES = """format = "triaxcal.profile/1"
name = "phone"
driver = "mcap"
[identity]
vendor = "v"
product = "p"
[output]
unit = "counts"
nominal_scale_factor = [8192, -8192, 8192]
[sampling]
rate_hz = 50
[streams.readings]
topic = "/imu"
channels = { ux = "x", uy = "y", uz = "z" }
"""


@pytest.mark.parametrize(("topic", "wanted"), [("/imu", []), ("/imu2", ["no_frames"])])
def test_messages_of_others_are_looked_at_too(triaxcal: Run, tmp_path: Path, topic: str, wanted: list[str]) -> None:
    with open(tmp_path / "a.mcap", "wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Imu", "jsonschema", b"{}")
        numbers = [writer.register_channel(name, "json", schema) for name in ("/imu", "/gps")]
        for k, u in enumerate(readings()):
            time_ns = int(T0 * 1e9 + k * 1e9 / RATE)
            for number in numbers[: 1 + (k % 5 == 0)]:
                data = json.dumps(dict(zip("xyz", u, strict=True))).encode()
                writer.add_message(number, time_ns, data, time_ns)
        writer.finish()
    (tmp_path / "a.toml").write_text(MESSAGES.replace('"/imu"', f'"{topic}"'))
    done = triaxcal("devices", "check", tmp_path / "a.toml", tmp_path / "a.mcap", "--json")
    assert (done.code, codes(done.json)) == (1 if wanted else 0, wanted)
    rows = {row["identifier"]: row for row in done.json["log"]["frames"]}
    assert {name: (row["kind"], row["count"]) for name, row in rows.items()} == {
        "/imu": ("Imu", 2500),
        "/gps": ("Imu", 500),
    }
    assert rows["/gps"]["streams"] == []
    assert rows["/imu"]["streams"] == ([] if wanted else ["readings"])
    if not wanted:
        assert done.json["log"]["streams"]["readings"]["at_rest_g"] == pytest.approx(AT_REST_G, abs=0.03)


@pytest.mark.parametrize(
    ("profile", "recording", "identifiers"),
    [
        ("triax-ref-can", "can-second-order.mcap", {"0x185", "0x285", "0x385", "0x485"}),
        ("triax-ref-modbus", "modbus-temperature-bias.mcap", {"input 0x0000", "input 0x0400"}),
    ],
)
def test_recordings_of_a_unit_are_looked_at_too(
    triaxcal: Run, profile: str, recording: str, identifiers: set[str]
) -> None:
    path = Path(__file__).parents[3] / "recordings" / recording
    done = triaxcal("devices", "check", profile, path, "--json")
    assert codes(done.json) == ["rate", "rate"]  # simulated time ran faster than the clock
    assert {row["identifier"] for row in done.json["log"]["frames"]} == identifiers
    for stream in done.json["log"]["streams"].values():
        assert stream["at_rest_g"] == pytest.approx(1.0, abs=0.01)


ROLES = """
[correction]
form = "{form}"
readings = "before"
output_per_g = 9.80665
[registers]
cx = {{ object = "0x2000:01", type = "int16", scale = 1e-7, role = "matrix.xx" }}
cy = {{ object = "0x2000:02", type = "float32", role = "matrix.yy", minimum = -0.01, maximum = 0.01 }}
cz = {{ object = "0x2000:03", type = "int32", scale = 1e-12, role = "matrix.zz" }}
ox = {{ object = "0x2001:01", type = "int16", role = "offset.x" }}
oy = {{ object = "0x2001:02", type = "int16", scale = 0.5, role = "offset.y", minimum = -100, maximum = 200 }}
oz = {{ object = "0x2001:03", type = "uint16", offset = -32768, role = "offset.z" }}
t1x = {{ object = "0x2002:01", type = "int16", scale = 0.01, role = "offset.x.t1" }}
t1y = {{ object = "0x2002:02", type = "int16", scale = 0.01, role = "offset.y.t1" }}
t1z = {{ object = "0x2002:03", type = "int16", scale = 0.01, role = "offset.z.t1" }}
t = {{ object = "0x2002:04", type = "int16", scale = 0.01, role = "reference_temperature" }}
"""


@pytest.mark.parametrize("form", ["matrix", "matrix-after"])
def test_registers_are_weighed_by_what_they_do_to_one_g(triaxcal: Run, imu: Any, form: str) -> None:
    """Judged by the correction itself, of the reading of 1 g along each axis."""
    done = triaxcal("devices", "check", imu(profile=PROFILE + ROLES.format(form=form)), "--json")
    rows = {row["role"]: row for row in done.json["calibration"]["roles"]}
    nominal = {"x": 8192.0, "y": -8192.0, "z": 8192.0}

    def corrected_g(axis: str, c: float | None = None, o: float = 0.0) -> float:
        u = nominal[axis]
        gain = 9.80665 / u if c is None else c
        return (gain * (u - o) if form == "matrix" else gain * u - o) / 9.80665

    def near(row: dict[str, Any], least: float, most: float, step: float) -> None:
        assert [row["least_g"], row["most_g"]] == pytest.approx([least, most], rel=1e-5)
        assert row["resolution_g"] == pytest.approx(step, rel=1e-5)

    near(rows["matrix.xx"], corrected_g("x", -32768e-7), corrected_g("x", 32767e-7), corrected_g("x", 1e-7))
    near(
        rows["matrix.yy"],
        corrected_g("y", 0.01),
        corrected_g("y", -0.01),
        abs(corrected_g("y", float(np.spacing(np.float32(9.80665 / 8192))))),
    )
    near(
        rows["matrix.zz"],
        corrected_g("z", -(2**31) * 1e-12),
        corrected_g("z", (2**31 - 1) * 1e-12),
        corrected_g("z", 1e-12),
    )
    of = {axis: abs(1 - corrected_g(axis, o=1.0)) for axis in nominal}  # of an offset of 1
    near(rows["offset.x"], -32768 * of["x"], 32767 * of["x"], of["x"])
    near(rows["offset.y"], -100 * of["y"], 200 * of["y"], 0.5 * of["y"])
    near(rows["offset.z"], -32768 * of["z"], 32767 * of["z"], of["z"])
    near(rows["offset.y.t1"], -327.68 * of["y"], 327.67 * of["y"], 0.01 * of["y"])
    assert [rows[role]["per"] for role in ("matrix.xx", "offset.x", "offset.x.t1")] == ["", "", "K"]
    assert codes(done.json) == []


def test_bad_input_is_one_line(triaxcal: Run, imu: Any, log: Any, tmp_path: Path) -> None:
    path = log("a.log")
    triaxcal("devices", "check", imu(('"AX"', '"AQ"')), path).failed(2, "no signal 'AQ'; did you mean")
    triaxcal("devices", "check", imu(("rate_hz", "rate_hzz"))).failed(2, "did you mean 'rate_hz'?")
    triaxcal("devices", "check", imu(), tmp_path / "none.log").failed(2, "none.log: cannot be read")
    triaxcal("devices", "check", imu(), imu()).failed(2, "no log of a known kind")
    triaxcal("devices", "check", "triax-ref-modbus", path).failed(2, "driver 'modbus' has no other logs")
    triaxcal("devices", "check", "none").failed(2, "built-in profiles")
    recording = Path(__file__).parents[3] / "recordings" / "can-second-order.mcap"
    triaxcal("devices", "check", "triax-ref-modbus", recording).failed(2, "driver 'can'", "driver is 'modbus'")
    triaxcal("devices", "check", "triax-ref-can", recording, "--node", 5).failed(2, "neither --node nor --channel")
