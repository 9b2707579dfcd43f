"""Who may do what: sign-in by PIN, sessions, tokens of programs, roles, and the trail
of what was done and refused."""

from __future__ import annotations

import asyncio
import hashlib
import ipaddress
import json
import math
import time
from collections import Counter
from collections.abc import Callable, Coroutine, Mapping
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Annotated, Any, Final, Protocol

from fastapi import APIRouter, Request
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from starlette.requests import HTTPConnection

from triaxcald.errors import DaemonError
from triaxcald.service import people
from triaxcald.service.errors import ApiError, Problem
from triaxcald.service.people import LOOPBACK, People, Person, Role, is_right
from triaxcald.station.config import Station

TRIES_MOST: Final = 10
"""Wrong tries of a person, or from an address, before it is locked."""
LOCKED_S: Final = 60.0
REMEMBERED_S: Final = 600.0
"""A wrong try counts for so long."""
KEYS_MOST: Final = 4096
"""Names and addresses whose tries are remembered."""
HASHES_MOST: Final = 2
"""PINs compared at once. Each takes 64 MiB for a tenth of a second."""
HOUR_S: Final = 3600
REFUSALS_MOST: Final = 60
"""Refusals of an hour with rows of their own, for each code and address."""
REFUSALS_ALL_MOST: Final = 300
"""The same of all codes and addresses."""
SUMMARY_S: Final = 60.0
"""The others are counted. One row tells their number so long after the first of
them."""
TEXT_MOST: Final = 200
"""Characters of each text in a row of the trail."""


@dataclass(frozen=True)
class Who:
    """``by`` is `cookie`, `token` or `loopback`."""

    name: str
    role: Role
    by: str


@dataclass
class RequestInfo:
    """The request under way, for the trail: its sender's address, who that is as far as
    known, and whether its refusal is in the trail."""

    address: str
    method: str | None = None
    path: str | None = None
    who: Who | None = None
    person: str | None = None
    """The existing person as whom someone tries to sign in."""
    trailed: bool = False


REQUEST: ContextVar[RequestInfo | None] = ContextVar("triaxcal_request", default=None)


class Ledger(people.Book, Protocol):
    """What access asks of the ledger. ``trail`` blocks and raises DatabaseError."""

    def trail(
        self, time: str, who: str | None, role: str | None, action: str, what: Mapping[str, Any], ok: bool,
        code: str | None,
    ) -> None: ...  # fmt: skip


def is_loopback(address: str) -> bool:
    """Whether the peer of a connection is this machine."""
    try:
        ip = ipaddress.ip_address(address)
    except ValueError:
        return False
    return ((ip.ipv4_mapped if isinstance(ip, ipaddress.IPv6Address) else None) or ip).is_loopback


def network_of(address: str) -> str:
    """By which tries and refusals are counted: an IPv4 address, or the 64 leading bits
    of an IPv6 address, of which a computer may choose the others."""
    try:
        ip = ipaddress.ip_address(address)
    except ValueError:
        return address
    if isinstance(ip, ipaddress.IPv6Address):
        return str(ip.ipv4_mapped or ipaddress.ip_network((int(ip) >> 64 << 64, 64)))
    return str(ip)


# Wrong tries.


@dataclass
class _Tries:
    times_s: list[float] = field(default_factory=list)
    locked_until_s: float = 0.0


