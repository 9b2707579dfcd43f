"""What stands before the interface and the pages: the checks of every request, and the
connections on which requests come."""

from __future__ import annotations

import asyncio
import ipaddress
import json
import socket
import ssl
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Final

import h11
import uvicorn
from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from triaxcald.errors import InputError
from triaxcald.service.access import REQUEST, Access, RequestInfo
from triaxcald.service.errors import ApiError, Problem

BODY_MOST: Final = 64 << 10
"""Bytes of a body."""
FIRST_S: Final = 10.0
"""Time for a TLS handshake, for the head of a request, and for its body."""
CONNECTIONS_MOST: Final = 256
"""Connections at once. One more takes the place of the one that has waited longest
without a request: each holds a descriptor, which the recordings need."""
UNREAD_MOST: Final = 4 << 20
"""Bytes of a refused body that are dropped so that its sender can read the answer;
after more the connection ends."""
READING: Final = frozenset(("GET", "HEAD", "OPTIONS"))
"""Methods that change nothing; every other one writes."""
POLICY: Final = (
    "default-src 'self'; img-src 'self' data:; object-src 'none'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
"""No inline script or style, nothing from elsewhere, in nobody's frame. A response with
a policy of its own keeps it."""
HEADERS: Final = {
    "Content-Security-Policy": POLICY,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
}
API: Final = "/api/"
LOOPBACK_NAMES: Final = ("localhost", "127.0.0.1", "[::1]")
WILDCARDS: Final = frozenset(("", "0.0.0.0", "::"))
_BY_STATUS: Final = {401: Problem.NOT_SIGNED_IN, 403: Problem.ROLE, 404: Problem.UNKNOWN}


# Where the service may listen, and under which names.


def is_loopback_host(host: str) -> bool:
    """Whether a service that listens on ``host`` is reached from this machine alone."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host.lower() == "localhost"


def require_safe(host: str, cert: Path | None, key: Path | None) -> bool:
    """Whether the service speaks TLS. Raises InputError where it would be reached from
    other machines without, and where certificate and key are not a usable pair."""
    if (cert is None) != (key is None):
        raise InputError("--cert and --key: give both, or neither")
    if cert is None or key is None:
        if is_loopback_host(host):
            return False
        raise InputError(
            f"--host {host}: other machines can reach it, and PINs would cross the network in clear text: give "
            "--cert and --key, or listen on 127.0.0.1"
        )
    for option, path in (("--cert", cert), ("--key", key)):
        try:
            path.read_bytes()
        except OSError as e:
            raise InputError(f"{option}: {path}: {e.strerror}") from e
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(cert, key, password=_no_passphrase)
    except (ssl.SSLError, ValueError, OSError) as e:
        raise InputError(
            f"--cert {cert}, --key {key}: expected a certificate and its key in PEM, the key without a passphrase"
        ) from e
    return True


def _no_passphrase() -> str:
    """In place of a question at the terminal."""
    raise ValueError("the key has a passphrase")


def known_hosts(host: str, port: int, *, secure: bool, names: Iterable[str] = ()) -> frozenset[str]:
    """Values of the header Host under which the service answers: the names of the
    loopback, ``host``, the machine's own name, and further ``names``, each with the
    ``port``. Where it listens on all addresses, the address that a connection has
    reached is known too (`Gate`)."""
    own = [] if host in WILDCARDS else [f"[{host}]" if ":" in host and not host.startswith("[") else host]
    known = {name.lower() for name in (*LOOPBACK_NAMES, *own, socket.gethostname(), *names)}
    usual = port == (443 if secure else 80)
    return frozenset(f"{name}:{port}" for name in known) | (frozenset(known) if usual else frozenset())


# The checks of every request.


class Gate:
    """ASGI application around ``app``, the outermost one. It checks Host, path, Origin,
    Content-Type and the size of the body of each request, adds headers that protect
    pages to each response, and leaves a row in the trail for each refused request,
    whoever refuses it."""

    def __init__(self, app: ASGIApp, access: Access, *, first_s: float = FIRST_S) -> None:
        self._app, self._access, self._first_s = app, access, first_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1008})
            return
        request = RequestInfo(
            address=(scope.get("client") or ("",))[0], method=str(scope["method"]), path=str(scope["path"])
        )
        token = REQUEST.set(request)
        try:
            answered = partial(self._send, send, scope["path"], request, [])
            try:
                self._check(scope)
                whole = await _whole(receive, Headers(scope=scope), self._first_s)
            except ApiError as e:
                await _answer(answered, e)
                return
            if whole is not None:
                await self._app(scope, whole, answered)
        finally:
            REQUEST.reset(token)

    def _check(self, scope: Scope) -> None:
        """Raises ApiError."""
        headers = Headers(scope=scope)
        known = self._known(scope)
        if headers.get("host", "").lower() not in known:
            raise ApiError(Problem.ORIGIN, "the service has another name; see --host of triaxcal serve")
        if _leads_out(scope["path"]):
            raise ApiError(Problem.UNKNOWN, "there is no such page")
        if scope["method"] not in READING:
            self._check_origin(headers, known)
            # A page of another site may send a form, and JSON only if we allow it.
            if headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
                raise ApiError(Problem.INVALID, "expected a body in JSON with Content-Type: application/json")
        length = headers.get("content-length", "0")
        if not length.isdecimal() or int(length) > BODY_MOST:
            raise _too_large()

    def _known(self, scope: Scope) -> frozenset[str]:
        """An address is no name that a foreign domain could be made to mean: the one
        that the connection has reached is known."""
        host, port = scope.get("server") or ("", None)
        reached = f"[{host}]" if ":" in host else host
        return self._access.hosts | {f"{reached}:{port}"}

    def _check_origin(self, headers: Headers, known: frozenset[str]) -> None:
        """A browser says from which page it writes; other programs send neither
        header."""
        scheme = "https://" if self._access.secure else "http://"
        foreign = any(
            not origin.startswith(scheme) or origin.removeprefix(scheme).lower() not in known
            for origin in headers.getlist("origin")
        )
        if foreign or headers.get("sec-fetch-site", "none") == "cross-site":
            raise ApiError(Problem.ORIGIN, "the request comes from a page of another site")

    async def _send(self, send: Send, path: str, request: RequestInfo, held: list[Message], message: Message) -> None:
        """The head of a refusal is ``held`` until its body tells the code: whoever
        reads the answer finds the row in the trail."""
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in HEADERS.items():
                headers.setdefault(name, value)
            if path.startswith(API):
                headers.setdefault("Cache-Control", "no-store")
            if _is_refusal(request, message["status"]):
                held.append(message)
                return
        elif held:
            start = held.pop()
            await self._access.refused(request, _code_in(message.get("body", b""), start["status"]))
            await send(start)
        await send(message)


def _is_refusal(request: RequestInfo, status: int) -> bool:
    """What someone would read and is not there is no refusal, unless the path leads
    elsewhere; neither is a failure of the service."""
    if request.method not in READING or _leads_out(request.path or ""):
        return 400 <= status < 500 or status == 503
    return status in (401, 403, 413, 429)


def _code_in(body: bytes, status: int) -> str:
    try:
        return str(Problem(json.loads(body)["code"]))
    except (ValueError, KeyError, TypeError, RecursionError):
        return str(_BY_STATUS.get(status, Problem.INVALID))


def _leads_out(path: str) -> bool:
    """Whether a decoded path has parts that mean another folder, or characters that no
    path of ours has."""
    return not path.isprintable() or "\\" in path or any(part in (".", "..") for part in path.split("/"))


def _too_large() -> ApiError:
    return ApiError(Problem.TOO_LARGE, f"a body has at most {BODY_MOST >> 10} KiB")


async def _whole(receive: Receive, headers: Headers, most_s: float) -> Receive | None:
    """Take the whole body, so that its size is known and its sender cannot keep the
    application waiting. None if the sender has gone. Raises ApiError."""
    if "content-length" not in headers and "transfer-encoding" not in headers:
        return receive
    body = bytearray()
    try:
        async with asyncio.timeout(most_s):
            while True:
                message = await receive()
                if message["type"] == "http.disconnect":
                    return None
                body += message.get("body", b"")
                if len(body) > BODY_MOST:
                    raise _too_large()
                if not message.get("more_body", False):
                    break
    except TimeoutError:
        raise ApiError(Problem.INVALID, f"the body did not come within {most_s:g} s", {"Connection": "close"}) from None
    first: list[Message] = [{"type": "http.request", "body": bytes(body), "more_body": False}]

    async def again() -> Message:
        return first.pop() if first else await receive()

    return again


async def _answer(send: Callable[[Message], Any], error: ApiError) -> None:
    body = json.dumps(error.body).encode()
    headers = {"Content-Type": "application/json", "Content-Length": str(len(body)), **error.headers}
    raw = [(name.lower().encode(), value.encode()) for name, value in headers.items()]
    await send({"type": "http.response.start", "status": error.problem.status, "headers": raw})
    await send({"type": "http.response.body", "body": body})


# Connections.


class StationProtocol(H11Protocol):
    """HTTP/1.1 on one connection, which ends if the head of a request does not come
    within `FIRST_S`. uvicorn itself waits without end for the first request and for the
    rest of a begun one. Its limit on connections answers 503 to those who do send a
    request, and leaves the idle ones open."""

    access: ClassVar[Access]
    first_s: ClassVar[float] = FIRST_S

    _deadline: asyncio.TimerHandle | None = None
    _asked = False
    _unread = 0
    waits_since_s: float | None = None
    """Time of the loop since which no request is under way; None during one."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        super().connection_made(transport)
        self._wait()
        if len(self.connections) > CONNECTIONS_MOST:
            waiting = [c for c in self.connections if isinstance(c, StationProtocol) and c.waits_since_s is not None]
            longest = min(waiting, key=lambda c: c.waits_since_s or 0.0)  # this one at least
            longest.drop(Problem.TOO_MANY, f"there are {CONNECTIONS_MOST} connections")

    def connection_lost(self, exc: Exception | None) -> None:
        self._stop_waiting()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        if self.cycle is not None and self.cycle.response_complete and self.conn.their_state is h11.SEND_BODY:
            self._unread += len(data)
            if self._unread > UNREAD_MOST:
                self.transport.abort()
                return
        super().data_received(data)
        self._look()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        if not self.transport.is_closing():
            self._look()

    def _look(self) -> None:
        """Start or stop the clock."""
        if self.cycle is not None and not self.cycle.response_complete:
            self._asked, self._unread = True, 0
            self._stop_waiting()
        elif self.waits_since_s is None:
            self._wait()

    def _wait(self) -> None:
        self.waits_since_s = self.loop.time()
        self._deadline = self.loop.call_later(self.first_s, self._late)

    def _stop_waiting(self) -> None:
        self.waits_since_s = None
        if self._deadline is not None:
            self._deadline.cancel()
            self._deadline = None

    def _late(self) -> None:
        self.drop(Problem.INVALID, f"no request came within {self.first_s:g} s")

    def drop(self, problem: Problem, why: str) -> None:
        """End the connection at once; with a row in the trail if it has never brought a
        request."""
        self._stop_waiting()
        if not self._asked:
            self.access.refused_soon(RequestInfo(address=(self.client or ("",))[0]), problem, why)
        self.transport.abort()

    def send_400_response(self, msg: str) -> None:
        """What is no HTTP, as the head of a request or in the midst of its body."""
        if self.cycle is not None:  # whatever it would answer now comes too late
            self.cycle.disconnected = True
            self.cycle.message_event.set()
        if self.conn.our_state not in (h11.IDLE, h11.SEND_RESPONSE):  # in the midst of an answer
            self.transport.abort()
            return
        problem = ApiError(Problem.INVALID, msg)
        self.access.refused_soon(RequestInfo(address=(self.client or ("",))[0]), problem.problem, msg)
        body = json.dumps(problem.body).encode()
        headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode()),
                   (b"connection", b"close")]  # fmt: skip
        for event in (
            h11.Response(status_code=problem.problem.status, headers=headers, reason=b"Bad Request"),
            h11.Data(data=body),
            h11.EndOfMessage(),
        ):
            self.transport.write(self.conn.send(event) or b"")
        self.transport.close()


def configured(
    app: ASGIApp, access: Access, *, cert: Path | None = None, key: Path | None = None, first_s: float = FIRST_S
) -> uvicorn.Config:
    """How uvicorn serves ``app`` behind a `Gate`; it is for `StationServer`."""
    protocol = type("StationProtocol", (StationProtocol,), {"access": access, "first_s": first_s})
    return uvicorn.Config(
        Gate(app, access, first_s=first_s),
        http=protocol,
        loop="asyncio",
        ws="none",
        proxy_headers=False,  # else X-Forwarded-For would choose the address of the peer
        server_header=False,
        access_log=False,
        log_config=None,
        log_level="error",  # a request that is no HTTP is a warning, of which anybody could send millions
        timeout_graceful_shutdown=5,
        ssl_certfile=cert,
        ssl_keyfile=key,
    )


class StationServer(uvicorn.Server):
    """Gives a TLS handshake `FIRST_S` in place of asyncio's minute."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        if self.config.ssl is None:
            await super().startup(sockets)
            return
        loop: Any = asyncio.get_running_loop()
        loop.create_server = partial(loop.create_server, ssl_handshake_timeout=FIRST_S)
        try:
            await super().startup(sockets)
        finally:
            del loop.create_server
