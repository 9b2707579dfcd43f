"""The next measurement: the poses and channels with the largest expected
information."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.effects import TEMPERATURE
from triaxcal.effects.catalogue import EffectFault
from triaxcal.effects.contract import channel_of, is_derived
from triaxcal.evidence.covariances import (
    PoseInputs,
    RowPrecision,
    UnmodelledCovariance,
    UnmodelledKind,
    reading_geometry,
)
from triaxcal.evidence.likelihood import Evidence, SetEvidence
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.mixture import Components, components
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.terms import Term
from triaxcal.model.directions import cube_directions, elsewhere
from triaxcal.poses.pose import Pose
from triaxcal.rounding import reaches

# The predictive distribution of poses to come: a normal distribution for each likely
# set, conditional on all rows.


@dataclass(frozen=True)
class Hypothesis:
    """A hypothesis: the effects that act, the outliers, the pose from which on there
    is another unit (−1: none), and the kind of unmodelled part (None: none)."""

    names: frozenset[str]
    outliers: frozenset[int]
    change_point: int
    unmodelled: UnmodelledKind | None


@dataclass(frozen=True, eq=False)
class Predictive:
    """The likeliest sets, each with one part of the evidence and one choice of sizes:
    C cells of H hypotheses. ``weight`` (C,) sums to one and gives each hypothesis its
    share of the probability of all that have a cell; ``of`` (C,) is the index of each
    cell's hypothesis in ``hypotheses``."""

    posterior: Posterior
    mixture: Sequence[Components]
    weight: Floats
    hypotheses: Sequence[Hypothesis]
    of: Ints

    @classmethod
    def likeliest(cls, posterior: Posterior, share: float) -> Predictive:
        """The cells with this share of the probability, or all."""
        mixture = components(posterior, share)
        each = [_hypothesis(posterior, cells.found, cells.part) for cells in mixture]
        hypotheses = list(dict.fromkeys(each))
        of = np.repeat([hypotheses.index(h) for h in each], [len(cells.share) for cells in mixture])
        weight = np.concatenate([cells.share for cells in mixture])
        whole = probabilities(posterior)
        wanted = np.array([whole[h] for h in hypotheses])
        # Rescale the cells so that each hypothesis has its full posterior probability.
        weight = weight * (wanted / np.bincount(of, weight))[of]
        return cls(posterior, mixture, weight / weight.sum(), hypotheses, of)

    def with_name(self, name: str) -> Floats:
        """(C,) one where the effect acts, else zero."""
        return np.array([float(name in h.names) for h in self.hypotheses])[self.of]

    def predicted(self, rows: LinearisedData) -> tuple[Floats, Floats]:
        """Mean (C,M) and covariance (C,M,M) of M future rows, over their errors."""
        evidence = self.posterior.evidence
        columns = _columns(evidence, sorted({i for cells in self.mixture for i in cells.found.members}), rows)
        here, there = PoseInputs.of(evidence.rows), PoseInputs.of(rows)
        of_parts: dict[int, tuple[Floats, Floats]] = {}
        mean, covariance = [], []
        for cells in self.mixture:
            kind, tau = evidence.parts[cells.part].kind, evidence.parts[cells.part].tau
            if cells.part not in of_parts:
                of_parts[cells.part] = _unmodelled(kind, tau, here, there, cells.inverse)
            # Kriging for the unmodelled part, T = K(new, old) P, on top of the linear
            # model.
            to, error = of_parts[cells.part]
            design = np.concatenate([rows.linear, columns[:, cells.places]], axis=1) - to @ cells.design
            mean.append(to @ evidence.rows.y + cells.conditional_mean @ design.T)
            covariance.append(cells.noise[:, None, None] * (error + design @ cells.conditional_covariance @ design.T))
        return np.concatenate(mean), np.concatenate(covariance)


def _unmodelled(
    kind: UnmodelledCovariance | None, tau: float, here: PoseInputs, there: PoseInputs, inverse: RowPrecision
) -> tuple[Floats, Floats]:
    """Noise and unmodelled part of the future rows: best linear prediction (M,N) from
    the known rows, with the ``inverse`` of their covariance, and the covariance (M,M)
    of its error."""
    k, n = len(there.error), len(here.error)
    if kind is None:
        return np.zeros((k, n)), np.eye(k)
    crossed = tau**2 * kind.covariance_of(there, here)
    to = crossed @ inverse
    return to, np.eye(k) + tau**2 * kind.covariance_of(there, there) - to @ crossed.T


