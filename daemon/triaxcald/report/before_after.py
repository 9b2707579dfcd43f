"""The errors before and after, over the same poses: what tells most first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import triaxcal as tc
from triaxcald.report.document import Outcome
from triaxcald.report.figures import micro_g, p_value, ratio
from triaxcald.report.stages import Residual


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

    def row(name: str, text: Callable[[Residual], str], first: bool = False) -> Row:
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
