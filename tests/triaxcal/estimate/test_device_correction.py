"""The coefficients of a device's own correction: against the best of each shape by another solver, from true sensors
over many seeds, with the reading before or after the correction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares

from triaxcal.arrays import rms
from triaxcal.effects import effect_named, effect_of
from triaxcal.errors import Refused
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.device_correction import DeviceCorrection, device_correction, uncorrected
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.correction import COEFFICIENTS, DIAGONAL, ENTRIES, OFFSETS, LinearCorrection
from triaxcal.model.directions import spiral
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose

SHAPES = {
    "offsets": OFFSETS,
    "gain and offset": (*DIAGONAL, *OFFSETS),
    "matrix and offset": (*ENTRIES, *OFFSETS),
    "upper triangle": (*DIAGONAL, "matrix.xy", "matrix.xz", "matrix.yz", *OFFSETS),
}
NOISE_G = 2e-5
SEEDS = range(4)


def truth(seed: int, size: float = 1.0) -> Sensor:
    """A unit with an output of ``size`` per g, wrong by percents."""
    rng = np.random.default_rng([seed, 541])
    return Sensor(
        size * (1 + 0.02 * rng.standard_normal(3)), 5e-3 * rng.standard_normal(3), 0.02 * rng.standard_normal(3)
    )


def poses(sensor: Sensor, seed: int, count: int = 26) -> list[Pose]:
    rng = np.random.default_rng([seed, 542])
    size = NOISE_G * np.abs(sensor.scale_factor)
    u = sensor.output(spiral(count), {}) + size * rng.standard_normal((count, 3))
    return [Pose(i * 10.0, i * 10.0 + 5, 500, u[i], np.diag(size**2), 100.0) for i in range(count)]


def best_of_shape(sensor: Sensor, nominal: LinearCorrection, names: tuple[str, ...]) -> float:
    """rms error of |a| that this shape leaves at best, by a general solver on thousands of directions."""
    u, t = sensor.output(spiral(2000), {}), np.zeros(2000)
    start = np.array([nominal.values.get(n, 0.0) for n in names])
    size = np.array(
        [abs(nominal.values["matrix.xx"]) if n in ENTRIES else 1 / nominal.values["matrix.xx"] for n in names]
    )

    def off(p: np.ndarray) -> np.ndarray:
        return nominal.moved(names, p * size - start).magnitude(u, t) - 1.0

    return rms(least_squares(off, start / size, xtol=1e-14, ftol=1e-14, gtol=1e-14).fun)


def own_error(sensor: Sensor, correction: LinearCorrection) -> float:
    u = sensor.output(spiral(2000), {})
    return rms(correction.magnitude(u, np.zeros(len(u))) - 1.0)


def found(sensor: Sensor, seed: int, held: LinearCorrection, names: tuple[str, ...]) -> DeviceCorrection:
    return device_correction(fit(poses(sensor, seed)), held, names)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("after", [False, True], ids=["matrix", "matrix-after"])
@pytest.mark.parametrize("neutral", [True, False], ids=["neutral", "held"])
@pytest.mark.parametrize("shape", SHAPES)
def test_what_remains_is_that_of_the_best_of_the_shape(shape: str, neutral: bool, after: bool, seed: int) -> None:
    size = (1.0, 9.80665, 2.4)[seed % 3]
    sensor, names = truth(seed, size), SHAPES[shape]
    nominal = LinearCorrection.nominal(np.full(3, size), after=after, output_per_g=9.80665)
    rng = np.random.default_rng([seed, 543])
    scale = np.array([0.02 * nominal.values["matrix.xx"] if n in ENTRIES else 0.05 * size for n in names])
    held = nominal if neutral else nominal.moved(names, scale * rng.standard_normal(len(names)))
    best = best_of_shape(sensor, nominal, names)
    d = found(sensor, seed, held, names)
    assert d.left_rms == pytest.approx(best, rel=0.1, abs=1e-9)
    assert d.left_rms <= d.left_largest
    assert own_error(sensor, d.correction) <= 1.1 * best + 3 * NOISE_G
    assert d.own_rms == pytest.approx(own_error(sensor, held), rel=0.02, abs=3 * NOISE_G)
    assert d.better(d.correction)
    fixed = {n for n in COEFFICIENTS if n not in names}
    assert all(d.correction.values.get(n, 0.0) == held.values.get(n, 0.0) for n in fixed)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("shape", SHAPES)
def test_a_second_calibration_leaves_a_calibrated_device_as_it_is(shape: str, seed: int) -> None:
    sensor, names = truth(seed), SHAPES[shape]
    first = found(sensor, seed, LinearCorrection.nominal(np.ones(3)), names).correction
    assert not found(sensor, seed + 100, first, names).better(first)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_equivalent_sensor_has_the_magnitude_and_its_uncertainty(seed: int) -> None:
    sensor = truth(seed)
    d = found(sensor, seed, LinearCorrection.nominal(np.ones(3)), SHAPES["matrix and offset"])
    c = d.equivalent.calibration
    own = c.sensor.magnitude(d.u, {})[0]
    np.testing.assert_allclose(own, d.correction.magnitude(d.u, d.temperature_c), atol=1e-12)
    # All nine are free: the same as the fit itself.
    fitted = fit(poses(sensor, seed))
    np.testing.assert_allclose(c.values, fitted.values, atol=1e-7)
    np.testing.assert_allclose(c.covariance, fitted.covariance, rtol=1e-3, atol=1e-18)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_rotation_that_the_device_holds_stays(seed: int) -> None:
    angle = 0.3
    rotation = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    held = LinearCorrection(dict(zip(ENTRIES, rotation.ravel().tolist(), strict=True)))
    d = found(truth(seed), seed, held, SHAPES["matrix and offset"])
    (matrix,), _ = d.correction.of(np.zeros(1))
    assert np.abs(matrix - rotation).max() < 0.1
    assert own_error(truth(seed), d.correction) < 3 * NOISE_G


def thermal(seed: int) -> tuple[Calibration, list[Pose]]:
    """A unit whose bias changes with temperature, in poses at many temperatures."""
    rng = np.random.default_rng([seed, 544])
    sensor = replace(truth(seed), effects=(effect_of("temperature_bias", {"x": 4e-4, "y": -3e-4, "z": 2e-4}),))
    celsius = np.tile([10.0, 25.0, 40.0], 20)
    u = sensor.output(spiral(60), {"temp_c": celsius - 25.0}) + NOISE_G * rng.standard_normal((60, 3))
    covariance = NOISE_G**2 * np.eye(3)
    made = [Pose(i * 10.0, i * 10.0 + 5, 500, u[i], covariance, 100.0, {"temp_c": celsius[i]}) for i in range(60)]
    return fit(made, effects=[effect_named("temperature_bias")]), made


@pytest.mark.parametrize("seed", SEEDS)
def test_registers_of_temperature_take_what_depends_on_it(seed: int) -> None:
    c, made = thermal(seed)
    held = LinearCorrection.nominal(np.ones(3), reference_c=20.0)
    with_t1 = (*ENTRIES, *OFFSETS, *(f"{name}.t1" for name in OFFSETS))
    d = device_correction(c, held, with_t1)
    assert d.left_rms < 1e-6
    own = d.equivalent.calibration
    covariates = {"temp_c": d.temperature_c - own.channel_reference["temp_c"]}
    np.testing.assert_allclose(own.sensor.magnitude(d.u, covariates)[0], 1.0, atol=1e-5)
    without = device_correction(c, held, (*ENTRIES, *OFFSETS))
    assert without.left_rms > 1e-3
    # In poses of one temperature nobody knows how it goes on: the registers stay.
    narrow = fit([replace(p, channels={"temp_c": 25.0 + 0.1 * i}) for i, p in enumerate(poses(truth(seed), seed, 14))])
    kept = device_correction(narrow, held.moved(("offset.x.t1",), np.array([1e-3])), with_t1).correction
    assert kept.values["offset.x.t1"] == 1e-3
    assert made


@pytest.mark.parametrize("after", [False, True], ids=["matrix", "matrix-after"])
def test_a_correction_is_removed_from_poses(after: bool) -> None:
    rng = np.random.default_rng(545)
    values = dict(zip(ENTRIES, (np.eye(3) + 0.05 * rng.standard_normal((3, 3))).ravel().tolist(), strict=True))
    values |= dict(zip(OFFSETS, (0.1 * rng.standard_normal(3)).tolist(), strict=True)) | {"offset.y.t1": 1e-3}
    held = LinearCorrection(values, after=after, reference_c=20.0)
    (plain,) = poses(truth(1), 1, 1)
    u = replace(plain, channels={"temp_c": 31.0}, creep=np.array([1e-3, 0, 0]), before=np.array([0.1, 0.2, -0.9]))
    t = np.array([31.0])
    matrix = held.of(t)[0][0]
    y = replace(
        u, mean=held.output(u.mean[None], t)[0], covariance=matrix @ u.covariance @ matrix.T, creep=matrix @ u.creep,
        before=held.output(u.before[None], t)[0],
    )  # fmt: skip
    (back,) = uncorrected([y], held)
    for name in ("mean", "covariance", "creep", "before"):
        np.testing.assert_allclose(getattr(back, name), getattr(u, name), rtol=1e-9, atol=1e-15)
    with pytest.raises(Refused, match="temp_c"):
        uncorrected([replace(y, channels={})], held)
    with pytest.raises(Refused, match="no inverse"):
        uncorrected([y], LinearCorrection(dict.fromkeys(ENTRIES, 1.0)))


def test_a_device_that_does_something_else_is_refused() -> None:
    sensor = truth(1)
    nothing = LinearCorrection({"matrix.xx": 1.0, "matrix.yy": 0.0, "matrix.zz": 0.0})
    with pytest.raises(Refused, match="correction"):
        found(sensor, 1, nothing, OFFSETS)


def test_by_coefficients_is_the_derivative() -> None:
    rng = np.random.default_rng(546)
    u, t = rng.standard_normal((40, 3)), rng.uniform(0, 50, 40)
    for after in (False, True):
        values = {name: 0.1 * float(rng.standard_normal()) * (0.01 if ".t" in name else 1) for name in COEFFICIENTS}
        at = LinearCorrection(values | dict.fromkeys(DIAGONAL, 1.5), after, 2.0, 20.0)
        by = at.by_coefficients(COEFFICIENTS, u, t)
        for i, name in enumerate(COEFFICIENTS):
            h = 1e-6 if ".t" in name else 1e-5
            up, down = (at.moved((name,), np.array([s * h])).magnitude(u, t) for s in (1, -1))
            np.testing.assert_allclose(by[:, i], (up - down) / (2 * h), rtol=2e-4, atol=2e-4 * np.abs(by[:, i]).max())
