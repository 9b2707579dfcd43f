"""Whether anything is left: one test of all candidates together.

The best of many candidates has to outdo what chance makes of the best, and the sum of squares spreads over directions
in which no effect acts. The likelihood ratio averaged over all that there may be tells more often than either: of the
tests of one level it has the most power on that average (Andrews and Ploberger 1994, Econometrica 62:1383).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from triaxcal.arrays import Floats
from triaxcal.poses.noise_levels import NoiseLevels
from triaxcal.search.gains import Gains

DRAWS = 2000
SIZE = 5.0
"""The effects averaged over have this size s (rms): much larger ones are seen in any case, smaller ones by nobody."""
LARGE = 20.0
"""Half of what has no name has this size: spread over many directions, in noise that is hardly known, even a large
departure is not beyond all that chance could do if only small ones were thought of."""
NAMELESS = 0.2
"""Share of what has no name."""
FREE_LEAST = 1e-3
"""A pose of which the model leaves less than this share carries a parameter, and is never off."""


def anything_p(gains: Gains, names: Sequence[str], model: Floats, noise: NoiseLevels) -> float:
    """Probability that noise alone looks as much like one of the candidates, or like something that is none of them.

    ``names`` (c,) of the candidates: each has the same weight, and so has one pose that is off, whichever it is.
    ``model`` (n,k) is the orthonormal basis of what was fitted; ``noise`` how large the poses' noise may be. Simulated,
    as candidates are alike.
    """
    n, k = model.shape
    rng = np.random.default_rng(0)
    drawn = rng.standard_normal((n, DRAWS))
    drawn = (drawn - model @ (model.T @ drawn)) * np.sqrt(noise.drawn(DRAWS, rng))
    y = np.column_stack([gains.y, drawn])
    total = np.sum(y**2, axis=0)
    free = 1 - np.sum(model**2, axis=1)
    shows = free > FREE_LEAST
    tries = Counter(names)
    named = np.array([*(1 / tries[name] for name in names), *np.full(n, 1 / n)[shows]])
    weights = np.append((1 - NAMELESS) / named.sum() * named, [NAMELESS / 2, NAMELESS / 2])
    rank = np.concatenate([gains.ranks, np.ones(shows.sum()), [n - k, n - k]])[:, None]
    taken = np.vstack([gains.of_noise(y), y[shows] ** 2 / free[shows, None], total, total])
    size = np.append(np.full(len(rank) - 1, SIZE), LARGE)[:, None]
    # By effects whose coefficients are normal; the size of the noise is told by the poses' own and by the residuals.
    share = size**2 / (size**2 + rank)
    by_noise = noise.log_likelihood(np.vstack([total - share * taken, total]), n - k)
    likelier = 0.5 * rank * np.log1p(-share) + by_noise[:-1] - by_noise[-1]
    most = likelier.max(axis=0)
    log_mean = most + np.log(weights @ np.exp(likelier - most))
    as_large = float(np.mean(np.append(log_mean[1:] >= log_mean[0], True)))
    # Under noise its mean is 1, so that a large one is rarer than its inverse (Markov), which draws cannot show.
    return float(min(as_large, np.exp(-log_mean[0])))
