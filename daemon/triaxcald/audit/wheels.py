"""A folder of wheels, and what it lacks of an environment that some Python shall have.

The names of the files are those of the binary distribution format (PEP 427); what they
need stands in their metadata (core metadata, `Requires-Dist`).
"""

from __future__ import annotations

import zipfile
from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from packaging.metadata import RawMetadata, parse_email
from packaging.requirements import InvalidRequirement, Requirement
from packaging.specifiers import InvalidSpecifier, SpecifierSet
from packaging.utils import (
    InvalidSdistFilename,
    InvalidWheelFilename,
    canonicalize_name,
    parse_sdist_filename,
    parse_wheel_filename,
)
from packaging.version import Version

from triaxcald.errors import InputError


@dataclass(frozen=True)
class Target:
    """A Python that wheels shall be for: the ``tags`` that it takes (PEP 425), and the
    values of environment ``markers`` (PEP 508)."""

    tags: frozenset[str]
    markers: Mapping[str, str]


@dataclass(frozen=True)
class Wheel:
    path: Path
    version: Version
    tags: frozenset[str]

    def suits(self, target: Target) -> bool:
        return not self.tags.isdisjoint(target.tags)

    def unsuited(self, target: Target) -> str:
        """Whether it is for another Python or for another platform, in words."""
        pythons, platforms = ({_half(tag, i) for tag in target.tags} for i in (0, 1))
        of_python = {_half(tag, 0) for tag in self.tags}
        of_platform = {_half(tag, 1) for tag in self.tags}
        other = []
        if pythons.isdisjoint(of_python):
            other.append(f"another Python ({', '.join(sorted(of_python))})")
        if platforms.isdisjoint(of_platform):
            other.append(f"another platform ({', '.join(sorted(of_platform))})")
        return f"{self.path.name} is for {' and '.join(other) or 'another Python on this platform'}"

    def metadata(self) -> RawMetadata:
        """Raises InputError where the file is no wheel."""
        try:
            with zipfile.ZipFile(self.path) as archive:
                name = next(n for n in archive.namelist() if n.count("/") == 1 and n.endswith(".dist-info/METADATA"))
                return parse_email(archive.read(name))[0]
        except (OSError, zipfile.BadZipFile, StopIteration, NotImplementedError, RuntimeError) as e:
            raise InputError(f"{self.path}: is no wheel, or a damaged one") from e


def _half(tag: str, which: int) -> str:
    """Interpreter and ABI of a tag, or its platform."""
    python, abi, platform = tag.split("-", 2)
    return platform if which else f"{python}-{abi}"


@dataclass(frozen=True)
class Wheels:
    """Those in a folder by name, and the versions of which it has the source alone."""

    folder: Path
    by_name: Mapping[str, tuple[Wheel, ...]]
    sources: Mapping[str, tuple[Version, ...]]

    @classmethod
    def of(cls, folder: Path) -> Wheels:
        """Raises InputError where there is no such folder."""
        wheels: dict[str, list[Wheel]] = {}
        sources: dict[str, list[Version]] = {}
        try:
            paths = sorted(folder.iterdir())
        except OSError as e:
            raise InputError(f"--wheels {folder}: {e.strerror}, expected a folder of wheels") from e
        for path in paths:
            try:
                if path.suffix == ".whl":
                    name, version, _, tags = parse_wheel_filename(path.name)
                    wheels.setdefault(name, []).append(Wheel(path, version, frozenset(map(str, tags))))
                elif path.name.endswith((".tar.gz", ".zip")):
                    name, version = parse_sdist_filename(path.name)
                    sources.setdefault(name, []).append(version)
            except (InvalidWheelFilename, InvalidSdistFilename):
                continue
        newest = {name: tuple(sorted(of, key=lambda w: w.version, reverse=True)) for name, of in wheels.items()}
        return cls(folder, newest, {name: tuple(of) for name, of in sources.items()})

    def chosen(self, wanted: Requirement, target: Target) -> Wheel | None:
        """The newest that suits."""
        fitting = self._fitting(wanted)
        return next((wheel for wheel in fitting if wheel.suits(target)), None)

    def _fitting(self, wanted: Requirement) -> list[Wheel]:
        found = self.by_name.get(canonicalize_name(wanted.name), ())
        # A development version is taken where only that meets what is wanted.
        for prereleases in (None, True):
            if fitting := [w for w in found if wanted.specifier.contains(w.version, prereleases)]:
                return fitting
        return []

    def missing(self, wanted: Iterable[Requirement], target: Target) -> list[str]:
        """What is wanted, or needed by what is wanted, and is not there for the target:
        each by its name and version, with the reason. Where several versions meet a
        need, the newest counts."""
        found: dict[str, str] = {}
        seen: set[str] = set()
        queue = deque((requirement, "") for requirement in wanted)
        while queue:
            requirement, by = queue.popleft()
            if str(requirement) in seen:
                continue
            seen.add(str(requirement))
            wheel = self.chosen(requirement, target)
            if wheel is None:
                found.setdefault(str(requirement), self._why(requirement, target) + by)
                continue
            try:
                needs = needed_by(wheel.metadata(), requirement, target)
            except InputError as e:
                found[str(requirement)] = str(e)
                continue
            queue.extend((need, f", which {requirement.name} needs") for need in needs)
        return list(found.values())

    def _why(self, wanted: Requirement, target: Target) -> str:
        name = f"{wanted.name} {str(wanted.specifier).removeprefix('==')}".strip()
        if fitting := self._fitting(wanted):
            return f"{name} ({'; '.join(wheel.unsuited(target) for wheel in fitting)})"
        key = canonicalize_name(wanted.name)
        if any(wanted.specifier.contains(version, True) for version in self.sources.get(key, ())):
            return f"{name} (there is its source, expected a wheel)"
        others = sorted({wheel.version for wheel in self.by_name.get(key, ())})
        return f"{name} (there is {', '.join(map(str, others))})" if others else name


def needed_by(metadata: RawMetadata, wanted: Requirement, target: Target) -> list[Requirement]:
    """What a wheel with this ``metadata`` needs in the target, with the extras that are
    wanted of it. Raises InputError where it is for another Python."""
    of_python = metadata.get("requires_python", "")
    try:
        if not SpecifierSet(of_python).contains(target.markers["python_full_version"], True):
            raise InputError(f"{wanted.name} {metadata.get('version')} (needs Python {of_python})")
        needs = [Requirement(text) for text in metadata.get("requires_dist", ())]
    except (InvalidSpecifier, InvalidRequirement) as e:
        raise InputError(f"{wanted.name} {metadata.get('version')} (its metadata are damaged: {e})") from e
    return [need for need in needs if _applies(need, wanted.extras, target)]


def _applies(need: Requirement, extras: Iterable[str], target: Target) -> bool:
    if need.marker is None:
        return True
    return any(need.marker.evaluate({**target.markers, "extra": extra}) for extra in ("", *extras))