def probabilities(posterior: Posterior) -> Mapping[Hypothesis, float]:
    """The posterior probability of every hypothesis."""
    out: dict[Hypothesis, float] = defaultdict(float)
    for weight, found in zip(posterior.set_probabilities, posterior.sets, strict=True):
        share = weight * found.part_probabilities
        by_what: dict[UnmodelledKind | None, float] = defaultdict(float)
        for part, p in zip(found.parts, share, strict=True):
            by_what[_what(posterior, part)] += float(p)
        any_of = _hypothesis(posterior, found, 0)
        for what, p in by_what.items():
            out[replace(any_of, unmodelled=what)] += p
    return out


def _hypothesis(posterior: Posterior, found: SetEvidence, part: int) -> Hypothesis:
    terms = (posterior.evidence.terms[i] for i in found.members)
    another = max((term.change_point for term in terms), default=-1)
    return Hypothesis(posterior.names_of(found), posterior.poses_of(found), another, _what(posterior, part))


def _what(posterior: Posterior, part: int) -> UnmodelledKind | None:
    kind = posterior.evidence.parts[part].kind
    return None if kind is None or kind.what is UnmodelledKind.WITHIN_POSE else kind.what


def _columns(evidence: Evidence, members: Sequence[int], rows: LinearisedData) -> Floats:
    """(M,C) derivatives of the future rows by all terms; zero for terms outside
    ``members``, for outliers, and where a foreign effect is not defined."""
    out = np.zeros((len(rows.y), evidence.columns.count))
    known: dict[int, Floats] = {}
    for i in members:
        term = evidence.terms[i]
        out[:, evidence.places([i])] = _of_term(term, rows, known)
    return out


def _of_term(term: Term, rows: LinearisedData, known: dict[int, Floats]) -> Floats:
    if term.change_point >= 0:
        return np.asarray(rows.linear * term.combination)
    if term.effect is None:
        return np.zeros((len(rows.y), term.rank))
    if id(term.effect) not in known:
        try:
            columns = rows.by_coefficients(term.effect)
        except EffectFault:
            columns = np.full((len(rows.y), len(term.effect.coefficients)), np.nan)
        known[id(term.effect)] = np.where(np.isfinite(columns), columns, 0.0)
    return np.asarray(known[id(term.effect)][:, list(term.kept)] * term.combination)


# The possible actions, and the pose that each would give.

UNDECIDED_PROBABILITY = 0.02
"""Names and outliers of smaller probability get no action of their own."""
FAR = 3.0
"""Standard errors from the linear fit from which on a pose is a candidate for
repetition."""
AGAIN = 4
"""Number of poses that are candidates for repetition, the farthest off."""
SAME = float(np.cos(np.radians(5.0)))
"""Cosine of the angle below which two directions count as one, the accuracy of
positioning by hand."""
POSE, MOVED, WAITED = 1.0, 5.0, 3.0
"""Costs: a pose; a pose after a change of a channel that has to settle, which takes
minutes; a pose after a pause, which takes as long but no work."""
FACES = 6
"""Directions for a changed channel or a rested unit: the effect is a bias or a scale
factor of an axis, and a face shows either best."""
BETWEEN = 24
"""Directions farthest from all that were taken and from those of the cube. On faces,
edges and vertices an axis reads only four values; functions that agree there differ
in between."""
LONGER = 4.0
"""Factor on the duration of the poses where each has an error of its own: it halves
the part that averages out."""


class ActionKind(StrEnum):
    POSE = "pose"
    """A pose in a direction, next."""
    REPEAT = "repeat"
    """A pose in the direction of one that was taken."""
    CHANNEL = "channel"
    """A logged channel is moved before the pose, and stays there."""
    PAUSE = "pause"
    """The unit rests before the pose."""
    LOG = "log"
    """An unmodelled drift may follow a channel that is not logged: log it."""
    HOLD = "hold"
    """Each pose has an error of its own: hold all of them longer."""


@dataclass(frozen=True, eq=False)
class Action:
    """``up`` (3,) is the direction of up in the unit's frame, with its ``label`` in a
    plan. ``repeat_of`` is the index of a given pose with the same direction.
    ``channel`` is changed ``by`` so much, in its unit, or is to be logged; empty
    where unknown. The pose begins ``pause_s`` later than otherwise, or lasts
    ``hold_s``. ``information`` is the expected gain in nats, given the previous
    actions."""

    kind: ActionKind
    up: Floats | None = None
    label: str = ""
    repeat_of: int | None = None
    channel: str = ""
    by: float = 0.0
    pause_s: float = 0.0
    hold_s: float = 0.0
    information: float = 0.0

    @property
    def cost(self) -> float:
        return {ActionKind.CHANNEL: MOVED, ActionKind.PAUSE: WAITED}.get(self.kind, POSE)


