"""From readings to the frame on tables from level on: every orientation is found, errors are as they are stated."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from tests.half_turns import HANDS, stood
from triaxcal.estimate.pose_fit import fit
from triaxcal.frames.faces import labelled
from triaxcal.frames.orientations import verticals
from triaxcal.frames.standing import stand
from triaxcal.frames.unit_frames import frames
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import poses_of
from triaxcal.poses.stillness.detector import TURN_S, StillnessDetector

SEEDS = 10


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [0.0, 5e-5, 2e-4, 5e-4, 1e-3])
def test_the_rotation_is_within_its_stated_error_on_a_table_of_any_tilt(tilt: float, paper_unit: Sensor) -> None:
    pulls, inside = [], 0
    for seed in range(SEEDS):
        stream = stood(paper_unit, list(HANDS.values())[seed % len(HANDS)], tilt, seed)
        detector = StillnessDetector()
        detector.feed(stream.time_ns, stream.u)
        detector.finish()
        found = verticals(fit(poses_of(detector.windows(), detector.spans(TURN_S)), signs=(-1, -1, -1)))
        standing = stand(found, labelled(found.direction, found.used, stream.labels))
        (unit,) = frames([standing]).units
        miss = (stream.rotation * Rotation.from_matrix(unit.rotation).inv()).as_rotvec()
        pulls.append(miss / unit.standard_error)
        inside += int(np.sum(np.abs(miss) < unit.coverage_factor() * unit.standard_error))
        # Noise of a twentieth of a sample's: a pose of the wrong place would be told by this alone.
        assert np.abs(miss).max() < 4 * np.sqrt(2e-4**2 / 500)
    n = 3 * SEEDS
    assert np.sum(np.square(pulls)) < stats.chi2.ppf(0.999, n)
    assert inside >= stats.binom.ppf(1e-3, n, 0.95)
