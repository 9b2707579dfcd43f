"""Sets of poses that cannot carry nine parameters are refused, and what is wanted mends them."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from triaxcal.errors import Refused
from triaxcal.estimate.calibration import FewPoses, PoorSpread
from triaxcal.estimate.initial_estimate import problem_of, start
from triaxcal.estimate.pose_fit import fit
from triaxcal.model.directions import cube_directions, dilution
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses

MINUS = (-1, -1, -1)
FACES = np.concatenate([np.eye(3), -np.eye(3)])
AROUND = np.linspace(0, 2 * np.pi, 16, endpoint=False)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def circle(normal: np.ndarray, height: float) -> np.ndarray:
    first, second = np.linalg.svd(unit(normal)[None])[2][1:]
    ring = np.outer(np.cos(AROUND), first) + np.outer(np.sin(AROUND), second)
    return unit(height * unit(normal) + np.sqrt(1 - height**2) * ring)


def cap(degrees: float) -> np.ndarray:
    v = unit(np.random.default_rng(0).standard_normal((20000, 3)))
    return v[v @ unit(np.array([1.0, 2.0, 3.0])) > np.cos(np.radians(degrees))][:20]


def clusters() -> np.ndarray:
    rng = np.random.default_rng(0)
    return unit(np.repeat(unit(rng.standard_normal((3, 3))), 6, axis=0) + 0.02 * rng.standard_normal((18, 3)))


def vertices() -> np.ndarray:
    return unit(np.array(list(itertools.product((1.0, -1.0), repeat=3))))


POOR = {
    "six faces, three times each": np.tile(FACES, (3, 1)),
    "eight vertices, twice": np.tile(vertices(), (2, 1)),
    "one plane through two axes": circle(np.array([0.0, 0.0, 1.0]), 0.0),
    "one oblique plane": circle(np.array([1.0, 2.0, 3.0]), 0.0),
    "one cone": circle(np.array([1.0, 2.0, 3.0]), 0.5),
    "a cap of 10 degrees": cap(10),
    "a cap of 30 degrees": cap(30),
    "three clusters": clusters(),
    "one direction, nine times": np.tile([0.6, 0.64, 0.48], (9, 1)),
    "two opposite directions": np.tile([[0.6, 0.64, 0.48], [-0.6, -0.64, -0.48]], (7, 1)),
    "six faces": FACES,
    "eight poses": np.concatenate([FACES, vertices()[:2]]),
}


def measured(sensor: Sensor, directions: np.ndarray) -> list[Pose]:
    return noisy_poses(sensor, directions, 1.5e-5, np.random.default_rng(0))


@pytest.mark.parametrize("name", POOR)
def test_a_poor_set_is_refused_and_the_poses_wanted_mend_it(name: str, paper_unit: Sensor) -> None:
    with pytest.raises(Refused, match=r"cannot carry nine|need at least 9|no ellipsoid") as refusal:
        fit(measured(paper_unit, POOR[name]), signs=MINUS)
    assert 0 < len(refusal.value.wanted) <= 9
    where = dict(cube_directions())
    more = np.array([where[label] for label in refusal.value.wanted])
    mended = fit(measured(paper_unit, np.concatenate([POOR[name], more])), signs=MINUS)
    assert mended.dilution < 20
    assert np.abs(mended.values[:3] - paper_unit.scale_factor) == pytest.approx(np.zeros(3), abs=1e-3)


def a_triad(rng: np.random.Generator, alike: bool) -> tuple[Sensor, tuple[int, ...]]:
    """Of scale factors and biases that nobody knows; not ``alike``: sensitivities up to 10 : 1, 0.5 g, 23°."""
    signs = rng.choice([-1, 1], 3)
    if alike:
        k, angles, bias = 1 + rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.02, 0.02, 3), rng.uniform(-0.1, 0.1, 3)
    else:
        k, angles, bias = 10 ** rng.uniform(-0.5, 0.5, 3), rng.uniform(-0.4, 0.4, 3), rng.uniform(-0.5, 0.5, 3)
    return Sensor(2.4 * signs * k, angles, bias), tuple(int(s) for s in signs)


def deficient(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Directions that do not suffice, or may not."""
    ball, axis = unit(rng.standard_normal((4000, 3))), unit(rng.standard_normal(3))
    cube = np.array([v for _, v in cube_directions()])
    many = int(rng.integers(9, 27))
    flat = unit(ball - np.outer(ball @ axis, axis))[:many]
    match kind:
        case "few":
            return ball[: rng.integers(0, 9)]
        case "few of the cube":
            return cube[rng.permutation(26)[: rng.integers(0, 9)]]
        case "cap":
            return ball[ball @ axis > np.cos(np.radians(rng.uniform(10, 60)))][:many]
        case "plane":
            return unit(flat + np.radians(rng.choice([0.0, 0.5, 2.0])) * rng.standard_normal(flat.shape))
        case "cone":
            height = rng.uniform(-0.8, 0.8)
            return unit(height * axis + np.sqrt(1 - height**2) * flat)
        case "clusters":
            spots = np.repeat(ball[: rng.integers(1, 8)], 4, axis=0)
            return unit(spots + 0.02 * rng.standard_normal(spots.shape))
        case "nine of fourteen":
            return cube[rng.permutation(14)[:9]]
        case _:
            return unit(np.tile(FACES, (3, 1)) + np.radians(rng.choice([0.0, 1.0])) * rng.standard_normal((18, 3)))


