"""All orders of faults, against a model of a device: what is said of it is never wrong.

The faults of an order strike one after another, each at its next operation, or at one after that. A fault of the line
strikes once, a second unit stays, and a device goes on as it began.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.daemon.provision.model_device import FAULTS, NEW, OLD, OTHERS, Fault, Kind, ModelDevice, bundle_of
from triaxcal_drivers.errors import DriverError
from triaxcald.errors import DaemonError
from triaxcald.provision.access import RegisterLink
from triaxcald.provision.journal import parse
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.registers import Snapshot, image_of
from triaxcald.provision.state import DeviceState, Evidence

KINDS = [
    Kind(store=store, reset=reset, counter=counter)
    for store, reset, counter in itertools.product((True, False), repeat=3)
]
BUNDLES = {kind: bundle_of(kind) for kind in KINDS}


@dataclass(frozen=True)
class Run:
    """``done``: it ended without an error. ``stored`` and ``in_use`` are the truth afterwards."""

    done: bool
    state: DeviceState
    evidence: Evidence
    settled: bool
    stored: Mapping[str, bytes]
    in_use: Mapping[str, bytes]
    others: Mapping[str, bytes] | None
    stores: bool
    """Whether writes take a store to last. A direct write reaches a second unit before anybody can know of it."""


def provisioning(device: ModelDevice, folder: Path, wanted: Mapping[str, bytes]) -> Provisioning:
    bundle = BUNDLES[device.kind]
    link = RegisterLink(device, bundle.profile, clock=device.clock)
    image = image_of(bundle.profile, wanted)
    return Provisioning(link, bundle, image, unit="u", folder=folder, expected_serial="0777", where="here", run="1")


async def _to_the_end(device: ModelDevice, folder: Path) -> Run:
    p, done = provisioning(device, folder, NEW), False
    with suppress(DriverError, DaemonError):
        await p.examine()
        with p.finishing():
            await p.write()
        done = True
    return _run(p, device, done)


def _run(p: Provisioning, device: ModelDevice, done: bool) -> Run:
    unit, second = device.unit, device.second
    others = None if second is None else dict(second.eeprom)
    stores = device.kind.store
    return Run(done, p.held.state, p.held.evidence, p.settled, dict(unit.eeprom), dict(unit.ram), others, stores)


async def _restored(device: ModelDevice, folder: Path) -> Run | None:
    """By the journal, once nothing strikes any more; None where there is none."""
    device.calm()
    found = sorted(folder.glob("journal/*.json"))
    if not found:
        return None
    entry = parse(found[0].read_bytes(), where="the journal")
    p, done = provisioning(device, folder, entry.before), False
    with suppress(DriverError, DaemonError):
        with p.finishing():
            await p.put_back(Snapshot(entry.before, entry.serial))
        done = True
    return _run(p, device, done)


def is_mixture(registers: Mapping[str, bytes]) -> bool:
    return registers not in (OLD, NEW)


def wrong(run: Run) -> str | None:
    """What is wrong in what was said."""
    match run.state:
        case DeviceState.UNTOUCHED if run.stored != OLD:
            return "said to be untouched"
        case DeviceState.OLD if run.settled and run.stored != OLD:
            return "said to hold the old calibration"
        case DeviceState.OLD if run.in_use != OLD and run.evidence is Evidence.READ_BACK:
            return "said to have the old calibration in use"
        case DeviceState.NEW_VERIFIED if run.stored != NEW:
            return "said to hold the new calibration"
        case DeviceState.NEW_UNVERIFIED if run.in_use != NEW:
            return "said to have the new calibration in use"
        case DeviceState.MIXED if not is_mixture(run.stored) and not is_mixture(run.in_use):
            return "said to hold a mixture"
    if is_mixture(run.in_use) and run.state not in (DeviceState.MIXED, DeviceState.UNKNOWN):
        return "a mixture is not told"
    if run.others not in (None, OTHERS) and (run.done or run.stores):
        return "a second unit was stored as well"
    if run.done and run.state in (DeviceState.MIXED, DeviceState.UNKNOWN):
        return "ended well with nothing known"
    return None


def orders(depth: int, faults: Sequence[Fault] = FAULTS) -> Iterator[tuple[Fault, ...]]:
    for n in range(1, depth + 1):
        yield from itertools.product(faults, repeat=n)


async def _both(device: ModelDevice, folder: Path) -> str | None:
    """Provision; then, with nothing striking any more, restore what is not settled. What is wrong in what was said."""
    run = await _to_the_end(device, folder)
    found = wrong(run)
    if found is None and not run.settled:
        again = await _restored(device, folder)
        if again is not None and (found := wrong(again)) is not None:
            found = f"restored: {found}"
    for path in folder.glob("journal/*.json"):
        path.unlink()
    return found


async def false_statements(
    kind: Kind, every: Iterator[tuple[Fault, ...]], occurrences: int, folder: Path
) -> list[tuple[str, tuple[Fault, ...], tuple[int, ...]]]:
    """Of all the orders; each fault strikes at each of so many next operations."""
    found = []
    for order in every:
        for at in itertools.product(range(occurrences), repeat=len(order)):
            if (what := await _both(ModelDevice(kind, order, at), folder)) is not None:
                found.append((what, order, at))
    return found


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The disk is not what is tested here: it need not synchronise thousands of journals."""
    monkeypatch.setattr("os.fsync", lambda descriptor: None)
    return tmp_path


