"""The EEPROM of a simulated unit as a file, so that it survives the process."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from triaxcald.errors import InputError
from triaxcald.simulation.unit import ReferenceUnit

LOOK_S = 0.05


def read_eeprom(path: Path) -> bytes | None:
    """None where there is no such file yet. Raises InputError."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as e:
        raise InputError(f"{path}: {e.strerror}") from e


def write_eeprom(path: Path, image: bytes) -> None:
    """Whole or not at all. Raises InputError."""
    temporary = path.with_name(f".{path.name}.new")
    try:
        temporary.write_bytes(image)
        os.replace(temporary, path)
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from e


@asynccontextmanager
async def keep_eeprom(unit: ReferenceUnit, path: Path | None) -> AsyncIterator[None]:
    """Writes the unit's EEPROM to ``path`` whenever it changes, until the context ends."""
    if path is None:
        yield
        return
    task = asyncio.create_task(_follow(unit, path))
    try:
        yield
    finally:
        task.cancel()
        with suppress(asyncio.CancelledError):
            await task
        write_eeprom(path, unit.eeprom)


async def _follow(unit: ReferenceUnit, path: Path) -> None:
    held = read_eeprom(path)
    while True:
        if unit.eeprom != held:
            held = unit.eeprom
            write_eeprom(path, held)
        await asyncio.sleep(LOOK_S)
