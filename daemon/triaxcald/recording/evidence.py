"""Which segments are kept because an outcome or a certificate beside them rests
on them: an index of those documents, each of which is read once."""

from __future__ import annotations

import os
import re
import threading
import time
from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple
from weakref import WeakValueDictionary

import numpy as np

from triaxcal_drivers.files import read_whole
from triaxcald.recording.manifest import Manifest, Segment

EVIDENCE = (".outcome.json", ".certificate.json")
"""How the names of documents end that may rest on a recording."""
EVIDENCE_MOST = 4 * 2**20  # bytes of one, as for any document
SETTLED_NS = 2_000_000_000
"""A file that was changed so lately may change again within one tick of the file
system's clock, and look the same: it is read again."""
NAMES_MOST = 4096
"""Names and digests of one document that are held; ours have a dozen. One with
more is read each time."""
FILE_NAME_MOST = 255
DIGEST_DIGITS = 64  # of a SHA-256

_DIGEST = re.compile(r"[0-9a-f]{64}")
_SUFFIX = ".mcap"
_IS_HEX = np.isin(np.arange(256), np.frombuffer(b"0123456789abcdef", dtype=np.uint8))


class Evidence(NamedTuple):
    """``kept`` are files that stay; ``unread`` is the document, or the folder,
    that may name any of them."""

    kept: frozenset[str]
    unread: str | None = None


class _Stamp(NamedTuple):
    """By which a file is known to be as it was."""

    device: int
    inode: int
    size: int
    modified_ns: int
    changed_ns: int

    @staticmethod
    def of(status: os.stat_result) -> _Stamp:
        return _Stamp(status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)

    @property
    def settled(self) -> bool:
        now_ns = time.time_ns()
        return all(abs(now_ns - at_ns) > SETTLED_NS for at_ns in (self.modified_ns, self.changed_ns))


class _Names(NamedTuple):
    """What a document may name: runs of digits of digests, and the ends of its
    text at each `.mcap`, written backwards."""

    digests: frozenset[str]
    ends: frozenset[str]


@dataclass
class _All:
    """The same of all documents that are indexed, to be searched."""

    digests: frozenset[str] = frozenset()
    long_runs: tuple[str, ...] = ()
    ends: tuple[str, ...] = ()  # in order
    documents: tuple[str, ...] = ()  # names of all documents, in order

    def names(self, segment: Segment) -> bool:
        if _begins_one(self.documents, f"{Path(segment.file).stem}.") or _begins_one(self.ends, segment.file[::-1]):
            return True
        told = [digest for digest in (segment.sha256, segment.raw_sha256) if digest]
        return any(digest in self.digests or any(digest in run for run in self.long_runs) for digest in told)


def _begins_one(ordered: tuple[str, ...], beginning: str) -> bool:
    at = bisect_left(ordered, beginning)
    return at < len(ordered) and ordered[at].startswith(beginning)


