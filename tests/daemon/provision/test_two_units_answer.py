"""Two units at one address: neither loses its calibration, and the message names both."""

from __future__ import annotations

import re
import uuid
from pathlib import Path

import pytest

from tests.daemon.provision.host import Host
from tests.devices.bench import TRANSPORTS, Bench, Transport
from tests.devices.canopen import CanopenNode
from tests.devices.habits import Habits
from tests.devices.memory import Electronics
from tests.devices.motion import Motion
from tests.devices.place import Place, Trouble
from tests.devices.profiles import Timing, Wording
from tests.devices.sdo import SdoServer
from tests.devices.table import FACTORY, OLD
from triaxcal_drivers.two_senders import KEYS_MOST, OPEN_MOST, Answers, Extra
from triaxcald.provision.state import DeviceState

PATIENT = Timing(reply_s=10.0, silence_s=20.0, store_poll_s=20.0, reconnect_s=20.0)
every_transport = pytest.mark.parametrize("transport", TRANSPORTS)


def another(habits: Habits, serial: int = 888, **more: int) -> Electronics:
    return Electronics(habits, FACTORY.image(habits), serial_number=serial, **more)


@every_transport
@pytest.mark.parametrize("after_s", [0.01, 0.04, 0.15])
def test_nothing_is_unlocked_where_two_units_answer(
    tmp_path: Path, triaxcal, transport: Transport, after_s: float
) -> None:
    with Bench(tmp_path, triaxcal, transport, timing=PATIENT) as bench:
        other = bench.place.second = another(bench.habits)
        bench.place.second_after_s = after_s
        done = bench.provision("--json")
        outcome = done.json["outcome"]
        assert (done.code, outcome["code"], outcome["exit_code"]) == (4, "two_answer", 4)
        assert (outcome["verdict"], outcome["device_state"]) == ("aborted", "untouched")
        assert "two units answer at" in outcome["reason"]
        assert "4711, 0888" in outcome["reason"]
        for unit in (bench.unit, other):
            assert [r for r in unit.log if r.kind == "write"] == []
        assert other.eeprom == FACTORY.image(bench.habits)
        assert bench.holds_old()


@every_transport
def test_the_faster_unit_may_be_the_wrong_one(tmp_path: Path, triaxcal, transport: Transport) -> None:
    with Bench(tmp_path, triaxcal, transport, timing=PATIENT) as bench:
        bench.place.unit, bench.place.second = another(bench.habits), bench.unit
        done = bench.provision("--json")
        outcome = done.json["outcome"]
        assert (done.code, outcome["code"]) == (4, "two_answer")
        assert "0888, 4711" in outcome["reason"]
        assert [r for r in bench.unit.log if r.kind == "write"] == []


@every_transport
def test_two_units_that_answer_alike_are_two(tmp_path: Path, triaxcal, transport: Transport) -> None:
    with Bench(tmp_path, triaxcal, transport, serial=None, wording=Wording(serial=False), timing=PATIENT) as bench:
        other = bench.place.second = Electronics(bench.habits, OLD.image(bench.habits))
        done = bench.provision("--json")
        assert (done.code, done.json["outcome"]["code"]) == (4, "two_answer")
        assert [r for r in other.log if r.kind == "write"] == []


@pytest.mark.parametrize("late_s", [0.0, 0.04])
def test_two_nodes_with_one_node_id_keep_what_they_hold(tmp_path: Path, triaxcal, late_s: float) -> None:
    channel = f"two-nodes-{uuid.uuid4()}"
    other = another(Habits())
    place = Place(other, Trouble(late=1.0, late_s=late_s))
    second = CanopenNode(SdoServer(place), channel=channel, motion=Motion())
    with second, Bench(tmp_path, triaxcal, "canopen", node={"channel": channel}, timing=PATIENT) as bench:
        done = bench.provision("--json")
        outcome = done.json["outcome"]
        assert (done.code, outcome["code"], outcome["device_state"]) == (4, "two_answer", "untouched")
        assert "two units answer at node 5 on virtual" in outcome["reason"]
        assert {"4711", "0888"} <= set(re.findall(r"\d+", outcome["reason"]))
        assert bench.holds_old()
        assert other.eeprom == FACTORY.image(bench.habits)
        assert [r for unit in (bench.unit, other) for r in unit.log if r.kind == "write"] == []


