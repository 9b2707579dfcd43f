"""The frame of the mounting faces: truth recovered, the bound reached, and what cannot be told said."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from triaxcal.errors import InvalidData, Refused
from triaxcal.estimate.calibration import Calibration
from triaxcal.estimate.pose_fit import fit
from triaxcal.frames.faces import AXES, LABELS, AxesAssumed, axis_of, labelled, nearest_rotation, recognise
from triaxcal.frames.orientations import Assumed, NotTurned, verticals, verticals_under
from triaxcal.frames.standing import OrientationsAlike, SingleOrientation, Standing, stand
from triaxcal.frames.unit_frames import Datum, FacesMissing, Frames, SyntheticFixture, UnitsDisagree, frames
from triaxcal.model.directions import directions
from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose
from triaxcal.synthetic import noisy_poses

Plan = Sequence[tuple[str, float]]
MINUS = (-1, -1, -1)
NO_FACE = [v for label, v in directions(26) if len(label) > 2]
TILT = 1e-3


def in_pairs(rng: np.random.Generator, labels: Sequence[str] = LABELS) -> list[tuple[str, float]]:
    """Each face at a heading of its own, then half a turn on."""
    return [(label, h + turn) for label in labels for h in [float(rng.uniform(0, 6))] for turn in (0.0, np.pi)]


@dataclass
class Bench:
    """A unit that stood on a fixture: truth and poses. ``mount`` (3,3) takes the sensor's frame to the body's."""

    sensor: Sensor
    fixture: SyntheticFixture
    mount: np.ndarray
    plan: Plan
    poses: list[Pose]

    @classmethod
    def of(
        cls,
        sensor: Sensor,
        seed: int,
        *,
        sigma: float | np.ndarray = 1e-5,
        mount: np.ndarray | None = None,
        plan: Plan | None = None,
        fixture: SyntheticFixture | None = None,
        face_error: float = 1e-3,
        tilt: float = TILT,
        seating: float = 0.0,
    ) -> Bench:
        rng = np.random.default_rng(seed)
        fixture = fixture or SyntheticFixture.drawn(rng, face_error, tilt)
        mount = Rotation.from_rotvec(rng.normal(0, 0.05, 3)).as_matrix() if mount is None else mount
        plan = in_pairs(rng) if plan is None else plan
        up = fixture.ups(plan) + rng.normal(0, seating, (len(plan), 3))
        up = np.concatenate([up / np.linalg.norm(up, axis=1, keepdims=True), NO_FACE])
        return cls(sensor, fixture, mount, plan, noisy_poses(sensor, up @ mount, sigma, rng))

    def calibrated(self) -> Calibration:
        return fit(self.poses, signs=tuple(np.sign(self.sensor.scale_factor)), excluded=())

    def stood(self, labels: Sequence[str | None] | None = None, **known: float) -> Standing:
        found = verticals(self.calibrated())
        if labels is None:
            labelling = recognise(found.direction, found.used)
        else:
            labelling = labelled(found.direction, found.used, labels)
        return stand(found, labelling, Assumed(**known))

    def truth(self, faces: Sequence[str] = LABELS) -> tuple[np.ndarray, np.ndarray]:
        """Rotation of the unit and inward normals, in the least-squares frame of the faces."""
        inward = np.array([self.fixture.inward[label] for label in faces])
        datum, _ = Rotation.align_vectors(np.array([axis_of(x) for x in faces]), inward)
        return datum.as_matrix() @ self.mount, datum.apply(inward)

    def miss(self, found: Frames, unit: int = 0, faces: Sequence[str] = LABELS) -> np.ndarray:
        """(3,) small rotation about the body's axes from the one found to the truth."""
        rotation = self.truth(faces)[0] @ found.units[unit].rotation.T
        return np.asarray(Rotation.from_matrix(rotation).as_rotvec())


