"""Keys: Ed25519 pairs in files, encrypted at rest.

A folder has `NAME.key`, a private key (PKCS #8 in PEM, scrypt and AES-256-CBC as in
RFC 7914 and RFC 8018), and `NAME.pub`, its public key (SubjectPublicKeyInfo in PEM),
both as OpenSSL reads them.
"""

from __future__ import annotations

import base64
import errno
import hashlib
import os
import re
import secrets
import stat
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.files import new_file, synchronise, write_bytes

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

FOLDER: Final = "keys"
"""Folder of the keys in a station's folder."""
PRIVATE, PUBLIC = ".key", ".pub"
PASSPHRASE: Final = "TRIAXCAL_KEY_PASSPHRASE"
"""Environment variable with the passphrase, or the PIN of a token."""
KEY_BYTES: Final = 32
SIGNATURE_BYTES: Final = 64
FILE_MOST: Final = 65_536
"""Bytes of a file with a key or a passphrase; ours have some hundred."""
SCRYPT: Final = {"n": 2**14, "r": 8, "p": 5}
"""16 MiB and 0.2 s a guess: of the settings that OWASP's Password Storage Cheat Sheet
recommends, the one that OpenSSL reads within its limit of 32 MiB."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@contextmanager
def loaded() -> Iterator[None]:
    """Imports of packages of the extras `sign` and `hsm`. Raises InputError with the
    extra that is missing."""
    try:
        yield
    except ModuleNotFoundError as e:
        hint = td.hints.lacking(e)
        if hint is None:
            raise
        raise InputError(f"signatures: {hint}") from e


def require_name(name: str) -> str:
    """Raises InputError."""
    if not _NAME.fullmatch(name):
        raise InputError(f"key '{td.hints.clipped(name)}': expected 1 to 64 of A–Z a–z 0–9 . _ -, the first no sign")
    return name


def key_id(public: bytes) -> str:
    """SHA-256 of a public key's SubjectPublicKeyInfo, in hexadecimal digits."""
    return hashlib.sha256(_SPKI + public).hexdigest()


_SPKI: Final = bytes.fromhex("302a300506032b6570032100")
"""DER before the 32 bytes of an Ed25519 key (RFC 8410)."""


def to_text(public: bytes) -> str:
    return base64.b64encode(public).decode()


def verifies(public: bytes, signature: bytes, message: bytes) -> bool:
    """Whether the signature is of this key over the message. Raises InputError where
    cryptography is missing."""
    if len(public) != KEY_BYTES or len(signature) != SIGNATURE_BYTES:
        return False
    with loaded():
        from cryptography.exceptions import InvalidSignature
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
    try:
        Ed25519PublicKey.from_public_bytes(public).verify(signature, message)
    except (InvalidSignature, ValueError):
        return False
    return True


@dataclass(frozen=True)
class SigningKey:
    """A private key at work. ``sign`` may raise InputError or StationError."""

    name: str
    public: bytes
    sign: Callable[[bytes], bytes]
    folder: Path | None = None
    """Folder of its file, in which it remembers its chains; None without one."""

    @property
    def id(self) -> str:
        return key_id(self.public)


def new_key(folder: Path, name: str, passphrase: bytes | None) -> SigningKey:
    """Make a pair in the folder, the private key with file mode 0600. None for a key
    without a passphrase. Raises InputError."""
    require_name(name)
    with loaded():
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
    pair = Ed25519PrivateKey.generate()
    path = folder / f"{name}{PRIVATE}"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        if os.path.lexists(path.with_suffix(PUBLIC)) or os.path.lexists(path):
            raise FileExistsError(errno.EEXIST, "exists already; a key is never overwritten")
        with new_file(path, stat.S_IRUSR | stat.S_IWUSR) as file:
            file.write(_pem_of(pair, passphrase))
            file.flush()
            os.fsync(file.fileno())
        synchronise(folder)
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from e
    made = _key_of(name, pair, folder)
    write_public(folder, name, made.public)
    return made


def write_public(folder: Path, name: str, public: bytes) -> Path:
    """Raises InputError."""
    text = base64.b64encode(_SPKI + public).decode()
    pem = f"-----BEGIN PUBLIC KEY-----\n{text}\n-----END PUBLIC KEY-----\n"
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as e:
        raise InputError(f"{folder}: {e.strerror}") from e
    return write_bytes(folder / f"{name}{PUBLIC}", pem.encode())


def read_public(path: Path) -> bytes:
    """The 32 bytes of a public key in PEM. Raises InputError."""
    with loaded():
        from cryptography.exceptions import UnsupportedAlgorithm
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
        from cryptography.hazmat.primitives.serialization import load_pem_public_key
    try:
        found = load_pem_public_key(_read(path))
    except (ValueError, UnsupportedAlgorithm):
        raise InputError(f"{path}: expected a public key in PEM") from None
    if not isinstance(found, Ed25519PublicKey):
        raise InputError(f"{path}: expected a key of Ed25519")
    return found.public_bytes_raw()


