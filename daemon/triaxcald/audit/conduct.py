"""One audit of one recording: what is looked at, and in which order."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

import triaxcal_drivers as td
from triaxcald.audit import contents, previews
from triaxcald.audit.beside import beside, outcomes_beside
from triaxcald.audit.differences import Difference, Kind, compare
from triaxcald.audit.drawings import same_report
from triaxcald.audit.figures import SHARE, Agreement, furthest
from triaxcald.audit.results import (
    CANNOT,
    DRAWN_WITH,
    Again,
    Digests,
    as_stored,
    by_its_own_words,
    compute,
    digests,
    exit_codes_in,
    has_codes,
    held_in,
    outcome_again,
    report_of,
    sealed_later,
)
from triaxcald.audit.signature import Policy, Signature, State
from triaxcald.audit.signature import check as check_signature
from triaxcald.audit.traffic import Rules, Said, Traffic, check
from triaxcald.audit.within import COMPUTES, Within, moved, same_within
from triaxcald.computer import KEYS, computer
from triaxcald.documents import to_text
from triaxcald.errors import DEVICE, InputError, RecordingError
from triaxcald.inputs import losses_of, parse_document
from triaxcald.memory import little_garbage
from triaxcald.outcome import ATTACHMENT, CERTIFICATE, FORMAT, REPORT, Verdict, digest_of
from triaxcald.provision.correction import AT_START
from triaxcald.provision.state import DeviceState, Held
from triaxcald.recording.bus import require_of_unit
from triaxcald.recording.manifest import is_manifest
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import END_RECORD, EVENTS, PHASE_KEY, RAW_RECORD, RECOVERY_RECORD
from triaxcald.recording.survey import Survey, survey
from triaxcald.run.write_back import REGISTERS_AFTER, REGISTERS_BEFORE, REGISTERS_EARLIER, VERIFICATION_FILE
from triaxcald.software import drawn_with, software

NEW = (DeviceState.NEW_VERIFIED, DeviceState.NEW_UNVERIFIED)
Compute = Callable[[Recording, Digests], Again]


class Result(StrEnum):
    SAME_BYTES = "same_bytes"
    SAME_FIGURES = "same_figures"
    WITHIN = "within"
    DIFFERS = "differs"


@dataclass(frozen=True)
class Notes:
    """What an auditor should know and what is no difference. ``versions`` by
    name, then and now; ``not_beside`` are files that are not beside the
    recording; ``report_as_listed`` where the report was not drawn again, and
    ``pictures_as_signed`` where only the lines in its pictures were not."""

    versions: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    report_as_listed: bool = False
    pictures_as_signed: bool = False
    losses: tuple[str, ...] = ()
    mended: bool = False
    not_beside: tuple[str, ...] = ()
    supersedes: str | None = None
    """The digest of an earlier outcome that is not in the folder."""


@dataclass(frozen=True)
class Audit:
    """No difference means that everything comes out the same, and that no part
    is missing: byte for byte, unless ``agreement`` has figures that are not.

    ``computed_on`` is the computer then and now, by what is known of it.
    ``checked`` are the attachments that were computed again or compared with
    the register traffic. ``verdict`` is the outcome's, None where it has none.
    ``made_by`` is the version of triaxcal that made the recording, None where
    it is this one; of another version's documents neither the sentences are
    compared nor the keys that they lack.
    """

    recording: str
    checked: tuple[str, ...]
    differences: tuple[Difference, ...]
    notes: Notes = Notes()
    verdict: str | None = None
    agreement: Agreement = field(default_factory=Agreement)
    computed_on: tuple[Mapping[str, str], Mapping[str, str]] = field(default_factory=lambda: ({}, {}))
    made_by: str | None = None
    furthest: tuple[float, str] | None = None
    """Of another version's calibration: the largest difference of a coefficient
    in its standard error, and which."""
    within: Within | None = None
    """Of other software's figures, where it was asked for how far they may be off."""
    serial: str | None = None
    run: str | None = None
    """Of the outcome, where it has them."""
    signature: Signature = field(default_factory=lambda: Signature(State.UNSIGNED))

    @property
    def result(self) -> Result:
        if self.differences:
            return Result.DIFFERS
        if self.within and self.agreement.of_uncertainty > SHARE:
            return Result.WITHIN
        return Result.SAME_FIGURES if self.agreement.figures else Result.SAME_BYTES


