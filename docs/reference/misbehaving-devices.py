"""Writes docs/reference/misbehaving-devices.md from the rows of the tests: run it by `python`."""

from __future__ import annotations

import sys
from pathlib import Path

PAGE = Path(__file__).with_suffix(".md")
HEAD = """# Devices that misbehave

Simulated devices on Modbus TCP, Modbus RTU and CANopen, which share no code with the drivers, are provisioned by `triaxcal provision`. Each has one habit of real devices and lines. The table says what the device starts with afterwards, by its memory cells, and how the command ends ([outcome](outcome.md)). The tests run every row. Made from `tests/devices/rows.py` by `docs/reference/misbehaving-devices.py`. `python -m benchmarks.faulty_devices` draws devices and lines with many faults at once.

| a device that … | starts with | `device_state` | exit code | and it says |
|---|---|---|---|---|
"""  # noqa: E501


def page() -> str:
    sys.path.insert(0, str(PAGE.parents[2]))  # tests are no part of what is installed
    try:
        from tests.devices.rows import ROWS
    finally:
        del sys.path[0]
    rows = (f"| {r.does} | {r.holds} | `{r.state}` | {r.exit_code} | {r.says} |\n" for r in ROWS)
    return HEAD + "".join(rows)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
