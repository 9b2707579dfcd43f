"""The drivers and profiles that are installed, found by entry point, none imported
until asked for; and from the text of a profile to a `Bundle`: the driver that it
names validates it, and its files are read."""

from __future__ import annotations

import errno
import os
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from triaxcal_drivers.errors import DriverMissing, ProfileError
from triaxcal_drivers.files import inside, read_whole, size
from triaxcal_drivers.hints import absent, clipped, closest, lacking
from triaxcal_drivers.profile import Bundle
from triaxcal_drivers.toml_text import PROFILE, parse_toml, read_toml, validate

if TYPE_CHECKING:
    from triaxcal_drivers.interface import Driver

GROUP, PROFILES = "triaxcal.drivers", "triaxcal.profiles"
OURS = "triaxcal"


@dataclass(frozen=True)
class Listed:
    """An installed driver; ``fault`` says why it cannot be used, where it
    cannot."""

    name: str
    target: str
    distribution: str
    fault: str | None = None


def _points() -> Mapping[str, EntryPoint]:
    return _points_on(tuple((folder, _changed_ns(folder)) for folder in sys.path))


@lru_cache(maxsize=1)
def _points_on(path: tuple[tuple[str, int], ...]) -> Mapping[str, EntryPoint]:
    """Those on this ``path``, folder by folder with the time of its last change: an
    audit of many recordings asks for the same driver again and again."""
    return {p.name: p for p in entry_points(group=GROUP)}


def _changed_ns(folder: str) -> int:
    try:
        return os.stat(folder or ".").st_mtime_ns
    except OSError:
        return 0


def driver_named(name: str, *, where: str = "") -> Driver:
    """Raises DriverMissing with the nearest name, or with the reason why it
    cannot be imported."""
    lead = f"{where}: " if where else ""
    points = _points()
    if name not in points:
        close = closest(name, points)
        hint = f"; did you mean '{close}'?" if close else f"; installed: {', '.join(sorted(points)) or 'none'}"
        raise DriverMissing(f"{lead}no driver named '{clipped(name)}'{hint}")
    try:
        return cast("Driver", points[name].load()())
    except Exception as e:
        why = (lacking(e) if isinstance(e, ModuleNotFoundError) else None) or repr(e)
        raise DriverMissing(f"{lead}driver '{name}' ({points[name].value}) cannot be loaded: {why}") from e


def listed() -> list[Listed]:
    """Every installed driver, tried; for `triaxcal devices`."""
    found = []
    for name, point in sorted(_points().items()):
        fault = None
        try:
            fault = absent(getattr(driver_named(name), "packages", ()))
        except DriverMissing as e:
            fault = str(e)
        found.append(Listed(name, point.value, point.dist.name if point.dist else "?", fault))
    return found


BUILT_IN = Path(__file__).parent / "profiles"
"""Ours. Profiles of other packages are found by an entry point of the group
`PROFILES`, which names a package with TOML files, or the path of their folder."""


def new_profile(kind: str) -> str:
    """A commented profile to begin with: ``can-dbc``, ``can-pdo``, ``modbus-poll`` or
    ``modbus-fifo``."""
    return (BUILT_IN / "new" / f"{kind}.toml").read_text("utf-8")


@dataclass(frozen=True)
class ListedProfile:
    """An installed profile, by the ``name`` that a station gives; ``fault`` says why
    it cannot be found, where it cannot, and ``path`` is None then."""

    name: str
    path: Path | None
    distribution: str
    fault: str | None = None


def listed_profiles() -> list[ListedProfile]:
    """Every installed profile: ours, and those of other packages, which are imported
    for it. None of them is read."""
    found = [ListedProfile(path.stem, path, OURS) for path in sorted(BUILT_IN.glob("*.toml"))]
    holders = {one.name: one.distribution for one in found}
    for point in sorted(entry_points(group=PROFILES), key=lambda p: (p.name, p.value)):
        package = (point.dist.name if point.dist else None) or "?"
        try:
            paths = _paths(point)
        except ProfileError as e:
            found.append(ListedProfile(point.name, None, package, str(e)))
            continue
        for path in paths:
            why = f"{holders[path.stem]} has a profile of that name: give {path}" if path.stem in holders else None
            holders.setdefault(path.stem, package)
            found.append(ListedProfile(path.stem, None if why else path, package, why))
    return found


def _paths(point: EntryPoint) -> list[Path]:
    """The profiles of an entry point. Raises ProfileError with the reason, whatever
    the other package does when it is imported."""
    try:
        paths = [path for folder in _folders(point.load()) for path in sorted(folder.glob("*.toml"))]
    except (Exception, SystemExit) as e:
        raise ProfileError(f"{point.value} cannot be loaded: {e!r}") from e
    if not paths:
        raise ProfileError(f"{point.value}: there is no profile (*.toml) in it")
    return paths


def _folders(named: Any) -> list[Path]:
    """Of a package, or the folder itself. Raises OSError, TypeError."""
    if getattr(named, "__path__", None) is None and hasattr(named, "__file__"):
        raise TypeError("a module: expected a package, or the path of a folder")  # whose folder has files of others
    folders = [Path(place) for place in getattr(named, "__path__", None) or [os.fspath(named)]]
    for folder in folders:
        if not folder.is_dir():
            raise NotADirectoryError(f"{folder} is no folder")
    return folders


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


def _installed(name: str) -> Path | None:
    """The file of an installed profile; other packages are imported for it where none
    of ours has that name. None without one."""
    path = BUILT_IN / f"{name}.toml"
    return path if os.path.exists(path) else next((p.path for p in listed_profiles() if p.name == name), None)


def _absent(path: Path) -> ProfileError:
    """Names the installed profiles, and why one of that name is not to be had."""
    profiles = listed_profiles()
    ours = ", ".join(p.name for p in profiles if p.distribution == OURS)
    others = ", ".join(p.name for p in profiles if p.distribution != OURS and p.path is not None)
    broken = "".join(f"; {p.distribution}: {p.fault}" for p in profiles if p.name == path.stem and p.fault)
    more = f"; of other packages: {others}" if others else ""
    return ProfileError(f"{path}: {os.strerror(errno.ENOENT)}; built-in profiles: {ours}{more}{broken}")


def load_bundle(path: Path) -> Bundle:
    """The profile at ``path``, or an installed one where ``path`` is a bare name
    such as ``triax-ref-can``."""
    if "\0" in str(path):
        raise ProfileError(f"{str(path)!r}: no file has such a name")
    if not os.path.exists(path) and path.suffix in ("", ".toml") and path.parent == Path():
        path = _installed(path.stem) or path
    try:
        text = read_toml(path, expected=PROFILE)
    except FileNotFoundError as e:
        raise _absent(path) from e
    except OSError as e:
        raise ProfileError(f"{path}: {e.strerror}") from e
    return parse_bundle(text, None, where=str(path), folder=path.parent)