def audit(
    path: td.files.AnyPath,
    *,
    compute: Compute = compute,
    within: float | None = None,
    policy: Policy = Policy(),  # noqa: B008 - frozen
) -> Audit:
    """Raises RecordingError where the file cannot be read, or holds no result;
    InputError for an unusable trust file. ``compute`` makes the results again.
    ``within``: so much of its uncertainty a figure may be off that another version of
    triaxcal, numpy or scipy computed. ``policy`` is what is asked of signatures."""
    if is_manifest(path):
        raise RecordingError(f"{path}: a recording in segments, which holds no result to audit")
    # Pictures are made of cycles: garbage is looked for seldom, not a hundred times.
    with little_garbage(), Recording.open(path) as recording:
        require_of_unit(recording)
        if not recording.ends_with:
            raise RecordingError(
                f"{path}: holds no result to audit; `record` made it, or a development version before 0.2"
            )
        if recording.ends_with != FORMAT:
            raise RecordingError(f"{path}: ends with {recording.ends_with}, which this version does not know")
        return _Audit(path, recording, compute, within, policy).run()


COMPUTED = (CERTIFICATE, VERIFICATION_FILE, ATTACHMENT)
"""Documents whose figures are computed again."""


class _Audit:
    def __init__(
        self, path: td.files.AnyPath, recording: Recording, compute: Compute, within: float | None, policy: Policy
    ) -> None:
        self._path, self._recording, self._compute, self._policy = path, recording, compute, policy
        self._held = {name: recording.attachments[name] for name in recording.attachments if "/" not in name}
        self._checked: list[str] = []
        self._differences: list[Difference] = []
        self._outcome: Mapping[str, Any] = {}
        self._raw = digests(recording)
        self._mended = RECOVERY_RECORD in recording.metadata
        self._signed = False
        self._listed_report = self._pictures_as_signed = False
        self._agreement = Agreement()
        self._furthest: tuple[float, str] | None = None
        by = {name: then for name, (then, _) in self._versions().items() if name in COMPUTES}
        self._within = Within(within, by) if within is not None and by else None

    def run(self) -> Audit:
        found = survey(self._recording, ATTACHMENT)
        if self._mended and not {CERTIFICATE, ATTACHMENT} & set(self._held):
            raise RecordingError(
                f"{self._path}: attachment {ATTACHMENT}: missing; the recording holds no result to audit"
            )
        signature, unproven = check_signature(self._path, self._held, found, self._policy)
        self._signed = signature.state is State.TRUSTED and not signature.mended
        again = self._again()
        self._check_outcome(found, again)
        if again is not None:
            self._check_results(again)
            self._differences += previews.check(self._recording, again.previews, cut_short=self._mended)
        self._check_raw()
        self._differences += contents.faults(found)
        if self._outcome:
            self._differences += contents.against_inventory(found, self._outcome)
        self._differences += unproven
        differing, not_beside = beside(self._path, self._held)
        self._differences += differing
        return Audit(
            str(self._path),
            tuple(dict.fromkeys(self._checked)),
            tuple(self._of_figure(d) for i, d in enumerate(self._differences) if d not in self._differences[:i]),
            self._notes(tuple(not_beside)),
            self._said("verdict"),
            self._agreement,
            self._computed_on(),
            self._made_by,
            self._furthest,
            self._within,
            self._said("serial"),
            self._said("run"),
            signature,
        )

    def _said(self, key: str) -> str | None:
        """Of the outcome; None where it is no text."""
        value = self._outcome.get(key)
        return value if isinstance(value, str) else None

    def _of_figure(self, of: Difference) -> Difference:
        """With its share of the uncertainty, where that was asked for."""
        share = self._within.share_at(of.part, of.place) if self._within and of.kind is Kind.VALUE else None
        return replace(of, of_uncertainty=share)

    @property
    def _made_by(self) -> str | None:
        """The version that made it, where that is another one."""
        made_by = self._recording.metadata.get("software", {}).get("triaxcal", "an unknown version")
        return None if made_by == software()["triaxcal"] else made_by

    @property
    def _aborted(self) -> bool:
        return self._outcome.get("verdict") == Verdict.ABORTED.value

    def _add(self, part: str, kind: Kind, place: str = "", **values: Any) -> None:
        self._differences.append(Difference(part, kind, place, **values))

    def _again(self) -> Again | None:
        try:
            again = self._compute(self._recording, self._raw)
            documents = {name: _object(self._held.get(name, b"")) for name in COMPUTED}
            computed, (again, self._agreement) = again, as_stored(again, documents)
            stored = documents[CERTIFICATE] if self._made_by else None
            if stored is not None and again.certified is not None:
                both = (document["result"]["calibration"] for document in (stored, again.certified.document))
                self._furthest = furthest(*both)
            if self._within is not None:
                self._within = replace(self._within, moved=tuple(moved(computed, documents)))
                return same_within(again, documents, self._within.limit, self._agreement)
            return again if stored is None else by_its_own_words(again, stored)
        except CANNOT as e:
            self._add(CERTIFICATE, Kind.NOT_COMPUTED, again=str(e) or repr(e))
            return None

    # The outcome, which everything else has to agree with.

    def _check_outcome(self, found: Survey, again: Again | None) -> None:
        self._checked.append(ATTACHMENT)
        if ATTACHMENT not in self._held:
            self._add(ATTACHMENT, Kind.NO_END)
            return
        data = self._held[ATTACHMENT]
        end = self._recording.metadata.get(END_RECORD)
        expected = {"name": ATTACHMENT, "sha256": hashlib.sha256(data).hexdigest()}
        if end is None:
            self._add(END_RECORD, Kind.MISSING)
        elif end != expected:
            self._add(END_RECORD, Kind.VALUE, "sha256", stored=end.get("sha256"), again=expected["sha256"])
        held = _object(data)
        if held is None:
            self._add(ATTACHMENT, Kind.NO_DOCUMENT)
            return
        self._outcome = held
        aborted_with = exit_codes_in(held)
        if self._aborted and held.get("exit_code") not in aborted_with:
            self._add(ATTACHMENT, Kind.VALUE, "exit_code", stored=held.get("exit_code"), again=list(aborted_with))
        state = held_in(held)
        if state is None:
            self._add(ATTACHMENT, Kind.NOT_SHOWN, "device_state", stored=held.get("device_state"))
        elif not self._has_its_journal(state):
            wanted = "a path" if held.get("journal") is None else None
            self._add(ATTACHMENT, Kind.VALUE, "journal", stored=held.get("journal"), again=wanted)
        if self._aborted and state is not None and _owes_device(state, held) and held.get("exit_code") != DEVICE:
            self._add(ATTACHMENT, Kind.VALUE, "exit_code", stored=held.get("exit_code"), again=DEVICE)
        if again is None:
            return
        if state is not None and again.written and not self._aborted:
            ends_with = (DeviceState.OLD,) if held.get("verdict") == Verdict.FAIL.value else NEW
            if state.state not in ends_with:
                self._add(ATTACHMENT, Kind.NOT_SHOWN, "device_state", stored=held.get("device_state"))
        contents_again = held.get("contents") if self._mended else found.inventory.document()
        document = outcome_again(held, again, self._recording, self._papers(again), contents_again or {})
        # The inventory is compared part by part.
        again_data = to_text(document).encode()
        told = compare(
            ATTACHMENT, _without_contents(data), _without_contents(again_data), by_another=bool(self._made_by)
        )
        if not told and self._made_by is None and contents_again == held.get("contents") and data != again_data:
            told = [Difference(ATTACHMENT, Kind.BYTES)]
        self._differences += told

    def _has_its_journal(self, state: Held) -> bool:
        """Whether the outcome names a journal where one is needed, and only there."""
        needed, named = _needs_journal(state, self._outcome.get("registers")), self._outcome.get("journal") is not None
        # Without the registers, nothing tells that an undoing has failed.
        return needed in (named, None) or (named and self._sealed_later)

    @property
    def _sealed_later(self) -> bool:
        return sealed_later(self._outcome, self._recording)

    def _papers(self, again: Again) -> dict[str, str]:
        """Digests of the papers that the line leaves: computed again where they
        can be."""
        found = {}
        ending = None if self._aborted else again.ending()
        if ending is not None and again.certified is not None:
            if ending.verdict is not Verdict.FAIL:
                by_another = self._made_by is not None or self._within is not None
                same = not by_another or CERTIFICATE not in self._held
                document = to_text(again.certified.document).encode() if same else self._held[CERTIFICATE]
                found[CERTIFICATE] = digest_of(document)
            if REPORT in self._held:
                found[REPORT] = digest_of(self._held[REPORT])
        return found

    # What the raw records, profile and station file make.

    def _check_results(self, again: Again) -> None:
        ending = None if self._aborted else again.ending()
        if again.golden is not None:
            self._check_golden(again)
        elif again.certified is None and not self._aborted:
            self._add(CERTIFICATE, Kind.NOT_COMPUTED, again=again.why_not)
        elif again.certified is not None and ending is not None:
            has_one = ending.verdict is not Verdict.FAIL
            self._result(CERTIFICATE, to_text(again.certified.document) if has_one else None)
            self._check_report(again)
        elif self._aborted:
            for name in (CERTIFICATE, REPORT):
                self._result(name, None)
        document = to_text(again.verification) if again.verification is not None else None
        if VERIFICATION_FILE in self._held and document is None:
            self._checked.append(VERIFICATION_FILE)
            self._add(VERIFICATION_FILE, Kind.NOT_COMPUTED, again="there are no check poses, or no output to check")
        elif VERIFICATION_FILE in self._held or (again.checked and ending is not None):
            self._result(VERIFICATION_FILE, document)
            if VERIFICATION_FILE not in self._held:
                self._add(VERIFICATION_FILE, Kind.MISSING)
        self._check_registers(again)

    def _check_golden(self, again: Again) -> None:
        """A golden unit is not calibrated: it has no certificate and no report, its
        recording no other poses, and none of its registers was written."""
        for name in (CERTIFICATE, REPORT):
            self._result(name, None)
        if self._raw.calibration.records:
            self._add(RAW_RECORD, Kind.UNCALLED_FOR, "calibration")
        if again.verification is None and not self._aborted:
            self._add(VERIFICATION_FILE, Kind.NOT_COMPUTED, again=again.why_not)
        with suppress(*CANNOT):  # `_check_registers` tells of records that cannot be read
            if any(access.operation == "write" for access in self._recording.register_accesses()):
                self._add("/registers", Kind.UNCALLED_FOR, "write")

    def _result(self, name: str, again: str | None) -> None:
        """``again`` is None where there ought to be none."""
        stored = self._held.get(name)
        if again is None:
            if stored is not None:
                self._add(name, Kind.UNCALLED_FOR)
            return
        self._checked.append(name)
        if stored is None:
            self._add(name, Kind.MISSING)
        else:
            self._differences += compare(name, stored, again.encode(), by_another=bool(self._made_by))

    def _check_report(self, again: Again) -> None:
        stored, ending = self._held.get(REPORT), again.ending()
        if stored is None:
            self._checked.append(REPORT)
            self._add(REPORT, Kind.MISSING)
        elif any(self._versions()):
            self._listed_report = True
        elif ending is not None:
            self._checked.append(REPORT)
            self._pictures_as_signed = self._signed
            try:
                # A trusted station signed the lines in the pictures, which show the
                # same figures as the words do.
                drawn = report_of(again, ending, held_in(self._outcome) or Held(), pictures=not self._signed)
            except CANNOT as e:
                self._add(REPORT, Kind.NOT_COMPUTED, again=str(e) or repr(e))
                return
            # The figures of a stored certificate are those that were drawn.
            figures = again.certified.document if again.certified and CERTIFICATE not in self._held else {}
            if stored != drawn.encode() and not same_report(stored, drawn, figures, self._agreement):
                self._add(REPORT, Kind.NOT_DRAWN)

    def _check_registers(self, again: Again) -> None:
        names = (AT_START, REGISTERS_BEFORE, REGISTERS_EARLIER, REGISTERS_AFTER)
        kept: dict[str, Mapping[str, bytes] | None] = {}
        for name in names:
            kept[name] = None
            if name in self._held:
                self._checked.append(name)
                kept[name] = _registers(self._held[name])
                if kept[name] is None:
                    self._add(name, Kind.NO_DOCUMENT)
        if again.written and not self._aborted:
            for name in (REGISTERS_BEFORE, REGISTERS_AFTER):
                if name not in self._held:
                    self._add(name, Kind.MISSING)
        told = self._outcome.get("registers")
        said = Said(
            before=kept[REGISTERS_BEFORE],
            earlier=kept[REGISTERS_EARLIER],
            after=kept[REGISTERS_AFTER],
            image=again.certified.image if again.certified else None,
            told=told if isinstance(told, Mapping) else None,
            held=held_in(self._outcome) if self._outcome else None,
            forced=self._outcome.get("forced") is not None or not self._outcome,
            aborted=self._aborted,
            provisioned=self._check_events(again),
            rules=Rules.MARK_OR_SUPPLY if has_codes(self._outcome) else Rules.ACKNOWLEDGED,
            cut_short=self._sealed_later,
            at_start=kept[AT_START],
        )
        if again.written and not self._aborted and self._outcome and said.told is None:
            self._add(ATTACHMENT, Kind.VALUE, "registers", stored=told, again="what was written")
        try:
            traffic = Traffic(self._recording.register_accesses(), again.bundle.profile)
            self._differences += check(traffic, said, self._recording.metadata.get("unit", {}).get("serial") or None)
        except CANNOT as e:
            self._add("/registers", Kind.NOT_COMPUTED, again=str(e) or repr(e))

    def _check_events(self, again: Again) -> list[str] | None:
        """The registers that were written, by the event that says so."""
        events: dict[str, Any] = {}
        kinds = []
        try:
            for event in self._recording.events():
                kinds.append(event.kind)
                events[event.kind] = event.detail
            provisioned = [str(n) for n in events["provisioned"]["written"]] if "provisioned" in events else None
            failed = events.get("failed", {}).get("error")
            restored = events.get("restored", {}).get("state")
        except (RecordingError, ValueError, LookupError, TypeError, AttributeError):
            self._add(EVENTS, Kind.NO_DOCUMENT)
            return None
        if kinds[:1] != ["recording_started"] and not self._mended:
            self._add(EVENTS, Kind.MISSING, "recording_started")
        if again.written and not self._aborted and provisioned is None:
            self._add(EVENTS, Kind.MISSING, "provisioned")
        if self._outcome:
            reason = self._outcome.get("reason") if self._aborted else None
            # A recording that was cut short may tell another reason, or none.
            if failed != reason and not self._sealed_later:
                self._add(EVENTS, Kind.VALUE, "failed.error", stored=failed, again=reason)
            state = self._outcome.get("device_state")
            undone = self._outcome.get("verdict") == Verdict.FAIL.value and again.written
            if not self._aborted and restored != (state if undone else None):
                self._add(EVENTS, Kind.VALUE, "restored.state", stored=restored, again=state if undone else None)
        return provisioned

    def _check_raw(self) -> None:
        said = self._recording.metadata.get(RAW_RECORD)
        again = self._raw.whole.record()
        if said is None:
            self._add(RAW_RECORD, Kind.MISSING)
            return
        # The counts of phases follow from the records: they are compared where these
        # are the same. Earlier versions wrote none.
        counted = any(key.startswith(PHASE_KEY) for key in said) and said.get("sha256") == again["sha256"]
        for key in dict.fromkeys([*said, *again]):
            if said.get(key) != again.get(key) and (counted or not key.startswith(PHASE_KEY)):
                self._add(RAW_RECORD, Kind.VALUE, key, stored=said.get(key), again=again.get(key))

    # Notes.

    def _versions(self) -> dict[str, tuple[str, str]]:
        now = {name: v for name, v in {**software(), **drawn_with()}.items() if name not in KEYS}
        then = self._recording.metadata.get("software", {})
        drawn = {name: then.get(name, "unknown") for name in DRAWN_WITH}
        return {n: (v, now[n]) for n, v in {**then, **drawn}.items() if n in now and v != now[n]}

    def _computed_on(self) -> tuple[Mapping[str, str], Mapping[str, str]]:
        then = self._recording.metadata.get("software", {})
        return {name: then[name] for name in KEYS if name in then}, computer()

    def _notes(self, not_beside: tuple[str, ...]) -> Notes:
        return Notes(
            versions=self._versions(),
            report_as_listed=self._listed_report,
            pictures_as_signed=self._pictures_as_signed,
            losses=tuple(losses_of(self._recording)),
            mended=self._mended,
            not_beside=not_beside,
            supersedes=self._superseded(),
        )

    def _superseded(self) -> str | None:
        digest = self._outcome.get("supersedes")
        return digest if isinstance(digest, str) and digest not in outcomes_beside(self._path) else None


