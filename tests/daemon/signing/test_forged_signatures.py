"""What can be done to a signed recording, by whoever has the `mcap` library, a key, and all digests right."""

from __future__ import annotations

import base64
import json
import shutil
from collections.abc import Callable
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from mcap.records import Attachment

from tests.daemon.audit.forging import Forgery
from tests.daemon.signing.conftest import trusted
from tests.daemon.signing.line import (
    SECOND_NS,
    Line,
    envelope_of,
    looked_at,
    put_signature,
    sign_anew,
    when,
)
from triaxcald.audit import Policy
from triaxcald.audit.differences import Kind
from triaxcald.audit.signature import State
from triaxcald.outcome import ATTACHMENT
from triaxcald.recording.manifest import SignatureMade
from triaxcald.recording.recover import recover
from triaxcald.recording.schema import RAW, SIGNATURE_FILE, decode_raw, encode_raw
from triaxcald.signing.envelope import CHAIN_TYPE, MANIFEST_TYPE, Envelope, canonical, pae, parse_envelope
from triaxcald.signing.keys import SigningKey, to_text
from triaxcald.signing.manifest import claims_in, manifest
from triaxcald.signing.station import StationSigning

Keys = dict[str, SigningKey]


def _resealed(change: Callable[[Forgery], object]) -> Callable[[Line, Keys, Path], object]:
    """Changed, every digest but the signature's brought in step."""

    def make(line: Line, keys: Keys, path: Path) -> None:
        forgery = Forgery.of(path)
        signature = deepcopy(forgery.attachment(SIGNATURE_FILE))
        change(forgery)
        line.forged(forgery, path, signed=False)
        put_signature(path, signature.data)
        _sidecars(path)

    return make


def _sidecars(path: Path) -> None:
    """The files beside it, as they are in it."""
    forgery = Forgery.of(path)
    for name in (ATTACHMENT, SIGNATURE_FILE):
        path.with_suffix(f".{name}").write_bytes(forgery.attachment(name).data)


def _raw_byte(f: Forgery) -> None:
    def change(m: Any) -> Any:
        first, phase, batch = decode_raw(m.data)
        payload = bytes([batch.payload[0] ^ 1]) + batch.payload[1:]
        return replace(m, data=encode_raw(first, phase, replace(batch, payload=payload)))

    f.first(RAW, change)


def _raw_reordered(f: Forgery) -> None:
    """Two messages change places; their running indices are brought in step."""
    a, b = list(f.messages(RAW))[:2]
    i, j = f.records.index(a), f.records.index(b)
    (first, phase, one), (second, _, two) = decode_raw(a.data), decode_raw(b.data)
    f.records[i] = replace(b, data=encode_raw(first, phase, two))
    f.records[j] = replace(a, data=encode_raw(first + len(two), phase, one))
    assert second == len(one)


def _rebatched(f: Forgery) -> None:
    """The same records in other messages: no digest of records shows it."""
    m = next(f.messages(RAW))
    first, phase, batch = decode_raw(m.data)
    halves = [batch.part(0, 4), batch.part(4, 8)]
    at = f.records.index(m)
    f.records[at : at + 1] = [
        replace(m, data=encode_raw(first + 4 * i, phase, half), log_time=int(half.time_ns[-1]),
                publish_time=int(half.time_ns[-1]))
        for i, half in enumerate(halves)
    ]  # fmt: skip


def _other_attachment(f: Forgery) -> None:
    held = f.attachment("certificate.json")
    f.records.insert(f.records.index(held), Attachment(held.create_time, held.log_time, "more.txt", "text/plain", b"x"))


def _attachments_reordered(f: Forgery) -> None:
    i, j = (f.records.index(f.attachment(name)) for name in ("station.toml", "profile.toml"))
    f.records[i], f.records[j] = f.records[j], f.records[i]