def read_private(path: Path, passphrase: bytes | None, given_by: str = "--passphrase-file") -> SigningKey:
    """A private key in PEM. Raises InputError: unreadable, another kind, a wrong or
    missing passphrase, which ``given_by`` or the environment gives."""
    with loaded():
        from cryptography.exceptions import UnsupportedAlgorithm
        from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
        from cryptography.hazmat.primitives.serialization import load_pem_private_key
    data = _read(path)
    encrypted = b"BEGIN ENCRYPTED PRIVATE KEY" in data
    if encrypted and passphrase is None:
        raise InputError(f"{path}: needs its passphrase: {PASSPHRASE} in the environment, or {given_by}")
    try:
        pair = load_pem_private_key(data, passphrase if encrypted else None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        told = "the passphrase is wrong, or the file damaged" if encrypted else "expected a private key in PEM"
        raise InputError(f"{path}: {told}") from None
    if not isinstance(pair, Ed25519PrivateKey):
        raise InputError(f"{path}: expected a key of Ed25519")
    return _key_of(path.stem, pair, path.parent)


def private_keys(folder: Path) -> list[Path]:
    """Files with private keys, by name; none where there is no folder. Raises
    InputError: a folder that cannot be read is not one without keys."""
    return _files(folder, PRIVATE)


def public_keys(folder: Path) -> list[Path]:
    """As `private_keys`."""
    return _files(folder, PUBLIC)


def _files(folder: Path, suffix: str) -> list[Path]:
    try:
        with os.scandir(folder) as entries:
            return sorted(folder / entry.name for entry in entries if entry.name.endswith(suffix))
    except OSError as e:
        if isinstance(e, FileNotFoundError) or (isinstance(e, NotADirectoryError) and not os.path.lexists(folder)):
            return []
        raise InputError(f"{folder}: cannot be read: {e.strerror}") from e


def passphrase_of(file: Path | None, environment: Mapping[str, str] = os.environ) -> bytes | None:
    """The first line of the file, else the environment's; None without either. Raises
    InputError."""
    if file is None:
        found = environment.get(PASSPHRASE)
        return found.encode("utf-8", "surrogateescape") if found else None
    line = _read(file).split(b"\n", 1)[0].removesuffix(b"\r")
    if not line:
        raise InputError(f"{file}: expected a passphrase in its first line")
    return line


def _read(path: Path) -> bytes:
    try:
        with td.files.open_file(path) as file:
            data = file.read(FILE_MOST + 1)
    except OSError as e:
        raise InputError(f"{path}: cannot be read: {e.strerror}") from e
    if len(data) > FILE_MOST:
        raise InputError(f"{path}: more than {FILE_MOST} bytes")
    return data


def _key_of(name: str, pair: Ed25519PrivateKey, folder: Path) -> SigningKey:
    return SigningKey(name, pair.public_key().public_bytes_raw(), pair.sign, folder)


def _pem_of(pair: Ed25519PrivateKey, passphrase: bytes | None) -> bytes:
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    plain = pair.private_bytes(Encoding.DER, PrivateFormat.PKCS8, NoEncryption())
    if passphrase is None:
        return _pem("PRIVATE KEY", plain)
    return _pem("ENCRYPTED PRIVATE KEY", _encrypted(plain, passphrase))


def _pem(label: str, data: bytes) -> bytes:
    text = base64.b64encode(data).decode()
    lines = [text[i : i + 64] for i in range(0, len(text), 64)]
    return "\n".join([f"-----BEGIN {label}-----", *lines, f"-----END {label}-----", ""]).encode()


# PKCS #8 with scrypt. `BestAvailableEncryption` of cryptography derives the key by
# 2048 rounds of PBKDF2, which guesses far too fast.


def _encrypted(plain: bytes, passphrase: bytes) -> bytes:
    """EncryptedPrivateKeyInfo by PBES2, scrypt and AES-256-CBC (RFC 5958, RFC 8018,
    RFC 7914)."""
    from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
    from cryptography.hazmat.primitives.kdf.scrypt import Scrypt

    salt, start = secrets.token_bytes(16), secrets.token_bytes(16)
    key = Scrypt(salt=salt, length=32, **SCRYPT).derive(passphrase)
    fill = 16 - len(plain) % 16
    cipher = Cipher(algorithms.AES(key), modes.CBC(start)).encryptor()
    data = cipher.update(plain + bytes([fill]) * fill) + cipher.finalize()
    numbers = b"".join(_der_integer(SCRYPT[name]) for name in ("n", "r", "p"))
    derivation = _der(0x30, _SCRYPT_ID + _der(0x30, _der(0x04, salt) + numbers))
    encryption = _der(0x30, _AES_256_CBC_ID + _der(0x04, start))
    algorithm = _der(0x30, _PBES2_ID + _der(0x30, derivation + encryption))
    return _der(0x30, algorithm + _der(0x04, data))


_PBES2_ID: Final = bytes.fromhex("06092a864886f70d01050d")
_SCRYPT_ID: Final = bytes.fromhex("06092b06010401da47040b")
_AES_256_CBC_ID: Final = bytes.fromhex("060960864801650304012a")


def _der(tag: int, body: bytes) -> bytes:
    """DER of a body of up to 255 bytes."""
    length = bytes([len(body)]) if len(body) < 128 else bytes([0x81, len(body)])
    return bytes([tag]) + length + body


def _der_integer(value: int) -> bytes:
    return _der(0x02, value.to_bytes(value.bit_length() // 8 + 1, "big"))
