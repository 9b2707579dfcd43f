"""Two processes: at one device, or on one serial port, the second says who holds it; on one bus both go on."""

from __future__ import annotations

import asyncio
import json
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

Run = Callable[..., Any]
DEADLINE_S = 180.0
CAL = {
    "format": "triaxcal.calibration/1",
    "scale_factor": [-2.41, -2.405, -2.37],
    "misalignment": [0.006, 0.004, -0.001],
    "bias": [0.005, -0.003, 0.004],
    "effects": {},
}
COMMANDS = ("run", "record", "provision", "registers")
ENDLESS = {"poses": 26, "hold_s": 1.0, "patience_s": 1e6}


def _arguments(command: str, workshop: Any, station: Path) -> list[Any]:
    output = workshop.folder / f"{command}.mcap"
    return {
        "run": ["run", station],
        "record": ["record", station, "-o", output, "--seconds", 1],
        "provision": ["provision", workshop.write("cal.json", json.dumps(CAL)), station],
        "registers": ["registers", station],
    }[command]


@contextmanager
def _hesitating(served: Any) -> Iterator[tuple[threading.Event, threading.Event]]:
    """The unit answers no request until it is told to: the events say that one has come, and that it may go on."""
    asked, go_on = threading.Event(), threading.Event()
    alive = served.unit.alive

    def wait(unit_time_s: float) -> bool:
        asked.set()
        go_on.wait(DEADLINE_S)
        return bool(alive(unit_time_s))

    served.unit.alive = wait
    try:
        yield asked, go_on
    finally:
        go_on.set()


def _patient_profile(workshop: Any) -> str:
    """Waits for a reply as long as a test may take."""
    from triaxcal_drivers.catalogue import BUILT_IN

    text = (BUILT_IN / "triax-ref-modbus.toml").read_text()
    assert "[sampling]\n" in text
    return workshop.write("patient.toml", text.replace("[sampling]\n", "[sampling]\nreply_timeout_s = 100.0\n")).name


@pytest.fixture(params=["tcp", "rtu"])
def buses(request: pytest.FixtureRequest, tmp_path: Path) -> Any:
    """The bus as the unit names it, and what the station says otherwise; what the refusal calls it."""
    if request.param == "tcp":
        return {"host": "127.0.0.1", "port": 0}, {}, "Modbus unit 1, TCP port "
    line = tmp_path / "line"
    return (
        {"serial_port": f"pty:{line}"},
        {"serial_port": str(line), "baudrate": 115200, "parity": "N"},
        "serial port /dev/pts/",
    )


@pytest.mark.slow
@pytest.mark.parametrize("holder", COMMANDS)
def test_of_two_commands_at_one_device_the_first_goes_on_and_the_second_says_who_that_is(
    workshop: Any, triaxcal: Run, start: Run, buses: Any, holder: str
) -> None:
    unit_bus, station_bus, what = buses
    with workshop.serve(workshop.device(bus=unit_bus, speed=2.0)) as served, _hesitating(served) as (asked, go_on):
        unit = {"bus": {**served.bus, **station_bus}, "profile": _patient_profile(workshop)}
        station = workshop.station(unit, plan=ENDLESS)
        first = start(*_arguments(holder, workshop, station))
        assert asked.wait(DEADLINE_S), first.err
        for command in COMMANDS:
            done = triaxcal(*_arguments(command, workshop, station))
            done.failed(4, what, f" is in use by `triaxcal {holder} ", f", pid {first.pid}, since 20")
        assert list(workshop.folder.glob("*.mcap")) == []
        go_on.set()
        if holder == "run":
            first.says("poses: ")
            first.send(signal.SIGINT)
        assert first.wait() == (130 if holder == "run" else 0), first.err
        assert triaxcal("registers", station).code == 0


@pytest.mark.slow
def test_a_command_that_is_killed_holds_nothing_any_more(workshop: Any, triaxcal: Run, start: Run) -> None:
    with workshop.serve(workshop.device()) as served, _hesitating(served) as (asked, go_on):
        station = workshop.station({"bus": served.bus, "profile": _patient_profile(workshop)})
        first = start("provision", workshop.write("cal.json", json.dumps(CAL)), station)
        assert asked.wait(DEADLINE_S), first.err
        first.send(signal.SIGKILL)
        first.wait()
        go_on.set()
        assert triaxcal("registers", station).code == 0


