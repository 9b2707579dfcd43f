"""Recordings of one unit are told from those of two by the shape of the triad."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from triaxcald.likeness import Shape, shape_by_poses, shape_in, unlike_shapes

KNOWN = 1e-5
"""Standard error of scale factors, as a share, and of misalignments [rad]."""


def _shape(
    scale_factor: tuple[float, ...] = (2.0, 2.0, 2.0),
    misalignment: tuple[float, ...] = (0.0, 0.0, 0.0),
    known: float = KNOWN,
    dof: float = 20.0,
) -> Shape:
    k = np.array(scale_factor)
    return Shape.of(k, np.array(misalignment), np.diag(np.concatenate([k * known, np.full(3, known)]) ** 2), dof)


def _asked(one: Shape | None, another: Shape | None) -> bool:
    return bool(unlike_shapes("a.csv", "b.csv", one, another))


@pytest.mark.parametrize(
    "other",
    [
        _shape((2.1, 2.1, 2.1)),  # temperature scales all axes alike
        _shape((2.0, 2.006, 2.0)),  # and one of them a little more
        _shape((-2.0, -2.0, -2.0)),  # signs are asked about elsewhere
        _shape(misalignment=(2e-3, -2e-3, 1e-3)),
    ],
)
def test_what_age_and_temperature_do_to_a_unit_is_not_asked_about(other: Shape) -> None:
    assert not _asked(_shape(), other)


def test_a_unit_of_other_misalignment_or_of_other_ratios_of_scale_factors_is_asked_about_in_one_line() -> None:
    (line,) = unlike_shapes("a.csv", "b.csv", _shape(), _shape((2.0, 2.02, 2.02), (8e-3, 0.0, -5e-3)))
    assert line.startswith("a.csv and b.csv: misalignment differs by up to 8 mrad and the ratio of scale factors by ")
    assert line.endswith("by up to 1 %, more than age and temperature make of one unit: the same unit?")
    assert _asked(_shape(), _shape(misalignment=(0.0, 8e-3, 0.0)))
    assert _asked(_shape(), _shape((2.0, 2.0, 2.06)))


def test_no_axis_tells_more_than_another() -> None:
    apart = [
        _asked(_shape(), _shape(tuple(2.0 + d * (i == axis) for i in range(3))))
        for d in (0.02, 0.04)
        for axis in range(3)
    ]
    assert apart == [False] * 3 + [True] * 3


def test_what_the_poses_do_not_know_is_not_asked_about() -> None:
    far = (8e-3, 0.0, -5e-3)
    assert not _asked(_shape(), _shape(misalignment=far, known=5e-3))
    assert _asked(_shape(), _shape(misalignment=far, known=1e-3))
    assert not _asked(_shape(), _shape(misalignment=far, known=1e-3, dof=1.0))
    assert _asked(_shape(), _shape(misalignment=far, dof=1.0))  # so well known that it does not matter
    assert not _asked(None, _shape(misalignment=far))
    assert not _asked(_shape(), None)
    assert shape_by_poses([], (1, 1, 1), 1.0) is None


def test_a_document_has_the_shape_that_it_says_it_knows() -> None:
    document: dict[str, Any] = {
        "scale_factor": [2.0, 2.0, 2.0],
        "misalignment": [8e-3, 0.0, -5e-3],
        "standard_error": {"scale_factor": [2e-5] * 3, "misalignment": [1e-5] * 3},
    }
    assert _asked(_shape(), shape_in(document))
    for errors in ({}, {"scale_factor": [2e-5] * 3, "misalignment": [None] * 3}, {"scale_factor": 1}, None):
        assert shape_in({**document, "standard_error": errors}) is None
    assert shape_in({**document, "scale_factor": [1e-300, 2.0, 2.0]}) is None
