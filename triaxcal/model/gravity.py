"""Local gravity from latitude and height, with its uncertainty."""

from __future__ import annotations

import math

from triaxcal.errors import InvalidData

STANDARD_GRAVITY = 9.80665
"""m/s² in 1 g."""

# Geodetic Reference System 1980 (Moritz 2000, J. Geodesy 74:128).
_EQUATOR_MPS2 = 9.7803267715
_SOMIGLIANA_K = 0.001931851353  # k of Somigliana's formula, GRS80
_E2 = 0.00669438002290  # first eccentricity squared, GRS80
_FLATTENING = 1 / 298.257222101  # f, GRS80
_RADIUS_M = 6_378_137.0  # semi-major axis a, GRS80
_M = 0.00344978600308
"""Centrifugal acceleration over gravity at the equator."""
ANOMALY_MPS2 = 1795**0.5 * 1e-5
"""rms over the Earth of the difference between gravity and this formula: 42 mGal
(Tscherning and Rapp 1974: point variance of free-air anomalies 1795 mGal²)."""
HEIGHTS_M = (-500.0, 9000.0)
"""From below the lowest shore on land (the Dead Sea, −430 m) to above the highest
summit (8849 m). A height beyond them is a mistake, or in other units."""


def local_gravity(latitude_deg: float, height_m: float) -> float:
    """Normal gravity in m/s² at a geodetic latitude and a height above sea level.

    Somigliana's formula on the ellipsoid, continued upwards to the second
    degree of the height (Moritz 2000). True gravity differs from it by the free-air
    anomaly, `ANOMALY_MPS2` rms. Raises InvalidData outside ±90 degrees
    and −500 … 9000 m.
    """
    if not -90 <= latitude_deg <= 90:
        raise InvalidData(f"latitude {latitude_deg:g}: expected degrees between -90 and 90")
    if not HEIGHTS_M[0] <= height_m <= HEIGHTS_M[1]:
        raise InvalidData(f"height {height_m:g}: expected metres between {HEIGHTS_M[0]:g} and {HEIGHTS_M[1]:g}")
    s2 = math.sin(math.radians(latitude_deg)) ** 2
    on_ellipsoid = _EQUATOR_MPS2 * (1 + _SOMIGLIANA_K * s2) / math.sqrt(1 - _E2 * s2)
    h = height_m / _RADIUS_M
    return on_ellipsoid * (1 - 2 * (1 + _FLATTENING + _M - 2 * _FLATTENING * s2) * h + 3 * h**2)


def local_gravity_g(latitude_deg: float, height_m: float) -> tuple[float, float]:
    """`local_gravity` and its standard uncertainty, in units of standard gravity
    (9.80665 m/s²)."""
    return local_gravity(latitude_deg, height_m) / STANDARD_GRAVITY, ANOMALY_MPS2 / STANDARD_GRAVITY
