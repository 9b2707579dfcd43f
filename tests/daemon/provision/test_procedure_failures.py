"""Every failure at every step ends with the old calibration, or says truly what the device holds instead."""

import asyncio
import contextlib

import pytest

from triaxcal_drivers.errors import DeviceSilent, DriverError, RegisterRefused
from triaxcald.errors import ProvisionError
from triaxcald.provision.procedure import to_its_end
from triaxcald.provision.state import DeviceState, Evidence
from triaxcald.simulation.unit import CALIBRATION, ConstantPhysics, Faults, ReferenceUnit, Stored

OLD, UNTOUCHED, UNKNOWN = DeviceState.OLD, DeviceState.UNTOUCHED, DeviceState.UNKNOWN
NEW = (DeviceState.NEW_VERIFIED, DeviceState.NEW_UNVERIFIED)


def refusing(*names: str) -> Faults:
    return Faults(refuse_registers=frozenset(names))


async def fail(bench) -> str:
    with pytest.raises(ProvisionError) as caught:
        await bench.provision()
    message = str(caught.value)
    assert "\n" not in message
    return message.removeprefix("provisioning failed at ")


async def test_a_refused_unlock_leaves_the_unit_untouched(make_bench) -> None:
    bench = make_bench(faults=refusing("unlock_key"))
    assert await fail(bench) == "unlock: register unlock_key: locked"
    assert bench.held.state is UNTOUCHED
    assert bench.journals == []
    bench.assert_holds(bench.old)
    assert bench.device.written == []


@pytest.mark.parametrize("name", CALIBRATION)
async def test_a_refused_write_is_undone(make_bench, name: str) -> None:
    bench = make_bench(faults=refusing(name))
    assert await fail(bench) == f"writing {name}: register {name}: locked"
    assert (bench.held.state, bench.held.evidence) == (OLD, Evidence.NOTHING_STORED)
    assert bench.journals == []
    bench.assert_holds(bench.old)
    assert bench.stored.write_counter == 3


@pytest.mark.parametrize("name", CALIBRATION)
async def test_a_register_that_reads_back_differently_is_never_stored(make_bench, name: str) -> None:
    bench = make_bench(faults=Faults(corrupt_write={name: 0x01}))
    message = await fail(bench)
    assert message.startswith(f"reading back: register {name} holds ")
    assert bench.held.state is OLD
    bench.assert_holds(bench.old)
    assert bench.stored.write_counter == 3


async def test_a_refused_store_is_undone(make_bench) -> None:
    bench = make_bench(faults=refusing("store"))
    assert await fail(bench) == "store: register store: locked"
    assert (bench.held.state, bench.held.evidence) == (OLD, Evidence.RESTART)
    bench.assert_holds(bench.old)


async def test_a_forgotten_store_is_noticed_after_the_reset(make_bench) -> None:
    bench = make_bench(faults=Faults(forget_store=True))
    message = await fail(bench)
    assert message.endswith("after the restart the registers hold the old calibration: nothing was stored")
    assert (bench.held.state, bench.held.evidence) == (OLD, Evidence.RESTART)
    assert bench.device.log.count(("write", "store")) == 1
    bench.assert_holds(bench.old)


async def test_a_refused_reset_leaves_a_stored_calibration_that_no_restart_has_proven(make_bench) -> None:
    bench = make_bench(faults=refusing("reset"))
    assert await fail(bench) == "reset: register reset: locked"
    assert (bench.held.state, bench.held.evidence) == (DeviceState.NEW_UNVERIFIED, Evidence.READ_BACK)
    assert bench.journals == ["TRIAX-REF-0007.json"]
    bench.assert_stored(bench.new)


@pytest.mark.parametrize("name", ["unlock_key", *CALIBRATION])
async def test_a_unit_that_dies_before_the_store_keeps_its_old_calibration(make_bench, name: str) -> None:
    bench = make_bench(faults=Faults(die_on_write=name))
    message = await fail(bench)
    if name == "unlock_key":
        assert message.startswith("unlock: ")
        assert bench.held.state is UNTOUCHED
    else:
        assert message.startswith(f"writing {name}: ")
        assert (bench.held.state, bench.held.evidence) == (UNKNOWN, Evidence.NO_ANSWER)
        assert bench.journals == ["TRIAX-REF-0007.json"]
    bench.assert_stored(bench.old)


