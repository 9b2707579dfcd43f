"""Fleets of simulated units at the level of poses and coefficients, with undeclared effects of places, or none.

A world is a year of one part number: units in batches, at stations with fixtures of four slots, by operators, in two
shifts. Its units differ by a distribution of their own. What a place does is physics: it acts on the poses, and the
nine coefficients take what they absorb of it. The size of an effect is in spreads between units.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from triaxcal.planning import directions
from triaxcal.population.runs import PlaceKind, SeenEffect, SeenPoses, UnitRun
from triaxcal.population.statements import Place, PlacedEffects, Statement, Verdict

YEAR_S = 365.25 * 86400.0
SPREAD = np.array([6e-3] * 3 + [3e-3] * 3 + [4e-3] * 3)
"""Between units: relative, rad, g."""
COUNTS = 4096.0
"""Of a converter for 1 g."""
MOUNTED_RAD = 2e-3
"""Of a unit's axes against its faces."""
HELD_RAD = 4e-3
"""Of a pose against the plan."""
PER_K = np.array([1e-4] * 3 + [0.0] * 3 + [6e-4] * 3)
"""Spread of the temperature coefficients: relative, -, g/K."""
EFFECTS = ("third_order_nonlinearity", "hysteresis", "warm_up")
OPERATORS, SLOTS = 4, 4


@dataclass(frozen=True)
class Undeclared:
    """An effect of a place: what it does, ``kind`` and ``name`` of the place, the time as shares of the year, its
    ``size`` in spreads, and the kinds of figures that show it."""

    what: str
    kind: PlaceKind
    name: str
    since: float
    until: float
    size: float
    shows: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class World:
    runs: list[UnitRun]
    truths: tuple[Undeclared, ...] = ()
    inside: Mapping[int, np.ndarray] = field(default_factory=dict)
    """(N,) runs in which each acts."""


@dataclass(eq=False)
class _Draft:
    """Arrays of a world before its poses: one row a run."""

    rng: np.random.Generator
    time: np.ndarray
    labels: dict[PlaceKind, np.ndarray]
    hour: np.ndarray
    unit: np.ndarray
    shift: np.ndarray
    """(N,9) of the coefficients: relative, rad, g."""
    scatter: np.ndarray
    rotation: np.ndarray
    probe_k: np.ndarray
    rate: np.ndarray
    """(N,3) of `EFFECTS`."""
    of_effect: np.ndarray
    """(N,) added to the coefficient of an effect."""
    residual: list[Callable[[np.ndarray, np.ndarray], np.ndarray] | None]
    """(n,) g of |a|, by readings (n,3) and directions (n,3)."""


def world(
    seed: int,
    effects: int = 0,
    units: int = 500,
    *,
    batches: int = 5,
    kinds: tuple[str, ...] | None = None,
    sizes: tuple[float, float] = (2.0, 10.0),
    poses: int = 26,
) -> World:
    """A year of ``units``, with so many undeclared effects."""
    rng = np.random.default_rng(seed)
    draft = _draft(rng, units, batches)
    truths, inside = [], {}
    names = list(kinds or KINDS)
    while len(truths) < effects:
        what = str(rng.choice(names))
        found = _undeclared(draft, what, float(np.exp(rng.uniform(*np.log(sizes)))))
        if found is None or any((found.kind, found.name) == (t.kind, t.name) for t in truths):
            continue
        inside[len(truths)] = acting(draft, found)
        KINDS[what](draft, inside[len(truths)], found.size)
        truths.append(found)
    order = np.argsort(draft.time)
    return World(_runs(draft, poses, order), tuple(truths), {k: i[order] for k, i in inside.items()})


BROKEN_SPREADS, LAST_RUNS = 15.0, 3
"""Of one coefficient of a broken unit, and the runs at the end of which one is of it."""


