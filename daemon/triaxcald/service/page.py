"""The pages of the station for people: templates filled with words in their language.
All that a page shows of the station comes from the interface under `/api/1`."""

from __future__ import annotations

import asyncio
import json
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, Final, Protocol
from urllib.parse import urlencode

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, JSONResponse, RedirectResponse, Response
from jinja2 import Environment, FileSystemLoader, StrictUndefined

from triaxcald.errors import DaemonError
from triaxcald.inputs import measure
from triaxcald.schema.codes import Code, Stage, Verdict
from triaxcald.service.api import Access, person_of
from triaxcald.service.errors import ApiError, Problem
from triaxcald.station.config import Station

FOLDER: Final = Path(__file__).with_name("page")
LANGUAGES: Final = ("en", "de", "uk")
THEMES: Final = ("auto", "light", "dark")
REMEMBERED_S: Final = 365 * 24 * 3600
"""How long a browser keeps language and appearance."""
POLICY: Final = (
    "default-src 'self'; img-src 'self' data:; object-src 'none'; base-uri 'none'; form-action 'self'; "
    "frame-ancestors 'none'"
)
"""No inline script or style, nothing from elsewhere."""
TYPES: Final = {
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
}
PAGES: Final = (("station", "/"), ("runs", "/runs"), ("quality", "/quality"))
"""In the head of every page."""


class Ledger(Protocol):
    def run_of(self, run_id: str, /) -> dict[str, Any] | None:
        """A row of `triaxcal.results/1`. Blocks, raises DaemonError."""


class Service(Protocol):
    """What the pages need of the service."""

    @property
    def station(self) -> Station: ...

    @property
    def access(self) -> Access: ...

    @property
    def ledger(self) -> Ledger: ...


@cache
def words(language: str) -> dict[str, str]:
    """Every text of the pages in the language, by `table.entry`."""
    tables = tomllib.loads((FOLDER / "words.toml").read_text(encoding="utf-8"))
    return {f"{table}.{entry}": text[language] for table, texts in tables.items() for entry, text in texts.items()}


@dataclass(frozen=True)
class Chosen:
    """Language and appearance of a page."""

    language: str
    theme: str

    @classmethod
    def of(cls, request: Request) -> Chosen:
        """As in the address, else as this browser has chosen before, else as it
        prefers."""
        asked, kept = request.query_params, request.cookies
        language = next((of.get("lang") for of in (asked, kept) if of.get("lang") in LANGUAGES), None)
        theme = next((of.get("theme") for of in (asked, kept) if of.get("theme") in THEMES), None)
        return cls(language or preferred(request.headers.get("accept-language", "")), theme or "auto")


def preferred(accepted: str) -> str:
    """The language of ours that the header `Accept-Language` ranks highest; English
    where it names none."""
    best, ranked = "en", 0.0
    for part in accepted.split(","):
        tag, _, parameter = part.strip().partition(";")
        name = tag.strip().lower().partition("-")[0]
        try:
            rank = float(parameter.strip().removeprefix("q=")) if parameter else 1.0
        except ValueError:
            continue
        if name in LANGUAGES and rank > ranked:
            best, ranked = name, rank
    return best


@dataclass(frozen=True)
class Static:
    """A file that belongs to the pages."""

    content: bytes
    media_type: str
    tag: str


@cache
def static_files() -> Mapping[str, Static]:
    """By name: nothing else can be asked for."""
    found = {}
    for path in sorted((FOLDER / "static").iterdir()):
        if path.suffix in TYPES:
            content = path.read_bytes()
            found[path.name] = Static(content, TYPES[path.suffix], f'"{sha256(content).hexdigest()[:20]}"')
    return found


