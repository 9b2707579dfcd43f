"""What the posterior says of poses whose truth is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tests.triaxcal.evidence.conftest import MINUS, SIGMA_G
from tests.undeclared.examine import Case, still_poses
from triaxcal.estimate.pose_fit import fit
from triaxcal.evidence import Posterior, Refusal, posterior_of, refusal
from triaxcal.evidence.covariances import UnmodelledKind
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses

Poses = Callable[..., list[Pose]]


def found(poses: list[Pose]) -> Posterior:
    return posterior_of(poses, fit(poses, signs=MINUS), signs=MINUS)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_named_where_nothing_acts(poses_with: Poses, seed: int) -> None:
    posterior = found(poses_with(seed))
    assert max(posterior.effect_probabilities.values(), default=0.0) < 0.3
    assert max(posterior.outlier_probabilities) < 0.3
    assert posterior.unmodelled_probability < 0.3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "coefficients"),
    [
        ("third_order_nonlinearity", [3e-3, -2e-3, 2.5e-3]),
        ("second_order_nonlinearity", [0.0, 2e-3, 0.0]),
        ("scale_factor_asymmetry", [1e-3, 8e-4, -9e-4]),
        ("temperature_bias", [5e-4, -4e-4, 6e-4]),
        ("temperature_scale_factor", [5e-4, 4e-4, -6e-4]),
        ("hysteresis", [8e-4, -7e-4, 9e-4]),
        ("cross_coupling", [9e-4, -8e-4, 7e-4, 6e-4, 0.0, 0.0, 0.0]),
    ],
)
def test_what_acts_is_named(poses_with: Poses, name: str, coefficients: list[float]) -> None:
    posterior = found(poses_with(11, **{name: coefficients}))
    assert next(iter(posterior.effect_probabilities)) == name
    assert posterior.effect_probabilities[name] > 0.99
    assert posterior.least_leave_one_out(name) > 0.99
    assert posterior.unmodelled_probability < 0.2


@pytest.mark.slow
def test_two_effects_at_once_are_both_named(poses_with: Poses) -> None:
    posterior = found(poses_with(5, hysteresis=[8e-4, -7e-4, 9e-4], temperature_bias=[5e-4, -4e-4, 6e-4]))
    names, probability = next(iter(posterior.effect_set_probabilities.items()))
    assert names == {"hysteresis", "temperature_bias"}
    assert probability > 0.9


def test_a_knocked_pose_is_an_outlier_and_nothing_else(
    poses_with: Poses, knocked: Callable[[list[Pose], int, float], list[Pose]]
) -> None:
    posterior = found(knocked(poses_with(2), 7, 5e-4))
    assert posterior.outlier_probabilities[7] > 0.99
    assert np.delete(posterior.outlier_probabilities, 7).max() < 0.2
    assert max(posterior.effect_probabilities.values(), default=0.0) < 0.3


@pytest.mark.slow
def test_a_name_that_one_pose_decides_does_not_survive_its_loss(
    poses_with: Poses, knocked: Callable[[list[Pose], int, float], list[Pose]]
) -> None:
    """A single knock looks like many things; whatever is made of it, nothing is certain without that pose."""
    for seed in range(3):
        posterior = found(knocked(poses_with(seed), 12, 3e-4))
        assert all(posterior.least_leave_one_out(name) < 0.5 for name in posterior.effect_probabilities)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["dead_zone", "random_walk", "magnetic_field"])
def test_what_is_in_no_catalogue_is_unmodelled(kind: str) -> None:
    recording = Case(kind, 1, (100.0, 200.0), 26, "white").make()
    poses = still_poses(recording.samples())
    posterior = posterior_of(poses, fit(poses, signs=recording.signs), signs=recording.signs)
    assert posterior.unmodelled_probability > 0.5
    assert all(posterior.least_leave_one_out(name) < 0.99 for name in posterior.effect_probabilities)


@pytest.mark.slow
def test_probabilities_are_those_of_a_partition(poses_with: Poses) -> None:
    posterior = found(poses_with(1, warm_up=[2e-4, 3e-4, -2e-4]))
    assert posterior.set_probabilities.sum() == pytest.approx(1.0)
    assert posterior.part_probabilities.sum() == pytest.approx(1.0)
    assert sum(posterior.effect_set_probabilities.values()) == pytest.approx(1.0)
    assert posterior.unmodelled_probability <= sum(posterior.unmodelled_kind_probabilities.values()) + 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_channels_that_were_exchanged_on_the_way_are_seen_with_the_pose(poses_with: Poses, seed: int) -> None:
    first = 9 + 4 * seed
    poses = poses_with(seed)
    late = [replace(p, mean=p.mean[[1, 0, 2]]) for p in poses[first:]]
    posterior = found([*poses[:first], *late])
    assert int(np.argmax(posterior.change_point_probabilities)) == first
    assert posterior.change_point_probabilities[first] > 0.9
    assert refusal(posterior) is Refusal.CHANGE_POINT


@pytest.mark.slow
def test_another_unit_from_some_pose_on_is_seen(poses_with: Poses) -> None:
    poses = poses_with(3)
    scale = np.array([1.004, 0.995, 1.002])
    posterior = found([*poses[:14], *(replace(p, mean=p.mean * scale) for p in poses[14:])])
    assert posterior.change_point_probabilities[12:17].sum() > 0.9


@pytest.mark.slow
def test_one_unit_all_through_is_no_other(poses_with: Poses) -> None:
    for effects in ({}, {"bias_step": [4e-4, 3e-4, -5e-4]}, {"warm_up": [4e-4, 3e-4, -5e-4]}):
        assert found(poses_with(6, **effects)).change_point_probabilities.sum() < 0.05


@pytest.mark.slow
def test_the_unit_of_the_reference_changes_no_probability(poses_with: Poses) -> None:
    """A tenth of g: effects that go by the sign of a force know its size by its order of magnitude alone."""
    poses = poses_with(9, second_order_nonlinearity=[2e-4, 1e-4, -2e-4], hysteresis=[6e-5, -5e-5, 4e-5])
    in_g, in_si = (
        posterior_of(poses, fit(poses, signs=MINUS, reference=r), signs=MINUS).effect_probabilities for r in (1.0, 10.0)
    )
    assert {n: p for n, p in in_si.items() if p > 1e-3} == pytest.approx(
        {n: p for n, p in in_g.items() if p > 1e-3}, rel=1e-3, abs=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("mg", [2.0, 5.0, 15.0])
@pytest.mark.parametrize("name", ["second_order_nonlinearity", "third_order_nonlinearity", "temperature_bias"])
def test_a_strong_effect_is_as_certain_as_a_weak_one(poses_with: Poses, name: str, mg: float) -> None:
    """At several mg the linear fit is too far off for one linearisation about it."""
    posterior = found(poses_with(12, **{name: [mg * 1e-3, -0.7e-3 * mg, 0.5e-3 * mg]}))
    assert posterior.certain == ((name,),)
    assert refusal(posterior) is None


@pytest.mark.slow
@pytest.mark.parametrize("by_g", [0.01, 0.4, 0.9])
def test_a_pose_is_an_outlier_however_far_it_is_off(
    poses_with: Poses, knocked: Callable[[list[Pose], int, float], list[Pose]], by_g: float
) -> None:
    posterior = found(knocked(poses_with(2), 7, by_g))
    assert posterior.outlier_probabilities[7] > 0.99
    assert posterior.unmodelled_probability < 0.3


@pytest.mark.slow
def test_a_unit_turned_in_its_socket_is_seen_with_the_pose(poses_with: Poses) -> None:
    """As a connector plugged in the other way round: two channels change their signs."""
    poses = poses_with(7)
    posterior = found([*poses[:17], *(replace(p, mean=p.mean * [-1, -1, 1]) for p in poses[17:])])
    assert posterior.change_point_probabilities[17] > 0.9
    assert refusal(posterior) is Refusal.CHANGE_POINT


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("bent_g", [0.0, 2e-4])
def test_a_repeat_that_contradicts_is_time_or_memory_and_no_outlier(
    with_effects: Callable[..., Sensor], bent_g: float, seed: int
) -> None:
    """The same direction within half a degree, 450 µg off, with a drift that no channel logs."""
    rng = np.random.default_rng(seed)
    ups = rng.permutation(np.array([up for _, up in directions(26)]))
    again = ups[3] + np.radians(0.5) * np.cross(ups[3], rng.standard_normal(3))
    unit = with_effects(**({"second_order_nonlinearity": [bent_g, -bent_g, bent_g]} if bent_g else {}))
    poses = noisy_poses(unit, np.concatenate([ups, [again / np.linalg.norm(again)]]), SIGMA_G, rng)
    along = rng.standard_normal(3)
    share = np.linspace(0, 1, len(poses))
    drift_g = 450e-6 * along / abs(along @ ups[3]) / (share[-1] - share[3])
    posterior = found(
        [replace(p, mean=p.mean + unit.scale_factor * drift_g * x) for p, x in zip(poses, share, strict=True)]
    )
    moves = {"bias_drift", "warm_up", "bias_step", "scale_factor_drift", "hysteresis", "remanence"}
    assert (
        posterior.any_of(moves)
        + posterior.unmodelled_kind_probabilities[UnmodelledKind.TIME]
        + posterior.unmodelled_kind_probabilities[UnmodelledKind.POSE_BEFORE]
        > 0.99
    )
    assert max(posterior.outlier_probabilities[3], posterior.outlier_probabilities[-1]) < 0.5
    assert all(posterior.least_leave_one_out(name) >= 0.99 for (name, *others) in posterior.certain if not others)


def test_names_that_are_equally_probable_come_in_one_order_in_every_process() -> None:
    """Sets of names have another order in each; documents are compared byte for byte."""
    names = ["warm_up", "hysteresis", "cross_coupling", "bias_step", "remanence", "compression", "bias_drift"]
    terms = [SimpleNamespace(name=name, effect=object()) for name in names]
    one = SimpleNamespace(members=tuple(range(len(names))), total=0.0)
    posterior = Posterior(cast(Any, SimpleNamespace(terms=terms)), [cast(Any, one)])
    assert dict(posterior.effect_probabilities) == dict.fromkeys(names, 1.0)
    assert list(posterior.effect_probabilities) == sorted(names)
