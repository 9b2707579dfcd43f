"""Requests and connections that are refused before the service looks at what they ask for."""

from __future__ import annotations

import asyncio
import json
import shutil
import socket
import subprocess
from collections.abc import AsyncIterator
from contextlib import suppress
from pathlib import Path

import httpx
import pytest

from tests.conftest import Workshop
from tests.daemon.service.guarded import JSON, Guarded, guarded
from tests.daemon.service.test_access import refused, scan, station_of
from triaxcald.errors import InputError
from triaxcald.service.gate import BODY_MOST, CONNECTIONS_MOST, known_hosts, require_safe

FORMS = ("application/x-www-form-urlencoded", "multipart/form-data; boundary=x", "text/plain")


@pytest.fixture
async def service(workshop: Workshop) -> AsyncIterator[Guarded]:
    """Where anybody at the loopback may write: what is refused is so for another reason."""
    async with guarded(station_of(workshop, rules={"open_loopback": True})) as service:
        yield service


async def still_works(service: Guarded) -> None:
    assert (await scan(service)).status_code == 200
    assert [row["ok"] for row in service.rows() if row["action"] == "scan"][-1]  # refusals may follow it


async def raw(service: Guarded, data: bytes) -> tuple[int, dict[str, str]]:
    """Status and document of the answer to bytes on a connection, until it ends."""
    reader, writer = await asyncio.open_connection("127.0.0.1", service.port)
    writer.write(data)
    answer = await reader.read()
    writer.close()
    head, _, body = answer.partition(b"\r\n\r\n")
    return int(head.split()[1]), json.loads(body)


async def last_words(reader: asyncio.StreamReader) -> bytes:
    """What comes until the connection ends, in order or not."""
    try:
        return await reader.read()
    except ConnectionError:
        return b""


# Host and Origin.


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:PORT", "127.0.0.1", "127.0.0.1:1", "localhost.evil:PORT", ""]
)
@pytest.mark.parametrize("method", ["GET", "POST"])
async def test_a_foreign_host_is_refused(service: Guarded, host: str, method: str) -> None:
    headers = {"Host": host.replace("PORT", str(service.port)), **JSON}
    refused(await service.client.request(method, "/api/1/station", headers=headers), 403, "origin")
    assert service.refusals() == [("origin", "/api/1/station", None)]
    await still_works(service)


async def test_the_names_of_the_loopback_and_of_the_machine_are_known(service: Guarded) -> None:
    for name in ("localhost", "LOCALHOST", "127.0.0.1", "[::1]", socket.gethostname()):
        headers = {"Host": f"{name}:{service.port}"}
        assert (await service.client.get("/api/1/station", headers=headers)).status_code == 200


async def test_further_names_are_known_where_they_are_given(workshop: Workshop) -> None:
    async with guarded(station_of(workshop), names=("line3.factory",)) as service:
        answer = await service.client.get("/api/1/station", headers={"Host": f"line3.factory:{service.port}"})
        assert answer.status_code == 200


def test_known_hosts_have_their_port_and_the_usual_one_may_be_left_out() -> None:
    assert "station3:8484" in known_hosts("station3", 8484, secure=False)
    assert "station3" not in known_hosts("station3", 8484, secure=False)
    assert {"station3", "station3:443"} <= known_hosts("station3", 443, secure=True)
    assert "station3" not in known_hosts("station3", 443, secure=False)
    assert "[fd00::2]:8484" in known_hosts("fd00::2", 8484, secure=True)
    assert not any(host.startswith(("0.0.0.0", ":")) for host in known_hosts("0.0.0.0", 8484, secure=True))


async def test_the_address_that_a_connection_has_reached_is_known(service: Guarded) -> None:
    """As that of the machine is where the service listens on all of its addresses."""
    async with service.from_elsewhere() as other:
        transport = other._transport
        assert isinstance(transport, httpx.ASGITransport)
        token = service.token("mes", "reader")
        # httpx takes the server's address of the scope from the URL, as the socket has it in reality.
        assert (await other.get("http://192.0.2.2:8484/api/1/station", headers=token)).status_code == 200
        headers = {**token, "Host": "evil.example:8484"}
        refused(await other.get("http://192.0.2.2:8484/api/1/station", headers=headers), 403, "origin")


