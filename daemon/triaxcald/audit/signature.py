"""The signature of a recording: who signed what is in it, when, and whether the key is
trusted."""

from __future__ import annotations

import base64
import binascii
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from enum import StrEnum
from pathlib import Path
from typing import Any, Final

import triaxcal_drivers as td
from triaxcald.audit.differences import Difference, Kind, compare
from triaxcald.documents import json_value
from triaxcald.errors import InputError
from triaxcald.outcome import RUN_RECORD, Verdict
from triaxcald.outcome import digest_of as outcome_digest
from triaxcald.recording.manifest import End
from triaxcald.recording.schema import RECOVERY_RECORD, SIGNATURE_FILE, STATION_FILE
from triaxcald.recording.survey import Survey
from triaxcald.signing import chain, stamps
from triaxcald.signing.envelope import MANIFEST_TYPE, MEDIA_TYPE, Envelope, NotAnEnvelope, parse_envelope, payload_of
from triaxcald.signing.keys import key_id, verifies
from triaxcald.signing.manifest import Claims, claims_of, manifest
from triaxcald.signing.stamps import Stamp, StampState
from triaxcald.signing.trust import NAME as TRUST_FILE
from triaxcald.signing.trust import Rejected, Trust, load_trust, moment, nearest

CLOCK: Final = timedelta(seconds=1)
"""A clock that is corrected by steps may go back by some tenths of a second."""
LATE: Final = timedelta(minutes=10)
"""A recording is signed within seconds of its end, within minutes where a tray of many
units waits for an authority that does not answer."""


class State(StrEnum):
    UNSIGNED = "unsigned"
    TRUSTED = "trusted"
    UNTRUSTED = "untrusted"
    """By a key that the trust file does not have, or there is no trust file."""
    REVOKED = "revoked"
    INVALID = "invalid"
    """It is not of this recording, or not of its key, or no signature."""


@dataclass(frozen=True)
class Policy:
    """What an audit asks of signatures. ``trust`` is the trust file, or what it says,
    for workers that do not have it; by default that of the folder among ``folders``
    with the recording, else the nearest one above it;
    ``allow_unsigned`` lets recordings pass that are not signed, or not by a trusted
    key. ``folders`` are those that were asked for: a trust file further below, where
    an audit was not asked to look for one, does not count."""

    trust: Path | Trust | None = None
    allow_unsigned: bool = False
    folders: tuple[Path, ...] = ()

    @property
    def given(self) -> Path | None:
        """Path of the trust file that was given."""
        return self.trust.path if isinstance(self.trust, Trust) else self.trust

    def trust_of(self, recording: td.files.AnyPath) -> Trust | None:
        """In a store only the file that was given counts. Raises InputError; Rejected
        where the nearest one may be a stranger's."""
        if isinstance(self.trust, Trust):
            return self.trust
        path = self.file_of(recording)
        return None if path is None else load_trust(path)

    def file_of(self, recording: td.files.AnyPath) -> Path | None:
        if self.trust is not None or not isinstance(recording, Path):
            return self.given
        parent = recording.parent.resolve()
        for folder in self.folders:
            if parent.is_relative_to(folder.resolve()) and (found := nearest(folder, TRUST_FILE)) is not None:
                return found
        return nearest(parent, TRUST_FILE)


@dataclass(frozen=True)
class Signature:
    """``key`` is the key's id, ``name`` its name in the trust file, else the one that
    it gives itself; ``signed`` the station's own time. ``number``, ``digest`` and
    ``previous`` are the place in the chain. ``stamp`` is None where no time stamp was
    asked for. ``older``: not signed, and from before the trust file. ``trust`` is the
    path of that file, None without one. ``mended``: a later start signed what an
    earlier run had left, and knows no more of it than what is in the file."""

    state: State
    key: str | None = None
    name: str | None = None
    signed: str | None = None
    number: int | None = None
    digest: str | None = None
    previous: str | None = None
    stamp: Stamp | None = None
    older: bool = False
    trust: str | None = None
    mended: bool = False

    def document(self) -> dict[str, Any]:
        stamp = self.stamp
        return {
            "state": self.state.value,
            "key": self.key,
            "name": self.name,
            "signed": self.signed,
            "number": self.number,
            "digest": self.digest,
            "previous": self.previous,
            "time_stamp": None
            if stamp is None
            else {
                "state": stamp.state.value,
                "time": None if stamp.time is None else stamp.time.isoformat(),
                "authority": stamp.authority,
            },
            "older": self.older,
            "trust": self.trust,
            "mended": self.mended,
        }


