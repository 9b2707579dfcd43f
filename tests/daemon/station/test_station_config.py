"""A station file that is wrong is refused with one line: file, line, field, what was expected."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.can.driver import CanDriver
from triaxcal_drivers.can.model import CanBus
from triaxcal_drivers.catalogue import load_bundle
from triaxcal_drivers.errors import DriverError
from triaxcald.errors import InputError
from triaxcald.station.config import Station, check_lines, load_station

PROFILE = load_bundle(Path("triax-ref-can")).profile

GOOD = """\
format = "triaxcal.station/1"
name = "bench"

[plan]
poses = 14
hold_s = 2.0

[limits]
rms_g = 5e-5

[[units]]
name = "left"
profile = "triax-ref-can"
serial = "4711"
bus = { interface = "virtual", channel = "x", node_id = 5 }

[[units]]
name = "right"
profile = "triax-ref-modbus"
bus = { host = "127.0.0.1", port = 502 }
"""


def test_a_sound_station_gives_its_places_and_its_own_text(tmp_path: Path) -> None:
    path = tmp_path / "station.toml"
    path.write_text(GOOD)
    station = load_station(path)
    assert station.text == GOOD.encode()
    assert station.folder == tmp_path / "."
    left, right = station.places
    assert left.address == "interface=virtual, channel=x, node_id=5"
    assert left.signs == right.signs == (-1, -1, -1)
    assert station.file.plan.check_poses == 6
    assert station.file.limits.verification_rms_g is None
    assert station.file.provisioning.write
    assert station.place("right") is right


def test_signs_of_the_station_go_before_those_of_the_profile(tmp_path: Path) -> None:
    path = tmp_path / "station.toml"
    path.write_text(GOOD.replace('serial = "4711"', "signs = [1, -1, 1]"))
    assert load_station(path).places[0].signs == (1, -1, 1)


def test_a_profile_beside_the_station_goes_before_a_built_in_one(tmp_path: Path, workshop: Any) -> None:
    name = workshop.impatient_profile()
    path = tmp_path / "station.toml"
    path.write_text(GOOD.replace('"triax-ref-modbus"', f'"{name}"'))
    assert load_station(path).places[1].bundle.profile.sampling.silence_timeout_s == 0.5


def test_one_of_several_units_has_to_be_named(tmp_path: Path) -> None:
    path = tmp_path / "station.toml"
    path.write_text(GOOD)
    station = load_station(path)
    for name in (None, "middle"):
        with pytest.raises(InputError, match=r"station\.toml: units: name one of left, right with --unit"):
            station.place(name)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('name = "bench"', 'nam = "bench"', "line 2: nam: unknown key; did you mean 'name'?"),
        ("poses = 14", "pose = 14", "line 5: plan.pose: unknown key; did you mean 'poses'?"),
        ("poses = 14", "poses = 8", "line 5: plan.poses: input should be greater than or equal to 9, not 8"),
        ("poses = 14", "poses = 14.5", "line 5: plan.poses: input should be a valid integer"),
        ("poses = 14", 'poses = "14"', "line 5: plan.poses: input should be a valid integer, not '14'"),
        ("hold_s = 2.0", "hold_s = nan", "line 6: plan.hold_s: "),
        ("rms_g = 5e-5", "rms_g = 0.0", "line 9: limits.rms_g: input should be greater than 0"),
        ("rms_g = 5e-5", "rms_g = inf", "line 9: limits.rms_g: "),
        ('serial = "4711"', "serial = 4711", "line 14: units.0.serial: input should be a valid string, not 4711"),
        ('serial = "4711"', "signs = [1, 0, 1]", "line 14: units.0.signs.1: input should be -1 or 1, not 0"),
        ('name = "left"', 'name = "le ft"', "line 12: units.0.name: "),
        ('name = "left"', 'name = "../left"', "line 12: units.0.name: "),
        ('name = "left"', 'name = "right"', "units: the name 'right' is given twice"),
        ('format = "triaxcal.station/1"', 'format = "triaxcal.station/2"', "line 1: format: "),
        ('format = "triaxcal.station/1"\n', "", "format: missing"),
        ('name = "bench"', "name = bench", "not TOML: "),
        ('name = "bench"', 'name = "b\xe9nch"', "not UTF-8 text (byte "),
        ("node_id = 5", "node = 5", "units.0.bus: node: unknown key; did you mean 'node_id'?"),
        ("node_id = 5", "node_id = 128", "units.0.bus: node_id: input should be less than or equal to 127"),
        (", node_id = 5", "", "units.0.bus: node_id: missing"),
        ("port = 502", "port = 70000", "units.1.bus: port: input should be less than or equal to 65535"),
        ('host = "127.0.0.1", ', "", 'units.1.bus: give either host = "…" (Modbus TCP) or serial_port = "…" (RTU)'),
        ('host = "127.0.0.1"', 'host = "a", serial_port = "/dev/b"', "units.1.bus: give either host"),
        ('profile = "triax-ref-can"', 'profile = "triax-ref-cna"', "triax-ref-cna: No such file or directory"),
    ],
)
def test_a_fault_is_said_with_file_line_and_field(tmp_path: Path, old: str, new: str, words: str) -> None:
    path = tmp_path / "station.toml"
    assert old in GOOD
    path.write_bytes(GOOD.replace(old, new, 1).encode("latin-1"))
    with pytest.raises((InputError, DriverError)) as caught:
        load_station(path)
    message = str(caught.value)
    assert words in message
    assert "\n" not in message
    assert "profile: give" not in message
    assert "triax-ref-cna" in message or message.startswith(str(path))


TRAY = """\

