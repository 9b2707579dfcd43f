"""What it costs that the poses leave open which effect acts."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.truth import PAPER_UNIT, Condition, plan
from triaxcal.diagnosis import diagnose
from triaxcal.model.samples import Moment
from triaxcal.poses.pose import Pose
from triaxcal.uncertainty import budget
from triaxcal.uncertainty.statements import AveragedModels


def one_after_the_other(poses: list[Pose], every_s: float, duration_s: float) -> list[Pose]:
    """Taken in this order, so that each knows the pose before it."""
    out: list[Pose] = []
    for i, p in enumerate(poses):
        before = out[-1].mean if out else None
        out.append(replace(p, start_s=every_s * i, end_s=every_s * i + duration_s, before=before))
    return out


@pytest.mark.slow
def test_a_drift_that_may_be_a_warm_up_holds_the_truth_in_the_middle_of_the_recording() -> None:
    """Both are corrected where neither is certain, each by its probability, and the budget names them."""
    both = 0
    for seed in range(4):
        rng = np.random.default_rng([seed, 9])
        c = Condition("", PAPER_UNIT, plan(26)[rng.permutation(26)], np.array(6e-6))
        t = 8.0 * np.arange(26)
        drift = (t - t.mean())[:, None] / 100 * np.array([2e-4, -2e-4, 1e-4]) * c.unit.scale_factor
        still = c.poses(rng.standard_normal((26, 3)) * c.error + drift)
        loop = diagnose(one_after_the_other(still, 8.0, 6.0), signs=c.signs, at=Moment.MEAN)
        assert next(iter(loop.probabilities)) == "bias_drift"
        assert loop.posterior.any_of({"bias_drift", "warm_up"}) > 0.99
        b = budget(loop.after)
        assert np.all(np.abs(loop.after.values[:9] - c.truth) < 1.5 * b.parameters.expanded[:9])
        lines = {line.source: line for line in b.components}
        if loop.after.terms == ("linear", "bias_drift"):
            assert lines["choice_of_effect"].basis == AveragedModels(())
            assert lines["choice_of_effect"].magnitude < lines["noise"].magnitude < 5e-6
        else:
            both += 1
            assert lines["choice_of_effect"].basis == AveragedModels(("bias_drift", "warm_up"))
    assert both == 1


@pytest.mark.slow
def test_intervals_hold_the_truth_that_none_of_the_names_has() -> None:
    alone, pulls, named = [], [], 0
    for seed in range(5):
        rng = np.random.default_rng([seed, 1])
        c = Condition("", PAPER_UNIT, plan(14)[rng.permutation(14)], np.array(6e-6))
        # A stand that does not come back, of which no effect knows; five degrees of freedom are left to see it by.
        off = 1e-4 * rng.standard_normal(14)[:, None] * c.ups * c.unit.scale_factor
        still = c.poses(rng.standard_normal((14, 3)) * c.error + off)
        loop = diagnose(one_after_the_other(still, 1.0, 1.0), signs=c.signs)
        assert loop.findings == ()
        named += len(loop.candidates)
        assert loop.found.unexplained.significant or loop.candidates
        b = budget(loop.after)
        miss = np.abs(loop.after.values[:9] - c.truth)
        (noise,) = [line for line in b.components if line.source == "noise"]
        alone.append(miss < 2 * noise.parameters[:9])
        pulls.append(miss / b.parameters.standard[:9])
        assert b.dominant.source in ("choice_of_effect", "unmodelled")
    assert named <= 1  # five degrees of freedom hardly tell scatter from a function of the direction
    assert np.mean(alone) < 0.4
    assert np.mean(np.array(pulls) < 2) > 0.85
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.4