@pytest.mark.parametrize(
    "origin",
    ["https://evil.example", "null", "http://127.0.0.1:1", "https://127.0.0.1:PORT", "http://evil@127.0.0.1:PORT", ""],
)
async def test_writing_from_a_foreign_page_is_refused(service: Guarded, origin: str) -> None:
    refused(await scan(service, headers={"Origin": origin.replace("PORT", str(service.port))}), 403, "origin")
    assert service.refusals() == [("origin", "/api/1/scan", None)]
    await still_works(service)


async def test_writing_from_the_own_page_works(service: Guarded) -> None:
    for name in ("127.0.0.1", "localhost"):
        headers = {"Origin": f"http://{name}:{service.port}", "Sec-Fetch-Site": "same-origin"}
        assert (await scan(service, headers=headers)).status_code == 200
    refused(await scan(service, headers={"Sec-Fetch-Site": "cross-site"}), 403, "origin")


@pytest.mark.parametrize("form", [*FORMS, None, "application/json-seq", "text/html; application/json"])
@pytest.mark.parametrize("method", ["POST", "PUT", "PATCH", "DELETE"])
async def test_writing_without_json_is_refused(service: Guarded, form: str | None, method: str) -> None:
    headers = {} if form is None else {"Content-Type": form}
    answer = await service.client.request(method, "/api/1/scan", content=b"text=1042", headers=headers)
    refused(answer, 400, "invalid")
    assert service.refusals() == [("invalid", "/api/1/scan", None)]
    await still_works(service)


async def test_a_form_of_a_foreign_page_is_refused_for_its_origin(service: Guarded) -> None:
    headers = {"Content-Type": FORMS[0], "Origin": "https://evil.example", "Sec-Fetch-Site": "cross-site"}
    refused(await service.client.post("/api/1/scan", content=b"text=1042", headers=headers), 403, "origin")


async def test_json_with_a_character_set_is_json(service: Guarded) -> None:
    headers = {"Content-Type": "Application/JSON; charset=utf-8"}
    answer = await service.client.post("/api/1/scan", content=b'{"text": "1042"}', headers=headers)
    assert answer.status_code == 200


# Bodies and paths.