def bound(bench: Bench, sigma: np.ndarray) -> np.ndarray:
    """Cramér–Rao bound (3,3) of the rotation in the least-squares frame, by numerical differentiation of everything.

    Unknown are the sensor (9), its rotation (3), the normals of the faces (12, of which the datum takes 3), the tilt on
    each face (12) and the attitude of every other pose.
    """
    rotation, inward = bench.truth()
    faces = [label for label, _ in bench.plan]
    up = bench.fixture.ups(bench.plan) @ (rotation @ bench.mount.T).T
    others = np.array(NO_FACE) @ (rotation @ bench.mount.T).T
    s = bench.sensor

    def across(v: np.ndarray) -> np.ndarray:
        return np.linalg.svd(v[None])[2][1:]

    def output(x: np.ndarray) -> np.ndarray:
        sensor = Sensor(s.scale_factor * (1 + x[0:3]), s.misalignment + x[3:6], s.bias + x[6:9])
        turned = Rotation.from_rotvec(x[9:12]).as_matrix() @ rotation
        a = []
        for i, label in enumerate(faces):
            k = LABELS.index(label)
            m = inward[k] + x[12 + 2 * k : 14 + 2 * k] @ across(inward[k])
            half = np.cos(bench.plan[i][1] - next(h for f, h in bench.plan if f == label))
            tilt = half * (x[24 + 2 * k : 26 + 2 * k] @ across(inward[k]))
            v = m / np.linalg.norm(m) + (up[i] - inward[k]) + tilt
            a.append(v / np.linalg.norm(v))
        for i, v in enumerate(others):
            w = v + x[36 + 2 * i : 38 + 2 * i] @ across(v)
            a.append(w / np.linalg.norm(w))
        return (sensor.output(np.array(a) @ turned, {}) / s.scale_factor).ravel()

    n = 36 + 2 * len(others)
    h = 1e-6
    J = np.stack([(output(h * e) - output(-h * e)) / (2 * h) for e in np.eye(n)], axis=1)
    information = J.T @ (J / sigma.ravel()[:, None] ** 2)
    G = np.zeros((3, n))
    for k in range(6):
        G[:, 12 + 2 * k : 14 + 2 * k] = np.cross(AXES[k], across(inward[k])).T
    scale = np.trace(information) / n
    whole = np.linalg.inv(np.block([[information / scale, G.T], [G, np.zeros((3, 3))]]))
    return np.asarray(whole[9:12, 9:12] / scale)


@pytest.mark.parametrize("noise", ["equal", "by axis", "by pose"])
@pytest.mark.parametrize("turned", [0.05, 0.5])
def test_the_covariance_is_the_cramer_rao_bound_of_the_whole_model(
    paper_unit: Sensor, noise: str, turned: float
) -> None:
    sigma = np.full((12 + len(NO_FACE), 3), 1e-5)
    if noise == "by axis":
        sigma *= [1.0, 10.0, 0.5]
    if noise == "by pose":
        sigma *= np.random.default_rng(5).uniform(0.5, 2.0, (len(sigma), 1))
    mount = Rotation.from_rotvec(turned * np.array([1.0, -0.7, 0.5])).as_matrix()
    bench = Bench.of(paper_unit, 3, sigma=sigma, mount=mount)
    c = bench.calibrated()
    found = verticals(replace(c, birge_ratio=1.0, covariance=c.covariance / c.birge_ratio**2))
    labelling = labelled(found.direction, found.used, [label for label, _ in bench.plan] + [None] * len(NO_FACE))
    (unit,) = frames([stand(found, labelling, Assumed(seating=0.0))]).units
    limit = bound(bench, sigma)
    assert np.diag(unit.covariance) == pytest.approx(np.diag(limit), rel=2e-3)
    assert unit.covariance == pytest.approx(limit, abs=2e-3 * np.trace(limit))


def within(pulls: np.ndarray, doubt: float = 1e-3) -> np.ndarray:
    """Whether mean squares of normal pulls (n,k) lie in the chi-square limits of all k together."""
    n, k = pulls.shape
    low, high = stats.chi2.ppf([doubt / 2 / k, 1 - doubt / 2 / k], n) / n
    square = (pulls**2).mean(axis=0)
    return np.asarray((low < square) & (square < high))


