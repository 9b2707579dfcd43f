"""The runs of all stations on one server, as `fleet` reads them."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import psycopg
import pytest

from tests.daemon.fleet.worlds import line, write
from triaxcald.errors import InputError
from triaxcald.fleet import Selection, read_runs
from triaxcald.service.ledger import Ledger

pytestmark = pytest.mark.slow


def test_two_stations_on_a_server_are_one_fleet(postgresql: str, tmp_path: Path) -> None:
    with psycopg.connect(f"{postgresql}/postgres", autocommit=True) as connection:
        connection.execute("CREATE DATABASE fleet")
    url = f"{postgresql}/fleet"
    with pytest.raises(InputError, match="no table of runs"):
        read_runs(url, Selection())
    documents = line(20)
    for station in ("line1", "line2"):
        folder = write(tmp_path / station, [d for d in documents if d["station"] == station])
        with closing(Ledger.of_folder(folder, station, url)) as ledger:
            ledger.take()
    found = read_runs(url, Selection())
    here = read_runs(str(write(tmp_path / "all", documents)), Selection())
    ours, theirs = ({row["run"]: row["bias_y"] for row in of.rows} for of in (here, found))
    assert theirs == ours
    assert len(read_runs(url, Selection(equal={"station": "line2"})).rows) < len(found.rows)
    middle = found.rows[20]["at_us"]
    assert len(read_runs(url, Selection(until_us=middle)).rows) == 20