KINDS = ["few", "few of the cube", "cap", "plane", "cone", "clusters", "nine of fourteen", "faces"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("alike", [True, False], ids=["triads alike", "triads of any kind"])
def test_the_poses_wanted_mend_a_deficient_set_in_one_round(kind: str, alike: bool) -> None:
    """Whatever the unit's scale and bias, poses taken 2° off, noise up to 3e-4 g."""
    rng = np.random.default_rng(KINDS.index(kind))
    where = dict(cube_directions())
    refused = 0
    for _ in range(25 if kind == "nine of fourteen" else 16):
        sensor, signs = a_triad(rng, alike)
        there, error = deficient(kind, rng), 10 ** rng.uniform(-6, -3.5)
        wanted = wanted_by(noisy_poses(sensor, there, error, rng), signs)
        if wanted is not None:
            refused += 1
            assert 0 < len(wanted) <= 9
            more = np.array([where[label] for label in wanted])
            more = unit(more + np.radians(2) * rng.standard_normal(more.shape))
            linearise_all = np.concatenate([there, more])
            assert dilution(linearise_all) < 5, (kind, wanted)
            assert wanted_by(noisy_poses(sensor, linearise_all, error, rng), signs) is None
    assert refused > 5


def wanted_by(poses: list[Pose], signs: tuple[int, ...]) -> tuple[str, ...] | None:
    """What a refusal wants; None where there is none."""
    try:
        start(problem_of(poses, signs=signs), poses, signs)
    except Refused as e:
        return e.wanted
    return None


def test_the_nine_pose_subsets_that_are_singular_are_mended_by_few_poses(paper_unit: Sensor) -> None:
    rng = np.random.default_rng(0)
    cube = np.array([v for _, v in cube_directions()[:14]])
    where = dict(cube_directions())
    seen = 0
    for subset in rng.permutation(list(itertools.combinations(range(14), 9)))[:120]:
        wanted = wanted_by(noisy_poses(paper_unit, cube[subset], 1e-5, rng), MINUS)
        if wanted is not None:
            seen += 1
            assert 0 < len(wanted) <= 4
            assert dilution(np.concatenate([cube[subset], [where[label] for label in wanted]])) <= 2.0
    assert seen > 15


NEARLY = {
    "a cap of 50 degrees": lambda: cap(50),
    "a cap of 60 degrees": lambda: cap(60),
    "an octant": lambda: np.abs(cap(180)),
    "a plane, wobbling by 5 degrees": lambda: wobbling(5),
    "a plane, wobbling by 10 degrees": lambda: wobbling(10),
    "six faces, off by 1 degree": lambda: unit(
        np.tile(FACES, (3, 1)) + np.radians(1) * np.random.default_rng(1).standard_normal((18, 3))
    ),
}


def wobbling(degrees: float) -> np.ndarray:
    ring = circle(np.array([1.0, 2.0, 3.0]), 0.0)
    return unit(ring + np.radians(degrees) * np.random.default_rng(1).standard_normal(ring.shape))


@pytest.mark.slow
@pytest.mark.parametrize("name", NEARLY)
@pytest.mark.parametrize("noise_g", [1e-6, 3e-4])
def test_a_set_that_is_nearly_singular_is_warned_of_and_its_errors_are_true(
    name: str, noise_g: float, paper_unit: Sensor
) -> None:
    there, rng = NEARLY[name](), np.random.default_rng(4)
    truth = np.concatenate([paper_unit.scale_factor, paper_unit.misalignment, paper_unit.bias])
    squares = []
    for _ in range(25):
        found = fit(noisy_poses(paper_unit, there, noise_g, rng), signs=MINUS, excluded=())
        assert any(isinstance(c, PoorSpread) and c.wanted for c in found.cautions)
        missed = (found.values - truth) / found.birge_ratio
        covariance = found.covariance / found.birge_ratio**2
        scale = np.sqrt(np.diag(covariance))
        missed, correlation = missed / scale, covariance / np.outer(scale, scale)
        values, vectors = np.linalg.eigh(correlation)
        # The worst combination of the parameters, which is the one that such a set leaves open.
        squares.append((vectors[:, -1] @ missed) ** 2 / values[-1])
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], 25)
    assert low < np.sum(squares) < high


