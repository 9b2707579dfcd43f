"""Verification by physics: the length of the corrected output against the reference, nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from triaxcal.poses.pose import Pose
from triaxcald.verification import verification_document, verify


def _pose(mean: list[float], error: float = 1e-5, at_s: float = 0.0) -> Pose:
    return Pose(at_s, at_s + 2.0, 200, np.array(mean), np.eye(3) * error**2, 50.0)


def test_the_error_is_that_of_the_length_in_any_direction() -> None:
    found = verify([_pose([1.001, 0, 0]), _pose([0, -0.6, 0.8]), _pose([0, 0, -0.998])], reference=1.0)
    np.testing.assert_allclose(found.error_g, [1e-3, 0, -2e-3], atol=1e-15)
    assert found.rms_g == pytest.approx(np.sqrt(5e-6 / 3))
    np.testing.assert_allclose(found.standard_error_g, 1e-5)
    assert found.noise_floor_g == pytest.approx(1e-5)


def test_noise_across_the_measured_vector_does_not_count() -> None:
    pose = Pose(0.0, 2.0, 200, np.array([0, 0, 1.0]), np.diag([1e-2, 1e-2, 1e-10]), 50.0)
    assert verify([pose], 1.0).noise_floor_g == pytest.approx(1e-5)


def test_the_verdict_follows_the_limit() -> None:
    before, after = verify([_pose([1.01, 0, 0])], 1.0), verify([_pose([1.0001, 0, 0])], 1.0)
    verdicts = [
        verification_document(before, after, limit_g=limit, raw_sha256="00")["verdict"] for limit in (None, 2e-4, 5e-5)
    ]
    assert verdicts == ["not judged", "within limits", "outside limits"]


def test_the_document_has_before_and_after_and_every_pose() -> None:
    after = verify([_pose([1.0001, 0, 0]), _pose([0, 0.9998, 0], at_s=3.0)], 1.0)
    document = verification_document(verify([_pose([1.01, 0, 0])], 1.0), after, limit_g=1e-3, raw_sha256="ab")
    assert document["format"] == "triaxcal.verification/1"
    assert document["before_rms_g"] == pytest.approx(1e-2)
    assert document["after_max_abs_g"] == pytest.approx(2e-4)
    assert document["raw_sha256"] == "ab"
    assert [p["start_s"] for p in document["poses"]] == [0.0, 3.0]
    assert [p["error_g"] for p in document["poses"]] == pytest.approx([1e-4, -2e-4])


def test_no_pose_at_all_is_outside_any_limit() -> None:
    nothing = verify([], 1.0)
    assert nothing.rms_g is None
    document = verification_document(nothing, nothing, limit_g=1.0, raw_sha256="")
    assert document["verdict"] == "outside limits"
    assert document["after_rms_g"] is document["after_max_abs_g"] is None
    assert verification_document(nothing, nothing, limit_g=None, raw_sha256="")["verdict"] == "not judged"
