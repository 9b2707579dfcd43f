"""Numbers out of CDR: what rosbags' own encoder wrote, and literal bytes."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.mcap.driver import DEEPEST, CdrReader, Fields, message_types

rosbags = pytest.importorskip("rosbags.typesys")

LINE = "=" * 80
STAMP = "builtin_interfaces/Time stamp\nstring frame_id\n"
TIME = f"{LINE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
VECTOR = f"{LINE}\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n"
QUATERNION = f"{LINE}\nMSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
IMU_FIELDS = (
    "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance\n"
)
HEADER = f"{LINE}\nMSG: std_msgs/Header\n{STAMP}{TIME}"
IMU = f"{IMU_FIELDS}{HEADER}{QUATERNION}{VECTOR}"
ACCELERATION = [["linear_acceleration", axis] for axis in "xyz"]


def types_of(text: str, name: str = "pkg/msg/Mixed") -> tuple[str, Mapping[str, Fields]]:
    return message_types(name, "ros2msg", text.encode(), "profile p")


def imu_message(frame_id: str, acceleration: tuple[float, float, float]) -> bytes:
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    make = {name.rpartition("/")[2]: kind for name, kind in store.types.items()}
    stamp = make["Time"](sec=1_700_000_000, nanosec=5)
    nine = np.arange(9.0)
    message = make["Imu"](
        header=make["Header"](stamp=stamp, frame_id=frame_id),
        orientation=make["Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=nine,
        angular_velocity=make["Vector3"](x=1.0, y=2.0, z=3.0),
        angular_velocity_covariance=nine,
        linear_acceleration=make["Vector3"](*acceleration),
        linear_acceleration_covariance=nine,
    )
    return bytes(store.serialize_cdr(message, "sensor_msgs/msg/Imu"))


@pytest.mark.parametrize("frame_id", ["", "a", "imu_link", "x" * 100])
def test_an_imu_is_read_as_rosbags_wrote_it(frame_id: str) -> None:
    name, types = types_of(IMU, "sensor_msgs/msg/Imu")
    paths = [*ACCELERATION, ["header", "stamp", "sec"], ["header", "stamp", "nanosec"], ["orientation_covariance", "8"]]
    read = CdrReader(name, types, paths, "p").read
    assert read(imu_message(frame_id, (0.5, -9.8, 1e-3))) == [0.5, -9.8, 1e-3, 1_700_000_000, 5, 8.0]


MIXED = "uint8 Kind\nfloat32[3] ACC\nstring[] names\npkg/Inner[] inner\nint16 last\n" + (
    f"{LINE}\nMSG: pkg/Inner\nbool ok\nfloat64 Value_1\n"
)


@pytest.mark.parametrize("order", ["<", ">"])
def test_capitals_sequences_and_both_byte_orders(order: str) -> None:
    name, types = types_of(MIXED)
    body = struct.pack(order + "B3x3f", 7, 1.0, 2.0, 3.0)  # at 0, and at 4
    body += struct.pack(order + "I", 2)  # two names, at 16
    body += struct.pack(order + "I2s2x", 2, b"a\0") + struct.pack(order + "I3sx", 3, b"bc\0")  # to 36
    body += struct.pack(order + "I", 2)  # two inner ones, to 40
    body += struct.pack(order + "?7xd", True, 0.25) + struct.pack(order + "?7xd", False, 0.5)
    body += struct.pack(order + "h", -2)
    data = (b"\x00\x01\x00\x00" if order == "<" else b"\x00\x00\x00\x00") + body
    paths = [["Kind"], ["ACC", "1"], ["inner", "1", "Value_1"], ["inner", "0", "ok"], ["last"]]
    assert CdrReader(name, types, paths, "p").read(data) == [7, 2.0, 0.5, True, -2]


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("ACX", "no field 'ACX'; did you mean 'ACC'?"),
        ("inner.0.Value", "no field 'Value' in 'inner.0'; did you mean 'Value_1'?"),
        ("ACC.3", "'ACC.3' is beyond the array's 3 elements"),
        ("ACC", "'ACC' is no number"),
        ("names.0", "'names.0' is no number"),
        ("Kind.x", "'Kind' has no field 'x'"),
    ],
)
def test_a_path_to_no_number_is_named_with_the_nearest(path: str, words: str) -> None:
    name, types = types_of(MIXED)
    with pytest.raises(ProfileError) as caught:
        CdrReader(name, types, [path.split(".")], "profile p")
    assert str(caught.value) == f"profile p: {words}"


def test_a_message_cut_anywhere_is_no_message() -> None:
    name, types = types_of(IMU, "sensor_msgs/msg/Imu")
    read = CdrReader(name, types, ACCELERATION, "p").read
    whole = imu_message("imu", (1.0, 2.0, 3.0))
    for cut in range(len(whole) - 72):
        with pytest.raises(ValueError):
            read(whole[:cut])


@pytest.mark.parametrize(
    "data", [b"", b"\0\1", b"\0\3\0\0" + bytes(400), b"\0\1\0\0" + bytes(8) + b"\xff\xff\xff\xff" + bytes(400)]
)
def test_lengths_are_not_believed(data: bytes) -> None:
    name, types = types_of(IMU, "sensor_msgs/msg/Imu")
    with pytest.raises(ValueError):
        CdrReader(name, types, ACCELERATION, "p").read(data)


def test_a_definition_that_holds_itself_ends() -> None:
    types: Any = {"a/msg/A": [("a", ("message", "a/msg/A")), ("x", ("base", "float64"))]}
    with pytest.raises(ValueError, match="nested too deeply"):
        CdrReader("a/msg/A", types, [["x"]], "p").read(b"\0\1\0\0" + bytes(8 * DEEPEST))


def test_idl_definitions_are_read() -> None:
    parts = {"Foo": "pkg::msg::Bar Bar_1; float z;", "Bar": "double X[3]; sequence<octet> b;"}
    idl = "".join(
        f"{LINE}\nIDL: pkg/msg/{name}\n// generated\nmodule pkg {{ module msg {{ struct {name} {{ {body} }}; }}; }};\n"
        for name, body in parts.items()
    )
    name, types = message_types("pkg/msg/Foo", "ros2idl", idl.encode(), "p")
    data = b"\0\1\0\0" + struct.pack("<3dI3sxf", 1, 2, 3, 3, b"abc", 0.5)
    assert CdrReader(name, types, [["Bar_1", "X", "2"], ["z"]], "p").read(data) == [3, 0.5]


@pytest.mark.parametrize("text", ["float64 x\n$%&\n", "\xff"])
def test_a_definition_that_cannot_be_read_is_an_error_of_one_line(text: str) -> None:
    with pytest.raises(ProfileError) as caught:
        message_types("pkg/Foo", "ros2msg", text.encode("latin1"), "profile p")
    assert "\n" not in str(caught.value)
    assert "profile p: the definition of 'pkg/Foo'" in str(caught.value)
