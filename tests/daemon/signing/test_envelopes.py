"""Envelopes: the form of DSSE, and whatever anybody may put in their place."""

from __future__ import annotations

import base64
import json
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.daemon.signing.line import MEDIA_TYPE, Line, envelope_of
from triaxcald.audit import Policy
from triaxcald.audit.signature import State, check
from triaxcald.outcome import ATTACHMENT
from triaxcald.recording.manifest import End
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import SIGNATURE_FILE
from triaxcald.recording.survey import Survey, survey
from triaxcald.signing import chain
from triaxcald.signing.envelope import NotAnEnvelope, canonical, pae, parse_envelope
from triaxcald.signing.keys import verifies


def test_what_is_signed_is_the_pre_authentication_encoding() -> None:
    """The example of the specification, protocol.md."""
    assert pae("http://example.com/HelloWorld", b"hello world") == (
        b"DSSEv1 29 http://example.com/HelloWorld 11 hello world"
    )


def test_an_envelope_holds_one_signature_over_type_and_payload(recorded: Line) -> None:
    document = json.loads(envelope_of(recorded.made[1]))
    assert set(document) == {"payload", "payloadType", "signatures"}
    assert document["payloadType"] == "application/vnd.triaxcal.manifest+json"
    (signature,) = document["signatures"]
    payload = base64.b64decode(document["payload"])
    message = b"DSSEv1 %d %b %d %b" % (
        len(document["payloadType"]), document["payloadType"].encode(), len(payload), payload,
    )  # fmt: skip
    assert verifies(recorded.key.public, base64.b64decode(signature["sig"]), message)
    manifest = json.loads(payload)
    assert manifest["format"] == "triaxcal.manifest/1"
    assert [a["name"] for a in manifest["contents"]["attachments"]] == [
        "station.toml", "profile.toml", "certificate.json", "outcome.json",
    ]  # fmt: skip
    assert (manifest["work"], manifest["software"]) == ({"slot": "unit"}, {"triaxcal": "0.2.0"})
    assert (manifest["raw"]["batches"], manifest["raw"]["records"]) == (3, "24")


def test_the_hash_chain_of_raw_batches_can_be_made_by_hand(recorded: Line) -> None:
    from hashlib import sha256

    link = bytes(32)
    with Recording.open(recorded.made[1]) as recording:
        for _, message in recording.messages("/raw"):
            link = sha256(link + sha256(message.data).digest()).digest()
    payload = parse_envelope(envelope_of(recorded.made[1])).payload
    assert json.loads(payload)["raw"]["chain"] == link.hex()


@pytest.mark.parametrize("change", [
    {"payload": "!"},
    {"payload": "QQ"},
    {"payload": "QR=="},
    {"payload": 1},
    {"payloadType": None},
    {"signatures": []},
    {"signatures": [{"keyid": "a", "sig": "QQ=="}] * 2},
    {"signatures": [{"keyid": "a"}]},
    {"signatures": [{"keyid": 1, "sig": "QQ=="}]},
    {"signatures": [{"keyid": "a", "sig": "QQ==", "cert": "x"}]},
    {"signatures": {"keyid": "a", "sig": "QQ=="}},
    {"more": 1},
], ids=str)  # fmt: skip
def test_other_forms_are_no_envelope(change: dict[str, Any]) -> None:
    right = {"payload": "QQ==", "payloadType": "t", "signatures": [{"keyid": "a", "sig": "QQ=="}]}
    assert parse_envelope(canonical(right)).payload == b"A"
    with pytest.raises(NotAnEnvelope):
        parse_envelope(canonical({**right, **change}))


@pytest.mark.parametrize("data", [b"", b"\xff", b"[" * 10**5, b'{"a":1,"a":2}', b"null", b'"\\ud800"', b"1e999"])
def test_other_bytes_are_no_envelope(data: bytes) -> None:
    with pytest.raises(NotAnEnvelope):
        parse_envelope(data)


# Fuzzing.

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=8,
)
QUICK = settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


@cache
def _surveyed(path: Path) -> Survey:
    with Recording.open(path) as recording:
        return survey(recording, ATTACHMENT)


def _state(recorded: Line, data: bytes) -> State:
    found = _surveyed(recorded.made[1])
    end = found.end
    assert end is not None
    held = End(SIGNATURE_FILE, MEDIA_TYPE, end.time_ns, data)
    signature, differences = check(recorded.made[1], {}, replace(found, signature=held), Policy())
    assert (signature.state is State.TRUSTED) or differences
    return signature.state


@QUICK
@given(data=st.data())
def test_an_envelope_with_other_bytes_is_refused_without_a_traceback(recorded: Line, data: st.DataObject) -> None:
    envelope = bytearray(envelope_of(recorded.made[1]))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(envelope) - 1))
        envelope[at : at + data.draw(st.integers(0, 5))] = data.draw(st.binary(max_size=5))
    same = _parsed(bytes(envelope)) == _parsed(envelope_of(recorded.made[1]))
    assert (_state(recorded, bytes(envelope)) is State.TRUSTED) is same


def _parsed(data: bytes) -> Any:
    try:
        return parse_envelope(data)
    except NotAnEnvelope:
        return None


@QUICK
@given(payload=JSON | st.dictionaries(st.sampled_from(["key", "signed", "number", "previous", "contents"]), JSON),
       keep=st.booleans())  # fmt: skip
def test_a_payload_that_the_key_has_signed_may_be_anything(recorded: Line, payload: Any, keep: bool) -> None:
    """The worst: the key itself has signed what is no manifest."""
    envelope = parse_envelope(envelope_of(recorded.made[1]))
    base = json.loads(envelope.payload)
    document = {**base, **payload} if keep and isinstance(payload, dict) else payload
    try:
        data = canonical(document)
    except ValueError:
        return
    signature = recorded.key.sign(pae(envelope.payload_type, data))
    forged = replace(envelope, payload=data, signature=signature)
    assert (_state(recorded, forged.to_bytes()) is State.TRUSTED) is (data == envelope.payload)


@QUICK
@given(value=JSON, text=st.binary(max_size=60))
def test_an_envelope_of_any_json_is_refused_without_a_traceback(recorded: Line, value: Any, text: bytes) -> None:
    for data in (json.dumps(value).encode(), text):
        assert _state(recorded, data) is State.INVALID


@QUICK
@given(data=st.data())
def test_a_line_of_a_chain_may_be_anything(recorded: Line, data: st.DataObject) -> None:
    line = bytearray(chain.read_lines(recorded.folder / chain.NAME)[data.draw(st.integers(0, 4))])
    at = data.draw(st.integers(0, len(line) - 1))
    line[at : at + data.draw(st.integers(0, 5))] = data.draw(st.binary(max_size=5))
    with suppress(NotAnEnvelope):
        assert chain.said_in(chain.entry_of(bytes(line))).claims.number >= 0


@QUICK
@given(stamp=st.binary(max_size=200))
def test_a_time_stamp_may_be_anything(recorded: Line, stamp: bytes) -> None:
    envelope = parse_envelope(envelope_of(recorded.made[1]))
    found = _surveyed(recorded.made[1])
    assert found.end is not None
    data = replace(envelope, stamp=stamp).to_bytes()
    held = End(SIGNATURE_FILE, MEDIA_TYPE, found.end.time_ns, data)
    signature, differences = check(recorded.made[1], {}, replace(found, signature=held), Policy())
    assert signature.stamp is not None
    assert (signature.stamp.state.value, len(differences)) == ("invalid", 1)
