"""Verification by physics: the length of the corrected output against the reference, nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from triaxcal.poses.pose import Pose
from triaxcal_drivers.catalogue import load_bundle
from triaxcal_drivers.profile import CORRECTED
from triaxcald.raw_to_poses import Pipeline
from triaxcald.verification import Apart, verification_document, verified, verify

RAW = "0" * 64
ALL_APART = Apart(np.zeros((0, 3)), 10.0)


def _pose(mean: list[float], error: float = 1e-5, at_s: float = 0.0, fault: str = "") -> Pose:
    return Pose(at_s, at_s + 2.0, 200, np.array(mean), np.eye(3) * error**2, 50.0, fault=fault)


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
        verification_document(before, after, limit_g=limit, raw_sha256=RAW, apart=ALL_APART)["verdict"]
        for limit in (None, 2e-4, 5e-5)
    ]
    assert verdicts == ["not judged", "within limits", "outside limits"]


@pytest.mark.parametrize(
    ("after", "limit", "verdict"),
    [
        (4e-4, None, "worse than before"),
        (1.5e-4, None, "not judged"),
        (4e-4, 5e-4, "within limits"),
    ],
)
def test_without_a_limit_the_old_calibration_is_the_limit_but_for_chance(
    after: float, limit: float | None, verdict: str
) -> None:
    signs = (-1) ** np.arange(26)
    old, new = (verify([_pose([1 + e * s, 0, 0]) for s in signs], 1.0) for e in (1e-4, after))
    assert verification_document(old, new, limit_g=limit, raw_sha256=RAW, apart=ALL_APART)["verdict"] == verdict


def test_poses_that_are_only_noisier_are_not_worse() -> None:
    signs = (-1) ** np.arange(26)
    old = verify([_pose([1 + 1e-5 * s, 0, 0], error=1e-5) for s in signs], 1.0)
    noisy, quiet = (verify([_pose([1 + 4e-5 * s, 0, 0], error=e) for s in signs], 1.0) for e in (4e-5, 1e-5))
    verdicts = [
        verification_document(old, v, limit_g=None, raw_sha256=RAW, apart=ALL_APART)["verdict"] for v in (noisy, quiet)
    ]
    assert verdicts == ["not judged", "worse than before"]


def test_the_document_has_before_and_after_and_every_pose() -> None:
    after = verify([_pose([1.0001, 0, 0]), _pose([0, 0.9998, 0], at_s=3.0)], 1.0)
    document = verification_document(
        verify([_pose([1.01, 0, 0])], 1.0), after, limit_g=1e-3, raw_sha256=RAW, apart=ALL_APART
    )
    assert document["format"] == "triaxcal.verification/1"
    assert document["before_rms_g"] == pytest.approx(1e-2)
    assert document["after_max_abs_g"] == pytest.approx(2e-4)
    assert document["raw_sha256"] == RAW
    assert [p["start_s"] for p in document["poses"]] == [0.0, 3.0]
    assert [p["error_g"] for p in document["poses"]] == pytest.approx([1e-4, -2e-4])


def test_no_pose_at_all_is_outside_any_limit() -> None:
    nothing = verify([], 1.0)
    assert nothing.rms_g is None
    document = verification_document(nothing, nothing, limit_g=1.0, raw_sha256=RAW, apart=ALL_APART)
    assert document["verdict"] == "outside limits"
    assert document["after_rms_g"] is document["after_max_abs_g"] is None
    assert (
        verification_document(nothing, nothing, limit_g=None, raw_sha256=RAW, apart=ALL_APART)["verdict"]
        == "not judged"
    )


def test_a_pose_that_cannot_be_trusted_is_in_no_figure_and_stays_marked_in_the_document() -> None:
    railed = _pose([0, 0.5, 0], error=1e-3, at_s=3.0, fault="saturation")
    before = verify([_pose([1.01, 0, 0]), railed], 1.0)
    after = verify([_pose([1.0001, 0, 0]), railed, _pose([0, 0.9998, 0], at_s=6.0)], 1.0)
    document = verification_document(before, after, limit_g=1e-3, raw_sha256=RAW, apart=ALL_APART)
    assert document["before_rms_g"] == pytest.approx(1e-2)
    assert document["after_rms_g"] == pytest.approx(np.sqrt(2.5e-8))
    assert document["after_max_abs_g"] == pytest.approx(2e-4)
    assert document["noise_floor_g"] == pytest.approx(1e-5)
    assert document["verdict"] == "within limits"
    assert [(p["used"], p["fault"]) for p in document["poses"]] == [(True, None), (False, "saturation"), (True, None)]
    assert document["poses"][1]["error_g"] == pytest.approx(-0.5)


def test_where_none_can_be_trusted_there_is_no_figure_and_no_limit_is_kept() -> None:
    stuck = verify([_pose([1.0, 0, 0], fault="stuck_output")], 1.0)
    assert [p.fault for p in stuck.untrusted] == ["stuck_output"]
    assert stuck.rms_g is stuck.max_abs_g is stuck.noise_floor_g is None
    assert (
        verification_document(stuck, stuck, limit_g=1.0, raw_sha256=RAW, apart=ALL_APART)["verdict"] == "outside limits"
    )


def test_what_spoils_the_corrected_stream_is_in_the_document() -> None:
    pipeline = Pipeline(load_bundle(Path("triax-ref-can")), CORRECTED)
    pipeline.counts["samples"], pipeline.counts["missing"] = 99, 1
    found = verified(pipeline, 1.0)
    assert found.data_quality == ("missing_samples: 1 of 100",)
    assert verification_document(found, found, limit_g=None, raw_sha256=RAW, apart=ALL_APART)["data_quality"] == [
        *found.data_quality
    ]


def test_the_expanded_uncertainty_of_the_rms_is_twice_its_scatter() -> None:
    """Over many drawings of the noise, for errors far above it, of its size, and below it."""
    rng = np.random.default_rng(1)
    noise = 1e-5
    for size in (1e-4, 1e-5):
        true = size * (-1.0) ** np.arange(12)
        drawn = [
            verify([_pose([1 + e, 0, 0], error=noise) for e in true + noise * rng.standard_normal(12)], 1.0)
            for _ in range(600)
        ]
        scatter = np.std([v.rms_g for v in drawn])
        told = np.median([v.expanded_uncertainty_g for v in drawn])
        assert told == pytest.approx(2 * scatter, rel=0.12)


def test_a_pose_that_cannot_be_trusted_has_no_part_in_the_uncertainty() -> None:
    sound = [_pose([1 + 1e-4, 0, 0]), _pose([0, 1 - 1e-4, 0])]
    spoiled = _pose([0, 0, 1.01], error=1e-2, fault="saturated")
    assert verify([*sound, spoiled], 1.0).expanded_uncertainty_g == verify(sound, 1.0).expanded_uncertainty_g
    assert verify([spoiled], 1.0).expanded_uncertainty_g is None


def test_the_document_says_how_far_each_check_pose_was_from_the_fits() -> None:
    fitted = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    tilted = [np.cos(np.radians(12.0)), np.sin(np.radians(12.0)), 0]
    after = verify([_pose(tilted), _pose([0, 1, 0]), _pose([0, -1, 0], fault="saturated")], 1.0)
    document = verification_document(after, after, limit_g=1e-3, raw_sha256=RAW, apart=Apart(fitted, 10.0))
    assert [p["from_fit_deg"] for p in document["poses"]] == [12.0, 0.0, 90.0]
    assert document["poses_apart"] == 1