class Options:
    """The possible actions after the poses of a posterior and those chosen so far,
    each with its pose, of typical duration and noise. Covariates keep their last
    values; the previous pose is the last one."""

    def __init__(self, posterior: Posterior, wanted: Sequence[int]) -> None:
        """``wanted`` are poses to be repeated in any case, even if the unit has to
        leave one for that."""
        self.rows = posterior.evidence.rows
        self.wanted = {int(self.rows.places[i]) for i in wanted}
        # Typical pose: median error, duration and gap.
        poses = self.rows.poses
        self.sensor = self.rows.state.sensor(self.rows.problem)
        self.usual = poses[int(np.argsort(self.rows.error[: self.rows.n], kind="stable")[self.rows.n // 2])]
        self.last = max(poses, key=lambda p: (p.run.index, p.t_s))
        run = sorted((p for p in poses if p.run == self.last.run), key=lambda p: p.t_s)
        self.duration_s = float(np.median(self.rows.duration_s))
        gaps = [after.start_s - before.end_s for before, after in itertools.pairwise(run)]
        self.gap_s = max(float(np.median(gaps)), 0.0) if gaps else 0.0
        self.lasted_s = run[-1].end_s - run[0].start_s
        self.range = {
            channel: _range(poses, channel) for channel in _channels(posterior) if channel in self.last.channels
        }
        self.taken = reading_geometry(self.rows, self.rows.problem.u).up
        self.suspects = list(dict.fromkeys([*wanted, *_suspects(posterior)]))
        cube = cube_directions()
        known = np.concatenate([self.taken, [up for _, up in cube]])
        planned = [(label, up) for label, up in cube if not self._near(up, self.suspects)]
        self.directions: list[tuple[str, Floats, int | None]] = [
            *((_label(self.taken[i]), self.taken[i], int(self.rows.places[i])) for i in self.suspects),
            *((label, up, self._again(up)) for label, up in [*planned, *elsewhere(known, BETWEEN)]),
        ]

    def after(self, chosen: Sequence[Pose]) -> list[tuple[Action, Pose]]:
        """Actions in another direction than the last pose: a unit that does not move
        gives no new pose."""
        last = chosen[-1] if chosen else self.last
        here = reading_geometry(self.rows, last.mean[None]).up[0]
        return [
            (action, pose)
            for action, pose in self._after(last)
            if action.up is None or action.up @ here <= SAME or action.repeat_of in self.wanted
        ]

    def _after(self, last: Pose) -> Iterator[tuple[Action, Pose]]:
        # Plain poses and repetitions; then faces after a pause, or with a changed
        # channel.
        next_s = last.end_s + self.gap_s
        for label, up, again in self.directions:
            yield (
                Action(ActionKind.POSE if again is None else ActionKind.REPEAT, up, label, again),
                self._pose(last, up, next_s),
            )
        for label, up in cube_directions()[:FACES]:
            again = self._again(up)
            if self.lasted_s > 0:
                later = self._pose(last, up, next_s + self.lasted_s)
                yield Action(ActionKind.PAUSE, up, label, again, pause_s=self.lasted_s), later
            for channel, whole in self.range.items():
                for by in (whole, -whole):
                    settled = replace(
                        last,
                        channels={**last.channels, channel: last.channels[channel] + by},
                        rates=dict.fromkeys(last.rates, 0.0),
                    )
                    yield Action(ActionKind.CHANNEL, up, label, again, channel, by), self._pose(settled, up, next_s)

    def _pose(self, last: Pose, up: Floats, start_s: float) -> Pose:
        nothing = np.zeros(3)
        return replace(
            self.usual,
            start_s=start_s,
            end_s=start_s + self.duration_s,
            mean=self.sensor.output(up[None] * self.rows.problem.reference, {})[0],
            creep=nothing,
            slope=nothing,
            channels=last.channels,
            rates=last.rates,
            bends=dict.fromkeys(last.bends, 0.0),
            before=last.mean,
            run=last.run,
        )

    def _again(self, up: Floats) -> int | None:
        """Index, among all given, of the pose with the same direction."""
        near = self._near(up, range(len(self.taken)))
        return int(self.rows.places[near[0]]) if near else None

    def _near(self, up: Floats, among: Sequence[int]) -> list[int]:
        """Indices of the poses with this direction, the nearest first."""
        along = self.taken @ up
        same = [i for i in among if along[i] > SAME]
        return sorted(same, key=lambda i: -along[i])


def _label(up: Floats) -> str:
    """The label of the cube's direction, where it is one."""
    return next((label for label, v in cube_directions() if float(v @ up) > SAME), "")


def _suspects(posterior: Posterior) -> list[int]:
    """Possible outliers, and poses far off the linear fit."""
    rows, outlier = posterior.evidence.rows, posterior.outlier_probabilities
    # Studentized residuals of the linear fit.
    spread = np.sqrt(np.maximum(1 - np.sum(rows.basis**2, axis=1), 0.0))
    off = np.abs(rows.left / np.maximum(spread, 1e-9))[: rows.n]
    found = [i for i in range(rows.n) if outlier[i] >= UNDECIDED_PROBABILITY or off[i] >= FAR]
    return sorted(found, key=lambda i: (outlier[i] < UNDECIDED_PROBABILITY, -off[i]))[:AGAIN]


def _channels(posterior: Posterior) -> list[str]:
    """Logged channels on which a possible effect depends."""
    effects = {t.name: t.effect for t in posterior.evidence.terms if t.effect is not None}
    likely = [effects[name] for name, p in posterior.effect_probabilities.items() if p >= UNDECIDED_PROBABILITY]
    needed = (need for effect in likely for need in effect.needs if not is_derived(need))
    return list(dict.fromkeys(map(channel_of, needed)))


def _range(poses: Sequence[Pose], channel: str) -> float:
    return float(np.ptp([p.channels[channel] for p in poses]))


# Selection of the poses with the largest expected information on the hypotheses
# (Lindley 1956, Ann. Math. Stat. 27:986).

SHARE = 0.99
"""Share of the probability in the predictive cells, if few enough hold it
(`mixture.CELLS`)."""
DRAWS = 256
"""Number of draws of the outcomes: the expected entropy is then known to a few
hundredths."""
LEAST = 0.05
"""Nats per cost of a pose, the change from even odds to two to one; less is not worth
a pose."""
MOST = 6
"""Number of poses in one plan: their outcome is so informative that the draws are too
few for more."""
AT_ONCE = 16
"""Number of poses predicted at once: each cell has a covariance matrix of all their
rows."""
ALIKE = 0.02
"""Relative difference below which actions are equally good and the first is chosen,
as large as the sampling error of the draws: rounding decides nothing."""


@dataclass(frozen=True)
class Expected:
    """The probability of a name ``now``, and its mean after the actions
    ``if_it_acts``."""

    now: float
    if_it_acts: float


@dataclass(frozen=True, eq=False)
class Advice:
    """``actions`` in order. ``entropy`` is that of the hypotheses in nats,
    ``entropy_after`` its mean after the actions; ``expected`` has the undecided
    names, the likeliest first."""

    actions: tuple[Action, ...]
    entropy: float
    entropy_after: float
    expected: Mapping[str, Expected]


def advice(posterior: Posterior, most: int = 3) -> Advice:
    """Up to ``most`` poses (at most `MOST`), and further actions: channels to log,
    longer poses. Raises Refused where the model does not hold in poses to come."""
    if decided(posterior):
        return Advice((), 0.0, 0.0, {})
    most = min(most, MOST)
    future = _PredictiveDraws(Predictive.likeliest(posterior, SHARE))
    # Repeat influential poses first, then select greedily.
    wanted = _influential_poses(posterior)[:most]
    options = Options(posterior, wanted)
    for pose in wanted:
        future.take(options, int(posterior.evidence.rows.places[pose]))
    while len(future.actions) < most and future.take(options):
        pass
    names = {
        name: p
        for name, p in posterior.effect_probabilities.items()
        if UNDECIDED_PROBABILITY < p < 1 - UNDECIDED_PROBABILITY
    }
    expected = {name: Expected(p, future.if_it_acts(name, p)) for name, p in names.items()}
    return Advice((*_other_actions(posterior), *future.actions), future.entropy, future.entropy_after, expected)


def decided(posterior: Posterior) -> bool:
    """Whether the hypothesis of all certain effects and outliers, and nothing else,
    has a probability above one half."""
    certain = posterior.evidence.odds.certain
    names = frozenset(name for group in posterior.certain if len(group) == 1 for name in group)
    outliers = frozenset(i for i, p in enumerate(posterior.outlier_probabilities) if reaches(p, certain))
    settled = probabilities(posterior).get(Hypothesis(names, outliers, -1, None), 0.0)
    return reaches(settled, posterior.evidence.odds.reported)


def _influential_poses(posterior: Posterior) -> list[int]:
    """Poses without which a certain name would not be certain: to be repeated in any
    case."""
    certain = posterior.evidence.odds.certain
    out = []
    for name, p in posterior.effect_probabilities.items():
        without = posterior.leave_one_out(name) if reaches(p, certain) else np.array([p])
        if reaches(p, certain) and not reaches(without.min(), certain):
            out.append(int(np.argmin(without)))
    return list(dict.fromkeys(out))


def _other_actions(posterior: Posterior) -> Iterator[Action]:
    """Actions that are no poses: logging of a channel, and longer poses."""
    if not reaches(posterior.unmodelled_probability, posterior.evidence.odds.reported):
        return
    what = next(what for what in posterior.unmodelled_kind_probabilities if what is not UnmodelledKind.WITHIN_POSE)
    rows = posterior.evidence.rows
    if what is UnmodelledKind.TIME:
        logged = any(TEMPERATURE in p.channels for p in rows.poses)
        yield Action(ActionKind.LOG, channel="" if logged else TEMPERATURE)
    elif what is UnmodelledKind.EACH_POSE:
        yield Action(ActionKind.HOLD, hold_s=LONGER * float(np.median(rows.duration_s)))


class _PredictiveDraws:
    """Draws of the outcomes of the chosen actions: ``shown`` (S,K) rows of draw s,
    those of one pose side by side, under the cell ``truth`` (S,)."""

    def __init__(self, cells: Predictive) -> None:
        self.cells = cells
        # Stratified draws of the true cell, in order of the hypotheses.
        order = np.argsort(cells.of, kind="stable")
        ends = np.cumsum(cells.weight[order])
        self.truth: Ints = order[np.minimum(np.searchsorted(ends, (np.arange(DRAWS) + 0.5) / DRAWS), len(ends) - 1)]
        self.of = np.eye(len(cells.hypotheses))[:, cells.of]
        self.weight = np.tile(cells.weight[:, None], DRAWS)
        """(C,S) of each cell after the actions."""
        self.actions: list[Action] = []
        self.poses: list[Pose] = []
        self.shown: Floats = np.empty((DRAWS, 0))
        self.rng = np.random.default_rng(0)
        self.entropy = self.entropy_after = self._entropy_of(self.weight)

    def take(self, options: Options, again: int | None = None) -> bool:
        """Take the best action, if it is worth its cost; or the best repetition of
        the pose ``again``, whatever its worth."""
        found, gain = options.after(self.poses), list[float]()
        normal = self.rng.standard_normal((DRAWS, 2 if options.rows.slopes else 1))

        def predictions(of: Sequence[tuple[Action, Pose]]) -> _CellPredictions:
            rows = options.rows.of_future_poses([*self.poses, *(pose for _, pose in of)])
            return _CellPredictions(self, rows, normal)

        # Expected information of every candidate: entropy now less mean entropy after.
        for first in range(0, len(found), AT_ONCE):
            some = predictions(found[first : first + AT_ONCE])
            for i in range(len(self.poses), some.rows.n):
                weight = some.weight(i, some.shown_with(i))
                gain.append(self.entropy_after - self._entropy_of(weight))
        # Information per cost; ties go to the first.
        rate = np.array(gain) / [action.cost for action, _ in found]
        if again is not None:
            rate[[action.kind is not ActionKind.REPEAT or action.repeat_of != again for action, _ in found]] = -np.inf
        best = int(np.argmax(rate >= rate.max() - ALIKE * abs(rate.max())))
        if again is None and rate[best] < LEAST:
            return False
        chosen = predictions([found[best]])
        self.shown = chosen.shown_with(len(self.poses))
        self.weight = chosen.weight(len(self.poses), self.shown)
        action, pose = found[best]
        self.actions.append(replace(action, information=gain[best]))
        self.poses.append(pose)
        self.entropy_after -= gain[best]
        return True

    def if_it_acts(self, name: str, p: float) -> float:
        """E[p′²] / E[p′] for the probability p′ after the actions: the mean of p′
        over draws in which the name acts, which are as frequent as p′ states."""
        after = self.cells.with_name(name) @ self.weight
        return float(np.mean(after**2) / np.mean(after)) if after.any() else p

    def _entropy_of(self, weight: Floats) -> float:
        return float(np.mean(_entropy(self.of @ weight)))


class _CellPredictions:
    """Predictions of every cell for the poses of ``rows``, the chosen ones first,
    conditional on ``shown``; ``normal`` (S,r) are standard normal draws, common to
    all."""

    def __init__(self, future: _PredictiveDraws, rows: LinearisedData, normal: Floats) -> None:
        self.future, self.rows, self.normal = future, rows, normal
        self.mean, self.covariance = future.cells.predicted(rows)
        self.noise = np.concatenate([cells.noise for cells in future.cells.mixture])
        self.taken = self._places(range(len(future.poses)))
        # Regression of the candidate rows on the rows shown: Σ₁₁⁻¹ Σ₁₂.
        inner = self.covariance[:, self.taken[:, None], self.taken]
        self.gain = np.linalg.solve(inner, self.covariance[:, self.taken])
        self.off = future.shown - self.mean[future.truth[:, None], self.taken]

    def _places(self, poses: Iterable[int]) -> Ints:
        """Indices of the rows of poses."""
        index = np.array(list(poses), dtype=int)[:, None]
        return np.ravel([index, index + self.rows.n] if self.rows.slopes else index, order="F")

    def _principal(self, covariance: Floats) -> tuple[Floats, Floats]:
        """Variances (C,k) and axes (C,k,k) of predictive covariances (C,k,k); no
        variance is below the noise, whatever rounding leaves."""
        size, axes = np.linalg.eigh(covariance)
        return np.maximum(size, self.noise[:, None]), axes

    def shown_with(self, pose: int) -> Floats:
        """(S,K) the rows shown so far and those of this pose, drawn from the true
        cell."""
        at, truth = self._places([pose]), self.future.truth
        gain = self.gain[:, :, at]
        crossed = self.covariance[:, at[:, None], self.taken]
        own = self.covariance[:, at[:, None], at]
        # Conditional covariance and mean of the new rows, then a normal draw.
        lower = _lower(*self._principal(own - crossed @ gain))[truth]
        mean = self.mean[truth[:, None], at] + np.einsum("sk,skr->sr", self.off, gain[truth])
        return np.concatenate([self.future.shown, mean + np.einsum("srq,sq->sr", lower, self.normal)], axis=1)

    def weight(self, pose: int, shown: Floats) -> Floats:
        """(C,S) weights of the cells after this pose: Bayes' rule with normal
        likelihoods, as one matrix product for all draws."""
        at = np.concatenate([self.taken, self._places([pose])])
        own = self.covariance[:, at[:, None], at]
        size, axes = self._principal(own)
        mean, precision = self.mean[:, at], (axes / size[:, None]) @ axes.transpose(0, 2, 1)
        # −½ (y − μ)ᵀ P (y − μ) − ½ ln|Σ|, expanded in products y yᵀ and y.
        scored = np.einsum("cij,cj->ci", precision, mean)
        pairs = (shown[:, :, None] * shown[:, None]).reshape(len(shown), -1)
        squares = precision.reshape(len(mean), -1) @ pairs.T - 2 * scored @ shown.T
        own = np.log(self.future.cells.weight) + 0.5 * (-np.log(size).sum(axis=1) - np.sum(scored * mean, axis=1))
        log = own[:, None] - 0.5 * squares
        weight = np.exp(log - log.max(axis=0))
        return np.asarray(weight / weight.sum(axis=0))


def _lower(size: Floats, axes: Floats) -> Floats:
    """(C,k,k) Cholesky factors of covariances with these variances and axes, by QR,
    accurate for variances of any ratio."""
    upper: Floats = np.asarray(np.linalg.qr((axes * np.sqrt(size)[:, None]).transpose(0, 2, 1), mode="r"))
    sign = np.where(np.diagonal(upper, axis1=1, axis2=2) < 0, -1.0, 1.0)
    return np.asarray((upper * sign[:, :, None]).transpose(0, 2, 1))


def _entropy(p: Floats) -> Floats:
    """(…) entropy of probabilities (H,…), in nats."""
    return np.asarray(-np.sum(p * np.log(np.maximum(p, 1e-300)), axis=0))
