"""Writes a calibration to a device so that it ends with the new one or with the
old one, and says with which."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import triaxcal_drivers as td
from triaxcald.errors import DiskError, InputError, ProvisionError, StationError, TwoAnswer
from triaxcald.provision.access import NO_CONTACT, Label, RegisterLink, lock_quietly, reconnect, run_sequence, run_steps
from triaxcald.provision.identity import IdentityRead, WrongUnit, check_identity, identified, require_alone
from triaxcald.provision.journal import Entry, Journal, Owner, Step, journals_of, was_cut_short
from triaxcald.provision.registers import (
    RegisterImage,
    SanityWarning,
    Snapshot,
    image_of,
    sanity_warnings,
    take_snapshot,
    unstable,
)
from triaxcald.provision.restart_check import Restart, checked_restart
from triaxcald.provision.state import DeviceState, Evidence, Held, Observation
from triaxcald.software import new_run_id

# Puts an old calibration back and shows that it is back, whatever state the device
# is in.

Images = Sequence[Mapping[str, bytes]]


async def restore(
    link: RegisterLink,
    bundle: td.Bundle,
    snapshot: Snapshot,
    *,
    stored: bool = True,
    wanted: Mapping[str, bytes] | None = None,
) -> Evidence:
    """Make the device hold ``snapshot``, also permanently where ``stored`` says
    that it may have been overwritten; ``wanted`` is what may have been stored
    in its place.

    First a restart: it brings back what is stored, and writes nothing. Then the
    registers that differ are written, and stored if ``stored``. The store is
    also sent if no restart has shown what is stored: the registers in use may
    differ from it. Returns once every register reads back as the snapshot's raw
    bytes; the evidence is a restart only if a probe was gone after it. Raises
    ProvisionError that says why not; WrongUnit, with nothing written, if another
    unit answers.
    """
    known = [snapshot.raw, wanted or {}]
    try:
        await _contact(link, bundle, snapshot)
        if stored:
            await let_a_store_end(link, bundle)
        restarted = await _restart(link, bundle, snapshot, known)
        doubtful = stored and not restarted and bool(bundle.profile.sequences.store)
        if await differing(link, bundle, snapshot) or doubtful:
            restarted = await _write_back(link, bundle, snapshot, known, stored)
    except td.DriverError as e:
        raise ProvisionError(str(e)) from e
    if not stored:
        return Evidence.NOTHING_STORED
    return Evidence.RESTART if restarted else Evidence.READ_BACK


async def let_a_store_end(link: RegisterLink, bundle: td.Bundle) -> None:
    """Wait for a running store to end: a restart in the middle of it could corrupt
    the stored copy."""
    waits = [step for step in bundle.profile.sequences.store if isinstance(step, (td.WaitStep, td.PollStep))]
    with suppress(td.DriverError, StationError):
        await run_steps(link, bundle, "store", waits)


async def differing(link: RegisterLink, bundle: td.Bundle, snapshot: Snapshot) -> tuple[str, ...]:
    """Registers of the snapshot's own unit that differ from the snapshot. Raises
    WrongUnit, DriverError."""
    await check_identity(link, bundle, snapshot.serial)
    return snapshot.differing((await take_snapshot(link, bundle, snapshot.raw)).raw)


async def _contact(link: RegisterLink, bundle: td.Bundle, snapshot: Snapshot) -> None:
    """Check the identity, over a new connection if the device just lost its power."""
    try:
        await check_identity(link, bundle, snapshot.serial)
    except NO_CONTACT:
        await reconnect(link, bundle.profile)
        await check_identity(link, bundle, snapshot.serial)


async def _restart(link: RegisterLink, bundle: td.Bundle, snapshot: Snapshot, known: Images) -> bool:
    """Whether a probe shows that the device restarted."""
    if not bundle.profile.sequences.reset:
        return False
    await lock_quietly(link, bundle)
    try:
        return (await checked_restart(link, bundle, snapshot.serial, *known)).probe_gone
    except WrongUnit:  # one of ProvisionError
        raise
    except (td.RegisterRefused, ProvisionError):
        return False  # writing the registers back may still succeed


async def _write_back(link: RegisterLink, bundle: td.Bundle, snapshot: Snapshot, known: Images, stored: bool) -> bool:
    acknowledged, theirs = True, False
    try:
        await run_sequence(link, bundle, "unlock")
        for name in await differing(link, bundle, snapshot):
            await link.write(name, snapshot.raw[name])
        await _require_equal(link, bundle, snapshot)  # never store a wrong value
        if stored:
            await require_alone(link, bundle)  # a store reaches every unit at the address
            acknowledged = await run_sequence(link, bundle, "store")
            await _require_equal(link, bundle, snapshot)  # the supply may have failed during the store
    except (WrongUnit, TwoAnswer):
        theirs = True
        raise
    finally:
        if not theirs:
            await lock_quietly(link, bundle)
    if not stored:
        return False
    restarted = False
    if bundle.profile.sequences.reset:
        restarted = (await checked_restart(link, bundle, snapshot.serial, *known)).probe_gone
    await _require_equal(link, bundle, snapshot)
    if not acknowledged and not restarted:
        raise ProvisionError("the store of the old calibration went unanswered, and no read decides what it did")
    return restarted


async def _require_equal(link: RegisterLink, bundle: td.Bundle, snapshot: Snapshot) -> None:
    if wrong := await differing(link, bundle, snapshot):
        raise ProvisionError(f"of the old calibration, {', '.join(wrong)} will not come back")


T = TypeVar("T")


@dataclass
class Provisioning:
    """Provisioning of one device: `examine`, then `write`; `undo` if the new
    calibration must not stay.

    ``folder`` is the station's, with the journal; ``started`` is a time as text for
    the journal. ``held`` is the state of the device at any moment, also after an
    exception. ``found`` is the first snapshot. ``before`` is the snapshot that an
    undo restores: ``found``, or the one before an earlier provisioning that was cut
    short. ``after`` is the last snapshot. ``differing`` are the registers that
    differed from the image, ``written`` the written ones, ``steps`` the steps in
    order.
    """

    link: RegisterLink
    bundle: td.Bundle
    image: RegisterImage
    unit: str
    folder: Path
    expected_serial: str | None
    where: str
    started: str = ""
    run: str = field(default_factory=new_run_id)
    """The identifier of this run. It names the journal of a unit without a
    serial number."""
    source: Path | None = None
    """The journal from which `put_back` takes its snapshot."""
    power_cycle: Callable[[], Awaitable[bool]] | None = None
    """Asks for a power cycle if no restart proves the stored values; returns whether
    the supply was seen off and on."""
    on_settled: Callable[[Held], None] = lambda _: None
    """Receives the state of a settled device before its journals are removed. Raises
    DiskError."""
    held: Held = field(default_factory=Held)
    warnings: list[SanityWarning] = field(default_factory=list)
    differing: tuple[str, ...] = ()
    written: list[str] = field(default_factory=list)
    steps: list[str] = field(default_factory=list)
    stored: bool = False
    carried: bool = False
    """Whether an earlier provisioning was cut short."""
    undoing_failed: str | None = None
    restart_owed: bool = False
    """Whether a restart still has to show that the values read are the stored ones."""
    _store_owed: bool = False
    """Whether the image is in use, but the interrupted provisioning may not have
    stored it."""
    _restarted: bool = False
    """Whether a restart was proven before the first reading of the registers."""
    _journaled: bool = False
    _probing: bool = False
    """Whether the journal is there for a probe alone."""
    _earlier: list[Journal] = field(default_factory=list)
    """Journals of this unit that earlier provisionings left, the newest first."""
    _removed: list[Journal] = field(default_factory=list)
    """Those of them that are gone since the device is settled."""
    _unlocked: bool = False
    _store_asked: bool = False
    _decided: bool = False

    _journals: list[tuple[Journal, Entry]] = field(default_factory=list)

    identity: IdentityRead = field(init=False)
    owner: Owner = field(init=False)
    journal: Journal = field(init=False)
    found: Snapshot = field(init=False)
    before: Snapshot = field(init=False)
    after: Snapshot = field(init=False)

    @property
    def identified(self) -> bool:
        """Whether the unit is identified."""
        return hasattr(self, "journal")

    @property
    def examined(self) -> bool:
        """Whether the unit is identified and its registers are read."""
        return hasattr(self, "before")

    @property
    def settles(self) -> str | None:
        """The id of the run whose journal this provisioning has removed, or would;
        None if there was none."""
        runs = {journal: entry.run for journal, entry in self._journals}
        return next((run for journal in self._removed or self._earlier if (run := runs.get(journal))), None)

    @property
    def resets(self) -> bool:
        """Whether the device can be restarted by a command."""
        return bool(self.bundle.profile.sequences.reset)

    @property
    def stores(self) -> bool:
        """Whether a write needs a store to last; else every write lasts."""
        return bool(self.bundle.profile.sequences.store)

    @property
    def open_journal(self) -> Path | None:
        """Path of the journal, if there is one and it is still needed."""
        if self.settled:
            return None
        if self._journaled:
            return self.journal.path
        return self._earlier[0].path if self._earlier else None

    async def examine(self, *, restart: bool = True) -> None:
        """Identify the unit and read its registers. Writes nothing, except the probe
        of a restart check if the device has a journal.

        A device that already holds the image, or that has a journal, is restarted if
        ``restart`` allows it: its values in use may differ from the stored ones.
        Raises ProvisionError, WrongUnit, InputError (the journal), DriverError,
        SequenceStalled.
        """
        if not self.examined:
            await self.look()
        journals = self._journals
        # Step 1: a restart, after which the values in use are the stored ones.
        if restart and self.restart_owed:
            if not journals:  # `write` proves its restart later, once the warnings are answered
                await self._sequence("reset")
            else:
                self.steps.append("reset")
                known = [image for _, entry in journals for image in (entry.before, entry.wanted)]
                self._restarted = (await self._restart(*known)).probe_gone
            self.found = await self._read("reading the stored calibration")
            self.restart_owed = False
            self._compare()
        # Step 2: continue an interrupted provisioning, or check the old calibration.
        entry = self._entry_of_this_unit(journals)
        if entry is not None:
            self.carried, self.before = True, Snapshot(entry.before, self.identity.serial)
            stored = entry.step in ("probing", "stored", "unverified")
            self._store_owed = self.stores and not stored and not self._restarted
            if self.found.differing(entry.wanted) and self.found.differing(entry.before):
                self.held.now(DeviceState.MIXED, Evidence.READ_BACK)
        else:
            self.held.now(DeviceState.UNTOUCHED, Evidence.NOTHING_WRITTEN)
            again = await self._read("reading the old calibration again")
            profile = self.bundle.profile
            self.warnings = unstable(profile, self.found, again) or sanity_warnings(profile, self.found, self.image)

    async def look(self) -> None:
        """Identify the unit and read its registers, without a write or a restart.
        Raises as `examine` does."""
        await self.identify()
        self._journals = journals_of(self.folder, self.owner, self.bundle.profile)
        if self._journals:
            self._earlier = [journal for journal, _ in self._journals]
            self.held.now(DeviceState.UNKNOWN, Evidence.NO_ANSWER)
        self.found = await self._read("reading the old calibration")
        self._compare()
        self.restart_owed = self.resets and (bool(self._journals) or not self.differing)

    def _compare(self) -> None:
        self.before = self.after = self.found
        self.differing = self.found.differing(self.image.raw)

    def _entry_of_this_unit(self, journals: list[tuple[Journal, Entry]]) -> Entry | None:
        """The journal entry of an interrupted provisioning of this device; journals
        of other units are ignored as far as they can be told apart."""
        profile = self.bundle.profile
        fits = [
            (journal, entry)
            for journal, entry in journals
            if was_cut_short(entry, profile, self.found, self.image, self._restarted)
        ]
        # A provisioning that continued an earlier journal left one of its own.
        same = [journal for journal, entry in fits if entry.before == fits[0][1].before]
        self._earlier = list(dict.fromkeys([*same, *self._named_for_it(journals)]))
        return fits[0][1] if fits else None

    def _named_for_it(self, journals: list[tuple[Journal, Entry]]) -> list[Journal]:
        """Journals with the product and the serial number of this unit. A journal of
        an earlier version has the digest of the profile in place of the product.
        Without a serial number, a probe is of this unit if its registers are."""
        mine = self.bundle.digest()
        return [
            j
            for j, e in journals
            if (e.serial is not None and (e.product or e.profile_sha256 == mine))
            or (e.step == "probing" and not self.found.differing(e.before))
        ]

    async def identify(self) -> None:
        """Identify the unit, and check that no other one answers. Raises WrongUnit,
        TwoAnswer, DriverError."""
        self.steps.append("identity")
        self.link.before_probe = self._before_probe
        self.identity = await identified(self.link, self.bundle, self.expected_serial, where=self.where)
        self.link.watch()
        self.owner = Owner.of(self.bundle.profile, self.unit, self.identity.serial)
        self.journal = Journal.of(self.folder, self.owner, self.run)

    async def write(self) -> None:
        """Write what differs, store it, restart the device, and read it back.

        Raises ProvisionError with the failed step and its error, WrongUnit,
        DiskError. Every exception, a cancellation too, is raised only after the
        attempt to restore the old calibration; ``held`` has its result.
        """
        try:
            if self.differing or self._store_owed:
                await self._write()
                await self._store()
                await self._prove()
            else:
                self.held.saw(Observation.READ_BACK)
                self.held.now(DeviceState.NEW_UNVERIFIED, Evidence.READ_BACK)
                await self._prove()
        except (td.DriverError, StationError) as trouble:
            e = await to_its_end(self._named(trouble))
            await to_its_end(self._give_up())
            if not self.written and isinstance(e, ProvisionError):
                raise
            raise ProvisionError(f"provisioning failed at {self.steps[-1]}: {e}") from e
        except BaseException:
            self._decided = self.held.state is DeviceState.NEW_VERIFIED
            await to_its_end(self._give_up())
            raise

    async def put_back(self, snapshot: Snapshot) -> None:
        """Write ``snapshot`` back into the device, in place of `examine` and `write`;
        ``image`` is that of the snapshot.

        An earlier journal stays unchanged, so an interruption adds no third set of
        values. Raises ProvisionError with the reason if the snapshot is not back;
        WrongUnit, DriverError, DiskError.
        """
        self.held.now(DeviceState.UNKNOWN, Evidence.NO_ANSWER)
        await self.identify()
        self.found = self.before = self.after = await self._read("reading the registers")
        self.differing = self.found.differing(snapshot.raw)
        with suppress(InputError):  # a journal that cannot be read is of no use
            journals = journals_of(self.folder, self.owner, self.bundle.profile)
            mine = [(j, e) for j, e in journals if j.path == self.source or (e.serial and e.before == snapshot.raw)]
            self._earlier = list(dict.fromkeys([*(j for j, _ in mine), *self._named_for_it(journals)]))
            self._journals = journals
            if mine:  # the wanted image is known: a device that holds it is not in a mixed state
                self.image = image_of(self.bundle.profile, mine[0][1].wanted)
        if self.differing and not self._earlier:
            self._note("writing")
        self.before, self.carried = snapshot, True
        await self.undo()
        self.written = [name for name in self.differing if name in self.link.touched]
        if (task := asyncio.current_task()) and task.cancelling():
            raise asyncio.CancelledError
        if self.held.state is DeviceState.OLD:
            await self.prove_old()
        if self.held.state is not DeviceState.OLD:
            raise ProvisionError(self.undoing_failed or "the old calibration is not back")

    async def undo(self) -> None:
        """Restore the old calibration by every means; ``held`` has the result."""
        await to_its_end(self._undo())

    async def prove_old(self) -> None:
        """Prove the restored calibration by a power cycle, if no restart has proven it
        and a power cycle can be requested."""
        if self.power_cycle is None or self.held.settled:
            return
        self.steps.append("power cycle")
        if await self.power_cycle():
            self.held.saw(Observation.SUPPLY_SWITCHED)
            self.after = await self._look()
            if lost := self.after.differing(self.before.raw):
                self.undoing_failed = f"after the power cycle {', '.join(lost)} no longer held the old calibration"
            self.held.now(self._state_of(self.after), Evidence.POWER_CYCLE)

    @property
    def settled(self) -> bool:
        """Whether the state of the device is known and needs no further work."""
        return self.held.settled and (self.undoing_failed is None or self.held.state is DeviceState.OLD)

    @contextmanager
    def finishing(self) -> Iterator[None]:
        """Calls `finish` at the end of the context. Raises DiskError, unless another
        exception is being raised."""
        try:
            yield
        except BaseException:
            with suppress(DiskError):
                self.finish()
            raise
        self.finish()

    def finish(self) -> None:
        """Remove the journals of a settled device; note an unverified one. Raises
        DiskError."""
        if not self.examined:
            return
        if self.settled:
            self.on_settled(self.held)
            for journal in (*self._earlier, *([self.journal] if self._journaled else [])):
                journal.remove()
            self._removed = self._removed or self._earlier
            self._earlier, self._journaled, self._probing = [], False, False
        elif self._probing and not self.link.touched & set(self.before.raw):  # the probe is gone
            self.journal.remove()
            self._journaled = self._probing = False
        elif self._journaled and self.held.state is DeviceState.NEW_UNVERIFIED:
            self._note("unverified")

    # Steps of `write`.

    async def _write(self) -> None:
        # The journal is on disk before the first write.
        await self._same_unit("identity before the unlock")
        self._note("writing")
        self._unlocked = True
        await self._sequence("unlock")
        for name in self.differing:
            self.steps.append(f"writing {name}")
            if not self.stores:  # each write lasts at once
                await self._require_same_unit()
            self.written.append(name)
            self.held.now(DeviceState.UNKNOWN, Evidence.NO_ANSWER)
            await self.link.write(name, self.image.raw[name])
        self.after = await self._read("reading back")
        self._require_image()

    async def _store(self) -> None:
        await self._same_unit("identity before the store")
        if self.stores:
            self._note("storing")
            count = await self._times_stored()
            self._store_asked = True
            self.stored = await self._sequence("store")
            # The acknowledgement, the write counter and the read-back are separate
            # observations: an unanswered store may have happened.
            if self.stored:
                self.held.saw(Observation.ACKNOWLEDGED)
            else:
                await self._reach()
            self._by_counter(count, await self._times_stored())
            # If the supply failed during the store, the device has restarted from a
            # partial copy.
            self.after = await self._read_after_store()
            self._require_image()
        else:
            self.stored = True
        self.held.saw(Observation.READ_BACK)
        if self.stored and self.held.state is not DeviceState.NEW_UNVERIFIED:
            self.held.now(DeviceState.NEW_UNVERIFIED, Evidence.READ_BACK)
        if self.stored:
            self._note("stored")
        self.steps.append("lock")
        await lock_quietly(self.link, self.bundle)

    async def _read_after_store(self) -> Snapshot:
        self.steps.append("reading after the store")
        try:
            return await self._look()
        except NO_CONTACT:
            await self._reach()
            return await self._look()

    async def _prove(self) -> None:
        self._decided = True  # further writes would not improve the evidence
        try:
            if self.resets:
                await self._prove_by_restart()
            else:
                await self._decide(Evidence.READ_BACK)  # the lock may have discarded unstored registers
            if self.held.state is not DeviceState.NEW_VERIFIED:
                await self._prove_by_power_cycle()
        except TwoAnswer:  # a probe may be in use, or a restart may have changed the registers
            self.held.now(DeviceState.UNKNOWN, Evidence.NO_ANSWER)
            raise
        if self.held.state is DeviceState.UNKNOWN:
            raise ProvisionError("the store went unanswered, and no read decides what it did")

    async def _prove_by_power_cycle(self) -> None:
        if self.power_cycle is None:
            return
        self.steps.append("power cycle")
        if await self.power_cycle():
            self.held.saw(Observation.SUPPLY_SWITCHED)
            await self._decide(Evidence.POWER_CYCLE)

    async def _prove_by_restart(self) -> None:
        self.steps.append("reset")
        try:
            restart = await self._restart(self.image.raw, self.before.raw, self.found.raw)
        except td.RegisterRefused:
            if self.power_cycle is None:
                raise
            return
        except ProvisionError:
            self._decided = False  # the probe is still in use
            raise
        self.steps.append("identity after the reset")
        await self._decide(Evidence.RESTART if restart.probe_gone else Evidence.READ_BACK)

    async def _decide(self, evidence: Evidence) -> None:
        """Read the registers and set the state of the device. Raises ProvisionError if
        they are not the image."""
        try:
            self.after = await self._look()
        except NO_CONTACT:
            await self._reach()
            self.after = await self._look()
        if not self.after.differing(self.image.raw):
            if evidence is not Evidence.READ_BACK:
                self.held.now(DeviceState.NEW_VERIFIED, evidence)
            return
        if not self.after.differing(self.before.raw) and evidence is not Evidence.READ_BACK:
            self.held.now(DeviceState.OLD, evidence)
            raise ProvisionError("after the restart the registers hold the old calibration: nothing was stored")
        self._decided = False  # what is stored is unknown until the old calibration is written and stored
        self.held.now(DeviceState.MIXED if self.after.differing(self.before.raw) else DeviceState.UNKNOWN, evidence)
        self._require_image()

    # Steps of `undo`.

    async def _give_up(self) -> None:
        if self._decided:
            return
        if self.written or self.carried or self._store_asked:
            await self._undo()
        elif self._unlocked:
            with suppress(td.DriverError, StationError):
                await self._require_same_unit()
                await lock_quietly(self.link, self.bundle)

    async def _undo(self) -> None:
        lasting = self._store_asked or not self.stores or self.carried
        was = self.held.state, self.held.evidence
        self.held.now(DeviceState.UNKNOWN, Evidence.NO_ANSWER)
        self.held.observed.clear()
        self.link.refresh()
        self.link.go_on_unrecorded()
        self.link.touched.clear()
        if not self.link.two_answered:
            try:
                evidence = await restore(self.link, self.bundle, self.before, stored=lasting, wanted=self.image.raw)
            except TwoAnswer:
                pass
            except StationError as e:
                self.undoing_failed = str(e)
                if not self.link.touched & set(self.before.raw):
                    self.held.now(*was)
                with suppress(td.DriverError, StationError):
                    await self._judge(lasting)
                return
            else:
                self.held.saw(Observation.READ_BACK)
                if evidence is Evidence.RESTART:
                    self.held.saw(Observation.MARK_GONE)
                self.held.now(DeviceState.OLD, evidence)
                return
        await to_its_end(self._undo_beside_another(lasting))

    async def _undo_beside_another(self, lasting: bool) -> None:
        """Undo while two units answer, when every write reaches both.

        Nothing is stored: a restart restores the stored values of each unit; without
        a restart command the old registers are put in use again. Changes by a store
        or a lasting write stay until one unit is taken away.
        """
        self.link.tolerate()
        self.undoing_failed = "two units answer; take one of them away, then restore"
        with suppress(td.DriverError, StationError):
            await lock_quietly(self.link, self.bundle)
            if self.resets:
                await self._sequence("reset")
            elif not lasting:
                await self._write_old_in_use()
            if lasting:
                return
            self.after = await self._look()
            if not self.after.differing(self.before.raw):
                self.undoing_failed = None
                # Without a restart the other unit may be the one that was read.
                self.held.now(DeviceState.OLD, Evidence.NOTHING_STORED if self.resets else Evidence.READ_BACK)

    async def _write_old_in_use(self) -> None:
        await self._sequence("unlock")
        for name in self.written:
            await self.link.write(name, self.before.raw[name])
        await lock_quietly(self.link, self.bundle)

    async def _named(self, e: td.DriverError | StationError) -> td.DriverError | StationError:
        """The error, with both serial numbers if two units answer."""
        if not isinstance(e, TwoAnswer):
            return e
        self.link.tolerate()
        try:
            await require_alone(self.link, self.bundle)
        except TwoAnswer as named:
            return named
        except td.DriverError:
            pass
        return e

    async def _judge(self, lasting: bool) -> None:
        """Set the state of the device after a failed undo. Raises DriverError,
        StationError."""
        await self._require_same_unit()
        restarted = self.resets and (await self._restart(self.before.raw, self.image.raw)).probe_gone
        held = self.after = await self._look()
        state = self._state_of(held)
        if not restarted and state is DeviceState.OLD and lasting:
            state = DeviceState.UNKNOWN
        if not restarted and state is DeviceState.NEW_VERIFIED:
            state = DeviceState.NEW_UNVERIFIED if self.stored or not self.stores else DeviceState.UNKNOWN
        self.held.now(state, Evidence.RESTART if restarted else Evidence.READ_BACK)

    def _state_of(self, held: Snapshot) -> DeviceState:
        """State of a device that restarted with these registers."""
        if not held.differing(self.before.raw):
            return DeviceState.OLD
        if not self.before.differing(self.image.raw) and not held.differing(self.found.raw):
            return DeviceState.UNKNOWN  # a restoration changed nothing, and the new calibration is unknown
        return DeviceState.MIXED if held.differing(self.image.raw) else DeviceState.NEW_VERIFIED

    # Shared steps.

    async def _sequence(self, label: Label) -> bool:
        self.steps.append(label)
        return await run_sequence(self.link, self.bundle, label)

    async def _restart(self, *known: Mapping[str, bytes]) -> Restart:
        restart = await checked_restart(self.link, self.bundle, self.identity.serial, *known)
        if restart.probe_gone:
            self.held.saw(Observation.MARK_GONE)
        return restart

    async def _read(self, step: str) -> Snapshot:
        self.steps.append(step)
        return await take_snapshot(self.link, self.bundle)

    async def _same_unit(self, step: str) -> None:
        self.steps.append(step)
        await identified(self.link, self.bundle, self.identity.serial, where=self.where)

    async def _require_same_unit(self) -> None:
        await check_identity(self.link, self.bundle, self.identity.serial, where=self.where)

    async def _look(self) -> Snapshot:
        """Snapshot of the same unit, with no other one answering."""
        await self._require_same_unit()
        found = await take_snapshot(self.link, self.bundle)
        if not self.link.tolerant:
            await require_alone(self.link, self.bundle)
        return found

    async def _reach(self) -> None:
        self.link.refresh()
        await reconnect(self.link, self.bundle.profile)

    async def _times_stored(self) -> bytes | None:
        name = self.bundle.profile.by_role(td.roles.WRITE_COUNTER_ROLE)
        return None if name is None else await self.link.read(name)

    def _by_counter(self, before: bytes | None, after: bytes | None) -> None:
        """Compare the write counter before and after the store. Raises ProvisionError
        if an unanswered store was not counted and no restart can show more."""
        if before is not None and before != after:
            self.held.saw(Observation.COUNTER_ADVANCED)
            if not self.stored:
                self.stored = True
                self.held.now(DeviceState.NEW_UNVERIFIED, Evidence.WRITE_COUNTER)
        elif not self.stored and before is not None and not self.resets:
            raise ProvisionError("the store went unanswered, and by its counter the device has not stored")

    def _require_image(self) -> None:
        for name in self.after.differing(self.image.raw):
            raise ProvisionError(
                f"register {name} holds {self.after.raw[name].hex()}, expected {self.image.raw[name].hex()}"
            )

    def _before_probe(self) -> None:
        """The journal is on disk before the first probe, which stands in no register
        image. Raises DiskError."""
        if self.examined and not (self._journaled or self._earlier):
            self._note("probing")

    def _note(self, step: Step) -> None:
        self._journaled, self._probing = True, step == "probing"
        self.journal.write(
            Entry(
                unit=self.unit,
                product=self.owner.product,
                run=self.run,
                serial=self.identity.serial,
                profile_sha256=self.bundle.digest(),
                started=self.started,
                before=self.before.raw,
                wanted={word.register: word.raw for word in self.image.words},
                step=step,
            )
        )


async def to_its_end(work: Coroutine[object, object, T]) -> T:
    """The result of ``work``, which no cancellation stops half-way or hides.

    A caller that has more to do afterwards looks whether it was cancelled
    meanwhile (`asyncio.Task.cancelling`).
    """
    task = asyncio.ensure_future(work)
    while not task.done():
        with suppress(asyncio.CancelledError):
            await asyncio.wait([task])
    return task.result()
