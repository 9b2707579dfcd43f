"""Close the loop: is anything left beyond noise, which effect is it, and what does the error become with it.

A raw residual correlates with the wrong candidate nearly always, because the fit has absorbed part of the right one.
So the candidates' columns are first projected off those of the model (Frisch–Waugh–Lovell), and what remains is
tested against the noise inside the poses (pure error).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.calibration import Calibration, channels_of, conditions_elsewhere
from triaxcal.effects import CATALOGUE
from triaxcal.effects.contract import TIME, Effect
from triaxcal.errors import InvalidData
from triaxcal.fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.problem import solve
from triaxcal.search import FAMILYWISE, Search
from triaxcal.sensor import Sensor
from triaxcal.start import problem_of, start
from triaxcal.visibility import is_visible

ROUNDS_MOST = 3
"""Effects and spoiled poses are sought in turn so often."""


@dataclass(frozen=True)
class Finding:
    """An effect that the data show. ``coefficients`` name → (value, standard error, unit).

    ``verdict`` is "adopted" where the name is earned, "confounded" where ``alternatives`` fit as well.
    """

    effect: str
    verdict: str
    p_value: float
    coefficients: Mapping[str, tuple[float, float, str]]
    alternatives: tuple[str, ...]
    reason: str
    remedy: str


@dataclass(frozen=True)
class Unexplained:
    """What is left. ``rms_g`` is its size beyond noise; ``lead`` the best hint at what it may be."""

    significant: bool
    p_value: float | None
    rms_g: float
    lead: str


@dataclass(frozen=True)
class HeldOut:
    """Errors of the magnitude in poses that no fit saw, in g."""

    before_rms_g: float
    after_rms_g: float
    noise_floor_g: float
    poses: int


@dataclass(frozen=True)
class Loop:
    """The closed loop: the linear calibration, the extended one, and what lies between."""

    before: Calibration
    after: Calibration
    findings: tuple[Finding, ...]
    unexplained: Unexplained
    held_out: HeldOut | None
    advice: tuple[str, ...]


def diagnose(
    poses: Sequence[Pose],
    *,
    signs: Sequence[float] = (1, 1, 1),
    reference: float = 1.0,
    check: Sequence[Pose] | None = None,
    catalogue: Sequence[Effect] = CATALOGUE,
) -> Loop:
    """Find and add the effects that still poses show beyond the linear model.

    Raises as `triaxcal.fit.fit` does. ``check`` are poses of another recording, for the held-out error.
    """
    aside = _aside(fit(poses, signs=signs, reference=reference))
    if aside:
        # What looks like spoiled poses may be an effect that the linear model lacks.
        whole = _searched(poses, (), signs, reference, catalogue)
        without = _searched(poses, aside, signs, reference, catalogue)
        aside = aside if _criterion(without, len(poses)) < _criterion(whole, len(poses)) else ()
    for _ in range(ROUNDS_MOST):
        found = _searched(poses, aside, signs, reference, catalogue)
        # Beside an effect a spoiled pose may not have shown; with the effect in the model it does.
        sought = fit(poses, signs=signs, reference=reference, effects=found.adopted)
        again = _aside(sought)
        if again == aside or not found.adopted:
            break
        aside = again
    search, before = found.search, found.search.before
    after = search.best = (
        sought
        if _aside(sought) == aside
        else fit(poses, signs=signs, reference=reference, effects=found.adopted, aside=aside)
    )
    blind = tuple(e.name for e in catalogue if e not in search.seen)
    findings = tuple(_finding(search, e, found.adopted) for e in found.adopted)
    unexplained = _unexplained(after, search)
    return Loop(
        before=before.with_blind_to(blind),
        after=after.with_blind_to(blind),
        findings=findings,
        unexplained=unexplained,
        held_out=_held_out(before, after, check) if check is not None else None,
        advice=tuple(_advice(findings, unexplained, blind)),
    )


@dataclass(frozen=True)
class _Found:
    """What the search found with so many poses left out."""

    search: Search
    adopted: list[Effect]
    aside: tuple[int, ...]


def _aside(c: Calibration) -> tuple[int, ...]:
    return tuple(i for i, p in enumerate(c.poses) if not p.used)


def _searched(
    poses: Sequence[Pose],
    aside: tuple[int, ...],
    signs: Sequence[float],
    reference: float,
    catalogue: Sequence[Effect],
) -> _Found:
    before = fit(poses, signs=signs, reference=reference, aside=aside)
    kept = [p for i, p in enumerate(poses) if i not in aside]
    problem = problem_of(kept, signs=signs, reference=reference)
    linear = solve(problem, start(problem, kept, signs), ())
    seen = [e for e in catalogue if is_visible(problem, linear, e)]
    search = Search(problem, kept, signs, reference, seen, before)
    return _Found(search, search.run(linear), aside)


def _criterion(found: _Found, n: int) -> float:
    """Schwarz's: a pose left out costs a parameter, and the choice of it as much again."""
    search = found.search
    chi2 = search.chi2(search.with_effects(search.linear, found.adopted))
    effects = sum(len(e.coefficients) for e in found.adopted)
    return chi2 + (effects + 2 * len(found.aside)) * float(np.log(n))


