"""Runs, their files, units and quality over HTTP, from a real ledger behind the real access control."""

from __future__ import annotations

import asyncio
import csv
import io
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from sqlalchemy import text

from tests.daemon.service.conftest import put_outcome
from triaxcald.schema.codes import Code
from triaxcald.schema.columns import NAMES
from triaxcald.schema.quality import Chart, Quality
from triaxcald.service.access import Access
from triaxcald.service.api import answer_errors
from triaxcald.service.api_data import data_router
from triaxcald.service.gate import Gate, known_hosts
from triaxcald.service.ledger import Ledger
from triaxcald.station.config import Station

MakeStation = Callable[..., Station]
OpenLedger = Callable[[Station], Ledger]
in_a_file = pytest.mark.parametrize("database", ["sqlite"], indirect=True)
ADDRESSES = [
    "/runs", "/runs.csv", "/runs/x", "/runs/x/events", "/runs/x/outcome", "/units/1001", "/quality",
    "/charts?name=rms_g",
]  # fmt: skip


@dataclass
class Data:
    ledger: Ledger
    access: Access

    def client(self, address: str = "127.0.0.1") -> httpx.AsyncClient:
        app = FastAPI()
        app.include_router(data_router(self))
        answer_errors(app)
        transport = httpx.ASGITransport(Gate(app, self.access), client=(address, 40000))
        return httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8484/api/1", timeout=180)


@asynccontextmanager
async def served(station: Station, open_ledger: OpenLedger) -> AsyncIterator[tuple[Data, httpx.AsyncClient]]:
    """With what is in the folder."""
    ledger = await asyncio.to_thread(open_ledger, station)
    await asyncio.to_thread(ledger.take)
    data = Data(ledger, Access(ledger, station, secure=False, hosts=known_hosts("127.0.0.1", 8484, secure=False)))
    async with data.client() as client:
        yield data, client
    await data.access.close()


async def get(client: httpx.AsyncClient, address: str, **query: Any) -> Any:
    answer = await client.get(address, params=query)
    assert answer.status_code == 200, answer.text
    return answer.json()


async def refused(client: httpx.AsyncClient, address: str) -> tuple[int, str]:
    answer = await client.get(address)
    body = answer.json()
    assert set(body) == {"code", "message"}
    assert "\n" not in body["message"]
    return answer.status_code, body["code"]


async def test_runs_units_and_quality_are_those_of_the_folder(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path
) -> None:
    made = [
        put_outcome(tmp_path, 1), put_outcome(tmp_path, 2, Code.FIT_OUTSIDE), put_outcome(tmp_path, 3, Code.ABSENT),
        put_outcome(tmp_path, 4, serial="001002", attempt=2),
    ]  # fmt: skip
    ids = [document["run"] for document in made]
    async with served(make_station(), open_ledger) as (data, client):
        page = await get(client, "/runs", limit=3)
        assert [row["run"] for row in page["runs"]] == ids[:0:-1]
        assert list(page["runs"][0]) == list(NAMES)
        rest = await get(client, "/runs", limit=3, after=page["next"])
        assert ([row["run"] for row in rest["runs"]], rest["next"]) == (ids[:1], None)
        assert [row["run"] for row in (await get(client, "/runs", code="absent"))["runs"]] == [ids[2]]

        event = {"format": "triaxcal.event/1", "seq": 1, "run": ids[0], "event": "back"}
        data.ledger.append([event])
        run = await get(client, f"/runs/{ids[0]}")
        assert {name: run[name] for name in NAMES} == rest["runs"][0]
        assert run["measurements"] == data.ledger.measurements_of(ids[0])
        assert run["events"] == (await get(client, f"/runs/{ids[0]}/events"))["events"] == [event]

        unit = await get(client, "/units/01002")
        assert (unit["serial"], [row["run"] for row in unit["runs"]]) == ("01002", [ids[1], ids[3]])

        quality = await get(client, "/quality")
        assert Quality.model_validate(quality).document() == quality
        told = [quality[key] for key in ("units", "attempts", "first_pass_yield", "yield")]
        assert told == [3, 4, pytest.approx(1 / 3), pytest.approx(2 / 3)]
        assert quality["codes"] == {"within_limits": 2, "absent": 1, "fit_outside": 1}
        # A re-test is no first pass, although the first attempt is not among the runs.
        later = await get(client, "/quality", since=made[3]["started"])
        assert [later[key] for key in ("units", "first_pass_units", "yield")] == [1, 0, 1]

        chart = await get(client, "/charts", name="bias_x", points=1)
        assert Chart.model_validate(chart).document() == chart
        assert (chart["n"], [p["run"] for p in chart["points"]]) == (2, [ids[3]])


