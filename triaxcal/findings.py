"""What the loop found and what to do about it, in words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from triaxcal.calibration import Calibration
from triaxcal.effects.contract import SCATTER, TIME, Effect, channel_of, is_derived, rate_of
from triaxcal.effects.part import Part
from triaxcal.effects.plugins import package_of
from triaxcal.figures import micro_g, probability, the_poses
from triaxcal.leads import TOWARDS
from triaxcal.poses.pose import Began
from triaxcal.search import FAILED, FAMILYWISE, Search, alternatives, compared, telling_apart
from triaxcal.search.alternatives import instead_of
from triaxcal.unexplained import MORE, NAMELESS, UNTESTED, Unexplained

SPOILED_POSES = "spoiled poses"
OTHERS = ("", "the other effect", "the other two effects", "the other three effects", "the other four effects")


@dataclass(frozen=True)
class Finding:
    """An effect that the data show. ``coefficients`` name → (value, standard error, unit).

    ``verdict`` is "adopted" where the name is earned, "confounded" where ``alternatives``, or poses that something
    ``spoiled``, fit as well, or where it is not put to the test (``coincidence``).
    """

    effect: str
    verdict: str
    p_value: float
    coefficients: Mapping[str, tuple[float, float | None, str]]
    alternatives: tuple[str, ...]
    reason: str
    remedy: str
    step: Calibration
    """The model with this effect and those before it."""
    apart: tuple[str, ...] = ()
    """What to record so as to tell it from its alternatives."""
    spoiled: tuple[Began, ...] = ()
    """When poses began that would do as well as any effect, were they spoiled."""
    coincidence: float | None = None
    """Probability that one effect or another would have explained as much, whatever it was, 1 where |a| goes inside the
    poses otherwise because of this one; None where it is small."""
    instead: Mapping[str, tuple[Effect, ...]] = field(default_factory=dict, repr=False)
    """The effects of the model with each alternative in its place, by name."""

    @property
    def rivals(self) -> tuple[str, ...]:
        """What would do as well: the alternatives, that poses are spoiled, that it is nothing known."""
        others = {SPOILED_POSES: bool(self.spoiled), NAMELESS: self.coincidence is not None}
        return (*self.alternatives, *(name for name, open_ in others.items() if open_))


def finding_of(
    search: Search,
    effect: Effect,
    pair: tuple[Calibration | None, Calibration],
    after: Calibration,
    step: Calibration,
    rivals: Sequence[Sequence[Effect]],
    spoiled: Sequence[Began],
    chance: float,
) -> Finding:
    """The ``pair`` are the model that lacks this effect alone (None where the poses cannot carry it), and that with all
    effects found; ``after`` is what is handed on. ``rivals`` explain as much with other poses left out, the poses
    ``spoiled`` without any effect; ``chance`` is its coincidence (`triaxcal.search`)."""
    found = alternatives(search, effect, search.found)
    for rival in rivals:
        names = instead_of(search, effect, rival)
        model = search.model(rival) if names else None
        found |= {name: model for name in names if model and name not in found}
    others = [e for e in search.found.effects if e is not effect]
    p = search.earned(effect, others)
    reason = f"{_fall(*pair, len(others))}familywise p {probability(p)}"
    if isinstance(effect, Part) and not effect.selects:
        reason += f"; of its coefficients these poses show only {effect.formula}, which they share in that proportion"
    if found:
        reason += f"; {', '.join(found)} would do as well on these poses"
    if spoiled:
        reason += f"; that something spoiled {the_poses(spoiled)} would {'also ' * bool(found)}do as well"
    untested = chance >= FAMILYWISE
    if untested and chance < FAILED:
        reason += f"; {UNTESTED.format(probability(chance))} (limit {FAMILYWISE:g})"
    elif untested:
        reason += "; inside the poses |a| does not move as what was found foretells"
    more = [MORE if chance < FAILED else TOWARDS[TIME]] if untested else []
    apart = dict.fromkeys(telling_apart(search, effect, found)) if found else ()
    floor = pair[1].residual.noise_floor_g
    if not effect.coefficients[0].unit.startswith("g"):
        floor /= after.reference  # the effect is a share of the magnitude
    return Finding(
        effect=effect.name,
        verdict="confounded" if found or spoiled or untested else "adopted",
        p_value=p,
        coefficients=after.coefficients_of(effect.name),
        alternatives=tuple(found),
        reason=reason,
        remedy=effect.advice(_largest(after, effect), floor),
        step=step,
        apart=(*([f"take {the_poses(spoiled)} again"] if spoiled else []), *apart, *more),
        spoiled=tuple(spoiled),
        coincidence=chance if untested else None,
        instead={name: model.effects for name, model in found.items()},
    )


def _largest(c: Calibration, effect: Effect) -> float:
    """The largest coefficient of an effect, by its amount."""
    return max(float(np.max(np.abs(q))) for e, q in c.sensor.whole.effects if e.name == effect.name)


def _fall(without: Calibration | None, complete: Calibration, others: int) -> str:
    """What an effect does to the cross-validated error; empty where that is not known."""
    found = None if without is None else compared(complete, without)
    if found is None or found.old_g is None or found.new_g is None:
        return ""
    beside = f", beside {OTHERS[others]}," if others else ""
    which = "which" if len(found.but) == 1 else "each of which"
    but = f", but for {the_poses(p.pose.began for p in found.but)}, {which} alone carries a coefficient," * bool(
        found.but
    )
    return (
        f"with it{beside} the cross-validated error{but} {'falls' if found.new_g < found.old_g else 'goes'} from "
        f"{micro_g(found.old_g)} to {micro_g(found.new_g)} (noise floor {micro_g(complete.residual.noise_floor_g)}); "
    )


def description_of(smooth: Calibration, without: Calibration, p_value: float | None = None) -> Finding:
    """The empirical term, the last effect of ``smooth``; ``p_value`` is that of what it describes."""
    effect = smooth.sensor.effects[-1][0]
    return Finding(
        effect=effect.name,
        verdict="adopted",
        p_value=without.residual.lack_of_fit_p or 0.0 if p_value is None else p_value,
        coefficients=smooth.coefficients_of(effect.name),
        alternatives=(),
        reason=(
            "asked for: a smooth term that describes what is left and explains nothing; with it the cross-validated "
            f"error falls from {micro_g(without.residual.cross_validated_rms_g)} to "
            f"{micro_g(smooth.residual.cross_validated_rms_g)}"
        ),
        remedy=effect.remedy,
        step=smooth,
    )


def why_not_shown(search: Search, effect: Effect) -> str:
    """Why poses cannot show an effect in full."""
    known = search.problem.channel_reference
    for name in effect.needs:
        rate, channel = name.endswith(rate_of("")), channel_of(name.removesuffix(rate_of("")))
        logged = any(channel in p.channels for p in search.poses)
        if name not in known and (rate or not is_derived(name)) and not (rate and logged):
            return f"channel {channel} is not logged{' in every pose' if logged else ''}"
        if name not in known:
            return f"how fast {channel} changes is not known in every pose" if rate else f"{name} is not known"
        if name in search.still:
            if name in SCATTER:
                return "the readings scatter alike in all poses"
            return f"{channel} changes no faster in one pose than in another" if rate else f"{channel} stood still"
    if effect.needs:
        return "too few poses, or what it goes with moved along with their directions"
    return "the poses point in too few directions"


def advice_of(
    findings: Sequence[Finding],
    unexplained: Unexplained,
    undescribed: str,
    blind: Mapping[str, str],
    faulty: Mapping[str, str],
) -> list[str]:
    """``undescribed`` is why the empirical term that was asked for is not in the model; ``blind`` are effects that do
    not show in full, ``faulty`` those of other packages that were left out, each with the reason why."""
    out = [f"{f.effect}: {f.remedy}" for f in findings if f.verdict == "adopted"]
    said: set[str] = set()
    for f in findings:
        if f.verdict == "confounded":
            new = [line for line in f.apart if line not in said] or f.apart
            out.append(f"{f.effect} cannot be told from {', '.join(f.rivals)} here: {'; '.join(new)}")
            said |= set(f.apart)
    if unexplained.only_inside:
        out.append(f"what was found does not explain how |a| moves inside the poses: {unexplained.towards}")
    elif unexplained.significant and not (unexplained.or_spoiled or unexplained.or_named):
        out.append(f"something is left that no candidate explains: {unexplained.towards}")
    if undescribed:
        out.append(f"empirical: {undescribed}")
    for why in dict.fromkeys(blind.values()):
        names = ", ".join(name for name, reason in blind.items() if reason == why)
        out.append(f"these poses cannot show in full {names}: {why}")
    return out + [f"the effect {name} of {package_of(name)} was left out: {why}" for name, why in faulty.items()]
