"""Prior odds and sizes of effects, before any pose: the posterior of a diagnosis and
the budget of a fit share them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

EFFECT_ODDS = 0.3
"""Odds that some effect of the catalogue acts, shared evenly among the possible names;
also of a second effect."""
ON_ONE_AXIS, ON_TWO_AXES = 0.25, 0.25
"""Probabilities for an effect with a part for each axis. In the remaining half one
mechanism acts on all axes, as is usual."""
SMALLEST = 0.1
"""Size of the smallest effect, in noises of a pose: no data show a smaller one."""
SIZES = 9
"""Number of sizes up to the largest, even in the logarithm: steps by a factor of 3 to
5, within which the evidence hardly changes."""
AXES = 3
"""The sensitive axes, and the components of a vector."""


def on_axes(
    parts: Sequence[str], one: float = ON_ONE_AXIS, two: float = ON_TWO_AXES
) -> Iterator[tuple[tuple[int, ...], float]]:
    """The sets of free coefficients, by index, each with its share of the prior.

    ``parts`` has the part of each coefficient. ``one`` and ``two`` are the shares of
    effects on one axis and on two axes."""
    labels = list(dict.fromkeys(parts))
    every = tuple(range(len(parts)))
    if len(labels) == 1:
        yield every, 1.0
        return
    two = two if len(labels) == AXES else 0.0
    yield every, 1 - one - two

    def free(some: Sequence[str]) -> tuple[int, ...]:
        return tuple(i for i, part in enumerate(parts) if part in some)

    for label in labels:
        yield free([label]), one / len(labels)
    if two:
        for pair in combinations(labels, 2):
            yield free(pair), two / AXES