class Lockout:
    """Wrong tries by name or address. Ten of them lock it for a minute, whatever comes
    then, and begin to count anew. Times are those of one clock, in seconds."""

    def __init__(self) -> None:
        self._tries: dict[str, _Tries] = {}

    def begin(self, key: str, now_s: float) -> None:
        """Count a try as wrong before it is judged: of many at once no more than ten
        are. Raises ApiError where the key is locked."""
        tries = self._tries.pop(key, None) or _Tries()
        if tries.locked_until_s and now_s >= tries.locked_until_s:
            tries = _Tries()
        self._tries[key] = tries
        while len(self._tries) > KEYS_MOST:
            del self._tries[next(iter(self._tries))]  # the one that was tried longest ago
        if tries.locked_until_s:
            left_s = str(math.ceil(tries.locked_until_s - now_s))
            raise ApiError(Problem.TOO_MANY, f"{TRIES_MOST} wrong tries; wait {left_s} s", {"Retry-After": left_s})
        tries.times_s = [t for t in tries.times_s if now_s - t < REMEMBERED_S] + [now_s]
        if len(tries.times_s) >= TRIES_MOST:
            tries.locked_until_s = now_s + LOCKED_S

    def take_back(self, key: str) -> None:
        """The last try was right."""
        if tries := self._tries.get(key):
            tries.times_s = tries.times_s[:-1]
            tries.locked_until_s = 0.0

    def forget(self, key: str) -> None:
        """All tries of the key, after the right one."""
        self._tries.pop(key, None)


# Refusals.


