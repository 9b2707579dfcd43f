"""Serial numbers that are text, longer than any number: two units that begin alike are two units."""

from __future__ import annotations

import json
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
from tests.devices.profiles import Timing, profile_text
from tests.devices.table import OLD
from triaxcald.recording.reader import Recording

PATIENT = Timing(reply_s=10.0, silence_s=20.0, store_poll_s=20.0, reconnect_s=20.0)
OWN, OTHER = "WT5500001234", "WT5500001235"
LINES: list[tuple[Transport, Literal["big", "little"], Literal["big", "little"]]] = [
    ("tcp", "big", "big"), ("tcp", "little", "little"), ("rtu", "big", "little"), ("canopen", "big", "big"),
]  # fmt: skip


@pytest.mark.parametrize(("transport", "word_order", "byte_order"), LINES)
def test_the_unit_of_that_text_is_taken_and_one_that_begins_alike_is_refused(
    tmp_path: Path, triaxcal: Callable[..., Any], transport: Transport, word_order: Any, byte_order: Any
) -> None:
    habits = Habits(serial_type="ascii", word_order=word_order, byte_order=byte_order)
    with Bench(tmp_path, triaxcal, transport, habits=habits, timing=PATIENT, serial_number=OWN, serial=OWN) as bench:
        done = bench.registers("--json")
        assert done.code == 0, done.err
        assert done.json["serial"] == OWN
        bench.station.write_text(bench.station.read_text().replace(OWN, OTHER))
        refused = bench.registers("--json")
        assert refused.code == 4
        assert refused.err.rstrip().endswith(f"is serial {OWN}, expected {OTHER}")
        assert len(refused.err.splitlines()) == 1


@pytest.mark.parametrize(("held", "serial"), [("AB-7", "AB-7"), ("  AB-7", "AB-7"), ("a/b: 3\\4  ", "a/b: 3\\4")])
def test_documents_have_the_text_without_what_fills_it_up(
    tmp_path: Path, triaxcal: Callable[..., Any], held: str, serial: str
) -> None:
    habits = Habits(serial_type="ascii", reset_command=False)
    with Bench(tmp_path, triaxcal, habits=habits, timing=PATIENT, serial_number=held, serial=serial) as bench:
        done = bench.provision("--json")
        assert done.code == 0, done.err
        assert done.json["serial"] == done.json["outcome"]["serial"] == serial
        (journal,) = tmp_path.glob("journal/*.json")
        assert json.loads(journal.read_text())["serial"] == serial
        assert triaxcal("provision", "--resume", bench.station).code == 0


@pytest.mark.parametrize("held", ["", "   ", "WT\n55", "WT\xff\xff", "\xff" * 12, "\x01\x02"])
def test_bytes_that_are_no_text_are_refused_in_one_line(
    tmp_path: Path, triaxcal: Callable[..., Any], held: str
) -> None:
    habits = Habits(serial_type="ascii")
    with Bench(tmp_path, triaxcal, habits=habits, timing=PATIENT, serial_number=held, serial=None) as bench:
        done = bench.registers()
    assert done.code == 4
    assert len(done.err.splitlines()) == 1
    assert "serial_number" in done.err
    assert held.encode("latin-1").ljust(12, b"\0").hex() in done.err


@pytest.mark.parametrize(("second", "code"), [(OTHER, 0), (OWN, 4)])
def test_two_units_that_begin_alike_are_recorded_together(
    tmp_path: Path, triaxcal: Callable[..., Any], second: str, code: int
) -> None:
    habits = Habits(serial_type="ascii")
    (tmp_path / "profile.toml").write_text(profile_text("modbus", habits, PATIENT))
    text = 'format = "triaxcal.station/1"\nname = "bench"\n'
    with ExitStack() as stack:
        for name, serial in (("left", OWN), ("right", second)):
            unit = Electronics(habits, OLD.image(habits), serial)
            served = stack.enter_context(ModbusTcp(ModbusUnit(Place(unit), Motion())))
            text += f'[[units]]\nname = "{name}"\nprofile = "profile.toml"\n[units.bus]\n'
            text += "".join(f"{key} = {json.dumps(value)}\n" for key, value in served.bus.items())
        station = tmp_path / "station.toml"
        station.write_text(text)
        (tmp_path / "out").mkdir()
        done = triaxcal("record", station, "-o", tmp_path / "out", "--seconds", "0.3")
    assert done.code == code, done.err
    recorded = set()
    for path in (tmp_path / "out").glob("*.mcap"):
        with Recording.open(path) as recording:
            recorded.add(recording.metadata["unit"]["serial"])
    assert recorded == {OWN, second}
