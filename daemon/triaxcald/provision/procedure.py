"""Writes a calibration to a device so that it ends in one of two states: the new one verified, or the old."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Mapping
from dataclasses import dataclass, field

from triaxcal_drivers.errors import DriverError
from triaxcal_drivers.interface import Device
from triaxcal_drivers.profile import Bundle
from triaxcald.errors import ProvisionError, StationError
from triaxcald.provision.access import RecordedDevice, RegisterAccess
from triaxcald.provision.identity import IdentityRead, WrongUnit, check_identity
from triaxcald.provision.image import RegisterImage
from triaxcald.provision.restore import lock_quietly, restore
from triaxcald.provision.sequence import REAL_PACE, Label, Pace, run_sequence
from triaxcald.provision.snapshot import Snapshot, take_snapshot


@dataclass(frozen=True)
class ProvisionReport:
    """What was done. ``differing``: registers in which the device differed from the image; ``written`` are the
    same unless it was a dry run; ``unchanged`` the others. ``after`` was read after the restart. ``steps`` in
    words, in order."""

    identity: IdentityRead
    before: Snapshot
    differing: tuple[str, ...]
    written: tuple[str, ...]
    unchanged: tuple[str, ...]
    after: Snapshot
    stored: bool
    steps: tuple[str, ...]


@dataclass
class _Run:
    """One run of the procedure: with what, and how far it has come."""

    device: Device
    bundle: Bundle
    image: RegisterImage
    pace: Pace
    before: Snapshot | None = None
    written: list[str] = field(default_factory=list)
    unlocked: bool = False
    store_asked: bool = False
    steps: list[str] = field(default_factory=list)

    async def sequence(self, label: Label) -> None:
        self.steps.append(label)
        await run_sequence(self.device, self.bundle, label, self.pace)

    async def read(self, step: str) -> Snapshot:
        self.steps.append(step)
        return await take_snapshot(self.device, self.bundle)


async def provision(
    device: Device,
    bundle: Bundle,
    image: RegisterImage,
    *,
    expected_serial: str | None,
    record: Callable[[RegisterAccess], None] | None = None,
    dry_run: bool = False,
    where: str | None = None,
    pace: Pace = REAL_PACE,
) -> ProvisionReport:
    """Write ``image`` to the opened ``device``, make it permanent, restart the device and verify.

    Only registers that differ are written, the checksum last; a device that holds the image already is
    restarted and read, and not written. A dry run reads only. ``record`` is told of every register access.

    Raises WrongUnit (nothing was written) and ProvisionError, which says what failed at which step, and in
    what state the device is: the old calibration untouched, restored and verified, or not restored. A
    cancellation, like any other exception, goes on only once the old calibration is back. All but WrongUnit
    have that state as a note.
    """
    run = _Run(RecordedDevice(device, record) if record else device, bundle, image, pace)
    try:
        return await _provision(run, expected_serial, where, dry_run)
    except (DriverError, StationError) as e:
        if isinstance(e, WrongUnit) and not run.unlocked:
            raise
        state = await to_its_end(_undo(run))
        failed = ProvisionError(f"provisioning failed at {run.steps[-1]}: {e}; {state}")
        failed.add_note(state)
        raise failed from e
    except (Exception, asyncio.CancelledError, KeyboardInterrupt) as e:
        e.add_note(await to_its_end(_undo(run)))
        raise


async def _provision(run: _Run, expected_serial: str | None, where: str | None, dry_run: bool) -> ProvisionReport:
    run.steps.append("identity")
    identity = await check_identity(run.device, run.bundle, expected_serial, where=where)
    before = await run.read("reading the old calibration")
    if not dry_run and not before.differing(run.image.raw):
        await run.sequence("reset")  # what is in use may be the image and what is stored another
        before = await run.read("reading the stored calibration")
    run.before = after = before
    differing = before.differing(run.image.raw)
    if differing and not dry_run:
        await _write(run, differing)
        await run.sequence("store")
        await run.sequence("lock")
        await run.sequence("reset")
        run.steps.append("identity after the reset")
        await check_identity(run.device, run.bundle, identity.serial, where=where)
        after = await run.read("reading back after the reset")
        _require(run.image.raw, after)
    unchanged = tuple(name for name in before.raw if name not in differing)
    return ProvisionReport(
        identity, before, differing, tuple(run.written), unchanged, after, run.store_asked, tuple(run.steps)
    )


async def _write(run: _Run, names: tuple[str, ...]) -> None:
    run.unlocked = True
    await run.sequence("unlock")
    for name in names:
        run.steps.append(f"writing {name}")
        run.written.append(name)
        await run.device.write(name, run.image.raw[name])
    _require(run.image.raw, await run.read("reading back"))
    run.store_asked = True


def _require(expected: Mapping[str, bytes], held: Snapshot) -> None:
    for name in held.differing(expected):
        raise ProvisionError(f"register {name} holds {held.raw[name].hex()}, expected {expected[name].hex()}")


async def _undo(run: _Run) -> str:
    """Back to the old calibration; says in what state the device is."""
    if run.before is None or not run.written:
        if run.unlocked:
            await lock_quietly(run.device, run.bundle, run.pace)
        return "old calibration untouched"
    try:
        await restore(run.device, run.bundle, run.before, stored=run.store_asked, pace=run.pace)
    except StationError as e:
        stored = "either calibration may be stored" if run.store_asked else "the stored calibration is the old one"
        return f"NOT restored: {e}; {stored}"
    return "old calibration restored and verified"


async def to_its_end(work: Coroutine[object, object, str]) -> str:
    """Awaits ``work`` and does not let a further cancellation stop it half-way."""
    task = asyncio.ensure_future(work)
    while True:
        try:
            return await asyncio.shield(task)
        except asyncio.CancelledError:
            if task.done():
                raise
