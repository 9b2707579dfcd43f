"""Writes docs/reference/profile-keys.md from the models of profiles: `python docs/reference/profile-keys.py`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from triaxcal_drivers.schema import schema

PAGE = Path(__file__).with_suffix(".md")
DRIVERS = ("can", "modbus", "mcap")
HEAD = """# Keys of a profile

Every key that [a profile](profile.md) may have. `NAME` stands for a name of the profile's own; `[]` for each entry of a list. A key without a default must be there if the table that it is in is. Made from the models of the drivers by `docs/reference/profile-keys.py`.
"""  # noqa: E501
SECTIONS = {
    ("can", "modbus", "mcap"): "Every profile",
    ("can", "modbus"): "CAN and Modbus",
    ("can",): "CAN",
    ("modbus",): "Modbus",
    ("mcap",): "MCAP",
}
Row = tuple[str, str, str]


def page() -> str:
    drivers: dict[Row, list[str]] = {}
    for driver in DRIVERS:
        document = json.loads(schema(driver))
        for row in dict.fromkeys(_rows(document, document["$defs"], "")):
            drivers.setdefault(row, []).append(driver)
    assert {tuple(found) for found in drivers.values()} <= SECTIONS.keys()
    parts = [HEAD]
    for of, title in SECTIONS.items():
        rows = [row for row, found in drivers.items() if tuple(found) == of]
        if rows:
            parts.append(f"\n## {title}\n\n| key | default | |\n|---|---|---|\n" + "".join(map(_line, rows)))
    return "".join(parts)


def _rows(node: dict[str, Any], named: dict[str, Any], prefix: str) -> Iterator[Row]:
    """Key, default and meaning of what stands in a table of TOML, and in those below it."""
    for name, of in node.get("properties", {}).items():
        below = [named[r] for r in dict.fromkeys(_references(of)) if "properties" in named[r]]
        if not below or "description" in of:
            default = json.dumps(of["default"], ensure_ascii=False) if of.get("default") not in (None, [], {}) else ""
            shown = default or ("none" if "default" in of else "")
            yield (f"{prefix}{name}", shown, of.get("description", ""))
        each = "[]" if of.get("type") == "array" else ".NAME" if of.get("type") == "object" else ""
        inside = prefix + (f"{name}.NAME" if each == ".NAME" else f"NAME{each}" if each else name)
        for inner in below:
            yield from _rows(inner, named, f"{inside}.")


def _references(of: Any) -> Iterator[str]:
    if isinstance(of, dict):
        if isinstance(reference := of.get("$ref"), str):
            yield reference.rpartition("/")[2]
        for inner in of.values():
            yield from _references(inner)
    elif isinstance(of, list):
        for inner in of:
            yield from _references(inner)


def _line(row: Row) -> str:
    key, default, meaning = row
    cells = (f"`{key}`", f"`{default}`" if default and default != "none" else default, meaning)
    return "| " + " | ".join(c.replace("|", r"\|") for c in cells) + " |\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
