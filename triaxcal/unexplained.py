"""What no effect of the catalogue explains: how much it is, and the best hint at what it may be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.calibration import Calibration, PoseResult
from triaxcal.effects.contract import TIME
from triaxcal.figures import micro_g, moment, probability, the_poses
from triaxcal.leads import AGAIN, LEAD, TOWARDS, Lead, clear_patterns
from triaxcal.poses.pose import Began
from triaxcal.pure_error import LACK_OF_FIT
from triaxcal.search import FAILED, FAMILYWISE, NEAR, Nearest, Search

NAMELESS = "something in no catalogue"
UNTESTED = "of random errors as large as these one effect or another would explain as much with a probability of {}"
MORE = "take more poses, or where the error is small hold them for longer"
HINT = 0.05
"""Familywise p up to which an effect that was passed over for it is a hint."""


@dataclass(frozen=True)
class Unexplained:
    """What is left. ``p_value`` is the probability of as much by chance; ``rms_g`` its size beyond noise; ``lead`` the
    best hint at what it may be, ``towards`` what would tell more. ``or_spoiled``: it is poses that were left out as
    spoiled, or an effect. ``or_named``: it is what the findings name, or something that no effect explains.
    ``only_inside``: the means of the poses are explained, and not how |a| moves inside them.
    """

    significant: bool
    p_value: float | None
    rms_g: float
    lead: str
    or_spoiled: bool = False
    or_named: bool = False
    only_inside: bool = False
    towards: str = ""


def unexplained_of(
    after: Calibration,
    passed_over: Mapping[str, str],
    p: float | None = None,
    nearest: Nearest | None = None,
    hints: Sequence[Lead] = (),
) -> Unexplained:
    """``passed_over`` are the effects that came near, each with the reason why it was not adopted, and ``nearest`` the
    one that came nearest; ``hints`` what else is known of what is left.

    ``p`` is the probability of what is left by chance (`triaxcal.search.omnibus`): that of its sum of squares where it
    is None.
    """
    p = after.residual.lack_of_fit_p if p is None else p
    if p is None or p >= LACK_OF_FIT:
        return Unexplained(False, p, beyond_noise(after), "")
    found = lead(after, passed_over, nearest, hints)
    return Unexplained(True, p, _size(after), found.text, towards=found.towards)


def spoiled_or(
    whole: Calibration,
    p: float | None,
    spoiled: Sequence[PoseResult],
    names: Sequence[str],
    left: Unexplained | None = None,
) -> Unexplained:
    """What the poses leave where those that are ``spoiled`` explain it no better than the effects of these ``names``
    would. ``whole`` is the fit to all poses, ``p`` the probability of what it leaves, which is significant; ``left`` is
    what the others leave without those: where that is significant, neither is all there is."""
    off = " and ".join(f"{the_poses([s.pose.began])} ({micro_g(s.residual_g, '+')})" for s in spoiled)
    doubt = f"spoiled, or it is {' or '.join(names)}, which would explain as much"
    if left is not None and left.significant:
        return replace(left, lead=f"{left.lead}; besides, left out is {off}: {doubt}")
    return Unexplained(True, p, _size(whole), f"most of it is {off}: {doubt}", or_spoiled=True)


def or_named(
    before: Calibration,
    p: float | None,
    untested: Mapping[str, float],
    spoiled: Sequence[Began],
    moving: Unexplained | None = None,
) -> Unexplained:
    """What the poses leave ``before`` the effects in question, with a probability ``p`` by chance, where these explain
    all of it, but need not be what it is: what is ``untested``, each with its coincidence, or that the poses at these
    times are ``spoiled`` would do as well. ``moving`` is what they leave inside the poses."""
    why = []
    if untested:
        chances = [probability(p) for p in untested.values() if p < FAILED]
        chance = f": {UNTESTED.format(' and '.join(chances))} (limit {FAMILYWISE:g})" if chances else ""
        why.append(f"it need not be {' or '.join(untested)}{chance}")
    if not moving and any(p == FAILED for p in untested.values()):
        why.append("inside the poses |a| does not move as is foretold")
    why += [f"that something spoiled {the_poses(spoiled)} would do as well as any effect"] if spoiled else []
    why += [moving.lead] if moving else []
    return Unexplained(True, p, _size(before), "; ".join(why), or_named=True)


def moving_inside(search: Search) -> Unexplained | None:
    """What the model found leaves of the trends inside the poses, where these are beyond chance."""
    p = search.trends_p(search.found)
    if search.trends is None or p >= LEAD:
        return None
    text = "inside the poses |a| moves too, so it goes with the time or something that changes, not the attitude"
    if search.found.effects:
        quiet = search.trends_p(search.linear) >= LEAD
        text = "with the time or something that changes, or with a delay"
        text = f"inside the poses |a| {'does not move as' if quiet else f'moves, {text}, otherwise than'} is foretold"
    rms_g = search.trends.rms_g(search.found.state)
    return Unexplained(True, p, rms_g, text, only_inside=True, towards=TOWARDS[TIME])


def beyond_noise(after: Calibration) -> float:
    """rms of the residuals beyond noise, in g."""
    residual = after.residual
    return float(np.sqrt(max(residual.rms_g**2 - residual.noise_floor_g**2, 0.0)))


def _size(after: Calibration) -> float:
    """The same where it is significant: one loud pose may hide in the plain rms what the others show, each by its own
    noise."""
    noise = after.residual.noise_floor_g
    raised = after.inflation**2 * (noise**2 + after.excess_g**2) - noise**2
    return max(beyond_noise(after), float(np.sqrt(max(raised, 0.0))))


def hints_of(search: Search) -> list[Lead]:
    """What the poses tell of what is left but by their residuals."""
    out = []
    if moving := moving_inside(search):
        out.append(Lead(moving.lead, moving.towards))
    if not search.found.effects:
        limit = search.against_trends(search.found) + NEAR
        few = dict.fromkeys(m.effects[0].name for m in search.untestable() if search.against_trends(m) < limit)
        if few:
            out.append(Lead(f"these poses are too few to test {', '.join(few)}", "take more poses"))
    return out


def lead(
    after: Calibration, passed_over: Mapping[str, str], nearest: Nearest | None = None, hints: Sequence[Lead] = ()
) -> Lead:
    """The patterns that the residuals show beyond chance: on the sphere, in time, in one pose, in a channel."""
    used = [p for p in after.poses if p.used]
    worst = max(used, key=lambda p: abs(p.studentized))
    parts: list[Lead] = []
    if worst.studentized**2 > 0.5 * sum(p.studentized**2 for p in used):
        text = (
            f"most of it is one pose, at {moment(worst.pose.began)} ({micro_g(worst.residual_g, '+')}): was it still?"
        )
        parts.append(Lead(text, f"take {the_poses([worst.pose.began])} again"))
    parts += [*clear_patterns(after, used), *hints]
    inside = {effect.name for effect, _ in after.sensor.effects}
    near = {name: why for name, why in passed_over.items() if _is_hint(why) and name not in inside}
    if nearest is not None and nearest.p_value < FAMILYWISE:
        why = f"p {probability(nearest.p_value)}, but it explains too little for what it adds"
        near.setdefault(nearest.effect, why)
    parts += [Lead(f"the nearest effect is {name}, not adopted: {why}") for name, why in list(near.items())[:2]]
    if not parts:
        others = "" if len(used) == len(after.poses) else "but for the poses that were left out, "
        parts = [Lead(f"{others}no candidate comes near, and no pose, pattern or channel stands out")]
    towards = dict.fromkeys(part.towards for part in parts if part.towards)
    return Lead("; ".join(part.text for part in parts), "; ".join(towards) or AGAIN)


def _is_hint(why: str) -> bool:
    """Whether the reason why an effect was passed over is any other than that it may well be chance."""
    return not why.startswith("p ") or float(why.removeprefix("p ").removeprefix("< ")) < HINT
