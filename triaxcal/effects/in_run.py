"""An effect of the clocks in some of several recordings of a unit, with
coefficients of its own in each."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from triaxcal.arrays import Bools, Floats
from triaxcal.effects.contract import CLOCKS, RUN, SINCE_START, TIME, Coefficient, Effect
from triaxcal.effects.wrapped import Wrapped

NAMED = re.compile(r"(.+)_run([1-9]\d*)")


def of_clocks(effect: Effect) -> bool:
    """Whether an effect depends on nothing but the clocks, which start anew in
    every recording."""
    return bool(effect.needs) and set(effect.needs) <= set(CLOCKS)


@dataclass(frozen=True)
class InRuns(Wrapped):
    """``whole`` in ``runs`` (0-based); in the others it is zero, or, where it
    is `Effect.lasting`, what it was before in earlier ones. Coefficients are
    named ``x_run2`` for x in the second recording.
    """

    runs: tuple[int, ...]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        own = self.whole.coefficients
        return tuple(Coefficient(f"{c.name}_run{run + 1}", c.unit, c.part) for run in self.runs for c in own)

    @property
    def needs(self) -> tuple[str, ...]:
        return (*self.whole.needs, RUN)

    @property
    def absent(self) -> str:
        # What lasts begins in one run, by whose clock its moment is reckoned.
        return self.whole.absent + (f" of recording {self.runs[0] + 1}" if self.whole.lasting else "")

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        parts = [np.where(there[:, None, None], self.whole.basis(s, c), 0.0) for there, c in self._by_run(covariates)]
        return np.concatenate(parts, axis=-1)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        parts = [
            np.where(there[:, None, None, None], self.whole.slope(s, c), 0.0) for there, c in self._by_run(covariates)
        ]
        return np.concatenate(parts, axis=-1)

    def _by_run(self, covariates: Mapping[str, Floats]) -> Iterator[tuple[Bools, Mapping[str, Floats]]]:
        """For each run: where it acts (n,), and covariates whose clocks stand
        outside the run as they do in use."""
        index = covariates[RUN]
        for run in self.runs:
            outside = np.where((index < run) & self.whole.lasting, -np.inf, np.inf)
            held = dict(covariates)
            if TIME in held:
                held[TIME] = np.where(index == run, held[TIME], 0.0)
            if SINCE_START in held:
                held[SINCE_START] = np.where(index == run, held[SINCE_START], outside)
            yield (index == run) | (self.whole.lasting & (index < run)), held

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        return tuple(InRuns(v, self.runs) for v in self.whole.variants(longest(covariates, self.runs)))


def longest(covariates: Mapping[str, Floats], runs: Iterable[int]) -> dict[str, Floats]:
    """The covariates in that of the runs which has the most poses."""
    index = covariates[RUN]
    rows = max((index == run for run in runs), key=lambda there: int(there.sum()))
    return {name: values[rows] for name, values in covariates.items()}


def runs_named(coefficients: Iterable[str]) -> tuple[int, ...]:
    """The runs (0-based) that names of coefficients speak of; none where they
    speak of all alike."""
    found = {int(match[2]) - 1 for name in coefficients if (match := NAMED.fullmatch(name))}
    return tuple(sorted(found))
