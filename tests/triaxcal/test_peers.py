"""Judged from outside: the same poses to ODRPACK95 and to imucal."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.peers import FACES, cases, ferraris, orthogonal_distance, ours
from benchmarks.truth import Condition, bound_and_best, plan
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.sensor import Sensor

CASES = {c.name: c for c in cases()}


@pytest.mark.parametrize("name", CASES)
def test_the_fit_is_odrpack_s_orthogonal_distance_far_below_the_noise(name: str) -> None:
    pytest.importorskip("odrpack")
    c = CASES[name]
    bound = np.sqrt(np.diag(bound_and_best(c)[0]))
    # What differs is of second order: the square of the largest noise, against the smallest; ODRPACK's own search ends
    # a thousandth of a standard error off.
    limit = 2e-3 + 10 * float(c.error_g.max() ** 2 / c.error_g.min())
    for seed in range(4):
        poses, _ = c.draw(seed)
        assert np.max(np.abs(ours(c, poses) - orthogonal_distance(c, poses)) / bound) < limit


@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, -1, -1)])
def test_on_exact_faces_the_fit_is_imucal_s_but_for_the_frame(signs: tuple[int, int, int]) -> None:
    pytest.importorskip("imucal")
    unit = Sensor(np.array([2.4, 2.3, 2.5]) * signs, np.array([0.01, -0.02, 0.03]), np.array([0.05, -0.03, 0.02]))
    # The sensor sits askew in its housing, by an angle that |a| does not show.
    axis = np.array([0.02, -0.05, 0.03])
    turn = np.linalg.qr(np.eye(3) + np.cross(np.eye(3), axis))[0]
    turn *= np.sign(np.diag(turn))
    c = Condition("", unit, plan(26) @ turn.T, np.array(1e-9))
    poses = c.poses(np.zeros((26, 3)))
    found = fit(poses, signs=signs).sensor
    faces = np.array([poses[int(np.argmax(plan(26) @ v))].mean for v in FACES])
    theirs, centre = ferraris(faces * signs)
    matrix = found.scale_factor[:, None] * found.axes * np.outer(signs, np.ones(3))
    # Both matrices lead from a frame to the outputs; their product with their transpose leaves the frame out.
    assert matrix @ matrix.T == pytest.approx(theirs @ theirs.T, abs=1e-11)
    assert found.centre * signs == pytest.approx(centre, abs=1e-11)