async def test_a_table_is_that_of_results(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("triaxcald.service.api_data.BATCH", 4)
    for number in range(8):
        put_outcome(tmp_path, number, Code.LOST if number == 4 else Code.WITHIN_LIMITS, order='a "b", c')
    (tmp_path / "b-1001-000001.report.html").write_text("<p>")
    async with served(make_station(), open_ledger) as (_, client):
        answer = await client.get("/runs.csv")
        command = [sys.executable, "-m", "triaxcald.cli", "results", str(tmp_path), "-o", str(tmp_path / "t.csv")]
        await asyncio.to_thread(subprocess.run, command, check=True, capture_output=True)
        assert answer.content == (tmp_path / "t.csv").read_bytes()
        assert answer.headers["content-type"].startswith("text/csv")
        assert "attachment" in answer.headers["content-disposition"]
        chosen = await client.get("/runs.csv", params={"verdict": "aborted"})
        assert [row["serial"] for row in csv.DictReader(io.StringIO(chosen.text))] == ["1004"]
        assert (await client.get("/runs.csv", params={"order": "none"})).text == ",".join(NAMES) + "\n"


@in_a_file
@pytest.mark.parametrize(
    ("query", "numbers"),
    [
        ("since=2030-01-01T00:02:00Z", [2, 3]),
        ("since=2030-01-01T01:02:00+01:00", [2, 3]),  # the plus is not encoded
        ("since=2030-01-01T01:02:00%2B01:00&until=2030-01-01T00:03", [2]),
        ("since=2030-01-01&until=2030-01-01", [1, 2, 3]),
        ("until=2029-12-31", []),
        ("serial=01003&verdict=&code=&order=", [3]),
        ("slot=b", [1, 3]),
        ("fixture=F%202", [2]),
        ("operator=A&part_number=", [1, 2, 3]),
    ],
)
async def test_runs_are_chosen(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path, query: str, numbers: list[int]
) -> None:
    for number in (1, 2, 3):
        put_outcome(tmp_path, number, fixture="F 2" if number == 2 else None)
    async with served(make_station(), open_ledger) as (_, client):
        found = (await client.get(f"/runs?{query}")).json()["runs"]
        assert [row["serial"] for row in reversed(found)] == [str(1000 + n) for n in numbers]
        assert (await client.get(f"/quality?{query}")).json()["units"] == len(numbers)


@in_a_file
async def test_files_of_a_run_are_those_that_its_row_names(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path
) -> None:
    run = put_outcome(tmp_path, 1)["run"]
    stem = tmp_path / "b-1001-000001"
    recording = bytes(range(256)) * 40
    stem.with_name(stem.name + ".mcap").write_bytes(recording)
    stem.with_name(stem.name + ".report.html").write_text("<!DOCTYPE html><script>1</script>")
    async with served(make_station(), open_ledger) as (_, client):
        outcome = await client.get(f"/runs/{run}/outcome")
        assert outcome.content == stem.with_name(stem.name + ".outcome.json").read_bytes()
        assert outcome.headers["content-type"] == "application/json"

        report = await client.get(f"/runs/{run}/report")
        assert report.headers["content-type"] == "text/html; charset=utf-8"
        policy = report.headers["content-security-policy"].split("; ")
        assert "sandbox" in policy  # without allow-scripts
        assert "default-src 'none'" in policy
        assert "inline" in report.headers["content-disposition"]

        whole = await client.get(f"/runs/{run}/recording")
        assert whole.content == recording
        assert "attachment" in whole.headers["content-disposition"]
        part = await client.get(f"/runs/{run}/recording", headers={"Range": "bytes=300-399"})
        assert (part.status_code, part.content) == (206, recording[300:400])
        assert part.headers["content-range"] == f"bytes 300-399/{len(recording)}"

        assert await refused(client, f"/runs/{run}/certificate") == (404, "unknown")
        stem.with_name(stem.name + ".mcap").unlink()
        assert await refused(client, f"/runs/{run}/recording") == (404, "unknown")


@in_a_file
@pytest.mark.parametrize("name", ["../secret.mcap", "/etc/passwd", "folder.mcap", "..", "nothing\0.mcap"])
async def test_a_file_out_of_the_folder_is_not_given_whatever_an_outcome_names(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path, name: str
) -> None:
    folder = tmp_path / "out"
    (folder / "folder.mcap").mkdir(parents=True)
    (tmp_path / "secret.mcap").write_text("secret")
    run = put_outcome(folder, 1)["run"]
    async with served(make_station(folder="out"), open_ledger) as (data, client):
        with data.ledger.writing() as db:
            db.execute(text("UPDATE run SET recording = :name"), {"name": name})
        assert await refused(client, f"/runs/{run}/recording") == (404, "unknown")


@in_a_file
@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("/runs/nobody", (404, "unknown")),
        ("/runs/%00", (404, "unknown")),
        ("/runs/nobody/events", (404, "unknown")),
        ("/runs/RUN/..%2Fstation.toml", (404, "unknown")),
        ("/runs/RUN/station.toml", (404, "unknown")),
        ("/runs/RUN/run", (404, "unknown")),
        ("/units/7", (404, "unknown")),
        ("/units/a%2Fb%0A", (404, "unknown")),
        ("/charts?name=duration_s", (404, "unknown")),
        ("/charts", (400, "invalid")),
        ("/charts?name=rms_g&points=0", (400, "invalid")),
        ("/runs?since=yesterday", (400, "invalid")),
        ("/runs?until=2030-13-01", (400, "invalid")),
        ("/quality?since=2030-01-02&until=2030-01-01", (400, "invalid")),
        ("/runs.csv?since=0000", (400, "invalid")),
        ("/runs?after=nonsense", (400, "invalid")),
        ("/runs?after=OTk5OTk5OTk5OTk5OTk5OTk5OTk5OTk5Oi5vdXRjb21lLmpzb24=", (400, "invalid")),
        ("/runs?limit=0", (400, "invalid")),
        ("/runs?limit=501", (400, "invalid")),
        ("/runs?verdict=good", (400, "invalid")),
        ("/runs?code=bad", (400, "invalid")),
        ("/runs?serial=%00", (400, "invalid")),
    ],
)
async def test_what_is_wrong_is_refused_in_one_line(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path, address: str, expected: tuple[int, str]
) -> None:
    run = put_outcome(tmp_path, 1)["run"]
    async with served(make_station(), open_ledger) as (_, client):
        assert await refused(client, address.replace("RUN", run)) == expected


