"""The start sequence of a profile: before each stream and after each restart, in the recording, and not where nothing
is to be sent."""

from __future__ import annotations

import asyncio
import json
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from tests.canopen_node import MappedNode
from triaxcal_drivers.can.line import join, leave
from triaxcal_drivers.can.model import BusSettings
from triaxcal_drivers.catalogue import BUILT_IN, parse_bundle
from triaxcal_drivers.errors import ProfileError
from triaxcald.recording.reader import Recording

pytestmark = pytest.mark.slow
Run = Callable[..., Any]
START = [0x00, 0x31020110, 0x31020210, 0x31020310, 0x65110008, 4, 254, 10]
DELIVERED = {
    (0x1800, 2): 1,
    (0x1800, 5): 0,
    (0x1A00, 0): 2,
    (0x1A00, 1): 0x60100010,
    (0x1A00, 2): 0x60200010,
}
"""Two angles, sent at each SYNC."""


def value_of(index: int, subindex: int, seconds: float) -> int:
    """Accelerations of 1/4096 g that turn about one axis; 25 °C."""
    if index == 0x3102:
        return round(4096 * (0.6, 0.8 * math.cos(seconds), 0.8 * math.sin(seconds))[subindex - 1])
    return 25 if index == 0x6511 else 0


@pytest.fixture
def channel() -> str:
    return f"start-{os.getpid()}-{time.monotonic_ns()}"


@pytest.fixture
def node(channel: str) -> Iterator[MappedNode]:
    with MappedNode(channel, 5, BUILT_IN / "sick-tmm61.eds", value_of, DELIVERED) as node:
        yield node


@pytest.fixture
def station(channel: str, workshop: Any) -> Callable[..., Path]:
    """A station of one unit with the profile of the TMM61, or with a changed one."""

    def make(*changes: tuple[str, str]) -> Path:
        text = (BUILT_IN / "sick-tmm61.toml").read_text("utf-8")
        for old, new in (("[sampling]\n", "[sampling]\nsilence_timeout_s = 0.5\nreply_timeout_s = 0.3\n"), *changes):
            assert old in text
            text = text.replace(old, new)
        workshop.write("sick-tmm61.eds", (BUILT_IN / "sick-tmm61.eds").read_bytes())
        bus = {"interface": "virtual", "channel": channel, "node_id": 5}
        path: Path = workshop.station({"profile": workshop.write("unit.toml", text).name, "bus": bus})
        return path

    return make


def written(path: Path) -> list[int]:
    with Recording.open(path) as recording:
        return [int.from_bytes(a.raw, "little") for a in recording.register_accesses() if a.operation == "write"]


def samples(path: Path, triaxcal: Run) -> np.ndarray:
    table = path.with_suffix(".csv")
    done = triaxcal("log", "export", path, "-o", table)
    assert done.code == 0, done.err
    return np.genfromtxt(table, delimiter=",", names=True, comments="#")


def record(triaxcal: Run, station: Path, path: Path, *options: str, seconds: float = 1.5) -> Any:
    return triaxcal("record", station, "-o", path, "--seconds", seconds, "--give-up-after", "3", *options)


def test_a_unit_that_maps_something_else_as_delivered_is_recorded(
    node: MappedNode, station: Callable[..., Path], workshop: Any, triaxcal: Run
) -> None:
    path = workshop.folder / "a.mcap"
    done = record(triaxcal, station(), path)
    assert done.code == 0, done.err
    assert written(path) == START
    table = samples(path, triaxcal)
    assert np.sqrt(table["ux"] ** 2 + table["uy"] ** 2 + table["uz"] ** 2) == pytest.approx(1, abs=1e-3)
    assert set(table["temp_c"]) == {25}


def test_without_its_start_it_sends_no_such_sample(
    node: MappedNode, station: Callable[..., Path], workshop: Any, triaxcal: Run
) -> None:
    path = workshop.folder / "a.mcap"
    done = record(triaxcal, station(), path, "--no-start")
    assert done.code == 4, done.err
    assert written(path) == []


def test_commands_that_only_read_registers_send_none_of_it(
    node: MappedNode, station: Callable[..., Path], triaxcal: Run
) -> None:
    assert triaxcal("registers", station()).code == 0
    assert not node.node.data_store


