"""Serial numbers that no float holds: two units whose numbers differ by one are two units."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal

import pytest

from tests.devices.bench import Bench, Transport
from tests.devices.habits import Habits
from tests.devices.memory import Electronics
from tests.devices.modbus import ModbusUnit
from tests.devices.modbus_tcp import ModbusTcp
from tests.devices.motion import Motion
from tests.devices.place import Place
from tests.devices.profiles import Timing, calibration_text, profile_text
from tests.devices.table import NEW, OLD
from triaxcal_drivers.catalogue import parse_bundle
from triaxcal_drivers.profile import Bundle
from triaxcald.provision.access import RegisterLink, SequenceStalled, run_sequence
from triaxcald.provision.identity import WrongUnit, check_identity, same_serial
from triaxcald.provision.registers import checksum_of
from triaxcald.recording.reader import Recording

SerialType = Literal["uint64", "int64"]
PATIENT = Timing(reply_s=10.0, silence_s=20.0, store_poll_s=20.0, reconnect_s=20.0)
LINES: list[tuple[Transport, Literal["big", "little"]]] = [
    ("tcp", "big"), ("tcp", "little"), ("rtu", "little"), ("canopen", "big"),
]  # fmt: skip
PAIRS: list[tuple[SerialType, int, int]] = [
    ("uint64", 2**53, 2**53 + 1),
    ("uint64", 2**53 + 1, 2**53),
    ("uint64", 2**63, 2**63 + 1),
    ("uint64", 2**64 - 1, 2**64 - 2),
    ("int64", -(2**53) - 1, -(2**53)),
    ("int64", -(2**63), -(2**63) + 1),
    ("int64", 2**63 - 1, 2**63 - 2),
    ("int64", -5, 5),
]
every_line = pytest.mark.parametrize(("transport", "word_order"), LINES)
every_pair = pytest.mark.parametrize(("serial_type", "own", "other"), PAIRS)


@every_line
@every_pair
def test_the_right_unit_is_taken_and_the_next_number_is_another_unit(
    tmp_path: Path, triaxcal: Callable[..., Any], transport: Transport, word_order: Any,
    serial_type: SerialType, own: int, other: int,
) -> None:  # fmt: skip
    habits = Habits(serial_type=serial_type, word_order=word_order)
    with Bench(
        tmp_path, triaxcal, transport, habits=habits, timing=PATIENT, serial_number=own, serial=str(own)
    ) as bench:
        done = bench.registers("--json")
        assert done.code == 0, done.err
        assert int(done.json["serial"]) == own
        assert isinstance(done.json["serial"], str)
        text = bench.station.read_text()
        bench.station.write_text(text.replace(f'"{own}"', f'"{other}"'))
        refused = bench.registers("--json")
        assert refused.code == 4
        assert refused.err.rstrip().endswith(f"is serial {own:04d}, expected {other}")


@pytest.mark.parametrize("request_number", range(1, 30, 4))
def test_a_unit_that_is_swapped_for_the_next_number_is_not_written(
    tmp_path: Path, triaxcal: Callable[..., Any], request_number: int
) -> None:
    habits = Habits(serial_type="uint64")
    other = Electronics(habits, OLD.image(habits), 2**53 + 1)
    with Bench(
        tmp_path, triaxcal, habits=habits, timing=PATIENT, serial_number=2**53, serial=str(2**53),
        swapped=(request_number, other),
    ) as bench:  # fmt: skip
        done = bench.provision("--json")
        assert done.code == 4
        assert str(2**53 + 1) in done.err
    assert other.written == []
    assert other.stores == 0


def test_documents_and_journal_have_every_digit(tmp_path: Path, triaxcal: Callable[..., Any]) -> None:
    """No restart proves what is stored, so the journal stays."""
    serial = 2**64 - 1
    habits = Habits(serial_type="uint64", reset_command=False)
    with Bench(tmp_path, triaxcal, habits=habits, timing=PATIENT, serial_number=serial, serial=f"00{serial}") as bench:
        bench.calibration.write_text(calibration_text(NEW, serial=f"0{serial}"))
        done = bench.provision("--json")
        assert done.code == 0, done.err
        assert done.json["serial"] == done.json["outcome"]["serial"] == str(serial)
        (journal,) = tmp_path.glob("journal/*.json")
        assert json.loads(journal.read_text())["serial"] == str(serial)
        assert str(serial) in journal.name
        assert triaxcal("provision", "--resume", bench.station).code == 0


def test_a_calibration_of_the_next_number_is_refused(tmp_path: Path, triaxcal: Callable[..., Any]) -> None:
    with Bench(
        tmp_path, triaxcal, habits=Habits(serial_type="uint64"), timing=PATIENT,
        serial_number=2**53 + 1, serial=None,
    ) as bench:  # fmt: skip
        bench.calibration.write_text(calibration_text(NEW, serial=str(2**53)))
        assert bench.provision().code == 4
        bench.station.write_text(
            bench.station.read_text().replace('name = "unit"', f'name = "unit"\nserial = "{2**53 + 1}"')
        )
        assert bench.provision().code == 3
        assert bench.unit.written == []


@pytest.mark.parametrize(("second", "code"), [(2**53 + 1, 0), (2**53, 4)])
def test_two_units_of_one_station_are_one_only_with_the_same_number(
    tmp_path: Path, triaxcal: Callable[..., Any], second: int, code: int
) -> None:
    habits = Habits(serial_type="uint64")
    (tmp_path / "profile.toml").write_text(profile_text("modbus", habits, PATIENT))
    text = 'format = "triaxcal.station/1"\nname = "bench"\n'
    with ExitStack() as stack:
        for name, serial in (("left", 2**53), ("right", second)):
            unit = Electronics(habits, OLD.image(habits), serial)
            served = stack.enter_context(ModbusTcp(ModbusUnit(Place(unit), Motion())))
            text += f'[[units]]\nname = "{name}"\nprofile = "profile.toml"\n[units.bus]\n'
            text += "".join(f"{key} = {json.dumps(value)}\n" for key, value in served.bus.items())
        station = tmp_path / "station.toml"
        station.write_text(text)
        (tmp_path / "out").mkdir()
        done = triaxcal("record", station, "-o", tmp_path / "out", "--seconds", "0.3")
    assert done.code == code, done.err
    recorded = []
    for path in (tmp_path / "out").glob("*.mcap"):
        with Recording.open(path) as recording:
            recorded.append(recording.metadata["unit"]["serial"])
    assert sorted(recorded) == sorted({str(2**53), str(second)})


PROFILE = """
format = "triaxcal.profile/1"
name = "wide"
driver = "modbus"
identity = { vendor = "v", product = "p", serial_register = "serial", expect = { product_code = 9007199254740993 } }
output = { unit = "V" }
sampling = { rate_hz = 50.0 }
[streams.readings]
layout = "poll"
address = 0
poll_period_s = 0.02
channels = { ux = { word = 0, type = "int16" }, uy = { word = 1, type = "int16" }, uz = { word = 2, type = "int16" } }
[registers]
serial = { address = 0, type = "uint64", scale = 0.001, access = "ro" }
product_code = { address = 4, type = "uint64", access = "ro" }
key = { address = 8, type = "uint64" }
status = { address = 12, type = "uint64", access = "ro" }
bias_x = { address = 16, type = "int64", scale = 1e-9, role = "bias.x" }
checksum = { address = 20, type = "uint32", role = "calibration_crc" }
[sequences]
unlock = [{ write = "key", value = 18446744073709551615 },
          { poll = "status", until = 9007199254740993, timeout_s = 0.1 }]
