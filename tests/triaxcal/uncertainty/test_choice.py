"""What other models that explain the poses as well make of the unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.truth import PAPER_UNIT, Condition, plan
from triaxcal.effects import effect_named
from triaxcal.loop import diagnose
from triaxcal.pose_fit import fit
from triaxcal.sensor import Sensor
from triaxcal.synthetic import noisy_poses
from triaxcal.uncertainty import budget
from triaxcal.uncertainty.basis import CompetingModels

NOISE = 2e-5
SIGNS = (-1, -1, -1)


def test_models_that_explain_the_poses_as_well_are_a_line_of_their_own(
    paper_unit: Sensor, twenty_six: np.ndarray
) -> None:
    temp_c = 25 + 6 * np.sin(1.7 * np.arange(26))
    effect = effect_named("temperature_bias")
    truth = replace(paper_unit, effects=((effect, np.array([3e-4, -2e-4, 1e-4])),))
    poses = noisy_poses(
        truth,
        twenty_six,
        NOISE,
        np.random.default_rng(4),
        channels={"temp_c": temp_c},
        channel_reference={"temp_c": 25.0},
    )
    c, without = (fit(poses, signs=SIGNS, effects=effects, aside=()) for effects in ([effect], []))
    assert not any(line.source == "choice_of_effect" for line in budget(c).components)
    b = budget(replace(c, rivals={"this": without, "that": without}))
    (line,) = [line for line in b.components if line.source == "choice_of_effect"]
    assert line.basis == CompetingModels(("this", "that"))
    # Two of three are off by as much; coefficients of effects count as they are.
    off = np.append(without.values - c.values[:9], np.zeros(3))
    assert line.parameters == pytest.approx(np.abs(off) * np.sqrt(2 / 3))
    ups = np.random.default_rng(0).standard_normal((20000, 3))
    u = c.sensor.output(ups / np.linalg.norm(ups, axis=1, keepdims=True), {"temp_c": np.zeros(20000)})
    length, _ = without.sensor.magnitude(u, {})
    assert line.magnitude == pytest.approx(np.sqrt(2 / 3 * np.mean((length - 1) ** 2)), rel=0.02)
    assert b.magnitude.standard == pytest.approx(np.hypot(budget(c).magnitude.standard, line.magnitude))


def test_a_drift_that_may_be_a_warm_up_is_compared_with_it_in_the_middle_of_the_recording() -> None:
    """Long after the start, where a warm-up holds, a drift says nothing: that is no doubt about this recording."""
    told = 0
    for seed in range(4):
        rng = np.random.default_rng([seed, 9])
        c = Condition("", PAPER_UNIT, plan(26)[rng.permutation(26)], np.array(6e-6))
        t = 8.0 * np.arange(26)
        drift = (t - t.mean())[:, None] / 100 * np.array([2e-4, -2e-4, 1e-4]) * c.unit.scale_factor
        still = c.poses(rng.standard_normal((26, 3)) * c.error + drift)
        loop = diagnose([replace(p, start_s=s, end_s=s + 6) for p, s in zip(still, t, strict=True)], signs=c.signs)
        (found,) = loop.findings
        if (found.effect, found.alternatives) != ("bias_drift", ("warm_up",)):
            continue
        told += 1
        b = budget(loop.after)
        (line,) = [line for line in b.components if line.source == "choice_of_effect"]
        assert line.magnitude < 1e-5
        assert np.all(np.abs(loop.after.values[:9] - c.truth) < 1.5 * b.parameters.expanded[:9])
    assert told >= 2


def test_intervals_hold_the_truth_that_none_of_the_names_has() -> None:
    alone, held = [], []
    for seed in range(5):
        rng = np.random.default_rng([seed, 1])
        c = Condition("", PAPER_UNIT, plan(14)[rng.permutation(14)], np.array(6e-6))
        # A stand that does not come back, of which no effect knows; five degrees of freedom are left to see it by.
        off = 1e-4 * rng.standard_normal(14)[:, None] * c.ups * c.unit.scale_factor
        loop = diagnose(c.poses(rng.standard_normal((14, 3)) * c.error + off), signs=c.signs)
        if not any(f.alternatives for f in loop.findings):
            continue
        assert set(loop.after.rivals) >= {n for f in loop.findings for n in f.alternatives}
        miss = np.abs(loop.after.values[:9] - c.truth)
        alone.append(miss < 2 * loop.after.standard_errors[:9])
        held.append(miss < budget(loop.after).parameters.expanded[:9])
    assert len(held) >= 3
    assert np.mean(alone) < 0.4
    assert np.mean(held) > 0.75
