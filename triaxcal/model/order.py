"""In which order to take poses, so that what happens in time does not pass for
what happens with direction.

A unit drifts, warms up, and remembers the pose before. In an unlucky order such
an effect looks like nonlinearity, or hides in the nine linear parameters, and
nobody can tell them apart afterwards. The order is chosen by a Bayesian
A-criterion (DuMouchel and Jones 1994, Technometrics 36:37): the smallest sum of
the posterior variances of everything that may be there beside the nine
parameters, each with a prior of its own size.
"""

from __future__ import annotations

import numpy as np

from triaxcal.arrays import Floats, Ints

PRIOR = np.repeat([10.0, 1.0, 10.0, 0.3, 0.3, 0.3], 3)
"""Prior standard deviations, in standard errors of one pose: of second order,
third order, steady drift, drift that bends, scale factors that drift, and
hysteresis. Second order and steady drift are to be distinguished whatever they
are, since one fakes the other in real recordings; the rest where poses are left
to do it with."""
STARTS, ROWS_MOST, STEPS_MOST = 4, 12000, 80
"""Searches from different orders (one for a large plan); rows of trial orders
that one step of a search looks at."""
SURE = 1e-9
"""Orders that differ by less than this are the same, whatever the processor
makes of the last digits."""


def in_order(a: Floats, *, attached: Floats | None = None, kind: Ints | None = None) -> Ints:
    """(n,) the rows of ``a`` (n,3) in the order to take them, the first row
    first; it is repeated at the end.

    ``attached`` (n,q): columns of effects that are looked for in any case and
    go with their row. Rows change places only with rows of the same ``kind``
    (n,). Deterministic.
    """
    n = len(a)
    kind = np.zeros(n, dtype=int) if kind is None else kind
    first, second = np.triu_indices(n - 1, 1)
    pairs = np.stack([first, second], axis=1) + 1
    pairs = pairs[kind[pairs[:, 0]] == kind[pairs[:, 1]]]
    best: tuple[float, Ints] = (np.inf, np.arange(n))
    for seed in range(STARTS if len(pairs) <= ROWS_MOST // n else 1) if len(pairs) else ():
        rng = np.random.default_rng(seed)
        order = _shuffled(kind, rng)
        found = _descended(a, attached, order, pairs, rng)
        if found[0] < best[0] - SURE:
            best = found
    return best[1]


def _shuffled(kind: Ints, rng: np.random.Generator) -> Ints:
    order = np.arange(len(kind))
    for k in np.unique(kind):
        places = np.flatnonzero(kind == k)
        places = places[places > 0]
        order[places] = rng.permutation(places)
    return order


def _descended(
    a: Floats, attached: Floats | None, order: Ints, pairs: Ints, rng: np.random.Generator
) -> tuple[float, Ints]:
    """Swaps of two until none helps; of a large plan a sample of the swaps, for
    a limited number of steps."""
    n = len(order)
    some = max(ROWS_MOST // n, 8)
    least = float(_criterion(a, attached, order[None])[0])
    for _ in range(STEPS_MOST if n < 200 else STEPS_MOST // 4):
        tried = pairs if len(pairs) <= some else rng.permutation(pairs)[:some]
        trials = np.tile(order, (len(tried), 1))
        each = np.arange(len(tried))
        trials[each, tried[:, 0]], trials[each, tried[:, 1]] = order[tried[:, 1]], order[tried[:, 0]]
        values = _criterion(a, attached, trials)
        at = int(np.argmax(values <= values.min() + SURE))
        if values[at] < least - SURE:
            least, order = float(values[at]), trials[at]
        elif len(pairs) <= some:
            break
    return least, order


def _criterion(a: Floats, attached: Floats | None, orders: Ints) -> Floats:
    """(m,) for orders (m,n): the sum of the variances, the first pose repeated
    at the end."""
    closed = np.concatenate([orders, orders[:, :1]], axis=1)
    b = a[closed]
    time = np.linspace(-1, 1, closed.shape[1])[:, None]
    before = np.concatenate([b[:, :1], b[:, :-1]], axis=1)
    linear = [b[..., :1] * b, b[..., 1:2] * b[..., 1:], b[..., 2:] ** 2, b]
    asked = [] if attached is None else [attached[closed]]
    suspected = [b**3, b**4, time * b, time**2 * b, time * b**2, before * b]
    X = np.concatenate([*linear, *asked, *suspected], axis=2)
    precision = np.zeros(X.shape[2])
    precision[-len(PRIOR) :] = 1 / PRIOR**2
    information = np.swapaxes(X, 1, 2) @ X + np.diag(precision)
    variance = np.diagonal(np.linalg.inv(information), axis1=1, axis2=2)
    return np.asarray(variance[:, 9:].sum(axis=1))
