"""The extremes of every tenth of a second and how often they were read, and the
step of the output."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from triaxcal.arrays import Bools, Floats, Ints, joined

LATTICE = 20.5
"""Differences up to so many steps tell whether there are steps at all."""
OFF_LATTICE = 0.05
"""Steps by which a difference may miss a whole number of them; one in ten is as
near by chance."""
LATTICE_LEAST = 8
"""Differences that have to lie on the lattice: by chance as many do once in ten
million."""
COARSE = 0.5
"""Noise in steps, of a sample: with less, readings rest on one value for long."""
HUSHED = 0.35
"""The same for the quietest tenth of the blocks, which chance makes quieter
than the rest."""
BLOCK = 16
"""Samples in a block. Longer ones hold noise and motion at once; of shorter
ones chance decides which it is."""
BLOCKS_LEAST = 4
"""Blocks of noise in a chunk below which their quantiles say nothing."""
NOISE_LIKE = 0.4
"""Variance by fourth differences over that by second ones: 1 for white noise,
next to 0 for smooth motion. Nearer to 1 sound noise is lost by chance."""
NOISY_SHARE = 0.2
"""Of all blocks: moves and stretches without noise may fill the others."""
NOISELESS = 1e-13
"""Scatter, as a share of the readings, that the arithmetic makes."""
FINEST = 1e-10
"""A step below this share of the readings is rounding of the arithmetic."""


@dataclass(frozen=True)
class Cells:
    """Stretches of equal length: ``start_ns``, ``end_ns`` (m,); ``high``,
    ``low`` (m,3) extremes of the readings, ``at_high``, ``at_low`` (m,3) how
    many samples read exactly that. ``size`` samples in each.
    """

    size: int
    start_ns: Ints
    end_ns: Ints
    high: Floats
    low: Floats
    at_high: NDArray[np.integer[Any]]
    at_low: NDArray[np.integer[Any]]

    def __len__(self) -> int:
        return len(self.start_ns)


@dataclass
class CellKeeper:
    """Fed whole cells, in order."""

    size: int
    _done: list[tuple[Any, ...]] = field(default_factory=list)  # as Cells has them, behind its size

    def feed(self, time_ns: Ints, u: Floats) -> None:
        """``u`` (3,n), n a multiple of ``size``."""
        blocks = u.reshape(3, -1, self.size)
        times = time_ns.reshape(-1, self.size)
        high, low = blocks.max(axis=2), blocks.min(axis=2)
        small = np.min_scalar_type(self.size)  # there is one for each tenth of a second, however long
        at_high = np.count_nonzero(blocks == high[:, :, None], axis=2).astype(small)
        at_low = np.count_nonzero(blocks == low[:, :, None], axis=2).astype(small)
        self._done.append((times[:, 0].copy(), times[:, -1].copy(), high.T, low.T, at_high.T, at_low.T))

    def cells(self) -> Cells:
        if not self._done:
            none = np.zeros(0, dtype=np.int64)
            empty = np.zeros((0, 3))
            return Cells(self.size, none, none, empty, empty, empty.astype(np.int64), empty.astype(np.int64))
        if len(self._done) > 1:
            self._done = [joined(self._done)]
        return Cells(self.size, *self._done[0])


@dataclass
class StepEstimator:
    """Learns the smallest step of each axis, and its noise from sample to
    sample, from chunks of the stream."""

    _least: list[Floats] = field(default_factory=list)
    _rough: list[list[float]] = field(default_factory=lambda: [[], [], []])
    _least_rough: Floats = field(default_factory=lambda: np.full(3, np.inf))
    _blocks: int = 0
    _noisy: Ints = field(default_factory=lambda: np.zeros(3, dtype=np.int64))

    def feed(self, u: Floats) -> None:
        """``u`` (3,n) consecutive samples."""
        if u.shape[1] < BLOCK + 4:
            return
        difference = np.diff(u, axis=1)
        size = np.abs(difference)
        largest = np.abs(u).max(axis=1)
        self._least.append(np.array([_step(size[axis], FINEST * largest[axis]) for axis in range(3)]))
        second, count = np.diff(difference, axis=1), (u.shape[1] - 4) // BLOCK
        rough = _mean_square(second, count) / 6
        # Noise is as large in fourth differences as in second ones; what moves
        # smoothly all but vanishes there.
        like_noise = (_mean_square(np.diff(second, n=2, axis=1), count) / 70 > NOISE_LIKE * rough) & (
            rough > (NOISELESS * largest[:, None]) ** 2
        )
        self._blocks += rough.shape[1]
        self._noisy += like_noise.sum(axis=1)
        for axis in range(3):
            noisy = rough[axis, like_noise[axis]]
            if len(noisy) >= BLOCKS_LEAST:
                low, middle = np.quantile(noisy, [0.1, 0.5])
                self._rough[axis].append(float(middle))
                self._least_rough[axis] = min(self._least_rough[axis], float(low))

    def step(self) -> Floats:
        """(3,) the smallest difference between readings, zero where they lie on
        no lattice of steps that shows."""
        if not self._least:
            return np.zeros(3)
        least = np.array(self._least)
        found = np.where(least > 0, least, np.inf).min(axis=0)
        return np.where(np.isfinite(found), found, 0.0)

    def roughness(self) -> Floats:
        """(3,) standard deviation of the noise of a sample, as far as it
        differs from sample to sample; zero where most of the stream has none.
        """
        out = np.zeros(3)
        for axis in np.flatnonzero(self._noisy > NOISY_SHARE * self._blocks).tolist():
            out[axis] = np.sqrt(np.median(self._rough[axis])) if self._rough[axis] else 0.0
        return out

    def scatters(self, step: Floats) -> Bools:
        """(3,) whether the noise is wider than half a ``step`` (3,), so that
        readings rest on no value for long: as a rule, and not much less in any
        part of the stream, as where a machine that shakes the stand is switched
        off.
        """
        return np.asarray((self.roughness() > COARSE * step) & (np.sqrt(self._least_rough) > HUSHED * step))


def _mean_square(differences: Floats, count: int) -> Floats:
    """(3,count) in blocks."""
    blocks = differences[:, : count * BLOCK].reshape(3, count, BLOCK)
    return np.asarray(np.einsum("ijk,ijk->ij", blocks, blocks) / BLOCK)


def _step(size: Floats, floor: float) -> float:
    changes = size[size > floor]
    if not len(changes):
        return 0.0
    least = float(changes.min())
    near = changes[changes < LATTICE * least] / least
    if len(near) < LATTICE_LEAST or np.mean(np.abs(near - np.rint(near)) < OFF_LATTICE) < 0.999:
        return 0.0
    return least
