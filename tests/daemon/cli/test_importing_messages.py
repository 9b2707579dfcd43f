"""log import of other people's MCAP files: ROS 2, JSON and protobuf messages."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from mcap.writer import CompressionType, Writer

from tests.drivers.mcap.test_messages import IMU, IMU_FIELDS, LINE, imu_message

Run = Callable[..., Any]
T0 = 1_700_000_000_000_000_000
PROFILE = """
format = "triaxcal.profile/1"
name = "ros-imu"
driver = "mcap"
identity = { vendor = "Anybody", product = "IMU" }
output = { unit = "m/s²", nominal_scale_factor = [9.80665, 9.80665, 9.80665] }
sampling = { rate_hz = 100 }

[streams.readings]
topic = "/imu"
TIME
channels = { ux = "P.x", uy = "P.y", uz = { field = "P.z", scale = 2.0, offset = 1.0 } }
"""


def profile(folder: Path, path: str = "linear_acceleration", time: str = "header.stamp") -> Path:
    file = folder / "imu.toml"
    file.write_text(PROFILE.replace("P.", f"{path}.").replace("TIME", f'time = "{time}"' if time else ""))
    return file


def values(i: int) -> tuple[float, float, float]:
    return 0.25 * i, -9.5, 0.5


def stamped(message: bytes, sec: int, nanosec: int) -> bytes:
    return message[:4] + struct.pack("<iI", sec, nanosec) + message[12:]


def log_of(
    path: Path,
    messages: list[tuple[int, bytes]],
    schema: tuple[str, str, bytes] | None,
    encoding: str = "cdr",
    **more: Any,
) -> Path:
    with open(path, "wb") as file:
        writer = Writer(file, **more)
        writer.start(profile="ros2")
        number = writer.register_schema(*schema) if schema else 0
        imu = writer.register_channel("/imu", encoding, number)
        other = writer.register_channel("/rosout", "cdr", 0)
        for time_ns, data in messages:
            writer.add_message(imu, time_ns, data, time_ns)
            writer.add_message(other, time_ns, b"\0\1\0\0", time_ns)
        writer.finish()
    return path


def drive(count: int = 20, *, moving: bool = True) -> list[tuple[int, bytes]]:
    """Logged with a jitter of a millisecond, stamped each 10 ms by a clock of its own."""
    return [
        (
            T0 + 10_000_000 * i + 1_000_000 * (i % 2),
            stamped(imu_message("imu_link", values(i)), 5, 10_000_000 * i if moving else 0),
        )
        for i in range(count)
    ]


@pytest.fixture
def imported(triaxcal: Run, tmp_path: Path) -> Callable[..., Any]:
    def take(log: Path, by: Path, *options: Any) -> Any:
        return triaxcal("log", "import", log, "--profile", by, "-o", tmp_path / "rec.mcap", *options)

    return take


def samples(triaxcal: Run, folder: Path) -> Any:
    done = triaxcal("log", "export", folder / "rec.mcap")
    assert done.code == 0, done
    return np.array([line.split(",") for line in done.out.splitlines()[1:]], dtype=float)


def wanted(count: int = 20) -> Any:
    return np.array([[x, y, 2 * z + 1] for x, y, z in map(values, range(count))])


IMU_SCHEMA = ("sensor_msgs/msg/Imu", "ros2msg", IMU.encode())


@pytest.mark.parametrize("compression", list(CompressionType))
def test_an_imu_of_ros_2_goes_by_its_own_stamps(
    tmp_path: Path, triaxcal: Run, imported: Run, compression: CompressionType
) -> None:
    log = log_of(tmp_path / "bag.mcap", drive(), IMU_SCHEMA, compression=compression, chunk_size=2000)
    done = imported(log, profile(tmp_path))
    assert done.code == 0, done
    assert done.err == "left out: 20 messages of other topics\n"
    assert "20 samples in 0.19 s from bag.mcap (MCAP)" in done.out
    found = samples(triaxcal, tmp_path)
    np.testing.assert_allclose(found[:, 0], 0.01 * np.arange(20), atol=1e-9)
    np.testing.assert_array_equal(found[:, 1:], wanted())
    info = triaxcal("log", "info", tmp_path / "rec.mcap", "--json").json
    assert set(info["attachments"]) == {"profile.toml", "profile/readings.schema.json"}
    assert (info["imported"]["taken"], info["imported"]["remarks"]) == (20, [])


@pytest.mark.slow
def test_messages_need_no_chunks(tmp_path: Path, triaxcal: Run, imported: Run) -> None:
    log = log_of(tmp_path / "bag.mcap", drive(), IMU_SCHEMA, use_chunking=False)
    assert imported(log, profile(tmp_path)).code == 0
    np.testing.assert_array_equal(samples(triaxcal, tmp_path)[:, 1:], wanted())


@pytest.mark.slow
def test_an_imu_inside_another_message_whose_stamp_stands_still(tmp_path: Path, triaxcal: Run, imported: Run) -> None:
    text = f"uint8 Node_ID\nsensor_msgs/Imu imu\n{LINE}\nMSG: sensor_msgs/Imu\n{IMU_FIELDS}" + IMU[len(IMU_FIELDS) :]
    inside = [(t, b"\0\1\0\0" + b"\x07\0\0\0" + data[4:]) for t, data in drive(moving=False)]
    log = log_of(tmp_path / "bag.mcap", _aligned(inside), ("vehicle_msgs/msg/Wheel", "ros2msg", text.encode()))
    done = imported(log, profile(tmp_path, "imu.linear_acceleration", "imu.header.stamp"))
    assert done.code == 0, done
    assert "the messages' own time stamp stands still: times are those at which they were logged" in done.err
    found = samples(triaxcal, tmp_path)
    np.testing.assert_allclose(found[:, 0], 0.01 * np.arange(20) + 0.001 * (np.arange(20) % 2), atol=1e-9)
    np.testing.assert_array_equal(found[:, 1:], wanted())


def _aligned(messages: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    """A byte before the rest moves it by four; the numbers, which are aligned to eight, follow in their own way."""
    made = []
    for time_ns, data in messages:
        body = data[4:]
        head, rest = body[:12], body[12:]  # node, stamp
        (length,) = struct.unpack_from("<I", rest)
        name = rest[4 : 4 + length]
        begin = 12 + 4 + length
        after = rest[4 + length :]
        skipped = -(begin - 4) % 8  # as it was aligned without the byte
        numbers = after[skipped:]
        made.append((time_ns, data[:4] + head + rest[:4] + name + bytes(-begin % 8) + numbers))
    return made


@pytest.mark.parametrize("stamp", [{"sec": 5, "nsec": 0}, 5.0, 5_000_000_000])
def test_json_messages(tmp_path: Path, triaxcal: Run, imported: Run, stamp: Any) -> None:
    def at(i: int) -> Any:
        if isinstance(stamp, dict):
            return {"sec": 5, "nsec": 10_000_000 * i}
        return stamp + (0.01 if isinstance(stamp, float) else 10_000_000) * i

    rows = [
        (T0 + i, json.dumps({"t": at(i), "a": dict(zip("xyz", values(i), strict=True))}).encode()) for i in range(20)
    ]
    log = log_of(tmp_path / "bag.mcap", rows, None, "json")
    assert imported(log, profile(tmp_path, "a", "t")).code == 0
    found = samples(triaxcal, tmp_path)
    np.testing.assert_allclose(found[:, 0], 0.01 * np.arange(20), atol=1e-6)
    np.testing.assert_array_equal(found[:, 1:], wanted())


def test_protobuf_messages(tmp_path: Path, triaxcal: Run, imported: Run) -> None:
    file = FileDescriptorProto(name="imu.proto", package="p", syntax="proto3")
    vector = file.message_type.add(name="V")
    for number, axis in enumerate("xyz", 1):
        vector.field.add(name=axis, number=number, type=FieldDescriptorProto.TYPE_DOUBLE)
    imu = file.message_type.add(name="Imu")
    imu.field.add(name="a", number=1, type=FieldDescriptorProto.TYPE_MESSAGE, type_name=".p.V")

    def encoded(i: int) -> bytes:
        inner = b"".join(bytes([8 * n + 1]) + struct.pack("<d", v) for n, v in enumerate(values(i), 1))
        return b"\x0a" + bytes([len(inner)]) + inner

    schema = ("p.Imu", "protobuf", FileDescriptorSet(file=[file]).SerializeToString())
    rows = [(T0 + 10_000_000 * i, encoded(i)) for i in range(20)]
    assert imported(log_of(tmp_path / "bag.mcap", rows, schema, "protobuf"), profile(tmp_path, "a", "")).code == 0
    found = samples(triaxcal, tmp_path)
    np.testing.assert_allclose(found[:, 0], 0.01 * np.arange(20), atol=1e-9)
    np.testing.assert_array_equal(found[:, 1:], wanted())


def test_what_is_not_there_is_named_with_the_nearest(tmp_path: Path, imported: Run) -> None:
    log = log_of(tmp_path / "bag.mcap", drive(), IMU_SCHEMA)
    imported(log, profile(tmp_path, "linear_accelaration")).failed(
        2, "no field 'linear_accelaration'; did you mean 'linear_acceleration'?"
    )
    imported(log, profile(tmp_path, time="header.stamp.second")).failed(2, "no field 'second' in 'header.stamp'")
    by = profile(tmp_path)
    by.write_text(by.read_text().replace("/imu", "/imu/data"))
    imported(log, by).failed(2, "no message on topic '/imu/data'; did you mean '/imu'?")
    assert not (tmp_path / "rec.mcap").exists()


@pytest.mark.slow
def test_messages_that_are_not_as_defined_are_counted(tmp_path: Path, triaxcal: Run, imported: Run) -> None:
    rows = drive()
    rows[3] = (rows[3][0], rows[3][1][:50])
    rows[5] = (rows[5][0], bytes(70_000))
    done = imported(log_of(tmp_path / "bag.mcap", rows, IMU_SCHEMA), profile(tmp_path), "--json")
    counts = done.json["samples"]
    assert (counts["samples"], counts["errors"], counts["malformed"]) == (18, 0, 1)
    assert (done.json["damaged"], done.json["damage"]) == (1, "message 11: 70000 bytes, expected at most 65535")
    rows = [(t, data[:50]) for t, data in drive()]
    (tmp_path / "rec.mcap").unlink()
    imported(log_of(tmp_path / "bad.mcap", rows, IMU_SCHEMA), profile(tmp_path)).failed(
        2,
        "no sample in its 20 messages of the profile: 20 too short for the profile's message, or not as it is defined",
    )


@pytest.mark.slow
def test_a_file_cut_anywhere_gives_what_is_whole(tmp_path: Path, imported: Run) -> None:
    whole = log_of(tmp_path / "bag.mcap", drive(), IMU_SCHEMA, chunk_size=2000).read_bytes()
    by = profile(tmp_path)
    for cut in range(9, len(whole), 397):
        (tmp_path / "cut.mcap").write_bytes(whole[:cut])
        done = imported(tmp_path / "cut.mcap", by, "--json")
        assert done.code in (0, 2)
        assert "Traceback" not in done.err
        assert not done.code or done.err.count("\n") == 1
        (tmp_path / "rec.mcap").unlink(missing_ok=True)


def test_a_profile_and_a_log_of_unlike_kinds_are_refused(tmp_path: Path, triaxcal: Run, imported: Run) -> None:
    log = log_of(tmp_path / "bag.mcap", drive(), IMU_SCHEMA)
    triaxcal("log", "import", log, "--profile", "triax-ref-can", "-o", tmp_path / "r.mcap").failed(
        2, f"{log}: MCAP, which holds no frames of CAN; the profile's driver is 'can'"
    )
    imported(log, profile(tmp_path), "--node", "5").failed(2, "--node: of a CAN bus; the profile's driver is")
    frames = tmp_path / "a.log"
    frames.write_text("(1436509052.249713) vcan0 044#2A366C2B\n")
    imported(frames, profile(tmp_path)).failed(2, "candump, which holds no messages; the profile's driver is 'mcap'")


def test_there_is_no_bus_to_run_or_record_on(tmp_path: Path, triaxcal: Run) -> None:
    profile(tmp_path)
    station = tmp_path / "station.toml"
    station.write_text(
        'format = "triaxcal.station/1"\nname = "b"\n[[units]]\nname = "u"\nprofile = "imu.toml"\nbus = {}\n'
        "signs = [1, 1, 1]\n"
    )
    for command in (["run", station], ["record", station, "-o", tmp_path / "r.mcap"]):
        done = triaxcal(*command)
        assert done.code == 2, done
        assert "driver 'mcap' reads logs and no bus: `triaxcal log import` takes them" in done.err
        assert "Traceback" not in done.err


def of_two(
    path: Path, messages: list[tuple[int, int, bytes]], schemas: tuple[tuple[str, str, bytes], ...] = ()
) -> Path:
    """Messages of two publishers on one topic: which, when, what."""
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        numbers = [writer.register_schema(*schema) for schema in schemas or (IMU_SCHEMA,)]
        channels = [
            writer.register_channel("/imu", "cdr", numbers[i % len(numbers)], {"callerid": f"/imu_{side}", "qos": "x"})
            for i, side in enumerate(("left", "right"))
        ]
        for which, time_ns, data in messages:
            writer.add_message(channels[which], time_ns, data, time_ns)
        writer.finish()
    return path


def test_two_publishers_on_one_topic_are_asked_about(tmp_path: Path, triaxcal: Run, imported: Run) -> None:
    messages = [(i % 2, time_ns, data) for i, (time_ns, data) in enumerate(drive(21))]
    log, by = of_two(tmp_path / "bag.mcap", messages), profile(tmp_path)
    there = "1 (callerid /imu_left, 11 messages), 2 (callerid /imu_right, 10 messages)"
    imported(log, by).failed(
        2, f"{log}: topic '/imu' comes on the channels {there}; --channel says which is the unit's"
    )
    imported(log, by, "--channel", "7").failed(2, f"--channel 7: {log} has {there}")
    assert not (tmp_path / "rec.mcap").exists()
    done = imported(log, by, "--channel", "2")
    assert (done.code, done.err) == (0, "left out: 11 of other channels or nodes\n")
    np.testing.assert_allclose(samples(triaxcal, tmp_path)[:, 1:4], wanted(21)[1::2])


def test_a_publisher_that_is_started_anew_has_a_second_channel(tmp_path: Path, triaxcal: Run, imported: Run) -> None:
    messages = [(int(i >= 12), time_ns, data) for i, (time_ns, data) in enumerate(drive())]
    done = imported(of_two(tmp_path / "bag.mcap", messages), profile(tmp_path))
    assert (done.code, done.err) == (
        0, "the messages come on one channel after another, as of a publisher started anew: all are taken\n"
    )  # fmt: skip
    np.testing.assert_allclose(samples(triaxcal, tmp_path)[:, 1:4], wanted())


def test_a_channel_may_be_asked_for_whose_topic_has_messages_of_two_definitions(
    tmp_path: Path, triaxcal: Run, imported: Run
) -> None:
    messages = [(0, T0 - 1, b"\0\1\0\0"), *((1, time_ns, data) for time_ns, data in drive())]
    other = ("std_msgs/msg/Float64", "ros2msg", b"float64 data")
    log, by = of_two(tmp_path / "bag.mcap", messages, (other, IMU_SCHEMA)), profile(tmp_path)
    assert imported(log, by).code == 2
    assert imported(log, by, "--channel", "2").code == 0
    np.testing.assert_allclose(samples(triaxcal, tmp_path)[:, 1:4], wanted())


def test_poses_and_fit_take_the_recording(tmp_path: Path, triaxcal: Run, imported: Run) -> None:
    assert imported(log_of(tmp_path / "bag.mcap", drive(), IMU_SCHEMA), profile(tmp_path)).code == 0
    assert triaxcal("fit", tmp_path / "rec.mcap").code == 3
    assert triaxcal("poses", tmp_path / "rec.mcap", "--json").code in (0, 3)