@pytest.mark.slow
def test_pulls_of_rotation_faces_and_tilt_have_the_variance_they_should(paper_unit: Sensor) -> None:
    """The noise of the poses and of seatings being known; errors of faces and table of 1 mrad each."""
    rotation, faces, tilt = [], [], []
    for seed in range(80):
        seating = 3e-5 if seed % 2 else 0.0
        bench = Bench.of(paper_unit, seed, seating=seating)
        c = bench.calibrated()
        found = verticals(replace(c, birge_ratio=1.0, covariance=c.covariance / c.birge_ratio**2))
        result = frames([stand(found, recognise(found.direction, found.used), Assumed(seating=seating))])
        (unit,) = result.units
        rotation.append(np.linalg.solve(np.linalg.cholesky(unit.covariance), bench.miss(result)))
        miss = (result.fixture.up - bench.truth()[1]) / np.maximum(result.fixture.standard_error, 1e-12)
        faces.append(miss[AXES == 0])
        tilt.append([(t.magnitude - TILT) / t.standard_error for t in unit.standing.tilts])
    for pulls in (rotation, faces, tilt):
        assert within(np.array(pulls)).all(), (np.array(pulls) ** 2).mean(axis=0)


def test_without_noise_the_truth_comes_out_to_rounding_however_large_the_errors(paper_unit: Sensor) -> None:
    """Half a turn cancels the tilt exactly, and no angle is taken for small."""
    mount = Rotation.from_rotvec([0.05, -0.05, 0.05]).as_matrix()
    for face_error, tilt in ((1e-3, 1e-3), (8e-3, 2e-2)):
        bench = Bench.of(paper_unit, 1, sigma=1e-12, mount=mount, face_error=face_error, tilt=tilt)
        standing = bench.stood(seating=0.0)
        result = frames([standing])
        assert np.abs(bench.miss(result)).max() < 1e-10
        assert result.fixture.up == pytest.approx(bench.truth()[1], abs=1e-10)
        assert standing.table.tilt == pytest.approx(np.sin(tilt), abs=1e-10)


def test_a_half_turn_that_is_off_leaves_half_its_error_times_the_tilt(paper_unit: Sensor) -> None:
    rng = np.random.default_rng(2)
    off = 2e-3
    plan = [(label, h + (off if i % 2 else 0.0)) for i, (label, h) in enumerate(in_pairs(rng))]
    bench = Bench.of(paper_unit, 4, sigma=1e-12, plan=plan)
    left = np.abs(bench.miss(frames([bench.stood(seating=0.0)])))
    assert left.max() < 1e-6
    assert left.max() < TILT * off / 2 * np.sqrt(2)
    told = bench.stood(seating=0.0, turn=off)
    found = frames([told])
    assert np.all(left < 3 * found.units[0].standard_error)
    assert told.covariance.trace() == pytest.approx(6 * (np.sin(TILT) * off / 2) ** 2, rel=1e-2)


def test_the_least_squares_rotation_is_that_of_scipy(paper_unit: Sensor) -> None:
    bench = Bench.of(paper_unit, 8, sigma=1e-4, face_error=1e-2)
    standing = bench.stood(seating=0.0)
    outside, _ = Rotation.align_vectors([axis_of(x) for x in standing.faces], standing.up)
    (unit,) = frames([standing]).units
    assert unit.rotation == pytest.approx(outside.as_matrix(), abs=1e-12)
    assert nearest_rotation(standing.up, AXES) == pytest.approx(outside.as_matrix(), abs=1e-12)