async def _route(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, ports: dict[int, int], opened: list[Any]
) -> None:
    """One client of the gateway: each request to the unit that it names, each reply back."""
    behind: dict[int, Any] = {}
    try:
        while True:
            head = await reader.readexactly(7)
            request = head + await reader.readexactly(int.from_bytes(head[4:6], "big") - 1)
            if head[6] not in behind:
                behind[head[6]] = await asyncio.open_connection("127.0.0.1", ports[head[6]])
                opened.append(behind[head[6]][1])
            replies, requests = behind[head[6]]
            requests.write(request)
            reply = await replies.readexactly(6)
            writer.write(reply + await replies.readexactly(int.from_bytes(reply[4:6], "big")))
    except (asyncio.IncompleteReadError, ConnectionError):
        writer.close()


@contextmanager
def _gateway(ports: dict[int, int]) -> Iterator[int]:
    """A TCP port behind which the units of ``ports`` are, by their unit ids."""
    loop, opened = asyncio.new_event_loop(), []
    thread = threading.Thread(target=loop.run_forever)
    thread.start()

    async def listen() -> asyncio.Server:
        return await asyncio.start_server(lambda r, w: _route(r, w, ports, opened), "127.0.0.1", 0)

    async def end(server: asyncio.Server) -> None:
        server.close()
        for writer in opened:
            writer.close()

    server = asyncio.run_coroutine_threadsafe(listen(), loop).result(DEADLINE_S)
    try:
        yield int(server.sockets[0].getsockname()[1])
    finally:
        asyncio.run_coroutine_threadsafe(end(server), loop).result(DEADLINE_S)
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


@pytest.mark.slow
def test_two_commands_at_two_units_of_one_gateway_both_go_on(workshop: Any, triaxcal: Run, start: Run) -> None:
    buses = [{"host": "127.0.0.1", "port": 0, "unit_id": i} for i in (1, 2)]
    devices = [workshop.device(f"{b['unit_id']}.toml", serial=4710 + b["unit_id"], bus=b) for b in buses]
    with (
        workshop.serve(devices[0]) as one,
        workshop.serve(devices[1]) as two,
        _hesitating(one) as (asked, go_on),
        _gateway({1: one.bus["port"], 2: two.bus["port"]}) as port,
    ):
        profile = _patient_profile(workshop)
        stations = [
            workshop.station({"profile": profile, "bus": {**b, "port": port}}, name=f"station{b['unit_id']}.toml")
            for b in buses
        ]
        first = start("registers", stations[0], "--json")
        assert asked.wait(DEADLINE_S), first.err
        second = triaxcal("registers", stations[1], "--json")
        assert (second.code, second.json["serial"]) == (0, "4712")
        go_on.set()
        assert first.wait() == 0, first.err
        assert json.loads(first.out)["serial"] == "4711"


@pytest.mark.slow
def test_two_commands_at_two_nodes_of_one_can_bus_both_go_on(
    workshop: Any, triaxcal: Run, start: Run, free_port: int, multicast_fault: str | None
) -> None:
    if multicast_fault is not None:
        pytest.skip(f"multicast does not work on this machine: {multicast_fault}")
    bus = {"interface": "udp_multicast", "channel": "239.74.163.2", "options": {"port": free_port}}
    places = [{**bus, "node_id": node} for node in (5, 6)]
    devices = [
        workshop.device(f"{place['node_id']}.toml", profile="triax-ref-can", bus=place, speed=1.0) for place in places
    ]
    stations = [
        workshop.station({"profile": "triax-ref-can", "bus": place}, name=f"station{place['node_id']}.toml")
        for place in places
    ]
    with workshop.serve(devices[0]), workshop.serve(devices[1]):
        first = start("record", stations[0], "-o", workshop.folder / "rec.mcap")
        first.says("recording")
        assert triaxcal("registers", stations[1]).code == 0
        same = workshop.station({"profile": "triax-ref-can", "bus": {**places[0], "bitrate": 500_000}})
        triaxcal("registers", same).failed(4, "node 5 on udp_multicast 239.74.163.2", f"pid {first.pid}, ")
        first.send(signal.SIGINT)
        assert first.wait() == 130