def _operator(f: Forgery) -> None:
    f.metadata("work").metadata = {**f.metadata("work").metadata, "operator": "Eve"}


def _recomputed(name: str) -> Callable[[Line, Keys, Path], object]:
    """All of it made anew, by another key, in the place in the chain."""

    def make(line: Line, keys: Keys, path: Path) -> None:
        forgery = Forgery.of(path)
        _raw_byte(forgery)
        line.forged(forgery, path, signed=False)
        _signed_in_place(path, line, keys[name])

    return make


def _signed_in_place(
    path: Path, line: Line, key: SigningKey, change: Callable[[dict[str, Any]], object] = lambda _: None, **other: Any
) -> None:
    """Signed by the key with the claims that it had in the line, but for ``other`` ones, and a payload ``change``d."""
    original = parse_envelope(path.with_suffix(f".{SIGNATURE_FILE}").read_bytes())
    claims = replace(claims_in(original), key=key.name, public=to_text(key.public))
    claims = replace(claims, **{k: v for k, v in other.items() if k != "key_id"})

    @contextmanager
    def sign(contents: Any) -> Any:
        document = json.loads(manifest(contents, claims))
        change(document)
        payload = canonical(document)
        signature = key.sign(pae(MANIFEST_TYPE, payload))
        envelope = Envelope(MANIFEST_TYPE, payload, other.get("key_id", key.id), signature)
        yield SignatureMade(SIGNATURE_FILE, "", envelope.to_bytes())

    sign_anew(path, sign)
    _sidecars(path)


def _spoofed_key_id(line: Line, keys: Keys, path: Path) -> None:
    _signed_in_place(path, line, keys["stranger"], key_id=line.key.id)


def _spoofed_public_key(line: Line, keys: Keys, path: Path) -> None:
    _signed_in_place(path, line, keys["stranger"], key_id=line.key.id, public=to_text(line.key.public))


def _other_public_key_claimed(line: Line, keys: Keys, path: Path) -> None:
    """By the right key, which claims to be another one."""
    _signed_in_place(path, line, line.key, public=to_text(keys["stranger"].public))


def _set_back(line: Line, keys: Keys, path: Path) -> None:
    """The key's holder dates the signature before the end of the run."""
    _signed_in_place(path, line, line.key, signed=when(line.now_ns - 10**6 * SECOND_NS))


def _says_more(line: Line, keys: Keys, path: Path) -> None:
    _signed_in_place(path, line, line.key, lambda document: document.update(remark="passed"))


def _says_another_verdict(line: Line, keys: Keys, path: Path) -> None:
    _signed_in_place(path, line, line.key, lambda document: document.update(verdict="fail"))


def _moved(line: Line, keys: Keys, path: Path) -> None:
    put_signature(path, envelope_of(line.made[2]))
    _sidecars(path)


def _swapped(line: Line, keys: Keys, path: Path) -> None:
    """The files of two recordings change their names; the documents beside them stay."""
    other = line.made[2]
    aside = path.with_suffix(".aside")
    path.rename(aside)
    other.rename(path)
    aside.rename(other)


def _edited(change: Callable[[dict[str, Any]], object]) -> Callable[[Line, Keys, Path], object]:
    """The envelope's JSON, the signature left as it is."""

    def make(line: Line, keys: Keys, path: Path) -> None:
        envelope = json.loads(envelope_of(path))
        change(envelope)
        put_signature(path, canonical(envelope))
        _sidecars(path)

    return make


def _payload(change: Callable[[dict[str, Any]], object]) -> Callable[[dict[str, Any]], object]:
    def edit(envelope: dict[str, Any]) -> None:
        document = json.loads(base64.b64decode(envelope["payload"]))
        change(document)
        envelope["payload"] = base64.b64encode(canonical(document)).decode()

    return edit


def _other_signature(envelope: dict[str, Any]) -> None:
    signature = bytearray(base64.b64decode(envelope["signatures"][0]["sig"]))
    signature[5] ^= 1
    envelope["signatures"][0]["sig"] = base64.b64encode(signature).decode()


