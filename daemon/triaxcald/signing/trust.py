"""The file of trusted keys, `trust.toml` in a station's folder (`triaxcal.trust/1`)."""

from __future__ import annotations

import base64
import binascii
import json
import os
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field

import triaxcal_drivers as td
from triaxcald.errors import InputError
from triaxcald.files import write_durably
from triaxcald.signing.keys import KEY_BYTES, key_id

FORMAT: Final = "triaxcal.trust/1"
NAME: Final = "trust.toml"


def _time(text: str) -> str:
    if moment(text) is None:
        raise ValueError("expected a time as 2026-01-31T12:00:00+00:00")
    return text


def _public(text: str) -> str:
    try:
        if len(base64.b64decode(text, validate=True)) == KEY_BYTES:
            return text
    except (binascii.Error, ValueError):
        pass
    raise ValueError(f"expected {KEY_BYTES} bytes in Base64")


def moment(text: object) -> datetime | None:
    """A time in ISO 8601 with its offset; None of anything else."""
    if not isinstance(text, str):
        return None
    try:
        found = datetime.fromisoformat(text)
    except ValueError:
        return None
    return found if found.tzinfo is not None else None


Time = Annotated[str, AfterValidator(_time)]


class TrustedKey(td.Strict):
    """``retired``: it was replaced while nobody else had it, so what it signed before
    stays trusted."""

    name: str
    public: Annotated[str, AfterValidator(_public), Field(description="the 32 bytes of an Ed25519 key in Base64")]
    since: Annotated[Time, Field(description="when it was entered here")]
    revoked: Annotated[Time | None, Field(description="nothing signed from then on is trusted")] = None
    reason: str | None = None
    retired: Annotated[
        bool, Field(description="replaced while nobody else had it: what it says to have signed before stays trusted")
    ] = False

    @property
    def public_bytes(self) -> bytes:
        return base64.b64decode(self.public)

    @property
    def id(self) -> str:
        return key_id(self.public_bytes)


class Authority(td.Strict):
    """A time-stamping authority (RFC 3161), by its root certificate."""

    name: str
    certificate: Annotated[str, Field(description="root certificate in PEM")]


class TrustFile(td.Strict):
    format: Literal["triaxcal.trust/1"]
    since: Annotated[Time, Field(description="recordings from then on are signed")]
    keys: tuple[TrustedKey, ...] = ()
    authorities: tuple[Authority, ...] = ()


@dataclass(frozen=True)
class Trust:
    """A trust file that was read."""

    path: Path
    file: TrustFile

    def key(self, identifier: str) -> TrustedKey | None:
        return next((key for key in self.file.keys if key.id == identifier), None)

    def named(self, name: str) -> TrustedKey | None:
        return next((key for key in self.file.keys if key.name == name), None)

    @property
    def since(self) -> datetime:
        found = moment(self.file.since)
        assert found is not None
        return found


def load_trust(path: Path) -> Trust:
    """Raises InputError, ProfileError: file, line and key."""
    try:
        text = td.toml_text.read_toml(path, expected=FORMAT)
    except OSError as e:
        raise InputError(f"{path}: {e.strerror}") from e
    found = td.toml_text.parse_toml(text, where=str(path), expected=FORMAT)
    return Trust(path, td.toml_text.validate(TrustFile, found, text, where=str(path)))


def trust_of(recording: Path) -> Trust | None:
    """That of the nearest folder upwards that has one: the station's. Raises
    InputError; Rejected as `nearest`."""
    path = nearest(recording.parent, NAME)
    return None if path is None else load_trust(path)


class Rejected(InputError):
    """A file above a folder that somebody else may have put there."""


def nearest(folder: Path, name: str) -> Path | None:
    """The file of that name in the folder, or in the nearest one above it. Above, it
    has to be root's, the user's or the owner's of the folder: whoever can write above
    all folders shall not choose the file. Raises Rejected where it is another's, or
    where nobody can tell."""
    try:
        folder = folder.resolve()
        while not folder.exists():
            folder = folder.parent
        owners = {0, getattr(os, "geteuid", int)(), folder.stat().st_uid}
        for within in (folder, *folder.parents):
            path = within / name
            if not path.is_file():
                continue
            if within != folder and not {path.lstat().st_uid, path.stat().st_uid} <= owners:
                raise Rejected(f"{path}: belongs to another user than {folder}; give the trust file by --trust")
            return path
    except OSError as e:
        raise Rejected(f"{e.filename or folder}: {e.strerror}; give the trust file by --trust") from e
    return None


def save(path: Path, file: TrustFile) -> None:
    """Raises InputError."""
    lines = [f'format = "{FORMAT}"', f"since = {_toml(file.since)}"]
    for table, entries in (("keys", file.keys), ("authorities", file.authorities)):
        for entry in entries:
            lines += ["", f"[[{table}]]"]
            values: dict[str, Any] = entry.model_dump(exclude_none=True)
            lines += [f"{key} = {_toml(value)}" for key, value in values.items() if value is not False]
    try:
        write_durably(path, "\n".join(lines) + "\n")
    except OSError as e:
        raise InputError(f"{path}: cannot be written: {e.strerror}") from e


def trust_key(folder: Path, name: str, public: bytes) -> TrustedKey:
    """Enter a key into the folder's trust file, which is made if there is none. Raises
    InputError, ProfileError."""
    file = _file_of(folder)
    entry = TrustedKey(name=name, public=base64.b64encode(public).decode(), since=now())
    for known in file.keys:
        if known.id == entry.id or known.name == name:
            same = known.id == entry.id
            told = f"revoked on {known.revoked}" if known.revoked else "trusted already" if same else "another key"
            raise InputError(f"{folder / NAME}: key {known.name}: {told}")
    save(folder / NAME, file.model_copy(update={"keys": (*file.keys, entry)}))
    return entry


def trust_authority(folder: Path, name: str, certificate: str) -> None:
    """Enter a time-stamping authority. Raises InputError, ProfileError."""
    file = _file_of(folder)
    if any(known.name == name for known in file.authorities):
        raise InputError(f"{folder / NAME}: authority {name}: trusted already")
    entry = Authority(name=name, certificate=certificate)
    save(folder / NAME, file.model_copy(update={"authorities": (*file.authorities, entry)}))


def revoke_key(folder: Path, name: str, reason: str, *, retired: bool) -> TrustedKey:
    """Raises InputError, ProfileError."""
    trust = load_trust(folder / NAME)
    known = trust.named(name)
    if known is None:
        names = [key.name for key in trust.file.keys]
        raise InputError(f"{trust.path}: no key '{td.hints.clipped(name)}'{td.hints.nearest(name, names)}")
    if known.revoked is not None:
        raise InputError(f"{trust.path}: key {name}: revoked already, on {known.revoked}")
    revoked = known.model_copy(update={"revoked": now(), "reason": reason, "retired": retired})
    keys = tuple(revoked if key is known else key for key in trust.file.keys)
    save(trust.path, trust.file.model_copy(update={"keys": keys}))
    return revoked


def _file_of(folder: Path) -> TrustFile:
    path = folder / NAME
    return load_trust(path).file if path.exists() else TrustFile(format=FORMAT, since=now())


def _toml(value: object) -> str:
    """A TOML value: a JSON text is a basic string but for the character DEL."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")