def test_after_a_restart_the_unit_is_started_again(
    node: MappedNode, station: Callable[..., Path], workshop: Any, triaxcal: Run
) -> None:
    path = workshop.folder / "a.mcap"
    switch = threading.Timer(2.0, node.restart)
    switch.start()
    try:
        done = record(triaxcal, station(), path, seconds=4.0)
    finally:
        switch.cancel()
    assert done.code == 0, done.err
    assert written(path) == 2 * START
    table = samples(path, triaxcal)
    assert np.hypot(table["uy"], table["uz"]) == pytest.approx(0.8, abs=1e-3)


def test_a_step_that_the_unit_refuses_makes_it_absent(
    node: MappedNode, station: Callable[..., Path], workshop: Any, triaxcal: Run
) -> None:
    path = workshop.folder / "a.mcap"
    unknown = ('{ write = "kind", value = 254 }', '{ write = "spare", value = 1 }')
    register = ("\n[sequences]", 'spare = { object = "0x2999:00", type = "uint8" }\n\n[sequences]')
    done = record(triaxcal, station(unknown, register), path)
    assert done.code == 4, done.err
    assert "register spare (0x2999:00)" in done.err.splitlines()[-1]
    assert len(written(path)) >= 2 * (START.index(254) + 1)  # tried again, each time from the first step


def test_a_unit_that_answers_sync_gets_it_while_its_stream_is_read(
    node: MappedNode, station: Callable[..., Path], workshop: Any, triaxcal: Run
) -> None:
    path = workshop.folder / "a.mcap"
    by_sync = ('{ write = "kind", value = 254 }', '{ write = "kind", value = 1 }')
    period = ('eds = "sick-tmm61.eds"\n', 'eds = "sick-tmm61.eds"\nsync_period_s = 0.02\n')
    done = record(triaxcal, station(by_sync, period, ("rate_hz = 100", "rate_hz = 50")), path)
    assert done.code == 0, done.err
    assert len(samples(path, triaxcal)) == pytest.approx(75, abs=15)
    sent = node.sent
    time.sleep(0.1)
    assert node.sent == sent  # nothing after the command


async def test_sync_is_sent_once_for_all_units_on_a_bus(channel: str) -> None:
    settings = BusSettings(interface="virtual", channel=channel)
    got: list[float] = []
    with can.Bus(channel, interface="virtual") as bus:
        notifier = can.Notifier(bus, [lambda msg: got.append(msg.timestamp) if msg.arbitration_id == 0x80 else None])
        lines = [await join(settings) for _ in range(3)]
        wanted = [line.sync(period) for line, period in zip(lines, (0.02, 0.05, 0.02), strict=True)]
        await asyncio.sleep(0.5)
        for line, want in zip(lines, wanted, strict=True):
            line.unsync(want)
        await asyncio.sleep(0.05)
        so_far = len(got)
        await asyncio.sleep(0.1)
        for line in lines:
            await leave(line)
        notifier.stop()
    assert len(got) == so_far <= 27
    assert so_far > 5


class Commanded(can.Listener):
    """A unit on plain CAN that sends nothing until it is told to by a frame."""

    def __init__(self, channel: str) -> None:
        self.commands: list[can.Message] = []
        self._bus = can.Bus(channel, interface="virtual")
        self._notifier = can.Notifier(self._bus, [self])
        self._task: Any = None

    def on_message_received(self, msg: can.Message) -> None:
        if msg.arbitration_id != 0x60:
            self.commands.append(msg)
        if self._task is None and bytes(msg.data) == bytes.fromhex("FFAA030900"):
            told = can.Message(arbitration_id=0x60, data=bytes([1, 2, 3]), is_extended_id=False)
            self._task = self._bus.send_periodic(told, 0.01)

    def __enter__(self) -> Commanded:
        return self

    def __exit__(self, *_: object) -> None:
        self._notifier.stop()
        self._bus.shutdown()


PLAIN = """format = "triaxcal.profile/1"
name = "plain"
driver = "can"
[identity]
vendor = "V"
product = "P"
[output]
unit = "g"
nominal_scale_factor = [1.0, 1.0, 1.0]
[sampling]
rate_hz = 100
silence_timeout_s = 0.5
[streams.readings]
layout = "dbc"
file = "plain.dbc"
channels = { ux = "X", uy = "Y", uz = "Z" }
[sequences]
start = [
    { send = "0x050", data = "FF AA 69 88 B5" },
    { wait_s = 0.05 },
    { send = "0x050", data = "FFAA030900" },
    { send = "0x18EF0150", data = "", extended = true },
]
"""
DBC = """VERSION ""
BU_: S
BO_ 96 M: 3 S
 SG_ X : 0|8@1+ (1,0) [0|0] "" S
 SG_ Y : 8|8@1+ (1,0) [0|0] "" S
 SG_ Z : 16|8@1+ (1,0) [0|0] "" S
"""


