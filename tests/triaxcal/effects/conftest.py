"""What the tests of single effects share: their truth, sought again by the fit over many seeds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from triaxcal.effects import Effect
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.sensor import Sensor
from triaxcal.synthetic import noisy_poses

SIGMA_G = 1.5e-5
SEEDS = 40
CHANCE = 1e-3
"""How often a sound fit would fail."""


@pytest.fixture(scope="session")
def with_effect(paper_unit: Sensor) -> Callable[[Effect, Sequence[float]], Sensor]:
    def make(effect: Effect, truth: Sequence[float]) -> Sensor:
        return replace(paper_unit, effects=((effect, np.array(truth)),))

    return make


@pytest.fixture(scope="session")
def recovers(with_effect: Callable[[Effect, Sequence[float]], Sensor], twenty_six: np.ndarray) -> Callable[..., None]:
    """Asserts that the fit gives the nine parameters and the effect's coefficients back, as far off as it says."""

    def check(
        effect: Effect,
        truth: Sequence[float],
        channels: Mapping[str, np.ndarray] | None = None,
        reference: Mapping[str, float] | None = None,
    ) -> None:
        sensor, found = with_effect(effect, truth), []
        true = np.concatenate([sensor.scale_factor, sensor.misalignment, sensor.bias, truth])
        for seed in range(SEEDS):
            rng = np.random.default_rng(seed)
            ups = twenty_six[rng.permutation(26)]
            poses = noisy_poses(sensor, ups, SIGMA_G, rng, channels=channels, channel_reference=reference)
            c = fit(poses, signs=(-1, -1, -1), effects=[effect])
            found.append((c.values - true) / (c.standard_errors / c.birge_ratio))
        pulls = np.array(found)
        each = CHANCE / pulls.shape[1]
        low, high = stats.chi2.ppf([each / 2, 1 - each / 2], SEEDS - 1) / (SEEDS - 1)
        assert np.all(np.abs(pulls.mean(axis=0)) < stats.norm.isf(each / 2) / np.sqrt(SEEDS)), pulls.mean(axis=0)
        spread = pulls.var(axis=0, ddof=1)
        # That a shape may be another is in the errors, and the truth's was given here.
        assert np.all(spread < high), spread
        assert effect.shape or np.all(low < spread), spread

    return check
