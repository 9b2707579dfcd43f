"""Keys in a device, by PKCS #11: the private key never leaves it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from triaxcald.errors import InputError, StationError
from triaxcald.signing.keys import KEY_BYTES, PASSPHRASE, SigningKey, loaded, require_name

_EDWARDS25519: Final = b"\x13\x0cedwards25519"
"""The curve as PKCS #11 3.0 names it (section 2.3.5): a PrintableString."""


def open_key(module: Path, token: str, label: str, pin: bytes | None) -> SigningKey:
    """The Ed25519 key with that label in a token, for as long as the process lives.
    Raises InputError."""
    with _errors(module, token):
        session = _session(module, token, pin, label, rw=False)
        from pkcs11 import Attribute, KeyType, Mechanism, ObjectClass, PKCS11Error

        try:
            private = session.get_key(object_class=ObjectClass.PRIVATE_KEY, key_type=KeyType.EC_EDWARDS, label=label)
            public = session.get_key(object_class=ObjectClass.PUBLIC_KEY, key_type=KeyType.EC_EDWARDS, label=label)
            point = bytes(public[Attribute.EC_POINT])
        except PKCS11Error:
            session.close()
            raise
    one_at_a_time = threading.Lock()  # a session is of one thread

    def sign(message: bytes) -> bytes:
        with one_at_a_time:
            try:
                return bytes(private.sign(message, mechanism=Mechanism.EDDSA))
            except PKCS11Error as e:
                raise StationError(f"token {token}: key {label} signs nothing: {_named(e)}") from e

    return SigningKey(label, point[-KEY_BYTES:], sign)


def new_key(module: Path, token: str, label: str, pin: bytes | None) -> bytes:
    """Make a pair in the token; its public key. Raises InputError."""
    require_name(label)
    with _errors(module, token):
        session = _session(module, token, pin, label, rw=True)
        from pkcs11 import Attribute, KeyType, Mechanism

        try:
            if any(session.get_objects({Attribute.LABEL: label})):
                raise InputError(f"token {token}: has a key {label} already; a key is never overwritten")
            curve = session.create_domain_parameters(
                KeyType.EC_EDWARDS, {Attribute.EC_PARAMS: _EDWARDS25519}, local=True
            )
            public, _ = curve.generate_keypair(
                mechanism=Mechanism.EC_EDWARDS_KEY_PAIR_GEN, label=label, id=label.encode(), store=True
            )
            point = bytes(public[Attribute.EC_POINT])
        finally:
            session.close()
    return point[-KEY_BYTES:]


def _session(module: Path, token: str, pin: bytes | None, label: str, *, rw: bool) -> Any:
    if pin is None:
        raise InputError(f"token {token}: key {label} needs a PIN: {PASSPHRASE} in the environment, or a file with it")
    import pkcs11

    found = pkcs11.lib(str(module)).get_token(token_label=token)
    try:
        return found.open(rw=rw, user_pin=pin.decode("utf-8", "replace"))
    except pkcs11.UserAlreadyLoggedIn:  # a login is of the whole process
        return found.open(rw=rw)


@contextmanager
def _errors(module: Path, token: str) -> Iterator[None]:
    """Raises InputError for what the device or its library raises."""
    with loaded():
        from pkcs11 import PKCS11Error
    try:
        yield
    except (PKCS11Error, OSError, RuntimeError) as e:
        raise InputError(f"{module}: token {token}: {_named(e)}") from e


def _named(e: Exception) -> str:
    """PKCS #11 errors often have a name alone."""
    return str(e) or type(e).__name__
