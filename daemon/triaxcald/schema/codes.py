"""Why the work on a unit ended, in words for programs. Without the models: every
command that may end so needs them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from triaxcald.errors import DEVICE, DISK, DONE, INTERRUPTED, OUTSIDE, REFUSED


class Stage(StrEnum):
    """Stages of the work on a unit, in the order of a run."""

    IDENTITY = "identity"
    """The identity is read."""
    POSES = "poses"
    """Still poses are collected."""
    FITTING = "fitting"
    """The calibration is computed."""
    WRITING = "writing"
    """The registers are written and read back."""
    POWER_OFF = "power_off"
    """The operator switches the supply off."""
    POWER_ON = "power_on"
    """The operator switches the supply on."""
    CHECK_POSES = "check_poses"
    """Check poses are collected, of the device's own output."""
    REPORT = "report"
    """The report is written."""


class Verdict(StrEnum):
    PASS = "pass"
    """Within every limit."""
    FAIL = "fail"
    """Outside a limit, or worse than before without one; there is no certificate,
    and what was written is undone."""
    ABORTED = "aborted"
    """Refused, interrupted or failed."""
    NOT_JUDGED = "not_judged"
    """There is no limit, or nothing was measured."""


class Code(StrEnum):
    """Why the work on a unit ended, for programs. Each code has one verdict and
    one exit code."""

    WITHIN_LIMITS = "within_limits"
    """The fit, and the check poses if there are any, are within the limits."""
    NO_LIMIT = "no_limit"
    """The station has no limit."""
    NOT_CHECKED = "not_checked"
    """No check pose has seen the calibration that the device holds."""
    FIT_OUTSIDE = "fit_outside"
    """The rms of the fit is outside its limit."""
    CROSS_VALIDATED_OUTSIDE = "cross_validated_outside"
    """The cross-validated rms of the fit is outside its limit."""
    VERIFICATION_OUTSIDE = "verification_outside"
    """The device's own output in the check poses is outside its limit."""
    VERIFICATION_WORSE = "verification_worse"
    """Without a limit, the device's own output is worse than before."""
    NO_POSES = "no_poses"
    """No new still pose came."""
    REFUSED = "refused"
    """The data cannot carry the answer."""
    IMPLAUSIBLE = "implausible"
    """The registers hold no calibration under the profile."""
    WRONG_UNIT = "wrong_unit"
    """Another product or serial number answers."""
    SERIAL_TWICE = "serial_twice"
    """Two places report one serial number."""
    TWO_ANSWER = "two_answer"
    """Two units answer at one address."""
    ABSENT = "absent"
    """Nothing answers."""
    LOST = "lost"
    """The unit fell silent."""
    IN_USE = "in_use"
    """Another command has the unit."""
    NOT_SETTLED = "not_settled"
    """The device did not take the calibration, or its state is open."""
    DISK = "disk"
    """The disk is full or fails."""
    MEMORY = "memory"
    """The memory ran out."""
    STOPPED = "stopped"
    """The work was interrupted."""
    KILLED = "killed"
    """The process was killed; the next start in the folder has written the outcome."""
    INTERNAL = "internal"
    """An error of this program."""

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
    **dict.fromkeys((Code.KILLED, Code.INTERNAL), (Verdict.ABORTED, None)),
}  # fmt: skip
