"""Who corrects what, in words, and the error that each choice leaves in the
poses of the fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import triaxcal as tc
from triaxcald.doubts import HOST, PROCESS, REGISTERS
from triaxcald.report.document import Finding, Outcome
from triaxcald.report.registers import Device, passes
from triaxcald.report.stages import Residual, residual_of
from triaxcald.report.untrusted import mapping, texts


@dataclass(frozen=True)
class Choice:
    """``who`` says in words who corrects what."""

    who: str
    residual: Residual


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


_Told = tuple[Sequence[str], Sequence[str], Residual]


def _read(entry: Mapping[str, object]) -> _Told:
    return texts(entry.get("corrected_by")), texts(entry.get("terms")), residual_of(entry) or Residual()


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
        rows.append(([first, *process], held, alone or Residual()))
    if not known or set(unit) - set(held):
        rows.append(([first, HOST, *process] if known else [first, *process], unit, outcome.final))
    return rows


def _who(by: Sequence[str], terms: Sequence[str], registers: Sequence[str], passing: Sequence[str]) -> str:
    parts = []
    if REGISTERS in by:
        parts.append("Registers: " + _named([name for name in terms if name in registers]))
    if HOST in by:
        left = [name for name in terms if name not in registers] if REGISTERS in by else terms
        parts.append(f"{'host' if parts else 'Host or registers'}: " + _named(left))
    if PROCESS in by:
        parts.append("process: free of " + _named(passing))
    return "; ".join(parts)


def _named(terms: Sequence[str]) -> str:
    names = ["linear model" if name == "linear" else tc.text.traces.effect_title(name).lower() for name in terms]
    return ", ".join(names) + (" alone" if names == ["linear model"] else "")