async def test_what_a_unit_holds_that_dies_on_the_store_is_unknown(make_bench) -> None:
    bench = make_bench(faults=Faults(die_on_write="store"))
    assert (await fail(bench)).startswith("store: ")
    assert (bench.held.state, bench.held.evidence) == (UNKNOWN, Evidence.NO_ANSWER)
    bench.assert_stored(bench.old)


async def test_what_a_unit_holds_that_dies_while_storing_is_unknown(make_bench) -> None:
    clean = make_bench()
    store_s = None

    def watch(operation: int, done: bool) -> None:
        nonlocal store_s
        if clean.device.log[-1] == ("write", "store"):
            store_s = clean.device.now_s

    clean.device.trouble = watch
    await clean.provision()
    bench = make_bench(faults=Faults(die_at_s=store_s + 0.03))
    assert (await fail(bench)).startswith("store: ")
    assert bench.held.state is UNKNOWN
    bench.assert_stored(bench.old)


async def test_a_value_that_was_put_in_to_show_a_restart_does_not_stay(bench) -> None:
    """No reset is heard, and the register takes the new value again only at the second attempt."""
    puts: list[str] = []

    def deaf_to_resets(operation: int, done: bool) -> None:
        request = bench.device.log[-1]
        if done:
            return
        if request == ("write", "reset"):
            raise DeviceSilent("no reply")
        if request == ("write", "scale_factor_x"):
            puts.append(request[1])
            if len(puts) == 4:  # the new value, a probe for each attempt, the new value again
                raise RegisterRefused("locked", register=request[1], code=1)

    bench.device.trouble = deaf_to_resets
    assert await fail(bench) == "reset: register scale_factor_x does not take its value again"
    assert bench.held.state in (OLD, UNKNOWN)
    bench.assert_holds(bench.old)


async def test_a_unit_that_dies_on_the_reset_holds_the_new_calibration_unverified(make_bench) -> None:
    bench = make_bench(faults=Faults(die_on_write="reset"))
    assert (await fail(bench)).startswith("reset: ")
    assert (bench.held.state, bench.held.evidence) == (DeviceState.NEW_UNVERIFIED, Evidence.READ_BACK)
    assert bench.journals == ["TRIAX-REF-0007.json"]
    bench.assert_stored(bench.new)


async def test_values_tried_but_never_stored_come_back_too(make_bench) -> None:
    bench = make_bench(faults=refusing("calibration_date"))
    bench.put_in_ram("bias_x", 0.125)
    tried = {name: bench.unit.read(name, bench.device.now_s) for name in CALIBRATION}
    await fail(bench)
    assert bench.held.state is OLD
    assert {name: bench.unit.read(name, bench.device.now_s) for name in CALIBRATION} == tried
    bench.assert_stored(bench.old)


class Trouble:
    """Strikes once, at operation number ``at``."""

    def __init__(self, bench, kind: str, at: int) -> None:
        self.bench, self.kind, self.at = bench, kind, at
        self.task: asyncio.Task[object] | None = None
        bench.device.trouble = self

    def __call__(self, operation: int, done: bool) -> None:
        device, at_s = self.bench.device, self.bench.device.now_s
        if operation != self.at or done != (self.kind in ("the reply is lost", "power is cut after it")):
            return
        self.at = 0
        match self.kind:
            case "power is cut before it" | "power is cut after it":
                device.unit.power_cycle(at_s)
            case "the unit dies":
                device.unit.power_cycle(at_s)
                device.dead = True
            case "the request is lost" | "the reply is lost":
                raise DeviceSilent("no reply")
            case "it is refused":
                raise RegisterRefused("refused", register="?", code=1)
            case "it is cancelled":
                self.task.cancel()
            case "it is interrupted":
                raise KeyboardInterrupt
            case "a bug shows":
                raise ZeroDivisionError


