"""Numbers out of CDR: what rosbags' own encoder wrote, and literal bytes."""

from __future__ import annotations

import struct
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.mcap.definitions import Fields, message_types
from triaxcal_drivers.mcap.driver import DEEPEST, DEFINITION_MOST, CdrReader

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
    return message_types(name, "ros2msg", text.encode())


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
    name, types = message_types("pkg/msg/Foo", "ros2idl", idl.encode())
    data = b"\0\1\0\0" + struct.pack("<3dI3sxf", 1, 2, 3, 3, b"abc", 0.5)
    assert CdrReader(name, types, [["Bar_1", "X", "2"], ["z"]], "p").read(data) == [3, 0.5]


def rosbags_types(text: str, name: str) -> dict[str, list[str]]:
    """Fields of each message as rosbags, an independent peer, reads them."""
    return {str(n): [f for f, _ in fields] for n, (_, fields) in rosbags.get_types_from_msg(text, name).items()}


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_every_message_of_ros_2_is_read_as_rosbags_reads_it(end: str) -> None:
    store = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
    for name in store.types:
        text, _ = store.generate_msgdef(name, ros_version=2)
        _, types = types_of(text.replace("\n", end), name)
        peers = rosbags_types(text, name)
        placeholder = {n for n, fields in peers.items() if not fields}
        assert {n: [f for f, _ in fields] for n, fields in types.items() if n not in placeholder} == {
            n: fields for n, fields in peers.items() if n not in placeholder
        }


def idl_of(name: str, body: str) -> str:
    package, _, bare = name.split("/")
    return f"{LINE}\nIDL: {name}\n{body}\n" if "module" in body else (
        f"{LINE}\nIDL: {name}\nmodule {package} {{ module msg {{ struct {bare} {{ {body} }}; }}; }};\n"
    )  # fmt: skip


IDL_IMU = """// generated from rosidl_adapter/resource/msg.idl.em
#pragma once
#define LONG(a) \\
  strange { a
#include "geometry_msgs/msg/Vector3.idl"
  # include "std_msgs/msg/Header.idl"

module sensor_msgs {
  module msg {
    module Imu_Constants {
      const string KIND = "a { b; " "c";
      const uint32 N = 9;
    };
    typedef double double__9[9];
    @verbatim (language="comment", text=
      "Accelerations } in (m/s^2)" "\\n" "don't")
    struct Imu {
      @key std_msgs::msg::Header header; /* a remark;
      struct in two lines */
      sequence<string<8>, 4> notes;
      @default (value=TRUE) boolean ok, good;
      double__9 orientation_covariance;
      float rows[2][Imu_Constants::N];
      pkg::msg::Colour colour;
      @unit (value="m/s^2")
      geometry_msgs::msg::Vector3 linear_acceleration;
      union_like<3> odd;
    };
  };
};"""


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_idl_of_real_packages_is_read(end: str) -> None:
    idl = (
        idl_of("sensor_msgs/msg/Imu", IDL_IMU)
        + idl_of("geometry_msgs/msg/Vector3", "double x; double y; double z;")
        + idl_of("std_msgs/msg/Header", "builtin_interfaces::msg::Time stamp; string frame_id;")
        + idl_of("builtin_interfaces/msg/Time", "int32 sec; uint32 nanosec;")
        + idl_of("pkg/msg/Colour", "module pkg { module msg { enum Colour { RED, GREEN }; }; };")
    )
    name, types = message_types("sensor_msgs/msg/Imu", "ros2idl", idl.replace("\n", end).encode())
    data = struct.pack("<iII4sI??", 5, 6, 4, b"imu\0", 0, True, False)
    data += bytes(-len(data) % 8) + struct.pack("<9d18fI", *range(9), *range(18), 1)
    data += bytes(-len(data) % 8) + struct.pack("<3d", 0.5, -9.8, 1e-3)
    paths = [*ACCELERATION, ["header", "stamp", "sec"], ["rows", "1", "3"], ["colour"]]
    assert CdrReader(name, types, paths, "p").read(b"\0\1\0\0" + data) == [0.5, -9.8, 1e-3, 5, 12.0, 1]


UNUSUAL = """float64 f nan
string s a text
string KIND="a # b"  # remark
wstring<=4 note "x"
	int8  a	-1
byte[ 2 ] B [1, 2]
float64 x"""


def test_unusual_lines_of_msg_are_read() -> None:
    name, types = types_of("\ufeff@verbatim\n" + UNUSUAL + "\n$%& behind it")
    assert [field for field, _ in types[name]] == ["f", "s", "note", "a", "B", "x", ""]
    data = b"\0\1\0\0" + struct.pack("<dIIb2B5xd", 0, 0, 0, -1, 1, 2, 0.25)
    assert CdrReader(name, types, [["x"], ["a"]], "p").read(data) == [0.25, -1]


@pytest.mark.parametrize(
    ("language", "definition", "path", "line"),
    [
        ("ros2msg", "float64 x\n$%&\nfloat64 y", "y", 2),
        ("ros2msg", "float64 x\r\n\r\n$%&\r\nfloat64 y", "y", 3),
        ("ros2msg", "float64 x\n$%&\n", "z", 2),
        ("ros2msg", f"pkg/In a\nfloat64 y\n{LINE}\nMSG: pkg/In\nint8 a\nint8 \xe4\n", "y", 6),
        ("ros2idl", idl_of("pkg/msg/Foo", "double x;\nlong double w;\ndouble y;"), "y", 4),
        ("ros2idl", idl_of("pkg/msg/Foo", "double x;\nmap<string, long> w;\ndouble y;"), "y", 4),
        ("ros2idl", f"#include <a>\n{idl_of('pkg/msg/Foo', 'double x[M];')}", "x.0", 4),
        ("ros2idl", idl_of("pkg/msg/Foo", "module pkg { module msg {\nunion Foo { }; }; };"), "y", 4),
    ],
)
def test_the_line_that_cannot_be_read_is_named(language: str, definition: str, path: str, line: int) -> None:
    name, types = message_types("pkg/Foo", language, definition.encode("latin1"))
    with pytest.raises(ProfileError) as caught:
        CdrReader(name, types, [path.split(".")], "profile p")
    text = definition.replace("\r\n", "\n").split("\n")[line - 1]
    assert f"line {line} " in str(caught.value)
    assert text.encode("ascii", "ignore").decode().strip()[:4] in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_line_behind_the_fields_of_the_profile_does_not_matter() -> None:
    name, types = message_types("pkg/Foo", "ros2msg", b"float64 x\n$%&\nfloat64 y")
    assert CdrReader(name, types, [["x"]], "p").read(b"\0\1\0\0" + struct.pack("<d", 2.0)) == [2.0]


def test_a_type_that_the_definition_lacks_is_named() -> None:
    name, types = types_of("pkg/Other a\nfloat64 x")
    with pytest.raises(ProfileError, match="lacks that of 'pkg/msg/Other'"):
        CdrReader(name, types, [["x"]], "profile p")


@pytest.mark.parametrize(
    "piece",
    ["/*", '"\\', "'", "@a(", "module a {", "struct A {", "double x[", "sequence<", "=" * 80 + "\n", "a::", "x "],
)
@pytest.mark.parametrize("language", ["ros2idl", "ros2msg"])
def test_a_long_definition_without_sense_takes_no_long_time(piece: str, language: str) -> None:
    started = time.process_time()
    message_types("pkg/Foo", language, (piece * DEFINITION_MOST)[:DEFINITION_MOST].encode())
    assert time.process_time() - started < 20  # a time that grows by the square would be minutes