@every_transport
@pytest.mark.parametrize("command", ["run", "record"])
def test_nothing_is_recorded_of_two_units_that_answer(
    tmp_path: Path, triaxcal, transport: Transport, command: str
) -> None:
    with Bench(tmp_path, triaxcal, transport, timing=PATIENT) as bench:
        bench.place.second = another(bench.habits)
        output = ("-o", tmp_path / "two.mcap", "--seconds", 1) if command == "record" else ()
        done = triaxcal(command, bench.station, *output)
        done.failed(4, "two units answer at", "4711, 0888")
        assert not list(tmp_path.rglob("*.mcap"))


HABITS = [
    Habits(),
    Habits(reset_command=False),
    Habits(unlock=False),
    Habits(store_command=False),
    Habits(counter=True, store_seconds=0.3, while_storing="busy"),
]


async def requests_of_a_clean_run(folder: Path, habits: Habits) -> list[tuple[str, str]]:
    host = Host(folder, habits)
    assert await host.provision()
    return [(r.kind, r.register) for r in host.unit.log]


@pytest.mark.slow
@pytest.mark.parametrize("habits", HABITS)
async def test_whenever_a_second_unit_appears_the_state_is_as_told(tmp_path: Path, habits: Habits) -> None:
    asked = await requests_of_a_clean_run(tmp_path / "clean", habits)
    store = next((i for i, r in enumerate(asked, 1) if r == ("write", "store")), len(asked))
    for at in range(1, len(asked) + 1):
        host = Host(tmp_path / str(at), habits)
        other = another(habits)
        host.place.second_at(at, other)
        done = await host.provision()
        assert host.provisioning is not None
        held, starts_with = host.provisioning.held, host.starts_with()
        match held.state:
            case DeviceState.UNTOUCHED | DeviceState.OLD:
                assert starts_with == "old", at
            case DeviceState.NEW_VERIFIED:
                assert starts_with == "new", at
            case DeviceState.NEW_UNVERIFIED:
                assert {n: raw for n, raw in host.unit.in_use.items() if n in host.new} == host.new, at
        # A second unit keeps its calibration; until the last look before the store the first keeps its old one.
        if habits.store_command:
            assert other.eeprom == FACTORY.image(habits), at
        if at < store - 3 and habits.store_command:
            assert starts_with == "old", at
        if at < len(asked) - 3:  # from the last look on, nobody asks any more
            assert not done, at


def test_answers_are_counted_against_requests() -> None:
    answers: Answers[str] = Answers()
    answers.asked("serial")
    answers.answered("serial", b"777")
    assert answers.take() == []
    answers.answered("serial", b"888")
    answers.answered("serial", b"777")
    assert answers.take() == [Extra("serial", b"888", b"777"), Extra("serial", b"777", b"777")]
    assert answers.take() == []


def test_a_late_answer_to_a_request_that_was_repeated_is_explained() -> None:
    answers: Answers[str] = Answers()
    for _ in range(2):
        answers.asked("bias")
    for raw in (b"1", b"2"):
        answers.answered("bias", raw)
    assert answers.take() == []


def test_lost_requests_do_not_explain_answers_for_ever() -> None:
    answers: Answers[str] = Answers()
    for _ in range(100):
        answers.asked("bias")
    for _ in range(OPEN_MOST + 1):
        answers.answered("bias", b"1")
    assert len(answers.take()) == 1


def test_an_answer_that_nobody_asked_for_has_no_first() -> None:
    answers: Answers[str] = Answers()
    answers.answered("bias", b"1")
    assert answers.take() == [Extra("bias", b"1", None)]


def test_answers_take_bounded_memory() -> None:
    answers: Answers[int] = Answers()
    for key in range(3 * KEYS_MOST):
        answers.asked(key)
        answers.answered(key, b"1")
        answers.answered(-1 - key, b"1")
    assert len(answers.take()) == KEYS_MOST
    assert not answers.was_asked(0)
    assert answers.was_asked(3 * KEYS_MOST - 1)
