"""People and programs that may use the service: their roles, PINs, tokens and sessions
in the database. Everything here blocks."""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import UTC, datetime
from enum import StrEnum
from functools import cache
from typing import Any, Final, Protocol

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError
from sqlalchemy import Connection, delete, insert, select, update

from triaxcald import work
from triaxcald.errors import InputError
from triaxcald.service import tables

PIN_LEAST: Final = 4
PIN_MOST: Final = 64
LOOPBACK: Final = "loopback"
"""In place of the name of someone at this machine who is not signed in."""
IDLE_S: Final = 12 * 3600.0
"""A session ends when it was not used for so long."""
USE_S: Final = 60.0
"""The use of a session is noted no more often than this."""
TOKEN_PREFIX: Final = "triaxcal_"
"""By which programs that look for secrets in files know a token."""


class Role(StrEnum):
    """Each may do what those before it may."""

    READER = "reader"
    OPERATOR = "operator"
    ENGINEER = "engineer"

    def covers(self, other: Role) -> bool:
        return _RANK[self] >= _RANK[other]


_RANK: Final = {role: rank for rank, role in enumerate(Role)}


@dataclass(frozen=True)
class Person:
    """``pin`` is the hash of the PIN."""

    name: str
    role: Role
    pin: str
    disabled: bool


@dataclass(frozen=True)
class Token:
    name: str
    role: Role
    created: str
    revoked: bool


def require_name(name: str) -> None:
    """Raises InputError."""
    if fault := work.wrong(name):
        raise InputError(f"{name}: {fault}")
    if name != name.strip() or name == LOOPBACK:
        raise InputError(f"'{name}': expected a name other than {LOOPBACK}, without blanks around it")


def already(name: str) -> InputError:
    return InputError(f"there is a person '{name}' already; people role, pin or enable changes it")


def nobody(name: str) -> InputError:
    return InputError(f"there is no person '{name}'; triaxcal people list shows them")


def hashed(pin: str) -> str:
    """The hash of a PIN by argon2id, with its salt. Raises InputError."""
    if not PIN_LEAST <= len(pin) <= PIN_MOST:
        raise InputError(f"the PIN has {len(pin)} characters, expected {PIN_LEAST} to {PIN_MOST}")
    if not pin.isprintable():
        raise InputError("the PIN has characters that cannot be typed into a page")
    return PasswordHasher().hash(pin)


def is_right(pin_hash: str | None, pin: str) -> bool:
    """Whether ``pin`` is the one of the hash. It takes the same time without a hash."""
    try:
        PasswordHasher().verify(_of_nobody() if pin_hash is None else pin_hash, pin)
    except (VerificationError, InvalidHashError):
        return False
    return pin_hash is not None


@cache
def _of_nobody() -> str:
    return PasswordHasher().hash(secrets.token_hex(32))


def fingerprint(secret: str) -> str:
    """What is kept of a token or of a session's cookie: the SHA-256, in hexadecimal
    digits. They are random numbers of 256 bits, which nobody finds by trying."""
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).hexdigest()


class Book(Protocol):
    """The database: a transaction that writes, and one that reads. Both raise
    DatabaseError."""

    def writing(self) -> AbstractContextManager[Connection]: ...

    def reading(self) -> AbstractContextManager[Connection]: ...


