"""What |a| does not show of a reading, and what is corrected where no name describes what acts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest

from tests.triaxcal.evidence.conftest import FEW, MINUS
from triaxcal.diagnosis import Loop, diagnose
from triaxcal.documents import Calibration
from triaxcal.effects import effect_named
from triaxcal.effects.nonlinear import CrossCoupling
from triaxcal.errors import InvalidData
from triaxcal.estimate.calibration import Exclusion, reduced
from triaxcal.evidence.covariances import UnmodelledKind
from triaxcal.model.directions import directions, spiral
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses
from triaxcal.uncertainty.propagation import uncertainty_of_magnitude, uncertainty_of_readings

CATALOGUE = (*FEW, CrossCoupling())
SPHERE = spiral(60)
Added = Callable[[np.ndarray], np.ndarray]
"""(n,3) in g, of the force (n,3) along the axes."""


def recorded(unit: Sensor, added: Added, seed: int, ups: Sequence[np.ndarray], noise_g: float = 1e-5) -> list[Pose]:
    rng = np.random.default_rng(seed)
    poses = noisy_poses(unit, rng.permutation(np.array(ups)), noise_g, rng)
    return [replace(p, mean=p.mean + unit.scale_factor * added(_force(unit, p))[0]) for p in poses]


def _force(unit: Sensor, pose: Pose) -> np.ndarray:
    return unit.along_axes(pose.mean[None], {})


def errors(loop: Loop, unit: Sensor, added: Added) -> tuple[np.ndarray, np.ndarray]:
    """(n,3) of the components all over the sphere, before and after."""
    s = SPHERE @ unit.axes.T
    u = unit.output(SPHERE, {}) + unit.scale_factor * added(s)
    return loop.before.sensor.specific_force(u, {}) - SPHERE, loop.after.sensor.specific_force(u, {}) - SPHERE


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def of_y(s: np.ndarray) -> np.ndarray:
    return np.stack([1e-3 * s[:, 1] ** 2, 0 * s[:, 0], 0 * s[:, 0]], axis=1)


@pytest.fixture(scope="module")
def square(paper_unit: Sensor) -> Loop:
    """x reads the square of y."""
    poses = recorded(paper_unit, of_y, 3, [up for _, up in directions(26)])
    return diagnose(poses, signs=MINUS, catalogue=CATALOGUE)


def test_coefficients_that_look_the_same_share_what_is_seen_and_keep_their_width(square: Loop) -> None:
    """The square of y on x is y times x on y, in |a|."""
    (name,) = (f.effect for f in square.findings)
    found = square.after.coefficients_of(name)
    (one, error), (other, of_other) = (found[k][:2] for k in ("x_yy", "y_yx"))
    assert one + other == pytest.approx(1e-3, rel=0.1)
    assert error is not None
    assert of_other is not None
    assert min(error, of_other) > 0.2e-3
    both = [square.after.parameters.index(f"{name}.{k}") for k in ("x_yy", "y_yx")]
    sum_variance = square.after.covariance[np.ix_(both, both)].sum()
    assert np.sqrt(sum_variance) < 0.1 * error


def test_components_are_covered_and_no_worse_where_axes_share_what_is_seen(square: Loop, paper_unit: Sensor) -> None:
    before, after = errors(square, paper_unit, of_y)
    assert rms(after) < 0.95 * rms(before)
    u = paper_unit.output(SPHERE, {}) + paper_unit.scale_factor * of_y(SPHERE @ paper_unit.axes.T)
    c = square.after
    stated = uncertainty_of_readings(c.sensor, c.covariance, u, {}, c.unmodelled)
    assert np.mean(np.abs(after) <= 1.96 * stated) > 0.9
    alone = uncertainty_of_magnitude(c.sensor, c.covariance, u, {}, c.unmodelled)
    assert rms(alone) < 0.2 * rms(stated)


def test_a_document_has_what_no_parameter_describes(square: Loop) -> None:
    document = Calibration(square.after).to_dict()
    assert square.after.unmodelled is not None
    loaded = Calibration.from_dict(document).fitted.unmodelled
    assert loaded is not None
    assert loaded.across == pytest.approx(square.after.unmodelled.across, rel=0.05)
    document["unmodelled"]["across_g"] = -1.0
    with pytest.raises(InvalidData, match="unmodelled"):
        Calibration.from_dict(document)


def test_registers_without_an_effect_have_what_its_components_lose(square: Loop, paper_unit: Sensor) -> None:
    held = reduced(square.after, lambda effect: False).calibration
    assert held.unmodelled is not None
    before, _ = errors(square, paper_unit, of_y)
    assert held.unmodelled.across > 0.5 * rms(before)


def kink(s: np.ndarray) -> np.ndarray:
    """A step at zero on two axes."""
    return np.stack([4e-4 * np.tanh(s[:, 0] / 0.05), -3e-4 * np.tanh(s[:, 1] / 0.05), 0 * s[:, 0]], axis=1)


@pytest.mark.slow
def test_a_function_of_direction_without_a_name_is_corrected_where_that_pays(paper_unit: Sensor) -> None:
    ratio = []
    for seed in range(3):
        poses = recorded(paper_unit, kink, seed, [up for _, up in directions(40)])
        loop = diagnose(poses, signs=MINUS, catalogue=(effect_named("second_order_nonlinearity"),))
        assert loop.smooth
        assert not [f for f in loop.findings if f.verdict == "adopted"]
        before, after = (np.sum(e * SPHERE, axis=1) for e in errors(loop, paper_unit, kink))
        ratio.append(rms(after) / rms(before))
    assert max(ratio) < 0.9


@pytest.mark.slow
def test_what_each_pose_has_of_its_own_is_not_corrected(paper_unit: Sensor) -> None:
    rng = np.random.default_rng(5)
    own = rng.normal(0, 3e-4, (40, 3))
    poses = recorded(paper_unit, lambda s: 0 * s, 1, [up for _, up in directions(40)])
    moved = [replace(p, mean=p.mean + paper_unit.scale_factor * by) for p, by in zip(poses, own, strict=False)]
    loop = diagnose(moved, signs=MINUS, catalogue=FEW)
    assert loop.after.terms == ("linear",)
    assert loop.after.unmodelled is not None
    assert loop.after.unmodelled.along == pytest.approx(3e-4, rel=0.4)


def knee(s: np.ndarray) -> np.ndarray:
    """x gives way beyond −0.9 g."""
    return np.stack([5e-3 * np.maximum(-s[:, 0] - 0.9, 0.0), 0 * s[:, 0], 0 * s[:, 0]], axis=1)


def with_two_poses_beyond_the_knee(unit: Sensor, seed: int) -> list[Pose]:
    tilted = np.array([-0.94, 0.0, np.sqrt(1 - 0.94**2)])
    return recorded(unit, knee, seed, [*(up for _, up in directions(26)), tilted])


def test_outliers_that_share_a_direction_are_kept_as_evidence(paper_unit: Sensor) -> None:
    loop = diagnose(with_two_poses_beyond_the_knee(paper_unit, 2), signs=MINUS, catalogue=FEW)
    assert not loop.found.outliers
    assert loop.found.change_point is None
    assert loop.found.unexplained.significant
    assert loop.found.unexplained.kind is UnmodelledKind.LOCAL
    assert all(p.used for p in loop.after.poses)


def test_one_pose_that_was_knocked_is_an_outlier_all_the_same(
    paper_unit: Sensor, knocked: Callable[[list[Pose], int, float], list[Pose]]
) -> None:
    poses = knocked(recorded(paper_unit, lambda s: 0 * s, 4, [up for _, up in directions(26)]), 5, 5e-4)
    loop = diagnose(poses, signs=MINUS, catalogue=FEW)
    assert list(loop.found.outliers) == [5]
    assert loop.after.poses[5].excluded is Exclusion.OUTLIER


def test_two_poses_that_were_knocked_in_other_directions_are_outliers(
    paper_unit: Sensor, knocked: Callable[[list[Pose], int, float], list[Pose]]
) -> None:
    poses = recorded(paper_unit, lambda s: 0 * s, 4, [up for _, up in directions(40)])
    loop = diagnose(knocked(knocked(poses, 6, 6e-4), 19, -4e-4), signs=MINUS, catalogue=FEW)
    assert set(loop.found.outliers) == {6, 19}