def _finding(search: Search, effect: Effect, adopted: list[Effect]) -> Finding:
    alternatives = search.alternatives(effect, adopted)
    errors = dict(zip(search.best.parameters, search.best.standard_errors, strict=True))
    values = dict(zip(search.best.parameters, search.best.values, strict=True))
    rest = search.fitted([e for e in adopted if e is not effect])
    without = rest.residual if rest else search.before.residual
    p = search.earned(effect, [e for e in adopted if e is not effect])
    reason = (
        f"with it the cross-validated error falls from {_micro(without.cross_validated_rms_g)} to "
        f"{_micro(search.best.residual.cross_validated_rms_g)} (noise floor "
        f"{_micro(search.best.residual.noise_floor_g)}); familywise p {_probability(p)}"
    )
    if alternatives:
        reason += f"; {', '.join(alternatives)} would do as well on these poses"
    return Finding(
        effect=effect.name,
        verdict="confounded" if alternatives else "adopted",
        p_value=p,
        coefficients={
            c.name: (values[f"{effect.name}.{c.name}"], errors[f"{effect.name}.{c.name}"], c.unit)
            for c in effect.coefficients
        },
        alternatives=alternatives,
        reason=reason,
        remedy=effect.remedy,
    )


def _micro(value: float | None) -> str:
    return "unknown" if value is None else f"{value * 1e6:.3g} µg"


def _probability(p: float) -> str:
    return "below 1e-12" if p < 1e-12 else f"{p:.1e}"


def _unexplained(after: Calibration, search: Search) -> Unexplained:
    residual = after.residual
    p = residual.lack_of_fit_p
    significant = p is not None and p < FAMILYWISE
    beyond = float(np.sqrt(max(residual.rms_g**2 - residual.noise_floor_g**2, 0.0)))
    return Unexplained(significant, p, beyond, _lead(after, search) if significant else "")


def _lead(after: Calibration, search: Search) -> str:
    used = [p for p in after.poses if p.used]
    worst = max(used, key=lambda p: abs(p.studentized))
    squares = np.array([p.studentized**2 for p in used])
    parts = []
    if worst.studentized**2 > 0.5 * squares.sum():
        parts.append(
            f"most of it is one pose, at {worst.pose.start_s:.1f} s ({worst.residual_g * 1e6:+.3g} µg): was it still?"
        )
    for name, why in search.passed_over.items():
        parts.append(f"the nearest effect is {name}, not adopted: {why}")
    miss = np.array([p.residual_g for p in used])
    for name, values in channels_of([p.pose for p in used]).items():
        if np.ptp(values) > 0:
            r = float(np.corrcoef(values, miss)[0, 1])
            if abs(r) > 0.6:
                parts.append(f"it goes with {'time' if name == TIME else name} (correlation {r:+.2f})")
    return "; ".join(parts) or "no candidate comes near, and no pose or channel stands out"


def _held_out(before: Calibration, after: Calibration, check: Sequence[Pose]) -> HeldOut:
    """Raises InvalidData where the check poses lack a channel that the effects need."""
    if not check:
        raise InvalidData("the check recording has no still pose")
    try:
        errors = [
            magnitude_errors(c.sensor, check, channel_reference=c.channel_reference, reference=c.reference)
            for c in (before, after)
        ]
    except InvalidData as e:
        raise InvalidData(f"the check recording: {e}") from e
    return HeldOut(_rms(errors[0][0]), _rms(errors[1][0]), _rms(errors[1][1]), len(check))


def magnitude_errors(
    sensor: Sensor, poses: Sequence[Pose], *, channel_reference: Mapping[str, float], reference: float
) -> tuple[Floats, Floats]:
    """|a| − reference (n,) of poses under a sensor's model, and its standard error (n,) from their noise.

    The poses are of another recording than the model's, whose clock is its own: effects of time count as at their
    reference. Raises InvalidData where a channel that the effects need is missing.
    """
    u = np.array([p.mean for p in poses])
    held = conditions_elsewhere(poses, channel_reference)
    length, by_u = sensor.magnitude(u, held)
    covariance = np.array([p.covariance for p in poses])
    return length - reference, np.sqrt(np.einsum("ni,nij,nj->n", by_u, covariance, by_u))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _advice(
    findings: Sequence[Finding],
    unexplained: Unexplained,
    blind: Sequence[str],
) -> list[str]:
    out = [f"{f.effect}: {f.remedy}" for f in findings if f.verdict == "adopted"]
    for f in findings:
        if f.verdict == "confounded":
            out.append(
                f"{f.effect} cannot be told from {', '.join(f.alternatives)} here: record again with the poses in "
                "another order, some of them repeated at the end, and with more directions"
            )
    if unexplained.significant:
        out.append("something is left that no candidate explains: look at the lead, and record more poses")
    if blind:
        out.append(
            f"these poses cannot show {', '.join(blind)}: too few directions, or no such channel, or it stood still"
        )
    return out
