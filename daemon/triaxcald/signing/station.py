"""A station that signs: its key, and what the key signs."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from triaxcald.errors import DaemonError, DiskError, InputError, NotSigned
from triaxcald.outcome import ATTACHMENT, SUFFIX
from triaxcald.outcome import digest_of as outcome_digest
from triaxcald.recording.manifest import SealedContents, SignatureMade
from triaxcald.recording.reader import indexed_attachments
from triaxcald.recording.schema import SIGNATURE_FILE
from triaxcald.signing import chain, hsm, stamps
from triaxcald.signing.chain import Entry, EntryKind, Memory, OpenChain
from triaxcald.signing.envelope import CHAIN_TYPE, MANIFEST_TYPE, MEDIA_TYPE, Envelope, canonical, pae
from triaxcald.signing.keys import (
    FOLDER,
    PRIVATE,
    SigningKey,
    key_id,
    passphrase_of,
    private_keys,
    public_keys,
    read_private,
    read_public,
    to_text,
    verifies,
)
from triaxcald.signing.manifest import Claims, claims_document, manifest
from triaxcald.signing.trust import NAME as TRUST_FILE
from triaxcald.signing.trust import Trust, load_trust, trust_of
from triaxcald.station.config import Sign, Station
from triaxcald.utc import iso_time


@dataclass(frozen=True)
class StationSigning:
    """Signs the recordings of a station into the chain of its ``folder``. ``authority``
    is the URL of a time-stamping authority. ``clock_ns`` is the host's time."""

    key: SigningKey
    folder: Path
    station: str
    authority: str | None = None
    clock_ns: Callable[[], int] = time.time_ns

    @contextmanager
    def sign(self, contents: SealedContents) -> Iterator[SignatureMade]:
        """`triaxcald.recording.manifest.Sign`: the recording has its place in the chain
        when the context ends. Raises NotSigned, OSError."""
        with self._next() as (open_chain, claims):
            payload = manifest(contents, claims)
            envelope = self._envelope(MANIFEST_TYPE, payload)
            name = str(contents.metadata.get("run", {}).get("run", ""))
            recording = chain.recording_in(contents) or name
            entry = Entry(EntryKind.RECORDING, claims.number, chain.digest_of(payload), recording)
            open_chain.note(recording, entry.digest)
            try:
                yield SignatureMade(SIGNATURE_FILE, MEDIA_TYPE, envelope.to_bytes())
                self._append(open_chain, entry)
            finally:
                open_chain.forget()

    def bury(self, of: str, recording: str, reason: str) -> None:
        """Sign that a recording is about to be deleted, and why. ``of`` is its digest
        as `Tombstone` has it. Raises NotSigned, OSError."""
        with self._next() as (open_chain, claims):
            document = {**chain.tombstone_document(of, recording, reason), **claims_document(claims)}
            self._append(open_chain, self._entry(EntryKind.TOMBSTONE, claims, document, recording))

    @contextmanager
    def _next(self) -> Iterator[tuple[OpenChain, Claims]]:
        """The chain under its lock, and the claims of its next entry."""
        try:
            with chain.locked(self.folder) as open_chain:
                if open_chain.head is None:
                    self._require_new()
                    self._begin(open_chain)
                open_chain.settle()
                head = open_chain.head
                assert head is not None
                self._require_remembered(open_chain)
                yield open_chain, self._claims(head.number + 1, head.digest)
        except DiskError:
            raise
        except DaemonError as e:
            raise NotSigned(str(e)) from e

    def _begin(self, open_chain: OpenChain) -> None:
        claims = self._claims(0, "")
        document = chain.start_document(self.station, earlier_outcomes(self.folder))
        self._append(open_chain, self._entry(EntryKind.START, claims, {**document, **claims_document(claims)}))

    def _append(self, open_chain: OpenChain, entry: Entry) -> None:
        open_chain.append(entry)
        if self.key.folder is not None:
            path = Memory.path_of(self.key.folder, self.key.name, open_chain.start())
            Memory(path, entry.number, entry.digest, self._of).write()

    @property
    def _of(self) -> str:
        """The folder as the key remembers it."""
        return str(self.folder.resolve())

    def _require_remembered(self, open_chain: OpenChain) -> None:
        """Raises NotSigned where this key or another of its folder remembers more of
        the chain, or another chain here."""
        start = open_chain.start()
        for known in self._memories():
            if Memory.is_of(known.path, start):
                chain.require_remembered(known, open_chain.head)
            elif known.of == self._of:
                chain.require_remembered(known, None)

    def _require_new(self) -> None:
        """Raises NotSigned where the folder had a chain before."""
        for known in self._memories():
            if known.of == self._of:
                chain.require_remembered(known, None)
        signed = _signed_in(self.folder)
        if signed is not None:
            raise NotSigned(
                f"{self.folder / chain.NAME} is gone, and {signed} was signed into it: put the chain back, or move "
                "what is signed elsewhere"
            )

    def _memories(self) -> list[Memory]:
        return [] if self.key.folder is None else chain.memories(self.key.folder)

    def _claims(self, number: int, previous: str) -> Claims:
        return Claims(self.key.name, to_text(self.key.public), iso_time(self.clock_ns()), number, previous)

    def _entry(self, kind: EntryKind, claims: Claims, document: dict[str, Any], recording: str | None = None) -> Entry:
        payload = canonical(document)
        return Entry(kind, claims.number, chain.digest_of(payload), recording, self._envelope(CHAIN_TYPE, payload))

    def _envelope(self, payload_type: str, payload: bytes) -> Envelope:
        signature = self.key.sign(pae(payload_type, payload))
        stamp = None if self.authority is None else stamps.stamp(self.authority, signature)
        return Envelope(payload_type, payload, self.key.id, signature, stamp)

    def require_works(self) -> None:
        """Raises InputError if the key signs nothing, or the chain cannot go on."""
        probe = b"triaxcal: does this key sign?"
        try:
            if not verifies(self.key.public, self.key.sign(probe), probe):
                raise InputError(f"key {self.key.name}: what it signs is not verified by its own public key")
            if not os.path.lexists(self.folder / chain.NAME):
                self._require_new()
                return
            with chain.locked(self.folder) as open_chain:
                if open_chain.head is None:
                    self._require_new()
                else:
                    open_chain.settle()
                    self._require_remembered(open_chain)
        except OSError as e:
            raise InputError(f"{self.folder / chain.NAME}: cannot be written: {e.strerror}") from e
        except DaemonError as e:
            raise InputError(f"this station signs its recordings, and cannot: {e}") from e


