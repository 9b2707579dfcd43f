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

from triaxcal.interchange.calibration_document import Document
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.state import Held

FORMAT = "triaxcal.outcome/1"
ATTACHMENT, SUFFIX = "outcome.json", ".outcome.json"


class Verdict(StrEnum):
    PASS = "pass"
    FAIL = "fail"
    ABORTED = "aborted"
    NOT_JUDGED = "not_judged"


@dataclass(frozen=True)
class Ending:
    """How the work on one unit ended. ``reason`` is one sentence for people;
    ``exit_code`` as the command owes it."""

    verdict: Verdict
    reason: str
    exit_code: int
    wanted: tuple[str, ...] = ()


@dataclass(frozen=True)
class Papers:
    """What an ending rests on, as documents, as far as there is any.

    ``measured`` are figures of the fit; ``digests`` of what was made, by name,
    None where it was not; ``contents`` the inventory of the recording that the
    outcome is the last part of.
    """

    measured: Document | None = None
    verification: Document | None = None
    registers: Document | None = None
    limits: Mapping[str, float | None] = field(default_factory=dict)
    outside: Sequence[str] = ()
    digests: Mapping[str, str | None] = field(default_factory=dict)
    contents: Document | None = None


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
) -> Document:
    """``ended`` is a time in words; ``supersedes`` the digest of the outcome
    that this one replaces, ``journal`` the path of a journal that is still
    needed, ``forced`` the reason for which doubts were overruled."""
    return {
        "format": FORMAT,
        "unit": unit,
        "serial": serial,
        "station": station,
        "ended": ended,
        "verdict": ending.verdict.value,
        "reason": ending.reason,
        "exit_code": ending.exit_code,
        "device_state": held.state.value,
        "evidence": held.evidence.value,
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


def measured_in(certificate: Mapping[str, Any]) -> Document:
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


def registers_told(p: Provisioning) -> Document:
    """What was done to the registers, and what an undoing would bring back."""
    return {
        "differing": list(p.differing),
        "written": list(p.written),
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
