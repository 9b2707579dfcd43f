"""Ctrl-C, SIGTERM and SIGHUP: the work ends in good order, the device holds the old calibration, and it is said."""

from __future__ import annotations

import asyncio
import json
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from triaxcal_drivers.modbus.device import ModbusDevice
from triaxcald.cli.interrupt import Interrupted, run_interruptible
from triaxcald.provision.procedure import restore as put_back
from triaxcald.provision.state import Evidence
from triaxcald.recording.reader import Recording
from triaxcald.recording.writer import RecordingWriter
from triaxcald.simulation.unit import CALIBRATION, Stored, factory_calibration
from triaxcald.text import VERDICTS

Run = Callable[..., Any]
OLD = Stored(factory_calibration())
FIXTURE = {"poses": 12, "hold_s": 2.0, "move_s": 0.8}
QUICK = {"speed": 60.0, "fixture": FIXTURE}
PLAN = {"poses": 12, "hold_s": 1.0, "check_poses": 6}
CAL = {
    "format": "triaxcal.calibration/1",
    "scale_factor": [-2.41, -2.405, -2.37],
    "misalignment": [0.006, 0.004, -0.001],
    "bias": [0.005, -0.003, 0.004],
}
DEADLINE_S = 180.0
INT, TERM, HUP = signal.SIGINT, signal.SIGTERM, signal.SIGHUP


@pytest.fixture(autouse=True)
def _a_signal_that_nobody_heeds_does_not_end_the_tests() -> Iterator[None]:
    held = {number: signal.signal(number, lambda *_: None) for number in (INT, TERM, HUP)}
    yield
    for number, handler in held.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def _short_wait_for_a_dead_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("triaxcald.provision.access.RECONNECT_S", 0.3)


async def _long() -> None:
    async with asyncio.timeout(DEADLINE_S):
        await asyncio.Event().wait()


def _holds_old(served: Any) -> None:
    assert Stored.from_image(served.unit.eeprom).calibration == OLD.calibration
    assert {name: served.unit._ram[name] for name in CALIBRATION} == OLD.calibration


def test_work_that_nobody_interrupts_gives_its_result_and_leaves_the_signals_alone() -> None:
    async def work() -> int:
        return 7

    before = [signal.getsignal(number) for number in (INT, TERM, HUP)]
    assert run_interruptible(work()) == 7
    assert [signal.getsignal(number) for number in (INT, TERM, HUP)] == before


@pytest.mark.parametrize("number", [INT, TERM, HUP])
def test_the_first_signal_cancels_the_work_and_what_it_left_to_say_is_passed_on(number: int) -> None:
    async def work() -> None:
        try:
            signal.raise_signal(number)
            await _long()
        except asyncio.CancelledError as e:
            e.add_note("everything is back")
            raise

    with pytest.raises(Interrupted) as interrupted:
        run_interruptible(work())
    assert (interrupted.value.number, interrupted.value.notes) == (number, ("everything is back",))
    assert str(interrupted.value) == "interrupted; everything is back"


def test_a_second_signal_cancels_again_and_says_that_things_are_put_in_order(capfd: pytest.CaptureFixture[str]) -> None:
    async def work() -> None:
        with suppress(asyncio.CancelledError):  # as where a cancellation gets lost
            signal.raise_signal(TERM)
            await _long()
        signal.raise_signal(HUP)
        await _long()

    with pytest.raises(Interrupted) as interrupted:
        run_interruptible(work())
    assert interrupted.value.number == TERM
    assert capfd.readouterr().err == (
        "triaxcal: putting things in order, please wait; a third signal ends it at once\n"
    )


def test_what_the_work_had_to_say_is_not_lost_when_a_second_signal_strikes_later() -> None:
    async def work() -> None:
        try:
            signal.raise_signal(INT)
            try:
                await _long()
            except asyncio.CancelledError as e:
                e.add_note("NOT restored: it is dead")
                raise
        finally:
            signal.raise_signal(INT)
            await _long()

    with pytest.raises(Interrupted) as interrupted:
        run_interruptible(work())
    assert interrupted.value.notes == ("NOT restored: it is dead",)


