"""devices new: each printed profile is sound beside the files that it names, also with every optional line."""

from __future__ import annotations

import re
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.catalogue import BUILT_IN
from triaxcald.cli.syntax import NEW_PROFILES

Run = Callable[..., Any]
OPTIONAL = re.compile(r"^#(?=[\w\[])", re.MULTILINE)
SIGNALS = {
    "AccelX": "0|16", "AccelY": "16|16", "AccelZ": "32|16", "Temperature": "48|8", "SampleCounter": "56|4",
    "Valid": "60|1",
}  # fmt: skip
CORRECTED = {"CorrectedX": "0|16", "CorrectedY": "16|16", "CorrectedZ": "32|16"}
NUMBERS = {"6010": (3, 3), "6011": (1, 3), "6020": (1, 5), "6021": (1, 5)}  # objects: members, data type


def dbc() -> str:
    text = 'VERSION ""\nBU_: A\n'
    for number, signals in ((256, SIGNALS), (257, CORRECTED)):
        text += f"BO_ {number} M{number}: 8 A\n"
        text += "".join(f' SG_ {name} : {place}@1+ (1,0) [0|0] "" A\n' for name, place in signals.items())
    return text


def eds() -> str:
    text = "[DeviceInfo]\nVendorName=A\n"

    def section(name: str, *entries: str) -> str:
        return "\n".join([f"[{name}]", f"ParameterName={name}", *entries, ""])

    number = ("ObjectType=7", "AccessType=rw")
    counter = "0x60200108"
    tpdos = (["0x60100110", "0x60100210", "0x60100310", counter, "0x60210108"], ["0x60110110", counter])
    for k, words in enumerate(tpdos):
        comm, mapping = f"180{k}", f"1A0{k}"
        text += section(comm, "ObjectType=9", "SubNumber=2")
        text += section(f"{comm}sub1", *number, "DataType=7", f"DefaultValue=$NODEID+0x{0x180 + 0x100 * k:X}")
        text += section(mapping, "ObjectType=9", "SubNumber=5")
        for i, word in enumerate([str(len(words)), *words]):
            text += section(f"{mapping}sub{i}", *number, "DataType=7", f"DefaultValue={word}")
    for index, (count, kind) in NUMBERS.items():
        text += section(index, "ObjectType=9", f"SubNumber={count + 1}")
        for sub in range(1, count + 1):
            text += section(f"{index}sub{sub}", *number, f"DataType={kind}")
    return text


@pytest.fixture(params=NEW_PROFILES)
def printed(request: pytest.FixtureRequest, triaxcal: Run, tmp_path: Path) -> str:
    """A profile as printed, whose files lie beside it."""
    done = triaxcal("devices", "new", request.param)
    assert (done.code, done.err) == (0, "")
    (tmp_path / "my-device.dbc").write_text(dbc())
    (tmp_path / "my-device.eds").write_text(eds())
    text: str = done.out
    return text


def checked(triaxcal: Run, path: Path, text: str) -> dict[str, Any]:
    path.write_text(text)
    done = triaxcal("devices", "check", path, "--json")
    assert (done.code, done.json["problems"]) == (0, []), done
    document: dict[str, Any] = done.json
    return document


def test_a_printed_profile_loads_beside_the_files_that_it_names(triaxcal: Run, tmp_path: Path, printed: str) -> None:
    document = checked(triaxcal, tmp_path / "my-device.toml", printed)
    assert document["profile"] == "my-device"
    assert [c["name"] for c in document["streams"][0]["channels"]][:3] == ["ux", "uy", "uz"]


def test_every_optional_line_of_a_printed_profile_is_sound(triaxcal: Run, tmp_path: Path, printed: str) -> None:
    whole = OPTIONAL.sub("", printed)
    assert whole.count("\n#") < printed.count("\n#")
    if "[streams.readings]" in whole and "counter" in whole:
        whole = whole.replace('together = "time"', "")  # in place of a counter
    whole = re.sub(r'serial_register = "\w+".*', 'serial_register = "serial_number"', whole)
    document = checked(triaxcal, tmp_path / "my-device.toml", whole)
    assert {r["name"] for r in document["registers"]} >= {"serial_number", "product_code"}
    keys = {line.split(" = ")[0].strip("#") for line in printed.splitlines() if OPTIONAL.match(line) and " = " in line}
    assert "expect" in keys


def test_what_has_to_be_replaced_is_marked_and_may_be(triaxcal: Run, tmp_path: Path, printed: str) -> None:
    """By what the reference unit has: every value that is not kept was marked."""
    for name in ("triax-ref-can.dbc", "triax-ref-can.eds"):
        shutil.copy(BUILT_IN / name, tmp_path)
    values = {
        "file": '"triax-ref-can.dbc"', "eds": '"triax-ref-can.eds"', "name": '"unit"', "vendor": '"TRIA"',
        "product": '"TRIAX-REF"', "rate_hz": "100.0", "nominal_scale_factor": "[-2.4, -2.4, -2.4]",
        "table": '"input"', "address": "0x0000", "poll_period_s": "0.05", "record_start": "3", "record_words": "10",
        "record_capacity": "12", "header": "{ count = 0, remaining = 1, lost = 2 }",
        "counter": '{ word = 0, type = "uint16" }',
    }  # fmt: skip
    of_axes = {"dbc": '"U{}"', "pdo": '"0x2300:0{}"', "poll": '{{ word = {}, type = "int16" }}'}
    layout = str(tomllib.loads(printed)["streams"]["readings"]["layout"])
    for i, axis in enumerate("xyz"):
        of_axis = of_axes.get(layout, '{{ word = {}, type = "int32" }}')
        values[f"u{axis}"] = of_axis.format({"dbc": axis, "pdo": i + 1, "poll": i}.get(layout, 3 + 2 * i))
    values["temp_c"] = '{ word = 9, type = "int16", scale = 0.01 }'

    def replaced(line: str) -> str:
        key, equals, rest = line.partition(" = ")
        marked = equals and "# replace" in rest and not line.startswith("#")
        return f"{key} = {values[key]}" if marked else line

    text = "\n".join(map(replaced, printed.splitlines()))
    if layout in ("dbc", "pdo"):  # its samples take two messages
        counter = "Counter" if layout == "dbc" else "0x2300:04"
        text = text.replace('#together = "time"', f'counter = "{counter}"')
    document = checked(triaxcal, tmp_path / "unit.toml", text)
    assert document["profile"] == "unit"
    assert document["driver"] == ("modbus" if layout in ("poll", "fifo") else "can")
