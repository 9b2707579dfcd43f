"""Time stamps of an authority (RFC 3161): that a signature was there at a time."""

from __future__ import annotations

import hashlib
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Final

import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.signing.keys import loaded

TIMEOUT_S: Final = 5.0
"""An authority answers within some tenths of a second; a tray waits for it."""
DOWN_S: Final = 60.0
"""Time for which an authority that did not answer is not asked again, so that the units
of a tray do not wait for it one after the other."""
ANSWER_MOST: Final = 65_536
"""Bytes of an answer: a signature and two or three certificates have some thousand."""


class StampState(StrEnum):
    TRUSTED = "trusted"
    UNTRUSTED = "untrusted"
    INVALID = "invalid"
    MISSING = "missing"


@dataclass(frozen=True)
class Stamp:
    """``time`` of the authority, None where there is none to be read; ``authority`` is
    its name in the trust file."""

    state: StampState
    time: datetime | None = None
    authority: str | None = None


_down: dict[str, float] = {}
_lock = threading.Lock()


def require_installed() -> None:
    """Raises InputError where the package is missing."""
    with loaded():
        import rfc3161_client  # noqa: F401


def stamp(url: str, message: bytes) -> bytes | None:
    """The authority's answer, in DER; None where none can be had. Raises nothing: the
    signature holds without it, and the audit says that the stamp is missing."""
    import http.client
    import urllib.request

    from rfc3161_client import TimestampRequestBuilder, VerificationError

    with _lock:
        if time.monotonic() < _down.get(url, 0.0):
            return None
    request = TimestampRequestBuilder().data(message).build()
    asked = urllib.request.Request(
        url,
        request.as_bytes(),
        {"Content-Type": "application/timestamp-query", "Accept": "application/timestamp-reply"},
    )
    try:
        with urllib.request.urlopen(asked, timeout=TIMEOUT_S) as answer:  # the URL is the station file's
            data = bytes(answer.read(ANSWER_MOST + 1))
        found = _decoded(data)
        if found.tst_info.nonce != request.nonce or not _is_of(found, message):
            raise VerificationError("an answer to something else")
    except (OSError, ValueError, VerificationError, http.client.HTTPException):
        with _lock:
            _down[url] = time.monotonic() + DOWN_S
        return None
    return data


def check(data: bytes, message: bytes, roots: Sequence[tuple[str, str]]) -> Stamp:
    """What an answer shows about the message, by the root certificates (name, PEM) that
    are trusted. Raises InputError where the package is missing."""
    with loaded():
        from cryptography.x509 import load_pem_x509_certificate
        from rfc3161_client import VerificationError, VerifierBuilder
    try:
        found = _decoded(data)
        when = found.tst_info.gen_time.astimezone(UTC)
        if not _is_of(found, message):
            return Stamp(StampState.INVALID)
    except ValueError:
        return Stamp(StampState.INVALID)
    for name, pem in roots:
        try:
            root = load_pem_x509_certificate(pem.encode())
            VerifierBuilder(roots=[root]).build().verify_message(found, message)
        except (ValueError, VerificationError):
            continue
        return Stamp(StampState.TRUSTED, when, name)
    return Stamp(StampState.UNTRUSTED, when)


def _decoded(data: bytes):  # type: ignore[no-untyped-def]
    """Raises ValueError."""
    from rfc3161_client import decode_timestamp_response

    if len(data) > ANSWER_MOST:
        raise ValueError("too long")
    return decode_timestamp_response(data)


def _is_of(found, message: bytes) -> bool:  # type: ignore[no-untyped-def]
    """Whether the answer is about the message, by its digest."""
    imprint = found.tst_info.message_imprint
    digest = {32: hashlib.sha256, 48: hashlib.sha384, 64: hashlib.sha512}.get(len(imprint.message))
    return digest is not None and digest(message).digest() == imprint.message


def certificate_in(path: Path) -> str:
    """The certificate of a file in PEM. Raises InputError."""
    with loaded():
        from cryptography.hazmat.primitives.serialization import Encoding
        from cryptography.x509 import load_pem_x509_certificate
    try:
        with td.files.open_file(path) as file:
            found = load_pem_x509_certificate(file.read(ANSWER_MOST))
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {e.strerror}") from e
    except ValueError:
        raise InputError(f"{path}: expected a certificate in PEM") from None
    return found.public_bytes(Encoding.PEM).decode()
