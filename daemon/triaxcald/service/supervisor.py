"""Reports to systemd (sd_notify(3)) that the service is ready, alive or stopping, and
serves its metrics."""

from __future__ import annotations

import asyncio
import errno
import html
import json
import os
import shutil
import socket
import sys
import threading
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from prometheus_client.registry import Collector

import triaxcal_drivers as td
from triaxcald.errors import InputError, StationError
from triaxcald.run.record_only import State, UnitStatus

_SHARE = 3.0
"""Signs of life per watchdog time, so that one may be late."""
_QUIET_S = 10.0
"""Period of the status reports without a watchdog."""


class Supervisor:
    """The supervisor that started this process, if it wants reports."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = environment.get("NOTIFY_SOCKET", "")
        meant_for = environment.get("WATCHDOG_PID", str(os.getpid()))
        watchdog_us = environment.get("WATCHDOG_USEC", "") if meant_for == str(os.getpid()) else ""
        self.watchdog_s = int(watchdog_us) / 1e6 if watchdog_us.isdigit() and int(watchdog_us) else None

    def tell(self, **said: str) -> None:
        """Each as a variable of its own; nowhere where nobody wants to hear, or
        nobody reads: nothing waits for it."""
        if not self._address:
            return
        address = "\0" + self._address[1:] if self._address.startswith("@") else self._address
        text = "\n".join(f"{name}={' '.join(value.split())}" for name, value in said.items())
        with (
            suppress(OSError),
            socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK) as out,
        ):
            out.sendto(text.encode(), address)

    @asynccontextmanager
    async def kept_informed(self, status: Callable[[], str]) -> AsyncIterator[None]:
        """That the service is up, then again and again that it lives: from the
        event loop, so that a loop that hangs is found out."""

        async def live() -> None:
            while True:
                self.tell(WATCHDOG="1", STATUS=status())
                await asyncio.sleep(_QUIET_S if self.watchdog_s is None else self.watchdog_s / _SHARE)

        self.tell(READY="1")
        living = asyncio.ensure_future(live())
        try:
            yield
        finally:
            living.cancel()
            self.tell(STOPPING="1")


# Numbers for Prometheus and a page for people, on the loopback: how recordings
# stand.

IDLE_S = 10.0
"""A client that says nothing for so long is let go: each holds a descriptor,
which the recording may need."""
Statuses = Callable[[], Sequence[UnitStatus]]

_COUNTED = {
    "samples": "Samples of the readings",
    "missing": "Samples missing by the unit's own count",
    "duplicates": "Samples that came twice",
    "incomplete": "Samples of which a part was missing",
    "errors": "Error frames and failed requests",
    "malformed": "Records too short for their message, or not as it is defined",
}
_OF_A_BUS = ("errors",)
"""Counts of the recording of a bus."""


class UnitMetrics(Collector):
    """Metrics of the recordings; the free space is that of the file system of
    ``folder``."""

    def __init__(self, statuses: Statuses, folder: Path) -> None:
        self._statuses, self._folder = statuses, folder

    def collect(self) -> Iterator[Metric]:
        units = self._statuses()
        recording = GaugeMetricFamily(
            "triaxcal_unit_recording", "1 while samples come, or the bus is there", labels=["unit"]
        )
        records = CounterMetricFamily("triaxcal_records", "Raw records that were recorded", labels=["unit"])
        lost = CounterMetricFamily("triaxcal_lost_records", "Records lost between bus and disk", labels=["unit"])
        gaps = CounterMetricFamily("triaxcal_gaps", "Interruptions and losses on the bus", labels=["unit"])
        gaps_s = CounterMetricFamily("triaxcal_gap_seconds", "Time in which the unit was lost", labels=["unit"])
        last = GaugeMetricFamily(
            "triaxcal_last_record_timestamp_seconds", "Host time of the last record", labels=["unit"]
        )
        queued = GaugeMetricFamily("triaxcal_queued_batches", "What waits for the disk", labels=["unit"])
        size = GaugeMetricFamily("triaxcal_recording_bytes", "Size of the recording's file", labels=["unit"])
        channel = GaugeMetricFamily(
            "triaxcal_channel", "Last value of another channel, the temperature among them", labels=["unit", "channel"]
        )
        identifiers = GaugeMetricFamily("triaxcal_identifiers", "Different ones that came on a bus", labels=["unit"])
        counted = {
            name: CounterMetricFamily(f"triaxcal_{name}", text, labels=["unit"]) for name, text in _COUNTED.items()
        }
        for u in units:
            recording.add_metric([u.unit], float(u.state is State.RECORDING))
            records.add_metric([u.unit], u.records)
            lost.add_metric([u.unit], u.lost)
            gaps.add_metric([u.unit], u.gaps)
            gaps_s.add_metric([u.unit], u.gaps_s)
            queued.add_metric([u.unit], u.queued)
            if u.last_ns is not None:
                last.add_metric(
                    [u.unit], (u.last_ns + td.host_clock.HOST.steps_ns()) / 1e9
                )  # as the host's clock has it
            if u.path is not None:
                with suppress(OSError):  # it was taken away: that is seen elsewhere
                    size.add_metric([u.unit], u.path.stat().st_size)
            for name, value in u.latest.items():
                channel.add_metric([u.unit, name], value)
            if u.kind == "bus":
                identifiers.add_metric([u.unit], u.counts["identifiers"])
            for name, family in counted.items():
                if u.kind == "unit" or name in _OF_A_BUS:
                    family.add_metric([u.unit], u.counts.get(name, 0))
        yield from (
            recording, records, lost, gaps, gaps_s, queued, last, size, channel, identifiers, *counted.values(),
        )  # fmt: skip
        free = GaugeMetricFamily("triaxcal_disk_free_bytes", "Where recordings go")
        with suppress(OSError):
            free.add_metric([], shutil.disk_usage(self._folder).free)
        yield free


def health(units: Sequence[UnitStatus]) -> dict[str, Any]:
    """``healthy`` where every unit and bus is there and is recorded; not before
    there is any."""
    return {
        "format": "triaxcal.health/1",
        "healthy": bool(units) and all(u.state is State.RECORDING for u in units),
        "units": [
            {
                "unit": u.unit,
                "kind": u.kind,
                "state": u.state.value,
                "trouble": u.trouble,
                "recording": str(u.path) if u.path else None,
                "records": u.records,
                "gaps": u.gaps,
                "lost": u.lost,
            }
            for u in units
        ],
    }


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Drop the error of a client that has disconnected: standard error belongs to
        the recording."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


@contextmanager
def served(port: int, statuses: Statuses, folder: Path) -> Iterator[int]:
    """``/metrics``, ``/health`` (503 where a unit is lost) and ``/`` on the
    loopback; the port, which the system chooses where ``port`` is 0. Raises
    StationError where it is taken, which may pass, InputError where this user
    may never have it."""
    registry = CollectorRegistry(auto_describe=False)
    registry.register(UnitMetrics(statuses, folder))

    class Page(BaseHTTPRequestHandler):
        timeout = IDLE_S

        def do_HEAD(self) -> None:
            self.do_GET()

        def do_GET(self) -> None:
            path = self.path.partition("?")[0]
            if path == "/metrics":
                self._answer(200, CONTENT_TYPE_LATEST, generate_latest(registry))
            elif path == "/health":
                document = health(statuses())
                body = json.dumps(document, indent=2).encode()
                self._answer(200 if document["healthy"] else 503, "application/json", body)
            elif path == "/":
                self._answer(200, "text/html; charset=utf-8", _page(statuses()).encode())
            else:
                self._answer(404, "text/plain", b"/, /health and /metrics are here\n")

        def _answer(self, code: int, kind: str, body: bytes) -> None:
            self.send_response(code)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing: standard error belongs to the recording."""

    try:
        server = _Server(("127.0.0.1", port), Page)
    except OSError as e:
        kind = StationError if e.errno == errno.EADDRINUSE else InputError
        raise kind(f"--metrics {port}: cannot listen on 127.0.0.1: {e.strerror}") from e
    threading.Thread(target=server.serve_forever, name="metrics", daemon=True).start()
    try:
        yield server.server_address[1]
    finally:
        server.shutdown()
        server.server_close()


def _page(units: Sequence[UnitStatus]) -> str:
    rows = "".join(
        "<tr>"
        + "".join(
            f"<td>{html.escape(str(cell))}</td>"
            for cell in (u.unit, u.state.value, u.records, u.gaps, u.lost, u.path or "", u.trouble or "")
        )
        + "</tr>"
        for u in units
    )
    heads = "".join(
        f"<th>{name}</th>" for name in ("unit", "state", "records", "gaps", "lost records", "recording", "trouble")
    )
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><meta http-equiv="refresh" content="5">'
        "<title>triaxcal record</title><style>body{font-family:sans-serif}td,th{padding:.2em 1em;text-align:left}"
        f"</style><h1>triaxcal record</h1><table><tr>{heads}</tr>{rows}</table></html>\n"
    )