def with_broken_end(made: World, seed: int) -> World:
    """One of the last runs is of a broken unit: no effect of a place."""
    rng = np.random.default_rng(seed)
    i, k = len(made.runs) - 1 - int(rng.integers(LAST_RUNS)), int(rng.integers(9))
    size = BROKEN_SPREADS * SPREAD[k] * (COUNTS if k < 3 else 1.0) * rng.choice([-1, 1])
    runs = list(made.runs)
    runs[i] = replace(runs[i], coefficients=runs[i].coefficients + size * np.eye(9)[k])
    return replace(made, runs=runs)


def _draft(rng: np.random.Generator, units: int, batches: int) -> _Draft:
    # A few units come again, on another day.
    again = rng.integers(0, units, size=units // 25)
    unit = np.concatenate([np.arange(units), again])
    time = np.concatenate([np.sort(rng.uniform(0, 1, units)), rng.uniform(0.05, 1, len(again))])
    n = len(unit)
    # Batches follow each other, and overlap.
    place = np.clip(time[unit] + rng.normal(0, 0.06, n)[unit], 0, 0.999)
    batch = np.array([f"B{int(b)}" for b in place * batches])
    # Fixtures stay, or move to the other station once.
    fixture = rng.integers(0, 3, n)
    moved = rng.uniform(0.3, 0.7) if rng.random() < 0.5 else 2.0
    station = np.where(fixture < 2, np.where((fixture == 1) & (time > moved), 1, 0), 1)
    early = rng.random(n) < 0.5
    hour = np.where(early, rng.uniform(6, 14, n), rng.uniform(14, 22, n))
    # Operators keep to a shift, mostly.
    operator = np.where(rng.random(n) < 0.85, early * 2, (1 - early) * 2) + rng.integers(0, 2, n)
    names = np.array([f"F{k}" for k in fixture])
    slot = np.array([f"F{k}/s{s}" for k, s in zip(fixture, rng.integers(0, SLOTS, n), strict=True)])
    labels = {
        PlaceKind.BATCH: batch,
        PlaceKind.STATION: np.array([f"S{k}" for k in station]),
        PlaceKind.FIXTURE: names,
        PlaceKind.SLOT: slot,
        PlaceKind.OPERATOR: np.array([f"O{k}" for k in operator]),
    }
    zero = np.zeros((n, 9))
    rate = np.tile([0.05, 0.03, 0.02], (n, 1))
    return _Draft(
        rng, time, labels, hour, unit, zero.copy(), np.ones((n, 9)), np.zeros((n, 3)), np.zeros(n), rate, np.zeros(n),
        [None] * n,
    )  # fmt: skip


# What a place does.


def _one(draft: _Draft, inside: np.ndarray, size: float) -> None:
    k = int(draft.rng.integers(9))
    draft.shift[inside, k] += draft.rng.choice([-1, 1]) * size * SPREAD[k]


def _mix(draft: _Draft, inside: np.ndarray, size: float) -> None:
    v = draft.rng.normal(size=9)
    draft.shift[inside] += size * SPREAD * v / np.linalg.norm(v)


def _gravity(draft: _Draft, inside: np.ndarray, size: float) -> None:
    draft.shift[inside, :3] += draft.rng.choice([-1, 1]) * size * SPREAD[0]


def _stand(draft: _Draft, inside: np.ndarray, size: float) -> None:
    v = draft.rng.normal(size=3)
    draft.rotation[inside] += size * MOUNTED_RAD * v / np.linalg.norm(v)


def _probe(draft: _Draft, inside: np.ndarray, size: float) -> None:
    draft.probe_k[inside] += draft.rng.choice([-1, 1]) * size * SPREAD[6] / PER_K[6]


NOISE_G = 3e-5
"""Of |a| in a pose."""
WAVE_G = NOISE_G / np.sqrt(6.0)
"""Spread of a wave's amplitude: noise over the root of the poses that carry it, less what the nine absorb."""


def _bit(draft: _Draft, inside: np.ndarray, size: float) -> None:
    axis, bit = int(draft.rng.integers(3)), int(draft.rng.integers(3, 12))
    amplitude = size * WAVE_G * np.pi / 4

    def add(u: np.ndarray, a: np.ndarray) -> np.ndarray:
        square = np.where(np.floor(u[:, axis] / 2**bit).astype(int) % 2, 1.0, -1.0)
        return amplitude * square * a[:, axis]

    for i in np.flatnonzero(inside):
        draft.residual[i] = add


def _magnet(draft: _Draft, inside: np.ndarray, size: float) -> None:
    """Something of the third degree in the direction."""
    v = draft.rng.normal(size=3)
    v /= np.linalg.norm(v)

    def add(u: np.ndarray, a: np.ndarray) -> np.ndarray:
        return 4 * size * WAVE_G * (a @ v) ** 3

    for i in np.flatnonzero(inside):
        draft.residual[i] = add


def _scatter(draft: _Draft, inside: np.ndarray, size: float) -> None:
    if draft.rng.random() < 0.5:
        draft.scatter[inside, int(draft.rng.integers(9))] *= size
    else:
        draft.scatter[inside] *= size


def _drift(draft: _Draft, inside: np.ndarray, size: float) -> None:
    k, t = int(draft.rng.integers(9)), draft.time
    ramp = (t - t[inside].min()) / (1 - t[inside].min())
    draft.shift[inside, k] += draft.rng.choice([-1, 1]) * 2 * size * SPREAD[k] * ramp[inside]


def _frequency(draft: _Draft, inside: np.ndarray, size: float) -> None:
    k = int(draft.rng.integers(3))
    draft.rate[inside, k] = np.maximum(draft.rate[inside, k], min(0.1 + 0.08 * size, 0.9))


def _coefficient_of_effect(draft: _Draft, inside: np.ndarray, size: float) -> None:
    draft.of_effect[inside] += size


KINDS: dict[str, Callable[[_Draft, np.ndarray, float], None]] = {
    "one coefficient": _one, "a combination": _mix, "gravity": _gravity, "bent stand": _stand, "probe": _probe,
    "bad bit": _bit, "magnet": _magnet, "scatter": _scatter, "drift": _drift, "frequency": _frequency,
    "coefficient of an effect": _coefficient_of_effect,
}  # fmt: skip
SHOWS = {
    "one coefficient": ("coefficients",), "a combination": ("coefficients",), "gravity": ("coefficients",),
    "bent stand": ("directions",), "probe": ("coefficients",), "bad bit": ("converter", "poses"),
    "magnet": ("poses", "converter", "coefficients"), "scatter": ("coefficients",), "drift": ("coefficients",),
    "frequency": ("effect",), "coefficient of an effect": ("effect",),
}  # fmt: skip
OF = {
    "bent stand": (PlaceKind.FIXTURE, PlaceKind.SLOT), "probe": (PlaceKind.STATION, PlaceKind.FIXTURE),
    "bad bit": (PlaceKind.BATCH,), "gravity": (PlaceKind.STATION,),
    "drift": (PlaceKind.STATION, PlaceKind.FIXTURE), "magnet": (PlaceKind.FIXTURE, PlaceKind.SLOT, PlaceKind.STATION),
}  # fmt: skip
LEAST = 15
"""Runs of an effect, and without it: fewer are no place."""


def _undeclared(draft: _Draft, what: str, size: float) -> Undeclared | None:
    rng = draft.rng
    kind = OF[what][rng.integers(len(OF[what]))] if what in OF else list(PlaceKind)[rng.integers(len(PlaceKind))]
    since, until = 0.0, 1.0
    how = rng.random()
    if what != "drift" and (kind is PlaceKind.EVERYWHERE or (kind is not PlaceKind.BATCH and how < 0.5)):
        since = float(rng.uniform(0.2, 0.8))
        if how < 0.1:
            until = float(min(since + rng.uniform(0.15, 0.4), 1.0))
    if kind is PlaceKind.HOUR:
        first, length = int(rng.integers(6, 20)), int(rng.choice([2, 4, 8]))
        name = f"{first}-{(first + length - 1) % 24 + 1}"
    else:
        name = "" if kind is PlaceKind.EVERYWHERE else str(rng.choice(np.unique(draft.labels[kind])))
    found = Undeclared(what, kind, name, since, until, size, SHOWS[what])
    runs = acting(draft, found).sum()
    return found if LEAST <= runs <= len(draft.time) - LEAST else None


def acting(draft: _Draft, truth: Undeclared) -> np.ndarray:
    inside = (draft.time >= truth.since) & (draft.time <= truth.until)
    return np.asarray(inside & of_place(truth.kind, truth.name, draft.labels, draft.hour))


def of_place(kind: PlaceKind, name: str, labels: Mapping[PlaceKind, np.ndarray], hour: np.ndarray) -> np.ndarray:
    """(N,) runs of a place."""
    if kind is PlaceKind.EVERYWHERE:
        return np.ones(len(hour), dtype=bool)
    if kind is PlaceKind.HOUR:
        first, end = map(int, name.split("-"))
        length = (end - first - 1) % 24 + 1
        return np.asarray((np.floor(hour) - first) % 24 < length)
    return np.asarray(labels[kind] == name)


# The runs.


def _runs(draft: _Draft, poses: int, order: np.ndarray) -> list[UnitRun]:
    rng, _n = draft.rng, len(draft.time)
    units = int(draft.unit.max()) + 1
    # How units differ: normal, with heavier tails, or skew; correlated; a few are broken.
    kind = rng.integers(3)
    own = rng.normal(size=(units, 9))
    if kind == 1:
        own = rng.standard_t(6, size=(units, 9)) / np.sqrt(1.5)
    if kind == 2:
        own = (rng.gamma(8.0, size=(units, 9)) - 8.0) / np.sqrt(8.0)
    mixed = np.linalg.cholesky(0.4 * np.ones((3, 3)) + 0.6 * np.eye(3))
    own = np.concatenate([own[:, :3] @ mixed.T, own[:, 3:]], axis=1)
    broken = rng.random(units) < 0.01
    own[broken] *= 6
    per_k = rng.normal(size=(units, 9)) * PER_K
    mounted = rng.normal(size=(units, 3)) * MOUNTED_RAD
    has = rng.random((units, 3))
    plan = np.array([v for _, v in directions(poses)], dtype=float)
    plan /= np.linalg.norm(plan, axis=1, keepdims=True)
    out = []
    for i in order:
        u = draft.unit[i]
        true = own[u] * SPREAD * draft.scatter[i] + draft.shift[i] - per_k[u] * draft.probe_k[i]
        true = true + rng.normal(size=9) * SPREAD * 0.01
        held = plan + np.cross(rng.normal(size=(poses, 3)) * HELD_RAD + mounted[u] + draft.rotation[i], plan)
        held /= np.linalg.norm(held, axis=1, keepdims=True)
        noise = rng.normal(size=poses) * NOISE_G
        readings = COUNTS * (1 + true[:3]) * (held + true[6:])
        delta = noise if (add := draft.residual[i]) is None else noise + add(readings, held)
        # The nine take what they absorb.
        x, y, z = held.T
        jacobian = np.stack([x * x, y * y, z * z, y * z, x * z, x * y, x, y, z], axis=1)
        absorbed, *_ = np.linalg.lstsq(jacobian, delta, rcond=None)
        covariance = np.linalg.inv(jacobian.T @ jacobian) * NOISE_G**2
        fitted, error = true + absorbed, np.sqrt(np.diag(covariance))
        coefficients = np.concatenate([COUNTS * (1 + fitted[:3]), fitted[3:]])
        errors = np.concatenate([COUNTS * error[:3], error[3:]])
        effects = {}
        for k, name in enumerate(EFFECTS):
            acts = has[u, k] < draft.rate[i, k]
            p = 1 - 10 ** rng.uniform(-4, -1.2) if acts else 10 ** rng.uniform(-4.5, -2.2)
            value = 1.0 + 0.1 * rng.normal() if acts else 0.0
            effects[name] = SeenEffect(float(p), {"x": (value, 0.02)} if acts else {}, 0.3 / 23)
        # Everybody has coefficients of temperature.
        seen_per_k = per_k[u] + np.eye(9)[6] * draft.of_effect[i] * PER_K[6]
        effects["temperature_bias"] = SeenEffect(
            0.999, {a: (float(seen_per_k[6 + k] + rng.normal() * 1e-5), 1e-5) for k, a in enumerate("xyz")}, 0.3 / 23
        )
        effects["temperature_scale_factor"] = SeenEffect(
            0.999, {a: (float(per_k[u, k] + rng.normal() * 1e-5), 1e-5) for k, a in enumerate("xyz")}, 0.3 / 23
        )
        batch, station, fixture, slot, operator = (
            str(draft.labels[k][i])
            for k in (PlaceKind.BATCH, PlaceKind.STATION, PlaceKind.FIXTURE, PlaceKind.SLOT, PlaceKind.OPERATOR)
        )
        out.append(
            UnitRun(
                serial=f"U{u:05d}", time_s=float(draft.time[i] * YEAR_S), coefficients=coefficients,
                standard_errors=errors, part_number="P1", batch=batch, station=station, fixture=fixture,
                slot=slot.rpartition("/")[2], operator=operator, hour=float(draft.hour[i]), effects=effects,
                poses=SeenPoses(readings, delta - jacobian @ absorbed, np.full(poses, NOISE_G), held, plan),
                resolution=1.0,
                figures={"temperature": (23.0 + draft.probe_k[i] + float(rng.normal()), 0.1)},
            )
        )  # fmt: skip
    return out


# What a model says of a world.


@dataclass(frozen=True)
class Judgement:
    """Of one truth: ``named`` if a statement has its place alone, ``listed`` if a statement or a candidate has it among
    its places, ``pattern`` if in one of these the figures that show it are the likeliest; ``since_off_s`` is how far
    the change is off. ``statements`` are all of this truth's places."""

    named: bool
    listed: bool
    pattern: bool
    since_off_s: float | None
    statements: tuple[Statement, ...]


SAME = 0.9
"""Share of runs that two places have in common if they are one: hours that nobody works at are in either."""


def judged(made: World, k: int, found: PlacedEffects) -> Judgement:
    truth, inside = made.truths[k], made.inside[k]
    labels = {kind: np.array([run.place(kind) or "" for run in made.runs]) for kind in PlaceKind}
    hour = np.array([run.hour or 0.0 for run in made.runs])
    time = np.array([run.time_s for run in made.runs])

    def is_truth(statement: Statement, place: Place) -> bool:
        """Whether it is the place, or has the same runs in the time of the statement."""
        if (place.kind, place.name) == (truth.kind, truth.name):
            return True
        during = np.ones(len(time), dtype=bool)
        if statement.since_s is not None:
            during &= time >= statement.since_s
        if statement.until_s is not None:
            during &= time <= statement.until_s
        mine = of_place(place.kind, place.name, labels, hour) & during
        return bool((mine & inside).sum() > SAME * (mine | inside).sum())

    said = (*found.statements, *found.candidates)
    of_place_ = [s for s in said if any(is_truth(s, place) for place in s.places)]
    of_figures = [s for s in of_place_ if s.pattern.kind.value in truth.shows]
    known = [s for s in of_figures if s.verdict is not Verdict.CANDIDATE]
    off = None
    if truth.since > 0 and known and known[0].since_s is not None:
        off = known[0].since_s - truth.since * YEAR_S
    return Judgement(
        any(s.verdict is Verdict.NAMED for s in of_figures),
        bool(of_place_),
        bool(of_figures),
        off,
        tuple(of_place_),
    )
