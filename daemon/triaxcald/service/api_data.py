"""The interface of the service under `/api/1`: runs with their files, units,
quality."""

from __future__ import annotations

import asyncio
import csv
import io
import os
import stat
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import date
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Protocol, TypeVar

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import FileResponse, JSONResponse, Response, StreamingResponse

from triaxcald.errors import InputError
from triaxcald.schema.codes import Code, Verdict
from triaxcald.schema.columns import NAMES
from triaxcald.schema.quality import Chart, Quality
from triaxcald.service.api import ERRORS, Access
from triaxcald.service.database import DatabaseError
from triaxcald.service.errors import ApiError, Problem
from triaxcald.service.ledger import Ledger, RunFilter
from triaxcald.service.quality import COLUMNS, UNITS, chart_of, quality_of
from triaxcald.store import microseconds

PAGE, PAGE_MOST = 50, 500
"""Runs in an answer."""
POINTS, POINTS_MOST = 500, 5000
"""Of a chart."""
BATCH: Final = 500
"""Rows of a table that are in memory at once."""
TEXT_MOST: Final = 256
DAY_US: Final = 86_400_000_000
ROWS: Final = (*COLUMNS, "at_us", "tried")
MEDIA: Final = {
    "outcome": "application/json", "certificate": "application/json", "report": "text/html; charset=utf-8",
    "recording": "application/octet-stream",
}  # fmt: skip
"""Media types of a run's files, by the column with their names."""
SANDBOX: Final = "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:; frame-ancestors 'self'"
"""Of a report: a page of its own, without scripts, links and cookies."""

T = TypeVar("T")


class DataService(Protocol):
    """What the routes work with."""

    @property
    def access(self) -> Access: ...

    @property
    def ledger(self) -> Ledger: ...


# What is asked for.


def moment_us(name: str, text: str, days: int = 0) -> int:
    """Microseconds since 1970 of a time in ISO 8601; of a date its first moment, or
    that of so many days later. Raises ApiError."""
    with suppress(ValueError):
        return (date.fromisoformat(text) - date(1970, 1, 1)).days * DAY_US + days * DAY_US
    # A plus that was not encoded comes as a blank.
    for written in (text, text.replace(" ", "+")):
        with suppress(ValueError, OverflowError):
            return microseconds(written)
    expected = "expected a date or a time as 2026-01-31 or 2026-01-31T12:00:00+01:00"
    raise ApiError(Problem.INVALID, f"{name}: {expected}, not '{text}'")


Text = Annotated[str | None, Query(max_length=TEXT_MOST)]


def chosen(
    serial: Annotated[str | None, Query(max_length=TEXT_MOST, description="expected or reported")] = None,
    order: Text = None,
    verdict: Annotated[Verdict | Literal[""] | None, Query()] = None,
    code: Annotated[Code | Literal[""] | None, Query()] = None,
    part_number: Text = None,
    fixture: Text = None,
    slot: Text = None,
    operator: Text = None,
    since: Annotated[
        str | None, Query(max_length=TEXT_MOST, description="runs that began then or later: ISO 8601, else UTC")
    ] = None,
    until: Annotated[
        str | None, Query(max_length=TEXT_MOST, description="runs that began before; of a date, its last day")
    ] = None,
) -> RunFilter:
    """The runs that a query asks for; what is empty does not matter. Raises
    ApiError."""
    texts = {
        "serial": serial, "order": order, "part_number": part_number, "fixture": fixture, "slot": slot,
        "operator": operator,
    }  # fmt: skip
    for name, text in texts.items():
        if text and not text.isprintable():
            raise ApiError(Problem.INVALID, f"{name}: expected printable characters alone")
    since_us = moment_us("since", since) if since else None
    until_us = moment_us("until", until, days=1) if until else None
    if since_us is not None and until_us is not None and since_us >= until_us:
        raise ApiError(Problem.INVALID, f"since: expected a time before {until}, not '{since}'")
    return RunFilter(
        **{name: text or None for name, text in texts.items()},
        verdict=verdict or None,
        code=code or None,
        since_us=since_us,
        until_us=until_us,
    )


Chosen = Annotated[RunFilter, Depends(chosen)]


async def answered(work: Callable[[], T], input_is: Problem = Problem.DATABASE) -> T:
    """What the database answers, from a thread. Raises ApiError, with ``input_is`` for
    an InputError: the database may also be of a later version."""
    try:
        return await asyncio.to_thread(work)
    except DatabaseError as e:
        raise ApiError(Problem.DATABASE, str(e)) from e
    except InputError as e:
        raise ApiError(input_is, str(e)) from e


# Routes.


