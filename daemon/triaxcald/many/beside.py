"""Files beside recordings that a result depends on, too: where one changes, so does
the recording's stamp."""

from __future__ import annotations

import os
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Final

import triaxcal_drivers as td
from triaxcald.many.sources import Found, Source
from triaxcald.stores import Listed, StoreFile, files_in, path_of

FOLDERS: Final = 8
"""Listings of a store that are kept: recordings come folder by folder."""
_DIGITS: Final = 16  # of a digest: a change goes unseen once in 2**64


def with_files_beside(
    found: Iterable[Found],
    files: Callable[[td.files.AnyPath], Sequence[td.files.AnyPath]],
    also: Callable[[td.files.AnyPath], str] = lambda path: "",
) -> list[Found]:
    """Recordings whose stamps change with these ``files`` of each, which lie in its
    folder and may lack, and with the text ``also``. A recording of whose files the
    store does not tell has no stamp and no size, so that its row is made again."""
    listings = _Listings()

    def marked(of: Found) -> Found:
        if not isinstance(of, Source) or not (of.stamp or of.size):
            return of
        path = path_of(of.name)
        try:
            told = [(file.name, status) for file in files(path) if (status := listings.status(file)) is not None]
        except OSError:
            return Source(of.name)
        text = also(path)
        if not told and not text:
            return of
        digest = sha256(repr((told, text)).encode("utf-8", "backslashreplace")).hexdigest()[:_DIGITS]
        return Source(of.name, of.size, f"{of.stamp}+{digest}")

    return [marked(of) for of in found]


class _Listings:
    """Of folders in stores, each asked for once. The web lists none reliably: its files
    are asked for one by one, as are those of a folder that nobody may list."""

    def __init__(self) -> None:
        self._held: OrderedDict[str, Mapping[str, Listed] | None] = OrderedDict()

    def status(self, file: td.files.AnyPath) -> tuple[int | None, str] | None:
        """Size and stamp; None where it is not there. Raises OSError."""
        if not isinstance(file, StoreFile):
            return _of_disk(Path(str(file)))
        listing = self._listing(file.parent)
        try:
            found = file.listed() if listing is None else listing.get(file.name)
        except FileNotFoundError:
            return None
        return None if found is None else (found.size, found.stamp)

    def _listing(self, folder: StoreFile) -> Mapping[str, Listed] | None:
        url = str(folder)
        if url.startswith(("http://", "https://")):
            return None
        if url not in self._held:
            try:
                self._held[url] = files_in(folder)
            except OSError:
                self._held[url] = None
            if len(self._held) > FOLDERS:
                self._held.popitem(last=False)
        return self._held[url]


def _of_disk(path: Path) -> tuple[int, str] | None:
    try:
        status = os.stat(path)
    except (FileNotFoundError, NotADirectoryError, ValueError):
        return None
    return status.st_size, str(status.st_mtime_ns)
