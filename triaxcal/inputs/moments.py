"""Moments of the raw samples of a turning unit up to the fourth degree, in one pass
and constant memory.

The stream is cut into stretches of equal length; whenever their number reaches
`STRETCHES_MOST`, neighbours are merged. The limits of the stretches depend on the
samples alone, not on the size of the blocks. Differences between stretches in excess
of the noise later show how far the samples may be trusted.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints
from triaxcal.errors import InvalidData

MONOMIALS = [e for e in itertools.product(range(3), repeat=3) if sum(e) <= 2]
"""Exponents of the ten monomials of a quadric; products of two of them are all
monomials up to the fourth degree."""
STRETCHES_MOST = 128
"""Bound of the memory. After merging, half of them remain, twice as many as the
assessment of their scatter needs. Even, so that pairs come out."""
STRETCH_LEAST = 16
"""Initial number of samples in a stretch: as many as are kept of one (`SAMPLED`)."""
SAMPLED = 16
"""Samples kept of every stretch, for the directions."""
DIFFERENCE = 4
"""Order of the differences from sample to sample: they show the noise and hardly any
smooth motion."""
_DIFFERENCE_GAIN = 70.0
"""Gain of the differences for the variance of white noise: the sum of the squares of
1, 4, 6, 4, 1."""
_PIECE = 1 << 13
"""Number of samples whose products are formed at once, which bounds the memory. Both
it and the length of a stretch are powers of two, so one is a multiple of the
other."""
_SPAN_LIMIT = 1e60
"""Largest range of the outputs, and its inverse, of which the fourth power is
finite."""


@dataclass
class Moments:
    """Sums of products of monomials of the samples, by stretch. ``feed`` blocks of
    any size, then `summary`."""

    count: int = 0
    _origin: Floats = field(default_factory=lambda: np.zeros(3))
    _size: int = STRETCH_LEAST
    _low: Floats = field(default_factory=lambda: np.full((STRETCHES_MOST, 4), np.inf))
    _high: Floats = field(default_factory=lambda: np.full((STRETCHES_MOST, 4), -np.inf))
    _sums: Floats = field(default_factory=lambda: np.zeros((STRETCHES_MOST, 10, 10)))
    _rough: Floats = field(default_factory=lambda: np.zeros((STRETCHES_MOST, 3)))
    _lags: Floats = field(default_factory=lambda: np.zeros(STRETCHES_MOST))
    _sampled: Floats = field(default_factory=lambda: np.zeros((STRETCHES_MOST, SAMPLED, 3)))
    _warmth: Floats = field(default_factory=lambda: np.zeros(STRETCHES_MOST))
    _pieces: int = 0
    _rest: Floats = field(default_factory=lambda: np.zeros((0, 4)))

    def feed(self, u: Floats, temp_c: Floats | None = None) -> None:
        """``u`` (n,3) raw outputs, ``temp_c`` (n,) their temperature, None or NaN
        where unknown.

        Raises InvalidData where an output is not a finite number.
        """
        if not len(u):
            return
        if not np.isfinite(u).all():
            raise InvalidData(f"reading {self.count + int(np.argmin(np.isfinite(u).all(axis=1)))} is not finite")
        self.count += len(u)
        warm = np.full(len(u), np.nan) if temp_c is None else temp_c
        waiting = np.concatenate([self._rest, np.column_stack([u, warm])])
        # Sums are taken about the first samples, so that an offset costs no digits.
        if not self._pieces and len(waiting) >= STRETCH_LEAST:
            self._origin = np.median(waiting[:STRETCH_LEAST, :3], axis=0)  # so that no digits are lost to an offset
        # Take whole pieces, up to the next merging of stretches.
        at = 0
        while len(waiting) - at >= (piece := min(self._size, _PIECE)):
            until_full = STRETCHES_MOST * self._size // piece - self._pieces
            number = min((len(waiting) - at) // piece, _PIECE // piece, until_full)
            self._take(waiting[at : at + number * piece].reshape(number, piece, 4))
            at += number * piece
        self._rest = waiting[at:].copy()

    @np.errstate(over="ignore", invalid="ignore", under="ignore")  # judged by the range, in `summary`
    def _take(self, pieces: Floats) -> None:
        number, piece, _ = pieces.shape
        # The stretch of every piece; add the sums of the pieces to it.
        into = (self._pieces + np.arange(number)) * piece // self._size
        sums, rough = _sums_of(pieces[..., :3] - self._origin)
        np.minimum.at(self._low, into, pieces.min(axis=1))
        np.maximum.at(self._high, into, pieces.max(axis=1))
        np.add.at(self._sums, into, sums)
        np.add.at(self._rough, into, rough)
        np.add.at(self._lags, into, piece - DIFFERENCE)
        np.add.at(self._warmth, into, pieces[..., 3].sum(axis=1))
        # At no constant distance, so that no rate of rotation hides behind it.
        scattered = (into[:, None] * SAMPLED + np.arange(SAMPLED)) * 0.6180339887 % 1
        self._sampled[into] = pieces[np.arange(number)[:, None], (scattered * piece).astype(int), :3]
        self._pieces += number
        if self._pieces * piece == STRETCHES_MOST * self._size:
            self._halve()

    def _halve(self) -> None:
        # Merge neighbouring stretches: add sums, combine ranges, keep every second
        # sample.
        half = STRETCHES_MOST // 2
        for held in (self._sums, self._rough, self._lags, self._warmth):
            held[:half] = held[::2] + held[1::2]
            held[half:] = 0
        self._low[:half], self._low[half:] = np.minimum(self._low[::2], self._low[1::2]), np.inf
        self._high[:half], self._high[half:] = np.maximum(self._high[::2], self._high[1::2]), -np.inf
        self._sampled[:half] = np.concatenate([self._sampled[::2, ::2], self._sampled[1::2, ::2]], axis=1)
        self._size *= 2
        self._pieces = half * self._size // min(self._size, _PIECE)

    def summary(self) -> Summary:
        """The summary of all samples so far. Raises InvalidData where an axis never
        changed, or where values overflow."""
        # Stretches begun so far, the last one with its own number of samples.
        piece = min(self._size, _PIECE)
        closed = -(-self._pieces * piece // self._size)
        counts = np.full(closed, self._size)
        if closed:
            counts[-1] = self._pieces * piece - (closed - 1) * self._size
        held = _Stretches(
            self._origin,
            counts,
            *(
                v[:closed]
                for v in (self._low, self._high, self._sums, self._rough, self._lags, self._sampled, self._warmth)
            ),
        )
        return held.summary() if not len(self._rest) else held.and_then(self._rest).summary()


@dataclass(frozen=True)
class _Stretches:
    """Sums as they were fed, about ``origin`` (3,); (m,…) each, as in `Moments`.
    ``low`` and ``high`` (m,4) include the temperature, ``warmth`` (m,) is its sum."""

    origin: Floats
    counts: Ints
    low: Floats
    high: Floats
    sums: Floats
    rough: Floats
    lags: Floats
    sampled: Floats
    warmth: Floats

    def and_then(self, rest: Floats) -> _Stretches:
        """The same with further samples and temperatures (n,4) that did not fill a
        stretch."""
        sums, rough = _sums_of(rest[None, :, :3] - self.origin)
        return replace(
            self,
            counts=np.r_[self.counts, len(rest)],
            low=np.concatenate([self.low, rest.min(axis=0)[None]]),
            high=np.concatenate([self.high, rest.max(axis=0)[None]]),
            sums=np.concatenate([self.sums, sums]),
            rough=np.concatenate([self.rough, rough]),
            lags=np.r_[self.lags, max(len(rest) - DIFFERENCE, 1)],
            sampled=np.concatenate([self.sampled, np.broadcast_to(rest[:1, :3], (1, SAMPLED, 3))]),
            warmth=np.r_[self.warmth, rest[:, 3].sum()],
        )

    def only(self, kept: Bools) -> _Stretches:
        names = ("counts", "low", "high", "sums", "rough", "lags", "sampled", "warmth")
        return replace(self, **{name: getattr(self, name)[kept] for name in names})

    def summary(self) -> Summary:
        # Range of every axis; scale the samples to −1 … 1.
        low, high = self.low[:, :3].min(axis=0), self.high[:, :3].max(axis=0)
        flat = [axis for axis, least, most in zip("xyz", low, high, strict=True) if not most > least]
        if flat:
            raise InvalidData(f"the output of axis {', '.join(flat)} never changes")
        half, middle = (high - low) / 2, (high + low) / 2
        if not (np.all(half < _SPAN_LIMIT) and np.all(half > 1 / _SPAN_LIMIT)):
            raise InvalidData(f"outputs that range over {half.max():.3g} cannot be summed up")
        # Transform the moments to the scaled monomials: T M Tᵀ.
        T = _change_of_basis(middle - self.origin, half)
        return Summary(
            middle=middle,
            half=half,
            counts=self.counts,
            moments=T @ (self.sums / self.counts[:, None, None]) @ T.T,
            quick=np.median(self.rough / self.lags[:, None], axis=0) / _DIFFERENCE_GAIN / half**2,
            sampled=self.sampled.reshape(-1, 3),
            temperature=self._temperature(),
            _fed=self,
        )

    def _temperature(self) -> Temperature | None:
        mean = float(self.warmth.sum() / self.counts.sum())
        found = Temperature(mean, float(self.low[:, 3].min()), float(self.high[:, 3].max()))
        return found if np.isfinite([found.mean, found.lowest, found.highest]).all() else None


@dataclass(frozen=True)
class Temperature:
    """Temperature of the samples in °C."""

    mean: float
    lowest: float
    highest: float


@dataclass(frozen=True)
class Summary:
    """Samples scaled to ``x = (u − middle)/half``, between −1 and 1 in every axis.

    ``counts`` (m,) samples in each stretch, ``moments`` (m,10,10) mean products of
    `MONOMIALS` in it; ``quick`` (3,) variance of the noise of one sample, in scaled
    units, from differences from sample to sample; ``sampled`` (k,3) some of the
    outputs, from everywhere; ``temperature`` None where it is not known of all
    samples.
    """

    middle: Floats
    half: Floats
    counts: Ints
    moments: Floats
    quick: Floats
    sampled: Floats
    temperature: Temperature | None
    _fed: _Stretches

    @property
    def count(self) -> int:
        return int(self.counts.sum())

    @property
    def reach(self) -> Floats:
        """(m,3) largest deviation of the outputs of each stretch from the median."""
        middle = np.median(self.sampled, axis=0)
        return np.maximum(np.abs(self._fed.low[:, :3] - middle), np.abs(self._fed.high[:, :3] - middle))

    def only(self, stretches: Bools) -> Summary:
        """The summary of some of the stretches, scaled anew."""
        return self._fed.only(stretches).summary()

    def mean(self) -> Floats:
        """(10,10) mean moments over all samples."""
        return np.asarray(np.einsum("m,mij->ij", self.counts / self.count, self.moments))


def _sums_of(x: Floats) -> tuple[Floats, Floats]:
    """Sums over pieces (m,n,3): products of the monomials (m,10,10), and squared
    differences (m,3)."""
    # Monomials 1, xᵢ and xᵢ xⱼ of every sample; then all their products as one matrix
    # product.
    columns = np.ascontiguousarray(x.transpose(0, 2, 1))
    terms = np.empty((len(x), 10, x.shape[1]))
    with np.errstate(over="ignore", invalid="ignore", under="ignore"):  # judged by the range, in `summary`
        for row, powers in enumerate(MONOMIALS):
            axes = [axis for axis in range(3) for _ in range(powers[axis])]
            if len(axes) == 2:
                np.multiply(columns[:, axes[0]], columns[:, axes[1]], out=terms[:, row])
            else:
                terms[:, row] = columns[:, axes[0]] if axes else 1.0
        difference = np.diff(columns, n=DIFFERENCE, axis=2)
        rough = np.einsum("mij,mij->mi", difference, difference)
        return terms @ terms.transpose(0, 2, 1), rough


def _change_of_basis(offset: Floats, half: Floats) -> Floats:
    """(10,10): the monomials of ``(x − offset)/half`` from those of x."""
    T = np.zeros((10, 10))
    # Expand ((x − o)/h)^p by the binomial theorem, axis by axis.
    for row, powers in enumerate(MONOMIALS):
        for taken in itertools.product(*(range(p + 1) for p in powers)):
            factor = 1.0
            for p, t, o, h in zip(powers, taken, offset, half, strict=True):
                factor *= (2.0 if (p, t) == (2, 1) else 1.0) * (-o) ** (p - t) / h**p
            T[row, MONOMIALS.index((taken[0], taken[1], taken[2]))] += factor
    return T
