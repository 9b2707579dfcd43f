"""Endings of a run: verdict, exit code, and the reason in one line."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import triaxcal as tc
from triaxcald import text
from triaxcald.certificate import exceeded
from triaxcald.errors import (
    DEVICE,
    DISK,
    INTERRUPTED,
    exit_code_of,
)
from triaxcald.outcome import Code, Ending, Verdict
from triaxcald.printable import printable_lines
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.registers import ReadingsNotStated
from triaxcald.provision.state import DeviceState
from triaxcald.run.error_reasons import code_of as code_of
from triaxcald.run.error_reasons import reason_of as reason_of
from triaxcald.run.error_reasons import trace_of as trace_of
from triaxcald.station.config import Limits
from triaxcald.verification import OUTSIDE as VERIFIED_OUTSIDE
from triaxcald.verification import WORSE


def judged(certificate: tc.interchange.Document, verification: Mapping[str, Any] | None, limits: Limits) -> Ending:
    """Verdict on the figures of the fit in the ``certificate``, and on the device's
    own output if it was written. Nothing else enters, so an audit gives the same."""
    if outside := certificate["outside"]:
        names = exceeded(certificate["result"]["after"], limits)
        only_cross_validated = names == ["cross_validated_rms_g"]
        code = Code.CROSS_VALIDATED_OUTSIDE if only_cross_validated else Code.FIT_OUTSIDE
        return Ending.of(code, "; ".join(outside))
    if verification is not None and verification["verdict"] in (VERIFIED_OUTSIDE, WORSE):
        worse = verification["verdict"] == WORSE
        code = Code.VERIFICATION_WORSE if worse else Code.VERIFICATION_OUTSIDE
        return Ending.of(code, text.verification_failed(verification))
    checked = limits.verification_rms_g is not None and verification is not None
    if limits.rms_g is None and limits.cross_validated_rms_g is None and not checked:
        return Ending.of(Code.NO_LIMIT, text.NO_LIMIT)
    return Ending.of(Code.WITHIN_LIMITS, text.passed(verification))


def aborted(e: BaseException, p: Provisioning | None) -> Ending:
    """Ending of a run that raised ``e``.

    Once registers were written, every error counts as one of the device, unless the
    device is settled and only the disk failed or the run was interrupted.
    """
    exit_code, code = exit_code_of(e), code_of(e)
    if (trace := trace_of(e)) is not None:
        with suppress(OSError, ValueError):  # a closed standard error
            sys.stderr.write(printable_lines(trace))
    written = p is not None and p.held.state is not DeviceState.UNTOUCHED
    refused = isinstance(e, ReadingsNotStated)  # an earlier provisioning wrote, not this one
    if p is not None and written and not refused and not (p.settled and exit_code in (INTERRUPTED, DISK)):
        exit_code = DEVICE
        if code is None or code.exit_code != DEVICE or not p.settled:
            code = code if code in _WHO_IS_THERE else Code.NOT_SETTLED
    return Ending(Verdict.ABORTED, reason_of(e), exit_code, code, getattr(e, "wanted", ()))


_WHO_IS_THERE = (Code.WRONG_UNIT, Code.TWO_ANSWER)
"""Codes that are more specific than "the device is not settled"."""