class People:
    """People, tokens and sessions in a database. Other threads and processes may change
    them at the same time; each answer is of the present. All methods raise
    DatabaseError; those that change people or tokens InputError, with nothing
    changed."""

    def __init__(self, book: Book) -> None:
        self._book = book

    # People.

    def person(self, name: str) -> Person | None:
        with self._book.reading() as db:
            return _person(db, name)

    def everyone(self) -> list[Person]:
        """By name."""
        with self._book.reading() as db:
            rows = db.execute(select(tables.person).order_by(tables.person.c.name)).mappings()
            return [_person_of(row) for row in rows]

    def add(self, name: str, role: Role, pin: str) -> None:
        """``pin`` is hashed."""
        require_name(name)
        with self._book.writing() as db:
            if _person(db, name) is not None:
                raise already(name)
            db.execute(insert(tables.person).values(name=name, role=role, pin=pin, disabled=False, created=_now()))

    def set_pin(self, name: str, pin: str) -> None:
        """``pin`` is hashed. The person's sessions end."""
        self._change(name, end=True, pin=pin)

    def set_role(self, name: str, role: Role) -> None:
        self._change(name, end=False, role=role)

    def disable(self, name: str, disabled: bool) -> None:
        """The person's sessions end."""
        self._change(name, end=True, disabled=disabled)

    def _change(self, name: str, *, end: bool, **values: Any) -> None:
        with self._book.writing() as db:
            changed = db.execute(update(tables.person).where(tables.person.c.name == name).values(values))
            if not changed.rowcount:
                raise nobody(name)
            if end:
                db.execute(delete(tables.session).where(tables.session.c.person == name))

    # Tokens of programs.

    def new_token(self, name: str, role: Role) -> str:
        """The token; only its fingerprint is kept."""
        require_name(name)
        token = TOKEN_PREFIX + secrets.token_urlsafe(32)
        with self._book.writing() as db:
            if _token(db, name) is not None:
                raise InputError(f"there is a token '{name}' already; revoke it, or choose another name")
            db.execute(
                insert(tables.token).values(hash=fingerprint(token), name=name, role=role, created=_now(), revoked=None)
            )
        return token

    def token_of(self, token: str) -> Token | None:
        """The one that is not revoked."""
        with self._book.reading() as db:
            found = tables.token.c.hash == fingerprint(token)
            row = db.execute(select(tables.token).where(found)).mappings().first()
        known = None if row is None else _token_of(row)
        return None if known is None or known.revoked else known

    def tokens(self) -> list[Token]:
        """In the order of time."""
        with self._book.reading() as db:
            rows = db.execute(select(tables.token).order_by(tables.token.c.created, tables.token.c.name)).mappings()
            return [_token_of(row) for row in rows]

    def revoke(self, name: str) -> None:
        with self._book.writing() as db:
            if (token := _token(db, name)) is None:
                raise InputError(f"there is no token '{name}' that is not revoked; triaxcal token list shows them")
            db.execute(update(tables.token).where(tables.token.c.hash == token).values(revoked=_now()))

    # Sessions.

    def begin_session(self, person: Person, now_s: float) -> str | None:
        """The value of the cookie; only its fingerprint is kept. None if the person was
        changed meanwhile. Sessions that have ended are removed. ``now_s`` is in seconds
        since 1970."""
        value = secrets.token_urlsafe(32)
        with self._book.writing() as db:
            if _person(db, person.name) != person:
                return None
            db.execute(delete(tables.session).where(tables.session.c.used_s < now_s - IDLE_S))
            db.execute(insert(tables.session).values(hash=fingerprint(value), person=person.name, used_s=now_s))
        return value

    def signed_in(self, value: str, now_s: float, *, touch: bool) -> Person | None:
        """Whose session it is, if it has not ended. To ``touch`` it notes that it is
        used."""
        session = tables.session
        here = session.c.hash == fingerprint(value)
        with self._book.reading() as db:
            row = db.execute(select(session.c.person, session.c.used_s).where(here)).first()
            person = None if row is None else _person(db, row.person)
        if row is None:
            return None
        if person is None or person.disabled or now_s - row.used_s > IDLE_S:
            self.end_session(value)
            return None
        if touch and now_s - row.used_s >= USE_S:
            with self._book.writing() as db:
                db.execute(update(session).where(here, session.c.used_s < now_s).values(used_s=now_s))
        return person

    def end_session(self, value: str) -> Person | None:
        """Whose session it was."""
        here = tables.session.c.hash == fingerprint(value)
        with self._book.writing() as db:
            name = db.execute(select(tables.session.c.person).where(here)).scalar()
            db.execute(delete(tables.session).where(here))
            return None if name is None else _person(db, name)


def _person(db: Connection, name: str) -> Person | None:
    row = db.execute(select(tables.person).where(tables.person.c.name == name)).mappings().first()
    return None if row is None else _person_of(row)


def _person_of(row: Mapping[Any, Any]) -> Person:
    return Person(row["name"], Role(row["role"]), row["pin"], bool(row["disabled"]))


def _token(db: Connection, name: str) -> str | None:
    """Fingerprint of the token of that name that is not revoked."""
    token = tables.token.c
    found: str | None = db.execute(select(token.hash).where(token.name == name, token.revoked.is_(None))).scalar()
    return found


def _token_of(row: Mapping[Any, Any]) -> Token:
    return Token(row["name"], Role(row["role"]), row["created"], row["revoked"] is not None)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")