@dataclass(eq=False)
class EvidenceIndex:
    """Of the documents in one folder. From one look to the next only those are
    read that are new, or changed; from any thread."""

    folder: Path
    reads: int = 0
    """Documents that have been read."""
    _known: dict[str, tuple[_Stamp, _Names | None]] = field(default_factory=dict)
    _all: _All = field(default_factory=_All)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def of(self, manifest: Manifest) -> Evidence:
        """The files that an outcome or a certificate beside the manifest names,
        by name or by digest; all, where such a document cannot be read, and
        which that is."""
        every = frozenset(s.file for s in manifest.segments)
        with self._lock:
            try:
                unread = self._look()
                if unread is not None:
                    return Evidence(every, unread)
                texts = self._texts(name for name, (_, names) in self._known.items() if names is None)
                kept = {s.file for s in manifest.segments if self._all.names(s) or _is_in(s, texts)}
                odd = [s for s in manifest.segments if s.file not in kept and not _is_indexed(s)]
                if odd:
                    texts = self._texts(self._known)
                    kept |= {s.file for s in odd if _is_in(s, texts)}
            except _Unread as e:
                return Evidence(every, str(e))
            return Evidence(frozenset(kept))

    def _look(self) -> str | None:
        """Brings the index up to date; what cannot be read, if anything."""
        found: dict[str, tuple[_Stamp, _Names | None]] = {}
        try:
            with os.scandir(self.folder) as entries:
                names = sorted(entry.name for entry in entries if entry.name.endswith(EVIDENCE))
        except FileNotFoundError:
            names = []
        except OSError:
            return str(self.folder)
        changed = False
        for name in names:
            path = self.folder / name
            try:
                stamp = _Stamp.of(path.stat())
                known = self._known.get(name)
                if known is not None and known[0] == stamp and stamp.settled:
                    found[name] = known
                    continue
                found[name] = stamp, _names_in(self._data(name))
                changed = True
            except OSError:
                if os.path.lexists(path):
                    return name
        if changed or found.keys() != self._known.keys():
            self._known = found
            self._all = _joined(found)
        return None

    def _data(self, name: str) -> bytes:
        self.reads += 1
        return read_whole(self.folder / name, EVIDENCE_MOST)

    def _texts(self, names: Iterable[str]) -> list[str]:
        """Raises _Unread."""
        texts = []
        for name in names:
            try:
                texts.append(self._data(name).decode("utf-8", "replace"))
            except OSError:
                if os.path.lexists(self.folder / name):
                    raise _Unread(name) from None
        return texts


class _Unread(Exception):
    """A document that is there cannot be read."""


def _names_in(data: bytes) -> _Names | None:
    """None where there are too many to be held."""
    digests = frozenset(_digests_in(data))
    text = data.decode("utf-8", "replace")
    ends = set()
    at = text.find(_SUFFIX)
    while at >= 0:
        end = at + len(_SUFFIX)
        # The name of a file has no slash, and is no longer than this.
        ends.add(text[max(0, end - FILE_NAME_MOST) : end].rpartition("/")[2][::-1])
        if len(ends) + len(digests) > NAMES_MOST:
            return None
        at = text.find(_SUFFIX, end)
    return _Names(digests, frozenset(ends)) if len(digests) <= NAMES_MOST else None


def _digests_in(data: bytes) -> list[str]:
    """The runs of hexadecimal digits that are long enough. Ten times as fast as
    a regular expression, which begins anew at every digit of a number."""
    edges = np.flatnonzero(np.diff(_IS_HEX[np.frombuffer(data, dtype=np.uint8)].astype(np.int8), prepend=0, append=0))
    starts, ends = edges[::2], edges[1::2]
    long = ends - starts >= DIGEST_DIGITS
    return [data[a:b].decode() for a, b in zip(starts[long].tolist(), ends[long].tolist(), strict=True)]


def _joined(found: dict[str, tuple[_Stamp, _Names | None]]) -> _All:
    indexed = [names for _, names in found.values() if names is not None]
    runs = frozenset().union(*(names.digests for names in indexed))
    ends = frozenset().union(*(names.ends for names in indexed))
    long_runs = tuple(run for run in runs if len(run) > DIGEST_DIGITS)
    return _All(runs, long_runs, tuple(sorted(ends)), tuple(sorted(found)))


def _is_indexed(segment: Segment) -> bool:
    """Whether all that a document may call it by is of the kinds that are
    indexed."""
    return all(_DIGEST.fullmatch(d) for d in (segment.sha256, segment.raw_sha256) if d)


def _is_in(segment: Segment, texts: Iterable[str]) -> bool:
    told = [name for name in (segment.file, segment.sha256, segment.raw_sha256) if name]
    return any(name in text for text in texts for name in told)


_indexes: WeakValueDictionary[Path, EvidenceIndex] = WeakValueDictionary()
_indexes_lock = threading.Lock()


def evidence_in(folder: Path) -> EvidenceIndex:
    """The index of a folder, which all writers of this process share."""
    with _indexes_lock:
        key = folder.absolute()
        index = _indexes.get(key)
        if index is None:
            index = _indexes[key] = EvidenceIndex(key)
        return index