def check(
    path: td.files.AnyPath, attachments: Mapping[str, bytes], found: Survey, policy: Policy
) -> tuple[Signature, list[Difference]]:
    """The signature of a recording, and what of it keeps the recording from passing.
    ``found`` is what is in the file. Raises InputError for an unusable trust file, and
    where cryptography is missing."""
    trust = policy.trust_of(path)
    if found.signature is None:
        signature, differences = _unsigned(path, found, trust, policy)
    else:
        signature, differences = _signed(found.signature.data, found, trust, policy)
        differences += _in_its_place(found, found.signature)
        if signature.state is not State.INVALID and stamp_asked_for(attachments) and signature.stamp is None:
            signature = replace(signature, stamp=Stamp(StampState.MISSING))
    return replace(signature, trust=None if trust is None else str(trust.path)), differences


def _in_its_place(found: Survey, at: End) -> list[Difference]:
    """What of the attachment itself no signature covers."""
    differences = []
    if not found.signature_is_last:
        differences.append(_of(Kind.NOT_LAST, again=found.attachments[-1]))
    if at.media_type != MEDIA_TYPE:
        differences.append(_of(Kind.VALUE, "media_type", stored=at.media_type, again=MEDIA_TYPE))
    if found.end is not None and at.time_ns != found.end.time_ns:
        differences.append(_of(Kind.VALUE, "time_ns", stored=at.time_ns, again=found.end.time_ns))
    return differences


def _of(kind: Kind, place: str = "", **values: Any) -> Difference:
    return Difference(SIGNATURE_FILE, kind, place, **values)


# Without a signature.


def _unsigned(
    path: td.files.AnyPath, found: Survey, trust: Trust | None, policy: Policy
) -> tuple[Signature, list[Difference]]:
    older = trust is not None and _is_older(path, found, trust)
    needed = trust is not None and not older and not policy.allow_unsigned
    return Signature(State.UNSIGNED, older=older), [_of(Kind.UNSIGNED)] if needed else []


def _is_older(path: td.files.AnyPath, found: Survey, trust: Trust) -> bool:
    """Whether every time in the recording is before the trust file. If the folder has a
    chain, its start has to list the recording too, since times are easily set back. In
    a store there is no chain to ask."""
    last = latest(found)
    if last is None or last >= trust.since or not isinstance(path, Path):
        return False
    try:
        at = nearest(path.parent, chain.NAME)
    except Rejected:
        return False
    if at is None:
        return True
    start = trusted_start(at, trust)
    return start is not None and found.end is not None and outcome_digest(found.end.data) in start.earlier


def trusted_start(at: Path, trust: Trust) -> chain.Start | None:
    """The start of a chain that is signed by a key as trusted as that of a recording
    has to be; None of any other."""
    try:
        entry = chain.entry_of(chain.read_lines(at)[0])
        start = chain.said_in(entry)
    except (InputError, NotAnEnvelope, IndexError):
        return None
    envelope = entry.envelope
    if not isinstance(start, chain.Start) or envelope is None:
        return None
    return start if judge(envelope, start.claims, trust).state is State.TRUSTED else None


def latest(found: Survey) -> datetime | None:
    """The latest of all times in a recording; None where a document has none that can
    be read."""
    times = [entry["time_ns"] for entry in found.inventory.document()["attachments"]]
    times += [] if found.last_ns is None else [found.last_ns]
    times += [] if found.end is None else [found.end.time_ns]
    told = [found.inventory.records.get(RUN_RECORD, {}).get("started")]
    try:
        outcome = json_value(found.end.data if found.end else b"")
        told += [outcome["ended"], outcome["started"]]
    except (ValueError, LookupError, TypeError, RecursionError):
        return None
    moments = [moment(text) for text in told]
    if any(m is None for m in moments) or max(times, default=0) > _LATEST_NS:
        return None
    return max([*(m for m in moments if m), *(datetime.fromtimestamp(ns / 1e9, UTC) for ns in times)])


_LATEST_NS: Final = 2**63 - 1  # in the year 2262


# With one.