def test_the_primary_face_of_a_datum_is_true_and_the_secondary_in_one_direction(paper_unit: Sensor) -> None:
    bench = Bench.of(paper_unit, 9, sigma=1e-9)
    standing = bench.stood(seating=0.0)
    free = frames([standing])
    for primary, secondary in (("-Z", "-X"), ("+X", "-Y"), ("-Y", "+Z")):
        held = frames([standing], datum=Datum((primary, secondary)))
        error = dict(zip(held.fixture.faces, held.fixture.error, strict=True))
        sure = dict(zip(held.fixture.faces, held.fixture.standard_error, strict=True))
        first, second = (LABELS[LABELS.index(f) ^ 1] for f in (primary, secondary))
        third = int(np.flatnonzero(axis_of(first) + axis_of(second) == 0)[0])
        assert np.abs(error[first]).max() < 1e-14
        assert sure[first].max() < 1e-14
        assert abs(error[second][third]) < 1e-14
        m = dict(zip(standing.faces, standing.up @ held.units[0].rotation.T, strict=True))
        assert m[first] == pytest.approx(axis_of(first), abs=1e-12)
        assert m[second] @ axis_of(second) > 0.99
        for name, q in free.fixture.squareness.items():
            assert held.fixture.squareness[name].value == pytest.approx(q.value, abs=2e-5)
            assert held.fixture.squareness[name].standard_error == pytest.approx(q.standard_error, rel=0.02)


def test_squareness_and_parallelism_are_those_of_the_fixture(paper_unit: Sensor) -> None:
    bench = Bench.of(paper_unit, 10, sigma=1e-9)
    fixture = frames([bench.stood(seating=0.0)]).fixture
    n = bench.fixture.inward
    mean = {a: (n["+" + a] - n["-" + a]) / np.linalg.norm(n["+" + a] - n["-" + a]) for a in "XYZ"}
    for a, b in ("XY", "YZ", "ZX"):
        assert fixture.squareness[a + b].value == pytest.approx(mean[a] @ mean[b], abs=5e-6)
    for axis in "XYZ":
        wedge = np.linalg.norm(n["+" + axis] + n["-" + axis]) / 2
        assert np.hypot(*(q.value for q in fixture.parallelism[axis])) == pytest.approx(wedge, rel=5e-3)


@pytest.mark.slow
def test_seatings_that_differ_are_found_and_the_intervals_still_cover(paper_unit: Sensor) -> None:
    """By Student's t, since their size is known from five degrees of freedom."""
    seeds, inside, sizes = 50, 0, []
    for seed in range(seeds):
        bench = Bench.of(paper_unit, seed, seating=1e-4)
        result = frames([bench.stood()])
        (unit,) = result.units
        sizes.append(unit.standing.seating**2)
        inside += int(np.sum(np.abs(bench.miss(result)) < unit.coverage_factor() * unit.standard_error))
    # Three angles of one run share an estimate of the seating; at worst they are covered or not together.
    assert inside >= 3 * stats.binom.ppf(1e-3, seeds, 0.95)
    assert np.sqrt(np.mean(sizes)) == pytest.approx(1e-4, rel=4.5 / np.sqrt(2 * 5 * seeds) + 0.02)


@pytest.mark.slow
def test_several_units_come_into_one_frame_and_share_the_fixture(paper_unit: Sensor) -> None:
    other = Sensor(paper_unit.scale_factor * 2e5, -paper_unit.misalignment, -paper_unit.bias)
    quarter = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    pulls, chi2, agree = [], [], []
    for seed in range(24):
        first = Bench.of(paper_unit, seed)
        rng = np.random.default_rng(1000 + seed)
        order = [LABELS[i] for i in rng.permutation(6)]
        second = Bench.of(
            other,
            2000 + seed,
            fixture=first.fixture,
            plan=in_pairs(rng, order),
            mount=quarter @ first.mount,
            sigma=2e-5,
        )
        labels = [label for label, _ in second.plan] + [None] * len(NO_FACE)
        result = frames([first.stood(seating=0.0), second.stood(labels, seating=0.0)])
        chi2.append(result.chi2)
        assert result.left == 9
        agree.append(result.agree)
        between, covariance = result.between(0, 1)
        truth = second.mount.T @ first.mount
        miss = Rotation.from_matrix(truth.T @ Rotation.from_rotvec(between).as_matrix()).as_rotvec()
        miss = result.units[0].rotation @ miss  # about the body's axes
        pulls.append(np.linalg.solve(np.linalg.cholesky(covariance), miss))
        alone = frames([first.stood(seating=0.0)])
        assert np.trace(np.atleast_2d(result.fixture.covariance)) < 0.9 * np.trace(alone.fixture.covariance)
    # Standard errors that the fits raised for residuals a little large make pulls smaller, never larger.
    assert np.mean(np.square(pulls)) < stats.chi2.ppf(0.999, 3 * len(pulls)) / (3 * len(pulls))
    assert np.mean(np.square(pulls)) > 0.8 * stats.chi2.ppf(1e-3, 3 * len(pulls)) / (3 * len(pulls))
    assert agree.count(False) <= stats.binom.isf(0.001, len(agree), 0.01)
    assert np.sum(chi2) < stats.chi2.ppf(0.999, 9 * len(chi2))
    assert np.sum(chi2) > 0.8 * stats.chi2.ppf(1e-3, 9 * len(chi2))


