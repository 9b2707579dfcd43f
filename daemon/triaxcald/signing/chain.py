"""The chain of a station's signed recordings, `chain.jsonl` in its folder: one line an
entry, in the order in which recordings were closed.

The first entry lists the outcomes that were in the folder before. Each signed
recording, and each tombstone, has the number of its entry and the digest of the entry
before in what is signed. A recording's line is only an index to it; a start and a
tombstone are signed themselves, and are in their lines.

Who closes a recording holds a lock on the file until the recording is on the disk and
has its line. What that line will be is noted in `chain.pending` first. So a process
that was killed in between leaves a note by which the next one completes the chain.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

from triaxcald.documents import json_value
from triaxcald.errors import DiskError, InputError, NotSigned, RecordingError
from triaxcald.files import is_of_the_disk, synchronise, write_durably
from triaxcald.recording.manifest import SealedContents
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import SIGNATURE_FILE
from triaxcald.signing.envelope import CHAIN_TYPE, Envelope, NotAnEnvelope, envelope_of, parse_envelope, payload_of
from triaxcald.signing.manifest import NUMBER_MOST, Claims, claims_in, claims_of
from triaxcald.station.lock import fcntl

FORMAT: Final = "triaxcal.chain/1"
NAME: Final = "chain.jsonl"
PENDING: Final = "chain.pending"
MEMORY: Final = ".head"
"""Suffix of what a key remembers of a chain."""
CHAIN_MOST: Final = 2**30
"""Bytes of a chain that are read: five million recordings."""
_TAIL: Final = 2**16  # bytes; a line of a recording has some 250


class EntryKind(StrEnum):
    START = "start"
    RECORDING = "recording"
    TOMBSTONE = "tombstone"


@dataclass(frozen=True)
class Entry:
    """``digest`` is the SHA-256 of the payload that was signed. ``recording`` is the
    name of the file, and for a tombstone that of the file which was deleted;
    ``envelope`` is that of a start or a tombstone."""

    kind: EntryKind
    number: int
    digest: str
    recording: str | None = None
    envelope: Envelope | None = None

    def line(self) -> bytes:
        document: dict[str, Any] = {"kind": self.kind, "number": self.number, "digest": self.digest}
        if self.recording is not None:
            document["recording"] = self.recording
        if self.envelope is not None:
            document["envelope"] = self.envelope.document()
        return json.dumps(document, ensure_ascii=False).encode() + b"\n"


def entry_of(line: bytes) -> Entry:
    """Raises NotAnEnvelope."""
    try:
        found = json_value(line)
    except (ValueError, RecursionError):
        raise NotAnEnvelope("no JSON") from None
    if not isinstance(found, dict) or not set(found) <= {"kind", "number", "digest", "recording", "envelope"}:
        raise NotAnEnvelope("no entry of a chain")
    kind, number, digest, recording = (found.get(key) for key in ("kind", "number", "digest", "recording"))
    if kind not in list(EntryKind) or type(number) is not int or not 0 <= number < NUMBER_MOST:
        raise NotAnEnvelope("no entry of a chain")
    if not isinstance(digest, str) or not (recording is None or isinstance(recording, str)):
        raise NotAnEnvelope("no entry of a chain")
    signed = "envelope" in found
    if signed == (kind == EntryKind.RECORDING):
        raise NotAnEnvelope("a start and a tombstone have an envelope, a recording has none")
    envelope = envelope_of(found["envelope"]) if signed else None
    if envelope is not None and hashlib.sha256(envelope.payload).hexdigest() != digest:
        raise NotAnEnvelope("another digest than that of the payload")
    return Entry(EntryKind(kind), number, digest, recording, envelope)


def digest_of(payload: bytes) -> str:
    return hashlib.sha256(payload).hexdigest()


# What a start and a tombstone say.


@dataclass(frozen=True)
class Start:
    """``earlier`` are digests of the outcomes in the folder when the chain began."""

    claims: Claims
    earlier: frozenset[str]


@dataclass(frozen=True)
class Tombstone:
    """``of`` is the digest of what was deleted: of the payload of a signed recording,
    or of the file where it was not signed."""

    claims: Claims
    of: str
    recording: str
    reason: str


def start_document(station: str, earlier: list[str]) -> dict[str, Any]:
    """What the first entry says, but for the claims."""
    return {"format": FORMAT, "kind": EntryKind.START.value, "station": station, "earlier": earlier}


def tombstone_document(of: str, recording: str, reason: str) -> dict[str, Any]:
    return {
        "format": FORMAT, "kind": EntryKind.TOMBSTONE.value, "of": of, "recording": recording, "reason": reason,
    }  # fmt: skip


def said_in(entry: Entry) -> Start | Tombstone:
    """What the envelope of an entry says; the signature is not checked. Raises
    NotAnEnvelope."""
    if entry.envelope is None:
        raise NotAnEnvelope("no envelope")
    found = payload_of(entry.envelope, CHAIN_TYPE)
    claims = claims_of(found)
    if found.get("format") != FORMAT or found.get("kind") != entry.kind or claims.number != entry.number:
        raise NotAnEnvelope("a payload of another entry")
    if entry.kind is EntryKind.START:
        earlier = found.get("earlier")
        if not isinstance(earlier, list) or not all(isinstance(digest, str) for digest in earlier):
            raise NotAnEnvelope("a start without the outcomes before it")
        return Start(claims, frozenset(earlier))
    of, recording, reason = (found.get(key) for key in ("of", "recording", "reason"))
    if not isinstance(of, str) or not isinstance(recording, str) or not isinstance(reason, str):
        raise NotAnEnvelope("a tombstone that does not say of what")
    return Tombstone(claims, of, recording, reason)


# The file.


def read_lines(path: Path) -> list[bytes]:
    """All lines of a chain; one that was not written to its end is none yet. Raises
    InputError."""
    try:
        with open(path, "rb") as file:
            data = file.read(CHAIN_MOST)
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {e.strerror}") from e
    return data.split(b"\n")[:-1]


class OpenChain:
    """A chain under its lock."""

    def __init__(self, path: Path, descriptor: int) -> None:
        self.path, self._descriptor = path, descriptor
        self._end = 0  # of the last line that is whole
        self.head = self._read_head()

    def append(self, entry: Entry) -> None:
        """The line is on the disk when it returns. Raises OSError."""
        end = self._end
        try:
            os.ftruncate(self._descriptor, end)  # a line that was not written to its end
            os.pwrite(self._descriptor, entry.line(), end)
            os.fsync(self._descriptor)
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._descriptor, end)
            raise
        self._end = end + len(entry.line())
        self.head = entry

    def start(self) -> Entry:
        """The first entry. Raises InputError."""
        with open(self.path, "rb") as file:
            return self._entry(file.readline(CHAIN_MOST))

    def settle(self) -> None:
        """Complete what a killed process has left: the line of a recording that is on
        the disk. Raises OSError."""
        try:
            noted = json_value(self.path.with_name(PENDING).read_bytes())
            name, digest = Path(noted["recording"]).name, str(noted["digest"])
        except FileNotFoundError:
            return
        except (OSError, ValueError, LookupError, TypeError, RecursionError):
            self.forget()  # the process was killed before the recording was signed
            return
        if self.head is not None and digest != self.head.digest:
            claims = _claims_of(self.path.with_name(name), digest)
            if claims is not None and (claims.number, claims.previous) == (self.head.number + 1, self.head.digest):
                self.append(Entry(EntryKind.RECORDING, claims.number, digest, name))
        self.forget()

    def note(self, recording: str, digest: str) -> None:
        """Note what the next line will be. Raises OSError."""
        write_durably(self.path.with_name(PENDING), json.dumps({"recording": recording, "digest": digest}) + "\n")

    def forget(self) -> None:
        with suppress(OSError):
            self.path.with_name(PENDING).unlink(missing_ok=True)

    def _read_head(self) -> Entry | None:
        size, length = os.fstat(self._descriptor).st_size, _TAIL
        while True:
            first = max(0, size - length)
            data = os.pread(self._descriptor, size - first, first)
            end = data.rfind(b"\n") + 1
            begin = data.rfind(b"\n", 0, max(end - 1, 0)) + 1
            if first == 0 or (end and begin):
                break
            length *= 16
        self._end = first + end
        return self._entry(data[begin:end]) if end else None

    def _entry(self, line: bytes) -> Entry:
        try:
            return entry_of(line)
        except NotAnEnvelope as e:
            raise InputError(
                f"{self.path}: a line that is none of a chain: {e}; `triaxcal audit --chain` shows it"
            ) from e


def _claims_of(path: Path, digest: str) -> Claims | None:
    """What the signer of a finished recording claims, if its manifest has that
    digest."""
    envelope = envelope_in(path)
    if envelope is None or digest_of(envelope.payload) != digest:
        return None
    with suppress(NotAnEnvelope):
        return claims_in(envelope)
    return None


def recording_in(contents: SealedContents) -> str | None:
    """The name of the file, by its outcome."""
    with suppress(ValueError, LookupError, TypeError, RecursionError):
        return str(json_value(contents.document)["recording"])
    return None


def is_signed(path: Path) -> bool:
    """Whether a finished recording has an attachment in the place of a signature."""
    with suppress(RecordingError, InputError), Recording.open(path) as recording:
        return SIGNATURE_FILE in recording.attachments
    return False


def envelope_in(path: Path) -> Envelope | None:
    """That of a finished recording; None without one that can be read."""
    try:
        with Recording.open(path) as recording:
            return parse_envelope(recording.attachments[SIGNATURE_FILE])
    except (RecordingError, InputError, NotAnEnvelope, LookupError):
        return None


LOCK_S: Final = 60.0
"""Time for which a recording waits for others that are being closed. One takes its last
bytes to the disk and waits 5 s for an authority that does not answer, which the next
ones do not ask; a tray of 64 units is closed within this time."""
_LOOK_S: Final = 0.05
MODE: Final = 0o640
"""Whoever can open the file can hold its lock, and so keep a station from signing."""
_in_process: dict[Path, threading.Lock] = {}


@contextmanager
def locked(folder: Path) -> Iterator[OpenChain]:
    """The folder's chain, which no other thread or process extends meanwhile. Raises
    NotSigned, InputError: also where somebody else holds it for more than `LOCK_S`."""
    path, deadline = folder / NAME, time.monotonic() + LOCK_S
    lock = _in_process.setdefault(path.resolve(), threading.Lock())
    if not lock.acquire(timeout=LOCK_S):
        raise InputError(f"{path}: this process has closed another recording for more than {LOCK_S:g} s")
    try:
        try:
            descriptor = _opened(path, deadline)
        except OSError as e:
            kind = DiskError if is_of_the_disk(e) else InputError
            raise kind(f"{path}: cannot be written: {e.strerror}") from e
        try:
            yield OpenChain(path, descriptor)
        finally:
            os.close(descriptor)
    finally:
        lock.release()


def _opened(path: Path, deadline: float) -> int:
    flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_NOFOLLOW", 0)
    flags |= getattr(os, "O_BINARY", 0)
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, flags, MODE)
        try:
            _lock(path, descriptor, deadline)
        except BaseException:
            os.close(descriptor)
            raise
        with suppress(OSError):
            if os.path.samestat(os.fstat(descriptor), os.stat(path)):
                synchronise(path.parent)
                return descriptor
        os.close(descriptor)  # it was replaced meanwhile


def _lock(path: Path, descriptor: int, deadline: float) -> None:
    while fcntl is not None:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() >= deadline:
                raise InputError(
                    f"{path}: another process has held its lock for more than {LOCK_S:g} s; `fuser {path}` names it"
                ) from None
        time.sleep(_LOOK_S)


# What the key itself remembers of a chain, in the folder of the key: a chain that was
# cut at its end does not show it.


@dataclass(frozen=True)
class Memory:
    """The last entry that a key has signed in a chain: ``number`` and ``digest``, in
    the folder of recordings ``of``."""

    path: Path
    number: int
    digest: str
    of: str

    @staticmethod
    def path_of(folder: Path, key: str, start: Entry) -> Path:
        return folder / f"{key}-{start.digest[:16]}{MEMORY}"

    @staticmethod
    def is_of(path: Path, start: Entry) -> bool:
        """Whether the file of a memory is of the chain with this start."""
        return path.name.endswith(f"-{start.digest[:16]}{MEMORY}")

    @staticmethod
    def read(path: Path) -> Memory | None:
        """None of what is none."""
        try:
            found: Mapping[str, Any] = json_value(path.read_bytes())
            return Memory(path, int(found["number"]), str(found["digest"]), str(found["of"]))
        except (OSError, ValueError, LookupError, TypeError, RecursionError):
            return None

    def write(self) -> None:
        """Raises nothing: a folder of keys may be read-only."""
        document = {"number": self.number, "digest": self.digest, "of": self.of}
        with suppress(OSError):
            write_durably(self.path, json.dumps(document) + "\n")


def memories(folder: Path) -> list[Memory]:
    """All that the keys in a folder remember."""
    return [found for path in sorted(folder.glob(f"*{MEMORY}")) if (found := Memory.read(path)) is not None]


def require_remembered(known: Memory | None, head: Entry | None) -> None:
    """Raises NotSigned where a chain ends before what the key remembers of it."""
    if known is None:
        return
    number = -1 if head is None else head.number
    if number < known.number or (head is not None and number == known.number and head.digest != known.digest):
        ends = "is gone" if head is None else f"ends with entry {number}"
        raise NotSigned(
            f"{NAME} {ends}, and the key remembers entry {known.number}: put the chain back, or remove {known.path} to "
            "go on from here"
        )
