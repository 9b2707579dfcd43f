"""The final word on a unit: what a run or a provisioning ends with
(`triaxcal.outcome/1`)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Any

import triaxcal as tc
from triaxcald.errors import DEVICE, DISK, DONE, INTERRUPTED, OUTSIDE, REFUSED
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.state import Held

FORMAT = "triaxcal.outcome/1"
ATTACHMENT, SUFFIX = "outcome.json", ".outcome.json"


class Verdict(StrEnum):
    PASS = "pass"
    FAIL = "fail"
    ABORTED = "aborted"
    NOT_JUDGED = "not_judged"


class Code(StrEnum):
    """Why the work on a unit ended, for programs. Each code has one verdict and
    one exit code."""

    WITHIN_LIMITS = "within_limits"
    NO_LIMIT = "no_limit"
    NOT_CHECKED = "not_checked"
    """The device holds a calibration that no check pose has seen."""
    FIT_OUTSIDE = "fit_outside"
    CROSS_VALIDATED_OUTSIDE = "cross_validated_outside"
    VERIFICATION_OUTSIDE = "verification_outside"
    VERIFICATION_WORSE = "verification_worse"
    NO_POSES = "no_poses"
    REFUSED = "refused"
    IMPLAUSIBLE = "implausible"
    WRONG_UNIT = "wrong_unit"
    SERIAL_TWICE = "serial_twice"
    TWO_ANSWER = "two_answer"
    """Two units answer at one address."""
    ABSENT = "absent"
    LOST = "lost"
    IN_USE = "in_use"
    NOT_SETTLED = "not_settled"
    """The device did not take the calibration, or what it holds is open."""
    DISK = "disk"
    MEMORY = "memory"
    STOPPED = "stopped"
    INTERNAL = "internal"

    @property
    def verdict(self) -> Verdict:
        return _ENDS_WITH[self][0]

    @property
    def exit_code(self) -> int | None:
        """None where the process may have died without one."""
        return _ENDS_WITH[self][1]


_ENDS_WITH: Mapping[Code, tuple[Verdict, int | None]] = {
    Code.WITHIN_LIMITS: (Verdict.PASS, DONE),
    **dict.fromkeys((Code.NO_LIMIT, Code.NOT_CHECKED), (Verdict.NOT_JUDGED, DONE)),
    **dict.fromkeys(
        (Code.FIT_OUTSIDE, Code.CROSS_VALIDATED_OUTSIDE, Code.VERIFICATION_OUTSIDE, Code.VERIFICATION_WORSE),
        (Verdict.FAIL, OUTSIDE),
    ),
    **dict.fromkeys((Code.NO_POSES, Code.REFUSED, Code.IMPLAUSIBLE), (Verdict.ABORTED, REFUSED)),
    **dict.fromkeys(
        (
            Code.WRONG_UNIT, Code.SERIAL_TWICE, Code.TWO_ANSWER, Code.ABSENT, Code.LOST, Code.IN_USE, Code.NOT_SETTLED,
        ),
        (Verdict.ABORTED, DEVICE),
    ),
    **dict.fromkeys((Code.DISK, Code.MEMORY), (Verdict.ABORTED, DISK)),
    Code.STOPPED: (Verdict.ABORTED, INTERRUPTED),
    Code.INTERNAL: (Verdict.ABORTED, None),
}  # fmt: skip


@dataclass(frozen=True)
class Ending:
    """How the work on one unit ended. ``reason`` is one sentence for people,
    ``code`` is for programs: None after bad input, and after a dry run.
    ``exit_code`` as the command owes it."""

    verdict: Verdict
    reason: str
    exit_code: int
    code: Code | None
    wanted: tuple[str, ...] = ()

    @staticmethod
    def of(code: Code, reason: str) -> Ending:
        """With the verdict and the exit code of the code."""
        assert code.exit_code is not None
        return Ending(code.verdict, reason, code.exit_code, code)


@dataclass(frozen=True)
class Papers:
    """What an ending rests on, as documents, as far as there is any.

    ``measured`` are figures of the fit; ``digests`` of what was made, by name,
    None where it was not; ``contents`` the inventory of the recording that the
    outcome is the last part of.
    """

    measured: tc.interchange.Document | None = None
    verification: tc.interchange.Document | None = None
    registers: tc.interchange.Document | None = None
    limits: Mapping[str, float | None] = field(default_factory=dict)
    outside: Sequence[str] = ()
    digests: Mapping[str, str | None] = field(default_factory=dict)
    contents: tc.interchange.Document | None = None


def outcome_document(
    ending: Ending,
    held: Held,
    papers: Papers,
    *,
    unit: str,
    serial: str | None,
    station: str,
    ended: str,
    software: Mapping[str, str],
    supersedes: str | None,
    journal: str | None = None,
    forced: str | None = None,
) -> tc.interchange.Document:
    """``ended`` is a time in words; ``supersedes`` the digest of the outcome
    that this one replaces, ``journal`` the path of a journal that is still
    needed, ``forced`` the reason for which sanity warnings were overruled."""
    return {
        "format": FORMAT,
        "unit": unit,
        "serial": serial,
        "station": station,
        "ended": ended,
        "verdict": ending.verdict.value,
        "code": ending.code.value if ending.code else None,
        "reason": ending.reason,
        "exit_code": None if ending.code is Code.INTERNAL else ending.exit_code,
        "device_state": held.state.value,
        "evidence": held.evidence.value,
        "observed": held.observations,
        "registers": papers.registers,
        "forced": forced,
        "journal": journal,
        "limits": dict(papers.limits),
        "outside": list(papers.outside),
        "measured": papers.measured,
        "verification": papers.verification,
        "wanted_poses": list(ending.wanted),
        "supersedes": supersedes,
        "sha256": dict(papers.digests),
        "software": dict(software),
        "contents": papers.contents,
    }


def measured_in(certificate: Mapping[str, Any]) -> tc.interchange.Document:
    """The figures of the fit, as the certificate has them."""
    result = certificate["result"]
    return {
        "raw_sha256": certificate["recording"]["raw_sha256"],
        "poses": certificate["recording"]["poses"],
        "before": result["before"],
        "after": result["after"],
        "terms": result["calibration"]["terms"],
        "left_to_host": (certificate["registers"] or {}).get("left_to_host", []),
    }


def registers_told(p: Provisioning) -> tc.interchange.Document:
    """What was done to the registers, and what an undoing would bring back."""
    return {
        "differing": list(p.differing),
        "written": list(p.written),
        "marked": list(p.link.probed),
        "stored": p.stored,
        "cut_short_before": p.carried,
        "undoing_failed": p.undoing_failed,
        "steps": list(p.steps),
    }


def digest_of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def latest_of(folder: Path, serial: str | None) -> str | None:
    """The digest of the latest outcome of a unit in the station's folder; None
    where there is none."""
    if serial is None:
        return None
    found: list[tuple[str, str]] = []
    for path in folder.glob(f"*{serial}-*{SUFFIX}"):
        try:
            data = path.read_bytes()
            held = json.loads(data)
        except (OSError, ValueError, RecursionError):  # not one of ours
            continue
        if isinstance(held, dict) and held.get("format") == FORMAT and held.get("serial") == serial:
            found.append((str(held.get("ended", "")), digest_of(data)))
    return max(found)[1] if found else None
