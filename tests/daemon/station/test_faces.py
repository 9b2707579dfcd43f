"""A fixture's faces: 24 ways to sit on it, and every direction told so that a person finds it."""

from __future__ import annotations

import itertools
import re

import numpy as np
import pytest

from triaxcal.model.directions import cube_directions, directions, elsewhere
from triaxcald.mounting import rotation
from triaxcald.station.faces import OWN_NAMES, described, face_up, turned

SIGNED = [sign + axis for axis in "xyz" for sign in "+-"]
VECTORS = {axis: np.array([(1 if axis[0] == "+" else -1) * (axis[1] == a) for a in "xyz"], float) for axis in SIGNED}
PROPER = [
    "".join(axes)
    for axes in itertools.permutations(SIGNED, 3)
    if np.linalg.det(np.array([VECTORS[a] for a in axes])) > 0.5
]
MIRRORED = [
    "".join(axes)
    for axes in itertools.permutations(SIGNED, 3)
    if np.linalg.det(np.array([VECTORS[a] for a in axes])) < -0.5
]
NAMES = {"+x": "A", "-x": "B", "+y": "C", "-y": "D", "+z": "E", "-z": "F"}


def test_there_are_as_many_ways_to_sit_on_a_fixture_as_a_cube_has_rotations() -> None:
    assert len(PROPER) == len(MIRRORED) == 24
    assert len({rotation(m).tobytes() for m in PROPER}) == 24


@pytest.mark.parametrize("mounting", PROPER)
def test_a_mounting_turns_the_units_axes_into_the_fixtures(mounting: str) -> None:
    matrix = rotation(mounting)
    assert np.allclose(matrix.T @ matrix, np.eye(3))
    for k in range(3):
        assert np.array_equal(matrix @ np.eye(3)[k], VECTORS[mounting[2 * k : 2 * k + 2]])


@pytest.mark.parametrize("mounting", MIRRORED)
def test_a_mirror_image_is_refused(mounting: str) -> None:
    with pytest.raises(ValueError, match="mirror image"):
        rotation(mounting)


@pytest.mark.parametrize("mounting", ["", "+x+y", "+x+y+z+x", "xyz", "x+y+z", "+x +y +z", "+X+Y+Z", "+a+y+z", "+x+yz+"])
def test_what_is_no_three_axes_is_refused(mounting: str) -> None:
    with pytest.raises(ValueError, match="three axes of the fixture"):
        rotation(mounting)


@pytest.mark.parametrize("mounting", ["+x+x+z", "+x-x+z", "-y+z+y", "+z+z+z"])
def test_an_axis_that_is_given_twice_is_refused(mounting: str) -> None:
    with pytest.raises(ValueError, match=r"the fixture's [xyz] axis is given twice"):
        rotation(mounting)


@pytest.mark.parametrize("mounting", PROPER)
def test_a_label_goes_with_its_direction_into_the_units_axes(mounting: str) -> None:
    into_unit = rotation(mounting).T
    cube = dict(cube_directions())
    for label, v in cube.items():
        own, up = turned((label, v), into_unit)
        assert np.allclose(up, cube[own])
        assert np.allclose(rotation(mounting) @ up, v)
    finer = dict(elsewhere(np.zeros((0, 3)), 98))
    assert sorted(turned(d, into_unit)[0] for d in finer.items()) == sorted(finer)
    assert all(np.allclose(v, finer[own]) for own, v in (turned(d, into_unit) for d in finer.items()))
    assert [turned(d, into_unit)[0] for d in directions(20)] == [label for label, _ in directions(20)]


FACES = {label: f"{NAMES[label.lower()]} up" for label in OWN_NAMES.values()}
TWO_OR_THREE = [
    ("+X+Y", "edge A/C up"), ("-X+Z", "edge B/E up"), ("-Y-Z", "edge D/F up"),
    ("+X+Y+Z", "corner A/C/E up"), ("-X-Y-Z", "corner B/D/F up"), ("+X+Y-Z", "corner A/C/F up"),
]  # fmt: skip


@pytest.mark.parametrize(("label", "told"), [*FACES.items(), *TWO_OR_THREE])
def test_directions_of_the_cube_are_told_by_faces_edges_and_corners(label: str, told: str) -> None:
    assert described(dict(cube_directions())[label], NAMES) == told


def test_the_26_directions_are_told_apart_without_a_number() -> None:
    told = [described(v, NAMES) for _, v in cube_directions()]
    assert len(set(told)) == 26
    assert not any(re.search(r"\d", text) for text in told)
    labels = [label for label, _ in cube_directions()]
    kinds = [{2: FACES.get(label, " ")[0], 4: "edge", 6: "corner"}[len(label)] for label in labels]
    assert [text.split()[0] for text in told] == kinds
    assert [face_up(v, NAMES) for _, v in cube_directions()] == [NAMES.get(label.lower()) for label in labels]


def _understood(told: str) -> np.ndarray:
    """What a person makes of the words, with the names of the axes."""
    found = re.fullmatch(r"(.*) up(?:, tilted (\d+)° towards (.*))?", told)
    assert found, told
    base, other = (_direction(name) if name else None for name in (found[1], found[3]))
    assert base is not None
    if other is None:
        return base
    other = other - (other @ base) * base
    angle = np.radians(float(found[2]))
    return np.asarray(np.cos(angle) * base + np.sin(angle) * other / np.linalg.norm(other))


def _direction(name: str) -> np.ndarray:
    v = np.sum([VECTORS[axis.lower()] for axis in name.split()[-1].split("/")], axis=0)
    return np.asarray(v / np.linalg.norm(v))


@pytest.mark.parametrize("seed", range(5))
def test_whoever_turns_as_told_is_nearer_than_poses_are_apart(seed: int) -> None:
    ups = np.random.default_rng(seed).standard_normal((500, 3))
    for up in ups / np.linalg.norm(ups, axis=1, keepdims=True):
        told = described(up)
        assert np.degrees(np.arccos(min(1.0, _understood(told) @ up))) < 10.0, told
        assert "." not in told


@pytest.mark.parametrize("count", [9, 20, 40])
def test_the_directions_of_other_plans_are_told_apart(count: int) -> None:
    assert len({described(v) for _, v in directions(count)}) == count


def test_a_tilt_is_told_towards_the_side_that_it_is_to() -> None:
    def told(degrees: float) -> str:
        angle = np.radians(degrees)
        return described(np.array([np.cos(angle), np.sin(angle), 0.0]), NAMES)

    assert told(1.0) == "A up"
    assert told(12.0) == "A up, tilted 10° towards C"
    assert told(20.0) == "A up, tilted 20° towards C"
    assert told(30.0) == "edge A/C up, tilted 15° towards A"
    assert told(60.0) == "edge A/C up, tilted 15° towards C"
