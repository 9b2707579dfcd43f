"""The first line of the page: what came out, in one word and one sentence, and
what speaks against it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import triaxcal as tc
from triaxcald.caveats import HOST, PROCESS, REGISTERS, none_could_show, unit_questions
from triaxcald.report.document import (
    CANDIDATE,
    NO_RESIDUAL,
    Device,
    Finding,
    Outcome,
    faults_of,
    mapping,
    passes,
    residual_of,
    texts,
)
from triaxcald.report.figures import chance, micro_g, p_value, ratio, told

Kind = Literal["within", "outside", "unexplained", "refused"]
_WITHIN, _OUTSIDE, _UNEXPLAINED = "Within limits", "Outside a limit", "Unexplained error left"
_SMOOTHED = "Cause unknown, corrected by a smooth function of the direction"
_SMOOTH = " The correction is a smooth function of the direction, without a physical meaning."
_NO_LIMIT = "No limit was declared; the verdict compares with the noise floor alone."
_WHAT_IS_LEFT = {
    True: "something acts that no known effect describes",
    False: "more is left than the noise of the poses accounts for",
}
"""Of a search for effects, and of a fit."""
_MOST_NAMED = 3
USABLE = "usable"
_CALLS = {USABLE: "Usable", "record_more": "Record more", "investigate": "Investigate"}
"""What to do with the calibration, as documents have it."""
_CONTRADICTED = "The check recording contradicts the calibration"
_ANOTHER = "one calibration does not hold in all poses"


@dataclass(frozen=True)
class LimitCheck:
    """One declared limit in g against what was measured; `passed` is None where
    nothing was measured."""

    name: str
    measured_g: float | None
    limit_g: float | None

    @property
    def passed(self) -> bool | None:
        if self.measured_g is None or self.limit_g is None:
            return None
        return self.measured_g <= self.limit_g


@dataclass(frozen=True)
class Verdict:
    kind: Kind
    headline: str
    sentence: str
    reservations: tuple[str, ...]
    checks: tuple[LimitCheck, ...]


@dataclass(frozen=True)
class FinalWord:
    """A station's verdict on the unit, which knows its own output too, and why."""

    verdict: str
    reason: str


def final_word(papers: Mapping[str, object]) -> FinalWord | None:
    """None where no station has judged."""
    said = mapping(papers.get("outcome"))
    return FinalWord(str(said.get("verdict") or ""), str(said.get("reason") or "")) if said else None


def judge(
    outcome: Outcome,
    certificate_limits: Mapping[str, float | None],
    expanded_g: float | None = None,
    final: FinalWord | None = None,
) -> Verdict:
    """The verdict on an outcome, or the ``final`` one of a station, with what
    the fit says for it and against it.

    Limits are named like the fields of a residual, or `held_out_rms_g`, and
    hold inclusively. A limit that nothing was measured against is never taken
    as kept, and nothing is well whose times or unit are in doubt.
    """
    failed = final is not None and final.verdict == "fail"
    found = _concluded(_judged(outcome, certificate_limits, expanded_g, failed), final)
    if outcome.held_out is not None and outcome.held_out.contradicts and found.kind != "refused":
        kind: Kind = "unexplained" if found.kind == "within" else found.kind
        found = replace(found, kind=kind, headline=f"{_CONTRADICTED}; {found.headline[:1].lower()}{found.headline[1:]}")
    if not (doubts := unit_questions(outcome.doubts)):
        return found
    kind = "unexplained" if found.kind == "within" else found.kind
    return replace(found, kind=kind, headline="; ".join([found.headline, *doubts]))


def _concluded(found: Verdict, final: FinalWord | None) -> Verdict:
    if final is None or found.kind == "refused":
        return found
    because = f"{final.reason[:1].upper()}{final.reason[1:]}."
    if final.verdict == "not_judged":
        headline = f"Not judged; {found.headline[:1].lower()}{found.headline[1:]}"
        kind: Kind = "unexplained" if found.kind == "within" else found.kind
        return replace(found, kind=kind, headline=headline, sentence=f"{because} {found.sentence}")
    declared = tuple(line for line in found.reservations if line != _NO_LIMIT)
    if final.verdict == "fail":
        return replace(found, kind="outside", headline="Failed", sentence=f"{because} {found.sentence}",
                       reservations=declared)  # fmt: skip
    headline = _WITHIN if found.kind == "within" else found.headline
    return replace(found, headline=headline, sentence=f"{because} {found.sentence}", reservations=declared)


