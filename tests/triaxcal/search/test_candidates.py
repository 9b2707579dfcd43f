"""What the search tries: what shows beside the nine parameters, by plain projection, and nothing that stands still."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from triaxcal.effects import CATALOGUE, effect_named
from triaxcal.effects.bias_step import BiasStep
from triaxcal.effects.contract import SCATTER
from triaxcal.effects.part import Part
from triaxcal.effects.warm_up import WarmUp
from triaxcal.poses.pose import Pose
from triaxcal.problem import solve
from triaxcal.search.candidates import Candidate, Ground, candidates_of, still_conditions
from triaxcal.sensor import Sensor
from triaxcal.start import problem_of, start, with_history

Recorded = Callable[..., list[Pose]]
GroundOf = Callable[[list[Pose]], Ground]
Weighted = Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]


def quadric(a: np.ndarray) -> np.ndarray:
    """Orthonormal columns of what nine parameters can make of |a| on the sphere."""
    x, y, z = a.T
    return np.linalg.qr(np.stack([x * x, y * y, z * z, x * y, y * z, x * z, x, y, z], axis=1))[0]


def tried(poses: list[Pose], ground: Ground, *names: str) -> tuple[list[Candidate], set[str]]:
    return candidates_of(ground, [effect_named(n) for n in names], still_conditions(poses))


@pytest.fixture(scope="module")
def poses(paper_unit: Sensor, recorded: Recorded) -> list[Pose]:
    return recorded(paper_unit, 0)


@pytest.fixture(scope="module")
def ground(poses: list[Pose], ground_of: GroundOf) -> Ground:
    return ground_of(poses)


def test_columns_are_the_differences_of_the_residuals(poses: list[Pose], ground: Ground, weighted: Weighted) -> None:
    sensor = ground.state.sensor(ground.problem)
    s = np.array([p.mean for p in poses]) / sensor.scale_factor - sensor.bias
    basis = s[:, :, None] ** 2 * np.eye(3)
    y, J, Z = weighted(poses, sensor, basis)
    assert ground.columns(effect_named("second_order_nonlinearity")) == pytest.approx(Z, rel=1e-5, abs=1e-4 * Z.max())
    # At the solution the model has nothing left of the residuals, and its columns span those of the differences.
    assert ground.y == pytest.approx(y, abs=2e-3)
    assert ground.model.shape == (26, 9)
    assert J - ground.model @ (ground.model.T @ J) == pytest.approx(np.zeros((26, 9)), abs=1e-5 * np.abs(J).max())


def test_a_basis_is_orthonormal_and_free_of_the_model(poses: list[Pose], ground: Ground) -> None:
    found, _ = candidates_of(ground, CATALOGUE, still_conditions(poses))
    for c in found:
        assert c.basis.T @ c.basis == pytest.approx(np.eye(c.rank), abs=1e-9)
        assert np.abs(ground.model.T @ c.basis).max() < 1e-9


def test_what_shows_spans_the_mixed_columns_beside_the_model(poses: list[Pose], ground: Ground) -> None:
    found, _ = candidates_of(ground, CATALOGUE, still_conditions(poses))
    for c in found:
        Z = ground.columns(c.effect)
        rest = Z - ground.model @ (ground.model.T @ Z)
        assert c.rank == len(c.effect.coefficients)
        outside = rest - c.basis @ (c.basis.T @ rest)
        assert np.abs(outside).max() < 1e-8 * np.abs(Z).max()


def test_every_effect_is_tried_whole_on_all_axes_and_on_each_axis_alone(poses: list[Pose], ground: Ground) -> None:
    found, full = tried(poses, ground, "second_order_nonlinearity", "temperature_bias")
    assert full == {"second_order_nonlinearity", "temperature_bias"}
    for name in full:
        own = [c for c in found if c.name == name]
        kinds = {tuple(k.name for k in c.effect.coefficients) for c in own}
        assert {("x", "y", "z"), ("x",), ("y",), ("z",)} <= kinds
        assert len(kinds) == len(own)
        assert {c.tries for c in own} == {len(own)}


@pytest.mark.parametrize("reference", [1e-8, 5e4])
def test_what_shows_is_the_same_in_any_unit(
    reference: float, paper_unit: Sensor, recorded: Recorded, directions: np.ndarray
) -> None:
    shaken = 1e-6 * (1 + np.arange(26) % 3)
    poses = [replace(p, scatter=np.full(3, v)) for p, v in zip(recorded(paper_unit, 0), shaken, strict=True)]
    shown = []
    for size in (1.0, reference):
        scaled = [
            replace(
                p,
                mean=p.mean * size,
                covariance=p.covariance * size**2,
                before=None if p.before is None else p.before * size,
                scatter=p.scatter * size**2,
            )
            for p in poses
        ]
        problem = problem_of(scaled, signs=(-1, -1, -1), reference=size)
        state = start(problem, scaled, (-1, -1, -1))
        problem = with_history(problem, scaled, state.sensor(problem))
        found, full = candidates_of(Ground.at(problem, solve(problem, state, ())), CATALOGUE, set())
        shown.append(([(c.name, c.rank, [k.name for k in c.effect.coefficients]) for c in found], full))
    assert shown[0] == shown[1]
    assert {"third_order_nonlinearity", "vibration_rectification", "hysteresis"} <= shown[0][1]


def test_every_variant_of_a_shape_is_tried(poses: list[Pose], ground: Ground) -> None:
    found, _ = tried(poses, ground, "warm_up", "bias_step")
    held = ground.problem.conditions
    for effect in (WarmUp(), BiasStep()):
        wanted = {dict(v.shape)[n] for v in effect.variants(held) for n in v.shape}
        shown = {c.effect.shape[n] for c in found if c.name == effect.name for n in c.effect.shape}
        assert shown <= wanted
        # Far ends may hide in the nine parameters, or have too few poses to show on every axis; most do not.
        assert len(shown) > 0.8 * len(wanted)


@pytest.mark.parametrize(
    ("name", "shows"),
    [("second_order_nonlinearity", 3), ("third_order_nonlinearity", 1), ("scale_factor_asymmetry", 3)],
)
def test_of_an_effect_that_shows_in_part_only_what_shows_is_tried(
    name: str, shows: int, paper_unit: Sensor, recorded: Recorded, ground_of: GroundOf, fourteen: np.ndarray
) -> None:
    poses = recorded(paper_unit, 0, where=fourteen)
    ground = ground_of(poses)
    found, full = tried(poses, ground, name)
    # METHOD §5, and by plain projection on the exact directions.
    power = {"second_order_nonlinearity": fourteen**3, "third_order_nonlinearity": fourteen**4}
    columns = power.get(name, np.abs(fourteen) * fourteen)
    q = quadric(fourteen)
    assert np.linalg.matrix_rank(columns - q @ (q.T @ columns), tol=0.02) == shows
    assert max(c.rank for c in found) == shows
    assert (name in full) == (shows == 3)
    if shows == 1:
        (combined,) = [c for c in found if not all(k.name in "xyz" for k in c.effect.coefficients)]
        assert isinstance(combined.effect, Part)
        weight = combined.effect.mix[:, 0] / combined.effect.mix[0, 0]
        # The three axes by their sum (the scale factors of this unit are alike to 2 %).
        assert weight == pytest.approx(np.ones(3), abs=0.1)


def test_a_channel_that_stands_still_is_not_tried(paper_unit: Sensor, recorded: Recorded, ground_of: GroundOf) -> None:
    rng = np.random.default_rng(0)
    poses = recorded(
        paper_unit, 0, channels={"temp_c": np.full(26, 25.0), "supply_v": 5 + 0.01 * rng.standard_normal(26)}
    )
    assert {"temp_c", "temp_c.rate"} <= still_conditions(poses)
    assert "supply_v" not in still_conditions(poses)
    found, full = tried(poses, ground_of(poses), "temperature_bias", "channel_bias:supply_v")
    assert full == {"channel_bias:supply_v"}
    assert {c.name for c in found} == full


@pytest.mark.parametrize(("swing", "still"), [(0.02, True), (0.1, False)])
def test_a_channel_moves_where_it_moves_by_more_than_its_own_noise(
    swing: float, still: bool, paper_unit: Sensor, recorded: Recorded
) -> None:
    rng = np.random.default_rng(0)
    wander = rng.standard_normal(26)
    wander /= wander.std()
    poses = [
        replace(p, channel_errors={"temp_c": 0.02}, rates={"temp_c": r}, rate_errors={"temp_c": 0.02})
        for p, r in zip(recorded(paper_unit, 0, channels={"temp_c": 25 + swing * wander}), swing * wander, strict=True)
    ]
    # Three standard errors of 0.02 K, or of 0.02 K/s, are the limit.
    assert ("temp_c" in still_conditions(poses)) is still
    assert ("temp_c.rate" in still_conditions(poses)) is still


@pytest.mark.parametrize(("samples", "ratio", "still"), [(1000, 1.0, True), (1000, 2.0, False), (40, 1.4, True)])
def test_scatter_moves_where_poses_are_shaken_unlike_each_other_by_more_than_chance(
    samples: int, ratio: float, still: bool, paper_unit: Sensor, recorded: Recorded
) -> None:
    rng = np.random.default_rng(0)
    shaken = np.where(np.arange(26) % 2, 1.0, ratio)
    poses = [
        replace(p, samples=samples, scatter=1e-6 * f * rng.chisquare(samples - 1, 3) / (samples - 1))
        for p, f in zip(recorded(paper_unit, 0), shaken, strict=True)
    ]
    assert (set(SCATTER) <= still_conditions(poses)) is still


def test_an_effect_whose_channel_is_not_logged_is_not_tried(poses: list[Pose], ground: Ground) -> None:
    found, full = tried(poses, ground, "channel_bias:supply_v")
    assert (found, full) == ([], set())
