"""The interface of the service under `/api/1`: runs, units, quality."""

from __future__ import annotations

import asyncio
import csv
import io
from collections.abc import AsyncIterator
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Final, Protocol

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import FileResponse, JSONResponse, Response, StreamingResponse

from triaxcald.errors import InputError
from triaxcald.schema.codes import Code, Verdict
from triaxcald.schema.columns import NAMES
from triaxcald.schema.quality import Quality
from triaxcald.service.api import ERRORS, Access
from triaxcald.service.errors import ApiError, Problem
from triaxcald.service.ledger import Ledger, RunFilter
from triaxcald.service.quality import quality_of
from triaxcald.store import microseconds

PAGE_MOST: Final = 500
PAPERS: Final = {
    "outcome": "application/json", "certificate": "application/json", "report": "text/html; charset=utf-8",
    "recording": "application/octet-stream",
}  # fmt: skip
"""Files of a run, by the column that has their names."""
SANDBOX: Final = "sandbox allow-popups; default-src 'none'; img-src data:; style-src 'unsafe-inline'"
"""For a report: a page on its own, without scripts."""
CSV_ROWS: Final = 500


class DataService(Protocol):
    @property
    def access(self) -> Access: ...

    @property
    def ledger(self) -> Ledger: ...


def _time(name: str, text: str | None) -> int | None:
    """Microseconds since 1970 of a time in ISO 8601. Raises ApiError."""
    if text is None:
        return None
    try:
        datetime.fromisoformat(text)
        return microseconds(text)
    except (ValueError, OverflowError) as e:
        example = "2026-01-31 or 2026-01-31T12:00:00+00:00"
        raise ApiError(Problem.INVALID, f"{name}: expected a time as {example}, not '{text}'") from e


Text = Annotated[str | None, Query(max_length=64)]


def chosen(
    serial: Text = None,
    order: Text = None,
    verdict: Verdict | None = None,
    code: Code | None = None,
    part_number: Text = None,
    fixture: Text = None,
    slot: Text = None,
    operator: Text = None,
    since: Annotated[str | None, Query(description="ISO 8601, UTC where it has no offset")] = None,
    until: Annotated[str | None, Query(description="before this time")] = None,
) -> RunFilter:
    """The runs that a query asks for. Empty texts do not matter. Raises ApiError."""
    return RunFilter(
        serial or None, order or None, verdict, code, part_number or None, fixture or None, slot or None,
        operator or None, _time("since", since or None), _time("until", until or None),
    )  # fmt: skip


Chosen = Annotated[RunFilter, Depends(chosen)]


def data_router(service: DataService) -> APIRouter:
    """Runs, units and quality."""
    router, ledger, access = APIRouter(prefix="/api/1", responses=ERRORS), service.ledger, service.access

    async def run_of(request: Request, run: str) -> dict[str, Any]:
        await access.require(request, "reader")
        if (row := await asyncio.to_thread(ledger.run_of, run)) is None:
            raise ApiError(Problem.UNKNOWN, f"there is no run '{run}'")
        return row

    @router.get("/runs")
    async def runs(
        request: Request,
        wanted: Chosen,
        limit: Annotated[int, Query(ge=1, le=PAGE_MOST)] = 50,
        after: Annotated[str | None, Query(description="`next` of the page before")] = None,
    ) -> JSONResponse:
        await access.require(request, "reader")
        try:
            found, following = await asyncio.to_thread(ledger.runs, wanted, limit, after or None)
        except InputError as e:
            raise ApiError(Problem.INVALID, str(e)) from e
        return JSONResponse({"runs": found, "next": following})

    @router.get("/runs.csv")
    async def table(request: Request, wanted: Chosen) -> StreamingResponse:
        await access.require(request, "reader")
        found = await asyncio.to_thread(ledger.every, wanted)
        head = {"Content-Disposition": 'attachment; filename="runs.csv"'}
        return StreamingResponse(_csv(found), media_type="text/csv; charset=utf-8", headers=head)

    @router.get("/runs/{run}")
    async def run(request: Request, run: str) -> JSONResponse:
        row = await run_of(request, run)
        measured = await asyncio.to_thread(ledger.measurements_of, run)
        return JSONResponse({**row, "measurements": measured, "events": await asyncio.to_thread(ledger.events_of, run)})

    @router.get("/runs/{run}/{paper}")
    async def paper(request: Request, run: str, paper: str) -> Response:
        row = await run_of(request, run)
        if paper not in PAPERS:
            raise ApiError(Problem.UNKNOWN, f"a run has {', '.join(PAPERS)}, no '{paper}'")
        name = row[paper]
        path = None if name is None else ledger.folder / Path(name).name
        if path is None or not await asyncio.to_thread(path.is_file):
            raise ApiError(Problem.UNKNOWN, f"run '{run}' has no {paper}")
        head = {"Content-Security-Policy": SANDBOX} if paper == "report" else {}
        shown = paper in ("report", "outcome")
        return FileResponse(
            path, media_type=PAPERS[paper], headers=head, filename=path.name,
            content_disposition_type="inline" if shown else "attachment",
        )  # fmt: skip

    @router.get("/units/{serial:path}")
    async def unit(request: Request, serial: str) -> JSONResponse:
        await access.require(request, "reader")
        found = await asyncio.to_thread(ledger.unit, serial)
        if not found:
            raise ApiError(Problem.UNKNOWN, f"there is no unit '{serial}'")
        return JSONResponse({"serial": serial, "runs": found})

    @router.get("/quality", response_model=Quality)
    async def quality(request: Request, wanted: Chosen) -> JSONResponse:
        await access.require(request, "reader")
        return JSONResponse(await asyncio.to_thread(lambda: quality_of(ledger.every(wanted))))

    return router


async def _csv(rows: list[dict[str, Any]]) -> AsyncIterator[str]:
    """The columns of `triaxcal results`, some rows at a time."""
    for start in range(0, max(1, len(rows)), CSV_ROWS):
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        if start == 0:
            writer.writerow(NAMES)
        for row in rows[start : start + CSV_ROWS]:
            writer.writerow(["; ".join(v) if isinstance(v, list) else v for v in (row[name] for name in NAMES)])
        yield text.getvalue()
