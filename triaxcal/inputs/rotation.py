"""Calibration of a unit that turns slowly and never rests: adjusted least squares
from streaming moments.

Ordinary ellipsoid fits to raw samples have a bias of the order of the squared noise,
which more samples do not reduce. Adjusted least squares (Markovsky, Kukush and Van
Huffel 2004) corrects the moments of the samples for the noise, and estimates it. It
needs only the moments up to the fourth degree (`triaxcal.inputs.moments`).

The ellipsoid does not show how the axes share the noise; differences from sample to
sample do, where the unit turns slowly. Stretches of the recording show whether there
is more than noise: the mean magnitude of each differs from the reference by the noise
of one sample over the root of their number, if the noise is white, the model
complete, and the unit feels gravity alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy

from triaxcal.arrays import Bools, Floats, rms
from triaxcal.distributions import f_sf
from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.calibration import Calibration, Caution, Residual
from triaxcal.estimate.initial_estimate import coefficients
from triaxcal.inputs.moments import MONOMIALS, Moments, Summary, Temperature
from triaxcal.model.directions import linear_design, most_wanted
from triaxcal.model.sensor import Sensor
from triaxcal.poses.degrees_of_freedom import LACK_OF_FIT

# Adjusted least squares for an ellipsoid: moments corrected for the noise that makes
# them exactly singular.

ARITHMETIC = 1e-15
"""Rounding error of a variance."""


class NoEllipsoid(Refused):
    """The samples lie on no ellipsoid."""

    def __init__(self) -> None:
        super().__init__(
            "the samples lie on no ellipsoid: the unit felt accelerations besides gravity, or turned about too few "
            "axes; turn it more slowly, so that every side is up at some time"
        )


class DirectionsLacking(Refused):
    """The directions cannot carry nine parameters; ``dilution`` and its limit, where
    known."""

    def __init__(self, dilution: tuple[float, float] | None = None) -> None:
        by = "" if dilution is None else " (dilution {:.3g}, limit {:g})".format(*dilution)
        super().__init__(
            f"the directions of the turning unit cannot carry nine parameters{by}: turn the unit about more axes, so "
            "that every side is up at some time"
        )


@dataclass(frozen=True)
class Ellipsoid:
    """``|T x − o| = 1``, T (3,3) upper triangular with positive diagonal;
    ``variance`` (3,) of the noise of x."""

    T: Floats
    o: Floats
    variance: Floats

    def coefficients(self, held: Summary, reference: float) -> tuple[Floats, Floats, Floats]:
        """Scale factor, misalignment and bias in the units of output and reference,
        all signs plus."""
        return coefficients_of(self.T, self.o, held, reference)


def coefficients_of(T: Floats, o: Floats, held: Summary, reference: float) -> tuple[Floats, Floats, Floats]:
    return coefficients(T / held.half * reference, held.middle + held.half * np.linalg.solve(T, o))


# Hermite polynomials remove the effect of Gaussian noise of variance v on a power:
# coefficients of x^(n-2m) v^m.
_UNDO = {0: (1.0,), 1: (1.0,), 2: (1.0, -1.0), 3: (1.0, -3.0), 4: (1.0, -6.0, 3.0)}


def _undoing() -> list[tuple[tuple[int, int], tuple[int, int], tuple[int, ...], float]]:
    """Terms of the correction: corrected entry, entry with the lower moment, powers
    of the variances, factor."""
    at: dict[tuple[int, ...], tuple[int, int]] = {}
    for (i, left), (j, right) in itertools.product(enumerate(MONOMIALS), repeat=2):
        at.setdefault(tuple(p + q for p, q in zip(left, right, strict=True)), (i, j))
    out = []
    for (i, left), (j, right) in itertools.product(enumerate(MONOMIALS), repeat=2):
        powers = tuple(p + q for p, q in zip(left, right, strict=True))
        for m in itertools.product(*(range(len(_UNDO[p])) for p in powers)):
            factor = float(np.prod([_UNDO[p][n] for p, n in zip(powers, m, strict=True)]))
            out.append(((i, j), at[tuple(p - 2 * n for p, n in zip(powers, m, strict=True))], m, factor))
    return out


_TERMS = _undoing()
_TO = tuple(np.array([t[0] for t in _TERMS]).T)  # entries that are corrected
_FROM = tuple(np.array([t[1] for t in _TERMS]).T)  # entries that hold the lower moments
_POWERS = np.array([t[2] for t in _TERMS])  # of the variances of the axes
_FACTOR = np.array([t[3] for t in _TERMS])  # products of the coefficients of `_UNDO`


def corrected(moments: Floats, variance: Floats) -> Floats:
    """Moments (…,10,10) of the noiseless samples, for Gaussian noise of ``variance``
    (3,)."""
    terms = _FACTOR * np.prod(variance**_POWERS, axis=1) * moments[..., _FROM[0], _FROM[1]]
    out = np.zeros(moments.shape)
    np.add.at(out, (..., *_TO), terms)
    return out


def fitted(held: Summary, shape: Floats) -> Ellipsoid:
    """The ellipsoid for noise with variances in the ratio of ``shape`` (3,); their
    size follows.

    Raises Refused where there is none.
    """
    mean = held.mean()
    return _ellipsoid(mean, noise(mean, shape) * shape)


def noise(mean: Floats, shape: Floats) -> float:
    """The smallest noise with singular corrected moments, as a multiple of ``shape``
    (3,); 0 where it is within rounding."""
    # Corrected moments as a polynomial in the noise variance: M₀ + v M₁ + v² M₂.
    unit = shape / np.max(shape)
    none = corrected(mean, 0 * unit)
    once, twice = corrected(mean, unit) - none, corrected(mean, 2 * unit) - none
    second = twice / 2 - once  # the correction is a polynomial of the second degree
    first = once - second

    def smallest(variance: float) -> float:
        return float(np.linalg.eigvalsh(none + variance * first + variance**2 * second)[0])

    if smallest(0.0) <= ARITHMETIC:
        return 0.0
    # Bracket the first root of the smallest eigenvalue, then Brent's method.
    low, high = 0.0, ARITHMETIC
    while smallest(high) > 0:
        low, high = high, high * 4
        if high > 1:
            raise NoEllipsoid
    return float(scipy.optimize.brentq(smallest, low, high, xtol=1e-18, rtol=1e-12)) / float(np.max(shape))


def _ellipsoid(mean: Floats, variance: Floats) -> Ellipsoid:
    # The null vector of the corrected moments holds the coefficients of the quadric.
    values, vectors = np.linalg.eigh(corrected(mean, variance))
    if values[1] < 1e-9 * values[-1]:
        raise DirectionsLacking
    q = dict(zip(MONOMIALS, vectors[:, 0], strict=True))
    B = np.array(
        [
            [q[2, 0, 0], q[1, 1, 0] / 2, q[1, 0, 1] / 2],
            [q[1, 1, 0] / 2, q[0, 2, 0], q[0, 1, 1] / 2],
            [q[1, 0, 1] / 2, q[0, 1, 1] / 2, q[0, 0, 2]],
        ]
    )
    # Centre and H of the quadric as in the closed form; T is the upper Cholesky factor.
    linear = np.array([q[1, 0, 0], q[0, 1, 0], q[0, 0, 1]])
    try:
        centre = -0.5 * np.linalg.solve(B, linear)
        T = np.linalg.cholesky(B / (centre @ B @ centre - q[0, 0, 0])).T
    except np.linalg.LinAlgError:
        raise NoEllipsoid from None
    return Ellipsoid(T, T @ centre, variance)


def as_monomials(Q: Floats) -> Floats:
    """(10,) coefficients of the monomials in the quadratic form ``(x, 1)ᵀ Q (x, 1)``,
    Q (4,4)."""
    out = np.zeros(len(MONOMIALS))
    for row, powers in enumerate(MONOMIALS):
        axes = [axis for axis in range(3) for _ in range(powers[axis])]
        i, j = (*axes, 3, 3)[:2]
        out[row] = Q[i, j] if i == j else Q[i, j] + Q[j, i]
    return out


def design(e: Ellipsoid) -> Floats:
    """(9,10): derivative of |T x − o|²/2 by the entries of T (row by row) and o, as
    coefficients of the monomials."""
    forms = np.zeros((9, 4, 4))
    for n, (i, j) in enumerate(itertools.combinations_with_replacement(range(3), 2)):
        forms[n, j] = *e.T[i], -e.o[i]  # a_i x_j
    for i in range(3):
        forms[6 + i, 3] = *-e.T[i], e.o[i]  # −a_i
    return np.array([as_monomials(form) for form in forms])


def coefficients_by_entries(e: Ellipsoid, held: Summary, reference: float) -> Floats:
    """(9,9) derivative of scale factor, misalignment and bias by the entries of T and
    o, by central differences."""
    rows, columns = np.triu_indices(3)
    start = np.concatenate([e.T[rows, columns], e.o])

    def of(p: Floats) -> Floats:
        T = np.zeros((3, 3))
        T[rows, columns] = p[:6]
        return np.concatenate(coefficients_of(T, p[6:], held, reference))

    step = 1e-6
    return np.stack([(of(start + h) - of(start - h)) / (2 * step) for h in step * np.eye(9)], axis=1)


SAMPLES_LEAST = 100
"""With fewer samples, nine parameters and three noises are undetermined; a
conservative limit."""
ROUNDS_MOST = 20
"""The noise of the axes follows the scale factors from fit to fit; it ends once these
are constant."""
DILUTION_MOST = 100.0
"""Largest standard error of a combination of parameters, in noises of one sample over
the root of their number."""
DILUTION_WARNING = 10.0
"""A tenth of the limit of refusal: the errors are still valid, but large."""
UNSEEN_WARNING = 0.2
"""Share of a coefficient's variance from which on the unknown sharing of the noise is
reported."""
QUICK = 0.7
"""Least ratio of the scatter about the ellipsoid to the noise from sample to sample;
with less the unit turns too fast for its sample rate, and the differences are not
noise."""
UNEQUAL = 2.5
"""Ratio of the axes' noises from which on weights, which this fit lacks, would lower
the errors by a tenth."""
STRETCHES_LEAST = 30
"""With fewer stretches, their scatter is too uncertain for nine parameters."""
OUTLIER_SIGMA = 6.0
"""Limit in robust standard deviations, which noise exceeds twice in 10⁹: sound
stretches stay. Smaller deviations stay too, and raise the standard errors."""
OUTLIERS_MOST = 0.05
"""Largest share of stretches that are excluded as outliers."""
OUTLIER_ROUNDS = 4
"""Large outliers mask smaller ones, so the search is repeated without them; it ends
once none is left."""
SPIKE = 10.0
"""Ratio of the range of an outlying stretch to that of nine tenths of the others."""
STEPS = 0.5
"""Noise in steps of the output below which rounding is no noise."""


@dataclass(frozen=True)
class StretchesExcluded(Caution):
    """Stretches of the recording that stand out from the others."""

    stretches: int
    samples: int


@dataclass(frozen=True)
class FewDirections(Caution):
    dilution: float


@dataclass(frozen=True)
class StretchesDiffer(Caution):
    """The stretches differ by ``ratio`` times as much as white noise explains; the
    standard errors are raised by up to ``raised``."""

    ratio: float
    raised: float


@dataclass(frozen=True)
class NoiseUnseen(Caution):
    """A ``share`` of the noise does not show from sample to sample, and its
    distribution over the axes is unknown."""

    share: float


@dataclass(frozen=True)
class NoiseUnequal(Caution):
    """The noise of one axis is ``ratio`` times that of another; the fit has no
    weights."""

    ratio: float


@dataclass(frozen=True)
class CoarseSteps(Caution):
    """The outputs are rounded to steps larger than their noise, which the standard
    errors do not include."""


@dataclass(frozen=True)
class RotationFit:
    """``calibration`` has no poses; its residual is that of ``stretches`` of the
    recording, and its dilution is in noises of one sample over the root of
    ``samples``. ``noise_g`` (3,) of one sample along each sensitive axis.

    ``unseen_share`` of the noise, 0…1, does not show from sample to sample: its
    distribution over the axes is unknown. ``temperature`` is that of the fitted
    samples, at whose mean the coefficients hold; None where it is not known of all.
    """

    calibration: Calibration
    noise_g: Floats
    unseen_share: float
    samples: int
    stretches: int
    temperature: Temperature | None


def fit_rotation(moments: Moments, *, signs: tuple[int, int, int] = (1, 1, 1), reference: float = 1.0) -> RotationFit:
    """Fit the linear model to the moments of a turning unit.

    ``signs`` (3,) of the scale factors, which |a| does not show. ``reference`` is the
    magnitude of gravity in its unit. Raises Refused where the samples cannot carry
    nine parameters, with the sides that were never up; InvalidData where they are no
    sensor's.
    """
    if moments.count < SAMPLES_LEAST:
        raise Refused(f"{moments.count} samples of a turning unit; at least {SAMPLES_LEAST} are needed")
    if not (np.isfinite(reference) and reference > 0):
        raise InvalidData(f"the reference must be a positive number, not {reference}")
    s = np.asarray(signs, dtype=float)
    whole = moments.summary()
    try:
        held, e, unseen = _without_outliers(whole)
        judged = _Judged(held, e)
        if not judged.dilution < DILUTION_MOST:
            raise DirectionsLacking((judged.dilution, DILUTION_MOST))
    except Refused as refusal:
        refusal.wanted = _wanted(whole, s, refusal)
        raise
    p = judged.lack_of_fit_p
    entries, birge_ratio = judged.covariance(raised=p is not None and p < LACK_OF_FIT)
    G = coefficients_by_entries(e, held, reference)
    shares = _by_share(held, e, reference) * unseen
    flip = np.r_[s, s[1] * s[2], s[0] * s[2], s[0] * s[1], s]
    k, angles, b = e.coefficients(held, reference)
    r = judged.error * reference
    calibration = Calibration(
        sensor=Sensor(s * k, flip[3:6] * angles, s * b),
        covariance=np.outer(flip, flip) * (G @ entries @ G.T + shares @ shares.T),
        reference=reference,
        channel_reference={},
        residual=Residual(
            rms_g=rms(r),
            max_abs_g=float(np.max(np.abs(r))),
            cross_validated_rms_g=None,
            noise_floor_g=rms(judged.noise) * reference,
            lack_of_fit_p=p,
        ),
        poses=(),
        condition=judged.condition,
        dilution=judged.dilution,
        birge_ratio=birge_ratio,
        dof=float(max(len(held.counts) - 10, 1) if birge_ratio > 1 else held.count - 9),
    )
    noise_g = np.sqrt(e.variance) * held.half / k
    found = RotationFit(calibration, noise_g, unseen, held.count, len(held.counts), held.temperature)
    raised = float(np.max(np.sum(shares**2, axis=1) / np.diag(calibration.covariance)))
    return replace(found, calibration=replace(calibration, cautions=tuple(_cautions(found, whole, held, raised))))


def _without_outliers(held: Summary) -> tuple[Summary, Ellipsoid, float]:
    """Without outlying stretches, from a knock or a lost word, which stand out from
    all others."""
    spikes = _spiky(held)
    if spikes.any() and spikes.sum() <= max(OUTLIERS_MOST * len(spikes), 1):
        held = held.only(~spikes)
    e, unseen = _ellipsoid_and_noise(held)
    # Repeat: fit, robust z-scores of the stretches, exclusion.
    for _ in range(OUTLIER_ROUNDS):
        judged = _Judged(held, e)
        z = judged.error / judged.noise
        z -= np.median(z)
        bad: Bools = np.abs(z) > OUTLIER_SIGMA * max(1.4826 * float(np.median(np.abs(z))), 1.0)
        if not bad.any() or len(z) < STRETCHES_LEAST or bad.sum() > max(OUTLIERS_MOST * len(z), 1):
            break
        held = held.only(~bad)
        e, unseen = _ellipsoid_and_noise(held)
    return held, e, unseen


def _spiky(held: Summary) -> Bools:
    """Stretches with a range far beyond that of nearly all others, with which no fit
    could begin."""
    reach = held.reach
    return np.asarray((reach > SPIKE * np.quantile(reach, 0.9, axis=0)).any(axis=1))


def _ellipsoid_and_noise(held: Summary) -> tuple[Ellipsoid, float]:
    """The ellipsoid, and the share of the noise whose distribution over the axes is
    unknown."""
    mean = held.mean()
    # Distribution from the differences of samples, where these explain most of the
    # noise.
    if np.all(held.quick > 0):
        ratio = noise(mean, held.quick)
        if ratio > QUICK:
            by_chance = 1 + 4 * np.sqrt(8 / held.count)
            return fitted(held, held.quick), max(0.0, 1 - by_chance / ratio)
    # Otherwise equal noise in g on all axes, iterated with the scale factors.
    k = held.half.copy()
    for _ in range(ROUNDS_MOST):
        e = fitted(held, (k / held.half) ** 2)  # taken to be alike in g, hence unlike in scaled units
        before, (k, _, _) = k, e.coefficients(held, 1.0)
        if np.max(np.abs(k / before - 1)) < 1e-12:
            break
    return e, 1.0


def _by_share(held: Summary, e: Ellipsoid, reference: float) -> Floats:
    """(9,3): change of the coefficients if the share of the noise in one axis
    doubled, by differences."""
    step = 0.05
    start = np.concatenate(e.coefficients(held, reference))
    if not np.all(e.variance > 0):
        return np.zeros((9, 3))
    shifted = (fitted(held, e.variance * (1 + step * axis)) for axis in np.eye(3))
    return np.stack([(np.concatenate(o.coefficients(held, reference)) - start) / step for o in shifted], axis=1)


class _Judged:
    """Stretches under a fit. ``error`` (m,): mean of |a| − 1 in each, ``noise`` (m,)
    its standard error."""

    def __init__(self, held: Summary, e: Ellipsoid) -> None:
        self.counts, self.count = held.counts, held.count
        # Corrected moments; |a|² and its derivatives as coefficients of the monomials.
        moments = corrected(held.moments, e.variance)
        squares = np.concatenate([e.T, -e.o[:, None]], axis=1)  # a = squares @ (x, 1)
        self.across = e.T * np.sqrt(e.variance + ARITHMETIC)
        rows, ones = design(e), moments[:, MONOMIALS.index((0, 0, 0))]
        # (|a|² − 1)/2 ≈ |a| − 1, and the noise variance of |a| along a.
        miss = as_monomials(squares.T @ squares - np.diag([0.0, 0.0, 0.0, 1.0])) / 2
        along = as_monomials(squares.T @ self.across @ self.across.T @ squares)
        self.error = ones @ miss
        self.variance = np.maximum(ones @ along, 1e-300)
        self.noise = np.sqrt(self.variance / self.counts)
        # Scores and information of the nine entries.
        self.mean_row = ones @ rows.T
        self.scores = (moments @ miss) @ rows.T
        self.information = rows @ np.einsum("m,mij->ij", self.counts / self.count, moments) @ rows.T
        a = ((held.sampled - held.middle) / held.half) @ e.T.T - e.o
        self.directions = a / np.maximum(np.linalg.norm(a, axis=1, keepdims=True), 1e-300)

    @property
    def dilution(self) -> float:
        weakest = float(np.linalg.eigvalsh(self.information)[0])
        return float(1 / np.sqrt(weakest)) if weakest > 1e-12 else float("inf")

    @property
    def condition(self) -> float:
        norms = np.sqrt(np.diag(self.information))
        return float(np.sqrt(np.linalg.cond(self.information / np.outer(norms, norms))))

    @property
    def lack_of_fit_p(self) -> float | None:
        if len(self.counts) < STRETCHES_LEAST:
            return None
        inverse = np.linalg.inv(self.information) / self.count
        leverage = self.counts * np.einsum("mi,ij,mj->m", self.mean_row, inverse, self.mean_row)
        left = float(np.sum(1 - np.clip(leverage, 0.0, 1.0)))
        return float(f_sf(float(np.sum((self.error / self.noise) ** 2)) / left, left, self.count - 9))

    def covariance(self, *, raised: bool) -> tuple[Floats, float]:
        """(9,9) covariance of the entries of T and o, and the largest factor by which
        its standard errors were raised.

        From white noise, and from the scatter of the stretches where this is larger.
        """
        # White noise: inverse information times the mean variance.
        inverse = np.linalg.inv(self.information)
        white = inverse * float(self.variance @ self.counts) / self.count**2
        factor = self._unequal()
        white = white * np.outer(factor, factor)
        if not raised:
            return white, 1.0
        # Sandwich estimate from the scores of the stretches, at increasing lengths.
        score = self.scores * self.counts[:, None] / self.count
        most = np.diag(white)
        while len(score) >= STRETCHES_LEAST:  # neighbours put together, again and again: what drifts is no chance
            m = len(score)
            most = np.maximum(most, np.diag(inverse @ (score.T @ score) @ inverse) * m / (m - 10))
            score = score[: m // 2 * 2].reshape(m // 2, 2, 9).sum(axis=1)
        factor = np.sqrt(most / np.diag(white))
        return white * np.outer(factor, factor), float(factor.max())

    def _unequal(self) -> Floats:
        """(9,) factors on the standard errors for noise that depends on the
        direction."""
        # This needs moments of the sixth degree, which some of the samples approximate.
        J = linear_design(self.directions, self.directions)
        variance = np.sum((self.directions @ self.across) ** 2, axis=1)
        bread = np.linalg.pinv(J.T @ J)
        ratio = np.diag(bread @ (J.T * variance) @ J @ bread) / (np.diag(bread) * variance.mean())
        return np.asarray(np.sqrt(ratio))


def _wanted(held: Summary, signs: Floats, refusal: Refused) -> tuple[str, ...]:
    """Sides that were never up, as far as the directions can be determined without a
    fit."""
    # Without one scale for all, an axis that hardly moved would look like one
    # that swung from end to end.
    u = (held.sampled - np.median(held.sampled, axis=0)) / np.max(held.half) * signs
    wanted = most_wanted(u + 1e-12)
    if not wanted and not isinstance(refusal, NoEllipsoid):
        wanted = most_wanted(np.zeros((0, 3)))
    return tuple(dict.fromkeys(label for label, _ in wanted))


def _cautions(found: RotationFit, whole: Summary, held: Summary, unseen: float) -> Iterator[Caution]:
    """``unseen``: largest share of a coefficient's variance that is due to the
    unknown distribution of the noise."""
    c = found.calibration
    if gone := whole.count - held.count:
        yield StretchesExcluded(len(whole.counts) - len(held.counts), gone)
    if c.dilution > DILUTION_WARNING:
        yield FewDirections(c.dilution)
    if c.birge_ratio > 1:
        yield StretchesDiffer(c.residual.rms_g / c.residual.noise_floor_g, c.birge_ratio)
    if np.any(found.noise_g) and (found.unseen_share == 1 or unseen > UNSEEN_WARNING):
        yield NoiseUnseen(found.unseen_share)
    low, high = float(np.min(found.noise_g)), float(np.max(found.noise_g))
    if high > UNEQUAL * low > 0:
        yield NoiseUnequal(high / low)
    if np.any(_step(held) * STEPS > np.sqrt(held.half**2 * _variance(found, held))):
        yield CoarseSteps()


def _variance(found: RotationFit, held: Summary) -> Floats:
    """(3,) variance of the noise in scaled units."""
    return np.asarray((found.noise_g * found.calibration.sensor.scale_factor / held.half) ** 2)


def _step(held: Summary) -> Floats:
    """(3,) step of which all outputs are multiples; 0 where there is none."""
    out = np.zeros(3)
    for axis in range(3):
        gaps = np.diff(np.unique(held.sampled[:, axis]))
        gaps = gaps[gaps > 1e-9 * np.max(np.abs(held.sampled[:, axis]))]
        if len(gaps):
            parts = gaps / gaps.min()
            if np.mean(np.abs(parts - np.round(parts)) < 0.05) > 0.95:
                out[axis] = gaps.min()
    return out
