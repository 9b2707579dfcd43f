"""Caveats of a result: doubts about the unit's identity, assumptions behind the
budget, blind searches, and the residual of each way of correcting a unit."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import triaxcal as tc

UNIT = "unit"
"""Under ``doubts`` of a document: the recordings, or a calibration and a recording,
may belong to different units."""


def unit_questions(doubts: Iterable[str]) -> list[str]:
    """Questions to the reader that follow from the ``doubts`` of a document."""
    return ["is it the same unit?"] * (UNIT in doubts)


# Sentences that console and report add to the metrology's results.


def assumption(effects: Collection[str], reference_unit: str = "g") -> str:
    """The assumption behind a budget line about these effects; empty if there is
    none."""
    sizes = {
        "temperature_bias": f"bias {{:g}} {'µg/K' if reference_unit == 'g' else 'ppm of the reference per K'}",
        "temperature_scale_factor": "scale factor {:g} ppm/K",
    }
    assumed = " and ".join(
        text.format(1e6 * tc.uncertainty.SENSITIVITY_PER_K[e]) for e, text in sizes.items() if e in effects
    )
    if not assumed:
        return ""
    return (
        f"as far as the poses do not tell, this rests on an assumption, typical of data sheets: {assumed}; diagnose of "
        "a recording in which the temperature swings more would tell"
    )


def none_could_show(blind_to: Collection[str]) -> bool:
    """Whether a search without findings was blind: it could fully detect no effect of
    direction or time, the covariates that every recording has."""
    return {e.name for e in tc.effects.CATALOGUE if set(e.needs) <= {*tc.effects.CLOCKS, *tc.effects.BEFORE}} <= set(
        blind_to
    )


# Residual of each way of correcting a unit: the linear model alone, its registers,
# its registers and a host.

REGISTERS, HOST, PROCESS = "registers", "host", "process"


@dataclass(frozen=True)
class CorrectionOption:
    """One way of correcting a unit.

    ``corrected_by`` correct ``terms``, in the order in which they act; ``residual``
    remains in the poses of the fit. With `PROCESS` among them, the effects of the
    recording alone are assumed to be absent from the next recording.
    """

    corrected_by: tuple[str, ...]
    terms: tuple[str, ...]
    residual: tc.estimate.Residual


def correction_options(
    loop: tc.diagnosis.Loop, held: tc.estimate.Calibration | None = None
) -> tuple[CorrectionOption, ...]:
    """The ways of correcting a unit, from the fewest terms to the most.

    ``held`` is the calibration for which the device has registers. If it is None,
    the host corrects everything, the linear part too.
    """
    whole = [effect for effect, _ in loop.after.sensor.effects]
    unit, process = _of_unit(loop.after), (PROCESS,) if any(map(is_passing, whole)) else ()
    first = HOST if held is None else REGISTERS
    out = [CorrectionOption((first,), ("linear",), loop.before.residual)] if whole else []
    if held is None:
        return (*out, CorrectionOption((first, *process), unit, loop.after.residual))
    in_registers = _of_unit(held)
    if process or len(in_registers) > 1 or not out:
        out.append(CorrectionOption((first, *process), in_registers, held.residual))
    if set(unit) - set(in_registers):
        out.append(CorrectionOption((first, HOST, *process), unit, loop.after.residual))
    return tuple(out)


def is_passing(effect: tc.effects.Effect) -> bool:
    """Whether an effect belongs to the recording and not to the unit, so that no
    register can hold it."""
    rate = tc.effects.rate_of("")
    return bool(effect.needs) and all(n in tc.effects.DERIVED or n.endswith(rate) for n in effect.needs)


def _of_unit(c: tc.estimate.Calibration) -> tuple[str, ...]:
    return ("linear", *(effect.name for effect, _ in c.sensor.effects if not is_passing(effect)))