def _object(data: bytes) -> Mapping[str, Any] | None:
    """A document as one of ours could be: no key twice, no number that is none."""
    try:
        found = parse_document(data, where="")
        to_text(dict(found))
    except (InputError, ValueError):
        return None
    return found


def _needs_journal(held: Held, registers: object) -> bool | None:
    """Whether something is left to be cleared up; None where nothing was
    written, so that either may be."""
    told = registers if isinstance(registers, Mapping) else {}
    if held.state is DeviceState.NEW_UNVERIFIED and not told.get("written"):
        return None
    return not held.settled or (told.get("undoing_failed") is not None and held.state is not DeviceState.OLD)


def _owes_device(held: Held, outcome: Mapping[str, Any]) -> bool:
    """Whether registers were written, and what the device holds is not settled,
    so that the exit code says so."""
    told = outcome.get("registers")
    return isinstance(told, Mapping) and held.state is not DeviceState.UNTOUCHED and bool(_needs_journal(held, told))


def _without_contents(data: bytes) -> bytes:
    document = json.loads(data)
    document.pop("contents", None)
    return to_text(document).encode()


def _registers(data: bytes) -> Mapping[str, bytes] | None:
    found = _object(data)
    try:
        return None if found is None else {name: bytes.fromhex(raw) for name, raw in found.items()}
    except (ValueError, TypeError):
        return None
