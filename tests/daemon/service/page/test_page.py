"""The pages as they are sent: language, appearance, files, and who may see them."""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.daemon.service.page.results import written
from tests.daemon.service.page.stage import Stage, station_file
from triaxcald.service.page import FOLDER, LANGUAGES, local, preferred, static_files, words

RECORDINGS = Path(__file__).parents[4] / "recordings"


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    stage = Stage(station_file(tmp_path_factory.mktemp("station"), name='<Line> & "3"'))
    stage.begin()
    yield stage
    stage.end()


@pytest.fixture
def client(stage: Stage) -> Iterator[httpx.Client]:
    with httpx.Client(base_url=stage.url) as client:
        yield client


@pytest.mark.parametrize(
    ("accepted", "language"),
    [
        ("", "en"), ("de", "de"), ("de-AT,de;q=0.9,en;q=0.8", "de"), ("uk-UA", "uk"), ("fr-FR,fr;q=0.9", "en"),
        ("en;q=0.5, uk;q=0.7", "uk"), ("de;q=0, en;q=0.1", "en"), ("de;q=x, uk;q=0.3", "uk"), ("*", "en"),
    ],
)  # fmt: skip
def test_a_page_is_in_the_language_that_the_browser_prefers(accepted: str, language: str) -> None:
    assert preferred(accepted) == language


@pytest.mark.parametrize("language", LANGUAGES)
def test_language_and_appearance_stay_as_chosen(client: httpx.Client, language: str) -> None:
    asked = client.get("/runs", params={"lang": language, "theme": "dark"}, headers={"Accept-Language": "uk"})
    assert {cookie.name for cookie in client.cookies.jar} == {"lang", "theme"}
    assert all(re.search("httponly.*samesite=strict", c, re.IGNORECASE) for c in asked.headers.get_list("set-cookie"))
    again = client.get("/quality", headers={"Accept-Language": "de"})
    assert f'<html lang="{language}" data-theme="dark">' in again.text
    assert html.escape(words(language)["quality.title"]) in again.text


def test_an_unknown_language_or_appearance_is_not_taken(client: httpx.Client) -> None:
    answer = client.get("/", params={"lang": "xx", "theme": '"><script>'})
    assert '<html lang="en" data-theme="auto">' in answer.text
    assert "set-cookie" not in answer.headers


@pytest.mark.parametrize("path", ["/", "/runs", "/runs/x", "/units/SN%201", "/quality", "/sign-in"])
def test_a_page_has_no_script_or_style_of_its_own(client: httpx.Client, path: str) -> None:
    answer = client.get(path)
    assert answer.status_code == 200
    assert answer.headers["content-security-policy"].startswith("default-src 'self'")
    assert "unsafe" not in answer.headers["content-security-policy"]
    assert re.findall(r"<script(?![^>]* src=\"/static/)", answer.text) == []
    assert re.findall(r"<style| style=| on[a-z]+=", answer.text) == []
    assert re.findall(r"(?:src|href)=\"(?!/|\?|#)", answer.text) == []


def test_names_of_the_station_are_text(client: httpx.Client) -> None:
    page = client.get("/units/%3Cscript%3Ealert(1)%3C%2Fscript%3E").text
    assert "<Line>" not in page
    assert "<script>alert" not in page
    data = re.search(r'data-page="([^"]*)"', page)
    assert data is not None
    given = json.loads(html.unescape(data[1]))
    assert given["station"] == '<Line> & "3"'
    assert given["serial"] == "<script>alert(1)</script>"


def test_every_file_that_pages_and_scripts_name_is_there(client: httpx.Client) -> None:
    sources = [*(FOLDER / "templates").glob("*.html"), *(FOLDER / "static").glob("*.js")]
    named = {
        name
        for source in sources
        for name in re.findall(r"(?:/static/|from \"\./)([a-z_]+\.[a-z]+)", source.read_text(encoding="utf-8"))
    }
    pages = {"station", "runs", "run", "unit", "quality", "sign_in"}
    assert named | {f"{page}.js" for page in pages} == set(static_files())
    for name in static_files():
        answer = client.get(f"/static/{name}")
        assert answer.status_code == 200
        assert answer.headers["cache-control"] == "no-cache"
        assert client.get(f"/static/{name}", headers={"If-None-Match": answer.headers["etag"]}).status_code == 304


@pytest.mark.parametrize("path", ["nothing.js", "..%2fwords.toml", "%2e%2e/words.toml", "page.css%00"])
def test_nothing_else_can_be_had(client: httpx.Client, path: str) -> None:
    answer = client.get(f"/static/{path}")
    assert answer.status_code == 404
    assert answer.json()["code"] == "unknown"


def test_who_may_not_read_is_led_to_the_sign_in_and_back(stage: Stage) -> None:
    """Someone at another machine, who has not signed in."""

    async def asked(path: str) -> httpx.Response:
        transport = httpx.ASGITransport(stage.app, client=("192.0.2.7", 40000))
        async with httpx.AsyncClient(transport=transport, base_url=stage.url) as client:
            return await client.get(path)

    answer = stage.do(lambda: asked("/runs?order=A%26B"))
    assert answer.status_code == 303
    assert answer.headers["location"] == "/sign-in?next=%2Fruns%3Forder%3DA%2526B"
    assert stage.do(lambda: asked("/runs/x/trace")).status_code == 401
    page = stage.do(lambda: asked(answer.headers["location"]))
    assert page.status_code == 200
    assert "/runs?order=A%26B" in page.text


@pytest.mark.parametrize(
    ("address", "kept"),
    [
        ("/runs?x=1", "/runs?x=1"), ("https://evil.example", "/"), ("//evil.example", "/"), ("/\\evil.example", "/"),
        ("/a\\b", "/"), ("javascript:alert(1)", "/"), ("/\t/evil.example", "/"), ("", "/"),
    ],
)  # fmt: skip
def test_the_way_back_stays_in_this_service(address: str, kept: str) -> None:
    assert local(address) == kept


def test_a_trace_has_the_readings_and_their_poses(stage: Stage, client: httpx.Client) -> None:
    folder = stage.station.parent / "out"
    with_recording, without = (outcome["run"] for outcome in written(folder)[:2])
    (folder / "run-000.mcap").write_bytes((RECORDINGS / "can-second-order.mcap").read_bytes())
    stage.ledger.take()
    trace = client.get(f"/runs/{with_recording}/trace", timeout=180).json()
    assert trace["unit"] == "V"
    assert len(trace["poses"]) == 27
    assert len(trace["t_s"]) <= 1500
    assert [len(axis) for axis in trace["readings"]] == [len(trace["t_s"])] * 3
    assert trace["t_s"] == sorted(trace["t_s"])
    assert 2.0 < max(trace["readings"][0]) < 3.0
    for missing in (without, "unknown"):
        assert client.get(f"/runs/{missing}/trace").status_code == 404
