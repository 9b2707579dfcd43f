"""When a slot may run: its golden unit has verified there, lately. Pure; the times are
arguments, in microseconds since 1970."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from triaxcald.schema.codes import Verdict
from triaxcald.service.errors import Problem
from triaxcald.station.config import Rules

HOUR_US: Final = 3_600_000_000
CLOCK_STEP_US: Final = 60_000_000
"""By how much a clock may be set back without a doubt in what it said before."""


@dataclass(frozen=True)
class LastCheck:
    """The last verification of the golden unit in a slot: when it ended, and whether it
    was within the limit."""

    ended_us: int
    passed: bool


def is_check(row: Mapping[str, Any]) -> bool:
    """Whether a row of `triaxcal results` is the verification of a golden unit, which
    has check poses and no fit."""
    judged = row["verdict"] in (Verdict.PASS, Verdict.FAIL)
    return judged and row["verification_rms_g"] is not None and row["rms_g"] is None


def problem_of(last: LastCheck | None, now_us: int, every_h: float) -> Problem | None:
    """Why a slot may not run. A verification in the future, where a clock that was
    wrong has put it, says nothing of the present."""
    if last is None or (last.passed and last.ended_us > now_us + CLOCK_STEP_US):
        return Problem.GOLDEN_DUE
    if not last.passed:
        return Problem.GOLDEN_FAILED
    return Problem.GOLDEN_DUE if now_us - last.ended_us > every_h * HOUR_US else None


def blocked_slots(
    rules: Rules, due: Mapping[str, str | None], last: Mapping[str, LastCheck], now_us: int
) -> dict[str, Problem]:
    """Why slots may not run, those that may left out. ``due`` maps the slots of a start
    to their expected serial numbers. The golden unit itself may always run."""
    if rules.golden is None:
        return {}
    others = [slot for slot, serial in due.items() if not rules.of_golden(serial)]
    found = {slot: problem_of(last.get(slot), now_us, rules.golden.every_h) for slot in others}
    return {slot: problem for slot, problem in found.items() if problem is not None}


def worst(blocked: Mapping[str, Problem]) -> Problem | None:
    """The code of a tray with these blocked slots."""
    return max(blocked.values(), key=(Problem.GOLDEN_DUE, Problem.GOLDEN_FAILED).index, default=None)


def next_due_us(rules: Rules, last: Mapping[str, LastCheck], now_us: int) -> int | None:
    """When the next slot becomes due that is not yet."""
    if rules.golden is None:
        return None
    times = [check.ended_us + round(rules.golden.every_h * HOUR_US) for check in last.values() if check.passed]
    return min((time for time in times if time >= now_us), default=None)


def told(rules: Rules, blocked: Mapping[str, Problem]) -> str:
    """Why a tray with these blocked slots does not start, and what to do."""
    assert rules.golden is not None
    golden = rules.golden
    failed = [slot for slot, problem in blocked.items() if problem is Problem.GOLDEN_FAILED]
    due = [slot for slot, problem in blocked.items() if problem is Problem.GOLDEN_DUE]
    why = []
    if failed:
        why.append(f"the golden unit {golden.serial} has failed in {_slots(failed)}")
    if due:
        why.append(
            f"the golden unit {golden.serial} has not verified in {_slots(due)} within the last {golden.every_h:g} h"
        )
    return f"{'; '.join(why)}; scan it for {_slots([*failed, *due])} and start it there first"


def _slots(slots: list[str]) -> str:
    return f"slot{'s' if len(slots) > 1 else ''} {', '.join(slots)}"
