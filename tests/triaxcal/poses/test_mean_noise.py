"""The noise of the means of very long poses."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from triaxcal.poses import pose_noise
from triaxcal.poses.pose import poses_of
from triaxcal.synthetic import Tumble


def variance_of_mean(samples: int, keeps: float) -> float:
    """Of first-order noise of so many samples, whose innovations have unit variance."""
    lag = np.arange(samples)
    autocovariance = keeps**lag / (1 - keeps**2)
    return float(autocovariance[0] * samples + 2 * autocovariance[1:] @ (samples - lag[1:])) / samples**2


@pytest.mark.slow
@pytest.mark.parametrize(("memory_s", "off"), [(0.0, 0.15), (0.5, 0.15), (3.0, 0.3)])
def test_averages_of_windows_show_the_noise_as_well_as_the_windows_do(
    memory_s: float, off: float, fourteen: np.ndarray, detect: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Poses of 600 windows, averaged by eights: white noise, and noise with a memory of five or thirty windows. The
    windows themselves say 1.01, 1.11 and 0.86 times the true variance."""
    path = Tumble(fourteen, hold_s=60.0, move_s=1.5)
    t_s = np.arange(int(100 * path.round_s)) / 100
    keeps = float(np.exp(-0.01 / memory_s)) if memory_s else 0.0
    ratios, changed = [], False
    for seed in range(4):
        white = np.random.default_rng(seed).standard_normal((len(t_s), 3))
        noise = lfilter([1.0], [1.0, -keeps], white, axis=0) * 2e-4
        windows, spans, fine = detect(t_s, path.specific_force(t_s) + noise)
        with monkeypatch.context() as patched:
            patched.setattr(pose_noise, "LONGEST", 100)
            patched.setattr(pose_noise, "SHORTEST", 20)
            coarse = poses_of(windows, spans)
        changed |= any((c.covariance != f.covariance).any() for c, f in zip(coarse, fine, strict=True))
        ratios += [(p.standard_error / 2e-4) ** 2 / variance_of_mean(p.samples, keeps) for p in coarse]
    assert changed
    assert np.mean(ratios) == pytest.approx(1.0, abs=off)


def test_windows_are_averaged_as_far_as_the_shortest_pose_allows() -> None:
    most, least = pose_noise.LONGEST, pose_noise.SHORTEST
    assert pose_noise._averaged_at_once([least, most]) == 1
    assert pose_noise._averaged_at_once([600, 864_000]) == 8
    assert pose_noise._averaged_at_once([2 * least, 864_000]) == 2
    assert pose_noise._averaged_at_once([least, 864_000]) == 1
