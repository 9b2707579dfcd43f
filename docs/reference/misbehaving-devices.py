"""Writes docs/reference/misbehaving-devices.md from the rows of the tests: run it by `python`."""

from __future__ import annotations

import sys
from pathlib import Path

PAGE = Path(__file__).with_suffix(".md")
HEAD = """# Devices that misbehave

`triaxcal provision` calibrates simulated devices on Modbus TCP, Modbus RTU and CANopen that share no code with the drivers. Each device has one habit of real devices and lines. The table gives the calibration with which the device starts afterwards, by its memory cells, the [`device_state`](outcome.md) and the exit code. The tests run every case. Made from `tests/devices/rows.py` by `docs/reference/misbehaving-devices.py`. `python -m benchmarks.faulty_devices` draws devices and lines with many faults at once.

| starts with | `device_state` | exit | a device that … |
|---|---|---|---|
"""  # noqa: E501


def page() -> str:
    sys.path.insert(0, str(PAGE.parents[2]))  # tests are no part of what is installed
    try:
        from tests.devices.rows import ROWS
    finally:
        del sys.path[0]
    endings: dict[tuple[str, str, int], list[str]] = {}
    for r in ROWS:
        endings.setdefault((r.holds, str(r.state), r.exit_code), []).append(r.does)
    rows = (
        f"| {holds} | `{state}` | {code} | {';<br> '.join(does)} |\n" for (holds, state, code), does in endings.items()
    )
    return HEAD + "".join(rows)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