def _signed_as_chain(line: Line, keys: Keys, path: Path) -> None:
    """What the key has signed for the chain, as if it were of a recording."""
    start = json.loads((line.folder / "chain.jsonl").read_text().splitlines()[0])["envelope"]
    put_signature(path, canonical({**start, "payloadType": MANIFEST_TYPE}))
    _sidecars(path)


def _stripped(line: Line, keys: Keys, path: Path) -> None:
    forgery = Forgery.of(path)
    forgery.drop(SIGNATURE_FILE)
    forgery.write(path)
    path.with_suffix(f".{SIGNATURE_FILE}").unlink()


def _stripped_and_dated_back(line: Line, keys: Keys, path: Path) -> None:
    """A forger makes a recording from before the trust file; no signature has to be made."""
    old = Line(line.folder, line.key, line.now_ns - 10**7 * SECOND_NS)
    path.unlink()
    path.with_suffix(f".{SIGNATURE_FILE}").unlink()
    old.record(path.name, signed=False)


def _stripped_but_for_the_sidecar(line: Line, keys: Keys, path: Path) -> None:
    forgery = Forgery.of(path)
    forgery.drop(SIGNATURE_FILE)
    forgery.write(path)


def _two_signatures(line: Line, keys: Keys, path: Path) -> None:
    forgery = Forgery.of(path)
    held = forgery.attachment(SIGNATURE_FILE)
    forgery.records.insert(forgery.records.index(held), deepcopy(held))
    forgery.write(path)


def _signature_first(line: Line, keys: Keys, path: Path) -> None:
    forgery = Forgery.of(path)
    held = forgery.attachment(SIGNATURE_FILE)
    forgery.records.remove(held)
    forgery.records.insert(forgery.records.index(forgery.attachment("station.toml")), held)
    forgery.write(path)


def _attached_later(line: Line, keys: Keys, path: Path) -> None:
    forgery = Forgery.of(path)
    held = forgery.attachment(SIGNATURE_FILE)
    held.create_time = held.log_time = held.log_time + SECOND_NS
    forgery.write(path)


def _other_media_type(line: Line, keys: Keys, path: Path) -> None:
    forgery = Forgery.of(path)
    forgery.attachment(SIGNATURE_FILE).media_type = "text/plain"
    forgery.write(path)


def _recovered(line: Line, keys: Keys, path: Path) -> None:
    out = path.with_name("recovered.mcap")
    recover(path, out)
    out.replace(path)


def _other_sidecar(line: Line, keys: Keys, path: Path) -> None:
    shutil.copy(line.made[2].with_suffix(f".{SIGNATURE_FILE}"), path.with_suffix(f".{SIGNATURE_FILE}"))


def _record_after_the_end(line: Line, keys: Keys, path: Path) -> None:
    forgery = Forgery.of(path)
    raw = forgery.metadata("raw")
    raw.metadata = {**raw.metadata, "remark": "x"}
    forgery.write(path)


@dataclass(frozen=True)
class Row:
    name: str
    make: Callable[[Line, Keys, Path], object]
    state: State
    kinds: frozenset[Kind]


def _row(name: str, make: Callable[[Line, Keys, Path], object], state: State, *kinds: Kind) -> Row:
    return Row(name, make, state, frozenset(kinds))


