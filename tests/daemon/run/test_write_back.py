"""No way out of writing back leaves the device with a calibration that nobody vouches for."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from triaxcal.errors import Refused
from triaxcal.poses.pose import Pose
from triaxcal_drivers.errors import DeviceSilent
from triaxcal_drivers.interface import Device
from triaxcald.errors import DiskError, ProvisionError, RecordingError, StationError
from triaxcald.inputs import CALIBRATION as CALIBRATION_POSES
from triaxcald.provision.procedure import restore
from triaxcald.provision.registers import RegisterImage, build_image
from triaxcald.provision.state import DeviceState, Evidence
from triaxcald.recording.writer import RecordingWriter
from triaxcald.run.unit_run import UnitRun
from triaxcald.run.write_back import WriteBack
from triaxcald.schema.codes import Stage
from triaxcald.simulation.unit import CALIBRATION, TABLE, Faults, Stored, factory_calibration
from triaxcald.station.collection import Collection
from triaxcald.station.config import Place, Station, load_station
from triaxcald.verification import Verification, verify

OLD = Stored(factory_calibration())
QUICK = {"speed": 60.0}
BIAS = 0.005
WANTED = {
    **{f"scale_factor.{axis}": -2.41 for axis in "xyz"},
    **{f"misalignment.{axis}": 0.001 for axis in "xyz"},
    **{f"bias.{axis}": BIAS for axis in "xyz"},
}
NO_ROOM = "rec.mcap: writing failed: No space left on device"


@pytest.fixture(autouse=True)
def _short_wait_for_a_dead_unit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("triaxcald.provision.access.RECONNECT_S", 0.3)


class Quiet:
    """Shows nobody how it goes."""

    def stage(self, unit: str, stage: Stage) -> None: ...
    def note(self, unit: str, text: str) -> None: ...
    def back(self, unit: str) -> None: ...
    def lost(self, unit: str, code: object, trouble: str) -> None: ...

    def poses(self, unit: str, phase: Any, guide: Any) -> None: ...


def _holds_old(served: Any) -> None:
    """In use and stored; writing it back may have counted."""
    held = Stored.from_image(served.unit.eeprom)
    assert held.valid
    assert held.calibration == OLD.calibration
    assert {name: served.unit._ram[name] for name in CALIBRATION} == OLD.calibration


def _stored_bias(served: Any) -> float:
    return TABLE["bias_x"].decode(Stored.from_image(served.unit.eeprom).calibration["bias_x"])


@dataclass
class Bench:
    """A unit that holds the old calibration, and everything that it takes to write it another."""

    served: Any
    place: Place
    station: Station
    device: Device
    writer: RecordingWriter
    image: RegisterImage
    asked: list[Stage] = field(default_factory=list)

    def write_back(self, collect: Callable[[Collection], Awaitable[None]]) -> WriteBack:
        return WriteBack(
            self.place,
            self.station,
            self.writer,
            collect,
            ask=lambda stage, _: self.asked.append(stage),
            started="today",
        )

    async def run(self, back: WriteBack) -> None:
        acquisition = Collection(CALIBRATION_POSES, self.place.bundle, self.place.address)
        await back.write(await back.examine(self.device, self.image, "4711", acquisition), acquisition)


def _state(back: WriteBack) -> DeviceState:
    assert back.provisioning is not None
    return back.provisioning.held.state


OpenBench = Callable[..., contextlib.AbstractAsyncContextManager[Bench]]


@pytest.fixture
def open_bench(workshop: Any) -> OpenBench:
    @contextlib.asynccontextmanager
    async def opened(faults: Faults | None = None, **settings: Any) -> AsyncIterator[Bench]:
        with workshop.serve(workshop.device(**QUICK), faults) as served:
            unit = {"bus": served.bus, "profile": workshop.impatient_profile()}
            station = load_station(workshop.station(unit, **settings))
            (place,) = station.places
            async with place.opened() as device:
                run = UnitRun(station, place, Quiet())
                writer = run.writer(workshop.folder / "rec.mcap", await run.identify(device))
                image = build_image(place.bundle.profile, WANTED, date_days=20_000)
                try:
                    yield Bench(served, place, station, device, writer, image)
                finally:
                    with contextlib.suppress(RecordingError):
                        writer.close()

    return opened


async def _no_pose(check: Collection) -> None:
    """Check poses that nobody judges."""


async def test_what_no_limit_judges_stays_and_is_not_said_to_be_verified(
    open_bench: OpenBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    good = Pose(0.0, 2.0, 200, np.array([1.0, 0.0, 0.0]), 1e-10 * np.eye(3), 50.0)
    monkeypatch.setattr("triaxcald.run.write_back.corrected", lambda *_: verify([good], 1.0))
    async with open_bench() as bench:
        back = bench.write_back(_no_pose)
        await bench.run(back)
        assert back.verdict == "not judged"
        assert _state(back) is DeviceState.NEW_VERIFIED
        assert _stored_bias(bench.served) == pytest.approx(BIAS)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("failure", "raised"),
    [
        (asyncio.CancelledError(), asyncio.CancelledError),
        (BrokenPipeError("standard error"), BrokenPipeError),
        (ValueError("nobody has thought of this"), ValueError),
        (Refused("no new still pose"), StationError),
        (DeviceSilent("the device has sent nothing"), StationError),
        (DiskError(NO_ROOM), DiskError),
    ],
)
async def test_whatever_stops_the_check_poses_the_old_calibration_is_back(
    open_bench: OpenBench, failure: BaseException, raised: type[BaseException]
) -> None:
    async def fails(check: Collection) -> None:
        assert _stored_bias(bench.served) == pytest.approx(BIAS)
        raise failure

    async with open_bench() as bench:
        back = bench.write_back(fails)
        with pytest.raises(raised):
            await bench.run(back)
        assert _state(back) is DeviceState.OLD
        _holds_old(bench.served)


async def test_no_number_of_cancellations_stops_the_old_calibration_from_coming_back(
    open_bench: OpenBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    struck = []

    async def striking(device: Device, *arguments: Any, **options: Any) -> Evidence:
        read = device.read

        async def strike(register: str) -> bytes:
            struck.append(task.cancel())
            return await read(register)

        monkeypatch.setattr(device, "read", strike)
        return await restore(device, *arguments, **options)

    async def collect(check: Collection) -> None:
        task.cancel()
        await asyncio.Event().wait()

    monkeypatch.setattr("triaxcald.provision.procedure.restore", striking)
    async with open_bench() as bench:
        back = bench.write_back(collect)
        task = asyncio.ensure_future(bench.run(back))
        await asyncio.wait([task])
        assert task.cancelled()
        assert len(struck) > 3
        assert _state(back) is DeviceState.OLD
        _holds_old(bench.served)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("faults", "why"),
    [
        (["stuck_output"], r"no check pose can be trusted: 1 left out \(stuck_output\)"),
        ([], "there is no check pose"),
    ],
)
async def test_without_a_check_pose_that_can_be_trusted_the_old_calibration_is_back(
    open_bench: OpenBench, monkeypatch: pytest.MonkeyPatch, faults: list[str], why: str
) -> None:
    """Whether the station has a limit or not."""
    poses = [Pose(0.0, 2.0, 200, np.array([1.0, 0, 0]), 1e-10 * np.eye(3), 50.0, fault=fault) for fault in faults]
    monkeypatch.setattr("triaxcald.run.write_back.corrected", lambda *_: verify(poses, 1.0))
    async with open_bench() as bench:
        back = bench.write_back(_no_pose)
        with pytest.raises(StationError, match=why):
            await bench.run(back)
        assert _state(back) is DeviceState.OLD
        _holds_old(bench.served)


@pytest.mark.slow
async def test_without_a_limit_a_calibration_worse_than_the_old_one_does_not_stay(
    open_bench: OpenBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    outputs = iter([1 + 1e-3, 1 + 1e-5])  # the check poses are asked for first

    def corrected(*_: object) -> Verification:
        mean = np.array([next(outputs), 0.0, 0.0])
        return verify([Pose(float(t), t + 2.0, 200, mean, 1e-10 * np.eye(3), 50.0) for t in range(6)], 1.0)

    monkeypatch.setattr("triaxcald.run.write_back.corrected", corrected)
    async with open_bench() as bench:
        back = bench.write_back(_no_pose)
        await bench.run(back)
        assert back.verification
        assert back.verification["verdict"] == "worse than before"
        assert _state(back) is DeviceState.OLD
        _holds_old(bench.served)


@pytest.mark.slow
async def test_a_unit_that_cannot_be_put_back_is_said_to_be_uncertain(open_bench: OpenBench) -> None:
    async def dies(check: Collection) -> None:
        bench.served.unit._died_s = 0.0
        raise asyncio.CancelledError

    async with open_bench() as bench:
        back = bench.write_back(dies)
        with pytest.raises(asyncio.CancelledError):
            await bench.run(back)
        assert back.provisioning is not None
        assert _state(back) is DeviceState.NEW_VERIFIED  # which it is; only that nobody wants it
        assert not back.provisioning.settled
        why = str(back.provisioning.undoing_failed)
        assert "no reply" in why or "nothing answers" in why
        assert back.provisioning.journal.path.exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("faults", "state"),
    [
        (Faults(refuse_registers=frozenset({"bias_y"})), DeviceState.OLD),
        (Faults(forget_store=True), DeviceState.OLD),
        (Faults(refuse_registers=frozenset({"scale_factor_x"})), DeviceState.OLD),
        (Faults(die_on_write="bias_y"), DeviceState.UNKNOWN),
        (Faults(die_on_write="store"), DeviceState.UNKNOWN),
    ],
)
async def test_writing_that_fails_says_what_the_device_holds(
    open_bench: OpenBench, faults: Faults, state: DeviceState
) -> None:
    async with open_bench(faults) as bench:
        back = bench.write_back(_no_pose)
        with pytest.raises(ProvisionError):
            await bench.run(back)
        assert _state(back) is state
        assert Stored.from_image(bench.served.unit.eeprom).calibration == OLD.calibration


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "at"),
    [
        ("attach", "registers-after.json"),
        ("attach", "verification.json"),
        ("event", "provisioned"),
    ],
)
async def test_a_disk_that_fails_once_the_new_calibration_is_stored_brings_the_old_one_back(
    open_bench: OpenBench, monkeypatch: pytest.MonkeyPatch, method: str, at: str
) -> None:
    failed = _disk_fails(monkeypatch, method, at)
    async with open_bench() as bench:
        back = bench.write_back(_no_pose)
        with pytest.raises(DiskError, match="No space left on device"):
            await bench.run(back)
        assert failed
        assert _state(back) is DeviceState.OLD
        _holds_old(bench.served)


def _disk_fails(monkeypatch: pytest.MonkeyPatch, method: str, at: str) -> list[str]:
    """From ``at`` on, for whatever is to be recorded."""
    failed: list[str] = []

    def failing(name: str) -> Callable[..., Any]:
        real = getattr(RecordingWriter, name)

        def call(self: RecordingWriter, first: str = "", *more: Any, **named: Any) -> Any:
            if failed or (name, first) == (method, at):
                failed.append(name)
                raise DiskError(NO_ROOM)
            return real(self, first, *more, **named)

        return call

    for name in ("attach", "event", "register"):
        monkeypatch.setattr(RecordingWriter, name, failing(name))
    return failed


async def test_a_disk_that_fails_before_the_first_register_leaves_the_device_untouched(
    open_bench: OpenBench, monkeypatch: pytest.MonkeyPatch
) -> None:
    _disk_fails(monkeypatch, "attach", "registers-before.json")
    async with open_bench() as bench:
        back = bench.write_back(_no_pose)
        with pytest.raises(DiskError, match="No space left on device"):
            await bench.run(back)
        assert _state(back) is DeviceState.UNTOUCHED
        assert bench.served.unit.eeprom == OLD.image()
