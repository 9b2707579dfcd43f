"""The manifest of a signed recording (`triaxcal.manifest/1`): digests of all that is
in it, and who signed it, when, and after which other recording. No cryptography and
no I/O.

A check makes the manifest again from the recording and compares bytes. Only the
claims are taken from the signed one, since nothing else in a recording tells them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from triaxcald.documents import json_value
from triaxcald.recording.manifest import SealedContents
from triaxcald.recording.schema import RAW_RECORD
from triaxcald.signing.envelope import MANIFEST_TYPE, Envelope, NotAnEnvelope, canonical, payload_of

FORMAT: Final = "triaxcal.manifest/1"
NUMBER_MOST: Final = 2**53
"""The next integer is the first that JSON numbers elsewhere cannot tell from its
neighbour."""
_OUTCOME: Final = (
    "run", "recording", "station", "unit", "serial", "work", "started", "ended", "verdict", "code", "exit_code",
    "device_state", "supersedes",
)  # fmt: skip
"""Keys that the manifest takes over from the outcome."""


@dataclass(frozen=True)
class Claims:
    """What the signer states and the recording does not show. ``signed`` is the host's
    time in ISO 8601, ``number`` counts the entries of the chain, and ``previous`` is
    the SHA-256 of the payload of the entry before; ``key`` is the name of the key,
    ``public`` the public key in Base64."""

    key: str
    public: str
    signed: str
    number: int
    previous: str


def manifest(contents: SealedContents, claims: Claims) -> bytes:
    """The payload that is signed. Raises ValueError if the recording ends with no JSON
    object."""
    try:
        outcome = json_value(contents.document)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(outcome, dict):
        raise ValueError("no JSON object")
    raw = contents.closing.get(RAW_RECORD, {})
    return canonical(
        {
            "format": FORMAT,
            **claims_document(claims),
            **{key: outcome.get(key) for key in _OUTCOME},
            "software": dict(contents.metadata.get("software", {})),
            "raw": {
                "batches": contents.raw_batches,
                "chain": contents.raw_chain,
                "records": raw.get("records"),
                "sha256": raw.get("sha256"),
            },
            "contents": contents.contents,
            "closing": {name: dict(record) for name, record in contents.closing.items()},
        }
    )


def claims_document(claims: Claims) -> dict[str, Any]:
    """The claims as keys of a signed document."""
    return {
        "key": {"name": claims.key, "public": claims.public},
        "signed": claims.signed,
        "number": claims.number,
        "previous": claims.previous,
    }


def claims_of(document: Mapping[str, Any]) -> Claims:
    """Raises NotAnEnvelope."""
    key = document.get("key")
    texts = [key.get("name"), key.get("public")] if isinstance(key, Mapping) and len(key) == 2 else [None]
    texts += [document.get("signed"), document.get("previous")]
    number = document.get("number")
    if not all(isinstance(text, str) for text in texts) or type(number) is not int or not 0 <= number < NUMBER_MOST:
        raise NotAnEnvelope("a payload without the claims of its signer")
    name, public, signed, previous = (str(text) for text in texts)
    return Claims(name, public, signed, number, previous)


def claims_in(envelope: Envelope) -> Claims:
    """Of the manifest in an envelope, whatever else it says. Raises NotAnEnvelope."""
    return claims_of(payload_of(envelope, MANIFEST_TYPE))
