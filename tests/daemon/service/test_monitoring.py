"""`/health` and `/metrics` of a station's service whose database is lost while it works."""

from __future__ import annotations

import json
import os
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.daemon.service.page.stage import Stage, station_file
from triaxcald.store import FILE_NAME


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    stage = Stage(station_file(tmp_path, "ab"))
    stage.begin()
    yield stage
    stage.end()


def health(stage: Stage) -> tuple[int, dict[str, Any]]:
    try:
        with urllib.request.urlopen(f"{stage.url}/health", timeout=180) as answer:
            return answer.status, json.loads(answer.read())
    except urllib.error.HTTPError as e:
        return e.code, json.loads(e.read())


def losses(stage: Stage) -> float:
    with urllib.request.urlopen(f"{stage.url}/metrics", timeout=180) as answer:
        families = text_string_to_metric_families(answer.read().decode())
    (found,) = [s.value for family in families for s in family.samples if s.name == "triaxcal_database_losses_total"]
    return found


def lose(folder: Path) -> None:
    """As another process that sets a damaged file aside."""
    for end in ("-wal", "-shm", ""):
        if os.path.exists(path := f"{folder / FILE_NAME}{end}"):
            os.replace(path, f"{folder / FILE_NAME}.damaged{end}")


def test_a_database_that_is_lost_at_work_is_told_until_the_service_starts_anew(stage: Stage) -> None:
    folder = stage.station.parent / "out"
    stage.ledger.trail("2026-01-31T12:00:00.000+00:00", "A", "engineer", "people_add", {"name": "A"}, True, None)
    code, document = health(stage)
    assert (code, document["healthy"], document["database_lost"], losses(stage)) == (200, True, None, 0)
    lose(folder)
    assert stage.ledger.last_seq() == 0  # whatever asks the database finds out
    code, document = health(stage)
    assert (code, document["healthy"], document["blocked"]) == (503, False, None)
    assert document["database_lost"] == stage.ledger.lost
    assert str(folder / FILE_NAME) in document["database_lost"]
    assert losses(stage) == 1
    lose(folder)
    stage.ledger.last_seq()
    assert losses(stage) == 2
    stage.end()
    stage.begin()
    code, document = health(stage)
    assert (code, document["database_lost"], losses(stage)) == (200, None, 0)