[fixture]
together = true
faces = { "+x" = "A", "-z" = "lid" }

[rules]
serial = "[0-9]{4}"
attempts = 3
golden = { serial = "0001", every_h = 24, calibration = "golden.json" }

[work]
operator = "Ada"
order = "WO-7"
"""


def _tray(tmp_path: Path, old: str = "", new: str = "") -> Path:
    text = GOOD.replace('serial = "4711"', 'serial = "4711"\nmounting = "-y+x+z"').replace(
        "[[units]]", f"{TRAY}\n[[units]]", 1
    )
    text = text.replace("\nrms_g = 5e-5", "\nverification_rms_g = 5e-5", 1)  # by which the golden unit is judged
    assert old in text
    path = tmp_path / "station.toml"
    path.write_text(text.replace(old, new, 1))
    return path


def test_a_station_without_a_fixture_turns_each_unit_by_itself(tmp_path: Path) -> None:
    path = tmp_path / "station.toml"
    path.write_text(GOOD)
    file = load_station(path).file
    assert not file.fixture.together
    assert [unit.mounting for unit in file.units] == ["+x+y+z"] * 2
    assert file.fixture.names == {a: a.upper() for a in ("+x", "-x", "+y", "-y", "+z", "-z")}
    assert file.rules.model_dump() == {
        "serial": None, "attempts": None, "operator": False, "retest_reason": False, "open_loopback": False,
        "golden": None,
    }  # fmt: skip
    assert set(file.work.model_dump().values()) == {None}


def test_fixture_rules_and_work_are_read(tmp_path: Path) -> None:
    file = load_station(_tray(tmp_path)).file
    assert file.fixture.together
    assert file.fixture.names == {"+x": "A", "-x": "-X", "+y": "+Y", "-y": "-Y", "+z": "+Z", "-z": "lid"}
    assert [unit.mounting for unit in file.units] == ["-y+x+z", "+x+y+z"]
    assert (file.rules.serial, file.rules.attempts) == ("[0-9]{4}", 3)
    assert file.rules.golden is not None
    assert (file.rules.golden.serial, file.rules.golden.every_h, file.rules.golden.calibration) == (
        "0001", 24, "golden.json",
    )  # fmt: skip
    assert (file.work.operator, file.work.order, file.work.batch) == ("Ada", "WO-7", None)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("together = true", "together = 1", "line 13: fixture.together: input should be a valid boolean, not 1"),
        ("together = true", "togethr = true", "line 13: fixture.togethr: unknown key; did you mean 'together'?"),
        ('"+x" = "A"', '"+w" = "A"', "line 14: fixture.faces: unknown axis '+w', expected +x, -x, +y, -y, +z, -z"),
        ('"+x" = "A"', '"+X" = "A"', "line 14: fixture.faces: unknown axis '+X', "),
        ('"+x" = "A"', '"+x" = "lid"', "line 14: fixture.faces: two faces have the name 'lid'"),
        ('"+x" = "A"', '"+x" = "-Y"', "line 14: fixture.faces: two faces have the name '-Y'"),
        ('"+x" = "A"', '"+x" = ""', "line 14: fixture.faces: +x: expected a name of 1 to 24 printable characters"),
        ('"+x" = "A"', f'"+x" = "{25 * "A"}"', "line 14: fixture.faces: +x: expected a name of 1 to 24 printable"),
        ('"+x" = "A"', '"+x" = "A\\u001b"', "line 14: fixture.faces: +x: expected a name of 1 to 24 printable"),
        ('"+x" = "A"', '"+x" = 1', "line 14: fixture.faces.+x: input should be a valid string, not 1"),
        ('"-y+x+z"', '"+x-y+z"', "line 29: units.0.mounting: a mirror image, no rotation"),
        ('"-y+x+z"', '"+x+x+z"', "line 29: units.0.mounting: the fixture's x axis is given twice"),
        ('"-y+x+z"', '"xyz"', "line 29: units.0.mounting: expected three axes of the fixture"),
        ('"-y+x+z"', "1", "line 29: units.0.mounting: input should be a valid string, not 1"),
        ("[0-9]{4}", "[0-9", "line 17: rules.serial: expected a regular expression: unterminated character set"),
        ("attempts = 3", "attempts = 0", "line 18: rules.attempts: input should be greater than or equal to 1, not 0"),
        ("attempts = 3", 'operator = "yes"', "line 18: rules.operator: input should be a valid boolean, not 'yes'"),
        ("attempts = 3", "retest_reason = 1", "line 18: rules.retest_reason: input should be a valid boolean"),
        ("attempts = 3", "open_loopback = 1", "line 18: rules.open_loopback: input should be a valid boolean"),
        ("every_h = 24", "every_h = 0", "line 19: rules.golden.every_h: input should be greater than 0, not 0"),
        ('serial = "0001"', 'serial = ""', "line 19: rules.golden.serial: expected 1 to 64 characters, not ''"),
        (', calibration = "golden.json"', "", "line 19: rules.golden.calibration: missing"),
        ("verification_rms_g", "rms_g", "rules.golden: give limits.verification_rms_g too, by which the golden unit"),
        ('"Ada"', '""', "line 22: work.operator: expected 1 to 64 characters, not ''"),
        ('"Ada"', f'"{65 * "a"}"', "line 22: work.operator: expected 1 to 64 characters, not 'aaaa"),
        ('"Ada"', '"A\\u0007da"', "line 22: work.operator: expected printable characters alone"),
        ("order =", "slot =", "line 23: work.slot: unknown key"),
    ],
)
def test_a_fault_of_fixture_rules_or_work_is_said_with_file_line_and_key(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    path = _tray(tmp_path, old, new)
    with pytest.raises((InputError, DriverError)) as caught:
        load_station(path)
    message = str(caught.value)
    assert message.startswith((f"{path}, {words}", f"{path}: {words}"))
    assert "\n" not in message


TCP = {"host": "127.0.0.1", "port": 1502}
RTU = {"serial_port": "/dev/ttyUSB0", "baudrate": 115200, "parity": "N"}


@pytest.mark.parametrize(
    ("a", "b", "words"),
    [
        ({"bus": TCP}, {"bus": {**TCP, "host": "LOCALHOST"}},
         "units.1.bus: unit b is in the place of unit a (host=127.0.0.1, port=1502)"),
        ({"bus": RTU}, {"bus": {**RTU, "unit_id": 1}}, "units.1.bus: unit b is in the place of unit a (serial_port="),
        ({"bus": TCP, "serial": "0815"}, {"bus": RTU, "serial": " 00815"},
         "units.1.serial: unit b has the serial number of unit a, 0815"),
    ],
)  # fmt: skip
def test_two_units_that_are_one_device_are_refused(
    workshop: Any, a: dict[str, Any], b: dict[str, Any], words: str
) -> None:
    third = {"name": "c", "bus": {**TCP, "unit_id": 3}, "serial": "9"}
    path = workshop.station({"name": "a", **a}, {"name": "b", **b}, third)
    with pytest.raises(InputError, match=rf"^{path}: {re.escape(words)}"):
        load_station(path)


def test_units_of_one_gateway_and_of_one_line_are_different_places(workshop: Any) -> None:
    buses = [TCP, {**TCP, "unit_id": 2}, {**TCP, "port": 1503}, RTU, {**RTU, "unit_id": 2}]
    units = [{"name": f"u{i}", "bus": bus, "serial": str(i)} for i, bus in enumerate(buses, 1)]
    assert len(load_station(workshop.station(*units)).places) == 5


def on_one_line(workshop: Any, *buses: dict[str, Any]) -> Station:
    units = [{"name": f"u{i}", "bus": {**bus, "unit_id": i}, "serial": str(i)} for i, bus in enumerate(buses, 1)]
    return load_station(workshop.station(*units))


def test_a_line_that_cannot_carry_its_units_is_refused_with_the_arithmetic(workshop: Any) -> None:
    """A read of 123 words: 8 + 251 bytes of 10 bits at 115200 baud, two gaps of 1.75 ms; 100/12 a second, by stream."""
    check_lines(on_one_line(workshop, RTU, RTU).places, where="a.toml")
    each = " + ".join(f"u{i} {stream} 8.33/s × 26 ms" for i in (1, 2, 3) for stream in ("readings", "corrected"))
    words = (
        f"a.toml: /dev/ttyUSB0 at 115200 baud, parity N, 1 stop bits cannot carry its units at their rates: {each} = "
    )
    with pytest.raises(InputError, match=f"^{re.escape(words)}130% of its time; drive it faster, or lower"):
        check_lines(on_one_line(workshop, RTU, RTU, RTU).places, where="a.toml")


def on_one_bus(workshop: Any, count: int, **settings: Any) -> Station:
    bus = {"interface": "virtual", "channel": "busy", **settings}
    units = [
        {"name": f"u{i}", "profile": "triax-ref-can", "bus": {**bus, "node_id": i}, "serial": str(i)}
        for i in range(1, count + 1)
    ]
    return load_station(workshop.station(*units))


def test_a_bus_that_cannot_carry_its_units_is_refused_with_the_arithmetic(workshop: Any) -> None:
    """Two frames a sample and stream, 100 times a second, of 8 bytes and 47 bits beside: 22.2 kbit/s."""
    check_lines(on_one_bus(workshop, 2, bitrate=125_000).places, where="a.toml")
    check_lines(on_one_bus(workshop, 8).places, where="a.toml")  # who knows how fast it is
    each = " + ".join(f"u{i} {stream} 200/s × 0.888 ms" for i in (1, 2, 3) for stream in ("readings", "corrected"))
    bus = f"virtual busy of process {os.getpid()} at 125000 bit/s"
    words = f"a.toml: {bus} cannot carry its units at their rates: {each} = 107% of its time"
    with pytest.raises(InputError, match=f"^{re.escape(words)}"):
        check_lines(on_one_bus(workshop, 3, bitrate=125_000).places, where="a.toml")


@pytest.mark.parametrize("options", [{"fd": True}, {"data_bitrate": 2_000_000}])
def test_a_bus_on_which_frames_may_be_fast_is_not_judged_by_its_bit_rate(
    workshop: Any, options: dict[str, Any]
) -> None:
    check_lines(on_one_bus(workshop, 3, bitrate=125_000, options=options).places, where="a.toml")
    check_lines(on_one_bus(workshop, 3, bitrate=125_000, interface="socketcan").places, where="a.toml")
    classic = on_one_bus(workshop, 3, bitrate=125_000, interface="socketcan", options={"fd": False})
    with pytest.raises(InputError, match="cannot carry its units"):
        check_lines(classic.places, where="a.toml")


def test_a_frame_that_two_streams_take_is_sent_once() -> None:
    bundle = load_bundle(Path("triax-ref-can"))
    streams = {"readings": bundle.profile.streams["readings"], "corrected": bundle.profile.streams["readings"]}
    twice = replace(bundle, profile=bundle.profile.model_copy(update={"streams": streams}))
    bus = CanBus(interface="virtual", channel="busy", node_id=5, bitrate=125_000)
    assert list(CanDriver().loads(twice, bus)) == ["readings"]


def test_a_station_is_read_whatever_its_lines_carry_and_one_unit_of_it_is_recorded(workshop: Any) -> None:
    """Registers are read and restored at any rate."""
    places = on_one_line(workshop, RTU, RTU, {**RTU, "baudrate": 57600}).places
    for place in places:
        check_lines([place], where="a.toml")
    (slow,) = on_one_line(workshop, {**RTU, "baudrate": 9600}).places
    check_lines([slow], where="a.toml")  # which loses samples, and counts them


def test_a_pseudo_terminal_carries_what_it_is_given(workshop: Any) -> None:
    check_lines(on_one_line(workshop, *[{"serial_port": "/dev/pts/7"}] * 9).places, where="a.toml")


def test_units_that_drive_one_line_otherwise_are_refused(workshop: Any) -> None:
    places = on_one_line(workshop, RTU, {**RTU, "stopbits": 2}).places
    words = "a.toml: unit u2 asks for 115200 baud, parity N, 2 stop bits on /dev/ttyUSB0, unit u1 for 115200 baud"
    with pytest.raises(InputError, match=f"^{re.escape(words)}"):
        check_lines(places, where="a.toml")


def test_no_unit_at_all_is_a_fault(tmp_path: Path) -> None:
    path = tmp_path / "station.toml"
    path.write_text('format = "triaxcal.station/1"\nname = "bench"\nunits = []\n')
    with pytest.raises(DriverError, match=r"line 3: units: .*at least 1"):
        load_station(path)


def test_a_station_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.toml: No such file or directory"):
        load_station(tmp_path / "none.toml")


DBC = "triax-ref-can.dbc"


@pytest.mark.parametrize(
    ("file", "old", "new", "words"),
    [
        ("triax-ref-can.toml", 'driver = "can"', 'driver = "cann"', "no driver named 'cann'; did you mean 'can'?"),
        ("triax-ref-can.toml", 'driver = "can"', "driver = 5", "driver: expected the name of a driver"),
        (
            "triax-ref-can.toml",
            "rate_hz = 100.0",
            "rate = 100.0",
            "sampling.rate: unknown key; did you mean 'rate_hz'?",
        ),
        ("triax-ref-can.toml", "rate_hz = 100.0", "", "sampling.rate_hz: missing"),
        ("triax-ref-can.toml", "rate_hz = 100.0", 'rate_hz = "fast"', "sampling.rate_hz: "),
        ("triax-ref-can.toml", "[sampling]", "[sampling", "not TOML: "),
        ("triax-ref-can.toml", f'file = "{DBC}"', 'file = "other.dbc"', "the file 'other.dbc' that it names: No such"),
        ("triax-ref-can.toml", 'ux = "Ux"', 'ux = "Uxx"', "Uxx"),
        (DBC, "VERSION", "VERZION", DBC),
        (DBC, "SG_ Ux", "SG_ Vx", "Ux"),
        (DBC, None, "", DBC),
        (DBC, None, "\x00\x01 no text at all", DBC),
    ],
)
def test_a_fault_of_the_profile_or_its_dbc_is_found_before_any_bus_is_opened(
    tmp_path: Path, workshop: Any, file: str, old: str | None, new: str, words: str
) -> None:
    workshop.impatient_profile("triax-ref-can")
    target = tmp_path / file
    text = target.read_text()
    assert old is None or old in text
    target.write_text(new if old is None else text.replace(old, new, 1))
    station = workshop.station(
        {"profile": "triax-ref-can.toml", "bus": {"interface": "none", "channel": 0, "node_id": 1}}
    )
    with pytest.raises(DriverError) as caught:
        load_station(station)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)
    assert "triax-ref-can" in str(caught.value)


def test_a_place_on_earth_says_what_the_reference_is_and_how_well(tmp_path: Path) -> None:
    path = tmp_path / "station.toml"
    path.write_text(GOOD.replace('name = "bench"', 'name = "bench"\nlatitude_deg = 50.45\nheight_m = 179', 1))
    file = load_station(path).file
    assert file.reference == pytest.approx(9.8104 / 9.80665, abs=1e-4)
    assert file.stated(PROFILE).reference == pytest.approx(43e-6, rel=0.01)
    path.write_text(GOOD.replace('name = "bench"', 'name = "bench"\nreference = 1.0004\nreference_uncertainty = 2e-6'))
    file = load_station(path).file
    assert (file.reference, file.stated(PROFILE).reference) == (1.0004, 2e-6)
    path.write_text(GOOD)
    file = load_station(path).file
    stated = file.stated(PROFILE)
    assert (file.reference, stated.reference, stated.thermometer_k, stated.thermal_sensitivity) == (
        1.0,
        None,
        None,
        None,
    )


def test_the_station_comes_before_the_profile_in_what_a_kelvin_does(tmp_path: Path) -> None:
    path = tmp_path / "station.toml"
    sensitive = PROFILE.output.model_copy(update={"thermal_sensitivity_per_k": 2e-5})
    profile = PROFILE.model_copy(update={"output": sensitive})
    path.write_text(GOOD)
    assert load_station(path).file.stated(profile).thermal_sensitivity == 2e-5
    path.write_text(GOOD.replace('name = "bench"', 'name = "bench"\nthermal_sensitivity_per_k = 1e-5', 1))
    assert load_station(path).file.stated(profile).thermal_sensitivity == 1e-5


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("latitude_deg = 50.0", "latitude_deg and height_m: give both, or neither"),
        ("latitude_deg = 50.0\nheight_m = 1\nreference = 1.0", "reference: latitude_deg and height_m say it already"),
        ("latitude_deg = 91\nheight_m = 1", "line 3: latitude_deg: input should be less than or equal to 90"),
        ("reference = 9.81", "line 3: reference: input should be less than or equal to 1.1"),
        ("reference_uncertainty = -1e-6", "line 3: reference_uncertainty: input should be greater than or equal to 0"),
    ],
)
def test_a_reference_that_cannot_be_is_said(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "station.toml"
    path.write_text(GOOD.replace('name = "bench"', f'name = "bench"\n{line}', 1))
    with pytest.raises(DriverError) as caught:
        load_station(path)
    assert words in str(caught.value)


@pytest.mark.parametrize(("poses", "apart", "fits"), [(12, 60.0, True), (14, 60.0, False), (9, 60.0, True)])
def test_as_many_poses_as_a_sphere_has_room_for_are_allowed(
    tmp_path: Path, poses: int, apart: float, fits: bool
) -> None:
    """Twelve: an icosahedron's corners are 63.4 degrees apart."""
    path = tmp_path / "station.toml"
    path.write_text(GOOD.replace("poses = 14", f"poses = {poses}\napart_deg = {apart}", 1))
    if fits:
        assert load_station(path).file.plan.repeat
    else:
        with pytest.raises(DriverError, match=r"plan\.poses: there are not so many directions 60 degrees apart"):
            load_station(path)


