"""One unit's way down the line: record, certify, provision, verify. Everything
goes into its recording."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable, Generator, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald import text
from triaxcald.abort import AbortNotice, at_abort
from triaxcald.certificate import Certified, certify, why_not_written
from triaxcald.documents import to_text
from triaxcald.earlier_calibration import ATTACHMENT as EARLIER
from triaxcald.earlier_calibration import RECORD, EarlierFile
from triaxcald.errors import DISK, REFUSED, InputError, RecordingError
from triaxcald.files import in_a_name, unused, write_new, write_text
from triaxcald.inputs import CALIBRATION, VERIFICATION
from triaxcald.learned_odds import RECORD as ODDS_RECORD
from triaxcald.learned_odds import OddsFile, odds_of_station
from triaxcald.outcome import (
    ATTACHMENT,
    CERTIFICATE,
    FORMAT,
    REPORT,
    RUN_RECORD,
    SUFFIX,
    Code,
    Ending,
    Papers,
    Verdict,
    digest_of,
    measured_in,
    outcome_document,
    registers_told,
)
from triaxcald.provision.identity import IdentityRead
from triaxcald.provision.journal import Owner, journals_of, open_journal
from triaxcald.provision.procedure import Provisioning, to_its_end
from triaxcald.provision.registers import RegisterImage, leaves_open, require_readings_before
from triaxcald.provision.state import DeviceState, Evidence, Held
from triaxcald.raw_to_poses import Pipeline
from triaxcald.recording.manifest import SealedContents, SignatureMade
from triaxcald.recording.schema import ODDS_FILE, SIGNATURE_FILE
from triaxcald.recording.writer import RecordingWriter
from triaxcald.report.page import unit_report
from triaxcald.run.attempts import AttemptFile, Attempts, Killed, settle_killed
from triaxcald.run.endings import aborted, judged
from triaxcald.run.golden_unit import ATTACHMENT as GOLDEN_FILE
from triaxcald.run.golden_unit import RECORD as GOLDEN_RECORD
from triaxcald.run.golden_unit import GoldenCheck, check_directions, require_trusted
from triaxcald.run.orders import require_allowed, require_serial
from triaxcald.run.session import UnitSession
from triaxcald.run.together import side_by_side, whole_on_a_thread
from triaxcald.run.tray_progress import TrayProgress
from triaxcald.run.write_back import VERIFICATION_FILE, WriteBack, corrected
from triaxcald.schema.codes import Stage
from triaxcald.signing.station import StationSigning, signing_of
from triaxcald.software import new_run_id, software
from triaxcald.station.collection import Collection, Progress
from triaxcald.station.config import Place, SerialsSeen, Station
from triaxcald.station.on_demand import Judge, Judgement, OnDemand
from triaxcald.station.output_check import Confirmation
from triaxcald.station.reconnect import ActiveUnits, RetryPolicy, Streaming
from triaxcald.station.tray import Tray
from triaxcald.store import History
from triaxcald.utc import file_stamp, iso_time
from triaxcald.verification import Verification, fitted_attitudes
from triaxcald.work import RECORD as WORK_RECORD
from triaxcald.work import Attempt, Work


@dataclass(frozen=True)
class Outcome:
    """Outcome of one unit's run.

    ``exit_code`` is that of the command line, ``error`` one line if the run failed.
    ``document`` is the `triaxcal.outcome/1`. ``device_state`` describes the state of
    the device, None if nothing was to be written; ``recovery_command`` settles it,
    None if it is settled. ``lost`` counts records that did not reach the disk.
    ``data_quality`` lists possible causes if the readings were refused.
    """

    unit: str
    exit_code: int
    document: tc.interchange.Document
    held: Held
    recording: Path | None = None
    certificate: Path | None = None
    report: Path | None = None
    outcome: Path | None = None
    signature: Path | None = None
    certified: Certified | None = None
    verification: tc.interchange.Document | None = None
    provisioned: Provisioning | None = None
    device_state: str | None = None
    recovery_command: str | None = None
    error: str | None = None
    wanted: tuple[str, ...] = ()
    lost: int = 0
    data_quality: tuple[str, ...] = ()


class UnitRun(UnitSession):
    """The whole line for one unit of a station. The golden unit is verified alone.

    ``force`` is the reason to write in spite of sanity warnings, ``others`` counts
    the active units of the station. ``rezero`` is a calibration whose biases alone
    are renewed. ``work`` is what the unit is measured for, ``attempts`` the tray that
    the run belongs to; by default it is a tray of its own. ``start`` lets all units
    of a tray begin together. ``tray`` is that of units which are turned together.
    ``odds`` are learned ones, by which the unit is diagnosed. ``id`` is the id of the
    run.
    """

    def __init__(
        self,
        station: Station,
        place: Place,
        progress: Progress,
        *,
        serials: SerialsSeen | None = None,
        clock_ns: Callable[[], int] = time.time_ns,
        force: str | None = None,
        others: ActiveUnits | None = None,
        rezero: EarlierFile | None = None,
        work: Work | None = None,
        attempts: Attempts | None = None,
        start: Start | None = None,
        tray: Tray | None = None,
        odds: OddsFile | None = None,
    ) -> None:
        super().__init__(station, place, progress, serials=serials, clock_ns=clock_ns)
        self.rezero, self.tray, self.odds = rezero, tray, odds if rezero is None else None
        self.others, self.force = others or ActiveUnits(1), force
        self.id = new_run_id(clock_ns())
        self.stopped_for: str | None = None
        """Reason of a stop of this unit alone."""
        self._attempts, self._start = attempts, start
        self._attempt = Attempt(self.id, iso_time(clock_ns()), work or Work(self.name, place.unit.serial))
        self._attempt_file: AttemptFile | None = None
        self._history = History()
        self._at_work = False
        self._answered = False
        self._serial: str | None = None
        self._open_journal = open_journal(station.folder, self.profile, self.name, place.unit.serial)
        self._unreadable_journal = False
        self._recording: Path | None = None
        self._artifacts: dict[str, str] = {}
        self._paths: dict[str, Path] = {}
        self._acquisition: Collection | None = None
        self._confirmation: Confirmation | None = None
        self._certified: Certified | None = None
        self._write_back: WriteBack | None = None
        self._golden: GoldenCheck | None = None
        self._golden_verification: tc.interchange.Document | None = None
        self._at_start: dict[str, bytes] | None = None
        self._document: tc.interchange.Document | None = None
        self._signing: StationSigning | None = None
        self._envelope: bytes | None = None
        self._lost = 0

    async def run(self) -> Outcome:
        """Run the line. Raises nothing, not even when cancelled: the outcome has every
        error."""
        self._at_work = True
        if self._attempts is not None:
            return await self._run(self._attempts)
        tray = _attempts_at(self.station, self.id)
        try:
            with tray.under_way():
                return await self._run(tray)
        except InputError as e:
            return self._outcome(aborted(e, None))

    async def _run(self, tray: Attempts) -> Outcome:
        ending: Ending | None = None
        try:
            await self._begin(tray)
            policy = RetryPolicy(others=self.others)
            async with self.place.opened(policy, partial(self.waits, policy)) as device:
                identity = await self.identify(device)
                await self._identified(identity)
                path = unused(self.recording_path(identity))
                self._golden = await self._golden_check(identity)
                if self.rezero is not None:
                    self.rezero.require_of_place(self.place, self.station.file.reference, identity.serial)
                if self.odds is not None:
                    self.odds.require_of(self._attempt.work.part_number, f"unit {self.name}")
                self._require_readable_journal(identity)
                await self._require_readings_before(device)
                self._at_start = await self.correcting_registers(device)
                await self._note(recording=path.name)
                with self.writer(
                    path, identity, ends_with=FORMAT, more=self._records, at_start=self._at_start
                ) as writer:
                    self._recording = path
                    if self.rezero is not None:
                        writer.attach(EARLIER, "application/json", self.rezero.data)
                    if self.odds is not None and self._golden is None:
                        writer.attach(ODDS_FILE, "application/json", self.odds.data)
                    if self._golden is not None and self._golden.file is not None:
                        writer.attach(GOLDEN_FILE, "application/json", self._golden.file.data)
                    ending = await self._ending(device, identity, writer)
                    await _at_the_disk(partial(self._finalize, writer, ending))
        except (Exception, asyncio.CancelledError) as e:  # noqa: BLE001 - the one place that supervises a unit
            if self._document is None:  # a stored outcome is final
                ending = self._aborted(e)
                self._artifacts = {}  # they report another ending
                if self._recording is not None or ending.code is not None:
                    self._document = self._outcome_document(ending, None)
        assert ending is not None
        written = True
        try:
            await _at_the_disk(self._write_artifacts)
        except InputError as e:
            failed = f"{ending.reason}; {e}" if ending.exit_code else str(e)
            code = ending.code if ending.exit_code else Code.DISK
            ending = replace(ending, reason=failed, exit_code=ending.exit_code or DISK, code=code)
            written = False
        if self._attempt_file is not None:
            await _at_the_disk(partial(self._leave, self._attempt_file, written))
        return self._outcome(ending)

    def _leave(self, file: AttemptFile, written: bool) -> None:
        """Remove the attempt's file; or leave it to the next start, with the outcome
        if that is not sealed in a recording."""
        sealed = self._document is not None and self._document["contents"] is not None
        if written and (sealed or self._recording is None):
            file.remove()
        elif not sealed and self._document is not None:
            with suppress(OSError):  # then the next start takes the run for a killed one
                file.keep(self._document)

    async def _begin(self, tray: Attempts) -> None:
        """Note the attempt on the disk, and wait until all units of the tray have.
        Raises InputError, DiskError."""
        work = self._attempt.work
        if (signing := await asyncio.to_thread(signing_of, self.station)) is not None:
            self._signing = replace(signing, clock_ns=self.clock_ns)
        if work.serial is not None:
            await self._count(work.serial)
        self._attempt_file = await asyncio.to_thread(
            tray.begin, self._attempt, None if self._open_journal is None else str(self._open_journal)
        )
        if self._start is not None:
            await self._start.wait(self.name)
            if work.serial is not None:  # attempts that were settled meanwhile count too
                await self._count(work.serial)
        if self.stopped_for is not None:  # before it began
            raise asyncio.CancelledError

    def stop(self, reason: str) -> bool:
        """Note the reason of a stop. Returns whether a cancellation of `run` has to
        follow: a run that has not begun stops by itself, and a task that is cancelled
        before its first step would leave no outcome."""
        self.stopped_for = reason
        return self._at_work

    def _aborted(self, e: BaseException) -> Ending:
        ending = aborted(e, self._provisioning)
        if ending.code in (Code.LOST, Code.ABSENT):  # by the last attempt to reach it
            ending = replace(ending, code=Code.LOST if self._answered else Code.ABSENT)
        if self.stopped_for is not None and isinstance(e, asyncio.CancelledError):
            return replace(ending, reason=f"stopped: {self.stopped_for}")
        return ending

    async def _identified(self, identity: IdentityRead) -> None:
        """Note the serial number, and count the attempts at it. Raises InputError if
        the rules of the station forbid another; DiskError."""
        self._answered, self._serial = True, identity.serial
        work = self._attempt.work
        if work.serial is None and identity.serial is not None:  # else it was checked before the start
            await self._count(identity.serial)
            rules = self.station.file.rules
            require_serial(rules, identity.serial, self.name)
            require_allowed(rules, work, identity.serial, self._history)
        self._open_journal = open_journal(self.station.folder, self.profile, self.name, identity.serial)
        await self._note()

    async def _count(self, serial: str) -> None:
        self._history = await asyncio.to_thread(History.of, self.station.folder, serial)
        work = replace(self._attempt.work, attempt=self._history.attempts + 1)
        self._attempt = replace(self._attempt, work=work)

    async def _note(self, recording: str | None = None) -> None:
        """Note on the disk what is known by now. Raises DiskError."""
        assert self._attempt_file is not None
        file, journal = self._attempt_file, self._open_journal
        file.attempt, file.serial = replace(self._attempt, recording=recording), self._serial
        file.journal = None if journal is None else str(journal)
        await asyncio.to_thread(file.write)

    def _settled(self, held: Held) -> None:
        """Note the state of a settled device before its journal goes. Raises
        DiskError."""
        if self._attempt_file is not None:
            self._attempt_file.held = held
            self._attempt_file.write()

    @property
    def _records(self) -> dict[str, dict[str, str]]:
        """Metadata of the recording: the run, its work, the earlier calibration of a
        rezero, and how a golden unit is verified."""
        attempt = self._attempt
        return {
            RUN_RECORD: {"run": attempt.run, "started": attempt.started},
            WORK_RECORD: attempt.work.record(),
            **self._rezero_record,
            **({} if self.odds is None or self._golden is not None else {ODDS_RECORD: {"file": self.odds.name}}),
            **({} if self._golden is None else {GOLDEN_RECORD: self._golden.record}),
        }

    async def _ending(self, device: td.Device, identity: IdentityRead, writer: RecordingWriter) -> Ending:
        try:
            if self._golden is not None:
                return await self._verify_golden(device, identity, writer, self._golden)
            return await self._line(device, identity, writer)
        except (Exception, asyncio.CancelledError) as e:  # noqa: BLE001 - likewise: the recording still gets its outcome
            if self._confirmation is not None and self._confirmation.unconfirmed:
                self._certified, self._golden_verification = None, None  # its records may be another unit's
            ending = self._aborted(e)
            with suppress(RecordingError):
                writer.event("failed", {"error": ending.reason})
            return ending
        finally:
            self._lost = sum(writer.losses.values())

    def abort_notice(self, _: float) -> AbortNotice | None:
        """State of the device after an abort at this moment."""
        p = self._provisioning
        return (
            None
            if p is None
            else AbortNotice(f"unit {self.name}: {text.abort_notice(p, self.station.path)}", not p.settled)
        )

    @property
    def _provisioning(self) -> Provisioning | None:
        return self._write_back.provisioning if self._write_back else None

    @property
    def _held(self) -> Held:
        if self._provisioning:
            return self._provisioning.held
        cut_short = self._open_journal or self._unreadable_journal
        return Held(DeviceState.UNKNOWN, Evidence.NO_ANSWER) if cut_short else Held()

    def _finalize(self, writer: RecordingWriter, ending: Ending) -> None:
        """Store the outcome as the last attachment, with the inventory of everything
        before it, sign it all, and close the recording. From then on the outcome is
        final."""
        made: list[tc.interchange.Document] = []

        def make(contents: tc.interchange.Document) -> bytes:
            made.append(self._outcome_document(ending, contents))
            return to_text(made[0]).encode()

        writer.seal(ATTACHMENT, "application/json", make, None if self._signing is None else self._sign)
        self._document = made[0]

    @contextmanager
    def _sign(self, contents: SealedContents) -> Iterator[SignatureMade]:
        assert self._signing is not None
        with self._signing.sign(contents) as made:
            yield made
        self._envelope = made.data

    def _outcome_document(self, ending: Ending, contents: tc.interchange.Document | None) -> tc.interchange.Document:
        certificate = self._certified.document if self._certified else None
        back = self._write_back
        limits = self.station.file.limits.model_dump()
        return outcome_document(
            ending,
            self._held,
            # A recording that the disk has cut short bears out no figure.
            Papers(limits=limits)
            if contents is None
            else Papers(
                measured=measured_in(certificate) if certificate else None,
                verification=self._verification,
                registers=registers_told(back.provisioning) if back and back.provisioning else None,
                limits=limits,
                outside=certificate["outside"] if certificate else (),
                digests={name: digest_of(self._artifacts[name].encode()) for name in sorted(self._artifacts)},
                contents=contents,
            ),
            unit=self.name,
            serial=self._serial,
            station=self.station.file.name,
            ended=iso_time(self.clock_ns()),
            software=software(),
            supersedes=self._history.latest if self._serial is not None else None,
            journal=self._journal,
            forced=self.force if back and back.warnings else None,
            attempt=replace(self._attempt, recording=self._recording.name if self._recording else None),
        )

    @property
    def _verification(self) -> tc.interchange.Document | None:
        return self._write_back.verification if self._write_back else self._golden_verification

    @property
    def _journal(self) -> str | None:
        """Path of the journal, as long as it is needed."""
        p = self._provisioning
        path = p.open_journal if p else self._open_journal
        return str(path) if path else None

    @property
    def _recovery_command(self) -> str | None:
        if self._provisioning:
            return text.recovery_command(self._provisioning, self.station.path) or None
        return text.unfinished(self._open_journal, self.name, self.station.path) if self._open_journal else None

    def _write_artifacts(self) -> None:
        """Write the files beside the closed recording: certificate, report, signature,
        and the outcome last."""
        if self._recording is None:
            if self._document is not None:  # the attempt came to no recording
                stem = f"{self.name}-{in_a_name(self._serial or 'unknown')}-{file_stamp(self.clock_ns())}"
                self._paths[ATTACHMENT] = write_new(self.station.folder, stem, SUFFIX, to_text(self._document))
            return
        artifacts = dict(self._artifacts)
        if self._envelope is not None:
            artifacts[SIGNATURE_FILE] = self._envelope.decode()
        if self._document is not None:
            artifacts[ATTACHMENT] = to_text(self._document)
        for name, content in artifacts.items():
            self._paths[name] = write_text(self._recording.with_suffix(f".{name}"), content)

    def _outcome(self, ending: Ending) -> Outcome:
        back, held = self._write_back, self._held
        state = text.held(held) if back else None
        error = None
        if ending.verdict is Verdict.ABORTED or ending.exit_code == DISK:
            told = [ending.reason, *([state] if state and state not in ending.reason else [])]
            if recovery_command := self._recovery_command:
                told.append(recovery_command)
            error = f"unit {self.name}: {'; '.join(told)}"
        return Outcome(
            unit=self.name,
            exit_code=ending.exit_code,
            document=self._document or self._outcome_document(ending, None),
            held=held,
            recording=self._recording,
            certificate=self._paths.get(CERTIFICATE),
            report=self._paths.get(REPORT),
            outcome=self._paths.get(ATTACHMENT),
            signature=self._paths.get(SIGNATURE_FILE),
            certified=self._certified,
            verification=self._verification,
            provisioned=back.provisioning if back else None,
            device_state=state,
            recovery_command=self._recovery_command,
            error=error,
            wanted=ending.wanted,
            lost=self._lost,
            data_quality=self._possible_causes() if ending.exit_code == REFUSED else (),
        )

    def _possible_causes(self) -> tuple[str, ...]:
        """Faults of all readings that came, where these were refused."""
        if self._acquisition is None:
            return ()
        pipeline = self._acquisition.pipelines[td.READINGS]
        pipeline.close()
        return tuple(pipeline.data_quality())

    def _require_readable_journal(self, identity: IdentityRead) -> None:
        """Check the journals before any pose is taken. Raises InputError."""
        try:
            journals_of(self.station.folder, Owner.of(self.profile, self.name, identity.serial), self.profile)
        except InputError:
            self._open_journal, self._unreadable_journal = None, True  # no command can use it
            raise

    async def _require_readings_before(self, device: td.Device) -> None:
        """Check, before any pose is taken, that the registers state their readings.
        Raises Refused, DriverError."""
        written = self.station.file.provisioning.write and why_not_written(self.profile) is None and not self._golden
        if written and leaves_open(self.profile):
            with suppress(td.RegisterRefused):  # an unreadable register is not written either
                require_readings_before(self.profile, await self.registers(device))

    @property
    def _rezero_record(self) -> dict[str, dict[str, str]]:
        return {} if self.rezero is None else {RECORD: {"calibration": self.rezero.name}}

    async def _golden_check(self, identity: IdentityRead) -> GoldenCheck | None:
        """How the unit is verified, None if it is not the golden one. Raises
        InputError, Refused."""
        serial = identity.serial or self._attempt.work.serial
        golden = await asyncio.to_thread(GoldenCheck.at_place, self.station, self.place, serial)
        if golden is not None and self.rezero is not None:
            raise InputError(
                f"unit {self.name}: serial number {serial} is the golden unit, which is verified and keeps its biases; "
                "give no --rezero for it"
            )
        return golden

    async def _verify_golden(
        self, device: td.Device, identity: IdentityRead, writer: RecordingWriter, golden: GoldenCheck
    ) -> Ending:
        """Verify the golden unit in check poses. Nothing is written to it."""
        plan = self.station.file.plan
        check = Collection(VERIFICATION, self.place.bundle, self.place.address, ends_with=writer.ends_with)
        self._acquisition = check
        self._confirmation = self.confirmation(device, identity, writer, check)
        policy = RetryPolicy(plan.comes_back_s, others=self.others)
        reconnecting = self.reconnecting(device, identity, policy, confirmation=self._confirmation)
        async with self._confirmation.phase():
            self.progress.stage(self.name, Stage.CHECK_POSES)
            await self._collect(reconnecting, writer, check, golden.stream, plan.check_poses)
        found = await asyncio.to_thread(golden.verify, check.pipelines)
        document = self._golden_verification = golden.document(found, check.digest.hexdigest())
        writer.attach(VERIFICATION_FILE, "application/json", to_text(document).encode())
        require_trusted(found.poses)
        return golden.ending(document)

    async def _line(self, device: td.Device, identity: IdentityRead, writer: RecordingWriter) -> Ending:
        plan = self.station.file.plan
        acquisition = Collection(CALIBRATION, self.place.bundle, self.place.address, ends_with=writer.ends_with)
        self._acquisition = acquisition
        self._confirmation = self.confirmation(device, identity, writer, acquisition)
        policy = RetryPolicy(plan.comes_back_s, others=self.others)
        reconnecting = self.reconnecting(device, identity, policy, confirmation=self._confirmation)
        async with self._confirmation.phase():
            self.progress.stage(self.name, Stage.POSES)
            wanted = plan.poses_most if self.rezero is None else plan.rezero_poses
            await self._collect(reconnecting, writer, acquisition, td.READINGS, wanted)
        self.progress.stage(self.name, Stage.FITTING)
        poses = await asyncio.to_thread(acquisition.pipelines[td.READINGS].finish)
        certified = self._certified = await asyncio.to_thread(self._certify, acquisition, poses, identity)
        if certified.image is not None and self.station.file.provisioning.write and certified.within_limits:
            await self._write(device, writer, certified, certified.image, identity, acquisition)
        ending = judged(
            certified.document,
            self._write_back.verification if self._write_back else None,
            self.station.file.limits,
        )
        self.progress.stage(self.name, Stage.REPORT)
        artifacts = {
            REPORT: await asyncio.to_thread(self._report, certified, acquisition.pipelines[td.READINGS], ending)
        }
        if ending.verdict is not Verdict.FAIL:
            artifacts[CERTIFICATE] = to_text(certified.document)
        for name, media_type in ((REPORT, "text/html"), (CERTIFICATE, "application/json")):
            if name in artifacts:
                writer.attach(name, media_type, artifacts[name].encode())
        self._artifacts = artifacts
        return ending

    async def _write(
        self,
        device: td.Device,
        writer: RecordingWriter,
        certified: Certified,
        image: RegisterImage,
        identity: IdentityRead,
        acquisition: Collection,
    ) -> None:
        async def collect(check: Collection) -> None:
            self.progress.stage(self.name, Stage.CHECK_POSES)
            fitted = fitted_attitudes(acquisition.pipelines[td.READINGS], self.place.signs)
            plan = self.station.file.plan
            confirmation = self.confirmation(device, identity, writer, check)
            policy = RetryPolicy(plan.comes_back_s, others=self.others)
            reconnecting = self.reconnecting(device, identity, policy, confirmation=confirmation)
            async with confirmation.phase():
                await confirmation.ask()
                assert self.profile.own_output is not None
                await self._collect(reconnecting, writer, check, self.profile.own_output, plan.check_poses, fitted)

        self._write_back = WriteBack(
            self.place,
            self.station,
            writer,
            collect,
            ask=self._ask,
            run=self.id,
            on_settled=self._settled,
            started=iso_time(self.clock_ns(), "seconds"),
            force=self.force,
            at_start=self._at_start,
        )
        assert self._confirmation is not None
        if not certified.better:
            writer.event("not_written", {"reason": "the device holds nothing worse"})
            await self._write_back.check_alone(acquisition)
            return
        async with self._confirmation.phase():  # the unit may have been silent when the poses ended
            self.progress.stage(self.name, Stage.WRITING)
            examined = await self._write_back.examine(device, image, identity.serial, acquisition)
        await self._write_back.write(examined, acquisition)

    def _ask(self, stage: Stage, what: str) -> None:
        self.progress.stage(self.name, stage)
        self.progress.note(self.name, what)

    def _certify(self, acquisition: Collection, poses: list[Any], identity: IdentityRead) -> Certified:
        return certify(
            self.place.bundle,
            self.station.file,
            self.station.text,
            acquisition.pipelines[td.READINGS],
            poses,
            acquisition.digest,
            unit_name=self.name,
            serial=identity.serial,
            signs=self.place.signs,
            computed_with=software(),
            earlier=None if self.rezero is None else self.rezero.known(),
            at_start=self._at_start,
            odds=self.odds,
        )

    async def _collect(
        self,
        device: Streaming,
        writer: RecordingWriter | None,
        collection: Collection,
        stream: str,
        wanted: int,
        apart_from: tc.Floats | None = None,
    ) -> None:
        plan, targets, on_demand = self.station.file.plan, None, None
        calibrating = collection.phase == CALIBRATION
        if self._golden is not None:
            plan, targets = plan.model_copy(update={"repeat": False}), check_directions(wanted)
        elif self.rezero is None and calibrating and plan.stop is not None:
            odds = None if self.odds is None else self.odds.prior
            judge = Judge.of(plan.stop, self.place, self.station.file, odds)
            on_demand = OnDemand(judge, repeat=plan.repeat, tell=partial(self._judged, writer))
            targets = on_demand.targets
        elif self.rezero is not None and calibrating:
            plan, targets = plan.model_copy(update={"repeat": False}), tc.planning.bias_directions(wanted)
        if self.tray is not None:
            targets = (
                self.tray.targets(self.name, targets or tc.planning.directions(wanted))
                if apart_from is None
                else self.tray.check_targets(self.name, wanted, apart_from)
            )
        await collection.until_posed(
            device,
            writer,
            plan,
            stream=stream,
            wanted=wanted,
            targets=targets,
            nominal_scale_factor=self.profile.nominal_of(stream),
            nominal_offset=self.profile.offset_of(stream),
            tell=lambda state: self.progress.poses(self.name, collection.phase, state),
            apart_from=apart_from,
            on_demand=on_demand,
        )

    @staticmethod
    def _judged(writer: RecordingWriter | None, found: int, judgement: Judgement) -> None:
        """Note in the recording why the poses on demand went on, or ended."""
        if writer is not None:
            writer.event("poses_judged", {"found": found, **asdict(judgement)})

    async def check(self) -> Verification:
        """Verify the device's own corrected output in check poses; records and writes
        nothing."""
        async with self.place.opened() as device:
            identity = await self.identify(device)
            self.progress.stage(self.name, Stage.CHECK_POSES)
            check = Collection(VERIFICATION, self.place.bundle, self.place.address)
            confirmation = self.confirmation(device, identity, None, check)
            there = self.reconnecting(device, identity, RetryPolicy(most_s=0.0), confirmation=confirmation)
            wanted = self.station.file.plan.check_poses
            async with confirmation.phase():
                assert self.profile.own_output is not None  # as the command has made sure
                await self._collect(there, None, check, self.profile.own_output, wanted)
            return corrected(check, self.station.file.reference)

    def _report(self, certified: Certified, pipeline: Pipeline, ending: Ending) -> str:
        back = self._write_back
        return unit_report(certified, pipeline, ending, back.verification if back else None, self._held)


async def _at_the_disk(work: Callable[[], None]) -> None:
    """Do ``work`` on a thread, to its end: a slow disk holds up no other unit, and
    nothing leaves half of a document."""
    await to_its_end(whole_on_a_thread(work))


@dataclass
class UnitHandle:
    """A unit of a tray at work. ``slot`` is its name in the station file, ``run`` the
    id of its run."""

    slot: str
    run: str
    _unit: UnitRun
    _task: asyncio.Task[Outcome] | None = None

    def stop(self, reason: str) -> None:
        """Stop this unit alone: it first puts its device in order. The others go on."""
        if self._unit.stop(reason) and self._task is not None:
            self._task.cancel()

    @property
    def ended(self) -> bool:
        return self._task is not None and self._task.done()


@dataclass
class Start:
    """Lets the units of a tray begin together: ``opens`` is awaited once, after the
    attempts of all ``units`` are on the disk. Raises what it raises, in every unit."""

    units: set[str]
    opens: Callable[[], Awaitable[None]]
    _opening: asyncio.Task[None] | None = None
    _opened: asyncio.Event = field(default_factory=asyncio.Event)

    async def wait(self, unit: str) -> None:
        """Raises InputError, DiskError."""
        self.arrive(unit)
        await self._opened.wait()
        if self._opening is not None and (e := self._opening.exception()) is not None:
            raise e

    def arrive(self, unit: str) -> None:
        """The unit is ready, or has ended before."""
        self.units.discard(unit)
        if not self.units and self._opening is None:
            self._opening = asyncio.ensure_future(self.opens())
            self._opening.add_done_callback(lambda _: self._opened.set())


class TrayRun:
    """The units of a station that are started together; awaiting it runs them all, and
    gives their outcomes in the order of the station file.

    A failing unit does not stop the others; a lost unit is retried while others are
    active. Each cancellation is passed on to every unit. The units first put their
    devices in order; the outcomes then have exit code 130. ``id`` is the id of the
    tray, ``units`` the handles by slot.

    ``rezero`` maps a unit to the calibration whose biases alone are renewed, ``work``
    maps it to what it is measured for. ``odds`` are learned ones, by default those that
    the station names. ``begun`` is called once all attempts are noted
    on the disk, or a unit has ended before; ``ended`` then receives each outcome,
    ``killed`` each attempt that a killed process has left in the folder.
    """

    def __init__(
        self,
        station: Station,
        progress: Progress,
        *,
        force: str | None = None,
        rezero: Mapping[str, EarlierFile] | None = None,
        work: Mapping[str, Work] | None = None,
        odds: OddsFile | None = None,
        ended: Callable[[Outcome], None] = lambda _: None,
        killed: Callable[[Killed], None] = lambda _: None,
        begun: Callable[[], None] = lambda: None,
    ) -> None:
        self.id = new_run_id()
        self._station, self._ended, self._killed, self._begun = station, ended, killed, begun
        self._serials, self._others = SerialsSeen(), ActiveUnits(len(station.places))
        self._attempts = _attempts_at(station, self.id)
        self._start = Start({place.unit.name for place in station.places}, self._open)
        tray = _tray_of(station)
        self._shown = None if tray is None else TrayProgress(progress, tray)
        odds = odds_of_station(station) if odds is None else odds
        self._runs = [
            UnitRun(
                station, place, self._shown or progress,
                serials=self._serials, force=force, others=self._others,
                rezero=(rezero or {}).get(place.unit.name), work=(work or {}).get(place.unit.name),
                attempts=self._attempts, start=self._start, tray=tray, odds=odds,
            )
            for place in station.places
        ]  # fmt: skip
        self.units = {run.name: UnitHandle(run.name, run.id, run) for run in self._runs}

    def __await__(self) -> Generator[Any, None, list[Outcome]]:
        return self._all().__await__()

    def _begin(self) -> None:
        """Call ``begun``, once."""
        begun, self._begun = self._begun, lambda: None
        begun()

    async def _open(self) -> None:
        self._begin()
        for killed in await asyncio.to_thread(settle_killed, self._station):
            self._killed(killed)

    async def _all(self) -> list[Outcome]:
        """Raises InputError if the folder cannot be used."""
        with self._attempts.under_way(), ExitStack() as stack:
            for run in self._runs:
                stack.enter_context(at_abort(run.abort_notice))
            for run in self._runs:
                self.units[run.name]._task = asyncio.ensure_future(self._one(run))
            return await side_by_side(handle._task for handle in self.units.values() if handle._task is not None)

    async def _one(self, run: UnitRun) -> Outcome:
        try:
            outcome = await run.run()
        finally:
            self._start.arrive(run.name)
            self._others.leave()
            if self._shown is not None:
                self._shown.ended(run.name)
        self._begin()
        self._ended(outcome)
        return outcome


def _attempts_at(station: Station, tray: str) -> Attempts:
    return Attempts(station.folder, tray, station.file.name, station.file.limits.model_dump())


def _tray_of(station: Station) -> Tray | None:
    """The tray of a station whose units are turned together."""
    file = station.file
    if not file.fixture.together:
        return None
    mountings = {place.unit.name: place.unit.mounting for place in station.places}
    return Tray(mountings, file.fixture.names, hold_s=file.plan.hold_s, apart_deg=file.plan.apart_deg)
