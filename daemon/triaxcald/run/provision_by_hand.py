"""Provisioning by hand: a calibration that was made before, one that was cut
short, or an old one put back."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald import text
from triaxcald.abort import AbortNotice, at_abort
from triaxcald.documents import json_value, to_text
from triaxcald.errors import BAD_INPUT, Implausible, InputError, RecordingError
from triaxcald.files import in_a_name, write_new
from triaxcald.inputs import document_bytes
from triaxcald.outcome import (
    SUFFIX,
    Code,
    Ending,
    Papers,
    outcome_document,
    registers_told,
)
from triaxcald.provision.access import RegisterLink
from triaxcald.provision.correction import require_unchanged
from triaxcald.provision.journal import journaled_image, open_journal, parse, registers_of
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.registers import (
    RegisterImage,
    SanityWarning,
    Snapshot,
    image_of,
    leaves_open,
    require_readings_before,
)
from triaxcald.provision.state import DeviceState, Evidence, Held
from triaxcald.recording.reader import Recording
from triaxcald.run.endings import aborted
from triaxcald.run.write_back import REGISTERS_BEFORE, REGISTERS_EARLIER
from triaxcald.schema.codes import Stage
from triaxcald.software import new_run_id, software
from triaxcald.station.config import Place, Station
from triaxcald.station.output_check import live_output_warnings
from triaxcald.station.power import power_cycle_asked
from triaxcald.store import History
from triaxcald.utc import file_stamp, iso_time
from triaxcald.work import Attempt, Work, wrong


@dataclass(frozen=True)
class Provisioned:
    """Result of a provisioning: ``error`` is one line if it failed, ``path`` that of
    the written outcome, if any."""

    exit_code: int
    document: tc.interchange.Document
    provisioning: Provisioning | None
    error: str | None
    path: Path | None


@dataclass
class ProvisionRun:
    """Writes ``image``, meant for the unit ``serial``, to the device at ``place``;
    without an image, that of an interrupted provisioning. ``force`` is the reason to
    write in spite of sanity warnings."""

    station: Station
    place: Place
    image: RegisterImage | None = None
    serial: str | None = None
    dry_run: bool = False
    force: str | None = None
    at_start: Mapping[str, bytes] | None = None
    """Registers by which the device corrected the readings of the calibration, if it
    did; the device must still hold them."""
    ask: Callable[[Stage, str], None] | None = None
    """Instructs the operator. If given, it asks for a power cycle when no restart
    proves the stored values."""
    clock_ns: Callable[[], int] = time.time_ns
    provisioning: Provisioning | None = field(default=None, init=False)
    warnings: Sequence[SanityWarning] = field(default=(), init=False)
    id: str = field(default_factory=new_run_id, init=False)
    _begun: Provisioning | None = field(default=None, init=False)
    _attempt: Attempt = field(init=False)

    def __post_init__(self) -> None:
        serial = self.serial if self.serial and wrong(self.serial) is None else self.place.unit.serial
        work = Work(self.place.unit.name, serial)
        self._attempt = Attempt(self.id, iso_time(self.clock_ns()), work)

    async def run(self) -> Provisioned:
        """Provision. Raises nothing, not even when cancelled: the outcome has every
        error."""
        ending: Ending | None = None
        try:
            with at_abort(self.abort_notice):
                async with self.place.opened() as device:
                    await self._work(device)
                    ending = Ending.of(Code.NOT_CHECKED, self._done())
                    if self.dry_run:
                        ending = replace(ending, code=None)
        except (Exception, asyncio.CancelledError) as e:  # noqa: BLE001 - every ending has an outcome
            if ending is None:  # an error of the closing alone changes nothing
                ending = aborted(e, self.provisioning)
        assert ending is not None
        document = self._document(ending)
        path = None
        if self.provisioning is not None and not self.dry_run and ending.exit_code != BAD_INPUT:
            try:
                path = self._write(document)
            except InputError as e:
                failed = ending if ending.exit_code else Ending.of(Code.DISK, str(e))
                ending = replace(failed, reason=f"{failed.reason}; {e}" if ending.exit_code else str(e))
                document = self._document(ending)
        return Provisioned(ending.exit_code, document, self.provisioning, self._error(ending), path)

    def abort_notice(self, _: float) -> AbortNotice | None:
        """State of the device after an abort at this moment."""
        p = self._begun
        return (
            AbortNotice(text.abort_notice(p, self.station.path), not p.settled)
            if p is not None and p.examined
            else None
        )

    async def _work(self, device: td.Device) -> None:
        bundle = self.place.bundle
        link = RegisterLink(device, bundle.profile, name=self.place.device_name)
        image = self.image or await self._image_of_journal(link)
        p = self._begin(link, image)
        if self.image is not None and leaves_open(bundle.profile):  # a resume completes an earlier decision
            await p.look()
            self.provisioning = p
            require_readings_before(bundle.profile, p.found)
        await p.examine(restart=not self.dry_run)
        self.provisioning = p
        if not p.carried:
            require_unchanged(p.found.raw, self.at_start)
        self.warnings = p.warnings
        if not p.carried and p.differing and not self.warnings:
            self.warnings = await live_output_warnings(device, bundle, p.found)
        if self.warnings and self.force is None and not self.dry_run:
            raise Implausible(text.refused_by_sanity_warnings(self.warnings))
        if not self.dry_run:
            with p.finishing():
                await p.write()

    def _begin(self, link: RegisterLink, image: RegisterImage) -> Provisioning:
        p = self._begun = Provisioning(
            link,
            self.place.bundle,
            image,
            unit=self.place.unit.name,
            folder=self.station.folder,
            expected_serial=self.serial or self.place.unit.serial,
            where=self.place.address,
            started=self._attempt.started,
            run=self.id,
            power_cycle=power_cycle_asked(self.ask, link, self.place, self.station) if self.ask else None,
        )
        return p

    async def _image_of_journal(self, link: RegisterLink) -> RegisterImage:
        image, self.serial = await journaled_image(
            link,
            self.place.bundle,
            folder=self.station.folder,
            unit=self.place.unit.name,
            expected_serial=self.place.unit.serial,
            where=self.place.address,
        )
        return image

    @property
    def _held(self) -> Held:
        if self._begun is not None and self._begun.identified:
            return self._begun.held
        known = self.image is not None and self._open_journal is None
        return Held() if known else Held(DeviceState.UNKNOWN, Evidence.NO_ANSWER)

    @property
    def _open_journal(self) -> Path | None:
        """The journal of this or an earlier provisioning, if it is still needed."""
        if self._begun is not None and self._begun.identified:
            return self._begun.open_journal
        serial = self.serial or self.place.unit.serial
        return open_journal(self.station.folder, self.place.bundle.profile, self.place.unit.name, serial)

    def _done(self) -> str:
        assert self.provisioning is not None
        if self.dry_run:
            return text.rehearsed(self.provisioning)
        return text.provisioned(self.provisioning)

    def _document(self, ending: Ending) -> tc.interchange.Document:
        p = self.provisioning
        history = History.of(self.station.folder, p.identity.serial) if p else History()
        settles = p.settles if p is not None and p.settled and not self.dry_run else None
        return outcome_document(
            ending,
            self._held,
            Papers(registers=registers_told(p) if p else None),
            unit=self.place.unit.name,
            serial=p.identity.serial if p else None,
            station=self.station.file.name,
            ended=iso_time(self.clock_ns()),
            software=software(),
            supersedes=history.latest,
            journal=str(self._open_journal) if self._open_journal else None,
            forced=self.force if self.warnings else None,
            attempt=replace(self._attempt, settles=settles),
        )

    def _write(self, document: tc.interchange.Document) -> Path:
        """Raises InputError."""
        stem = f"{in_a_name(document['serial'] or self.place.unit.name)}-{file_stamp(self.clock_ns())}"
        return write_new(self.station.folder, stem, SUFFIX, to_text(document))

    def _error(self, ending: Ending) -> str | None:
        if not ending.exit_code:
            return None
        told = [ending.reason]
        p = self._begun
        if p is not None and (p.examined or p.open_journal):
            told.append(text.abort_notice(p, self.station.path))
        elif self._open_journal:
            told.append(text.unfinished(self._open_journal, self.place.unit.name, self.station.path))
        return "; ".join(filter(None, told))


@dataclass
class RestoreRun(ProvisionRun):
    """Restores ``snapshot`` in the device at ``place``. ``source`` is the recording
    or the journal that contains it."""

    snapshot: Snapshot = field(default_factory=lambda: Snapshot({}))
    source: Path | None = None

    async def _work(self, device: td.Device) -> None:
        profile = self.place.bundle.profile
        self.serial = self.snapshot.serial
        p = self._begin(
            RegisterLink(device, profile, name=self.place.device_name), image_of(profile, self.snapshot.raw)
        )
        p.source = self.source if self.source is not None and self.source.suffix == ".json" else None
        try:
            with p.finishing():
                await p.put_back(self.snapshot)
        finally:
            self.provisioning = p if p.examined else None

    def _done(self) -> str:
        assert self.provisioning is not None
        return text.put_back(self.provisioning)


def snapshot_in(path: Path, profile: td.Profile) -> tuple[Snapshot, str | None]:
    """The register snapshot of a recording or a journal, and the name of the unit.
    Raises InputError."""
    held, serial, unit = _kept(path)
    for name, raw in held.items():
        if name not in profile.registers:
            raise InputError(f"{path}: register {name}: profile {profile.name} has none of that name")
        try:
            profile.decode(name, raw)
        except td.RegisterValueError as e:
            raise InputError(f"{path}: {e}") from e
    return Snapshot(held, serial), unit


def unit_in(path: Path) -> str | None:
    """The name of the unit in a recording or a journal. Raises InputError."""
    return _kept(path)[2]


def _kept(path: Path) -> tuple[Mapping[str, bytes], str | None, str | None]:
    if path.suffix != ".mcap":
        entry = parse(document_bytes(str(path)), where=str(path))
        return entry.before, entry.serial, entry.unit
    with Recording.open(path, unfinished=True) as recording:
        kept = next((n for n in (REGISTERS_EARLIER, REGISTERS_BEFORE) if n in recording.attachments), None)
        if kept is None:
            raise RecordingError(f"{path}: attachment {REGISTERS_BEFORE}: missing; no register was written in it")
        unit = recording.metadata.get("unit", {})
        try:
            held = registers_of(json_value(recording.attachments[kept]))
        except (ValueError, TypeError, AttributeError) as e:
            raise RecordingError(f"{path}: attachment {kept}: no registers: {e}") from e
        return held, unit.get("serial") or None, unit.get("name") or None