def _signed(data: bytes, found: Survey, trust: Trust | None, policy: Policy) -> tuple[Signature, list[Difference]]:
    try:
        envelope = parse_envelope(data)
        said = payload_of(envelope, MANIFEST_TYPE)
        claims = claims_of(said)
    except NotAnEnvelope as e:
        return Signature(State.INVALID), [_of(Kind.NO_ENVELOPE, again=str(e))]
    judged = judge(envelope, claims, trust)
    differences = list(judged.differences(policy))
    # The manifest of what is in the recording, by the claims alone.
    again = None
    if found.sealed is not None:
        try:
            again = manifest(found.sealed, claims)
        except ValueError:
            again = None
    if again is None:
        differences.append(_of(Kind.NOT_COMPUTED, again="the recording ends with no document"))
    elif again != envelope.payload:
        differences += compare(SIGNATURE_FILE, envelope.payload, again)
    state = judged.state if again == envelope.payload else State.INVALID
    ended = moment(said.get("ended"))
    if (signed := moment(claims.signed)) is None or (ended is not None and signed < ended - CLOCK):
        differences.append(_of(Kind.CLOCK, "signed", stored=claims.signed, again=said.get("ended")))
    # Anybody can leave a recording without its end for the next start to mend and sign.
    # A run that was killed has aborted; any other verdict may be somebody else's.
    mended, verdict = RECOVERY_RECORD in found.closing, said.get("verdict")
    vouched = mended and state is State.TRUSTED and verdict != Verdict.ABORTED.value
    if vouched and not policy.allow_unsigned:
        differences.append(_of(Kind.MENDED, "verdict", stored=verdict, again=Verdict.ABORTED.value))
    return replace(judged.signature, state=state, mended=mended), differences


@dataclass(frozen=True)
class Judged:
    """A signature over whatever payload: whether it is of its key, and whether that is
    trusted."""

    state: State
    signature: Signature
    verified: bool
    stamp_fits: bool
    trust: Trust | None

    def differences(self, policy: Policy) -> list[Difference]:
        if not self.verified:
            return [_of(Kind.NOT_VERIFIED, again=self.signature.key)]
        found = []
        if self.state is State.REVOKED:
            found.append(_of(Kind.REVOKED, again=self.signature.name))
        if self.state is State.UNTRUSTED and self.trust is not None and not policy.allow_unsigned:
            found.append(_of(Kind.UNTRUSTED, again=self.signature.key))
        stamp = self.signature.stamp
        if stamp is not None and stamp.state is StampState.INVALID:
            found.append(_of(Kind.NOT_VERIFIED, "time_stamp", again="another signature"))
        elif not self.stamp_fits and stamp is not None and stamp.time is not None:
            found.append(_of(Kind.CLOCK, "signed", stored=self.signature.signed, again=stamp.time.isoformat()))
        return found


def judge(envelope: Envelope, claims: Claims, trust: Trust | None) -> Judged:
    """Raises InputError where cryptography is missing."""
    known = None if trust is None else trust.key(envelope.key_id)
    public = _decoded(claims.public) if known is None else known.public_bytes
    ours = key_id(public) == envelope.key_id and _decoded(claims.public) == public
    verified = ours and verifies(public, envelope.signature, envelope.signed_bytes)
    roots = [] if trust is None else [(a.name, a.certificate) for a in trust.file.authorities]
    stamp = None if envelope.stamp is None else stamps.check(envelope.stamp, envelope.signature, roots)
    signed, stamped = moment(claims.signed), None if stamp is None else stamp.time
    state = State.UNTRUSTED
    if not verified:
        state = State.INVALID
    elif known is not None:
        trusted_at = stamped if stamp is not None and stamp.state is StampState.TRUSTED else None
        state = State.REVOKED if _counts_as_revoked(known, signed, trusted_at) else State.TRUSTED
    fits = stamped is None or (signed is not None and -CLOCK <= stamped - signed <= LATE)
    signature = Signature(
        state,
        envelope.key_id if verified else None,
        (claims.key if known is None else known.name) if verified else None,
        claims.signed,
        claims.number,
        chain.digest_of(envelope.payload),
        claims.previous,
        stamp,
    )
    return Judged(state, signature, verified, fits, trust)


def _counts_as_revoked(key: Any, signed: datetime | None, stamped: datetime | None) -> bool:
    """Whoever stole a key can state any time, so only an authority's counts; of a key
    that was retired, its own counts too."""
    revoked = moment(key.revoked)
    if revoked is None:
        return False
    if stamped is not None:
        return stamped >= revoked
    return not (key.retired and signed is not None and signed < revoked)


def _decoded(text: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        return b""


def stamp_asked_for(attachments: Mapping[str, bytes]) -> bool:
    """Whether the station file in the recording names an authority."""
    try:
        sign = tomllib.loads(attachments[STATION_FILE].decode())["sign"]
        return isinstance(sign["timestamp"], str)
    except (LookupError, TypeError, ValueError, RecursionError):
        return False
