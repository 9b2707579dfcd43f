"""Eight units with an effect that none shows alone: how often it is certain of all together.

    python -m benchmarks.several_units [--sessions 40] [--nothing 300]

Each unit is held in 26 directions in an order of its own; the effect has three free coefficients, of a random direction
and a size of s = 3 in every unit: so many standard errors beside the nine linear parameters. They have values of their
own, or one for all. Sessions with nothing inside should find nothing.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks.processes import one_thread
from benchmarks.table import Table
from triaxcal.effects import effect_named
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence import posterior_of
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.pooled import pool
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses

UNITS, NOISE_G, STRENGTH = 8, 2e-5, 3.0
SIGNS = (1.0, 1.0, 1.0)
EFFECTS = ("temperature_bias", "second_order_nonlinearity", "hysteresis", "third_order_nonlinearity")
CERTAIN = 0.99


def poses_of(rng: np.random.Generator, name: str, along: np.ndarray | None) -> list[Pose]:
    """Of one unit; ``along`` (3,) is the direction of the coefficients, None for nothing inside."""
    ups = rng.permutation(np.array([up for _, up in directions(26)]))
    warm = {"temp_c": 25 + rng.standard_normal() + np.cumsum(rng.standard_normal(len(ups)))}
    unit = Sensor(1 + 0.02 * rng.standard_normal(3), 0.01 * rng.standard_normal(3), 0.02 * rng.standard_normal(3))
    noise = int(rng.integers(2**32))

    def made(coefficients: np.ndarray | None) -> list[Pose]:
        effects = () if coefficients is None else ((effect_named(name), coefficients),)
        return noisy_poses(
            replace(unit, effects=effects),
            ups,
            NOISE_G,
            np.random.default_rng(noise),
            channels=warm,
            channel_reference={"temp_c": 25.0},
        )

    if along is None:
        return made(None)
    bare = made(None)
    rows = LinearisedData.of(bare, fit(bare, signs=SIGNS), SIGNS)
    shown = rows.beyond_linear(rows.by_coefficients(effect_named(name)) @ along)
    return made(along * STRENGTH / float(np.linalg.norm(shown)))


@dataclass(frozen=True)
class Told:
    """That something ``acts``, in some unit, for certain; ``groups`` of names of which one acts in all for certain; and
    whether the values of the ``true`` effect are ``common``."""

    true: str
    acts: bool
    groups: tuple[tuple[str, ...], ...]
    common: bool


def session(kind: str, seed: int) -> Told:
    rng = np.random.default_rng((seed, ("own", "common", "nothing").index(kind)))
    name = EFFECTS[seed % len(EFFECTS)]
    common = rng.standard_normal(3)
    units = []
    for _ in range(UNITS):
        along = {"own": rng.standard_normal(3), "common": common, "nothing": None}[kind]
        poses = poses_of(rng, name, along)
        units.append(posterior_of(poses, fit(poses, signs=SIGNS), signs=SIGNS).resized(0.1 * NOISE_G))
    found = pool(units)
    return Told(name, found.nothing <= 1 - CERTAIN, found.certain(CERTAIN), found.common.get(name, 0.0) > 0.5)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=40, help="with values of their own, and with common ones")
    parser.add_argument("--nothing", type=int, default=300, help="with nothing inside")
    parser.add_argument("--jobs", type=int, default=2, help="processes")
    options = parser.parse_args(arguments)
    rows = []
    with ProcessPoolExecutor(options.jobs, initializer=one_thread) as pool:
        for kind, count in (("own", options.sessions), ("common", options.sessions), ("nothing", options.nothing)):
            found = list(pool.map(partial(session, kind), range(count)))
            acts = sum(f.acts for f in found)
            listed = sum(any(f.true in group for group in f.groups) for f in found)
            alone = sum(f.groups == ((f.true,),) for f in found)
            wrong = sum(bool(f.groups) and not any(f.true in group for group in f.groups) for f in found)
            named = [listed, alone, wrong] if kind != "nothing" else [0, 0, sum(bool(f.groups) for f in found)]
            rows.append([kind, str(count), str(acts), *map(str, named), str(sum(f.common for f in found))])
            head = ["values", "sessions", "something acts", "listed", "named alone", "wrong", "called common"]
            print(Table("So far", head, rows), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