STOP = "stop = { uncertainty_g = 3e-5, poses_least = 10, poses_most = 20 }"


def test_poses_on_demand_are_in_place_of_poses(tmp_path: Path) -> None:
    path = tmp_path / "station.toml"
    path.write_text(GOOD.replace("poses = 14", STOP, 1))
    plan = load_station(path).file.plan
    assert plan.stop is not None
    assert (plan.stop.uncertainty_g, plan.stop.poses_least, plan.poses_most) == (3e-5, 10, 20)
    path.write_text(GOOD.replace("poses = 14", "stop = { uncertainty_g = 3e-5 }", 1))
    stop = load_station(path).file.plan.stop
    assert stop is not None
    assert (stop.poses_least, stop.poses_most) == (9, 26)
    path.write_text(GOOD)
    assert load_station(path).file.plan.poses_most == 14


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (f"poses = 14\n{STOP}", "plan: poses and stop: give one or the other"),
        ("stop = {}", "plan.stop.uncertainty_g: missing"),
        ("stop = { uncertainty_g = 0.0 }", "plan.stop.uncertainty_g: input should be greater than 0"),
        ("stop = { uncertainty_g = 1e-5, poses_least = 8 }", "plan.stop.poses_least: input should be greater"),
        ("stop = { uncertainty_g = 1e-5, poses_most = 1001 }", "plan.stop.poses_most: input should be less"),
        ("stop = { uncertainty_g = 1e-5, poses_least = 27 }", "poses_least: 27 is above poses_most, 26"),
        ("stop = { uncertainty_g = 1e-5, poses = 9 }", "plan.stop.poses: unknown key"),
        (f"{STOP}\napart_deg = 60.0", "plan.stop.poses_most: there are not so many directions 60 degrees apart"),
    ],
)
def test_a_fault_of_poses_on_demand_is_one_line(tmp_path: Path, line: str, words: str) -> None:
    path = tmp_path / "station.toml"
    path.write_text(GOOD.replace("poses = 14", line, 1))
    with pytest.raises(DriverError) as caught:
        load_station(path)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("line", ["reference_uncertainty = 3e-5", "latitude_deg = 50.0\nheight_m = 100.0"])
def test_an_uncertainty_below_that_of_the_reference_is_out_of_reach(tmp_path: Path, line: str) -> None:
    path = tmp_path / "station.toml"
    text = GOOD.replace('name = "bench"', f'name = "bench"\n{line}', 1)
    path.write_text(text.replace("poses = 14", "stop = { uncertainty_g = 1e-5 }", 1))
    with pytest.raises(DriverError, match=r"plan\.stop\.uncertainty_g: out of reach, since the reference alone is"):
        load_station(path)
    path.write_text(text.replace("poses = 14", "stop = { uncertainty_g = 1e-3 }", 1))
    assert load_station(path).file.plan.stop is not None