def test_poses_that_noise_could_carry_anywhere_are_refused(paper_unit: Sensor) -> None:
    rng = np.random.default_rng(0)
    for _ in range(8):
        with pytest.raises(Refused, match="differ by little more than their noise") as refusal:
            fit(noisy_poses(paper_unit, cap(60), 3e-3, rng), signs=MINUS)
        assert refusal.value.wanted


def test_the_message_counts_what_there_is(paper_unit: Sensor) -> None:
    with pytest.raises(Refused, match=r"18 poses in 6 distinct directions"):
        fit(measured(paper_unit, POOR["six faces, three times each"]), signs=MINUS)
    with pytest.raises(Refused, match=r"^8 still poses; nine parameters need at least 9"):
        fit(measured(paper_unit, POOR["eight poses"]), signs=MINUS)


def test_no_pose_at_all_is_refused() -> None:
    with pytest.raises(Refused, match="0 still poses") as refusal:
        fit([])
    assert len(refusal.value.wanted) == 9


@pytest.mark.slow
def test_the_singular_nine_pose_subsets_of_the_fourteen_and_only_they_are_refused(
    paper_unit: Sensor, fourteen: np.ndarray
) -> None:
    # |a| of nine poses determines a quadric unless its design [x², …, z] loses rank: judged without the fit.
    x, y, z = fourteen.T
    design = np.stack([x * x, y * y, z * z, x * y, y * z, x * z, x, y, z], axis=1)
    subsets = np.array(list(itertools.combinations(range(14), 9)))
    singular = np.linalg.matrix_rank(design[subsets], tol=1e-9) < 9
    assert singular.mean() == pytest.approx(0.27, abs=0.005)
    poses = measured(paper_unit, fourteen)

    def refused(subset: np.ndarray) -> bool:
        try:
            fit([poses[i] for i in subset], signs=MINUS)
        except Refused:
            return True
        return False

    assert all(refused(subset) for subset in subsets[singular])
    assert not any(refused(subset) for subset in np.random.default_rng(0).permutation(subsets[~singular])[:150])


@pytest.mark.slow
def test_any_eleven_of_the_fourteen_are_enough(paper_unit: Sensor, fourteen: np.ndarray) -> None:
    poses = measured(paper_unit, fourteen)
    for subset in itertools.combinations(range(14), 11):
        assert fit([poses[i] for i in subset], signs=MINUS).dilution < 5


def still(u: np.ndarray) -> list[Pose]:
    return [Pose(float(i), i + 1.0, 100, v, np.eye(3) * 1e-10, 99.0) for i, v in enumerate(u)]


def test_an_axis_that_never_changes_is_named(fourteen: np.ndarray) -> None:
    with pytest.raises(Refused, match="axis z never changes"):
        fit(still(fourteen * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.7]))


@pytest.mark.parametrize("seed", range(20))
def test_readings_of_no_still_triad_are_never_passed_off_as_well_calibrated(seed: int) -> None:
    rng = np.random.default_rng(seed)
    u = rng.standard_normal((20, 3)) if seed % 2 else rng.uniform(-1, 1, (20, 3))
    try:
        found = fit(still(u))
    except Refused:
        return
    # Where an ellipsoid of sorts exists, the residual says what it is worth.
    assert found.residual.rms_g > 0.05
    assert found.residual.lack_of_fit_p is not None
    assert found.residual.lack_of_fit_p < 1e-6
    assert found.excess_g > 0.05


def test_a_poorly_spread_set_that_just_passes_is_warned_of_and_told_what_to_add(paper_unit: Sensor) -> None:
    found = fit(measured(paper_unit, cap(60)), signs=MINUS)
    caution = next(c for c in found.cautions if isinstance(c, PoorSpread))
    where = dict(cube_directions())
    more = np.array([where[label] for label in caution.wanted])
    better = fit(measured(paper_unit, np.concatenate([cap(60), more])), signs=MINUS)
    assert better.dilution < found.dilution / 5
    assert not any(isinstance(c, PoorSpread) for c in better.cautions)


def test_nine_poses_that_carry_nine_parameters_say_that_the_residual_proves_nothing(
    paper_unit: Sensor, fourteen: np.ndarray
) -> None:
    poses = measured(paper_unit, fourteen)
    found = fit([poses[i] for i in (0, 1, 2, 3, 4, 6, 7, 8, 10)], signs=MINUS)
    assert found.residual.rms_g < 1e-10
    assert found.residual.lack_of_fit_p is None
    assert found.residual.cross_validated_rms_g is None
    assert FewPoses(9, 9) in found.cautions
