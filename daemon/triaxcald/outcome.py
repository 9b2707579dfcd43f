"""The final word on a unit: what a run or a provisioning ends with
(`triaxcal.outcome/1`)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import triaxcal as tc
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.state import Held
from triaxcald.schema.codes import Code as Code
from triaxcald.schema.codes import Verdict as Verdict
from triaxcald.work import Attempt

if TYPE_CHECKING:  # the models are loaded when a document is made
    from triaxcald.schema.outcome import Measured, RegistersDone

FORMAT: Final = "triaxcal.outcome/1"
ATTACHMENT, SUFFIX = "outcome.json", ".outcome.json"
CERTIFICATE, REPORT = "certificate.json", "report.html"
RUN_RECORD: Final = "run"
"""Metadata record of a recording: the ids of run and tray, and the start."""


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
    """What an ending rests on, as far as there is any.

    ``measured`` are figures of the fit, ``verification`` the document of the
    check poses; ``digests`` of what was made, by name, None where it was not;
    ``contents`` the inventory of the recording that the outcome is the last
    part of.
    """

    measured: Measured | None = None
    verification: tc.interchange.Document | None = None
    registers: RegistersDone | None = None
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
    attempt: Attempt | None = None,
) -> tc.interchange.Document:
    """``ended`` is a time in words; ``supersedes`` the digest of the outcome
    that this one replaces, ``journal`` the path of a journal that is still
    needed, ``forced`` the reason for which sanity warnings were overruled;
    ``attempt`` is None for an outcome as development versions before 0.2 wrote it."""
    from triaxcald.schema.outcome import Contents, LimitsOfOutcome, Outcome, Work
    from triaxcald.schema.verification import Verification

    verification, contents = papers.verification, papers.contents
    told: dict[str, Any] = {}
    if attempt is not None:
        told = {
            "run": attempt.run,
            "started": attempt.started,
            "work": Work.model_validate(attempt.work.document()),
            "recording": attempt.recording,
            "settles": attempt.settles,
        }
    return Outcome(
        format=FORMAT,
        unit=unit,
        serial=serial,
        station=station,
        **told,
        ended=ended,
        verdict=ending.verdict,
        code=ending.code,
        reason=ending.reason,
        exit_code=None if ending.code in (Code.INTERNAL, Code.KILLED) else ending.exit_code,
        device_state=held.state,
        evidence=held.evidence,
        observed=held.observations,
        registers=papers.registers,
        forced=forced,
        journal=journal,
        limits=LimitsOfOutcome.model_validate(papers.limits),
        outside=list(papers.outside),
        measured=papers.measured,
        verification=None if verification is None else Verification.model_validate(verification),
        wanted_poses=list(ending.wanted),
        supersedes=supersedes,
        sha256=dict(papers.digests),
        software=dict(software),
        contents=None if contents is None else Contents.model_validate(contents),
    ).document()


def measured_in(certificate: Mapping[str, Any]) -> Measured:
    """The figures of the fit, as the certificate has them."""
    from triaxcald.schema.outcome import Measured, MeasuredCalibration

    recording, result = certificate["recording"], certificate["result"]
    calibration = result["calibration"]
    return Measured(
        raw_sha256=recording["raw_sha256"],
        poses=recording["poses"],
        before=tc.schema.Residual.model_validate(result["before"]),
        after=tc.schema.Residual.model_validate(result["after"]),
        terms=result["calibration"]["terms"],
        left_to_host=(certificate["registers"] or {}).get("left_to_host", []),
        calibration=MeasuredCalibration.model_validate(
            {**{name: calibration[name] for name in LINEAR}, "standard_error": errors_in(calibration)}
        ),
    )


LINEAR: Final = ("scale_factor", "misalignment", "bias")
"""Coefficients of the linear model."""


def errors_in(calibration: Mapping[str, Any]) -> dict[str, Any]:
    """Standard errors of the linear coefficients."""
    errors = calibration["standard_error"]
    return {name: errors[name] for name in LINEAR}


def registers_told(p: Provisioning) -> RegistersDone:
    """What was done to the registers, and what an undoing would bring back."""
    from triaxcald.schema.outcome import RegistersDone

    return RegistersDone(
        differing=list(p.differing),
        written=list(p.written),
        marked=list(p.link.probed),
        stored=p.stored,
        cut_short_before=p.carried,
        undoing_failed=p.undoing_failed,
        steps=list(p.steps),
    )


def digest_of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
