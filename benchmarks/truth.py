"""What the benchmarks and the tests know for certain: units, poses, and the Cramér–Rao bound by its own algebra.

Nothing here calls the fit. The bound is that of the whole likelihood: nine parameters of the unit and two angles of
attitude for every pose, from ``u = K (R a + b)`` and the covariance of each pose's mean.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from triaxcal.model.sensor import Sensor
from triaxcal.poses.pose import Pose

PAPER_UNIT = Sensor(
    np.array([-2.410618, -2.403823, -2.371761]),
    np.array([625.454406e-5, 404.734018e-5, -65.046441e-5]),
    np.array([564.518583e-5, -288.4559e-5, 463.952349e-5]),
)
PARAMETERS = tuple(f"{group}{axis}" for group in ("k", "a", "b") for axis in "xyz")


def plan(count: int) -> np.ndarray:
    """(count,3) directions of up: the paper's 14, the 26, or a spiral of golden angles."""
    corners = np.array(list(itertools.product((1.0, 0.0, -1.0), repeat=3)))
    sides = np.abs(corners).sum(axis=1)
    cube = np.concatenate([corners[sides == k] / np.sqrt(k) for k in (1, 3, 2)])
    if count in (14, 26):
        return cube[:count]
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    r = np.sqrt(1 - z**2)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)


@dataclass(frozen=True)
class Condition:
    """A unit in so many poses; ``error_g`` (n,3) is the noise of the pose means, by pose and axis, in g."""

    name: str
    unit: Sensor
    ups: np.ndarray
    error_g: np.ndarray

    @property
    def truth(self) -> np.ndarray:
        return np.concatenate([self.unit.scale_factor, self.unit.misalignment, self.unit.bias])

    @property
    def signs(self) -> list[float]:
        return np.sign(self.unit.scale_factor).tolist()

    @property
    def error(self) -> np.ndarray:
        """(n,3) in output units."""
        return np.broadcast_to(self.error_g, self.ups.shape) * np.abs(self.unit.scale_factor)

    def draw(self, seed: int) -> tuple[list[Pose], np.ndarray]:
        """Poses whose covariance is known, and the noise (n,3) that is in their means, output units."""
        noise = np.random.default_rng([seed, 20]).standard_normal(self.ups.shape) * self.error
        return self.poses(noise), noise

    def poses(self, noise: np.ndarray) -> list[Pose]:
        clean = (self.ups @ self.unit.axes.T + self.unit.bias) * self.unit.scale_factor
        return [
            Pose(float(i), i + 1.0, 1000, u, np.diag(e**2), 1e6)
            for i, (u, e) in enumerate(zip(clean + noise, self.error, strict=True))
        ]


def bound_and_best(c: Condition) -> tuple[np.ndarray, np.ndarray]:
    """The bound (9,9), and the matrix (9,3n) that makes of the noise the error of the estimator that attains it.

    That estimator is linear and knows the truth; it serves as the control variate of the Monte Carlo.
    """
    n = len(c.ups)
    k = c.unit.scale_factor
    ax, ay, az = c.unit.misalignment
    whole = np.zeros((3 * n, 9 + 2 * n))
    for i, a in enumerate(c.ups):
        row = slice(3 * i, 3 * i + 3)
        along = np.array([a[0] + az * a[1] + ay * a[2], a[1] + ax * a[2], a[2]])
        whole[row, 0:3] = np.diag(along + c.unit.bias)
        whole[row, 3:6] = [[0, k[0] * a[2], k[0] * a[1]], [k[1] * a[2], 0, 0], [0, 0, 0]]
        whole[row, 6:9] = np.diag(k)
        # Two directions across a, which its attitude moves it along.
        across = np.linalg.svd(a[None])[2][1:]
        for t, v in enumerate(across):
            turned = np.array([v[0] + az * v[1] + ay * v[2], v[1] + ax * v[2], v[2]])
            whole[row, 9 + 2 * i + t] = k * turned
    weighted = whole / c.error.ravel()[:, None]
    size = np.linalg.norm(weighted, axis=0)
    estimator = np.linalg.pinv(weighted / size, rcond=1e-15) / size[:, None]
    best = estimator[:9] / c.error.ravel()
    return estimator[:9] @ estimator[:9].T, best