def earlier_outcomes(folder: Path) -> list[str]:
    """Digests of all outcomes in a folder and below it, in recordings and beside
    them."""
    found = set()
    for path in folder.rglob(f"*{SUFFIX}"):
        with suppress(OSError):
            found.add(outcome_digest(path.read_bytes()))
    for path in folder.rglob("*.mcap"):
        found |= {outcome_digest(data) for data in indexed_attachments(path, ATTACHMENT).values()}
    return sorted(found)


def _signed_in(folder: Path) -> Path | None:
    """A signed recording, or a signature, that is of no chain below the folder."""
    others = {path.parent for path in folder.rglob(chain.NAME)} - {folder}
    for pattern in (f"*.{SIGNATURE_FILE}", "*.mcap"):
        for path in sorted(folder.rglob(pattern)):
            signed = path.suffix != ".mcap" or indexed_attachments(path, SIGNATURE_FILE)
            if signed and not others & set(path.parents):
                return path
    return None


# Which key a station has.


def signing_of(station: Station) -> StationSigning | None:
    """What signs the station's recordings, ready for use; None for a station that has
    neither a key nor anything that shows it signs. Raises InputError if its key is
    missing, cannot be used, or is not in its trust file."""
    sign, trust = station.file.sign, _trust_of(station)
    key = _key_of(station, sign, trust)
    if key is None:
        _require_never_signed(station, trust)
        return None
    known = None if trust is None else trust.key(key.id)
    if known is not None and known.revoked is not None:
        raise InputError(f"key {key.name}: revoked on {known.revoked}; `triaxcal keys new` makes another")
    if trust is not None and known is None:
        raise InputError(f"key {key.name}: not in {trust.path}; `triaxcal keys trust {key.name}` enters it")
    url = None if sign is None else sign.timestamp
    if url is not None:
        stamps.require_installed()
    found = StationSigning(key, station.folder, station.file.name, url)
    found.require_works()
    return found


