"""Which poses next: those with the largest expected information on what acts
(Lindley 1956, Ann. Math. Stat. 27:986).

The information of a pose is by how much it lowers the entropy of the hypotheses
on average, over what the likely sets say that it will show. That average is
taken over draws, as are the probabilities to expect. Poses are chosen one after
the other, each beside those before it; the best is that with the most
information for its cost.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from triaxcal.arrays import Floats, Ints
from triaxcal.effects import TEMPERATURE
from triaxcal.evidence.candidate_actions import LONGER, UNDECIDED_PROBABILITY, Action, ActionKind, Options
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.predictive import Hypothesis, Predictive, probabilities
from triaxcal.evidence.unmodelled_kernels import UnmodelledKind
from triaxcal.poses.pose import Pose
from triaxcal.rounding import reaches

SHARE = 0.99
"""Of the probability that the sets hold which are asked, if so few do
(`evidence.mixture_components.CELLS`)."""
DRAWS = 256
"""Of what the poses may show: an expected entropy is then known to a few
hundredths."""
LEAST = 0.05
"""Nats for the cost of a pose: what takes two hypotheses from even odds to two
to one. Less is not worth a pose."""
MOST = 6
"""Poses at a time: what they show then tells so much that the draws are too few
for one more."""
AT_ONCE = 16
"""Poses that are predicted together: what each cell says of all of them is a
matrix of all their rows."""
ALIKE = 0.02
"""Actions that bring as much but for this share are alike, and the first of
them is chosen: so much is the chance of the draws, and no processor's rounding
decides."""


@dataclass(frozen=True)
class Expected:
    """The probability of a name ``now``, and the mean of what it will be after
    the actions ``if_it_acts``."""

    now: float
    if_it_acts: float


@dataclass(frozen=True, eq=False)
class Advice:
    """``actions`` in the order to take them. ``entropy`` is that of the
    hypotheses, in nats, and ``entropy_after`` its mean after the actions;
    ``expected`` has the names that are open, the likeliest first."""

    actions: tuple[Action, ...]
    entropy: float
    entropy_after: float
    expected: Mapping[str, Expected]


def advice(posterior: Posterior, most: int = 3) -> Advice:
    """Up to so many poses, at best `MOST`, beside what to log and how long to
    hold them. Raises Refused where the model does not hold in poses to come."""
    if decided(posterior):
        return Advice((), 0.0, 0.0, {})
    most = min(most, MOST)
    future = _PredictiveDraws(Predictive.likeliest(posterior, SHARE))
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
    return Advice((*_beside_poses(posterior), *future.actions), future.entropy, future.entropy_after, expected)


def decided(posterior: Posterior) -> bool:
    """Whether it is likelier than not that nothing acts but what is certain."""
    certain = posterior.evidence.odds.certain
    names = frozenset(name for group in posterior.certain if len(group) == 1 for name in group)
    outliers = frozenset(i for i, p in enumerate(posterior.outlier_probabilities) if reaches(p, certain))
    settled = probabilities(posterior).get(Hypothesis(names, outliers, -1, None), 0.0)
    return reaches(settled, posterior.evidence.odds.reported)


def _influential_poses(posterior: Posterior) -> list[int]:
    """Poses without which a name that is certain would not be: to be taken
    again, whatever the posterior expects."""
    certain = posterior.evidence.odds.certain
    out = []
    for name, p in posterior.effect_probabilities.items():
        without = posterior.leave_one_out(name) if reaches(p, certain) else np.array([p])
        if reaches(p, certain) and not reaches(without.min(), certain):
            out.append(int(np.argmin(without)))
    return list(dict.fromkeys(out))


def _beside_poses(posterior: Posterior) -> Iterator[Action]:
    """What no pose tells: a channel that nobody logs, and an error that every
    pose has of its own."""
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
    """Draws of what the actions taken so far will show: of draw s the rows
    ``shown`` (S,K), those of one pose side by side, under the cell ``truth``
    (S,)."""

    def __init__(self, cells: Predictive) -> None:
        self.cells = cells
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
        """The best action of all, if it is worth its cost; or the best that
        takes a pose ``repeat_of``, whatever that is worth."""
        found, gain = options.after(self.poses), list[float]()
        normal = self.rng.standard_normal((DRAWS, 2 if options.rows.slopes else 1))

        def predictions(of: Sequence[tuple[Action, Pose]]) -> _CellPredictions:
            rows = options.rows.of_future_poses([*self.poses, *(pose for _, pose in of)])
            return _CellPredictions(self, rows, normal)

        for first in range(0, len(found), AT_ONCE):
            some = predictions(found[first : first + AT_ONCE])
            for i in range(len(self.poses), some.rows.n):
                weight = some.weight(i, some.shown_with(i))
                gain.append(self.entropy_after - self._entropy_of(weight))
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
        """The mean of p′² over that of p′, where p′ is the probability after
        the actions: draws in which the name acts are as frequent as p′ says."""
        after = self.cells.with_name(name) @ self.weight
        return float(np.mean(after**2) / np.mean(after)) if after.any() else p

    def _entropy_of(self, weight: Floats) -> float:
        return float(np.mean(_entropy(self.of @ weight)))


class _CellPredictions:
    """Of the poses of ``rows``, those taken first, what every cell says beside
    what was shown; ``normal`` (S,r) are the draws, the same for all."""

    def __init__(self, future: _PredictiveDraws, rows: LinearisedData, normal: Floats) -> None:
        self.future, self.rows, self.normal = future, rows, normal
        self.mean, self.covariance = future.cells.predicted(rows)
        self.noise = np.concatenate([cells.noise for cells in future.cells.mixture])
        self.taken = self._places(range(len(future.poses)))
        inner = self.covariance[:, self.taken[:, None], self.taken]
        self.gain = np.linalg.solve(inner, self.covariance[:, self.taken])
        self.off = future.shown - self.mean[future.truth[:, None], self.taken]

    def _places(self, poses: Iterable[int]) -> Ints:
        """Of the rows of poses."""
        index = np.array(list(poses), dtype=int)[:, None]
        return np.ravel([index, index + self.rows.n] if self.rows.slopes else index, order="F")

    def _principal(self, covariance: Floats) -> tuple[Floats, Floats]:
        """Variances (C,k) and axes (C,k,k) of covariances (C,k,k) of rows to
        come. None is less than the noise, whatever rounding leaves of it beside
        what is hardly known."""
        size, axes = np.linalg.eigh(covariance)
        return np.maximum(size, self.noise[:, None]), axes

    def shown_with(self, pose: int) -> Floats:
        """(S,K) what was shown and what this pose shows, by the cell that is
        true in each draw."""
        at, truth = self._places([pose]), self.future.truth
        gain = self.gain[:, :, at]
        crossed = self.covariance[:, at[:, None], self.taken]
        own = self.covariance[:, at[:, None], at]
        lower = _lower(*self._principal(own - crossed @ gain))[truth]
        mean = self.mean[truth[:, None], at] + np.einsum("sk,skr->sr", self.off, gain[truth])
        return np.concatenate([self.future.shown, mean + np.einsum("srq,sq->sr", lower, self.normal)], axis=1)

    def weight(self, pose: int, shown: Floats) -> Floats:
        """(C,S) of the cells after this pose too: by products of the precision
        of each cell with the squares of what is shown, one product of matrices
        for all draws."""
        at = np.concatenate([self.taken, self._places([pose])])
        own = self.covariance[:, at[:, None], at]
        size, axes = self._principal(own)
        mean, precision = self.mean[:, at], (axes / size[:, None]) @ axes.transpose(0, 2, 1)
        scored = np.einsum("cij,cj->ci", precision, mean)
        pairs = (shown[:, :, None] * shown[:, None]).reshape(len(shown), -1)
        squares = precision.reshape(len(mean), -1) @ pairs.T - 2 * scored @ shown.T
        own = np.log(self.future.cells.weight) + 0.5 * (-np.log(size).sum(axis=1) - np.sum(scored * mean, axis=1))
        log = own[:, None] - 0.5 * squares
        weight = np.exp(log - log.max(axis=0))
        return np.asarray(weight / weight.sum(axis=0))


def _lower(size: Floats, axes: Floats) -> Floats:
    """(C,k,k) the Cholesky factors of covariances with these variances and axes,
    however different the variances are."""
    upper: Floats = np.asarray(np.linalg.qr((axes * np.sqrt(size)[:, None]).transpose(0, 2, 1), mode="r"))
    sign = np.where(np.diagonal(upper, axis1=1, axis2=2) < 0, -1.0, 1.0)
    return np.asarray((upper * sign[:, :, None]).transpose(0, 2, 1))


def _entropy(p: Floats) -> Floats:
    """(…) of probabilities (H,…), in nats."""
    return np.asarray(-np.sum(p * np.log(np.maximum(p, 1e-300)), axis=0))
