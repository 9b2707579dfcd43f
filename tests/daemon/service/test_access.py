"""People, PINs, sessions, tokens and roles, over the real interface."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator
from pathlib import Path

import httpx
import pytest
from starlette.requests import Request

from tests.conftest import Workshop
from tests.daemon.service.guarded import JSON, PIN, Guarded, guarded
from triaxcald.service.access import (
    HOUR_S,
    KEYS_MOST,
    LOCKED_S,
    REFUSALS_ALL_MOST,
    REFUSALS_MOST,
    TRIES_MOST,
    Lockout,
    Refusals,
    is_loopback,
    network_of,
)
from triaxcald.service.errors import ApiError
from triaxcald.service.people import IDLE_S, Role, hashed

SCAN = {"text": "1042"}


def station_of(workshop: Workshop, **settings: object) -> Path:
    return workshop.station({"bus": {"host": "127.0.0.1", "port": 5020}}, folder="out", **settings)


@pytest.fixture
async def service(workshop: Workshop) -> AsyncIterator[Guarded]:
    async with guarded(station_of(workshop)) as service:
        yield service


def refused(response: httpx.Response, status: int, code: str) -> None:
    assert (response.status_code, response.json()["code"]) == (status, code), response.text
    assert set(response.json()) == {"code", "message"}
    assert "\n" not in response.json()["message"]


async def scan(service: Guarded, client: httpx.AsyncClient | None = None, **more: object) -> httpx.Response:
    return await (client or service.client).post("/api/1/scan", json=SCAN, **more)  # type: ignore[arg-type]


# On the loopback, and beyond it.


async def test_on_the_loopback_anybody_reads_and_nobody_writes(service: Guarded) -> None:
    assert (await service.client.get("/api/1/station")).json() == {
        "name": "loopback", "role": "reader", "by": "loopback",
    }  # fmt: skip
    assert (await service.client.get("/api/1/session")).json() == {"name": None, "role": "reader", "by": "loopback"}
    refused(await scan(service), 401, "not_signed_in")
    assert service.refusals() == [("not_signed_in", "/api/1/scan", "loopback")]


async def test_on_an_open_loopback_anybody_is_an_operator_and_no_more(workshop: Workshop) -> None:
    async with guarded(station_of(workshop, rules={"open_loopback": True})) as service:
        assert (await scan(service)).status_code == 200
        refused(await service.client.post("/api/1/reload", headers=JSON), 401, "not_signed_in")
        row = service.rows()[0]
        assert (row["who"], row["role"], row["action"], row["ok"]) == ("loopback", "operator", "scan", True)
        async with service.from_elsewhere() as other:
            refused(await scan(service, other), 401, "not_signed_in")


@pytest.mark.parametrize("header", ["X-Forwarded-For", "X-Real-IP", "Forwarded"])
async def test_beyond_the_loopback_reading_too_needs_a_sign_in_whatever_a_header_says(
    service: Guarded, header: str
) -> None:
    async with service.from_elsewhere() as other:
        refused(await other.get("/api/1/station", headers={header: "for=127.0.0.1"}), 401, "not_signed_in")
        refused(await other.get("/api/1/session", headers={header: "127.0.0.1"}), 401, "not_signed_in")
        answer = await other.get("/api/1/station", headers=service.token("mes", "reader"))
        assert answer.json() == {"name": "mes", "role": "reader", "by": "token"}
    assert {row["what"]["address"] for row in service.rows() if not row["ok"]} == {"192.0.2.7"}


async def test_a_header_does_not_choose_the_address_of_the_peer(service: Guarded) -> None:
    await scan(service, headers={"X-Forwarded-For": "198.51.100.9"})
    assert service.rows()[-1]["what"]["address"] == "127.0.0.1"


def test_the_loopback_is_the_whole_net_127_and_1_also_as_ipv6_writes_them() -> None:
    assert all(map(is_loopback, ("127.0.0.1", "127.8.8.8", "::1", "::ffff:127.0.0.1")))
    assert not any(map(is_loopback, ("192.0.2.7", "::ffff:192.0.2.7", "fe80::1%eth0", "localhost", "")))


# Sign-in.


async def test_a_person_signs_in_works_and_signs_out(service: Guarded) -> None:
    service.add("Ada", "operator")
    answer = await service.sign_in("Ada")
    assert (answer.status_code, answer.json()) == (200, {"name": "Ada", "role": "operator", "by": "cookie"})
    attributes = {part.strip().lower() for part in answer.headers["set-cookie"].split(";")[1:]}
    assert attributes == {"httponly", "samesite=strict", "path=/"}
    assert (await scan(service)).status_code == 200
    assert (await service.client.get("/api/1/session")).json()["name"] == "Ada"
    cookie = service.cookie()
    assert (await service.client.delete("/api/1/session", headers=JSON)).status_code == 200
    assert not service.client.cookies
    refused(await scan(service, headers=cookie), 401, "not_signed_in")
    assert [(r["action"], r["who"], r["ok"]) for r in service.rows()] == [
        ("sign_in", "Ada", True), ("scan", "Ada", True), ("sign_out", "Ada", True), ("request", "loopback", False),
    ]  # fmt: skip


async def test_an_operator_is_no_engineer_and_an_engineer_is_an_operator(service: Guarded) -> None:
    service.add("Ada", "operator")
    service.add("Grace", "engineer")
    await service.sign_in("Ada")
    refused(await service.client.post("/api/1/reload", headers=JSON), 403, "role")
    assert service.refusals() == [("role", "/api/1/reload", "Ada")]
    await service.sign_in("Grace")
    assert (await service.client.post("/api/1/reload", headers=JSON)).status_code == 200
    assert (await scan(service)).status_code == 200


async def test_a_reader_who_signed_in_on_an_open_loopback_is_a_reader(workshop: Workshop) -> None:
    async with guarded(station_of(workshop, rules={"open_loopback": True})) as service:
        service.add("Ada", "reader")
        await service.sign_in("Ada")
        refused(await scan(service), 403, "role")


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"{",
        b"[]",
        b'{"name": "Ada"}',
        b'{"name": "Ada", "pin": 4711}',
        b"[" * 60_000,
        b"\xff",
        b'{"name": "\\ud800", "pin": "4711"}',
        b'{"name": "Ada", "pin": "4711\\u0000"}',
    ],
)
async def test_a_sign_in_that_is_no_pair_of_texts_is_invalid_and_repeats_no_pin(service: Guarded, body: bytes) -> None:
    answer = await service.client.post("/api/1/session", content=body, headers=JSON)
    refused(answer, 400, "invalid")
    assert "4711" not in answer.text


async def test_a_wrong_pin_and_an_unknown_name_look_the_same(service: Guarded) -> None:
    service.add("Ada", "operator")
    wrong, unknown = await service.sign_in("Ada", "0000"), await service.sign_in("Bob", "0000")
    refused(wrong, 401, "not_signed_in")
    assert wrong.json() == unknown.json()
    # A PIN may have come into the wrong field: only names of existing people are kept.
    assert [row["what"].get("name") for row in service.rows()] == ["Ada", None]


async def test_ten_wrong_tries_lock_a_person_for_a_minute(service: Guarded) -> None:
    service.add("Ada", "operator")
    for i in range(TRIES_MOST):
        async with service.from_elsewhere(f"198.51.100.{i}") as other:
            refused(await other.post("/api/1/session", json={"name": "Ada", "pin": "0000"}), 401, "not_signed_in")
    locked = await service.sign_in("Ada")
    refused(locked, 429, "too_many")
    assert locked.headers["retry-after"] == "60"
    service.clock.now_s += LOCKED_S - 1
    refused(await service.sign_in("Ada"), 429, "too_many")
    service.clock.now_s += 1
    assert (await service.sign_in("Ada")).status_code == 200
    assert [row["code"] for row in service.rows() if row["code"]] == ["not_signed_in"] * 10 + ["too_many"] * 2


async def test_ten_wrong_tries_lock_an_address_and_no_other(service: Guarded) -> None:
    service.add("Ada", "operator")
    async with service.from_elsewhere() as other:
        for i in range(TRIES_MOST):
            await other.post("/api/1/session", json={"name": f"guess {i}", "pin": "0000"})
        refused(await other.post("/api/1/session", json={"name": "Ada", "pin": PIN}), 429, "too_many")
    assert (await service.sign_in("Ada")).status_code == 200


async def test_of_many_wrong_tries_at_once_ten_are_judged(service: Guarded) -> None:
    service.add("Ada", "operator")
    answers = await asyncio.gather(*(service.sign_in("Ada", f"{i:04}") for i in range(40)))
    assert sorted(answer.status_code for answer in answers) == [401] * 10 + [429] * 30


def test_the_right_pin_forgets_wrong_tries_of_the_name_and_takes_back_its_own_of_the_address() -> None:
    tries = Lockout()
    for _ in range(3):
        for i in range(TRIES_MOST - 1):
            tries.begin("Ada", float(i))
        tries.forget("Ada")
    for i in range(3 * TRIES_MOST):
        tries.begin("address", float(i))
        tries.take_back("address")
    for i in range(TRIES_MOST):
        tries.begin("address", 100.0 + i)
    with pytest.raises(ApiError, match="wait 59 s"):
        tries.begin("address", 110.0)


def test_wrong_tries_of_ten_minutes_ago_do_not_count() -> None:
    tries = Lockout()
    for i in range(10 * TRIES_MOST):
        tries.begin("Ada", i * 70.0)


def test_tries_are_remembered_of_a_bounded_number_of_names() -> None:
    tries = Lockout()
    for i in range(2 * KEYS_MOST):
        tries.begin(str(i), 0.0)
    assert len(tries._tries) == KEYS_MOST


def test_an_ipv6_network_counts_as_one_address() -> None:
    assert network_of("2001:db8::1") == network_of("2001:db8::ffff:1") != network_of("2001:db8:0:1::1")
    assert network_of("::ffff:192.0.2.7") == network_of("192.0.2.7") != network_of("192.0.2.8")


# Sessions.


async def test_a_session_survives_a_restart_of_the_service(workshop: Workshop) -> None:
    path = station_of(workshop)
    async with guarded(path) as service:
        service.add("Ada", "operator")
        await service.sign_in("Ada")
        cookie = service.cookie()
    async with guarded(path) as service:
        assert (await scan(service, headers=cookie)).status_code == 200


async def test_a_session_ends_after_twelve_hours_without_use(service: Guarded) -> None:
    service.add("Ada", "operator")
    await service.sign_in("Ada")
    for _ in range(3):
        service.clock.now_s += IDLE_S - 1
        assert (await scan(service)).status_code == 200
    service.clock.now_s += IDLE_S + 1
    refused(await scan(service), 401, "not_signed_in")
    service.clock.now_s -= 2
    refused(await scan(service), 401, "not_signed_in")  # it is gone, not asleep


async def test_what_a_page_does_by_itself_does_not_keep_a_session(service: Guarded) -> None:
    service.add("Ada", "operator")
    await service.sign_in("Ada")
    headers = [(b"cookie", service.cookie()["Cookie"].encode())]
    scope = {"type": "http", "headers": headers, "client": ("192.0.2.7", 1)}
    service.clock.now_s += IDLE_S - 1
    assert (await service.access.require(Request(scope), "operator", touch=False)).name == "Ada"
    service.clock.now_s += 2
    with pytest.raises(ApiError):
        await service.access.require(Request(scope), "operator", touch=False)


@pytest.mark.parametrize("change", ["disable", "pin", "role"])
async def test_a_disabled_person_another_pin_and_another_role_count_at_once(service: Guarded, change: str) -> None:
    service.add("Ada", "operator")
    await service.sign_in("Ada")
    people = service.people()
    match change:
        case "disable":
            people.disable("Ada", True)
        case "pin":
            people.set_pin("Ada", hashed("another"))
        case _:
            people.set_role("Ada", Role.READER)
    refused(await scan(service), 403 if change == "role" else 401, "role" if change == "role" else "not_signed_in")
    if change == "disable":
        refused(await service.sign_in("Ada"), 401, "not_signed_in")
        people.disable("Ada", False)
        refused(await scan(service), 401, "not_signed_in")  # the old session does not come back
        assert (await service.sign_in("Ada")).status_code == 200


async def test_a_new_sign_in_ends_the_session_before_it(service: Guarded) -> None:
    service.add("Ada", "operator")
    service.add("Grace", "operator")
    await service.sign_in("Ada")
    before = service.cookie()
    await service.sign_in("Grace")
    service.client.cookies.clear()
    refused(await scan(service, headers=before), 401, "not_signed_in")


# Tokens.


async def test_a_token_is_refused_once_it_is_revoked(service: Guarded) -> None:
    token = service.token("mes", "operator")
    assert (await scan(service, headers=token)).status_code == 200
    assert (await service.client.get("/api/1/session", headers=token)).json()["by"] == "token"
    service.people().revoke("mes")
    refused(await scan(service, headers=token), 401, "not_signed_in")
    assert service.refusals() == [("not_signed_in", "/api/1/scan", None)]


@pytest.mark.parametrize("given", ["Bearer no-token", "Bearer", "Basic QWRhOjQ3MTE=", "é"])
async def test_an_unknown_token_is_refused_where_none_is_needed(service: Guarded, given: str) -> None:
    answer = await service.client.get("/api/1/station", headers={"Authorization": given.encode()})
    refused(answer, 401, "not_signed_in")
    assert answer.headers["www-authenticate"] == "Bearer"


async def test_a_token_goes_before_a_cookie(service: Guarded) -> None:
    service.add("Ada", "engineer")
    await service.sign_in("Ada")
    refused(await service.client.post("/api/1/reload", json={}, headers=service.token("mes", "reader")), 403, "role")


# The trail, and what is in no file.


def test_refusals_of_one_address_leave_rows_for_others_and_all_leave_a_bounded_number() -> None:
    refusals = Refusals()
    rows = [refusals.has_row("role", "192.0.2.1", 0.0) for _ in range(1000)]
    assert sum(rows) == REFUSALS_MOST
    assert rows[:REFUSALS_MOST] == [True] * REFUSALS_MOST
    assert refusals.has_row("role", "192.0.2.2", 0.0)
    assert refusals.has_row("origin", "192.0.2.1", 0.0)
    assert sum(refusals.has_row("role", str(i), 1.0) for i in range(10_000)) == REFUSALS_ALL_MOST - REFUSALS_MOST - 2
    assert refusals.omitted["role"] == 1000 + 1 + 10_000 - (REFUSALS_ALL_MOST - 1)
    assert refusals.has_row("role", "192.0.2.1", HOUR_S)


async def test_refusals_without_a_row_of_their_own_are_counted_in_one(workshop: Workshop) -> None:
    async with guarded(station_of(workshop)) as service:
        for _ in range(REFUSALS_MOST + 7):
            await scan(service)
        assert len(service.refusals()) == REFUSALS_MOST
        await service.access.close()
        last = service.rows()[-1]
        assert (last["action"], last["what"]["omitted"], last["ok"]) == ("refusals", {"not_signed_in": 7}, False)


async def test_no_secret_is_in_a_file_of_the_station(workshop: Workshop) -> None:
    async with guarded(station_of(workshop)) as service:
        service.add("Ada", "operator", "geheim-4711")
        token = service.token("mes", "operator")["Authorization"].split()[1]
        await service.sign_in("Ada", "geheim-4711")
        await service.sign_in("Ada", "geheim-4712")
        await service.sign_in("geheim-4711", "x")
        cookie = next(iter(service.client.cookies.values()))
        await scan(service, headers={"Authorization": f"Bearer {token}"})
    held = b"".join(path.read_bytes() for path in workshop.folder.rglob("*") if path.is_file())
    assert b"sign_in" in held
    for secret in ("geheim-4711", "geheim-4712", token, cookie):
        assert secret.encode() not in held


async def test_the_trail_is_also_lines_of_json(workshop: Workshop) -> None:
    async with guarded(station_of(workshop)) as service:
        service.add("Ada", "operator")
        await service.sign_in("Ada")
        await scan(service, headers={"Origin": "https://evil.example"})
        rows = service.rows()
    lines = [json.loads(line) for line in (workshop.folder / "out" / "trail.jsonl").read_text().splitlines()]
    assert [(r["action"], r["who"], r["ok"], r["code"]) for r in lines] == [
        (r["action"], r["who"], r["ok"], r["code"]) for r in rows
    ] == [("sign_in", "Ada", True, None), ("request", None, False, "origin")]  # fmt: skip


async def test_a_text_that_no_file_can_hold_is_written_as_its_escape(service: Guarded) -> None:
    content = b'{"text": "\\ud800"}'
    answer = await service.client.post(
        "/api/1/scan", content=content, headers={**JSON, **service.token("mes", "operator")}
    )
    assert answer.status_code == 200
    assert service.rows()[-1]["what"]["text"] == "\\ud800"


async def test_a_long_text_is_cut_in_the_trail(service: Guarded) -> None:
    answer = await service.client.post(
        "/api/1/scan", json={"text": "x" * 60_000}, headers=service.token("mes", "operator")
    )
    assert answer.status_code == 200
    assert len(json.dumps(service.rows()[-1])) < 600