every_kind = pytest.mark.parametrize("kind", KINDS, ids=str)


@every_kind
async def test_nothing_false_is_said_after_two_faults(folder: Path, kind: Kind) -> None:
    every = orders(2, (*FAULTS, "flipped"))
    assert await false_statements(kind, every, 1, folder) == []


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind.counter], ids=str)
async def test_nothing_false_is_said_after_three_faults_wherever_they_strike(folder: Path, kind: Kind) -> None:
    every = orders(3, (*FAULTS, "flipped"))
    assert await false_statements(kind, every, 2, folder) == []


@pytest.mark.slow
@every_kind
async def test_nothing_false_is_said_after_four_faults(folder: Path, kind: Kind) -> None:
    every = list(orders(4))
    assert len(every) == 8 + 8**2 + 8**3 + 8**4
    assert await false_statements(kind, iter(every), 1, folder) == []


async def test_a_clean_run_ends_as_the_device_allows(folder: Path) -> None:
    for kind in KINDS:
        run = await _to_the_end(ModelDevice(kind, ()), folder)
        verified = kind.store and kind.reset
        assert run.done
        assert run.stored == NEW
        assert run.state is (DeviceState.NEW_VERIFIED if verified else DeviceState.NEW_UNVERIFIED)
        for path in folder.glob("journal/*.json"):
            path.unlink()


@pytest.mark.parametrize(
    ("kind", "order", "at", "state", "stored"),
    [
        # It drops what is not stored when it is locked, ignores its restart and has forgotten its store.
        (Kind(), ("forgotten", "reverted on lock", "ignored"), (0, 0, 3), DeviceState.NEW_UNVERIFIED, OLD),
        # It writes directly, forgets, and only acknowledges its restart.
        (Kind(store=False), ("forgotten", "ignored"), (1, 1), DeviceState.NEW_UNVERIFIED, None),
        # Its supply dips in the store, after its counter has advanced.
        (Kind(reset=False), ("torn",), (0,), DeviceState.OLD, OLD),
        # Its store flips just the bit by which a probe differs.
        (Kind(), ("flipped",), (0,), DeviceState.OLD, OLD),
        # A second unit answers from the second request on, and from the last look before the store on.
        (Kind(), ("second unit answers",), (1,), DeviceState.UNTOUCHED, OLD),
        (Kind(), ("second unit answers",), (14,), DeviceState.OLD, OLD),
    ],
)
async def test_what_a_device_holds_after_these_faults_is_told(
    folder: Path, kind: Kind, order: Sequence[Fault], at: Sequence[int], state: DeviceState, stored: dict[str, bytes]
) -> None:
    device = ModelDevice(kind, order, at)
    run = await _to_the_end(device, folder)
    assert wrong(run) is None
    assert device.struck_all
    assert run.state is state
    assert stored is None or run.stored == stored
    assert run.others in (None, OTHERS)
    assert run.done is (state is DeviceState.NEW_UNVERIFIED)
