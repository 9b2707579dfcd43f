"""Envelopes of signed documents (DSSE 1.0): the payload as bytes, its type, and one
signature over both. No cryptography and no I/O.

The signature is over PAE(type, payload), so nobody can pass a payload off as one of
another type (https://github.com/secure-systems-lab/dsse, protocol.md).
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from triaxcald.documents import json_value

MANIFEST_TYPE: Final = "application/vnd.triaxcal.manifest+json"
CHAIN_TYPE: Final = "application/vnd.triaxcal.chain+json"
MEDIA_TYPE: Final = "application/vnd.dsse.envelope.v1+json"
"""Of an envelope as an attachment."""
ENVELOPE_MOST: Final = 16 * 2**20
"""Bytes of an envelope; that of a run has some twenty thousand, the start of a chain
some hundred for each earlier recording."""
STAMP: Final = "rfc3161"
"""Key beside a signature with the authority's answer, in DER; DSSE allows further
keys."""


class NotAnEnvelope(ValueError):
    """The bytes are no envelope; the message says why."""


@dataclass(frozen=True)
class Envelope:
    """``signature`` is of the key ``key_id``, ``stamp`` the answer of a time-stamping
    authority about the signature, None where there is none."""

    payload_type: str
    payload: bytes
    key_id: str
    signature: bytes
    stamp: bytes | None = None

    @property
    def signed_bytes(self) -> bytes:
        return pae(self.payload_type, self.payload)

    def document(self) -> dict[str, Any]:
        signature = {"keyid": self.key_id, "sig": _text(self.signature)}
        if self.stamp is not None:
            signature[STAMP] = _text(self.stamp)
        return {"payload": _text(self.payload), "payloadType": self.payload_type, "signatures": [signature]}

    def to_bytes(self) -> bytes:
        return canonical(self.document()) + b"\n"


def pae(payload_type: str, payload: bytes) -> bytes:
    """The pre-authentication encoding: what is signed."""
    name = payload_type.encode()
    return b"DSSEv1 %d %b %d %b" % (len(name), name, len(payload), payload)


def canonical(document: Mapping[str, Any]) -> bytes:
    """JSON of one form: keys in order, no blanks, UTF-8."""
    return json.dumps(document, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False).encode()


def parse_envelope(data: bytes) -> Envelope:
    """Raises NotAnEnvelope."""
    if len(data) > ENVELOPE_MOST:
        raise NotAnEnvelope(f"more than {ENVELOPE_MOST} bytes")
    try:
        found = json_value(data)
    except (ValueError, RecursionError):
        raise NotAnEnvelope("no JSON") from None
    return envelope_of(found)


def envelope_of(found: object) -> Envelope:
    """Of a JSON value. Raises NotAnEnvelope."""
    outer = _object(found, {"payload", "payloadType", "signatures"})
    signatures = outer["signatures"]
    if not isinstance(signatures, list) or len(signatures) != 1:
        raise NotAnEnvelope("expected one signature")
    inner = _object(signatures[0], {"keyid", "sig"}, {STAMP})
    if not isinstance(outer["payloadType"], str) or not isinstance(inner["keyid"], str):
        raise NotAnEnvelope("expected texts")
    stamp = inner.get(STAMP)
    return Envelope(
        outer["payloadType"],
        _bytes(outer["payload"]),
        inner["keyid"],
        _bytes(inner["sig"]),
        None if stamp is None else _bytes(stamp),
    )


def payload_of(envelope: Envelope, payload_type: str) -> Mapping[str, Any]:
    """The payload as a JSON object in its one form. Raises NotAnEnvelope."""
    if envelope.payload_type != payload_type:
        raise NotAnEnvelope(f"a payload of type {envelope.payload_type[:60]!r}, expected {payload_type}")
    try:
        found = json_value(envelope.payload)
        again = canonical(found) if isinstance(found, dict) else b""
    except (ValueError, RecursionError):
        raise NotAnEnvelope("a payload that is no JSON") from None
    if again != envelope.payload or not isinstance(found, dict):
        raise NotAnEnvelope("a payload that is no JSON object in canonical form")
    return found


def _object(value: object, keys: set[str], optional: set[str] = frozenset()) -> dict[str, Any]:  # type: ignore[assignment]
    if not isinstance(value, dict) or not keys <= set(value) <= keys | optional:
        raise NotAnEnvelope(f"expected an object with {', '.join(sorted(keys))}")
    return value


def _bytes(value: object) -> bytes:
    if not isinstance(value, str):
        raise NotAnEnvelope("expected bytes in Base64")
    try:
        data = base64.b64decode(value, validate=True)
    except (binascii.Error, ValueError):
        raise NotAnEnvelope("expected bytes in Base64") from None
    if _text(data) != value:  # bits behind the last byte
        raise NotAnEnvelope("expected bytes in Base64")
    return data


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode()