def test_units_on_different_fixtures_are_told_by_their_faces(paper_unit: Sensor) -> None:
    result = frames([Bench.of(paper_unit, seed).stood() for seed in (1, 2)])
    assert result.lack_of_fit_p is not None
    assert result.lack_of_fit_p < 1e-10
    assert isinstance(result.cautions[-1], UnitsDisagree)
    assert result.agree is False
    assert result.units[0].standard_error.min() > 1e-4


def test_units_without_a_face_in_common_have_no_common_frame(paper_unit: Sensor) -> None:
    rng = np.random.default_rng(0)
    one = Bench.of(paper_unit, 1, plan=in_pairs(rng, ["+X", "+Y"]))
    two = Bench.of(paper_unit, 1, plan=in_pairs(rng, ["-X", "-Y", "-Z"]))
    with pytest.raises(Refused, match="do not connect") as refused:
        frames([one.stood(), two.stood()])
    assert set(refused.value.wanted) >= {"+X", "-X"}
    three = Bench.of(paper_unit, 1, plan=in_pairs(rng, ["+X", "+Y", "-X", "-Z"]))
    assert len(frames([one.stood(), two.stood(), three.stood()]).fixture.faces) == 5


@pytest.mark.parametrize("faces", [["+X", "+Y"], ["+X", "+Y", "+Z"], ["-X", "+Y", "-Y", "+Z", "-Z"]])
def test_fewer_faces_give_a_frame_of_those(paper_unit: Sensor, faces: list[str]) -> None:
    order = tuple(label for label in LABELS if label in faces)
    for seed in range(3):
        bench = Bench.of(paper_unit, seed, plan=in_pairs(np.random.default_rng(seed), faces))
        result = frames([bench.stood()])
        assert result.fixture.faces == order
        assert np.all(np.abs(bench.miss(result, faces=order)) < 5 * result.units[0].standard_error)
        assert np.all(result.units[0].standard_error < 4e-5)
        assert FacesMissing(tuple(label for label in LABELS if label not in faces)) in result.cautions


@pytest.mark.slow
@pytest.mark.parametrize("datum", [None, ("-Z", "-X"), ("+Y", "-Z")])
def test_what_the_datum_leaves_open_is_said(paper_unit: Sensor, datum: tuple[str, str] | None) -> None:
    """How far the frame lies from the one that a fixture with such faces was made to: farther if two faces define it
    than if all do."""
    pulls = []
    for seed in range(40):
        bench = Bench.of(paper_unit, seed)
        result = frames([bench.stood()], datum=Datum(datum))
        assert result.fixture.offset is not None
        wanted = Rotation.from_matrix(bench.mount @ result.units[0].rotation.T).as_rotvec()
        pulls.append(wanted / result.fixture.offset)
    t = stats.t(9)
    assert np.mean(np.square(pulls)) == pytest.approx(t.var(), rel=4.5 * np.sqrt(2.9 / (3 * len(pulls))))


@pytest.mark.parametrize("faces", [[], ["+X"], ["+X", "-X"]])
def test_too_few_faces_are_refused_and_the_missing_ones_named(paper_unit: Sensor, faces: list[str]) -> None:
    bench = Bench.of(paper_unit, 0, plan=in_pairs(np.random.default_rng(0), [*faces, "+Y", "+Z"]))
    keep = len(faces) * 2
    labels = [label if i < keep else None for i, (label, _) in enumerate(bench.plan)] + [None] * len(NO_FACE)
    with pytest.raises(Refused, match="at least two faces at right angles") as refused:
        bench.stood(labels)
    assert {"+Y", "-Y", "+Z", "-Z"} <= set(refused.value.wanted)


