"""The budget, judged by propagating distributions: every source drawn at random, fitted, and set against the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from triaxcal.effects import effect_named
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses
from triaxcal.uncertainty import SENSITIVITY_PER_K, Stated, budget
from triaxcal.uncertainty.statements import ReferenceTakenAsExact, SingleReading, TemperatureNotLogged

NOISE = 2e-5
SIGNS = (-1, -1, -1)
TEMPERATURES_C = 25 + 0.8 * np.sin(np.arange(26) * 1.7)
DRAWS = 400


def _within_chance(values: np.ndarray, truth: np.ndarray, standard: np.ndarray) -> bool:
    """Whether the scatter of ``values`` (m,p) about the truth is ``standard`` (p,): chi-square, 1e-4 over all."""
    m, p = values.shape
    low, high = stats.chi2.ppf([0.5e-4 / p, 1 - 0.5e-4 / p], m) / m
    ratio = np.mean((values - truth) ** 2, axis=0) / standard**2
    return bool(np.all((ratio > low) & (ratio < high)))


def _sphere_rms(c: Calibration, truth: Sensor) -> float:
    """rms error of |a| over 500 orientations that no plan has, at the reference conditions."""
    up = np.array([v for _, v in directions(500)])
    held = {n: np.zeros(len(up)) for n in c.channel_reference}
    length, _ = c.sensor.magnitude(truth.output(up, {}), held)
    return float(np.sqrt(np.mean((length - 1) ** 2)))


def test_noise_alone_is_what_the_fit_itself_says(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    poses = noisy_poses(paper_unit, twenty_six, NOISE, np.random.default_rng(1))
    c = fit(poses, signs=SIGNS, excluded=())
    assert c.birge_ratio == 1
    b = budget(c)
    assert [line.source for line in b.components] == ["noise"]
    np.testing.assert_allclose(b.parameters.standard, c.standard_errors, rtol=1e-9)
    np.testing.assert_allclose(b.parameters.coverage, c.coverage_factor(), rtol=1e-6)
    assert b.dominant.magnitude == float(b.magnitude.standard)


@pytest.mark.slow
def test_all_sources_together_scatter_as_the_budget_says(
    monkeypatch: pytest.MonkeyPatch, paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """JCGM 101: noise, creep, the reference and thermal effects that the model lacks, drawn 400 times."""
    rng = np.random.default_rng(7)
    reference, thermal_share = 15e-6, 0.04
    monkeypatch.setattr(
        "triaxcal.uncertainty.components.SENSITIVITY_PER_K",
        {n: v * thermal_share for n, v in SENSITIVITY_PER_K.items()},
    )
    creep = np.zeros((26, 3))
    creep[::4] = rng.uniform(-1, 1, (7, 3)) * 4e-4
    found, errors, said = [], [], []
    for _ in range(DRAWS):
        pairs = tuple(
            (effect_named(n), v * thermal_share * rng.standard_normal(3)) for n, v in SENSITIVITY_PER_K.items()
        )
        unit = Sensor(paper_unit.scale_factor, paper_unit.misalignment, paper_unit.bias, pairs)
        up = twenty_six * (1 + reference * rng.standard_normal())
        warm = {"temp_c": TEMPERATURES_C}
        poses = noisy_poses(unit, up, NOISE, rng, channels=warm, channel_reference={"temp_c": 25.0})
        poses = [_creeping(p, change, rng) for p, change in zip(poses, creep, strict=True)]
        c = fit(poses, signs=SIGNS, excluded=())
        found.append(c.values)
        errors.append(_sphere_rms(c, paper_unit) ** 2)
        # Residuals that happen to exceed the noise are no source of their own here.
        lines = [x for x in budget(c, Stated(reference=reference)).components if x.source != "lack_of_fit"]
        assert {x.source for x in lines} == {"noise", "creep", "reference", "temperature"}
        said.append(np.sum([np.r_[x.parameters, x.magnitude] ** 2 for x in lines], axis=0))
    truth = np.concatenate([paper_unit.scale_factor, paper_unit.misalignment, paper_unit.bias])
    expected = np.mean(said, axis=0)
    assert _within_chance(np.array(found), truth, np.sqrt(expected[:9]))
    assert abs(np.mean(errors) - expected[9]) < 4 * np.std(errors) / np.sqrt(DRAWS)


def _creeping(pose: Pose, change: np.ndarray, rng: np.random.Generator) -> Pose:
    """A pose whose mean is somewhere along its creep."""
    mean = pose.mean + change * rng.uniform(-0.5, 0.5)
    moved = replace(pose, mean=mean, creep=change)
    return replace(moved, covariance=pose.covariance + moved.creep_covariance)


@pytest.mark.slow
@pytest.mark.parametrize("moved_k", [0.1, 2.0])
def test_a_thermal_effect_that_shows_in_the_residuals_counts_once(
    paper_unit: Sensor, twenty_six: np.ndarray, moved_k: float
) -> None:
    """Of sensitivities as the budget expects them, nobody having diagnosed: under temperature, not under lack of fit
    too."""
    rng = np.random.default_rng(11)
    ratios = []
    for _ in range(60):
        pairs = tuple((effect_named(n), v * rng.standard_normal(3)) for n, v in SENSITIVITY_PER_K.items())
        unit = Sensor(paper_unit.scale_factor, paper_unit.misalignment, paper_unit.bias, pairs)
        warm = {"temp_c": 25 + moved_k * rng.permutation(np.linspace(-0.5, 0.5, 26))}
        poses = noisy_poses(unit, twenty_six, NOISE, rng, channels=warm, channel_reference={"temp_c": 25.0})
        c = fit(poses, signs=SIGNS, excluded=())
        ratios.append((_sphere_rms(c, paper_unit) / float(budget(c).magnitude.standard)) ** 2)
    assert abs(np.mean(ratios) - 1) < 4 * np.std(ratios) / np.sqrt(len(ratios))


@pytest.mark.parametrize(
    ("noise", "reference", "dominant"), [(1e-6, 4e-5, "reference"), (1e-3, 4e-5, "noise"), (1e-6, 1e-9, "noise")]
)
def test_the_largest_term_dominates_and_halving_it_is_worth_what_it_says(
    paper_unit: Sensor, twenty_six: np.ndarray, noise: float, reference: float, dominant: str
) -> None:
    poses = noisy_poses(paper_unit, twenty_six, noise, np.random.default_rng(2))
    c = fit(poses, signs=SIGNS, excluded=())
    b = budget(c, Stated(reference=reference))
    assert b.dominant.source == dominant
    assert sum(b.share(x) for x in b.components) == pytest.approx(1)
    halved = sum((x.magnitude / (2 if x is b.dominant else 1)) ** 2 for x in b.components)
    assert b.magnitude_if_halved == pytest.approx(np.sqrt(halved))


def test_no_expanded_uncertainty_is_below_the_standard_error_that_the_fit_states(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    """A temperature that explains all that is beyond noise, and is not in the model."""
    truth = replace(paper_unit, effects=((effect_named("temperature_bias"), np.array([3e-4, -2e-4, 1e-4])),))
    channels = {"temp_c": 25 + 2 * np.sin(np.arange(26) * 1.7)}
    rng = np.random.default_rng(5)
    poses = noisy_poses(truth, twenty_six, NOISE, rng, channels=channels, channel_reference={"temp_c": 25.0})
    c = fit(poses, signs=SIGNS, excluded=())
    assert c.excess_g > 5 * c.residual.noise_floor_g
    b = budget(c)
    assert np.all(b.parameters.standard >= c.standard_errors)
    assert np.all(b.parameters.expanded > c.standard_errors)


def test_what_nobody_stated_is_said_not_to_be_evaluated(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    c = fit(noisy_poses(paper_unit, twenty_six, NOISE, np.random.default_rng(2)), signs=SIGNS, excluded=())
    assert budget(c).not_evaluated == (ReferenceTakenAsExact(), TemperatureNotLogged("temp_c"))
    assert budget(c, Stated(reference=0.0)).not_evaluated == (TemperatureNotLogged("temp_c"),)


def test_what_a_single_reading_lacks_is_said_to_be_in_no_line(paper_unit: Sensor, twenty_six: np.ndarray) -> None:
    rng = np.random.default_rng(2)
    poses = noisy_poses(paper_unit, twenty_six, NOISE, rng)
    told = [replace(p, covariance=p.covariance / 25) for p in poses]
    said = [
        [x for x in budget(fit(ps, signs=SIGNS, excluded=())).not_evaluated if isinstance(x, SingleReading)]
        for ps in (poses, told)
    ]
    assert said[0] == []
    crossed = fit(told, signs=SIGNS, excluded=()).residual.cross_validated_rms_g
    assert crossed is not None
    assert said[1] == [SingleReading(crossed)]