class Refusals:
    """Which refusals get a row of their own, so that nobody fills the disk with them:
    of an hour the first `REFUSALS_MOST` of each code and network, and
    `REFUSALS_ALL_MOST` in all. ``now_s`` is in seconds since 1970."""

    def __init__(self) -> None:
        self._hour = -1
        self._rows: Counter[tuple[str, str]] = Counter()
        self.omitted: Counter[str] = Counter()
        """Those without a row, by code."""

    def has_row(self, code: str, network: str, now_s: float) -> bool:
        hour = int(now_s // HOUR_S)
        if hour != self._hour:
            self._hour = hour
            self._rows.clear()
        if self._rows[code, network] < REFUSALS_MOST and self._rows.total() < REFUSALS_ALL_MOST:
            self._rows[code, network] += 1
            return True
        self.omitted[code] += 1
        return False


class Access:
    """``hosts`` are the known values of the header Host (`gate.known_hosts`);
    ``secure`` says that the service speaks TLS. ``station`` is to be set again where
    the station file is read anew. ``clock`` gives seconds since 1970, ``ticks`` those
    of a clock that nobody sets. All methods are called in the event loop."""

    def __init__(
        self, ledger: Ledger, station: Station, *, secure: bool, hosts: frozenset[str],
        clock: Callable[[], float] = time.time, ticks: Callable[[], float] = time.monotonic,
        log: Callable[[str], None] = lambda _: None,
    ) -> None:  # fmt: skip
        self.station, self.secure, self.hosts = station, secure, hosts
        self._ledger, self._clock, self._ticks, self._log = ledger, clock, ticks, log
        self._people = People(ledger)
        self._names, self._networks = Lockout(), Lockout()
        self._hashing = asyncio.Semaphore(HASHES_MOST)
        self._refusals = Refusals()
        self._summary: asyncio.Task[None] | None = None
        self._soon: set[asyncio.Task[None]] = set()
        # Browsers send a cookie to all ports of a machine, which may have two stations.
        place = f"{station.file.name}\0{station.path.resolve()}"
        self.cookie = f"{'__Host-' if secure else ''}triaxcal-{hashlib.sha256(place.encode()).hexdigest()[:8]}"

    # Who asks.

    async def require(self, request: HTTPConnection, role: str, *, touch: bool = True) -> Who:
        """Who sends a request, if they have the ``role`` or a higher one. Without
        ``touch`` it does not count as use of a session: for what a page does by itself.
        Raises ApiError."""
        who = await self.who(request, touch=touch)
        if (info := REQUEST.get()) is not None:
            info.who = who
        if who is not None and who.role.covers(Role(role)):
            return who
        if who is None or who.by == LOOPBACK:
            raise ApiError(Problem.NOT_SIGNED_IN, f"sign in as {role}")
        raise ApiError(Problem.ROLE, f"{who.name} is {who.role}; this needs {role}")

    async def who(self, request: HTTPConnection, *, touch: bool = True) -> Who | None:
        """Who sends a request: by its token, else by the session of its cookie, else
        someone at this machine. Raises ApiError where there is a token and it is
        unknown or revoked."""
        if given := request.headers.getlist("authorization"):
            scheme, _, token = given[0].partition(" ")
            known = None
            if len(given) == 1 and scheme.lower() == "bearer":
                known = await self._ask(lambda: self._people.token_of(token.strip()))
            if known is None:
                raise ApiError(Problem.NOT_SIGNED_IN, "the token is unknown or revoked", {"WWW-Authenticate": "Bearer"})
            return Who(known.name, known.role, "token")
        if value := request.cookies.get(self.cookie):
            now_s = self._clock()
            if person := await self._ask(lambda: self._people.signed_in(value, now_s, touch=touch)):
                return Who(person.name, person.role, "cookie")
        if request.client is not None and is_loopback(request.client.host):
            opened = self.station.file.rules.open_loopback
            return Who(LOOPBACK, Role.OPERATOR if opened else Role.READER, LOOPBACK)
        return None

    async def sign_in(self, request: HTTPConnection, name: str, pin: str) -> tuple[Person, str]:
        """The person, and the value of the cookie of a new session; the one that the
        request belongs to ends. Raises ApiError."""
        network = network_of(request.client.host if request.client else "")
        self._networks.begin(network, self._ticks())
        self._names.begin(name, self._ticks())
        person = await self._ask(lambda: self._people.person(name))
        if person is not None and (info := REQUEST.get()) is not None:
            info.person = name
        async with self._hashing:  # also for nobody: how long it takes does not tell who there is
            right = await asyncio.to_thread(is_right, None if person is None else person.pin, pin)
        value = None
        if person is not None and right and not person.disabled:
            value = await self._ask(lambda: self._people.begin_session(person, self._clock()))
        if person is None or value is None:
            raise ApiError(Problem.NOT_SIGNED_IN, "name or PIN is wrong")
        self._names.forget(name)
        self._networks.take_back(network)
        await self.sign_out(request)
        await self.trail(Who(person.name, person.role, "cookie"), "sign_in", {})
        return person, value

    async def sign_out(self, request: HTTPConnection) -> None:
        """End the session of the request, if it has one."""
        if value := request.cookies.get(self.cookie):
            person = await self._ask(lambda: self._people.end_session(value))
            if person is not None:
                await self.trail(Who(person.name, person.role, "cookie"), "sign_out", {})

    async def _ask(self, question: Callable[[], Any]) -> Any:
        """Of the database, in a thread. Raises ApiError where it does not answer."""
        try:
            return await asyncio.to_thread(question)
        except DaemonError as e:
            raise ApiError(Problem.DATABASE, str(e)) from e

    # The trail.

    async def trail(
        self, who: Who | None, action: str, what: Mapping[str, Any], *, ok: bool = True, code: str | None = None
    ) -> None:
        """A row of the trail, with the address that the request came from. Raises
        ApiError where it cannot be written."""
        info = REQUEST.get()
        if not ok and info is not None:
            info.trailed = True
        if not ok and not self._has_row(str(code), info):
            return
        await self._ask(lambda: self._row(who, action, what, info, ok, code))

    async def refused(self, info: RequestInfo, code: str, why: str | None = None) -> None:
        """A row for a refused request or connection that has none yet."""
        if info.trailed:
            return
        info.trailed = True
        if not self._has_row(code, info):
            return
        action = "connection" if info.method is None else "request"
        what = {"method": info.method, "path": info.path, "name": info.person, "reason": why}
        given = {key: value for key, value in what.items() if value is not None}
        try:
            await self._ask(lambda: self._row(info.who, action, given, info, False, code))
        except ApiError as e:  # the refusal itself holds
            self._log(f"the trail cannot be written: {e.message}")

    def refused_soon(self, info: RequestInfo, problem: Problem, why: str) -> None:
        """The same from where nothing can be awaited."""
        self._later(self.refused(info, problem.value, why))

    async def close(self) -> None:
        """Write what waits for the trail."""
        if self._summary is not None:
            self._summary.cancel()
        await asyncio.gather(*self._soon)
        await self._tell_omitted()

    def _has_row(self, code: str, info: RequestInfo | None) -> bool:
        network = network_of(info.address) if info is not None else ""
        if self._refusals.has_row(code, network, self._clock()):
            return True
        if self._summary is None or self._summary.done():
            self._summary = asyncio.create_task(self._summarise())
        return False

    async def _summarise(self) -> None:
        await asyncio.sleep(SUMMARY_S)
        await self._tell_omitted()

    async def _tell_omitted(self) -> None:
        omitted, self._refusals.omitted = self._refusals.omitted, Counter()
        if not omitted:
            return
        what = {"omitted": dict(sorted(omitted.items()))}
        try:
            await self._ask(lambda: self._row(None, "refusals", what, None, False, None))
        except ApiError as e:
            self._refusals.omitted += omitted
            self._log(f"the trail cannot be written: {e.message}")

    def _row(
        self, who: Who | None, action: str, what: Mapping[str, Any], info: RequestInfo | None, ok: bool,
        code: str | None,
    ) -> None:  # fmt: skip
        details = {key: _short(value) for key, value in what.items()}
        if info is not None:
            details["address"] = info.address
        if who is not None:
            details["by"] = who.by
        now = datetime.fromtimestamp(self._clock(), UTC).isoformat(timespec="milliseconds")
        name, role = (None, None) if who is None else (who.name, str(who.role))
        self._ledger.trail(now, name, role, action, details, ok, code)

    def _later(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(work)
        self._soon.add(task)
        task.add_done_callback(self._soon.discard)


def _short(value: Any) -> Any:
    """With texts of at most `TEXT_MOST` characters, none a lone surrogate, and as many
    members of a list or an object."""
    match value:
        case str():
            value = value.encode("utf-8", "backslashreplace").decode()
            return value if len(value) <= TEXT_MOST else value[: TEXT_MOST - 1] + "…"
        case Mapping():
            return {str(_short(str(k))): _short(v) for k, v in list(value.items())[:TEXT_MOST]}
        case list() | tuple():
            return [_short(v) for v in value[:TEXT_MOST]]
        case _:
            return value


# Sign-in over the interface.

_SIGN_IN: Final = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": {
                    "type": "object",
                    "required": ["name", "pin"],
                    "properties": {"name": {"type": "string"}, "pin": {"type": "string", "format": "password"}},
                }
            }
        },
    }
}


