"""What follows from a recording's raw records, profile, station file and
metadata: computed as the station did it."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import triaxcal as tc
import triaxcal_drivers as td
from triaxcald.audit.figures import Agreement, Figures
from triaxcald.audit.previews import Previews, Thinned
from triaxcald.certificate import Certified, certify, over_limits, verdict_of, with_registers
from triaxcald.computer import compute_with_one_thread
from triaxcald.decoded import DecodedStream
from triaxcald.earlier_calibration import ATTACHMENT as EARLIER
from triaxcald.earlier_calibration import RECORD, EarlierFile
from triaxcald.errors import BAD_INPUT, DEVICE, DISK, INTERRUPTED, REFUSED, DaemonError, RecordingError
from triaxcald.inputs import CALIBRATION, VERIFICATION, bundle_of, signs_of
from triaxcald.learned_odds import RECORD as ODDS_RECORD
from triaxcald.learned_odds import OddsFile
from triaxcald.outcome import (
    ATTACHMENT,
    CERTIFICATE,
    RUN_RECORD,
    Code,
    Ending,
    Papers,
    Verdict,
    measured_in,
    outcome_document,
)
from triaxcald.provision.correction import from_attachments
from triaxcald.provision.registers import image_of
from triaxcald.provision.state import DeviceState, Evidence, Held, Observation
from triaxcald.raw_to_poses import Pipeline
from triaxcald.recording.reader import Recording
from triaxcald.recording.schema import ODDS_FILE, RECOVERY_RECORD, SEALED_LATER, STATION_FILE, RawDigest
from triaxcald.report.charts import undrawn
from triaxcald.report.page import unit_report
from triaxcald.run.endings import judged
from triaxcald.run.golden_unit import GoldenCheck
from triaxcald.run.write_back import VERIFICATION_FILE
from triaxcald.schema.outcome import RegistersDone
from triaxcald.station.config import StationFile, parse_station
from triaxcald.verification import (
    Apart,
    fitted_attitudes,
    poses_apart,
    verdict_by_limit,
    verification_document,
    verified,
)
from triaxcald.work import RECORD as WORK_RECORD
from triaxcald.work import Attempt, Work

CANNOT = (tc.TriaxcalError, td.DriverError, DaemonError, ValueError, ArithmeticError, LookupError, TypeError)
"""What a changed profile, station file or raw record may end in."""


@dataclass(frozen=True)
class Digests:
    """Of the raw records: of all, and of each phase by itself."""

    whole: RawDigest
    calibration: RawDigest
    verification: RawDigest


@dataclass(frozen=True)
class Again:
    """``certified`` is None where ``why_not`` says why the poses carry no
    certificate, and for a golden unit, which is verified as ``golden`` says;
    ``verification`` is None where there are no check poses, or no output to
    check."""

    bundle: td.Bundle
    station: StationFile
    readings: Pipeline
    certified: Certified | None
    why_not: str
    verification: tc.interchange.Document | None
    previews: Mapping[str, Thinned]
    golden: GoldenCheck | None = None

    @property
    def written(self) -> bool:
        """Whether a line that comes to its end writes registers."""
        c = self.certified
        return c is not None and c.better and self._would_write

    @property
    def _would_write(self) -> bool:
        c = self.certified
        return c is not None and c.image is not None and self.station.provisioning.write and c.within_limits

    @property
    def checked(self) -> bool:
        """Whether it then takes check poses, also where the device holds nothing worse;
        the line of a golden unit does nothing else."""
        return self.golden is not None or (self._would_write and self.bundle.profile.own_output is not None)

    def ending(self) -> Ending | None:
        """Of a line that came to its end."""
        if self.golden is not None:
            found = self.verification
            return None if found is None or found["after_rms_g"] is None else self.golden.ending(found)
        if self.certified is None:
            return None
        verification = self.verification if self.checked else None
        return judged(self.certified.document, verification, self.station.limits)


def digests(recording: Recording) -> Digests:
    found = Digests(*(RawDigest(recording.ends_with) for _ in range(3)))
    for phase, batch in recording.joined_batches():
        found.whole.update(phase, batch)
        if phase in (CALIBRATION, VERIFICATION):
            (found.calibration if phase == CALIBRATION else found.verification).update(phase, batch)
    return found


def compute(recording: Recording, raw: Digests) -> Again:
    """Raises RecordingError, ProfileError, InputError where the recording lacks
    what there is to compute with."""
    compute_with_one_thread()
    bundle = bundle_of(recording)
    if STATION_FILE not in recording.attachments:
        raise RecordingError(f"attachment {STATION_FILE}: missing")
    text = recording.attachments[STATION_FILE]
    station = parse_station(text, where=STATION_FILE)
    streams = [s for s in (td.READINGS, td.CORRECTED) if s in bundle.profile.streams]
    tumble, check = ({s: Pipeline(bundle, s) for s in streams} for _ in range(2))
    previews = Previews(bundle.profile)
    phases: dict[str, dict[str, Pipeline]] = {CALIBRATION: tumble, VERIFICATION: check}
    # Nothing is computed from unconfirmed records, but the station had drawn
    # their previews before it knew, with a decoder that had seen all before.
    drawn = {phase: {s: DecodedStream(bundle, s) for s in streams} for phase in phases}
    for phase, batch in recording.joined_batches():
        for stream, pipeline in phases.get(phase, {}).items():
            blocks = [] if batch.unconfirmed else [pipeline.feed(batch)]
            if recording.any_unconfirmed:
                blocks = [drawn[phase][stream].feed(batch)]
            for block in blocks:
                previews.feed(stream, block)
    golden = GoldenCheck.of_recording(recording, station, bundle)
    if golden is not None:
        verification, why_not = _verified_golden(golden, check, raw.verification)
        return Again(
            bundle, station, tumble[td.READINGS], None, why_not, verification, previews.thinned(), golden
        )  # fmt: skip
    certified, why_not = None, ""
    try:
        certified = _certified(recording, bundle, station, text, tumble[td.READINGS], raw.calibration)
    except CANNOT as e:
        why_not = str(e) or repr(e)
    verification = None
    if raw.verification.records and (own := bundle.profile.own_output) is not None:
        verification = verification_document(
            verified(tumble[own], station.reference),
            verified(check[own], station.reference),
            limit_g=station.limits.verification_rms_g,
            raw_sha256=raw.verification.hexdigest(),
            apart=_apart(recording, tumble[td.READINGS], station),
        )
    return Again(bundle, station, tumble[td.READINGS], certified, why_not, verification, previews.thinned())


def _verified_golden(
    golden: GoldenCheck, check: Mapping[str, Pipeline], raw: RawDigest
) -> tuple[tc.interchange.Document | None, str]:
    """The verification, or None and why there is none."""
    if not raw.records:
        return None, "there are no check poses"
    try:
        return golden.document(golden.verify(check), raw.hexdigest()), ""
    except CANNOT as e:
        return None, str(e) or repr(e)


def _apart(recording: Recording, readings: Pipeline, station: StationFile) -> Apart:
    return Apart(fitted_attitudes(readings, signs_of(recording) or (1, 1, 1)), station.plan.apart_deg)


def _certified(
    recording: Recording, bundle: td.Bundle, station: StationFile, text: bytes, pipeline: Pipeline, digest: RawDigest
) -> Certified:
    unit, signs = recording.metadata.get("unit", {}), signs_of(recording)
    if signs is None:
        raise ValueError("metadata unit.signs: expected three signs")
    named = recording.metadata.get("software", {})
    file = _earlier(recording)
    if file is not None:
        file.require_of(
            f"unit {unit.get('name', '')}",
            serial=unit.get("serial") or None,
            signs=signs,
            reference=station.reference,
            reference_unit="g",
            output_unit=bundle.profile.output.unit,
        )
    return certify(
        bundle,
        station,
        text,
        pipeline,
        pipeline.finish(),
        digest,
        unit_name=unit.get("name", ""),
        serial=unit.get("serial") or None,
        signs=signs,
        computed_with={name: named[name] for name in named if name not in DRAWN_WITH},
        earlier=None if file is None else file.known(),
        at_start=from_attachments(recording.attachments, recording.name),
        odds=_odds(recording),
    )


def _odds(recording: Recording) -> OddsFile | None:
    """The learned odds by which the unit was diagnosed."""
    name = recording.metadata.get(ODDS_RECORD, {}).get("file")
    if (name is None) != (ODDS_FILE not in recording.attachments):
        raise RecordingError(f"attachment {ODDS_FILE}: without its metadata {ODDS_RECORD}, or the other way round")
    return None if name is None else OddsFile.parsed(recording.attachments[ODDS_FILE], name)


def _earlier(recording: Recording) -> EarlierFile | None:
    """The calibration of which the recording renews the biases alone."""
    name = recording.metadata.get(RECORD, {}).get("calibration")
    if (name is None) != (EARLIER not in recording.attachments):
        raise RecordingError(f"attachment {EARLIER}: without its metadata {RECORD}, or the other way round")
    return None if name is None else EarlierFile.parsed(recording.attachments[EARLIER], name)


def as_stored(again: Again, stored: Mapping[str, Mapping[str, Any] | None]) -> tuple[Again, Agreement]:
    """With the figures of the ``stored`` documents, by name, where they are the
    same (`triaxcald.audit.figures`), and how far off these are.

    Figures alone are taken over. Register words and verdicts are made again of
    them as the station makes them, of the figures as they are printed: so no
    last digit decides what an audit says.
    """
    agreement, certified, verification = Agreement(), again.certified, again.verification
    if certified is not None:
        certified = _certified_as_stored(again, certified, stored_certificate(stored), agreement)
    found = stored.get(VERIFICATION_FILE)
    if verification is not None and found is not None:
        verification = Figures(verification).taken(VERIFICATION_FILE, found, agreement)
        if (limit_g := verification["limit_rms_g"]) is not None:
            verification["verdict"] = verdict_by_limit(verification["after_rms_g"], limit_g)
        if "poses_apart" in verification:
            verification["poses_apart"] = poses_apart(verification["poses"], again.station.plan.apart_deg)
    return replace(again, certified=certified, verification=verification), agreement


def stored_certificate(stored: Mapping[str, Mapping[str, Any] | None]) -> Mapping[str, Any]:
    """Or as much of it as the outcome has: a unit that failed has none."""
    found = stored.get(CERTIFICATE)
    measured = (stored.get(ATTACHMENT) or {}).get("measured")
    if found is None and isinstance(measured, Mapping):
        return {"result": {name: measured.get(name) for name in ("before", "after")}}
    return found or {}


def _certified_as_stored(
    again: Again, certified: Certified, stored: Mapping[str, Any], agreement: Agreement
) -> Certified:
    registers = certified.document["registers"]
    if registers is not None and isinstance(stored.get("registers"), Mapping):
        taken = Figures(registers).taken("", {"words": stored["registers"].get("words")}, Agreement())
        pairs = zip(registers["words"], taken["words"], strict=True)
        wanted = {new["role"]: new["wanted"] for old, new in pairs if old["wanted"] != new["wanted"]}
        if wanted:
            certified = with_registers(certified, again.bundle, again.station, wanted)
    document = Figures(certified.document).taken(CERTIFICATE, stored, agreement)
    outside = over_limits(document["result"]["after"], again.station.limits)
    document |= {"outside": outside, "verdict": verdict_of(outside, again.station.limits)}
    return replace(certified, document=document, within_limits=not outside)


def by_its_own_words(again: Again, stored: Mapping[str, Any]) -> Again:
    """With the register words of the ``stored`` certificate of another version,
    in place of those that this one computes: the register traffic is judged by
    what that version asked for. Raises LookupError, TypeError or ValueError
    where the certificate lacks a part, and DriverError for words that the
    profile does not have."""
    certified, registers = again.certified, stored["registers"]
    if certified is None or certified.image is None or registers is None:
        return again
    profile = again.bundle.profile
    words = {w["register"]: profile.encode(w["register"], w["wanted"]) for w in registers["words"]}
    return replace(again, certified=replace(certified, image=image_of(profile, words)))


DRAWN_WITH = ("matplotlib", "jinja2")
"""Versions that the recording names and the certificate does not."""


def held_in(outcome: Mapping[str, Any]) -> Held | None:
    """What the device holds, as an outcome says it; None where it says no such
    thing."""
    try:
        state, evidence = DeviceState(str(outcome.get("device_state"))), Evidence(str(outcome.get("evidence")))
        return Held(state, evidence, {Observation(o) for o in outcome.get("observed") or ()})
    except (ValueError, TypeError):
        return None


def has_codes(outcome: Mapping[str, Any]) -> bool:
    """Whether the version that wrote the outcome gave it a code, and kept the
    observations of the device apart; versions before 0.2 did neither."""
    return "code" in outcome


def report_of(again: Again, ending: Ending, held: Held, *, pictures: bool = True) -> str:
    """The page, with or without lines in its pictures."""
    assert again.certified is not None
    with nullcontext() if pictures else undrawn():
        return unit_report(again.certified, again.readings, ending, again.verification if again.checked else None, held)


def sealed_later(outcome: Mapping[str, Any], recording: Recording) -> bool:
    """Whether the next start sealed the recording, which ends before the run did. The
    outcome then has no figures."""
    if outcome.get("verdict") != Verdict.ABORTED.value:
        return False
    recovered = recording.metadata.get(RECOVERY_RECORD, {})
    return outcome.get("code") == Code.KILLED or recovered.get(SEALED_LATER) == ATTACHMENT


def outcome_again(
    stored: Mapping[str, Any],
    again: Again,
    recording: Recording,
    digests_of: Mapping[str, str],
    contents: tc.interchange.Document,
) -> tc.interchange.Document:
    """The outcome as it follows from all the rest. What a recording cannot know
    of itself is taken as ``stored``: when it ended, which outcome it
    supersedes, why doubts were overruled, and why work was aborted."""
    aborted = stored.get("verdict") == Verdict.ABORTED.value
    ending = None if aborted else again.ending()
    if ending is None:
        ending = Ending(
            Verdict.ABORTED,
            str(stored.get("reason")),
            _whole(stored.get("exit_code")),
            _code_in(stored),
            _texts(stored.get("wanted_poses")),
        )
    certificate = again.certified.document if again.certified else None
    if aborted and stored.get("measured") is None:  # it did not come to a fit
        certificate = None
    checked = VERIFICATION_FILE in recording.attachments or (again.checked and not aborted)
    unit = recording.metadata.get("unit", {})
    named = recording.metadata.get("software", {})
    document = outcome_document(
        ending,
        held_in(stored) or Held(),
        Papers(
            measured=measured_in(certificate) if certificate else None,
            verification=again.verification if checked and not sealed_later(stored, recording) else None,
            registers=RegistersDone.read(stored.get("registers")),
            limits=again.station.limits.model_dump(),
            outside=certificate["outside"] if certificate else (),
            digests=digests_of,
            contents=contents,
        ),
        unit=unit.get("name", ""),
        serial=unit.get("serial") or None,
        station=again.station.name,
        ended=str(stored.get("ended")),
        software={name: named[name] for name in named if name not in DRAWN_WITH},
        supersedes=_text_in(stored, "supersedes"),
        journal=_text_in(stored, "journal"),
        forced=_text_in(stored, "forced"),
        attempt=_attempt_in(stored, recording),
    )
    if not has_codes(stored):
        document = {name: value for name, value in document.items() if name not in ("code", "observed")}
    return document


def _attempt_in(stored: Mapping[str, Any], recording: Recording) -> Attempt | None:
    """The attempt: its id and its work as the recording's metadata have them. None in a
    recording of a development version before 0.2."""
    held = recording.metadata.get(RUN_RECORD)
    if held is None:
        return None
    try:
        work = Work.recorded(recording.metadata.get(WORK_RECORD, {}))
    except ValueError:
        work = Work("")
    return Attempt(
        held.get("run", ""),
        held.get("started", ""),
        work,
        _text_in(stored, "recording"),  # a file may have another name since
        _text_in(stored, "settles"),
    )


def _text_in(stored: Mapping[str, Any], key: str) -> str | None:
    value = stored.get(key)
    return value if isinstance(value, str) else None


ABORTED_WITH = (BAD_INPUT, REFUSED, DEVICE, DISK, INTERRUPTED)


def exit_codes_in(outcome: Mapping[str, Any]) -> tuple[int | None, ...]:
    """The exit codes that an aborted outcome may have: that of its code, or bad
    input without one. Earlier versions wrote no code."""
    if not has_codes(outcome):
        return ABORTED_WITH
    code = _code_in(outcome)
    return (code.exit_code if code else BAD_INPUT,)


def _code_in(outcome: Mapping[str, Any]) -> Code | None:
    try:
        return Code(str(outcome.get("code")))
    except ValueError:
        return None


def _whole(value: object) -> int:
    return value if isinstance(value, int) else -1


def _texts(value: object) -> tuple[str, ...]:
    return tuple(map(str, value)) if isinstance(value, list) else ()
