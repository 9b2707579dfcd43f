"""Additional poses: those that a set lacks, and the effect of each addition."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.effects.contract import TIME, Coefficient, Effect
from triaxcal.errors import Refused
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.initial_estimate import rough_directions, started_problem, wanted_for
from triaxcal.estimate.likelihood import Problem, State, linearise, residual_chi2, solve
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.directions import (
    FULL,
    Direction,
    cube_directions,
    dilution,
    directions,
    in_range,
    linear_design,
    most_wanted,
    worst_error,
)
from triaxcal.model.sensor import LINEAR
from triaxcal.planning.design import (
    PLANS_CLOCK,
    VISIBLE,
    OnPlansClock,
    TargetEffects,
    channels_needed,
    combinations,
    profile,
    profile_times,
    target_effects,
)
from triaxcal.poses.covariates import channels_of
from triaxcal.poses.degrees_of_freedom import SIGNIFICANT, within_pose_dof
from triaxcal.poses.pose import Pose

# The noise of a recording: residuals of its poses after the effects of the plan.


@dataclass(frozen=True, eq=False)
class Estimable(Effect):
    """The combinations ``seen`` (p,q) of the coefficients of all ``effects`` that the
    poses can show, as one effect."""

    effects: tuple[Effect, ...]
    seen: Floats = field(repr=False)
    name: str = "estimable"
    remedy: str = ""

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return tuple(Coefficient(f"combination_{k + 1}", "g") for k in range(self.seen.shape[1]))

    @property
    def needs(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(n for e in self.effects for n in e.needs))

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return np.concatenate([e.basis(s, covariates) for e in self.effects], axis=-1) @ self.seen

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return np.concatenate([e.slope(s, covariates) for e in self.effects], axis=-1) @ self.seen


def fit_with_estimable(
    poses: Sequence[Pose], effects: Sequence[Effect], *, signs: Sequence[float], reference: float
) -> Calibration:
    """The fit of the linear model together with the estimable combinations of
    ``effects``, so that these do not count as misfit.

    An effect of a plan's clock has the shape with the best fit. Raises Refused as
    `fit`; InvalidData where a channel that an effect needs is missing.
    """
    sound = [p for p in poses if not p.fault]
    linear = fit(sound, signs=signs, reference=reference)
    if not effects:
        return linear
    # Linearise about the linear fit, with the best shape of each effect.
    problem, begin = started_problem(sound, signs=signs, reference=reference, effects=effects)
    state = solve(problem, begin, ())
    chosen = tuple(_shaped(problem, state, e) for e in effects)
    _, J, s = linearise(problem, state.extended(chosen))
    weighted = J / s[:, None]
    # Fit the combinations that remain visible next to the nine parameters.
    seen, _ = combinations(weighted[:, :LINEAR], weighted[:, LINEAR:], VISIBLE)
    if not seen.shape[1]:
        return linear
    try:
        return fit(sound, signs=signs, reference=reference, effects=[Estimable(chosen, seen)])
    except Refused:  # too far from the linear fit to be reckoned
        return linear


def _shaped(problem: Problem, state: State, effect: Effect) -> Effect:
    if not isinstance(effect, OnPlansClock):
        return effect
    variants = effect.inner.variants(problem.covariates)
    return min(variants, key=lambda e: residual_chi2(linearise(problem, state.extended([e]))))


def noise_of(calibration: Calibration) -> Floats | None:
    """(n,) standard errors of the poses used, as expected for poses to come, in the
    unit of the reference; None where unknown.

    Noise inside the poses with the excess variance, and with a Birge ratio only where
    residuals exceed the noise significantly: since no factor ever lowers the noise,
    raising it for less would be biased.
    """
    used = [p for p in calibration.poses if p.used]
    error = np.array([p.error_g for p in used])
    within = within_pose_dof([p.pose for p in used]) >= 1
    if not within:
        return error if len(used) > len(calibration.parameters) else None
    p = calibration.residual.lack_of_fit_p
    return error if p is not None and p < SIGNIFICANT else error / calibration.birge_ratio


ENOUGH = 1.25
"""Limit of the worst parameter in standard errors of a pose (the 14 poses have 1.06
with equal noise), and of the errors of effects relative to the plan of 26."""
MOST = FULL
"""Largest number of additions: a whole plan would be better than more."""


@dataclass(frozen=True)
class ExistingPoses:
    """The existing poses. ``up`` (n,3); ``weights`` (n,) 1/variance, 1 for a typical
    pose; ``held`` by channel and time (n,), each from −1 to 1 over its range, of
    which ``half`` is the half in the channel's unit; ``axes`` (3,3) the sensitive
    axes, in rows."""

    up: Floats
    weights: Floats
    held: Mapping[str, Floats]
    half: Mapping[str, float]
    axes: Floats = field(default_factory=lambda: np.eye(3))

    @property
    def worst_error(self) -> float:
        """Worst error of the nine parameters in standard errors of a typical pose
        (`worst_error`)."""
        return worst_error(linear_design(self.up, self.up) * np.sqrt(self.weights)[:, None])


@dataclass(frozen=True)
class Addition:
    """One additional pose. ``levels`` of the channels, −1 lowest to 1 highest;
    ``dilution``, ``worst_error`` of the nine parameters and ``errors``
    (`TargetEffects.errors`, per unit of the channels) include this pose and all
    previous ones."""

    label: str
    up: Floats
    levels: Mapping[str, float]
    dilution: float
    worst_error: float
    errors: Mapping[str, Mapping[str, float | None]]


def additions(existing: ExistingPoses, targets: TargetEffects, first: Sequence[Direction] = ()) -> list[Addition]:
    """Poses of the 26 worth adding, best first: ``first`` those for the nine
    parameters, then those for the effects, until these are determined nearly as well
    as by a whole plan, or ``MOST`` are added.

    Each pose is the one with the largest information on the missing quantities.
    """
    return _Adding(existing, targets).run(first)


class _Adding:
    def __init__(self, existing: ExistingPoses, targets: TargetEffects) -> None:
        self.existing, self.targets = existing, targets
        self.channels = channels_needed(targets.effects)
        self.step = 2 / max(len(existing.up) - 1, 1)
        self.rows = targets.rows(existing.up, existing.held)
        self.scaled = targets.rows(existing.up, self._in_units(existing.held))
        self.weights = existing.weights
        self.out: list[Addition] = []

    def run(self, first: Sequence[Direction]) -> list[Addition]:
        for direction in first:
            self._add([direction])
        limit = _as_a_whole_plan(self.targets)
        while self.targets.rank and len(self.out) < MOST and not self._enough(limit):
            self._add(cube_directions())
        return self.out

    def _enough(self, limit: float) -> bool:
        _, singular, _ = np.linalg.svd(self.rows * np.sqrt(self.weights)[:, None])
        whole = len(self.rows) >= self.rows.shape[1] and singular[-1] > 1e-6 * singular[0]
        return bool(whole and self.targets.worst(self.rows, self.weights) <= limit)

    def _add(self, choice: Sequence[Direction]) -> None:
        """Add the best of these directions at the best levels."""
        # All levels of the channels in all directions, at the next time.
        combined = list(itertools.product((-1.0, 0.0, 1.0), repeat=len(self.channels)))
        options = [(d, dict(zip(self.channels, at, strict=True))) for at in combined for d in choice]
        ups = np.array([v for (_, v), _ in options])
        time = 1 + self.step * (len(self.out) + 1)
        held = {clock: np.full(len(options), time) for clock in (TIME, PLANS_CLOCK)} | {
            c: np.array([levels[c] for _, levels in options]) for c in self.channels
        }
        # The largest gain in information; ties go to the first.
        rows = self.targets.rows(ups, held)
        gain = self._gain(rows)
        at = int(np.argmax(gain >= gain.max() - 1e-6))
        (label, up), levels = options[at]
        self.rows = np.concatenate([self.rows, rows[at : at + 1]])
        self.weights = np.append(self.weights, 1.0)
        linear = self.rows[:, :LINEAR] * np.sqrt(self.weights)[:, None]
        scaled = self.targets.rows(ups[at : at + 1], {n: v[at : at + 1] for n, v in self._in_units(held).items()})
        self.scaled = np.concatenate([self.scaled, scaled])
        # Errors of all parameters with the pose added.
        errors = self.targets.errors(self.scaled, self.weights)
        ups = np.concatenate([self.existing.up, *(a.up[None] for a in self.out), up[None]])
        spread = dilution(ups, linear_design(ups, in_range(ups @ self.existing.axes.T)))
        self.out.append(Addition(label, up, levels, spread, worst_error(linear), errors))

    def _in_units(self, held: Mapping[str, Floats]) -> dict[str, Floats]:
        return {name: v * self.existing.half.get(name, 1.0) for name, v in held.items()}

    def _gain(self, rows: Floats) -> Floats:
        """(C,) log factor of the determinant of the effects' information by each row:
        ln(1 + x'M⁻¹x) − ln(1 + x₁'M₁₁⁻¹x₁)."""
        M = (self.rows * self.weights[:, None]).T @ self.rows + 1e-9 * np.eye(rows.shape[1])
        whole = np.einsum("ci,ij,cj->c", rows, np.linalg.inv(M), rows)
        linear = rows[:, :LINEAR]
        part = np.einsum("ci,ij,cj->c", linear, np.linalg.inv(M[:LINEAR, :LINEAR]), linear)
        return np.asarray(np.log1p(whole) - (np.log1p(part) if self.targets.rank else 0.0))


def _as_a_whole_plan(targets: TargetEffects) -> float:
    """Largest allowed standard error of the combinations of coefficients, from a
    whole plan."""
    ups = np.array([v for _, v in directions(FULL)])
    ups = np.concatenate([ups, ups[:1]])
    held = {TIME: profile_times(len(ups))} | profile(channels_needed(targets.effects), len(ups), 3)
    return ENOUGH * targets.worst(targets.rows(ups, held))


@dataclass(frozen=True)
class ChannelRange:
    """Range of a channel in a recording: both None where the recording lacks it, both
    equal where it was static."""

    lowest: float | None = None
    highest: float | None = None


@dataclass(frozen=True)
class MissingPoses:
    """``existing`` are the poses that carry a fit, None where they do not, ``dilution``
    that of the linear fit; ``wanted`` the additional poses; ``noise`` the standard
    error of a typical pose after the effects, relative to the reference; ``now`` the
    effects' standard errors without the additions, in that unit; ``absent`` the
    channels that the recording lacks; ``moves`` the ranges of the channels that have
    to change."""

    existing: ExistingPoses | None
    dilution: float | None
    wanted: list[Addition]
    noise: float | None
    now: Mapping[str, Mapping[str, float | None]]
    absent: tuple[str, ...]
    moves: dict[str, ChannelRange]


def missing_poses(
    poses: Sequence[Pose], effects: Sequence[Effect], *, signs: Sequence[float], reference: float
) -> MissingPoses:
    """Raises Refused where nothing of the effects can be seen at all."""
    asked_for = list(effects)
    logged = channels_of(list(poses)) if poses else {}
    absent = [c for c in channels_needed(asked_for) if c not in logged or not np.isfinite(logged[c]).all()]
    moves = dict.fromkeys(absent, ChannelRange())
    there = [e for e in asked_for if not set(e.needs) & set(absent)]
    targets = target_effects(there)
    if asked_for and not absent and targets.rank == 0:
        raise Refused(f"|a| shows nothing of {', '.join(e.name for e in effects)} beside the nine parameters")
    try:
        linear = fit(poses, signs=signs, reference=reference)
    except Refused as e:
        where = dict(cube_directions())
        up, _ = rough_directions(poses, signs)
        existing = _existing(up, np.ones(len(up)), poses if len(up) else [], moves, channels_needed(targets.effects))
        labels = e.wanted or wanted_for(poses, signs)
        wanted = additions(existing, targets, [(label, where[label]) for label in labels])
        return MissingPoses(None, None, wanted, None, {}, tuple(absent), moves)
    extended = fit_with_estimable(poses, there, signs=signs, reference=reference) if there else linear
    existing, noise = _existing_of(extended, moves, channels_needed(targets.effects))
    first = most_wanted(existing.up, enough=ENOUGH, most=FULL, weights=existing.weights)
    now = targets.errors(
        targets.rows(existing.up, {n: v * existing.half.get(n, 1.0) for n, v in existing.held.items()}),
        existing.weights,
    )
    return MissingPoses(
        existing, linear.dilution, additions(existing, targets, first), noise, now, tuple(absent), moves
    )


def _existing_of(
    c: Calibration, moves: dict[str, ChannelRange], channels: Sequence[str]
) -> tuple[ExistingPoses, float | None]:
    used = [p for p in c.poses if p.used]
    error = noise_of(c)
    typical = None if error is None else float(np.sqrt(np.median(error**2)))
    weights = np.ones(len(used)) if error is None or typical is None else (typical / error) ** 2
    up = np.array([p.direction for p in used])
    existing = _existing(up, weights, [p.pose for p in used], moves, channels)
    return replace(existing, axes=c.sensor.axes), None if typical is None else typical / c.reference


def _existing(
    up: Floats, weights: Floats, poses: Sequence[Pose], moves: dict[str, ChannelRange], channels: Sequence[str]
) -> ExistingPoses:
    """Adds to ``moves`` the channels that stood still."""
    held: dict[str, Floats] = {c: np.zeros(len(up)) for c in channels} | {TIME: profile_times(len(up))}
    half = dict.fromkeys((*channels, TIME), 1.0)
    for name, values in channels_of(list(poses)).items() if poses else ():
        span = float(np.ptp(values))
        if name in half and span > 0:
            half[name] = span / 2
            held[name] = (values - values.min()) / half[name] - 1
            if name != TIME:
                moves[name] = ChannelRange(float(values.min()), float(values.max()))
        elif name in channels:
            moves[name] = ChannelRange(float(values[0]), float(values[0]))
    return ExistingPoses(up, weights, held | {PLANS_CLOCK: held[TIME]}, half)
