"""Sentences that console and report add to what the metrology says: what it assumes, what its shares are shares of."""

from __future__ import annotations

from collections.abc import Collection

from triaxcal.effects import CATALOGUE
from triaxcal.effects.contract import BEFORE, CLOCKS
from triaxcal.loop import Loop
from triaxcal.uncertainty import SENSITIVITY_PER_K

SHARE = "% of it goes with "
"""How the lead of what is unexplained tells a share."""


def assumption(effects: Collection[str], reference_unit: str = "g") -> str:
    """On a line of the budget that assumes the size of these, empty where it assumes nothing."""
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


def overlap(lead: str) -> str:
    """On the shares of a lead (`triaxcal.unexplained`), empty where there are not several."""
    if lead.count(SHARE) < 2:
        return ""
    return (
        "each share is of the squares of all that is left, by that pattern alone; patterns overlap, so the shares do "
        "not sum to 100%"
    )


def none_could_show(blind_to: Collection[str]) -> bool:
    """Whether a search that found nothing could hardly find anything: no effect that goes with direction or time, which
    every recording has, shows in full."""
    return {e.name for e in CATALOGUE if set(e.needs) <= {*CLOCKS, *BEFORE}} <= set(blind_to)


def without(loop: Loop) -> str:
    """What the size of what is unexplained is without, where that need not be the cause."""
    return " without what was found" if loop.unexplained.or_named else ""


def nothing_shows(loop: Loop) -> str:
    """What a loop without findings says of the catalogue."""
    certain = " for certain" if loop.unexplained.or_spoiled else ""
    none = "; none could in full, with so few or such poses" if none_could_show(loop.after.blind_to) else ""
    return f"no effect of the catalogue shows{certain}{none}"