def test_work_that_was_through_when_the_signal_came_gives_its_result() -> None:
    async def work() -> int:
        signal.raise_signal(INT)
        return 7

    assert run_interruptible(work()) == 7


def test_a_computation_that_nobody_waits_for_any_more_does_not_hold_up_the_end() -> None:
    stop, ended = threading.Event(), []

    def compute() -> None:
        signal.raise_signal(INT)
        ended.append(stop.wait(DEADLINE_S))

    async def work() -> None:
        await asyncio.to_thread(compute)

    with pytest.raises(Interrupted):
        run_interruptible(work())
    assert ended == []
    stop.set()


def test_who_asked_to_be_spared_hanging_up_is_spared() -> None:
    """As `nohup` asks."""

    async def work() -> str:
        signal.raise_signal(HUP)
        for _ in range(5):
            await asyncio.sleep(0)
        return "done"

    signal.signal(HUP, signal.SIG_IGN)
    assert run_interruptible(work()) == "done"
    assert signal.getsignal(HUP) is signal.SIG_IGN


def _strike_in(monkeypatch: pytest.MonkeyPatch, phase: str, number: int) -> None:
    """Raises the signal with the third batch of the phase."""
    raw, batches = RecordingWriter.raw, []

    def striking(self: RecordingWriter, of: Any, batch: Any) -> bool:
        if of == phase:
            batches.append(batch)
            if len(batches) == 3:
                signal.raise_signal(number)
        return raw(self, of, batch)

    monkeypatch.setattr(RecordingWriter, "raw", striking)


@pytest.mark.parametrize("number", [TERM, HUP])
@pytest.mark.parametrize("command", ["run", "record"])
def test_a_recording_is_finished_and_the_device_left_alone(
    workshop: Any, triaxcal: Run, monkeypatch: pytest.MonkeyPatch, command: str, number: int
) -> None:
    _strike_in(monkeypatch, "calibration", number)
    with workshop.serve(workshop.device(**QUICK)) as served:
        station = workshop.station({"bus": served.bus}, plan=PLAN)
        path = workshop.folder / "rec.mcap"
        output = ["--json"] if command == "run" else ["-o", path, "--seconds", "60"]
        done = triaxcal(command, station, *output)
        assert served.unit.eeprom == OLD.image()
        _holds_old(served)
    assert done.code == 130
    assert "interrupted" in done.err.splitlines()[-1]
    if command == "run":
        (unit,) = done.json["units"]
        assert (unit["exit_code"], unit["device_state"], unit["registers_written"]) == (130, None, [])
        path = unit["recording"]
    else:
        # A busy machine changes the rate of a simulated unit, and a warning may follow.
        assert any(line.startswith(f"{path}: ") and " samples in " in line for line in done.err.splitlines())
    info = triaxcal("log", "info", path, "--json").json
    assert info["finished"] is True
    assert int(info["metadata"]["raw"]["records"]) == info["raw"]["calibration"]["records"] > 0


@pytest.mark.slow
@pytest.mark.parametrize(("first", "second"), [(INT, INT), (TERM, HUP)])
def test_two_signals_in_the_check_poses_do_not_keep_the_old_calibration_away(
    workshop: Any, triaxcal: Run, monkeypatch: pytest.MonkeyPatch, first: int, second: int
) -> None:
    began, ended = [], []

    async def striking(*arguments: Any, **options: Any) -> Evidence:
        began.append(served.unit.eeprom)
        signal.raise_signal(second)
        shown = await put_back(*arguments, **options)
        ended.append(served.unit.eeprom)
        return shown

    monkeypatch.setattr("triaxcald.provision.procedure.restore", striking)
    _strike_in(monkeypatch, "verification", first)
    with workshop.serve(workshop.device(**QUICK)) as served:
        done = triaxcal("run", workshop.station({"bus": served.bus}, plan=PLAN), "--json")
        _holds_old(served)
    assert [Stored.from_image(image).calibration == OLD.calibration for image in (*began, *ended)] == [False, True]
    assert done.code == 130
    (unit,) = done.json["units"]
    assert (unit["exit_code"], unit["outcome"]["device_state"]) == (130, "old")
    assert unit["error"] == f"unit unit0: interrupted; {unit['device_state']}"
    assert done.err.splitlines()[-1] == f"triaxcal: {VERDICTS[unit['outcome']['verdict']]} {unit['error']}"
    with Recording.open(Path(unit["recording"])) as recording:
        assert recording.finished
        assert "registers-before.json" in recording.attachments


