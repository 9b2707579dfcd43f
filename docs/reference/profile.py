"""Writes what stands here of the table of register types and the models of
profiles: `python docs/reference/profile.py`."""

from __future__ import annotations

from pathlib import Path

from triaxcal_drivers.registers import TYPES, Integer, in_words
from triaxcal_drivers.schema import schema

HERE = Path(__file__).parent
DRIVERS = ("can", "mcap", "modbus")
HEAD = """# Register types

These are the values of `type` of a register or, on Modbus, of a channel. Made from the table in `drivers/triaxcal_drivers/registers.py` by `docs/reference/profile.py`. Whole numbers are in two's complement, the others by IEEE 754. Most significant first or last is the profile's order, not the type's. A value goes to the nearest number; one beyond the range is refused. A register may also be of type `ascii`: text of `length` bytes, without NULs and spaces at its ends.

| type | bytes | lowest | highest | step near 1 | on Modbus |
|---|---|---|---|---|---|
"""  # noqa: E501


def pages() -> dict[Path, str]:
    """The text of each page by its path."""
    made = {HERE / f"profile-{driver}.schema.json": schema(driver) for driver in DRIVERS}
    return made | {HERE / "register-types.md": HEAD + "".join(map(_row, TYPES))}


def _row(name: str) -> str:
    type_ = TYPES[name]
    words = "yes" if in_words(name) else "no"
    ends = (str(e) if isinstance(type_, Integer) else f"{e:.4g}" for e in (type_.lowest, type_.highest))
    return f"| `{name}` | {type_.size} | {' | '.join(ends)} | {type_.step(1.0):.3g} | {words} |\n"


if __name__ == "__main__":
    for path, text in pages().items():
        path.write_text(text, encoding="utf-8")