def data_router(service: DataService) -> APIRouter:
    """Runs with their files, units, quality."""
    router, access = APIRouter(prefix="/api/1", responses=ERRORS), service.access
    computing = asyncio.Semaphore(1)
    """One such answer at a time leaves the threads to the tray."""

    async def run_of(request: Request, run: str) -> dict[str, Any]:
        await access.require(request, "reader")
        found = await answered(lambda: service.ledger.run_of(run)) if run.isprintable() else None
        if found is None:
            raise ApiError(Problem.UNKNOWN, f"there is no run {_told(run)}")
        return found

    async def computed(wanted: RunFilter, document: Callable[[list[dict[str, Any]], Ledger], T]) -> T:
        ledger = service.ledger
        async with computing:
            return await answered(lambda: document(ledger.columns(wanted, ROWS), ledger))

    @router.get("/runs")
    async def runs(
        request: Request,
        wanted: Chosen,
        limit: Annotated[int, Query(ge=1, le=PAGE_MOST)] = PAGE,
        after: Annotated[str | None, Query(max_length=4096, description="`next` of the answer before")] = None,
    ) -> JSONResponse:
        """The latest runs first, with the columns of `triaxcal results`."""
        await access.require(request, "reader")
        problem = Problem.INVALID if after else Problem.DATABASE
        found, following = await answered(lambda: service.ledger.runs(wanted, limit, after or None), problem)
        return JSONResponse({"runs": found, "next": following})

    @router.get("/runs.csv", response_class=Response)
    async def table(request: Request, wanted: Chosen) -> StreamingResponse:
        """All runs in the order of time, as `triaxcal results -o` writes them."""
        await access.require(request, "reader")
        batches = service.ledger.in_order(wanted, BATCH)
        first = await answered(lambda: next(batches, []))
        head = {"Content-Disposition": 'attachment; filename="runs.csv"'}
        return StreamingResponse(_csv(first, batches), media_type="text/csv; charset=utf-8", headers=head)

    @router.get("/runs/{run}")
    async def run(request: Request, run: str) -> JSONResponse:
        """A run with the columns of `triaxcal results`, its `measurements` and, as far
        as they are kept, its `events`."""
        row, ledger = await run_of(request, run), service.ledger
        more = await answered(lambda: {"measurements": ledger.measurements_of(run), "events": ledger.events_of(run)})
        return JSONResponse({**row, **more})

    @router.get("/runs/{run}/events")
    async def events(request: Request, run: str) -> JSONResponse:
        await run_of(request, run)
        return JSONResponse({"run": run, "events": await answered(lambda: service.ledger.events_of(run))})

    @router.get("/runs/{run}/{file}", response_class=Response)
    async def file(request: Request, run: str, file: str) -> FileResponse:
        """The outcome, certificate, report or recording."""
        row = await run_of(request, run)
        if file not in MEDIA:
            raise ApiError(Problem.UNKNOWN, f"expected {', '.join(MEDIA)} or events, not {_told(file)}")
        name = row[file]
        status = None if name is None else await asyncio.to_thread(_regular, service.ledger.folder, name)
        if status is None:
            raise ApiError(Problem.UNKNOWN, f"the folder has no {file} of run {run}")
        download = file == "recording"
        return FileResponse(
            service.ledger.folder / name, media_type=MEDIA[file], filename=name, stat_result=status,
            content_disposition_type="attachment" if download else "inline",
            headers={"Content-Security-Policy": SANDBOX} if file == "report" else None,
        )  # fmt: skip

    @router.get("/units/{serial:path}")
    async def unit(request: Request, serial: str) -> JSONResponse:
        """All runs of a unit, in the order of time."""
        await access.require(request, "reader")
        found = await answered(lambda: service.ledger.unit(serial)) if serial.isprintable() else []
        if not found:
            raise ApiError(Problem.UNKNOWN, f"there is no unit {_told(serial)}")
        return JSONResponse({"serial": serial, "runs": found})

    @router.get("/quality", response_model=Quality)
    async def quality(request: Request, wanted: Chosen) -> JSONResponse:
        await access.require(request, "reader")
        return JSONResponse(await computed(wanted, lambda rows, ledger: quality_of(rows, ledger.first_judged())))

    @router.get("/charts", response_model=Chart)
    async def chart(
        request: Request,
        wanted: Chosen,
        name: Annotated[str, Query(max_length=TEXT_MOST, description="of a characteristic of `/quality`")],
        points: Annotated[int, Query(ge=1, le=POINTS_MOST, description="the last ones")] = POINTS,
    ) -> JSONResponse:
        """Individuals and moving ranges of a characteristic."""
        await access.require(request, "reader")
        if name not in UNITS:
            raise ApiError(Problem.UNKNOWN, f"name: expected one of {', '.join(UNITS)}, not {_told(name)}")
        return JSONResponse(await computed(wanted, lambda rows, _: chart_of(rows, name, points)))

    return router


def _told(text: str) -> str:
    """As a message repeats it."""
    shown = "".join(c if c.isprintable() else "\ufffd" for c in text[:64])
    return f"'{shown}{'…' if len(text) > 64 else ''}'"


def _regular(folder: Path, name: str) -> os.stat_result | None:
    """The status of a file in the folder itself; None where there is none: an outcome
    may name what it likes."""
    if name != Path(name).name or name in ("", ".", ".."):
        return None
    try:
        status = os.stat(folder / name)
    except (OSError, ValueError):
        return None
    return status if stat.S_ISREG(status.st_mode) else None


async def _csv(first: Sequence[Mapping[str, Any]], others: Iterator[Sequence[Mapping[str, Any]]]) -> AsyncIterator[str]:
    """As `triaxcal results` writes it; an error on the way cuts the answer short."""
    yield _lines([NAMES])
    rows = first
    while rows:
        cells = [[row[name] for name in NAMES] for row in rows]
        yield await asyncio.to_thread(_lines, cells)
        rows = await asyncio.to_thread(next, others, [])


def _lines(rows: Sequence[Sequence[Any]]) -> str:
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerows(["; ".join(cell) if isinstance(cell, list) else cell for cell in row] for row in rows)
    return text.getvalue()