@pytest.mark.slow
def test_a_signal_while_a_calibration_that_failed_its_verification_is_put_back_is_heeded_after_it(
    workshop: Any, triaxcal: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def striking(*arguments: Any, **options: Any) -> Evidence:
        signal.raise_signal(TERM)
        return await put_back(*arguments, **options)

    monkeypatch.setattr("triaxcald.provision.procedure.restore", striking)
    with workshop.serve(workshop.device(**QUICK)) as served:
        station = workshop.station({"bus": served.bus}, plan=PLAN, limits={"verification_rms_g": 1e-9})
        done = triaxcal("run", station, "--json")
        _holds_old(served)
    assert done.code == 130
    (unit,) = done.json["units"]
    assert (unit["outcome"]["device_state"], unit["report"]) == ("old", None)


@pytest.mark.slow
def test_a_device_that_could_not_be_put_back_after_an_interruption_is_4_and_said(
    workshop: Any, triaxcal: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def dead(*arguments: Any, **options: Any) -> Evidence:
        served.unit._died_s = 0.0
        return await put_back(*arguments, **options)

    monkeypatch.setattr("triaxcald.provision.procedure.restore", dead)
    _strike_in(monkeypatch, "verification", INT)
    with workshop.serve(workshop.device(**QUICK)) as served:
        unit = {"bus": served.bus, "profile": workshop.impatient_profile()}
        done = triaxcal("run", workshop.station(unit, plan=PLAN), "--json")
    assert done.code == 4
    (unit,) = done.json["units"]
    assert unit["exit_code"] == 4
    assert (unit["outcome"]["verdict"], unit["outcome"]["device_state"]) == ("aborted", "new_verified")
    assert unit["error"].startswith(f"unit unit0: interrupted; {unit['device_state']}; to settle: ")
    assert Path(unit["outcome"]["journal"]).exists()
    assert done.err.splitlines()[-1] == f"triaxcal: {VERDICTS[unit['outcome']['verdict']]} {unit['error']}"


@pytest.mark.slow
@pytest.mark.parametrize(("dead", "code", "state"), [(False, 130, "old"), (True, 4, "unknown")])
def test_provision_interrupted_says_what_the_device_holds(
    workshop: Any, triaxcal: Run, monkeypatch: pytest.MonkeyPatch, dead: bool, code: int, state: str
) -> None:
    write = ModbusDevice.write

    async def striking(self: ModbusDevice, register: str, raw: bytes, **options: Any) -> None:
        await write(self, register, raw, **options)
        if register == "bias_x" and not struck:
            struck.append(register)
            signal.raise_signal(TERM)
            if dead:
                served.unit._died_s = 0.0

    struck: list[str] = []
    monkeypatch.setattr(ModbusDevice, "write", striking)
    with workshop.serve(workshop.device(**QUICK)) as served:
        station = workshop.station({"bus": served.bus, "profile": workshop.impatient_profile()})
        done = triaxcal("provision", workshop.write("cal.json", json.dumps(CAL)), station, "--json")
        assert Stored.from_image(served.unit.eeprom).calibration == OLD.calibration
    assert (done.code, done.json["outcome"]["device_state"]) == (code, state)
    assert done.err.splitlines()[-1].startswith("triaxcal: interrupted; ")
