"""Measured recordings of others, judged by what others found in them (README beside the recordings).

Skipped where the folder of recordings is not there.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from triaxcal.diagnosis import Loop, diagnose
from triaxcal.errors import Refused
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence import Refusal
from triaxcal.evidence.covariances import UnmodelledKind
from triaxcal.poses.pose import Pose, poses_of
from triaxcal.poses.quality import disturbances
from triaxcal.poses.stillness.detector import StillnessDetector

FOLDER = Path(__file__).parents[3] / "shared" / "datasets"
pytestmark = [
    pytest.mark.datasets,
    pytest.mark.skipif(not any(FOLDER.glob("*/*.csv.gz")), reason="no measured recordings in ../shared/datasets"),
]
SENSORS = range(1, 9)


Poses = Callable[[str], list[Pose]]


def detected(name: str) -> list[Pose]:
    t_s, *u = np.loadtxt(FOLDER / f"{name}.csv.gz", delimiter=",", skiprows=1, unpack=True)
    detector = StillnessDetector()
    detector.feed(np.round(t_s * 1e9).astype(np.int64), np.stack(u, axis=1))
    detector.finish()
    return poses_of(detector.windows(), detector.spans())


@pytest.fixture(scope="module")
def poses(once: Callable[[str, Callable[[Path], None]], Path]) -> Poses:
    """The poses of a recording, which is read once for all workers."""

    def make(name: str) -> list[Pose]:
        def write(folder: Path) -> None:
            (folder / "poses").write_bytes(pickle.dumps(detected(name)))

        held = once(f"measured-{name.replace('/', '-')}", write) / "poses"
        found: list[Pose] = pickle.loads(held.read_bytes())
        return found

    return make


def equal_weights_rss(means: np.ndarray) -> float:
    """Sum of squares of |a| − 1 under nine parameters, fitted by scipy alone."""
    size = np.ptp(means, axis=0).max() / 2
    u = (means - means.mean(axis=0)) / size

    def miss(p: np.ndarray) -> np.ndarray:
        A = np.array([[p[0], p[1], p[2]], [0, p[3], p[4]], [0, 0, p[5]]])
        return np.linalg.norm((u - p[6:]) @ A.T, axis=1) - 1

    first = np.array([1, 0, 0, 1, 0, 1, 0, 0, 0], dtype=float)
    return float(np.sum(least_squares(miss, first, xtol=1e-15, ftol=1e-15, gtol=1e-15).fun ** 2))


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(FOLDER.glob("*/*.csv.gz")), ids=lambda p: f"{p.parent.name}-{p.name}")
def test_no_pose_that_was_held_in_earnest_is_called_disturbed(path: Path, poses: Poses) -> None:
    assert disturbances(poses(f"{path.parent.name}/{path.name.removesuffix('.csv.gz')}")) == []


@pytest.mark.slow
@pytest.mark.parametrize("run", [1, 5, 6])
@pytest.mark.parametrize("sensor", SENSORS)
def test_every_sensor_of_the_array_shows_its_21_poses(run: int, sensor: int, poses: Poses) -> None:
    found = poses(f"mimu4444/run{run}_sensor{sensor}")
    assert len(found) == 21
    # Held for about 24 s each; the last stop, at the very end, was a short one.
    assert all(p.end_s - p.start_s > 20 for p in found[:20])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "count"), [("xsens/acc", 38), ("mpu9150/unit0", 22), ("mpu9150/unit1", 22)])
def test_the_other_units_show_all_their_poses(name: str, count: int, poses: Poses) -> None:
    assert len(poses(name)) == count


def test_six_directions_are_refused_and_counted(poses: Poses) -> None:
    with pytest.raises(Refused, match="6 distinct directions") as refusal:
        fit(poses("ferraris/session"))
    assert refusal.value.wanted


# 1e-6 g; the outside analyses agree among themselves to about this factor.
NEIGHBOURHOOD = 1.6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("names", "outside"),
    [
        ([f"mimu4444/run{r}_sensor{s}" for r in (1, 5, 6) for s in SENSORS], (106, 126)),
        # The outside figure is that of white noise; what slow noise adds is in the residuals, 101 by the same analysis.
        (["xsens/acc"], (55, 101)),
        (["mpu9150/unit0", "mpu9150/unit1"], (300, 300)),
    ],
)
def test_the_noise_of_a_pose_mean_is_near_what_others_found(
    names: list[str], outside: tuple[float, float], poses: Poses
) -> None:
    ordinary = [np.median([p.standard_error_g for p in fit(poses(n)).poses]) * 1e6 for n in names]
    assert outside[0] / NEIGHBOURHOOD < np.median(ordinary) < outside[1] * NEIGHBOURHOOD


@pytest.mark.parametrize(("run", "outside"), [(5, 133), (6, 590)])
def test_residuals_of_the_array_pooled_over_its_sensors_are_what_others_found(
    run: int, outside: float, poses: Poses
) -> None:
    squares = degrees = 0.0
    for sensor in SENSORS:
        means = np.array([p.mean for p in poses(f"mimu4444/run{run}_sensor{sensor}")[:20]])
        squares += equal_weights_rss(means)
        degrees += len(means) - 9
    assert np.sqrt(squares / degrees) * 1e6 == pytest.approx(outside, rel=0.02)


@pytest.mark.parametrize(("name", "low", "high"), [("xsens/acc", 96, 116), ("mpu9150/unit0", 107, 246),
                                                   ("mpu9150/unit1", 107, 246)])  # fmt: skip
def test_the_residual_of_the_fit_is_near_what_others_found(name: str, low: float, high: float, poses: Poses) -> None:
    assert low < fit(poses(name)).residual.rms_g * 1e6 < high


@pytest.fixture(scope="module")
def diagnosed(poses: Poses) -> Callable[[str], Loop]:
    return cache(lambda name: diagnose(poses(name)))


# A bias that moves with time and settles: nothing in |a| of 21 poses says after which law.
OF_TIME = {"bias_drift", "warm_up"}
NOT_CORRECTED = 8
"""Of this sensor something in time that has no name is likelier than a drift or a warm-up."""


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SENSORS)
def test_run_6_holds_a_drift_and_the_residual_falls_threefold_with_it(
    sensor: int, diagnosed: Callable[[str], Loop]
) -> None:
    loop = diagnosed(f"mimu4444/run6_sensor{sensor}")
    assert loop.posterior.any_of(OF_TIME) + loop.posterior.unmodelled_kind_probabilities[UnmodelledKind.TIME] > 0.99
    told = {name for f in loop.findings for name in (f.effect, *f.alternatives)} | {c.effect for c in loop.candidates}
    assert told <= OF_TIME
    if sensor == NOT_CORRECTED:
        assert loop.refusal is Refusal.UNMODELLED
        assert loop.found.unexplained.kind is UnmodelledKind.TIME
    else:
        assert told
        assert set(loop.after.terms) <= {"linear", *OF_TIME}
        assert loop.after.residual.rms_g < loop.before.residual.rms_g / 3


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SENSORS)
def test_run_5_of_the_same_array_holds_none(sensor: int, diagnosed: Callable[[str], Loop]) -> None:
    loop = diagnosed(f"mimu4444/run5_sensor{sensor}")
    assert loop.findings == ()
    assert not loop.found.unexplained.significant
    # A cross coupling that run 1 of the same sensor shows with the other sign, and that is told as no more than likely.
    assert [c.effect for c in loop.candidates] == (["cross_coupling"] if sensor == 2 else [])


@pytest.mark.slow
@pytest.mark.parametrize(("run", "sensor"), [*((1, s) for s in SENSORS), (5, 2)])
def test_no_recording_of_the_array_shows_a_nonlinearity(
    run: int, sensor: int, diagnosed: Callable[[str], Loop]
) -> None:
    loop = diagnosed(f"mimu4444/run{run}_sensor{sensor}")
    assert max((p for name, p in loop.probabilities.items() if "nonlinearity" in name), default=0.0) < 0.1


@pytest.mark.slow
def test_the_drift_is_reported_by_axis_with_its_units(diagnosed: Callable[[str], Loop]) -> None:
    (finding,) = diagnosed("mimu4444/run6_sensor1").findings
    assert {finding.effect, *finding.alternatives} == OF_TIME
    assert finding.effect == "warm_up"
    assert set(finding.coefficients) == {"x", "y", "z", "time_constant"}
    assert {unit for _, _, unit in finding.coefficients.values()} == {"g", "s"}
    assert all(error is not None for _, error, _ in finding.coefficients.values())


def test_the_recordings_give_the_same_poses_in_blocks_of_any_size(poses: Poses) -> None:
    t_s, *u = np.loadtxt(FOLDER / "mpu9150/unit0.csv.gz", delimiter=",", skiprows=1, unpack=True)
    time_ns, readings = np.round(t_s * 1e9).astype(np.int64), np.stack(u, axis=1)
    detector = StillnessDetector()
    for start in range(0, len(time_ns), 137):
        detector.feed(time_ns[start : start + 137], readings[start : start + 137])
    detector.finish()
    for here, there in zip(poses("mpu9150/unit0"), poses_of(detector.windows(), detector.spans()), strict=True):
        assert np.array_equal(here.mean, there.mean)
        assert np.array_equal(here.covariance, there.covariance)