@in_a_file
async def test_nothing_is_read_from_elsewhere_without_a_token(
    make_station: MakeStation, open_ledger: OpenLedger
) -> None:
    async with served(make_station(), open_ledger) as (data, _), data.client("192.0.2.7") as elsewhere:
        for address in ADDRESSES:
            assert await refused(elsewhere, address) == (401, "not_signed_in")


@in_a_file
async def test_a_database_that_is_of_no_use_is_told(make_station: MakeStation, open_ledger: OpenLedger) -> None:
    async with served(make_station(), open_ledger) as (data, client):
        with data.ledger.writing() as db:
            for table in ("run", "filed"):
                db.execute(text(f"ALTER TABLE {table} RENAME TO gone_{table}"))
        for address in ADDRESSES:
            assert await refused(client, address) == (503, "database")


@in_a_file
async def test_a_page_of_runs_is_read_by_an_index(
    make_station: MakeStation, open_ledger: OpenLedger, tmp_path: Path
) -> None:
    """However many there are."""
    put_outcome(tmp_path, 1)
    async with served(make_station(), open_ledger) as (data, _):
        with data.ledger.reading() as db:
            query = "EXPLAIN QUERY PLAN SELECT * FROM run ORDER BY at_us DESC, outcome DESC LIMIT 51"
            plan = " ".join(str(row) for row in db.execute(text(query)))
    assert "INDEX run_at" in plan
    assert "TEMP B-TREE" not in plan
