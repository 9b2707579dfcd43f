"""How likely effects are, and of which size, before any pose was seen: what the
posterior of a diagnosis and the budget of a fit have in common."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

EFFECT_ODDS = 0.3
"""That some effect of the catalogue acts, shared evenly among the names that
can; a second one likewise."""
ON_ONE_AXIS, ON_TWO_AXES = 0.25, 0.25
"""Of an effect with a part for each axis: usually, in the half that is left, one
mechanism acts on all of them."""
SMALLEST = 0.1
"""Size of the least effect, of the noise of a pose: what is less shows in no
data."""
SIZES = 9
"""Steps from there to the largest, even in the logarithm: a factor of 3 to 5,
within which the evidence hardly changes."""
AXES = 3
"""The sensitive axes, and the components of a vector."""


def on_axes(
    parts: Sequence[str], one: float = ON_ONE_AXIS, two: float = ON_TWO_AXES
) -> Iterator[tuple[tuple[int, ...], float]]:
    """Of coefficients that belong to these parts, which are free, and with which
    share of the prior; ``one`` and ``two`` are those of one axis and of two."""
    labels = list(dict.fromkeys(parts))
    whole = tuple(range(len(parts)))
    if len(labels) == 1:
        yield whole, 1.0
        return
    two = two if len(labels) == AXES else 0.0
    yield whole, 1 - one - two

    def of(some: Sequence[str]) -> tuple[int, ...]:
        return tuple(i for i, part in enumerate(parts) if part in some)

    for label in labels:
        yield of([label]), one / len(labels)
    if two:
        for pair in combinations(labels, 2):
            yield of(pair), two / AXES