def key_folders(station: Station) -> list[Path]:
    """Where its keys are looked for."""
    sign, beside = station.file.sign, station.path.parent
    if sign is not None and sign.folder is not None:
        return [beside / sign.folder]
    return list(dict.fromkeys((beside / FOLDER, station.folder / FOLDER)))


def _trust_of(station: Station) -> Trust | None:
    """That by which its recordings are audited, else the one beside its file. Raises
    InputError."""
    found, beside = trust_of(station.folder / "recording"), station.path.parent / TRUST_FILE
    return load_trust(beside) if found is None and os.path.lexists(beside) else found


def _require_never_signed(station: Station, trust: Trust | None) -> None:
    """Raises InputError where something says that the station signs."""
    left = [path for folder in key_folders(station) for path in public_keys(folder)]
    left += [] if trust is None else [trust.path]
    left += [path for path in (station.folder / chain.NAME,) if os.path.lexists(path)]
    if left:
        told = " or ".join(map(str, key_folders(station)))
        raise InputError(f"{left[0]}: this station signs its recordings, and there is no private key in {told}")


_opened: dict[tuple[str, ...], SigningKey] = {}
"""Keys at work by what opened them: the work of scrypt is done once."""


def _key_of(station: Station, sign: Sign | None, trust: Trust | None) -> SigningKey | None:
    if sign is not None and sign.pkcs11 is not None:
        return _of_token(station, sign)
    path = _path_of(station, sign, trust)
    if path is None:
        return None
    passphrase = _passphrase(station, sign)
    try:
        made = str(os.stat(path).st_mtime_ns)
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {e.strerror}") from e
    opened = (str(path.resolve()), made, hashlib.sha256(passphrase or b"").hexdigest())
    if opened not in _opened:
        _opened[opened] = read_private(path, passphrase, f"sign.passphrase_file in {station.path}")
    return _opened[opened]


def _of_token(station: Station, sign: Sign) -> SigningKey:
    assert sign.pkcs11 is not None
    if sign.key is None:
        raise InputError(f"{station.path}: sign.key: missing; it is the label of the key in the token")
    pin, module = _passphrase(station, sign), Path(sign.pkcs11.module)
    opened = (str(module), sign.pkcs11.token, sign.key, hashlib.sha256(pin or b"").hexdigest())
    if opened not in _opened:
        remembers = next((folder for folder in key_folders(station) if folder.is_dir()), None)
        _opened[opened] = replace(hsm.open_key(module, sign.pkcs11.token, sign.key, pin), folder=remembers)
    return _opened[opened]


def _passphrase(station: Station, sign: Sign | None) -> bytes | None:
    file = None if sign is None or sign.passphrase_file is None else station.path.parent / sign.passphrase_file
    return passphrase_of(file)


def _path_of(station: Station, sign: Sign | None, trust: Trust | None) -> Path | None:
    folders = key_folders(station)
    if sign is not None and sign.key is not None:
        for folder in folders:
            if (path := folder / f"{sign.key}{PRIVATE}") in private_keys(folder):
                return path
        told = " or ".join(map(str, folders))
        raise InputError(f"{station.path}: sign.key: there is no {sign.key}{PRIVATE} in {told}")
    found = next((keys for folder in folders if (keys := private_keys(folder))), [])
    if not found and sign is not None:
        told = " or ".join(map(str, folders))
        raise InputError(f"{station.path}: sign: there is no key in {told}; `triaxcal keys new NAME` makes one")
    if len(found) > 1:
        good = [path for path in found if not _revoked(path, trust)]
        if not good:
            raise InputError(
                f"{found[0].parent}: each of its {len(found)} keys is revoked; `triaxcal keys new` makes another"
            )
        found = good
    if len(found) > 1:
        names = ", ".join(path.stem for path in found)
        raise InputError(f'{station.path}: sign.key: name one of {names}, as in [sign] key = "{found[0].stem}"')
    return found[0] if found else None


def _revoked(path: Path, trust: Trust | None) -> bool:
    with suppress(InputError):
        known = None if trust is None else trust.key(key_id(read_public(path.with_suffix(".pub"))))
        return known is not None and known.revoked is not None
    return False
