"""Local gravity, judged by the tables of the reference system and by absolute measurements."""

from __future__ import annotations

import pytest

from triaxcal.errors import InvalidData
from triaxcal.model.gravity import ANOMALY_MPS2, local_gravity, local_gravity_g


@pytest.mark.parametrize(
    ("latitude_deg", "published"), [(0.0, 9.7803267715), (45.0, 9.806199203), (90.0, 9.8321863685)]
)
def test_gravity_on_the_ellipsoid_is_that_of_moritz_tables(latitude_deg: float, published: float) -> None:
    assert local_gravity(latitude_deg, 0.0) == pytest.approx(published, abs=1e-9)
    assert local_gravity(-latitude_deg, 0.0) == local_gravity(latitude_deg, 0.0)


@pytest.mark.parametrize(
    ("latitude_deg", "height_m", "measured"),
    [
        # Tate 1966, J. Res. NBS 70C; ICAG-2001, site A (Vitushkin et al. 2002, Metrologia 39:407).
        pytest.param(39.13, 132.0, 9.801018, id="Gaithersburg"),
        pytest.param(48.83, 57.0, 9.809257012, id="Sèvres"),
    ],
)
def test_absolute_gravimeters_agree_within_the_stated_uncertainty(
    latitude_deg: float, height_m: float, measured: float
) -> None:
    assert abs(local_gravity(latitude_deg, height_m) - measured) < 2 * ANOMALY_MPS2


def test_gravity_falls_by_0_3086_milligal_a_metre() -> None:
    fall = local_gravity(45.0, 0.0) - local_gravity(45.0, 100.0)
    assert fall == pytest.approx(100 * 0.3086e-5, rel=1e-3)


def test_the_uncertainty_is_the_scatter_of_gravity_anomalies() -> None:
    _, uncertainty = local_gravity_g(50.0, 200.0)
    assert uncertainty == pytest.approx(43.2e-6, rel=1e-3)


@pytest.mark.parametrize(("latitude_deg", "height_m"), [(91.0, 0.0), (0.0, 1e5), (float("nan"), 0.0)])
def test_places_that_are_not_on_earth_are_refused(latitude_deg: float, height_m: float) -> None:
    with pytest.raises(InvalidData, match="expected"):
        local_gravity(latitude_deg, height_m)
