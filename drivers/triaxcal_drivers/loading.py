"""From the text of a profile to a `Bundle`: the driver that it names validates
it, and its files are read."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from triaxcal_drivers.catalogue import driver_named
from triaxcal_drivers.errors import ProfileError
from triaxcal_drivers.files import inside, read_whole, size
from triaxcal_drivers.nearest import clipped
from triaxcal_drivers.profile import Bundle
from triaxcal_drivers.toml_text import PROFILE, parse_toml, read_toml
from triaxcal_drivers.validation import validate

BUILT_IN = Path(__file__).parent / "profiles"
FILE_MOST = 16 * 2**20
"""Bytes of a DBC or EDS file; the DBC of a whole vehicle, comments and all, has
some ten million."""


def parse_bundle(text: bytes, files: Mapping[str, bytes] | None, *, where: str, folder: Path | None = None) -> Bundle:
    """Validate a profile's text. Files come from ``files`` where given, else
    from ``folder``.

    Raises ProfileError (one line: where, line, field, what was expected),
    DriverMissing.
    """
    data = parse_toml(text, where=where, expected=PROFILE)
    name = data.get("driver")
    if not isinstance(name, str):
        raise ProfileError(f'{where}: driver: expected the name of a driver, as in driver = "can"')
    model = driver_named(name, where=where).profile_model
    profile = validate(model, data, text, where=where)
    held = {file: _held(file, files, folder, where) for file in profile.files()}
    for file in profile.optional_files():
        if file in files if files is not None else folder is not None and os.path.exists(folder / file):
            held[file] = _held(file, files, folder, where)
    return Bundle(profile, text, held)


def _held(file: str, files: Mapping[str, bytes] | None, folder: Path | None, where: str) -> bytes:
    """Raises ProfileError."""
    try:
        if files is None and folder is not None:
            return read_whole(inside(folder, file), FILE_MOST)
        data = (files or {})[file]
    except KeyError:
        raise ProfileError(f"{where}: the file '{clipped(file)}' that it names is missing") from None
    except OSError as e:
        raise ProfileError(f"{where}: the file '{clipped(file)}' that it names: {e.strerror}") from e
    if len(data) > FILE_MOST:
        raise ProfileError(f"{where}: the file '{clipped(file)}' that it names: larger than {size(FILE_MOST)}")
    return data


def load_bundle(path: Path) -> Bundle:
    """The profile at ``path``, or a built-in one where ``path`` is a bare name
    such as ``triax-ref-can``."""
    if "\0" in str(path):
        raise ProfileError(f"{str(path)!r}: no file has such a name")
    if not os.path.exists(path) and path.suffix in ("", ".toml") and path.parent == Path():
        built_in = BUILT_IN / (path.stem + ".toml")
        if os.path.exists(built_in):
            path = built_in
    try:
        text = read_toml(path, expected=PROFILE)
    except FileNotFoundError as e:
        known = sorted(p.stem for p in BUILT_IN.glob("*.toml"))
        raise ProfileError(f"{path}: {e.strerror}; built-in profiles: {', '.join(known)}") from e
    except OSError as e:
        raise ProfileError(f"{path}: {e.strerror}") from e
    return parse_bundle(text, None, where=str(path), folder=path.parent)
