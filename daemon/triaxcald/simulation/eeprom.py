"""The EEPROM of a simulated unit as a file, so that it survives the process."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from triaxcal_drivers.files import read_whole
from triaxcald.abort import at_abort
from triaxcald.errors import InputError
from triaxcald.files import require_writable, write_bytes
from triaxcald.simulation.unit import ReferenceUnit

LOOK_S = 0.05
EEPROM_MOST = 4096
"""Bytes; the unit's has 90. What is longer is somebody's file, and not to be
written over."""


def read_eeprom(path: Path) -> bytes | None:
    """None where there is no such file yet; it must be one that can be written.
    Raises InputError."""
    require_writable(path)
    try:
        return read_whole(path, EEPROM_MOST)
    except FileNotFoundError:
        return None
    except OSError as e:
        raise InputError(f"{path}: {e.strerror}") from e


def write_eeprom(path: Path, image: bytes) -> None:
    """Whole or not at all. Raises InputError."""
    write_bytes(path, image)


@asynccontextmanager
async def keep_eeprom(unit: ReferenceUnit, path: Path | None) -> AsyncIterator[None]:
    """Writes the unit's EEPROM to ``path`` whenever it changes, until the
    context ends."""
    if path is None:
        yield
        return

    def keep(_: float) -> None:
        with suppress(InputError):
            write_eeprom(path, unit.eeprom)

    task = asyncio.create_task(_follow(unit, path))
    with at_abort(keep):
        try:
            yield
        finally:
            if not task.cancel():
                task.result()
            write_eeprom(path, unit.eeprom)


async def _follow(unit: ReferenceUnit, path: Path) -> None:
    held = read_eeprom(path)
    while True:
        if unit.eeprom != held:
            held = unit.eeprom
            write_eeprom(path, held)
        await asyncio.sleep(LOOK_S)