def _judged(
    outcome: Outcome, certificate_limits: Mapping[str, float | None], expanded_g: float | None, failed: bool
) -> Verdict:
    checks = tuple(_checks(outcome, {**outcome.limits, **certificate_limits}))
    if outcome.refused is not None:
        return Verdict("refused", "Refused", outcome.refused, (), checks)
    reservations = (*_reservations(outcome, checks), *_beyond_limits(checks, expanded_g, outcome.small))
    errors = f"{_found(outcome)}{_errors(outcome)}"
    open_checks = [check for check in checks if check.passed is None]
    exceeded = [check.name for check in checks if check.passed is False]
    if exceeded:
        return Verdict("outside", _OUTSIDE, f"{', '.join(exceeded)}: over the limit. {errors}", reservations, checks)
    if _unexplained(outcome) or outcome.another_unit:
        kept = "Every declared limit is kept, but " if checks and not open_checks and not failed else ""
        smooth = tc.text.traces.SMOOTH in outcome.averaged
        left = _ANOTHER if outcome.another_unit else _left(outcome)
        unexplained = _SMOOTHED if smooth else _UNEXPLAINED
        headline = _called(outcome, _ANOTHER[0].upper() + _ANOTHER[1:] if outcome.another_unit else unexplained)
        what = f"{left}.{_SMOOTH if smooth and not outcome.another_unit else ''} {errors}"
        if _spoiled(outcome) or _rejected(outcome):
            headline = f"{headline}; poses to take again"
        sentence = f"{kept}{what}" if kept else f"{what[0].upper()}{what[1:]}"
        return Verdict("unexplained", headline, sentence, reservations, checks)
    if open_checks or not (checks or _tested(outcome)):
        return Verdict("unexplained", "Not assessed", f"Too little was measured for a verdict. {errors}",
                       reservations, checks)  # fmt: skip
    headline = _WITHIN if checks else _called(outcome, _without_limits(outcome))
    nothing_sure = outcome.something_is_left or _could_find_nothing(outcome) or bool(outcome.averaged)
    more = outcome.call in _CALLS and outcome.call != USABLE
    uncertain = not checks and (more or _uncertain(outcome) or (not outcome.findings and nothing_sure))
    if _spoiled(outcome) or _rejected(outcome):
        headline, uncertain = f"{headline}; poses to take again", True
    return Verdict("unexplained" if uncertain else "within", headline, errors, reservations, checks)


def _left(outcome: Outcome) -> str:
    """What is unexplained, with its probability and size where they are known."""
    known = outcome.unexplained.lead if outcome.unexplained is not None else ""
    return known or _WHAT_IS_LEFT[outcome.searched]


def _called(outcome: Outcome, headline: str) -> str:
    """With what to do with the calibration, where the document says it."""
    call = _CALLS.get(outcome.call)
    return headline if call is None else f"{call}: {headline[:1].lower()}{headline[1:]}"


def _without_limits(outcome: Outcome) -> str:
    if not outcome.searched:
        return "No lack of fit shows"
    if _could_find_nothing(outcome):
        return "No effect could show in full"
    if not outcome.findings and outcome.averaged:
        return "No effect certain, an average over what may act corrected"
    if not outcome.findings:
        sure = not outcome.something_is_left
        return "Nothing found beyond noise" if sure else "Nothing certain found beyond noise"
    return _effects(outcome)


def _effects(outcome: Outcome) -> str:
    what = "Effect" if len(outcome.findings) == 1 else f"{len(outcome.findings)} effects"
    if all(finding.verdict == CANDIDATE for finding in outcome.findings):
        return f"{what} probable, not certain"
    if outcome.not_corrected:
        return f"{what} found, none corrected"
    return f"{what} found, cause uncertain" if _uncertain(outcome) else f"{what} found and corrected"


