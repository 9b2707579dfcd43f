"""Wheels for tests, without a network: small ones of text, and those of the distributions that run the tests."""

from __future__ import annotations

import base64
import hashlib
import zipfile
from collections.abc import Iterable, Mapping
from importlib.metadata import distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

REPOSITORY = Path(__file__).parents[3]
PACKAGES = {"triaxcal": "triaxcal", "drivers/triaxcal_drivers": "triaxcal_drivers", "daemon/triaxcald": "triaxcald"}
"""Folders of the source, and where they are in a wheel."""
NOT_PACKED = ("RECORD", "INSTALLER", "REQUESTED", "direct_url.json")


def write_wheel(folder: Path, name: str, version: str, files: Mapping[str, bytes], tag: str = "py3-none-any") -> Path:
    """With a RECORD of its files; nothing is compressed, which is faster."""
    stem = f"{canonicalize_name(name).replace('-', '_')}-{version}"
    lines = []
    path = folder / f"{stem}-{tag}.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for place, data in files.items():
            archive.writestr(zipfile.ZipInfo(place), data)
            digest = base64.urlsafe_b64encode(hashlib.sha256(data).digest()).rstrip(b"=").decode()
            lines.append(f"{place},sha256={digest},{len(data)}\n")
        record = f"{stem}.dist-info/RECORD"
        archive.writestr(zipfile.ZipInfo(record), "".join(lines) + f"{record},,\n")
    return path


def small_wheel(
    folder: Path,
    name: str,
    version: str,
    *,
    tag: str = "py3-none-any",
    requires: Iterable[str] = (),
    headers: Iterable[str] = (),
    program: str = "",
) -> Path:
    """Of one module with a ``program``, whose ``main`` is the console script of the same name."""
    module = canonicalize_name(name).replace("-", "_")
    info = f"{module}-{version}.dist-info"
    lines = ["Metadata-Version: 2.1", f"Name: {name}", f"Version: {version}", *headers]
    files = {
        f"{module}.py": program.encode(),
        f"{info}/METADATA": "\n".join([*lines, *(f"Requires-Dist: {r}" for r in requires), "", ""]).encode(),
        f"{info}/WHEEL": f"Wheel-Version: 1.0\nGenerator: tests\nRoot-Is-Purelib: true\nTag: {tag}\n".encode(),
    }
    if program:
        files[f"{info}/entry_points.txt"] = f"[console_scripts]\n{name} = {module}:main\n".encode()
    return write_wheel(folder, name, version, files, tag)


def repacked(folder: Path, name: str) -> Path:
    """The wheel of an installed distribution, by its list of files: without scripts, which entry points make again."""
    found = distribution(name)
    info = next(Path(str(f)).parts[0] for f in found.files or () if str(f).endswith(".dist-info/METADATA"))
    stem = f"{canonicalize_name(found.name).replace('-', '_')}-{found.version}"
    files = {}
    for file in found.files or ():
        place = str(file)
        if place.startswith("..") or place.endswith(".pyc") or Path(place).name in NOT_PACKED:
            continue
        files[place.replace(info, f"{stem}.dist-info", 1)] = Path(str(found.locate_file(file))).read_bytes()
    return write_wheel(folder, found.name, found.version, files, _tag(files[f"{stem}.dist-info/WHEEL"].decode()))


def _tag(text: str) -> str:
    """The compressed tag of a file name, of the tags that a wheel lists."""
    tags = [line.partition(":")[2].strip().split("-", 2) for line in text.splitlines() if line.startswith("Tag:")]
    return "-".join(".".join(dict.fromkeys(part)) for part in zip(*tags, strict=True))


def of_source(folder: Path, version: str | None = None) -> Path:
    """The wheel of this source, in its own version or in another."""
    found = distribution("triaxcal")
    now = version or found.version
    info = f"triaxcal-{now}.dist-info"
    metadata = (found.read_text("METADATA") or "").replace(f"\nVersion: {found.version}\n", f"\nVersion: {now}\n", 1)
    files = {
        f"{to}/{path.relative_to(REPOSITORY / source).as_posix()}": path.read_bytes()
        for source, to in PACKAGES.items()
        for path in sorted((REPOSITORY / source).rglob("*"))
        if path.is_file() and path.suffix != ".pyc"
    }
    files |= {
        f"{info}/METADATA": metadata.encode(),
        f"{info}/WHEEL": b"Wheel-Version: 1.0\nGenerator: tests\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": (found.read_text("entry_points.txt") or "").encode(),
    }
    return write_wheel(folder, "triaxcal", now, files)


def needs_of(name: str) -> set[str]:
    """What a distribution needs, and what that needs, without extras."""
    found: set[str] = set()
    queue = [name]
    while queue:
        for text in distribution(queue.pop()).requires or ():
            need = Requirement(text)
            key = canonicalize_name(need.name)
            if key not in found and (need.marker is None or need.marker.evaluate({"extra": ""})):
                found.add(key)
                queue.append(key)
    return found
