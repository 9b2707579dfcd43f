"""Several units on one fixture, on real buses, read by the real drivers."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import triaxcal as tc
from tests.daemon.simulation.test_operating import HEAD, angle_deg, instruction, poses, stage
from triaxcal_drivers.errors import DeviceSilent
from triaxcal_drivers.interface import Device
from triaxcal_drivers.profile import READINGS
from triaxcald.errors import InputError
from triaxcald.inputs import CALIBRATION
from triaxcald.mounting import ORIENTATIONS
from triaxcald.simulation.bench import physics_of
from triaxcald.simulation.follow import LINE_MOST, Lines, Source, follow
from triaxcald.simulation.tray import Tray, load_tray
from triaxcald.station.collection import Collection
from triaxcald.station.config import Place, Plan, load_station
from triaxcald.station.guidance import Guide, ups
from triaxcald.station.reconnect import ReconnectingDevice, RetryPolicy

MOUNTINGS = {"left": "-z+x-y", "right": "+y-x+z"}
FIXTURE = {"poses": 9, "hold_s": 3.0, "move_s": 0.5, "attitude_error_deg": 6.0, "wrong_turns": 0.0, "reaction_s": 0.5}
HOLD_S = 0.8
NOMINAL = (-2.4, -2.4, -2.4)
ASKED = [v for _, v in tc.planning.cube_directions()][:3]
TARGETS = tc.planning.cube_directions()


def left(workshop: Any, **settings: Any) -> Path:
    bus = {"interface": "virtual", "channel": workshop.folder.name, "node_id": 5}
    values = {"profile": "triax-ref-can", "serial": 11, "bus": bus, "mounting": MOUNTINGS["left"], **settings}
    return Path(workshop.device("left.toml", **{"fixture": FIXTURE, **values}))


def right(workshop: Any, **settings: Any) -> Path:
    values = {"serial": 12, "seed": 4, "mounting": MOUNTINGS["right"], "fixture": FIXTURE, **settings}
    return Path(workshop.device("right.toml", **values))


@asynccontextmanager
async def served(tray: Tray, workshop: Any, profile: str = "triax-ref-modbus") -> AsyncIterator[Mapping[str, Place]]:
    on_can, on_modbus = tray.units
    async with on_can.serve(), on_modbus.serve() as server:
        station = workshop.station(
            {"name": "left", "profile": "triax-ref-can", "serial": "11", "bus": on_can.device.bus},
            {
                "name": "right",
                "profile": profile,
                "serial": "12",
                "bus": {**on_modbus.device.bus, "port": server.bus.port},
            },
        )
        yield {place.unit.name: place for place in load_station(station).places}


async def taken(place: Place, wanted: int, tell: Callable[[Guide], None] = lambda _: None) -> tc.Floats:
    """(n,3) up in the fixture's axes, in the poses held, by the driver of the unit's bus."""

    async def nothing() -> None: ...

    async with place.opened() as device:
        recorded = Collection(CALIBRATION, place.bundle, place.address)
        streaming = ReconnectingDevice(device, nothing, RetryPolicy(most_s=0.0), lambda _: None)
        await recorded.until_posed(
            streaming,
            None,
            Plan(hold_s=HOLD_S, repeat=False),
            stream=READINGS,
            wanted=wanted,
            nominal_scale_factor=NOMINAL,
            tell=tell,
            targets=TARGETS,
        )
        held = [p for p in recorded.pipelines[READINGS].held() if p.end_s - p.start_s >= HOLD_S]
        return ups(held, NOMINAL) @ ORIENTATIONS[MOUNTINGS[place.unit.name]]


def require_same(a: tc.Floats, b: tc.Floats, least: int) -> None:
    """Both saw ``least`` attitudes or more one after the other, though one may have begun and ended later.

    The two units' own errors are below 2 degrees; the attitudes' are about 8, and others are 25 away.
    """
    best = 0
    for shift in range(-len(b) + 1, len(a)):
        pairs = list(zip(a[max(shift, 0) :], b[max(-shift, 0) :], strict=False))
        if all(angle_deg(x, y) < 2.0 for x, y in pairs):
            best = max(best, len(pairs))
    assert best >= least, [[round(angle_deg(x, y), 1) for y in b] for x in a]


async def test_two_units_on_one_fixture_are_in_the_same_attitudes(workshop: Any) -> None:
    tray = load_tray([left(workshop), right(workshop)], followed=False)
    async with served(tray, workshop) as places:
        seen = await asyncio.gather(*(taken(place, 4) for place in places.values()))
    require_same(*seen, least=2)


@pytest.mark.parametrize("followed", [False, True])
@pytest.mark.parametrize("lacks", ["left", "right"])
def test_one_file_may_describe_the_fixture_for_all(workshop: Any, lacks: str, followed: bool) -> None:
    paths = [left(workshop), right(workshop)]
    whole = load_tray(paths, followed=followed)
    path = workshop.folder / f"{lacks}.toml"
    path.write_text("\n".join(line for line in path.read_text().splitlines() if not line.startswith("fixture")))
    assert "hold_s" not in path.read_text()
    tray = load_tray(paths, followed=followed)
    t_s = np.arange(0.0, 40.0, 0.1)
    for tray_ in (whole, tray):
        if tray_.operator is not None:
            tray_.operator.read(instruction(ASKED[1]), 0.0)
    for simulated, expected in zip(tray.units, whole.units, strict=True):
        of_all, alone = (u.unit.physics.sample(t_s) for u in (simulated, expected))
        np.testing.assert_array_equal(of_all[0], alone[0])


async def test_two_units_follow_the_events_in_a_file_that_grows(workshop: Any) -> None:
    tray = load_tray([left(workshop), right(workshop)], followed=True)
    assert tray.operator is not None
    events = workshop.write("events.jsonl", instruction(ASKED[0]) + b"\n")
    found: dict[str, int] = {}

    def tell(slot: str, guide: Guide) -> None:
        before = min(found.values(), default=0)
        found[slot] = guide.found
        if len(found) == 2 and before < (now := min(found.values())) < len(ASKED):
            with events.open("ab") as file:
                line = instruction(ASKED[now]) + b"\n"
                file.write(line[:50])
                file.flush()
                file.write(line[50:])

    async with served(tray, workshop) as places:
        following = asyncio.create_task(follow(Source(str(events)), tray.operator, {}, tray.time_base, print))
        collecting = [taken(p, len(ASKED), lambda g, s=s: tell(s, g)) for s, p in places.items()]
        seen = await asyncio.gather(*collecting)
        following.cancel()
    require_same(*seen, least=len(ASKED))
    for up in seen:
        for asked in ASKED:
            assert min(angle_deg(v, asked) for v in up) < 25


async def answers(device: Device) -> bool:
    try:
        await device.read("serial_number")
    except DeviceSilent:
        return False
    return True


async def test_the_operator_switches_the_supply_of_one_unit(workshop: Any) -> None:
    tray = load_tray([left(workshop), right(workshop)], followed=True)
    assert tray.operator is not None
    reading, writing = os.pipe()
    source = Source(f"/dev/fd/{reading}")
    units = {d.slot: u.unit for d, u in zip(tray.described, tray.units, strict=True)}
    impatient = workshop.impatient_profile()
    async with served(tray, workshop, impatient) as places, places["left"].opened() as a, places["right"].opened() as b:
        following = asyncio.create_task(follow(source, tray.operator, units, tray.time_base, print))
        os.write(writing, stage("right", "power_off") + b"\n")
        while await answers(b):
            pass
        assert int.from_bytes(await a.read("serial_number"), "little") == 11
        os.write(writing, stage("right", "power_on") + b"\n")
        while not await answers(b):
            await b.close()
            await b.open()
        following.cancel()
    os.close(writing)
    os.close(reading)


async def test_a_stream_that_ends_leaves_the_units_as_they_are_and_served(workshop: Any) -> None:
    tray = load_tray([left(workshop), right(workshop)], followed=True)
    assert tray.operator is not None
    events = workshop.folder / "events"
    os.mkfifo(events)
    said: list[str] = []
    ended = asyncio.Event()

    def asked(up: np.ndarray) -> bytes:
        return poses("third", up) + b"\n" + poses("left", ORIENTATIONS[MOUNTINGS["left"]] @ up)

    def say(line: str) -> None:
        said.append(line)
        if "ended" in line:
            ended.set()

    following = asyncio.create_task(follow(Source(str(events)), tray.operator, {}, tray.time_base, say))
    for turn, v in enumerate(ASKED[:2], start=1):  # a run, and the next one
        await asyncio.to_thread(events.write_bytes, b"junk\n" + asked(v))
        await ended.wait()
        ended.clear()
        assert (tray.operator.ignored, tray.operator.paths["left"].turns) == (turn, turn)
        assert len(said) == 2 * turn + 1
        assert "no unit here has the slot third; the slots are left, right" in said[1]
        arrived_s = tray.time_base.now_s() + 5.0
        assert angle_deg(tray.operator.paths["left"].specific_force(np.array([arrived_s]))[0], v) < 25
        await tray.time_base.wait_until(arrived_s)
    assert not following.done()
    following.cancel()


@pytest.mark.parametrize("change", ["shorter", "replaced"])
async def test_a_file_that_is_written_anew_is_read_from_its_start(tmp_path: Path, change: str) -> None:
    path = tmp_path / "events"
    path.write_bytes(b"first and long\n")
    came: asyncio.Queue[bytes | None] = asyncio.Queue()
    loop = asyncio.get_running_loop()
    reading = asyncio.create_task(asyncio.to_thread(_reads, Source(str(path)), loop, came))
    assert await came.get() == b"first and long\n"
    if change == "replaced":
        (tmp_path / "new").write_bytes(b"second, which is longer\n")
        (tmp_path / "new").replace(path)
    else:
        path.write_bytes(b"second\n")
    assert (await came.get() or b"").startswith(b"second")
    await reading


class _Enough(Exception):
    pass


def _reads(source: Source, loop: asyncio.AbstractEventLoop, came: asyncio.Queue[bytes | None]) -> None:
    told = []

    def tell(data: bytes | None) -> None:
        told.append(data)
        loop.call_soon_threadsafe(came.put_nowait, data)
        if len(told) == 2:
            raise _Enough

    with pytest.raises(_Enough):
        source.read(tell)


def test_lines_come_whole_however_the_bytes_are_parted() -> None:
    text = b"one\ntwo\n\nthree"
    for size in range(1, len(text) + 1):
        lines = Lines()
        whole = [line for i in range(0, len(text), size) for line in lines.feed(text[i : i + size])]
        assert [*whole, *lines.rest()] == [b"one", b"two", b"", b"three"]


def test_a_line_without_an_end_takes_no_memory_without_an_end() -> None:
    lines = Lines()
    chunk = b"x" * (1 << 20)
    cut = [line for _ in range(20) for line in lines.feed(chunk)]
    assert max(map(len, cut)) <= LINE_MOST + len(chunk)
    assert sum(map(len, [*cut, *lines.rest()])) == 20 << 20
    assert HEAD not in cut


def test_one_file_is_on_a_fixture_of_its_own(workshop: Any) -> None:
    path = left(workshop, mounting="+x+y+z")
    (simulated,) = load_tray([path], followed=False).units
    t_s = np.arange(0.0, 60.0, 0.01)
    alone = physics_of(simulated.device).sample(t_s)
    for a, b in zip(alone, simulated.unit.physics.sample(t_s), strict=True):
        np.testing.assert_array_equal(a, b)


SAME_BUS = {"host": "127.0.0.1", "port": 15020}


@pytest.mark.parametrize(
    ("first", "second", "words"),
    [
        ({}, {"speed": 2.0}, "right.toml: speed: 2, but 20 in "),
        ({}, {"serial": 11}, "right.toml: serial: the same as in "),
        ({"slot": "right"}, {}, "right.toml: slot: the same as in "),
        ({"eeprom": "held"}, {"eeprom": "./held"}, "right.toml: eeprom: the same as in "),
        ({}, {"fixture": {**FIXTURE, "move_s": 2.0}}, "right.toml: fixture.move_s: 2, but 0.5 in "),
        (
            {"profile": "triax-ref-modbus", "bus": {**SAME_BUS, "host": "localhost"}},
            {"bus": {**SAME_BUS, "unit_id": 2}},
            "right.toml: bus: the same as in ",
        ),
        (
            {"profile": "triax-ref-modbus", "bus": {"serial_port": "pty:line"}},
            {"bus": {"serial_port": "pty:./line", "unit_id": 2}},
            "right.toml: bus: the same as in ",
        ),
        (
            {"bus": {"interface": "udp_multicast", "channel": "239.74.163.2", "node_id": 5}},
            {
                "profile": "triax-ref-can",
                "bus": {
                    "interface": "udp_multicast", "channel": "239.74.163.2", "node_id": 5, "options": {"port": 43113},
                },
            },
            "right.toml: bus: the same as in ",
        ),
        ({}, {"mounting": "+x+y-z"}, "mounting: expected one of the 24 right-handed"),
        ({}, {"mounting": "up"}, "mounting: expected one of the 24 right-handed"),
    ],
)  # fmt: skip
def test_files_that_do_not_go_together(
    workshop: Any, triaxcal: Callable[..., Any], first: dict[str, Any], second: dict[str, Any], words: str
) -> None:
    events = workshop.write("events.jsonl", b"")
    arguments = ("sim", left(workshop, **first), right(workshop, **second), "--follow", events)
    triaxcal(*arguments).failed(2, words)


def test_units_on_free_ports_and_on_other_nodes_go_together(workshop: Any) -> None:
    bus = {"interface": "virtual", "channel": workshop.folder.name, "node_id": 6}
    third = workshop.device("third.toml", serial=13, fixture=FIXTURE)
    fourth = workshop.device("fourth.toml", serial=14, profile="triax-ref-can", bus=bus, fixture=FIXTURE)
    tray = load_tray([left(workshop), right(workshop), third, fourth], followed=False)
    assert [d.slot for d in tray.described] == ["left", "right", "third", "fourth"]
    assert len({id(u.time_base) for u in tray.units}) == 1


@pytest.mark.parametrize("followed", ["none.jsonl", "."])
def test_what_cannot_be_followed(workshop: Any, triaxcal: Callable[..., Any], followed: str) -> None:
    triaxcal("sim", left(workshop), "--follow", followed).failed(2, followed)


def test_a_closed_standard_input_cannot_be_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", None)
    with pytest.raises(InputError, match="standard input"):
        Source("-")