def _could_find_nothing(outcome: Outcome) -> bool:
    return outcome.searched and not outcome.findings and none_could_show(outcome.blind_to)


def _spoiled(outcome: Outcome) -> bool:
    return any(fault.spoils for fault in faults_of(outcome.data_quality))


def _rejected(outcome: Outcome) -> int:
    """How many poses the fit left out, to be taken again."""
    return sum(pose.again for pose in outcome.poses)


def _uncertain(outcome: Outcome) -> bool:
    return any(finding.verdict == "confounded" or finding.in_question for finding in outcome.findings)


def _found(outcome: Outcome) -> str:
    """The effects in words, each with its name."""
    unexplained = outcome.unexplained is not None and outcome.unexplained.significant
    if not outcome.searched or not (outcome.findings or _tested(outcome)) or (unexplained and not outcome.findings):
        return ""
    if _could_find_nothing(outcome):
        return "These poses are too few, or such that no effect beyond the linear model could show in full. "
    if not outcome.findings and tc.text.traces.SMOOTH in outcome.averaged:
        return (
            "Something acts that no known effect describes. "
            "The correction is a smooth function of the direction, without a physical meaning. "
        )
    if not outcome.findings and outcome.averaged:
        each = ", ".join(
            f"{tc.text.traces.effect_title(name).lower()} ({chance(p)})" for name, p in outcome.averaged.items()
        )
        else_acts = outcome.unexplained.probability if outcome.unexplained is not None else None
        other = f"; or something that no known effect describes ({chance(else_acts)})" if else_acts is not None else ""
        return (
            f"No effect is likely by itself. The correction averages over what may act, by its probability: {each}"
            f"{other}. "
        )
    if not outcome.findings and outcome.something_is_left:
        return "Something acts beyond the linear model, and these poses do not tell what. "
    if not outcome.findings:
        return "No effect beyond the linear model was found. "
    certain = [_named(finding, outcome) for finding in outcome.findings if finding.verdict != CANDIDATE]
    probable = [_named(finding, outcome) for finding in outcome.findings if finding.verdict == CANDIDATE]
    told_of = (("Found", certain), ("Probable", probable))
    return "".join(f"{what}: {'; '.join(said)}. " for what, said in told_of if said)


def _named(finding: Finding, outcome: Outcome) -> str:
    names = {finding.effect: finding.probability, **{n: finding.probabilities.get(n) for n in finding.alternatives}}
    clauses = []
    for name, probability in list(names.items())[:_MOST_NAMED]:
        known = told(name, outcome.channel_reference)
        title = known.title.lower()
        beside = [] if known.clause == title else [title]
        beside += [] if probability is None else [f"probability {chance(probability)}"]
        clauses.append(f"{known.clause} ({', '.join(beside)})" if beside else known.clause)
    clauses += ["others"] if len(names) > _MOST_NAMED else []
    doubt = "" if len(clauses) == 1 else " – these poses cannot tell which"
    if finding.hangs_on_a_pose:
        doubt = ", but a single pose decides it"
    if finding.verdict == CANDIDATE and finding.in_model:
        doubt += "; it is corrected"
    return " or ".join(clauses) + doubt


def _checks(outcome: Outcome, limits: Mapping[str, float | None]) -> list[LimitCheck]:
    held_out_g = outcome.held_out.after_rms_g if outcome.held_out else None
    measured = {
        "rms_g": ("Residual, rms", outcome.final.rms_g),
        "max_abs_g": ("Residual, largest", outcome.final.max_abs_g),
        "cross_validated_rms_g": ("Cross-validated error, rms", outcome.final.cross_validated_rms_g),
        "held_out_rms_g": ("Held-out error, rms", held_out_g),
    }
    return [LimitCheck(*measured.get(name, (name, None)), limit) for name, limit in limits.items()]


def _tested(outcome: Outcome) -> bool:
    if outcome.unexplained is not None and outcome.unexplained.probability is not None:
        return True
    return outcome.final.lack_of_fit_p is not None


def _unexplained(outcome: Outcome) -> bool:
    if outcome.unexplained is not None:
        return outcome.unexplained.significant
    return lacks_fit(outcome)


