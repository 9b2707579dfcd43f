"""The sources of the budget, one by one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from triaxcal.effects import effect_named
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import noisy_poses
from triaxcal.uncertainty import Stated, budget

NOISE = 2e-5
SIGNS = (-1, -1, -1)


def test_fourteen_poses_leave_0_80_of_a_poses_noise_in_the_magnitude(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    poses = noisy_poses(paper_unit, fourteen, 1.5e-5, np.random.default_rng(3))
    noise = next(line for line in budget(fit(poses, signs=SIGNS, excluded=())).components if line.source == "noise")
    assert noise.magnitude / 1.5e-5 == pytest.approx(0.80, abs=0.01)  # METHOD, section 5


def test_creep_that_only_turns_the_unit_is_no_line_of_the_budget(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    """Across the measured vector it is nothing but rounding, which is another from processor to processor."""
    poses = noisy_poses(paper_unit, twenty_six, NOISE, np.random.default_rng(1))
    _, outward = fit(poses, signs=SIGNS, excluded=()).sensor.magnitude(np.array([p.mean for p in poses]), {})
    turns = np.cross(outward, [0.3, -0.5, 0.8])
    turns *= 1e-3 / np.linalg.norm(turns, axis=1, keepdims=True)
    for share, sources in ((0.0, {"noise"}), (1e-3, {"noise", "creep"})):
        creep = turns + share * 1e-3 * outward / np.linalg.norm(outward, axis=1, keepdims=True)
        creeping = [replace(p, creep=c) for p, c in zip(poses, creep, strict=True)]
        moved = [replace(p, covariance=p.covariance + p.creep_covariance) for p in creeping]
        assert {line.source for line in budget(fit(moved, signs=SIGNS, excluded=())).components} == sources


def test_residuals_beyond_noise_are_a_line_of_their_own(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    rng = np.random.default_rng(2)
    poses = noisy_poses(paper_unit, twenty_six, NOISE, rng)
    told = [replace(p, covariance=p.covariance / 25) for p in poses]
    c = fit(told, signs=SIGNS, excluded=())
    b = budget(c)
    assert b.dominant.source == "lack_of_fit"
    np.testing.assert_allclose(b.parameters.standard, c.standard_errors, rtol=1e-9)
    # 17 degrees of freedom behind it, so Student's factor is not the normal one.
    np.testing.assert_allclose(b.parameters.coverage, stats.t.ppf(0.975, 17), rtol=0.02)


def test_a_time_constant_that_had_to_be_found_belongs_to_the_noise(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    """Nothing is lacking in a model whose residuals are noise, however uncertain a shape of it makes its values."""
    warming = effect_named("warm_up").shaped({"time_constant": 400.0})
    truth = replace(paper_unit, effects=((warming, np.array([3e-3, -2e-3, 1e-3])),))
    c = fit(
        noisy_poses(truth, twenty_six, NOISE, np.random.default_rng(5)), signs=SIGNS, effects=[warming], excluded=()
    )
    assert c.birge_ratio == 1
    assert c.shape_errors["warm_up.time_constant"] > 0
    b = budget(c)
    assert [line.source for line in b.components] == ["noise"]
    np.testing.assert_allclose(b.parameters.standard, c.standard_errors, rtol=1e-6)


def test_an_error_of_the_reference_moves_scale_factors_alike(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    poses = noisy_poses(paper_unit, twenty_six, NOISE, np.random.default_rng(2))
    c = fit(poses, signs=SIGNS, excluded=())
    other = fit(poses, signs=SIGNS, reference=1 + 1e-5, excluded=())
    line = next(x for x in budget(c, Stated(reference=1e-5)).components if x.source == "reference")
    np.testing.assert_allclose(line.parameters, np.abs(other.values - c.values), rtol=1e-3, atol=1e-12)
    assert line.magnitude == pytest.approx(1e-5, rel=1e-3)


def test_steps_of_registers_are_rectangular(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    c = fit(noisy_poses(paper_unit, twenty_six, NOISE, np.random.default_rng(2)), signs=SIGNS, excluded=())
    line = next(x for x in budget(c, Stated(rounding={"bias.y": 6e-5})).components if x.source == "register_rounding")
    assert line.parameters[c.parameters.index("bias.y")] == pytest.approx(6e-5 / np.sqrt(12))
    assert np.count_nonzero(line.parameters) == 1
    # |a| feels the bias of one axis by its direction cosine, whose mean square over the sphere is a third.
    assert line.magnitude == pytest.approx(6e-5 / np.sqrt(12) / np.sqrt(3), rel=0.02)
