"""Effects of several recordings of one unit: in some of them, and between them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from triaxcal.arrays import Bools, Floats
from triaxcal.effects.contract import CLOCKS, RUN, SINCE_START, TIME, Coefficient, Effect, Meaning, no_slope, xyz

# A wrapper of another effect, which delegates everything that it does not override.


@dataclass(frozen=True, eq=False)
class Wrapped(Effect):
    """Delegates to the effect ``inner``. The default has one form, this one."""

    inner: Effect

    @property
    def name(self) -> str:
        return self.inner.name

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        return self.inner.coefficients

    @property
    def needs(self) -> tuple[str, ...]:
        return self.inner.needs

    @property
    def remedy(self) -> str:
        return self.inner.remedy

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self.inner.basis(s, covariates)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return self.inner.slope(s, covariates)

    def advice(self, largest: float, floor: float) -> str:
        return self.inner.advice(largest, floor)

    @property
    def meaning(self) -> Meaning | None:
        return self.inner.meaning

    @property
    def absent(self) -> str:
        return self.inner.absent

    @property
    def shape(self) -> Mapping[str, tuple[float, str]]:
        return self.inner.shape

    def shaped(self, values: Mapping[str, float]) -> Self:
        return replace(self, inner=self.inner.shaped(values))


# An effect of the clocks in some of several recordings of a unit, with its own
# coefficients in each.

NAMED = re.compile(r"(.+)_run([1-9]\d*)")


def of_clocks(effect: Effect) -> bool:
    """Whether an effect depends on the clocks alone, which restart in every
    recording."""
    return bool(effect.needs) and set(effect.needs) <= set(CLOCKS)


@dataclass(frozen=True)
class InRuns(Wrapped):
    """The effect ``inner`` in ``runs`` (0-based). It is zero in the others; an effect
    that is `Effect.lasting` has its initial value in earlier ones. ``x_run2`` is the
    coefficient x in the second recording.
    """

    runs: tuple[int, ...]

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        own = self.inner.coefficients
        return tuple(Coefficient(f"{c.name}_run{run + 1}", c.unit, c.part) for run in self.runs for c in own)

    @property
    def needs(self) -> tuple[str, ...]:
        return (*self.inner.needs, RUN)

    @property
    def absent(self) -> str:
        # A lasting effect begins in one run; its moment is on that run's clock.
        return self.inner.absent + (f" of recording {self.runs[0] + 1}" if self.inner.lasting else "")

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        parts = [np.where(active[:, None, None], self.inner.basis(s, c), 0.0) for active, c in self._by_run(covariates)]
        return np.concatenate(parts, axis=-1)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        parts = [
            np.where(active[:, None, None, None], self.inner.slope(s, c), 0.0) for active, c in self._by_run(covariates)
        ]
        return np.concatenate(parts, axis=-1)

    def _by_run(self, covariates: Mapping[str, Floats]) -> Iterator[tuple[Bools, Mapping[str, Floats]]]:
        """For each run: the poses (n,) in which the effect acts, and the covariates.
        Outside the run their clocks have the values of a unit in use, or of the time
        before a lasting effect."""
        index = covariates[RUN]
        for run in self.runs:
            outside = np.where((index < run) & self.inner.lasting, -np.inf, np.inf)
            values = dict(covariates)
            if TIME in values:
                values[TIME] = np.where(index == run, values[TIME], 0.0)
            if SINCE_START in values:
                values[SINCE_START] = np.where(index == run, values[SINCE_START], outside)
            yield (index == run) | (self.inner.lasting & (index < run)), values

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        return tuple(InRuns(v, self.runs) for v in self.inner.variants(longest_run(covariates, self.runs)))


def longest_run(covariates: Mapping[str, Floats], runs: Iterable[int]) -> dict[str, Floats]:
    """The covariates in the run with the most poses."""
    index = covariates[RUN]
    rows = max((index == run for run in runs), key=lambda poses: int(poses.sum()))
    return {name: values[rows] for name, values in covariates.items()}


def runs_named(coefficients: Iterable[str]) -> tuple[int, ...]:
    """The runs (0-based) in the names of coefficients; none for coefficients of all
    runs."""
    found = {int(match[2]) - 1 for name in coefficients if (match := NAMED.fullmatch(name))}
    return tuple(sorted(found))


# Bias and scale factor that differ between the recordings of a unit: their
# start-to-start repeatability.

_OF_RUNS = "q: one for each recording, their sum zero; where one recording alone differs, zero in the others"
_AGAINST_FIRST = "{by} in recording {n}, −{by} in recording 1"
ALONE = re.compile(r"[xyz]_run([1-9]\d*)_alone")


@dataclass(frozen=True)
class RunBias(Effect):
    """``e_i = q_ik`` in run k of ``runs``. In the first run it is minus the sum of the
    others, so the unit's bias is the mean over the recordings. ``x_run2`` is the
    coefficient of x in the second.

    With ``alone`` (0-based), e_i = q_i in that run and zero in all others, which have
    the unit's bias: ``x_run2_alone``.
    """

    runs: int = 2
    alone: int | None = None
    name: str = "run_bias"
    needs: tuple[str, ...] = (RUN,)
    unit: str = "g"
    remedy: str = (
        "The bias comes back anew at every start: allow for its spread, or correct it after each start by a few poses."
    )
    meaning = Meaning(
        clause="the bias comes back a little different at every start",
        because=(
            "What is switched off and on does not settle in quite the same place. It belongs to these "
            "recordings, not to the unit."
        ),
        formula="e = q",
        factors={"*": "1"},
        symbols=_OF_RUNS,
        in_run=_AGAINST_FIRST,
    )

    def advice(self, largest: float, floor: float) -> str:
        if self.alone is None:
            return self.remedy
        return f"Look for what was different in recording {self.alone + 1}: a knock, a pause, another temperature."

    def named(self, coefficients: Iterable[str]) -> Self:
        """The effect with coefficients of these names."""
        names = list(coefficients)
        alone = [int(match[1]) - 1 for name in names if (match := ALONE.fullmatch(name))]
        if alone:
            return replace(self, alone=alone[0])
        numbers = [int(name.rpartition("_run")[2]) for name in names if name.rpartition("_run")[2].isdecimal()]
        return replace(self, runs=max([2, *numbers]))

    @property
    def coefficients(self) -> tuple[Coefficient, ...]:
        if self.alone is not None:
            return xyz(self.unit, f"{{}}_run{self.alone + 1}_alone")
        return tuple(c for k in range(2, self.runs + 1) for c in xyz(self.unit, f"{{}}_run{k}"))

    @property
    def absent(self) -> str:
        if self.alone is not None:
            return f"in all recordings but recording {self.alone + 1}"
        return "in the mean over the recordings"

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return np.concatenate([c[:, None, None] * np.eye(3) for c in self._contrasts(covariates)], axis=2)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        return no_slope(s, len(self.coefficients))

    def _contrasts(self, covariates: Mapping[str, Floats]) -> list[Floats]:
        """(n,) for each run: the factor of its coefficients in each pose."""
        index = covariates[RUN]
        if self.alone is not None:
            return [(index == self.alone).astype(float)]
        return [(index == k).astype(float) - (index == 0) for k in range(1, self.runs)]

    def variants(self, covariates: Mapping[str, Floats]) -> Sequence[Effect]:
        """A value for each run, and, with more than two runs, one run that differs
        alone."""
        single = range(self.runs) if self.runs > 2 else ()
        return (self, *(replace(self, alone=run) for run in single))


@dataclass(frozen=True)
class RunScaleFactor(RunBias):
    """``e_i = q_ik s_i``, as `RunBias`: the unit's scale factor is the mean over the
    recordings."""

    name: str = "run_scale_factor"
    unit: str = "g/g"
    remedy: str = (
        "The scale factor comes back anew at every start, or goes with what nobody logged: log the temperature, and "
        "allow for its spread."
    )
    meaning = Meaning(
        clause="the scale factor comes back a little different at every start",
        because=(
            "What is switched off and on does not settle in quite the same place, or something that "
            "nobody logged was different. It belongs to these recordings, not to the unit."
        ),
        formula="e = q s",
        factors={"*": "s"},
        symbols=_OF_RUNS,
        in_run=_AGAINST_FIRST,
    )

    def basis(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        shares = self._contrasts(covariates)
        return np.concatenate([(c[:, None] * s)[:, :, None] * np.eye(3) for c in shares], axis=2)

    def slope(self, s: Floats, covariates: Mapping[str, Floats]) -> Floats:
        diagonal = np.zeros((3, 3, 3))
        diagonal[range(3), range(3), range(3)] = 1.0
        return np.concatenate([c[:, None, None, None] * diagonal for c in self._contrasts(covariates)], axis=3)


BETWEEN_RUNS: tuple[RunBias, ...] = (RunBias(), RunScaleFactor())