lock = [{ poll = "status", until = 1, mask = 9007199254740993, timeout_s = 0.1 }]
[crc]
register = "checksum"
algorithm = "crc-32"
over = ["bias_x"]
"""
ANSWERS = {"serial": 2**53 + 1, "product_code": 2**53 + 1, "status": 2**53 + 1}


class Answers:
    """A device that answers with these numbers, and takes what is written."""

    def __init__(self, **numbers: int) -> None:
        self.held = {name: n.to_bytes(8, "big") for name, n in {**ANSWERS, **numbers}.items()}

    async def read(self, register: str) -> bytes:
        return self.held[register]

    async def write(self, register: str, raw: bytes, *, timeout_s: float | None = None) -> None:
        self.held[register] = raw


@pytest.fixture(scope="module")
def wide() -> Bundle:
    return parse_bundle(PROFILE.encode(), {}, where="wide.toml")


async def test_a_product_code_is_compared_to_its_last_digit(wide: Bundle) -> None:
    device: Any = Answers()
    identity = await check_identity(device, wide, str(2**53 + 1))
    assert (identity.serial, identity.values) == (str(2**53 + 1), {"product_code": 2**53 + 1})  # whatever the scale
    device = Answers(product_code=2**53)
    with pytest.raises(WrongUnit, match="holds 0x20000000000000, expected 0x20000000000001"):
        await check_identity(device, wide, None)


async def test_a_sequence_writes_and_waits_for_every_digit(wide: Bundle) -> None:
    device: Any = Answers()
    await run_sequence(RegisterLink(device, wide.profile), wide, "unlock")
    assert device.held["key"] == b"\xff" * 8
    device = Answers(status=2**53)
    with pytest.raises(SequenceStalled, match=r"holds 9007199254740992 after .* expected 9007199254740993"):
        await run_sequence(RegisterLink(device, wide.profile), wide, "unlock")


async def test_a_mask_sees_the_lowest_bit_of_a_wide_register(wide: Bundle) -> None:
    device: Any = Answers(status=(0x55 << 55) + 1)
    await run_sequence(RegisterLink(device, wide.profile), wide, "lock")
    device = Answers(status=0x55 << 55)
    with pytest.raises(SequenceStalled):
        await run_sequence(RegisterLink(device, wide.profile), wide, "lock")


@pytest.mark.parametrize("number", [2**53 + 1, -(2**53) - 1, 2**63 - 1, -(2**63)])
def test_a_checksum_covers_the_bytes_that_the_register_holds(wide: Bundle, number: int) -> None:
    raw = number.to_bytes(8, "big", signed=True)
    assert checksum_of(wide.profile, {"bias_x": raw}) == zlib.crc32(raw)


@pytest.mark.parametrize(
    ("serial", "expected", "same"),
    [
        ("0777", "777", True), ("0777", " 00777 ", True), ("0000", "0", True), ("-005", "-5", True),
        ("-005", "5", False), (str(2**53), str(2**53 + 1), False), ("0777", "7770", False), (None, "777", False),
        ("0A1", "A1", True), ("A1", "A10", False),
    ],
)  # fmt: skip
def test_leading_zeros_of_a_serial_number_do_not_count(serial: str | None, expected: str, same: bool) -> None:
    assert same_serial(serial, expected) is same
