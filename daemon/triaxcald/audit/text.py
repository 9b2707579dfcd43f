"""What an audit has found, in lines for people. Nothing reads them back."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from math import ceil, floor, log10
from typing import Any

import triaxcal as tc
from triaxcald.audit.chain import ChainAudit
from triaxcald.audit.conduct import Audit, Notes, Result
from triaxcald.audit.differences import NOTHING, Difference, Kind
from triaxcald.audit.figures import SHARE, Agreement
from triaxcald.audit.signature import Signature, State
from triaxcald.audit.within import Moved, Within
from triaxcald.signing.stamps import Stamp, StampState

_LONGEST = 60


def difference(of: Difference) -> str:
    return f"{of.part}: {_what(of)}"


def _what(of: Difference) -> str:
    place, stored, again = of.place, _short(of.stored), _short(of.again)
    match of.kind:
        case Kind.VALUE:
            share = "" if of.of_uncertainty is None else f" ({_shown(of.of_uncertainty)} of its uncertainty)"
            return f"{place}: stored {stored}, computed again {again}{share}"
        case Kind.BYTES:
            return "the bytes differ, the content does not"
        case Kind.MORE:
            return f"and {of.again} more"
        case Kind.NO_DOCUMENT:
            return "the stored one is no JSON document that could be"
        case Kind.NOT_COMPUTED:
            return f"cannot be computed again: {of.again}"
        case Kind.MISSING:
            return f"{place}: missing" if place else "missing, though the result rests on it"
        case Kind.UNCALLED_FOR:
            return "by what was measured there is none"
        case Kind.UNLISTED:
            return "is in the recording, and the outcome does not list it"
        case Kind.LISTED:
            return f"{place}: the outcome lists {stored}, the recording has {again}"
        case Kind.NOT_DRAWN:
            return "drawn again, it comes out otherwise"
        case Kind.ORDER:
            return "in another order than the outcome lists them"
        case Kind.NOT_LAST:
            return f"not the last attachment; that is {_bare(of.again)}"
        case Kind.NO_END:
            return "missing, though the recording says that it ends with it"
        case Kind.TWICE:
            return "is in the recording more than once"
        case Kind.TIMES:
            return f"{_records(of)} with other times than those in the content"
        case Kind.SEQUENCE:
            return f"{_records(of)} with a sequence number, which the station gives none"
        case Kind.RUNNING_INDEX:
            return f"{of.again} gap{'' if of.again == 1 else 's'} in the running index, not noted as losses"
        case Kind.TOPIC:
            return "a topic that no recording has"
        case Kind.UNDECODABLE:
            return f"{_records(of)} that cannot be decoded"
        case Kind.INDEX:
            return "the index at the end of the file is not of what is in it"
        case Kind.NOT_OF_RAW:
            return "not what the raw records give"
        case Kind.NOT_HELD:
            return f"{place}: the device holds {_bare(of.stored)}, the certificate asks for {_bare(of.again)}"
        case Kind.NOT_READ:
            return f"{place}: {_bare(of.stored)} here, {_bare(of.again)} by the register traffic"
        case Kind.NOT_ASKED_FOR:
            return f"{place}: {_bare(of.stored)} was written, which neither the certificate nor the profile asks for"
        case Kind.NOT_SHOWN:
            return f"{place}: {stored}: the register traffic does not bear it out"
        case Kind.NOT_FORCED:
            return f"forced: {place} held no plausible calibration before, and no reason is given for writing over it"
        case Kind.BESIDE:
            return "the file beside the recording is not the one in it"
        case Kind.ALONE:
            return "lies beside the recording, which has none"
        case Kind.UNSIGNED:
            return "missing: the recording is not signed, and the trust file asks for it; --allow-unsigned lets it pass"
        case Kind.NO_ENVELOPE:
            return f"no signature: {_bare(of.again)}"
        case Kind.NOT_VERIFIED if place:
            return f"{place}: of {_bare(of.again)}"
        case Kind.NOT_VERIFIED:
            return "the signature is not of its key over this content"
        case Kind.UNTRUSTED:
            return f"signed by a key that the trust file does not have, {_bare(of.again)}"
        case Kind.REVOKED:
            return f"signed by key {_bare(of.again)}, which is revoked"
        case Kind.CLOCK:
            return f"{place}: {_bare(of.stored)} cannot be, by {_bare(of.again)}: a clock was set back"
        case Kind.MENDED:
            return f"{place}: {stored}, signed by the start that mended the recording, which only vouches for {again}"
        case Kind.REMOVED if place:
            return (
                f"entry {of.again} of the chain is of no recording in the folder, and the signature of its tombstone, "
                f"entry {place}, does not count"
            )
        case Kind.REMOVED:
            return f"entry {of.again} of the chain is of no recording in the folder, and no tombstone says why"
        case Kind.INSERTED:
            return f"not in the chain ({_bare(of.again)})"
        case Kind.COPIED:
            return f"the same recording as {_bare(of.again)}"
        case Kind.RENAMED:
            return f"was signed under the name {_bare(of.stored)}"
        case Kind.LATE:
            return f"signed on {_bare(of.stored)}, long after its end on {_bare(of.again)}"
        case Kind.BROKEN:
            return f"entry {place}: {_bare(of.again)}"
        case Kind.CUT:
            return f"the chain ends with entry {stored}; {_bare(of.again)} is known, so it was cut"
        case Kind.NO_CHAIN:
            return "there is no chain in the folder of these signed recordings"


def _records(of: Difference) -> str:
    return f"{of.again} record{'' if of.again == 1 else 's'}"


def _bare(value: object) -> str:
    return value if isinstance(value, str) else _short(value)


def _short(value: object) -> str:
    if value is NOTHING:
        return "nothing"
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= _LONGEST else text[: _LONGEST - 3] + "…"


def notes(of: Notes) -> list[str]:
    found = [f"{name}: {then} then, {now} now" for name, (then, now) in of.versions.items()]
    if "triaxcal" in of.versions:
        found.append("sentences, and keys that the earlier version did not write, are not compared")
    if of.report_as_listed:
        found.append("report.html was not drawn again, since versions differ; it is compared with the outcome's digest")
    if of.pictures_as_signed:
        found.append("the pictures in report.html are as a trusted key signed them; words and figures are compared")
    found += of.losses
    if of.mended:
        found.append("the recording was cut short or damaged, and mended")
    if of.supersedes:
        found.append(f"the outcome that this one supersedes is not in the folder: SHA-256 {of.supersedes}")
    if of.not_beside:
        found.append(f"not beside the recording: {', '.join(of.not_beside)}")
    return found


def signature(of: Signature) -> str | None:
    """Who signed it, and when; None of a recording without a signature."""
    if of.state is State.UNSIGNED:
        return "not signed; it is from before the trust file" if of.older else None
    if of.state is State.INVALID:
        return "the signature is not valid"
    told = f"signed by {of.name or of.key} on {of.signed}, entry {of.number}; {_TRUST[of.state]}"
    if of.state is State.UNTRUSTED:
        told += " (no trust file)" if of.trust is None else f" ({of.trust})"
    told += "; signed by the start that mended it" if of.mended else ""
    return f"{told}{_stamped(of.stamp)}"


_TRUST = {
    State.TRUSTED: "the key is trusted",
    State.UNTRUSTED: "nothing says that the key is trusted",
    State.REVOKED: "the key is revoked",
}


def _stamped(stamp: Stamp | None) -> str:
    if stamp is None:
        return ""
    if stamp.state is StampState.MISSING:
        return "; the time stamp that the station asks for is missing"
    if stamp.state is StampState.INVALID or stamp.time is None:
        return "; the time stamp is not valid"
    by = f"by {stamp.authority}" if stamp.authority else "by an authority that the trust file does not have"
    return f"; time stamp {stamp.time.isoformat()} {by}"


def chained(of: ChainAudit) -> list[str]:
    """The chain of a folder, in lines."""
    number = tc.number_format.number_of
    told = [f"{number(of.recordings, 'signed recording')}", f"{number(of.tombstones, 'tombstone')}"]
    if of.doubtful:
        told.append(f"{of.doubtful} without a signature that counts")
    if of.earlier:
        told.append(f"{of.earlier} from before")
    head = f"; head {of.head[0]}, {of.head[1]}" if of.head else ""
    result = "the chain differs" if of.differences else "the chain is whole"
    return [f"{of.folder}: {result} ({', '.join(told)}){head}", *(f"  {difference(d)}" for d in of.differences)]


def chain_document(of: ChainAudit) -> dict[str, Any]:
    """An entry of `chains` in `triaxcal.audit/1`."""
    return {
        **of.document(),
        "differences": [difference(d) for d in of.differences],
        "codes": codes(of.differences),
        "error": None,
    }


def chain_error(folder: str, error: str) -> dict[str, Any]:
    """The entry of a folder whose chain cannot be audited."""
    return {**chain_document(ChainAudit(folder, ())), "error": error}


def codes(of: Sequence[Difference]) -> list[str]:
    """The kind of each difference, for programs."""
    return [d.kind.name.lower() for d in of]


def heading(of: Audit) -> str:
    verdict = f"; verdict {of.verdict}" if of.verdict else ""
    return f"{of.recording}: {_result(of)} ({', '.join(of.checked)}){verdict}"


def _result(of: Audit) -> str:
    if of.within is not None:
        return _result_within(of, of.within)
    match of.result:
        case Result.DIFFERS:
            return f"differs from what triaxcal {of.made_by} computed{_furthest(of)}" if of.made_by else "differs"
        case Result.SAME_FIGURES:
            return f"the same figures (largest difference {_largest(of.agreement)}; {_where(of)})"
        case _:
            return f"the same as triaxcal {of.made_by} computed" if of.made_by else "the same, byte for byte"


def _result_within(of: Audit, within: Within) -> str:
    """Of a recording of other software, where figures may be off by a share of their
    uncertainties."""
    by = ", ".join(f"{name} {version}" for name, version in within.by.items())
    largest = within.largest
    if largest is not None:
        off = f"{_shown(largest.of_uncertainty or 0.0)} of its uncertainty, {largest.part}: {largest.place}"
        off = f" (largest difference {off})"
    else:
        off = "" if within.moved else " (no figure differs)"
    match of.result:
        case Result.DIFFERS:
            return f"differs from what {by} computed{off}"
        case Result.WITHIN:
            return f"within {within.limit:g} of the uncertainties of what {by} computed{off}"
        case _:
            return f"the same as {by} computed{off}"


def _shown(share: float) -> str:
    return f"{share:.2g}"


def _furthest(of: Audit) -> str:
    if of.furthest is None:
        return ""
    share, place = of.furthest
    where = f" ({place})" if share > SHARE else ""
    return f", coefficients by at most {_rounded_up(max(share, SHARE))} of their standard errors{where}"


def _largest(of: Agreement) -> str:
    """Rounded up: no figure is further off."""
    if of.of_uncertainty:
        return f"{_rounded_up(of.of_uncertainty)} of its uncertainty"
    return f"{_rounded_up(of.relative)} of itself" if of.relative else "in the last digit of a drawing or a sentence"


def _rounded_up(share: float) -> str:
    step = 10.0 ** floor(log10(share))
    return f"{ceil(share / step * (1 - 1e-12)) * step:.0e}".replace("e-0", "e-")


def _where(of: Audit) -> str:
    then, now = of.computed_on
    if not then:
        return "it does not say on which processor it was computed"
    return f"computed on {'the same' if dict(then) == dict(now) else 'another'} processor"


def lines(of: Audit) -> list[str]:
    """All that there is to say of one audit."""
    signed = signature(of.signature)
    return [
        heading(of),
        *(f"  {difference(d)}" for d in of.differences),
        *(f"  note: {n}" for n in notes(of.notes)),
        *([] if signed is None else [f"  {signed}"]),
    ]


AGREE, DIFFER, UNREADABLE = "agree", "differ", "unreadable"


def outcome_of(result: object) -> str:
    """How a recording counts, by its ``result``; None where it could not be audited."""
    return UNREADABLE if result is None else DIFFER if result == Result.DIFFERS.value else AGREE


def summary(of: Counter[str]) -> str:
    """ "12 recordings: 10 agree, 1 differs, 1 could not be audited", of how many count
    as what."""
    return f"{tc.number_format.number_of(of.total(), 'recording')}: {_told(of)}"


def stopped(of: Counter[str], total: int) -> str:
    """ "12 of 40 recordings audited: 11 agree, 1 differs"."""
    told = f": {_told(of)}" if of else ""
    return f"{of.total()} of {tc.number_format.number_of(total, 'recording')} audited{told}"


def _told(counts: Counter[str]) -> str:
    told = [f"{counts[AGREE]} agree{'s' if counts[AGREE] == 1 else ''}"]
    if counts[DIFFER]:
        told.append(f"{counts[DIFFER]} differ{'s' if counts[DIFFER] == 1 else ''}")
    if counts[UNREADABLE]:
        told.append(f"{counts[UNREADABLE]} could not be audited")
    return ", ".join(told)


def counts(of: Counter[str]) -> dict[str, int]:
    """The same as numbers, for the document."""
    return {"recordings": of.total(), **{name: of[name] for name in (AGREE, DIFFER, UNREADABLE)}}


def document(recording: str, found: Audit | None, error: str | None = None) -> dict[str, Any]:
    """An entry of `triaxcal.audit/1`."""
    return {
        "recording": recording,
        "checked": list(found.checked) if found else [],
        "differences": [difference(d) for d in found.differences] if found else [],
        "codes": codes(found.differences) if found else [],
        "notes": notes(found.notes) if found else [],
        "verdict": found.verdict if found else None,
        "signature": found.signature.document() if found else None,
        "error": error,
        "result": found.result.value if found else None,
        "largest_difference": _agreement(found.agreement) if found else None,
        "computer": dict(zip(("then", "now"), map(dict, found.computed_on), strict=True)) if found else None,
        "within": _within(found.within) if found and found.within else None,
    }


def _within(of: Within) -> dict[str, Any]:
    """Every figure that is off, and the one that is furthest off in its uncertainty."""
    return {
        "limit": of.limit,
        "by": dict(of.by),
        "largest": _moved(of.largest) if of.largest else None,
        "figures": [_moved(figure) for figure in of.moved],
    }


def _moved(of: Moved) -> dict[str, Any]:
    return {
        "part": of.part,
        "place": of.place,
        "stored": of.stored,
        "again": of.again,
        "uncertainty": of.uncertainty,
        "of_uncertainty": of.of_uncertainty,
    }


def document_of_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """The same of a row that an earlier run has stored, which keeps the first
    difference alone."""
    first = row.get("first_difference")
    known = {key: row.get(key) for key in ("recording", "verdict", "error", "result")}
    return {**document("", None), **known, "differences": [] if first is None else [first]}


def lines_of_row(row: Mapping[str, Any]) -> list[str]:
    """Of a row that an earlier run has stored; none where there is an error."""
    if row.get("error") is not None:
        return []
    count, first = row.get("differences") or 0, row.get("first_difference")
    more = f" (and {count - 1} more)" if count > 1 else ""
    said = {
        Result.SAME_BYTES: "the same, byte for byte",
        Result.SAME_FIGURES: "the same figures",
        Result.WITHIN: "within the share of the uncertainties that was asked for",
    }
    head = f"{row['recording']}: {said.get(Result(row['result']), 'differs')}; verdict {row.get('verdict')}"
    return [head, *([] if first is None else [f"  {first}{more}"])]


def _agreement(of: Agreement) -> dict[str, Any] | None:
    """How far figures are off that are the same; None where all have the same
    bytes."""
    if not of.figures:
        return None
    return {
        "figures": of.figures,
        "of_uncertainty": of.of_uncertainty,
        "relative": of.relative,
        "place": of.worst or None,
    }
