"""`/health` and `/metrics` of a station's service, for whoever watches machines."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Iterator
from contextlib import suppress
from typing import Any, Final, Protocol

from fastapi import APIRouter, Request, Response
from fastapi.responses import JSONResponse
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from prometheus_client.registry import Collector

from triaxcald.schema.codes import Verdict
from triaxcald.schema.station_state import SlotIs
from triaxcald.service.api import Access
from triaxcald.service.floor import Floor
from triaxcald.service.ledger import Ledger
from triaxcald.service.outbox import Outbox

TICK_S: Final = 0.05
"""From one look at the event loop to the next."""


class LoopLateness:
    """How late the event loop is: something that blocks it delays the units at work and
    the pages. ``worst_s`` is the greatest lateness since `watch` began."""

    def __init__(self) -> None:
        self.worst_s = 0.0

    async def watch(self) -> None:
        """Look until cancelled."""
        loop = asyncio.get_running_loop()
        while True:
            due_s = loop.time() + TICK_S
            await asyncio.sleep(TICK_S)
            self.worst_s = max(self.worst_s, loop.time() - due_s)


class Monitored(Protocol):
    @property
    def floor(self) -> Floor: ...

    @property
    def access(self) -> Access: ...

    @property
    def ledger(self) -> Ledger: ...

    @property
    def outbox(self) -> Outbox: ...

    @property
    def lateness(self) -> LoopLateness: ...


def health(service: Monitored) -> dict[str, Any]:
    """``healthy`` where the next tray could start, and the database was not lost since
    the service began: ``database_lost`` says what people have to do."""
    floor, deliveries, lost = service.floor, service.outbox.status(), service.ledger.lost
    return {
        "format": "triaxcal.health/1",
        "healthy": floor.blocked is None and lost is None,
        "blocked": floor.blocked,
        "database_lost": lost,
        "slots": [{"slot": s.slot, "state": s.state.value, "serial": s.serial} for s in floor.desk.slots.values()],
        "runs": dict(floor.counts),
        "outbox": [d.document() for d in deliveries],
        "listeners": floor.stream.listeners,
    }


class StationMetrics(Collector):
    def __init__(self, service: Monitored) -> None:
        self._service = service

    def collect(self) -> Iterator[Metric]:
        floor = self._service.floor
        slots = GaugeMetricFamily("triaxcal_slots", "Slots by their state", labels=["state"])
        states = [slot.state for slot in floor.desk.slots.values()]
        for state in SlotIs:
            slots.add_metric([state.value], states.count(state))
        runs = CounterMetricFamily("triaxcal_runs", "Runs that ended since the service began", labels=["verdict"])
        for verdict in Verdict:
            runs.add_metric([verdict.value], floor.counts.get(verdict.value, 0))
        waiting = GaugeMetricFamily("triaxcal_outbox_waiting", "Results that wait for a receiver", labels=["receiver"])
        refused = GaugeMetricFamily("triaxcal_outbox_refused", "Results that a receiver refused", labels=["receiver"])
        age = GaugeMetricFamily(
            "triaxcal_outbox_age_seconds", "Age of the oldest result that waits", labels=["receiver"]
        )
        for d in self._service.outbox.status():
            waiting.add_metric([d.receiver], d.waiting)
            refused.add_metric([d.receiver], d.refused)
            age.add_metric([d.receiver], d.oldest_s)
        listeners = GaugeMetricFamily("triaxcal_listeners", "Open event streams")
        listeners.add_metric([], floor.stream.listeners)
        blocked = GaugeMetricFamily("triaxcal_blocked", "1 while no tray can start")
        blocked.add_metric([], float(floor.blocked is not None))
        late = GaugeMetricFamily("triaxcal_loop_late_seconds", "Greatest lateness of the event loop since the start")
        late.add_metric([], self._service.lateness.worst_s)
        losses = CounterMetricFamily(
            "triaxcal_database_losses", "Times the database was damaged or removed since the service began"
        )
        losses.add_metric([], self._service.ledger.losses)
        free = GaugeMetricFamily("triaxcal_disk_free_bytes", "Where recordings go")
        with suppress(OSError):
            free.add_metric([], shutil.disk_usage(floor.station.folder).free)
        yield from (slots, runs, waiting, refused, age, listeners, blocked, late, losses, free)


def monitoring_router(service: Monitored) -> APIRouter:
    router, registry = APIRouter(), CollectorRegistry(auto_describe=False)
    registry.register(StationMetrics(service))

    @router.get("/health", include_in_schema=False)
    async def get_health(request: Request) -> JSONResponse:
        await service.access.require(request, "reader")
        document = await asyncio.to_thread(health, service)
        return JSONResponse(document, 200 if document["healthy"] else 503)

    @router.get("/metrics", include_in_schema=False)
    async def get_metrics(request: Request) -> Response:
        await service.access.require(request, "reader")
        return Response(await asyncio.to_thread(generate_latest, registry), media_type=CONTENT_TYPE_LATEST)

    return router