def information(unit: Sensor, ups: np.ndarray, error: np.ndarray) -> np.ndarray:
    """(9,9) of nine parameters, by pose: what is known along the normal of the ellipsoid is all that attitude leaves.

    ``ups`` (n,3) and ``error`` (n,3) in output units. The inverse is the bound again, for any number of poses.
    """
    k = unit.scale_factor
    ax, ay, az = unit.misalignment
    x, y, z = ups.T
    along = np.stack([x + az * y + ay * z, y + ax * z, z], axis=1)
    normal = np.linalg.solve((k[:, None] * unit.axes).T, ups.T).T
    angles = np.stack([normal[:, 1] * k[1] * z, normal[:, 0] * k[0] * z, normal[:, 0] * k[0] * y], axis=1)
    rows = np.concatenate([normal * (along + unit.bias), angles, normal * k], axis=1)
    return np.asarray(rows.T @ (rows / np.sum((normal * error) ** 2, axis=1)[:, None]))


def _unit(
    k: tuple[float, ...] = (2.4, 2.3, 2.5),
    angles: tuple[float, ...] = (6e-3, 4e-3, -1e-3),
    b: tuple[float, ...] = (6e-3, -3e-3, 5e-3),
) -> Sensor:
    return Sensor(np.array(k), np.array(angles), np.array(b))


LEANING = tuple(np.tan(np.radians([25.0, -25.0, 25.0])).tolist())


def covariates() -> Iterator[Condition]:
    """Everything that the claim about the bound names, alone and together."""
    for sigma in (1e-6, 1e-5, 1e-4, 1e-3):
        for count in (14, 26, 20):
            yield Condition(f"{count} poses, {sigma:g} g", PAPER_UNIT, plan(count), np.array(sigma))
    by_axis = np.array([1e-5, 3e-5, 3e-4])
    yield Condition("noise 1 : 3 : 30 by axis, 14 poses", PAPER_UNIT, plan(14), by_axis)
    yield Condition("noise 1 : 3 : 30 by axis, 26 poses", PAPER_UNIT, plan(26), by_axis)
    yield Condition("noise 1 : 1 : 100 by axis, 26 poses", PAPER_UNIT, plan(26), np.array([1e-5, 1e-5, 1e-3]))
    for count in (14, 26):
        by_pose = 1e-5 * np.geomspace(1, 30, count)[np.random.default_rng(0).permutation(count)][:, None]
        yield Condition(f"noise 1 to 30 by pose, {count} poses", PAPER_UNIT, plan(count), by_pose)
        uneven = by_pose * np.array([1.0, 2.0, 5.0])
        yield Condition(f"noise by pose and axis, {count} poses", PAPER_UNIT, plan(count), uneven)
    ten = _unit(k=(10.0, 1.0, 3.0))
    yield Condition("sensitivities 10 : 1, equal in g", ten, plan(26), np.array(1e-4))
    yield Condition("sensitivities 10 : 1, equal in output", ten, plan(26), 1e-5 * np.array([1.0, 10.0, 3.3]))
    counts = _unit(k=(2000.0, 2100.0, 1900.0), b=tuple(2**23 / k for k in (2000.0, 2100.0, 1900.0)))
    yield Condition("offset 2^23 counts", counts, plan(26), np.array(1e-5))
    yield Condition("bias 0.5 g", _unit(b=(0.5, -0.5, 0.5)), plan(14), np.array(1e-4))
    yield Condition("25° off square, 14 poses", _unit(angles=LEANING), plan(14), np.array(1e-4))
    yield Condition("25° off square, 26 poses", _unit(angles=LEANING), plan(26), np.array(1e-4))
    yield Condition("signs + − +", _unit(k=(2.4, -2.3, 2.5)), plan(14), np.array(1e-4))
    yield Condition("signs − + −", _unit(k=(-2.4, 2.3, -2.5)), plan(26), np.array(1e-4))
    yield hard()


def hard() -> Condition:
    """All of it at once."""
    unit = _unit(k=(-10.0, 1.0, 3.0), angles=LEANING, b=(0.5, -0.5, 0.5))
    by_pose = 1e-5 * np.geomspace(1, 10, 26)[np.random.default_rng(1).permutation(26)][:, None]
    return Condition("all at once, 26 poses", unit, plan(26), by_pose * np.array([1.0, 2.0, 3.0]))
