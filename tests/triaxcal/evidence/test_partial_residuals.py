"""What the poses show of one effect, against what drives it: judged by the truth that was put in, projected here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from tests.triaxcal.evidence.conftest import MINUS
from triaxcal.effects import effect_named
from triaxcal.effects.contract import SINCE_START, TIME, Coefficient, Effect, no_slope
from triaxcal.effects.empirical import Empirical
from triaxcal.effects.nonlinear import CrossCoupling
from triaxcal.estimate.calibration import Calibration, Exclusion
from triaxcal.estimate.pose_fit import fit
from triaxcal.estimate.recordings import gather
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.partial_residuals import (
    PANELS,
    PREDICTED,
    VISIBLE,
    Quantity,
    Trace,
    of_effect,
    residuals,
    telling_variables,
    unit_of,
)
from triaxcal.model.sensor import LINEAR
from triaxcal.poses.pose import Pose

Poses = Callable[..., list[Pose]]
SEEDS = range(12)


def traced(poses: list[Pose], *effects: Effect) -> tuple[LinearisedData, Calibration]:
    rows = LinearisedData.of(poses, fit(poses, signs=MINUS), MINUS, effects)
    return rows, fit(poses, signs=MINUS, effects=effects)


def left_by_the_nine(up: np.ndarray, contribution: np.ndarray) -> np.ndarray:
    """What scale factors, biases and misalignments leave of a contribution to |a|, by the directions alone."""
    pairs = np.stack([up[:, 1] * up[:, 2], up[:, 0] * up[:, 2], up[:, 0] * up[:, 1]], axis=1)
    nine = np.concatenate([up**2, up, pairs], axis=1)
    left: np.ndarray = contribution - nine @ np.linalg.lstsq(nine, contribution, rcond=None)[0]
    return left


def directions_of(c: Calibration) -> np.ndarray:
    return np.array([p.direction for p in c.poses])


READ = {
    "second_order_nonlinearity": lambda s: s**2,
    "third_order_nonlinearity": lambda s: s**3,
    "scale_factor_asymmetry": lambda s: np.abs(s),
}


@pytest.mark.parametrize("name", READ)
def test_the_curve_is_the_true_contribution_after_what_the_nine_absorb(poses_with: Poses, name: str) -> None:
    """Within its 95 % band in about so many of the poses, over all seeds."""
    q = np.array([6e-4, -4e-4, 5e-4])
    within, total = 0, 0
    for seed in SEEDS:
        rows, c = traced(poses_with(seed, **{name: q.tolist()}), effect_named(name))
        up = directions_of(c)
        for i, trace in enumerate(of_effect(rows, c, name)):
            assert (trace.variable, trace.axis, trace.quantity) == (f"reading_{'xyz'[i]}", "xyz"[i], Quantity.MAGNITUDE)
            assert trace.coefficients == ("xyz"[i],)
            true = left_by_the_nine(up, q[i] * READ[name](up[:, i]) * up[:, i])
            near = 0.03 * np.abs(true).max()  # misalignment and bias, which the projection here does not know
            off = np.abs(np.interp(trace.x, trace.grid, trace.curve) - true)
            within += int(np.sum(off <= np.interp(trace.x, trace.grid, trace.half_width) + near))
            total += len(true)
    assert within / total > 0.9


ALL = {
    "second_order_nonlinearity": [6e-4, -4e-4, 5e-4],
    "cross_coupling": [4e-4, 0.0, 0.0, 0.0, 0.0, -3e-4, 2e-4],
    "temperature_bias": [5e-4, -4e-4, 6e-4],
    "temperature_scale_factor": [3e-4, -3e-4, 2e-4],
    "hysteresis": [4e-4, 3e-4, -5e-4],
    "bias_drift": [4e-6, -4e-6, 3e-6],
}
DRIVEN_BY = {
    "temperature_bias": {"temp_c"},
    "temperature_scale_factor": {"temp_c"},
    "hysteresis": {"before_x", "before_y", "before_z"},
    "bias_drift": {"t_s"},
}


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("seed", [0, 1])
def test_a_pose_is_off_the_curve_by_its_residual_under_the_full_model(poses_with: Poses, name: str, seed: int) -> None:
    rows, c = traced(poses_with(seed, **{name: ALL[name]}), effect_named(name))
    traces = of_effect(rows, c, name)
    assert 1 <= len(traces) <= PANELS
    for trace in traces:
        fitted = np.interp(trace.x, trace.grid, trace.curve)
        step = np.abs(np.diff(trace.curve)).max()
        residual = np.array([c.poses[i].residual_g / c.poses[i].standard_error_g for i in trace.pose])
        off = np.abs((trace.y - fitted) / trace.error)
        np.testing.assert_allclose(off, np.abs(residual), atol=0.05 + 0.1 * step / trace.error.min())
        assert np.abs(trace.curve).max() > 3 * np.median(trace.error) / 2
        assert (trace.half_width >= 0).all()
        if name in DRIVEN_BY:
            assert trace.variable in DRIVEN_BY[name]
            assert trace.quantity is Quantity.READING
            loading = np.abs(directions_of(c)[trace.pose, "xyz".index(trace.axis)])
            assert loading.min() > 0.98 * min(VISIBLE, VISIBLE**0.5)


@pytest.mark.parametrize(
    ("name", "q"), [("temperature_bias", [5e-4, -4e-4, 6e-4]), ("hysteresis", [4e-4, 3e-4, -5e-4])]
)
def test_along_a_covariate_the_curve_goes_as_the_bias_does(poses_with: Poses, name: str, q: list[float]) -> None:
    """A little less where the covariate went along with the directions, and never more than its band tells."""
    for seed in SEEDS:
        rows, c = traced(poses_with(seed, **{name: ALL[name]}), effect_named(name))
        for trace, true in zip(of_effect(rows, c, name), ALL[name], strict=True):
            rise = (trace.curve[-1] - trace.curve[0]) / (trace.grid[-1] - trace.grid[0])
            assert 0.4 < rise / true < 1.15


@pytest.mark.parametrize("jitter_s", [0.0, 4.0])
def test_a_step_is_drawn_over_time_however_long_each_pose_was_held(poses_with: Poses, jitter_s: float) -> None:
    """The pose in which it falls goes by its own duration, and stays on the picture with its residual."""
    rng, poses = np.random.default_rng(3), poses_with(1)
    poses = [
        replace(p, start_s=p.start_s + jitter_s * a, end_s=p.end_s - jitter_s * b)
        for p, (a, b) in zip(poses, rng.uniform(0, 1, (len(poses), 2)), strict=True)
    ]
    middle = poses[13]
    effect = effect_named("bias_step").shaped({"at": (middle.start_s + middle.end_s) / 2 + 0.1})
    for trace in of_effect(*traced(poses, effect), "bias_step"):
        assert trace.variable in (TIME, SINCE_START)
        assert len(trace.x) > 1


def test_an_effect_on_several_axes_at_once_is_drawn_against_its_own_prediction(poses_with: Poses) -> None:
    class Everywhere(Effect):
        name = "everywhere"
        coefficients = (Coefficient("all", "g"),)
        needs = ()
        remedy = "None."

        def basis(self, s: np.ndarray, covariates: Mapping[str, np.ndarray]) -> np.ndarray:
            return np.sin(3 * s + s[:, [1, 2, 0]])[:, :, None]

        def slope(self, s: np.ndarray, covariates: Mapping[str, np.ndarray]) -> np.ndarray:
            return no_slope(s, 1)

    rows, c = traced(poses_with(1), Everywhere())
    (trace,) = of_effect(rows, c, "everywhere")
    assert (trace.variable, trace.axis, trace.coefficients) == (PREDICTED, "", ("all",))
    np.testing.assert_array_equal(trace.grid, trace.curve)
    np.testing.assert_allclose(trace.half_width / np.abs(trace.grid), trace.half_width[0] / abs(trace.grid[0]))


@pytest.mark.parametrize("whole", [False, True])
def test_cross_coupling_is_drawn_against_the_reading_of_the_other_axis(poses_with: Poses, whole: bool) -> None:
    """|a| shows the same of a product on one axis and of the square of that axis on the other: so does the picture."""
    q = {"x_xy": 2e-3}
    true = [q.get(o.name, 0.0) for o in CrossCoupling().coefficients]
    rows, c = traced(poses_with(1, cross_coupling=true), CrossCoupling())
    if whole:  # half of it on the other axis
        effect, ((_, found),) = CrossCoupling(whole=True), c.sensor.effects
        known = dict(zip([o.name for o in CrossCoupling().coefficients], found, strict=True))
        values = np.array([known["x_xy"] / 2 if o.name in ("x_xy", "y_xx") else 0.0 for o in effect.coefficients])
        n = LINEAR + len(values)
        covariance = np.zeros((n, n))
        covariance[:LINEAR, :LINEAR] = c.covariance[:LINEAR, :LINEAR]
        c = replace(c, sensor=replace(c.sensor, effects=((effect, values),)), covariance=covariance)
    trace = next(t for t in of_effect(rows, c, "cross_coupling") if "x_xy" in t.coefficients)
    assert (trace.variable, trace.axis, trace.quantity) == ("reading_y", "x", Quantity.READING)
    rise = np.polyfit(trace.grid, trace.curve, 1)[0]
    assert 0.4 < rise / q["x_xy"] < 1.15
    np.testing.assert_allclose(trace.curve, np.polyval(np.polyfit(trace.grid, trace.curve, 1), trace.grid), atol=1e-9)


def test_the_band_against_the_prediction_is_that_of_the_contribution_to_the_poses(poses_with: Poses) -> None:
    """Many coefficients of opposite signs are each uncertain where their sum is small."""
    rows, c = traced(poses_with(1), Empirical("odd"))
    (trace,) = of_effect(rows, c, Empirical().name)
    X = -rows.by_coefficients(Empirical("odd"))[: rows.n] * rows.error[: rows.n, None]
    nine = rows.linear[: rows.n] * rows.error[: rows.n, None]
    weight = 1 / rows.error[: rows.n, None]
    X = X - nine @ np.linalg.lstsq(nine * weight, X * weight, rcond=None)[0]
    own = c.covariance[LINEAR:, LINEAR:]
    deviation = np.sqrt(np.einsum("np,pq,nq->n", X, own, X))
    half = np.interp(trace.x, trace.grid, trace.half_width) / c.coverage_factor(0.95)
    assert trace.variable == PREDICTED
    assert np.mean(half**2) == pytest.approx(np.mean(deviation**2), rel=0.1)


def test_a_model_without_the_effect_has_no_trace_of_it(poses_with: Poses) -> None:
    rows, c = traced(poses_with(1))
    with pytest.raises(KeyError):
        of_effect(rows, c, "hysteresis")


@pytest.mark.parametrize(
    ("name", "q", "variables"),
    [
        ("temperature_bias", [9e-4, -9e-4, 9e-4], {"temp_c"}),
        ("third_order_nonlinearity", [0.0, 3e-3, 0.0], {"reading_y"}),
        ("hysteresis", [0.0, 0.0, 1e-3], {"before_z"}),
        ("bias_drift", [8e-6, 8e-6, -8e-6], {"since_start_s"}),
    ],
)
def test_the_most_telling_variable_is_the_one_that_acts(
    poses_with: Poses, name: str, q: list[float], variables: set[str]
) -> None:
    for seed in range(6):
        rows, c = traced(poses_with(seed, **{name: q}))
        traces = telling_variables(rows, c)
        assert len(traces) == PANELS
        assert len({t.variable for t in traces}) == PANELS
        assert {traces[0].variable} == variables
        shares = [t.share for t in traces]
        assert shares == sorted(shares, reverse=True)
        assert shares[0] is not None
        assert shares[0] > 0.7
        assert traces[0].p_value is not None
        assert traces[0].p_value < 1e-3


def test_where_nothing_is_left_no_variable_tells_more_than_chance(poses_with: Poses) -> None:
    told = [telling_variables(*traced(poses_with(seed))) for seed in range(40)]
    assert np.median([traces[0].share or 0.0 for traces in told]) < 0.4
    by_chance = sum(min(t.p_value for t in traces if t.p_value is not None) < 0.05 for traces in told)
    assert by_chance <= 5  # of 40; more than that in one of a hundred, where the p-value is exact


def test_excluded_poses_are_marked_and_move_no_curve(
    poses_with: Poses, knocked: Callable[[list[Pose], int, float], list[Pose]]
) -> None:
    effect, q = effect_named("temperature_bias"), [5e-4, -4e-4, 6e-4]
    poses = poses_with(2, temperature_bias=q)

    def traces(which: list[Pose]) -> tuple[Trace, ...]:
        rows = LinearisedData.of(which, fit(which, signs=MINUS), MINUS, (effect,))
        without = fit(which, signs=MINUS, effects=(effect,), excluded=[7], why=Exclusion.CALLER)
        return of_effect(rows, without, effect.name)

    for one, other in zip(traces(poses), traces(knocked(poses, 7, 2e-3)), strict=True):
        np.testing.assert_array_equal(other.pose[other.excluded], [7] if 7 in other.pose else [])
        np.testing.assert_allclose(one.curve, other.curve, atol=0.05 * np.abs(one.curve).max())
    assert any(7 in trace.pose for trace in traces(poses))


def test_residuals_are_in_standard_errors_of_their_poses(poses_with: Poses) -> None:
    _, c = traced(poses_with(3))
    trace = residuals(c)
    np.testing.assert_allclose(trace.y, [p.residual_g / p.standard_error_g for p in c.poses])
    assert (trace.error == 1).all()
    assert (trace.variable, len(trace.grid)) == ("since_start_s", 0)
    nobody = replace(c, poses=tuple(replace(p, pose=replace(p.pose, start_s=0.0, end_s=0.0)) for p in c.poses))
    assert residuals(nobody).variable == "pose"


def test_an_effect_of_one_of_several_recordings_is_drawn_over_that_one(poses_with: Poses) -> None:
    from triaxcal.effects.runs import InRuns

    effect = InRuns(effect_named("bias_drift"), (1,))
    poses = gather([poses_with(1), poses_with(2, bias_drift=[6e-6, -6e-6, 6e-6])])
    rows, c = traced(poses, effect)
    for trace in of_effect(rows, c, "bias_drift"):
        assert set(trace.pose) <= set(range(30, 60))
        assert trace.coefficients[0].endswith("_run2")
        assert trace.variable == "t_s"


@pytest.mark.parametrize(
    ("variable", "unit"),
    [
        ("reading_x", "g"), ("before_y", "g"), ("scatter_z", "g²"), ("t_s", "s"), ("temp_c", "°C"),
        ("temp_c.rate", "K/s"), ("temp_c.lag:100", "K"), ("supply_v", "[supply_v]"), ("supply_v.rate", "[supply_v]/s"),
        ("run_index", ""), ("pose", ""),
    ],
)  # fmt: skip
def test_every_variable_has_its_unit(variable: str, unit: str) -> None:
    assert unit_of(variable) == unit
