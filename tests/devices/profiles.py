"""The text of a profile, a station file and a calibration that fit a device of these. No I/O.

Written from docs/reference/profile.md and station.md.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from tests.devices import canopen, modbus
from tests.devices.habits import Habits
from tests.devices.memory import PRODUCT_CODE, STORING
from tests.devices.table import (
    CHECKSUM,
    NINE,
    RESET_COMMAND,
    STORE_COMMAND,
    UNLOCK_KEY,
    Coefficients,
    Entry,
    registers_of,
)

DBC_FILE = "misbehaving.dbc"
DBC_NODE = 5
Driver = Literal["modbus", "can"]


@dataclass(frozen=True)
class Timing:
    """How long the master waits, in seconds: scaled for tests."""

    reply_s: float = 0.1
    silence_s: float = 0.5
    store_reply_s: float | None = None
    """For the reply to the store command, where the profile says so."""
    store_wait_s: float = 0.0
    """After the store command, where the device has no status register to poll."""
    store_poll_s: float = 1.0
    reset_wait_s: float = 0.0
    reconnect_s: float = 1.0


@dataclass(frozen=True)
class Wording:
    """What a profile may say about the same device in one way or another."""

    limits: bool = True
    word_order: Literal["big", "little"] | None = None
    """None: as the device's; the other: a profile that is wrong about it."""
    product_code: int = PRODUCT_CODE
    key: int = UNLOCK_KEY
    serial: bool = True
    """Whether it names the register of the serial number."""
    corrected: bool = True
    """Whether it has the stream of samples that the device corrects."""
    readings: Literal["before", "after"] | None = None
    """What it says of the readings: before or after the device's own correction."""
    nominal: float = -2.4
    form: Literal["matrix", "matrix-after"] | None = None
    output_per_g: float = 1.0


def profile_text(driver: Driver, habits: Habits, timing: Timing | None = None, wording: Wording | None = None) -> str:
    """A `triaxcal.profile/1`; on CAN it names `DBC_FILE`."""
    timing, wording = timing or Timing(), wording or Wording()
    identity: dict[str, Any] = {"vendor": "none", "product": "misbehaving unit"}
    if wording.serial:
        identity["serial_register"] = "serial_number"
    identity["expect"] = {"product_code": wording.product_code}
    parts = [
        _lines({"format": "triaxcal.profile/1", "name": "misbehaving", "driver": driver}),
        _lines({"word_order": wording.word_order or habits.word_order, "byte_order": habits.byte_order})
        if driver == "modbus"
        else "",
        _table("identity", identity),
        _table("output", {"unit": "V", "nominal_scale_factor": [wording.nominal] * 3}),
        _table(
            "sampling",
            {"rate_hz": 50.0, "reply_timeout_s": timing.reply_s, "silence_timeout_s": timing.silence_s},
        ),
        _streams(driver, wording.corrected),
        _table("registers", {name: _register(driver, e, wording) for name, e in registers_of(habits).items()}),
        _table("sequences", _sequences(habits, timing, wording)),
    ]
    correction = {"readings": wording.readings} if wording.readings else {}
    if wording.form:
        correction |= {"form": wording.form, "output_per_g": wording.output_per_g}
    if correction:
        parts.append(_table("correction", correction))
    if habits.checksum:
        parts.append(_table("crc", {"register": CHECKSUM, "algorithm": "crc-16/modbus", "over": NINE}))
    return "\n".join(part for part in parts if part)


def _streams(driver: Driver, corrected: bool) -> str:
    streams = {"readings": 0, "corrected": 1} if corrected else {"readings": 0}
    if driver == "can":
        made = {
            name: {"layout": "dbc", "file": DBC_FILE, "base_node_id": DBC_NODE, "counter": f"Counter{i}",
                   "channels": {f"u{axis}": f"{'UA'[i]}{axis}" for axis in "xyz"}}
            for name, i in streams.items()
        }  # fmt: skip
    else:
        made = {
            name: {"layout": "poll", "table": "input", "address": (modbus.READINGS, modbus.CORRECTED)[i],
                   "poll_period_s": 0.02,
                   "channels": {f"u{axis}": {"word": 2 * j, "type": "float32"} for j, axis in enumerate("xyz")}}
            for name, i in streams.items()
        }  # fmt: skip
    return "\n".join(_table(f"streams.{name}", stream) for name, stream in made.items())