@pytest.mark.slow
def test_a_face_that_stood_one_way_gets_the_tilt_of_the_others_as_uncertainty(paper_unit: Sensor) -> None:
    pulls = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        plan = in_pairs(rng)
        bench = Bench.of(paper_unit, seed, plan=plan[:8] + plan[9:])
        standing = bench.stood(seating=0.0)
        result = frames([standing])
        assert [t.label for t in standing.tilts if not t.resolved] == ["+Z"]
        assert isinstance(standing.cautions[0], SingleOrientation)
        assert standing.cautions[0].faces == ("+Z",)
        (unit,) = result.units
        pulls.append(bench.miss(result) / unit.standard_error)
        # A quarter of the tilt's component, doubled in variance because headings may go together.
        assert unit.standard_error[:2] == pytest.approx(TILT / 4, rel=0.05)
        assert unit.standard_error[2] < 2e-5
    assert np.all(np.mean(np.square(pulls), axis=0)[:2] == pytest.approx(0.5, abs=0.3))


def test_without_second_orientations_the_tilt_has_to_be_given(paper_unit: Sensor) -> None:
    plan = [(label, 0.3) for label in LABELS]
    bench = Bench.of(paper_unit, 1, plan=plan)
    with pytest.raises(Refused, match="no face of 6 stood in two orientations") as refused:
        bench.stood()
    assert refused.value.wanted == LABELS
    standing = bench.stood(tilt=TILT)
    (unit,) = frames([standing]).units
    assert standing.table.source == "given"
    assert np.all(np.abs(bench.miss(frames([standing]))) < TILT * 1.1)
    assert unit.standard_error == pytest.approx(np.full(3, TILT / np.sqrt(2)), rel=0.15)


def test_a_pose_repeated_without_a_turn_is_no_second_orientation(paper_unit: Sensor) -> None:
    """The first pose again at the end, all faces one way: the one pair says nothing on the tilt."""
    plan = [*((label, 0.3) for label in LABELS), ("+X", 0.3)]
    bench = Bench.of(paper_unit, 1, plan=plan)
    with pytest.raises(Refused, match="--table-tilt"):
        bench.stood()
    assert not any(t.resolved for t in bench.stood(tilt=TILT).tilts)


@pytest.mark.parametrize("turn", [0.0, np.pi / 2])
def test_a_face_that_was_not_turned_by_half_a_turn_is_noticed(paper_unit: Sensor, turn: float) -> None:
    plan = in_pairs(np.random.default_rng(3))
    plan[5] = (plan[4][0], plan[4][1] + turn)
    bench = Bench.of(paper_unit, 3, plan=plan)
    standing = bench.stood(seating=0.0)
    assert [t.label for t in standing.tilts if not t.resolved] == [plan[4][0]]
    assert isinstance(standing.cautions[0], NotTurned)
    assert standing.cautions[0].face == plan[4][0]
    result = frames([standing])
    assert np.all(np.abs(bench.miss(result)) < 4 * result.units[0].standard_error)


def test_more_poses_on_a_face_in_any_order_are_split_into_the_two_orientations(paper_unit: Sensor) -> None:
    rng = np.random.default_rng(4)
    plan = in_pairs(rng)
    plan = [plan[i] for i in rng.permutation([*range(12), 0, 0, 3, 6, 7, 7])]
    for seed in range(5):
        bench = Bench.of(paper_unit, seed, plan=plan)
        result = frames([bench.stood(seating=0.0)])
        assert result.units[0].standing.table.tilt == pytest.approx(TILT, abs=3e-5)
        assert np.all(np.abs(bench.miss(result)) < 4.5 * result.units[0].standard_error)


