"""The chain of a folder against the recordings in it: what was removed, inserted, cut
off, copied, or closed out of its time."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from triaxcald.audit.differences import Difference, Kind
from triaxcald.audit.signature import CLOCK, LATE, Policy, State, judge
from triaxcald.errors import DONE, OUTSIDE, InputError, RecordingError
from triaxcald.outcome import ATTACHMENT, FORMAT
from triaxcald.outcome import digest_of as outcome_digest
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import RECOVERY_RECORD, SIGNATURE_FILE
from triaxcald.signing import chain
from triaxcald.signing.chain import Entry, EntryKind, Memory, Start, Tombstone
from triaxcald.signing.envelope import MANIFEST_TYPE, Envelope, NotAnEnvelope, parse_envelope, payload_of
from triaxcald.signing.keys import FOLDER
from triaxcald.signing.manifest import Claims, claims_of
from triaxcald.signing.trust import Trust, moment


@dataclass(frozen=True)
class ChainAudit:
    """``recordings`` counts those that are signed and in the chain, ``tombstones``
    those that were deleted with a reason, ``earlier`` those that were there before the
    chain. ``head`` is number and digest of the last entry: an audit that is given it
    later finds a chain that was cut."""

    folder: str
    differences: tuple[Difference, ...]
    recordings: int = 0
    tombstones: int = 0
    earlier: int = 0
    head: tuple[int, str] | None = None
    doubtful: int = 0
    """Tombstones whose signature does not hold, or is of a key that is not trusted."""
    emptied: bool = False
    """Trusted tombstones tell of every recording that was in the folder: it has none
    left, and had none before the chain."""

    @property
    def exit_code(self) -> int:
        return OUTSIDE if self.differences else DONE

    def document(self) -> dict[str, Any]:
        return {
            "folder": self.folder,
            "recordings": self.recordings,
            "tombstones": self.tombstones,
            "earlier": self.earlier,
            "head": None if self.head is None else {"number": self.head[0], "digest": self.head[1]},
        }


@dataclass(frozen=True)
class _Signed:
    """A signed recording in the folder. ``mended``: a later start has closed it."""

    path: Path
    envelope: Envelope
    claims: Claims
    name: str
    ended: datetime | None
    mended: bool

    @property
    def digest(self) -> str:
        return chain.digest_of(self.envelope.payload)


Tombstones = set[tuple[str, str | None]]
"""Digests, as `Tombstone` has them, each with the name of the recording."""


def audit_chain(folder: Path, policy: Policy = Policy(), head: str | None = None) -> ChainAudit:  # noqa: B008 - frozen
    """``head`` is the digest of an entry that the chain is known to have had. Raises
    InputError for a folder without a chain or a signed recording, and for an unusable
    trust file."""
    return _ChainAudit(folder, policy.trust_of(folder / "recording"), policy, head).run()


def chains_in(folder: Path) -> list[Path]:
    """The folder and those below it that have a chain. The folder itself is among them
    where there is none at all, and where a chain is missing: signed recordings are of
    none, or a key remembers one that is gone."""
    below = sorted({path.parent for path in folder.rglob(chain.NAME)})
    if below and folder not in below and not _lacks_chain(folder, below):
        return below
    return [folder, *(path for path in below if path != folder)]


def _lacks_chain(folder: Path, chains: Sequence[Path]) -> bool:
    if forgotten(folder):
        return True
    if any(_outside(folder, f"*.{SIGNATURE_FILE}", chains)):
        return True
    return any(chain.is_signed(path) for path in _outside(folder, "*.mcap", chains))


def _outside(folder: Path, pattern: str, chains: Iterable[Path]) -> Iterator[Path]:
    """Files below the folder that are in none of these."""
    others = set(chains)
    return (path for path in sorted(folder.rglob(pattern)) if not others & set(path.parents))


def forgotten(folder: Path) -> list[Memory]:
    """What keys in the folder, below and above it remember of chains in it that are
    not there."""
    here = folder.resolve()
    keys = [*(path for path in folder.rglob(FOLDER)), *(path / FOLDER for path in (here, *here.parents))]
    known = {memory.path.resolve(): memory for at in keys for memory in chain.memories(at)}
    missing = [m for m in known.values() if _is_below(m.of, here) and not os.path.lexists(Path(m.of) / chain.NAME)]
    if not missing:
        return []
    starts = [_start_of(path) for path in folder.rglob(chain.NAME)]  # it may have been moved with its folder
    return [m for m in missing if not any(start and start[:16] in m.path.name for start in starts)]


def _is_below(of: str, folder: Path) -> bool:
    return Path(of).is_absolute() and Path(of).is_relative_to(folder)


def _start_of(path: Path) -> str | None:
    """The digest of a chain's first entry; None without one."""
    with suppress(InputError, NotAnEnvelope, IndexError):
        return chain.entry_of(chain.read_lines(path)[0]).digest
    return None


