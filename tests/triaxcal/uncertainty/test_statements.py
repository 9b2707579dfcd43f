"""What nobody can tell from a recording."""

from __future__ import annotations

import pytest

from triaxcal.errors import InvalidData
from triaxcal.uncertainty import Stated


@pytest.mark.parametrize("value", [-1e-6, float("nan"), float("inf")])
def test_uncertainties_that_are_none_are_refused(value: float) -> None:
    with pytest.raises(InvalidData, match="reference"):
        Stated(reference=value)
    with pytest.raises(InvalidData, match="thermometer"):
        Stated(thermometer_k=value)


def test_a_place_gives_the_uncertainty_of_gravity_there_unless_it_was_measured() -> None:
    assert Stated.at(50.0, 200.0).reference == pytest.approx(43.2e-6, rel=1e-3)
    assert Stated.at(50.0, 200.0, 2e-8).reference == 2e-8
    assert Stated.at(None, None).reference is None
