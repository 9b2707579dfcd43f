"""What the daemon says of devices and provisionings, in English. Nothing reads
these sentences back."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import triaxcal as tc
from triaxcald.provision.state import DeviceState, Evidence, Held
from triaxcald.schema.codes import Code, Stage, Verdict

if TYPE_CHECKING:
    from triaxcald.provision.procedure import Provisioning
    from triaxcald.provision.registers import SanityWarning

_HELD: dict[tuple[DeviceState, Evidence | None], str] = {
    (DeviceState.UNTOUCHED, None): "no register was written",
    (DeviceState.OLD, Evidence.NOTHING_STORED): "the old calibration is in use again, and nothing was stored",
    (DeviceState.OLD, Evidence.RESTART): "the device holds the old calibration, read back after a restart",
    (DeviceState.OLD, Evidence.POWER_CYCLE): "the device holds the old calibration, read back after a power cycle",
    (DeviceState.OLD, None): "the old calibration is written back and reads back equal; no restart has proven it",
    (DeviceState.NEW_VERIFIED, Evidence.RESTART): "the device holds the new calibration, read back after a restart",
    (
        DeviceState.NEW_VERIFIED,
        Evidence.POWER_CYCLE,
    ): "the device holds the new calibration, read back after a power cycle",
    (DeviceState.NEW_UNVERIFIED, Evidence.WRITE_COUNTER): (
        "the device has stored the new calibration by its own counter; no restart has proven it"
    ),
    (DeviceState.NEW_UNVERIFIED, None): "the new calibration is written and reads back equal; no restart has proven it",
    (DeviceState.MIXED, None): "the registers read back as neither the old calibration nor the new one",
    (DeviceState.UNKNOWN, None): "what the device holds is unknown",
}


IS_BACK = "the unit is back"
STAGES = {
    Stage.IDENTITY: "reading identity",
    Stage.POSES: "poses",
    Stage.FITTING: "fitting",
    Stage.WRITING: "writing the registers",
    Stage.POWER_OFF: "switch the supply off",
    Stage.POWER_ON: "switch the supply on",
    Stage.CHECK_POSES: "verifying by physics",
    Stage.REPORT: "writing the report",
}
"""Stages of a run, for people."""
VERDICTS = {Verdict.PASS: "PASS", Verdict.FAIL: "FAIL", Verdict.ABORTED: "STOPPED", Verdict.NOT_JUDGED: "NO LIMIT"}
"""Verdicts, for people: the first word of a line."""
BUS_IS_BACK = "the bus is back"
NOTHING_YET = "nothing has come yet"
DISK_IS_BEHIND = "records are lost: the disk does not keep up"
DISK_KEEPS_UP = "the disk keeps up again"


def unidentified(why: str) -> str:
    """Of a unit that is asked again who it is."""
    return f"does not say whether it is still the same unit, and is asked again later: {why}"


def unconfirmed(records: int) -> str:
    return (
        f"{tc.number_format.number_of(records, 'record')} not used, which came after the unit was last "
        "confirmed to be there; "
        "another one answered later"
    )


def mostly_unconfirmed(unconfirmed: int, records: int, why: str) -> str:
    """``why`` is by what another unit was noticed, where that is known."""
    return (
        f"{unconfirmed} of {tc.number_format.number_of(records, 'record')} are unconfirmed, and not used: "
        f"{why or 'another unit answered'}; record it again with the right unit alone there"
    )


def two_senders(where: str, stream: str) -> str:
    return (
        f"two units answer at {where}: stream {stream} has two senders, each with samples of its own; "
        "disconnect one of them, or give it another address"
    )


def waits(trouble: str) -> str:
    """Of a unit or a bus that is lost for now."""
    return f"waiting: {trouble}"


def waited_for(trouble: str, *, endless: bool) -> str:
    """What is the matter with a unit or a bus that is lost; where that is waited
    for without a limit, how to set one."""
    return f"{trouble}; the wait has no end, unless --give-up-after S sets one" if endless else trouble


def nothing_deleted(document: str) -> str:
    """Of retention that may not delete what a document may name."""
    return f"nothing is deleted, as {document} cannot be read, and may name any segment"


def metrics_at(port: int) -> str:
    return f"http://127.0.0.1:{port}/metrics has the numbers, http://127.0.0.1:{port}/health says how it stands"


def recorded(units: int, buses: int, lost: Sequence[str], ended: Sequence[str], records: int) -> str:
    """How recordings stand, in a line."""
    missing = "".join(
        f", {what} {', '.join(names)}" for what, names in (("waiting for", lost), ("ended:", ended)) if names
    )
    kinds = " and ".join(kind for kind, count in (("units", units), ("buses", buses)) if count)
    there = units + buses
    came = (
        f"{there - len(lost) - len(ended)} of {there} {kinds} recorded, {tc.number_format.number_of(records, 'record')}"
    )
    return f"{came}{missing}"


def reloaded(changed: Sequence[str]) -> str:
    """The station file, while what it names is recorded."""
    return f"the station file was read again; changed: {', '.join(changed) or 'nothing'}"


def not_begun_again(error: str) -> str:
    return f"what the disk ended was not begun again: {error}"


def not_reloaded(error: str) -> str:
    return f"the station file was not taken, and what was recorded goes on: {error}"


def one_of_several(units: Sequence[str], buses: Sequence[str], output: Path) -> str:
    """Where a single file is to hold what a station records."""
    there = [tc.number_format.number_of(len(units), "unit")] if units else []
    there += [f"{len(buses)} bus{'es' * (len(buses) != 1)}"] if buses else []
    return (
        f"there are {' and '.join(there)}; name one of {', '.join([*units, *buses])} with --unit, or record all of "
        f"them into a folder that exists: {output} is none"
    )


_NOT_A_SAMPLE = {
    "errors": "in error",
    "malformed": "too short for the profile's message, or not as it is defined",
    "incomplete": "that lack a message or part",
    "duplicates": "that repeat an earlier one",
    "invalid": "that the unit says are not valid",
    "not_finite": "whose outputs are no finite numbers",
}


def no_sample(seconds: float, counts: Mapping[str, int]) -> str:
    """Of a stream of which records come, and no sample; ``counts`` is what was
    made of them meanwhile."""
    said = [f"{counts[name]} {what}" for name, what in _NOT_A_SAMPLE.items() if counts.get(name)]
    came = f": {', '.join(said)}" if said else ": its counter stands still, or a message of it never comes"
    return f"the device sends, but no whole sample of it for {seconds:g} s{came}"


def own_seconds(own: float, by_host: float | None) -> str:
    """How long samples span by the unit's counter or stamps, and by the host's
    clock where that is another time by a tenth: its rate is not the profile's,
    or it is simulated faster."""
    if by_host is None or by_host < 1.0 or by_host / 1.1 < own < by_host * 1.1:
        return f"{own:.1f} s"
    return f"{own:.1f} s of the unit's own time ({by_host:.1f} s by the host's clock)"


def bus_recorded(name: str, counts: Mapping[str, int], seconds: float) -> str:
    """What the recording of a bus has come to; ``counts`` as
    `triaxcald.station.listening.Listened` has them."""
    frames, identifiers = (
        tc.number_format.number_of(counts["frames"], "frame"),
        tc.number_format.number_of(counts["identifiers"], "identifier"),
    )
    came = f"{name}: {frames} of {identifiers} in {seconds:.1f} s"
    return f"{came}, {tc.number_format.number_of(counts['errors'], 'error frame')}" if counts["errors"] else came


SWITCH_ON = "switch the supply of the unit on"


KILLED = "the process was killed"


def killed(slot: str, started: str, path: Path, outcome: Mapping[str, Any], station: Path) -> str:
    """Of a run that ended without an outcome in its recording, which the next start
    has written."""
    journal, device = outcome["journal"], ""
    if journal is not None:
        device = f"; {unfinished(Path(journal), slot, station)}"
    elif outcome["device_state"] == DeviceState.UNTOUCHED:
        device = "; no register was written"
    how = "was killed" if outcome["code"] == Code.KILLED else f"could not be stored ({outcome['reason']})"
    return f"unit {slot}: the run of {started} {how}; its outcome is {path}{device}"


def switch_supply(off_s: float) -> str:
    """What the operator is to do."""
    return f"switch the supply of the unit off for at least {math.ceil(off_s)} s, then on"


def held(of: Held) -> str:
    """What the device holds."""
    return _HELD.get((of.state, of.evidence)) or _HELD[of.state, None]


def recovery_command(p: Provisioning, station: Path) -> str:
    """The command that settles the state of the device; empty if it is settled."""
    return "" if p.settled else _command_to_settle(p.held, p.open_journal, p.unit, station)


def _command_to_settle(of: Held, journal: Path | None, unit: str, station: Path) -> str:
    """The command for a device in the state ``of``, with the journal if there is
    one."""
    provision = f"triaxcal provision {'--resume' if journal else 'CAL.json'} {station} --unit {unit}"
    restore = f"triaxcal restore {journal or 'REC'} {station} --unit {unit}"
    told = f" (journal: {journal})" if journal else ""
    if of.state is DeviceState.NEW_UNVERIFIED:
        return f"to verify: '{provision} --power-cycle', and switch its supply off and on when asked{told}"
    if of.state is DeviceState.OLD:
        return f"to verify: '{restore} --power-cycle', and switch its supply off and on when asked"
    return f"to settle: '{provision}' writes the new calibration, '{restore}' the old one"


def unfinished(journal: Path, unit: str, station: Path) -> str:
    """Notice about a journal whose device this run has not examined."""
    unknown = Held(DeviceState.UNKNOWN, Evidence.NO_ANSWER)
    return (
        f"an earlier provisioning was cut short or not verified; {_command_to_settle(unknown, journal, unit, station)}"
    )


def abort_notice(p: Provisioning, station: Path) -> str:
    """State of the device, and the recovery command."""
    return "; ".join(filter(None, (held(p.held), recovery_command(p, station))))


def provisioned(p: Provisioning) -> str:
    """What was done, and what the device holds now."""
    if not p.written:
        marked = ", ".join(dict.fromkeys(p.link.probed))
        wrote = (
            f"; only {marked} was written, to show a restart, and holds its value again"
            if marked
            else ", and nothing was written"
        )
        if p.held.state is DeviceState.NEW_UNVERIFIED:
            return f"the registers in use held these values already{wrote}; no restart shows them stored"
        return f"the registers held these values already{wrote}; {held(p.held)}"
    stored = "written and stored" if p.stores else "written"
    return f"{tc.number_format.number_of(len(p.written), 'register')} {stored}; {held(p.held)}"


def rehearsed(p: Provisioning) -> str:
    """The same where only a dry run was asked for."""
    there = tc.number_format.number_of(len(p.differing), "register")
    if p.restart_owed:
        return (
            f"dry run: nothing was written; {there} in use {'differs' if len(p.differing) == 1 else 'differ'} from the "
            "calibration; the device would be restarted first, and what differs then would be written"
        )
    return f"dry run: {there} would be written, nothing was"


def put_back(p: Provisioning) -> str:
    """The same of an old calibration."""
    done = (
        f"{tc.number_format.number_of(len(p.written), 'register')} written back"
        if p.written
        else "nothing had to be written"
    )
    return f"{done}; {held(p.held)}"


NO_LIMIT = "the station has no limit for what was measured"


def passed(verification: Mapping[str, Any] | None) -> str:
    if verification is None:
        return "the fit is within the limits; the device's own output was not checked"
    limit = verification["limit_rms_g"]
    told = "" if limit is None else f", limit {tc.number_format.micro_g(limit)}"
    return f"within the limits; the device's own output in {_poses(verification)} is {_checked(verification)}{told}"


def verification_failed(verification: Mapping[str, Any]) -> str:
    limit = verification["limit_rms_g"]
    if limit is None:
        before = tc.number_format.micro_g(verification["before_rms_g"])
        limited = f"worse than {before} before"
    else:
        limited = f"limit {tc.number_format.micro_g(limit)}"
    return f"the device's own output in {_poses(verification)} is {_checked(verification)}, {limited}"


def golden(verification: Mapping[str, Any], calibration: str | None) -> str:
    """How a golden unit has verified: by its own output, or by its readings under the
    file ``calibration``."""
    of = "the device's own output" if calibration is None else f"the readings under {calibration}"
    count = tc.number_format.number_of(sum(p["used"] for p in verification["poses"]), "check pose")
    limit = tc.number_format.micro_g(verification["limit_rms_g"])
    return f"golden unit: {of} in {count} is {_checked(verification)}, limit {limit}"


def _poses(verification: Mapping[str, Any]) -> str:
    count, apart = sum(p["used"] for p in verification["poses"]), verification.get("poses_apart")
    if apart is None or count == 0:
        return "the check poses"
    if apart == 0:
        return f"{count} check poses in the attitudes of the fit"
    if apart == count:
        return f"{count} check poses in other attitudes than the fit's"
    return f"{count} check poses ({apart} in other attitudes than the fit's)"


def _checked(verification: Mapping[str, Any]) -> str:
    expanded = verification.get("expanded_uncertainty_g")
    told = f" ± {tc.number_format.micro_g(expanded)}" if expanded is not None else ""
    return f"{tc.number_format.micro_g(verification['after_rms_g'])}{told} off"


def sanity_warning(of: SanityWarning) -> str:
    match of.kind:
        case "not_a_number":
            return f"{of.register} holds no number"
        case "outside_limits":
            return f"{of.register} holds {of.value:.6g}, outside its limits {of.low:g} to {of.high:g}"
        case "unstable":
            return f"{of.register} reads differently each time"
        case "checksum":
            return f"the checksum in {of.register} does not fit the registers"
        case "corrected_output":
            return f"the corrected output is {of.value:.3g} g off what the registers make of the readings"
        case _:
            return f"{of.register} holds {of.value:.6g}, expected {of.low:g} to {of.high:g}"


MOST_WARNINGS = 3
"""Number of warnings listed: one cause, such as a wrong word order, affects most
registers."""


def refused_by_sanity_warnings(of: Sequence[SanityWarning]) -> str:
    """Refusal to write because of sanity warnings."""
    listed = "; ".join(sanity_warning(w) for w in of[:MOST_WARNINGS])
    more = f"; and {len(of) - MOST_WARNINGS} more" if len(of) > MOST_WARNINGS else ""
    return (
        f"what the device holds is no calibration under its profile (word order, scaling, addresses?): {listed}{more}; "
        "nothing was written; --force REASON writes all the same"
    )


def of_correction(figures: Mapping[str, Any], rounding_rms_g: float | None) -> list[str]:
    """What the registers of a device's own correction leave and gain: the figures of
    `CorrectionOfCertificate`."""
    lines = []
    if fixed := figures.get("fixed"):
        lines.append(
            f"no register for {', '.join(fixed)}: that leaves |a| off by {_micro(figures.get('left_rms_g'))} rms, "
            f"{_micro(figures.get('left_largest_g'))} at most"
        )
    own = figures.get("own_rms_g") or {}
    lines.append(
        f"|a| of the device's own output: off by {_micro(own.get('before'))} rms with the old registers, "
        f"{_micro(own.get('predicted'))} predicted with the new, of which rounding is {_micro(rounding_rms_g)}"
    )
    if figures.get("better") is False:
        lines.append("the new registers are no better than the old by more than the uncertainty of the prediction")
    return lines


def _micro(value_g: float | None) -> str:
    return "unknown" if value_g is None else tc.number_format.micro_g(value_g)
