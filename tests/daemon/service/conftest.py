"""Databases of the service: SQLite, and a PostgreSQL server of these tests' own."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from triaxcald.documents import to_text
from triaxcald.outcome import Ending, Papers, outcome_document
from triaxcald.provision.state import Held
from triaxcald.schema.codes import Code, Verdict
from triaxcald.schema.outcome import Measured
from triaxcald.service.ledger import Ledger
from triaxcald.software import new_run_id
from triaxcald.station.config import Station, load_station
from triaxcald.work import Attempt, Work

REQUIRED = "TRIAXCAL_POSTGRES"
"""Is `required` where the tests may not do without the server."""


def _programs() -> Path | None:
    """The folder of initdb, also where Debian keeps it."""
    if found := shutil.which("initdb"):
        return Path(found).parent
    return next(iter(sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True)), None)


@pytest.fixture(scope="session")
def postgresql() -> Iterator[str]:
    """URL of a server's superuser, without the name of a database."""
    programs = _programs()
    if programs is None or (os.geteuid() == 0 and not shutil.which("runuser")):
        if os.environ.get(REQUIRED) == "required":
            pytest.fail("there is no PostgreSQL server")
        pytest.skip("there is no PostgreSQL server")
    # The server does not run as root.
    who = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
    folder = Path(tempfile.mkdtemp(prefix="triaxcal-postgresql-", dir="/tmp"))  # a socket's path is short
    if who:
        shutil.chown(folder, "postgres", "postgres")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    def call(program: str, *arguments: str) -> None:
        command = [*who, str(programs / program), *arguments]
        subprocess.run(command, check=True, capture_output=True, cwd=folder, timeout=180)

    data = str(folder / "data")
    options = f"-c listen_addresses=127.0.0.1 -c port={port} -c unix_socket_directories={folder} -c fsync=off"
    call("initdb", "-D", data, "-U", "postgres", "-A", "trust", "-E", "UTF8", "--no-sync")
    call("pg_ctl", "-D", data, "-w", "-l", str(folder / "log"), "-o", options, "start")
    try:
        yield f"postgresql://postgres@127.0.0.1:{port}"
    finally:
        call("pg_ctl", "-D", data, "-m", "immediate", "stop")
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(params=["sqlite", "postgresql"])
def database(request: pytest.FixtureRequest) -> str | None:
    """A database that is empty: None for SQLite in the folder, else its URL."""
    if request.param == "sqlite":
        return None
    import psycopg

    server: str = request.getfixturevalue("postgresql")
    name = f"t{os.getpid()}_{abs(hash(request.node.nodeid))}"
    with psycopg.connect(f"{server}/postgres", autocommit=True) as connection:
        connection.execute(f'CREATE DATABASE "{name}"')
    return f"{server}/{name}"


STATION = """\
format = "triaxcal.station/1"
name = "line 1"
folder = "{folder}"

[limits]
rms_g = 1e-4

{more}

[[units]]
name = "a"
profile = "triax-ref-modbus"
bus = {{ host = "127.0.0.1", port = 5020 }}

[[units]]
name = "b"
profile = "triax-ref-modbus"
bus = {{ host = "127.0.0.1", port = 5021 }}
"""


@pytest.fixture
def make_station(tmp_path: Path) -> Callable[..., Station]:
    """A station file with ``more`` in it."""

    def make(more: str = "", name: str = "line 1", folder: str = ".") -> Station:
        path = tmp_path / "station.toml"
        path.write_text(STATION.format(more=more, folder=folder).replace("line 1", name))
        return load_station(path)

    return make


@pytest.fixture
def open_ledger(database: str | None) -> Iterator[Callable[[Station], Ledger]]:
    opened: list[Ledger] = []

    def make(station: Station) -> Ledger:
        opened.append(Ledger.open(station, database))
        return opened[-1]

    yield make
    for ledger in opened:
        ledger.close()


START = datetime(2030, 1, 1, tzinfo=UTC)
FIGURES = {"rms_g": 2e-5, "max_abs_g": 5e-5, "cross_validated_rms_g": 3e-5, "noise_floor_g": 5e-6, "lack_of_fit_p": 0.4}


def outcome(number: int, code: Code = Code.WITHIN_LIMITS, **changes: Any) -> dict[str, Any]:
    """An outcome, with a fit where the code has one. ``changes`` are of the work, or the ``serial`` of the unit."""
    serial = changes.pop("serial", str(1000 + number))
    begun = START + timedelta(minutes=number)
    work = replace(Work("ab"[number % 2], serial, operator="A", order="WO 1", attempt=1), **changes)
    measured = None
    if code.verdict is not Verdict.ABORTED:
        three = [number * 1e-3, 0.0, -1e-3]
        linear = {"scale_factor": [1.0, 1.01, 0.99], "misalignment": three, "bias": three}
        measured = Measured.model_validate(
            {
                "raw_sha256": "0" * 64, "poses": 26, "before": FIGURES, "after": {**FIGURES, "rms_g": 1e-5},
                "terms": ["linear"], "left_to_host": [],
                "calibration": {**linear, "standard_error": dict.fromkeys(linear, [1e-5] * 3)},
            }
        )  # fmt: skip
    return dict(
        outcome_document(
            Ending(code.verdict, "a reason", code.exit_code or 0, code),
            Held(),
            Papers(measured=measured, limits={"rms_g": 1e-4}),
            unit=work.slot,
            serial=serial,
            station="line 1",
            ended=(begun + timedelta(seconds=50)).isoformat(timespec="milliseconds"),
            software={"triaxcal": "0.2.0"},
            supersedes=None,
            attempt=Attempt(new_run_id(int(begun.timestamp() * 1e9)), begun.isoformat(timespec="milliseconds"), work),
        )
    )


def put_outcome(folder: Path, number: int, code: Code = Code.WITHIN_LIMITS, **changes: Any) -> dict[str, Any]:
    """Write an outcome as a run leaves it."""
    document = outcome(number, code, **changes)
    (folder / f"{document['unit']}-{document['serial']}-{number:06d}.outcome.json").write_text(to_text(document))
    return document
