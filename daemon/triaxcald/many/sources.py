"""Which recordings are meant: files, folders, patterns, lists, and URLs of stores."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from errno import ELOOP
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Final

import triaxcal_drivers as td
from triaxcald.errors import BAD_INPUT, DISK, DaemonError, InputError, exit_code_of
from triaxcald.files import is_of_the_disk
from triaxcald.stores import Listed, StoreFile, files_like, files_under, is_url, path_of

LIST: Final = (".list", ".manifest")
"""Ends of names of a manifest: a list of recordings, one a line."""
LIST_MOST: Final = 2**29
"""Bytes of a list: four million paths."""
LINE_MOST: Final = 4096
_WILD: Final = frozenset("*?[")
_SEGMENT: Final = re.compile(r"(.+)-\d{6,18}\.mcap")
MANIFEST: Final = ".segments.json"


@dataclass(frozen=True, slots=True)
class Source:
    """A recording. ``stamp`` changes with its contents: the modification time [ns], or
    the ETag of a store; both are empty where it does not tell."""

    name: str
    size: int | None = None
    stamp: str = ""


@dataclass(frozen=True)
class Unusable:
    """What was asked for and names no recording. ``empty``: a folder that can be read
    and has none."""

    name: str
    error: str
    exit_code: int
    empty: bool = False


class NoRecording(InputError):
    """A folder without a recording."""


Found = Source | Unusable


def sources_of(
    asked: Sequence[str],
    endings: tuple[str, ...],
    *,
    without: Iterable[Path] = (),
    lists: tuple[str, ...] = LIST,
    absolute: bool = False,
) -> list[Found]:
    """Recordings, folders of recordings, patterns, lists and URLs, in the order in
    which they are given, each recording once. What names no recording is its own error.
    ``endings`` are those of recordings in a folder, ``lists`` those of manifests; the
    files ``without`` are none. Paths are ``absolute`` for who has another folder to
    start from."""
    own = {path.absolute() for path in without}
    found: dict[str, Found] = {}
    for given in asked:
        try:
            for source in _sources_of(given, endings, lists):
                if absolute and isinstance(source, Source) and not is_url(source.name):
                    source = replace(source, name=str(Path(source.name).absolute()))
                if not own or is_url(source.name) or Path(source.name).absolute() not in own:
                    found.setdefault(source.name, source)
        except DaemonError as e:
            found[given] = Unusable(given, str(e), exit_code_of(e), isinstance(e, NoRecording))
        except OSError as e:
            found[given] = _unusable(given, e)
    return list(found.values())


def _sources_of(given: str, endings: tuple[str, ...], lists: tuple[str, ...]) -> Iterable[Found]:
    """Raises InputError, OSError."""
    if given == "-":
        raise InputError("-: standard input is no recording among many; give files")
    if given.endswith(lists) and not _is_folder(given):
        return list(_of_list(given))
    if is_url(given) and not given.startswith("file://"):
        return _in_store(given, endings)
    return _in_folder(path_of(given), endings)


def _unusable(name: str, e: OSError, why: str = "") -> Unusable:
    return Unusable(name, f"{name}: {why}{e.strerror or e}", DISK if is_of_the_disk(e) else 2)


def _is_folder(given: str) -> bool:
    path = path_of(given)
    return isinstance(path, Path) and path.is_dir()


def _in_store(url: str, endings: tuple[str, ...]) -> list[Found]:
    if _WILD & set(url.partition("?")[0] if url.startswith("http") else url):
        found = files_like(url)
        if not found:
            raise InputError(f"{url}: no file in the store has a name like this")
        return [_stored(listed) for listed in found]
    file = StoreFile(url)
    if file.name.endswith(endings):
        return [_one(url, file)]
    found = files_under(url, endings)
    if not found:
        raise InputError(f"{url}: no recording ({', '.join(endings)}) is in this folder of the store")
    return [_stored(listed) for listed in found]


def _one(name: str, file: StoreFile) -> Found:
    try:
        return _stored(file.listed())
    except OSError as e:
        return _unusable(name, e, "cannot be read: ")
    except DaemonError as e:
        return Unusable(name, str(e), exit_code_of(e))


def _stored(of: Listed) -> Source:
    return Source(of.url, of.size, of.stamp)


def _in_folder(given: td.files.AnyPath, endings: tuple[str, ...]) -> list[Found]:
    assert isinstance(given, Path)
    if given.is_dir():
        found = _recordings_of(given, endings)
        if not found:
            raise NoRecording(f"{given}: Is a directory, without a recording ({', '.join(endings)}) in it")
        return found
    if not given.exists() and _WILD & set(str(given)):
        matches = sorted(map(Path, glob.glob(str(given), recursive=True)))
        closed: list[Found] = list(_not_searched(given))
        if not matches and not closed:
            raise InputError(f"{given}: no file has a name like this")
        found = [s for of in matches for s in (_recordings_of(of, endings) if of.is_dir() else [_local(of)])] + closed
        if not found:
            raise NoRecording(f"{given}: folders without a recording ({', '.join(endings)}) in them")
        return found
    return [_local(given)]


def _recordings_of(folder: Path, endings: tuple[str, ...]) -> list[Found]:
    """Recordings below a folder in order, and folders that cannot be looked into."""
    errors: list[OSError] = []
    paths = sorted(
        Path(within, name)
        for within, _, names in os.walk(folder, onerror=errors.append)
        for name in names
        if name.endswith(endings)
    )
    if MANIFEST in endings:
        paths = _without_segments(paths)
    return [*map(_local, paths), *map(_closed, errors)]


def _closed(e: OSError, path: str | None = None) -> Unusable:
    """A folder that cannot be looked into."""
    return _unusable(str(e.filename) if path is None else path, e, "cannot be looked into: ")


def _not_searched(pattern: Path) -> list[Unusable]:
    """Folders that the pattern leads to and that cannot be read; `glob` passes over
    them without a word."""
    errors: dict[str, OSError] = {}
    seen: set[tuple[str, int]] = set()  # links may form circles

    def search(folder: str, first: int) -> None:
        while first < len(pattern.parts) - 1 and not _WILD & set(pattern.parts[first]):
            folder, first = os.path.join(folder, pattern.parts[first]), first + 1
        if first == len(pattern.parts) or (real := (os.path.realpath(folder), first)) in seen:
            return
        seen.add(real)
        part, last = pattern.parts[first], first == len(pattern.parts) - 1
        below: list[str] = []
        try:
            if not _WILD & set(part):  # a name that is looked up
                os.lstat(os.path.join(folder, part))
                return
            with os.scandir(folder or ".") as entries:
                # What the last part matches is looked into by who opens it.
                fitting = [e for e in entries if _fits(e.name, part)] if part == "**" or not last else []
        except OSError as e:
            if not isinstance(e, (FileNotFoundError, NotADirectoryError)):
                errors[folder] = e
            return
        for entry in fitting:
            path = os.path.join(folder, entry.name)
            try:
                if entry.is_dir():
                    below.append(path)
            except OSError as e:
                if e.errno != ELOOP:  # a link to itself is no folder
                    errors[path] = e
        if part == "**":
            search(folder, first + 1)
        for path in sorted(below):
            search(path, first if part == "**" else first + 1)

    search("", 0)
    return [_closed(e, path or ".") for path, e in errors.items()]


def _fits(name: str, part: str) -> bool:
    hidden = name.startswith(".") and not part.startswith(".")
    return not hidden and (part == "**" or fnmatchcase(name, part))


def _without_segments(paths: list[Path]) -> list[Path]:
    """A manifest stands for its segments."""
    series = {str(path).removesuffix(MANIFEST) for path in paths if path.name.endswith(MANIFEST)}
    return [p for p in paths if not ((match := _SEGMENT.fullmatch(str(p))) and match[1] in series)]


def _local(path: Path) -> Source:
    """One that is not there is found so by who opens it."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        return Source(str(path))
    return Source(str(path), status.st_size, str(status.st_mtime_ns))