class SessionDocument(BaseModel):
    """Who is signed in."""

    name: Annotated[str | None, Field(description="null of someone at this machine who is not signed in")]
    role: Role
    by: Annotated[str, Field(description="cookie, token or loopback")]


def session_router(access: Access) -> APIRouter:
    """`/api/1/session`."""
    router = APIRouter(prefix="/api/1")

    @router.post("/session", response_model=SessionDocument, openapi_extra=_SIGN_IN)
    async def sign_in(request: Request) -> JSONResponse:
        # By hand: a message of the framework about a wrong body would repeat the PIN.
        try:
            body = json.loads(await request.body())
        except (ValueError, RecursionError):
            body = None
        name, pin = (body.get("name"), body.get("pin")) if isinstance(body, dict) else (None, None)
        if not isinstance(name, str) or not isinstance(pin, str):
            raise ApiError(Problem.INVALID, "expected an object with the texts name and pin")
        if not name.isprintable() or not pin.isprintable():
            raise ApiError(Problem.INVALID, "name and pin: expected printable characters")
        person, value = await access.sign_in(request, name, pin)
        response = JSONResponse({"name": person.name, "role": person.role, "by": "cookie"})
        response.set_cookie(access.cookie, value, httponly=True, samesite="strict", secure=access.secure, path="/")
        return response

    @router.delete("/session")
    async def sign_out(request: Request) -> JSONResponse:
        await access.sign_out(request)
        response = JSONResponse({})
        response.delete_cookie(access.cookie, httponly=True, samesite="strict", secure=access.secure, path="/")
        return response

    @router.get("/session", response_model=SessionDocument)
    async def session(request: Request) -> JSONResponse:
        who = await access.require(request, Role.READER)
        return JSONResponse({"name": None if who.by == LOOPBACK else who.name, "role": who.role, "by": who.by})

    return router
