"""What is said of poses to come, held against the conditional of the joint density of all rows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.triaxcal.evidence.conftest import MINUS, rows_of
from tests.undeclared.examine import Case, still_poses
from triaxcal.effects import CATALOGUE
from triaxcal.evidence.covariances import PoseInputs, UnmodelledKind
from triaxcal.evidence.likelihood import Evidence
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.evidence.next_measurement import Predictive
from triaxcal.evidence.posterior import Posterior
from triaxcal.evidence.prior import Odds
from triaxcal.evidence.terms import terms_of
from triaxcal.poses.pose import Pose

Poses = Callable[..., list[Pose]]
FLAT = 1e3
"""Standard deviation that stands for a flat prior of the nine parameters, in standard errors."""


def recorded() -> tuple[list[Pose], LinearisedData]:
    recording = Case("none", 1, (1.0, 1.0), 26, "white").make()
    poses = still_poses(recording.samples())
    return poses, rows_of(poses, recording.signs)


def test_poses_that_were_taken_are_to_come_as_they_were(poses_with: Poses) -> None:
    means = poses_with(1)
    for poses, rows in (recorded(), (means, rows_of(means, MINUS))):
        again = rows.of_future_poses(rows.poses)
        assert again.slopes == rows.slopes
        assert len(rows.poses) == len(poses)
        assert again.linear == pytest.approx(rows.linear, abs=1e-9)
        for effect in CATALOGUE:
            if all(need in rows.problem.channel_reference for need in effect.needs):
                expected = rows.by_coefficients(effect)
                assert again.by_coefficients(effect) == pytest.approx(
                    expected, rel=1e-3, abs=1e-3 * abs(expected).max()
                )


@pytest.mark.slow
def test_a_covariance_with_poses_to_come_is_that_of_the_rows_where_they_are_the_same() -> None:
    _, rows = recorded()
    evidence = Evidence(rows, terms_of(rows, [], Odds()), Odds())
    here, there = PoseInputs.of(rows), PoseInputs.of(rows.of_future_poses(rows.poses))
    for kind in {part.kind for part in evidence.parts if part.kind is not None}:
        crossed, whole = kind.covariance_of(there, here), kind.covariance_of(here, here)
        own = kind.what in (UnmodelledKind.EACH_POSE, UnmodelledKind.WITHIN_POSE)
        expected = np.zeros_like(whole) if own else whole
        assert crossed == pytest.approx(expected, abs=1e-6 * np.abs(whole).max()), kind.what
        assert pytest.approx(crossed, abs=1e-9) == kind.covariance_of(here, there).T


def of(evidence: Evidence, name: str) -> int:
    return next(i for i, term in enumerate(evidence.terms) if term.name == name)


@pytest.mark.parametrize("part", [0, 4, 11, 24, 32, 46, 53])
def test_poses_to_come_are_predicted_as_the_joint_density_of_all_rows_says(poses_with: Poses, part: int) -> None:
    poses = poses_with(3, third_order_nonlinearity=[2e-4, 1e-4, -3e-4])
    rows = rows_of(poses, MINUS)
    evidence = Evidence(rows, terms_of(rows, CATALOGUE, Odds()), Odds())
    members = tuple(sorted((of(evidence, "third_order_nonlinearity"), of(evidence, "hysteresis"))))
    found = evidence.of_set(members, [part])
    cell = int(np.argmax(found.log[0]))
    ahead = rows.of_future_poses(poses_with(8)[:5])
    one = replace(found, sizes=found.sizes[[cell]], log=found.log[:, [cell]])
    mean, covariance = Predictive.likeliest(Posterior(evidence, [one]), 1.0).predicted(ahead)

    def design(of_rows: LinearisedData) -> np.ndarray:
        columns = []
        for i, size in zip(members, found.sizes[cell], strict=True):
            term = evidence.terms[i]
            assert term.effect is not None
            columns.append(size * of_rows.by_coefficients(term.effect)[:, list(term.kept)] * term.combination)
        return np.concatenate([FLAT * of_rows.linear, *columns], axis=1)

    both = np.concatenate([design(rows), design(ahead)])
    joint = np.eye(len(both)) + both @ both.T
    assumed = evidence.parts[part]
    if assumed.kind is not None:
        here, there = PoseInputs.of(rows), PoseInputs.of(ahead)
        crossed = assumed.kind.covariance_of(here, there)
        joint += assumed.tau**2 * np.block(
            [[assumed.kind.covariance_of(here, here), crossed], [crossed.T, assumed.kind.covariance_of(there, there)]]
        )
    n = rows.n
    gain = joint[n:, :n] @ np.linalg.inv(joint[:n, :n])
    assert mean[0] == pytest.approx(gain @ rows.y, rel=1e-3, abs=1e-3)
    # Of an unmodelled part, whose kind is not that of the truth, the noise is a little less or more.
    expected = joint[n:, n:] - gain @ joint[:n, n:]
    noise = covariance[0, 0, 0] / expected[0, 0]
    assert noise == pytest.approx(1.0, abs=0.01)
    assert covariance[0] == pytest.approx(noise * expected, rel=1e-3, abs=1e-3)
