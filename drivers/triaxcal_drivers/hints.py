"""Hints in messages: the right name nearest to a wrong one, and which extra
brings a package that a bare install lacks."""

from __future__ import annotations

import difflib
import importlib.util
from collections.abc import Iterable
from itertools import islice

LONGEST = 64  # characters; comparing takes their square, and nobody misspells a longer name
MOST = 20_000  # names compared, a fifth of a second; a vehicle's DBC has not many more
SHOWN = 12


def closest(name: str, known: Iterable[str]) -> str | None:
    """Whatever the case of letters."""
    by_lower = {n.lower(): n for n in reversed(_compared(known))}
    close = difflib.get_close_matches(name.lower(), by_lower, n=1, cutoff=0.5) if len(name) <= LONGEST else []
    return by_lower[close[0]] if close else None


def nearest(name: str, known: Iterable[str]) -> str:
    """Empty where nothing is known."""
    names = _compared(known)
    close = closest(name, names)
    if close is not None:
        return f"; did you mean '{close}'?"
    return f"; known: {', '.join(names[:SHOWN])}" if names else ""


def _compared(known: Iterable[str]) -> list[str]:
    return sorted(set(islice((n for n in map(str, known) if len(n) <= LONGEST), MOST)))


def clipped(text: object, most: int = LONGEST) -> str:
    """A user's text, shortened for a message."""
    shown = str(text)
    return shown if len(shown) <= most else f"{shown[:most]}…"


EXTRAS = {
    "can": "can",
    "canopen": "can",
    "pymodbus": "modbus",
    "serial": "modbus",
    "msgpack": "station",
    "asammdf": "logs",
    "lz4": "logs",
    "fastapi": "serve",
    "uvicorn": "serve",
    "sse_starlette": "serve",
    "sqlalchemy": "serve",
    "alembic": "serve",
    "httpx": "serve",
    "argon2": "serve",
    "psycopg": "postgres",
    "dask": "fleet",
    "distributed": "fleet",
    "fsspec": "fleet",
    "s3fs": "fleet",
    "aiohttp": "fleet",
    "cryptography": "sign",
    "rfc3161_client": "sign",
    "pkcs11": "hsm",
}
"""Extra of each module, by import name."""
CALLED = {
    "can": "python-can",
    "serial": "pyserial",
    "sse_starlette": "sse-starlette",
    "argon2": "argon2-cffi",
    "rfc3161_client": "rfc3161-client",
    "pkcs11": "python-pkcs11",
}
"""Package names that differ from the import name."""


def absent(modules: Iterable[str]) -> str | None:
    """Hint about missing modules (import names); None if all are there."""
    missing = [m for m in modules if importlib.util.find_spec(m) is None]
    if not missing:
        return None
    ours = [m for m in missing if m in EXTRAS]
    extras = {EXTRAS[m] for m in ours}
    return _told((ours or missing)[0], extras.pop() if len(extras) == 1 else "station" if extras else None)


def lacking(e: ModuleNotFoundError) -> str | None:
    """Hint about a missing package; None if it is in no extra of ours."""
    module = (e.name or "").partition(".")[0]
    return _told(module, EXTRAS[module]) if module in EXTRAS else None


def _told(module: str, extra: str | None) -> str:
    brings = f"; pip install 'triaxcal[{extra}]' brings it" if extra else ""
    return f"the package {CALLED.get(module, module)} is not installed{brings}"