def _register(driver: Driver, entry: Entry, wording: Wording) -> dict[str, Any]:
    if driver == "can":
        held: dict[str, Any] = {"object": "0x{:04X}:{:02X}".format(*entry.object)}
    else:
        held = {"address": entry.address}
    held |= {"type": entry.type, "access": entry.access}
    if entry.type == "ascii":
        held["length"] = entry.size
    if entry.role:
        held["role"] = entry.role
    if entry.unit:
        held["unit"] = entry.unit
    if entry.scale != 1.0:
        held["scale"] = entry.scale
    if entry.limit is not None and wording.limits:
        held |= {"minimum": -entry.limit, "maximum": entry.limit}
    return held


def _sequences(habits: Habits, timing: Timing, wording: Wording) -> dict[str, Any]:
    held: dict[str, Any] = {}
    if habits.unlock:
        held["unlock"] = [{"write": "unlock_key", "value": wording.key}]
        held["lock"] = [{"write": "unlock_key", "value": 0}]
    if habits.store_command:
        held["store"] = [{"write": "store", "value": STORE_COMMAND}]
        if timing.store_reply_s is not None:
            held["store"][0]["timeout_s"] = timing.store_reply_s
        if habits.status:
            held["store"].append({"poll": "status", "mask": STORING, "until": 0, "timeout_s": timing.store_poll_s})
        elif timing.store_wait_s:
            held["store"].append({"wait_s": timing.store_wait_s})
    if habits.reset_command:
        held["reset"] = [{"write": "reset", "value": RESET_COMMAND}]
        held["reset"] += [{"wait_s": timing.reset_wait_s}] if timing.reset_wait_s else []
        held["reset"].append({"reconnect": True, "timeout_s": timing.reconnect_s})
    return held


def dbc_text() -> str:
    """The frames of `tests.devices.canopen`, for node `DBC_NODE`."""
    lines = ['VERSION ""', "", "NS_ :", "", "BS_:", "", "BU_: Unit Station", ""]
    scales = (canopen.READINGS_UNIT_V, canopen.CORRECTED_UNIT_G)
    for i, (cob_id, unit) in enumerate(((canopen.READINGS, "V"), (canopen.CORRECTED, "g"))):
        lines.append(f"BO_ {cob_id + DBC_NODE} Frame{i}: 8 Unit")
        for j, axis in enumerate("xyz"):
            lines.append(f' SG_ {"UA"[i]}{axis} : {20 * j}|20@1- ({scales[i]!r},0) [0|0] "{unit}" Station')
        lines += [f' SG_ Counter{i} : 60|4@1+ (1,0) [0|0] "" Station', ""]
    return "\n".join(lines)


def station_text(
    profile: str, bus: Mapping[str, Any], *, serial: str | None = None, tables: Mapping[str, Mapping[str, Any]] = {}
) -> str:
    """A `triaxcal.station/1` with one unit; ``tables`` are further ones, such as ``limits``."""
    unit = {"name": "unit", "profile": profile, **({"serial": serial} if serial else {}), "bus": bus}
    head = _lines({"format": "triaxcal.station/1", "name": "bench"})
    return head + "".join(_table(name, table) for name, table in tables.items()) + "\n[[units]]\n" + _lines(unit)


def calibration_text(coefficients: Coefficients, *, serial: str | None = None) -> str:
    """A `triaxcal.calibration/1` of the linear model, as little as one needs."""
    document: dict[str, Any] = {
        "format": "triaxcal.calibration/1",
        "terms": ["linear"],
        "reference": 1.0,
        "scale_factor": coefficients.scale_factor,
        "misalignment": coefficients.misalignment,
        "bias": coefficients.bias,
        "effects": {},
    }
    return json.dumps({**document, **({"unit": {"name": "unit", "serial": serial}} if serial else {})})


def _table(name: str, values: Mapping[str, Any]) -> str:
    return f"[{name}]\n" + _lines(values)


def _lines(values: Mapping[str, Any]) -> str:
    return "".join(f"{key} = {_value(value)}\n" for key, value in values.items())


def _value(value: Any) -> str:
    """A TOML value, tables inline."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{k} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, Iterable) and not isinstance(value, str):
        return "[" + ", ".join(map(_value, value)) + "]"
    return json.dumps(value)