@pytest.mark.parametrize("quarters", [(0, 1, 2, 3), (2, 0, 3), (3, 3, 1, 2, 0, 1)])
def test_orientations_a_quarter_turn_apart_cancel_the_tilt_as_well(
    paper_unit: Sensor, quarters: tuple[int, ...]
) -> None:
    plan = [(label, 0.2 + k * np.pi / 2) for label in LABELS for k in quarters]
    bench = Bench.of(paper_unit, 2, plan=plan)
    standing = bench.stood(seating=0.0)
    assert standing.table.tilt == pytest.approx(TILT, abs=3e-5)
    (unit,) = frames([standing]).units
    assert np.all(np.abs(bench.miss(frames([standing]))) < 4.5 * unit.standard_error)
    assert np.all(unit.standard_error < 1e-5)


@pytest.mark.slow
def test_headings_that_are_known_resolve_faces_that_stood_one_way(paper_unit: Sensor) -> None:
    rng = np.random.default_rng(6)
    plan = in_pairs(rng)
    plan = [*plan[:2], *plan[2::2]]
    pulls = []
    for seed in range(40):
        bench = Bench.of(paper_unit, seed, plan=plan)
        found = verticals(bench.calibrated())
        none = [None] * len(NO_FACE)
        labelling = labelled(
            found.direction, found.used, [x for x, _ in plan] + none, [h % 6.283185307179586 for _, h in plan] + none
        )
        standing = stand(found, labelling, Assumed(seating=0.0))
        assert all(t.resolved for t in standing.tilts)
        # Up as the table's axes have it: away from where its normal leans to.
        assert standing.table.vector == pytest.approx(-bench.fixture.table[:2], abs=1e-4)
        result = frames([standing])
        pulls.append(bench.miss(result) / result.units[0].standard_error)
        assert np.all(result.units[0].standard_error < 3e-5)
    assert np.mean(np.square(pulls)) < stats.chi2.ppf(0.999, 40) / 40


def test_a_level_table_and_a_fixture_that_was_not_turned_look_the_same(paper_unit: Sensor) -> None:
    level = Bench.of(paper_unit, 1, tilt=0.0).stood()
    still = Bench.of(paper_unit, 1, plan=[(label, 0.3) for label in LABELS for _ in range(2)]).stood()
    for standing in (level, still):
        assert not standing.table.shows
        assert OrientationsAlike() in standing.cautions


@pytest.mark.parametrize("signs", [(1, 1, 1), (-1, 1, 1), (1, -1, -1)])
def test_signs_of_any_kind_and_counts_as_outputs(signs: tuple[int, int, int]) -> None:
    sensor = Sensor(np.array([8.2e5, 7.9e5, 8.4e5]) * signs, np.array([0.02, -0.03, 0.01]), np.array([0.3, -0.2, 0.1]))
    bench = Bench.of(sensor, 5)
    result = frames([bench.stood()])
    assert np.all(np.abs(bench.miss(result)) < 4.5 * result.units[0].standard_error)


@pytest.mark.parametrize("angle", [0.0, np.pi / 2, np.pi, 2.2])
def test_labels_find_any_mounting(paper_unit: Sensor, angle: float) -> None:
    mount = Rotation.from_rotvec(angle * np.array([2, -1, 2]) / 3).as_matrix()
    bench = Bench.of(paper_unit, 5, mount=mount)
    for labels in (
        [label for label, _ in bench.plan] + [None] * len(NO_FACE),
        [label for label, _ in bench.plan],
        [label for label, _ in bench.plan[::2]],
    ):
        if len(labels) < len(bench.poses) and angle == 2.2:
            continue  # without labels for all, the faces have to be recognised first
        result = frames([bench.stood(labels)])
        assert not result.units[0].standing.labelling.assumed
        assert np.all(np.abs(bench.miss(result)) < 4.5 * result.units[0].standard_error)


def test_without_labels_the_nearest_axes_are_taken_and_it_is_said(paper_unit: Sensor) -> None:
    quarter = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    for mount in (np.eye(3), Rotation.from_rotvec([0.1, -0.2, 0.3]).as_matrix()):
        bench = Bench.of(paper_unit, 6, mount=quarter @ mount)
        standing = bench.stood()
        assert standing.labelling.assumed
        assert standing.labelling.cautions == (AxesAssumed(),)
        assert standing.labelling.mounting == pytest.approx(mount, abs=5e-3)
        assert standing.labelling.labels[12:] == (None,) * len(NO_FACE)