def lacks_fit(outcome: Outcome) -> bool:
    """Whether the residuals exceed the noise of the poses."""
    p = outcome.final.lack_of_fit_p
    return p is not None and p < tc.poses.LACK_OF_FIT


def _errors(outcome: Outcome) -> str:
    """The error before and after where both are known, the most honest one
    available, against the floor."""
    name, pairs = "cross-validated", [s.residual.cross_validated_rms_g for s in outcome.stages]
    if outcome.held_out is not None and outcome.held_out.after_rms_g is not None:
        name, pairs = "held-out", [outcome.held_out.before_rms_g, outcome.held_out.after_rms_g]
    if not pairs or pairs[-1] is None:
        name, pairs = "residual", [s.residual.rms_g for s in outcome.stages]
    floor_g = outcome.final.noise_floor_g
    if name == "held-out" and outcome.held_out is not None:
        floor_g = outcome.held_out.noise_floor_g
    after = pairs[-1] if pairs else None
    unit = outcome.small
    text = f"Error of the magnitude, {name}: {micro_g(after, unit)} rms"
    if len(pairs) > 1 and pairs[0] is not None:
        text += f", {micro_g(pairs[0], unit)} before"
    weighted = [s.residual.weighted_rms for s in outcome.stages]
    in_errors = ""
    if weighted and weighted[-1] is not None:
        before = f", {ratio(weighted[0])} before" if len(weighted) > 1 else ""
        in_errors = f"; residuals in standard errors: {ratio(weighted[-1])} rms{before}"
    crossed = "; not cross-validated" if name == "residual" and outcome.averaged else ""
    return f"{text}; noise floor {micro_g(floor_g, unit)}{in_errors}{crossed}."


def _beyond_limits(checks: tuple[LimitCheck, ...], expanded_g: float | None, unit: tc.units.ErrorUnit) -> list[str]:
    """What no residual can show: an error of the reference is the same in every
    pose, and fitted away."""
    least = min((c.limit_g for c in checks if c.limit_g is not None), default=None)
    if least is None or expanded_g is None or expanded_g <= least:
        return []
    return [
        f"The expanded uncertainty of the magnitude, {micro_g(expanded_g, unit)}, is above the limit of "
        f"{micro_g(least, unit)}; residuals alone were judged by it."
    ]


def _reservations(outcome: Outcome, checks: tuple[LimitCheck, ...]) -> list[str]:
    rejected = _rejected(outcome)
    found = []
    if _spoiled(outcome):
        found.append("Poses with faults are excluded, and have to be taken again: see below.")
    if rejected:
        found.append(f"{rejected} of {len(outcome.poses)} poses not used.")
    if not checks:
        found.append(_NO_LIMIT)
    if not _tested(outcome):
        found.append("Whether anything is left beyond noise was not tested.")
    for count, what in ((len(outcome.warnings), "warning"), (len(outcome.data_quality), "remark")):
        if count:
            where = "on the fit" if what == "warning" else "on the quality of the data"
            found.append(f"{count} {what}{'s' if count > 1 else ''} {where}, listed below.")
    return found


# The errors before and after, over the same poses: what tells most first.


@dataclass(frozen=True)
class Row:
    """``before`` is empty where there is one model alone. ``first``: it tells
    more than the rest."""

    name: str
    before: str
    after: str
    first: bool = False


def before_after(outcome: Outcome, unit: tc.units.ErrorUnit) -> tuple[Row, ...]:
    """None where the document holds no residual."""
    if not outcome.stages:
        return ()
    one = outcome.stages[0].residual if len(outcome.stages) > 1 else None

    def row(name: str, text: Callable[[tc.schema.Residual], str], first: bool = False) -> Row:
        return Row(name, "" if one is None else text(one), text(outcome.final), first)

    rows = []
    if held := outcome.held_out:
        before = "" if one is None else micro_g(held.before_rms_g, unit)
        rows.append(Row(f"Held-out error, rms in {held.poses} poses", before, micro_g(held.after_rms_g, unit), True))
    rows += [
        row("Cross-validated error, rms", lambda r: micro_g(r.cross_validated_rms_g, unit), True),
        row("Residuals in standard errors, rms", lambda r: ratio(r.weighted_rms), True),
        row("χ² per degree of freedom", lambda r: ratio(r.reduced_chi2), True),
        row("Lack of fit, p", lambda r: p_value(r.lack_of_fit_p)),
        row("Residual, rms", lambda r: micro_g(r.rms_g, unit)),
        row("Residual, largest", lambda r: micro_g(r.max_abs_g, unit)),
        row("Noise floor", lambda r: micro_g(r.noise_floor_g, unit)),
    ]
    return tuple(rows)