@dataclass
class _ChainAudit:
    folder: Path
    trust: Trust | None
    policy: Policy
    known_head: str | None
    differences: list[Difference] = field(default_factory=list)
    _keys: set[str] = field(default_factory=set)
    _doubtful: dict[tuple[str, str | None], int] = field(default_factory=dict)

    def run(self) -> ChainAudit:
        # A run may end meanwhile. What it adds to the chain after this is an entry too.
        path = self.folder / chain.NAME
        entries = self._entries(path) if path.exists() else []
        signed, unsigned = self._recordings()
        missing = forgotten(self.folder)
        for memory in missing:
            if Path(memory.of) != self.folder.resolve():
                self._add(str(Path(memory.of) / chain.NAME), Kind.NO_CHAIN)
        if not path.exists():
            if not (signed or missing or self._below(f"*.{SIGNATURE_FILE}")):
                raise InputError(f"{self.folder}: no chain of signed recordings ({chain.NAME})")
            self._add(chain.NAME, Kind.NO_CHAIN)
            return ChainAudit(str(self.folder), tuple(self.differences))
        entries = entries or self._entries(path)
        self._keys = {one.envelope.key_id for one in signed}
        start, tombstones = self._said(entries)
        self._linked(entries, signed)
        self._removed(entries, tombstones, signed)
        extra = self._inserted(entries, signed)
        earlier = self._unsigned(unsigned, start)
        self._sidecars(tombstones)
        entries += extra
        self._cut(entries)
        known = self.trust is not None and start is not None and not start.earlier
        return ChainAudit(
            str(self.folder),
            tuple(dict.fromkeys(self.differences)),
            sum(e.kind is EntryKind.RECORDING for e in entries),
            len(tombstones),
            earlier,
            (entries[-1].number, entries[-1].digest) if entries else None,
            len(self._doubtful),
            known and bool(tombstones) and not (signed or unsigned or self.differences),
        )

    def _add(self, part: str, kind: Kind, place: str = "", **values: Any) -> None:
        self.differences.append(Difference(part, kind, place, **values))

    # What is there.

    def _recordings(self) -> tuple[list[_Signed], list[tuple[Path, bytes]]]:
        """Signed recordings, and the outcomes of the others. One that cannot be read is
        left to its own audit."""
        signed, unsigned = [], []
        for path in self._below("*.mcap"):
            try:
                with Recording.open(path) as recording:
                    if recording.ends_with != FORMAT:
                        continue
                    data = recording.attachments.get(SIGNATURE_FILE)
                    if data is None:
                        unsigned.append((path, recording.attachments.get(ATTACHMENT, b"")))
                        continue
                    mended = RECOVERY_RECORD in recording.metadata
            except (RecordingError, InputError):
                continue
            try:
                envelope = parse_envelope(data)
                said = payload_of(envelope, MANIFEST_TYPE)
                claims = claims_of(said)
            except NotAnEnvelope as e:
                self._add(path.name, Kind.NO_ENVELOPE, again=str(e))
                continue
            told = said.get("recording")
            name = told if isinstance(told, str) else path.name
            signed.append(_Signed(path, envelope, claims, name, moment(said.get("ended")), mended))
        return signed, unsigned

    def _below(self, pattern: str) -> list[Path]:
        """Files in the folder, but for those of folders with a chain of their own."""
        others = {path.parent for path in self.folder.rglob(chain.NAME)} - {self.folder}
        return list(_outside(self.folder, pattern, others))

    def _entries(self, path: Path) -> list[Entry]:
        """The lines of the chain up to the first that is none."""
        found: list[Entry] = []
        for number, line in enumerate(chain.read_lines(path)):
            try:
                entry = chain.entry_of(line)
            except NotAnEnvelope as e:
                self._add(chain.NAME, Kind.BROKEN, str(number), again=str(e))
                break
            found.append(entry)
        for at, entry in enumerate(found):
            if entry.number != at or (entry.kind is EntryKind.START) != (at == 0):
                self._add(chain.NAME, Kind.BROKEN, str(at), again=f"a line of entry {entry.number} ({entry.kind})")
                return found[:at]
        return found

    # Signatures and links.

    def _said(self, entries: Sequence[Entry]) -> tuple[Start | None, Tombstones]:
        """What start and tombstones say, if their signatures hold."""
        start, tombstones, before = None, Tombstones(), ""
        for entry in entries:
            if entry.envelope is not None:
                try:
                    said = chain.said_in(entry)
                except NotAnEnvelope as e:
                    self._add(chain.NAME, Kind.BROKEN, str(entry.number), again=str(e))
                else:
                    good = self._holds(f"{chain.NAME} {entry.number}", entry.envelope, said.claims)
                    if said.claims.previous != before:
                        self._add(chain.NAME, Kind.BROKEN, str(entry.number), again="it follows another entry")
                    elif good and isinstance(said, Start):
                        start = said
                    elif good and isinstance(said, Tombstone):
                        tombstones.add((said.of, said.recording))
                    elif isinstance(said, Tombstone):
                        self._doubtful[said.of, said.recording] = entry.number
            before = entry.digest
        return start, tombstones

    def _holds(self, part: str, envelope: Envelope, claims: Claims) -> bool:
        """Whether the signature is of its key, and the key is trusted; without a trust
        file, whether it has signed a recording in the folder."""
        judged = judge(envelope, claims, self.trust)
        found = judged.differences(self.policy)
        self.differences += [Difference(part, d.kind, d.place, d.stored, d.again) for d in found]
        if self.trust is None:
            return judged.state is State.UNTRUSTED and envelope.key_id in self._keys
        return judged.state is State.TRUSTED

    def _linked(self, entries: Sequence[Entry], signed: Sequence[_Signed]) -> None:
        """Each recording names its number and the entry before, and was closed after
        it."""
        by_digest = {one.digest: one for one in signed}
        before: Entry | None = None
        last: tuple[datetime, str] | None = None
        for entry in entries:
            one = by_digest.get(entry.digest)
            claims = one.claims if one is not None else _claims_in(entry)
            if one is not None and entry.kind is EntryKind.RECORDING:
                self._holds(one.path.name, one.envelope, one.claims)
                previous = "" if before is None else before.digest
                if (one.claims.number, one.claims.previous) != (entry.number, previous):
                    self._add(one.path.name, Kind.BROKEN, str(entry.number), again="it was signed after another entry")
                self._in_time(one)
            at = moment(claims.signed) if claims is not None else None
            if at is not None:
                part = chain.NAME if one is None else one.path.name
                if last is not None and at < last[0] - CLOCK:
                    self._add(part, Kind.CLOCK, "signed", stored=at.isoformat(), again=last[0].isoformat())
                last = max(last or (at, part), (at, part))
            before = entry

    def _in_time(self, one: _Signed) -> None:
        signed = moment(one.claims.signed)
        if signed is not None and one.ended is not None and signed - one.ended > LATE and not one.mended:
            self._add(one.path.name, Kind.LATE, stored=one.claims.signed, again=one.ended.isoformat())

    # Recordings that are missing, or too many.

    def _removed(self, entries: Sequence[Entry], tombstones: Tombstones, signed: Sequence[_Signed]) -> None:
        there: dict[str, list[_Signed]] = {}
        for one in signed:
            there.setdefault(one.digest, []).append(one)
        missing: list[Entry] = []
        for entry in entries:
            if entry.kind is not EntryKind.RECORDING:
                continue
            found = sorted(there.get(entry.digest, []), key=lambda one: one.path.name != one.name)
            if not found and (entry.digest, entry.recording) not in tombstones:
                missing.append(entry)
            for other in found[1:]:
                self._add(other.path.name, Kind.COPIED, again=str(found[0].path))
            if found and found[0].path.name != found[0].name:
                self._add(found[0].path.name, Kind.RENAMED, stored=found[0].name)
        if missing:  # they may have been deleted while this was read
            tombstones |= self._said(self._entries(self.folder / chain.NAME))[1]
        for entry in missing:
            if (entry.digest, entry.recording) not in tombstones:
                self._add(
                    entry.recording or chain.NAME, Kind.REMOVED, self._doubt(entry.digest, entry.recording),
                    again=entry.number,
                )  # fmt: skip

    def _doubt(self, digest: str, recording: str | None) -> str:
        """The entry of a tombstone that does not count; empty without one."""
        return str(self._doubtful.get((digest, recording), ""))

    def _inserted(self, entries: Sequence[Entry], signed: Sequence[_Signed]) -> list[Entry]:
        """Signed recordings that no line has. One that continues the chain was closed
        by a process that was killed just then; it is an entry too."""
        known, extra = {entry.digest for entry in entries}, list[Entry]()
        for one in sorted(signed, key=lambda s: s.claims.number):
            if one.digest in known:
                continue
            last = (*entries, *extra)[-1:]
            follows = [(one.claims.number, one.claims.previous)] == [(e.number + 1, e.digest) for e in last]
            if self._holds(one.path.name, one.envelope, one.claims) and follows:
                extra.append(Entry(EntryKind.RECORDING, one.claims.number, one.digest, one.name))
                self._in_time(one)
            else:
                self._add(one.path.name, Kind.INSERTED, again=f"signed as entry {one.claims.number}")
            known.add(one.digest)
        return extra

    def _unsigned(self, unsigned: Iterable[tuple[Path, bytes]], start: Start | None) -> int:
        earlier = 0
        for path, outcome in unsigned:
            if start is not None and outcome_digest(outcome) in start.earlier:
                earlier += 1
            elif not self.policy.allow_unsigned:
                self._add(path.name, Kind.INSERTED, again="not signed, and not there when the chain began")
        return earlier

    def _sidecars(self, tombstones: Tombstones) -> None:
        """A signature beside no recording, which only a recording that was removed
        leaves."""
        for path in self._below(f"*.{SIGNATURE_FILE}"):
            recording = path.with_name(path.name.removesuffix(f".{SIGNATURE_FILE}") + ".mcap")
            if recording.exists():
                continue
            try:
                envelope = parse_envelope(path.read_bytes())
                said = payload_of(envelope, MANIFEST_TYPE)
                number: int | str = claims_of(said).number
            except (OSError, NotAnEnvelope):
                self._add(recording.name, Kind.REMOVED, again="unknown")
                continue
            digest, told = chain.digest_of(envelope.payload), said.get("recording")
            name = told if isinstance(told, str) else None
            if (digest, name) not in tombstones:
                self._add(recording.name, Kind.REMOVED, self._doubt(digest, name), again=number)

    # The end.

    def _cut(self, entries: Sequence[Entry]) -> None:
        last = entries[-1].number if entries else None
        digests = {entry.digest for entry in entries}
        if self.known_head is not None and self.known_head not in digests:
            self._add(chain.NAME, Kind.CUT, stored=last, again=self.known_head)
        if not entries:
            self._add(chain.NAME, Kind.CUT, stored=None, again="a first entry")
            return
        here = self.folder.resolve()
        for folder in (here, *here.parents):
            for known in chain.memories(folder / FOLDER):
                ours = known.of == str(here) or Memory.is_of(known.path, entries[0])
                if ours and known.digest not in digests and known.digest not in self._digests_by_now():
                    self._add(chain.NAME, Kind.CUT, stored=last, again=f"entry {known.number}")

    def _digests_by_now(self) -> set[str]:
        """Those of the chain, which may have gone on since it was read."""
        return {entry.digest for entry in self._entries(self.folder / chain.NAME)}


def _claims_in(entry: Entry) -> Claims | None:
    try:
        return chain.said_in(entry).claims
    except NotAnEnvelope:
        return None
