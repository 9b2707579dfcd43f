"""How work ends: the verdict, the exit code it owes, and the reason in one
line."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any

from triaxcald import text
from triaxcald.exit_codes import DEVICE, DISK, DONE, INTERRUPTED, OUTSIDE, exit_code_of
from triaxcald.outcome import Ending, Verdict
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.state import DeviceState
from triaxcald.run.reasons import reason_of as reason_of
from triaxcald.run.reasons import trace_of as trace_of
from triaxcald.station.config import Limits
from triaxcald.verification import OUTSIDE as VERIFIED_OUTSIDE
from triaxcald.verification import WORSE


def judged(outside: Sequence[str], verification: Mapping[str, Any] | None, limits: Limits) -> Ending:
    """The verdict on the figures: on those of the fit, ``outside`` where they
    are outside a limit, and on the device's own output where it was written.
    Nothing else enters, so that an audit comes to the same."""
    if outside:
        return Ending(Verdict.FAIL, "; ".join(outside), OUTSIDE)
    if verification is not None and verification["verdict"] in (VERIFIED_OUTSIDE, WORSE):
        return Ending(Verdict.FAIL, text.verification_failed(verification), OUTSIDE)
    checked = limits.verification_rms_g is not None and verification is not None
    if limits.rms_g is None and limits.cross_validated_rms_g is None and not checked:
        return Ending(Verdict.NOT_JUDGED, text.NO_LIMIT, DONE)
    return Ending(Verdict.PASS, text.passed(verification), DONE)


def aborted(e: BaseException, p: Provisioning | None) -> Ending:
    """Once registers were written any error is one of the device, unless it is
    settled and only the disk failed or somebody interrupted."""
    code = exit_code_of(e)
    if (trace := trace_of(e)) is not None:
        with suppress(OSError, ValueError):  # a closed standard error
            sys.stderr.write(trace)
    written = p is not None and p.held.state is not DeviceState.UNTOUCHED
    if p is not None and written and not (p.settled and code in (INTERRUPTED, DISK)):
        code = DEVICE
    return Ending(Verdict.ABORTED, reason_of(e), code, getattr(e, "wanted", ()))