INVALID, UNSIGNED = State.INVALID, State.UNSIGNED
ROWS = [
    _row("a raw byte changed", _resealed(_raw_byte), INVALID, Kind.VALUE),
    _row("raw messages in another order", _resealed(_raw_reordered), INVALID, Kind.VALUE),
    _row("raw records in other messages", _resealed(_rebatched), INVALID, Kind.VALUE),
    _row("a raw message removed", _resealed(lambda f: f.first(RAW, lambda _: None)), INVALID, Kind.VALUE),
    _row("the certificate changed", _resealed(lambda f: f.put("certificate.json", b"{}\n")), INVALID, Kind.VALUE),
    _row("the certificate removed", _resealed(lambda f: f.drop("certificate.json")), INVALID, Kind.VALUE),
    _row("an attachment inserted", _resealed(_other_attachment), INVALID, Kind.VALUE),
    _row("attachments in another order", _resealed(_attachments_reordered), INVALID, Kind.VALUE),
    _row("another operator", _resealed(_operator), INVALID, Kind.VALUE),
    _row("an end edited", _resealed(lambda f: f.edit(ATTACHMENT, lambda o: o.update(ended=o["started"]))),
         INVALID, Kind.VALUE),
    _row("another verdict", _resealed(lambda f: f.edit(ATTACHMENT, lambda o: o.update(verdict="fail"))),
         INVALID, Kind.VALUE),
    _row("a record after the end changed", _record_after_the_end, INVALID, Kind.VALUE),
    _row("made anew by a key that is not trusted", _recomputed("stranger"), State.UNTRUSTED, Kind.UNTRUSTED),
    _row("made anew under the id of a trusted key", _spoofed_key_id, INVALID, Kind.NOT_VERIFIED),
    _row("made anew under id and public key of a trusted key", _spoofed_public_key, INVALID, Kind.NOT_VERIFIED),
    _row("a key that claims to be another", _other_public_key_claimed, INVALID, Kind.NOT_VERIFIED),
    _row("the clock set back", _set_back, State.TRUSTED, Kind.CLOCK),
    _row("a manifest that says more", _says_more, INVALID, Kind.VALUE),
    _row("a manifest that says another verdict", _says_another_verdict, INVALID, Kind.VALUE),
    _row("the envelope of another recording", _moved, INVALID, Kind.VALUE),
    _row("two recordings swapped", _swapped, State.TRUSTED, Kind.BESIDE),
    _row("a payload edited", _edited(_payload(lambda p: p.update(verdict="fail"))), INVALID, Kind.NOT_VERIFIED),
    _row("a number edited", _edited(_payload(lambda p: p.update(number=9))), INVALID, Kind.NOT_VERIFIED),
    _row("a signature edited", _edited(_other_signature), INVALID, Kind.NOT_VERIFIED),
    _row("a key id edited", _edited(lambda e: e["signatures"][0].update(keyid="0" * 64)), INVALID, Kind.NOT_VERIFIED),
    _row("another payload type", _edited(lambda e: e.update(payloadType=CHAIN_TYPE)), INVALID, Kind.NO_ENVELOPE),
    _row("an entry of the chain as signature", _signed_as_chain, INVALID, Kind.NOT_VERIFIED),
    _row("stripped", _stripped, UNSIGNED, Kind.UNSIGNED),
    _row("stripped and dated back", _stripped_and_dated_back, UNSIGNED, Kind.UNSIGNED),
    _row("stripped but for the file beside it", _stripped_but_for_the_sidecar, UNSIGNED, Kind.UNSIGNED, Kind.ALONE),
    _row("two signatures", _two_signatures, State.TRUSTED, Kind.TWICE),
    _row("the signature before the outcome", _signature_first, State.TRUSTED, Kind.NOT_LAST),
    _row("the signature attached later", _attached_later, State.TRUSTED, Kind.VALUE),
    _row("another media type of the signature", _other_media_type, State.TRUSTED, Kind.VALUE),
    _row("recovered by hand", _recovered, UNSIGNED, Kind.UNSIGNED),
    _row("the file beside it replaced", _other_sidecar, State.TRUSTED, Kind.BESIDE),
]  # fmt: skip


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_a_forgery_is_found_and_named(row: Row, line: Line, keys: Keys) -> None:
    path = line.made[1]
    row.make(line, keys, path)
    signature, found = looked_at(path, Policy())
    assert signature.state is row.state
    assert row.kinds <= set(found), found


