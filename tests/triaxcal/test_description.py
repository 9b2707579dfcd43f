"""The empirical term is in the model where it helps poses that no fit saw, and else it is said why it is not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from triaxcal.description import DESCRIBES, described
from triaxcal.loop import Loop, diagnose
from triaxcal.pose_fit import fit
from triaxcal.poses.pose import Pose
from triaxcal.sensor import Sensor
from triaxcal.synthetic import noisy_poses
from triaxcal.unexplained import Unexplained

MINUS = (-1, -1, -1)
SIGMA_G = 1.5e-5
Left = Callable[[np.ndarray], np.ndarray]


def swell(up: np.ndarray) -> np.ndarray:
    """A harmonic of degree 4 that no effect has, as a share of |a|."""
    return np.asarray(3e-4 * up[:, 0] ** 3 * up[:, 1] - 3e-4 * up[:, 0] * up[:, 1] ** 3)


def ripple(up: np.ndarray) -> np.ndarray:
    return np.asarray(3e-4 * np.sin(25 * up).sum(axis=1))


@pytest.fixture(scope="module")
def poses(paper_unit: Sensor) -> Callable[[Left], list[Pose]]:
    def make(left: Left) -> list[Pose]:
        rng = np.random.default_rng(0)
        up = rng.standard_normal((60, 3))
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        return noisy_poses(paper_unit, up * (1 + left(up))[:, None], SIGMA_G, rng)

    return make


def told(loop: Loop) -> list[str]:
    return [line for line in loop.advice if line.startswith("empirical: ")]


def test_a_smooth_rest_is_described_and_nothing_else_is_said_of_it(poses: Callable[[Left], list[Pose]]) -> None:
    loop = diagnose(poses(swell), signs=MINUS, empirical=True)
    assert [f.effect for f in loop.findings] == ["empirical"]
    assert loop.after.terms == ("linear", "empirical")
    before, after = loop.before.residual.cross_validated_rms_g, loop.after.residual.cross_validated_rms_g
    assert before is not None
    assert after is not None
    assert after < before / DESCRIBES
    assert f"from {before * 1e6:.1f} µg to {after * 1e6:.1f} µg" in loop.findings[0].reason
    assert told(loop) == [f"empirical: {loop.findings[0].remedy}"]


def test_a_rest_that_no_smooth_term_describes_is_said_to_be_so_with_the_errors(
    poses: Callable[[Left], list[Pose]],
) -> None:
    loop = diagnose(poses(ripple), signs=MINUS, empirical=True)
    assert loop.unexplained.significant
    assert "empirical" not in loop.after.terms
    error = loop.after.residual.cross_validated_rms_g
    assert error is not None
    (line,) = told(loop)
    assert line.startswith(
        "empirical: tried, but not in the model: with the best smooth term the cross-validated error"
    )
    assert f"goes from {error * 1e6:.1f} µg to " in line
    assert line.endswith(f"has to fall to {error / DESCRIBES * 1e6:.1f} µg or less")


def test_where_noise_explains_what_is_left_nothing_is_tried_and_that_is_said(
    poses: Callable[[Left], list[Pose]],
) -> None:
    loop = diagnose(poses(lambda up: np.zeros(len(up))), signs=MINUS, empirical=True)
    assert told(loop) == [
        f"empirical: not tried, as what is left is no more than noise explains (p {loop.unexplained.p_value:.2g})"
    ]


def test_poses_that_cannot_carry_a_smooth_term_are_said_not_to(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    c = fit(noisy_poses(paper_unit, fourteen[:11], SIGMA_G, np.random.default_rng(0)), signs=MINUS)
    best, why = described(c, Unexplained(True, 1e-3, 1e-4, ""), MINUS)
    assert best is None
    assert why == "tried, but not in the model: the poses cannot carry a smooth term beside the rest"


def test_who_did_not_ask_for_it_hears_nothing_of_it(poses: Callable[[Left], list[Pose]]) -> None:
    loop = diagnose(poses(ripple), signs=MINUS)
    assert not told(loop)