async def chunks(size: int) -> AsyncIterator[bytes]:
    for _ in range(size // 1024):
        yield b" " * 1024


async def test_a_body_of_a_megabyte_is_refused_whole_or_in_chunks(service: Guarded) -> None:
    whole = await service.client.post("/api/1/scan", content=b" " * (1 << 20), headers=JSON)
    refused(whole, 413, "too_large")
    refused(await service.client.post("/api/1/scan", content=chunks(1 << 20), headers=JSON), 413, "too_large")
    assert service.refusals() == [("too_large", "/api/1/scan", None)] * 2
    await still_works(service)


async def test_the_largest_body_is_taken_and_one_byte_more_is_not(service: Guarded) -> None:
    body = b'{"text": "1"}'.ljust(BODY_MOST)
    for content in (body, chunks_of(body)):
        answer = await service.client.post("/api/1/scan", content=content, headers=JSON)
        assert answer.json() == {"size": BODY_MOST}
    for content in (body + b" ", chunks_of(body + b" ")):
        refused(await service.client.post("/api/1/scan", content=content, headers=JSON), 413, "too_large")


async def chunks_of(body: bytes) -> AsyncIterator[bytes]:
    yield body[:1000]
    yield body[1000:]


async def test_a_body_without_end_ends_with_its_connection(service: Guarded) -> None:
    _, writer = await asyncio.open_connection("127.0.0.1", service.port)
    head = f"POST /api/1/scan HTTP/1.1\r\nHost: 127.0.0.1:{service.port}\r\nContent-Type: application/json\r\n"
    writer.write(head.encode() + b"Transfer-Encoding: chunked\r\n\r\n")
    with suppress(ConnectionError):
        while True:
            writer.write(b"10000\r\n" + b" " * 0x10000 + b"\r\n")
            await writer.drain()
    await still_works(service)


@pytest.mark.parametrize(
    "path", ["/../etc/passwd", "/api/1/../station", "/api/1/runs/..%2f..%2fetc%2fpasswd", "/api/1/runs/%2e%2e/x",
             "/static/..%5c..%5cx", "/api/1/runs/a%00b", "/api/1/runs/a%0ab", "/./"],
)  # fmt: skip
async def test_a_path_that_leads_elsewhere_is_unknown(service: Guarded, path: str) -> None:
    head = f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1:{service.port}\r\nConnection: close\r\n\r\n"
    status, document = await raw(service, head.encode())
    assert (status, document["code"]) == (404, "unknown")
    [(code, told, _)] = service.refusals()
    assert code == "unknown"
    assert told is not None
    await still_works(service)


async def test_a_script_in_a_serial_is_refused_by_the_service_with_one_row(service: Guarded) -> None:
    text = "<script>alert(1)</script>"
    refused(await service.client.post("/api/1/scan", json={"text": text}), 400, "invalid")
    assert service.refusals() == [("invalid", "/api/1/scan", "loopback")]
    await still_works(service)


async def test_what_is_merely_not_there_is_no_refusal(service: Guarded) -> None:
    refused(await service.client.get("/favicon.ico"), 404, "unknown")
    assert service.rows() == []


# Headers.


async def test_every_answer_has_headers_that_protect_pages(service: Guarded) -> None:
    for answer in (
        await service.client.get("/api/1/station"),
        await service.client.get("/nothing"),
        await service.client.get("/api/1/station", headers={"Host": "evil.example"}),
    ):
        policy = answer.headers["content-security-policy"]
        assert "default-src 'self'" in policy
        assert "frame-ancestors 'none'" in policy
        assert "unsafe" not in policy
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert "referrer-policy" in answer.headers
        assert "server" not in answer.headers
    assert (await service.client.get("/api/1/station")).headers["cache-control"] == "no-store"
    page = await service.client.get("/")
    assert page.headers.get_list("content-security-policy") == ["default-src 'none'"]
    assert "access-control-allow-origin" not in (await scan(service, headers={"Origin": service.url})).headers


# Connections.


async def test_two_hundred_idle_connections_block_nobody_and_are_ended(workshop: Workshop) -> None:
    async with guarded(station_of(workshop, rules={"open_loopback": True}), first_s=0.5) as service:
        idle = [await asyncio.open_connection("127.0.0.1", service.port) for _ in range(200)]
        await still_works(service)
        for reader, _ in idle:
            assert await last_words(reader) == b""
        for _, writer in idle:
            writer.close()
        await still_works(service)
        await service.access.close()
        dropped = [row for row in service.rows() if row["action"] == "connection"]
        omitted = next(row for row in service.rows() if row["action"] == "refusals")
        assert len(dropped) + omitted["what"]["omitted"]["invalid"] == 200
        assert {row["what"]["reason"] for row in dropped} == {"no request came within 0.5 s"}


async def test_a_head_that_comes_drop_by_drop_is_not_waited_for(workshop: Workshop) -> None:
    """Neither the first nor a later one on the same connection; uvicorn alone would wait for both."""
    async with guarded(station_of(workshop), first_s=0.5) as service:
        whole = f"GET /api/1/station HTTP/1.1\r\nHost: 127.0.0.1:{service.port}\r\n\r\n".encode()
        for before in (b"", whole):
            reader, writer = await asyncio.open_connection("127.0.0.1", service.port)
            writer.write(before)
            if before:
                await reader.readuntil(b"}")
            writer.write(whole[:20])
            assert await last_words(reader) == b""
            writer.close()


async def test_a_body_that_comes_drop_by_drop_is_not_waited_for(workshop: Workshop) -> None:
    async with guarded(station_of(workshop, rules={"open_loopback": True}), first_s=0.5) as service:
        head = f"POST /api/1/scan HTTP/1.1\r\nHost: 127.0.0.1:{service.port}\r\nContent-Type: application/json\r\n"
        status, document = await raw(service, head.encode() + b"Content-Length: 100\r\n\r\n{")
        assert (status, document["code"]) == (400, "invalid")
        await still_works(service)


async def test_more_connections_than_there_may_be_end_the_longest_idle_ones(service: Guarded) -> None:
    assert (await service.client.get("/api/1/station")).status_code == 200  # a connection that goes on
    idle = [await asyncio.open_connection("127.0.0.1", service.port) for _ in range(CONNECTIONS_MOST + 20)]
    assert await last_words(idle[0][0]) == b""
    await still_works(service)
    last_reader, last_writer = idle[-1]
    last_writer.write(f"GET /api/1/station HTTP/1.1\r\nHost: 127.0.0.1:{service.port}\r\n\r\n".encode())
    assert (await last_reader.readline()).startswith(b"HTTP/1.1 200")
    for _, writer in idle:
        writer.close()
    await service.access.close()
    assert "too_many" in {row["code"] for row in service.rows()}


async def test_what_is_no_http_is_refused_with_a_row(service: Guarded) -> None:
    status, document = await raw(service, b"\x16\x03\x01 what\r\n\r\n")
    assert (status, document["code"]) == (400, "invalid")
    await still_works(service)
    await service.access.close()
    assert "connection" in {row["action"] for row in service.rows()}


async def test_a_body_that_is_no_http_is_answered_once_and_fills_no_log(
    service: Guarded, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Also where the request is refused for another reason at the same time, without a row that takes time."""
    monkeypatch.setattr("triaxcald.service.access.REFUSALS_MOST", 0)
    for host in ("127.0.0.1", "evil.example"):
        head = f"POST /api/1/scan HTTP/1.1\r\nHost: {host}:{service.port}\r\nContent-Type: application/json\r\n"
        status, document = await raw(service, head.encode() + b"Transfer-Encoding: chunked\r\n\r\nno length\r\n")
        assert (status, document["code"]) == (400, "invalid")
    await still_works(service)
    assert [record for record in caplog.records if record.levelname == "ERROR"] == []


# TLS.


@pytest.fixture(scope="module")
def certificate(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    if shutil.which("openssl") is None:
        pytest.skip("needs openssl")
    folder = tmp_path_factory.mktemp("tls")
    cert, key = folder / "cert.pem", folder / "key.pem"
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes", "-days", "2",
         "-subj", "/CN=station", "-keyout", str(key), "-out", str(cert)],
        check=True, capture_output=True,
    )  # fmt: skip
    return cert, key


async def test_with_tls_a_cookie_is_secure_and_idle_handshakes_end(
    workshop: Workshop, certificate: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("triaxcald.service.gate.FIRST_S", 1.0)
    async with guarded(station_of(workshop), tls=certificate) as service:
        reader, writer = await asyncio.open_connection("127.0.0.1", service.port)
        service.add("Ada", "operator")
        answer = await service.sign_in("Ada", headers={"Origin": service.url})
        assert answer.status_code == 200
        assert answer.headers["set-cookie"].startswith("__Host-")
        assert "; Secure" in answer.headers["set-cookie"]
        assert (await scan(service)).status_code == 200
        assert await last_words(reader) == b""
        writer.close()


def test_beyond_the_loopback_a_certificate_is_needed(certificate: tuple[Path, Path]) -> None:
    for host in ("127.0.0.1", "localhost", "::1", "[::1]", "127.1.2.3"):
        assert not require_safe(host, None, None)
    for host in ("0.0.0.0", "::", "", "192.0.2.2", "station3", "localhost.example"):
        with pytest.raises(InputError, match="--cert and --key"):
            require_safe(host, None, None)
        assert require_safe(host, *certificate)


def test_a_certificate_that_cannot_be_used_is_one_clear_line(certificate: tuple[Path, Path], tmp_path: Path) -> None:
    cert, key = certificate
    locked = tmp_path / "locked.pem"
    subprocess.run(
        ["openssl", "ec", "-aes128", "-passout", "pass:x", "-in", str(key), "-out", str(locked)],
        check=True, capture_output=True,
    )  # fmt: skip
    for pair in ((cert, None), (None, key), (cert, tmp_path / "none"), (key, cert), (cert, locked), (tmp_path, key)):
        with pytest.raises(InputError) as caught:
            require_safe("0.0.0.0", *pair)
        assert "\n" not in str(caught.value)
        assert "--cert" in str(caught.value) or "--key" in str(caught.value)
