"""How work that failed ends: the exit code it owes, and the reason in one line."""

from __future__ import annotations

import asyncio
import sys
import traceback
from contextlib import suppress

from triaxcal.errors import TriaxcalError
from triaxcal_drivers.errors import DriverError
from triaxcald.errors import DaemonError
from triaxcald.exit_codes import DEVICE, DISK, INTERRUPTED, exit_code_of
from triaxcald.outcome import Ending, Verdict
from triaxcald.provision.procedure import Provisioning
from triaxcald.provision.state import DeviceState


def aborted(e: BaseException, p: Provisioning | None) -> Ending:
    """Once registers were written any error is one of the device, unless it is settled and only the disk failed or
    somebody interrupted."""
    code, reason = exit_code_of(e), str(e) or type(e).__name__
    if isinstance(e, asyncio.CancelledError):
        reason = "interrupted"
    elif not isinstance(e, (TriaxcalError, DriverError, DaemonError)):
        reason = f"internal error: {e!r}"
        with suppress(OSError, ValueError):  # a closed standard error
            traceback.print_exception(e, file=sys.stderr)
    written = p is not None and p.held.state is not DeviceState.UNTOUCHED
    if p is not None and written and not (p.settled and code in (INTERRUPTED, DISK)):
        code = DEVICE
    return Ending(Verdict.ABORTED, reason, code, getattr(e, "wanted", ()))