def test_frames_of_the_start_are_sent_and_recorded(channel: str, workshop: Any, triaxcal: Run) -> None:
    workshop.write("plain.dbc", DBC)
    bus = {"interface": "virtual", "channel": channel, "node_id": 1}
    station = workshop.station({"profile": workshop.write("plain.toml", PLAIN).name, "bus": bus})
    path = workshop.folder / "a.mcap"
    with Commanded(channel) as unit:
        done = record(triaxcal, station, path)
    assert done.code == 0, done.err
    frames = [(0x50, False, "ffaa6988b5"), (0x50, False, "ffaa030900"), (0x18EF0150, True, "")]
    assert [(m.arbitration_id, m.is_extended_id, m.data.hex()) for m in unit.commands] == frames
    with Recording.open(path) as recording:
        sent = [json.loads(e.text) for e in recording.events() if e.kind == "sent"]
    assert [(s["identifier"], s["extended"], s["data"]) for s in sent] == frames


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"0x050", data = "FF AA 69 88 B5"', '"0x850", data = ""', "0x850 is no identifier of 11 bits"),
        ('"FF AA 69 88 B5"', '"FF AA 6"', "sequences.start"),
        ('"FF AA 69 88 B5"', '"00 11 22 33 44 55 66 77 88"', "sequences.start"),
        ("{ wait_s = 0.05 }", '{ write = "none", value = 1 }', "sequences.start: no register named 'none'"),
    ],
)
def test_a_step_that_cannot_be_is_named(old: str, new: str, words: str) -> None:
    assert old in PLAIN
    with pytest.raises(ProfileError, match="sequences") as caught:
        parse_bundle(PLAIN.replace(old, new).encode(), {"plain.dbc": DBC.encode()}, where="unit.toml")
    assert words in str(caught.value)


def test_a_start_writes_no_calibration_and_sends_no_frame_on_modbus() -> None:
    text = (BUILT_IN / "triax-ref-modbus.toml").read_text("utf-8")
    for step, words in (
        ('{ write = "bias_x", value = 0.0 }', "register bias_x holds calibration"),
        ('{ send = "0x050", data = "00" }', "send is for devices on CAN"),
    ):
        changed = text.replace("[sequences]\n", f"[sequences]\nstart = [{step}]\n")
        assert changed != text
        with pytest.raises(ProfileError, match=words):
            parse_bundle(changed.encode(), {}, where="unit.toml")


def test_a_calibrated_unit_gets_it_before_each_stream_and_the_audit_expects_it(workshop: Any, triaxcal: Run) -> None:
    text = (BUILT_IN / "triax-ref-can.toml").read_text("utf-8")
    text = text.replace("[sequences]\n", '[sequences]\nstart = [{ write = "unlock_key", value = 0 }]\n')
    for beside in BUILT_IN.glob("triax-ref-can.[de]*"):
        workshop.write(beside.name, beside.read_bytes())
    bus = {"interface": "virtual", "channel": f"calibrated-{os.getpid()}", "node_id": 5}
    fixture = {"poses": 14, "hold_s": 2.0, "move_s": 0.8}
    with workshop.serve(workshop.device(profile="triax-ref-can", bus=bus, speed=40.0, fixture=fixture)):
        profile = workshop.write("started.toml", text).name
        done = triaxcal("run", workshop.station({"profile": profile, "bus": bus}), "--json")
    assert done.code == 0, done.err
    path = Path(done.json["units"][0]["recording"])
    path = path if path.is_absolute() else next(workshop.folder.rglob(path.name))
    with Recording.open(path) as recording:
        accesses = [a for a in recording.register_accesses() if a.operation == "write"]
    locks = [i for i, a in enumerate(accesses) if a.register == "unlock_key" and not any(a.raw)]
    assert locks[0] == 0  # before the poses
    assert len(accesses) - 1 in locks  # before the check poses
    audited = triaxcal("audit", path)
    assert audited.code == 0, audited.out + audited.err