def test_labels_that_contradict_the_readings_are_named(paper_unit: Sensor) -> None:
    bench = Bench.of(paper_unit, 7)
    right: list[str | None] = [label for label, _ in bench.plan] + [None] * len(NO_FACE)
    with pytest.raises(InvalidData, match=r"pose 4 is labelled \+Y and is \d\d° from it"):
        bench.stood([*right[:3], "+Y", *right[4:]])
    mirror = {"+X": "-X", "-X": "+X"}
    with pytest.raises(InvalidData, match="mirror image"):
        bench.stood([mirror.get(label or "", label) for label in right])
    with pytest.raises(InvalidData, match="7 labels for 32 poses, of which 12 stand on 6 faces"):
        bench.stood(right[:7])


@pytest.mark.slow
def test_a_calibration_of_another_recording_adds_its_uncertainty(paper_unit: Sensor) -> None:
    pulls = []
    for seed in range(40):
        c = Bench.of(paper_unit, 500 + seed, sigma=3e-5).calibrated()
        bench = Bench.of(paper_unit, seed, plan=in_pairs(np.random.default_rng(seed)))
        found = verticals_under(
            c.sensor, bench.poses[:12], c.covariance / c.birge_ratio**2, channel_reference=c.channel_reference
        )
        result = frames([stand(found, recognise(found.direction, found.used), Assumed(seating=0.0))])
        (unit,) = result.units
        pulls.append(np.linalg.solve(np.linalg.cholesky(unit.covariance), bench.miss(result)))
        assert np.all(unit.standard_error > 1e-5)
    assert within(np.array(pulls)).all()


def test_a_spoiled_pose_does_not_count(paper_unit: Sensor) -> None:
    bench = Bench.of(paper_unit, 11)
    knocked = list(bench.poses)
    knocked[2] = replace(knocked[2], mean=knocked[2].mean * (1 + 2e-3))
    found = verticals(fit(knocked, signs=MINUS))
    assert list(np.flatnonzero(~found.used)) == [2]
    standing = stand(found, recognise(found.direction, found.used))
    assert [t.label for t in standing.tilts if not t.resolved] == ["-X"]
    result = frames([standing])
    assert np.all(np.abs(bench.miss(result)) < 4.5 * result.units[0].standard_error)


@pytest.mark.parametrize("faces", [("-Z", "+Z"), ("-Z", "Q"), ("-Z", "-Z")])
def test_a_datum_is_two_faces_at_right_angles(faces: tuple[str, str]) -> None:
    with pytest.raises(InvalidData, match="two faces at right angles"):
        Datum(faces)


def test_a_datum_on_a_face_that_nobody_stood_on_is_refused(paper_unit: Sensor) -> None:
    bench = Bench.of(paper_unit, 1, plan=in_pairs(np.random.default_rng(1), ["+X", "+Y", "-Z"]))
    with pytest.raises(Refused, match="no unit stood on the face -Z") as refused:
        frames([bench.stood()], datum=Datum(("-Z", "-X")))
    assert refused.value.wanted == ("+Z",)


def test_the_page_on_frames_can_be_redone_by_hand() -> None:
    page = Path(__file__).parents[3] / "docs/explanation/frames.md"
    (block,) = re.findall(r"^```python\n(.*?)^```$", page.read_text("utf-8"), re.MULTILINE | re.DOTALL)
    exec(block, {})


def test_a_unit_that_stood_nowhere_near_a_cube_is_refused() -> None:
    up = np.array([[0, 0, 1.0], [0, 0.6, 0.8], [0.5, 0.0, np.sqrt(0.75)]])
    with pytest.raises(Refused, match="no two poses at right angles") as refused:
        recognise(up, np.ones(3, dtype=bool))
    assert refused.value.wanted == LABELS
