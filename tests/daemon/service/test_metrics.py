"""Numbers for Prometheus, read by its own parser, and the health page."""

from __future__ import annotations

import errno
import http.client
import json
import socket
import struct
import threading
import urllib.error
import urllib.request
from dataclasses import replace
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from triaxcald.errors import InputError, StationError
from triaxcald.run.record_only import State, UnitStatus
from triaxcald.service.supervisor import served

COUNTS = {"samples": 1000, "missing": 7, "errors": 2, "malformed": 4}


def status(
    unit: str, state: State = State.RECORDING, trouble: str | None = None, path: Path | None = None
) -> UnitStatus:
    last_ns = 1_700_000_000_500_000_000
    return UnitStatus(unit, state, trouble, path, 2000, COUNTS, 3, 4.5, 6, last_ns, {"temp_c": 24.5}, queued=8)


def fetched(port: int, path: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=180) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as e:
        return e.code, e.read().decode()


def samples(text: str) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_each_unit_has_its_numbers(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(bytes(123))
    units = [status("a", path=tmp_path / "a.mcap"), status('b"\\', State.WAITING, "nothing answers")]
    with served(0, lambda: units, tmp_path) as port:
        code, text = fetched(port, "/metrics")
    assert code == 200
    found = samples(text)
    of_a = {name: value for (name, labels), value in found.items() if labels == (("unit", "a"),)}
    assert of_a == {
        "triaxcal_unit_recording": 1.0,
        "triaxcal_records_total": 2000.0,
        "triaxcal_lost_records_total": 6.0,
        "triaxcal_gaps_total": 3.0,
        "triaxcal_gap_seconds_total": 4.5,
        "triaxcal_queued_batches": 8.0,
        "triaxcal_last_record_timestamp_seconds": 1_700_000_000.5,
        "triaxcal_recording_bytes": 123.0,
        "triaxcal_samples_total": 1000.0,
        "triaxcal_missing_total": 7.0,
        "triaxcal_duplicates_total": 0.0,
        "triaxcal_incomplete_total": 0.0,
        "triaxcal_errors_total": 2.0,
        "triaxcal_malformed_total": 4.0,
    }
    assert found["triaxcal_unit_recording", (("unit", 'b"\\'),)] == 0.0
    assert found["triaxcal_channel", (("channel", "temp_c"), ("unit", "a"))] == 24.5
    assert found["triaxcal_disk_free_bytes", ()] > 0


def test_a_bus_has_its_numbers_and_none_of_a_unit_s(tmp_path: Path) -> None:
    counts = {"frames": 1998, "identifiers": 12, "errors": 2}
    bus = replace(status("all"), counts=counts, latest={}, kind="bus")
    with served(0, lambda: [bus, status("a")], tmp_path) as port:
        _, text = fetched(port, "/metrics")
        _, health = fetched(port, "/health")
    found = samples(text)
    of_bus = {name: value for (name, labels), value in found.items() if labels == (("unit", "all"),)}
    assert of_bus == {
        "triaxcal_unit_recording": 1.0,
        "triaxcal_records_total": 2000.0,
        "triaxcal_lost_records_total": 6.0,
        "triaxcal_gaps_total": 3.0,
        "triaxcal_gap_seconds_total": 4.5,
        "triaxcal_queued_batches": 8.0,
        "triaxcal_last_record_timestamp_seconds": 1_700_000_000.5,
        "triaxcal_identifiers": 12.0,
        "triaxcal_errors_total": 2.0,
    }
    assert ("triaxcal_identifiers", (("unit", "a"),)) not in found
    assert [(u["unit"], u["kind"]) for u in json.loads(health)["units"]] == [("all", "bus"), ("a", "unit")]


@pytest.mark.parametrize(
    ("units", "code"),
    [
        ([status("a")], 200),
        ([status("a"), status("b", State.WAITING, "nothing answers at node 5")], 503),
        ([status("a", State.ENDED)], 503),
        ([], 503),
    ],
)
def test_health_is_that_of_the_worst_unit(tmp_path: Path, units: list[UnitStatus], code: int) -> None:
    with served(0, lambda: units, tmp_path) as port:
        found, text = fetched(port, "/health")
    assert found == code
    document = json.loads(text)
    assert document["healthy"] is (code == 200)
    assert [(u["unit"], u["state"], u["trouble"]) for u in document["units"]] == [
        (u.unit, u.state.value, u.trouble) for u in units
    ]


def test_the_page_shows_what_is_the_matter_and_runs_no_script_of_it(tmp_path: Path) -> None:
    units = [status("a", State.WAITING, "<script>alert(1)</script>")]
    with served(0, lambda: units, tmp_path) as port:
        code, text = fetched(port, "/")
        missing, _ = fetched(port, "/nothing")
    assert (code, missing) == (200, 404)
    assert "&lt;script&gt;" in text
    assert "<script>" not in text


def test_who_asks_for_the_head_alone_gets_no_body(tmp_path: Path) -> None:
    with served(0, lambda: [status("a")], tmp_path) as port:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=180)
        connection.request("HEAD", "/health")
        answer = connection.getresponse()
        assert (answer.status, answer.read()) == (200, b"")
        assert int(answer.headers["Content-Length"]) > 0


def test_a_client_that_says_nothing_is_let_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("triaxcald.service.supervisor.IDLE_S", 0.05)
    with served(0, list, tmp_path) as port, socket.create_connection(("127.0.0.1", port), timeout=180) as idle:
        assert idle.recv(1) == b""


def test_of_a_client_that_has_gone_nothing_is_said(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    asked, gone = threading.Event(), threading.Event()

    def late() -> list[UnitStatus]:
        asked.set()
        assert gone.wait(10)
        return [status("a")]

    with served(0, late, tmp_path) as port:
        client = socket.create_connection(("127.0.0.1", port), timeout=180)
        client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closed by a reset
        client.sendall(b"GET /health HTTP/1.0\r\n\r\n")
        assert asked.wait(10)
        client.close()
        gone.set()
        fetched(port, "/health")
    assert capfd.readouterr().err == ""


def test_a_port_that_is_taken_is_said_in_a_line_and_tried_again_by_a_service(tmp_path: Path) -> None:
    with (
        served(0, list, tmp_path) as port,
        pytest.raises(StationError, match=rf"^--metrics {port}: cannot listen on ") as taken,
        served(port, list, tmp_path),
    ):
        pass
    assert taken.value.exit_code == 4, "the unit of systemd starts 2 no second time"


def test_a_port_that_this_user_may_not_have_is_bad_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("triaxcald.service.supervisor._Server", refused)
    with pytest.raises(InputError, match=r"^--metrics 80: "), served(80, list, tmp_path):
        pass
