"""Sentences that console and report add to what the metrology says: what it
assumes, what its shares are shares of."""

from __future__ import annotations

from collections.abc import Collection

from triaxcal.effects import CATALOGUE
from triaxcal.effects.contract import BEFORE, CLOCKS
from triaxcal.uncertainty import SENSITIVITY_PER_K


def assumption(effects: Collection[str], reference_unit: str = "g") -> str:
    """On a line of the budget that assumes the size of these, empty where it
    assumes nothing."""
    said = {
        "temperature_bias": f"bias {{:g}} {'µg/K' if reference_unit == 'g' else 'ppm of the reference per K'}",
        "temperature_scale_factor": "scale factor {:g} ppm/K",
    }
    assumed = " and ".join(text.format(1e6 * SENSITIVITY_PER_K[e]) for e, text in said.items() if e in effects)
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
    return {e.name for e in CATALOGUE if set(e.needs) <= {*CLOCKS, *BEFORE}} <= set(blind_to)
