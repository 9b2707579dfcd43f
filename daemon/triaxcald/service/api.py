"""The interface of the service under `/api/1`: the station, its tray and its events."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator, AsyncIterator, Awaitable, Callable, Mapping
from contextlib import suppress
from typing import Annotated, Any, Final, Protocol
from uuid import UUID

from fastapi import APIRouter, FastAPI, Header, Query, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, ConfigDict, Field
from sse_starlette import EventSourceResponse, ServerSentEvent
from starlette.exceptions import HTTPException

from triaxcald.errors import DaemonError
from triaxcald.schema.station_state import StationState
from triaxcald.service.desk import WORK
from triaxcald.service.errors import ApiError, Problem
from triaxcald.service.floor import Floor
from triaxcald.service.people import Role
from triaxcald.service.stream import Message, TooSlow

ALIVE_S: Final = 2.0
"""A listener that hears nothing for more than twice as long knows that the service is
gone."""
SEQ_MOST: Final = 2**63 - 1


class Who(Protocol):
    """Who asks: ``name``, the ``role``, and ``by`` what they are known: `cookie` of one
    who has signed in, `token` or `loopback`."""

    name: str
    role: str
    by: str


class Access(Protocol):
    """Who may do what, and the trail of what was done."""

    async def require(self, request: Request, role: str, *, touch: bool = True) -> Any:
        """Raises ApiError."""

    async def trail(
        self, who: Any, action: str, what: Mapping[str, Any], *, ok: bool = True, code: str | None = None
    ) -> None: ...


class Service(Protocol):
    """What the interface works with."""

    @property
    def floor(self) -> Floor: ...

    @property
    def access(self) -> Access: ...


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid")


class ScanBody(_Body):
    text: Annotated[str, Field(description="what the scanner has read")]


class TrayBody(_Body):
    slots: Annotated[dict[str, str | None], Field(description="serial number by slot; `null` empties the slot")] = (
        Field(default_factory=dict)
    )
    operator: str | None = None
    order: str | None = None
    batch: str | None = None
    part_number: str | None = None
    fixture: str | None = None
    reason: Annotated[str | None, Field(description="reason of a re-test")] = None


class StartBody(_Body):
    request: Annotated[UUID | None, Field(description="id of this request: the same starts once")] = None


class StopBody(_Body):
    reason: Annotated[str, Field(description="1 to 64 printable characters")] = "stopped"


class ErrorBody(BaseModel):
    """Why a request is refused."""

    code: Annotated[str, Field(description="reason for programs")]
    message: Annotated[str, Field(description="reason for people, one sentence")]


ERRORS: Final[dict[int | str, dict[str, Any]]] = {
    status: {"model": ErrorBody} for status in (400, 401, 403, 404, 409, 413, 429, 503)
}


def station_router(service: Service) -> APIRouter:
    """State, events and tray of the station."""
    router, floor, access = APIRouter(prefix="/api/1", responses=ERRORS), service.floor, service.access

    async def done(
        request: Request, role: str, action: str, what: Mapping[str, Any], work: Callable[[Any], Awaitable[Any]]
    ) -> JSONResponse:
        """Do the work for someone with the role, and leave a row in the trail."""
        who = await access.require(request, role)
        try:
            answer = await work(who)
        except ApiError as e:
            await access.trail(who, action, what, ok=False, code=e.problem.value)
            raise
        await access.trail(who, action, what)
        return JSONResponse(answer)

    async def state_after(work: Awaitable[Any]) -> dict[str, Any]:
        await work
        return floor.state(floor.stream.seq)

    @router.get("/station", response_model=StationState)
    async def station(request: Request) -> JSONResponse:
        await access.require(request, "reader")
        return JSONResponse(floor.state(floor.stream.seq))

    @router.get("/events", response_class=EventSourceResponse)
    async def events(
        request: Request,
        after: Annotated[int | None, Query(ge=0, le=SEQ_MOST, description="`seq` of the last event known")] = None,
        live: Annotated[bool, Query(description="also `live`: the present directions, for a picture")] = False,
        last_event_id: Annotated[str | None, Header(description="of a browser that comes again")] = None,
    ) -> EventSourceResponse:
        await access.require(request, "reader", touch=False)
        if after is None and last_event_id is not None and last_event_id.isascii() and last_event_id.isdigit():
            after = min(int(last_event_id[:19]), SEQ_MOST)
        # Its own sign of life is a comment, which a page cannot see: ours is an event.

        async def may_listen() -> None:
            await access.require(request, "reader", touch=False)

        messages = sent(floor.stream.listen(after), may_listen, live=live)
        return EventSourceResponse(messages, ping=3600, headers={"Cache-Control": "no-store"})

    @router.post("/scan")
    async def scan(request: Request, body: ScanBody) -> JSONResponse:
        return await done(
            request, "operator", "scan", {"text": body.text}, lambda who: floor.scan(body.text, person_of(who))
        )

    @router.put("/tray", response_model=StationState)
    async def put_tray(request: Request, body: TrayBody) -> JSONResponse:
        given: dict[str, Any] = body.model_dump(exclude_unset=True)
        work: dict[str, str | None] = {key: given[key] for key in WORK if key in given}
        return await done(request, "operator", "tray", given, lambda _: state_after(floor.put(body.slots, work)))

    @router.post("/tray/start")
    async def start(request: Request, body: StartBody) -> JSONResponse:
        wanted = None if body.request is None else str(body.request)
        return await done(
            request, "operator", "start", {"request": wanted}, lambda who: floor.start(wanted, person_of(who))
        )

    @router.post("/tray/stop")
    async def stop(request: Request, body: StopBody) -> JSONResponse:
        return await done(request, "operator", "stop", {"reason": body.reason}, lambda _: floor.stop(body.reason))

    @router.post("/tray/clear", response_model=StationState)
    async def clear(request: Request) -> JSONResponse:
        return await done(request, "operator", "clear", {}, lambda _: state_after(floor.clear()))

    @router.post("/slots/{slot}/stop")
    async def stop_slot(request: Request, slot: str, body: StopBody) -> JSONResponse:
        what = {"slot": slot, "reason": body.reason}
        return await done(request, "operator", "stop", what, lambda _: floor.stop_slot(slot, body.reason))

    return router


def person_of(who: Who) -> str | None:
    """The name of one who has signed in and may operate; None of programs, readers."""
    return who.name if who.by == "cookie" and who.role != Role.READER else None


async def sent(
    messages: AsyncGenerator[Message], may_listen: Callable[[], Awaitable[None]], *, live: bool = False
) -> AsyncIterator[ServerSentEvent]:
    """The messages as server-sent events, and a sign of life every `ALIVE_S`; those of
    the kind `live` if wanted. Ends once ``may_listen`` raises ApiError: the session or
    the token has ended."""
    loop = asyncio.get_running_loop()
    beat_s = loop.time() + ALIVE_S
    following: asyncio.Task[Message] = asyncio.ensure_future(anext(messages))
    try:
        while True:
            done, _ = await asyncio.wait([following], timeout=max(0.0, beat_s - loop.time()))
            if done:
                try:
                    message = following.result()
                except (TooSlow, StopAsyncIteration):
                    return
                if live or message.kind != "live":
                    yield _sent(message)
                following = asyncio.ensure_future(anext(messages))
            if loop.time() >= beat_s:
                beat_s = loop.time() + ALIVE_S
                try:
                    await may_listen()
                except ApiError:
                    return
                yield ServerSentEvent("{}", event="alive")
    finally:
        following.cancel()
        with suppress(asyncio.CancelledError, TooSlow, StopAsyncIteration):
            await following
        await messages.aclose()


def _sent(message: Message) -> ServerSentEvent:
    data = json.dumps(message.data, ensure_ascii=False, allow_nan=False)
    return ServerSentEvent(data, event=message.kind, id=None if message.seq is None else str(message.seq))


def answer_errors(app: FastAPI) -> None:
    """Every error is answered by `code` and `message`, those of the framework too."""

    async def ours(_: Request, e: Exception) -> JSONResponse:
        assert isinstance(e, ApiError)
        return JSONResponse(e.body, e.problem.status, headers=e.headers)

    async def invalid(_: Request, e: Exception) -> JSONResponse:
        assert isinstance(e, RequestValidationError)
        first = e.errors()[0]
        where = ".".join(str(part) for part in first["loc"] if part not in ("body", "query", "path"))
        error = ApiError(Problem.INVALID, f"{where or 'the request'}: {first['msg']}")
        return JSONResponse(error.body, error.problem.status)

    async def framework(_: Request, e: Exception) -> JSONResponse:
        assert isinstance(e, HTTPException)
        problem = Problem.UNKNOWN if e.status_code == 404 else Problem.INVALID
        return JSONResponse({"code": problem.value, "message": str(e.detail)}, e.status_code, headers=e.headers)

    async def database(_: Request, e: Exception) -> JSONResponse:
        error = ApiError(Problem.DATABASE, str(e))
        return JSONResponse(error.body, error.problem.status)

    app.add_exception_handler(ApiError, ours)
    app.add_exception_handler(DaemonError, database)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(HTTPException, framework)
