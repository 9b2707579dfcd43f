"""Remarks that put all the rest in doubt, by their names in documents."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import triaxcal as tc

UNIT = "unit"
"""Under ``doubts``: recordings, or a calibration and a recording, may not be of
one unit."""


def doubts_of(doubts: Iterable[str]) -> list[str]:
    """What to ask, each once."""
    return ["is it the same unit?"] * (UNIT in doubts)


# Sentences that console and report add to what the metrology says: what it assumes,
# what its shares are shares of.


def assumption(effects: Collection[str], reference_unit: str = "g") -> str:
    """On a line of the budget that assumes the size of these, empty where it
    assumes nothing."""
    said = {
        "temperature_bias": f"bias {{:g}} {'µg/K' if reference_unit == 'g' else 'ppm of the reference per K'}",
        "temperature_scale_factor": "scale factor {:g} ppm/K",
    }
    assumed = " and ".join(
        text.format(1e6 * tc.uncertainty.SENSITIVITY_PER_K[e]) for e, text in said.items() if e in effects
    )
    if not assumed:
        return ""
    return (
        f"as far as the poses do not tell, this rests on an assumption, typical of data sheets: {assumed}; diagnose of "
        "a recording in which the temperature swings more would tell"
    )


def none_could_show(blind_to: Collection[str]) -> bool:
    """Whether a search that found nothing could hardly find anything: no effect
    that goes with direction or time, which every recording has, shows in
    full."""
    return {e.name for e in tc.effects.CATALOGUE if set(e.needs) <= {*tc.effects.CLOCKS, *tc.effects.BEFORE}} <= set(
        blind_to
    )


# What each way of correcting a unit leaves: the linear model alone, its registers,
# its registers and a host.

REGISTERS, HOST, PROCESS = "registers", "host", "process"


@dataclass(frozen=True)
class Choice:
    """``terms`` are corrected by ``corrected_by``, in the order in which they
    act; ``residual`` is what is left in the poses of the fit. With `PROCESS`
    among them, what belongs to the recording alone is taken as kept out of the
    next.
    """

    corrected_by: tuple[str, ...]
    terms: tuple[str, ...]
    residual: tc.estimate.Residual


def choices_of(loop: tc.diagnosis.Loop, held: tc.estimate.Calibration | None = None) -> tuple[Choice, ...]:
    """From the least to the most. ``held`` is the calibration that the device
    has registers for, None without one: then the host corrects everything, the
    linear part too."""
    whole = [effect for effect, _ in loop.after.sensor.effects]
    unit, process = _of_unit(loop.after), (PROCESS,) if any(map(is_passing, whole)) else ()
    first = HOST if held is None else REGISTERS
    out = [Choice((first,), ("linear",), loop.before.residual)] if whole else []
    if held is None:
        return (*out, Choice((first, *process), unit, loop.after.residual))
    in_registers = _of_unit(held)
    if process or len(in_registers) > 1 or not out:
        out.append(Choice((first, *process), in_registers, held.residual))
    if set(unit) - set(in_registers):
        out.append(Choice((first, HOST, *process), unit, loop.after.residual))
    return tuple(out)


def is_passing(effect: tc.effects.Effect) -> bool:
    """Whether an effect is the recording's rather than the unit's, so that no
    register could hold it."""
    rate = tc.effects.rate_of("")
    return bool(effect.needs) and all(n in tc.effects.DERIVED or n.endswith(rate) for n in effect.needs)


def _of_unit(c: tc.estimate.Calibration) -> tuple[str, ...]:
    return ("linear", *(effect.name for effect, _ in c.sensor.effects if not is_passing(effect)))