def test_a_recording_as_it_was_made_is_signed_by_a_trusted_key(recorded: Line) -> None:
    for number, path in enumerate(recorded.made[1:], start=1):
        signature, found = looked_at(path, Policy())
        assert found == []
        assert (signature.state, signature.name, signature.number) == (State.TRUSTED, "line-1", number)
        assert signature.key == recorded.key.id


def test_every_record_of_a_recording_is_under_the_signature(line: Line, keys: Keys) -> None:
    """Each attachment, metadata record and message in turn is taken out, and all digests are brought in step."""
    path = line.made[1]
    whole = Forgery.of(path)
    signature = whole.attachment(SIGNATURE_FILE).data
    kept = {SIGNATURE_FILE, ATTACHMENT, "raw", "end", "recording"}
    for i, record in enumerate(whole.records):
        if getattr(record, "name", "") in kept:
            continue
        forgery = whole.copied()
        del forgery.records[i]
        line.forged(forgery, path, signed=False)
        put_signature(path, signature)
        assert looked_at(path, Policy())[0].state is State.INVALID, record


def test_a_stripped_recording_passes_only_where_nothing_asks_for_a_signature(line: Line, keys: Keys) -> None:
    path = line.made[1]
    _stripped(line, keys, path)
    assert looked_at(path, Policy(allow_unsigned=True)) == (replace(looked_at(path, Policy())[0]), [])
    (line.folder / "trust.toml").unlink()
    signature, found = looked_at(path, Policy())
    assert (signature.state, found, signature.trust) == (UNSIGNED, [], None)


def test_an_earlier_recording_passes_without_a_signature(recorded: Line) -> None:
    signature, found = looked_at(recorded.made[0], Policy())
    assert (signature.state, signature.older, found) == (UNSIGNED, True, [])


@pytest.mark.parametrize(("settings", "state"), [
    ({"reason": "stolen"}, State.REVOKED),
    ({"reason": "replaced", "retired": True}, State.TRUSTED),
])  # fmt: skip
def test_what_a_revoked_key_signed_counts_only_if_nobody_else_had_it(
    line: Line, settings: dict[str, Any], state: State
) -> None:
    trusted(line.folder, when(line.now_ns - 10**6 * SECOND_NS), line.key, revoked=when(line.now_ns), **settings)
    signature, found = looked_at(line.made[1], Policy())
    assert signature.state is state
    assert found == ([Kind.REVOKED] if state is State.REVOKED else [])
    line.now_ns += 60 * SECOND_NS
    signature, found = looked_at(line.record(), Policy())
    assert (signature.state, found) == (State.REVOKED, [Kind.REVOKED])


def test_without_a_trust_file_the_signature_is_checked_and_nobody_is_trusted(line: Line) -> None:
    (line.folder / "trust.toml").unlink()
    signature, found = looked_at(line.made[1], Policy())
    assert (signature.state, signature.name, found) == (State.UNTRUSTED, "line-1", [])


def test_an_auditor_brings_a_trust_file_of_his_own(line: Line, keys: Keys, tmp_path: Path) -> None:
    own = tmp_path / "own"
    own.mkdir()
    path = trusted(own, when(line.now_ns), keys["stranger"])
    assert looked_at(line.made[1], Policy(path))[1] == [Kind.UNTRUSTED]
    assert looked_at(line.made[1], Policy(path, allow_unsigned=True))[1] == []


def test_two_keys_of_one_station_are_both_trusted(line: Line, keys: Keys) -> None:
    trusted(line.folder, when(line.now_ns), line.key, keys["line-2"])
    line.key = keys["line-2"]
    signature, found = looked_at(line.record(), Policy())
    assert (signature.state, signature.name, signature.number, found) == (State.TRUSTED, "line-2", 5, [])
    assert isinstance(line.signing, StationSigning)