@cache
def _templates() -> Environment:
    return Environment(
        loader=FileSystemLoader(FOLDER / "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def _rendered(
    service: Service, request: Request, name: str, *, who: Any = None, status: int = 200, **given: Any
) -> Response:
    """The template as a page; it keeps a language or appearance that the address
    asks for."""
    chosen, file = Chosen.of(request), service.station.file
    texts = words(chosen.language)
    query = {key: value for key, value in request.query_params.items() if key not in ("lang", "theme")}

    def here(**changed: str) -> str:
        return f"{request.url.path}?{urlencode(query | changed)}"

    data = {
        "language": chosen.language,
        "words": texts,
        "station": file.name,
        "slots": [unit.name for unit in file.units],
        "faces": file.fixture.names,
        "together": file.fixture.together,
        "operator": file.rules.operator,
        "person": None if who is None else person_of(who),
        "golden": None if file.rules.golden is None else file.rules.golden.serial,
        **given,
    }
    page = _templates().get_template(f"{name}.html").render(
        t=texts.__getitem__, words=words, name=name, chosen=chosen, languages=LANGUAGES, themes=THEMES, pages=PAGES,
        station=file.name, slots=data["slots"], who=who, here=here, codes=[code.value for code in Code],
        verdicts=[verdict.value for verdict in Verdict], stages=[stage.value for stage in Stage], given=given,
        data=json.dumps(data, ensure_ascii=False),
    )  # fmt: skip
    answer = HTMLResponse(page, status, headers={"Content-Security-Policy": POLICY, "Cache-Control": "no-store"})
    for key, value in (("lang", chosen.language), ("theme", chosen.theme)):
        if request.query_params.get(key) == value:
            answer.set_cookie(key, value, max_age=REMEMBERED_S, samesite="strict", httponly=True)
    return answer


def page_router(service: Service) -> APIRouter:
    """The pages, their files, and the thinned readings of a recording as a picture
    needs them. Pages are for readers: whoever is none is led to the sign-in."""
    router = APIRouter(include_in_schema=False, default_response_class=HTMLResponse)
    drawing = asyncio.Semaphore(1)
    """One recording at a time leaves memory and threads to the tray."""

    async def shown(request: Request, name: str, **given: Any) -> Response:
        try:
            who = await service.access.require(request, "reader")
        except ApiError as e:
            if e.problem is not Problem.NOT_SIGNED_IN:
                raise
            asked = request.url.path + (f"?{request.url.query}" if request.url.query else "")
            return RedirectResponse(
                f"/sign-in?{urlencode({'next': asked})}", 303, headers={"Cache-Control": "no-store"}
            )
        return _rendered(service, request, name, who=who, **given)

    @router.get("/")
    async def station(request: Request) -> Response:
        return await shown(request, "station")

    @router.get("/runs")
    async def runs(request: Request) -> Response:
        return await shown(request, "runs")

    @router.get("/runs/{run}")
    async def run(request: Request, run: str) -> Response:
        return await shown(request, "run", run=run)

    @router.get("/runs/{run}/trace")
    async def trace(request: Request, run: str) -> Response:
        await service.access.require(request, "reader")
        row = await asyncio.to_thread(service.ledger.run_of, run)
        name = None if row is None else row.get("recording")
        if name is None:
            raise ApiError(Problem.UNKNOWN, f"run {run} has no recording")
        async with drawing:
            return JSONResponse(await asyncio.to_thread(trace_of, service.station.folder / Path(name).name))

    @router.get("/units/{serial:path}")
    async def unit(request: Request, serial: str) -> Response:
        return await shown(request, "unit", serial=serial)

    @router.get("/quality")
    async def quality(request: Request) -> Response:
        return await shown(request, "quality")

    @router.get("/sign-in")
    async def sign_in(request: Request) -> Response:
        return _rendered(service, request, "sign_in", next=local(request.query_params.get("next", "/")))

    @router.get("/static/{name}")
    async def static(request: Request, name: str) -> Response:
        if (file := static_files().get(name)) is None:
            raise ApiError(Problem.UNKNOWN, f"no file '{name}'")
        # Asked for anew each time, and sent only if the software has changed.
        head = {"ETag": file.tag, "Cache-Control": "no-cache", "X-Content-Type-Options": "nosniff"}
        if request.headers.get("if-none-match") == file.tag:
            return Response(status_code=304, headers=head)
        return Response(file.content, media_type=file.media_type, headers=head)

    return router


def local(address: str) -> str:
    """The address if it is one of this service, else that of the first page."""
    ours = address.startswith("/") and not address.startswith(("//", "/\\")) and address.isprintable()
    return address if ours and "\\" not in address else "/"


TRACE_POINTS: Final = 1500


def trace_of(recording: Path) -> dict[str, Any]:
    """Thinned readings of a recording, for a picture: `t_s` (n,), `readings` three
    lists (n,) in `unit`, `poses` [start, end] in s. Blocks; raises ApiError if there
    is nothing to draw."""
    from triaxcald.report.charts import overview_of, thin  # matplotlib is slow to load

    if not recording.is_file():
        raise ApiError(Problem.UNKNOWN, f"{recording.name} is not in the folder")
    try:
        measured = measure(str(recording))
    except DaemonError as e:
        raise ApiError(Problem.UNKNOWN, f"{recording.name} cannot be drawn: {e}") from e
    unit = measured.output_unit if measured.profile is None else measured.profile.output.unit
    overview = overview_of(measured.windows, measured.poses, unit)
    if overview is None:
        raise ApiError(Problem.UNKNOWN, f"{recording.name} holds no readings")
    time_s, readings = thin(overview.time_s, overview.readings, TRACE_POINTS)
    return {
        "t_s": [round(float(t), 3) for t in time_s],
        "readings": [[float(f"{v:.6g}") for v in readings[:, i]] for i in range(3)],
        "unit": unit,
        "poses": [[round(start, 3), round(end, 3)] for start, end in overview.spans],
    }
