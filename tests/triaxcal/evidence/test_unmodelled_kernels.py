"""Covariances of what no name describes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.triaxcal.evidence.conftest import MINUS, rows_of
from tests.undeclared.examine import Case, still_poses
from triaxcal.evidence.covariances import PoseInputs, UnmodelledKind, kinds_of
from triaxcal.evidence.linearised_data import LinearisedData
from triaxcal.poses.pose import Pose


def of_recording() -> LinearisedData:
    recording = Case("none", 1, (1.0, 1.0), 26, "white").make()
    return rows_of(still_poses(recording.samples()), recording.signs)


@pytest.fixture(params=["means alone", "with slopes"])
def rows(request: pytest.FixtureRequest, poses_with: Callable[..., list[Pose]]) -> LinearisedData:
    rows = of_recording() if request.param == "with slopes" else rows_of(poses_with(1), MINUS)
    assert rows.slopes == (request.param == "with slopes")
    return rows


@pytest.mark.slow
def test_every_kind_has_a_mean_variance_of_one_beyond_the_nine_parameters(rows: LinearisedData) -> None:
    for kind in kinds_of(rows):
        here = PoseInputs.of(rows)
        left = rows.beyond_linear(rows.beyond_linear(kind.covariance_of(here, here)).T)
        assert np.trace(left) / rows.residual_dof == pytest.approx(1.0), kind.what
        assert kind.of_rows.beyond(rows.basis) == pytest.approx(np.diag(left), abs=1e-9 * np.trace(left))


def test_only_slopes_know_what_acts_inside_the_poses_alone(rows: LinearisedData) -> None:
    assert (UnmodelledKind.WITHIN_POSE in {kind.what for kind in kinds_of(rows)}) == rows.slopes


def test_nothing_goes_with_time_where_nobody_knows_when_poses_were_taken(poses_with: Callable[..., list[Pose]]) -> None:
    rows = rows_of([replace(p, start_s=0.0, end_s=0.0) for p in poses_with(1)], MINUS)
    assert UnmodelledKind.TIME not in {kind.what for kind in kinds_of(rows)}