async def operations_of_a_clean_run(make_bench) -> int:
    bench = make_bench()
    await bench.provision()
    assert bench.device.operations > 90
    return bench.device.operations


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [
        "power is cut before it",
        "power is cut after it",
        "the unit dies",
        "the request is lost",
        "the reply is lost",
        "it is refused",
    ],
)
async def test_whatever_operation_is_struck_the_outcome_is_as_told(make_bench, kind: str) -> None:
    told = {}
    for at in range(1, await operations_of_a_clean_run(make_bench) + 1):
        bench = make_bench()
        Trouble(bench, kind, at)
        with contextlib.suppress(DriverError, ProvisionError):
            await bench.provision()
        state = told[at] = bench.held.state
        match state:
            case DeviceState.UNTOUCHED | DeviceState.OLD if kind == "the unit dies":
                bench.assert_stored(bench.old)
            case DeviceState.UNTOUCHED | DeviceState.OLD:
                bench.assert_holds(bench.old)
            case DeviceState.NEW_VERIFIED:
                bench.assert_holds(bench.new)
            case DeviceState.NEW_UNVERIFIED:
                bench.assert_stored(bench.new)
            case _:
                assert kind == "the unit dies", (at, state)
                bench.assert_stored(bench.old if bench.stored.write_counter == 3 else bench.new)
    states = set(told.values())
    match kind:
        case "the unit dies":
            assert states == {UNTOUCHED, UNKNOWN, DeviceState.NEW_UNVERIFIED}
        case "the reply is lost":
            assert states == {DeviceState.NEW_VERIFIED}  # what is lost once is asked again, or read
        case "the request is lost":
            assert states == {DeviceState.NEW_VERIFIED, OLD}  # a lost store is never sent again
        case _:
            assert {UNTOUCHED, OLD} <= states <= {UNTOUCHED, OLD, *NEW}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "error"),
    [
        ("it is cancelled", asyncio.CancelledError),
        ("it is interrupted", KeyboardInterrupt),
        ("a bug shows", ZeroDivisionError),
    ],
)
async def test_whenever_it_is_stopped_the_old_calibration_is_back_before_it_goes_on(make_bench, kind, error) -> None:
    states = set()
    for at in range(1, await operations_of_a_clean_run(make_bench) + 1):
        bench = make_bench()
        trouble = Trouble(bench, kind, at)

        async def run(bench=bench) -> DeviceState:
            with pytest.raises(error):
                await bench.provision()
            return bench.held.state

        trouble.task = asyncio.create_task(run())
        state = await trouble.task
        states.add(state)
        bench.assert_holds(bench.new if state in NEW else bench.old)
    assert {UNTOUCHED, OLD} <= states <= {UNTOUCHED, OLD, *NEW}


async def test_a_store_under_way_is_let_to_end_before_the_restart(make_bench) -> None:
    clean = make_bench()
    await clean.provision()
    store = clean.device.log.index(("write", "store")) + 1
    bench = make_bench()
    trouble = Trouble(bench, "it is cancelled", store + 1)
    trouble.task = asyncio.create_task(bench.provision())
    with pytest.raises(asyncio.CancelledError):
        await trouble.task
    assert bench.stored.write_counter == 5  # the new one was stored whole, then the old one again
    bench.assert_holds(bench.old)


async def test_where_the_restart_is_refused_the_old_values_are_written_back(make_bench) -> None:
    bench = make_bench(faults=refusing("reset", "calibration_date"))
    await fail(bench)
    assert bench.held.state is OLD
    bench.assert_holds(bench.old)
    assert bench.device.written.count("bias_x") == 2


async def test_a_second_cancellation_does_not_stop_the_restoring(make_bench) -> None:
    bench = make_bench()
    trouble = Trouble(bench, "it is cancelled", await operations_of_a_clean_run(make_bench))
    trouble.task = task = asyncio.create_task(bench.provision())
    strike = trouble.__call__

    def twice(operation: int, done: bool) -> None:
        strike(operation, done)
        if trouble.at == 0:
            task.cancel()

    bench.device.trouble = twice
    with pytest.raises(asyncio.CancelledError):
        await task
    bench.assert_holds(bench.old)


@pytest.mark.parametrize("turns", range(4))
async def test_a_cancellation_that_comes_as_the_restoring_ends_does_not_hide_what_came_of_it(turns: int) -> None:
    async def work() -> str:
        await asyncio.sleep(0)
        ending.set()
        return "restored"

    ending = asyncio.Event()
    task = asyncio.create_task(to_its_end(work()))
    await ending.wait()
    for _ in range(turns):
        await asyncio.sleep(0)
    task.cancel()
    assert await task == "restored"


async def test_a_device_whose_old_calibration_was_damaged_can_be_provisioned(make_bench) -> None:
    bench = make_bench()
    image = bytearray(Stored(bench.old, write_counter=3).image())
    image[-1] ^= 0xFF
    bench.unit = ReferenceUnit(ConstantPhysics(), serial_number=7, stored=bytes(image))
    bench.device.exchange(bench.unit)
    await bench.provision()
    bench.assert_holds(bench.new)
