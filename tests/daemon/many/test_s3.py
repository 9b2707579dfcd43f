"""A store that speaks S3, on a server of this machine."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.daemon.many.conftest import CAN, TABLE, rows_of

pytestmark = pytest.mark.slow


@pytest.fixture
def bucket(
    process: Callable[..., Any], until: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> tuple[Any, dict[str, str]]:
    """The store with a bucket called line, and the environment of who uses it."""
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        port = bound.getsockname()[1]
    process("moto.server", "-H", "127.0.0.1", "-p", port)

    def answers() -> bool:
        with socket.socket() as tried:
            return tried.connect_ex(("127.0.0.1", port)) == 0

    until(answers)
    environment = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ACCESS_KEY_ID": "testing",
        "AWS_SECRET_ACCESS_KEY": "testing",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    store = s3fs.S3FileSystem(use_listings_cache=False)
    store.mkdir("line")
    return store, environment


def test_a_bucket_is_worked_at_by_two_workers_and_resumed(
    bucket: Any, cluster: Callable[..., str], tmp_path: Path, triaxcal: Callable[..., Any]
) -> None:
    store, environment = bucket
    for i in range(4):
        store.pipe(f"line/2026/r{i}.csv.gz", TABLE.read_bytes())
    store.pipe("line/2026/broken.mcap", b"no recording")
    address = cluster(**environment)
    arguments = ("batch", "poses", "s3://line/2026", "-o", tmp_path / "t.csv", "--scheduler", address)
    done = triaxcal(*arguments)
    assert done.code == 2
    rows = rows_of(tmp_path / "t.csv")
    assert [r["recording"] for r in rows] == [
        "s3://line/2026/broken.mcap", *(f"s3://line/2026/r{i}.csv.gz" for i in range(4)),
    ]  # fmt: skip
    assert {r["poses"] for r in rows[1:]} == {"14"}
    assert len({r["stamp"] for r in rows[1:]}) == 1  # the ETag of the same bytes
    store.pipe("line/2026/r2.csv.gz", CAN.read_bytes())
    triaxcal(*arguments, "--resume")
    again = rows_of(tmp_path / "t.csv")
    assert [a == b for a, b in zip(rows, again, strict=True)] == [True, True, True, False, True]
    assert again[3]["exit_code"] == "2"


def test_an_audit_reads_recording_and_sidecars_from_the_bucket(
    bucket: Any, tmp_path: Path, triaxcal: Callable[..., Any]
) -> None:
    store, _ = bucket
    store.pipe("line/a.mcap", CAN.read_bytes())
    store.pipe("line/a.certificate.json", b"{}")
    done = triaxcal("audit", "s3://line/*.mcap", "-o", tmp_path / "t.csv")
    assert done.code == 1
    [row] = rows_of(tmp_path / "t.csv")
    assert (row["result"], row["verdict"], row["differences"]) == ("differs", "pass", "1")
    assert row["first_difference"] == "a.certificate.json: the file beside the recording is not the one in it"
    triaxcal("audit", "s3://line/none.mcap").failed(2, "s3://line/none.mcap", "no such file in the store")
    triaxcal("audit", "s3://nobody/").failed(2, "s3://nobody/")