def _of_list(name: str) -> Iterator[Found]:
    """Recordings of a list: a path or URL a line, relative to the list; lines that
    begin with # are comments. Raises InputError, OSError."""
    where = path_of(name)
    try:
        lines = td.files.read_whole(where, LIST_MOST).decode().splitlines()
    except UnicodeDecodeError as e:
        raise InputError(f"{name}: not UTF-8 text (byte {e.start}), expected a path or URL a line") from e
    count = 0
    for number, line in enumerate(lines, start=1):
        entry = line.strip()
        if not entry or entry.startswith("#"):
            continue
        count += 1
        if len(entry) > LINE_MOST or "\0" in entry:
            at = f"{name}, line {number}"
            yield Unusable(at, f"{at}: expected a path or URL of at most {LINE_MOST} characters", BAD_INPUT)
        elif is_url(entry) and not entry.startswith("file://"):
            yield _one(entry, StoreFile(entry))
        elif isinstance(where, Path):
            yield _of_line(entry, where.parent)
        else:
            url = f"{where.parent}/{entry}"
            yield _one(url, StoreFile(url))
    if not count:
        raise InputError(f"{name}: no recording is in this list")


def _of_line(entry: str, folder: Path) -> Found:
    try:
        path = path_of(entry)
    except DaemonError as e:
        return Unusable(entry, str(e), exit_code_of(e))
    assert isinstance(path, Path)
    return _local(folder / path)
