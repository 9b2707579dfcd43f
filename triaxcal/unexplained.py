"""What no effect of the catalogue explains: how much it is, and the best hint at what it may be."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.calibration import Calibration, PoseResult
from triaxcal.conditions import channels_of, with_scale
from triaxcal.distributions import f_sf
from triaxcal.effects.contract import BEFORE, CHANGE, HELD, RUN, SCATTER, SINCE_START, TIME, channel_of
from triaxcal.figures import micro_g, plain, probability
from triaxcal.plan.directions import linear_design
from triaxcal.pure_error import LACK_OF_FIT
from triaxcal.search import FAMILYWISE, NEAR, Nearest, Search

LEAD = 0.01
"""Probability of a pattern as clear as this by chance, the choice among all patterns allowed for, up to which it is a
lead."""
LEADS_MOST = 3
HINT = 0.05
"""Familywise p up to which an effect that was passed over for it is a hint."""
PERIODS = 24
NAMES = {TIME: "the time", RUN: "the recording", HELD: "how long the pose was held"}
NAMES |= {b: f"the pose before, along {b[-1]}" for b in BEFORE}
NAMES |= {c: f"the change since the pose before, along {c[-1]}" for c in CHANGE}
NAMES |= {s: f"the scatter of axis {s[-1]}" for s in SCATTER}


@dataclass(frozen=True)
class Unexplained:
    """What is left. ``p_value`` is the probability of as much by chance; ``rms_g`` its size beyond noise; ``lead`` the
    best hint at what it may be. ``or_spoiled``: it is poses that were left out as spoiled, or an effect.
    """

    significant: bool
    p_value: float | None
    rms_g: float
    lead: str
    or_spoiled: bool = False


@dataclass(frozen=True)
class _Pattern:
    """A pattern of the residuals: its columns (n,q) in g, and how to say it. Of one family the clearest is told."""

    columns: Floats
    text: str
    family: str


def unexplained_of(
    after: Calibration,
    passed_over: Mapping[str, str],
    p: float | None = None,
    nearest: Nearest | None = None,
    hints: Sequence[str] = (),
) -> Unexplained:
    """``passed_over`` are the effects that came near, each with the reason why it was not adopted, and ``nearest`` the
    one that came nearest; ``hints`` what else is known of what is left.

    ``p`` is the probability of what is left by chance (`triaxcal.search.omnibus`): that of its sum of squares where it
    is None.
    """
    p = after.residual.lack_of_fit_p if p is None else p
    if p is None or p >= LACK_OF_FIT:
        return Unexplained(False, p, beyond_noise(after), "")
    return Unexplained(True, p, _size(after), lead(after, passed_over, nearest, hints))


def spoiled_or(
    whole: Calibration, p: float, spoiled: Sequence[PoseResult], names: Sequence[str], left: Unexplained
) -> Unexplained:
    """What the poses leave where those that are ``spoiled`` explain it no better than the effects of these ``names``
    would. ``whole`` is the fit to all poses, ``p`` the probability of what it leaves, which is significant; ``left`` is
    what the others leave without those: where that is significant, neither is all there is."""
    off = " and ".join(f"the pose at {s.pose.at} ({micro_g(s.residual_g, '+')})" for s in spoiled)
    doubt = f"spoiled, or it is {' or '.join(names)}, which would explain as much"
    if left.significant:
        return replace(left, lead=f"{left.lead}; besides, left out is {off}: {doubt}")
    return Unexplained(True, p, _size(whole), f"most of it is {off}: {doubt}", or_spoiled=True)


def beyond_noise(after: Calibration) -> float:
    """rms of the residuals beyond noise, in g."""
    residual = after.residual
    return float(np.sqrt(max(residual.rms_g**2 - residual.noise_floor_g**2, 0.0)))


def _size(after: Calibration) -> float:
    """The same where it is significant: one loud pose may hide in the plain rms what the others show, each by its own
    noise."""
    raised = after.residual.noise_floor_g * float(np.sqrt(max(after.inflation**2 - 1, 0.0)))
    return max(beyond_noise(after), raised)


def hints_of(search: Search) -> list[str]:
    """What the poses tell of what is left but by their residuals."""
    out = []
    if search.trends_p() < LEAD:
        out.append(
            "inside the poses |a| moves too, so it goes with the time or something that changes, not the attitude"
        )
    if not search.found.effects:
        limit = search.against_trends(search.found) + NEAR
        few = dict.fromkeys(m.effects[0].name for m in search.untestable() if search.against_trends(m) < limit)
        if few:
            out.append(f"these poses are too few to test {', '.join(few)}")
    return out


def lead(
    after: Calibration, passed_over: Mapping[str, str], nearest: Nearest | None = None, hints: Sequence[str] = ()
) -> str:
    """The patterns that the residuals show beyond chance: on the sphere, in time, in one pose, in a channel."""
    used = [p for p in after.poses if p.used]
    worst = max(used, key=lambda p: abs(p.studentized))
    parts = []
    if worst.studentized**2 > 0.5 * sum(p.studentized**2 for p in used):
        parts.append(f"most of it is one pose, at {worst.pose.at} ({micro_g(worst.residual_g, '+')}): was it still?")
    parts += [*_clear_patterns(after, used, _patterns(after, used)), *hints]
    inside = {effect.name for effect, _ in after.sensor.effects}
    near = {name: why for name, why in passed_over.items() if _is_hint(why) and name not in inside}
    if nearest is not None and nearest.p_value < FAMILYWISE:
        why = f"p {probability(nearest.p_value)}, but it explains too little for what it adds"
        near.setdefault(nearest.effect, why)
    parts += [f"the nearest effect is {name}, not adopted: {why}" for name, why in list(near.items())[:2]]
    others = "" if len(used) == len(after.poses) else "but for the poses that were left out, "
    return "; ".join(parts) or f"{others}no candidate comes near, and no pose, pattern or channel stands out"


def _is_hint(why: str) -> bool:
    """Whether the reason why an effect was passed over is any other than that it may well be chance."""
    return not why.startswith("p ") or float(why.removeprefix("p ").removeprefix("< ")) < HINT


def _clear_patterns(after: Calibration, used: Sequence[PoseResult], patterns: Sequence[_Pattern]) -> list[str]:
    error = np.array([p.standard_error_g for p in used])
    y = np.array([p.residual_g for p in used]) / error
    model, _ = np.linalg.qr(_fitted(after, used) / error[:, None])
    free = len(y) - model.shape[1] - sum(len(effect.shape) for effect, _ in after.sensor.effects)
    y = y - model @ (model.T @ y)
    total = float(y @ y)
    found: dict[str, tuple[float, str]] = {}
    for pattern in patterns:
        columns = pattern.columns / error[:, None]
        size = np.linalg.norm(columns, axis=0)
        columns = columns[:, size > 0] / size[size > 0]
        left, singular, _ = np.linalg.svd(columns - model @ (model.T @ columns), full_matrices=False)
        basis = left[:, singular > 0.05]
        q, rest = basis.shape[1], free - basis.shape[1]
        if not q or rest < 2:
            continue
        share = float(np.sum((basis.T @ y) ** 2)) / total
        p = float(f_sf(share / q / max((1 - share) / rest, 1e-12), q, rest)) * len(patterns)
        if p < min(LEAD, found.get(pattern.family, (LEAD, ""))[0]):
            found[pattern.family] = (p, f"{share:.0%} of it goes with {pattern.text}")
    return [text for _, text in sorted(found.values())[:LEADS_MOST]]


def _fitted(after: Calibration, used: Sequence[PoseResult]) -> Floats:
    """(n,9+p) what the model can make of the magnitude: the nine parameters, and the effects in it."""
    direction = np.array([p.direction for p in used])
    poses = [p.pose for p in used]
    held = after.conditions_of(poses)
    at = after.sensor.radius(np.array([p.mean for p in poses]), held)
    effects = [np.einsum("ni,nip->np", at.by_v, effect.basis(at.s, held)) for effect, _ in after.sensor.effects]
    return np.concatenate([linear_design(direction, direction), *effects], axis=1)


def _patterns(after: Calibration, used: Sequence[PoseResult]) -> list[_Pattern]:
    direction = np.array([p.direction for p in used])
    poses = [p.pose for p in used]
    out = [
        _Pattern(_monomials(direction, 3), "an odd pattern on the sphere (degree 3, as of second order)", "odd"),
        _Pattern(_monomials(direction, 4), "an even pattern on the sphere (degree 4, as of third order)", "even"),
    ]
    sensor = after.sensor
    held = with_scale(channels_of(poses), poses, sensor.scale_factor, sensor.bias)
    for name, values in held.items():
        if name != SINCE_START and np.ptp(values) > 1e-9 * np.max(np.abs(values)):
            scaled = (values - values.mean()) / np.ptp(values)
            said = NAMES.get(name, channel_of(name))
            out.append(_Pattern(scaled[:, None], said, name))
            out.append(_Pattern(scaled[:, None] * direction, f"{said}, as a bias", name))
    t, n = held[TIME], len(poses)
    slow, long, short = (0.8, max(n / 2.5, 2.0)), (0.8, 10.0), (2.0, 10.0)
    axes = [(axis, direction[:, i : i + 1]) for i, axis in enumerate("xyz")]
    swing, wave = "a swing in time with a period of {} s", "a wave along the output of {}, {{}} g long"
    out += _waves([(t, np.ones((n, 1)))], "time", swing, slow, digits=3)
    out += _waves([(t, direction)], "time", f"{swing}, as a bias", slow, digits=3)
    for axis, own in axes:
        out += _waves([(t, own)], "time", f"{swing}, as a bias of axis {axis}", slow, digits=3)
        out += _waves([(own[:, 0], own)], "wave", wave.format(f"axis {axis}"), long, digits=2)
    # Longer ones along all axes make any even pattern.
    out += _waves([(own[:, 0], own) for _, own in axes], "wave", wave.format("every axis"), short, digits=2)
    return out


def _waves(
    parts: Sequence[tuple[Floats, Floats]], family: str, text: str, cycles: tuple[float, float], digits: int
) -> list[_Pattern]:
    """Sines of many periods, from the first number of ``cycles`` in the whole range to the last, together of all
    ``parts``: along x (n,), of the sizes (n,m). Each counts as chosen among them."""
    whole = max(float(np.ptp(x)) for x, _ in parts) or 1.0
    out = []
    for count in np.geomspace(*cycles, PERIODS):
        angles = [(2 * np.pi * count * x[:, None] / whole, size) for x, size in parts]
        columns = np.concatenate([turn(angle) * size for angle, size in angles for turn in (np.sin, np.cos)], axis=1)
        out.append(_Pattern(columns, text.format(plain(whole / count, digits)), family))
    return out


def _monomials(a: Floats, degree: int) -> Floats:
    """(n,m) all products of ``degree`` components of directions (n,3): what is left of them beside the nine parameters
    are the harmonics of that degree."""
    powers = [(i, j, degree - i - j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    return np.array([a[:, 0] ** i * a[:, 1] ** j * a[:, 2] ** k for i, j, k in powers]).T