# Who corrects what, in words, and the error that each choice leaves in the poses of
# the fit.


@dataclass(frozen=True)
class Choice:
    """``who`` says in words who corrects what."""

    who: str
    residual: tc.schema.Residual


def choices_in(document: Mapping[str, object], papers: Mapping[str, object], outcome: Outcome) -> tuple[Choice, ...]:
    """From the least to the most; empty where there is nothing to choose.
    Documents from before they had `choices` tell the same by their steps and
    their registers."""
    stated = document.get("choices")
    told = [_read(mapping(entry)) for entry in stated] if isinstance(stated, list) else _reckoned(papers, outcome)
    passing = tuple(name for name, _ in outcome.effects if passes(name))
    rows: list[Choice] = []
    registers: tuple[str, ...] = ("linear",)
    for by, terms, residual in told:
        if tuple(by)[:1] == (REGISTERS,) and HOST not in by:
            registers = tuple(terms)
        rows.append(Choice(_who(by, terms, registers, passing), residual))
    return tuple(rows) if len(rows) > 1 or REGISTERS in {name for by, _, _ in told for name in by} else ()


def who_corrects(finding: Finding, device: Device | None) -> str:
    """In use, after the calibration."""
    if not finding.in_model:
        return "nobody: it is not in the model"
    if finding.effect in {effect.name for effect in tc.effects.BETWEEN_RUNS}:
        return "nobody in advance: it comes anew with every start"
    if passes(finding.effect):
        return "nobody: it depends on how these poses were taken; keep it out of the process"
    if device is None or device.not_written:
        return "the host, or the device where it has registers for it"
    return "the device, by its registers" if finding.effect in device.held else "the host: the device has no registers"


_Told = tuple[Sequence[str], Sequence[str], tc.schema.Residual]


def _read(entry: Mapping[str, object]) -> _Told:
    return texts(entry.get("corrected_by")), texts(entry.get("terms")), residual_of(entry) or NO_RESIDUAL


def _reckoned(papers: Mapping[str, object], outcome: Outcome) -> list[_Told]:
    known = mapping(papers.get("registers"))
    unit = ["linear", *(name for name, _ in outcome.effects if not passes(name))]
    process = [PROCESS] if any(passes(name) for name, _ in outcome.effects) else []
    first = REGISTERS if known else HOST
    rows: list[_Told] = []
    if len(outcome.stages) > 1:
        rows.append(([first], ["linear"], outcome.stages[0].residual))
    held = texts(known.get("terms"))
    if known and (len(held) > 1 or process or not rows):
        alone = residual_of({"rms_g": known.get("rms_g")}) if set(unit) - set(held) else outcome.final
        rows.append(([first, *process], held, alone or NO_RESIDUAL))
    if not known or set(unit) - set(held):
        rows.append(([first, HOST, *process] if known else [first, *process], unit, outcome.final))
    return rows


def _who(by: Sequence[str], terms: Sequence[str], registers: Sequence[str], passing: Sequence[str]) -> str:
    parts = []
    if REGISTERS in by:
        parts.append("Registers: " + _named_terms([name for name in terms if name in registers]))
    if HOST in by:
        left = [name for name in terms if name not in registers] if REGISTERS in by else terms
        parts.append(f"{'host' if parts else 'Host or registers'}: " + _named_terms(left))
    if PROCESS in by:
        parts.append("process: avoid " + _named_terms(passing))
    return "; ".join(parts)


def _named_terms(terms: Sequence[str]) -> str:
    names = ["linear model" if name == "linear" else tc.text.traces.effect_title(name).lower() for name in terms]
    return ", ".join(names) + (" alone" if names == ["linear model"] else "")
