"""Runs of equal readings: how long they are as a rule, and the longest ones."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from triaxcal.arrays import Bools, Floats, Ints

ROWS = 4
"""The three axes, and all of them together."""
LONGEST_COUNTED = 4096
"""Lengths that are counted each by itself; longer runs count as this long, and
are kept besides."""
KEPT_LEAST = 8
"""Samples in a run from which on it is kept by itself: shorter ones are common
in sound noise. A frozen output of fewer samples is not told."""
KEPT_MOST = 256
"""Longest runs that are kept of each row, which bounds the memory; all others
are counted."""
RUNS_LEAST = 200
"""Runs from which it is learned how long they are."""
FALSE_ALARM = 1e-4
"""Probability, in a stream, of a run by chance that is called a fault."""
MARGIN = 1.5
"""By which the tail may fall more slowly than was learned, from one run in a
thousand."""
SCALE_LEAST = 0.3
"""Samples over which the tail falls by a factor of e, at least: as though one
sample in 28 repeated, where fewer do. Errs on the side of calling nothing a
fault."""


@dataclass(frozen=True)
class EqualRun:
    """``samples`` equal readings in a row, from ``start_ns`` to ``end_ns``."""

    start_ns: int
    end_ns: int
    samples: int
    value: float


@dataclass
class RunLengths:
    """Fed chunks of the stream in order; a run may go on from chunk to chunk."""

    by_chance: float = 0.0
    """How often all axes are expected to repeat at once."""
    counts: Ints = field(default_factory=lambda: np.zeros((ROWS, LONGEST_COUNTED + 1), dtype=np.int64))
    _long: list[list[EqualRun]] = field(default_factory=lambda: [[] for _ in range(ROWS)])
    _fed: int = 0
    _start: list[int] = field(default_factory=lambda: [0] * ROWS)
    _start_ns: list[int] = field(default_factory=lambda: [0] * ROWS)
    _last: Floats = field(default_factory=lambda: np.zeros(3))
    _last_ns: int = 0

    def feed(self, time_ns: Ints, u: Floats) -> None:
        """``u`` (3,n)."""
        n = len(time_ns)
        changed = np.empty((ROWS, n), dtype=bool)
        changed[:3, 0] = u[:, 0] != self._last if self._fed else False
        np.not_equal(u[:, 1:], u[:, :-1], out=changed[:3, 1:])
        changed[3] = changed[0] | changed[1] | changed[2]
        if not self._fed:
            self._start_ns = [int(time_ns[0])] * ROWS
        for row in range(ROWS):
            at = np.flatnonzero(changed[row])
            if len(at):
                self._close(row, at, time_ns, u)
        self.by_chance += _by_chance(changed[:3])
        self._fed += n
        self._last, self._last_ns = u[:, -1].copy(), int(time_ns[-1])

    def _close(self, row: int, at: Ints, time_ns: Ints, u: Floats) -> None:
        """The runs that end before the changes at ``at``."""
        length = np.diff(at, prepend=self._start[row] - self._fed)
        self.counts[row] += np.bincount(np.minimum(length, LONGEST_COUNTED), minlength=LONGEST_COUNTED + 1)
        for i in np.flatnonzero(length >= KEPT_LEAST):
            before = int(at[i]) - 1
            start_ns = self._start_ns[row] if i == 0 else int(time_ns[at[i - 1]])
            end_ns = int(time_ns[before]) if before >= 0 else self._last_ns
            value = float(u[row % 3, before] if before >= 0 else self._last[row % 3])
            self._long[row].append(EqualRun(start_ns, end_ns, int(length[i]), value))
        self._long[row] = _longest(self._long[row], 2 * KEPT_MOST)
        self._start[row], self._start_ns[row] = self._fed + int(at[-1]), int(time_ns[at[-1]])

    def runs(self, row: int) -> list[EqualRun]:
        """The longest runs, by time, with the one that is not over yet."""
        last = self._fed - self._start[row]
        open_run = [EqualRun(self._start_ns[row], self._last_ns, last, float(self._last[row % 3]))] if last else []
        return sorted(_longest(self._long[row], 0) + open_run, key=lambda r: r.start_ns)

    def allowed(self, row: int) -> float:
        """The longest run that the noise makes, by how the tail of the run
        lengths falls; infinite where not known.

        Runs of a scattering output end at any sample with some chance, so that
        their tail is exponential at most. It is learned from how often samples
        repeat, and where one run in a hundred and one in a thousand end, which
        a frozen output does not shift.
        """
        counts = self.counts[row]
        total = int(counts.sum())
        if total < RUNS_LEAST:
            return float("inf")
        above = np.cumsum(counts)
        high, higher = (int(np.searchsorted(above, q * total)) for q in (0.99, 0.999))
        length = np.arange(1, higher + 1)
        usual = counts[1 : higher + 1]
        repeating = float(((length - 1) * usual).sum() / max((length * usual).sum(), 1))
        scale = max(SCALE_LEAST, (higher - high) / np.log(10.0), -1 / np.log(max(repeating, 1e-300)))
        return float(higher + MARGIN * scale * np.log(max(total / 1000, 1.0) / FALSE_ALARM))

    def repeated(self, row: int, most: float) -> tuple[int, int]:
        """Samples that repeat the one before, in runs of up to ``most``, and
        all samples in such runs."""
        upto = min(int(most), LONGEST_COUNTED - 1) + 1
        length = np.arange(upto)
        counts = self.counts[row, :upto]
        return int(((length - 1) * counts)[1:].sum()), int((length * counts).sum())


def _by_chance(changed: Bools) -> float:
    """From ``changed`` (3,n): what the other combinations of axes that repeat
    let expect, whatever any two axes have in common (the log-linear model
    without the interaction of all three; Bishop, Fienberg and Holland 1975).
    """
    n = np.bincount((~changed).astype(np.int8).T @ np.array([1, 2, 4], dtype=np.int8), minlength=8).astype(float)
    return float(n[0] * n[3] * n[5] * n[6] / np.maximum(n[[1, 2, 4]], 1.0).prod())


def _longest(found: list[EqualRun], unless: int) -> list[EqualRun]:
    if len(found) <= max(unless, KEPT_MOST):
        return found
    return sorted(found, key=lambda r: (-r.samples, r.start_ns))[:KEPT_MOST]
