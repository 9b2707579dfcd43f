"""The frame of the mounting faces against the bound: errors over seeds, coverage, and what is left where it fails.

`python benchmarks/frame.py [SEEDS]`; a thousand seeds take about a minute. The bound is the covariance that the result
states with the noise known, which the tests hold against a Cramér–Rao bound of the whole nonlinear model.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.spatial.transform import Rotation

from triaxcal.arrays import Floats
from triaxcal.estimate.pose_fit import fit
from triaxcal.frames.faces import AXES, LABELS, nearest_rotation, recognise
from triaxcal.frames.orientations import Assumed, verticals
from triaxcal.frames.standing import stand
from triaxcal.frames.unit_frames import SyntheticFixture, frames
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import noisy_poses

SENSOR = Sensor(
    np.array([-2.410618, -2.403823, -2.371761]),
    np.array([625.454406e-5, 404.734018e-5, -65.046441e-5]),
    np.array([564.518583e-5, -288.4559e-5, 463.952349e-5]),
)
NO_FACE = [v for label, v in directions(26) if len(label) > 2]
CASES = {
    "faces and table 1 mrad": {},
    "noise 1e-6 g": {"sigma": 1e-6},
    "noise 1e-4 g": {"sigma": 1e-4},
    "faces and table perfect": {"face": 0.0, "tilt": 0.0},
    "faces and table 5 mrad": {"face": 5e-3, "tilt": 5e-3},
    "half turns off by 1 mrad": {"turn": 1e-3},
    "half turns off by 1°": {"turn": np.radians(1)},
    "seatings 20 µrad": {"seating": 2e-5},
    "seatings 100 µrad": {"seating": 1e-4},
}


def one(
    seed: int, *, sigma: float = 1e-5, face: float = 1e-3, tilt: float = 1e-3, turn: float = 0.0, seating: float = 0.0
) -> tuple[Floats, Floats, Floats, Floats]:
    """Miss of the rotation (3,) rad, its bound, whether the 95 % interval covers, and what the datum leaves open."""
    rng = np.random.default_rng(seed)
    fixture = SyntheticFixture.drawn(rng, face, tilt)
    mount = Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix()
    plan = [
        (label, h + k * (np.pi + rng.normal(0, turn))) for label in LABELS for h in [rng.uniform(0, 6)] for k in (0, 1)
    ]
    up = fixture.ups(plan) + rng.normal(0, seating, (12, 3))
    up = np.concatenate([up / np.linalg.norm(up, axis=1, keepdims=True), NO_FACE])
    calibration = fit(noisy_poses(SENSOR, up @ mount, sigma, rng), signs=(-1, -1, -1))
    found = verticals(calibration)
    labelling = recognise(found.direction, found.used)
    known = frames([stand(found, labelling, Assumed(seating=seating, turn=turn))]).units[0]
    (unit,) = (result := frames([stand(found, labelling, Assumed(turn=turn))])).units
    datum = nearest_rotation(np.array([fixture.inward[label] for label in LABELS]), AXES)
    miss = Rotation.from_matrix(datum @ mount @ unit.rotation.T).as_rotvec()
    off = np.zeros(3) if result.fixture.offset is None else result.fixture.offset
    birge_ratio = calibration.birge_ratio if calibration.residual.lack_of_fit_p < 0.05 else 1.0
    return miss, known.standard_error / birge_ratio, np.abs(miss) < unit.coverage_factor() * unit.standard_error, off


def main(seeds: int) -> None:
    print("| case | rms error, µrad | rms error / bound | covered by 95 % | datum left open, µrad |")
    print("|---|--:|--:|--:|--:|")
    for name, case in CASES.items():
        miss, bound, inside, off = (np.array(x) for x in zip(*(one(s, **case) for s in range(seeds)), strict=True))
        ratio = np.sqrt(np.mean((miss / bound) ** 2))
        print(
            f"| {name} | {1e6 * np.sqrt(np.mean(miss**2)):.2f} | {ratio:.3f} | {np.mean(inside):.1%} "
            f"| {1e6 * np.sqrt(np.mean(off**2)):.0f} |"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1000)
